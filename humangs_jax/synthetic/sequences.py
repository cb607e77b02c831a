"""Makes smooth motions: walking along curves, turning on the spot, reaching for things.

Soles on the ground stay where they are. Walks and turns follow footprints along a path. A foot
rolls from heel to toe on each footprint and swings to the next. The pelvis follows the path, as
high as the legs allow, and `anatomy.place_feet` solves for the legs. In a reach both feet stay on
the ground while the body moves from pose to pose. In the world y is up, lengths are in metres, and
the ground is at y = 0, where the soles of the bare body stand.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.integrate import cumulative_trapezoid

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.synthetic import anatomy as kin
from humangs_jax.synthetic.anatomy import Joint
from humangs_jax.synthetic.poses import (
    ARMS,
    STANCES,
    Stance,
    arm_clearance,
    bend_arm,
    bend_trunk,
    draw_goal,
    in_world,
    pose_hand,
)
from humangs_jax.synthetic.surfaces import choice

FPS = 30.0
"""Frames per second."""
_LONG_STEP = 0.75
"""Length of a long step, in lengths of a leg."""
_STANCE_SHARE = 0.62
"""Share of a stride during which a foot is on the ground."""
_FLAT_FROM = 0.15
"""Share of the time on the ground after which the sole is flat."""
_FLAT_UNTIL = 0.55
"""Share of the time on the ground until which the sole is flat."""
_SMOOTHING = 4
"""Number of frames on each side over which the height of the pelvis is smoothed."""
_SPARE = 0.995
"""Largest distance from hip to ankle, as a share of the leg's length, that the choice of the
pelvis's height allows.
"""
_TRIES = 12
"""Largest number of times that an arm is drawn until it is clear of the body."""


_Heading = Callable[[float | np.ndarray], float | np.ndarray]
"""A function of the phase (strides) that returns the heading: the angle about y, radians."""
_Track = Callable[[float], kin.Vector]
"""A function of the phase (strides) that returns the body's place on its path (3,), metres."""
_Moves = tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"], Bool[np.ndarray, "m 2"]]
"""A motion of m frames: rotations of the joints (m, j, 3), axis-angle, radians; positions of the
pelvis (m, 3), metres; and whether the left and the right foot are on the ground (m, 2).
"""
_KeyPose = tuple[kin.Rotations, kin.Vector, float]
"""A pose: rotations of the joints (j, 3), radians; the place of the pelvis on the ground (3,),
metres; and how far the pelvis is below the highest place that the legs allow, metres.
"""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """A motion of one person."""

    kind: str
    """Kind of motion, one of KINDS."""
    rotations: Float[np.ndarray, "m j 3"]
    """Rotations of the joints, (m, j, 3), axis-angle, radians."""
    translations: Float[np.ndarray, "m 3"]
    """Translations of the body, (m, 3), metres."""
    planted: Bool[np.ndarray, "m 2"]
    """Whether the left and the right foot are on the ground, (m, 2)."""
    fps: float = FPS
    """Frames per second."""


def sample_sequence(
    rng: np.random.Generator, build: kin.Build, frames: int = 60, kind: str | None = None
) -> Sequence:
    """Makes a motion of a person at 30 frames per second.

    kind: "walk", "turn" or "reach". None: a random one.

    Raises: ValueError if there is no such kind, or if `frames` is less than 1.
    """
    if frames < 1:
        raise ValueError(f"frames: expected at least 1, got {frames}")
    if kind is None:
        kind = choice(rng, {name: odds for name, (odds, _) in KINDS.items()})
    if kind not in KINDS:
        raise ValueError(f"no kind of sequence {kind!r}: expected one of {', '.join(KINDS)}")
    rotations, pelvis, planted = KINDS[kind][1](rng, build, frames)
    return Sequence(kind, rotations, pelvis - build.joints[Joint.PELVIS], planted)


@dataclasses.dataclass(frozen=True)
class _Gait:
    """How a person walks or turns on the spot."""

    cadence: float
    """Strides per second; a stride is two steps."""
    step: float
    """Length of a step, metres."""
    bend: float
    """Angle by which the heading changes with each step, radians."""
    width: float
    """Distance of a foot from the path, metres."""
    lift: float
    """Height to which a swinging foot is raised, metres."""
    turn_out: float
    """Angle by which the feet are turned outwards, radians."""
    swing: float
    """Largest angle by which the arms swing, radians."""


