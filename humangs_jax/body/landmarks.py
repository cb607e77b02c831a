"""Positions on a body of the landmarks that annotators and detectors mark in photos.

A landmark is a mean of joints, or a vertex that a rule finds on the body's own template
(`_Finder`), so that any body whose joints have SMPL-X's names has them. Sides are the person's.
Joints: shoulder, elbow, wrist, hip, knee, ankle, jaw, eye (the centre of the eyeball), knuckles
`{side}_FINGER_1, 2, 3` from the palm outwards, and means of them: neck (of the shoulders, as
OpenPose has it), mid_hip. Vertices: nose (or face_30), face_8 the chin, face_27 the root of the
nose, ears, finger tips, and of each foot big_toe, small_toe, heel and the foremost, foot_index. The
other 65 points of the face follow expressions, which bodies without a face rig do not have.

Annotators put hips and shoulders a little elsewhere (hips higher and outwards, by centimetres):
fits give them less weight. Where it is known at which places a detector sees its landmarks, they
are moved there: `Place`.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import FINGERS
from humangs_jax.body.model import (
    EXACT,
    BodyModel,
    BodyPose,
    SurfacePoints,
    joint_transforms,
    pose_features,
    pose_points,
    shaped,
    surface_points,
)
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import transform

# Names of the two sides
# ------------------------------------------------------------------------------------------------


class _FacePart(NamedTuple):
    """Points of the face, from `first` to before `end`. Two are mirror images if their numbers add
    up to `total`.

    left_is_later: whether the one with the larger number is on the person's left.
    """

    first: int
    end: int
    total: int
    left_is_later: bool = True


_FACE_PARTS = (
    _FacePart(0, 17, 16),  # jaw
    _FacePart(17, 27, 43),  # brows
    _FacePart(31, 36, 66),  # nostrils
    _FacePart(48, 55, 102),  # upper lip, outside
    _FacePart(55, 60, 114, left_is_later=False),  # lower lip, outside
    _FacePart(60, 65, 124),  # upper lip, inside
    _FacePart(65, 68, 132, left_is_later=False),  # lower lip, inside
)
_FACE_EYES = {36: 45, 37: 44, 38: 43, 39: 42, 40: 47, 41: 46}
"""Of the right eye, and of the left."""


def mirrored_name(name: str) -> str:
    """Returns the landmark that a mirror puts in the place of `name`; what is in the middle is its
    own mirror image.
    """
    kind, _, rest = name.partition("_")
    if kind == "face":
        return f"face_{_mirrored_face(int(rest))[0]}"
    other = {"left": "right", "right": "left"}
    if kind in other:
        return f"{other[kind]}_{rest}"
    return name


def side_of(name: str) -> int:
    """Returns -1 for a landmark of the person's right, and 1 for the left and the middle."""
    kind, _, rest = name.partition("_")
    if kind == "face":
        return _mirrored_face(int(rest))[1]
    return -1 if kind == "right" else 1


def _mirrored_face(i: int) -> tuple[int, int]:
    """The number of the mirror image of a point of the face, and the side of the point."""
    for first, end, total, left_is_later in _FACE_PARTS:
        if first <= i < end:
            right = i < total - i if left_is_later else i > total - i
            return total - i, -1 if right else 1
    if i in _FACE_EYES:
        return _FACE_EYES[i], -1
    return {left: right for right, left in _FACE_EYES.items()}.get(i, i), 1


# Places of detectors
# --------------------------------------------------------------------------------------------------


Millimetres = tuple[float | int, float | int, float | int]


class Place(NamedTuple):
    """Where a detector sees one of its landmarks."""

    name: str
    """Name of the landmark."""
    base: str
    """The landmark of `body.landmarks` that it is measured from."""
    offset: tuple[float, float, float]
    """From there to the landmark, metres in T-pose: x to the person's left, y up, z to the
    front.
    """
    joints: tuple[str, ...] = ()
    """Joints whose turning carries the offset along, by equal shares; none: what carries the base,
    which then is a vertex.
    """


