import numpy as np
import pytest

from humangs_jax.avatar.video import ERROR_COLORS, GAP, error_colors, side_by_side, tile
from humangs_jax.io.images import read_image, to_uint8

LEVEL = 0.5 / 255 + 1e-6


def images(count, height=40, width=50):
    return np.random.default_rng(0).random((count, height, width, 3))


@pytest.mark.parametrize(("count", "columns"), [(1, 1), (5, 3), (4, None), (3, 8)])
def test_every_tile_is_where_it_belongs(count, columns):
    tiles = images(count)
    sheet = tile(tiles, columns=columns)
    across = 2 if columns is None else min(columns, count)
    for i in range(count):
        y, x = GAP + (i // across) * (40 + GAP), GAP + (i % across) * (50 + GAP)
        np.testing.assert_array_equal(sheet[y : y + 40, x : x + 50], tiles[i])
        sheet[y : y + 40, x : x + 50] = 1
    assert (sheet == 1).all()  # nothing but the tiles
    assert sheet.shape == (-(-count // across) * 44 + GAP, across * 54 + GAP, 3)


def test_texts_are_written_beside_the_images_and_cut_to_their_width():
    tiles = images(4)
    sheet = tile(
        tiles, labels=["a", "long label " * 20, "", "d"], headers=["truth", "ours"], columns=2
    )
    found = [
        (y, x)
        for y in range(sheet.shape[0] - 39)
        for x in (GAP, 2 * GAP + 50)
        if any(np.array_equal(sheet[y : y + 40, x : x + 50], p) for p in tiles)
    ]
    assert len(found) == 4  # no letter on any image
    first_rows = sheet[: found[0][0]]
    assert (first_rows[: first_rows.shape[0] // 2] < 0.5).any() and (
        first_rows[first_rows.shape[0] // 2 :] < 0.5
    ).any()
    assert (sheet[: found[0][0], -GAP:] == 1).all()  # the long one stays inside its tile
    assert (sheet[found[0][0] + 40 : found[2][0], :50] == 1).all()  # an empty label leaves white


def test_colors_are_rounded_to_the_nearest():
    assert list(to_uint8(np.array([-1.0, 0, 0.4999 / 255, 0.5001 / 255, 1, 7, np.nan]))) == [
        0,
        0,
        0,
        1,
        255,
        255,
        0,
    ]


def test_error_colors_are_ordered_and_saturate():
    colors = error_colors(np.linspace(0, 0.5, 101), 0.5)
    np.testing.assert_allclose(colors[[0, 25, 50, 75, 100]], ERROR_COLORS, atol=1e-12)
    assert (np.diff(colors @ [0.299, 0.587, 0.114]) < 0).all()  # darker and darker
    np.testing.assert_array_equal(error_colors(np.array([3.0]), 0.5)[0], ERROR_COLORS[-1])


@pytest.mark.parametrize("count", [1, 5])
def test_side_by_side_shows_truth_ours_and_error(tmp_path, count):
    truth = images(count)
    ours = truth.copy()
    ours[:, :20] = np.clip(ours[:, :20] + 0.5, 0, 1)
    side_by_side(truth, ours, tmp_path / "a.png", labels=[f"view {i}" for i in range(count)])
    sheet, alpha = read_image(tmp_path / "a.png")
    assert alpha is None and [p.name for p in tmp_path.iterdir()] == ["a.png"]
    y = next(
        y for y in range(80) if np.abs(sheet[y : y + 40, GAP : GAP + 50] - truth[0]).max() < LEVEL
    )
    tiles = [sheet[y : y + 40, GAP + i * (50 + GAP) : GAP + i * (50 + GAP) + 50] for i in range(3)]
    np.testing.assert_allclose(tiles[1], ours[0], atol=LEVEL)
    assert (tiles[2][20:] == 1).all() and (tiles[2][:20].mean() < 0.7)
    assert len(np.unique(sheet[-10], axis=0)) > 20  # the scale
