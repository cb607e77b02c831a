"""Files for other people's viewers: one world for all of them, read back by hand, by plyfile and by npm's tools."""

import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import SH_C0, grounded_gaussians, turned, write_glb, write_ply, write_splat
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import Gaussians, covariances

MATRICES = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}
AXES = {"y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1]}
PREFIX = "KHR_gaussian_splatting:"
TOOLS = Path(os.environ.get("HUMANGS_NPM", "."))
"""Folder where `npm install @playcanvas/splat-transform` was run; the environment variable HUMANGS_NPM."""
TRANSFORM = shutil.which(
    "splat-transform", path=f"{TOOLS / 'node_modules' / '.bin'}{os.pathsep}{os.environ.get('PATH', '')}"
)


def person(seed=0, g=20):
    rng = np.random.default_rng(seed)
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    return Gaussians(
        f32(rng.normal(size=(g, 3))),
        f32(rng.normal(size=(g, 4))),
        f32(np.exp(rng.normal(size=(g, 3)) - 3)),
        f32(rng.uniform(0.05, 0.95, g)),
        f32(rng.random((g, 3))),
    )


def unit(quats):
    return np.asarray(quats) / np.linalg.norm(quats, axis=1, keepdims=True)


@pytest.mark.parametrize(("up", "matrix"), MATRICES.items())
def test_a_world_is_turned_as_a_whole_and_up_is_where_it_is_said(up, matrix):
    before, R = person(), np.asarray(matrix, float)
    after = turned(before, up)
    np.testing.assert_allclose(R @ [0, 1, 0], AXES[up], atol=1e-6)
    np.testing.assert_allclose(after.means, np.asarray(before.means) @ R.T, atol=1e-6)
    exact = R @ np.asarray(covariances(before)) @ R.T
    assert np.abs(np.asarray(covariances(after)) - exact).max() < 1e-5 * np.abs(exact).max()


def test_the_lowest_gaussian_that_is_seen_stands_on_the_floor():
    gaussians = person()
    gaussians = replace(
        gaussians, opacities=gaussians.opacities.at[0].set(0.01), means=gaussians.means.at[0, 1].set(-9.0)
    )
    moved = grounded_gaussians(gaussians)
    seen = np.asarray(gaussians.opacities) >= 0.5
    assert np.asarray(moved.means)[seen, 1].min() == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(moved.means[:, [0, 2]], gaussians.means[:, [0, 2]])
    faint = replace(gaussians, opacities=gaussians.opacities * 0.1)
    assert np.isfinite(grounded_gaussians(faint).means).all()


def test_splat_holds_thirty_two_bytes_each_the_largest_first(tmp_path):
    gaussians = person()
    write_splat(tmp_path / "a.splat", gaussians)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 32 * 20
    rows = [struct.unpack("<6f8B", data[at : at + 32]) for at in range(0, len(data), 32)]
    weight = np.asarray(gaussians.opacities) * np.asarray(gaussians.scales).prod(1)
    for row, i in zip(rows, np.argsort(-weight), strict=True):
        np.testing.assert_allclose(row[:3], gaussians.means[i])
        np.testing.assert_allclose(row[3:6], gaussians.scales[i])
        rgba = [*gaussians.colors[i], gaussians.opacities[i]]
        np.testing.assert_allclose(np.asarray(row[6:10]) / 255, rgba, atol=0.51 / 255)
        np.testing.assert_allclose((np.asarray(row[10:]) - 128) / 128, unit(gaussians.quats)[i], atol=1.01 / 128)


def read_glb(path):
    """JSON and the arrays of its only primitive, read by the letter of glTF 2.0."""
    data = path.read_bytes()
    magic, version, length, first, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and first % 4 == 0
    document = json.loads(data[20 : 20 + first])
    size, kind = struct.unpack("<I4s", data[20 + first : 28 + first])
    binary = data[28 + first :]
    assert kind == b"BIN\0" and size == len(binary) == document["buffers"][0]["byteLength"] and size % 4 == 0
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind, step = {5126: ("<f4", 1), 5121: ("u1", 255)}[accessor["componentType"]]
        array = np.frombuffer(binary, kind, accessor["count"] * width, view["byteOffset"])
        arrays[name] = array.reshape(-1, width) / step
    return document, arrays


def test_glb_holds_the_attributes_of_the_extension(tmp_path):
    gaussians = person()
    write_glb(tmp_path / "a.glb", gaussians)
    document, arrays = read_glb(tmp_path / "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    np.testing.assert_array_equal(arrays["POSITION"], gaussians.means)
    np.testing.assert_allclose(document["accessors"][0]["min"], np.asarray(gaussians.means).min(0))
    back = Gaussians(
        jnp.asarray(arrays["POSITION"]),
        jnp.asarray(arrays[PREFIX + "ROTATION"][:, [3, 0, 1, 2]]),
        jnp.asarray(arrays[PREFIX + "SCALE"]),
        jnp.asarray(arrays[PREFIX + "OPACITY"][:, 0]),
        jnp.asarray(0.5 + SH_C0 * arrays[PREFIX + "SH_DEGREE_0_COEF_0"]),
    )
    exact = np.asarray(covariances(gaussians))
    assert np.abs(np.asarray(covariances(back)) - exact).max() < 1e-4 * np.abs(exact).max()
    np.testing.assert_allclose(back.opacities, gaussians.opacities)
    np.testing.assert_allclose(back.colors, gaussians.colors, atol=1e-6)
    np.testing.assert_allclose(arrays["COLOR_0"], np.column_stack([gaussians.colors, gaussians.opacities]), atol=1e-6)


def small_file(folder):
    """An avatar file of upright people's Gaussians: heads above feet."""
    gaussians = person()
    Avatar(
        replace(gaussians, opacities=jnp.full(20, 0.9)),
        jnp.ones((20, 1)),
        gaussians.means[:4],
        gaussians.means[:1],
        jnp.asarray([[0, 1, 2]], jnp.int32),
        parents=(-1,),
        joint_names=("root",),
    ).save(folder / "me.npz")
    return folder / "me.npz"


@pytest.mark.parametrize(("name", "axis"), [("a.ply", [0, -1, 0]), ("a.splat", [0, -1, 0]), ("a.glb", [0, 1, 0])])
def test_the_suffix_decides_the_format_and_its_world(name, axis, tmp_path, monkeypatch, capsys):
    source = small_file(tmp_path)
    monkeypatch.setattr(sys, "argv", ["humangs", "export", str(source), "--out", str(tmp_path / name)])
    cli.main()
    assert "20 Gaussians" in capsys.readouterr().out
    if name.endswith(".ply"):
        import plyfile

        vertex = plyfile.PlyData.read(str(tmp_path / name))["vertex"]
        means = np.stack([vertex[c] for c in "xyz"], axis=1)
    elif name.endswith(".glb"):
        means = read_glb(tmp_path / name)[1]["POSITION"]
    else:
        means = np.frombuffer((tmp_path / name).read_bytes(), "<f4").reshape(-1, 8)[:, :3]
    heights = means @ np.asarray(axis, np.float32)
    assert heights.min() == pytest.approx(0, abs=1e-6)
    own = np.asarray(person().means)[:, 1]
    np.testing.assert_allclose(np.sort(heights), np.sort(own - own.min()), atol=1e-5)


def transformed(source, target):
    """What a program that is not ours makes of a file."""
    done = subprocess.run([str(TRANSFORM), "-w", str(source), str(target)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout


needs_npm = pytest.mark.skipif(
    TRANSFORM is None, reason="needs npm's @playcanvas/splat-transform (HUMANGS_NPM: its folder)"
)


@pytest.mark.slow
@needs_npm
def test_splat_transform_makes_our_glb_of_our_ply(tmp_path):
    """Worlds, scales, rotations, opacities and colours of both files are the same to a program that is not ours."""
    gaussians = person()
    write_ply(tmp_path / "a.ply", turned(gaussians, "-y"))
    write_glb(tmp_path / "a.glb", gaussians)
    transformed(tmp_path / "a.ply", tmp_path / "b.glb")
    (ours, arrays), (theirs, others) = (read_glb(tmp_path / name) for name in ("a.glb", "b.glb"))
    extension = lambda document: document["meshes"][0]["primitives"][0]["extensions"]
    assert extension(ours) == extension(theirs) and set(arrays) == set(others)
    nearest = [int(np.argmin(np.linalg.norm(others["POSITION"] - mean, axis=1))) for mean in arrays["POSITION"]]
    assert len(set(nearest)) == len(gaussians.means)
    for name, array in arrays.items():
        other = others[name][nearest]
        if name.endswith("ROTATION"):
            other = other * np.sign((other * array).sum(1, keepdims=True))
        np.testing.assert_allclose(other, array, atol=0.51 / 255 if name == "COLOR_0" else 2e-6, err_msg=name)


@pytest.mark.slow
@needs_npm
def test_splat_transform_reads_our_splat(tmp_path):
    import plyfile

    gaussians = person()
    write_splat(tmp_path / "a.splat", gaussians)
    transformed(tmp_path / "a.splat", tmp_path / "b.ply")
    vertex = plyfile.PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    read = lambda *names: np.stack([vertex[name] for name in names], axis=-1)
    means = read("x", "y", "z")
    nearest = [int(np.argmin(np.linalg.norm(means - mean, axis=1))) for mean in np.asarray(gaussians.means)]
    np.testing.assert_allclose(means[nearest], gaussians.means, atol=1e-5)
    np.testing.assert_allclose(np.exp(read("scale_0", "scale_1", "scale_2"))[nearest], gaussians.scales, rtol=1e-4)
    np.testing.assert_allclose(1 / (1 + np.exp(-vertex["opacity"]))[nearest], gaussians.opacities, atol=0.003)
    np.testing.assert_allclose(0.5 + SH_C0 * read("f_dc_0", "f_dc_1", "f_dc_2")[nearest], gaussians.colors, atol=0.003)
    quats = unit(read("rot_0", "rot_1", "rot_2", "rot_3"))[nearest]
    assert np.abs((quats * unit(gaussians.quats)).sum(1)).min() > 0.999
