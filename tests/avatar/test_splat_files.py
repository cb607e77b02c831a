"""Files of Gaussians: ours come back as written; files by other programs' layouts are read."""

import gzip
import json
import re
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from small import random_gaussians

import humangs_jax as hg
from humangs_jax.avatar.export.spz import zstd
from humangs_jax.core.pytree import replace
from humangs_jax.io.reading import FileError, Limits, set_limits
from humangs_jax.rendering.gaussians import Gaussians, covariances

COUNTS = (0, 3, 8, 15)
C0 = 0.5 / np.sqrt(np.pi)
EXTENSION = "KHR_gaussian_splatting"
STEPS = {
    # means, covariances (relative), opacities, colors, harmonics: what the format's own numbers
    # leave
    ".ply": (1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    ".glb": (1e-6, 1e-5, 1e-6, 1e-6, 1e-6),
    ".splat": (1e-6, 0.05, 0.51 / 255, 0.51 / 255, 0),
    ".spz": (1e-6, 0.08, 0.51 / 255, 0.51 / 255 / 0.15 * C0, 0.51 / 128),
}


def scene(count=0, g=20, seed=0) -> Gaussians:
    """Returns Gaussians in the order of `.splat`, the largest first."""
    gaussians = random_gaussians(seed, g, count)
    order = jnp.argsort(-gaussians.opacities * gaussians.scales.prod(axis=1))
    return replace(gaussians, scales=gaussians.scales[order], opacities=gaussians.opacities[order])


def assert_close(found, expected, steps):
    exact = np.asarray(covariances(expected))
    np.testing.assert_allclose(found.means, expected.means, atol=steps[0])
    assert np.abs(np.asarray(covariances(found)) - exact).max() <= steps[1] * np.abs(exact).max()
    np.testing.assert_allclose(np.linalg.norm(found.quats, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=steps[2])
    np.testing.assert_allclose(found.colors, expected.colors, atol=steps[3])
    assert (found.harmonics is None) == (expected.harmonics is None)
    if found.harmonics is not None:
        np.testing.assert_allclose(found.harmonics, expected.harmonics, atol=steps[4])


CASES = [(suffix, count) for suffix in STEPS for count in COUNTS if suffix != ".splat" or not count]


@pytest.mark.parametrize(("suffix", "count"), CASES)
def test_what_is_saved_comes_back_and_stays(suffix, count, tmp_path):
    """Saving the read Gaussians again changes nothing: the format rounds once."""
    path, again = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    before = scene(count)
    hg.save_gaussians(path, before)
    back = hg.load_gaussians(path)
    hg.save_gaussians(again, back)
    assert_close(back, before, STEPS[suffix])
    assert_close(hg.load_gaussians(again), back, (2e-6, 0.01, 1e-6, 1e-6, 1e-6))
    assert_close(
        hg.load_gaussians(
            str(path.rename(tmp_path / ("c.splat" if suffix == ".splat" else "c.bin")))
        ),
        back,
        [0] * 5,
    )


@pytest.mark.parametrize("suffix", STEPS)
def test_worlds_with_y_up_come_back_and_stand_upright_everywhere(suffix, tmp_path):
    """In viewers of every format the head of an exported person is above the feet."""
    before = scene()
    hg.save_gaussians(tmp_path / f"a{suffix}", before, y_up=True)
    assert_close(hg.load_gaussians(tmp_path / f"a{suffix}", y_up=True), before, STEPS[suffix])
    plain = np.asarray(hg.load_gaussians(tmp_path / f"a{suffix}").means)
    sign = -1 if suffix in (".ply", ".splat") else 1  # y of what viewers read
    np.testing.assert_allclose(
        plain[:, 1], sign * np.asarray(before.means)[:, 1], atol=STEPS[suffix][0]
    )


def test_deformations_and_a_low_pass_are_in_the_scales(tmp_path):
    rng = np.random.default_rng(3)
    bent = replace(
        scene(),
        deformations=jnp.asarray(np.eye(3) + 0.2 * rng.normal(size=(20, 3, 3)), jnp.float32),
    )
    hg.save_gaussians(tmp_path / "a.ply", bent)
    assert_close(hg.load_gaussians(tmp_path / "a.ply"), bent, STEPS[".ply"])


def ply(gaussians, kind="<f4", form="binary_little_endian", extra=(), faces=False):
    """Returns a .ply file in the layout of 3DGS's authors."""
    g = gaussians
    rest = np.zeros((len(g.means), 0))
    if g.harmonics is not None:
        rest = np.asarray(g.harmonics).swapaxes(1, 2).reshape(20, -1)
    extra = extra if isinstance(extra, dict) else dict.fromkeys(extra, np.arange(20))
    columns = dict(zip("xyz", np.asarray(g.means).T, strict=True)) | extra
    columns |= {f"f_dc_{i}": (np.asarray(g.colors)[:, i] - 0.5) / C0 for i in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    p = np.asarray(g.opacities, np.float64)
    columns |= {"opacity": np.log(p / (1 - p))} | {
        f"scale_{i}": np.log(g.scales)[:, i] for i in range(3)
    }
    columns |= {f"rot_{i}": 2 * np.asarray(g.quats)[:, i] for i in range(4)}
    word = {"4": "float", "8": "double"}[kind[-1]]
    header = ["ply", f"format {form} 1.0", "comment made by hand", "element vertex 20"]
    header += [f"property {word} {name}" for name in columns]
    header += ["element face 1", "property list uchar int vertex_indices"] if faces else []
    rows = np.stack(list(columns.values()), axis=1)
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()) + "\n"
    body = text.encode() if form == "ascii" else rows.astype(kind).tobytes()
    return "\n".join([*header, "end_header\n"]).encode() + body + (b"\3" + bytes(12)) * faces


def packed(parts, widths):
    """Returns numbers from 0 to 1 packed into 32-bit words, the first in the highest bits."""
    word = np.zeros(len(parts), np.uint32)
    for part, width in zip(parts.T, widths, strict=True):
        word = word << np.uint32(width) | np.rint(part * (2**width - 1)).astype(np.uint32)
    return word


def smallest_three(quats):
    """Returns the index of the largest component, which is made positive, and the other three."""
    quats = np.asarray(quats) / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.argmax(np.abs(quats), axis=1)
    quats = quats * np.sign(quats[np.arange(len(quats)), largest])[:, None]
    return largest.astype(np.uint32), np.stack(
        [np.delete(q, i) for q, i in zip(quats, largest, strict=True)]
    )


def compressed_ply(gaussians, colors_bounded=True):
    """A file in PlayCanvas's layout: bounds of each 256 Gaussians, and integers between them."""
    g = gaussians
    largest, three = smallest_three(g.quats)
    rotation = largest << np.uint32(30) | packed(three / np.sqrt(2) + 0.5, (10, 10, 10))
    kinds = {"": np.asarray(g.means), "scale_": np.log(g.scales), "c": np.asarray(g.colors)}
    words, bounds, count = {}, {}, len(g.means)
    chunks = [slice(at, at + 256) for at in range(0, count, 256)]
    # each chunk has bounds; words hold the place between them, from 0 to 1
    for key, values in kinds.items():
        names = "rgb" if key == "c" else [f"{key}{axis}" for axis in "xyz"]
        low, high = (
            np.stack([pick(values[chunk], axis=0) for chunk in chunks]) for pick in (np.min, np.max)
        )
        if key == "c" and not colors_bounded:
            low, high = np.zeros_like(low), np.ones_like(high)
        else:
            bounds |= {f"min_{n}": c for n, c in zip(names, low.T, strict=True)}
            bounds |= {f"max_{n}": c for n, c in zip(names, high.T, strict=True)}
        low, high = (np.repeat(each, 256, axis=0)[:count] for each in (low, high))
        words[key] = (values - low) / (high - low)
    color = packed(np.column_stack([words["c"], g.opacities]), (8, 8, 8, 8))
    vertex = [
        packed(words[""], (11, 10, 11)),
        rotation,
        packed(words["scale_"], (11, 10, 11)),
        color,
    ]
    names = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    header = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    header += [f"property float {name}" for name in bounds] + [f"element vertex {count}"]
    header += [f"property uint {name}" for name in names]
    body = (
        np.stack(list(bounds.values()), axis=1).astype("<f4").tobytes()
        + np.stack(vertex, axis=1).astype("<u4").tobytes()
    )
    # harmonics are bytes of their own element, from -4 to 4
    if g.harmonics is not None:
        rest = np.asarray(g.harmonics).swapaxes(1, 2).reshape(count, -1)
        header += [
            f"element sh {count}",
            *(f"property uchar f_rest_{i}" for i in range(rest.shape[1])),
        ]
        body += np.clip(np.trunc((rest / 8 + 0.5) * 256), 0, 255).astype("u1").tobytes()
    return "\n".join([*header, "end_header\n"]).encode() + body


def spz(gaussians, version):
    """A file by Niantic's specification, versions 1 to 4; `spz_four` packs version 4."""
    g, bits = gaussians, 12
    k = 0 if g.harmonics is None else g.harmonics.shape[1]
    quats = np.asarray(g.quats) / np.linalg.norm(g.quats, axis=1, keepdims=True)
    # three components of the quaternion as bytes, from version 3 on the three smallest
    if version < 3:
        rotations = (
            np.rint(127.5 * np.where(quats[:, :1] < 0, -1, 1) * quats[:, 1:] + 127.5)
            .astype("u1")
            .tobytes()
        )
    else:
        largest, three = smallest_three(quats[:, [1, 2, 3, 0]])
        words = largest
        for part in three.T:
            words = words << np.uint32(10) | (part < 0).astype(np.uint32) << np.uint32(9)
            words = words | np.rint(511 * np.sqrt(2) * np.abs(part)).astype(np.uint32)
        rotations = words.astype("<u4").tobytes()
    byte = lambda x: np.clip(np.rint(x), 0, 255).astype("u1").tobytes()
    # places: 24 bits of fixed point, in version 1 half floats
    fixed = np.rint(np.asarray(g.means) * 2**bits).astype(int).reshape(-1).tolist()
    places = b"".join((n % 2**24).to_bytes(3, "little") for n in fixed)
    places = np.asarray(g.means).astype("<f2").tobytes() if version == 1 else places
    colors = byte(255 * (0.15 * (np.asarray(g.colors) - 0.5) / C0 + 0.5))
    parts = [
        places,
        byte(255 * np.asarray(g.opacities)),
        colors,
        byte(16 * (np.log(g.scales) + 10)),
        rotations,
    ]
    parts += [byte(128 * np.asarray(g.harmonics) + 128)] if k else []
    if version == 4:
        return spz_four(parts, degree=COUNTS.index(k), bits=bits)
    return gzip.compress(
        struct.pack("<IIIBBBB", 0x5053474E, version, 20, COUNTS.index(k), bits, 1, 0)
        + b"".join(parts)
    )


def spz_four(parts, count=20, degree=0, bits=12, flags=0, records=b"", sizes=None, toc=None):
    """Returns a file of version 4: header, records, table, and a zstd frame for each array."""
    frames = [zstd.compress(part) for part in parts]
    sizes = [len(part) for part in parts] if sizes is None else sizes
    table = b"".join(
        struct.pack("<QQ", len(frame), size) for frame, size in zip(frames, sizes, strict=True)
    )
    at = 32 + len(records) if toc is None else toc
    header = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, count, degree, bits, flags, len(parts), at)
    return header + records + table + b"".join(frames)


def glb(gaussians, node=None, change=lambda content: None, short=False):
    """Returns a glTF 2.0 file with the extension's attributes; `short` stores 16-bit rotations."""
    g = gaussians
    quats = np.asarray(g.quats) / np.linalg.norm(g.quats, axis=1, keepdims=True)
    columns = {
        "POSITION": g.means,
        f"{EXTENSION}:SCALE": g.scales,
        f"{EXTENSION}:OPACITY": g.opacities,
    }
    columns[f"{EXTENSION}:ROTATION"] = quats[:, [1, 2, 3, 0]]
    columns[f"{EXTENSION}:SH_DEGREE_0_COEF_0"] = (np.asarray(g.colors) - 0.5) / C0
    names = [
        f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"
        for degree in (1, 2, 3)
        for i in range(2 * degree + 1)
    ]
    if g.harmonics is not None:
        columns |= {name: g.harmonics[:, i] for i, name in enumerate(names[: g.harmonics.shape[1]])}
    # an attribute is an accessor and a view into the binary chunk
    binary, views, accessors = b"", [], []
    for name, values in columns.items():
        small = short and name.endswith("ROTATION")
        numbers = np.asarray(values, "<f4")
        if small:
            numbers = np.rint(np.asarray(values) * 32767).astype("<i2")
        data = numbers.tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        binary += data
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[np.asarray(values).reshape(20, -1).shape[1]]
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": 5122 if small else 5126,
                "count": 20,
                "type": kind,
            }
        )
        accessors[-1] |= {"normalized": True} if small else {}
    about = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    part = {
        "attributes": {name: i for i, name in enumerate(columns)},
        "mode": 0,
        "extensions": {EXTENSION: about},
    }
    content = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [EXTENSION],
        "nodes": [{"mesh": 0} | (node or {})],
    }
    content |= {"meshes": [{"primitives": [part]}], "accessors": accessors, "bufferViews": views}
    content |= {"buffers": [{"byteLength": len(binary)}]}
    # `change` may damage the document before it is written
    change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


