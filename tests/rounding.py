"""How far float32 results may be apart: bounds from error analysis, and one switch that tightens
them all.

The rule for a sum (Higham, Accuracy and Stability of Numerical Algorithms, section 4.2): computed
in any order, with any width of vectors and with or without fused multiplications, a sum of n terms
is off by at most n u sum |term|, u = 2^-24; if every term has been rounded r times on its way, by
at most (n + r) u sum |term|. So the bound is relative to the sum of the magnitudes of the terms,
which cancellation does not make smaller, and not to the result.

`HUMANGS_TOLERANCE_SCALE=0.33` multiplies every bound made here, and (see conftest.py) every rtol
and atol with which numpy compares float32 arrays: a run with it finds the tests whose error is
close to their bound.
"""

import os

import numpy as np

SCALE = float(os.environ.get("HUMANGS_TOLERANCE_SCALE", "1"))

UNIT = 2.0**-24
"""Largest relative error of one float32 operation."""

LARGEST_ROUNDING = 1e-3
"""A larger rtol or atol is not about rounding (millimetres of a body, say): the switch leaves it
alone.
"""


def bound(value: float) -> float:
    """A float32 tolerance, under the switch."""
    return SCALE * value


def scaled_comparison(compare):
    """`np.testing.assert_allclose`, `np.allclose` or `np.isclose` with the switch applied where an
    array is float32.
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
