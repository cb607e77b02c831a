"""OpenPose's --write_json: NAME_keypoints.json, {people: [{pose_keypoints_2d, hand_left_keypoints_2d, ...}]}, a file an image.

RTMPose's 17, 26, 133 or 136 points, in one list, come in the same form (Pose2Sim, RTMLib).
"""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, expect, members
from humangs_jax.data.formats import SourceFormat
from humangs_jax.data.keypoints.keypoints import DetectedImage, Detections, Source, triples
from humangs_jax.data.keypoints.sets import OPENPOSE_67, SETS_BY_COUNT

SUFFIX = "_keypoints"
"""What OpenPose adds to the name of the image."""
PARTS = {"pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21}
"""The face, if it is there, is not read."""
OTHER_MODELS = {18: "COCO", 15: "MPI", 135: "BODY_135"}
"""By their number of points."""


def recognizes(source: Source) -> bool:
    """Whether a file is a JSON object with people."""
    return isinstance(source.json, dict) and "people" in source.json


def read(source: Source, format: SourceFormat) -> Detections:
    """The people of one image. Raises: CaptureError."""
    (entries,) = members(source.json, source.path, people=list)
    people = [_person(entry, source.path, f"people[{i}]") for i, entry in enumerate(entries)]
    kind = next((SETS_BY_COUNT[len(each)] for each in people if len(each) in SETS_BY_COUNT), OPENPOSE_67)
    if odd := [i for i, each in enumerate(people) if len(each) != len(kind.names)]:
        raise CaptureError(source.path, f"people[{odd[0]}]", f"not of the {kind.name} points of another person")
    image = DetectedImage(source.name.removesuffix(SUFFIX), source.path, tuple(people))
    return Detections(kind if people else None, (image,))


def _person(person: Any, file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    (body,) = members(person, file, field, pose_keypoints_2d=list)
    if len(body) % 3 == 0 and len(body) // 3 in SETS_BY_COUNT:
        return triples(body, file, f"{field}.pose_keypoints_2d")
    return np.concatenate([_part(person.get(key, []), file, f"{field}.{key}", n) for key, n in PARTS.items()])


def _part(values: Any, file: Path, field: str, count: int) -> Float[np.ndarray, "k 3"]:
    """The points of the body or of a hand; an empty list means that it was not detected."""
    if not expect(values, list, file, field):
        return np.zeros((count, 3))
    found = len(values) // 3
    if count != 21 and found in OTHER_MODELS:
        problem = f"the {found} points of the model {OTHER_MODELS[found]}: expected BODY_25 (--model_pose BODY_25)"
        raise CaptureError(file, field, problem)
    return triples(values, file, field, count)
