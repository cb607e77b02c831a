"""`humangs detect`: who is chosen, what is written, and what is said where that is not clear."""

import shutil
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_json

from humangs_jax import cli
from humangs_jax.apps import detect
from humangs_jax.apps.detect import Found, PhotoPeople, choose, person_mask, same_people, write_found
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.data.capture import load_capture
from humangs_jax.data.keypoints.formats import SeenPerson
from humangs_jax.data.keypoints.keypoints import MEDIAPIPE_33
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.io.images import read_grey, write_png

SIZE = (40, 30)
BESIDE = np.asarray([0.8, 0.0, 0.3])
"""Metres from the demo's person to the other one."""
DEMO = Path(detect.__file__).parents[1] / "assets" / "demo_capture"


def found(mark, area, corner=(5, 10)):
    """A person whose pixels are all `mark`."""
    points = np.concatenate([np.full((33, 2), float(mark)), np.ones((33, 1))], axis=1)
    return Found(SeenPerson(points, np.zeros((33, 3)), 1.0), np.full((8, 4), 255, np.uint8), corner, area)


def photo(name, *people):
    return PhotoPeople(name, SIZE, np.ones((30, 40, 3)), people)


def marks(photos):
    return [[None if each is None else each.person.points[0, 0] for each in p.people] for p in photos]


def test_without_cameras_the_largest_of_each_photo_is_the_person(tmp_path):
    photos = same_people([photo("a", found(1, 90.0), found(2, 20.0)), photo("b"), photo("c", found(3, 80.0))])
    assert marks(photos) == [[1, 2], [None, None], [3, None]]
    assert choose(photos, None, tmp_path / "s.png") == 0 and choose(photos, 1, tmp_path / "s.png") == 1
    assert detect.remarks(photos, 1) == [f"{name}: the person was not found in it" for name in ("b", "c")]


def test_who_is_meant_is_never_guessed(tmp_path):
    photos = same_people([photo("a", found(1, 90.0), found(2, 60.0)), photo("b", found(3, 80.0))])
    with pytest.raises(ValueError, match=r"2 people in a: expected one\. Person 0 to 1: numbers on .*s\.png"):
        choose(photos, None, tmp_path / "s.png")
    with pytest.raises(ValueError, match=r"^person 2: expected 0 to 1, as on .*s\.png"):
        choose(photos, 2, tmp_path / "s.png")
    with pytest.raises(ValueError, match="no person in a, b: expected one"):
        choose([photo("a"), photo("b")], 0, tmp_path / "s.png")


def colored(name, *shades, size=(60, 40)):
    """A photo of people side by side, each of one grey."""
    picture, people = np.ones((size[1], size[0], 3)), []
    for i, shade in enumerate(shades):
        picture[:, 20 * i : 20 * i + 20] = shade
        person = found(shade, 90.0 - i)
        person.person.points[:, :2] = 20 * i + 10, 20
        people.append(person)
    return PhotoPeople(name, size, picture, tuple(people))


def test_without_cameras_colors_tell_large_people_apart(tmp_path):
    photos = same_people([colored("a", 0.9, 0.1), colored("b", 0.2, 0.8), colored("c", 0.05), colored("d")])
    shades = [[None if each is None else int(each.area) for each in p.people] for p in photos]
    assert shades == [[89, 90], [90, 89], [90, None], [None, None]]  # the dark one has more pixels in all
    with pytest.raises(ValueError, match="2 people in a, b: expected one"):
        choose(photos, None, tmp_path / "s.png")
    assert choose(photos, 1, tmp_path / "s.png") == 1


def test_people_of_one_color_are_not_mixed_in_silence(tmp_path):
    photos = same_people([colored("a", 0.9, 0.1), colored("b", 0.5, 0.5), colored("c", 0.9, 0.2)])
    with pytest.raises(ValueError, match=r"^b: which of the people of .*people\.png is meant\? Their colors do not tell"):
        choose(photos, 1, tmp_path / "people.png")
    assert (tmp_path / "people.png").is_file()


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
        x, y = np.floor(keypoints.points[i]).astype(int).T
        assert expected[y, x].mean() > 0.9


def test_without_litert_it_is_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    (tmp_path / "photos").mkdir()
    write_png(tmp_path / "photos" / "black.png", np.zeros((64, 64, 3)))
    assert cli.execute(["detect", str(tmp_path / "photos"), "--out", str(tmp_path / "found")]) == cli.BAD_DATA
    said = capsys.readouterr().err
    assert "error: finding people in photos needs LiteRT: pip install 'humangs_jax[photos]'" in said and said.count("\n") == 1


def test_a_capture_without_masks_gets_its_people_matched_by_its_cameras(tmp_path, monkeypatch):
    """The second person of one view comes first there: only the cameras tell."""
    capture = load_capture("demo_capture")
    shutil.copytree(DEMO, tmp_path / "c")
    edit_json(tmp_path / "c" / "capture.json", lambda d: [view.pop("mask", None) for view in d["views"]])
    model = landmark_model(capture.body, MEDIAPIPE_33.names)
    points = np.asarray(pose_landmarks(model, jnp.asarray(capture.betas), capture.pose(0))[0])
    shown = []
    for v in range(4):
        K, transform = (np.asarray(x[v], float) for x in (capture.cameras.K, capture.cameras.cam_from_world))
        people = []
        for area, place in ((50.0, points), (40.0, points + BESIDE)):
            local = (place @ transform[:3, :3].T + transform[:3, 3]) @ K.T
            pixels = np.c_[local[:, :2] / local[:, 2:], np.asarray(model.known, float)]
            people.append(found(0, area)._replace(person=SeenPerson(pixels, np.zeros((33, 3)), 1.0)))
        if v == 2:
            mirrored = people[1].person.points[np.asarray(MEDIAPIPE_33.mirror)]
            people[1] = people[1]._replace(person=SeenPerson(mirrored, np.zeros((33, 3)), 1.0), area=70.0)
            people.reverse()
        shown.append(photo(f"{capture.names[v]}.png", *people))
    monkeypatch.setattr(detect, "detect_photos", lambda names, photos: shown)
    ordered = detect.found_in_photos(tmp_path / "c")
    assert [p.people[0].area for p in ordered] == [50.0, 50.0, 50.0, 50.0]
    repaired = lambda person: [line for line in detect.remarks(ordered, person) if line.endswith("repaired")]
    assert repaired(0) == [] and [line.split(":")[0] for line in repaired(1)] == [f"{capture.names[2]}.png"]


def test_two_photos_never_share_a_mask(tmp_path):
    photos = same_people([photo("a.jpg", found(1, 90.0)), photo("a.png", found(2, 90.0))])
    with pytest.raises(ValueError, match=r"a\.jpg and a\.png: both masks would be masks/a\.png"):
        write_found(tmp_path, photos, 0)
    assert list(tmp_path.iterdir()) == []
