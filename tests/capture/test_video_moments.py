"""Frames of one moment are found by their times; colors and pixel shapes follow the videos."""

import subprocess

import numpy as np
import pytest
from PIL import Image

from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.calibration.moments import find_moments, progressions
from humangs_jax.capture.calibration.videos import (
    frame_times,
    grey_frames,
    split_video,
    write_frames,
)
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos
from humangs_jax.io.images import read_image
from tests.capture import calibration_files as written


def clock(rate, count, without=(), shake=0.0):
    times = np.delete(np.arange(count) / rate, list(without))
    return times + shake / rate * np.random.default_rng(count).uniform(-1, 1, len(times)) * (
        times > 0
    )


def apart(found, times):
    """Returns the longest time between views of one moment."""
    rows = zip(*found.frames.values(), strict=True)
    seen = [
        [times[camera][n] for camera, n in zip(times, row, strict=True) if n is not None]
        for row in rows
    ]
    return max(np.ptp(each) for each in seen if each)


def test_frames_of_one_rate_are_paired_by_number():
    for shake in (0, 0.2):
        times = {
            "a": clock(30, 90, shake=shake),
            "b": clock(30, 80, shake=shake),
            "c": 5 + clock(30, 90),
        }
        found = find_moments(times)
        assert found.frames["a"] == found.frames["c"] == list(range(90)) and not found.notes
        assert found.frames["b"] == [*range(80), *[None] * 10]
        assert [each[:2] for each in found.warnings] == ["b:"] and "ends at 2.6" in found.warnings[
            0
        ]


@pytest.mark.parametrize("rates", [(30, 60), (60, 30, 25), (29.97, 30), (24, 50, 120), (10, 30)])
def test_frames_of_other_rates_are_paired_by_time(rates):
    times = {str(i): clock(rate, int(4 * rate), shake=0.1) for i, rate in enumerate(rates)}
    found = find_moments(times)
    assert apart(found, times) < 0.75 / sorted(rates)[1] and not found.warnings
    assert abs(len(found.times) - 4 * min(rates)) <= 1
    assert all(sum(n is None for n in numbers) <= 2 for numbers in found.frames.values())
    assert bool(found.notes) == (max(rates) / min(rates) > 1.01)


@pytest.mark.parametrize("camera", ["a", "b", "all"])
def test_a_camera_is_left_out_where_it_dropped_frames(camera):
    gap = range(20, 31)
    times = {
        name: clock(30, 90, gap if camera in (name, "all") else ()) for name in ("a", "b", "c")
    }
    found = find_moments(times)
    assert apart(found, times) < 1e-6 and len(found.times) == 90
    for name, numbers in found.frames.items():
        assert [n is None for n in numbers] == [
            i in gap and camera in (name, "all") for i in range(90)
        ]
    assert len(found.warnings) == (3 if camera == "all" else 1)
    assert "no frame at 11 moments (0.67 to 1.00 s): left out there" in found.warnings[0]


@pytest.mark.parametrize("names", ["abc", "bca"])
def test_a_camera_that_lacks_its_first_frames_begins_later(names):
    times = dict(
        zip(names, (clock(30, 90), clock(30, 90, range(12)), 0.04 + clock(60, 180)), strict=True)
    )
    found = find_moments(times)
    assert len(found.times) == 90
    assert found.frames[names[0]] == list(range(90)) and found.frames[names[2]] == list(
        range(0, 180, 2)
    )
    assert found.frames[names[1]] == [*[None] * 12, *range(78)]
    assert "no frame at 12 moments (0.00 to 0.37 s)" in found.warnings[0]


def test_no_frame_is_of_two_moments():
    rng = np.random.default_rng(0)
    for _ in range(50):
        times = {name: np.cumsum(rng.uniform(0.01, 0.06, rng.integers(2, 60))) for name in "abc"}
        for numbers in find_moments(times).frames.values():
            known = [n for n in numbers if n is not None]
            assert known == sorted(set(known))


@pytest.mark.parametrize("times", [[0.0], [0, 0, 0, 0], [np.nan] * 4, [0, 2, 1, 3]])
def test_videos_that_do_not_tell_times_are_paired_by_number(times):
    found = find_moments({"a": np.asarray(times, float), "b": clock(30, 4)})
    assert found.frames["a"][: len(times)] == list(range(len(times)))


