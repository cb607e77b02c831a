"""Validation uses the same views every time, as many as the middle of training's counts.

It also tests how they are laid out.
"""

import dataclasses

import jax
import numpy as np

from humangs_jax.training.config import tiny
from humangs_jax.training.forward import sheet, validation_examples
from humangs_jax.training.sources import captured_people

CONFIG = dataclasses.replace(
    tiny(), views=dataclasses.replace(tiny().views, input_counts=(3, 1, 2))
)


def test_the_middle_number_of_views_the_same_ones_again(body, captures, same):
    first, again = (
        validation_examples(captured_people(captures, body), CONFIG, 2) for _ in range(2)
    )
    assert len(first) == 2 and same(first, again)
    size = CONFIG.model.conventions.image_size
    for example in first:
        assert example.inputs.images.shape == (2, size, size, 3)
        assert example.targets.images.shape == (CONFIG.views.target_count, size, size, 3)
    assert len(validation_examples(captured_people(captures, body), CONFIG, 8)) == len(captures)


def test_a_row_of_the_sheet_is_inputs_and_then_pairs(body, captures):
    examples = validation_examples(captured_people(captures, body), CONFIG, 2)
    shown = [np.full(example.targets.images.shape, 0.25 * i) for i, example in enumerate(examples)]
    image, size = sheet(examples, shown), CONFIG.model.conventions.image_size
    assert image.shape == (2 * size, (2 + 2 * 2) * size, 3)
    row = jax.tree.map(np.asarray, examples[1])
    tiles = np.split(image[size:], 6, axis=1)
    for tile, expected in zip(
        tiles, [*row.inputs.images, row.targets.images[0], shown[1][0]], strict=False
    ):
        np.testing.assert_array_equal(tile, expected)
