"""Where errors are, of images whose errors are known."""

import numpy as np
import pytest

from experiments.evaluation import error_shares


def person(size=48, half=12):
    """A grey square on white: colors, coverage."""
    alpha = np.zeros((size, size))
    alpha[size // 2 - half : size // 2 + half, size // 2 - half : size // 2 + half] = 1
    return np.where(alpha[..., None] > 0, 0.4, 1.0) * np.ones(3), alpha


NAMES = ("share at the silhouette", "share in holes", "share in colors", "share around the person")


@pytest.mark.parametrize("place", NAMES)
def test_an_error_is_counted_where_it_is(place):
    image, mask = person()
    rgb, alpha = image.copy(), mask.copy()
    if place == "share at the silhouette":
        rgb, alpha = person(half=11)
    elif place == "share in holes":
        rgb[24, 24], alpha[24, 24] = 1, 0
    elif place == "share in colors":
        rgb[24, 24] = 0.9
    else:
        rgb[2, 2], alpha[2, 2] = 0.4, 1
    found = error_shares.shares(rgb, alpha, image, mask)
    assert found["squared error"] > 0 and np.isclose(found[place], found["squared error"])
    assert all(found[name] == 0 for name in NAMES if name != place)


def test_under_the_true_coverage_only_the_colors_count():
    image, mask = person()
    rgb, alpha = person(half=11)
    rgb[24, 24] = 0.5  # so that the PSNR is finite
    found = error_shares.shares(rgb, alpha, image, mask)
    assert found["PSNR with the true silhouette and the predicted colors, dB"] > found["PSNR"] + 20


def test_fog_of_the_prediction_stands_beside_that_of_the_truth():
    image, mask = person()
    alpha = mask.copy()
    alpha[24:26, 24] = 0.5
    found = error_shares.shares(image, alpha, image, mask)
    assert np.isclose(found["semi_transparent"], 2 / mask.sum()) and found["semi_transparent of the true images"] == 0


def test_the_table_has_a_column_for_each_weights_and_size():
    rows = {"PSNR, other poses, dB": 25.0, "squared error": 0.003, "share in holes": 0.25}
    table = error_shares.section({"before, 256 px": rows, "now, 256 px": rows | {"share in holes": 0.125}})
    assert "| share in holes | 0.250 | 0.125 |" in table and "25.00" in table and "squared error" not in table
