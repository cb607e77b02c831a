"""Known points come back exactly from each format; names of views, and sets of points."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from changes import edit_json

from humangs_jax.capture.keypoints.formats import (
    ImagePeople,
    SeenPerson,
    read_people,
    save_keypoints,
    write_people,
)
from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    COCO_WHOLEBODY_133,
    HALPE_26,
    HALPE_136,
    KEYPOINT_SETS,
    MEDIAPIPE_33,
    OPENPOSE_67,
    Keypoints,
)
from humangs_jax.capture.keypoints.reading import match_views, read_keypoints
from humangs_jax.data.capture_checks import CaptureError

NAMES, SIZE = ("front", "back", "left"), (320, 240)
CAMERA_NAMES = (
    "images_cam0_000000",
    "images_cam0_000001",
    "images_cam1_000000",
    "images_cam1_000001",
)


def known(count, views=3, seed=0):
    """Returns points (v, k, 3) that float32 and JSON keep exactly.

    Pixels are whole eighths, confidences whole sixteenths.
    """
    rng = np.random.default_rng(seed)
    points = rng.integers(8, 8 * 200, (views, count, 2)) / 8
    return np.concatenate([points, rng.integers(1, 17, (views, count, 1)) / 16], axis=-1)


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def read(path, names=NAMES, **options):
    return read_keypoints(path, names, *SIZE, **options)


def check(keypoints, values, keypoint_set, missing=()):
    """Checks points that were read: the tools' first pixel has its centre at 0, ours at 0.5."""
    assert keypoints.set is keypoint_set
    np.testing.assert_array_equal(keypoints.points, values[..., :2] + 0.5)
    np.testing.assert_array_equal(keypoints.confidences, values[..., 2])
    assert keypoints.points.dtype == keypoints.confidences.dtype == np.float32
    assert keypoints.missing == tuple(missing)
    assert not [line for line in keypoints.warnings if "ignored" in line]


def flat(values):
    return values.reshape(-1).tolist()


def openpose_person(values, hands=True):
    person = {
        "person_id": [-1],
        "pose_keypoints_2d": flat(values[:25]),
        "face_keypoints_2d": [1.0] * 210,
    }
    person |= {"hand_left_keypoints_2d": flat(values[25:46]) if hands else []}
    return person | {
        "hand_right_keypoints_2d": flat(values[46:]) if hands else [],
        "pose_keypoints_3d": [],
    }


def openpose(*people):
    return {"version": 1.3, "people": list(people)}


def annots(values, filename, number=0):
    """Returns EasyMocap's content of a file, with hands beside BODY_25."""
    hands = {}
    if len(values) == 67:
        hands = {"handl2d": values[25:46].tolist(), "handr2d": values[46:].tolist()}
    person = {
        "bbox": [0, 0, 9, 9, 1.0],
        "personID": number,
        "keypoints": values[: 25 if hands else None].tolist(),
    } | hands
    return {"height": SIZE[1], "width": SIZE[0], "annots": [person]} | (
        {"filename": filename} if filename else {}
    )


def instances(values):
    return [
        {
            "keypoints": values[:, :2].tolist(),
            "keypoint_scores": values[:, 2].tolist(),
            "bbox": [[0, 0, 9, 9]],
        }
    ]


def frames(values, first=0):
    return [{"frame_id": i, "instances": instances(each)} for i, each in enumerate(values, first)]


def demo(content):
    """Returns the content of a file of MMPose's demo scripts."""
    return {"meta_info": {"dataset_name": "coco"}, "instance_info": content}


