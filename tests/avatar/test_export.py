"""Files for viewers of other programs have one world, and come back unchanged.

Our own reader (test_splat_files) and npm's tools read them.
"""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small import random_gaussians

from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import EXPORTS, chosen_format
from humangs_jax.avatar.export.gaussians import (
    BACKWARDS,
    SH_C0,
    export,
    frame_range,
    grounded_gaussians,
    load_gaussians,
    rotated,
    turned,
)
from humangs_jax.avatar.export.splats import write_glb, write_ply, write_splat
from humangs_jax.avatar.export.spz import write_spz
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.core.registry import imported
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.mesh import parse_glb, read_accessor
from humangs_jax.motion import save_motion
from humangs_jax.rendering.gaussians import covariances, widened
from humangs_jax.rendering.projection import project_gaussians as project

MATRICES = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
}
AXES = {"y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1]}
PREFIX = "KHR_gaussian_splatting:"
SPZ_LOSSES = {
    **{"SCALE": 0.02, "ROTATION": 0.08, "OPACITY": 0.51 / 255},
    "SH_DEGREE_0_COEF_0": 0.51 / 255 / 0.15,
}
"""Errors that the bits of `.spz` leave: scales of up to 0.6 m have steps of 6 %, and covariances
twice that.
"""
TOOLS = Path(os.environ.get("HUMANGS_NPM", "."))
"""Folder in which `npm install @playcanvas/splat-transform` was run: the variable HUMANGS_NPM."""
TRANSFORM = shutil.which(
    "splat-transform",
    path=f"{TOOLS / 'node_modules' / '.bin'}{os.pathsep}{os.environ.get('PATH', '')}",
)


@pytest.mark.parametrize(("up", "matrix"), MATRICES.items())
def test_a_world_is_turned_as_a_whole_to_the_up_that_was_asked_for(up, matrix):
    before, R = random_gaussians(), np.asarray(matrix, float)
    after = turned(before, up)
    np.testing.assert_allclose(R @ [0, 1, 0], AXES[up], atol=1e-6)
    np.testing.assert_allclose(after.means, np.asarray(before.means) @ R.T, atol=1e-6)
    exact = R @ np.asarray(covariances(before)) @ R.T
    assert np.abs(np.asarray(covariances(after)) - exact).max() < 1e-5 * np.abs(exact).max()


def off_by(a, b):
    """Returns the largest differences of covariances (relative), opacities and colors."""
    exact = np.asarray(covariances(a))
    return [
        np.abs(np.asarray(covariances(b)) - exact).max() / np.abs(exact).max(),
        np.abs(np.asarray(b.opacities) - np.asarray(a.opacities)).max(),
        np.abs(np.asarray(b.colors) - np.asarray(a.colors)).max(),
    ]


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.sampled_from(sorted(MATRICES)), st.floats(-8, 2), st.floats(-2, 4)
)
def test_one_person_comes_back_from_every_file(tmp_path_factory, seed, up, thickness, distance):
    """Gaussians are micrometres to metres thick, up to a kilometre away, opaque and faint."""
    folder = tmp_path_factory.mktemp("files")
    rng, before = np.random.default_rng(seed), random_gaussians(seed)
    opacities = jnp.asarray(rng.choice([0.0, 1e-3, 0.5, 1.0], 20), jnp.float32)
    scales = before.scales * 10.0 ** (thickness / 2)
    before = replace(
        before, means=before.means * 10.0 ** (distance - 1), scales=scales, opacities=opacities
    )
    R, world = np.asarray(MATRICES[up], float), turned(before, up)
    write_ply(folder / "a.ply", world)
    write_spz(folder / "a.spz", world)
    back = load_gaussians(folder / "a.ply")
    np.testing.assert_allclose(np.asarray(back.means) @ R, before.means, rtol=1e-6)  # R^-1 = R^T
    assert max(off_by(world, back)) < 1e-5
    back = load_gaussians(folder / "a.spz")
    step = max(1e-6, np.abs(before.means).max() * 2.0**-22)
    np.testing.assert_allclose(np.asarray(back.means) @ R, before.means, atol=step)
    covariance, opacity, color = off_by(world, back)
    assert opacity <= 0.501 / 255 and color <= 0.501 / 255 / 0.15 * SH_C0
    # scales in steps of 1 / 16: e^(1 / 16) of the squares. Those below e^-10 become it; of a
    # covariance whose largest scale is s the largest element is at least s^2 / 3
    raised = 0
    if np.asarray(scales).min() < np.exp(-10):
        raised = 3 * (np.exp(-10) / np.asarray(scales).max()) ** 2
    assert covariance < 0.08 + raised


