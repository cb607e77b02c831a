"""Places the landmarks that annotators and detectors mark in photos on a body.

A landmark is a mean of joints, or a vertex that a rule finds on the body's own template
(`_Finder`). So every body whose joints have SMPL-X's names has landmarks. Sides are the person's.

These landmarks are joints: shoulder, elbow, wrist (or hand_root), hip, knee, ankle, jaw, eye (the
centre of the eyeball), and the knuckles `{side}_FINGER_1, 2, 3` from the palm outwards. Two are
means of joints: neck (of the shoulders, as OpenPose has it) and mid_hip. These are vertices: nose
(or face_30), face_8 the chin, face_27 the root of the nose, ears, finger tips, and of each foot
big_toe, small_toe, heel and foot_index, the foremost point. The other 65 points of the face follow
expressions, and no body has them here.

Annotators put hips and shoulders a little elsewhere (hips higher and outwards, by centimetres), so
fits give these landmarks less weight. If it is known where a detector sees its landmarks, they are
moved there by a `LandmarkDefinition`.
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
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import transform

# Names of the two sides
# ------------------------------------------------------------------------------------------------


class _FacePart(NamedTuple):
    """A range of face points that is its own mirror image."""

    first: int
    """Number of the first point."""
    end: int
    """Number of the last point plus 1."""
    total: int
    """Number of a point plus the number of its mirror image. All points of the range have the same
    sum.
    """
    left_is_later: bool = True
    """Whether the point with the larger number of a mirrored pair is on the person's left."""


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
"""Number of each point of the right eye -> number of its mirror image at the left eye."""


def mirrored_name(name: str) -> str:
    """Returns the name of the landmark's mirror image. A landmark in the middle is its own mirror
    image.
    """
    kind, _, rest = name.partition("_")
    if kind == "face":
        return f"face_{_mirrored_face(int(rest))[0]}"
    other = {"left": "right", "right": "left"}
    if kind in other:
        return f"{other[kind]}_{rest}"
    return name


def side_of(name: str) -> int:
    """Returns -1 for a landmark on the person's right, and 1 for one on the left or in the
    middle.
    """
    kind, _, rest = name.partition("_")
    if kind == "face":
        return _mirrored_face(int(rest))[1]
    return -1 if kind == "right" else 1


def _mirrored_face(i: int) -> tuple[int, int]:
    """Returns the number of a face point's mirror image, and the side of the point: -1 on the
    right, else 1.
    """
    for first, end, total, left_is_later in _FACE_PARTS:
        if first <= i < end:
            mirrored = total - i
            on_the_right = (i < mirrored) if left_is_later else (i > mirrored)
            side = -1 if on_the_right else 1
            return mirrored, side
    if i in _FACE_EYES:
        return _FACE_EYES[i], -1
    right_of_left = {left: right for right, left in _FACE_EYES.items()}
    return right_of_left.get(i, i), 1


# Places of detectors
# --------------------------------------------------------------------------------------------------


Millimetres = tuple[float | int, float | int, float | int]


class LandmarkDefinition(NamedTuple):
    """The place where a detector sees one of its landmarks."""

    name: str
    """Name of the landmark."""
    base: str
    """Name of the landmark of `body.landmarks` that the offset starts from."""
    offset: tuple[float, float, float]
    """Vector from the base to the landmark, metres in T-pose: x to the person's left, y up, z to
    the front.
    """
    joints: tuple[str, ...] = ()
    """Joints whose rotations turn the offset, in equal shares. Without joints, the offset turns
    with the base.
    """


def place(
    name: str, base: str, joints: tuple[str, ...], millimetres: Millimetres
) -> LandmarkDefinition:
    """Returns a `LandmarkDefinition` whose offset is given in millimetres."""
    x, y, z = millimetres
    return LandmarkDefinition(name, base, (x / 1000, y / 1000, z / 1000), joints)


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
"""The joints whose rotations turn the offset of each kind of landmark. Without joints, the offset
turns with the landmark's vertex.
"""