def place(name: str, base: str, joints: tuple[str, ...], millimetres: Millimetres) -> Place:
    """A landmark whose offset is in millimetres."""
    x, y, z = millimetres
    return Place(name, base, (x / 1000, y / 1000, z / 1000), joints)


CARRIERS = {
    **dict.fromkeys(("nose", "ear", "heel", "big_toe", "small_toe"), ()),
    **{
        "eye": ("head",),
        "shoulder": ("{side}_collar",),
        "elbow": ("{side}_shoulder",),
        "wrist": ("{side}_elbow",),
    },
    **{"hip": ("pelvis",), "knee": ("{side}_hip",), "ankle": ("{side}_knee",)},
}
"""The joints whose turning carries what lies beside a landmark; none: what carries its vertex."""


def plain_places(names: tuple[str, ...]) -> tuple[Place, ...]:
    """Landmarks that lie where this module has them, as far as fits may find them elsewhere."""
    sides = [
        name.split("_", 1) if name.startswith(("left_", "right_")) else ("", name) for name in names
    ]
    known = [
        (name, side, part)
        for name, (side, part) in zip(names, sides, strict=True)
        if part in CARRIERS
    ]
    return tuple(
        Place(n, n, (0.0, 0.0, 0.0), tuple(j.format(side=side) for j in CARRIERS[part]))
        for n, side, part in known
    )


def both_sides(
    names: tuple[str, str], base: str, joints: tuple[str, ...], millimetres: Millimetres
) -> tuple[Place, Place]:
    """A landmark of the left side and its mirror image.

    Arguments: names: of the left and the right one. base, joints: with {side} for the side.
    millimetres: the left one's.
    """
    x, y, z = millimetres
    left, right = (
        place(
            name,
            base.format(side=side),
            tuple(joint.format(side=side) for joint in joints),
            (sign * x, y, z),
        )
        for name, side, sign in zip(names, ("left", "right"), (1, -1), strict=True)
    )
    return left, right


# Landmarks
# --------------------------------------------------------------------------------------------------


SIDES = {"left": 1.0, "right": -1.0}
"""And the sign of x that is outwards in T-pose."""
MEMBER = 0.5
"""A vertex belongs to the segment whose joints have at least this share of its weight."""
CARRIES = 0.1
"""A joint moves a point that has at least this share of its weight from it."""
MIDLINE = 0.006
"""Half-width of the middle of the face, metres."""
FOOT = {
    "foot_index": (0.0, 1.0),
    "big_toe": (-0.3, 1.0),
    "small_toe": (1.0, 1.0),
    "heel": (0.0, -1.0),
}
"""The direction in which landmarks of the foot are farthest: outwards and forwards."""


@pytree_dataclass
class LandmarkModel:
    """What of a body its landmarks depend on: k landmarks from j joints and p points of the
    surface.
    """

    joints: Float[Array, "j 3"]
    """Rest joints of the mean shape, (j, 3), metres."""
    joint_directions: Float[Array, "j 3 s"]
    """Change of the rest joints per unit of a shape coefficient, (j, 3, s), metres."""
    points: SurfacePoints
    """The points of the surface that landmarks need; those of `places` come last."""
    regressor: Float[Array, "k jp"]
    """Landmarks from posed joints and points, (k, j + p); rows sum to 1, or are 0 where the body
    lacks a landmark.
    """
    certainty: Float[Array, " k"]
    """Weights of errors, (k,), see `LESS_CERTAIN`."""
    names: tuple[str, ...] = static_field(default=())
    """Names of the landmarks, k of them."""
    known: tuple[bool, ...] = static_field(default=())
    """Whether the body has each landmark, k of them."""
    parents: tuple[int, ...] = static_field(default=())
    """Parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field(default=())
    """Names of the j joints."""
    movers: tuple[int, ...] = static_field(default=())
    """The joints whose turning moves a landmark."""
    placed: tuple[int, ...] = static_field(default=())
    """Landmark of each of the last points, which are those of `places`."""
    groups: tuple[tuple[int, int], ...] = static_field(default=())
    """(group, side) of each of these points: a group is a pair, or what is in the middle; side 1,
    and -1 for what is mirrored.
    """

    def moved(self, offsets: Float[Array, "g 3"]) -> "LandmarkModel":
        """The model with more offsets of its places, metres, one for each group; x of a mirrored
        one is turned round.
        """
        if not self.placed:
            return self
        which, sides = np.asarray(self.groups).T
        own = offsets[which] * np.stack([sides, np.ones_like(sides), np.ones_like(sides)], axis=-1)
        rest = self.points.rest.at[-len(which) :].add(own)
        return replace(self, points=replace(self.points, rest=rest))

    def by_landmark(self, offsets: Float[Array, "g 3"]) -> Float[np.ndarray, "k 3"]:
        """The same offsets by landmark; 0 for those without a place."""
        found = np.zeros((len(self.names), 3))
        for row, (group, side) in zip(self.placed, self.groups, strict=True):
            found[row] = np.asarray(offsets[group]) * (side, 1, 1)
        return found


LESS_CERTAIN = {"hip": 2.0, "shoulder": 1.5, "neck": 1.5, "mid_hip": 1.5, "ear": 1.5}
"""Multiples of the noise for landmarks on whose position annotators disagree."""


def usual_certainty(names: tuple[str, ...]) -> Float[np.ndarray, " k"]:
    """(k,) the weight of a landmark's error in (0, 1], see `LESS_CERTAIN`."""
    return np.asarray([1 / LESS_CERTAIN.get(kind_of(name), 1.0) for name in names], np.float32)


