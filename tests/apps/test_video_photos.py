"""Photos that are taken from a video: at which times, and of which person."""

import numpy as np
import pytest

from humangs_jax.apps import video_photos
from humangs_jax.apps.video_photos import MARK, photos_of_video, seconds_of_photos
from humangs_jax.avatar.video import write_video
from humangs_jax.capture.detection.people import Crop, Detection, Landmarks
from humangs_jax.io.reading import read_json, write_json
from tests.capture.test_frame_choice import turning

COUNT = 40


def seen_person(world):
    """Returns what the landmark network finds of a person with these 3D landmarks."""
    crop = Crop(np.full(2, 16.0), 32.0, 0.0)
    hips = np.full(2, 16.0)
    return Landmarks(
        pixels=np.tile(hips, (33, 1)),
        visibility=np.ones(33),
        world=world,
        presence=1.0,
        mask=np.ones((256, 256)),
        crop=crop,
        again=Detection(1.0, hips, hips - np.asarray([0.0, 12.0])),
    )


@pytest.fixture
def clip(tmp_path, monkeypatch):
    """Returns (path of a video of noise, list of calls of the network).

    A made-up detector sees a person in it who turns once around.
    """
    frames = np.random.default_rng(0).uniform(0, 1, (COUNT, 32, 32, 3))
    write_video(tmp_path / "me.mp4", list(frames), 10)
    world = turning(np.linspace(0, 2 * np.pi, COUNT, endpoint=False))
    people = iter([seen_person(each) for each in world])
    asked = []

    class Follower:
        def landmarks(self, photo, crop):
            asked.append("landmarks")
            return next(people)

    def find_people(networks, photo):
        asked.append("detector")
        return [next(people)]

    monkeypatch.setattr(video_photos, "available", lambda: True)
    monkeypatch.setattr(video_photos, "Networks", Follower)
    monkeypatch.setattr(video_photos, "find_people", find_people)
    return tmp_path / "me.mp4", asked


def test_a_video_of_someone_who_turns_gives_photos_from_all_sides_and_their_times(clip, tmp_path):
    video, asked = clip
    message = photos_of_video(video, tmp_path / "photos")
    known = read_json(tmp_path / "photos" / MARK)
    assert "from all sides of the person" in message and known["by_direction"]
    assert len(known["chosen"]) == 16 and max(np.diff(known["chosen"])) <= 4
    assert asked[0] == "detector" and set(asked[1:]) == {"landmarks"}  # found once, then followed
    names = sorted(path.stem for path in (tmp_path / "photos" / "images").iterdir())
    seconds = seconds_of_photos(tmp_path / "photos", names)
    np.testing.assert_allclose(seconds, np.asarray(known["chosen"]) / 10)


@pytest.mark.parametrize("rate", [None, 0, "10"])
def test_photos_without_a_known_rate_have_no_times(tmp_path, rate):
    assert seconds_of_photos(tmp_path, ["frame_00000001"]) is None
    write_json(tmp_path / MARK, {"rate": rate})
    assert seconds_of_photos(tmp_path, ["frame_00000001"]) is None


def test_photos_of_other_names_have_no_times(tmp_path):
    write_json(tmp_path / MARK, {"rate": 10})
    assert seconds_of_photos(tmp_path, ["front", "back"]) is None
    assert seconds_of_photos(tmp_path, ["frame_00000004", "frame_00000002"]) is None


def test_a_video_without_anybody_is_not_searched_to_its_end(monkeypatch):
    looks = []
    monkeypatch.setattr(video_photos, "Networks", lambda: None)
    monkeypatch.setattr(video_photos, "find_people", lambda *_: looks.append(1) or [])
    blank = [np.zeros((8, 8, 3), np.uint8)] * COUNT
    assert len(list(video_photos.followed(blank, COUNT))) < COUNT
    assert len(looks) == video_photos.PATIENCE