def test_frames_are_named_as_python_names_them():
    assert list(frame_range("0:10:4", 100)) == [0, 4, 8] and len(frame_range(":", 7)) == 7
    assert list(frame_range("-2:", 7)) == [5, 6] and list(frame_range("::3", 7)) == [0, 3, 6]
    for bad in ("", "5", "a:b", "1:2:3:4", "0:5:0", "5:0:-1", "9:", "1.5:2"):
        with pytest.raises(ValueError, match=r"expected|none of the 7 frames"):
            frame_range(bad, 7)


def test_the_lowest_gaussian_that_is_seen_stands_on_the_floor():
    gaussians = random_gaussians()
    gaussians = replace(
        gaussians,
        opacities=gaussians.opacities.at[0].set(0.01),
        means=gaussians.means.at[0, 1].set(-9.0),
    )
    moved = grounded_gaussians(gaussians)
    seen = np.asarray(gaussians.opacities) >= 0.5
    assert np.asarray(moved.means)[seen, 1].min() == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(moved.means[:, [0, 2]], gaussians.means[:, [0, 2]])
    faint = replace(gaussians, opacities=gaussians.opacities * 0.1)
    assert np.isfinite(grounded_gaussians(faint).means).all()


def read_glb(path):
    """Returns (document, arrays of its only primitive by name)."""
    document, binary = parse_glb(path.read_bytes())
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    return document, {
        name: read_accessor(document, binary, index) for name, index in attributes.items()
    }


def test_viewers_that_do_not_know_the_extension_show_colored_points(tmp_path):
    gaussians = random_gaussians()
    write_glb(tmp_path / "a.glb", gaussians)
    data = (tmp_path / "a.glb").read_bytes()
    start, version, length, header = struct.unpack("<4sIII", data[:16])
    assert (start, version, length) == (b"glTF", 2, len(data)) and header % 4 == len(data) % 4 == 0
    document, arrays = read_glb(tmp_path / "a.glb")
    assert (
        document["extensionsUsed"] == ["KHR_gaussian_splatting"]
        and "extensionsRequired" not in document
    )
    assert document["meshes"][0]["primitives"][0]["mode"] == 0  # points
    np.testing.assert_allclose(document["accessors"][0]["min"], np.asarray(gaussians.means).min(0))
    np.testing.assert_allclose(arrays["COLOR_0"][:, 3], gaussians.opacities, atol=1e-6)
    linear = arrays["COLOR_0"][:, :3]  # glTF's colors of vertices are linear
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(encoded, gaussians.colors, atol=1e-6)


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_viewers_that_add_their_own_low_pass_draw_what_we_draw(tmp_path_factory, seed):
    """A viewer of 3DGS adds 0.3 square pixels to the file's covariances, our renderer 0.1 to scales
    that contain the rest.
    """
    file, depth = tmp_path_factory.mktemp("files") / "a.ply", 2.0
    camera = Camera.from_opencv(
        np.asarray([[512.0, 0, 256], [0, 512, 256], [0, 0, 1]]), np.eye(4), 512, 512
    )
    gaussians = random_gaussians(seed)
    means = gaussians.means * jnp.asarray([0.05, 0.05, 0]) + jnp.asarray([0, 0, depth])
    gaussians = replace(gaussians, means=means, scales=gaussians.scales / 10)  # about a pixel
    pixel = jnp.full(20, depth / 512)
    write_ply(
        file, replace(gaussians, scales=widened(gaussians.scales, pixel), pixel_footprint=pixel)
    )
    assert off_by(gaussians, load_gaussians(file))[0] < 1e-4  # float32: a difference of squares
    ours = project(
        replace(gaussians, scales=widened(gaussians.scales, pixel), pixel_footprint=pixel), camera
    )
    theirs = project(load_gaussians(file), camera)
    for name in ("xx", "yy"):
        ratio = np.asarray(getattr(theirs, name)) / np.asarray(getattr(ours, name))
        # the viewers' 0.2 lie in the image, ours in the Gaussian
        np.testing.assert_allclose(ratio, 1, atol=0.02)


def small_file(folder):
    """Writes an avatar whose Gaussians are upright people, heads above feet; returns its path."""
    gaussians = random_gaussians()
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