def kind_of(name: str) -> str:
    """The name without its side."""
    if name.startswith(("left_", "right_")):
        return name.split("_", 1)[1]
    return name


@checked_arguments
def landmark_model(
    body: BodyModel,
    names: tuple[str, ...],
    places: tuple[Place, ...] = (),
    certainty: tuple[float, ...] = (),
) -> LandmarkModel:
    """The landmarks of a body by name; those that it does not have get rows of zeros. No names: the
    joints alone.

    Arguments: places: of the landmarks that may be elsewhere than the module says; ignored where
    the body lacks what they depend on. certainty: of each, if it is known.
    Raises: ValueError if it has none of them, which is so when its joints have other names than
    SMPL-X's.
    """
    # sources of each landmark: joints and vertices, or a place that the caller gives
    finder = _Finder(body)
    moved = {
        place.name: place
        for place in places
        if finder.find(place.base) and finder.has(place.joints)
    }
    sources = [[] if name in moved else finder.find(name) for name in names]
    known = tuple(bool(found) or name in moved for name, found in zip(names, sources, strict=True))
    if names and not any(known):
        raise ValueError(
            f"body '{body.name}' has none of these landmarks: are its joints named like SMPL-X's"
            f" (left_hip, ...)? They are {', '.join(body.joint_names[:4]) or 'not named'}"
        )
    # points of the surface: vertices that are sources, then the places; left and right share a
    # group
    vertices = sorted({source for found in sources for source in found if source >= 0})
    joints, placed = len(body.parents), [moved[name] for name in names if name in moved]
    pairs = [
        place.name if side_of(place.name) > 0 else mirrored_name(place.name) for place in placed
    ]
    numbers = sorted(set(pairs))
    # each landmark is the mean of its sources, or its place
    regressor = np.zeros((len(names), joints + len(vertices) + len(placed)), np.float32)
    for row, name, found in zip(regressor, names, sources, strict=True):
        for source in found:
            column = -1 - source
            if source >= 0:
                column = joints + vertices.index(source)
            row[column] += 1 / len(found)
        if name in moved:
            row[joints + len(vertices) + placed.index(moved[name])] = 1.0
    points = _concatenated(
        [_rows(surface_points(body), vertices), *(_placed(body, finder, place) for place in placed)]
    )
    return LandmarkModel(
        joints=_regressed(body, body.template),
        joint_directions=_regressed(body, body.shape_directions),
        points=points,
        regressor=jnp.asarray(regressor),
        certainty=jnp.asarray(certainty or usual_certainty(names), jnp.float32),
        names=names,
        known=known,
        parents=body.parents,
        joint_names=body.joint_names,
        movers=_movers(
            body.parents, np.any(regressor[:, :joints], axis=0), np.asarray(points.weights)
        ),
        placed=tuple(names.index(place.name) for place in placed),
        groups=tuple(
            (numbers.index(pair), side_of(each.name))
            for pair, each in zip(pairs, placed, strict=True)
        ),
    )


