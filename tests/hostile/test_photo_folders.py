"""Folders of any photos give a result and a warning that names the photo, or one line.

After an error nothing is written. The person is that of the demo, in a drawn room. `humangs detect`
runs on each folder, and `humangs start` continues from its answer.
"""

import io
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.your_photos import in_a_room
from humangs_jax import cli
from humangs_jax.apps import detect
from humangs_jax.avatar.video import write_video
from humangs_jax.capture.detection.people import find_people
from humangs_jax.capture.keypoints.formats import read_people
from humangs_jax.data.capture import load_capture
from humangs_jax.io.images import read_grey, resized, to_uint8

HEIC = Path(__file__).parents[1] / "io" / "phone.heic"
TURNED = 6
"""Value of the EXIF orientation."""
CAPTURE = load_capture("demo_capture")


def view(i, size=384):
    """Returns (photo, mask) of the person."""
    photo = in_a_room(np.asarray(CAPTURE.images[i]), np.asarray(CAPTURE.masks[i]))
    return resized(photo, size, size), resized(np.asarray(CAPTURE.masks[i]), size, size)


def room(width=384, height=384):
    return in_a_room(np.ones((height, width, 3)), np.zeros((height, width)))


def save(folder, name, photo, **options):
    folder.mkdir(parents=True, exist_ok=True)
    mode = options.pop("mode", None)
    picture = Image.fromarray(to_uint8(photo))
    (picture.convert(mode) if mode else picture).save(folder / name, **options)


def good(folder, count=2):
    for i in range(count):
        save(folder, f"good{i}.png", view(i % CAPTURE.view_count)[0])


def with_changed(change, name="odd.png", **options):
    """Returns a maker of a folder of two good photos and a changed one."""

    def make(folder):
        good(folder)
        save(folder, name, change(view(0)[0]), **options)

    return make


def beside(scales):
    """Returns a maker of photos of people side by side; `scales` are shares of the height."""

    def make(folder):
        for i in range(2):
            photo = room(768, 384)
            for k, scale in enumerate(scales):
                size = round(384 * scale)
                person, mask = view(i, size)
                part = photo[384 - size :, 384 * k : 384 * k + size]
                part += mask[..., None] * (person - part)
            save(folder, f"both{i}.png", photo)

    return make


def grey(photo):
    return np.repeat(photo.mean(-1, keepdims=True), 3, axis=-1)


