"""Geometry asks for full precision in every product of floats, by construction.

Accelerators otherwise round the factors of float32 products to 8 or 10 bits: 0.1 to 1.4 pixels at a focal length of 1,500. The
programs are inspected, not run: CPUs compute in full precision either way.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy_body import MODEL

from humangs_jax.apps import check
from humangs_jax.avatar.export.gaussians import turned
from humangs_jax.body import skinning
from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices
from humangs_jax.fitting import fit_capture, landmark_fit
from humangs_jax.fitting.landmark_fit import FitConfig, keypoint_problem
from humangs_jax.fitting.residuals import scan, silhouettes
from humangs_jax.fitting.residuals.keypoints import Observations, frame_residuals
from humangs_jax.fitting.solve import solve
from humangs_jax.fitting.state import Origin, camera_origin, cameras_of, clothing_thickness, segments, zero_state
from humangs_jax.fitting.triangulation import triangulate_robustly
from humangs_jax.geometry import camera, quaternion, transform
from humangs_jax.network import vertex_decoder
from humangs_jax.network.parts import Shells, VertexFeatures
from humangs_jax.network.reader import project_vertices
from humangs_jax.network.vertex_decoder import RawGaussians, VertexDecoder
from humangs_jax.rendering.gaussians import Gaussians, covariances, skin_gaussians
from humangs_jax.rendering.projection import project_gaussians

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
    cameras=camera_origin(camera.stack_cameras([CAMERA]), np.zeros(1, np.int32), False),
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
    "transform": lambda: precisions(
        lambda a, p: transform.apply(transform.invert_rigid(a), p), jnp.eye(4), jnp.ones((5, 3))
    ),
    "svd": lambda: precisions(quaternion.left_singular_vectors, jnp.ones((2, 3, 3))),
    "slerp": lambda: precisions(quaternion.interpolate, jnp.ones((2, 3)), jnp.ones((2, 3)), jnp.ones(2)),
    "skinning": lambda: precisions(skinning.blend_transforms, jnp.ones((3, J)), jnp.ones((J, 4, 4))),
    "body": lambda: precisions(posed, jnp.ones(1), POSE.rotations, POSE.translation),
    "landmarks": lambda: precisions(lambda betas: pose_landmarks(MODEL, betas, POSE), jnp.ones(1)),
    "covariances": lambda: precisions(skinned, GAUSSIANS, jnp.ones((5, 4, 4))),
    "rotated": lambda: precisions(lambda g, t: skin_gaussians(g, t, "rotation"), GAUSSIANS, jnp.ones((5, 4, 4))),
    "splats": lambda: precisions(lambda g: project_gaussians(g, CAMERA), GAUSSIANS),
    "triangulation": lambda: precisions(triangulate_robustly, ONE),
    "keypoints": lambda: precisions(
        lambda state: frame_residuals(PROBLEM, ONE, state, 5.0), zero_state(PROBLEM.origin)
    ),
    "starts": lambda: precisions(
        lambda seen: landmark_fit._rigid_starts(PROBLEM, seen, jnp.ones((8, 3)), jnp.ones(8), 2), ONE
    ),
    "distance": lambda: precisions(
        lambda x: landmark_fit._metres_per_pixel(ONE, x, jnp.ones((VIEWS, 8))), jnp.ones((8, 3))
    ),
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
