"""The one door to motions: `load_motion` reads every format of `arrays`, `bvh` and `gltf`."""

import logging
from importlib import resources
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.smplx import HandBasis
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.data.capture_checks import LARGEST_DISTANCE, LARGEST_TURN
from humangs_jax.data.motion import arrays, rules, skeleton, world
from humangs_jax.data.motion.bvh import read_bvh
from humangs_jax.data.motion.gltf import read_animation
from humangs_jax.data.motion.motion import Motion, MotionError
from humangs_jax.io.reading import check_limit, reading

logger = logging.getLogger(__name__)

WALK = "walk.npz"
SLOWEST = 0.01
"""Frames per second: one in more than a minute and a half is no motion."""
_SKELETONS = {".bvh": read_bvh, ".glb": read_animation}


@checked_arguments
def load_motion(
    path: str | Path | None = None,
    *,
    up: str = "auto",
    fps: float | int | None = None,
    hands: HandBasis | None = None,
    flat_hand_mean: bool = True,
    rest_joints: Float[Array, "j 3"] | Float[np.ndarray, "j 3"] | None = None,
) -> Motion:
    """Read a motion; suffix and keys decide the format (docs/motions.md).

    Arguments:
        path: None for the walk that comes with the package; else a file (.npz, .pkl, .json, .bvh, .glb), or a folder of LHM's
            JSON files.
        up: axis of the file's world that points up ("y", "-y", "z", ...); the motion is turned so that y does. "auto" is
            the format's own: AMASS z, others y; of .bvh the up of the rest pose if a person stands in it, else y. It is
            another only where people stand along that and its floor carries them (`world.up_axis`), which is logged as a
            warning, and never in our own format, AIST++ and .glb.
        fps: frames per second in place of those in the file.
        hands: hand basis of an SMPL-X model, needed for hands of fewer than 45 numbers (principal coefficients) and for
            `flat_hand_mean` False, which adds the mean hand (only to hands that a file has). Our own format holds
            whole rotations: there is nothing to add.
        rest_joints: joints in the T-pose of the body that will move (`avatar.rest_joints`), metres: skeletons of other programs
            are brought to it, and a motion of another number of joints is refused. None: the shipped body.

    Raises: MotionError, one line naming file and key.
    """
    if up not in ("auto", *rules.UPRIGHT):
        raise ValueError(f"up: expected auto, {', '.join(rules.UPRIGHT)}, got {up!r}")
    if hands is None and not flat_hand_mean:
        raise ValueError("flat_hand_mean=False needs the mean hand: pass hands")
    if path is None:
        with resources.as_file(resources.files("humangs_jax") / "assets" / WALK) as file:
            return load_motion(file, up=up, fps=fps, rest_joints=rest_joints)
    if fps is not None and not (np.isfinite(fps) and fps > 0):
        raise MotionError(path, "fps", f"expected a positive number of frames per second, got {fps}")
    with reading(path, "motion", MotionError):
        return _load(Path(path), up, None if fps is None else float(fps), hands, flat_hand_mean, rest_joints)


def _load(path, up, fps, hands, flat_hand_mean, rest_joints):
    if not path.exists():
        raise MotionError(path, "", "no such file")
    read = _SKELETONS.get(path.suffix.lower())
    body = lambda: skeleton.shipped_joints() if rest_joints is None else np.asarray(rest_joints, np.float64)
    with np.errstate(all="ignore"):  # of numbers without sense, which are refused below
        if read is None or path.is_dir():
            rotations, translations, file_fps, form = arrays.read_arrays(path, hands, flat_hand_mean, fps)
            found = _up_of_arrays(form, rotations, translations, body, file_fps) if up == "auto" else (up, "")
            rotations, translations = world.turned_upright(rotations, translations, found[0])
            said = found[1]
        else:
            clip = read(path)
            file_fps = skeleton.whole_rate(clip.fps)
            rotations, translations, said = skeleton.retargeted(clip, body(), up)
    if rest_joints is not None and rotations.shape[1] != len(rest_joints):
        raise MotionError(path, "rotations", f"expected {len(rest_joints)} joints, got {rotations.shape[1]}")
    with np.errstate(over="ignore"):  # what is no float32 is infinite from here on
        rotations, translations = rotations.astype(np.float32), translations.astype(np.float32)
    if not np.isfinite(rotations).all():
        raise MotionError(path, "", "expected rotations and a skeleton of finite size")
    if (largest := np.abs(rotations).max()) > LARGEST_TURN:
        raise MotionError(path, "rotations", f"expected radians, at most {LARGEST_TURN:g}, got {largest:.4g}")
    if not (farthest := np.abs(translations).max()) <= LARGEST_DISTANCE:
        limit = f"at most {LARGEST_DISTANCE:g} from the origin"
        raise MotionError(path, "", f"expected metres, {limit}, got {farthest:g}")
    check_limit("frames", len(rotations), "frames")
    rate = file_fps if fps is None else fps
    check_limit("rate", rate, "frames per second")
    if rate < SLOWEST:
        raise MotionError(path, "", f"{rate:g} frames per second: expected at least {SLOWEST:g}")
    if said:
        logger.warning("%s: %s", path, said)
    return Motion(jnp.asarray(rotations), jnp.asarray(translations), rate)


def _up_of_arrays(form, rotations, translations, body, fps):
    """The axis that is up, and what is to be said about it."""
    stands = None if form.fixed else world.standing_axis(rotations[:, 0])
    if stands in (None, form.up):
        return form.up, ""
    chosen = world.sampled_frames(len(rotations))
    joints = body()
    if len(joints) != rotations.shape[1]:  # refused later
        return form.up, ""
    points = world.joint_places(joints, rotations[chosen], translations[chosen])
    return world.up_axis(points, stands, form.up, fps, form.also)
