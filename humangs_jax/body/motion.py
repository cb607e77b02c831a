"""Motions of a body: one pose per frame, for the joints of SMPL-X or of another body."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import DEFAULT_FPS
from humangs_jax.body.model import BodyPose, RestBody, joint_transforms
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.axes import UPRIGHT, upright_matrix
from humangs_jax.io.reading import check_limit

PELVIS = np.array([0.0, -0.35, 0.0])
"""Position of the root joint of SMPL-X and of the shipped body in T-pose, metres. `turned_upright`
needs it, because translations are relative to it. The root of another body lies elsewhere. Its
turned motion is then shifted by a constant, and `grounded` removes this shift.
"""


@pytree_dataclass
class Motion:
    """Poses of a body over time."""

    rotations: Float[Array, "m j 3"]
    """Axis-angle of each joint relative to its parent, (m, j, 3), radians."""
    translations: Float[Array, "m 3"]
    """Translation in each frame, applied last, (m, 3), metres."""
    fps: float = static_field(default=DEFAULT_FPS)
    """Frames per second."""
    expressions: Float[Array, "m e"] | None = None
    """Coefficients of expressions, (m, e), mostly in [0, 1]. None: nothing is known of the face."""
    expression_names: tuple[str, ...] = static_field(default=())
    """Names of the expressions, such as ARKit's "jawOpen"."""

    def pose(self, frame: int, expression_names: Sequence[str] = ()) -> BodyPose:
        """Returns the pose of one frame.

        expression_names: expressions of the face that will move (`avatar.expression_names`). The
        pose has a coefficient for each of them if the motion has any of them; otherwise its
        expression is None.

        Raises: IndexError if the motion has no such frame.
        """
        faces = self.expressions_of(expression_names)
        expression = None
        if faces is not None:
            expression = taken(faces, frame)
        pose = taken(self.rotations, frame), taken(self.translations, frame)
        return BodyPose(*pose, expression)

    def part(self, frames: slice) -> "Motion":
        """Returns the motion of some of the frames, at the same rate."""
        faces = None
        if self.expressions is not None:
            faces = taken(self.expressions, frames)
        return replace(
            self,
            rotations=taken(self.rotations, frames),
            translations=taken(self.translations, frames),
            expressions=faces,
        )

    def expressions_of(self, names: Sequence[str]) -> Float[Array, "m e"] | None:
        """Returns the coefficients for a face with these expressions, (m, e). They are 0 for
        expressions that the motion does not have. Returns None if the motion has none of them.
        """
        own = self.expression_names
        if self.expressions is None or not set(names) & set(own):
            return None
        still = jnp.zeros_like(self.expressions[:, :1])
        known = jnp.concatenate([self.expressions, still], axis=1)
        index = [own.index(name) if name in own else len(own) for name in names]
        return known[:, np.asarray(index)]

    def at_rate(self, fps: float | int) -> "Motion":
        """Returns the motion at another frame rate. Between two frames, rotations are interpolated
        on the shortest way, translations and expressions linearly. fps: frames per second.

        Raises: ValueError if the rate is not positive, or if there would be more frames than the
        limit.
        """
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"fps: expected a positive number of frames per second, got {fps}")
        last = len(self.translations) - 1
        count = max(1, round(min((last + 1) * fps / self.fps, 1e18)))
        check_limit("frames", count, "frames")
        return replace(
            self._at(np.minimum(np.arange(count) * self.fps / fps, last)), fps=float(fps)
        )

    def _at(self, times: Float[np.ndarray, " n"]) -> "Motion":
        low = np.floor(times).astype(int)
        frames = taken(self.rotations, low), taken(self.translations, low)
        if (times > low).any():
            high = np.minimum(low + 1, len(self.translations) - 1)
            share = jnp.asarray(times - low, jnp.float32)
            frames = _between(*frames, self.rotations[high], self.translations[high], share)
        faces = self.expressions
        if faces is not None:
            high, share = np.minimum(low + 1, len(faces) - 1), jnp.asarray(times - low, jnp.float32)
            faces = faces[low] + share[:, None] * (faces[high] - faces[low])
        return replace(self, rotations=frames[0], translations=frames[1], expressions=faces)


@compiled()
def _between(
    rotations: Float[Array, "m j 3"],
    translations: Float[Array, "m 3"],
    next_rotations: Float[Array, "m j 3"],
    next_translations: Float[Array, "m 3"],
    share: Float[Array, " m"],
) -> tuple[Float[Array, "m j 3"], Float[Array, "m 3"]]:
    """Returns poses that are interpolated between frames and the next frames: rotations (m, j, 3)
    and translations (m, 3).
    share: weight of the next frame, (m,), 0 to 1. Where it is 0, the frame itself is returned.
    """
    turned = quaternion.interpolate(rotations, next_rotations, share[:, None])
    moved = translations + share[:, None] * (next_translations - translations)
    return jnp.where(share[:, None, None] > 0, turned, rotations), moved


def grounded(motion: Motion, rest: RestBody, parents: tuple[int, ...]) -> Motion:
    """Returns a motion that is moved by a constant. The root joint then starts at x = z = 0, and
    the lowest point of the person over all frames is at y = 0.

    Arguments:
        rest: vertices and joints of the body that will move, at rest. The lowest point is estimated
            from the lowest joint over all frames. It is taken to be as far below this joint as the
            sole is below the lowest joint at rest.
        parents: parents of the joints of that body.
    """
    moved = _on_the_floor(rest, parents, motion.rotations, motion.translations)
    return replace(motion, translations=moved)


@compiled(static=["parents"])
def _on_the_floor(
    rest: RestBody,
    parents: tuple[int, ...],
    rotations: Float[Array, "m j 3"],
    translations: Float[Array, "m 3"],
) -> Float[Array, "m 3"]:
    """Returns the translations that `grounded` gives to the motion, (m, 3), metres."""
    transforms = jax.vmap(joint_transforms, in_axes=(None, None, 0, 0))
    transforms = transforms(rest.joints, parents, rotations, translations)
    joints = transform.apply(transforms, rest.joints)
    sole = rest.joints[:, 1].min() - rest.vertices[:, 1].min()
    shift = jnp.stack([joints[0, 0, 0], joints[..., 1].min() - sole, joints[0, 0, 2]])
    return translations - shift


def turned_upright(
    rotations: Float[np.ndarray, "m j 3"],
    translations: Float[np.ndarray, "m 3"],
    up: str,
    pelvis: Float[np.ndarray, "3"] = PELVIS,
) -> tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]:
    """Returns the rotations and translations of poses in a world that is turned so that its axis
    `up` becomes +y. pelvis: root joint in T-pose, (3,), metres.
    """
    if up == "y":
        return rotations, translations
    turn = upright_matrix(up)
    root = _turned_root(from_host(UPRIGHT[up], np.float32), from_host(rotations[:, 0], np.float32))
    root = np.asarray(root, np.float64)
    root *= np.where(root[:, :1] < 0, -1, 1)  # the shorter way round
    sine = np.linalg.norm(root[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, root[:, :1])
    axis_angle = root[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)
    rotations = np.concatenate([axis_angle[:, None], rotations[:, 1:]], axis=1)
    return rotations, (translations + pelvis) @ turn.T - pelvis


@compiled()
def _turned_root(turn: Float[Array, "4"], root: Float[Array, "m 3"]) -> Float[Array, "m 4"]:
    return quaternion.multiply(turn, quaternion.from_axis_angle(root))