def plain_places(names: tuple[str, ...]) -> tuple[LandmarkDefinition, ...]:
    """Returns a definition with offset 0 for each of the landmarks whose kind is in `CARRIERS`. A
    fit may then find other offsets.
    """
    places = []
    for name in names:
        part = kind_of(name)
        if part in CARRIERS:
            side = name.removesuffix(f"_{part}")
            joints = tuple(joint.format(side=side) for joint in CARRIERS[part])
            places.append(LandmarkDefinition(name, name, (0.0, 0.0, 0.0), joints))
    return tuple(places)


def both_sides(
    names: tuple[str, str], base: str, joints: tuple[str, ...], millimetres: Millimetres
) -> tuple[LandmarkDefinition, LandmarkDefinition]:
    """Returns the definitions of a left landmark and of its mirror image on the right.

    Arguments: names: names of the left and the right landmark. base, joints: names with {side} in
    place of the side. millimetres: the offset of the left landmark.
    """
    x, y, z = millimetres

    def one(name: str, side: str, offset: Millimetres) -> LandmarkDefinition:
        carriers = tuple(joint.format(side=side) for joint in joints)
        return place(name, base.format(side=side), carriers, offset)

    return one(names[0], "left", (x, y, z)), one(names[1], "right", (-x, y, z))


# Landmarks
# --------------------------------------------------------------------------------------------------


SIDES = {"left": 1.0, "right": -1.0}
"""Sign of x that points outwards on each side, in T-pose."""
FOOT = {
    "foot_index": (0.0, 1.0),
    "big_toe": (-0.3, 1.0),
    "small_toe": (1.0, 1.0),
    "heel": (0.0, -1.0),
}
"""Direction in which each landmark of the foot is the farthest vertex: (outwards, forwards)."""


class PlacedLandmark(NamedTuple):
    """A landmark whose place a fit may move. A left and a right landmark move together.

    Code unpacks it as a plain tuple and does not read its fields by name, because `jax.export`
    restores it from files as a plain tuple.
    """

    landmark: int
    """Number of the landmark."""
    group: int
    """Number of the group. A group is a pair of mirror images, or one landmark in the middle."""
    side: int
    """-1 for the right landmark of a pair, whose x moves the opposite way; else 1."""


@pytree_dataclass
class LandmarkModel:
    """The part of a body that k landmarks need. It can be posed without the rest of the body.

    landmarks = `regressor` @ [the j posed joints, the p posed `points` of the surface]
    """

    joints: Float[Array, "j 3"]
    """Rest joints of the mean shape, (j, 3), metres."""
    joint_directions: Float[Array, "j 3 s"]
    """Change of the rest joints per unit of a shape coefficient, (j, 3, s), metres."""
    points: SurfacePoints
    """The p points of the surface that landmarks need. The points of `placed` come last."""
    regressor: Float[Array, "k jp"]
    """Weights of joints and points in each landmark, (k, j + p). Rows sum to 1, or to 0 where the
    body lacks the landmark.
    """
    certainty: Float[Array, " k"]
    """Weights of the landmarks' errors, (k,), in (0, 1], see `LESS_CERTAIN`."""
    names: tuple[str, ...] = static_field(default=())
    """Names of the k landmarks."""
    known: tuple[bool, ...] = static_field(default=())
    """Whether the body has each of the k landmarks."""
    parents: tuple[int, ...] = static_field(default=())
    """Parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field(default=())
    """Names of the j joints."""
    movers: tuple[int, ...] = static_field(default=())
    """Indices of the joints whose turning moves a landmark."""
    placed: tuple[PlacedLandmark, ...] = static_field(default=())
    """The landmarks whose places a fit may move, in the order of their points."""

    def moved(self, offsets: Float[Array, "g 3"]) -> "LandmarkModel":
        """Returns the model with its placed landmarks moved, each group by its offset.

        offsets: (g, 3), metres in T-pose, of the left landmark of a pair, or of the landmark in the
        middle.
        """
        if not self.placed:
            return self
        _, groups, sides = np.asarray(self.placed).T
        own = offsets[groups] * np.stack([sides, np.ones_like(sides), np.ones_like(sides)], axis=-1)
        rest = self.points.rest.at[-len(groups) :].add(own)
        return replace(self, points=replace(self.points, rest=rest))

    def by_landmark(self, offsets: Float[Array, "g 3"]) -> Float[np.ndarray, "k 3"]:
        """Returns the offset of each landmark, (k, 3), from the offsets of the groups (g, 3).
        Landmarks that are not placed have 0.
        """
        found = np.zeros((len(self.names), 3))
        for landmark, group, side in self.placed:
            found[landmark] = np.asarray(offsets[group]) * (side, 1, 1)
        return found


LESS_CERTAIN = {"hip": 2.0, "shoulder": 1.5, "neck": 1.5, "mid_hip": 1.5, "ear": 1.5}
"""By kind of landmark, the factor by which its noise is larger than that of other landmarks,
because annotators disagree on the position. The weight of its error is 1 / factor.
"""


def usual_certainty(names: tuple[str, ...]) -> Float[np.ndarray, " k"]:
    """Returns the weight of each landmark's error, (k,), in (0, 1], see `LESS_CERTAIN`."""
    return np.asarray([1 / LESS_CERTAIN.get(kind_of(name), 1.0) for name in names], np.float32)


