"""Holds expressions over time, and converts the names of expressions in files to ARKit's shapes."""

import dataclasses
import re

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.reading import InvalidFileError

ARKIT = (
    "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight",
    "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "eyeBlinkLeft", "eyeBlinkRight",
    "eyeLookDownLeft", "eyeLookDownRight", "eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft",
    "eyeLookOutRight", "eyeLookUpLeft", "eyeLookUpRight", "eyeSquintLeft", "eyeSquintRight",
    "eyeWideLeft", "eyeWideRight", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose",
    "mouthDimpleLeft", "mouthDimpleRight", "mouthFrownLeft", "mouthFrownRight", "mouthFunnel",
    "mouthLeft", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthPressLeft", "mouthPressRight",
    "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower",
    "mouthShrugUpper", "mouthSmileLeft", "mouthSmileRight", "mouthStretchLeft",
    "mouthStretchRight", "mouthUpperUpLeft", "mouthUpperUpRight", "noseSneerLeft",
    "noseSneerRight", "tongueOut",
)  # fmt: skip
"""The names of ARKit's 52 shapes, in alphabetical order."""
PRESETS = {
    "happy": {"mouthSmile": 0.8, "cheekSquint": 0.5},
    "angry": {"browDown": 1.0, "mouthPress": 0.5, "noseSneer": 0.4},
    "sad": {"browInnerUp": 0.8, "mouthFrown": 0.7},
    "relaxed": {"mouthSmile": 0.4, "eyeBlink": 0.3},
    "surprised": {"browInnerUp": 0.8, "browOuterUp": 0.8, "eyeWide": 0.7, "jawOpen": 0.3},
    "aa": {"jawOpen": 0.6},
    "ih": {"jawOpen": 0.25, "mouthStretch": 0.3, "mouthSmile": 0.2},
    "ou": {"mouthPucker": 0.8, "jawOpen": 0.1},
    "ee": {"mouthSmile": 0.4, "mouthStretch": 0.4, "jawOpen": 0.15},
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.7},
    "blink": {"eyeBlink": 1.0},
    "blinkleft": {"eyeBlinkLeft": 1.0},
    "blinkright": {"eyeBlinkRight": 1.0},
    "neutral": {},
    "lookup": {"eyeLookUp": 1.0},
    "lookdown": {"eyeLookDown": 1.0},
    "lookleft": {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
    "lookright": {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
    # of VRM 0
    "joy": {"mouthSmile": 0.8, "cheekSquint": 0.5},
    "sorrow": {"browInnerUp": 0.8, "mouthFrown": 0.7},
    "fun": {"mouthSmile": 0.5},
    "a": {"jawOpen": 0.6},
    "i": {"jawOpen": 0.25, "mouthStretch": 0.3, "mouthSmile": 0.2},
    "u": {"mouthPucker": 0.8, "jawOpen": 0.1},
    "e": {"mouthSmile": 0.4, "mouthStretch": 0.4, "jawOpen": 0.15},
    "o": {"jawOpen": 0.4, "mouthFunnel": 0.7},
    "blink_l": {"eyeBlinkLeft": 1.0},
    "blink_r": {"eyeBlinkRight": 1.0},
}  # fmt: skip
"""For each preset of VRM, the weights of ARKit's shapes at a weight of 1. Names of presets are in
lower case. A shape without a side stands for both sides."""
FARTHEST = 10.0
"""Largest magnitude of a coefficient of a track. Shapes are made for 0 to 1, and components of
SMPL-X go up to about 3.
"""
_PLAIN = {name.lower(): name for name in ARKIT}


@dataclasses.dataclass(frozen=True)
class FaceTrack:
    """Expressions of a face in each of m frames."""

    names: tuple[str, ...]
    """Names of the e expressions."""
    values: Float[np.ndarray, "m e"]
    """Coefficients of the expressions, a row for each frame, (m, e)."""


def arkit_name(name: str) -> str | None:
    """Returns the name of ARKit's shape that a name in a file means; None for another name.

    A beginning before ".", ":" or "|" is ignored, "_L" and "_R" at the end stand for the sides, and
    only letters count, without case: "Blend.EyeBlink_L" is "eyeBlinkLeft".
    """
    plain = re.split(r"[.:|]", name)[-1]
    plain = re.sub(r"_l$", "left", re.sub(r"_r$", "right", plain.lower()))
    plain = re.sub(r"[^a-z]", "", plain)
    return _PLAIN.get(plain)


def of_preset(name: str) -> dict[str, float] | None:
    """Returns the weights of ARKit's shapes that a name stands for, by shape. The name may be a
    shape of ARKit, with the weight 1, or a preset of VRM. None for another name.
    """
    own = arkit_name(name)
    if own is not None:
        return {own: 1.0}
    shapes = PRESETS.get(name.lower())
    if shapes is None:
        return None
    found = {}
    for shape, weight in shapes.items():
        if shape in ARKIT:
            sides = [shape]
        else:
            sides = [f"{shape}Left", f"{shape}Right"]
        found |= dict.fromkeys(sides, weight)
    return found


def as_arkit(track: FaceTrack) -> tuple[FaceTrack | None, tuple[str, ...]]:
    """Converts a track to ARKit's shapes.

    Returns: the converted track, (m, 52), or None if none of the names is known; and the names that
    are neither shapes of ARKit nor presets.
    """
    values = np.zeros((len(track.values), len(ARKIT)))
    unknown = []
    known = False
    for name, column in zip(track.names, track.values.T, strict=True):
        shapes = of_preset(name)
        if shapes is None:
            unknown.append(name)
            continue
        known = True
        for shape, weight in shapes.items():
            values[:, ARKIT.index(shape)] += weight * column
    return (FaceTrack(ARKIT, values) if known else None), tuple(unknown)


def clipped(values: Float[np.ndarray, "m e"]) -> Float[np.ndarray, "m e"]:
    """Limits coefficients to the range from -1 to 2, because trackers overshoot.

    Values that are not finite stay.
    """
    return np.where(np.isfinite(values), np.clip(values, -1, 2), values)


def checked_track(
    track: FaceTrack, frames: int
) -> tuple[tuple[str, ...], Float[np.ndarray, "m e"]]:
    """Returns the names and the float32 values of a track.

    Raises: InvalidFileError if there is not one row for each frame and one column for each name, or
    if a number is not finite or is larger than FARTHEST in magnitude.
    """
    values = np.asarray(track.values, np.float64)
    if values.shape != (frames, len(track.names)):
        raise InvalidFileError(
            f"expressions: expected shape ({frames}, {len(track.names)}), a row for each frame, got"
            f" {values.shape}"
        )
    if not (np.isfinite(values).all() and np.abs(values).max(initial=0) <= FARTHEST):
        raise InvalidFileError(
            f"expressions: expected numbers between -{FARTHEST:g} and {FARTHEST:g}"
        )
    return track.names, values.astype(np.float32)