OF_NAMES = lambda values: zip(NAMES, values, strict=True)
OF_CAMERAS = lambda values: ((i // 2, i % 2, each) for i, each in enumerate(values))
VIDEO = ("f_0000", "f_0001", "f_0002")
FOLDERS = {
    "OpenPose": (
        OPENPOSE_67,
        NAMES,
        lambda v: {f"{n}_keypoints": openpose(openpose_person(x)) for n, x in OF_NAMES(v)},
    ),
    "OpenPose of videos": (
        OPENPOSE_67,
        CAMERA_NAMES,
        lambda v: {
            f"cam{c}_{f:012d}_keypoints": openpose(openpose_person(x)) for c, f, x in OF_CAMERAS(v)
        },
    ),
    "OpenPose in a folder for each camera": (
        OPENPOSE_67,
        CAMERA_NAMES,
        lambda v: {
            f"cam{c}/{f:06d}_keypoints": openpose(openpose_person(x)) for c, f, x in OF_CAMERAS(v)
        },
    ),
    "RTMPose's Halpe in OpenPose's form": (
        HALPE_26,
        ("front",),
        lambda v: {"front": openpose({"person_id": [-1], "pose_keypoints_2d": flat(v[0])})},
    ),
    "EasyMocap": (
        OPENPOSE_67,
        CAMERA_NAMES,
        lambda v: {
            f"cam{c}/{f:06d}": annots(x, f"images/cam{c}/{f:06d}.jpg") for c, f, x in OF_CAMERAS(v)
        },
    ),
    "EasyMocap, Halpe": (HALPE_136, NAMES, lambda v: {n: annots(x, None) for n, x in OF_NAMES(v)}),
    "MMPose's demo": (
        COCO_17,
        NAMES,
        lambda v: {f"results_{n}": demo(instances(x)) for n, x in OF_NAMES(v)},
    ),
    "MMPose's demo of a video": (COCO_17, VIDEO, lambda v: {"walk": demo(frames(v, 1))}),
    "MMPose of two videos": (
        COCO_WHOLEBODY_133,
        CAMERA_NAMES,
        lambda v: {f"cam{i}": frames(v[2 * i : 2 * i + 2]) for i in (0, 1)},
    ),
}
"""The set of points, the views, and the files that are written from the points, by format."""


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_of_files(kind, tmp_path):
    keypoint_set, names, files = FOLDERS[kind]
    values = known(len(keypoint_set.names), len(names))
    written = [write(tmp_path / f"{name}.json", content) for name, content in files(values).items()]
    check(read(tmp_path, names), values, keypoint_set)
    if len(written) == 1:
        check(read(written[0], names), values, keypoint_set)


def test_people_of_easymocap_are_chosen_by_their_id(tmp_path):
    values = known(67)
    for name, each in zip(NAMES, values, strict=True):
        content = annots(each, f"{name}.jpg", 1)
        if name == "front":  # somebody else, in one view alone
            content["annots"].append(annots(np.add(each, [1, 1, 0]), "", 0)["annots"][0])
        write(tmp_path / f"{name}.json", content)
    check(read(tmp_path, person=1), values, OPENPOSE_67)


@pytest.mark.parametrize(
    ("ids", "order"), [([1, 100], [1, 0]), ([2, -1, -1], [1, 2, 0]), ([None, 0], [1, 0])]
)
def test_nobody_is_lost_whose_id_of_easymocap_is_no_count(ids, order, tmp_path):
    values = known(67, 1)[0]
    content = annots(values, "front.jpg", ids[0])
    for shift, number in enumerate(ids[1:], 1):
        other = annots(np.add(values, [shift, 0, 0]), "", number)
        content["annots"] += other["annots"]
    write(tmp_path / "front.json", content)
    for person, shift in enumerate(order):
        found = read(tmp_path, ("front",), person=person)
        np.testing.assert_allclose(found.points[0], values[:, :2] + [shift + 0.5, 0.5])


@pytest.mark.parametrize("tool", ["openpose", "mmpose"])
def test_nobody_is_found_in_a_view(tool, tmp_path):
    values = known(67 if tool == "openpose" else 17)
    for name, each in zip(NAMES, values, strict=True):
        nobody = name == "back"
        if tool == "openpose":
            content = openpose() if nobody else openpose(openpose_person(each))
        else:
            content = [] if nobody else instances(each)
        write(tmp_path / f"{name}.json", content)
    keypoints = read(tmp_path)
    assert keypoints.missing == ("back",) and not keypoints.confidences[1].any()
    np.testing.assert_array_equal(keypoints.points[[0, 2]], values[[0, 2], :, :2] + 0.5)


# COCO
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keypoint_set", [COCO_17, HALPE_26, COCO_WHOLEBODY_133, HALPE_136])
@pytest.mark.parametrize("key", ["image_id", "file_name"])
def test_coco_results_and_alphapose_by_name(tmp_path, keypoint_set, key):
    values = known(len(keypoint_set.names))
    entries = [
        {"image_id": 7, key: f"{name}.jpg", "category_id": 1, "keypoints": flat(each), "score": 2.9}
        for name, each in reversed(list(zip(NAMES, values, strict=True)))
    ]
    file = write(tmp_path / "out" / "alphapose-results.json", entries)
    check(read(file), values, keypoint_set)
    check(read(file.parent), values, keypoint_set)  # a folder of one file


def parts(values):
    names = ("keypoints", "foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts")
    return {k: flat(v) for k, v in zip(names, np.split(values, [17, 23, 91, 112]), strict=True)}


def test_whole_body_results_in_parts(tmp_path):
    values = known(133)
    entries = [{"image_id": name, **parts(each)} for name, each in zip(NAMES, values, strict=True)]
    del entries[1]["face_kpts"]
    values[1, 23:91] = 0
    check(read(write(tmp_path / "r.json", entries)), values, COCO_WHOLEBODY_133)


@pytest.mark.parametrize("whole", [False, True])
def test_annotations_tell_visibility(tmp_path, whole):
    values = known(133 if whole else 17)
    values[..., 2] = np.arange(values.shape[1]) % 3  # 0 not labelled, 1 hidden, 2 visible
    images = [
        {"id": 5 + i, "file_name": f"{n}.png", "width": 320, "height": 240}
        for i, n in enumerate(NAMES)
    ]
    entries = [
        {
            "id": i,
            "image_id": 5 + i,
            "iscrowd": 0,
            **(parts(each) if whole else {"keypoints": flat(each)}),
        }
        for i, each in enumerate(values)
    ]
    entries += [
        {"id": 8, "image_id": 5, "iscrowd": 1, "keypoints": [9.0, 9.0, 2.0] * 17},
        {"id": 9, "image_id": 5},
    ]
    values[..., 2] /= 2  # hidden is half sure
    file = write(tmp_path / "person_keypoints.json", {"images": images, "annotations": entries})
    check(read(file), values, COCO_WHOLEBODY_133 if whole else COCO_17)


# Ours
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keypoint_set", KEYPOINT_SETS.values(), ids=lambda each: each.name)
def test_our_own_file_round_trips_exactly(tmp_path, keypoint_set):
    rng = np.random.default_rng(1)
    shape = (3, len(keypoint_set.names))
    points = rng.uniform(-40, 300, (*shape, 2)).astype(np.float32)
    confidences = rng.uniform(size=shape).astype(np.float32)
    confidences[1] = 0
    saved = Keypoints(points, confidences, keypoint_set, missing=("back",))
    save_keypoints(tmp_path / "k.npz", saved, NAMES)
    back = read(tmp_path / "k.npz")
    np.testing.assert_array_equal(back.points, points)
    np.testing.assert_array_equal(back.confidences, confidences)
    assert (back.set, back.missing, len(back.warnings)) == (keypoint_set, ("back",), 1)
    assert [file.name for file in tmp_path.iterdir()] == ["k.npz"]  # nothing aside is left
    other = read(shutil.copy(tmp_path / "k.npz", tmp_path / "K.NPZ"))
    np.testing.assert_array_equal(other.points, points)
    assert len(other.warnings) == 1
    swapped = read(tmp_path / "k.npz", ("left", "front"))
    np.testing.assert_array_equal(swapped.points, points[[2, 0]])


def people_file(path):
    """Writes a file of `humangs detect`; the second person is not in the second image."""
    rng = np.random.default_rng(2)

    def person():
        return SeenPerson(
            np.concatenate(
                [rng.integers(0, 800, (33, 2)) / 4, rng.integers(1, 17, (33, 1)) / 16], axis=1
            ),
            rng.integers(-8, 8, (33, 3)) / 8,
            0.5,
        )

    images = [
        ImagePeople(
            f"{name}.jpg", SIZE, tuple(None if (i, j) == (1, 1) else person() for j in range(2))
        )
        for i, name in enumerate(NAMES)
    ]
    write_people(path, images)
    return images


def test_people_of_our_detector_round_trip_exactly(tmp_path):
    images = people_file(tmp_path / "keypoints.json")
    kind, back = read_people(tmp_path / "keypoints.json")
    assert kind is MEDIAPIPE_33 and [(i.image, i.size) for i in back] == [
        (i.image, i.size) for i in images
    ]
    for image, again in zip(images, back, strict=True):
        for a, b in zip(image.people, again.people, strict=True):
            assert (a is None) == (b is None)
            if a is not None and b is not None:
                np.testing.assert_array_equal(a.points, b.points)
                np.testing.assert_array_equal(a.world, b.world)
                assert a.presence == b.presence


@pytest.mark.parametrize("where", ["keypoints.json", "."])
def test_a_person_of_our_detector_is_read_by_number(tmp_path, where):
    images = people_file(tmp_path / "keypoints.json")
    with pytest.raises(CaptureError, match=r"view front: 2 people: expected one\. Person I"):
        read(tmp_path / where)
    found = read(tmp_path / where, person=1)
    assert found.set is MEDIAPIPE_33 and found.missing == ("back",)
    # no half pixel is added
    np.testing.assert_array_equal(found.points[0], images[0].people[1].points[:, :2])
    np.testing.assert_array_equal(found.confidences[2], images[2].people[1].points[:, 2])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: c.update(set="faces"), "set: expected one of .*mediapipe33.*, got 'faces'"),
        (lambda c: c["images"][0].pop("people"), r"images\[0\]\.people: missing"),
        (
            lambda c: c["images"][0]["people"][0]["pixels"].pop(),
            r"people\[0\]\.pixels: .*\(33, 2\), got \(32, 2\)",
        ),
    ],
)
def test_damaged_files_of_our_detector_are_one_line(tmp_path, change, problem):
    path = tmp_path / "keypoints.json"
    people_file(path)
    edit_json(path, change)
    with pytest.raises(CaptureError, match=problem) as error:
        read(path, person=0)
    assert "\n" not in str(error.value)


