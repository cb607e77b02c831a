import numpy as np
import pytest
from fit_people import NAMES_WITHIN_LIMITS, rotations_of

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.fitting.residuals.priors import MIRROR, RANGES, pose_prior, violations

PRIOR = pose_prior(JOINT_NAMES)


def test_every_joint_has_a_range_that_holds_its_usual_value():
    assert set(RANGES) == {name for name in JOINT_NAMES if not name.startswith("right_")}
    assert (PRIOR.lower <= PRIOR.mean).all() and (PRIOR.mean <= PRIOR.upper).all()
    assert (PRIOR.std > 0).all()


def test_right_is_the_mirror_image_of_left():
    for j, name in enumerate(JOINT_NAMES):
        if name.startswith("left_"):
            other = JOINT_NAMES.index(name.replace("left_", "right_"))
            np.testing.assert_array_equal(PRIOR.mean[other], MIRROR * PRIOR.mean[j])
            both = np.stack([MIRROR * PRIOR.lower[j], MIRROR * PRIOR.upper[j]])
            np.testing.assert_array_equal(PRIOR.lower[other], both.min(0))
            np.testing.assert_array_equal(PRIOR.upper[other], both.max(0))


@pytest.mark.parametrize("pose", NAMES_WITHIN_LIMITS)
def test_people_bend_within_their_limits(pose):
    assert violations(PRIOR, rotations_of(pose)) == []


@pytest.mark.parametrize(
    ("joint", "vector", "axis"),
    [
        ("left_knee", (-0.6, 0, 0), 0),
        ("right_elbow", (0, -0.8, 0), 1),
        ("left_index2", (0, 0, 1.2), 2),
        ("head", (1.6, 0, 0), 0),
    ],
)
def test_what_no_joint_does_is_found(joint, vector, axis):
    rotations = rotations_of("standing")
    j = JOINT_NAMES.index(joint)
    rotations[j] = vector
    found = violations(PRIOR, rotations)
    assert [(k, a) for k, a, _ in found] == [(j, axis)]
    assert found[0][2] > 0.3


def test_unknown_joints_rest_freely():
    prior = pose_prior(("pelvis", "tail"))
    assert (prior.mean[1] == 0).all() and (prior.upper[1] > 3).all()
