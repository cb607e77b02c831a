"""Values of data-set files, checked one by one: every fault is a `CaptureError` that names file and key."""

import functools

import numpy as np

from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io import arrays

LARGEST_ANGLE = 4 * np.pi
"""Radians of a rotation vector; fits wander beyond 2 pi now and then, degrees are far above."""
FARTHEST = 100.0
"""Metres of a translation or of a camera from the origin; millimetres are far above."""
LARGEST_COEFFICIENT = 30.0
"""Of shape and expression: standard deviations, usually below 5."""

open_arrays = functools.partial(arrays.ArrayFile.open, error=CaptureError)
checked_numbers = functools.partial(arrays.checked_numbers, error=CaptureError)
