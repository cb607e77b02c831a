"""Matches the people in photos: decides which people in different photos are the same person.

In the simplest case each photo shows one large person, who is the same everywhere. Where several
are large and cameras are calibrated, people of one moment are matched by how well their landmarks
triangulate. From one moment to the next, people are matched by their place in space, or else by
their place in the photos of one camera. Without calibrated cameras nothing decides who of several
large people is who. Colors are no proof, since photos may be exposed differently. Somebody who was
matched to nobody may still be the person. Only somebody who is in a photo together with the person
is surely somebody else.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from humangs_jax.capture.fitting.triangulation import (
    Seen,
    comparable,
    in_order_of_time,
    match_people,
)
from humangs_jax.capture.keypoints.formats import SeenPerson
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33
from humangs_jax.core.array_types import Bool, Float, Int, UInt
from humangs_jax.geometry.camera import Camera

_RIVAL = 0.35
"""Least area of a rival, as a share of the area of the largest person. A rival could be the
intended person, too.
"""


class PersonInPhoto(NamedTuple):
    """A person who was found in a photo."""

    person: SeenPerson
    """Landmarks in pixels of the photo and in metres, with their visibility."""
    mask: UInt[np.ndarray, "h w"]
    """The person's mask, (h, w), 0 to 255, in the part of the photo that begins at `corner`."""
    corner: tuple[int, int]
    """Row and column of the first pixel of the mask in the photo."""
    area: float
    """Number of pixels of the person. If other people may cover the person, it is at least a tenth
    of the area of the detector's crop. That is about the area of a person who stands free.
    """
    mirrored: bool = False
    """Whether the detector exchanged left and right of the landmarks, as other views showed. The
    landmarks here are corrected.
    """
    apart: bool = False
    """Whether the landmarks contradict the landmarks in other photos of the same moment. Then the
    camera is off, or this is somebody else.
    """
    covered: bool = False
    """Whether other people may stand in front of this person."""


@dataclasses.dataclass(frozen=True, eq=False)
class PhotoPeople:
    """A photo, and the people who were found in it."""

    name: str
    """Name of the photo's file."""
    size: tuple[int, int]
    """Width and height of the photo, pixels."""
    thumbnail: Float[np.ndarray, "h w 3"]
    """The reduced photo for the sheet, (h, w, 3), 0 to 1."""
    people: tuple[PersonInPhoto | None, ...]
    """The people by their number, which is the same in all photos. None for people who are not in
    this photo.
    """
    known: bool = True
    """Whether equal numbers mean the same person. False if several people of this photo are large
    and nothing shows who they are in other photos. Then numbers only follow size.
    """


def inside_photo(
    x: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], width: int, height: int
) -> Bool[np.ndarray, " n"]:
    """Returns which pixels (x, y) lie in a photo of this size, (n,)."""
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def same_people(
    photos: Sequence[PhotoPeople],
    cameras: Camera | None = None,
    frames: Sequence[int] | None = None,
) -> list[PhotoPeople]:
    """Orders the people of each photo so that the i-th is the same person in all photos. The first
    is the person with the most pixels in all photos together.

    Arguments: cameras: a batch with the camera of each photo. None: not known; then people are in
    the order of size, see `PhotoPeople.known`. frames: the moment of each photo. None: all photos
    are of one moment.
    """
    if cameras is not None and len(photos) > 1:
        moments = np.asarray([0] * len(photos) if frames is None else frames)
        rows = _with_only_ones(_matched(photos, cameras, moments), moments)
    else:
        rows = [list(photo.people) for photo in photos]
        # of one photo the numbers say who is who
        known = [len(photos) == 1 or len(_large(row)) < 2 for row in rows]
        photos = [
            dataclasses.replace(photo, known=sure)
            for photo, sure in zip(photos, known, strict=True)
        ]
    most = max((len(row) for row in rows), default=0)
    ordered = [
        dataclasses.replace(photo, people=(*row, *[None] * (most - len(row))))
        for photo, row in zip(photos, rows, strict=True)
    ]
    order = np.argsort([-area for area in _areas(ordered)], kind="stable")
    order = [i for i in order if any(photo.people[i] is not None for photo in ordered)]
    return [
        dataclasses.replace(photo, people=tuple(photo.people[i] for i in order))
        for photo in ordered
    ]


def _large(people: Sequence[PersonInPhoto | None]) -> list[int]:
    """Returns the indices of the people of a photo who are large enough to be the intended
    person.
    """
    areas = [0.0 if each is None else each.area for each in people]
    return [
        i for i, each in enumerate(people) if each is not None and areas[i] > _RIVAL * max(areas)
    ]


def _areas(photos: Sequence[PhotoPeople]) -> list[float]:
    people = zip(*(photo.people for photo in photos), strict=True)
    return [sum((found.area for found in person if found is not None), 0.0) for person in people]


Row = list[PersonInPhoto | None]
"""The people of one photo. The index is the number of the person; None for people not in the photo.
"""