def test_numbers_are_written_as_progressions():
    assert progressions([]) == [] and progressions([7]) == [(7, 0, 7)]
    assert progressions([0, 2, 4, 5, 6, 9]) == [(0, 2, 4), (5, 1, 6), (9, 0, 9)]
    rng = np.random.default_rng(1)
    numbers = np.flatnonzero(rng.random(300) < 0.7).tolist()
    assert [
        n for first, step, last in progressions(numbers) for n in range(first, last + 1, step or 1)
    ] == numbers


# Videos
# --------------------------------------------------------------------------------------------------


def encode(path, frames, rate, *options, filters="null", pixels="yuv420p", codec="libx264"):
    """Encodes frames (h, w, 3) in [0, 1] as a video, with almost no loss."""
    import imageio_ffmpeg

    height, width = frames[0].shape[:2]
    data = b"".join(np.rint(65535 * np.clip(each, 0, 1)).astype("<u2").tobytes() for each in frames)
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb48le", "-s", f"{width}x{height}", "-r", str(rate)]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *raw, "-i", "-"]
    # no frame is repeated or dropped to keep a rate
    command += ["-vf", filters, "-fps_mode", "passthrough"]
    quality = ["-crf", "6", "-preset", "ultrafast"] if codec == "libx264" else []
    command += ["-c:v", codec, *quality, "-pix_fmt", pixels, *options, str(path)]
    subprocess.run(command, input=data, check=True, capture_output=True)


RATE = 10
"""Frames in a second; the brightness of a frame tells its time."""


def moment(seconds):
    return np.full((48, 64, 3), 0.2 + 0.3 * seconds)


def test_videos_of_other_rates_and_with_gaps_become_frames_of_one_moment(tmp_path):
    names = ("a", "b", "c")
    K, poses = written.scene(3)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, names)
    (tmp_path / "videos").mkdir()
    encode(tmp_path / "videos" / "a.mp4", [moment(i / 10) for i in range(20)], 10)
    encode(tmp_path / "videos" / "b.mp4", [moment(i / 30) for i in range(60)], 30)
    # c lacks frames in the middle, the late one those at its start
    dropped = "select=not(between(n\\,5\\,9))"
    late = "select=not(lt(n\\,4))"
    encode(tmp_path / "videos" / "c.mp4", [moment(i / 10) for i in range(20)], 10, filters=dropped)
    encode(tmp_path / "late.mp4", [moment(i / 10) for i in range(20)], 10, filters=late)
    np.testing.assert_allclose(frame_times(tmp_path / "late.mp4"), np.arange(4, 20) / 10, atol=1e-4)
    report = import_cameras(tmp_path / "rig.json", tmp_path / "videos", tmp_path / "out", up="+y")
    assert (report.frames, report.views) == (20, 55)
    photos = load_photos(tmp_path / "out")
    seen = photos.images.mean(axis=(1, 2, 3))
    for frame in range(20):
        assert np.ptp(seen[photos.frames == frame]) < 0.03
    assert (
        "videos of 30 and 10 frames a second: paired by time, views of one moment are at most 0.000"
        " s apart" in str(report)
    )
    assert "warning: c: no frame at 5 moments (0.50 to 0.90 s): left out there" in str(report)
    # of every fourth moment the first three, one of them in the gap
    report = import_cameras(
        tmp_path / "rig.json", tmp_path / "videos", tmp_path / "few", up="+y", every=4, frames=3
    )
    photos = load_photos(tmp_path / "few")
    assert photos.frames.tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    np.testing.assert_allclose(
        photos.images.mean(axis=(1, 2, 3)), 0.2 + 0.12 * photos.frames, atol=0.03
    )


