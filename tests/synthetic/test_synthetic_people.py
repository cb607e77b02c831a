"""Whole people are deterministic, dressed, in the frame, on the ground; folders of captures."""

import jax
import numpy as np
import pytest

from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
from humangs_jax.synthetic import fabrics, subject, surroundings, writer
from humangs_jax.synthetic.anatomy import Joint
from humangs_jax.synthetic.fabrics import PATTERNS
from humangs_jax.synthetic.subject import SPLITS

DEMO = SPLITS["demo"]
SEEDS = [DEMO[i] for i in range(4)]
SIZE = 96
POKED = 0.01
"""Largest share of a person's pixels with skin from under a hem: hems move in strong poses."""
UNDER_CLOTH = 0.003
"""Distance from a hem at which skin has to be covered, metres."""


@pytest.fixture(scope="module")
def people(body):
    return [subject.make_subject(seed, body) for seed in SEEDS]


@pytest.fixture(scope="module")
def posed(people):
    return [writer.sample_pose(person, 0) for person in people]


@pytest.fixture(scope="module")
def views(posed):
    """Returns for each person (three cameras, images, masks)."""
    result = []
    for i, p in enumerate(posed):
        rng = np.random.default_rng(i)
        batch = surroundings.cameras_around(
            rng, p.vertices, surroundings.spread_azimuths(rng, 3), SIZE
        )
        images, masks = zip(*(subject.render_view(p, batch[k]) for k in range(3)), strict=True)
        result.append((batch, np.stack(images), np.stack(masks)))
    return result


@pytest.mark.slow
def test_a_seed_is_a_person_bit_for_bit(body, people, posed, views):
    again = subject.make_subject(SEEDS[0], body)
    np.testing.assert_array_equal(again.surface.vertices, people[0].surface.vertices)
    np.testing.assert_array_equal(again.surface.faces, people[0].surface.faces)
    p = writer.sample_pose(again, 0)
    np.testing.assert_array_equal(p.rotations, posed[0].rotations)
    batch, images, masks = views[0]
    image, mask = subject.render_view(p, batch[1])
    np.testing.assert_array_equal(image, images[1])
    np.testing.assert_array_equal(mask, masks[1])


def test_different_seeds_are_different_people(people):
    shapes = np.stack([person.betas for person in people])
    assert (
        np.linalg.norm(shapes[:, None] - shapes[None], axis=-1)[
            np.triu_indices(len(SEEDS), 1)
        ].min()
        > 0.5
    )
    assert len({len(person.surface.vertices) for person in people}) > 2


def test_other_bodies_are_refused(body):
    with pytest.raises(ValueError, match="makehuman"):
        subject.make_subject(0, replace(body, name="other"))


def test_meshes_are_sound(people):
    for person in people:
        s = person.surface
        assert (
            np.isfinite(s.vertices).all() and s.faces.min() == 0 and s.faces.max() < len(s.vertices)
        )
        np.testing.assert_allclose(s.weights.sum(1), 1, atol=1e-4)
        assert (s.weights >= 0).all()
        assert len(person.face_materials) == len(s.faces) < 45_000
        corners = s.vertices[s.faces]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        assert edges.max() < 0.25  # nothing explodes at rest


def test_poses_do_not_tear_the_cloth(people, posed):
    for person, p in zip(people, posed, strict=True):

        def lengths(vertices, faces=person.surface.faces):
            corners = vertices[faces]
            return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)

        stretched = lengths(p.vertices) - 2.5 * lengths(person.surface.vertices)
        assert stretched.max() < 0.1
        assert p.vertices[:, 1].min() == pytest.approx(0, abs=1e-5)  # on the ground
        assert 1.2 < np.ptp(p.vertices[:, 1]) < 2.6


def test_cloth_covers_and_leaves_the_body(body, people, posed):
    """Most of what is seen is cloth, and the silhouette is wider than the naked body's."""
    for person, p in zip(people[:3], posed[:3], strict=True):
        rest = shape_body(body, jax.numpy.asarray(person.betas))
        pose = BodyPose(jax.numpy.asarray(p.rotations), jax.numpy.asarray(p.translation))
        naked = pose_body(body, rest, pose)
        rng = np.random.default_rng(0)
        camera = surroundings.cameras_around(rng, p.vertices, np.asarray([0.4]), SIZE)[0]
        skin = np.asarray(rasterize_mesh(naked.vertices, body.faces, camera).face_ids) >= 0
        fragments = rasterize_mesh(*subject.padded(p.vertices, person.surface.faces), camera)
        ids = np.asarray(fragments.face_ids)
        dressed = ids >= 0
        assert (skin & dressed).sum() > 0.93 * skin.sum()  # the cloth is where the body is
        assert dressed.sum() > 1.05 * skin.sum()
        assert (person.face_materials[ids[dressed]] > 1).mean() > 0.5


@pytest.mark.slow
def test_hardly_any_skin_pokes_through(people, posed, views):
    for person, p, (batch, _, _) in zip(people, posed, views, strict=True):
        faces = person.surface.faces
        for k in range(3):
            fragments = rasterize_mesh(*subject.padded(p.vertices, faces), batch[k])
            ids, weights = np.asarray(fragments.face_ids), np.asarray(fragments.barycentrics)
            seen = ids >= 0
            under = ((person.cover > UNDER_CLOTH)[faces[ids[seen]]] * weights[seen]).sum(-1)
            assert (under > 0.75).mean() < POKED


