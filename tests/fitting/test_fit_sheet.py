import dataclasses

import numpy as np
import pytest
from seen_people import person

from humangs_jax.apps import check as module
from humangs_jax.apps.check import LEFT, RIGHT, fit_sheet, plot_over_time
from humangs_jax.avatar.sheets import GAP
from humangs_jax.data.keypoints.sets import COCO_17
from humangs_jax.fitting.fit_capture import examine
from humangs_jax.fitting.report import FitReport, ViewReport
from humangs_jax.io.images import read_image

SIDE = 128
LEFT_WRIST, RIGHT_WRIST = (COCO_17.names.index(f"{side}_wrist") for side in ("left", "right"))


def drawn(sheet, color):
    """Pixels that are nearly of a color, on the photos only: (row, column) each."""
    return np.argwhere(np.abs(sheet - np.asarray(color)).max(-1) < 0.08)


@pytest.fixture(scope="module")
def sheet(tmp_path_factory):
    """One view at twice its size, and the same with another left wrist that is an outlier."""
    capture, keypoints = person(30, 1, 1)
    keypoints = dataclasses.replace(keypoints, confidences=np.zeros_like(keypoints.confidences))
    keypoints.points[0, LEFT_WRIST], keypoints.points[0, RIGHT_WRIST] = (32, 16), (224, 16)
    keypoints.confidences[0, [LEFT_WRIST, RIGHT_WRIST]] = 1
    examination = examine(capture, keypoints)
    far = np.zeros_like(examination.outliers)
    far[0, RIGHT_WRIST] = True
    examination = dataclasses.replace(examination, outliers=far)
    path = tmp_path_factory.mktemp("sheet") / "fit.png"
    fit_sheet(capture, keypoints, examination, path)
    return read_image(path)[0], examination


@pytest.mark.slow
def test_discs_are_where_the_keypoints_are(sheet):
    image, _ = sheet
    top = image.shape[0] - 512 - GAP
    blue = drawn(image[top : top + 60], LEFT)
    assert len(blue) > 30
    np.testing.assert_allclose(blue.mean(0), [2 * 16 - 0.5, 2 * 32 - 0.5 + GAP], atol=1.0)


@pytest.mark.slow
def test_outliers_are_hollow(sheet):
    image, _ = sheet
    top = image.shape[0] - 512 - GAP
    y, x = top + 2 * 16, GAP + 2 * 224
    assert (image[y - 1 : y + 1, x - 1 : x + 1, 2] > 0.9).all()  # the white photo, or the line, but no red disc
    around = image[y - 8 : y + 8, x - 8 : x + 8]
    assert ((around[..., 0] - around[..., 2]) > 0.3).sum() > 10 and RIGHT[0] > RIGHT[2]


@pytest.mark.slow
def test_lines_lead_to_the_body(sheet):
    image, examination = sheet
    top = image.shape[0] - 512 - GAP
    x, y = 2 * examination.landmarks[0, LEFT_WRIST] + [GAP, top]
    cross = np.asarray(module.CROSS) / 255
    near = image[int(y) - 6 : int(y) + 7, int(x) - 6 : int(x) + 7]
    assert (np.abs(near - cross).max(-1) < 0.3).sum() >= 5


@pytest.mark.slow
def test_many_views_and_frames(tmp_path, monkeypatch):
    """An evenly chosen few of them, and a plot below."""
    monkeypatch.setattr(module, "LONGEST_SIDE", SIDE)
    capture, keypoints = person(31, 9, 3)
    keypoints.confidences[26] = 0
    examination = examine(capture, keypoints)
    names = []
    monkeypatch.setattr(module, "_label", lambda found, view: names.append(found.report.views[view].name) or "")
    overlays = []
    monkeypatch.setattr(module, "_overlay", lambda capture, view: overlays.append(view) or np.ones((SIDE, SIDE, 3)))
    fit_sheet(capture, keypoints, examination, tmp_path / "fit.png")
    image, _ = read_image(tmp_path / "fit.png")
    assert len(overlays) == module.VIEWS == len(names) and names[0] == "m0v0" and names[-1] == "m8v2"
    assert np.diff(overlays).max() <= 2
    plot = plot_over_time(examination.frames, image.shape[1])
    np.testing.assert_allclose(image[-len(plot) :], plot, atol=1 / 255)


@pytest.mark.slow
def test_labels(sheet):
    views = (ViewReport("a", 0, 17, 2.06, 4.0, 0.0), ViewReport("b", 0, 0, np.nan, np.nan, 0.0))
    examination = dataclasses.replace(sheet[1], report=FitReport("keypoints", views=views))
    assert [module._fit_label(examination, i) for i in (0, 1)] == ["a  2.1 px", "b  no keypoints"]


def test_the_plot_rises_and_has_gaps():
    errors = np.array([1.0, 1.0, 4.0, np.nan, 2.0, 2.0])
    plot = plot_over_time(errors, 600)
    blue = drawn(plot, LEFT)
    row = lambda column: blue[np.abs(blue[:, 1] - column) <= 2, 0].mean()
    columns = [30 + (580 - 30) * i / 5 for i in range(6)]
    assert row(columns[2]) < row(columns[4]) < row(columns[0])  # rows count downwards
    unit = (row(columns[0]) - row(columns[2])) / 3
    assert row(columns[0]) - row(columns[4]) == pytest.approx(unit, abs=2)
    between = (blue[:, 1] > columns[2] + 4) & (blue[:, 1] < columns[4] - 4)
    assert not between.any()


@pytest.mark.parametrize("errors", [[0.0, 0.0], [np.nan, np.nan], [np.nan, 3.0], [1e-6, 2e6]])
def test_plots_of_extremes(errors):
    plot = plot_over_time(np.asarray(errors), 300)
    assert plot.shape == (module.LINES * module.SMALLEST_TEXT, 300, 3) and np.isfinite(plot).all()


@pytest.mark.parametrize(
    "highest, count, whole, ticks",
    [
        (10.5, 4, False, [0, 5, 10]),
        (2.6, 4, False, [0, 1, 2]),
        (0.03, 4, False, [0, 0.01, 0.02, 0.03]),
        (1, 9, True, [0, 1]),
    ],
)
def test_ticks_are_round(highest, count, whole, ticks):
    np.testing.assert_allclose(module._ticks(highest, count, whole), ticks)
