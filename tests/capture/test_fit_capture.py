import dataclasses
import json
import shutil

import numpy as np
import pytest
from changes import edit_json
from fit_people import POSES, default_body, observe

from humangs_jax.capture.fitting import files
from humangs_jax.capture.fitting.files import check_place, read_fit_record, write_fitted
from humangs_jax.capture.fitting.fit_capture import fit_photos
from humangs_jax.capture.keypoints.keypoints import COCO_WHOLEBODY_133, Keypoints
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import capture_from_arrays, load_capture, save_capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos

SIZE = 16
FRAMES = tuple(POSES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Returns (capture folder without body.npz, its keypoints, true joints).

    It has five frames of four views each, in random order.
    """
    joints, _, seen = observe(FRAMES, noise=2.0)
    order = np.random.default_rng(0).permutation(len(FRAMES) * 4)
    frames, views = order // 4, order % 4
    path = tmp_path_factory.mktemp("photos") / "me"
    K, pose = np.asarray(seen.K)[frames, views], np.asarray(seen.cam_from_world)[frames, views]
    images = np.full((len(order), SIZE, SIZE, 3), 0.5, np.float32)
    rest = np.zeros((len(FRAMES), 55, 3)), np.zeros((len(FRAMES), 3))
    save_capture(
        path,
        capture_from_arrays(
            images, K, pose, *rest, frames=[int(f) for f in frames], body=default_body()
        ),
    )
    (path / "body.npz").unlink()
    points, confidences = (np.asarray(x)[frames, views] for x in (seen.points, seen.confidences))
    return path, Keypoints(points, confidences, COCO_WHOLEBODY_133), joints


@pytest.fixture(scope="module")
def fitted(folder):
    return fit_photos(load_photos(folder[0]), folder[1], default_body())


@pytest.mark.slow
def test_views_are_sorted_by_their_frames(folder, fitted):
    errors = 1000 * np.linalg.norm(np.asarray(fitted.fit.joints) - folder[2], axis=-1)
    assert errors.mean() < 10
    report = fitted.report
    assert (
        fitted.capture.frame_count == len(FRAMES)
        and report.ok
        and len(report.views) == 4 * len(FRAMES)
    )
    assert report.errors["keypoint_error_px"].after == pytest.approx(1.1774 * 2.0, rel=0.1)
    assert json.loads(json.dumps(report.to_json()))["views"][0]["name"] == fitted.capture.names[0]


@pytest.mark.slow
def test_written_in_place_and_read_again(folder, fitted, tmp_path):
    path = copied(folder[0], tmp_path)
    described = (path / "capture.json").read_text()
    with pytest.raises(CaptureError, match="humangs fit"):
        load_capture(path)
    write_fitted(
        path, check_place(path, None, overwrite=False), fitted.capture, fitted.report, fitted.record
    )
    again = load_capture(path)
    np.testing.assert_array_equal(again.poses.rotations, fitted.capture.poses.rotations)
    np.testing.assert_array_equal(again.betas, fitted.capture.betas)
    assert json.loads((path / "capture.json").read_text()) == json.loads(described)
    record = read_fit_record(path / "fit.npz")
    np.testing.assert_array_equal(record.keypoints.points, folder[1].points)
    np.testing.assert_allclose(record.joint_std, fitted.record.joint_std, rtol=1e-6)
    assert record.names == again.names
    kind, own = record.keypoints.set, fitted.record.keypoints.set
    np.testing.assert_allclose(kind.certainty, own.certainty, rtol=1e-6)
    np.testing.assert_allclose(kind.offsets, own.offsets, atol=1e-7)
    with pytest.raises(ValueError, match=r"body\.npz exists"):
        check_place(path, None, overwrite=False)
    check_place(path, None, overwrite=True)


@pytest.mark.slow
def test_a_fit_in_place_is_written_whole_or_not_at_all(folder, fitted, tmp_path, monkeypatch):
    """The fit moved cameras and body together: one without the other is wrong."""
    path = copied(folder[0], tmp_path)
    write_fitted(path, path, fitted.capture, fitted.report, fitted.record)
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    moved = fitted.capture.cameras.cam_from_world.at[3, 0, 3].add(0.25)
    capture = dataclasses.replace(
        fitted.capture, cameras=replace(fitted.capture.cameras, cam_from_world=moved)
    )
    with monkeypatch.context() as broken, pytest.raises(OSError, match="disk full"):
        broken.setattr(files, "write_json", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
        write_fitted(path, path, capture, fitted.report)
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before
    write_fitted(path, path, capture, fitted.report)
    assert not (path / "fit.npz").exists()
    np.testing.assert_array_equal(load_capture(path).cameras.cam_from_world, moved)


@pytest.mark.slow
def test_a_body_in_a_folder_of_its_own_is_written_and_read_again(folder, fitted, tmp_path):
    path = copied(folder[0], tmp_path)
    edit_json(path / "capture.json", lambda d: d.update(body="params/body.npz"))
    for out in (None, tmp_path / "out"):
        target = check_place(path, out, overwrite=False)
        write_fitted(path, target, fitted.capture, fitted.report, fitted.record)
        np.testing.assert_array_equal(load_capture(target).betas, fitted.capture.betas)
        assert (target / "params" / "body.npz").is_file()


@pytest.mark.slow
def test_written_elsewhere_with_its_images_and_new_cameras(folder, fitted, tmp_path):
    moved = fitted.capture.cameras.cam_from_world.at[3, 0, 3].add(0.25)
    kept = np.full(fitted.capture.body.template.shape, 0.01, np.float32)
    capture = dataclasses.replace(
        fitted.capture,
        cameras=replace(fitted.capture.cameras, cam_from_world=moved),
        displacement=kept,
    )
    # the new folder is complete, and the old one unchanged
    target = check_place(folder[0], tmp_path / "out", overwrite=False)
    write_fitted(folder[0], target, capture, fitted.report)
    again = load_capture(target)
    np.testing.assert_array_equal(again.cameras.cam_from_world, moved)
    np.testing.assert_array_equal(again.displacement, kept)
    np.testing.assert_array_equal(again.images, load_photos(folder[0]).images)
    assert not (target / "fit.npz").exists() and not (folder[0] / "body.npz").exists()
    with pytest.raises(
        ValueError,
        match=(
            r"the folder is not empty.*which deletes body\.npz, capture\.json, fit\.json, images "
        ),
    ):
        check_place(folder[0], target, overwrite=False)
    # folders that are not ours, or that hold what is read, are refused
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "diary.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"holds no capture\.json"):
        check_place(folder[0], tmp_path / "other", overwrite=True)
    inside = target / "held_out"
    write_fitted(folder[0], inside, capture, fitted.report)
    for place, inputs in ((inside, ()), (folder[0], (None, target / "images"))):
        with pytest.raises(ValueError, match="lies in it and would be deleted"):
            check_place(place, target, overwrite=True, inputs=inputs)


@pytest.mark.slow
def test_frames_that_views_hardly_show_are_named(folder):
    points, confidences = folder[1].points, folder[1].confidences.copy()
    frames = load_photos(folder[0]).frames
    confidences[frames == 1] = 0
    confidences[np.flatnonzero(frames == 3)[1:]] = 0
    found = fit_photos(
        load_photos(folder[0]), Keypoints(points, confidences, folder[1].set), default_body()
    )
    blind, single = found.report.warnings[-2:]
    assert blind.startswith("frame 1: 0 keypoints are seen")
    assert single.startswith("frame 3: seen by one view")
    assert [v.keypoints > 0 for v in found.report.views if v.frame == 3] == [
        True,
        False,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, c: (p, 0 * c), "no view has a keypoint"),
        (lambda p, c: (p[:3], c[:3]), "keypoints of 3 views, but there are 20 photos"),
    ],
)
def test_what_cannot_be_fitted_is_one_error(folder, change, message):
    keypoints = Keypoints(*change(folder[1].points, folder[1].confidences), folder[1].set)
    with pytest.raises(ValueError, match=message):
        fit_photos(load_photos(folder[0]), keypoints, default_body())


def test_a_record_that_lacks_a_key_names_it_and_who_writes_such_files(tmp_path):
    np.savez(tmp_path / "fit.npz", set=np.asarray("coco17"), names=np.asarray(["a"]))
    with pytest.raises(
        CaptureError, match="points: missing: expected a file that `humangs fit` wrote"
    ):
        read_fit_record(tmp_path / "fit.npz")


def test_a_body_whose_root_is_not_first_is_refused(folder):
    body = default_body()
    strange = replace(body, parents=(1, -1, *body.parents[2:]))
    with pytest.raises(ValueError, match="root to be its first joint, got joint 1"):
        fit_photos(load_photos(folder[0]), folder[1], strange)


def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "me")
