"""People for evaluation: the same photos for all numbers of views, and held-out views."""

import numpy as np
import pytest

from experiments import subjects as people
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.synthetic.subject import SPLITS
from humangs_jax.synthetic.writer import Layout, write_person

DEMO = SPLITS["demo"]
SIZE = 48
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def person(body):
    return people.make_evaluation_subject(DEMO[0], body, [1, 4, 6], SIZE, people.HeldOut(2, 2, 1))


def test_photos_are_evenly_spaced_and_shared(person):
    assert person.positions == (0, 2, 3, 4, 6, 8, 9, 10)
    four, six = person.inputs(4), person.inputs(6)
    assert four.names == ("photo_00", "photo_03", "photo_06", "photo_09") and set(four.frames) == {
        0
    }
    assert np.array_equal(person.inputs(1).images[0], four.images[0]) and np.array_equal(
        four.images[2], six.images[3]
    )
    middle = np.asarray(four.poses.translation[0])[[0, 2]]
    away = np.asarray(four.cameras.center)[:, [0, 2]] - middle
    azimuths = np.arctan2(away[:, 0], away[:, 1])
    turns = np.diff(np.unwrap(azimuths))
    # jitter, and the middle is not quite what cameras look at
    assert np.all(np.abs(np.rad2deg(turns) - 90) < 30)
    with pytest.raises(ValueError, match=r"\[1, 5, 7, 11\]"):
        person.inputs(12)
    with pytest.raises(ValueError, match="12 cameras"):
        people.ring_positions(5)


def test_the_first_photo_is_the_frontal_one(person):
    centers = np.asarray(person.photos.cameras.center)[:, [0, 2]]
    towards = centers - centers.mean(0)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    turn = person.photos.poses.rotations[0, 0]
    facing = np.asarray(people.matrix_from_axis_angle(turn))[[0, 2], 2]
    assert np.argmax(towards @ facing) == 0


def test_held_out_views_are_those_of_written_captures(person, body, tmp_path):
    write_person(tmp_path / "a", DEMO[0], body, Layout(SIZE, views=1, held_out_views=2))
    written = load_capture(tmp_path / "a" / "held_out", body=body)
    novel = person.held_out.select([0, 1])
    assert np.array_equal(written.images, novel.images) and np.array_equal(
        written.masks, novel.masks
    )
    assert np.array_equal(written.cameras.cam_from_world, novel.cameras.cam_from_world)
    assert list(person.held_out.frames) == [0, 0, 1, 2]
    assert not np.allclose(person.held_out.poses.rotations[1], person.held_out.poses.rotations[0])


def test_poses_go_to_the_joints_of_other_bodies_by_name(person, body):
    order = np.r_[0, np.arange(54, 0, -1)]
    other = replace(
        body, joint_names=tuple("tail" if i == 7 else body.joint_names[i] for i in order)
    )
    carried = np.asarray(person.with_body(other).held_out.poses.rotations)
    expected = np.asarray(person.held_out.poses.rotations)[:, order]
    expected[:, list(order).index(7)] = 0
    assert np.array_equal(carried, expected)
