"""Finds our joints in a file's skeleton: by known names, or else by the tree of the joints.

In the tree, two limbs with similar bones that hang on one joint are the legs, and two other limbs
further up the trunk are the arms. The chain that hangs between the arms ends in the head. A knee or
elbow is where the two main bones of a limb meet, see `_bends`. Names or places tell left from
right.
"""

import re
from collections.abc import Sequence

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.geometry.mesh import unit
from humangs_jax.io.reading import InvalidFileError
from humangs_jax.motion.rules import (
    ENDS,
    EXPECTED_NAMES,
    FEW,
    FINGER_JOINT,
    LIKE,
    MIDDLE,
    NEEDED,
    NOISE,
    SIDED,
    SIDES,
    UNDER,
)

_SHOWN = 12
"""Largest number of joints' names in an error."""
_Places = Float[np.ndarray, "s 3"]
_Pair = tuple[list[int], list[int]]


def matched(
    names: Sequence[str], parents: Sequence[int], rest: _Places, posed: _Places
) -> dict[str, int]:
    """Returns, for each of our joints that the file has, the index of the file's joint.

    names, parents: names and parents of the file's joints. rest, posed: places of these joints in
    the rest pose and in the first frame, (s, 3).

    Raises: InvalidFileError if neither names nor the tree show all joints that are needed.
    """
    # by names first
    plain = _plain(names)
    source = _named(plain)
    hips = [source[name] for name in ("left_hip", "right_hip") if name in source][1:]
    if hips:
        _place_pelvis(source, parents, (source["left_hip"], *hips))
    # where names do not tell, the tree tells which joints are arms and legs
    if any(name not in source for name in NEEDED) or not _descends(source, parents):
        lengths = np.asarray(
            [0.0 if p < 0 else np.linalg.norm(rest[i] - rest[p]) for i, p in enumerate(parents)]
        )
        limbs = _limbs(plain, parents, lengths, posed)
        if limbs is None:
            missing = [name for name in NEEDED if name not in source]
            what = "joints that do not hang below each other"
            if missing:
                what = f"no joint for {', '.join(missing)}"
            found = ", ".join(names[:_SHOWN])
            raise InvalidFileError(f"{what}: {EXPECTED_NAMES}, got {found}")
        body = {
            f"{side}_{name}"
            for side in SIDES
            for name in ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
        }
        source = {
            name: i for name, i in source.items() if name not in body | {"pelvis", "neck", "head"}
        } | limbs
    # toes, head and spine follow from the rest
    _match_toes(source, parents, rest)
    _match_head(source, plain, parents)
    _match_spine(source, parents)
    return source


# Names
# --------------------------------------------------------------------------------------------------


def _plain(names: Sequence[str]) -> list[str]:
    """Simplifies names to lower-case letters and digits: "Model:Bip01_L_Thigh" is "lthigh".

    Words that say nothing about the joint are removed. A beginning that all names share is removed
    if there are at least `FEW` names. A name that begins with two underscores becomes "": MakeHuman
    puts such a joint, which never turns, above the joint of the same name.
    """
    plain = [re.sub(r"^.*[:|]", "", name).lower() for name in names]
    plain = [re.sub(r"(finger\d)-(?=\d)", rf"\1{FINGER_JOINT}", name) for name in plain]
    words = [[] if name.startswith("__") else re.findall(r"[a-z0-9]+", name) for name in plain]
    words = [[word for word in each if word not in NOISE] for each in words]
    plain = [re.sub(r"^mixamorig\d*", "", "".join(each)) for each in words]
    filled = [name for name in plain if name]
    start = next(
        (i for i, letters in enumerate(zip(*filled, strict=False)) if len(set(letters)) > 1), 0
    )
    return [name[start if len(filled) >= FEW else 0 :] for name in plain]


def _named(plain: Sequence[str]) -> dict[str, int]:
    """Returns the index of the file's joint for each of our joints that has a known name. Each
    joint of the file is taken once, by the first match.
    """
    source: dict[str, int] = {}

    def find(ours: str, theirs: Sequence[str]) -> None:
        taken = set(source.values())
        for name in theirs:
            index = plain.index(name) if name in plain else None
            if index is not None and index not in taken:
                source[ours] = index
                return

    for ours, theirs in MIDDLE.items():
        find(ours, theirs)
    for ours, theirs in SIDED.items():
        for side in SIDES:
            find(
                f"{side}_{ours}",
                [form for x in theirs for form in (side + x, side[0] + x, x + side[0], x + side)],
            )
    return source


