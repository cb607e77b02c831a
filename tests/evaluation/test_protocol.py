"""Crops and backgrounds of the protocols against other implementations, on random images."""

import typing

import numpy as np
import pytest
from evaluation_cases import ellipse
from scipy import ndimage

from humangs_jax.cli.training import Evaluate
from humangs_jax.evaluation.scores import (
    PROTOCOLS,
    CentredWindow,
    MaskBox,
    SquareBox,
    WholeFrame,
)
from humangs_jax.losses.losses import GAUSSIAN, TORCHMETRICS, UNIFORM


def blob(seed, height, width):
    """Returns (image, mask) with a mask at a random place, perhaps at the rim."""
    rng = np.random.default_rng(seed)
    tall, wide = rng.integers(height // 4, height // 2), rng.integers(width // 6, width // 2)
    top, left = rng.integers(0, height - tall + 1), rng.integers(0, width - wide + 1)
    mask = np.zeros((height, width), np.float32)
    mask[top : top + tall, left : left + wide] = ellipse(tall, wide, 0.6, 0.6, soft=False)
    return rng.random((height, width, 3)).astype(np.float32), mask


def bounds(inside):
    places = np.nonzero(inside)
    return [(int(axis.min()), int(axis.max())) for axis in places]


def test_the_presets_are_those_of_the_table():
    """The table of docs/evaluation.md lists background, crop, mask, LPIPS and SSIM."""
    table = {
        "humangs": ("white", WholeFrame(), None, False, ("vgg",), GAUSSIAN),
        "animatable-gaussians": (
            "white",
            WholeFrame(),
            SquareBox(50, 512),
            False,
            ("vgg",),
            UNIFORM,
        ),
        "ghg": ("black", CentredWindow(1000, 500, 1024), None, False, ("alex", "vgg"), UNIFORM),
        "giga": ("black", MaskBox(), None, True, ("alex",), TORCHMETRICS),
        "lhm": ("white", WholeFrame(), None, False, ("squeeze",), TORCHMETRICS),
        "lhm++": ("white", WholeFrame(), None, True, ("alex",), UNIFORM),
        "lvsm": ("dataset", WholeFrame(), None, False, ("vgg",), GAUSSIAN),
    }
    fields = ("background", "crop", "lpips_crop", "masked", "lpips", "ssim")
    assert {
        name: tuple(getattr(p, field) for field in fields) for name, p in PROTOCOLS.items()
    } == table
    assert [name for name, p in PROTOCOLS.items() if p.needs_masks] == [
        "animatable-gaussians",
        "ghg",
        "giga",
        "lhm++",
    ]
    assert [PROTOCOLS[name].behind for name in ("lhm", "ghg", "lvsm")] == [1.0, 0.0, 1.0]
    assert typing.get_args(typing.get_type_hints(Evaluate)["protocol"]) == tuple(PROTOCOLS)


@pytest.mark.parametrize("seed", range(3))
def test_the_square_box(seed):
    """The box is padded by hand and resampled by scipy.

    Sample i of n lies at (i + 1/2) of / n - 1/2, and the rim is repeated.
    """
    image, mask = blob(seed, 130, 110)
    (top, bottom), (left, right) = bounds(mask > 0.5)
    np.testing.assert_array_equal(
        MaskBox().cut(image, mask, 0.0), image[top : bottom + 1, left : right + 1]
    )
    margin, side = 9, 64
    (top, bottom), (left, right) = bounds(mask > 0)
    rows = slice(max(0, top - margin), min(130, bottom + margin))
    columns = slice(max(0, left - margin), min(110, right + margin))
    part = image[rows, columns]
    height, width = part.shape[:2]
    largest = max(height, width)
    above, before = (largest - height) // 2, (largest - width) // 2
    pad = ((above, largest - height - above), (before, largest - width - before), (0, 0))
    square = np.pad(part, pad, constant_values=1.0)
    at = (np.arange(side) + 0.5) * largest / side - 0.5
    grid = np.meshgrid(at, at, indexing="ij")
    expected = np.stack(
        [
            ndimage.map_coordinates(square[..., c].astype(float), grid, order=1, mode="nearest")
            for c in range(3)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(SquareBox(margin, side).cut(image, mask, 1.0), expected, atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_the_centred_window(seed):
    """The window has its final size; the published rule for its corner is written with branches."""
    image, mask = blob(seed, 100, 80)
    wanted, corner = (70, 30), []
    for (first, last), size, side in zip(bounds(mask > 0), wanted, mask.shape, strict=True):
        before = (size - (last + 1 - first)) // 2
        after = size - (last - first) - before
        # a window that would reach beyond the image is moved to its edge
        if first - before < 0:
            corner.append(0)
        elif last + after > side:
            corner.append(side - size)
        else:
            corner.append(first - before)
    expected = image[corner[0] : corner[0] + 70, corner[1] : corner[1] + 30]
    found = CentredWindow(70, 30, 100).cut(image, mask, 0.0)
    assert found.shape == (70, 30, 3)
    np.testing.assert_array_equal(found, expected)


def test_the_centred_window_is_of_the_published_size():
    image, mask = blob(1, 256, 256)
    assert PROTOCOLS["ghg"].crop.cut(image, mask, 0.0).shape == (1000, 500, 3)
    # narrower than the window
    assert CentredWindow().cut(image[:, :100], mask[:, :100] + 1, 0.0).shape == (
        1000,
        400,
        3,
    )
