"""The motion of a video: which person is followed, interrupted runs, and what is written."""

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax import cli
from humangs_jax.apps import video_motion
from humangs_jax.apps.video_motion import LONGER_SIDE, fit_video, motion_beside, smooth_faces
from humangs_jax.avatar.video import write_video
from humangs_jax.body.motion import Motion
from humangs_jax.capture.detection.face_and_hands import Hand
from humangs_jax.capture.detection.people import Crop, Detection, Landmarks
from humangs_jax.capture.fitting.motion_fit import MotionFit
from humangs_jax.motion import load_motion, made_from_of, save_motion
from humangs_jax.motion.skeleton import shipped_joints

COUNT = 12


def seen_at(x, side=16.0):
    """Returns a detected person whose hips are at column `x`."""
    hips = np.asarray([x, 16.0])
    return Landmarks(
        pixels=np.tile(hips, (33, 1)),
        visibility=np.ones(33),
        world=np.zeros((33, 3)),
        presence=1.0,
        mask=np.ones((256, 256)),
        crop=Crop(hips, side, 0.0),
        again=Detection(1.0, hips, hips - np.asarray([0.0, side / 2.5])),
    )


class Scene:
    """A made-up detector: a large person walks to the right, a smaller one stands at the left."""

    def __init__(self):
        self.looks, self.frame, self.hidden, self.stop = 0, -1, (), None

    def people(self):
        large = [] if self.frame in self.hidden else [seen_at(16.0 + self.frame)]
        return [*large, seen_at(4.0, 8.0)]

    def landmarks(self, photo, crop):
        self._look(photo)
        near = min(self.people(), key=lambda p: abs(p.crop.center[0] - crop.center[0]))
        far = abs(near.crop.center[0] - crop.center[0]) > 8
        return near._replace(presence=0.0) if far else near

    def face(self, photo, body):
        return None if self.frame == 3 else np.full(51, 0.05 * self.frame, np.float32)

    def hands(self, photo, body, visibility):
        pixels = np.tile([body[0, 0] + 2, 20.0], (21, 1))
        return Hand(pixels, np.zeros((21, 3)), 0.75), None

    def find(self, networks, photo):
        self._look(photo)
        return self.people()

    def _look(self, photo):
        self.looks += 1
        self.frame = int(np.round(photo.mean() * 255 / 10))  # frames are as bright as their number
        if self.stop is not None and self.frame == self.stop:
            raise KeyboardInterrupt


@pytest.fixture
def scene(tmp_path, monkeypatch):
    frames = np.ones((COUNT, 32, 64, 3)) * (np.arange(COUNT) * 10 / 255)[:, None, None, None]
    write_video(tmp_path / "me.mp4", list(frames), 10)
    scene = Scene()
    monkeypatch.setattr(video_motion, "Networks", lambda: scene)
    monkeypatch.setattr(video_motion, "find_people", scene.find)
    monkeypatch.setattr(video_motion, "FaceAndHands", lambda: scene)

    def fit(body, keypoints, K, fps, *, betas, height, watch):
        scene.keypoints, scene.K, scene.fps, scene.betas = keypoints, K, fps, betas
        count = len(keypoints.points)
        motion = Motion(jnp.zeros((count, 55, 3)), jnp.zeros((count, 3)), fps)
        return MotionFit(
            np.zeros(22), motion, np.zeros((count, 55, 3)), np.eye(4), np.zeros((count, 4))
        )

    monkeypatch.setattr(video_motion, "fit_motion", fit)
    return scene


def hips_of(scene):
    return scene.keypoints.points[:, 0, 0]


def test_the_largest_person_is_followed_from_frame_to_frame(scene, tmp_path):
    found = fit_video(tmp_path / "me.mp4", focal_mm=43.2666)
    np.testing.assert_allclose(hips_of(scene), 16.5 + np.arange(COUNT), atol=1.01)
    assert scene.looks == COUNT and scene.fps == pytest.approx(10)
    assert found.size == (64, 32) and max(found.size) <= LONGER_SIDE
    assert found.K[0, 0] == pytest.approx(np.hypot(64, 32), rel=1e-3)  # 35-mm film's diagonal


def test_hands_and_face_are_found_with_the_body(scene, tmp_path):
    motion = fit_video(tmp_path / "me.mp4").fit.motion
    names = scene.keypoints.set.names
    left, right = (names.index(f"{side}_index_tip") for side in ("left", "right"))
    np.testing.assert_allclose(
        scene.keypoints.points[:, left, 0], scene.keypoints.points[:, 0, 0] + 2
    )
    assert (scene.keypoints.confidences[:, left] == 0.75).all()
    assert (scene.keypoints.confidences[:, right] == 0).all()  # this one was not seen
    # the face of the frame that does not show it lies between the others
    expected = 0.05 * np.arange(COUNT)
    middle = slice(1, -1)  # the smoothing bends the ends
    np.testing.assert_allclose(
        np.asarray(motion.expressions_of(("jawOpen",)))[middle, 0], expected[middle], atol=1e-3
    )
    assert len(motion.expression_names) == 51