def kind_of(name: str) -> str:
    """Returns the landmark's name without its side: "hip" for "left_hip"."""
    if name.startswith(("left_", "right_")):
        return name.split("_", 1)[1]
    return name


@checked_arguments
def landmark_model(
    body: BodyModel,
    names: tuple[str, ...],
    places: tuple[LandmarkDefinition, ...] = (),
    certainty: tuple[float, ...] = (),
) -> LandmarkModel:
    """Returns a model of the named landmarks of a body. Landmarks that the body lacks get rows of
    zeros. Without names, the model has only the joints.

    Arguments: places: definitions of landmarks that are elsewhere than this module says. A
    definition is ignored where the body lacks what it depends on. certainty: weight of each
    landmark's error, in the order of `names`; if empty, `usual_certainty` is taken.
    Raises: ValueError if the body has none of the landmarks, for example because its joints do not
    have SMPL-X's names.
    """
    finder = _Finder(body)
    # where each landmark is: at a place that the caller gives, or at the mean of its sources
    placed = {
        place.name: place
        for place in places
        if finder.find(place.base) and finder.has(place.joints) and place.name in names
    }
    sources = {name: [] if name in placed else finder.find(name) for name in names}
    known = tuple(bool(sources[name]) or name in placed for name in names)
    if names and not any(known):
        raise ValueError(
            f"body '{body.name}' has none of these landmarks: are its joints named like SMPL-X's"
            f" (left_hip, ...)? They are {', '.join(body.joint_names[:4]) or 'not named'}"
        )

    # the surface's points: vertices that are sources, then the places in the order of landmarks
    vertices = sorted({source for found in sources.values() for source in found if source >= 0})
    order = [name for name in names if name in placed]
    beside = tuple(
        _Beside(
            tuple(finder.find(placed[name].base)),
            tuple(finder.index[joint] for joint in placed[name].joints),
            placed[name].offset,
        )
        for name in order
    )
    joint_places, joint_directions, points = _on_the_body(body, tuple(vertices), beside)

    # the weights of joints, vertices and places in each landmark
    joints = len(body.parents)
    regressor = np.zeros((len(names), joints + len(vertices) + len(order)), np.float32)
    for row, name in zip(regressor, names, strict=True):
        for source in sources[name]:
            column = -1 - source
            if source >= 0:
                column = joints + vertices.index(source)
            row[column] += 1 / len(sources[name])
        if name in placed:
            row[joints + len(vertices) + order.index(name)] = 1.0

    used = np.any(regressor[:, :joints], axis=0)
    return LandmarkModel(
        joints=joint_places,
        joint_directions=joint_directions,
        points=points,
        regressor=jnp.asarray(regressor),
        certainty=jnp.asarray(certainty or usual_certainty(names), jnp.float32),
        names=names,
        known=known,
        parents=body.parents,
        joint_names=body.joint_names,
        movers=_movers(body.parents, used, np.asarray(points.weights)),
        placed=_grouped(names, order),
    )


