"""`humangs detect`: which person is chosen, what is written, and when it warns."""

import dataclasses
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_json
from scipy.spatial.transform import Rotation

from humangs_jax import cli
from humangs_jax.apps import detect
from humangs_jax.apps.detect import (
    PersonInPhoto,
    PhotoPeople,
    choose,
    person_mask,
    same_people,
    write_found,
)
from humangs_jax.capture.detection.people import Crop, Detection, Landmarks, mask_in_photo
from humangs_jax.capture.detection.sharpening import sharpened
from humangs_jax.capture.keypoints.formats import SeenPerson
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, Keypoints
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.data.capture import load_capture
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import read_grey, to_uint8, write_png

SIZE = (40, 30)
DEMO = Path(detect.__file__).parents[1] / "assets" / "demo_capture"


def found(mark, area, corner=(5, 10)):
    """Returns a person with a crop at `corner` whose landmarks all have the coordinate `mark`."""
    points = np.concatenate([np.full((33, 2), float(mark)), np.ones((33, 1))], axis=1)
    return PersonInPhoto(
        SeenPerson(points, np.zeros((33, 3)), 1.0), np.full((8, 4), 255, np.uint8), corner, area
    )


def photo(name, *people):
    return PhotoPeople(name, SIZE, np.ones((30, 40, 3)), people)


def marks(photos):
    return [
        [None if each is None else each.person.points[0, 0] for each in p.people] for p in photos
    ]


def test_without_cameras_the_largest_of_each_photo_is_the_person(tmp_path):
    photos = same_people(
        [photo("a", found(1, 90.0), found(2, 20.0)), photo("b"), photo("c", found(3, 80.0))]
    )
    assert marks(photos) == [[1, 2], [None, None], [3, None]]
    assert (
        choose(photos, None, tmp_path / "s.png") == 0 and choose(photos, 1, tmp_path / "s.png") == 1
    )
    assert detect.remarks(photos, 1) == [
        f"{name}: the person was not found in it" for name in ("b", "c")
    ]


def test_who_is_meant_is_never_guessed(tmp_path):
    photos = same_people([photo("a", found(1, 90.0), found(2, 30.0)), photo("b", found(3, 80.0))])
    with pytest.raises(ValueError, match=r"^person 2: expected 0 to 1, as on .*s\.png"):
        choose(photos, 2, tmp_path / "s.png")
    with pytest.raises(ValueError, match="no person in a, b: expected one"):
        choose([photo("a"), photo("b")], 0, tmp_path / "s.png")


def test_sizes_and_colors_of_large_people_tell_nothing_across_photos(tmp_path):
    photos = same_people([photo("a", found(1, 90.0), found(2, 60.0)), photo("b", found(3, 80.0))])
    for person in (None, 0, 1):
        with pytest.raises(
            ValueError, match=r"^a.*: which of the people of .*s\.png is meant\? Nothing"
        ):
            choose(photos, person, tmp_path / "s.png")
    assert (tmp_path / "s.png").is_file()


def test_one_photo_of_three_people_says_so_and_takes_the_one_who_is_asked_for(tmp_path):
    photos = same_people([photo("a", found(1, 90.0), found(2, 60.0), found(3, 20.0))])
    with pytest.raises(
        ValueError, match=r"^3 people in a: expected one\. Person 0 to 2: numbers on .*s\.png"
    ):
        choose(photos, None, tmp_path / "s.png")
    assert choose(photos, 2, tmp_path / "s.png") == 2