def _walk(rng: np.random.Generator, build: kin.Build, frames: int) -> _Moves:
    """Makes a walk, straight or along a curve."""
    step, curved = rng.uniform(0.3, _LONG_STEP) * build.leg, rng.random() < 0.6
    cadence = rng.uniform(0.75, 1.05)
    bend = rng.normal(0, 0.16) if curved else 0.0
    width = build.hip_width * rng.uniform(0.5, 0.9)
    lift = rng.uniform(0.04, 0.09)
    turn_out = rng.uniform(0.0, 0.18)
    swing = rng.uniform(0.25, 0.5) * min(1.0, step / build.leg / 0.6)
    return _step_along(rng, build, frames, _Gait(cadence, step, bend, width, lift, turn_out, swing))


def _turn(rng: np.random.Generator, build: kin.Build, frames: int) -> _Moves:
    """Makes a turn on the spot."""
    cadence, step = rng.uniform(0.6, 0.9), rng.uniform(-0.02, 0.06)
    bend = rng.choice([-1, 1]) * rng.uniform(0.25, 0.5)
    width = build.hip_width * rng.uniform(0.95, 1.3)
    lift, turn_out, swing = rng.uniform(0.05, 0.09), rng.uniform(0.05, 0.2), rng.uniform(0.03, 0.15)
    return _step_along(rng, build, frames, _Gait(cadence, step, bend, width, lift, turn_out, swing))


def _step_along(rng: np.random.Generator, build: kin.Build, frames: int, gait: _Gait) -> _Moves:
    """Makes steps along a path or on the spot: first footprints, then trunk, legs and arms."""
    start = rng.uniform(0, 1)
    if abs(gait.step) < 0.1 * build.leg:
        begin_heading = rng.uniform(-np.pi, np.pi)
    else:
        begin_heading = rng.uniform(-0.7, 0.7)
    phase = start + gait.cadence * (np.arange(frames) / FPS)  # strides; two steps each

    def heading(p):
        return begin_heading + 2 * gait.bend * (p - start)

    # where the feet are, and whether they are on the ground
    track = _path(heading, 2 * gait.step, start, phase[-1])
    feet = [tuple(_foot_at(build, gait, heading, track, side, p) for side in (0, 1)) for p in phase]
    planted = np.asarray([[(p + 0.5 * side) % 1 < _STANCE_SHARE for side in (0, 1)] for p in phase])
    # the trunk sways over the foot that stands: left at a quarter stride
    rotations = np.zeros((frames, kin.JOINTS, 3))
    turns = _carry_trunk(rng, build, rotations, phase, gait, heading)
    sway = 0.25 * gait.width * np.sin(2 * np.pi * (phase - 0.06))
    aside = [kin.turned(y=heading(p))[:, 0] * s for p, s in zip(phase, sway, strict=True)]
    centers = np.stack([track(p) for p in phase]) + np.stack(aside)
    # the pelvis is as high as the legs let it, and the legs reach the feet
    pelvis = _ride(build, turns, centers, feet)
    for i in range(frames):
        kin.place_feet(build, rotations[i], pelvis[i], feet[i])
    _swing_arms(rng, build, rotations, phase, gait)
    return rotations, pelvis, planted