def test_masks_are_those_of_the_frames_they_go_with(tmp_path):
    """A camera's video has a gap in its times, and the video of its masks has none."""
    K, poses = written.scene(2)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, ("a", "b"))
    for kind in ("videos", "masks"):
        (tmp_path / kind).mkdir()
        for name in ("a", "b"):
            times = [i for i in range(12) if name == "a" or not 4 <= i < 8]
            gap = "null"
            if kind == "videos":
                frames = [moment(i / 10) for i in times]
                if name == "b":  # its times show the gap, those of its masks do not
                    gap = "select=1,setpts=if(gte(N\\,4)\\,PTS+4/TB/10\\,PTS)"
            else:
                frames = [np.eye(48, 64)[..., None] * [1, 1, 1] + (i > 7) for i in times]
            encode(tmp_path / kind / f"{name}.mp4", frames, 10, filters=gap)
    import_cameras(
        tmp_path / "rig.json",
        tmp_path / "videos",
        tmp_path / "out",
        masks=tmp_path / "masks",
        up="+y",
    )
    photos = load_photos(tmp_path / "out")
    both = lambda frames: np.repeat(frames, 2).tolist()
    assert photos.frames.tolist() == [*both(range(4)), 4, 5, 6, 7, *both(range(8, 12))]
    covered = photos.masks.mean(axis=(1, 2)) > 0.5
    assert covered.tolist() == (photos.frames > 7).tolist()


def test_masks_of_another_rate_are_found_by_their_times(tmp_path):
    K, poses = written.scene(2)
    written.write_calibration_full(tmp_path / "rig.json", K, poses, ("a", "b"))
    for kind, rate in (("videos", 20), ("masks", 10)):
        (tmp_path / kind).mkdir()
        for name, each in (("a", rate), ("b", 10)):
            frames = [
                (
                    moment(i / each)
                    if kind == "videos"
                    else np.eye(48, 64)[..., None] + (i / each > 0.55)
                )
                for i in range(each)
            ]
            encode(tmp_path / kind / f"{name}.mp4", [frame * [1, 1, 1] for frame in frames], each)
    import_cameras(
        tmp_path / "rig.json",
        tmp_path / "videos",
        tmp_path / "out",
        masks=tmp_path / "masks",
        up="+y",
    )
    photos = load_photos(tmp_path / "out")
    assert len(photos.frames) == 20
    assert (photos.masks.mean(axis=(1, 2)) > 0.5).tolist() == (photos.frames > 5).tolist()


def srgb_to_light(levels):
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def to_hlg(light):
    """Returns BT.2100's HLG signal of scene light, where 1 is white paper."""
    light = 0.265 * light
    bright = 0.17883277 * np.log(np.maximum(12 * light - 0.28466892, 1e-9)) + 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), bright)


