"""How far float32 results may be apart: bounds of an error analysis, with one switch for all.

The rule for a sum (Higham, Accuracy and Stability of Numerical Algorithms, section 4.2): a sum of n
terms, computed in any order, with any width of vectors and with or without fused multiplications,
is off by at most n u sum |term|, u = 2^-24. If every term has been rounded r times before, it is
off by at most (n + r) u sum |term|. The bound is therefore relative to the sum of the magnitudes of
the terms, which cancellation does not make smaller, and not to the result.

`HUMANGS_TOLERANCE_SCALE=0.33` multiplies every bound made here, and every rtol and atol with which
numpy compares float32 arrays (see conftest.py). A run with it finds the tests whose error is close
to their bound.
"""

import os

import numpy as np

SCALE = float(os.environ.get("HUMANGS_TOLERANCE_SCALE", "1"))

UNIT = 2.0**-24
"""Largest relative error of one float32 operation."""

LARGEST_ROUNDING = 1e-3
"""Largest rtol or atol that the switch changes: larger ones are not about rounding."""


def bound(value: float) -> float:
    """Returns a float32 tolerance, multiplied by the switch."""
    return SCALE * value


def scaled_comparison(compare):
    """Returns a comparison of numpy's with the switch applied where an array is float32.

    It is made for `np.testing.assert_allclose`, `np.allclose` and `np.isclose`.
    """
    defaults = (
        {"rtol": 1e-7, "atol": 0.0}
        if compare is np.testing.assert_allclose
        else {"rtol": 1e-5, "atol": 1e-8}
    )

    def scaled(actual, desired, rtol=defaults["rtol"], atol=defaults["atol"], **options):
        if any(getattr(a, "dtype", None) == np.float32 for a in (actual, desired)):
            rtol, atol = (SCALE * x if x < LARGEST_ROUNDING else x for x in (rtol, atol))
        return compare(actual, desired, rtol=rtol, atol=atol, **options)

    return scaled
