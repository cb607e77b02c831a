"""The scripts that check people find planted faults and draw sheets."""

import dataclasses

import numpy as np
import pytest

from experiments import generator as check_people
from humangs_jax.synthetic import surroundings
from humangs_jax.synthetic.subject import SPLITS, make_subject
from humangs_jax.synthetic.writer import sample_pose

DEMO = SPLITS["demo"]
SIZE = 96


@pytest.fixture(scope="module")
def posed(body):
    return sample_pose(make_subject(DEMO[28], body), 0)  # a T-shirt and jeans


@pytest.fixture(scope="module")
def faults(body, posed):
    heading = np.asarray([posed.rotations[0, 1]], float)
    camera = surroundings.cameras_around(np.random.default_rng(0), posed.vertices, heading, SIZE)[0]

    def count(posed):
        pixels, *counts = check_people.count_faults(body, posed, camera)
        assert pixels > 500
        return dict(zip(check_people.FAULTS, np.asarray(counts) / pixels, strict=True))

    return count


@pytest.mark.slow
def test_a_dressed_person_has_hardly_any_fault_and_skin_that_is_pushed_through_cloth_is_counted(
    posed, faults
):
    before = faults(posed)
    assert before["poking"] < 0.01 and before["hollow"] < 0.01 and before["gaps"] < 0.01
    pushed = posed.vertices + 0.04 * posed.normals * (posed.subject.cover > 0)[:, None]
    after = faults(dataclasses.replace(posed, vertices=pushed.astype(np.float32)))
    assert after["poking"] > before["poking"] + 0.005
    assert after["inside"] >= after["poking_deep"]


def test_holes_in_cloth_are_counted(posed, faults):
    subject = posed.subject
    middle = posed.vertices[subject.surface.faces].mean(1)
    chest = (subject.face_materials >= 2) & (
        np.abs(middle[:, 1] - 0.65 * posed.vertices[:, 1].max()) < 0.08
    )
    front = chest & (middle[:, 2] > middle[chest, 2].mean())
    surface = dataclasses.replace(subject.surface, faces=subject.surface.faces[~front])
    torn = dataclasses.replace(
        subject, surface=surface, face_materials=subject.face_materials[~front]
    )
    shares = faults(dataclasses.replace(posed, subject=torn))
    assert shares["hollow"] + shares["gaps"] > 0.02
