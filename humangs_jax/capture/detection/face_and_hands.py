"""Finds the face and the hands of a person that BlazePose has found. For a face it returns scores
of ARKit's shapes, and for each hand 21 landmarks. The networks are mediapipe's, run by LiteRT.

The networks look twice at a face or a hand. The first region is computed from BlazePose's
landmarks, and the second from the landmarks that the first look found. Mediapipe does this from one
frame of a video to the next. Regions are squares, turned so that the face or the hand is upright,
as in mediapipe's graphs.
"""

from typing import NamedTuple

import numpy as np

from humangs_jax.capture.detection.people import Crop, load_networks, outputs_of, sampled
from humangs_jax.core.array_types import Float
from humangs_jax.motion.face_tracks import ARKIT

_FACE_SIZE = 256
"""Side of the face network's input, pixels."""
_HAND_SIZE = 224
"""Side of the hand network's input, pixels."""
_HAND_POINTS = 21
"""Number of landmarks of a hand."""
_LEAST_PRESENCE = 0.5
"""A face or a hand counts as found if the network gives it at least this probability."""
_ENLARGED = {"face": 1.5, "palm": 2.0}
"""Factors by which the bounding squares of the landmarks of a face and of a palm are enlarged to
regions.
"""
_HAND_REGIONS = (1.9, 2.7)
"""Sides of the two regions in which a hand is looked for. The second one is used if no hand is
found in the first. The unit is twice the length from the wrist to the knuckles.

Mediapipe uses 2.7. Of 54 visible hands of synthetic people, 35 are found with 2.7, 47 with 1.9, and
51 with both. A hand that points at the camera needs the larger region.
"""
PALM = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)
"""Indices of the hand landmarks from which the region of the next look is computed. They lie on the
palm and near it, because fingers move more.
"""
SMALLEST = 24.0
"""Faces and hands are looked for only in regions with at least this side, pixels."""
SHAPE_NAMES = ARKIT[:-1]
"""Names of the scores: all of ARKit's shapes except the tongue."""
SHAPE_POINTS = (
    0, 1, 4, 5, 6, 7, 8, 10, 13, 14, 17, 21, 33, 37, 39, 40, 46, 52, 53, 54, 55, 58, 61, 63,
    65, 66, 67, 70, 78, 80, 81, 82, 84, 87, 88, 91, 93, 95, 103, 105, 107, 109, 127, 132, 133,
    136, 144, 145, 146, 148, 149, 150, 152, 153, 154, 155, 157, 158, 159, 160, 161, 162, 163,
    168, 172, 173, 176, 178, 181, 185, 191, 195, 197, 234, 246, 249, 251, 263, 267, 269, 270,
    276, 282, 283, 284, 285, 288, 291, 293, 295, 296, 297, 300, 308, 310, 311, 312, 314, 317,
    318, 321, 323, 324, 332, 334, 336, 338, 356, 361, 362, 365, 373, 374, 375, 377, 378, 379,
    380, 381, 382, 384, 385, 386, 387, 388, 389, 390, 397, 398, 400, 402, 405, 409, 415, 454,
    466, 468, 469, 470, 471, 472, 473, 474, 475, 476, 477,
)  # fmt: skip
"""Indices of the face landmarks that are the input of the network for the scores."""
_EYES, _MOUTH, _WRISTS = (2, 5), (9, 10), (15, 16)
"""Indices of BlazePose's landmarks of the eyes, the corners of the mouth, and the wrists. In each
pair the left one comes first.
"""
_EYE_CORNERS, _WRIST, _ROOTS = (33, 263), 0, (5, 9, 13)
"""Indices of landmarks. `_EYE_CORNERS` are the outer corners of the right and the left eye in the
face. `_WRIST` and `_ROOTS` (index, middle and ring finger) are in the hand.
"""


class Hand(NamedTuple):
    """A hand in a photo."""

    pixels: Float[np.ndarray, "21 2"]
    """Landmarks, (21, 2), pixels, with the centre of the first pixel at 0. The wrist comes first,
    then thumb to little finger, each from the palm outwards.
    """
    world: Float[np.ndarray, "21 3"]
    """Landmarks relative to the wrist in the camera's axes (x right, y down, z away), (21, 3),
    metres.
    """
    presence: float
    """Probability of a hand."""


