"""Bodies on which weights are tried: the made-up one is another mesh of the same people.

It reads as SMPL-X.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments import bodies
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.network.presets import tiny


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 2000)


def sides(faces):
    """Returns the undirected edges, and how many faces each has."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)


def volume(vertices, faces):
    a, b, c = (np.asarray(vertices)[np.asarray(faces)[:, i]] for i in range(3))
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def test_no_inner_edge_is_left_and_the_surface_stays(body):
    other = bodies.turned_subdivision(body)
    old, new = np.asarray(body.faces), np.asarray(other.faces)
    edges, faces_at = sides(old)
    n, rim = len(body.template), int(np.sum(faces_at == 1))
    new_edges, new_faces_at = sides(new)
    assert len(other.template) == n + len(old) and len(new) == 3 * len(old)
    assert faces_at.max() == new_faces_at.max() == 2 and int(np.sum(new_faces_at == 1)) == rim
    kept = {tuple(edge) for edge in edges} & {tuple(edge) for edge in new_edges}
    assert len(kept) == rim  # an open edge of the old mesh is one of the new one
    # Euler's characteristic
    assert n - len(edges) + len(old) == len(other.template) - len(new_edges) + len(new)
    assert np.isclose(volume(other.template, new), volume(body.template, old), rtol=0.05)


def test_a_rim_stays_where_it_is(body):
    few = {
        name: getattr(body, name)[:4]
        for name in ("template", "shape_directions", "skinning_weights")
    }
    faces, regressor = jnp.asarray([[0, 1, 2], [0, 2, 3]]), body.joint_regressor[:, :4]
    square = replace(body, **few, faces=faces, joint_regressor=regressor)
    turned = {
        tuple(np.roll(face, -np.argmin(face)))
        for face in np.asarray(bodies.turned_subdivision(square).faces)
    }
    assert turned == {(0, 1, 4), (1, 2, 4), (2, 5, 4), (0, 4, 5), (2, 3, 5), (0, 5, 3)}


def test_the_made_up_body_is_the_same_people(body, monkeypatch):
    monkeypatch.setattr(bodies, "SMPLX_SEED_VERTICES", 1000)
    made = bodies.smplx_body(body)
    small = decimate(body, 1000)
    assert (
        made.joint_names == JOINT_NAMES
        and made.name == "SMPLX_MADE_UP"
        and made.pose_directions is not None
    )
    rng = np.random.default_rng(0)
    betas = jnp.asarray(rng.normal(size=body.shape_directions.shape[-1]), jnp.float32)
    pose = BodyPose(
        jnp.asarray(0.3 * rng.normal(size=(55, 3)), jnp.float32), jnp.asarray([0.1, 0.2, 0.3])
    )
    posed = [pose_body(x, shape_body(x, betas), pose) for x in (small, made)]
    assert np.allclose(posed[0].joints, posed[1].joints, atol=1e-5)
    assert np.allclose(posed[0].vertices, posed[1].vertices[:1000], atol=1e-5)


def test_other_joints_are_no_smplx(body, tmp_path):
    with pytest.raises(ValueError, match="joints"):
        bodies.write_smplx(
            tmp_path / "a.npz", replace(body, joint_names=("tail", *body.joint_names[1:]))
        )


@pytest.mark.slow
def test_fractions_are_as_they_are_and_split(body, monkeypatch):
    monkeypatch.setattr(bodies, "SMPLX_SEED_VERTICES", 600)
    config = tiny().with_conventions(body_vertices=1000, max_edge_length=0.05)
    cases = bodies.body_cases(body, config)
    assert list(cases) == [
        "default",
        "SMPL-X format",
        "1/4",
        "1/16",
        "1/4, edges split",
        "1/16, edges split",
    ]
    counts = {
        name: (len(case.body.template), len(case.carrier.template)) for name, case in cases.items()
    }
    assert counts["1/4"] == (500, 500) and counts["1/16"] == (125, 125)
    assert all(counts[f"{name}, edges split"][1] > 1000 for name in ("1/4", "1/16"))
    assert bodies.gaussian_body(cases["1/16"].body, bodies.as_it_is(config)) is cases["1/16"].body