def _carry_trunk(
    rng: np.random.Generator,
    build: kin.Build,
    rotations: Float[np.ndarray, "m j 3"],
    phase: Float[np.ndarray, " m"],
    gait: _Gait,
    heading: _Heading,
) -> Float[np.ndarray, "m 3 3"]:
    """Sets pelvis, spine and head in `rotations`; returns the pelvis's rotations (m, 3, 3).

    The pelvis turns and rolls with the steps, the spine turns against the pelvis, and the head
    looks where the path leads.
    """
    lean = rng.normal(0.02, 0.02) + 0.12 * max(gait.step, 0) / build.leg
    twist = 0.14 * gait.step / build.leg / 0.6
    look = np.clip(1.2 * gait.bend, -0.5, 0.5)
    turns = np.empty((len(phase), 3, 3))
    for i, p in enumerate(phase):
        once = 2 * np.pi * p
        roll = 0.05 * np.sin(once - 0.1) * min(1.0, gait.step / build.leg + 0.3)
        facing = kin.turned(y=heading(p) - twist * np.cos(once))
        turns[i] = facing @ kin.turned(x=0.4 * lean, z=roll)
        against = 2 * twist * np.cos(once - 0.2)
        for joint, share in ((Joint.SPINE1, 0.3), (Joint.SPINE2, 0.4), (Joint.SPINE3, 0.3)):
            rotations[i, joint] = np.asarray([0.6 * lean, against, -0.8 * roll]) * share
        sideways = 0.5 * look - 0.5 * twist * np.cos(once - 0.2)
        rotations[i, [Joint.NECK, Joint.HEAD]] = [-0.3 * lean, sideways, 0]
    rotations[:, Joint.PELVIS] = kin.rotation_vector(turns)
    return turns


def _path(heading: _Heading, stride: float, first: float, last: float) -> _Track:
    """Returns the path that follows a heading: a function of the phase, see `_Track`.

    stride: metres per stride. first, last: phases between which the path is needed. At the phase
    `first` the path is at the origin.
    """
    grid = np.linspace(first - 1.5, last + 1.5, int(64 * (last - first + 3)) + 2)
    direction = np.stack([np.sin(heading(grid)), np.zeros_like(grid), np.cos(heading(grid))], -1)
    along = cumulative_trapezoid(direction, grid, axis=0, initial=0)

    def at(p):
        return np.asarray([np.interp(p, grid, along[:, k]) for k in range(3)])

    origin = at(first)
    return lambda p: stride * (at(p) - origin)


def _foot_at(
    build: kin.Build, gait: _Gait, heading: _Heading, track: _Track, side: int, phase: float
) -> kin.Foot:
    """Returns where one foot is at a phase (strides).

    The left foot comes down at whole phases, the right foot half a stride later. side: 0 for left,
    1 for right.
    """
    number, share = divmod(phase + 0.5 * side, 1.0)
    down = number - 0.5 * side
    here, there = (_footprint(build, gait, heading, track, side, down + k) for k in (0, 1))
    long = np.clip(gait.step / (_LONG_STEP * build.leg), 0.15, 1.0)
    # pitches of the foot when it comes down on the heel, and when it leaves from the toes
    strike = 0.0
    if gait.step > 0.2 * build.leg:
        strike = 0.28 * long
    off = 0.85 * (0.35 + 0.65 * long)
    if share < _STANCE_SHARE:
        u = share / _STANCE_SHARE
        rise = np.clip((u - _FLAT_UNTIL) / (1 - _FLAT_UNTIL), 0.0, 1.0)  # from rest to full motion
        late = off * (rise**2 * (3 - rise) / 2)
        pitch = late
        if u < _FLAT_FROM:
            pitch = -strike * (1 - _ease(u / _FLAT_FROM))
        return dataclasses.replace(here, pitch=float(pitch))
    u = (share - _STANCE_SHARE) / (1 - _STANCE_SHARE)
    s = _ease(u)
    at = (
        float(a + s * (b - a))
        for a, b in ((here.x, there.x), (here.z, there.z), (here.yaw, there.yaw))
    )
    # quickly, to clear the ground
    pitch = off * (1 - _ease(min(1.0, u / 0.6))) - strike * _ease((u - 0.4) / 0.6)
    return kin.Foot(*at, pitch=float(pitch), lift=float(gait.lift * np.sin(np.pi * s) ** 2))


def _footprint(
    build: kin.Build, gait: _Gait, heading: _Heading, track: _Track, side: int, down: float
) -> kin.Foot:
    """Returns the footprint of a foot that comes down at phase `down` (strides).

    It is beside the place where the pelvis is in the middle of the foot's time on the ground.
    """
    middle = down + 0.5 * _STANCE_SHARE
    yaw, sign = float(heading(middle)), 1 - 2 * side
    # of the ball, standing
    ahead = build.joints[Joint.LEFT_FOOT, 2] - build.joints[Joint.PELVIS, 2] - 0.04 * build.leg
    x, _, z = track(middle) + kin.turned(y=yaw) @ np.asarray([sign * gait.width, 0.0, ahead])
    return kin.Foot(float(x), float(z), float(yaw + sign * gait.turn_out))


