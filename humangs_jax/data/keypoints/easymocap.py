"""EasyMocap's annots: {filename, height, width, annots: [{personID, keypoints, handl2d, handr2d}]}, a file an image.

The body is BODY_25 with both hands or without; 17, 26, 133 or 136 points are read, too.
"""

import numpy as np

from humangs_jax.data.capture_checks import CaptureError, file_numbers, members
from humangs_jax.data.formats import SourceFormat
from humangs_jax.data.keypoints.keypoints import DetectedImage, Detections, Source, detections_of
from humangs_jax.data.keypoints.sets import OPENPOSE_67

PARTS = {"keypoints": 25, "handl2d": 21, "handr2d": 21}
MOST_PEOPLE = 64
"""People are in the order of their IDs; beyond this many an ID is no count."""


def recognizes(source: Source) -> bool:
    """Whether a file is a JSON object with annots."""
    return isinstance(source.json, dict) and isinstance(source.json.get("annots"), list)


def read(source: Source, format: SourceFormat) -> Detections:
    """The people of one image: person I is the one with that personID, where these are small numbers. Raises: CaptureError."""
    content, file, people = source.json, source.path, {}
    for i, entry in enumerate(content["annots"]):
        field = f"annots[{i}]"
        members(entry, file, field, keypoints=list)
        parts = {key: file_numbers(entry[key], file, f"{field}.{key}", (None, 3), nulls=True) for key in PARTS if entry.get(key)}
        if len(parts.get("keypoints", ())) == PARTS["keypoints"]:
            parts = {key: parts.get(key, np.zeros((count, 3))) for key, count in PARTS.items()}
            if wrong := [key for key, count in PARTS.items() if len(parts[key]) != count]:
                raise CaptureError(file, f"{field}.{wrong[0]}", f"expected {PARTS[wrong[0]]} points")
            person = np.concatenate(list(parts.values()))
        else:
            person = parts.get("keypoints", np.zeros((0, 3)))
        number = entry.get("personID", i)
        people[number if type(number) is int and 0 <= number < MOST_PEOPLE and number not in people else len(people)] = person
    first = next(iter(people.values()), np.zeros((0, 3)))
    found = tuple(people.get(i, np.zeros_like(first)) for i in range(max(people, default=-1) + 1))
    name, size = content.get("filename"), (content.get("width"), content.get("height"))
    known = all(type(side) is int and side > 0 for side in size)
    image = DetectedImage(name if isinstance(name, str) and name else source.name, file, found, size if known else None)
    return Detections(OPENPOSE_67, (image,)) if len(first) == len(OPENPOSE_67.names) else detections_of([image])
