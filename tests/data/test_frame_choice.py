"""Frames of one video: sharp ones, each of which shows something new."""

import numpy as np
import pytest

from humangs_jax.avatar.video import write_video
from humangs_jax.data.calibration.videos import NOTHING_NEW, PHOTOS, choose_frames, grey_frames, looked_at, write_frames
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io.images import read_image
from humangs_jax.io.reading import Limits, Refused, set_limits

SIZE = 120, 160


def scene(seed):
    """Levels of random squares: sharp edges everywhere."""
    coarse = np.random.default_rng(seed).uniform(30, 220, (SIZE[0] // 10, SIZE[1] // 10))
    return np.kron(coarse, np.ones((10, 10)))


def blurred(frame):
    for axis in (0, 1):
        frame = sum(np.roll(frame, i, axis) for i in (-1, 0, 1)) / 3
    return frame


def noisy(frame, seed, levels=6):
    return np.clip(frame + np.random.default_rng(seed).normal(0, levels, frame.shape), 0, 255).astype(np.uint8)


def test_sharp_frames_of_every_scene_are_chosen():
    """Three scenes of 64 frames, of which every fourth is sharp: some windows have none."""
    frames = [scene(i // 64) if i % 4 == 2 else blurred(scene(i // 64)) for i in range(192)]
    sharpness, thumbnails = looked_at(noisy(frame, i) for i, frame in enumerate(frames))
    chosen = choose_frames(sharpness, thumbnails, PHOTOS)
    assert [i // 64 for i in chosen] == [0, 1, 2] and all(i % 4 == 2 for i in chosen)
    assert chosen == choose_frames(sharpness, thumbnails, PHOTOS)
    assert len(choose_frames(sharpness, thumbnails, 2)) == 2


def test_nothing_that_only_noise_changes_is_new():
    frames = [noisy(scene(0), i) for i in range(20)]
    sharpness, thumbnails = looked_at(iter(frames))
    apart = np.sqrt(((thumbnails[1:] - thumbnails[0]) ** 2).mean(axis=-1))
    assert apart.max() < NOTHING_NEW
    assert len(choose_frames(sharpness, thumbnails, PHOTOS)) == 1


def test_black_frames_are_left_out_and_of_nothing_else_refused():
    frames = [np.zeros(SIZE, np.uint8)] * 10
    with pytest.raises(Refused, match="none of its 10 frames shows anything"):
        choose_frames(*looked_at(iter(frames)), PHOTOS)
    assert choose_frames(*looked_at(iter([*frames, noisy(scene(0), 0)])), PHOTOS) == [10]


def test_chosen_frames_are_those_of_the_video(tmp_path):
    levels = [0.1, 0.3, 0.5, 0.7, 0.9]
    write_video(tmp_path / "v.mp4", [np.full((16, 32, 3), level) for level in levels], 10)
    seen = list(grey_frames(tmp_path / "v.mp4", 16))
    assert {frame.shape for frame in seen} == {(8, 16)} and len(seen) == len(levels)
    assert np.all(np.diff([int(frame.mean()) for frame in seen]) > 30)
    write_frames(tmp_path / "v.mp4", tmp_path / "f", [1, 4])
    assert sorted(path.name for path in (tmp_path / "f").iterdir()) == ["frame_00000001.png", "frame_00000004.png"]
    for frame in (1, 4):  # H.264 is off by a few levels
        image, _ = read_image(tmp_path / "f" / f"frame_{frame:08d}.png")
        np.testing.assert_allclose(image, levels[frame], atol=4 / 255)


def test_what_is_no_video_or_too_much_of_one_is_one_line(tmp_path):
    video = tmp_path / "v.mp4"
    write_video(video, [np.full((16, 32, 3), 0.5)] * 6, 10)
    try:
        set_limits(Limits(video_pixels=5 * 16 * 32))
        with pytest.raises(CaptureError, match=r"v\.mp4: .* pixels in the frames .*: the limit video_pixels is"):
            list(grey_frames(video, 480))
    finally:
        set_limits(None)
    whole = video.read_bytes()
    for data in (b"", whole[: len(whole) // 2], b"ffconcat version 1.0\nfile v2.mp4\n", bytes(range(256)) * 40):
        video.write_bytes(data)
        with pytest.raises(CaptureError, match=r"v\.mp4: not a readable video") as caught:
            list(grey_frames(video, 480))
        assert "\n" not in str(caught.value)