# Views by name and number
# ----------------------------------------------------------------------------------------------

CAMERAS = ("images_cam0_000000", "images_cam0_000012", "images_cam1_000000", "images_cam1_000012")


@pytest.mark.parametrize(
    "images, names, views",
    [
        (["back.jpg", "front.png", "other.png"], ("front", "back"), [1, 0, None]),
        (["/a/b/my photo (1).JPG"], ("my_photo__1_",), [0]),
        (["C:\\photos\\front.png"], ("front",), [0]),
        (["front.v2.png", "front.v2"], ("front.v2",), "both"),
        (["cam1/000012.png", "cam0/000000.png"], CAMERAS, [3, 0]),
        (["cam1_000000000012", "cam0_000000000000"], CAMERAS, [3, 0]),  # OpenPose on videos
        (["cam1/12"], CAMERAS, [3]),  # MMPose on videos
        (["000012.png"], CAMERAS, [None]),  # of which camera?
        # a video's frames from 0 and photos from 1, or the other way round: in order, for each
        # video by itself
        (
            ["f_000000000000", "f_000000000001", "f_000000000002"],
            ("f_001", "f_002", "f_003"),
            [0, 1, 2],
        ),
        (["f_1", "f_3", "f_2"], ("f_000", "f_001", "f_002"), [0, 2, 1]),
        (["b/0", "a/1", "b/1", "a/2"], ("v_a_1", "v_b_1", "v_a_2", "v_b_2"), [1, 0, 3, 2]),
        (["a_0.jpg", "a_1.jpg", "b_0.jpg", "b_1.jpg"], ("a_1", "a_2", "b_0", "b_1"), [0, 1, 2, 3]),
        # who knows: the numbers as they are
        (["f_0", "f_1", "f_2", "f_3"], ("f_1", "f_2", "f_3"), [None, 0, 1, 2]),
        (["f_0", "f_2", "f_3"], ("f_1", "f_2", "f_3"), [None, 1, 2]),
        (["cam_2", "cam_3"], ("cam_1", "cam_2"), [1, None]),
        (["1"], ("cam_1", "11"), [None]),
        (["cam0/000000", "cam1/000000"], ("000000",), "both"),
        (["01", "1"], ("1", "01"), [1, 0]),  # as written, before numbers as numbers
        (["a.jpg", "photo(1).jpg", "b.jpg"], ("a", "photo_1_"), [0, 1, None]),
    ],
)
def test_names(images, names, views):
    if views == "both":
        with pytest.raises(ValueError, match=f"are both for view '{names[0]}'"):
            match_views(images, names)
    else:
        assert match_views(images, names) == views


