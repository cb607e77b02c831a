import shutil
import subprocess
import weakref

import numpy as np
import pytest

from humangs_jax.avatar import video
from humangs_jax.avatar.video import check_video, video_size, write_video
from humangs_jax.io.images import read_image

H264_ERROR = 0.02
"""Mean absolute error of a compressed smooth image; a wrong color matrix gives at least 0.03."""
PALETTE_ERROR = 0.02
"""Mean absolute error with 256 colors for all frames."""


def moving_square(count, height=48, width=64):
    """Returns frames of a saturated square that moves over a smooth background."""
    y, x = np.mgrid[:height, :width]
    frames = np.stack(
        [np.stack([x / width, y / height, np.full(x.shape, 0.5)], -1) for _ in range(count)]
    )
    for i in range(count):
        frames[i, 8:24, 2 * i : 2 * i + 16] = [0.9, 0.1, 0.1]
    return frames


def ffmpeg(*arguments):
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)


def read_back(path, height=48, width=64):
    """Returns the frames of a video as ffmpeg reads them (imageio's reader leaves files open)."""
    data = ffmpeg(
        "-v",
        "error",
        "-i",
        path,
        "-fps_mode",
        "passthrough",
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3) / 255.0


@pytest.mark.parametrize("name", ["a.mp4", "a.MP4", "a.gif", "a.webm"])
def test_frames_come_back(tmp_path, name):
    frames = moving_square(12)
    assert write_video(tmp_path / name, frames, 24.0) == 12
    back = read_back(tmp_path / name)
    assert back.shape == frames.shape
    assert np.abs(back - frames).mean() < (PALETTE_ERROR if name.endswith("gif") else H264_ERROR)
    # inside the square: the colors of the matrix that the file names
    red = back[5, 12:20, 14:22].mean((0, 1))
    np.testing.assert_allclose(red, [0.9, 0.1, 0.1], atol=0.03)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_webm_and_png_files_are_transparent(tmp_path):
    """Alpha is straight: colors are kept where alpha is 1, and are not premultiplied."""
    colors = moving_square(6)
    alpha = np.zeros((*colors.shape[:3], 1))
    alpha[:, 10:40, 10:50] = 0.5
    alpha[:, 20:30, 20:40] = 1
    frames = np.concatenate([colors, alpha], axis=-1)
    write_video(tmp_path / "a.webm", frames, 24)
    source = ("-c:v", "libvpx-vp9", "-i", tmp_path / "a.webm")
    decode = (*source, "-f", "rawvideo", "-pix_fmt", "rgba", "-")
    # the decoder is named: another one of ffmpeg leaves alpha out
    back = (
        np.frombuffer(ffmpeg("-v", "error", *decode).stdout, np.uint8).reshape(6, 48, 64, 4) / 255.0
    )
    assert np.abs(back[..., 3] - alpha[..., 0]).mean() < H264_ERROR
    seen = alpha[..., 0] == 1
    assert np.abs(back - frames)[seen].mean() < H264_ERROR
    assert write_video(tmp_path / "frames", frames, 24) == 6
    for i, frame in enumerate(frames):
        image, its_alpha = read_image(tmp_path / "frames" / f"frame_{i:05d}.png")
        np.testing.assert_allclose(
            np.concatenate([image, its_alpha[..., None]], -1), frame, atol=0.5 / 255 + 1e-6
        )


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.gif", "frames"])
def test_frames_of_bytes_are_those_of_numbers(tmp_path, name):
    """Frames of OpenCV, Pillow and imageio are uint8."""
    frames, data = np.rint(255 * moving_square(3)).astype(np.uint8), []
    for given in (frames, frames / np.float32(255)):
        write_video(tmp_path / name, given, 24)
        data.append([path.read_bytes() for path in sorted(tmp_path.rglob("*")) if path.is_file()])
    assert data[0] == data[1]


