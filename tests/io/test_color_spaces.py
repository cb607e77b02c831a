"""Photos in any color space are read as sRGB."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from png_files import chunk

from humangs_jax.io.color_spaces import (
    cube,
    in_srgb,
    light_to_srgb,
    of_code_points,
    read_profile,
    srgb_to_light,
)
from humangs_jax.io.images import read_grey, read_image
from humangs_jax.io.reading import InvalidFileError
from tests.io import profiles

COLORS = np.random.default_rng(0).integers(30, 226, (6, 8, 3)).astype(np.uint8)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
RAMP = np.linspace(0, 1, 300)
P3 = profiles.of_colors(profiles.P3_TO_XYZ, profiles.SRGB_CURVE)
ADOBE = profiles.of_colors(profiles.ADOBE_TO_XYZ, profiles.gamma(563 / 256))
WIDE = {
    "Display P3": P3,
    "Adobe RGB": ADOBE,
    "ProPhoto": profiles.of_colors(profiles.PROPHOTO_TO_XYZ, profiles.gamma(1.8)),
    "P3 with a table": profiles.of_colors(profiles.P3_TO_XYZ, profiles.table(RAMP**2.4)),
    "linear": profiles.of_colors(profiles.P3_TO_XYZ, b"curv" + bytes(8)),
    "a formula of the fifth kind": profiles.of_colors(
        profiles.P3_TO_XYZ, profiles.formula(4, 2.2, 1, 0, 0.1, 0.05, 0, 0)
    ),
    "scanner": profiles.of_colors(profiles.ADOBE_TO_XYZ, profiles.formula(0, 2.2), kind=b"scnr"),
}


FINE = {
    "PNG": {},
    "WEBP": {"lossless": True},
    "AVIF": {"quality": 100, "subsampling": "4:4:4"},
    "JPEG": {"quality": 100, "subsampling": 0},
}
LOSSLESS = ("PNG", "WEBP")


def by_little_cms(pixels, profile, mode="RGB"):
    """Returns the pixels in sRGB as LittleCMS converts them."""
    source, target = ImageCms.getOpenProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    return np.asarray(
        ImageCms.profileToProfile(
            Image.fromarray(pixels, mode), source, target, intent, outputMode="RGB"
        )
    )


@pytest.mark.filterwarnings("ignore:.*mode.*:DeprecationWarning")
@pytest.mark.parametrize("kind", FINE)
@pytest.mark.parametrize("name", WIDE)
def test_colors_are_those_of_another_program(name, kind, tmp_path):
    pixels = np.repeat(np.repeat(COLORS, 8, 0), 8, 1)
    Image.fromarray(pixels).save(tmp_path / "a", kind, icc_profile=WIDE[name], **FINE[kind])
    found, alpha = read_image(tmp_path / "a")
    expected = by_little_cms(pixels, WIDE[name])
    assert alpha is None and found.dtype == np.float32
    off = np.abs(255 * found - expected)
    assert off.max() < 1.01 if kind in LOSSLESS else off.mean() < 2.5


@pytest.mark.parametrize(
    "profile", [None, SRGB, profiles.of_colors(profiles.SRGB_TO_XYZ, profiles.SRGB_CURVE)]
)
def test_values_of_srgb_are_as_stored_to_the_bit(profile, tmp_path):
    Image.fromarray(COLORS).save(
        tmp_path / "a.png", **({} if profile is None else {"icc_profile": profile})
    )
    np.testing.assert_array_equal(
        read_image(tmp_path / "a.png")[0], COLORS.astype(np.float32) / np.float32(255)
    )


def test_alpha_is_kept_beside_converted_colors(tmp_path):
    pixels = np.dstack([COLORS, np.arange(48, dtype=np.uint8).reshape(6, 8)])
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=P3)
    colors, alpha = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(255 * alpha, pixels[..., 3], atol=1e-4)
    Image.fromarray(COLORS).save(tmp_path / "b.png", icc_profile=P3)
    np.testing.assert_array_equal(colors, read_image(tmp_path / "b.png")[0])


@pytest.mark.parametrize("mode", ["L", "LA", "1", "I;16", "RGB"])
def test_greys_have_profiles_of_greys_and_of_colors(mode, tmp_path):
    grey = Image.fromarray(COLORS[..., 0])
    if mode == "I;16":
        image = Image.fromarray(COLORS[..., 0].astype(np.uint16) * 257)
        stored = COLORS[..., 0] / 255
    else:
        image = grey.convert(mode)
        stored = np.asarray(image.convert("RGB"), float)[..., 0] / 255
    for profile in (
        profiles.of_grey(profiles.gamma(1.8)),
        profiles.of_colors(profiles.P3_TO_XYZ, profiles.gamma(1.8)),
    ):
        if mode == "RGB" and profile[16:20] == b"GRAY":
            continue
        image.save(tmp_path / "a.png", icc_profile=profile)
        expected = light_to_srgb(stored ** (461 / 256))
        np.testing.assert_allclose(
            read_image(tmp_path / "a.png")[0], np.stack([expected] * 3, -1), atol=1e-3
        )


def png(pixels, *chunks, depth=8):
    """Returns a PNG file with further chunks before its pixels."""
    rows = b"".join(b"\0" + row.astype(f">u{depth // 8}").tobytes() for row in pixels)
    head = chunk(
        b"IHDR", struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], depth, 2, 0, 0, 0)
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [head, *chunks, chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")]
    )


def of_profile(data):
    return chunk(b"iCCP", b"a\0\0" + zlib.compress(data))


def test_sixteen_bits_are_converted_with_all_their_bits(tmp_path):
    deep = np.random.default_rng(1).integers(0, 65536, (7, 9, 3)).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(png(deep, of_profile(P3), depth=16))
    light = (
        srgb_to_light(deep / 65535) @ (np.linalg.inv(profiles.SRGB_TO_XYZ) @ profiles.P3_TO_XYZ).T
    )
    expected = light_to_srgb(np.clip(light, 0, 1))
    # a tenth of a level of 8 bits
    np.testing.assert_allclose(read_image(tmp_path / "a.png")[0], expected, atol=4e-4)


# A printer of yellow, magenta and cyan light, and one of inks
LAB = lambda r, g, b: (30 * r + 50 * g + 20 * b, 60 * r - 60 * g, 40 * r + 40 * g - 80 * b)
INKS = lambda c, m, y, k: (
    (100 - 30 * c - 40 * m - 10 * y) * (1 - k),
    0.8 * (60 * m - 30 * c) * (1 - k),
    50 * (y - c) * (1 - k),
)


@pytest.mark.filterwarnings("ignore:.*mode.*:DeprecationWarning")
def test_tables_are_followed_by_another_library(tmp_path):
    profile = profiles.of_tables(b"RGB ", 3, LAB)
    Image.fromarray(COLORS).save(tmp_path / "a.png", icc_profile=profile)
    eight = read_image(tmp_path / "a.png")[0]
    assert (
        np.abs(255 * eight - COLORS).mean() > 10
        and np.abs(255 * eight - by_little_cms(COLORS, profile)).mean() < 6
    )
    (tmp_path / "b.png").write_bytes(
        png(COLORS.astype(np.uint16) << 8 | COLORS, of_profile(profile), depth=16)
    )
    np.testing.assert_allclose(read_image(tmp_path / "b.png")[0], eight, atol=1e-5)


def test_inks_are_those_of_their_profile(tmp_path):
    inks = Image.fromarray(COLORS).convert("CMYK")
    big = inks.resize((80, 60), Image.Resampling.NEAREST)
    big.save(tmp_path / "plain.jpg", quality=95)
    big.save(tmp_path / "inks.jpg", quality=95, icc_profile=profiles.of_tables(b"CMYK", 4, INKS))
    plain, found = read_image(tmp_path / "plain.jpg")[0], read_image(tmp_path / "inks.jpg")[0]
    assert np.abs(found - plain).mean() > 0.03


BROKEN = {
    "cut": P3[:200],
    "no such tag": P3.replace(b"rTRC", b"xTRC"),
    "a link": profiles.of_colors(profiles.P3_TO_XYZ, profiles.SRGB_CURVE, kind=b"link"),
    "CMYK": profiles.of_tables(b"CMYK", 4, INKS),
    "no white": profiles.of_colors(3 * profiles.P3_TO_XYZ, profiles.SRGB_CURVE),
    "no numbers": profiles.of_colors(profiles.P3_TO_XYZ, profiles.formula(0, -300)),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_profile_that_cannot_be_used_is_one_warning(what, tmp_path, caplog):
    image = Image.fromarray(np.repeat(np.repeat(COLORS, 8, 0), 8, 1))
    image.save(tmp_path / "plain", "JPEG", quality=95)
    image.save(tmp_path / "photo", "JPEG", quality=95, icc_profile=BROKEN[what])
    for _ in range(2):
        np.testing.assert_array_equal(
            read_image(tmp_path / "photo")[0], read_image(tmp_path / "plain")[0]
        )
    assert len(caplog.messages) == 1 and "\n" not in caplog.text.strip()
    assert caplog.messages[0].startswith(f"{tmp_path / 'photo'}: its color profile is not used: it")


def test_masks_are_values_as_stored(tmp_path):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5
    for name, image in {"grey": grey, "colors": np.stack([grey] * 3, -1)}.items():
        linear = profiles.of_colors(profiles.P3_TO_XYZ, profiles.gamma(1))
        Image.fromarray(image).save(tmp_path / f"{name}.png", icc_profile=linear)
        np.testing.assert_array_equal(
            read_grey(tmp_path / f"{name}.png"), grey.astype(np.float32) / np.float32(255)
        )


# Numbers in headers
# --------------------------------------------------------------------------------------------------


def to_p3(srgb):
    light = srgb_to_light(srgb) @ (np.linalg.inv(profiles.P3_TO_XYZ) @ profiles.SRGB_TO_XYZ).T
    return light_to_srgb(np.clip(light, 0, 1))


def primaries(white, *points):
    return chunk(
        b"cHRM",
        struct.pack(">8I", *(round(100_000 * x) for each in (white, *points) for x in each)),
    )


def gamma_chunk(value):
    return chunk(b"gAMA", struct.pack(">I", round(100_000 * value)))


def test_numbers_in_a_png_say_how_colors_are_encoded(tmp_path):
    wanted = COLORS / 255
    p3 = np.rint(255 * to_p3(wanted))
    light = np.rint(65535 * srgb_to_light(wanted))
    # each chunk alone, before one of less weight, and with numbers that no colors have
    files = {
        "cICP": png(p3, chunk(b"cICP", bytes([12, 13, 0, 1]))),
        "cICP before another": png(
            p3, chunk(b"cICP", bytes([12, 13, 0, 1])), of_profile(WIDE["linear"])
        ),
        "sRGB in cICP before another": png(
            COLORS, chunk(b"cICP", bytes([1, 13, 0, 1])), of_profile(WIDE["linear"])
        ),
        "cICP that leaves it open": png(p3, chunk(b"cICP", bytes([2, 2, 0, 1])), of_profile(P3)),
        "cICP that leaves the primaries open": png(
            p3, chunk(b"cICP", bytes([2, 13, 0, 1])), of_profile(P3)
        ),
        "cHRM": png(p3, gamma_chunk(0.45455), primaries((0.3127, 0.329), *profiles.P3)),
        "gAMA": png(light, gamma_chunk(1.0), depth=16),
        "sRGB": png(COLORS, chunk(b"sRGB", b"\0"), gamma_chunk(1.0)),
        "as of old": png(COLORS, gamma_chunk(0.45455)),
        "nonsense": png(COLORS, gamma_chunk(0), primaries((0, 0), (0, 0), (0, 0), (0, 0))),
        "gAMA beside nonsense": png(
            light, gamma_chunk(1.0), primaries((0, 0), (0, 0), (0, 0), (0, 0)), depth=16
        ),
        "gAMA beside points on a line": png(
            light,
            gamma_chunk(1.0),
            primaries((0.3, 0.3), (0.1, 0.1), (0.2, 0.2), (0.3, 0.3)),
            depth=16,
        ),
        "gAMA beside no real colors": png(
            light,
            gamma_chunk(1.0),
            primaries((0.3127, 0.329), (0.4, 0.4), (0.41, 0.4), (0.4, 0.42)),
            depth=16,
        ),
        "points on a line": png(COLORS, primaries((0.3, 0.3), (0.1, 0.1), (0.2, 0.2), (0.3, 0.3))),
        "short": png(COLORS, chunk(b"cICP", b"\x0c")),
    }
    for name, data in files.items():
        (tmp_path / "a.png").write_bytes(data)
        np.testing.assert_allclose(
            255 * read_image(tmp_path / "a.png")[0], COLORS, atol=2, err_msg=name
        )


HEIC = (Path(__file__).parent / "phone.heic").read_bytes()
"""A photo in red with a blue upper left quarter; see test_images."""


def with_box(heic, box):
    """Returns a HEIC photo with another color box.

    Boxes around it grow, and positions in the file move.
    """
    at = heic.index(b"colr") - 4
    size = int.from_bytes(heic[at : at + 4], "big")
    data, more = bytearray(heic), len(box) - size
    for place in [heic.index(name) - 4 for name in (b"ipco", b"iprp", b"meta")]:
        data[place : place + 4] = struct.pack(
            ">I", int.from_bytes(data[place : place + 4], "big") + more
        )
    for old in (481, 584):  # of its two parts
        place = heic.index(struct.pack(">I", old), heic.index(b"iloc"))
        data[place : place + 4] = struct.pack(">I", old + more)
    data[at : at + size] = box
    return bytes(data)


def test_heic_photos_have_profiles_and_numbers_too(tmp_path):
    pytest.importorskip("pi_heif")
    numbers = HEIC.replace(b"colrnclx\x00\x01", b"colrnclx\x00\x0c")
    profile = with_box(HEIC, struct.pack(">I", 12 + len(P3)) + b"colrprof" + P3)
    (tmp_path / "plain.heic").write_bytes(HEIC)
    plain = read_image(tmp_path / "plain.heic")[0]
    light = srgb_to_light(plain) @ (np.linalg.inv(profiles.SRGB_TO_XYZ) @ profiles.P3_TO_XYZ).T
    for data in (numbers, profile):
        (tmp_path / "a.heic").write_bytes(data)
        np.testing.assert_allclose(
            read_image(tmp_path / "a.heic")[0], light_to_srgb(np.clip(light, 0, 1)), atol=0.02
        )
    assert np.abs(light_to_srgb(np.clip(light, 0, 1)) - plain).mean() > 0.02


def test_numbers_in_an_avif_say_how_colors_are_encoded(tmp_path):
    file = io.BytesIO()
    pixels = np.repeat(np.repeat(np.rint(255 * to_p3(COLORS / 255)), 8, 0), 8, 1).astype(np.uint8)
    Image.fromarray(pixels).save(file, "AVIF", quality=100, subsampling="4:4:4")
    data = file.getvalue().replace(b"colrnclx\x00\x01", b"colrnclx\x00\x0c")
    (tmp_path / "a.avif").write_bytes(data)
    found = 255 * read_image(tmp_path / "a.avif")[0][4::8, 4::8]
    assert np.abs(found - COLORS).mean() < 1.5


@pytest.mark.parametrize("transfer", [16, 18])
def test_of_high_dynamic_range_white_stays_white_and_hues_stay(transfer):
    encoding = of_code_points(9, transfer)
    paper = {16: 0.5806, 18: 0.75}[transfer]  # BT.2408: 203 candela per square metre
    greys = in_srgb(np.stack([np.linspace(0, 1, 101)] * 3, -1), encoding)
    assert (
        np.abs(greys - greys[:, :1]).max() < 1e-3
        and (np.diff(greys[:, 0]) > -1e-9).all()
        and greys.max() <= 1
    )
    assert 0.94 < np.interp(paper, np.linspace(0, 1, 101), greys[:, 0]) < 0.98
    colors = np.asarray([[0.7, 0.3, 0.3], [0.2, 0.6, 0.3], [0.3, 0.35, 0.7], [0.6, 0.45, 0.38]])
    levels = np.linspace(0, 1, 20_001)
    signal = np.interp(
        srgb_to_light(colors) @ np.linalg.inv(encoding.matrix).T, encoding.curves[0](levels), levels
    )
    found = in_srgb(signal, encoding)
    off = found / found.max(axis=-1, keepdims=True) - colors / colors.max(axis=-1, keepdims=True)
    assert np.abs(off).max() < 0.12  # cameras encode with more contrast


def test_a_table_for_videos_says_the_same():
    encoding = of_code_points(9, 18)
    lines = cube(encoding, 3).split("\n")
    rows = np.asarray([line.split() for line in lines[1:-1]], float)
    assert lines[0] == "LUT_3D_SIZE 3" and rows.shape == (27, 3)
    np.testing.assert_allclose(rows[[1, 3, 9]], in_srgb(np.eye(3) / 2, encoding), atol=1e-6)


def test_what_is_close_to_srgb_is_taken_for_it():
    assert (
        of_code_points(1, 13) is None
        and of_code_points(6, 6) is None
        and of_code_points(2, 2) is None
    )
    with pytest.raises(InvalidFileError, match="damaged"):
        read_profile(bytes(200))
