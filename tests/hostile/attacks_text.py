"""JSON, YAML, COLMAP and configurations: nesting, length, numbers that are none, parts that do not exist."""

import json
import re

import honest_files as honest
import numpy as np
from hostile_cases import case, changed, described, edited, setting, written
from readers import FORMATS

from humangs_jax.apps.settings import KIND, PRESETS
from humangs_jax.core.configuration import config_to_json
from humangs_jax.training.config import tiny

# JSON and YAML --------------------------------------------------------------------------------------------------------

JSON_READERS = {
    **{"json": "a.json", "transforms": "transforms.json", "opencv json": "calibration_full.json", "openpose": "a.json"},
    **{"coco": "a.json", "mmpose": "a.json", "lhm": "a.json", "joints json": "a.json", "configuration": "a.json"},
    "manifest": "manifest.json",
}
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
for reader, name in JSON_READERS.items():
    for kind, data in DEEP.items():
        fine = reader == "json" and kind in FINE
        expect = "read" if fine or (reader == "configuration" and kind == "no keys") else "refused"
        case(kind, reader, written(name, data), expect, 6)
for reader in ("json", "openpose", "transforms"):
    case("100 MB", reader, written(JSON_READERS[reader], lambda: b"[" + b"1," * (50 << 20) + b"1]"), item=5)

YAML = {
    "lists in lists": "a: " + "[" * 3000 + "]" * 3000,
    "maps in maps": "\n".join(" " * i + "a:" for i in range(2000)),
    "keys of keys": "? " * 3000 + "a",
    "a billion laughs": "a: &a [x,x]\n"
    + "\n".join(f"{c}: &{c} [*{b},*{b}]" for b, c in zip("abcdefgh", "bcdefghi", strict=True)),
    "2 MB": "K_a: 1\n" * 300_000,
    "a number of 400,000 digits": "K_a: " + "1" * 400_000 + "x",
    "a whole number of 400,000 digits": "K_a: " + "1" * 400_000,
    "commas": "K_a: {" + "," * 200_000,
    "python's objects": "K_a: !!python/object/apply:os.system ['touch OWNED']",
    "another tag": "K_a: !!binary aGVsbG8=",
    "a matrix of words": "K_a: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [a, b]",
    "a matrix of 10^18": "K_a: !!opencv-matrix\n   rows: 1000000000\n   cols: 1000000000\n   dt: d\n   data: [1]",
    "a matrix that is negative": "K_a: !!opencv-matrix\n   rows: -1\n   cols: -1\n   dt: d\n   data: [1]",
    "a matrix of .Inf": "K_a: !!opencv-matrix\n   rows: .Inf\n   cols: 1\n   dt: d\n   data: [1]",
    "names that are a number": honest.opencv_yaml() + "names: 3\n",
    "names of nobody": honest.opencv_yaml() + "names: [x, y]\n",
}
for kind, data in YAML.items():
    case(kind, "opencv yaml", written("cameras.yml", "%YAML:1.0\n---\n" + data), item=5 if "digits" not in kind else 6)


# Numbers that are none ------------------------------------------------------------------------------------------------


def json_case(kind, reader, name, value, item=6, expect="refused"):
    case(kind, reader, written(name, json.dumps(value)), expect, item)


