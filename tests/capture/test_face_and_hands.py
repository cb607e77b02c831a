"""Where faces and hands are searched, and how hands become keypoints."""

import numpy as np
import pytest

from humangs_jax.apps.same_people import PersonInPhoto, exchanged
from humangs_jax.capture.detection.face_and_hands import (
    FaceAndHands,
    Hand,
    face_region,
    hand_columns,
    hand_region,
)
from humangs_jax.capture.keypoints.formats import (
    ImagePeople,
    SeenPerson,
    columns_of,
    write_people,
)
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, MEDIAPIPE_69
from humangs_jax.capture.keypoints.reading import read_keypoints

LEFT, RIGHT = (MEDIAPIPE_69.names.index(f"{side}_hand_root") for side in ("left", "right"))


def turned(points, degrees, middle=(100.0, 100.0)):
    """Returns the points of a photo after it was turned clockwise."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (points - middle) @ np.asarray([[c, s], [-s, c]]) + middle


def upright_body():
    """Returns landmarks of an upright face and of a left hand that points up."""
    body = np.zeros((33, 2))
    body[[2, 5]] = [[120, 90], [80, 90]]  # eyes: the person's left is on the right
    body[[9, 10]] = [[110, 130], [90, 130]]
    body[[15, 17, 19]] = [[200, 200], [190, 160], [210, 160]]
    return body


@pytest.mark.parametrize("degrees", [0, 30, 90, 180, -120])
def test_regions_turn_with_the_person_and_have_the_same_size(degrees):
    for region in (face_region, lambda body: hand_region(body, 0, 1.9)):
        upright, after = region(upright_body()), region(turned(upright_body(), degrees))
        assert after.side == pytest.approx(upright.side) and after.side > 60
        np.testing.assert_allclose(after.center, turned(upright.center, degrees), atol=1e-6)
        apart = np.degrees(after.angle - upright.angle) - degrees
        assert abs((apart + 180) % 360 - 180) < 1e-6
    assert face_region(upright_body()).angle == pytest.approx(0, abs=1e-9)


def test_a_face_is_whole_in_its_region():
    crop = face_region(upright_body())
    chin, brow = crop.from_photo(np.asarray([[100.0, 160], [100, 70]]))
    assert 0.1 < brow[1] < chin[1] < 0.9 and crop.from_photo(crop.center) == pytest.approx(0.5)


def hand(first):
    points = first + np.arange(42.0).reshape(21, 2)
    return Hand(points, np.full((21, 3), 0.01), 0.75)


def seen_person(hands):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.integers(0, 60, (33, 2)) + 0.5, np.full(33, 0.5)])
    world = rng.integers(-8, 8, (33, 3)) / 8
    return SeenPerson(points, world, 1.0, hand_columns(hands, world))


def test_hands_follow_the_body_in_the_keypoints_and_begin_at_its_wrists():
    person = seen_person((hand(3.0), None))
    columns = columns_of(person, hands=True)
    np.testing.assert_allclose(columns[LEFT : LEFT + 21, :2], hand(3.0).pixels)
    np.testing.assert_allclose(columns[LEFT, 3:], person.world[15] + 0.01)
    # of the hand that was not seen there is what BlazePose has
    names = MEDIAPIPE_33.names
    for part in ("pinky_1", "index_1", "thumb_2"):
        row = MEDIAPIPE_69.names.index(f"right_{part}")
        np.testing.assert_allclose(
            columns[row, :2], person.points[names.index(f"right_{part}"), :2]
        )
    assert columns[RIGHT, 2] == 0 and columns[MEDIAPIPE_69.names.index("right_ring_tip"), 2] == 0
    assert hand_columns((None, None), person.world) is None
    assert len(MEDIAPIPE_69.names) == len(set(MEDIAPIPE_69.names)) == 69


def test_hands_are_written_with_the_people_of_photos_and_read_again(tmp_path):
    people = [seen_person((hand(3.0), hand(9.0))), seen_person((None, None))]
    images = [ImagePeople(f"{i}.png", (64, 64), (each,)) for i, each in enumerate(people)]
    write_people(tmp_path / "keypoints.json", images)
    found = read_keypoints(tmp_path / "keypoints.json", ("0", "1"), 64, 64)
    assert found.set.name == "mediapipe69"
    inside = found.confidences[0] > 0  # what is outside of the photo does not count
    expected = columns_of(people[0], hands=True)
    np.testing.assert_allclose(found.points[0][inside], expected[inside, :2], atol=1e-3)
    assert inside[LEFT : LEFT + 21].any() and not found.confidences[1, RIGHT]
    # people without hands are as they were
    write_people(tmp_path / "few.json", images[1:])
    assert read_keypoints(tmp_path / "few.json", ("1",), 64, 64).set.name == "mediapipe33"


def test_hands_change_sides_where_left_and_right_were_exchanged():
    person = seen_person((hand(3.0), None))
    found = exchanged(PersonInPhoto(person, np.zeros((1, 1), np.uint8), (0, 0), 1.0))
    np.testing.assert_allclose(found.person.hands[21:, :2], hand(3.0).pixels)
    assert not found.person.hands[:21].any()


def test_a_photo_without_anybody_has_no_face_and_no_hands():
    """The networks that ship with the package find nothing in noise."""
    parts, noise = FaceAndHands(), np.random.default_rng(0).uniform(0, 1, (256, 256, 3))
    body = upright_body()
    assert parts.face(noise.astype(np.float32), body) is None
    assert parts.hands(noise.astype(np.float32), body, np.ones(33))[1] is None
    assert parts.hands(noise.astype(np.float32), body, np.zeros(33)) == (None, None)


def test_a_hand_that_the_small_region_does_not_show_is_looked_for_in_the_large_one(monkeypatch):
    looked = []

    def hand_in(self, photo, crop, wrist):
        looked.append(crop.side)
        return hand(3.0) if crop.side > 200 else None

    monkeypatch.setattr(FaceAndHands, "_hand_in", hand_in)
    photo, body = np.zeros((8, 8, 3), np.float32), upright_body()
    found, _ = FaceAndHands().hands(photo, body, 1.0 * (np.arange(33) == 15))
    assert found is not None and np.diff(looked) > 0 and len(looked) == 2