def test_a_video_that_hardly_shows_a_face_has_no_expressions():
    faces = np.full((40, 51), np.nan, np.float32)
    faces[:3] = 0.5
    assert smooth_faces(faces, 30.0) is None
    faces[:5] = 0.5
    np.testing.assert_allclose(smooth_faces(faces, 30.0), 0.5)


def test_another_person_is_followed_by_number(scene, tmp_path):
    fit_video(tmp_path / "me.mp4", person=1)
    np.testing.assert_allclose(hips_of(scene), 4.5)
    with pytest.raises(ValueError, match="--person 2: at most 2 people are seen"):
        fit_video(tmp_path / "me.mp4", person=2)


def test_who_is_hidden_for_some_frames_is_found_again_and_nobody_else_is_taken(scene, tmp_path):
    scene.hidden = (5, 6)
    fit_video(tmp_path / "me.mp4")
    lost = scene.keypoints.confidences.max(1) == 0
    assert np.flatnonzero(lost).tolist() == [5, 6]
    np.testing.assert_allclose(hips_of(scene)[7:], 16.5 + np.arange(7, COUNT), atol=1.01)


def test_an_interrupted_run_goes_on_where_it_was(scene, tmp_path):
    kept = tmp_path / "m.seen.npz"
    scene.stop = 7
    with pytest.raises(KeyboardInterrupt):
        fit_video(tmp_path / "me.mp4", kept=kept)
    assert kept.exists()
    scene.stop, scene.looks = None, 0
    fit_video(tmp_path / "me.mp4", kept=kept)
    assert scene.looks == COUNT - 7
    np.testing.assert_allclose(hips_of(scene), 16.5 + np.arange(COUNT), atol=1.01)
    # what was seen of somebody else does not count
    fit_video(tmp_path / "me.mp4", kept=kept, person=1)
    np.testing.assert_allclose(hips_of(scene), 4.5)
    np.savez(kept, other=np.zeros(3))
    with pytest.raises(ValueError, match=r"m\.seen\.npz: exists, and is not ours"):
        fit_video(tmp_path / "me.mp4", kept=kept)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"height": 172.0}, "expected metres, 0.4 to 2.5"),
        ({"focal_mm": 1.0}, "expected millimetres"),
        ({"person": -1}, "expected a number from 0"),
        ({"height": 1.7, "rest_joints": np.zeros((55, 3))}, "expected no avatar with it"),
    ],
)
def test_options_out_of_range_are_refused_before_the_work(scene, tmp_path, options, problem):
    with pytest.raises(ValueError, match=problem):
        fit_video(tmp_path / "me.mp4", **options)
    assert scene.looks == 0


def test_the_motion_beside_a_video_is_found_once_for_an_avatar(scene, tmp_path):
    joints = np.asarray(shipped_joints(), np.float32)
    motion = motion_beside(tmp_path / "me.mp4", joints, None)
    assert len(motion.translations) == COUNT and scene.betas is not None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["me.motion.npz", "me.mp4"]
    looks = scene.looks
    motion_beside(tmp_path / "me.mp4", joints, None)
    assert scene.looks == looks
    # a larger avatar is another body
    motion_beside(tmp_path / "me.mp4", 1.1 * joints, None)
    assert scene.looks > looks
    # a file of others stays
    save_motion(tmp_path / "me.motion.npz", load_motion())
    with pytest.raises(ValueError, match=r"me\.motion\.npz: exists, and is not of this command"):
        motion_beside(tmp_path / "me.mp4", joints, None)


def test_a_motion_knows_what_it_was_made_from(tmp_path):
    save_motion(tmp_path / "a.npz", load_motion(), made_from="abc")
    assert made_from_of(tmp_path / "a.npz") == "abc"
    assert len(load_motion(tmp_path / "a.npz").translations) == len(load_motion().translations)
    save_motion(tmp_path / "b.npz", load_motion())
    assert made_from_of(tmp_path / "b.npz") is None
    (tmp_path / "c.npz").write_text("no archive")
    assert made_from_of(tmp_path / "c.npz") is None


def test_the_command_writes_the_motion_and_refuses_the_files_of_others(scene, tmp_path, capsys):
    video, out = str(tmp_path / "me.mp4"), tmp_path / "m.npz"
    assert cli.execute(["motion", video, "--out", str(out), "--height", "1.7"]) == 0
    message = capsys.readouterr().out
    assert f"{COUNT} frames at 10 a second" in message and "--motion" in message
    assert len(load_motion(out).translations) == COUNT and not list(tmp_path.glob("*.seen.npz"))
    # the same again replaces it; a motion that somebody else made stays
    assert cli.execute(["motion", video, "--out", str(out)]) == 0
    save_motion(tmp_path / "theirs.npz", load_motion())
    code = cli.execute(["motion", video, "--out", str(tmp_path / "theirs.npz")])
    assert code == cli.BAD_USAGE and "was not found in a video" in capsys.readouterr().err
    # what cannot be a video is one line, before any work
    looks = scene.looks
    (tmp_path / "text.mp4").write_text("no video")
    for name in ("text.mp4", "missing.mp4"):
        assert cli.execute(["motion", str(tmp_path / name), "--out", str(out)]) == cli.BAD_DATA
        message = capsys.readouterr().err
        assert name in message and message.strip().count("\n") == 0
    assert scene.looks == looks
