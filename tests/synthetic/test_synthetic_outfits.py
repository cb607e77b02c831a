"""What people are and wear: descriptions, every kind of garment, letters, light."""

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.pytree import replace
from humangs_jax.synthetic import outfits, subject, surroundings
from humangs_jax.synthetic.anatomy import ARM_GIRTH, ARMHOLE, TRUNK_GIRTH
from humangs_jax.synthetic.fabrics import Spots
from humangs_jax.synthetic.hair import BEARDS, CUTS
from humangs_jax.synthetic.subject import HEIGHT_RANGE, SPLITS, YEARS, describe
from humangs_jax.synthetic.trimmings import EMBLEMS, bitmap, emblem, written

DEMO = SPLITS["demo"]
MILLIMETRES = 4e-3
"""Error of the stature: two vertices of the mean body set it, and another one may be highest."""


@pytest.fixture(scope="module")
def people(body):
    # the first 148 wear everything that there is
    return [describe(DEMO[i], body) for i in range(150)]


def test_people_are_as_tall_as_they_are_described(body, people):
    statures = np.asarray([p.stature for p in people])
    assert statures.min() < 1.46 and statures.max() > 1.95
    assert statures.min() >= HEIGHT_RANGE[0] and statures.max() <= HEIGHT_RANGE[1]
    template, directions = np.asarray(body.template), np.asarray(body.shape_directions)
    for person in (people[np.argmin(statures)], people[np.argmax(statures)], people[0]):
        vertices = template + directions @ person.betas
        assert np.ptp(vertices[:, 1]) == pytest.approx(person.stature, abs=MILLIMETRES)


def test_people_differ(people):
    assert {p.male for p in people} == {True, False}
    assert {p.haircut.cut for p in people} == set(CUTS)
    assert {p.haircut.beard for p in people} == set(BEARDS)
    years = np.asarray([p.years for p in people])
    assert years.min() >= YEARS[0] and years.max() <= YEARS[1] and years.std() > 10
    assert {g.kind for p in people for g in p.garments} == set(outfits.KINDS)
    skins = np.stack([p.complexion.skin for p in people]).mean(1)
    assert skins.min() < 0.25 and skins.max() > 0.6
    assert np.stack([p.lights.gain for p in people]).std(0).min() > 0.04


def test_clothes_go_together(people):
    for person in people:

        def count(kinds, person=person):
            return sum(garment.kind in kinds for garment in person.garments)

        assert count(outfits.DRESSES + outfits.TOPS) >= 1
        assert (
            count(outfits.DRESSES + outfits.BOTTOMS + outfits.SKIRTS) == count(outfits.SHOES) == 1
        )
        assert count(outfits.HEADWEAR) <= 1 and count(outfits.OUTER) <= 1
        assert not (person.male and count(outfits.DRESSES + outfits.SKIRTS))


@pytest.mark.slow
def test_every_kind_of_garment_and_hair_can_be_built(body, people):
    missing = (
        set(outfits.KINDS)
        | set(CUTS)
        | {"full", "goatee", "moustache", "hood_up", "hood", "lapels", "open"}
    )
    for person in people:
        own = {g.kind for g in person.garments} | {d for g in person.garments for d in g.details}
        own |= {person.haircut.cut, person.haircut.beard}
        if not own & missing:
            continue
        missing -= own
        built = subject.make_subject(person.seed, body)
        s = built.surface
        assert np.isfinite(s.vertices).all() and np.isfinite(s.attributes["cloth"]).all(), person
        np.testing.assert_allclose(s.weights.sum(1), 1, atol=1e-4)
        corners = s.vertices[s.faces]
        assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max() < 0.3, own
        assert len(s.faces) < 60_000
        for k, material in enumerate(built.materials):
            chosen = np.unique(s.faces[built.face_materials == k])[::7]
            if len(chosen):
                colors = material.albedo(
                    Spots(s.attributes["cloth"][chosen], s.attributes["template"][chosen])
                )
                assert colors.shape == (len(chosen), 3) and np.isfinite(colors).all()
                assert colors.min() > -0.1 and colors.max() < 1.6
    assert not missing


