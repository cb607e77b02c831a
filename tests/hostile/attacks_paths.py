"""Captures and calibrations that name files outside of their folder."""

import json
import os

import honest_files as honest
import numpy as np
from honest_files import pixels
from hostile_cases import case
from PIL import Image

# Paths out of the folder -------------------------------------------------------------------------------------------------


def capture_that_names(key, value, prepare=lambda folder: None):
    def make(folder):
        inner = folder / "me"
        inner.mkdir()
        honest.write_capture(inner)
        prepare(folder)
        description = honest.capture_description()
        if key == "body":
            description["body"] = value(folder) if callable(value) else value
        else:
            description["views"][0][key] = value(folder) if callable(value) else value
        (inner / "capture.json").write_text(json.dumps(description))
        return inner

    return make


def photo_outside(folder):
    Image.fromarray(pixels(12, 10, 3)).save(folder / "outside.png")
    Image.fromarray(pixels(12, 10)).save(folder / "mask.png")
    np.savez(folder / "outside.npz", **honest.body_parameters())


def linked(name, target):
    def prepare(folder):
        photo_outside(folder)
        (folder / "me" / name).symlink_to(folder / target)

    return prepare


WAYS_OUT = {
    "an absolute path": (lambda name: lambda folder: str(folder / name), photo_outside),
    "a path upwards": (lambda name: f"../{name}", photo_outside),
    "a path down and upwards": (lambda name: f"images/../../{name}", photo_outside),
    "a null character": (lambda name: f"{name}\0", photo_outside),
    "5,000 characters": (lambda name: "x" * 5000 + name, photo_outside),
}
for way, (named, prepare) in WAYS_OUT.items():
    for key, name in (("image", "outside.png"), ("mask", "mask.png"), ("body", "outside.npz")):
        for reader in ("capture", "photos", "boundary"):
            unread = key == "body" and reader == "photos" and "characters" in way
            expect = "either" if unread else "refused"
            case(f"{key}: {way}", reader, capture_that_names(key, named(name), prepare), expect, 2)
LINKS = (("image", "l.png", "outside.png"), ("mask", "l.png", "mask.png"), ("body", "l.npz", "outside.npz"))
for key, name, target in LINKS:
    for reader in ("capture", "photos", "boundary"):
        case(f"{key}: a link outwards", reader, capture_that_names(key, name, linked(name, target)), item=2)
for name in ("images/000.png", "capture.json", "", ".", "images"):
    case(f"body: {name!r}", "capture", capture_that_names("body", name), item=2)


def import_that_names(name, prepare=lambda folder: None):
    def make(folder):
        inner = folder / "in"
        inner.mkdir()
        honest.write_import(inner)
        photo_outside(folder)
        prepare(inner)
        frames = [{"file_path": name, "transform_matrix": honest.POSE}]
        (inner / "transforms.json").write_text(json.dumps(honest.transforms(frames=frames)))
        return inner / "transforms.json"

    return make


for name in ("../outside.png", "../../outside.png", "/outside.png", "photos/../../outside.png", "..\\outside.png"):
    case(f"a photo {name}", "import", import_that_names(name), item=2)
case(
    "a photo that is a link outwards", "import",
    import_that_names("l.png", lambda inner: (inner / "photos" / "l.png").symlink_to(inner.parent / "outside.png")), item=2,
)  # fmt: skip


def camera_named(name):
    def make(folder):
        honest.write_import(folder)
        (folder / "cameras.json").write_text(
            json.dumps({name: {"K": honest.K, "R": np.eye(3).tolist(), "T": [0, 0, 3], "imgSize": [10, 12]}})
        )
        return folder / "cameras.json"

    return make


for name in ("..", "../..", "/", "/tmp", "x\0y"):
    case(f"a camera {name!r}", "import", camera_named(name), item=2)


# Captures and folders of photos that cost more than they weigh ------------------------------------------------------------------


def capture_of(count, prepare=lambda folder: None, image="images/000.png", **changes):
    """Views that name a photo each: `image` with the number of the view, if it has a place for it."""

    def make(folder):
        honest.write_capture(folder)
        prepare(folder)
        description = honest.capture_description()
        view = {**description["views"][0], "frame": 0, **changes}
        del view["mask"]
        description["views"] = [view | {"image": image.format(i)} for i in range(count)]
        (folder / "capture.json").write_text(json.dumps(description))
        return folder

    return make


def large_photo(folder, size=1024):
    Image.fromarray(np.zeros((size, size, 3), np.uint8)).save(folder / "images" / "000.png")


def copies(count, link):
    """Of the large photo, hard or symbolic links."""

    def prepare(folder):
        large_photo(folder)
        for i in range(count):
            link(folder / "images" / "000.png", folder / f"{i}.png")

    return prepare


def white_photos(folder):
    large_photo(folder, 7000)
    for i in range(21):
        (folder / f"{i}.png").write_bytes((folder / "images" / "000.png").read_bytes())


def five_thousand_photos(folder):
    for i in range(5000):
        (folder / f"{i}.png").write_bytes((folder / "images" / "000.png").read_bytes())


for reader in ("capture", "photos", "boundary"):
    case("one photo 4,000 times", reader, capture_of(4000, large_photo), item=5)
    case("one photo 100 times", reader, capture_of(100, large_photo), item=5)
    for kind, link in {"links": lambda old, new: new.symlink_to(old), "hard links": os.link}.items():
        case(f"400 {kind} to a photo", reader, capture_of(400, copies(400, link), "{}.png"), item=5)
    if reader != "boundary":  # which reads one after the other
        case("21 white photos of 49 million pixels", reader, capture_of(21, white_photos, "{}.png"), item=5)
case("5,000 photos", "photos", capture_of(5000, five_thousand_photos, "{}.png"), item=5)
for frame in (2_000_000_000, 10**30, 100_000, 1000):
    case(f"frame {frame}", "photos", capture_of(4, frame=frame), item=5)


def folders(prepare):
    def make(folder):
        place = honest.write_import_folder(folder)
        prepare(place / "photos")
        return place

    return make


def keypoint_folder(prepare):
    def make(folder):
        (folder / "keypoints").mkdir()
        for name in honest.VIEWS:
            (folder / "keypoints" / f"{name}_keypoints.json").write_text(honest.openpose())
        prepare(folder / "keypoints")
        return folder / "keypoints"

    return make


def nested(folder):
    for _ in range(900):
        folder = folder / "a"
        folder.mkdir()


def two_links_to_itself(folder):
    for name in ("a", "b"):
        (folder / name).symlink_to(folder)


def forty_pairs(folder):
    """Each folder of a chain has two links to the next."""
    for i in range(40):
        (folder / f"p{i}").mkdir()
        for name in ("a", "b"):
            (folder / f"p{i}" / name).symlink_to(folder / f"p{i + 1}")


FOLDERS = {
    "two links to itself": two_links_to_itself,
    "a link to the root": lambda folder: (folder / "all").symlink_to("/"),
    "a link to the folder above": lambda folder: (folder / "up").symlink_to(folder.parent),
    "40 pairs of links": forty_pairs,
    "a link to nothing": lambda folder: (folder / "x.png").symlink_to(folder / "no"),
    "a link in a circle": lambda folder: (folder / "x").symlink_to(folder / "x"),
    "900 folders in folders": nested,
}
for kind, prepare in FOLDERS.items():
    case(kind, "start", folders(prepare), "either", 5)
    case(f"{kind}, of keypoints", "openpose", keypoint_folder(prepare), "either", 5)