class FaceAndHands:
    """Runs mediapipe's networks for face landmarks, scores of face shapes, and hand landmarks.

    Raises: ImportError, which says what to install, if LiteRT is missing.
    """

    def __init__(self) -> None:
        names = "face_landmarks_detector", "face_blendshapes", "hand_landmark_full"
        files = [f"{name}.tflite" for name in names]
        self._face, self._shapes, self._hand = load_networks("mediapipe", files)

    def face(
        self, photo: Float[np.ndarray, "h w 3"], body: Float[np.ndarray, "33 2"]
    ) -> Float[np.ndarray, "51"] | None:
        """Returns the scores of `SHAPE_NAMES` for a person's face, (51,). None if no face is seen,
        or if its region is smaller than `SMALLEST`.

        photo: values in [0, 1]. body: BlazePose's landmarks of the person, (33, 2), pixels.
        """
        crop = face_region(body)
        for _ in range(2):
            if crop.side < SMALLEST:
                return None
            outputs = outputs_of(self._face, sampled(photo, crop, _FACE_SIZE))
            if _probability(outputs["Identity_1"]) < _LEAST_PRESENCE:
                return None
            landmarks = outputs["Identity"].reshape(-1, 3)  # 478 of them
            points = crop.to_photo(landmarks[:, :2] / _FACE_SIZE)
            right, left = points[list(_EYE_CORNERS)]
            crop = _around(points, _angle(left - right), _ENLARGED["face"])
        scores = next(iter(outputs_of(self._shapes, points[list(SHAPE_POINTS)]).values()))
        return np.asarray(scores, np.float32).ravel()[1:]  # the first is that of a neutral face

    def hands(
        self,
        photo: Float[np.ndarray, "h w 3"],
        body: Float[np.ndarray, "33 2"],
        visibility: Float[np.ndarray, " 33"],
    ) -> tuple[Hand | None, Hand | None]:
        """Returns the left and the right hand of a person. None stands for a hand that is not
        found, or whose wrist has a visibility below 0.5.

        photo: values in [0, 1]. body and visibility: BlazePose's landmarks of the person, (33, 2),
        pixels, and their visibilities, (33,).
        """
        found: list[Hand | None] = []
        for side, wrist in enumerate(_WRISTS):
            if visibility[wrist] < 0.5:  # hands of hidden wrists are not looked at
                found.append(None)
            else:
                found.append(self._found_hand(photo, body, side))
        left, right = found
        return left, right

    def _found_hand(
        self, photo: Float[np.ndarray, "h w 3"], body: Float[np.ndarray, "33 2"], side: int
    ) -> Hand | None:
        """Returns the left (side 0) or the right (side 1) hand, from the first region in which a
        hand is found. None if there is none.
        """
        for enlarged in _HAND_REGIONS:
            region = hand_region(body, side, enlarged)
            hand = self._hand_in(photo, region, body[_WRISTS[side]])
            if hand is not None:
                return hand
        return None

    def _hand_in(
        self, photo: Float[np.ndarray, "h w 3"], crop: Crop, wrist: Float[np.ndarray, "2"]
    ) -> Hand | None:
        first = crop
        for _ in range(2):
            if crop.side < SMALLEST:
                return None
            outputs = outputs_of(self._hand, sampled(photo, crop, _HAND_SIZE))
            presence = float(outputs["Identity_1"].ravel()[0])
            if presence < _LEAST_PRESENCE:
                return None
            points = outputs["Identity"].reshape(_HAND_POINTS, 3)[:, :2] / _HAND_SIZE
            world = outputs["Identity_3"].reshape(_HAND_POINTS, 3).astype(np.float64)
            world[:, :2] = world[:, :2] @ crop.turn.T
            points, crop = crop.to_photo(points), _palm_region(crop.to_photo(points))
        # a hand elsewhere is another one
        if np.hypot(*(points[_WRIST] - wrist)) > first.side / 3:
            return None
        return Hand(points, world - world[_WRIST], presence)