def _grouped(names: tuple[str, ...], placed: Sequence[str]) -> tuple[PlacedLandmark, ...]:
    """Returns the placed landmarks with their groups. A left landmark and its mirror image share a
    group.
    """
    pairs = [name if side_of(name) > 0 else mirrored_name(name) for name in placed]
    groups = sorted(set(pairs))
    return tuple(
        PlacedLandmark(names.index(name), groups.index(pair), side_of(name))
        for name, pair in zip(placed, pairs, strict=True)
    )


def _regressed(body: BodyModel, values: Float[Array, "n *b"]) -> Float[Array, "j *b"]:
    """Returns a quantity at the joints, (j, ...), from its values at the vertices, (n, ...). The
    quantity has to be linear in the vertices.
    """
    return jnp.einsum("jn,n...->j...", body.joint_regressor, values, precision=EXACT)


def _rows(points: SurfacePoints, rows: Sequence[int]) -> SurfacePoints:
    """Returns the points whose numbers are `rows`, in this order."""
    return jax.tree.map(lambda leaf: leaf[np.asarray(rows, np.int32)], points)


def _joint_point(body: BodyModel, joint: int) -> SurfacePoints:
    """Returns one joint as a point of the surface, with the skinning weight 1 for this joint."""
    row = body.joint_regressor[joint : joint + 1]

    def product(values):
        return jnp.einsum("jn,n...->j...", row, values, precision=EXACT)

    return SurfacePoints(
        product(body.template),
        product(body.shape_directions),
        None if body.pose_directions is None else jnp.zeros_like(body.pose_directions[:1]),
        jnp.zeros_like(body.skinning_weights[:1]).at[0, joint].set(1.0),
    )


class _Beside(NamedTuple):
    """The place of a landmark that has a definition."""

    sources: tuple[int, ...]
    """Vertices, and joints j as -1 - j, whose mean the place starts from."""
    joints: tuple[int, ...]
    """Indices of the joints that carry the place. Empty: the joints that carry its sources."""
    offset: tuple[float, float, float]
    """Vector from the mean to the place, in the axes of the body at rest, metres."""


def _placed(body: BodyModel, place: _Beside) -> SurfacePoints:
    """Returns one point at an offset from the mean of the sources of a landmark. Shape coefficients
    move the point as they move this mean. The point turns with the joints of the place.
    """
    every = surface_points(body)
    points = [
        _rows(every, [source]) if source >= 0 else _joint_point(body, -1 - source)
        for source in place.sources
    ]
    mean = jax.tree.map(lambda leaf: leaf.mean(axis=0, keepdims=True), _concatenated(points))
    weights = mean.weights
    if place.joints:
        carriers = np.asarray(place.joints)
        weights = jnp.zeros_like(weights).at[0, carriers].set(1 / len(carriers))
    return replace(mean, rest=mean.rest + jnp.asarray(place.offset, jnp.float32), weights=weights)


@compiled(static=["vertices", "places"])
def _on_the_body(
    body: BodyModel, vertices: tuple[int, ...], places: tuple[_Beside, ...]
) -> tuple[Float[Array, "j 3"], Float[Array, "j 3 s"], SurfacePoints]:
    """Returns the joints at rest, their shape directions, and the points of these vertices and
    places.

    It is one jitted program, because eager JAX would compile dozens of small ones.
    """
    points = [_rows(surface_points(body), vertices)]
    points += [_placed(body, place) for place in places]
    return (
        _regressed(body, body.template),
        _regressed(body, body.shape_directions),
        _concatenated(points),
    )


def _concatenated(points: Sequence[SurfacePoints]) -> SurfacePoints:
    """Joins several records of points into one."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *points)


def pose_landmarks(
    model: LandmarkModel, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Returns landmarks (k, 3) and joints (j, 3) of a person in a pose, metres.

    Landmarks that the body lacks are at the origin. The pose's expression is ignored.
    """
    transforms, joints = pose_joints(model, betas, pose)
    posed = pose_points(model.points, betas, pose_features(pose.rotations), transforms)
    return landmarks_from(model, joints, posed), joints


