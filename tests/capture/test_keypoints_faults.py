"""Faults in keypoint files, and oddities that are only reported."""

import json

import numpy as np
import pytest

from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.data.capture_checks import CaptureError

NAMES, SIZE = ("front", "back"), (320, 240)


def entry(image="front", confidence=0.75, shift=0.0, count=17, **more):
    values = np.stack(
        [100.0 + shift + np.arange(count), np.full(count, 50.0), np.full(count, confidence)], axis=1
    )
    return {"image_id": image, "keypoints": values.reshape(-1).tolist(), **more}


def with_number(index, value, image="front"):
    """Returns an entry with one number replaced: 0 is the nose's x, 1 its y, 2 its confidence."""
    each = entry(image)
    each["keypoints"][index] = value
    return each


def read(path, content, **options):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_keypoints(path, NAMES, *SIZE, **options)


def annotations(size=SIZE, **more):
    image = {"id": 1, "file_name": "front.png", "width": size[0], "height": size[1]}
    keypoints = entry()["keypoints"]
    keypoints[2::3] = [2] * 17
    return {"images": [image], "annotations": [{"image_id": 1, "keypoints": keypoints} | more]}


# Odd, but used
# --------------------------------------------------------------------------------------------------


def test_frames_that_were_matched_in_order_are_reported(tmp_path):
    """OpenPose counts the frames of a video from 0 and ffmpeg from 1."""
    content = [entry(f"clip_{i:012d}", shift=i) for i in range(3)]
    (tmp_path / "k.json").write_text(json.dumps(content))
    keypoints = read_keypoints(tmp_path / "k.json", [f"clip_{i + 1:06d}" for i in range(3)], *SIZE)
    assert keypoints.points[:, 0, 0].tolist() == [100.5, 101.5, 102.5] and keypoints.missing == ()
    assert keypoints.warnings[0].endswith("matched in order: clip_000000000000 is view clip_000001")
    assert read(tmp_path / "k.json", [entry("front"), entry("back")]).warnings == ()


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, None])
def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path, index, value):
    keypoints = read(tmp_path / "k.json", [with_number(index, value)])
    assert (
        "1 keypoints are not finite numbers" in keypoints.warnings[1]
        and np.isfinite(keypoints.points).all()
    )
    assert keypoints.confidences[0, 0] == 0 and (keypoints.confidences[0, 1:] == 0.75).all()


@pytest.mark.parametrize(
    "confidence, clipped", [(1.02, 1.0), (2.0, 1.0), (-0.01, 0.0), (-1.0, 0.0)]
)
def test_confidences_a_little_out_of_range_are_clipped(tmp_path, confidence, clipped):
    assert read(tmp_path / "k.json", [with_number(2, confidence)]).confidences[0, 0] == clipped


def test_scores_of_another_scale_are_divided_by_the_largest_with_a_warning(tmp_path):
    people = [entry(confidence=1.5), entry("back", confidence=6.0)]
    people[0]["keypoints"][2] = 3.0
    keypoints = read(tmp_path / "k.json", people)
    np.testing.assert_allclose(keypoints.confidences[0, :2], [0.5, 0.25])
    assert (keypoints.confidences[1] == 1).all()
    assert "scores of up to 6, of another scale than [0, 1]: divided by that" in keypoints.warnings


@pytest.mark.parametrize(
    "index, value, kept",
    [
        *((0, -159.0, True), (0, -161.0, False), (0, 478.0, True), (0, 480.0, False)),
        *((1, -119.0, True), (1, -121.0, False), (1, 358.0, True), (1, 360.0, False)),
    ],
)
def test_points_half_an_image_outside_are_dropped_and_counted(tmp_path, index, value, kept):
    keypoints = read(tmp_path / "k.json", [with_number(index, value)])
    assert (keypoints.confidences[0, 0] > 0) == kept
    assert any(line.startswith("1 keypoints lie far outside") for line in keypoints.warnings) == (
        not kept
    )
    assert keypoints.points[0, 0, index] == value + 0.5


# Several people
# --------------------------------------------------------------------------------------------------


def test_several_people_are_refused(tmp_path):
    people = [entry(), entry(shift=50), entry("back"), entry(shift=90)]
    with pytest.raises(
        CaptureError, match=r"k\.json: view front: 3 people: expected one\. Person I is the I-th"
    ):
        read(tmp_path / "k.json", people)


@pytest.mark.parametrize(("count", "set_size"), [(16, 133), (5, 133), (17, 133), (16, 17)])
def test_people_whose_hands_and_faces_were_not_found_are_people(tmp_path, count, set_size):
    """16 points of the body are 12 % of COCO-WholeBody's. Without a warning, the more confident of
    two such people was taken.
    """
    people = [entry(count=set_size, confidence=confidence) for confidence in (0.7, 0.9)]
    for person in people:
        person["keypoints"][3 * count + 2 :: 3] = [0.0] * (set_size - count)
    with pytest.raises(CaptureError, match=r"k\.json: view front: 2 people: expected one"):
        read(tmp_path / "k.json", people)
    assert read(tmp_path / "k.json", people, person=0).confidences[0, 0] == np.float32(0.7)


def test_openpose_people_without_hands_are_people(tmp_path):
    body = np.stack([100.0 + np.arange(25), np.full(25, 50.0), np.full(25, 0.8)], axis=1)
    person = {
        "pose_keypoints_2d": body.reshape(-1).tolist(),
        "hand_left_keypoints_2d": [],
        "hand_right_keypoints_2d": [],
    }
    with pytest.raises(CaptureError, match=r"view front: 2 people: expected one"):
        read(tmp_path / "front_keypoints.json", {"people": [person, person]})
    assert read(tmp_path / "front_keypoints.json", {"people": [person]}).missing == ("back",)


