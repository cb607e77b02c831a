"""A motion in memory: SMPL-X's 55 joints, axis-angle in radians, metres, y up."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body import skinning
from humangs_jax.body.model import BodyPose, RestBody
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.data.motion.rules import DEFAULT_FPS
from humangs_jax.geometry import quaternion, transform
from humangs_jax.io.npz import write_npz
from humangs_jax.io.reading import FileError, check_limit


class MotionError(FileError):
    """Something is wrong with a motion file; the message is one line: file, key, and what was expected."""


@pytree_dataclass
class Motion:
    """Poses over time. rotations: (m, j, 3) axis-angle. translations: (m, 3) metres, applied last. fps: static."""

    rotations: Float[Array, "m j 3"]
    translations: Float[Array, "m 3"]
    fps: float = static_field(default=DEFAULT_FPS)

    def pose(self, frame: int) -> BodyPose:
        """One frame."""
        return BodyPose(self.rotations[frame], self.translations[frame])

    def at_rate(self, fps: float | int) -> "Motion":
        """The motion at another frame rate, between two frames interpolated: rotations on the shortest way, positions linearly.

        Raises: ValueError for a rate that is not positive, or more frames than the limit.
        """
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"fps: expected a positive number of frames per second, got {fps}")
        last = len(self.translations) - 1
        count = max(1, round(min((last + 1) * fps / self.fps, 1e18)))
        check_limit("frames", count, "frames")
        times = np.minimum(np.arange(count) * self.fps / fps, last)
        low = np.floor(times).astype(int)
        frames = self.rotations[low], self.translations[low]
        if (times > low).any():
            high = np.minimum(low + 1, last)
            share = jnp.asarray(times - low, jnp.float32)
            frames = _between(*frames, self.rotations[high], self.translations[high], share)
        return replace(self, rotations=frames[0], translations=frames[1], fps=float(fps))


@jax.jit
def _between(rotations, translations, next_rotations, next_translations, share):
    """Frames between frames; those with share 0 as they are."""
    turned = quaternion.interpolate(rotations, next_rotations, share[:, None])
    moved = translations + share[:, None] * (next_translations - translations)
    return jnp.where(share[:, None, None] > 0, turned, rotations), moved


def save_motion(path: str | Path, motion: Motion) -> None:
    """Write our own format, compressed; the file appears whole or not at all."""
    write_npz(path, {"rotations": motion.rotations, "translations": motion.translations, "fps": motion.fps})


def grounded(motion: Motion, rest: RestBody, parents: tuple[int, ...]) -> Motion:
    """The motion moved by a constant so that the person starts at x = z = 0 and, at its lowest, stands on y = 0.

    Arguments:
        rest, parents: of the body that will move. Its lowest joint is asked, and as far below it as in T-pose is the sole.
    """
    joints = _joint_paths(rest.joints, parents, motion.rotations, motion.translations)
    sole = rest.joints[:, 1].min() - rest.vertices[:, 1].min()
    shift = jnp.stack([joints[0, 0, 0], joints[..., 1].min() - sole, joints[0, 0, 2]])
    return replace(motion, translations=motion.translations - shift)


@functools.partial(jax.jit, static_argnames="parents")
def _joint_paths(rest_joints, parents, rotations, translations):
    """(m, j, 3) joints in space."""
    transforms = jax.vmap(skinning.joint_transforms, in_axes=(None, None, 0, 0))
    transforms = transforms(rest_joints, parents, rotations, translations)
    return transform.apply(transforms, rest_joints)
