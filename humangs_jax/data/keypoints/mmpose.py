"""MMPose's JSON: what the inferencer writes for images and videos (pred_out_dir), and what the demo scripts write.

An instance has keypoints (k x 2) and keypoint_scores (k). An image's file is a list of instances, a video's a list of
{frame_id, instances}; the demo scripts put either under instance_info.
"""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.detections import DetectedImage, expect, floats

DEMO_PREFIX = "results_"
"""What the demo scripts put before the name of the image."""


def mmpose_images(entries: list[Any], file: Path, name: str, alone: bool) -> list[DetectedImage]:
    """The images of one file: one image, or the frames of a video.

    Arguments:
        entries: the list of instances or frames. name: of the image or video, from the file's name.
        alone: there is no other file: the frames of a video are known by their number, else by name/number.

    Raises: CaptureError.
    """
    name = name.removeprefix(DEMO_PREFIX)
    if not any(isinstance(entry, dict) and "frame_id" in entry for entry in entries):
        return [DetectedImage(name, file, _people(entries, file, "instances"))]
    images = []
    for i, entry in enumerate(entries):
        frame, instances = _frame(entry, file, f"[{i}]")
        label = frame if alone else f"{name}/{frame}"
        images.append(DetectedImage(label, file, _people(instances, file, f"[{i}].instances")))
    return images


def _frame(entry: Any, file: Path, field: str) -> tuple[int, list[Any]]:
    frame = expect(entry, dict, file, field).get("frame_id")
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise CaptureError(file, f"{field}.frame_id", f"expected an integer, got {frame!r}")
    return frame, expect(entry.get("instances"), list, file, f"{field}.instances")


def _people(instances: list[Any], file: Path, field: str) -> tuple[Float[np.ndarray, "k 3"], ...]:
    return tuple(_person(instance, file, f"{field}[{i}]") for i, instance in enumerate(instances))


def _person(instance: Any, file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    expect(instance, dict, file, field)
    for key in ("keypoints", "keypoint_scores"):
        if key not in instance:
            raise CaptureError(file, f"{field}.{key}", "missing")
    points = floats(instance["keypoints"], file, f"{field}.keypoints")
    scores = floats(instance["keypoint_scores"], file, f"{field}.keypoint_scores")
    if points.ndim != 2 or points.shape[1] != 2:
        raise CaptureError(file, f"{field}.keypoints", f"expected x and y of each point, got shape {points.shape}")
    if scores.shape != points.shape[:1]:
        problem = f"expected one for each of {len(points)} keypoints, got shape {scores.shape}"
        raise CaptureError(file, f"{field}.keypoint_scores", problem)
    return np.concatenate([points, scores[:, None]], axis=1)
