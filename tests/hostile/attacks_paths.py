"""Captures and calibrations that name files outside of their folder."""

import json

import numpy as np
import readers
from hostile_cases import case
from PIL import Image
from readers import pixels

# Paths out of the folder -------------------------------------------------------------------------------------------------


def capture_that_names(key, value, prepare=lambda folder: None):
    def make(folder):
        inner = folder / "me"
        inner.mkdir()
        readers.write_capture(inner)
        prepare(folder)
        description = readers.capture_description()
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
    np.savez(folder / "outside.npz", **readers.body_parameters())


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
        for reader in ("capture", "photos", "outline"):
            unread = key == "body" and reader == "photos" and "characters" in way
            case(
                f"{key}: {way}",
                reader,
                capture_that_names(key, named(name), prepare),
                "either" if unread else "refused",
                2,
            )
for key, name, target in (
    ("image", "l.png", "outside.png"),
    ("mask", "l.png", "mask.png"),
    ("body", "l.npz", "outside.npz"),
):
    for reader in ("capture", "photos", "outline"):
        case(f"{key}: a link outwards", reader, capture_that_names(key, name, linked(name, target)), item=2)
for name in ("images/000.png", "capture.json", "", ".", "images"):
    case(f"body: {name!r}", "capture", capture_that_names("body", name), item=2)


def import_that_names(name, prepare=lambda folder: None):
    def make(folder):
        inner = folder / "in"
        inner.mkdir()
        readers.write_import(inner)
        photo_outside(folder)
        prepare(inner)
        frames = [{"file_path": name, "transform_matrix": readers.POSE}]
        (inner / "transforms.json").write_text(json.dumps(readers.transforms(frames=frames)))
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
        readers.write_import(folder)
        (folder / "cameras.json").write_text(
            json.dumps({name: {"K": readers.K, "R": np.eye(3).tolist(), "T": [0, 0, 3], "imgSize": [10, 12]}})
        )
        return folder / "cameras.json"

    return make


for name in ("..", "../..", "/", "/tmp", "x\0y"):
    case(f"a camera {name!r}", "import", camera_named(name), item=2)
