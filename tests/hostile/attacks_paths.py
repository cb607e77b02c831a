"""Captures and calibrations that name files outside of their folder, and folders that cost more
than they weigh.
"""

import json
import os

import honest_files as honest
import numpy as np
from honest_files import pixels
from hostile_cases import capture_with, case
from PIL import Image

# Paths out of the folder
# -------------------------------------------------------------------------------------------------

CAPTURES = ("capture", "photos", "boundary")
"""Readers of captures."""
OUTSIDE = {"views.0.image": "outside.png", "views.0.mask": "mask.png", "body": "outside.npz"}


def write_outside(folder):
    """What lies beside a capture."""
    Image.fromarray(pixels(12, 10, 3)).save(folder.parent / "outside.png")
    Image.fromarray(pixels(12, 10)).save(folder.parent / "mask.png")
    np.savez(folder.parent / "outside.npz", **honest.body_parameters())


def linked(folder):
    write_outside(folder)
    for name in OUTSIDE.values():
        (folder / name).symlink_to(folder.parent / name)


WAYS_OUT = {
    "an absolute path": lambda folder, name: str(folder.parent / name),
    "a path upwards": lambda folder, name: f"../{name}",
    "a path down and upwards": lambda folder, name: f"images/../../{name}",
    "a null character": lambda folder, name: f"{name}\0",
    "5,000 characters": lambda folder, name: "x" * 5000 + name,
    "a link outwards": lambda folder, name: name,
}
for way, named in WAYS_OUT.items():
    prepare = linked if "link" in way else write_outside
    for key, name in OUTSIDE.items():
        for reader in CAPTURES:
            unread = key == "body" and reader == "photos" and "characters" in way
            make = capture_with(
                lambda folder, key=key, named=named, name=name: {key: named(folder, name)}, prepare
            )
            case(f"{key}: {way}", reader, make, "either" if unread else "refused", 2)
for name in ("images/000.png", "capture.json", "", ".", "images"):
    case(f"body: {name!r}", "capture", capture_with({"body": name}), item=2)


def import_of(calibration, content, link=False):
    """Photos and a calibration."""

    def make(folder):
        folder = folder / "in"
        folder.mkdir()
        honest.write_import(folder)
        write_outside(folder)
        if link:
            (folder / "photos" / "l.png").symlink_to(folder.parent / "outside.png")
        (folder / calibration).write_text(json.dumps(content))
        return folder / calibration

    return make


def one_frame(name):
    return honest.transforms(frames=[{"file_path": name, "transform_matrix": honest.POSE}])


for name in (
    "../outside.png",
    "../../outside.png",
    "/outside.png",
    "photos/../../outside.png",
    "..\\outside.png",
):
    case(f"a photo {name}", "import", import_of("transforms.json", one_frame(name)), item=2)
case(
    "a photo that is a link outwards",
    "import",
    import_of("transforms.json", one_frame("l.png"), link=True),
    item=2,
)
for name in ("..", "../..", "/", "/tmp", "x\0y"):
    camera = {"K": honest.K, "R": np.eye(3).tolist(), "T": [0, 0, 3], "imgSize": [10, 12]}
    case(f"a camera {name!r}", "import", import_of("cameras.json", {name: camera}), item=2)


# Captures and folders of photos that cost more than they weigh
# ------------------------------------------------------------------


def capture_of(count, prepare=lambda folder: None, image="images/000.png", **changes):
    """Views that name a photo each: `image` with the number of the view, if it has a place for
    it.
    """
    view = {
        key: value
        for key, value in honest.capture_description()["views"][0].items()
        if key != "mask"
    }
    views = [view | {"frame": 0, "image": image.format(i)} | changes for i in range(count)]
    return capture_with({"views": views}, prepare)


def large_photo(folder, size=1024):
    Image.fromarray(np.zeros((size, size, 3), np.uint8)).save(folder / "images" / "000.png")


def copies(count, link=lambda old, new: new.write_bytes(old.read_bytes()), size=1024):
    """Of a large photo; hard or symbolic links."""

    def prepare(folder):
        large_photo(folder, size)
        for i in range(count):
            link(folder / "images" / "000.png", folder / f"{i}.png")

    return prepare


for reader in CAPTURES:
    case("one photo 4,000 times", reader, capture_of(4000, large_photo), item=5)
    case("one photo 100 times", reader, capture_of(100, large_photo), item=5)
    for kind, link in {
        "links": lambda old, new: new.symlink_to(old),
        "hard links": os.link,
    }.items():
        case(f"400 {kind} to a photo", reader, capture_of(400, copies(400, link), "{}.png"), item=5)
    if reader != "boundary":  # which reads one after the other
        case(
            "21 white photos of 49 million pixels",
            reader,
            capture_of(21, copies(21, size=7000), "{}.png"),
            item=5,
        )
case("5,000 photos", "photos", capture_of(5000, copies(5000, size=12), "{}.png"), item=5)
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