ONE = np.full((4, 6, 3), 0.5, np.float32)
NO_COLORS = {
    "numbers up to 200": (
        np.full((4, 6, 3), 200.0),
        r"frame 1: expected numbers in \[0, 1\], or uint8, got 200 to 200: divide",
    ),
    "below": (ONE - 1, r"expected numbers in \[0, 1\], or uint8, got -0.5 to -0.5"),
    "a hole": (ONE * np.nan, "frame 1 has numbers that are not finite"),
    "two channels": (
        ONE[..., :2],
        r"frame 1: expected shape \(h, w, 3\) or \(h, w, 4\), got \(4, 6, 2\)",
    ),
}


@pytest.mark.parametrize("name", NO_COLORS)
def test_numbers_that_are_no_colors_are_refused_and_nothing_is_written(tmp_path, name):
    frame, words = NO_COLORS[name]
    with pytest.raises(ValueError, match=words):
        write_video(tmp_path / "a.mp4", iter([ONE, frame]), 24)
    assert not list(tmp_path.iterdir())


def test_float32_roundings_beside_0_and_1_are_written(tmp_path):
    write_video(
        tmp_path / "frames", [ONE * 0 + np.float32(1 + 5e-7), ONE * 0 - np.float32(5e-7)], 24
    )
    assert [read_image(tmp_path / "frames" / f"frame_{i:05d}.png")[0].mean() for i in range(2)] == [
        1,
        0,
    ]


@pytest.mark.parametrize(
    ("name", "size"),
    [("a.mp4", (64, 48)), ("a.webm", (64, 48)), ("a.gif", (63, 47)), ("a", (63, 47))],
)
def test_the_reported_size_is_that_of_the_file(tmp_path, name, size):
    write_video(tmp_path / name, moving_square(2, 47, 63), 24)
    file = tmp_path / name / "frame_00000.png" if name == "a" else tmp_path / name
    assert video_size(file.parent if name == "a" else file, 63, 47) == size
    assert f"{size[0]}x{size[1]}" in ffmpeg("-i", file).stderr.decode()


def test_png_files_of_an_earlier_video_are_replaced_and_others_stay(tmp_path):
    write_video(tmp_path / "frames", moving_square(5), 24)
    (tmp_path / "frames" / "notes.txt").write_text("mine")
    write_video(tmp_path / "frames", moving_square(2), 24)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [
        "frame_00000.png",
        "frame_00001.png",
        "notes.txt",
    ]


def test_a_gif_that_does_not_fit_into_memory_ends_with_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "LARGEST_GIF", 3 * 64 * 64 * 3)
    frames = np.zeros((4, 64, 64, 3))
    write_video(tmp_path / "a.gif", frames[:3], 24)
    with pytest.raises(ValueError, match=r"4 frames of 64 x 64 are too many for a .gif"):
        write_video(tmp_path / "b.gif", iter(frames), 24)
    assert [file.name for file in tmp_path.iterdir()] == ["a.gif"]


def test_what_cannot_be_written_is_refused_before_it_is_drawn(tmp_path):
    (tmp_path / "a.mp4").mkdir()
    (tmp_path / "frames").write_text("mine")
    with pytest.raises(ValueError, match=r"path .*a.mp4: is a folder: expected a file name"):
        check_video(tmp_path / "a.mp4", 10, 64, 64)
    with pytest.raises(ValueError, match=r"frames: is a file: expected a folder name"):
        check_video(tmp_path / "frames", 10, 64, 64)
    with pytest.raises(
        ValueError, match=r"1000 frames of 1024 x 1024 are too many for a .gif: use .mp4 or .webm"
    ):
        check_video(tmp_path / "a.gif", 1000, 1024, 1024)
    check_video(tmp_path / "b.webm", 10**9, 8192, 8192, transparent=True)


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.gif", "frames"])
def test_frames_are_taken_one_by_one(tmp_path, name):
    """A generator gives the same file as an array, and an error in the middle leaves no file."""
    frames, alive = moving_square(12), []

    def drawn():
        for frame in frames:
            copy = frame.copy()
            alive.append(weakref.ref(copy))
            yield copy
            del copy
            assert sum(each() is not None for each in alive) <= 2

    write_video(tmp_path / name, drawn(), 24.0)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    data = [path.read_bytes() for path in files]
    write_video(tmp_path / name, frames, 24.0)
    assert [path.read_bytes() for path in files] == data
    shutil.rmtree(tmp_path / name) if name == "frames" else (tmp_path / name).unlink()
    with pytest.raises(ValueError, match="frame 12 has shape"):
        write_video(tmp_path / name, (f for f in (*frames, frames[0, 1:])), 24.0)
    assert list(tmp_path.iterdir()) == []