def _ancestors(parents: Sequence[int], joint: int) -> list[int]:
    """Returns a joint and all joints above it, from the joint to the root."""
    found = []
    while joint >= 0 and len(found) <= len(parents):
        found.append(joint)
        joint = parents[joint]
    return found


def _place_pelvis(source: dict[str, int], parents: Sequence[int], hips: Sequence[int]) -> None:
    """Sets the pelvis to the lowest joint above both hips, unless the joint that is named as the
    pelvis is above both, too.
    """
    above = [_ancestors(parents, hip)[1:] for hip in hips]
    common = [joint for joint in above[0] if joint in above[1]]
    if common and source.get("pelvis") not in common:
        source["pelvis"] = common[0]


def _descends(source: dict[str, int], parents: Sequence[int]) -> bool:
    """Says whether the joints of limbs hang below each other as they should, see UNDER."""
    pairs = [(f"{side}_{a}", f"{side}_{b}") for a, b in UNDER for side in SIDES]
    return all(
        source[a] in _ancestors(parents, source[b])[1:]
        for a, b in pairs
        if a in source and b in source
    )


# The tree
# --------------------------------------------------------------------------------------------------


def _path(joint: int, children: list[list[int]], reach: np.ndarray) -> list[int]:
    path = [joint]
    while children[path[-1]]:
        path.append(max(children[path[-1]], key=lambda child: reach[child]))
    return path


def _limbs(
    plain: Sequence[str], parents: Sequence[int], lengths: np.ndarray, posed: _Places
) -> dict[str, int] | None:
    """Finds the joints of arms, legs and pelvis by the tree. Returns None if the tree does not look
    like a person.

    plain: simplified names. lengths: length of the bone above each joint, (s,). posed: places in
    the first frame, (s, 3).
    """
    children: list[list[int]] = [[] for _ in parents]
    for i, p in enumerate(parents):
        if p >= 0:
            children[p].append(i)
    # length of the longest way down from each joint
    reach = lengths.copy()
    for i in reversed(range(len(parents))):
        reach[i] += max((reach[child] for child in children[i]), default=0.0)

    def pair_below(joint: int) -> _Pair | None:
        """Returns `_bends` of two limbs below a joint: of all pairs with similar bones, the pair
        with the longest bones. None if there is no such pair.
        """
        paths = [_path(child, children, reach) for child in children[joint]]
        limbs = [limb for limb in (_bends(path, lengths) for path in paths) if limb]

        def bones(limb):
            return lengths[limb[1:3]]

        pairs = [
            (a, b)
            for i, a in enumerate(limbs)
            for b in limbs[:i]
            if np.abs(bones(a) - bones(b)).max() <= LIKE * max(bones(a).max(), bones(b).max())
        ]
        return max(
            pairs, key=lambda pair: bones(pair[0]).sum() + bones(pair[1]).sum(), default=None
        )

    # the pelvis carries two limbs, and above it, but not below its legs, the chest carries two more
    above = [_ancestors(parents, joint) for joint in range(len(parents))]
    pairs = [(joint, pair_below(joint)) for joint in range(len(parents))]
    found = [(joint, pair) for joint, pair in pairs if pair is not None]
    for pelvis, legs in found:
        feet = {leg[0] for leg in legs}
        inside = [
            each
            for each in found
            if pelvis in above[each[0]][1:] and not feet.intersection(above[each[0]])
        ]
        if inside:
            chest, arms = max(inside, key=lambda each: lengths[[*each[1][0][1:3]]].sum())
            return _sided(plain, parents, posed, pelvis, legs, chest, arms)
    return None


def _bends(path: list[int], lengths: np.ndarray) -> list[int] | None:
    """Returns the three joints of a limb where its two main bones begin, meet and end, and then the
    next joint if there is one.

    The main bones are consecutive. Among all pairs of consecutive bones they are the pair whose
    shorter bone is longest. Returns None if the limb has fewer than two bones, or if one of the
    main bones has no length.
    """
    bones = lengths[path[1:]]
    if len(bones) < 2:
        return None
    shorter = np.minimum(bones[1:], bones[:-1])
    first = int(np.argmax(shorter))
    if shorter[first] > 0:
        return [path[first], path[first + 1], path[first + 2], *path[first + 3 : first + 4]]
    return None


