"""JSON, YAML, COLMAP and configurations: nesting, length, numbers that are none, parts that do not
exist.
"""

import json
import re
import struct

import honest_files as honest
from hostile_cases import case, changed, edited, json_case, setting, written
from readers import FORMATS

# JSON and YAML
# --------------------------------------------------------------------------------------------------

JSON_READERS = (
    "json",
    "transforms",
    "opencv json",
    "openpose",
    "coco",
    "mmpose",
    "lhm",
    "face scores",
    "configuration",
    "manifest",
)
DEEP = {
    "lists in lists": "[" * 100_000 + "]" * 100_000,
    "objects in objects": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "900 lists in lists": "[" * 900 + "]" * 900,
    "a number of 5,000 digits": '{"frames": ' + "9" * 5000 + "}",
    "characters that do not exist": b'{"a": "\xff\xfe"}',
    "half a surrogate": '"\\ud800"',
    "null": "null",
    "a number": "3",
    "a word": '"people"',
    "a list of nothing": "[]",
    "no keys": "{}",
}
FINE = ("null", "a number", "a word", "a list of nothing", "no keys", "half a surrogate")
for reader in JSON_READERS:
    for kind, data in DEEP.items():
        fine = (reader == "json" and kind in FINE) or (
            reader == "configuration" and kind == "no keys"
        )
        data = data if isinstance(data, bytes) else data.encode()
        case(
            kind,
            reader,
            changed(reader, lambda _, data=data: data),
            "read" if fine else "refused",
            6,
        )
for reader in ("json", "openpose", "transforms"):
    case("100 MB", reader, changed(reader, lambda _: b"[" + b"1," * (50 << 20) + b"1]"), item=5)


def edited_glb(reader, change):
    """The honest GLB file of a reader with another JSON."""

    def edit(data):
        length = struct.unpack_from("<I", data, 12)[0]
        header = json.dumps(change(json.loads(data[20 : 20 + length]))).encode()
        header += b" " * (-len(header) % 4)
        chunks = struct.pack("<II", len(header), 0x4E4F534A) + header + data[20 + length :]
        return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks

    return changed(reader, edit)


TABLES = {
    "no line": "",
    "a line of names alone": honest.face_table().splitlines()[0],
    "words for numbers": honest.face_table().replace("0.25", "soft", 1),
    "a number that is none": honest.face_table().replace("0.25", "nan", 1),
    "numbers without end": honest.face_table().replace("0.25", "1e999", 1),
    "a line that is cut off": honest.face_table()[:-20],
    "other columns": "time,speed\n0,1\n",
    "a million columns": ",".join(["JawOpen"] * 1_000_000),
    "a quote that does not end": honest.face_table() + '"' + "x" * 300_000,
    "zeros of another program": honest.face_table().replace("0.25", "0\0"),
}
for kind, data in TABLES.items():
    case(kind, "face table", written("face.csv", data), item=6)
for kind, score in {"a word": '"soft"', "a list": "[1]", "NaN": "NaN", "yes": "true"}.items():
    text = json.dumps(honest.face_scores()).replace("0.5", score, 1)
    case(f"a score that is {kind}", "face scores", written("face.json", text), item=6)
for kind, changes in {
    "times that stand still": {"accessors.0.count": 1},
    "a mesh that is not there": {"nodes.0.mesh": 7},
    "names that are numbers": {"meshes.0.extras": {"targetNames": [1, 2, 3, 4, 5, 6]}},
    "names of nobody": {"meshes.0.extras": {"targetNames": "jawOpen"}},
}.items():
    case(kind, "glb face", edited_glb("glb face", setting(changes)), item=4)

YAML = {
    "lists in lists": "a: " + "[" * 3000 + "]" * 3000,
    "maps in maps": "\n".join(" " * i + "a:" for i in range(2000)),
    "keys of keys": "? " * 3000 + "a",
    "a billion laughs": (
        "a: &a [x,x]\n"
        + "\n".join(f"{c}: &{c} [*{b},*{b}]" for b, c in zip("abcdefgh", "bcdefghi", strict=True))
    ),
    "2 MB": "K_a: 1\n" * 300_000,
    "a number of 400,000 digits": "K_a: " + "1" * 400_000 + "x",
    "a whole number of 400,000 digits": "K_a: " + "1" * 400_000,
    "commas": "K_a: {" + "," * 200_000,
    "python's objects": "K_a: !!python/object/apply:os.system ['touch OWNED']",
    "another tag": "K_a: !!binary aGVsbG8=",
    "a matrix of words": "K_a: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [a, b]",
    "a matrix of 10^18": (
        "K_a: !!opencv-matrix\n   rows: 1000000000\n   cols: 1000000000\n   dt: d\n   data: [1]"
    ),
    "a matrix that is negative": (
        "K_a: !!opencv-matrix\n   rows: -1\n   cols: -1\n   dt: d\n   data: [1]"
    ),
    "a matrix of .Inf": "K_a: !!opencv-matrix\n   rows: .Inf\n   cols: 1\n   dt: d\n   data: [1]",
    "names that are a number": honest.opencv_yaml() + "names: 3\n",
    "names of nobody": honest.opencv_yaml() + "names: [x, y]\n",
}
for kind, data in YAML.items():
    case(
        kind,
        "opencv yaml",
        written("cameras.yml", "%YAML:1.0\n---\n" + data),
        item=5 if "digits" not in kind else 6,
    )