SHORT = (1e-6, 1e-3, 1e-6, 1e-6, 1e-6)
PACKED = (2e-3, 0.03, 0.51 / 255, 0.51 / 255, 8 / 512)
"""Errors of 10-bit positions over some 5 m and of 8-bit harmonics from -4 to 4."""
BY_HAND = {
    "float": (ply, STEPS[".ply"]),
    "double": (lambda g: ply(g, "<f8"), STEPS[".ply"]),
    "big-endian, with other properties and faces": (
        lambda g: ply(g, ">f4", "binary_big_endian", ("nx", "label"), faces=True),
        STEPS[".ply"],
    ),
    "text": (lambda g: ply(g, form="ascii", extra=("nx",)), STEPS[".ply"]),
    "compressed": (compressed_ply, PACKED),
    "compressed, colors from 0 to 1": (lambda g: compressed_ply(g, colors_bounded=False), PACKED),
    "spz 1": (lambda g: spz(g, 1), (2e-3, 0.09, *STEPS[".spz"][2:])),
    "spz 4": (lambda g: spz(g, 4), (2.0**-13, *STEPS[".spz"][1:])),
    "spz 2": (lambda g: spz(g, 2), (2.0**-13, 0.09, *STEPS[".spz"][2:])),
    "spz 3": (lambda g: spz(g, 3), (2.0**-13, *STEPS[".spz"][1:])),
    "glb": (glb, STEPS[".glb"]),
    "glb in 16 bits": (lambda g: glb(g, short=True), SHORT),
}


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", BY_HAND)
def test_files_by_the_published_layouts_are_read(name, count, tmp_path):
    make, steps = BY_HAND[name]
    (tmp_path / "a.bin").write_bytes(make(scene(count)))
    assert_close(hg.load_gaussians(tmp_path / "a.bin"), scene(count), steps)


