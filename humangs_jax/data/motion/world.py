"""Which way is up in the world of a motion, and that world turned so that y is."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import PARENTS
from humangs_jax.core.array_types import Float
from humangs_jax.data.motion.rules import (
    CLEARLY_UP,
    FLOOR_BAND,
    HANDS,
    MOST_FRAMES,
    ON_THE_FLOOR,
    PELVIS,
    STILL,
    TREADMILL,
    UPRIGHT,
)
from humangs_jax.geometry import quaternion


def upright_matrix(up: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that turns the named axis to +y: a matrix of 0 and +-1."""
    return np.asarray(quaternion.to_matrix(jnp.asarray(UPRIGHT[up])), np.float64).round()


def nearest_axis(direction: Float[np.ndarray, "3"]) -> tuple[str, float]:
    """The name of the axis that a vector points along most, and how far it does."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis], float(np.abs(direction[axis]))


def standing_axis(root: Float[np.ndarray, "m 3"]) -> str | None:
    """The axis of the world that the pelvis's own y axis points along on average; None if none is clear.

    Arguments: root: axis-angle of the pelvis in each frame.
    """
    mean = Rotation.from_rotvec(np.asarray(root, np.float64)).as_matrix()[..., 1].mean(axis=0)
    axis, cosine = nearest_axis(mean)
    return None if cosine < CLEARLY_UP else axis


def sampled_frames(count: int) -> np.ndarray:
    """Frames that are asked for a floor, evenly spread, each followed by its next: 0, 1, 40, 41, ..."""
    first = np.unique(np.linspace(0, max(count - 2, 0), min(max(count - 1, 1), MOST_FRAMES)).astype(int))
    return np.minimum(np.stack([first, first + 1], axis=1), count - 1).reshape(-1)


def up_axis(
    points: Float[np.ndarray, "n k 3"], stands: str | None, usual: str, fps: float, also: tuple[str, ...] = ()
) -> tuple[str, str]:
    """The axis that is up, and what is to be said about it ("": nothing).

    It is the usual one of the format. Another has to be the one along which the person stands, and the floor must agree: things
    rest on a floor, so that the lowest joint stays at one height and still. Lying, crawling and upside-down people stand along
    other axes, but rest on no floor there.

    Arguments: points: joints in space, metres, pairs of frames as `sampled_frames` has them. stands: the axis along which the
    person stands on average, if any. usual: the format's. also: axes that are up in other files of the format; they are believed
    unless the floor contradicts. Someone who is upside down on the hands stands on them.
    """
    if stands is None or stands == usual:
        return usual, ""
    here, there = _floors(points, (usual, stands), fps)
    if here < ON_THE_FLOOR <= there and here <= 0.5 * there:
        return stands, f"{stands} is up, not {usual} as usual in such files: people stand and step on a floor below it"
    contradicted = there < ON_THE_FLOOR <= here and there <= 0.5 * here
    if stands in also and not contradicted and not (_opposite(stands, usual) and _on_hands(points, usual)):
        return stands, f"{stands} is up, not {usual}: people stand along it"
    if contradicted or _opposite(stands, usual):
        return usual, ""
    return (
        usual,
        f"{usual} is up, as usual in such files, and people lie along {stands}; if they should stand: up={stands}",
    )


def _floors(points, axes, fps):
    """Share of the frames in which something is on the floor, for the usual axis and for another, which has to be surer."""
    moves = np.linalg.norm(points[1::2] - points[::2], axis=-1) * fps
    limit = max(STILL[0], STILL[1] * float(moves.mean()))
    level, resting = [], []
    for axis in axes:
        heights = points[::2] @ upright_matrix(axis)[1]
        lowest, least = heights.argmin(axis=1), heights.min(axis=1)
        level.append(np.abs(least - np.median(least)) <= FLOOR_BAND)
        resting.append(level[-1] & (moves[np.arange(len(moves)), lowest] <= limit))
    rests, stays = ([float(x.mean()) for x in shares] for shares in (resting, level))
    # on a treadmill nothing rests
    return rests if max(rests) >= ON_THE_FLOOR else [stays[0], stays[1] if stays[1] >= TREADMILL else 0.0]


def _opposite(a, b):
    return a.lstrip("-") == b.lstrip("-") and a != b


def _on_hands(points, up):
    """Whether the lowest joint is one of the arms most of the time."""
    return np.isin((points[::2] @ upright_matrix(up)[1]).argmin(axis=1), HANDS).mean() > 0.5


def joint_places(
    joints: Float[np.ndarray, "j 3"], rotations: Float[np.ndarray, "m j 3"], translations: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m j 3"]:
    """Joints in space of a body of SMPL-X's joints."""
    world, places = [], []
    for j, parent in enumerate(PARENTS):
        own = Rotation.from_rotvec(rotations[:, j]).as_matrix()
        world.append(own if parent < 0 else world[parent] @ own)
        places.append(
            translations + joints[0] if parent < 0 else places[parent] + world[parent] @ (joints[j] - joints[parent])
        )
    return np.stack(places, axis=1)


def turned_upright(
    rotations: Float[np.ndarray, "m j 3"],
    translations: Float[np.ndarray, "m 3"],
    up: str,
    pelvis: Float[np.ndarray, "3"] = PELVIS,
) -> tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]:
    """Poses and positions in a world turned so that the axis `up` becomes +y. pelvis: the root joint in T-pose, metres."""
    if up == "y":
        return rotations, translations
    turn = upright_matrix(up)
    root = quaternion.from_axis_angle(jnp.asarray(rotations[:, 0], jnp.float32))
    root = np.asarray(quaternion.multiply(jnp.asarray(UPRIGHT[up], jnp.float32), root), np.float64)
    root *= np.where(root[:, :1] < 0, -1, 1)  # the shorter way round
    sine = np.linalg.norm(root[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, root[:, :1])
    axis_angle = root[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)
    rotations = np.concatenate([axis_angle[:, None], rotations[:, 1:]], axis=1)
    return rotations, (translations + pelvis) @ turn.T - pelvis