@pytest.mark.parametrize(
    "numbers, names, views",
    [
        ([139, 285], ("000000000285", "000000000139"), [1, 0]),
        ([3, 1], ("cam_1", "cam_2"), [None, 0]),
        ([0, 1, 2], ("f_001", "f_002", "f_003"), [0, 1, 2]),  # ffmpeg counts from 1
        ([0, 1, 2], ("f_100", "f_101", "f_102"), [0, 1, 2]),
        # who knows: the numbers as they are
        ([0, 1, 2, 3], ("f_001", "f_002", "f_003"), [None, 0, 1, 2]),
        ([1, 2, 3, 4], ("cam0_rgb", "cam1_rgb", "cam2_rgb", "cam3_rgb"), [0, 1, 2, 3]),
        ([3, 4], ("left_1", "left_2", "right_3", "right_4"), [2, 3]),  # not one for every view
    ],
)
def test_numbers(numbers, names, views):
    assert match_views(numbers, names) == views


def test_numbers_of_several_cameras_are_refused():
    with pytest.raises(
        ValueError, match=r"number 12 could be view 'images_cam0_000012' and 'images_cam1_000012'"
    ):
        match_views([12], CAMERAS)


# Sets of points
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keypoint_set", KEYPOINT_SETS.values(), ids=KEYPOINT_SETS)
def test_names_are_different_and_mirrors_are_mutual(keypoint_set):
    assert len(keypoint_set.names) == len(set(keypoint_set.names)) == len(keypoint_set.mirror)
    assert keypoint_set.name.endswith(str(len(keypoint_set.names)))
    for i, j in enumerate(keypoint_set.mirror):
        assert keypoint_set.mirror[j] == i
        name, other = keypoint_set.names[i], keypoint_set.names[j]
        if name.startswith("left_"):
            assert other == "right_" + name.removeprefix("left_")
        elif not name.startswith(("right_", "face_")):
            assert other == name