# Numbers that are none
# ------------------------------------------------------------------------------------------------

BAD_NUMBERS = {
    "10^400": 10**400,
    "inf": float("inf"),
    "NaN": float("nan"),
    "words": "x",
    "objects": {},
    "ragged": [[1], 2],
}
NUMBERS = {
    "transforms": {"frames.0.transform_matrix.0.0": 0, "fl_x": 0, "w": 0},
    "capture": {
        "views.0.K": 0,
        "views.0.cam_from_world": 0,
        "views.0.frame": 0,
        "views.0.image": 0,
    },
    "openpose": {"people.0.pose_keypoints_2d": 75},
    "coco": {"0.keypoints": 51},
    "mmpose": {"instance_info.0.instances.0.keypoint_scores": 17},
    "coco annotations": {"images.0.width": 0},
    "lhm": {"root_pose": 3},
}
"""By reader: places of numbers, and how many are expected there; 0: one number."""
for reader, paths in NUMBERS.items():
    for path, count in paths.items():
        for kind, bad in BAD_NUMBERS.items():
            fine = kind in ("inf", "NaN") and reader in (
                "coco",
                "mmpose",
            )  # a point that is not seen
            fine |= (reader, kind) == (
                "coco annotations",
                "objects",
            )  # an image without a width, whose keypoints tell the size
            expect = "read" if fine else "refused"
            json_case(
                f"{path} of {kind}", reader, {path: [bad] * count if count else bad}, expect=expect
            )
for kind, bad in {"numbers in words": "0.5", "truth": True}.items():
    for reader, path in (("openpose", "people.0.pose_keypoints_2d"), ("coco", "0.keypoints")):
        json_case(kind, reader, {f"{path}.0": bad, f"{path}.1": None})
for bad in ("640", 1e300, -5):
    json_case(f"a width of {bad!r}", "coco annotations", {"images.0.width": bad})

COLMAP = {
    "a point of inf": ("images.txt", "5.0 6.0 1", "5.0 6.0 inf"),
    "a point of nan": ("images.txt", "5.0 6.0 1", "5.0 6.0 nan"),
    "a point of 1e400": ("images.txt", "5.0 6.0 1", "5.0 6.0 1e400"),
    "a point's number in words": ("points3D.txt", "1 0 0.9", "x 0 0.9"),
    "a place of nan": ("points3D.txt", "0 0.9 0", "nan 0.9 0"),
    "a quaternion of inf": ("images.txt", "0 1 0 0", "inf 1 0 0"),
    "a quaternion of 0": ("images.txt", "0 1 0 0", "0 0 0 0"),
    "a camera that is not there": ("images.txt", " 1 photos", " 7 photos"),
    "a size of 10^30": ("cameras.txt", "10 12", f"{10**30} 12"),
    "a size of 1.5": ("cameras.txt", "10 12", "1.5 12"),
    "another lens": ("cameras.txt", "PINHOLE", "FISHEYE"),
}
for kind, (name, old, new) in COLMAP.items():
    case(
        kind,
        "colmap",
        edited("colmap", old, new, name),
        "either" if "place" in kind else "refused",
        6,
    )


# Configurations and weights
# -------------------------------------------------------------------------------------------

ENCODER = "model.architecture.encoder"
CONFIGURATIONS = {
    "100,000 layers": ({f"{ENCODER}.transformer.layers": 100_000}, 5),
    "10^400 layers": ({f"{ENCODER}.transformer.layers": 10**400}, 6),
    "no layers": ({f"{ENCODER}.transformer.layers": 0}, 6),
    "a width of 10^12": ({f"{ENCODER}.transformer.width": 10**12}, 5),
    "a texture of 10^9": ({f"{ENCODER}.texture.resolution": 10**9}, 5),
    "patches of half": ({f"{ENCODER}.patch_size": 0.5}, 6),
    "another module": ({f"{ENCODER}.kind": "antigravity.Encoder"}, 1),
    "the command line": ({f"{ENCODER}.kind": "humangs_jax.cli.__main__.Encoder"}, 1),
    "another function": ({f"{ENCODER}.kind": "os.system"}, 1),
    "a field that does not exist": ({f"{ENCODER}.evil": 1}, 6),
    "a reader of 10^9 features": (
        {"model.architecture.reader": {"kind": "PixelAlignedReader", "output_width": 10**9}},
        6,
    ),
    "a list for a part": ({"model.architecture.encoder": []}, 6),
    "a rate of 10^400": ({"optimizer.learning_rate": 10**400}, 6),
    "a thousand counts": ({"views.input_counts": [4] * 1000}, 5),
}
"""tests/core/test_configuration.py puts other values into every field."""
for kind, (changes, item) in CONFIGURATIONS.items():
    json_case(kind, "configuration", changes, item)