def _matched(
    photos: Sequence[PhotoPeople], cameras: Camera, frames: Int[np.ndarray, " v"]
) -> list[Row]:
    """Returns one row for each photo. Equal indices mean the same person in all rows, as far as
    cameras and times show it. frames: the moment of each photo, (v,).
    """
    K, transforms = (np.asarray(x, np.float64) for x in (cameras.K, cameras.cam_from_world))
    points = [
        tuple(each.person.points for each in photo.people if each is not None) for photo in photos
    ]
    times = [np.flatnonzero(frames == frame) for frame in np.unique(frames)]
    shown = [[Seen(K[v], transforms[v], points[v]) for v in own] for own in times]
    matches = [match_people(views, MEDIAPIPE_33.mirror) for views in shown]
    rows: list[Row] = [[] for _ in photos]
    for own, people in zip(times, in_order_of_time(matches, shown), strict=True):
        for match in people:
            for i, v in enumerate(own):
                member = None if match is None else match.members[i]
                found = None
                if member is not None:
                    found = photos[v].people[member]
                mirrored = found is not None and match is not None and match.mirrored[i]
                rows[v].append(exchanged(found) if mirrored else found)
    return rows


def _with_only_ones(rows: list[Row], frames: Int[np.ndarray, " v"]) -> list[Row]:
    """Takes all people who are the only large person of their photo for one person, even if they
    were not matched. Returns the rows in which these people are joined. Returns the given rows if
    nobody is joined.

    Two people who are in one photo together are not joined. If somebody else would still be large,
    nobody is joined, because a person who is alone in a photo could then be either of the two.
    """
    alone = {large[0] for large in map(_large, rows) if len(large) == 1}
    if not alone:
        return rows
    totals = [
        sum(each.area for each in person if each is not None) for person in zip(*rows, strict=True)
    ]
    first, *others = sorted(alone, key=lambda i: -totals[i])
    joined, source = [list(row) for row in rows], [first] * len(rows)
    for i in others:
        if any(row[first] is not None and row[i] is not None for row in joined):
            continue
        for v, row in enumerate(joined):
            if row[i] is not None:
                row[first], row[i], source[v] = row[i], None, i
        totals[first], totals[i] = totals[first] + totals[i], 0.0
    if any(total > _RIVAL * totals[first] for i, total in enumerate(totals) if i != first):
        return rows
    return _with_those_apart(joined, first, np.asarray(source), frames)


def _with_those_apart(
    rows: list[Row], person: int, source: Int[np.ndarray, " v"], frames: Int[np.ndarray, " v"]
) -> list[Row]:
    """Marks photos in which the joined person does not fit the other photos of the moment, see
    `PersonInPhoto.apart`. Changes the rows in place and returns them.

    Arguments: person: number of the joined person. source: the number that this person had in each
    photo before, (v,). frames: the moment of each photo, (v,).
    """
    for frame in np.unique(frames):
        own = [int(v) for v in np.flatnonzero(frames == frame) if rows[v][person] is not None]
        numbers, counts = np.unique(source[own], return_counts=True)
        most = numbers
        if len(own):
            most = numbers[counts == counts.max()]
        for v in own:
            others = [rows[w][person] for w in own if source[w] != source[v]]
            points = [each.person.points for each in others if each is not None]
            mine = rows[v][person]
            assert mine is not None
            if (len(most) > 1 or source[v] != most[0]) and any(
                comparable(mine.person.points, each) for each in points
            ):
                rows[v][person] = mine._replace(apart=True)
    return rows


def exchanged(found: PersonInPhoto) -> PersonInPhoto:
    """Exchanges left and right in the landmarks and hands of a person, and marks the person as
    mirrored.
    """
    order = np.asarray(MEDIAPIPE_33.mirror)
    person = dataclasses.replace(
        found.person,
        points=found.person.points[order],
        world=found.person.world[order],
        hands=None if found.person.hands is None else np.roll(found.person.hands, 21, axis=0),
    )
    return found._replace(person=person, mirrored=True)


def rivals(photos: Sequence[PhotoPeople]) -> list[int]:
    """Returns the numbers of the people, other than number 0, who could be the intended person as
    well. Their pixels in all photos together decide.
    """
    areas = _areas(photos)
    return [i for i in range(1, len(areas)) if areas[i] > _RIVAL * areas[0]]


def is_unclear(photos: Sequence[PhotoPeople], photo: int, person: int) -> bool:
    """Returns whether it is unclear who in a photo is the person.

    This is so if equal numbers of people need not mean the same person in this photo
    (`PhotoPeople.known` is False). It is also so if the person was not found in the photo, and
    somebody large is in it who is in no photo together with the person.
    """
    people = photos[photo].people
    if not photos[photo].known:
        return True
    if people[person] is not None:
        return False
    shown_with = [
        i
        for each in photos
        if each.people[person] is not None
        for i, one in enumerate(each.people)
        if one is not None
    ]
    return any(i not in shown_with for i in _large(people))
