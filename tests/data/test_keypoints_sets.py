import pytest

from humangs_jax.data.keypoints.keypoints import COCO_17, COCO_WHOLEBODY_133, KEYPOINT_SETS, MEDIAPIPE_33, OPENPOSE_67, hand_names


@pytest.mark.parametrize("keypoint_set, count", [(COCO_17, 17), (COCO_WHOLEBODY_133, 133), (OPENPOSE_67, 67), (MEDIAPIPE_33, 33)])
def test_names_are_different_and_mirrors_are_mutual(keypoint_set, count):
    assert len(keypoint_set.names) == len(set(keypoint_set.names)) == len(keypoint_set.mirror) == count
    assert KEYPOINT_SETS[keypoint_set.name] is keypoint_set
    for i, j in enumerate(keypoint_set.mirror):
        assert keypoint_set.mirror[j] == i
        name, other = keypoint_set.names[i], keypoint_set.names[j]
        if name.startswith("left_"):
            assert other == "right_" + name.removeprefix("left_")
        elif not name.startswith(("right_", "face_")):
            assert other == name


def test_points_are_where_the_tools_have_them():
    """Numbers from COCO's, COCO-WholeBody's and OpenPose's pages."""
    for keypoint_set, numbers in (
        (COCO_17, {0: "nose", 1: "left_eye", 4: "right_ear", 9: "left_wrist", 12: "right_hip", 16: "right_ankle"}),
        (
            COCO_WHOLEBODY_133,
            {17: "left_big_toe", 19: "left_heel", 20: "right_big_toe", 22: "right_heel", 23: "face_0", 90: "face_67"}
            | {91: "left_hand_root", 95: "left_thumb_tip", 96: "left_index_1", 112: "right_hand_root"}
            | {132: "right_pinky_tip"},
        ),
        (
            OPENPOSE_67,
            {1: "neck", 2: "right_shoulder", 4: "right_wrist", 5: "left_shoulder", 8: "mid_hip", 9: "right_hip"}
            | {14: "left_ankle", 15: "right_eye", 18: "left_ear", 19: "left_big_toe", 24: "right_heel"}
            | {25: "left_hand_root", 46: "right_hand_root", 66: "right_pinky_tip"},
        ),
        (
            MEDIAPIPE_33,
            {0: "nose", 2: "left_eye", 5: "right_eye", 8: "right_ear", 11: "left_shoulder", 16: "right_wrist"}
            | {17: "left_pinky_1", 20: "right_index_1", 22: "right_thumb_2", 24: "right_hip", 28: "right_ankle"}
            | {1: "face_42", 6: "face_36", 9: "face_54", 30: "right_heel", 32: "right_foot_index"},
        ),
    ):
        for i, name in numbers.items():
            assert keypoint_set.names[i] == name


@pytest.mark.parametrize(
    "a, b",
    [
        *((0, 16), (8, 8), (17, 26), (21, 22), (27, 27), (30, 30), (31, 35), (33, 33)),
        *((36, 45), (39, 42), (37, 44), (41, 46), (40, 47)),
        *((48, 54), (51, 51), (55, 59), (57, 57), (60, 64), (62, 62), (65, 67), (66, 66)),
    ],
)
def test_landmarks_of_the_face_mirror_as_in_300w(a, b):
    names = COCO_WHOLEBODY_133.names
    assert COCO_WHOLEBODY_133.mirror[names.index(f"face_{a}")] == names.index(f"face_{b}")


def test_fingers_go_from_the_palm_outwards():
    assert hand_names("right")[:6] == (
        *("right_hand_root", "right_thumb_1", "right_thumb_2", "right_thumb_3"),
        *("right_thumb_tip", "right_index_1"),
    )