def weights_with(changes):
    """Honest weights whose recorded architecture is changed."""

    def make(folder):
        from safetensors import safe_open
        from safetensors.numpy import save_file

        file = FORMATS["weights"].make(folder)
        with safe_open(file, "numpy") as content:
            tensors, metadata = (
                {key: content.get_tensor(key) for key in content.keys()},  # noqa: SIM118
                content.metadata(),
            )
        architecture = setting(changes)(json.loads(metadata["architecture"]))
        save_file(tensors, file, metadata | {"architecture": json.dumps(architecture)})
        return file

    return make


for kind, (changes, item) in CONFIGURATIONS.items():
    own = {
        path.removeprefix("model.architecture."): value
        for path, value in changes.items()
        if path.startswith(ENCODER + ".")
    }
    if own:
        case(kind, "weights", weights_with(own), item=item)
case(
    "one flipped bit in a tensor",
    "weights",
    changed("weights", lambda data: data[:-7] + bytes([data[-7] ^ 1]) + data[-6:]),
    item=3,
)
for kind, line in {
    "a slash": b"/",
    "a frame of 5,000 digits": b"cam00/" + b"9" * 5000,
    "no camera": b"00000001.jpg",
}.items():
    case(
        f"a line of {kind}",
        "missing photos",
        changed("missing photos", lambda _, line=line: line),
        item=6,
    )


# Words that a terminal would act on
# -----------------------------------------------------------------------------------

WORDS = {
    "a title": "\x1b]0;OWNED\x07",
    "a cleared screen": "\x1b[2J\x1b[1;1H",
    "C1": "\x9b2J\x85",
    "a new line": "a\nhumangs: error: forged",
    "a carriage return": "a\rforged",
    "marks of direction": "\u202egnp\u2066\u2069",
    "a line separator": "\u2028\u2029",
    "a tag": "\U000e0041",
    "half a surrogate": "\udc9b",
}
for kind, word in WORDS.items():
    for reader in ("capture", "photos"):
        for key in ("image", "mask"):
            json_case(f"{kind} in {key}", reader, {f"views.0.{key}": f"images/{word}.png"}, 0)
    json_case(
        f"{kind} in a path",
        "transforms",
        {"frames.0.file_path": word, "frames.0.transform_matrix": [1]},
        0,
    )
    json_case(f"{kind} in a name", "coco", {"0.file_name": word, "0.keypoints": [1]}, 0)
    json_case(f"{kind} in a field", "configuration", {word: 1}, 0)
    json_case(f"{kind} in a preset", "settings", {"settings.splat": word}, 0)
    case(
        f"{kind} in a name",
        "colmap",
        edited("colmap", "0.9 2.6 1 photos/000", f"x 2.6 1 photos/{word}", "images.txt"),
    )
    case(f"{kind} in a word", "bvh", edited("bvh", "CHANNELS", word))


# Amounts, of which each file has few bytes
# -------------------------------------------------------------------------------------

for key, values in {
    "settings": ([], "x", None, 3),
    "split": ([], {}, 10**400),
    "generator_version": ([1], {}, "1"),
    "version": ([2], {}, 10**400),
    "format": ([], {}, None),
}.items():
    for value in values:
        json_case(
            f"{key} {'10^400' if isinstance(value, int) and value > 9 else repr(value)}",
            "manifest",
            {key: value},
        )

NOBODY = '{"pose_keypoints_2d":[]}'
FEW_BYTES = {
    "a million people without points": (
        "openpose",
        lambda: '{"people":[' + ",".join([NOBODY] * 1_000_000) + "]}",
    ),
    "110,000 people without points": (
        "openpose",
        lambda: '{"people":[' + ",".join([NOBODY] * 110_000) + "]}",
    ),
    "a million images": (
        "coco annotations",
        lambda: '{"annotations":[],"images":[' + ",".join(["0"] * 1_000_000) + "]}",
    ),
    "a million frames": (
        "mmpose",
        lambda: "[" + ",".join(['{"frame_id":0,"instances":[]}'] * 1_000_000) + "]",
    ),
    "200,000 instances": (
        "mmpose",
        lambda: '[{"frame_id":0,"instances":[' + ",".join(["0"] * 200_000) + "]}]",
    ),
    "200,000 results": ("coco", lambda: "[" + ",".join(['{"image_id":0}'] * 200_000) + "]"),
}
for kind, (reader, data) in FEW_BYTES.items():
    case(kind, reader, written("000_keypoints.json", data), item=5)
for seconds in (b"1e-9", b"1e9", b"1e-300"):

    def of_seconds(data, seconds=seconds):
        return re.sub(rb"Frame Time: \S+", b"Frame Time: " + seconds, data)

    case(f"frames of {seconds.decode()} s", "bvh", changed("bvh", of_seconds), item=5)
