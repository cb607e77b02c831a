"""OpenPose's JSON, one file per image or frame, as --write_json writes it (BODY_25, and hands with --hand)."""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.detections import DetectedImage, expect, triples

SUFFIX = "_keypoints"
"""What OpenPose adds to the name of the image."""
_PARTS = {"pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21}
_OTHER_MODELS = {18: "COCO", 15: "MPI", 135: "BODY_135"}


def openpose_image(content: dict[str, Any], file: Path, name: str) -> DetectedImage:
    """The people of one file; each (67, 3). The face, if it is there, is not read.

    Raises: CaptureError.
    """
    people = expect(content["people"], list, file, "people")
    return DetectedImage(
        name.removesuffix(SUFFIX), file, tuple(_person(person, file, f"people[{i}]") for i, person in enumerate(people))
    )


def _person(person: Any, file: Path, field: str) -> Float[np.ndarray, "67 3"]:
    expect(person, dict, file, field)
    if "pose_keypoints_2d" not in person:
        raise CaptureError(file, f"{field}.pose_keypoints_2d", "missing")
    return np.concatenate([_part(person.get(key, []), file, f"{field}.{key}", n) for key, n in _PARTS.items()])


def _part(values: Any, file: Path, field: str, count: int) -> Float[np.ndarray, "k 3"]:
    """The points of the body or of a hand; an empty list says that it was not looked for."""
    if not expect(values, list, file, field):
        return np.zeros((count, 3))
    other = _OTHER_MODELS.get(len(values) // 3)
    if count != 21 and other is not None:
        problem = f"the {len(values) // 3} points of the model {other}: expected BODY_25 (--model_pose BODY_25)"
        raise CaptureError(file, field, problem)
    return triples(values, file, field, count)
