import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from fit_people import NOISE, default_body, person

from humangs_jax.apps.check import TINTS, fit_sheet
from humangs_jax.avatar.video import GAP
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.capture.fitting import fit_capture
from humangs_jax.capture.fitting.files import FitRecord
from humangs_jax.capture.fitting.fit_capture import examine
from humangs_jax.capture.fitting.report import (
    WORTH_A_LINE,
    undetermined_joints,
)
from humangs_jax.capture.fitting.swaps import Swap
from humangs_jax.capture.keypoints.keypoints import COCO_17, KeypointSet
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.io.images import read_image

FRAMES, VIEWS = 4, 4
NOSE, LEFT_WRIST, RIGHT_WRIST = (
    COCO_17.names.index(name) for name in ("nose", "left_wrist", "right_wrist")
)
RAYLEIGH = {0.5: 1.177, 0.9: 2.146}
"""Quantiles of the length of a vector of two components with standard deviation 1."""


@pytest.fixture(scope="module")
def good() -> tuple:
    return person(20, FRAMES, VIEWS)


def turned(capture: Capture, joint: str, frame: int, vector: tuple[float, float, float]) -> Capture:
    rotations = capture.poses.rotations.at[frame, JOINT_NAMES.index(joint)].set(jnp.asarray(vector))
    return dataclasses.replace(capture, poses=replace(capture.poses, rotations=rotations))


def with_points(keypoints, change):
    points, confidences = keypoints.points.copy(), keypoints.confidences.copy()
    change(points, confidences)
    return dataclasses.replace(keypoints, points=points, confidences=confidences)


@pytest.mark.slow
def test_a_good_fit_and_one_with_outliers(good):
    capture, keypoints = good
    examination = examine(*good)
    report = examination.report
    assert report.ok and report.swaps == () and report.undetermined == ()
    assert [view.name for view in report.views] == list(capture.names)
    assert [view.frame for view in report.views] == capture.frames.tolist()
    assert all(view.keypoints == 17 and view.outliers == 0 for view in report.views)
    for field, share in (("median", 0.5), ("high", 0.9)):
        assert np.mean([getattr(view, field) for view in report.views]) == pytest.approx(
            RAYLEIGH[share] * NOISE, rel=0.12
        )
    errors = np.linalg.norm(examination.landmarks - keypoints.points, axis=-1)
    np.testing.assert_allclose(
        [np.median(own) for own in errors], [view.median for view in report.views], rtol=1e-5
    )

    def displace(points, confidences):
        points[5, NOSE] += 40
        points[9, LEFT_WRIST] -= 40
        points[9, NOSE] += 40
        confidences[9, NOSE] = 0

    examination = examine(capture, with_points(keypoints, displace))
    assert np.argwhere(examination.outliers).tolist() == [[5, NOSE], [9, LEFT_WRIST]]
    assert (
        not examination.compared[9, NOSE]
        and examination.compared.sum() == examination.compared.size - 1
    )
    assert examination.report.views[9].keypoints == 16 and examination.report.views[
        9
    ].outliers == pytest.approx(1 / 16)
    assert examination.report.ok  # a detector may err at times


@pytest.mark.slow
def test_a_camera_that_was_moved(good):
    capture, keypoints = good
    matrices = capture.cameras.cam_from_world.at[6, 0, 3].add(0.3)
    report = examine(
        dataclasses.replace(capture, cameras=replace(capture.cameras, cam_from_world=matrices)),
        keypoints,
    ).report
    cause, warning = report.warnings
    assert cause.startswith("camera m1v2 is off by ")
    assert warning.startswith(
        "body and keypoints disagree in view m1v2: "
    ) and f"warning: {warning}" in str(report)
    assert np.argmax([view.median for view in report.views]) == 6


def test_exchanged_sides_are_named_before_what_they_cause(good):
    capture, keypoints = good

    def mirror(points, _):
        points[6] = points[6][list(COCO_17.mirror)]

    report = examine(capture, with_points(keypoints, mirror)).report
    assert report.swaps[0].views == ("m1v2",)
    assert report.warnings[0] == "view m1v2: left and right of the keypoints seem exchanged"
    assert report.warnings[1].startswith("body and keypoints disagree in view m1v2")


