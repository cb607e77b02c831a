"""Ranges of use: the committed file, and where captures lie in it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.robustness import LIMITS, interval
from humangs_jax.apps import check as limits
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture


@pytest.fixture(scope="module")
def capture():
    return load_capture("demo_capture")


def test_every_quantity_has_its_range_and_what_a_capture_shows_is_compared(capture):
    ranges = limits.load_limits()["ranges"]
    assert set(ranges) == set(LIMITS)
    text = limits.limits_table(capture)
    assert all(name in text for name in ranges) and text.count("here") == 3 and "!" not in text
    assert "here 4\n" in text and "here 1.74 to 1.88 m" in text and "here 216 to 234 pixels of 256" in text


def test_a_capture_outside_of_a_range_is_marked(capture):
    cameras = capture.cameras
    away = np.array(cameras.cam_from_world)
    away[:, 2, 3] -= 1.0
    near = dataclasses.replace(capture, cameras=replace(cameras, cam_from_world=jnp.asarray(away)))
    marked = [line for line in limits.limits_table(near).splitlines() if line.endswith("!")]
    assert len(marked) == 1 and marked[0].startswith("distance of the cameras")


def test_ends_are_where_the_loss_crosses_the_bound():
    row = interval("focal length", {-2.0: 3.0, -1.0: 0.5, 1.0: 0.2, 2.0: 0.9})
    assert row["low"] == pytest.approx(-1.2) and row["high"] is None
    assert interval("body moved", {0.5: 0.0, 1.0: 2.0})["low"] == 0  # an error without a sign