def to_pq(light):
    power = (203 * light / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


TO_2020 = np.asarray([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
TO_P3 = np.asarray([[0.8225, 0.1775, 0.0], [0.0332, 0.9668, 0.0], [0.0171, 0.0724, 0.9105]])
COLORS = np.asarray(
    [
        [0.8, 0.2, 0.2],
        [0.2, 0.7, 0.3],
        [0.2, 0.3, 0.75],
        [0.75, 0.6, 0.5],
        [0.5, 0.5, 0.5],
        [0.9, 0.8, 0.2],
    ]
)


def patches(colors):
    return np.repeat(np.repeat(colors[None], 32, 0), 32, 1)


def middles(path):
    return read_image(path)[0][16, 16::32]


def tagged(primaries, transfer, matrix, then="null"):
    """Returns filters that tag the video with these color properties."""
    to_matrix = {"bt2020nc": "bt2020", "bt709": "bt709", "smpte170m": "smpte170m"}[matrix]
    words = (
        f"setparams=color_primaries={primaries}:color_trc={transfer}:colorspace={matrix}:range=tv"
    )
    return f"scale=out_color_matrix={to_matrix}:out_range=tv,format=yuv444p10le,{words},{then}"


@pytest.mark.parametrize("transfer", ["arib-std-b67", "smpte2084"])
@pytest.mark.parametrize("suffix", [".mov", ".mkv"])
def test_videos_of_high_dynamic_range_have_the_colors_of_others(transfer, suffix, tmp_path):
    curve = {"arib-std-b67": to_hlg, "smpte2084": to_pq}[transfer]
    signal = curve(srgb_to_light(COLORS) @ TO_2020.T)
    path = tmp_path / f"v{suffix}"
    encode(
        path,
        [patches(signal)] * 3,
        RATE,
        filters=tagged("bt2020", transfer, "bt2020nc"),
        pixels="yuv420p10le",
    )
    split_video(path, tmp_path / "all")
    write_frames(path, tmp_path / "some", [1])
    assert sorted(each.name for each in (tmp_path / "all").iterdir()) == [
        f"{i:08d}.png" for i in range(3)
    ]
    for file in (tmp_path / "all" / "00000002.png", tmp_path / "some" / "frame_00000001.png"):
        with Image.open(file) as image:
            assert image.mode == "RGB" and not {"gamma", "icc_profile", "chromaticity"} & set(
                image.info
            )
        found = middles(file)
        assert np.abs(found - COLORS).mean() < 0.06 and np.abs(found - COLORS).max() < 0.17
        share = lambda x: x / x.max(axis=-1, keepdims=True)
        assert np.abs(share(found) - share(COLORS)).max() < 0.15
    assert len(list(grey_frames(path, 480))) == 3


def test_videos_of_wide_primaries_are_converted(tmp_path):
    light = srgb_to_light(COLORS) @ TO_P3.T
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    encode(
        tmp_path / "v.mov", [patches(signal)], RATE, filters=tagged("smpte432", "bt709", "bt709")
    )
    split_video(tmp_path / "v.mov", tmp_path / "all")
    np.testing.assert_allclose(middles(tmp_path / "all" / "00000000.png"), COLORS, atol=0.02)


ORDINARY = [
    "null",
    tagged("bt709", "bt709", "bt709"),
    tagged("smpte170m", "smpte170m", "smpte170m"),
]


@pytest.mark.parametrize("filters", ORDINARY)
def test_frames_of_other_videos_are_as_stored_to_the_bit(filters, tmp_path):
    import imageio_ffmpeg

    video = tmp_path / "v.mp4"
    encode(video, [patches(COLORS)], RATE, filters=filters)
    split_video(video, tmp_path / "all")
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-i",
        str(video),
        str(tmp_path / "one.png"),
    ]
    subprocess.run(command, check=True)
    with Image.open(tmp_path / "one.png") as stored:
        expected = np.asarray(stored).astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(read_image(tmp_path / "all" / "00000000.png")[0], expected)
    # of a user who took the frames out
    np.testing.assert_array_equal(read_image(tmp_path / "one.png")[0], expected)


@pytest.mark.parametrize(
    ("ratio", "size"), [("4/3", (85, 48)), ("8/9", (64, 54)), ("1/1", (64, 48)), ("2/1", (128, 48))]
)
def test_pixels_become_square(ratio, size, tmp_path):
    encode(tmp_path / "v.mp4", [moment(0)] * 2, RATE, filters=f"setsar={ratio}")
    split_video(tmp_path / "v.mp4", tmp_path / "all")
    for file in (tmp_path / "all").iterdir():
        with Image.open(file) as image:
            assert image.size == size
    assert next(grey_frames(tmp_path / "v.mp4", 480)).shape == size[::-1]


def test_a_video_on_its_side_has_its_pixels_scaled_along_the_other_axis(tmp_path):
    import imageio_ffmpeg

    encode(tmp_path / "v.mp4", [moment(0)], RATE, filters="setsar=2/1")
    turn = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-v",
        "error",
        "-display_rotation",
        "90",
        "-i",
        "v.mp4",
        "-c",
        "copy",
        "t.mp4",
    ]
    subprocess.run(turn, cwd=tmp_path, check=True)
    split_video(tmp_path / "t.mp4", tmp_path / "all")
    with Image.open(tmp_path / "all" / "00000000.png") as image:
        assert image.size == (48, 128)


def test_masks_take_the_shape_of_their_photos_and_keep_their_values(tmp_path):
    hdr = tagged("bt2020", "arib-std-b67", "bt2020nc", then="setsar=4/3")
    encode(tmp_path / "photos.mp4", [moment(0)], RATE, filters=hdr, pixels="yuv420p10le")
    encode(
        tmp_path / "masks.mp4",
        [moment(1)],
        RATE,
        filters=tagged("bt2020", "arib-std-b67", "bt2020nc"),
    )
    split_video(tmp_path / "masks.mp4", tmp_path / "all", mask_of=tmp_path / "photos.mp4")
    pixels = read_image(tmp_path / "all" / "00000000.png")[0]
    assert pixels.shape[:2] == (48, 85)
    np.testing.assert_allclose(pixels, 0.5, atol=0.02)


def test_pixels_of_no_camera_are_one_line(tmp_path):
    encode(tmp_path / "v.mp4", [moment(0)], RATE, filters="setsar=9/1")
    with pytest.raises(
        CaptureError, match=r"v\.mp4: its pixels are 9 to 1 wide to high: expected at most 4 to 1"
    ):
        split_video(tmp_path / "v.mp4", tmp_path / "all")