def test_keypoints_and_masks_are_those_of_the_person_and_the_picture_shows_everybody(tmp_path):
    photos = same_people([photo("x/a.jpg", found(1, 90.0), found(2, 20.0)), photo("b.jpg")])
    write_found(tmp_path, photos, 1)
    kept = read_keypoints(tmp_path / "keypoints.json", ("x_a", "b"), *SIZE)
    assert kept.set is MEDIAPIPE_33 and kept.missing == ("b",) and (kept.points[0] == 2).all()
    mask = read_grey(tmp_path / "masks" / "x" / "a.png")
    np.testing.assert_array_equal(mask, person_mask(photos[0], 1))
    assert mask[5:13, 10:14].all() and mask.sum() == 32
    assert not read_grey(tmp_path / "masks" / "b.png").any()
    assert (tmp_path / "people.png").is_file()


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Two photos of the demo's person and an empty one, of another size."""
    folder = tmp_path_factory.mktemp("mine") / "photos"
    (folder / "images").mkdir(parents=True)
    for name in ("0_00", "0_02"):
        shutil.copy(DEMO / "images" / f"{name}.png", folder / "images" / f"{name}.png")
    write_png(folder / "images" / "empty.png", np.full((64, 96, 3), 0.5))
    return folder


def test_keypoints_and_masks_of_photos(photos, tmp_path, capsys):
    assert cli.execute(["detect", str(photos), "--out", str(tmp_path / "found")]) == 0
    out, err = capsys.readouterr()
    assert "warning: empty.png: the person was not found in it" in err and "keypoints.json" in out
    truth = load_capture("demo_capture")
    keypoints = read_keypoints(tmp_path / "found" / "keypoints.json", ("0_00", "0_02"), 512, 512)
    for i, view in enumerate((0, 2)):
        mask = read_grey(tmp_path / "found" / "masks" / f"{truth.names[view]}.png") > 0.5
        expected = truth.masks[view] > 0.5
        assert (mask & expected).sum() / (mask | expected).sum() > 0.9
        seen = keypoints.points[i][keypoints.confidences[i] > 0]  # a hand may be hidden
        x, y = np.floor(seen).astype(int).T
        assert len(seen) >= 27 and expected[y, x].mean() > 0.9


def test_without_litert_it_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    (tmp_path / "photos").mkdir()
    write_png(tmp_path / "photos" / "black.png", np.zeros((64, 64, 3)))
    assert (
        cli.execute(["detect", str(tmp_path / "photos"), "--out", str(tmp_path / "found")])
        == cli.BAD_DATA
    )
    message = capsys.readouterr().err
    assert (
        "error: finding people in photos needs LiteRT: pip install 'humangs_jax[photos]'" in message
        and message.count("\n") == 1
    )


# One person in front of calibrated cameras is one person
# ---------------------------------------------------------------

SIDE, FOCAL = 600, 700.0
"""Side and focal length of the photos, pixels."""
BODY = np.random.default_rng(3).normal(0, [0.15, 0.45, 0.1], (33, 3))
OTHER_BODY = np.random.default_rng(4).normal(0, [0.15, 0.45, 0.1], (33, 3))


