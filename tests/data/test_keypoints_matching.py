import pytest

from humangs_jax.data.keypoints.reading import match_views

CAMERAS = ("images_cam0_000000", "images_cam0_000012", "images_cam1_000000", "images_cam1_000012")


@pytest.mark.parametrize(
    "images, names, views",
    [
        (["back.jpg", "front.png", "other.png"], ("front", "back"), [1, 0, None]),
        (["/a/b/my photo (1).JPG"], ("my_photo__1_",), [0]),
        (["C:\\photos\\front.png"], ("front",), [0]),
        (["front.v2.png", "front.v2"], ("front.v2",), "both"),
        (["front.v2"], ("front.v2",), [0]),
        (["cam1/000012.png", "cam0/000000.png"], CAMERAS, [3, 0]),
        (["images/cam1/000012.png"], CAMERAS, [3]),
        (["cam1_000000000012", "cam0_000000000000"], CAMERAS, [3, 0]),  # OpenPose on videos
        (["cam1/12"], CAMERAS, [3]),  # MMPose on videos
        (["000012.png"], CAMERAS, [None]),  # of which camera?
        # a video's frames from 0 and photos from 1, or the other way round: in order, for each video by itself
        (["f_000000000000", "f_000000000001", "f_000000000002"], ("f_001", "f_002", "f_003"), [0, 1, 2]),
        (["f_1", "f_3", "f_2"], ("f_000", "f_001", "f_002"), [0, 2, 1]),
        (["b/0", "a/1", "b/1", "a/2"], ("v_a_1", "v_b_1", "v_a_2", "v_b_2"), [1, 0, 3, 2]),
        (["a_0.jpg", "a_1.jpg", "b_0.jpg", "b_1.jpg"], ("a_1", "a_2", "b_0", "b_1"), [0, 1, 2, 3]),
        (["0", "1"], ("000001", "000002"), [0, 1]),
        # who knows: the numbers as they are
        (["f_0", "f_1", "f_2", "f_3"], ("f_1", "f_2", "f_3"), [None, 0, 1, 2]),
        (["f_0", "f_1"], ("f_1", "f_2", "f_3"), [None, 0]),
        (["f_0", "f_2", "f_3"], ("f_1", "f_2", "f_3"), [None, 1, 2]),
        (["cam_2", "cam_3"], ("cam_1", "cam_2"), [1, None]),
        (["cam_0"], ("cam_1",), [None]),
        (["frame_0"], ("0",), [None]),
        (["1"], ("cam_1", "11"), [None]),
        (["cam0/000000", "cam1/000000"], ("000000",), "both"),
        (["01", "1"], ("1", "01"), [1, 0]),  # as written, before numbers as numbers
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
        ([1, 2, 3], ("f_000", "f_001", "f_002"), [0, 1, 2]),
        ([0, 1, 2, 3], ("f_001", "f_002", "f_003"), [None, 0, 1, 2]),  # who knows: the numbers as they are
        ([0, 2, 3], ("f_001", "f_002", "f_003"), [None, 1, 2]),  # gaps
        ([5], ("front", "back"), [None]),
        ([], ("front",), []),
    ],
)
def test_numbers(numbers, names, views):
    assert match_views(numbers, names) == views


def test_numbers_of_several_cameras_are_refused():
    with pytest.raises(ValueError, match=r"number 12 could be view 'images_cam0_000012' and 'images_cam1_000012'"):
        match_views([12], CAMERAS)