@pytest.mark.parametrize(
    ("name", "axis"),
    [("a.ply", [0, -1, 0]), ("a.splat", [0, -1, 0]), ("a.spz", [0, 1, 0]), ("a.glb", [0, 1, 0])],
)
def test_the_suffix_decides_the_format_and_its_world(name, axis, tmp_path, monkeypatch, capsys):
    source = small_file(tmp_path)
    monkeypatch.setattr(
        sys, "argv", ["humangs", "export", str(source), "--out", str(tmp_path / name)]
    )
    cli.main()
    out = capsys.readouterr().out
    assert (
        "20 Gaussians" in out
        and out.splitlines()[-1] == f"next: humangs export {source} --html avatar.html"
    )
    means = np.asarray(load_gaussians(tmp_path / name).means)
    if name.endswith(".spz"):
        facing_z = np.sort(-np.asarray(random_gaussians().means)[:, 2])  # backwards
        np.testing.assert_allclose(np.sort(means[:, 2]), facing_z, atol=1e-5)
    heights = means @ np.asarray(axis, np.float32)
    assert heights.min() == pytest.approx(0, abs=1e-6)
    own = np.asarray(random_gaussians().means)[:, 1]
    np.testing.assert_allclose(np.sort(heights), np.sort(own - own.min()), atol=1e-5)


@pytest.mark.parametrize("each", EXPORTS.values(), ids=EXPORTS)
def test_every_row_names_code_that_is_there(each):
    assert callable(imported(each.code)) and each.suffixes


def exported(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["humangs", "export", *map(str, words)])
    cli.main()


@pytest.mark.slow
def test_a_sequence_of_frames_stands_on_one_floor(tmp_path, monkeypatch, capsys):
    source, rise = small_file(tmp_path), np.asarray([0, 0.5, 0.1, 2.0])
    moves = jnp.asarray(np.stack([0 * rise, rise, 0 * rise], axis=1), jnp.float32)
    save_motion(tmp_path / "jump.npz", Motion(jnp.zeros((4, 1, 3)), moves, 24.0))
    exported(
        monkeypatch,
        source,
        "--out",
        tmp_path / "x.ply",
        "--motion",
        tmp_path / "jump.npz",
        "--frames",
        "0:4:3",
    )
    assert "x_0000.ply to x_0003.ply: 2 files: 20 Gaussians" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.glob("x*")) == ["x_0000.ply", "x_0003.ply"]
    first, last = (np.asarray(load_gaussians(tmp_path / f"x_{i:04d}.ply").means) for i in (0, 3))
    np.testing.assert_allclose(first - last, np.tile([0, 2.0, 0], (20, 1)), atol=1e-5)  # -y is up
    exported(
        monkeypatch,
        source,
        "--out",
        tmp_path / "y.spz",
        "--motion",
        tmp_path / "jump.npz",
        "--frame",
        "3",
    )
    assert np.asarray(load_gaussians(tmp_path / "y.spz").means)[:, 1].min() == pytest.approx(
        0, abs=1e-5
    )