def camera_at(degrees, turned=0.0, distance=3.5):
    """Returns cam_from_world of a camera that looks at the origin from `distance` metres.

    `degrees` is its angle around the vertical, `turned` a turn about its x axis.
    """
    look, tilt = (
        Rotation.from_euler(axis, angle, degrees=True).as_matrix()
        for axis, angle in (("y", degrees), ("x", turned))
    )
    return np.block(
        [[tilt @ look, (tilt @ [0, 0, distance])[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]
    )


def batch(matrices):
    K = jnp.asarray([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    cameras = [Camera(K, jnp.asarray(matrix, jnp.float32), SIDE, SIDE) for matrix in matrices]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def moved(body, *step):
    return body + np.asarray(step)


def seen_at(name, matrix, *bodies, areas=(9e3, 8e3)):
    """Returns a photo in which a camera sees these bodies."""
    people = []
    for body, area in zip(bodies, areas, strict=False):
        local = body @ matrix[:3, :3].T + matrix[:3, 3]
        pixels = np.c_[local[:, :2] / local[:, 2:] * FOCAL + SIDE / 2, np.ones(33)]
        people.append(found(0, area)._replace(person=SeenPerson(pixels, np.zeros((33, 3)), 1.0)))
    return PhotoPeople(
        name, (SIDE, SIDE), np.ones((30, 30, 3)), tuple(sorted(people, key=lambda each: -each.area))
    )


def is_in_every_photo(photos, sheet):
    return choose(photos, None, sheet) == 0 and all(photo.people[0] is not None for photo in photos)


WAYS = {
    "one camera that stands still": [camera_at(0)] * 4,
    "one camera that moves": [camera_at(angle) for angle in (0, 25, 50, 75)],
    "a camera for each moment": [
        camera_at(angle, distance=2 + angle / 100) for angle in (0, 90, 180, 270)
    ],
}


@pytest.mark.parametrize("cameras", WAYS.values(), ids=WAYS)
@pytest.mark.parametrize("step", [0.0, 0.4, 1.6])
def test_frames_that_one_view_sees_show_one_person(cameras, step, tmp_path):
    photos = [
        seen_at(f"{f}", matrix, moved(BODY, 0.3 * step * f, 0, step * f))
        for f, matrix in enumerate(cameras)
    ]
    photos = same_people(photos, batch(cameras), range(4))
    assert is_in_every_photo(photos, tmp_path / "s.png") and len(photos[0].people) == 1
    assert not any("is not where" in line for line in detect.remarks(photos, 0))


@pytest.mark.parametrize("step", [0.9, 1.1, 2.5])
def test_a_person_who_walks_far_between_moments_stays_one_person(step, tmp_path):
    views = [camera_at(0, distance=9.0), camera_at(70, distance=9.0)]
    photos = [
        seen_at(f"{f}{v}", views[v], moved(BODY, step * f, 0, 0))
        for f in range(3)
        for v in range(2)
    ]
    photos = same_people(photos, batch(views * 3), [0, 0, 1, 1, 2, 2])
    assert is_in_every_photo(photos, tmp_path / "s.png")
    assert not any("is not where" in line for line in detect.remarks(photos, 0))


@pytest.mark.parametrize("views", [3, 4, 6])
@pytest.mark.parametrize("turned", [6.0, -12.0])
def test_a_camera_that_is_off_shows_the_same_person_and_is_named(views, turned, tmp_path):
    true = [camera_at(360 * v / views + 7 * v) for v in range(views)]
    photos = [seen_at(f"c{v}", matrix, BODY) for v, matrix in enumerate(true)]
    wrong = [camera_at(0, turned), *true[1:]]
    photos = same_people(photos, batch(wrong))
    assert is_in_every_photo(photos, tmp_path / "s.png")
    (line,) = [line for line in detect.remarks(photos, 0) if "the calibration is off there" in line]
    assert line.split(":")[0] == "c0"
    write_found(tmp_path, photos, 0)
    assert all(read_grey(tmp_path / "masks" / f"c{v}.png").any() for v in range(views))


@pytest.mark.slow  # detects and fits
def test_a_fit_sees_the_photo_of_a_camera_that_is_off_and_turns_it_back(tmp_path, capsys):
    shutil.copytree(DEMO, tmp_path / "c", ignore=shutil.ignore_patterns("body.npz", "masks"))
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("x", 5, degrees=True).as_matrix()

    def change(description):
        for view in description["views"]:
            del view["mask"]
        first = description["views"][0]
        first["cam_from_world"] = (tilt @ np.asarray(first["cam_from_world"])).tolist()

    edit_json(tmp_path / "c" / "capture.json", change)
    assert cli.execute(["fit", str(tmp_path / "c")]) == 0
    out, err = capsys.readouterr()
    assert "0_00.png: the person is not where the other photos of the moment show them" in err
    assert "camera 0_00 is off by 5" in out and "turned back" in out
    assert all(read_grey(tmp_path / "c" / "masks" / f"0_0{v}.png").mean() > 0.1 for v in range(4))


def test_of_two_cameras_that_do_not_agree_both_are_named(tmp_path):
    photos = [seen_at(f"c{v}", camera_at(80 * v), BODY) for v in range(2)]
    photos = same_people(photos, batch([camera_at(0, 9.0), camera_at(80)]))
    assert is_in_every_photo(photos, tmp_path / "s.png")
    assert any(
        line.startswith("c0, c1: the person is not where") for line in detect.remarks(photos, 0)
    )


def test_bystanders_of_one_view_do_not_make_the_person_another(tmp_path):
    views = [camera_at(angle) for angle in (0, 80, 200, 290)]
    photos = [seen_at(f"c{v}", matrix, BODY) for v, matrix in enumerate(views)]
    photos[2] = seen_at("c2", views[2], BODY, moved(OTHER_BODY, 1.0, 0, 1.0), areas=(9e3, 9.5e3))
    photos = same_people(photos, batch(views))
    assert is_in_every_photo(photos, tmp_path / "s.png") and photos[2].people[0].area == 9e3


def test_two_people_are_followed_in_the_photos_of_one_camera(tmp_path):
    steps = [np.asarray([0.1 * f, 0, 0]) for f in range(4)]
    photos = [
        seen_at(f"{f}", camera_at(0), BODY - 0.8 + step, moved(OTHER_BODY, 0.8, 0, 0) - step)
        for f, step in enumerate(steps)
    ]
    photos[2] = dataclasses.replace(photos[2], people=tuple(reversed(photos[2].people)))
    photos = same_people(photos, batch([camera_at(0)] * 4), range(4))
    assert [[each.area for each in photo.people] for photo in photos] == [[9e3, 8e3]] * 4
    with pytest.raises(ValueError, match=r"2 people in 0, 1, 2, 3: expected one\. Person 0 to 1"):
        choose(photos, None, tmp_path / "s.png")
    assert choose(photos, 1, tmp_path / "s.png") == 1


def test_rivals_who_are_matched_to_nobody_are_asked_about_and_get_no_black_mask(tmp_path):
    """The photos show different moments from different sides: nothing tells who is who."""
    cameras = [camera_at(0), camera_at(180)]
    photos = [
        seen_at(f"{f}", matrix, BODY - 0.8, OTHER_BODY + 0.8) for f, matrix in enumerate(cameras)
    ]
    photos = same_people(photos, batch(cameras), [0, 1])
    with pytest.raises(ValueError, match=r"2 people in 0, 1: expected one\. Person 0 to 3"):
        choose(photos, None, tmp_path / "s.png")
    with pytest.raises(
        ValueError,
        match=r"which of the people of .*s\.png is meant\? Nothing tells",
    ):
        choose(photos, 0, tmp_path / "s.png")


def test_somebody_else_for_certain_is_not_the_person(tmp_path):
    """The last view shows only the person who stands beside the chosen one in the others."""
    views = [camera_at(angle) for angle in (0, 80, 200)]
    photos = [
        seen_at(f"c{v}", matrix, BODY, moved(OTHER_BODY, 0.7, 0, 0.4))
        for v, matrix in enumerate(views)
    ]
    photos[2] = seen_at("c2", views[2], moved(OTHER_BODY, 0.7, 0, 0.4), areas=(8e3,))
    photos = same_people(photos, batch(views))
    assert choose(photos, 1, tmp_path / "s.png") == 1
    assert [photo.people[1] and photo.people[1].area for photo in photos] == [9e3, 9e3, None]
    assert detect.remarks(photos, 1) == ["c2: the person was not found in it"]


def with_masks(photo, corners):
    people = tuple(
        each._replace(corner=corner) for each, corner in zip(photo.people, corners, strict=True)
    )
    return dataclasses.replace(photo, people=people)


@pytest.mark.parametrize("kind", ["masks", "keypoints"])
def test_masks_and_keypoints_choose_in_each_photo_whatever_the_matching_says(kind, tmp_path):
    places = [(5, 10), (15, 30)]
    photos = [with_masks(photo(name, found(1, 90.0), found(2, 80.0)), places) for name in "abc"]
    meant = [0, 1, 1]
    masks, points, confidences = (
        np.zeros((3, 30, 40), np.float32),
        np.zeros((3, 33, 2), np.float32),
        np.ones((3, 33), np.float32),
    )
    for v, i in enumerate(meant):
        top, left = places[i]
        masks[v, top : top + 8, left : left + 4] = 1
        points[v] = left + 2, top + 3
    given = list(masks) if kind == "masks" else Keypoints(points, confidences, MEDIAPIPE_33)
    settled, number = detect.person_of(
        [dataclasses.replace(each, known=False) for each in photos], given, tmp_path / "s.png"
    )
    assert [each.people[number].corner for each in settled] == [places[i] for i in meant]
    assert all(each.known for each in settled)


def looked_at(center, side):
    """Returns what the landmark network finds in a crop: an elliptic mask."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, 256)] * 2)
    mask = (u**2 / 0.3 + v**2 / 0.8 < 1).astype(np.float32)
    crop = Crop(np.asarray(center, float), side, 0.1)
    points = crop.to_photo(np.random.default_rng(0).uniform(0.3, 0.7, (33, 2)))
    return Landmarks(
        points, np.ones(33), np.zeros((33, 3)), 1.0, mask, crop, Detection(1.0, *np.eye(2))
    )


@pytest.mark.parametrize("center", [(150, 100), (8, 4), (295, 190)])
def test_a_mask_is_made_where_the_person_is_and_is_the_one_of_the_whole_photo(center):
    picture, person = (
        np.random.default_rng(0).uniform(size=(200, 300, 3)).astype(np.float32),
        looked_at(center, 120.0),
    )
    whole = to_uint8(sharpened(mask_in_photo(person, 300, 200), picture, 120 / 256))
    seen = detect._found(person, picture)
    (top, left), (height, width) = seen.corner, seen.mask.shape
    np.testing.assert_array_equal(whole[top : top + height, left : left + width], seen.mask)
    assert whole.sum() == seen.mask.sum() > 0


def test_landmarks_beyond_the_photo_or_under_what_hides_it_are_not_seen():
    person = looked_at((150, 195), 120.0)
    picture = np.full((200, 300, 3), 0.5, np.float32)
    seen = detect._found(person, picture)
    below = person.pixels[:, 1] + 0.5 >= 200
    assert below.any() and not below.all()
    np.testing.assert_array_equal(seen.person.points[:, 2] == 0, below)
    hidden = np.zeros((200, 300), bool)
    hidden[:, :150] = True
    whole = PhotoPeople("a", (300, 200), np.ones((2, 3, 3)), (None, seen))
    (covered,) = detect.without_hidden_landmarks([whole], [hidden])
    points = covered.people[1].person.points
    np.testing.assert_array_equal(points[:, 2] == 0, below | (points[:, 0] < 150))
    np.testing.assert_array_equal(points[:, :2], seen.person.points[:, :2])
    assert covered.people[0] is None
    assert detect.without_hidden_landmarks([whole], [None])[0] is whole
    assert detect.without_hidden_landmarks([whole], None)[0] is whole


def test_two_photos_never_share_a_mask(tmp_path):
    photos = same_people([photo("a.jpg", found(1, 90.0)), photo("a.png", found(2, 90.0))])
    with pytest.raises(ValueError, match=r"a\.jpg and a\.png: both masks would be masks/a\.png"):
        write_found(tmp_path, photos, 0)
    assert list(tmp_path.iterdir()) == []


def test_others_hide_the_person_where_they_stand_unless_they_are_behind(tmp_path):
    """Hidden pixels are written beside the masks of a capture, without the mask's own pixels."""
    person, other = found(1, 90.0), found(2, 80.0, corner=(7, 12))
    shown = photo("a", person, other)
    hidden = detect.hidden_by_others(shown, 0)
    assert hidden.sum() == 32 - 6 * 2 and not hidden[person_mask(shown, 0) > 0.5].any()
    behind = photo("a", person, other._replace(covered=True))
    assert detect.hidden_by_others(behind, 0) is None
    assert detect.hidden_by_others(behind, 1) is not None
    given = person_mask(shown, 1)
    assert detect.hidden_by_others(shown, 0, given) is None
    assert detect.hidden_by_others(photo("a", person), 0) is None
