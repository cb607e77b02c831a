"""Face and hands of a person that BlazePose has found: scores of ARKit's shapes, and 21 landmarks a
hand, by mediapipe's networks in LiteRT.

Each is looked at twice: in the region that BlazePose's landmarks say, and in the one that the first
look says, as mediapipe does from one frame of a video to the next. Regions follow its graphs of
faces and hands: a square, turned upright.
"""

from typing import NamedTuple

import numpy as np

from humangs_jax.capture.detection.people import Crop, load_networks, outputs_of, sampled
from humangs_jax.core.array_types import Float
from humangs_jax.motion.face_tracks import ARKIT

_FACE_SIZE = 256
"""Pixels a side of the network of faces."""
_HAND_SIZE = 224
"""Pixels a side of the network of hands."""
_HAND_POINTS = 21
"""Landmarks of a hand."""
_LEAST_PRESENCE = 0.5
"""Probability of a face or a hand from which on it is believed."""
_ENLARGED = {"face": 1.5, "palm": 2.0}
"""Side of a region over that of the box around the landmarks."""
_HAND_REGIONS = (1.9, 2.7)
"""Sides of the regions in which a hand is looked for, one after the other, over twice the length
from the wrist to the knuckles. 2.7 is mediapipe's; of 54 hands of synthetic people that are in view
it finds 35, 1.9 finds 47, both find 51. A hand that points at the camera needs the larger one.
"""
PALM = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)
"""Landmarks of a hand that say where it is in the next look: fingers move, the palm less."""
SMALLEST = 24.0
"""Pixels. In a smaller region faces and hands are not looked for."""
SHAPE_NAMES = ARKIT[:-1]
"""Of the scores: all of ARKit's but the tongue's."""
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
"""Indices of the face's landmarks that the network of the scores reads."""
_EYES, _MOUTH, _WRISTS = (2, 5), (9, 10), (15, 16)
"""Landmarks of BlazePose: eyes, the corners of the mouth, and the wrists, the left one first."""
_EYE_CORNERS, _WRIST, _ROOTS = (33, 263), 0, (5, 9, 13)
"""Of a face, in the photo from left to right; of a hand, and the roots of its fingers."""


class Hand(NamedTuple):
    """A hand in a photo."""

    pixels: Float[np.ndarray, "21 2"]
    """Landmarks, pixels, the centre of the first at 0: wrist, then thumb to little finger, each
    from the palm outwards."""
    world: Float[np.ndarray, "21 3"]
    """Metres from the wrist in the camera's axes (x right, y down, z away)."""
    presence: float
    """Probability of a hand."""


class FaceAndHands:
    """The networks. Raises: ImportError, saying what to install, without LiteRT."""

    def __init__(self) -> None:
        names = "face_landmarks_detector", "face_blendshapes", "hand_landmark_full"
        files = [f"{name}.tflite" for name in names]
        self._face, self._shapes, self._hand = load_networks("mediapipe", files)

    def face(
        self, photo: Float[np.ndarray, "h w 3"], body: Float[np.ndarray, "33 2"]
    ) -> Float[np.ndarray, "51"] | None:
        """The scores of `SHAPE_NAMES` of somebody with these landmarks of BlazePose, pixels, in a
        photo with values in [0, 1]; None where no face is seen.
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
        """The left and the right hand of somebody with these landmarks of BlazePose."""
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
        """Returns the hand of a side from the first region that shows one, or None."""
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
    """Pixels, presence and places of the left and the right hand, which begin at the wrists of
    BlazePose's body in space; 0 for a hand that was not seen, None for neither.
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
    """By how much what points to the right in an upright region is turned clockwise."""
    return float(np.arctan2(across[1], across[0]))


def face_region(body: Float[np.ndarray, "33 2"]) -> Crop:
    """Where the face of somebody with these landmarks of BlazePose is looked for."""
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
    """Returns the square in which a hand of somebody with these landmarks of BlazePose is looked
    for. side: 0 for the left hand, 1 for the right one. enlarged: see `_HAND_REGIONS`.
    """
    # the little finger and the index finger, of each side
    knuckles = ((17, 19), (18, 20))
    pinky, index = body[list(knuckles[side])]
    middle, wrist = (2 * index + pinky) / 3, body[_WRISTS[side]]
    x, y = middle - wrist
    # fingers point up
    return Crop(middle, 2 * enlarged * float(np.hypot(x, y)), float(np.arctan2(x, -y)))


def _palm_region(points: Float[np.ndarray, "21 2"]) -> Crop:
    """The region of the next look, from the landmarks of this one."""
    index, middle, ring = points[list(_ROOTS)]
    x, y = ((index + ring) / 2 + middle) / 2 - points[_WRIST]
    crop = _around(points[list(PALM)], float(np.arctan2(x, -y)), _ENLARGED["palm"])
    # moved from the palm to the fingers by a tenth of the side
    up = np.asarray([0.0, -0.1 * crop.side / _ENLARGED["palm"]])
    return crop._replace(center=crop.center + crop.turn @ up)


def _around(points: Float[np.ndarray, "n 2"], angle: float, enlarged: float) -> Crop:
    """The square around points, enlarged, that is turned by an angle."""
    turned = Crop(np.zeros(2), 1.0, angle)
    own = points @ turned.turn
    low, high = own.min(0), own.max(0)
    return Crop((low + high) / 2 @ turned.turn.T, enlarged * float((high - low).max()), angle)