def _swing_arms(
    rng: np.random.Generator,
    build: kin.Build,
    rotations: Float[np.ndarray, "m j 3"],
    phase: Float[np.ndarray, " m"],
    gait: _Gait,
) -> None:
    """Sets arms and hands in `rotations`: arms hang, and swing against the legs.

    For each arm one hanging pose is drawn. In each frame its shoulder is turned about the x axis by
    the angle of the swing, and elbow and collar turn a little, too.
    """
    # arms hang beside straight legs
    stood = rotations[0].copy()
    stood[[*kin.LEGS[0], *kin.LEGS[1]]] = 0
    for side in (0, 1):
        for _ in range(_TRIES):
            if bend_arm(rng, build, stood, "hang", side) > 0.01:
                break
        pose_hand(rng, stood, side)
    for side, hand in (
        (0, slice(Joint.LEFT_HAND, Joint.RIGHT_HAND)),
        (1, slice(Joint.RIGHT_HAND, kin.JOINTS)),
    ):
        collar, shoulder, elbow, wrist = ARMS[side]
        sign = 1 - 2 * side
        # the left arm is back when the left heel comes down
        forward = -sign * np.cos(2 * np.pi * (phase - 0.04))
        base = kin.rotation_matrix(stood[shoulder])
        for i, f in enumerate(forward):
            rotations[i, shoulder] = kin.rotation_vector(kin.turned(x=-gait.swing * f) @ base)
            rotations[i, elbow] = stood[elbow] + np.asarray(
                [0, -sign * 0.35 * gait.swing * (1 + f), 0]
            )
            rotations[i, collar] = stood[collar] + np.asarray(
                [0, -sign * 0.05 * f * min(1.0, gait.swing / 0.4), 0]
            )
        rotations[:, wrist], rotations[:, hand] = stood[wrist], stood[hand]


def _reach(rng: np.random.Generator, build: kin.Build, frames: int) -> _Moves:
    """Makes a motion from pose to pose: hands reach for targets, feet stay on the ground."""
    name = rng.choice(["stand", "contrapposto", "wide", "stride"], p=[0.4, 0.2, 0.2, 0.2])
    heading = rng.uniform(-0.7, 0.7)
    stance = STANCES[name][1](rng, build.hip_width / build.leg)
    feet = in_world(stance.feet, build.leg, heading)
    keys, times = [_key_pose(rng, build, heading, stance, feet, None)], [0.0]
    while times[-1] <= frames / FPS:
        times.append(times[-1] + rng.uniform(0.7, 1.4))
        keys.append(_key_pose(rng, build, heading, stance, feet, keys[-1]))
    rotations = np.zeros((frames, kin.JOINTS, 3))
    centers = np.zeros((frames, 3))
    sinks = np.zeros(frames)
    for i in range(frames):
        k = int(np.searchsorted(times, i / FPS, side="right")) - 1
        a, b = keys[k], keys[k + 1]
        # four fifths of the time on the way, then a rest
        s = _ease((i / FPS - times[k]) / (0.8 * (times[k + 1] - times[k])))
        rotations[i] = kin.between(a[0], b[0], s)
        centers[i], sinks[i] = (1 - s) * a[1] + s * b[1], (1 - s) * a[2] + s * b[2]
    pelvis = _ride(
        build, kin.rotation_matrix(rotations[:, Joint.PELVIS]), centers, [feet] * frames, sinks
    )
    for i in range(frames):
        kin.place_feet(build, rotations[i], pelvis[i], feet)
    return rotations, pelvis, np.ones((frames, 2), bool)


