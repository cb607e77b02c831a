"""States of fits: what they move, and how; the prior of poses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import NAMES_WITHIN_LIMITS, rotations_of
from fit_people import TOY_MODEL as MODEL

from humangs_jax.apps import check
from humangs_jax.avatar.export.gaussians import turned
from humangs_jax.body import model
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices, pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.fitting import fit_capture, landmark_fit
from humangs_jax.fitting.landmark_fit import FitConfig, keypoint_problem
from humangs_jax.fitting.refine import CaptureRefineConfig, capture_origin, moved_capture
from humangs_jax.fitting.residuals import scan, silhouettes
from humangs_jax.fitting.residuals.keypoints import Observations, frame_residuals
from humangs_jax.fitting.state import (
    MIRROR,
    RANGES,
    Origin,
    StateStd,
    betas_of,
    camera_origin,
    cameras_of,
    clothing_thickness,
    limit_residuals,
    pose_of,
    pose_prior,
    segments,
    solve,
    state_of,
    usual_origin,
    violations,
    zero_state,
)
from humangs_jax.fitting.triangulation import triangulate_robustly
from humangs_jax.geometry import camera, quaternion, transform
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network import vertex_decoder
from humangs_jax.network.parts import Shells, VertexFeatures
from humangs_jax.network.reader import project_vertices
from humangs_jax.network.vertex_decoder import RawGaussians, VertexDecoder
from humangs_jax.rendering.gaussians import Gaussians, covariances, skin_gaussians
from humangs_jax.rendering.projection import project_gaussians
from tests.fitting.fit_people import default_body

STD = StateStd()


@pytest.fixture(scope="module")
def capture():
    """Two frames; view 2 is by the camera of view 0. The root is turned by nearly half a turn."""
    K = intrinsics_from_fov(1.0, 64, 48)
    cameras = orbit(jnp.zeros(3), 3.0, jnp.asarray([0.3, 2.0, 0.3]), 0.1, K, 64, 48)
    rotations = np.random.default_rng(0).normal(0, 0.2, (2, len(JOINT_NAMES), 3)).astype(np.float32)
    rotations[:, 0] = [[0, 3.1, 0.2], [0, 0, 0]]
    poses = BodyPose(jnp.zeros((1, 3)), jnp.zeros(3))
    poses = replace(poses, rotations=jnp.asarray(rotations), translation=jnp.asarray([[0, 0.1, 0], [0.2, 0, 0.0]]))
    images = np.ones((3, 48, 64, 3), np.float32)
    frames = np.asarray([0, 0, 1], np.int32)
    return Capture(images, None, cameras, frames, default_body(), np.zeros(3, np.float32), poses, ("a", "b", "c"))


@pytest.fixture(scope="module")
def origin(capture):
    return capture_origin(capture, capture.cameras, CaptureRefineConfig(coefficients=5))


def random_state(origin, seed=0):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), zero_state(origin))


def moved(state, **changes):
    """With some fields of the cameras changed."""
    return replace(state, cameras=replace(state.cameras, **changes))


def test_views_by_one_camera_share_it_and_equal_focal_lengths_are_one(capture):
    zoomed = replace(capture.cameras, K=capture.cameras.K.at[1, 0, 0].multiply(1.01))
    own, other = (camera_origin(cameras, capture.frames) for cameras in (capture.cameras, zoomed))
    assert own.camera.tolist() == other.camera.tolist() == other.focal.tolist() == [0, 1, 0]
    assert own.focal.tolist() == [0, 0, 0]


def test_zeros_are_the_origin_with_the_shape_filled_up(capture, origin):
    same = moved_capture(capture, origin, zero_state(origin))
    np.testing.assert_allclose(same.cameras.cam_from_world, capture.cameras.cam_from_world, atol=1e-6)
    np.testing.assert_array_equal(same.cameras.K, capture.cameras.K)
    np.testing.assert_allclose(same.poses.rotations, capture.poses.rotations, atol=2e-6)
    assert same.betas.tolist() == [0.0] * 5


def test_a_turned_camera_stays_in_its_place_by_its_std_and_focal_lengths_scale(capture, origin):
    state = zero_state(origin)
    start = state.cameras
    state = moved(state, rotations=start.rotations.at[1, 2].set(1.0), log_focals=start.log_focals + 1.0)
    K, matrices = cameras_of(origin, state)
    cameras = replace(capture.cameras, cam_from_world=matrices)
    np.testing.assert_allclose(cameras.center, capture.cameras.center, atol=1e-5)
    np.testing.assert_allclose(matrices[0], capture.cameras.cam_from_world[0], atol=1e-6)
    relative = matrices[1, :3, :3] @ capture.cameras.cam_from_world[1, :3, :3].T
    assert np.degrees(np.arccos((np.trace(relative) - 1) / 2)) == pytest.approx(STD.camera_rotation, rel=1e-2)
    factors = np.asarray(K / jnp.where(capture.cameras.K == 0, 1, capture.cameras.K))
    np.testing.assert_allclose(factors[:, [0, 1], [0, 1]], np.exp(STD.focal), rtol=1e-6)
    np.testing.assert_array_equal(K[:, :2, 2], capture.cameras.K[:, :2, 2])


def test_a_state_without_cameras_leaves_them_where_they_are(capture, origin):
    K, matrices = cameras_of(origin, replace(zero_state(origin), cameras=None))
    np.testing.assert_array_equal(K, capture.cameras.K)
    np.testing.assert_array_equal(matrices, capture.cameras.cam_from_world)


def test_a_shifted_camera_shifts_in_both_views_that_are_its_own(capture, origin):
    state = zero_state(origin)
    state = moved(state, centers=state.cameras.centers.at[0].set(jnp.asarray([0.0, 2.0, 0.0])))
    cameras = replace(capture.cameras, cam_from_world=cameras_of(origin, state)[1])
    shift = np.asarray(cameras.center - capture.cameras.center)
    np.testing.assert_allclose(shift, [[0, 2 * STD.camera_center, 0], [0, 0, 0], [0, 2 * STD.camera_center, 0]], atol=1e-5)


def test_the_root_turns_about_the_pelvis_by_small_turns_even_near_half_a_turn(capture, origin):
    """Posed by blend skinning, beside the same body turned as a whole."""
    state = random_state(origin)
    still = replace(state, global_orient=jnp.zeros_like(state.global_orient))
    rest = shape_body(capture.body, betas_of(origin, state))
    joints_of = jax.jit(jax.vmap(lambda pose: pose_body(capture.body, rest, pose).joints))
    turned, before = joints_of(pose_of(origin, state)), joints_of(pose_of(origin, still))
    turns = quaternion.matrix_from_axis_angle(jnp.radians(STD.global_orient) * state.global_orient)
    expected = jnp.einsum("mab,mjb->mja", turns, before - before[:, :1]) + before[:, :1]
    np.testing.assert_allclose(turned, expected, atol=2e-5)
    assert np.abs(turned - before).max() > 0.02


def test_states_are_found_again_from_their_poses(capture, origin):
    for own in (origin, usual_origin(pose_prior(JOINT_NAMES), origin.joints, 5)):
        state = random_state(own)
        again = state_of(own, betas_of(own, state), pose_of(own, state))
        for name in ("betas", "global_orient", "transl", "body_pose"):
            np.testing.assert_allclose(getattr(again, name), getattr(state, name), atol=2e-4)


@pytest.mark.slow
def test_poses_have_derivatives_at_zero_and_near_half_a_turn(origin):
    jacobian = jax.jacfwd(lambda state: pose_of(origin, state).rotations)(zero_state(origin))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jacobian))
    assert np.abs(jacobian.global_orient).max() > 0.5 * np.radians(STD.global_orient)


def test_fingers_and_eyes_wear_what_the_joint_above_them_wears(capture, origin):
    assert 0 not in origin.joints and "left_index1" not in [JOINT_NAMES[j] for j in origin.joints]
    own = segments(capture.body.parents, origin.joints)
    of = lambda name: own[JOINT_NAMES.index(name)]
    assert of("pelvis") == 0 and of("left_index2") == of("left_wrist") != of("right_wrist")
    assert of("left_eye") == of("head")


def test_refined_captures_keep_what_is_not_refined(capture, origin):
    refined = moved_capture(capture, origin, random_state(origin))
    assert refined.images is capture.images and refined.names == capture.names
    fingers = [j for j, name in enumerate(JOINT_NAMES) if "index" in name]
    np.testing.assert_array_equal(refined.poses.rotations[:, fingers], capture.poses.rotations[:, fingers])
    assert dataclasses.replace(refined, betas=capture.betas).body is capture.body


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
    [("left_knee", (-0.6, 0, 0), 0), ("right_elbow", (0, -0.8, 0), 1), ("left_index2", (0, 0, 1.2), 2), ("head", (1.6, 0, 0), 0)],
)
def test_what_no_joint_does_is_found(joint, vector, axis):
    rotations = rotations_of("standing")
    j = JOINT_NAMES.index(joint)
    rotations[j] = vector
    found = violations(PRIOR, rotations)
    assert [(k, a) for k, a, _ in found] == [(j, axis)]
    assert found[0][2] > 0.3


@pytest.mark.parametrize("limit", ["lower", "upper"])
def test_three_degrees_beyond_a_limit_count_as_much_as_one_deviation(limit):
    joints, side = tuple(range(1, len(JOINT_NAMES))), {"lower": -1, "upper": 1}[limit]
    turned = lambda degrees: jnp.asarray(getattr(PRIOR, limit) + side * np.deg2rad(degrees), jnp.float32)
    residuals = lambda degrees: limit_residuals(PRIOR, joints, turned(degrees))
    np.testing.assert_allclose(residuals(3.0), 1.0, atol=0.1)
    np.testing.assert_allclose(residuals(0.0), 0.0, atol=1e-5)


def test_unknown_joints_rest_freely():
    prior = pose_prior(("pelvis", "tail"))
    assert (prior.mean[1] == 0).all() and (prior.upper[1] > 3).all()


# Geometry asks for full precision in every product of floats, by construction -----------------------------------------


EXACT = jax.lax.Precision.HIGHEST
J, FRAMES, VIEWS = 4, 3, 2


def products(jaxpr, found):
    """The precision of every product of floats in a program and in the programs inside of it."""
    for equation in jaxpr.eqns:
        floats = all(jnp.issubdtype(x.aval.dtype, jnp.floating) for x in equation.invars if hasattr(x.aval, "dtype"))
        if equation.primitive.name in ("dot_general", "conv_general_dilated") and floats:
            precision = equation.params["precision"]
            found.append(precision if isinstance(precision, tuple) else (precision, precision))
        for value in equation.params.values():
            for each in value if isinstance(value, tuple | list) else (value,):
                inner = getattr(each, "jaxpr", each)
                if hasattr(inner, "eqns"):
                    products(inner, found)
    return found


def precisions(function, *arguments):
    return products(jax.make_jaxpr(function)(*arguments).jaxpr, [])


CAMERA = camera.Camera(jnp.diag(jnp.asarray([100.0, 100.0, 1.0])), jnp.eye(4), 16, 16)
POSE = BodyPose(jnp.ones((J, 3)), jnp.zeros(3))
FACES = jnp.asarray([[0, 1, 2], [1, 2, 3]])
GAUSSIANS = Gaussians(jnp.ones((5, 3)), jnp.ones((5, 4)), jnp.ones((5, 3)), jnp.ones(5), jnp.ones((5, 3)))
SEEN = jax.vmap(Observations)(
    jnp.ones((FRAMES, VIEWS, 8, 2)),
    jnp.ones((FRAMES, VIEWS, 8)),
    jnp.ones((FRAMES, VIEWS, 3, 3)),
    jnp.ones((FRAMES, VIEWS, 4, 4)),
    jnp.ones(FRAMES),
)
ONE = jax.tree.map(lambda leaf: leaf[0], SEEN)
CONFIG = FitConfig(smoothness=0.01)
PROBLEM = keypoint_problem(MODEL)


def posed(betas, rotations, translation):
    body = BodyModel(
        template=MODEL.joints,
        shape_directions=MODEL.joint_directions,
        pose_directions=jnp.ones((J, 3, 9 * (J - 1))),
        joint_regressor=jnp.eye(J),
        skinning_weights=jnp.eye(J),
        faces=FACES,
        parents=MODEL.parents,
    )
    return person_vertices(body, betas, BodyPose(rotations, translation))


def from_scan(state):
    surface = scan.BodySurface(MODEL.points, FACES, jnp.arange(J), jnp.ones(J), MODEL)
    given = scan.Given(jnp.ones((8, 3)), jnp.ones(8), jnp.ones(()), jnp.ones(()), jnp.ones(()))
    problem = scan.scan_problem(surface, MODEL.joint_names)
    return scan.scan_residuals(problem, scan.ScanMatches.none(), given, scan.Tolerances(*[jnp.ones(())] * 3), state)


def clothed(state):
    """Cameras and clothing of a refinement."""
    return cameras_of(MOVED, state), clothing_thickness(MOVED, state, jnp.ones((5, J)))


MOVED = Origin(
    betas=jnp.zeros(1),
    pose=jax.vmap(BodyPose)(jnp.zeros((1, J, 3)), jnp.zeros((1, 3))),
    body_pose_std=jnp.ones((J - 1, 3)),
    cameras=camera_origin(camera.stack_cameras([CAMERA]), np.zeros(1, np.int32)),
    segment=jnp.asarray(segments(MODEL.parents, (1, 2, 3))),
    joints=(1, 2, 3),
)


def fitted():
    return jax.eval_shape(lambda: landmark_fit._fit_frames(MODEL, SEEN, FitConfig()))


def looking(target):
    return camera.orbit(target, 2.0, jnp.ones(2), 0.1, jnp.eye(3), 8, 8).cam_from_world


def skinned(gaussians, transforms):
    return covariances(skin_gaussians(skin_gaussians(gaussians, transforms), transforms))


def decoded(geometry, logits):
    """What the decoder places: offsets along shells, turned into the frames of the normals; and a loss of theirs."""
    shells = Shells(jnp.ones(2), jnp.ones((5, 2, 3)), *[jnp.ones((5, 2))] * 3)
    features = VertexFeatures(jnp.ones((5, 1)), photo_colors=jnp.ones((5, 3)), shells=shells, normals=jnp.ones((5, 3)))
    raw = RawGaussians(geometry, jnp.ones((5, 1, 4)), None, logits)
    config = VertexDecoder(tight=1, free=0, frame="normal", residual_color=True)
    return vertex_decoder.activate(raw, config, features), vertex_decoder.shell_spread(logits, features)


PROGRAMS = {
    "look_at": lambda: precisions(looking, jnp.ones(3)),
    "rays": lambda: precisions(camera.plucker_rays, CAMERA),
    "project": lambda: precisions(camera.project, CAMERA, jnp.ones((4, 3))),
    "transform": lambda: precisions(lambda a, p: transform.apply(transform.invert_rigid(a), p), jnp.eye(4), jnp.ones((5, 3))),
    "svd": lambda: precisions(quaternion.left_singular_vectors, jnp.ones((2, 3, 3))),
    "slerp": lambda: precisions(quaternion.interpolate, jnp.ones((2, 3)), jnp.ones((2, 3)), jnp.ones(2)),
    "skinning": lambda: precisions(model.blend_transforms, jnp.ones((3, J)), jnp.ones((J, 4, 4))),
    "body": lambda: precisions(posed, jnp.ones(1), POSE.rotations, POSE.translation),
    "landmarks": lambda: precisions(lambda betas: pose_landmarks(MODEL, betas, POSE), jnp.ones(1)),
    "covariances": lambda: precisions(skinned, GAUSSIANS, jnp.ones((5, 4, 4))),
    "rotated": lambda: precisions(lambda g, t: skin_gaussians(g, t, "rotation"), GAUSSIANS, jnp.ones((5, 4, 4))),
    "splats": lambda: precisions(lambda g: project_gaussians(g, CAMERA), GAUSSIANS),
    "triangulation": lambda: precisions(triangulate_robustly, ONE),
    "keypoints": lambda: precisions(lambda state: frame_residuals(PROBLEM, ONE, state, 5.0), zero_state(PROBLEM.origin)),
    "starts": lambda: precisions(lambda seen: landmark_fit._rigid_starts(PROBLEM, seen, jnp.ones((8, 3)), jnp.ones(8), 2), ONE),
    "distance": lambda: precisions(lambda x: landmark_fit._metres_per_pixel(ONE, x, jnp.ones((VIEWS, 8))), jnp.ones((8, 3))),
    "scan": lambda: precisions(from_scan, zero_state(PROBLEM.origin)),
    "refinement": lambda: precisions(clothed, zero_state(MOVED)),
    "Levenberg and Marquardt": lambda: precisions(lambda x: solve(jnp.sin, x, 3, method="lm"), jnp.ones(4)),
    "L-BFGS": lambda: precisions(lambda x: solve(lambda y: jnp.sin(y @ y), x, 3, method="lbfgs"), jnp.ones(4)),
    "boundaries": lambda: precisions(lambda v: silhouettes._look(v, FACES, CAMERA), jnp.ones((4, 3))),
    "decoder": lambda: precisions(decoded, jnp.ones((5, 1, 10)), jnp.ones((5, 1, 2))),
    "pixels of vertices": lambda: precisions(project_vertices, CAMERA, jnp.ones((4, 3))),
    "exports": lambda: precisions(lambda g: turned(g, "z"), GAUSSIANS),
    "check": lambda: precisions(lambda v: check._body_image(v, FACES, jnp.ones((4, 3)), CAMERA), jnp.ones((4, 3))),
}
WHOLE = {
    "fit": lambda: precisions(lambda seen: landmark_fit._fit_frames(MODEL, seen, FitConfig()), SEEN),
    "motion": lambda: precisions(lambda s, f: landmark_fit.smooth_motion(MODEL, s, f, CONFIG), SEEN, fitted()),
    "uncertainty": lambda: precisions(lambda s, f: fit_capture._derivatives(MODEL, s, f), SEEN, fitted()),
}


@pytest.mark.parametrize("name", [*PROGRAMS, *(pytest.param(name, marks=pytest.mark.slow) for name in WHOLE)])
def test_every_product_is_exact(name):
    found = (PROGRAMS | WHOLE)[name]()
    assert [each for each in found if each != (EXACT, EXACT)] == []
    assert found or name in ("svd", "slerp", "splats", "distance")  # by multiplying and adding


def test_products_are_found_wherever_they_are():
    """In loops, branches, maps and derivatives."""

    def program(x):
        step = lambda carry, _: (jax.lax.cond(carry[0, 0] > 0, lambda y: y @ y, lambda y: y, carry), None)
        return jnp.sum(jax.jit(lambda y: jax.lax.scan(step, y, None, length=2)[0])(x))

    # derivatives of a product have its precision
    found = precisions(jax.vmap(jax.grad(program)), jnp.ones((2, 3, 3)))
    assert len(found) >= 3 and all(each != (EXACT, EXACT) for each in found)
