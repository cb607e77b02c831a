"""Synchronised videos become a capture; of one video, sharp and different frames become photos."""

import numpy as np
import pytest

from humangs_jax.avatar.video import write_video
from humangs_jax.capture.calibration import videos
from humangs_jax.capture.calibration.frame_choice import (
    NOTHING_NEW,
    PHOTOS,
    choose_frames,
    looked_at,
)
from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.calibration.videos import grey_frames, write_frames
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos
from humangs_jax.io.images import read_image
from humangs_jax.io.reading import InvalidFileError, Limits, set_limits
from tests.capture import calibration_files as written

NAMES, FRAMES = ("a", "b"), 5
LEVELS = 4 / 255
"""Largest error of a grey frame after compression by H.264."""


def grey(camera, frame):
    return (40 + 20 * camera + 30 * frame) / 255


def write_rig(folder, masks=False):
    """Writes a calibration with a lens, and a video of grey frames of 64 x 48 for each camera."""
    K, poses = written.scene(len(NAMES))
    written.write_calibration_full(folder / "rig.json", K, poses, NAMES)
    shape = written.HEIGHT, written.WIDTH, 3
    for kind in ("videos", "masks") if masks else ("videos",):
        (folder / kind).mkdir()
        for camera, name in enumerate(NAMES):

            def level(frame, kind=kind, camera=camera):
                return 1.0 if kind == "masks" else grey(camera, frame)

            write_video(
                folder / kind / f"{name}.mp4", [np.full(shape, level(f)) for f in range(FRAMES)], 30
            )
    return folder / "rig.json", folder / "videos", folder / "new" / "out"


def test_frames_of_several_videos_become_a_capture(tmp_path):
    rig = write_rig(tmp_path, masks=True)
    report = import_cameras(*rig, masks=tmp_path / "masks", up="+y", every=2)
    assert (report.cameras, report.frames, report.views) == (2, 3, 6)
    photos = load_photos(rig[2])
    assert photos.frames.tolist() == [0, 0, 1, 1, 2, 2]
    for view in range(6):
        np.testing.assert_allclose(
            photos.images[view], grey(view % 2, 2 * (view // 2)), atol=LEVELS
        )
    assert photos.masks is not None and photos.masks.min() > 0.98
    # nothing is left of the frames
    assert sorted(p.name for p in rig[2].parent.iterdir()) == ["out"]
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    report = import_cameras(*rig, masks=tmp_path / "masks", up="+y", frames=1, overwrite=True)
    assert (report.frames, report.views) == (1, 2)


def test_what_is_wrong_with_a_video_is_one_line(tmp_path):
    rig = write_rig(tmp_path)
    video = rig[1] / "b.mp4"
    whole = video.read_bytes()
    # of a video
    playlists = (
        b"#EXTM3U\n#EXTINF:1,\na.mp4\n",
        b"ffconcat version 1.0\nfile a.mp4\n",
    )
    for content in (b"", whole[: len(whole) // 2], bytes(range(256)) * 40, *playlists):
        video.write_bytes(content)
        for read in (lambda: import_cameras(*rig, up="+y"), lambda: list(grey_frames(video, 480))):
            with pytest.raises(CaptureError, match=r"b\.mp4: not a readable video") as caught:
                read()
            assert "\n" not in str(caught.value) and not rig[2].exists()
    video.write_bytes(whole)
    (rig[1] / "b.mov").write_bytes(whole)
    with pytest.raises(CaptureError, match=r"camera b has b.mov already"):
        import_cameras(*rig, up="+y")
    (rig[1] / "b.mov").unlink()
    (tmp_path / "masks").mkdir()
    with pytest.raises(CaptureError, match=r"a: expected a video of photos and one of masks"):
        import_cameras(*rig, up="+y", masks=tmp_path / "masks")
    with pytest.raises(ValueError, match="every 0"):
        import_cameras(*rig, up="+y", every=0)
    written.write_photos(tmp_path / "photos", [f"{name}.png" for name in NAMES])
    with pytest.raises(CaptureError, match="frames can be chosen of videos only"):
        import_cameras(rig[0], tmp_path / "photos", rig[2], up="+y", every=2)


@pytest.mark.parametrize("name", ["a%03d", "50% %s"])
def test_signs_of_patterns_in_a_name_mean_themselves(name, tmp_path):
    video = tmp_path / f"{name}.mp4"
    write_video(video, [np.full((16, 16, 3), level) for level in (0.2, 0.5, 0.8)], 10)
    assert video.is_file()
    folder = tmp_path / "frames%d" / name
    videos.split_video(video, folder)
    assert sorted(file.name for file in folder.iterdir()) == [f"{i:08d}.png" for i in range(3)]


def test_frames_of_videos_have_a_budget_of_pixels(tmp_path):
    rig, size = write_rig(tmp_path), written.WIDTH * written.HEIGHT
    try:
        set_limits(Limits(video_pixels=7 * size))
        with pytest.raises(
            CaptureError, match=r"b.mp4: .* pixels in the frames .*: the limit video_pixels is"
        ):
            import_cameras(*rig, up="+y")
        assert not rig[2].exists() and not list(rig[2].parent.glob("*"))
        assert import_cameras(*rig, up="+y", frames=3).views == 6
        set_limits(Limits(video_pixels=4 * size))
        with pytest.raises(
            CaptureError, match=r"a\.mp4: .* pixels in the frames .*: the limit video_pixels is"
        ):
            list(grey_frames(rig[1] / "a.mp4", 480))
    finally:
        set_limits(None)


# Which frames become photos
# -------------------------------------------------------------------------------------------

SIZE = 120, 160


def scene(seed):
    """Returns grey levels of random squares, which have sharp edges everywhere."""
    coarse = np.random.default_rng(seed).uniform(30, 220, (SIZE[0] // 10, SIZE[1] // 10))
    return np.kron(coarse, np.ones((10, 10)))


def blurred(frame):
    for axis in (0, 1):
        frame = sum(np.roll(frame, i, axis) for i in (-1, 0, 1)) / 3
    return frame


def noisy(frame, seed, levels=6):
    return np.clip(
        frame + np.random.default_rng(seed).normal(0, levels, frame.shape), 0, 255
    ).astype(np.uint8)


def test_sharp_frames_of_every_scene_are_chosen():
    """Of three scenes of 64 frames every fourth frame is sharp; some windows have no sharp one."""
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
    with pytest.raises(InvalidFileError, match="none of its 10 frames shows anything"):
        choose_frames(*looked_at(iter(frames)), PHOTOS)
    assert choose_frames(*looked_at(iter([*frames, noisy(scene(0), 0)])), PHOTOS) == [10]


def test_chosen_frames_are_those_of_the_video(tmp_path):
    levels = [0.1, 0.3, 0.5, 0.7, 0.9]
    write_video(tmp_path / "v.mp4", [np.full((16, 32, 3), level) for level in levels], 10)
    seen = list(grey_frames(tmp_path / "v.mp4", 16))
    assert {frame.shape for frame in seen} == {(8, 16)} and len(seen) == len(levels)
    assert np.all(np.diff([int(frame.mean()) for frame in seen]) > 30)
    write_frames(tmp_path / "v.mp4", tmp_path / "f", [1, 4])
    assert sorted(path.name for path in (tmp_path / "f").iterdir()) == [
        "frame_00000001.png",
        "frame_00000004.png",
    ]
    for frame in (1, 4):  # H.264 is off by a few levels
        image, _ = read_image(tmp_path / "f" / f"frame_{frame:08d}.png")
        np.testing.assert_allclose(image, levels[frame], atol=4 / 255)
