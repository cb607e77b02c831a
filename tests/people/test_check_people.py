"""The scripts that look at people: faults are found where they are made, sheets are drawn."""

import dataclasses

import numpy as np
import pytest

from experiments import generator as check_people
from humangs_jax.people import surroundings
from humangs_jax.people.subject import DEMO, make_subject
from humangs_jax.people.writer import sample_pose

SIZE = 96


@pytest.fixture(scope="module")
def posed(body):
    return sample_pose(make_subject(DEMO[28], body), 0)  # a T-shirt and jeans


@pytest.fixture(scope="module")
def camera(posed):
    return surroundings.cameras_around(
        np.random.default_rng(0), posed.vertices, np.asarray([posed.rotations[0, 1]], float), SIZE
    )[0]


def faults(body, posed, camera):
    pixels, *counts = check_people.count_faults(body, posed, camera)
    return pixels, dict(zip(check_people.FAULTS, np.asarray(counts) / pixels, strict=True))


@pytest.mark.slow
def test_a_dressed_person_has_hardly_any_fault(body, posed, camera):
    pixels, shares = faults(body, posed, camera)
    assert pixels > 500
    assert shares["poking"] < 0.01 and shares["hollow"] < 0.01 and shares["gaps"] < 0.01


@pytest.mark.slow
def test_skin_that_is_pushed_through_cloth_is_counted(body, posed, camera):
    _, before = faults(body, posed, camera)
    pushed = posed.vertices + 0.04 * posed.normals * (posed.subject.cover > 0)[:, None]
    _, after = faults(body, dataclasses.replace(posed, vertices=pushed.astype(np.float32)), camera)
    assert after["poking"] > before["poking"] + 0.005
    assert after["inside"] >= after["poking_deep"]


def test_holes_in_cloth_are_counted(body, posed, camera):
    subject = posed.subject
    middle = posed.vertices[subject.surface.faces].mean(1)
    chest = (subject.face_materials >= 2) & (np.abs(middle[:, 1] - 0.65 * posed.vertices[:, 1].max()) < 0.08)
    front = chest & (middle[:, 2] > middle[chest, 2].mean())
    surface = dataclasses.replace(subject.surface, faces=subject.surface.faces[~front])
    torn = dataclasses.replace(subject, surface=surface, face_materials=subject.face_materials[~front])
    _, shares = faults(body, dataclasses.replace(posed, subject=torn), camera)
    assert shares["hollow"] + shares["gaps"] > 0.02