def test_chunks_of_compressed_files_have_bounds_of_their_own(tmp_path):
    many = scene(g=300)
    many = replace(many, means=many.means + 100 * (jnp.arange(300) >= 256)[:, None])
    (tmp_path / "a.compressed.ply").write_bytes(compressed_ply(many))
    assert_close(hg.load_gaussians(tmp_path / "a.compressed.ply"), many, (4e-3, *PACKED[1:]))


def test_splat_is_read_by_its_suffix(tmp_path):
    g = scene()
    quats = np.asarray(g.quats) / np.linalg.norm(g.quats, axis=1, keepdims=True)
    numbers = np.column_stack([g.means, g.scales]).astype("<f4")
    bytes_ = np.clip(
        np.rint(np.column_stack([255 * g.colors, 255 * g.opacities, 128 * quats + 128])), 0, 255
    ).astype("u1")
    rows = b"".join(a.tobytes() + b.tobytes() for a, b in zip(numbers, bytes_, strict=True))
    (tmp_path / "a.SPLAT").write_bytes(rows)
    assert_close(hg.load_gaussians(tmp_path / "a.SPLAT"), g, STEPS[".splat"])


def test_gaussians_of_a_glb_lie_where_its_nodes_are(tmp_path):
    """One node turns by half about z, doubles the size and lifts by one; another one stays."""
    node = {"rotation": [0, 0, 1, 0], "scale": [2, 2, 2], "translation": [0, 1, 0]}
    (tmp_path / "a.glb").write_bytes(
        glb(scene(3), node, lambda content: content["nodes"].append({"mesh": 0}))
    )
    g, before = hg.load_gaussians(tmp_path / "a.glb"), scene(3)
    placed = np.asarray(before.means) * [-2, -2, 2] + [0, 1, 0]
    np.testing.assert_allclose(g.means, np.concatenate([placed, before.means]), atol=1e-5)
    np.testing.assert_allclose(np.sort(g.scales[:20]), np.sort(2 * before.scales), rtol=1e-4)
    turned = np.asarray(before.harmonics) * np.asarray([-1, 1, -1])[:, None]  # of y, z and x
    np.testing.assert_allclose(g.harmonics, np.concatenate([turned, before.harmonics]), atol=1e-5)