def _key_pose(
    rng: np.random.Generator,
    build: kin.Build,
    heading: float,
    stance: Stance,
    feet: kin.Feet,
    before: _KeyPose | None,
) -> _KeyPose:
    """Draws a pose in which the hands are at targets and the feet at their places.

    before: the pose before this one. Arms are then also kept clear of the body on the way between
    the poses. None: there is no such pose.
    """
    # the trunk: the deeper the knees are bent, the further it leans
    rotations = np.zeros((kin.JOINTS, 3))
    sink = stance.sink * build.leg
    if rng.random() < 0.3:
        sink += rng.uniform(0.05, 0.3) * build.leg
    stooped = sink / build.leg
    tilt, aside = 0.5 * stooped + rng.uniform(0, 0.05), rng.normal(0, 0.15)
    turn = kin.turned(y=heading + aside) @ kin.turned(x=tilt, z=stance.roll)
    rotations[Joint.PELVIS] = kin.rotation_vector(turn)
    # the pelvis is a little behind the middle of the feet
    offset = np.asarray([rng.normal(0, 0.02), 0, rng.normal(-0.08, 0.02)])
    back = kin.turned(y=heading) @ offset * build.leg
    center = np.asarray(
        [0.5 * (feet[0].x + feet[1].x) + back[0], 0.0, 0.5 * (feet[0].z + feet[1].z) + back[2]]
    )
    height = kin.highest_pelvis(build, turn, center[0], center[2], feet, _SPARE) - sink
    kin.place_feet(build, rotations, np.asarray([center[0], height, center[2]]), feet)
    bend_trunk(rng, rotations, stance.lean + 1.2 * stooped, stance.roll)
    # each arm takes the goal, of some, at which it is clearest of the body
    for side in (0, 1):
        best, best_clear = rotations, -np.inf
        for _ in range(_TRIES):
            tried = rotations.copy()
            goal = "hang" if rng.random() < 0.2 else draw_goal(rng)
            bend_arm(rng, build, tried, goal, side, other_arm=side == 1)
            clear = _clear_of(build, tried, side)
            if before is not None:  # the way there counts as much as the place
                way = (kin.between(before[0], tried, t) for t in (0.25, 0.5, 0.75))
                clear = min(clear, *(_clear_of(build, pose, side) for pose in way))
            if clear > best_clear:
                best, best_clear = tried, clear
            if clear > 0.0:
                break
        rotations = best
        pose_hand(rng, rotations, side)
    return rotations, center, sink


def _clear_of(build: kin.Build, rotations: kin.Rotations, side: int) -> float:
    """Returns the `arm_clearance` of a pose, metres, for placing the arm of one side.

    The left arm (side 0) is placed first. For the left arm, the right arm is set to its T-pose, out
    of the way.
    """
    if side == 0:
        rotations = rotations.copy()
        rotations[list(ARMS[1])] = 0
    return arm_clearance(build, rotations)


def _ride(
    build: kin.Build,
    turns: Float[np.ndarray, "m 3 3"],
    centers: Float[np.ndarray, "m 3"],
    feet: list[kin.Feet],
    sinks: Float[np.ndarray, " m"] | None = None,
) -> Float[np.ndarray, "m 3"]:
    """Returns positions of the pelvis (m, 3), metres.

    x and z are those of `centers`. The heights are smooth and low enough for the legs to reach the
    feet. sinks: metres by which the pelvis is lowered (m,). None: not at all.
    """
    heights = np.asarray([
        kin.highest_pelvis(build, turn, center[0], center[2], both, _SPARE)
        for turn, center, both in zip(turns, centers, feet, strict=True)
    ])  # fmt: skip

    def window(values):
        """Returns the values of the frames around each frame, (m, 2 _SMOOTHING + 1)."""
        padded = np.pad(values, _SMOOTHING, mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, 2 * _SMOOTHING + 1)

    weights = np.hanning(2 * _SMOOTHING + 3)[1:-1]
    smooth = window(window(heights).min(-1)) @ (weights / weights.sum())
    pelvis = centers.copy()
    pelvis[:, 1] = smooth - (0.0 if sinks is None else sinks)
    return pelvis


def _ease(t: float) -> float:
    """Maps t in [0, 1] smoothly to [0, 1]; speed and acceleration are 0 at both ends."""
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


KINDS: dict[str, tuple[float, Callable[[np.random.Generator, kin.Build, int], _Moves]]] = {
    "walk": (0.5, _walk), "turn": (0.2, _turn), "reach": (0.3, _reach),
}  # fmt: skip
"""Kinds of motion by name: the probability, and the function that makes such a motion. The function
takes a generator, a build and the number of frames.
"""