def _regressed(body: BodyModel, values: Float[Array, "n *b"]) -> Float[Array, "j *b"]:
    """Values of the joints from those of the vertices (n, ...)."""
    return jnp.einsum("jn,n...->j...", body.joint_regressor, values, precision=EXACT)


def _rows(points: SurfacePoints, rows: Int[np.ndarray, " p"] | list[int]) -> SurfacePoints:
    return jax.tree.map(lambda leaf: leaf[np.asarray(rows, np.int32)], points)


def _joint_point(body: BodyModel, joint: int) -> SurfacePoints:
    """A joint as a point that it carries itself."""
    row = body.joint_regressor[joint : joint + 1]

    def product(values):
        return jnp.einsum("jn,n...->j...", row, values, precision=EXACT)

    return SurfacePoints(
        product(body.template),
        product(body.shape_directions),
        None if body.pose_directions is None else jnp.zeros_like(body.pose_directions[:1]),
        jnp.zeros_like(body.skinning_weights[:1]).at[0, joint].set(1.0),
    )


def _placed(body: BodyModel, finder: "_Finder", place: Place) -> SurfacePoints:
    """One point beside the sources of a landmark: it grows with them, and turns with the joints of
    the place.
    """
    every, sources = surface_points(body), finder.find(place.base)
    points = [
        _rows(every, [source]) if source >= 0 else _joint_point(body, -1 - source)
        for source in sources
    ]
    mean = jax.tree.map(lambda leaf: leaf.mean(axis=0, keepdims=True), _concatenated(points))
    weights = mean.weights
    if place.joints:
        carriers = np.asarray([finder.index[joint] for joint in place.joints])
        weights = jnp.zeros_like(weights).at[0, carriers].set(1 / len(carriers))
    return replace(mean, rest=mean.rest + jnp.asarray(place.offset, jnp.float32), weights=weights)


def _concatenated(points: Sequence[SurfacePoints]) -> SurfacePoints:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *points)


