"""Textured meshes of dressed people: atlas, textures, skinning by few joints, exported scans."""

import dataclasses
import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.library import load_body
from humangs_jax.rendering.mesh import atlas, rasterizer
from humangs_jax.rendering.mesh.rasterizer import sample_texture
from humangs_jax.synthetic import bank, subject, surroundings, writer
from humangs_jax.synthetic.subject import SPLITS

DEMO = SPLITS["demo"]
SIZE = 512
LEAST_DENSITY = 0.4
"""Least area of a face in the texture over that on the body, but for the worst percent.

Charts may shrink faces that look aside, to `atlas.LEAST_COSINE` along one direction. 0.5 was
measured.
"""
SKINNING = 1.5e-3
"""Largest error, metres; 0.4 mm was measured with six joints a vertex."""
SCAN_PSNR = 32
"""Least PSNR of texels of 5 mm against colors of pixels, dB; at least 37 was measured."""


@pytest.fixture(scope="module")
def person():
    return subject.make_subject(DEMO[0], load_body())


@pytest.fixture(scope="module")
def baked(person):
    return bank.bake_subject(person, SIZE)


@pytest.fixture(scope="module")
def shown(baked):
    """Returns face and weights of every texel."""
    return atlas.texels(baked.atlas)


def flat_areas(uvs, faces):
    a, b, c = (uvs[faces[:, i]].astype(np.float64) for i in range(3))
    ab, ac = b - a, c - a
    return 0.5 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])


def test_charts_do_not_overlap_and_keep_their_winding(person, baked, shown):
    np.testing.assert_array_equal(baked.atlas.vertices[baked.atlas.faces], person.surface.faces)
    assert baked.atlas.uvs.min() >= 0 and baked.atlas.uvs.max() <= 1
    areas = flat_areas(baked.atlas.uvs, baked.atlas.faces) * SIZE**2
    assert areas.min() > -1e-3
    covered = np.count_nonzero(shown[0] >= 0)
    assert abs(areas.sum() / covered - 1) < 0.005  # each covered texel belongs to one face
    assert covered > 0.4 * SIZE**2


def test_charts_stay_apart_and_belong_to_one_piece(person, baked, shown):
    of_face = np.append(baked.atlas.charts, -1)
    charts = of_face[shown[0]]
    for axis in (0, 1):
        near, far = (np.take(charts, range(i, SIZE - 1 + i), axis) for i in (0, 1))
        # a texel at least between two of them
        assert not np.any((near != far) & (near >= 0) & (far >= 0))
    pieces = [
        np.unique(baked.atlas.charts[person.face_materials == k])
        for k in range(len(person.materials))
    ]
    assert len(np.concatenate(pieces)) == baked.atlas.charts.max() + 1


def test_texels_are_spread_evenly(person, baked):
    corners = person.surface.vertices[person.surface.faces].astype(np.float64)
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    flat = flat_areas(baked.atlas.uvs, baked.atlas.faces) * (SIZE * baked.atlas.texel) ** 2
    order = np.argsort(flat / np.maximum(areas, 1e-12))
    share = np.cumsum(areas[order]) / areas.sum()
    density = (flat / np.maximum(areas, 1e-12))[order]
    worst = density[np.searchsorted(share, 0.01)]
    assert worst > LEAST_DENSITY
    assert 0.75 < np.median(density) < 1.01
    assert density.max() < bank.FACE_DENSITY**2 * 1.01
    assert baked.atlas.texel < 0.007


def test_the_texture_says_what_the_materials_say(person, baked):
    rng = np.random.default_rng(0)
    faces = rng.integers(len(person.surface.faces), size=4000)
    weights = rng.dirichlet(np.ones(3), size=4000).astype(np.float32)
    albedo, slopes = subject.paint(person, faces, subject.spots_at(person, faces, weights))
    uv = sum(weights[:, i : i + 1] * baked.atlas.uvs[baked.atlas.faces[faces, i]] for i in range(3))

    def look(texture):
        return np.asarray(sample_texture(jnp.asarray(texture, jnp.float32), jnp.asarray(uv[None])))[
            0
        ]

    error = np.abs(look(baked.albedo) / 255 - np.clip(albedo, 0, 1))
    assert np.median(error) < 0.01 and error.mean() < 0.04  # edges of patterns are a texel wide
    bent = (look(baked.slopes) - bank.SLOPE_ZERO) * bank.SLOPE_STEP
    assert np.abs(bent - slopes).mean() < 0.05 * max(np.abs(slopes).mean(), 0.2)