def test_the_function_checks_as_the_command_does(tmp_path):
    small_file(tmp_path)
    avatar = Avatar.load(tmp_path / "me.npz")
    jump = Motion(jnp.zeros((4, 1, 3)), jnp.zeros((4, 3)), 24.0)
    for name, options, message in (
        ("x.sog", {}, "expected a name ending in .ply, .splat, .spz, .glb, .vrma or .obj"),
        ("x.spz", {"rest_fields": True}, "no rest fields: expected a name ending in .ply"),
        ("x.ply", {"mesh": True}, "expected a name ending in .glb, .vrma or .obj for a mesh"),
        ("x.ply", {"motion": jump}, "each of the 4 frames, got no numbers"),
        ("x.ply", {"motion": jump, "numbers": [1, 2]}, "each of the 4 frames, got 2 numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            export(tmp_path / name, avatar, **options)
    assert not list(tmp_path.glob("x*"))


@pytest.mark.parametrize("name", ["x.ply", "x.splat", "x.spz", "x.glb", "mesh.glb", "mesh.obj"])
def test_numbers_that_files_cannot_hold_are_not_written(name, tmp_path):
    small_file(tmp_path)
    avatar = Avatar.load(tmp_path / "me.npz")
    own = avatar.gaussians
    for value in (3e38, np.nan, -np.inf):
        means, scales, colors = (x.at[1, 0].set(value) for x in (own.means, own.scales, own.colors))
        wrong = [
            replace(own, means=means),
            replace(own, scales=scales),
            replace(own, colors=colors),
        ]
        people = [replace(avatar, gaussians=gaussians) for gaussians in wrong]
        mesh = name.startswith("mesh")
        if mesh:
            people = [
                people[2],
                replace(avatar, rest_vertices=avatar.rest_vertices.at[0, 0].set(value)),
            ]
        for person_ in people:
            with pytest.raises(ValueError, match=r"export: .*expected finite numbers"):
                export(tmp_path / name, person_, mesh=mesh)
    assert [file.name for file in tmp_path.iterdir()] == ["me.npz"]


def transformed(source, target):
    """Converts a file with splat-transform."""
    done = subprocess.run(
        [str(TRANSFORM), "-w", str(source), str(target)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr + done.stdout


needs_npm = pytest.mark.skipif(
    TRANSFORM is None, reason="needs npm's @playcanvas/splat-transform (HUMANGS_NPM: its folder)"
)


def _covariances(xyzw, scales):
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    return np.asarray(
        covariances(
            replace(random_gaussians(), quats=f32(xyzw[:, [3, 0, 1, 2]]), scales=f32(scales))
        )
    )


@pytest.mark.slow
@needs_npm
@pytest.mark.parametrize("name", ["a.ply", "a.spz"])
def test_splat_transform_makes_our_glb_of_our_files(name, tmp_path):
    """Another program finds the same worlds, scales, rotations, opacities and colors in both."""
    gaussians = random_gaussians()
    write = {"a.ply": write_ply, "a.spz": write_spz}[name]
    form = chosen_format(Path(name).suffix)
    write(
        tmp_path / name,
        rotated(gaussians, BACKWARDS) if form.backwards else turned(gaussians, form.up),
    )
    write_glb(tmp_path / "a.glb", gaussians)
    transformed(tmp_path / name, tmp_path / "b.glb")
    (ours, arrays), (theirs, others) = (read_glb(tmp_path / name) for name in ("a.glb", "b.glb"))
    extension = lambda document: document["meshes"][0]["primitives"][0]["extensions"]
    assert extension(ours) == extension(theirs) and set(arrays) == set(others)
    nearest = [
        int(np.argmin(np.linalg.norm(others["POSITION"] - mean, axis=1)))
        for mean in arrays["POSITION"]
    ]
    assert len(set(nearest)) == len(gaussians.means)
    nearest_ones = {attribute: array[nearest] for attribute, array in others.items()}
    for attribute, array in arrays.items():
        if attribute == "COLOR_0":  # the tool writes sRGB-encoded values, glTF asks for linear ones
            continue
        other = nearest_ones[attribute]
        # half a turn about an axis of the Gaussian makes no other one
        if attribute.endswith("ROTATION"):
            array, other = (
                _covariances(q, s[PREFIX + "SCALE"])
                for q, s in ((array, arrays), (other, nearest_ones))
            )
            array, other = array / np.abs(array).max(), other / np.abs(array).max()
        tolerance = (
            SPZ_LOSSES.get(attribute.removeprefix(PREFIX), 2e-6) if name == "a.spz" else 2e-6
        )
        np.testing.assert_allclose(other, array, atol=tolerance, err_msg=attribute)


def test_gsply_reads_our_spz(tmp_path):
    gsply = pytest.importorskip("gsply", reason="needs gsply (PyPI)")
    gaussians = random_gaussians()
    write_spz(tmp_path / "a.spz", gaussians)
    ours, theirs = load_gaussians(tmp_path / "a.spz"), gsply.read_spz(str(tmp_path / "a.spz"))
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(theirs.scales), ours.scales, rtol=1e-5)
    np.testing.assert_allclose(theirs.quats, ours.quats, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-theirs.opacities)), ours.opacities, atol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * theirs.sh0, ours.colors, atol=1e-5)


@pytest.mark.slow
@needs_npm
def test_splat_transform_reads_our_splat(tmp_path):
    gaussians = random_gaussians()
    write_splat(tmp_path / "a.splat", gaussians)
    transformed(tmp_path / "a.splat", tmp_path / "b.ply")
    back = load_gaussians(tmp_path / "b.ply")
    nearest = [
        int(np.argmin(np.linalg.norm(back.means - mean, axis=1)))
        for mean in np.asarray(gaussians.means)
    ]
    np.testing.assert_allclose(back.means[jnp.asarray(nearest)], gaussians.means, atol=1e-5)
    covariance, opacity, color = off_by(
        gaussians, jax.tree.map(lambda x: x[jnp.asarray(nearest)], back)
    )
    assert covariance < 0.05 and max(opacity, color) < 0.003