def test_exchanged_hands_are_named_and_explain_the_sides_of_their_view_and_no_cameras(monkeypatch):
    """The other exchanges are given, because finding them takes long."""
    names = ("left_wrist", "right_wrist", "left_hand_root", "right_hand_root", "nose")
    capture, keypoints = person(0, 1, 2, kind=KeypointSet("wrists", names, (1, 0, 3, 2, 4)))
    cameras, other = Swap("cameras", ("m0v0", "m0v1")), Swap("sides", ("m0v0",))
    either = Swap("sides", ("m0v0",), instead=("m0v1",))
    monkeypatch.setattr(
        fit_capture, "find_swaps", lambda *_: (cameras, Swap("sides", ("m0v1",)), either, other)
    )

    def exchange(points, _):
        points[1, 2:4] = points[1, [3, 2]]

    report = examine(capture, with_points(keypoints, exchange)).report
    (hands,) = [swap for swap in report.swaps if swap.kind == "hands"]
    assert report.swaps == (cameras, other, hands)
    message = "view m0v1: the keypoints of the hands seem exchanged: each lies at the other wrist"
    assert message in report.warnings and f"warning: {message}" in str(report)


def test_joints_that_turn_too_far(good):
    capture, keypoints = good
    bent = turned(
        turned(capture, "left_knee", 2, (-0.9, 0.0, 0.0)), "right_elbow", 0, (0.0, -0.27, 0.0)
    )
    for joint, beyond in (("left_knee", 0.049), ("right_knee", 0.051)):
        bent = turned(bent, joint, 1, (-0.15 - beyond, 0.0, 0.0))
    examination = examine(bent, keypoints)
    found = {(v.frame, v.joint, v.axis): v.degrees for v in examination.report.violations}
    assert found[2, "left_knee", "x"] == pytest.approx(np.rad2deg(0.9 - 0.15), abs=0.01)
    assert found[0, "right_elbow", "y"] == pytest.approx(np.rad2deg(0.27 - 0.15), abs=0.01)
    assert (1, "right_knee", "x") in found and (1, "left_knee", "x") not in found
    (warning,) = [warning for warning in examination.report.warnings if "beyond" in warning]
    # the elbow by 7 is no matter
    assert warning == "left_knee is 43 degrees beyond its limit about x, in frame 2"


def test_frames_and_views_without_keypoints(good):
    capture, keypoints = good

    def hide(_, confidences):
        confidences[[1, 8, 9, 10, 11]] = 0

    examination = examine(capture, with_points(keypoints, hide))
    assert examination.report.views[1].keypoints == 0 and np.isnan(
        examination.report.views[1].median
    )
    assert examination.report.warnings == ("no keypoints in view m0v1, m2v0, m2v1, m2v2, m2v3",)
    assert "nan" not in str(examination.report)
    nothing = examine(capture, with_points(keypoints, lambda _, confidences: confidences.fill(0)))
    assert not nothing.report.ok and "nan" not in str(nothing.report)


@pytest.mark.slow
def test_frames_without_views(good):
    """A capture may have poses that no view shows, also after the last one that is shown."""
    capture, keypoints = good
    some = [0, 1, 2, 3, 8, 9, 10, 11]
    chosen = with_points(keypoints, lambda points, confidences: None)
    chosen = dataclasses.replace(
        chosen, points=chosen.points[some], confidences=chosen.confidences[some]
    )
    record = record_of(capture, keypoints, np.arange(FRAMES * VIEWS), noise=np.ones(FRAMES))
    examination = examine(capture.select(some), chosen, record)
    assert [view.frame for view in examination.report.views] == [0] * 4 + [2] * 4
    assert examination.report.ok and examination.report.undetermined == ()


# Findings
# --------------------------------------------------------------------------------------------------


def test_undetermined_joints_are_named_in_groups():
    index = JOINT_NAMES.index
    joint_std = np.full((3, len(JOINT_NAMES)), 0.5 * WORTH_A_LINE.std)
    determined = np.full((3, len(JOINT_NAMES)), 2 * WORTH_A_LINE.determined)
    for joint, name in enumerate(JOINT_NAMES):
        if name.startswith("left_") and name[-1] in "123":
            determined[:, joint] = 0
    determined[1, [index("right_index1"), index("left_eye")]] = 0
    joint_std[:2, index("left_ankle")] = 2 * WORTH_A_LINE.std
    found = undetermined_joints(JOINT_NAMES, joint_std[:2], determined[:2])
    assert found == (
        "left hand",
        "left_ankle",
        "left_eye (in 1 of 2 frames)",
        "right_index1 (in 1 of 2 frames)",
    )