def test_mp4_says_its_speed_and_pixel_format(tmp_path):
    write_video(tmp_path / "a.mp4", moving_square(30, 47, 63), 30)  # odd sides
    message = ffmpeg("-i", tmp_path / "a.mp4").stderr.decode()
    assert (
        "Video: h264" in message
        and "yuv420p(tv, bt709" in message
        and "64x48" in message
        and " 30 fps" in message
    )
    assert "Duration: 00:00:01.0" in message
    back = read_back(tmp_path / "a.mp4")
    assert back.shape[0] == 30
    # padded, not resized
    assert np.abs(back[:, :47, :63] - moving_square(30, 47, 63)).mean() < H264_ERROR


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


@pytest.mark.parametrize("background", [1.0, 0.0, 0.37])
def test_gif_background_is_exact(tmp_path, background):
    """Median cut averages its boxes: white was 252 beside a person of many colors."""
    from PIL import Image

    frames = np.full((4, 48, 64, 3), background)
    near = np.linspace(background - 0.02, background + 0.02, 4 * 32 * 32).reshape(4, 32, 32, 1)
    frames[:, 8:40, 16:48] = np.clip(
        near * np.random.default_rng(0).uniform(0.9, 1.1, (4, 32, 32, 1)), 0, 1
    )
    frames[:, 12:36, 20:44] = np.random.default_rng(0).uniform(0, 1, (4, 24, 24, 3))
    write_video(tmp_path / "a.gif", frames, 24)
    with Image.open(tmp_path / "a.gif") as image:
        for i in range(4):
            image.seek(i)
            pixels = np.asarray(image.convert("RGB"))
            assert (pixels[:8] == round(255 * background)).all() and (
                pixels[40:] == round(255 * background)
            ).all()


NAN = np.zeros((3, 4, 4, 3))
NAN[1, 2, 2, 0] = np.nan


@pytest.mark.parametrize(
    ("name", "frames", "fps", "message"),
    [
        ("a.mp4", np.zeros((0, 4, 4, 3)), 24, "at least one frame"),
        ("a.mp4", np.zeros((2, 0, 4, 3)), 24, "at least one frame"),
        ("a.mp4", NAN, 24, "frame 1"),
        ("a.mp4", np.zeros((2, 4, 4, 3)), 0, "frames per second"),
        (
            "a.avi",
            np.zeros((2, 4, 4, 3)),
            24,
            r"expected a name ending in \.mp4, \.webm, \.gif or a folder",
        ),
        ("a.mp4", np.zeros((2, 4, 4, 4)), 24, r"\.mp4 has no transparency: expected \.webm"),
        ("a.gif", np.zeros((2, 4, 4, 4)), 24, r"\.gif has no transparency"),
    ],
)
def test_errors_write_nothing(tmp_path, name, frames, fps, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / name, frames, fps)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.gif", "frames"])
def test_an_interruption_leaves_nothing(tmp_path, name):
    def drawn():
        yield from moving_square(5)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / name, drawn(), 24)
    assert list(tmp_path.iterdir()) == []
