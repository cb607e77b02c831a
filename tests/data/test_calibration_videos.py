"""Synchronised videos become the frames of a capture."""

import numpy as np
import pytest

from humangs_jax.avatar.video import write_video
from humangs_jax.data.calibration import videos
from humangs_jax.data.calibration.importing import import_cameras
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos
from humangs_jax.io.reading import Limits, set_limits
from tests.data import calibration_files as written

NAMES, FRAMES = ("a", "b"), 5
LEVELS = 4 / 255
"""Of a grey frame that H.264 has compressed."""


def grey(camera, frame):
    return (40 + 20 * camera + 30 * frame) / 255


def write_rig(folder, masks=False):
    """Calibration with a lens and a video of 64 x 48 for each camera, every frame of one grey."""
    K, poses = written.scene(len(NAMES))
    written.write_calibration_full(folder / "rig.json", K, poses, NAMES)
    shape = written.HEIGHT, written.WIDTH, 3
    for kind in ("videos", "masks") if masks else ("videos",):
        (folder / kind).mkdir()
        for camera, name in enumerate(NAMES):
            level = lambda frame, kind=kind, camera=camera: 1.0 if kind == "masks" else grey(camera, frame)
            write_video(folder / kind / f"{name}.mp4", [np.full(shape, level(f)) for f in range(FRAMES)], 30)
    return folder / "rig.json", folder / "videos", folder / "new" / "out"


def test_frames_of_several_videos_become_a_capture(tmp_path):
    rig = write_rig(tmp_path, masks=True)
    report = import_cameras(*rig, masks=tmp_path / "masks", up="+y", every=2)
    assert (report.cameras, report.frames, report.views) == (2, 3, 6)
    photos = load_photos(rig[2])
    assert photos.frames.tolist() == [0, 0, 1, 1, 2, 2]
    for view in range(6):
        np.testing.assert_allclose(photos.images[view], grey(view % 2, 2 * (view // 2)), atol=LEVELS)
    assert photos.masks is not None and photos.masks.min() > 0.98
    assert sorted(p.name for p in rig[2].parent.iterdir()) == ["out"]  # nothing is left of the frames
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    report = import_cameras(*rig, masks=tmp_path / "masks", up="+y", frames=1, overwrite=True)
    assert (report.frames, report.views) == (1, 2)


def test_what_is_wrong_with_a_video_is_one_line(tmp_path):
    rig = write_rig(tmp_path)
    whole = (rig[1] / "b.mp4").read_bytes()
    for content, words in (
        (b"", "b.mp4"),
        (whole[: len(whole) // 2], "b.mp4"),
        (bytes(range(256)) * 40, "b.mp4"),
        (b"#EXTM3U\n#EXTINF:1,\n/etc/hostname\n", "b.mp4"),
        (b"ffconcat version 1.0\nfile /etc/hostname\n", "b.mp4"),
    ):
        (rig[1] / "b.mp4").write_bytes(content)
        with pytest.raises(CaptureError, match=words) as caught:
            import_cameras(*rig, up="+y")
        assert "\n" not in str(caught.value) and not rig[2].exists()
    (rig[1] / "b.mp4").write_bytes(whole)
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
    assert not videos.find_videos(tmp_path / "photos")


@pytest.mark.parametrize("name", ["a%03d", "50% %s"])
def test_signs_of_patterns_in_a_name_mean_themselves(name, tmp_path):
    video = tmp_path / f"{name}.mp4"
    write_video(video, [np.full((16, 16, 3), level) for level in (0.2, 0.5, 0.8)], 10)
    assert video.is_file()
    folder = tmp_path / "frames%d" / name
    videos.split_video(video, folder)
    assert sorted(file.name for file in folder.iterdir()) == [f"{i:08d}.png" for i in range(3)]


def test_a_list_of_files_is_no_video(tmp_path):
    write_video(tmp_path / "secret.mp4", [np.full((16, 16, 3), 0.5)] * 2, 10)
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile 'secret.mp4'\n")
    with pytest.raises(CaptureError, match=r"list\.mp4: not a readable video"):
        videos.split_video(tmp_path / "list.mp4", tmp_path / "frames")


def test_frames_of_videos_have_a_budget_of_pixels(tmp_path):
    rig, size = write_rig(tmp_path), written.WIDTH * written.HEIGHT
    try:
        set_limits(Limits(video_pixels=7 * size))
        with pytest.raises(CaptureError, match=r"b.mp4: .* pixels in the frames .*: the limit video_pixels is"):
            import_cameras(*rig, up="+y")
        assert not rig[2].exists() and not list(rig[2].parent.glob("*"))
        assert import_cameras(*rig, up="+y", frames=3).views == 6
    finally:
        set_limits(None)
