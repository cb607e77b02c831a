import subprocess
import weakref

import numpy as np
import pytest

from humangs_jax.avatar.video import write_video

H264_ERROR = 0.02
"""Mean absolute difference after compression of a smooth image; a wrong colour matrix gives 0.03 and more."""
PALETTE_ERROR = 0.02
"""256 colours for all frames."""


def moving_square(count, height=48, width=64):
    """A smooth coloured background, a saturated square that moves."""
    y, x = np.mgrid[:height, :width]
    frames = np.stack([np.stack([x / width, y / height, np.full(x.shape, 0.5)], -1) for _ in range(count)])
    for i in range(count):
        frames[i, 8:24, 2 * i : 2 * i + 16] = [0.9, 0.1, 0.1]
    return frames


def ffmpeg(*arguments):
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)


def read_back(path, height=48, width=64):
    """By ffmpeg itself (imageio's reader leaves file handles open)."""
    data = ffmpeg(
        "-v", "error", "-i", path, "-fps_mode", "passthrough", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"
    ).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3) / 255.0


@pytest.mark.parametrize("name", ["a.mp4", "a.MP4", "a.gif"])
def test_frames_come_back(tmp_path, name):
    frames = moving_square(12)
    write_video(tmp_path / name, frames, 24.0)
    back = read_back(tmp_path / name)
    assert back.shape == frames.shape
    assert np.abs(back - frames).mean() < (PALETTE_ERROR if name.endswith("gif") else H264_ERROR)
    red = back[5, 12:20, 14:22].mean((0, 1))  # inside the square: the colours of the matrix that the file names
    np.testing.assert_allclose(red, [0.9, 0.1, 0.1], atol=0.03)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_frames_are_taken_one_by_one(tmp_path, name):
    """The same file as of an array, and an error in the middle leaves nothing."""
    frames, alive = moving_square(12), []

    def drawn():
        for frame in frames:
            alive.append(weakref.ref(copy := frame.copy()))
            yield copy
            del copy
            assert sum(each() is not None for each in alive) <= 2

    write_video(tmp_path / name, drawn(), 24.0)
    data = (tmp_path / name).read_bytes()
    write_video(tmp_path / name, frames, 24.0)
    assert (tmp_path / name).read_bytes() == data
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match="frame 12 has shape"):
        write_video(tmp_path / name, (f for f in (*frames, frames[0, 1:])), 24.0)
    assert list(tmp_path.iterdir()) == []


def test_mp4_says_its_speed_and_pixel_format(tmp_path):
    write_video(tmp_path / "a.mp4", moving_square(30, 47, 63), 30)  # odd sides
    message = ffmpeg("-i", tmp_path / "a.mp4").stderr.decode()
    assert "Video: h264" in message and "yuv420p(tv, bt709" in message and "64x48" in message and " 30 fps" in message
    assert "Duration: 00:00:01.0" in message
    back = read_back(tmp_path / "a.mp4")
    assert back.shape[0] == 30
    assert np.abs(back[:, :47, :63] - moving_square(30, 47, 63)).mean() < H264_ERROR  # padded, not resized


@pytest.mark.parametrize(("fps", "count"), [(24, 24), (10, 24), (60, 12), (7.5, 24)])
def test_gif_keeps_its_speed_and_loops(tmp_path, fps, count):
    from PIL import Image

    write_video(tmp_path / "a.gif", moving_square(24), fps)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0 and image.n_frames == count
        total = 0
        for i in range(count):
            image.seek(i)
            total += image.info["duration"]
    assert abs(total - 24 / fps * 1000) <= 10


def test_gif_background_does_not_flicker(tmp_path):
    write_video(tmp_path / "a.gif", moving_square(12), 24)
    back = read_back(tmp_path / "a.gif")
    still = back[:, 30:, :, :]  # below the square
    assert (still == still[:1]).all()


@pytest.mark.parametrize("background", [1.0, 0.0, 0.37])
def test_gif_background_is_exact(tmp_path, background):
    """Median cut takes the mean of its boxes: white became 252 beside a person of many colours."""
    from PIL import Image

    frames = np.full((4, 48, 64, 3), background)
    near = np.linspace(background - 0.02, background + 0.02, 4 * 32 * 32).reshape(4, 32, 32, 1)
    frames[:, 8:40, 16:48] = np.clip(near * np.random.default_rng(0).uniform(0.9, 1.1, (4, 32, 32, 1)), 0, 1)
    frames[:, 12:36, 20:44] = np.random.default_rng(0).uniform(0, 1, (4, 24, 24, 3))
    write_video(tmp_path / "a.gif", frames, 24)
    with Image.open(tmp_path / "a.gif") as image:
        for i in range(4):
            image.seek(i)
            pixels = np.asarray(image.convert("RGB"))
            assert (pixels[:8] == round(255 * background)).all() and (pixels[40:] == round(255 * background)).all()


NAN = np.zeros((3, 4, 4, 3))
NAN[1, 2, 2, 0] = np.nan


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.mp4", np.zeros((0, 4, 4, 3)), 24, "at least one frame"),
        ("a.gif", np.zeros((0, 4, 4, 3)), 24, "at least one frame"),
        ("a.mp4", np.zeros((2, 0, 4, 3)), 24, "at least one frame"),
        ("a.mp4", NAN, 24, "frame 1"),
        ("a.mp4", np.zeros((2, 4, 4, 3)), 0, "frames per second"),
        ("a.mp4", np.zeros((2, 4, 4, 3)), float("inf"), "frames per second"),
        ("a.avi", np.zeros((2, 4, 4, 3)), 24, r"\.mp4 or \.gif"),
    ],
)
def test_errors_write_nothing(tmp_path, name, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / name, frames, fps)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    import humangs_jax.avatar.video as module

    (tmp_path / "a.mp4").write_text("old")
    monkeypatch.setattr(module, "to_uint8", lambda frame: (_ for _ in ()).throw(MemoryError("full")))
    with pytest.raises(MemoryError):
        write_video(tmp_path / "a.mp4", moving_square(2), 24)
    assert (tmp_path / "a.mp4").read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(FileNotFoundError, match="no such folder"):
        write_video(tmp_path / "nowhere" / "a.mp4", moving_square(2), 24)


def test_ffmpeg_failing_is_an_error(tmp_path, monkeypatch):
    import humangs_jax.avatar.video as module

    monkeypatch.setattr(module, "CONSTANT_RATE_FACTOR", "no number")
    with pytest.raises(OSError, match=r"ffmpeg failed: .*no number"):
        write_video(tmp_path / "a.mp4", moving_square(200), 24)
    assert list(tmp_path.iterdir()) == []
