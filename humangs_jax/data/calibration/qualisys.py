"""Qualisys Track Manager's XML: cameras with their place (millimetres), the rows of a rotation, and lenses in 64ths of pixels.

A camera looks along -z of its rotation and has y up: R = diag(1, -1, -1) M. Focal lengths and principal points are divided by 64,
and counted from the corner of the field of view; the coefficients of the lens are OpenCV's as they are.
"""

import re
import xml.etree.ElementTree as tree

import numpy as np

from humangs_jax.data.calibration.calibration import (
    CalibratedCamera,
    Calibration,
    Source,
    brown_conrady,
    image_size,
    intrinsics,
    pose_matrix,
)
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import Refused, check_limit

SUBPIXELS = 64.0
METRES = 1e-3
LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")


def recognizes(source: Source) -> bool:
    """Whether a file is XML of a calibration with fields of view."""
    text = source.text.lstrip()
    return text.startswith("<") and "<transform" in text and "focalLengthU" in text


def read(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of a file. Raises: CaptureError naming the camera and what is missing."""
    check_limit("slow_text_bytes", len(source.text), "characters of XML")
    if re.search(r"<!(DOCTYPE|ENTITY)", source.text):
        raise Refused("XML with entities, which are not read")
    try:
        root = tree.fromstring(source.text)
    except tree.ParseError as error:
        raise Refused(f"not valid XML: {error}") from error
    elements = [each for each in root.iter("camera") if each.find("transform") is not None]
    cameras = [_camera(element, f"camera {i}", source) for i, element in enumerate(elements)]
    if not cameras:
        raise CaptureError(source.path, "", "no camera with a transform")
    return source.calibration(format, cameras)


def _camera(element: tree.Element, field: str, source: Source) -> CalibratedCamera:
    def number(part: str, key: str) -> float:
        found = element.find(part)
        text = None if found is None else found.get(key)
        try:
            value = float(text or "")
        except ValueError:
            raise CaptureError(source.path, f"{field}.{part}.{key}", f"expected a number, got {text!r}") from None
        if not np.isfinite(value) or abs(value) > 1e12:
            raise CaptureError(source.path, f"{field}.{part}.{key}", f"expected a finite number, got {value}")
        return value

    turn = np.asarray([[number("transform", f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    turn = np.diag([1.0, -1, -1]) @ turn
    place = METRES * np.asarray([number("transform", axis) for axis in "xyz"])
    view = {side: number("fov_video", side) for side in ("left", "top", "right", "bottom")}
    focal = [number("intrinsic", f"focalLength{axis}") / SUBPIXELS for axis in "UV"]
    center = [number("intrinsic", f"centerPoint{axis}") / SUBPIXELS for axis in "UV"]
    K = intrinsics(*focal, center[0] - view["left"], center[1] - view["top"])
    size = [view["right"] - view["left"] + 1, view["bottom"] - view["top"] + 1]
    width, height = image_size(size, source.path, f"{field}.fov_video")
    lens = brown_conrady([number("intrinsic", key) for key in LENS], source.path, f"{field}.intrinsic")
    name = element.get("serial") or element.get("name") or field
    return CalibratedCamera(name, K, pose_matrix(turn, -turn @ place), width, height, lens)
