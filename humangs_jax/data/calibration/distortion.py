"""Lens distortion after Brown and Conrady with OpenCV's coefficients k1 k2 p1 p2 k3, and photos freed of it.

Of a point (x, y) = (X / Z, Y / Z) in front of the camera, with r^2 = x^2 + y^2, the lens makes (OpenCV, calib3d)

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.values import floats
from humangs_jax.data.capture_checks import CaptureError, numbers

UNDISTORT_BEFORE = "undistort the photos before (cv2.undistort, cv2.fisheye or colmap image_undistorter)"
COUNTS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's calibration writes: from the sixth on they are k4 k5 k6, s1..s4, tx ty."""


def brown_conrady(values: Any, file: object, field: str) -> Float[np.ndarray, "5"] | None:
    """k1 k2 p1 p2 k3 of OpenCV's list of coefficients; None if all are 0.

    Raises: CaptureError if there are not 4, 5, 8, 12 or 14, or others than the first five are not 0.
    """
    values = floats(values, file, field, (numbers(values, file, field).size,))
    if len(values) not in COUNTS:
        raise CaptureError(file, field, f"expected k1 k2 p1 p2 [k3], got {len(values)} numbers")
    if values[5:].any():
        raise CaptureError(file, field, f"coefficients beyond k1 k2 p1 p2 k3 are not supported: {UNDISTORT_BEFORE}")
    return np.pad(values[:5], (0, max(0, 5 - len(values)))) if values.any() else None


def distort(points: Float[np.ndarray, "*n 2"], coefficients: Float[np.ndarray, "5"]) -> Float[np.ndarray, "*n 2"]:
    """Where the lens puts points of the plane z = 1."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(
    image: Float[np.ndarray, "h w *c"], K: Float[np.ndarray, "3 3"], coefficients: Float[np.ndarray, "5"], fill: float
) -> Float[np.ndarray, "h w *c"]:
    """The photo that a pinhole of the same K (pixel centres at +0.5) would have taken, bilinear, float32.

    Pixels that the photo does not show get the value `fill`.
    """
    from skimage.transform import warp

    height, width = image.shape[:2]
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    plane = (np.stack([columns, rows], axis=-1) - K[:2, 2]) / np.diag(K)[:2]
    source = distort(plane, coefficients) * np.diag(K)[:2] + K[:2, 2] - 0.5
    source[(plane**2).sum(axis=-1) >= _squared_reach(coefficients)] = -2  # outside of the photo
    where = np.moveaxis(source, -1, 0)[::-1]
    channels = np.atleast_3d(image).transpose(2, 0, 1)
    warped = [warp(c, where, order=1, mode="constant", cval=fill, preserve_range=True) for c in channels]
    return np.stack(warped, axis=-1).reshape(image.shape).astype(np.float32)


def _squared_reach(coefficients):
    """r^2 up to which r (1 + k1 r^2 + ..) grows. Beyond it the formula folds the picture back over itself."""
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return real.min() if len(real) else np.inf