def test_gaps_take_the_nearest_texel():
    known = np.zeros((4, 6), bool)
    known[1, 1] = known[2, 5] = True
    image = np.where(known[..., None], [[[2.0]], [[3.0]], [[5.0]], [[7.0]]], 0.0)
    filled = bank.fill_gaps(image, known)
    assert filled[0, 0, 0] == 3.0 and filled[3, 5, 0] == 5.0
    assert set(np.unique(filled)) == {3.0, 5.0}


def test_a_few_joints_move_the_mesh_as_all_of_them(person):
    surface = person.surface
    posed = writer.sample_pose(person, 3)

    def moved(count):
        ids, weights = bank.strongest_joints(surface.weights, count)
        np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
        few = np.zeros_like(surface.weights)
        np.put_along_axis(few, ids.astype(int), weights, axis=1)
        other = dataclasses.replace(person, surface=dataclasses.replace(surface, weights=few))
        return np.abs(
            other.posed_vertices(posed.rotations, posed.translation) - posed.vertices
        ).max()

    assert moved(bank.JOINTS_PER_VERTEX) < SKINNING
    assert moved(2) > moved(bank.JOINTS_PER_VERTEX)


@pytest.mark.slow
def test_scans_are_read_back_as_they_were(person, tmp_path):
    import trimesh

    posed, baked = writer.sample_pose(person, 0), bank.bake_subject(person, 512)
    bank.export_scan(posed, tmp_path / "scan", 512)
    known = json.loads((tmp_path / "scan" / "scan.json").read_text())
    assert known["seed"] == person.seed and known["lit"]
    np.testing.assert_allclose(known["rotations"], posed.rotations)
    expected = bank.lit_texture(posed, baked)
    for name in ("scan.obj", "scan.glb"):
        mesh: Any = trimesh.load(tmp_path / "scan" / name, process=False, force="mesh")
        np.testing.assert_array_equal(mesh.faces, baked.atlas.faces)
        np.testing.assert_allclose(mesh.vertices, posed.vertices[baked.atlas.vertices], atol=1e-6)
        np.testing.assert_allclose(mesh.visual.uv, baked.atlas.uvs, atol=1e-6)
        material = mesh.visual.material
        texture = np.asarray(material.image if name.endswith("obj") else material.baseColorTexture)[
            ..., :3
        ]
        np.testing.assert_array_equal(texture, expected)
    # the file, drawn in twice the size and averaged, looks like the subject
    camera = surroundings.cameras_around(
        np.random.default_rng(0), posed.vertices, np.asarray([0.5]), 128
    )[0]
    direct, mask = subject.render_view(posed, camera)
    faces, uvs = jnp.asarray(baked.atlas.faces), jnp.asarray(baked.atlas.uvs)
    vertices = jnp.asarray(posed.vertices[baked.atlas.vertices])
    texture = jnp.asarray(expected / 255, jnp.float32)
    seen = rasterizer.rasterize_mesh(
        vertices, faces, camera.resized(2 * camera.width, 2 * camera.height)
    )
    covered = (seen.face_ids >= 0)[..., None]
    uv = rasterizer.interpolate_attributes(seen, faces, uvs, jnp.zeros(2))
    mean = lambda x: x.reshape(camera.height, 2, camera.width, 2, -1).mean(axis=(1, 3))
    again = mean(jnp.where(covered, sample_texture(texture, uv), 1.0))
    assert np.abs(np.asarray(mean(covered)[..., 0]) - mask).mean() < 1e-3
    assert -10 * np.log10(np.mean((np.asarray(again) - direct) ** 2)) > SCAN_PSNR