def test_garments_move_with_the_pose(people):
    """Raising the left thigh moves the cloth on it, and none on the head or the right arm."""
    person = people[0]
    rotations = np.zeros((55, 3), np.float32)
    rest = person.posed_vertices(rotations, np.zeros(3))
    np.testing.assert_allclose(rest, person.surface.vertices, atol=1e-5)
    rotations[Joint.LEFT_HIP] = [-0.6, 0, 0]
    moved = np.linalg.norm(person.posed_vertices(rotations, np.zeros(3)) - rest, axis=1)
    template = person.surface.attributes["template"]
    is_cloth = np.ones(len(rest), bool)
    is_cloth[np.unique(person.surface.faces[person.face_materials <= 1])] = False
    knee = person.build.joints[Joint.LEFT_KNEE]
    near_knee = np.linalg.norm(rest - (knee + np.asarray([0, 0.1, 0])), axis=1) < 0.15
    assert np.median(moved[near_knee]) > 0.05
    assert moved[(template[:, 1] > 0.25) & ~is_cloth].max() < 1e-5
    shifted = person.posed_vertices(rotations, np.asarray([1.0, 2.0, 3.0])) - person.posed_vertices(
        rotations, np.zeros(3)
    )
    np.testing.assert_allclose(shifted, np.broadcast_to([1.0, 2.0, 3.0], shifted.shape), atol=1e-5)


def test_skin_is_posed_as_the_body_model_poses_it(body, people, posed):
    person, p = people[1], posed[1]
    pose = BodyPose(jax.numpy.asarray(p.rotations), jax.numpy.asarray(p.translation))
    naked = np.asarray(
        pose_body(body, shape_body(body, jax.numpy.asarray(person.betas)), pose).vertices
    )
    head = np.unique(person.surface.faces[person.face_materials == 0])
    chosen = head[:: max(1, len(head) // 50)]
    distance = np.linalg.norm(p.vertices[chosen][:, None] - naked[None], axis=-1).min(1)
    assert distance.max() < 1e-4  # every visible point of the skin is a vertex of the posed body


def test_cameras_follow_the_protocol_and_see_the_whole_person(posed, views):
    for p, (batch, _, masks) in zip(posed, views, strict=True):
        assert (
            masks[:, 0].max()
            == masks[:, -1].max()
            == masks[:, :, 0].max()
            == masks[:, :, -1].max()
            == 0
        )
        share = masks.mean((1, 2))
        assert (share > 0.05).all() and (share < 0.5).all()
        center, radius = surroundings.bounding_sphere(p.vertices)
        offset = np.asarray(batch.center) - center
        distance = np.linalg.norm(offset, axis=1)
        assert (distance >= 1.8 * radius - 1e-4).all() and (distance < 2.7 * radius).all()
        elevation = np.rad2deg(np.arcsin(offset[:, 1] / distance))
        assert (elevation > -5.01).all() and (elevation < 15.01).all()
        np.testing.assert_allclose(
            2 * np.arctan(SIZE / 2 / np.asarray(batch.K[:, 1, 1])), np.deg2rad(60), rtol=1e-5
        )


def test_masks_are_the_coverage_of_the_pictures(posed, views):
    for p, (batch, images, masks) in zip(posed[:2], views[:2], strict=True):
        black, mask = subject.render_view(p, batch[0], background=0.0)
        np.testing.assert_array_equal(mask, masks[0])
        np.testing.assert_allclose(
            images[0] - black, np.broadcast_to(1 - mask[..., None], black.shape), atol=1e-6
        )
        assert (images[0][mask == 0] == 1).all() and images.min() >= 0 and images.max() <= 1
        assert set(np.unique(mask * 4)) == {0, 1, 2, 3, 4}  # 2 x 2 samples


def test_pictures_are_neither_flat_nor_burnt_out(views):
    means = []
    for _, images, masks in views:
        pixels = images[masks == 1]
        assert pixels.std() > 0.06
        assert (pixels.min(-1) > 0.95).mean() < 0.1  # distinct from the background
        means.append(pixels.mean(0))
    assert np.std(means, axis=0).min() > 0.02


def test_patterns_stay_in_range_and_differ():
    rng = np.random.default_rng(5)
    cloth = rng.uniform(-0.3, 0.3, (500, 4)).astype(np.float32)
    cloth[:, 3] = 0.16
    spots = fabrics.Spots(cloth, cloth[:, :3])
    seen = []
    for name, (_, make) in PATTERNS.items():
        base, other = fabrics.color(0.6, 0.7, 0.5), fabrics.color(0.1, 0.6, 0.8)
        colors = make(spots, np.random.default_rng(1), base, other)
        assert colors.shape == (500, 3) and np.isfinite(colors).all(), name
        assert colors.min() >= -0.05 and colors.max() <= 1.15, name
        seen.append(colors)
    for i, a in enumerate(seen):
        for b in seen[i + 1 :]:
            assert np.abs(a - b).max() > 0.02