def test_the_person_of_a_subject_is_its_description(body, people):
    built = subject.make_subject(DEMO[3], body)
    assert [g.kind for g in built.person.garments] == [g.kind for g in people[3].garments]
    np.testing.assert_array_equal(built.betas, people[3].betas)
    skin = built.face_materials == 0
    # only skin lies under hems
    assert (built.cover[np.unique(built.surface.faces[~skin])] == -1).all()
    assert built.cover.max() > 0.003  # metres


def test_words_read_from_left_to_right():
    cells = bitmap("L7")
    rows = ["".join("#" if c else "." for c in row) for row in cells]
    assert rows[0] == "#.....#####." and rows[6] == "#####..#....", rows
    x, y = np.meshgrid(np.arange(12) + 0.5, 6.5 - np.arange(7))
    drawn = written(cells, x.ravel(), y.ravel()).reshape(7, 12)
    np.testing.assert_array_equal(drawn > 0.5, cells)
    assert written(cells, np.asarray([-3.0, 50.0]), np.asarray([3.0, 3.0])).max() == 0


@pytest.mark.parametrize("kind", EMBLEMS)
def test_emblems_are_closed_shapes(kind):
    angle = np.linspace(0, 2 * np.pi, 50)
    assert (emblem(kind, 1.6 * np.sin(angle), 1.6 * np.cos(angle)) < 0).all()
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, 60), np.linspace(-1.2, 1.2, 60))
    assert 0.05 < (emblem(kind, x.ravel(), y.ravel()) > 0).mean() < 0.6


def test_a_chest_print_faces_the_viewer_and_a_sleeve_has_its_own_coordinates():
    template = np.asarray([[0.05, 0.0, 0.12], [ARMHOLE + 0.1, 0.1, 0.0]], np.float32)
    spots = Spots(np.asarray([[0.05, 0.0, 0.1, TRUNK_GIRTH]] * 2, np.float32), template)
    assert spots.around[0] > 0  # the viewer's right is the person's left
    np.testing.assert_allclose(spots.cloth[:, 3], [TRUNK_GIRTH, ARM_GIRTH])
    np.testing.assert_array_equal(Spots(spots.cloth, template).cloth, spots.cloth)


@pytest.mark.slow
def test_shadows_fall_away_from_the_light():
    grid = np.stack(
        np.meshgrid(np.linspace(-0.4, 0.4, 33), np.linspace(-0.4, 0.4, 33)), -1
    ).reshape(-1, 2)
    floor = np.stack([grid[:, 0], np.zeros(len(grid)), grid[:, 1]], -1)
    roof = np.stack([0.5 * grid[:, 0], np.full(len(grid), 0.3), 0.5 * grid[:, 1]], -1)
    vertices = np.concatenate([floor, roof]).astype(np.float32)
    normals = np.tile(np.asarray([0, 1, 0], np.float32), (len(vertices), 1))
    up = jnp.asarray([0.0, 1.0, 0.0])
    lit = np.asarray(
        surroundings.shaded_vertices(jnp.asarray(vertices), jnp.asarray(normals), up)[1]
    )
    below = np.linalg.norm(floor, axis=1) < 0.1
    assert (
        lit[: len(floor)][below].max()
        < 0.75
        < 0.95
        < lit[: len(floor)][np.abs(floor[:, 0]) > 0.37].min()
    )
    assert lit[len(floor) :].min() > 0.95  # nothing above the roof
    assert lit.min() >= surroundings.DARKEST


def test_exposure_and_white_balance_scale_the_picture():
    lights = surroundings.sample_lights(np.random.default_rng(0))
    plain = replace(lights, gain=jnp.ones(3))
    warm = replace(lights, gain=jnp.asarray([1.2, 1.0, 0.8]))
    point = (
        jnp.full((1, 3), 0.2),
        jnp.asarray([[0.0, 0.0, 1.0]]),
        jnp.ones(1),
        jnp.ones(1),
        jnp.zeros(1),
    )
    ratio = surroundings.shade(warm, *point) / surroundings.shade(plain, *point)
    np.testing.assert_allclose(ratio, [[1.2, 1.0, 0.8]], rtol=1e-5)


def test_highlights_are_bent_not_cut():
    bright = np.linspace(0, 3, 200, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    bent = np.asarray(surroundings.rolled_off(jnp.asarray(bright)))
    np.testing.assert_allclose(
        bent[bright < surroundings.SHOULDER], bright[bright < surroundings.SHOULDER]
    )
    assert (np.diff(bent, axis=0) > 0).all() and bent.max() < surroundings.WHITEST