def with_nan(field, place=(3,)):
    return replace(scene(3), **{field: getattr(scene(3), field).at[place].set(np.nan)})


def of_degree_4():
    return replace(scene(), harmonics=jnp.zeros((20, 24, 3)))


SIZES = [20 * width for width in (9, 1, 3, 3, 4)]


def zeros(harmonics=0):
    return [bytes(size) for size in SIZES] + [bytes(60 * harmonics)] * bool(harmonics)


def without(name):
    return lambda content: content["meshes"][0]["primitives"][0]["attributes"].pop(
        f"{EXTENSION}:{name}"
    )


def headed(*lines, body=b""):
    return (
        "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header\n"]).encode()
        + body
    )


def spz_of(version=3, count=20, degree=0, body=b"", behind=b""):
    return (
        gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0) + body)
        + behind
    )


BAD = {
    "ply of NaN": (
        lambda: ply(with_nan("scales", ...)),
        r"scale_\*: none of 20 Gaussians has finite numbers",
    ),
    "ply of degree 4": (lambda: ply(of_degree_4()), "of degree 1 to 3, got 72 of degree 4"),
    "ply cut off": (lambda: ply(scene())[:-1], "element vertex: 20 of them are not in"),
    "ply of points": (
        lambda: ply(scene()).replace(b"f_dc_0", b"red"),
        "f_dc_0: missing: expected Gaussians",
    ),
    "ply of 10^15": (
        lambda: headed("element vertex 1000000000000000", "property float x"),
        "the limit gaussians is",
    ),
    "compressed without chunks": (
        lambda: compressed_ply(scene()).replace(b"chunk 1", b"chunk 0"),
        "chunk: expected one for each 256",
    ),
    "splat of 33 bytes": (lambda: bytes(33), "expected 32 bytes for each Gaussian"),
    "splat of a negative scale": (
        lambda: np.full(8, -1, "<f4").tobytes(),
        "scale: expected numbers in",
    ),
    "spz of 2^32": (
        lambda: spz_of(count=2**32 - 1),
        "4,294,967,295 Gaussians: the limit gaussians",
    ),
    "spz bomb": (lambda: spz_of(count=19_000_000, degree=3), "bytes unpack to"),
    "spz cut off": (lambda: spz(scene(), 3)[:-30], "not a readable file of Gaussians"),
    "spz 4 of 2^32": (
        lambda: spz_four(zeros(), count=2**32 - 1),
        "4,294,967,295 Gaussians: the limit gaussians",
    ),
    "spz 4, a bomb": (
        lambda: spz_four([bytes(1 << 24), *zeros()[1:]], sizes=SIZES),
        "unpacks to more than the 180",
    ),
    "spz 4 cut off": (lambda: spz(scene(), 4)[:-1], "cut short: a stream of"),
    "spz 4 with its table elsewhere": (
        lambda: spz_four(zeros(), toc=2**32 - 1),
        "table of 5 streams at 4,294,967,295",
    ),
    "glb of NaN": (lambda: glb(with_nan("opacities", ...)), "OPACITY: none of 20"),
    "glb without rotations": (
        lambda: glb(scene(), change=without("ROTATION")),
        "ROTATION: missing",
    ),
    "glb of compressed Gaussians": (
        lambda: glb(scene(), change=lambda c: c.update(extensionsRequired=["SPZ_2"])),
        "needs the extension 'SPZ_2'",
    ),
    "glb of many copies": (
        lambda: glb(scene(), change=lambda c: c["nodes"].extend([{"mesh": 0}] * 2001)),
        "limit parts",
    ),
    "glb of a node in itself": (lambda: glb(scene(), {"children": [0]}), "lies below itself"),
    "text": (
        lambda: b"hello",
        "expected a file ending in .ply, .splat, .spz, .glb, .sog, .pt, .pth or .ckpt",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_one_line_with_file_and_property(name, tmp_path):
    make, message = BAD[name]
    path = tmp_path / ("a.splat" if name.startswith("splat") else "a.bin")
    path.write_bytes(make())
    with pytest.raises(FileError, match=message) as error:
        hg.load_gaussians(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_as_many_as_the_limits_allow(tmp_path):
    for suffix in STEPS:
        hg.save_gaussians(tmp_path / f"a{suffix}", scene())
    try:
        set_limits(Limits(gaussians=19))
        for suffix in STEPS:
            with pytest.raises(FileError, match=r"20 .*: the limit gaussians is 19"):
                hg.load_gaussians(tmp_path / f"a{suffix}")
    finally:
        set_limits(None)
    with pytest.raises(FileNotFoundError):
        hg.load_gaussians(tmp_path / "none.ply")


def test_what_a_file_cannot_hold_is_not_written(tmp_path):
    for name, gaussians, message in (
        ("a.splat", scene(3), r"a\.splat holds one color|one color for each Gaussian"),
        ("a.obj", scene(), r"expected a name ending in \.ply, \.splat, \.spz or \.glb"),
        ("a.ply", with_nan("harmonics"), "harmonics: expected finite numbers"),
        ("a.glb", scene(g=0), "at least one Gaussian"),
    ):
        with pytest.raises(ValueError, match=message):
            hg.save_gaussians(tmp_path / name, gaussians)
    assert not list(tmp_path.iterdir())


def test_a_spz_that_a_download_unpacked_is_read(tmp_path):
    packed, plain = tmp_path / "packed.spz", tmp_path / "plain.spz"
    hg.save_gaussians(packed, scene(3))
    plain.write_bytes(gzip.decompress(packed.read_bytes()))
    assert_close(hg.load_gaussians(plain), hg.load_gaussians(packed), [0] * 5)
    plain.write_bytes(plain.read_bytes()[:-1])
    with pytest.raises(FileError, match=r"expected 20 Gaussians in .* bytes, got less"):
        hg.load_gaussians(plain)


def test_version_4_is_written_and_read(tmp_path):
    """The table names each array and no more; versions 3 and 4 hold the same numbers."""
    for count in COUNTS:
        for version in (3, 4):
            hg.save_gaussians(tmp_path / f"{version}.spz", scene(count), version=version)
        assert (tmp_path / "4.spz").read_bytes()[:5] == b"NGSP\4"
        assert_close(
            hg.load_gaussians(tmp_path / "4.spz"), hg.load_gaussians(tmp_path / "3.spz"), [0] * 5
        )
    with pytest.raises(ValueError, match="version: expected 3 or 4, got 2"):
        hg.save_gaussians(tmp_path / "a.spz", scene(), version=2)
    with pytest.raises(
        ValueError, match=r"a\.ply: has no versions: expected a name ending in \.spz"
    ):
        hg.save_gaussians(tmp_path / "a.ply", scene(), version=4)


def test_unused_entries_of_a_spz_are_reported(tmp_path, caplog):
    system = struct.pack("<III", 0xADBE0003, 4, 1)
    other = struct.pack("<II", 0x12340001, 3) + b"abc"
    (tmp_path / "a.spz").write_bytes(spz_four(zeros(), flags=3, records=system + other))
    hg.load_gaussians(tmp_path / "a.spz")
    (line,) = caplog.messages
    assert line.startswith(f"{tmp_path / 'a.spz'}: ") and "antialiased" in line
    assert "the coordinate system" in line and "0x12340001" in line


@pytest.mark.parametrize("suffix", STEPS)
def test_gaussians_that_are_not_finite_are_left_out_and_counted(suffix, tmp_path, caplog):
    """A mean and a quaternion have a NaN, and a scale is infinite, as far as the format allows."""
    if suffix == ".spz":
        pytest.skip("holds finite numbers alone")
    bad = scene()
    bad = replace(
        bad, means=bad.means.at[3, 1].set(np.nan), scales=bad.scales.at[[7, 9], 2].set(np.inf)
    )
    path, good = tmp_path / f"a{suffix}", np.delete(np.arange(20), [3, 7, 9])
    if suffix == ".splat":
        hg.save_gaussians(path, scene())
        rows = np.frombuffer(path.read_bytes(), "<f4").reshape(20, 8).copy()
        rows[3, 1], rows[[7, 9], 5] = np.nan, np.inf
        path.write_bytes(rows.tobytes())
    else:
        path.write_bytes({".ply": ply, ".glb": glb}[suffix](bad))
    found = hg.load_gaussians(path)
    np.testing.assert_allclose(found.means, np.asarray(scene().means)[good], atol=1e-6)
    np.testing.assert_allclose(
        found.opacities, np.asarray(scene().opacities)[good], atol=STEPS[suffix][2]
    )
    assert "3 of 20 Gaussians are left out" in caplog.text and str(path) in caplog.text


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
def test_the_smoothing_filter_of_mip_splatting_is_in_scales_and_opacities(form, tmp_path):
    """By the formula of Mip-Splatting's `save_fused_ply`, for twenty filter sizes from 0 on."""
    kept, filters = scene(), np.arange(20)[:, None] / 40
    (tmp_path / "a.ply").write_bytes(ply(kept, form=form, extra={"filter_3D": filters[:, 0]}))
    scales, found = np.asarray(kept.scales, np.float64), hg.load_gaussians(tmp_path / "a.ply")
    wide = np.sqrt(scales**2 + filters**2)
    np.testing.assert_allclose(np.sort(found.scales), np.sort(wide), rtol=1e-5)
    share = np.sqrt((scales**2).prod(axis=1) / (wide**2).prod(axis=1))
    np.testing.assert_allclose(found.opacities, kept.opacities * share, atol=1e-6)


def test_properties_that_are_not_used_are_named(tmp_path, caplog):
    (tmp_path / "a.ply").write_bytes(ply(scene(), extra=("nx", "beta", "asg_\x1b")))
    hg.load_gaussians(tmp_path / "a.ply")
    assert caplog.messages == [
        f"{tmp_path / 'a.ply'}: properties that are not used: beta, asg_\\x1b"
    ]
    caplog.clear()
    (tmp_path / "a.ply").write_bytes(ply(scene(3), extra=("nx", "ny", "nz", "red"), faces=True))
    hg.load_gaussians(tmp_path / "a.ply")
    assert not caplog.messages


def test_kernels_and_attributes_of_a_glb_that_are_not_used_are_named(tmp_path, caplog):
    def change(content):
        (part,) = content["meshes"][0]["primitives"]
        part["extensions"][EXTENSION]["kernel"] = "beta"
        part["attributes"][f"{EXTENSION}:SH_DEGREE_4_COEF_0"] = 0

    (tmp_path / "a.glb").write_bytes(glb(scene(), change=change))
    hg.load_gaussians(tmp_path / "a.glb")
    assert "kernel 'beta'" in caplog.text and "SH_DEGREE_4_COEF_0" in caplog.text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.sog", "not a zip archive, or cut off"),
        ("meta.json", "an unbundled SOG, or no Gaussians: `zip -j scene.sog FOLDER/*`"),
        ("a.ksplat", "mkkellogg's viewer: `npx @playcanvas/splat-transform scene.ksplat"),
        (
            "ckpt_29999_rank0.pt",
            "not a zip archive, or cut off",
        ),
    ],
)
def test_other_files_of_gaussians_are_named_with_what_converts_them(name, message, tmp_path):
    (tmp_path / name).write_bytes(b"PK\3\4 or else")
    with pytest.raises(FileError, match=re.escape(message)):
        hg.load_gaussians(tmp_path / name)


def test_colors_of_other_spaces_are_reported(tmp_path, caplog):
    def linear(content):
        return content["meshes"][0]["primitives"][0]["extensions"][EXTENSION].update(
            colorSpace="lin_rec709_display"
        )

    (tmp_path / "a.glb").write_bytes(glb(scene(), change=linear))
    assert_close(hg.load_gaussians(tmp_path / "a.glb"), scene(), STEPS[".glb"])
    assert "lin_rec709_display" in caplog.text