def pose_joints(
    model: LandmarkModel, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "j 4 4"], Float[Array, "j 3"]]:
    """Returns the transforms of the joints from rest, (j, 4, 4), and the posed joints, (j, 3),
    metres. The pose's expression is ignored.
    """
    rest = shaped(model.joints, model.joint_directions, betas)
    transforms = joint_transforms(rest, model.parents, pose.rotations, pose.translation)
    return transforms, transform.apply(transforms, rest)


def landmarks_from(
    model: LandmarkModel, joints: Float[Array, "j 3"], points: Float[Array, "p 3"]
) -> Float[Array, "k 3"]:
    """Returns the landmarks (k, 3) of posed joints (j, 3) and posed points (p, 3), metres."""
    return jnp.matmul(model.regressor, jnp.concatenate([joints, points]), precision=EXACT)


def _movers(
    parents: tuple[int, ...],
    joints_used: Bool[np.ndarray, " j"],
    point_weights: Float[np.ndarray, "p j"],
) -> tuple[int, ...]:
    """Returns the indices of the joints whose rotation moves a used joint or a point.

    These are the joints that carry a point with a weight above 0.1, the ancestors of these joints,
    and the ancestors of used joints. A used joint does not count itself, because a joint does not
    move when it turns.

    Arguments: joints_used: whether a landmark uses each joint, (j,). point_weights: skinning
    weights of the points, (p, j).
    """
    moving = point_weights.max(axis=0, initial=0.0) > 0.1  # less is hardly seen
    for j in np.flatnonzero(joints_used | moving):
        parent = parents[j]
        while parent >= 0:
            moving[parent] = True
            parent = parents[parent]
    return tuple(int(j) for j in np.flatnonzero(moving))


Score = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
"""A function from positions (n, 3) to scores (n,). The best position has the largest score."""


class _Finder:
    """Finds the sources of landmarks on one body. A source is the number of a vertex, or -1 - j for
    joint j.
    """

    def __init__(self, body: BodyModel) -> None:
        self.template = np.asarray(body.template, np.float64)
        self.weights = np.asarray(body.skinning_weights)
        self.joints = np.asarray(body.joint_regressor, np.float64) @ self.template
        self.index = {name: j for j, name in enumerate(body.joint_names)}

    def has(self, joints: tuple[str, ...]) -> bool:
        """Says whether the body has these joints."""
        return all(name in self.index for name in joints)

    def find(self, name: str) -> list[int]:
        """Returns the sources whose mean is the landmark. The list is empty if the body lacks the
        landmark.
        """
        try:
            return self._find(name)
        except (KeyError, ValueError):  # a joint that it lacks, or no vertex where a rule looks
            return []

    def _find(self, name: str) -> list[int]:
        """Returns the sources of a landmark. Raises: KeyError, ValueError if the body lacks the
        landmark.
        """

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
        """Returns the vertices whose skinning weights for these joints sum to more than 0.5. Joints
        that the body lacks are left out.
        """
        present = [self.index[name] for name in joints if name in self.index]
        return np.flatnonzero(self.weights[:, present].sum(1) > 0.5)

    def _best(self, vertices: Int[np.ndarray, " n"], score: Score) -> int:
        """Returns the number of the vertex with the largest score, out of `vertices`."""
        return int(vertices[np.argmax(score(self.template[vertices]))])

    def _eyes(self) -> Float[np.ndarray, "3"]:
        """Returns the point midway between the eyes, (3,), metres."""
        return self.joints[[self.index["left_eye"], self.index["right_eye"]]].mean(0)

    def _head(self, low: float, high: float) -> Int[np.ndarray, " n"]:
        """Returns the vertices of the head between two heights, metres."""
        head = self._segment("head", "jaw")
        height = self.template[head, 1]
        return head[(height > low) & (height < high)]

    def _on_midline(self, score: Score, highest: float = np.inf) -> int:
        """Returns the number of the vertex with the largest score among vertices at the front of
        the head, within 6 mm of the middle and below `highest` metres.
        """
        head = self._segment("head", "jaw")
        p = self.template[head]
        front = p[:, 2] > 0.5 * (self._eyes()[2] + p[:, 2].max()) - 0.02
        middle = np.abs(p[:, 0]) < 0.006
        return self._best(head[front & middle & (p[:, 1] < highest)], score)