@pytest.mark.parametrize("ghost", [entry(confidence=0.29, shift=50), "few"])
def test_ghosts_beside_the_person_are_no_people(tmp_path, ghost):
    if ghost == "few":  # a quarter of the points
        ghost = entry(shift=50)
        ghost["keypoints"][4 * 3 + 2 :: 3] = [0.0] * 13
    for people in ([ghost, entry()], [entry(), ghost]):
        keypoints = read(tmp_path / "k.json", people)
        assert keypoints.points[0, 0, 0] == 100.5


def test_a_ghost_of_hands_is_no_person(tmp_path):
    """A ghost of COCO-WholeBody's 133 points, of which only the hands are sure."""
    person, ghost = entry(count=133), entry(count=133, shift=50)
    person["keypoints"][17 * 3 + 2 :: 3] = [0.0] * 116
    ghost["keypoints"][2 : 91 * 3 : 3] = [0.0] * 91
    for people in ([ghost, person], [person, ghost]):
        assert read(tmp_path / "k.json", people).points[0, 0, 0] == 100.5


def test_a_person_can_be_chosen(tmp_path):
    people = [entry(), entry("back", shift=20), entry(shift=50)]
    first, second = (read(tmp_path / "k.json", people, person=i) for i in (0, 1))
    assert first.points[:, 0, 0].tolist() == [100.5, 120.5] and first.missing == ()
    assert second.points[0, 0, 0] == 150.5 and second.missing == ("back",)
    with pytest.raises(
        CaptureError, match="person 2: no view has this many people: expected 0 to 1"
    ):
        read(tmp_path / "k.json", people, person=2)
    with pytest.raises(ValueError, match=r"^person -1: expected 0 for the first"):
        read(tmp_path / "k.json", people, person=-1)


# Wrong
# --------------------------------------------------------------------------------------------------

FAULTS = {
    "no JSON": ("{,", r"line 1: not valid JSON"),
    "no keypoints": (
        {"cameras": []},
        r"no keypoints: expected those of humangs detect; OpenPose; ",
    ),
    "another": (
        [entry(count=27)],
        (
            r"keypoints: expected 17 \(coco17\) or 26 \(halpe26\) or 133 \(wholebody133\) or 136"
            r" \(halpe136\) points, got 27"
        ),
    ),
    "two sets": (
        [entry(), entry("back", count=133)],
        r"image back: a person of 133 points, but another has 17",
    ),
    "other views": (
        [entry("x.jpg"), entry("y")],
        r"images x\.jpg, y are none of the views front, back",
    ),
    "percent": (
        [entry(confidence=80.0)],
        r"view front: expected confidences in \[0, 1\], got 80 to 80",
    ),
    "other photos": (
        [entry(shift=9000)],
        r"no point has a confidence above 0 \(not finite: 0, far outside .* 17\)",
    ),
    "same image twice": (
        [entry("front.jpg"), entry("front.png")],
        r"'front\.jpg' and 'front\.png' are both for view",
    ),
    "size": (
        annotations((640, 480)),
        r"size of front\.png: 640 x 480, but the capture's photos have 320 x 240",
    ),
    "visibility": (
        annotations(keypoints=[9.0, 9.0, 3.0] * 17),
        r"expected visibilities 0, 1 or 2, got 3",
    ),
    "openpose coco": (
        {"version": 1.3, "people": [{"pose_keypoints_2d": [1.0] * 45}]},
        (
            r"people\[0\]\.pose_keypoints_2d: expected 17, 18, 25, 26, 133, 136 points .*, got 15"
            r" points of MPI \(OpenPose: "
        ),
    ),
    "another canvas": (
        {"people": [{"pose_keypoints_2d": [9.0] * 54}], "canvas_width": 512, "canvas_height": 384},
        r"size of front: 512 x 384, but the capture's photos have 320 x 240",
    ),
    "openpose hand": (
        {"people": [{"pose_keypoints_2d": [], "hand_left_keypoints_2d": [1.0] * 60}]},
        (
            r"people\[0\]\.hand_left_keypoints_2d: expected a flat list of 63 \(21 times x, y,"
            r" confidence\)"
        ),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_one_line_that_names_the_file(tmp_path, fault):
    content, message = FAULTS[fault]
    with pytest.raises(CaptureError, match=message) as caught:
        read(tmp_path / "front.json", content)
    assert "front.json" in str(caught.value) and "\n" not in str(caught.value)


def test_shares_of_the_image_are_no_pixels(tmp_path):
    body = (
        np.stack([np.linspace(0.2, 0.8, 25), np.linspace(0, 1, 25), np.ones(25)], axis=1)
        .reshape(-1)
        .tolist()
    )
    with pytest.raises(
        CaptureError,
        match=r"expected pixels, not shares of the image \(OpenPose: --keypoint_scale 0\)",
    ):
        read(
            tmp_path / "front_keypoints.json",
            {"version": 1.3, "people": [{"pose_keypoints_2d": body}]},
        )
    with pytest.raises(CaptureError, match=r"not shares of the image$"):
        read(tmp_path / "front_keypoints.json", {"people": [{"pose_keypoints_2d": body}]})


def test_a_folder_of_two_tools_is_refused(tmp_path):
    (tmp_path / "front_keypoints.json").write_text(
        json.dumps({"people": [{"pose_keypoints_2d": [50.0] * 75}]})
    )
    (tmp_path / "back.json").write_text(json.dumps([entry("back")]))
    with pytest.raises(
        CaptureError,
        match=r"front_keypoints\.json: 67 points of OpenPose, but back\.json has 17 points of COCO",
    ):
        read_keypoints(tmp_path, NAMES, *SIZE)