# Of what a fit kept
# --------------------------------------------------------------------------------------------------


def record_of(capture, keypoints, order, **changes):
    shape = (FRAMES, len(default_body().joint_names))
    values: dict = dict(
        noise=np.full(FRAMES, 2.0), joint_std=np.full(shape, 0.001), determined=np.ones(shape)
    )
    values |= {"shape_covariance": np.eye(4)} | changes
    names = tuple(capture.names[i] for i in order)
    shuffled = dataclasses.replace(
        keypoints, points=keypoints.points[order], confidences=keypoints.confidences[order]
    )
    return FitRecord(shuffled, names, **values)


def test_a_record_is_brought_into_the_order_of_the_views(good):
    capture, keypoints = good
    joint_std = np.full((FRAMES, len(default_body().joint_names)), 0.001)
    joint_std[:, JOINT_NAMES.index("jaw")] = 1.0
    record = record_of(capture, keypoints, np.arange(FRAMES * VIEWS)[::-1], joint_std=joint_std)
    found = record.of_views(capture.names)
    np.testing.assert_array_equal(found.points, keypoints.points)
    examination = examine(capture, found, record)
    assert examination.report.ok and examination.report.undetermined == ("jaw",)
    assert "not determined by the views, taken from the prior: jaw" in str(examination.report)


def test_keypoints_and_records_of_something_else(good):
    capture, keypoints = good
    record = record_of(capture, keypoints, np.arange(15))
    with pytest.raises(ValueError, match="keypoints of 15 views, but the capture has 16"):
        examine(capture, record.keypoints)
    with pytest.raises(ValueError, match="knows no view m3v3: fit it again"):
        record.of_views(capture.names)
    with pytest.raises(ValueError, match="of 2 frames and 55 joints, but the capture has 4 and 55"):
        some = {"noise": np.ones(2), "joint_std": np.ones((2, 55)), "determined": np.ones((2, 55))}
        examine(capture, keypoints, record_of(capture, keypoints, np.arange(16), **some))


# The sheet
# --------------------------------------------------------------------------------------------------


def drawn(sheet, color):
    """Returns (row, column) of the pixels that nearly have a color."""
    return np.argwhere(np.abs(sheet - np.asarray(color)).max(-1) < 0.08)


@pytest.mark.slow
def test_discs_are_where_the_keypoints_are_those_of_outliers_are_hollow_and_lines_lead_to_the_body(
    tmp_path,
):
    """One view is drawn at twice its size; of the wrists the right one is an outlier."""
    capture, keypoints = person(30, 1, 1)
    keypoints = dataclasses.replace(keypoints, confidences=np.zeros_like(keypoints.confidences))
    keypoints.points[0, [LEFT_WRIST, RIGHT_WRIST]] = (32, 16), (224, 16)
    keypoints.confidences[0, [LEFT_WRIST, RIGHT_WRIST]] = 1
    examination = examine(capture, keypoints)
    far = np.zeros_like(examination.outliers)
    far[0, RIGHT_WRIST] = True
    fit_sheet(
        capture, keypoints, dataclasses.replace(examination, outliers=far), tmp_path / "fit.png"
    )
    image, _ = read_image(tmp_path / "fit.png")
    top = image.shape[0] - 512 - GAP
    blue = drawn(image[top : top + 60], TINTS.left)
    assert len(blue) > 30
    np.testing.assert_allclose(blue.mean(0), [2 * 16 - 0.5, 2 * 32 - 0.5 + GAP], atol=1.0)
    y, x = top + 2 * 16, GAP + 2 * 224
    # the white photo, or the line, but no red disc
    assert (image[y - 1 : y + 1, x - 1 : x + 1, 2] > 0.9).all()
    around = image[y - 8 : y + 8, x - 8 : x + 8]
    assert ((around[..., 0] - around[..., 2]) > 0.3).sum() > 10 and TINTS.right[0] > TINTS.right[2]
    x, y = 2 * examination.landmarks[0, LEFT_WRIST] + [GAP, top]
    near = image[int(y) - 6 : int(y) + 7, int(x) - 6 : int(x) + 7]
    assert (np.abs(near - np.asarray(TINTS.cross) / 255).max(-1) < 0.3).sum() >= 5