PAGES = [
    (
        COCO_17,
        "0 nose, 1 left_eye, 4 right_ear, 9 left_wrist, 12 right_hip, 16 right_ankle",
    ),
    (
        COCO_WHOLEBODY_133,
        "17 left_big_toe, 19 left_heel, 20 right_big_toe, 22 right_heel, 23 face_0, 90 face_67, "
        "91 left_hand_root, 95 left_thumb_tip, 96 left_index_1, 112 right_hand_root, "
        "132 right_pinky_tip",
    ),
    (
        OPENPOSE_67,
        "1 neck, 2 right_shoulder, 4 right_wrist, 5 left_shoulder, 8 mid_hip, 9 right_hip, "
        "14 left_ankle, 15 right_eye, 18 left_ear, 19 left_big_toe, 24 right_heel, "
        "25 left_hand_root, 46 right_hand_root, 47 right_thumb_1, 50 right_thumb_tip, "
        "66 right_pinky_tip",
    ),
    (
        MEDIAPIPE_33,
        "0 nose, 1 face_42, 2 left_eye, 5 right_eye, 6 face_36, 8 right_ear, 9 face_54, "
        "11 left_shoulder, 16 right_wrist, 17 left_pinky_1, 20 right_index_1, 22 right_thumb_2, "
        "24 right_hip, 28 right_ankle, 30 right_heel, 32 right_foot_index",
    ),
]
"""Sets of points, and numbers and names of some points on the pages of the tools."""