def far(width, height, size):
    """Returns a change that puts the person, `size` pixels high, into a large photo."""

    def change(_):
        photo, (person, mask) = room(width, height), view(0, size)
        part = photo[height // 2 : height // 2 + size, width // 2 : width // 2 + size]
        part += mask[..., None] * (person - part)
        return photo

    return change


def behind_a_table(photo):
    photo = photo.copy()
    photo[230:] = 0.35, 0.2, 0.1
    return photo


def only(**photos):
    def make(folder):
        for name, photo in photos.items():
            save(folder, f"{name}.png", photo)

    return make


def files(**contents):
    """Returns a maker of a folder of two good photos and files of these bytes.

    `_` in a name stands for a dot.
    """

    def make(folder):
        good(folder)
        for name, data in contents.items():
            (folder / name.replace("_", ".")).write_bytes(data)

    return make


def jpeg():
    stream = io.BytesIO()
    Image.fromarray(to_uint8(view(0)[0])).save(stream, "JPEG")
    return stream.getvalue()


def video(folder):
    folder.mkdir()
    write_video(folder / "room.mp4", [to_uint8(room(96, 96)) / 255] * 4, 10)


def animated(folder):
    good(folder)
    frames = [Image.fromarray(to_uint8(view(i)[0])) for i in (2, 3)]
    frames[0].save(folder / "odd.png", save_all=True, append_images=frames[1:])
    frames[0].save(folder / "moving.gif", save_all=True, append_images=frames[1:])


def duplicates(folder):
    good(folder)
    shutil.copy(folder / "good0.png", folder / "good0 (1).png")


def nested(folder):
    good(folder / "images" / "left")
    good(folder / "images" / "right")


TURNED_BY_EXIF = Image.Exif()
TURNED_BY_EXIF[0x0112] = TURNED
OUTSIDE = r"warning: odd\.png: a part of the person is outside of the photo"
NOBODY = r"warning: odd\.png: the person was not found in it"
FOLDERS = {
    # a result
    "good": (good, 2, ""),
    "one photo": (lambda folder: good(folder, 1), 1, ""),
    "40 photos": (lambda folder: good(folder, 40), 40, ""),
    "a folder for each camera": (nested, 4, ""),
    "the same photo twice": (duplicates, 3, ""),
    "a statue": (with_changed(grey), 3, ""),
    "CMYK": (with_changed(lambda photo: photo, "odd.jpg", mode="CMYK"), 3, ""),
    "animated": (animated, 3, ""),
    "turned by EXIF": (with_changed(lambda photo: np.rot90(photo), exif=TURNED_BY_EXIF), 3, ""),
    "mirrored": (with_changed(lambda photo: photo[:, ::-1]), 3, ""),
    "upside down": (with_changed(lambda photo: photo[::-1, ::-1]), 3, ""),
    "on its side": (with_changed(np.rot90), 3, ""),
    "mixed sizes": (with_changed(lambda photo: resized(photo, 600, 600)), 3, ""),
    "behind a table": (with_changed(behind_a_table), 3, ""),
    "far away": (with_changed(far(1000, 1000, 120)), 3, ""),
    "somebody small beside": (beside((1.0, 0.4)), 2, ""),
    "another format under this name": (files(odd_png=jpeg()), 3, ""),
    # a warning that names the photo
    "feet cut off": (with_changed(lambda photo: photo[:300]), 3, OUTSIDE),
    "cut at one side": (with_changed(lambda photo: photo[:, 160:]), 3, OUTSIDE),
    "an empty room among them": (with_changed(lambda photo: room()), 3, NOBODY),
    "a speck": (with_changed(far(1000, 1000, 30)), 3, NOBODY),
    # one clear line
    "black": (only(dark=np.zeros((64, 48, 3))), None, r"no person in dark\.png: expected one"),
    "tiny photos": (
        only(a=room(8, 8), b=room(1, 1)),
        None,
        r"no person in a\.png, b\.png: expected one",
    ),
    "two people": (
        beside((1.0, 0.9)),
        None,
        r"both0\.png, both1\.png: which of the people of .*people\.png is meant\?",
    ),
    "a photo cut short": (files(odd_jpg=jpeg()[:2000]), None, r"odd\.jpg"),
    "an empty file": (files(odd_jpg=b""), None, r"odd\.jpg"),
    "a HEIC without the extra": (files(odd_heic=HEIC.read_bytes()), None, r"odd\.heic.*heic"),
    "one name with two suffixes": (
        with_changed(lambda photo: photo, "good0.jpg"),
        None,
        r"good0\.jpg and .*good0\.png",
    ),
    "a video": (video, None, "no photo: expected"),
    "text files alone": (
        lambda folder: (folder.mkdir(), (folder / "a.txt").write_text("a")),
        None,
        "no photo: expected",
    ),
    "nothing": (lambda folder: folder.mkdir(), None, "no photo: expected"),
    "a folder that is not there": (lambda folder: None, None, "no such folder"),
}
FAST = (
    "black",
    "one name with two suffixes",
    "a HEIC without the extra",
    "a photo cut short",
    "feet cut off",
    "nothing",
)


@pytest.fixture(scope="module")
def remembered():
    """Returns a detector that keeps its results for photos that several folders have."""
    known = {}

    def find(networks, photo):
        key = (photo.shape, photo.tobytes())
        if key not in known:
            known[key] = find_people(networks, photo)
        return known[key]

    return find


def run(kind, command, remembered, monkeypatch, capsys):
    """Returns (exit code, lines of errors, lines of warnings) of a command."""
    monkeypatch.setattr(detect, "find_people", remembered)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    FOLDERS[kind][0](Path("photos"))
    code = cli.execute(command)
    err = capsys.readouterr().err
    assert "Traceback" not in err
    return code, *(
        [line for line in err.splitlines() if f"{word}:" in line] for word in ("error", "warning")
    )


def kinds(names, fast):
    return [pytest.param(name, marks=() if name in fast else pytest.mark.slow) for name in names]


@pytest.mark.parametrize("kind", kinds(FOLDERS, FAST))
def test_the_person_is_found_or_one_line_says_why_not(
    kind, remembered, tmp_path, monkeypatch, capsys
):
    _, count, expected = FOLDERS[kind]
    monkeypatch.chdir(tmp_path)
    code, errors, warnings = run(
        kind, ["detect", "photos", "--out", "found"], remembered, monkeypatch, capsys
    )
    if count is None:
        assert code == cli.BAD_DATA and len(errors) == 1 and not warnings
        assert re.search(expected, errors[0])
        assert {path.name for path in Path("found").glob("*")} <= {"people.png"}
        return
    assert code == 0 and not errors
    assert len(warnings) == bool(expected) and all(re.search(expected, line) for line in warnings)
    images = read_people(Path("found/keypoints.json"))[1]
    assert len(images) == count
    for each in images:
        mask = read_grey(Path("found/masks") / Path(each.image).with_suffix(".png"))
        assert mask.shape == each.size[::-1] and bool(mask.any()) == (each.people[0] is not None)


HOPELESS = [
    kind
    for kind, (_, count, _) in FOLDERS.items()
    if count is None and kind != "one name with two suffixes"
]


@pytest.mark.parametrize("kind", kinds(HOPELESS, ("a photo cut short", "nothing")))
def test_start_says_in_one_line_what_is_wrong_with_the_photos(
    kind, remembered, tmp_path, monkeypatch, capsys
):
    """The line may also say that cameras are missing; no capture is written then."""
    monkeypatch.chdir(tmp_path)
    command = ["start", "photos", "--out", "me", "--no-browser"]
    code, errors, warnings = run(kind, command, remembered, monkeypatch, capsys)
    assert code == cli.BAD_DATA and len(errors) == 1 and not warnings
    assert not Path("me").exists()
