"""MMPose's inferencer and demo scripts.

An instance has keypoints (k x 2) and keypoint_scores (k). An image's file is a list of instances, a video's a list of {frame_id,
instances}; the demo scripts put either under instance_info.
"""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, file_numbers, members
from humangs_jax.data.formats import SourceFormat
from humangs_jax.data.keypoints.keypoints import DetectedImage, Detections, Source, detections_of

PREFIX = "results_"
"""What the demo scripts put before the name of the image."""


def recognizes(source: Source) -> bool:
    """Whether a file has a list of instances or frames; an empty list may be anybody's."""
    entries = _entries(source)
    if not isinstance(entries, list):
        return False
    return not entries or any(isinstance(each, dict) and each.keys() & {"keypoint_scores", "frame_id"} for each in entries)


def read(source: Source, format: SourceFormat) -> Detections:
    """The image of a file, or the frames of a video. Raises: CaptureError."""
    name, file, entries = source.name.removeprefix(PREFIX), source.path, _entries(source)
    if not any(isinstance(entry, dict) and "frame_id" in entry for entry in entries):
        return detections_of([DetectedImage(name, file, _people(entries, file, "instances"))])
    images = []
    for i, entry in enumerate(entries):
        frame, instances = members(entry, file, f"[{i}]", frame_id=int, instances=list)
        label = frame if source.alone else f"{name}/{frame}"
        images.append(DetectedImage(label, file, _people(instances, file, f"[{i}].instances")))
    return detections_of(images)


def _entries(source: Source) -> Any:
    return source.json.get("instance_info") if isinstance(source.json, dict) else source.json


def _people(instances: list[Any], file: Path, field: str) -> tuple[Float[np.ndarray, "k 3"], ...]:
    return tuple(_person(instance, file, f"{field}[{i}]") for i, instance in enumerate(instances))


def _person(instance: Any, file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    points, scores = members(instance, file, field, keypoints=list, keypoint_scores=list)
    points = file_numbers(points, file, f"{field}.keypoints", nulls=True)
    scores = file_numbers(scores, file, f"{field}.keypoint_scores", nulls=True)
    if points.ndim != 2 or points.shape[1] != 2:
        raise CaptureError(file, f"{field}.keypoints", f"expected x and y of each point, got shape {points.shape}")
    if scores.shape != points.shape[:1]:
        problem = f"expected one for each of {len(points)} keypoints, got shape {scores.shape}"
        raise CaptureError(file, f"{field}.keypoint_scores", problem)
    return np.concatenate([points, scores[:, None]], axis=1)