@pytest.mark.parametrize(("keypoint_set", "points"), PAGES)
def test_points_are_where_the_tools_have_them(keypoint_set, points):
    for point in points.split(", "):
        number, name = point.split()
        assert keypoint_set.names[int(number)] == name


def test_landmarks_of_the_face_mirror_as_in_300w():
    jaw_brows_nose = ((0, 16), (8, 8), (17, 26), (21, 22), (27, 27), (30, 30), (31, 35), (33, 33))
    eyes_mouth = (
        (36, 45),
        (39, 42),
        (37, 44),
        (41, 46),
        (40, 47),
        (48, 54),
        (51, 51),
        (55, 59),
        (60, 64),
        (62, 62),
        (65, 67),
    )
    names = COCO_WHOLEBODY_133.names
    for a, b in (*jaw_brows_nose, *eyes_mouth):
        assert COCO_WHOLEBODY_133.mirror[names.index(f"face_{a}")] == names.index(f"face_{b}")


# Orders of OpenPose's points
# ------------------------------------------------------------------------------------------

COCO_18 = (
    *(
        "nose",
        "neck",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
    ),
    *("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
)
TOES = (
    "left_big_toe",
    "left_small_toe",
    "left_heel",
    "right_big_toe",
    "right_small_toe",
    "right_heel",
)
ORDERS = {
    "BODY_25": OPENPOSE_67.names[:25],
    "BODY_25B": (*COCO_17.names, "upper_neck", "head_top", *TOES),
    "OpenPose's COCO": COCO_18,
    "COCO with a neck": (*COCO_17.names, "neck"),
}
STANDING = {
    **{
        "nose": (150, 40),
        "left_eye": (154, 36),
        "right_eye": (146, 36),
        "left_ear": (160, 38),
        "right_ear": (140, 38),
    },
    **{
        "left_shoulder": (168, 64),
        "right_shoulder": (132, 64),
        "left_elbow": (176, 92),
        "right_elbow": (122, 90),
    },
    **{
        "left_wrist": (180, 116),
        "right_wrist": (104, 70),
        "left_hip": (162, 116),
        "right_hip": (138, 116),
    },
    **{
        "left_knee": (164, 158),
        "right_knee": (134, 156),
        "left_ankle": (164, 200),
        "right_ankle": (132, 198),
    },
    **{"left_big_toe": (168, 206), "left_small_toe": (172, 205), "left_heel": (162, 203)},
    **{"right_big_toe": (128, 205), "right_small_toe": (124, 204), "right_heel": (133, 202)},
    **{"neck": (150, 64), "mid_hip": (150, 116), "upper_neck": (150, 56), "head_top": (150, 20)},
}
"""Pixels of a person who faces the camera and raises the right hand."""


def standing(order, seen=lambda name: True):
    """Returns OpenPose's flat list of the seen points, in one of the orders."""
    points = [(*STANDING[name], 0.8) if seen(name) else (0, 0, 0) for name in ORDERS[order]]
    return [float(number) for point in points for number in point]


def assert_named(keypoints, seen=lambda name: True):
    """Checks that points have the places of their names."""
    for view in range(len(keypoints.points)):
        for name, point, confidence in zip(
            keypoints.set.names, keypoints.points[view], keypoints.confidences[view], strict=True
        ):
            if confidence:
                np.testing.assert_allclose(point - 0.5, STANDING[name], atol=0.51, err_msg=name)
            else:
                assert name not in STANDING or not seen(name), name


@pytest.mark.parametrize("seen", ["all", "without legs", "without the head", "some"])
@pytest.mark.parametrize("order", ORDERS)
def test_the_order_of_openposes_points_is_found_by_where_they_lie(order, seen, tmp_path):
    hidden = {
        "all": (),
        "without legs": ("knee", "ankle", "toe", "heel"),
        "without the head": ("eye", "ear", "nose", "head"),
    }
    hidden |= {"some": ("left_elbow", "right_knee", "left_eye", "small_toe")}
    visible = lambda name: not any(part in name for part in hidden[seen])
    for name in NAMES:
        write(
            tmp_path / f"{name}_keypoints.json",
            {"version": 1.3, "people": [{"pose_keypoints_2d": standing(order, visible)}]},
        )
    found = read(tmp_path)
    assert found.set.name == {"BODY_25": "openpose67", "BODY_25B": "openpose_b67"}.get(
        order, "openpose60"
    )
    assert_named(found, visible)
    assert [line for line in found.warnings if order in line] == list(found.warnings)[
        : order != "BODY_25"
    ]


def test_easymocaps_25_points_may_be_in_either_order_and_keep_their_hands(tmp_path):
    hand = [[100.0 + i, 50.0, 0.5] for i in range(21)]
    body = np.reshape(standing("BODY_25B"), (-1, 3)).tolist()
    annots = {"annots": [{"personID": 0, "keypoints": body, "handl2d": hand, "handr2d": hand}]}
    found = read(write(tmp_path / "front.json", annots), ("front",))
    assert_named(dataclasses.replace(found, confidences=found.confidences * (np.arange(67) < 25)))
    np.testing.assert_array_equal(found.points[0, 25:46] - 0.5, np.asarray(hand)[:, :2])


def test_an_order_that_is_not_clear_is_the_usual_one_with_a_warning(tmp_path):
    few = lambda name: name in ("nose", "left_wrist", "right_wrist", "left_big_toe", "left_eye")
    for order, line in (
        ("BODY_25B", "taken for BODY_25, not BODY_25B"),
        ("COCO with a neck", "taken for OpenPose's COCO, not"),
    ):
        people = [{"pose_keypoints_2d": standing(order, few)}]
        found = read(write(tmp_path / "front.json", {"people": people}), ("front",))
        assert any("is not clear" in each and line in each for each in found.warnings)


def test_frames_of_nodes_are_a_list_of_objects_with_a_canvas(tmp_path):
    """ControlNet's nodes write such files, with null for hands that were not found."""
    person = {
        "pose_keypoints_2d": standing("OpenPose's COCO"),
        "hand_left_keypoints_2d": None,
        "face_keypoints_2d": None,
    }
    frames = [
        {"people": [person], "canvas_width": SIZE[0], "canvas_height": SIZE[1]} for _ in NAMES
    ]
    assert_named(read(write(tmp_path / "poses.json", frames), ("0", "1", "2")))
    assert_named(read(write(tmp_path / "front.json", frames[:1]), ("front",)))
    nobody = {
        "people": [{"pose_keypoints_2d": None}],
        "canvas_width": SIZE[0],
        "canvas_height": SIZE[1],
    }
    assert read(write(tmp_path / "poses.json", [*frames[:2], nobody]), ("0", "1", "2")).missing == (
        "2",
    )