def _sided(
    plain: Sequence[str],
    parents: Sequence[int],
    posed: _Places,
    pelvis: int,
    legs: _Pair,
    chest: int,
    arms: _Pair,
) -> dict[str, int]:
    """Returns the joints of the pelvis and the limbs, by our names. Names or places tell left from
    right.
    """
    up = unit(posed[chest] - posed[pelvis])
    toes = [posed[leg[3]] - posed[leg[2]] for leg in legs if len(leg) > 3]
    forward = np.sum(toes, axis=0) if toes else np.array([0.0, 0, 1])
    left = np.cross(up, forward)
    source = {"pelvis": pelvis}
    for limbs, names in (
        (legs, ("hip", "knee", "ankle", "foot")),
        (arms, ("shoulder", "elbow", "wrist")),
    ):
        sides = [_side(plain, limb) for limb in limbs]
        if sorted(sides) != sorted(SIDES):
            across = [float(posed[limb[0]] @ left) for limb in limbs]
            if across[0] > across[1]:
                sides = ["left", "right"]
            else:
                sides = ["right", "left"]
        for side, limb in zip(sides, limbs, strict=True):
            source |= {f"{side}_{name}": joint for name, joint in zip(names, limb, strict=False)}
            above = parents[limb[0]]
            if limbs is arms and above != chest:
                source[f"{side}_collar"] = above
    return source


def _side(plain: Sequence[str], limb: Sequence[int]) -> str:
    """Returns "left" or "right" if the names of a limb's first three joints all begin or end with
    this word or its first letter, else "".
    """
    for side in SIDES:
        if all(
            plain[j].startswith((side, side[0])) or plain[j].endswith((side, side[0]))
            for j in limb[:3]
        ):
            return side
    return ""


# What follows from limbs
# --------------------------------------------------------------------------------------------------


def _match_toes(source: dict[str, int], parents: Sequence[int], rest: _Places) -> None:
    """Adds toes that have no known name: the joint below the ankle that is furthest from it."""
    for side in SIDES:
        ankle = source[f"{side}_ankle"]
        below = [
            i
            for i, p in enumerate(parents)
            if p == ankle and np.linalg.norm(rest[i] - rest[ankle]) > 0
        ]
        if f"{side}_foot" not in source and below:
            source[f"{side}_foot"] = max(
                below, key=lambda i: float(np.linalg.norm(rest[i] - rest[ankle]))
            )


def _match_head(source: dict[str, int], plain: Sequence[str], parents: Sequence[int]) -> None:
    """Adds neck and head, if neither is known, from the longest chain that hangs between the arms.

    The first joint is the neck, and the last one that is not the end of a bone is the head.
    """
    if "neck" in source or "head" in source:
        return
    arms = [_ancestors(parents, source[f"{side}_shoulder"])[1:] for side in SIDES]
    chest = next((joint for joint in arms[0] if joint in arms[1]), -1)
    below = [i for i, p in enumerate(parents) if p == chest and not any(i in arm for arm in arms)]
    below = [i for i in below if i not in source.values()]
    chains = []
    for i in below:
        chain = [i]
        children = [j for j, p in enumerate(parents) if p == i]
        while len(children) == 1:
            chain += children
            children = [j for j, p in enumerate(parents) if p == chain[-1]]
        while len(chain) > 1 and plain[chain[-1]].endswith(ENDS):
            chain.pop()
        chains.append(chain)
    if chains:
        chain = max(chains, key=len)
        source["neck"] = chain[0]
        if len(chain) > 1:
            source["head"] = chain[-1]


def _match_spine(source: dict[str, int], parents: Sequence[int]) -> None:
    """Adds the spine. Our three joints become the first, the middle and the last joint between the
    file's pelvis and neck.

    Files have one to five joints there, with different names in every program. If there are fewer
    than three, the last one is our third joint, and the first of two is our first.
    """
    chain = []
    if "neck" in source:
        at = parents[source["neck"]]
    elif "head" in source:
        at = parents[source["head"]]
    else:
        at = -1
    while at >= 0 and at != source.get("pelvis"):
        chain.insert(0, at)
        at = parents[at]
    last = len(chain) - 1
    if at >= 0:
        ours = {"spine3": last, "spine1": -1, "spine2": -1}
        if last > 0:
            ours["spine1"] = 0
        if last > 1:
            ours["spine2"] = last // 2
        source.update({name: chain[i] for name, i in ours.items() if i >= 0})