for kind, bad in {
    "10^400": 10**400,
    "inf": float("inf"),
    "NaN": float("nan"),
    "words": "x",
    "objects": {},
    "ragged": [[1], 2],
}.items():
    matrix = [[bad, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    frames = [{"file_path": "a.png", "transform_matrix": matrix}]
    json_case(f"a matrix with {kind}", "transforms", "transforms.json", honest.transforms(frames=frames))
    json_case(f"a focal length of {kind}", "transforms", "transforms.json", honest.transforms(fl_x=bad))
    json_case(f"a size of {kind}", "transforms", "transforms.json", honest.transforms(w=bad))
    views = honest.capture_description()["views"]
    for key in ("K", "cam_from_world", "frame", "image"):
        changed_views = honest.capture_description(views=[{**views[0], key: bad}, views[1]])
        case(f"{key} of {kind}", "capture", described(changed_views), item=6)
    person = {"pose_keypoints_2d": [bad] * 75}
    json_case(f"keypoints of {kind}", "openpose", "000_keypoints.json", {"people": [person]})
    json_case(f"keypoints of {kind}", "coco", "a.json", [{"file_name": "000.png", "keypoints": [bad] * 51}])
    json_case(f"a score of {kind}", "mmpose", "a.json", [{"keypoints": [[1, 2]] * 17, "keypoint_scores": [bad] * 17}])
    image = {"id": 1, "file_name": "000.png", "width": bad, "height": bad}
    json_case(f"a size of {kind}", "coco annotations", "a.json", {"images": [image], "annotations": []})
    json_case(f"a pose of {kind}", "lhm", "a.json", json.loads(honest.lhm()) | {"root_pose": [bad] * 3})
    json_case(f"a joint of {kind}", "joints json", "a.json", {"left_hip": [bad, 0, 0]})

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
    case(kind, "colmap", edited("colmap", old, new, name), "either" if "place" in kind else "refused", 6)


# Configurations and weights -------------------------------------------------------------------------------------------


def configuration(path, value):
    def data():
        content = json.loads(config_to_json(tiny()))
        setting(path, value)(content)
        return json.dumps(content)

    return written("config.json", data)


ENCODER = "model.architecture.encoder"
READER = {"kind": "PixelAlignedReader", "output_width": 10**9}
CONFIGURATIONS = {
    "100,000 layers": (f"{ENCODER}.transformer.layers", 100_000, 5),
    "10^400 layers": (f"{ENCODER}.transformer.layers", 10**400, 6),
    "no layers": (f"{ENCODER}.transformer.layers", 0, 6),
    "a reader of 10^9 features": ("model.architecture.reader", READER, 6),
    "heads of no width": (f"{ENCODER}.transformer.head_width", 0, 6),
    "patches of 0": (f"{ENCODER}.patch_size", 0, 6),
    "patches below 0": (f"{ENCODER}.patch_size", -4, 6),
    "patches of half": (f"{ENCODER}.patch_size", 0.5, 6),
    "another module": (f"{ENCODER}.kind", "antigravity.Encoder", 1),
    "the command line": (f"{ENCODER}.kind", "humangs_jax.cli.__main__.Encoder", 1),
    "another function": (f"{ENCODER}.kind", "os.system", 1),
    "a field that does not exist": (f"{ENCODER}.evil", 1, 6),
    "a list for a part": ("model.architecture.encoder", [], 6),
    "a rate of 10^400": ("optimizer.learning_rate", 10**400, 6),
}
for kind, (path, value, item) in CONFIGURATIONS.items():
    case(kind, "configuration", configuration(path, value), item=item)


def weights_with(path, value):
    """Honest weights whose recorded architecture is changed."""

    def make(folder):
        from safetensors import safe_open
        from safetensors.numpy import save_file

        file = FORMATS["weights"].make(folder)
        with safe_open(file, "numpy") as content:
            tensors, metadata = {key: content.get_tensor(key) for key in content.keys()}, content.metadata()  # noqa: SIM118
        architecture = json.loads(metadata["architecture"])
        setting(path, value)(architecture)
        save_file(tensors, file, metadata | {"architecture": json.dumps(architecture)})
        return file

    return make


for kind, (path, value, item) in CONFIGURATIONS.items():
    if path.startswith(ENCODER + "."):
        case(kind, "weights", weights_with(path.removeprefix("model.architecture."), value), item=item)


def weights_changed(folder):
    file = FORMATS["weights"].make(folder)
    data = bytearray(file.read_bytes())
    data[-7] ^= 1
    file.write_bytes(data)
    return file


case("one flipped bit in a tensor", "weights", weights_changed, item=3)
for kind, line in {"a slash": b"/", "a frame of 5,000 digits": b"cam00/" + b"9" * 5000, "no camera": b"00000001.jpg"}.items():
    case(f"a line of {kind}", "missing photos", changed("missing photos", lambda _, line=line: line), item=6)


# Numbers out of every range -------------------------------------------------------------------------------------------


def chosen(path, value):
    """Settings of `reconstruct --config`."""

    def data():
        content = json.loads(config_to_json(PRESETS["best"]))
        setting(path, value)(content)
        return json.dumps({"kind": KIND, "settings": content})

    return written("settings.json", data)


OUT_OF_RANGE = {
    "runtime.image_size": (10**6, 0, -8, 1e300),
    "runtime.token_capacity": (-5, 10**18),
    "runtime.body_vertices": (0, -1, 10**12),
    "runtime.longest_edge": (0, -1, 1e-9, 1e300, float("nan")),
    "runtime.raster.rows_per_step": (0, -1, 10**12),
    "runtime.raster.near": (-1, float("inf")),
    "refine_iterations": (10**6, -1),
    "refine_steps": (10**9, -1),
    "refine_size": (0, 10**9),
    "views": (0, -1, 10**9, True),
}
for path, values in OUT_OF_RANGE.items():
    for value in values:
        case(f"{path} {value}", "settings", chosen(path, value))
RUNS = {
    "target_size": (0, 10**6),
    "batch_size": (0, 10**9),
    "steps": (0, 10**12),
    "seed": (-1, 2**40),
    "ema_decay": (-1, 2),
    "views.input_counts": ([0], [10**9], [4] * 1000),
    "views.target_count": (0, -1, 10**9),
    "loss.squared": (-1, 1e300),
    "loss.structural_scales": (0, 10**6),
    "augmentation.mask_pixels": (-1, 10**9),
    "optimizer.warmup_steps": (-1,),
    "optimizer.betas": ([2, 2], [-1, 0]),
    "splat.tile_size": (0, 10**9),
    "splat.chunk": (-1, 10**9),
    "model.conventions.image_size": (0, 10**6),
    "model.conventions.longest_edge": (1e-9,),
    f"{ENCODER}.transformer.width": (10**9,),
    f"{ENCODER}.texture.resolution": (0, 10**9),
    "model.architecture.decoder.free": (-1, 10**9),
    "model.architecture.decoder.initial_log_scale": (1e9,),
}
for path, values in RUNS.items():
    for value in values:
        case(f"{path} {str(value)[:40]}", "configuration", configuration(path, value))
for path, value in (("encoder.texture.resolution", 10**9), ("decoder.free", 10**9), ("encoder.transformer.width", 10**12)):
    case(f"{path} {value}", "weights", weights_with(path, value))


# Words that a terminal would act on -----------------------------------------------------------------------------------

WORDS = {
    "a title": "\x1b]0;OWNED\x07",
    "a cleared screen": "\x1b[2J\x1b[1;1H",
    "C1": "\x9b2J\x85",
    "a new line": "a\nhumangs: error: forged",
    "a carriage return": "a\rforged",
    "marks of direction": "\u202egnp.\u2066\u2069",
    "a line separator": "\u2028\u2029",
    "a tag": "\U000e0041",
    "half a surrogate": "\udc9b",
}
for kind, word in WORDS.items():
    views = honest.capture_description()["views"]
    for key in ("image", "mask"):
        named = honest.capture_description(views=[{**views[0], key: f"images/{word}.png"}, views[1]])
        for reader in ("capture", "photos"):
            case(f"{kind} in {key}", reader, described(named))
    name = edited("colmap", "0.9 2.6 1 photos/000", f"x 2.6 1 photos/{word}", "images.txt")
    case(f"{kind} in a name", "colmap", name)
    case(f"{kind} in a word", "bvh", edited("bvh", "CHANNELS", word))
    frames = [{"file_path": word, "transform_matrix": [1]}]
    json_case(f"{kind} in a path", "transforms", "transforms.json", honest.transforms(frames=frames))
    json_case(f"{kind} in a name", "coco", "a.json", [{"file_name": word, "keypoints": [1]}])
    json_case(f"{kind} in a key", "joints json", "a.json", {word: [0, 0]})
    json_case(f"{kind} in a field", "configuration", "config.json", {word: 1})
    json_case(f"{kind} in a kind", "settings", "settings.json", {"kind": KIND, "settings": {"splat": word}})


# Words for numbers ----------------------------------------------------------------------------------------------------

for kind, bad in {"numbers in words": "0.5", "numbers in words beside none": None, "truth": True}.items():
    mixed = lambda count, bad=bad: ["0.5" if bad is None else bad, None, *[1.5] * (count - 2)]
    json_case(kind, "openpose", "000_keypoints.json", {"people": [{"pose_keypoints_2d": mixed(75)}]})
    json_case(kind, "coco", "a.json", [{"file_name": "000.png", "keypoints": mixed(51)}])
    json_case(kind, "mmpose", "a.json", [{"keypoints": [[1, 2]] * 17, "keypoint_scores": mixed(17)}])
for bad in ("640", True, 1e300, -5):
    image = {"id": 1, "file_name": "000.png", "width": bad, "height": 480}
    json_case(f"a width of {bad!r}", "coco annotations", "a.json", {"images": [image], "annotations": []})


# Amounts, of which each file has few bytes -------------------------------------------------------------------------------------

PLACEMENTS = {
    "zeros": np.zeros((4, 4)),
    "NaN": np.full((4, 4), np.nan),
    "a mirror": np.diag([-1.0, 1, 1, 1]),
    "a scale for each axis": np.diag([1.0, 2, 3, 1]),
    "1e200": np.eye(4) * 1e200,
    "1e-200": np.diag([1e-200, 1e-200, 1e-200, 1]),
    "another last row": np.eye(4)[::-1],
    "too few numbers": np.eye(3),
}
for kind, matrix in PLACEMENTS.items():
    json_case(f"a placement of {kind}", "scan views", "scan.json", {"world_from_scan": matrix.tolist()})
json_case("a placement of words", "scan views", "scan.json", {"world_from_scan": "x"})
json_case("a list", "scan views", "scan.json", [])
json_case("no placement", "scan views", "scan.json", {})
for key, values in {
    "settings": ([], "x", None, 3),
    "split": ([], {}, 10**400),
    "generator_version": ([1], {}, "1"),
    "version": ([2], {}, 10**400),
    "format": ([], {}, None),
}.items():
    for value in values:
        named = "10^400" if isinstance(value, int) and value > 9 else repr(value)
        json_case(f"{key} {named}", "manifest", "manifest.json", honest.MANIFEST | {key: value})
without = {key: value for key, value in honest.MANIFEST.items() if key != "settings"}
json_case("no settings", "manifest", "manifest.json", without)

NOBODY = '{"pose_keypoints_2d":[]}'
FEW_BYTES = {
    "a million people without points": ("openpose", lambda: '{"people":[' + ",".join([NOBODY] * 1_000_000) + "]}"),
    "110,000 people without points": ("openpose", lambda: '{"people":[' + ",".join([NOBODY] * 110_000) + "]}"),
    "a million images": ("coco annotations", lambda: '{"annotations":[],"images":[' + ",".join(["0"] * 1_000_000) + "]}"),
    "a million frames": ("mmpose", lambda: "[" + ",".join(['{"frame_id":0,"instances":[]}'] * 1_000_000) + "]"),
    "200,000 instances": ("mmpose", lambda: '[{"frame_id":0,"instances":[' + ",".join(["0"] * 200_000) + "]}]"),
    "200,000 results": ("coco", lambda: "[" + ",".join(['{"image_id":0}'] * 200_000) + "]"),
}
for kind, (reader, data) in FEW_BYTES.items():
    case(kind, reader, written("000_keypoints.json", data), item=5)
for seconds in (b"1e-9", b"1e9", b"1e-300"):

    def of_seconds(data, seconds=seconds):
        return re.sub(rb"Frame Time: \S+", b"Frame Time: " + seconds, data)

    case(f"frames of {seconds.decode()} s", "bvh", changed("bvh", of_seconds), item=5)