def pose_landmarks(
    model: LandmarkModel, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Landmarks and joints of a person in a pose, metres.

    Landmarks that the body lacks are at the origin.
    """
    transforms, joints = pose_joints(model, betas, pose)
    posed = pose_points(model.points, betas, pose_features(pose.rotations), transforms)
    return landmarks_from(model, joints, posed), joints


def pose_joints(
    model: LandmarkModel, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "j 4 4"], Float[Array, "j 3"]]:
    """Transforms of the joints from rest, and where the joints are, metres."""
    rest = shaped(model.joints, model.joint_directions, betas)
    transforms = joint_transforms(rest, model.parents, pose.rotations, pose.translation)
    return transforms, transform.apply(transforms, rest)


def landmarks_from(
    model: LandmarkModel, joints: Float[Array, "j 3"], points: Float[Array, "p 3"]
) -> Float[Array, "k 3"]:
    """Landmarks from posed joints and points."""
    return jnp.matmul(model.regressor, jnp.concatenate([joints, points]), precision=EXACT)


def _movers(
    parents: tuple[int, ...],
    joints_used: Bool[np.ndarray, " j"],
    point_weights: Float[np.ndarray, "p j"],
) -> tuple[int, ...]:
    """Joints above the used joints, and those that move a used point (p, j): turning a joint does
    not move itself.
    """
    moving = point_weights.max(axis=0, initial=0.0) > CARRIES
    for j in np.flatnonzero(joints_used | moving):
        parent = parents[j]
        while parent >= 0:
            moving[parent] = True
            parent = parents[parent]
    return tuple(int(j) for j in np.flatnonzero(moving))


Score = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
"""What the best of some places has most of."""


class _Finder:
    """Sources of landmarks on one body: vertices as they are, joints as -1 - joint."""

    def __init__(self, body: BodyModel) -> None:
        self.template = np.asarray(body.template, np.float64)
        self.weights = np.asarray(body.skinning_weights)
        self.joints = np.asarray(body.joint_regressor, np.float64) @ self.template
        self.index = {name: j for j, name in enumerate(body.joint_names)}

    def has(self, joints: tuple[str, ...]) -> bool:
        """Whether the body has these joints."""
        return all(name in self.index for name in joints)

    def find(self, name: str) -> list[int]:
        """The sources whose mean is the landmark; none if the body lacks it."""
        try:
            return self._find(name)
        except (KeyError, ValueError):  # a joint that it lacks, or no vertex where a rule looks
            return []

    def _find(self, name: str) -> list[int]:
        def joint(x):
            return -1 - self.index[x]

        match name.split("_"):
            # the middle between two joints
            case ["neck"]:
                return [joint(f"{side}_shoulder") for side in SIDES]
            case ["mid", "hip"]:
                return [joint(f"{side}_hip") for side in SIDES]
            # the face, by where the surface is foremost, lowest or at the height of the eyes
            case ["nose"] | ["face", "30"]:
                low, high = self.joints[self.index["jaw"], 1], self._eyes()[1]
                return [self._best(self._head(low, high), lambda p: p[:, 2])]
            case ["face", "8"]:
                return [
                    self._on_midline(lambda p: -p[:, 1], highest=self.joints[self.index["jaw"], 1])
                ]
            case ["face", "27"]:
                height = self._eyes()[1]
                return [self._on_midline(lambda p: -np.abs(p[:, 1] - height) + p[:, 2])]
            # joints themselves
            case ["jaw"] | [
                "left" | "right",
                "shoulder" | "elbow" | "wrist" | "hip" | "knee" | "ankle" | "eye",
            ]:
                return [joint(name)]
            case ["left" | "right" as side, "hand", "root"]:
                return [joint(f"{side}_wrist")]
            # parts of one side: the outermost vertex in a direction
            case ["left" | "right" as side, "ear"]:
                eyes = self._eyes()[1]
                return [
                    self._best(
                        self._head(eyes - 0.06, eyes + 0.03), lambda p: SIDES[side] * p[:, 0]
                    )
                ]
            case ["left" | "right" as side, *part] if "_".join(part) in FOOT:
                outward, forward = FOOT["_".join(part)]
                foot = self._segment(f"{side}_ankle", f"{side}_foot")
                return [
                    self._best(foot, lambda p: outward * SIDES[side] * p[:, 0] + forward * p[:, 2])
                ]
            case ["left" | "right" as side, finger, "tip"] if finger in FINGERS:
                middle, last = (self.joints[self.index[f"{side}_{finger}{k}"]] for k in (2, 3))
                return [
                    self._best(self._segment(f"{side}_{finger}3"), lambda p: p @ (last - middle))
                ]
            case ["left" | "right" as side, finger, "1" | "2" | "3" as knuckle] if (
                finger in FINGERS
            ):
                return [joint(f"{side}_{finger}{knuckle}")]
        raise KeyError(name)

    def _segment(self, *joints: str) -> Int[np.ndarray, " n"]:
        """Vertices that belong to some joints together; joints that the body lacks are left out."""
        owned = self.weights[:, [self.index[name] for name in joints if name in self.index]].sum(1)
        return np.flatnonzero(owned > MEMBER)

    def _best(self, vertices: Int[np.ndarray, " n"], score: Score) -> int:
        return int(vertices[np.argmax(score(self.template[vertices]))])

    def _eyes(self) -> Float[np.ndarray, "3"]:
        return self.joints[[self.index["left_eye"], self.index["right_eye"]]].mean(0)

    def _head(self, low: float, high: float) -> Int[np.ndarray, " n"]:
        """Vertices of the head between two heights."""
        head = self._segment("head", "jaw")
        height = self.template[head, 1]
        return head[(height > low) & (height < high)]

    def _on_midline(self, score: Score, highest: float = np.inf) -> int:
        """The best vertex of the front of the face's middle."""
        head = self._segment("head", "jaw")
        p = self.template[head]
        front = p[:, 2] > 0.5 * (self._eyes()[2] + p[:, 2].max()) - 0.02
        return self._best(head[front & (np.abs(p[:, 0]) < MIDLINE) & (p[:, 1] < highest)], score)
