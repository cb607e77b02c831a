"""Places on the body where a detector puts its landmarks, if these are not those of `body.landmarks`."""

from typing import NamedTuple

Millimetres = tuple[float | int, float | int, float | int]


class Place(NamedTuple):
    """Where a detector sees one of its landmarks.

    name: of the landmark. base: the landmark of `body.landmarks` that it is measured from. offset: from there, metres in T-pose:
    x to the person's left, y up, z to the front. joints: whose turning carries the offset along, by equal shares; none: what
    carries the base, which then is a vertex.
    """

    name: str
    base: str
    offset: tuple[float, float, float]
    joints: tuple[str, ...] = ()


def place(name: str, base: str, joints: tuple[str, ...], millimetres: Millimetres) -> Place:
    """A landmark whose offset is in millimetres."""
    x, y, z = millimetres
    return Place(name, base, (x / 1000, y / 1000, z / 1000), joints)


def both_sides(
    names: tuple[str, str], base: str, joints: tuple[str, ...], millimetres: Millimetres
) -> tuple[Place, Place]:
    """A landmark of the left side and its mirror image.

    Arguments: names: of the left and the right one. base, joints: with {side} for the side. millimetres: the left one's.
    """
    x, y, z = millimetres
    left, right = (
        place(name, base.format(side=side), tuple(joint.format(side=side) for joint in joints), (sign * x, y, z))
        for name, side, sign in zip(names, ("left", "right"), (1, -1), strict=True)
    )
    return left, right