def hand_columns(
    hands: tuple[Hand | None, Hand | None], body: Float[np.ndarray, "33 3"]
) -> Float[np.ndarray, "42 6"] | None:
    """Returns the landmarks of both hands, (42, 6), first of the left and then of the right hand.
    The columns are x and y in pixels, the presence, and x, y and z in metres. The rows of a hand
    that was not found are 0. None if neither was found.

    body: BlazePose's landmarks in space, (33, 3), metres. In space, each hand is moved so that its
    wrist lies at the wrist of the body.
    """
    if hands == (None, None):
        return None
    found = np.zeros((2, _HAND_POINTS, 6))
    for row, hand, wrist in zip(found, hands, body[list(_WRISTS)], strict=True):
        if hand is not None:
            row[:, :2], row[:, 2], row[:, 3:] = hand.pixels, hand.presence, hand.world + wrist
    return found.reshape(-1, 6)


def _probability(logit: np.ndarray) -> float:
    return float(1 / (1 + np.exp(-np.clip(logit.ravel()[0], -80, 80))))


def _angle(across: Float[np.ndarray, "2"]) -> float:
    """Returns the angle of a region, clockwise, radians. across: direction of its x axis in the
    photo.
    """
    return float(np.arctan2(across[1], across[0]))


def face_region(body: Float[np.ndarray, "33 2"]) -> Crop:
    """Returns the square in which a person's face is looked for. body: BlazePose's landmarks of the
    person, (33, 2), pixels.
    """
    left, right = body[list(_EYES)]
    eyes, mouth = (left + right) / 2, body[list(_MOUTH)].mean(0)
    down = mouth - eyes
    # from the side the eyes are one behind the other: the mouth says the size and what is up
    size = max(float(np.hypot(*down)), float(np.hypot(*(left - right))))
    angle = float(np.arctan2(-down[0], down[1]))
    # the height of a face is 2.75 times the distance from the eyes to the mouth, its middle at
    # 0.4 of that
    return Crop(eyes + 0.4 * down, _ENLARGED["face"] * 2.75 * size, angle)


def hand_region(body: Float[np.ndarray, "33 2"], side: int, enlarged: float) -> Crop:
    """Returns the square in which a person's hand is looked for. body: BlazePose's landmarks of the
    person, (33, 2), pixels. side: 0 for the left hand, 1 for the right one. enlarged: see
    `_HAND_REGIONS`.
    """
    # the little finger and the index finger, of each side
    knuckles = ((17, 19), (18, 20))
    pinky, index = body[list(knuckles[side])]
    middle, wrist = (2 * index + pinky) / 3, body[_WRISTS[side]]
    x, y = middle - wrist
    # fingers point up
    return Crop(middle, 2 * enlarged * float(np.hypot(x, y)), float(np.arctan2(x, -y)))


def _palm_region(points: Float[np.ndarray, "21 2"]) -> Crop:
    """Returns the square in which the network looks at a hand the second time. points: landmarks
    that it found in the first look, (21, 2), pixels.
    """
    index, middle, ring = points[list(_ROOTS)]
    x, y = ((index + ring) / 2 + middle) / 2 - points[_WRIST]
    crop = _around(points[list(PALM)], float(np.arctan2(x, -y)), _ENLARGED["palm"])
    # moved from the palm to the fingers by a tenth of the side
    up = np.asarray([0.0, -0.1 * crop.side / _ENLARGED["palm"]])
    return crop._replace(center=crop.center + crop.turn @ up)


def _around(points: Float[np.ndarray, "n 2"], angle: float, enlarged: float) -> Crop:
    """Returns a square around points, (n, 2), pixels. It is the smallest square with the given
    angle (radians) that contains the points, but with its side multiplied by `enlarged`.
    """
    turned = Crop(np.zeros(2), 1.0, angle)
    own = points @ turned.turn
    low, high = own.min(0), own.max(0)
    return Crop((low + high) / 2 @ turned.turn.T, enlarged * float((high - low).max()), angle)
