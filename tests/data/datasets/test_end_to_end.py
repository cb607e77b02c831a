"""Synthetic people in layouts of real data sets: preprocessed, loaded, reconstructed, animated.

Videos of them are fitted.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data.datasets import made_up
from data.datasets.dataset_files import calibration

from experiments.your_photos import landmarks_in
from humangs_jax import cli
from humangs_jax.apps.check import check_capture
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.video import write_video
from humangs_jax.body.library import load_body
from humangs_jax.body.model import pose_body, shape_body
from humangs_jax.capture.keypoints.keypoints import COCO_WHOLEBODY_133
from humangs_jax.data.capture import capture_from_arrays, load_capture
from humangs_jax.data.datasets.subject import FileBody, open_people
from humangs_jax.data.photos import load_photos
from humangs_jax.data.preprocess.run import PreprocessConfig, preprocess
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.presets import tiny
from humangs_jax.synthetic.subject import render_view

TIGHT_IOU = 0.9
"""Least mean overlap of the body with the silhouette of a person in tight clothes."""
SIZE = 256
SETTINGS = {
    "thuman": PreprocessConfig(
        "thuman", size=SIZE, views=6, factors=(1.75, 1.75), supersample=2, train=1, test=0
    ),
    "avatarrex": PreprocessConfig("avatarrex", size=SIZE),
    "thuman4": PreprocessConfig("thuman4", size=SIZE, every=1),
}
OPTIONS = {
    "thuman": {"seeds": made_up.SEEDS[:1], "texture_size": 512},
    "avatarrex": {"frames": 2, "cameras": 3, "size": (300, 408)},
    "thuman4": {"frames": 2, "cameras": 3, "size": (332, 288)},
}


@pytest.mark.slow
@pytest.mark.parametrize("layout", SETTINGS)
def test_a_person_goes_all_the_way(layout, tmp_path):
    source = made_up.WRITERS[layout](tmp_path / "raw", **OPTIONS[layout])
    body = FileBody.load(tmp_path / "raw" / "body.npz")
    report = preprocess(source, tmp_path / "scenes", body.file, SETTINGS[layout], progress=False)
    assert report.scenes == 1 and not report.skipped
    (person,) = open_people(tmp_path / "scenes", body)
    subject = person.subject
    assert len(subject) == (5 if layout == "thuman4" else 6)  # there a photo is missing
    capture = subject.capture(range(len(subject)), body, SIZE)
    checked = check_capture(capture, tmp_path / "check.png")
    overlap = [view.iou for view in checked.views]
    assert np.mean(overlap) > TIGHT_IOU and max(view.outside for view in checked.views) < 0.01, (
        overlap
    )
    config = tiny().with_runtime(token_capacity=64)
    avatar = reconstruct(init_humangs(jax.random.key(0), config), config, capture.select([0, 1]))
    last = capture.pose(capture.frame_count - 1)
    moved = animate(avatar, last)
    middle = np.asarray(moved.means).mean(axis=0)
    assert np.isfinite(np.asarray(moved.means)).all()
    # an untrained network, in its place
    assert np.linalg.norm(middle - np.asarray(last.translation)) < 1


FIT_ERROR = 0.015
"""Largest mean vertex error of bodies fitted to exact keypoints of three cameras, metres."""


@pytest.mark.slow
def test_videos_and_keypoints_become_a_capture_of_several_frames(tmp_path):
    """The command line imports and fits them: every frame has the person's pose."""
    names, frames, size = ("a", "b", "c"), 3, (288, 400)
    video = made_up.Video(tmp_path, made_up.SEEDS[0], frames, len(names), size, None)
    poses = np.stack([np.asarray(camera.cam_from_world, np.float64) for camera in video.cameras])
    video.R, video.T = poses[:, :3, :3], poses[:, :3, 3]  # of the world of the people, y up
    (tmp_path / "rig.json").write_text(json.dumps(calibration(names, video)))
    views = [
        [render_view(posed, camera, made_up.BACKGROUND) for camera in video.cameras]
        for posed in video.posed
    ]
    for part, kind in enumerate(("photos", "masks")):
        (tmp_path / kind).mkdir()
        for c, name in enumerate(names):
            shown = [np.broadcast_to(np.atleast_3d(of[c][part]), (*size[::-1], 3)) for of in views]
            write_video(tmp_path / kind / f"{name}.mp4", shown, 30)
    me, k = tmp_path / "me", tmp_path / "keypoints.npz"
    options = [
        "--images",
        tmp_path / "photos",
        "--masks",
        tmp_path / "masks",
        "--up=+y",
        "--out",
        me,
    ]
    assert cli.execute(["import", "cameras", str(tmp_path / "rig.json"), *map(str, options)]) == 0
    photos = load_photos(me)
    assert photos.frames.tolist() == np.repeat(np.arange(frames), len(names)).tolist()

    body = load_body()
    images, masks = (np.stack([view[i] for of in views for view in of]) for i in (0, 1))
    truth = capture_from_arrays(
        images,
        np.stack([camera.K for camera in video.cameras] * frames),
        np.concatenate([poses] * frames),
        np.stack([posed.rotations for posed in video.posed]),
        np.stack([posed.translation for posed in video.posed]),
        betas=video.posed[0].subject.betas,
        masks=masks,
        frames=photos.frames,
        body=body,
    )
    points = landmarks_in(truth)
    known = np.isfinite(points).all(-1)
    confidences = np.where(known, 0.9, 0.0)
    points = np.where(known[..., None], points, 0)
    np.savez(
        k, set=COCO_WHOLEBODY_133.name, names=photos.names, points=points, confidences=confidences
    )
    assert cli.execute(["fit", str(me), "--keypoints", str(k)]) == 0

    fitted = load_capture(me)
    assert fitted.frame_count == frames and fitted.frames.tolist() == photos.frames.tolist()
    vertices = [
        np.asarray(
            pose_body(body, shape_body(body, jnp.asarray(each.betas)), each.pose(f)).vertices
        )
        for each in (fitted, truth)
        for f in range(frames)
    ]
    found, expected = np.stack(vertices[:frames]), np.stack(vertices[frames:])
    assert np.linalg.norm(found - expected, axis=-1).mean() < FIT_ERROR
    moved = np.linalg.norm(np.diff(expected, axis=0), axis=-1).mean()
    assert moved > 4 * FIT_ERROR  # the frames differ
