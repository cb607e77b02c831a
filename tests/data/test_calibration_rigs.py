"""Cameras of motion capture programs and data sets, written from known cameras and read back; a table of formats."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humangs_jax.data.calibration.calibration import read_calibration
from humangs_jax.data.capture_checks import CaptureError
from tests.data import calibration_files as written

EXACT = 1e-9
NAMES = ("a", "b", "c", "d")
LENS = [0.01, -0.02, 0.001, 0.002, 0.003]
K, POSES = written.scene()
SIZE = [written.WIDTH, written.HEIGHT]


def tables(title, name="", extra=""):
    """TOML: a table of each camera."""
    lines = ["[metadata]", "adjusted = true"]
    for i, (k, pose) in enumerate(zip(K, POSES, strict=True)):
        lines += [f"[{title.format(i)}]", *([f'name = "{name.format(NAMES[i])}"'] if name else []), f"size = {SIZE}", extra]
        lines += [f"matrix = {k.tolist()}", f"distortions = {LENS}", f"translation = {pose[:3, 3].tolist()}"]
        lines += [f"rotation = {Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()}"]
    return "\n".join(lines)


def panoptic():
    rows = zip(NAMES, K, POSES, strict=True)
    entry = lambda n, k, p: {"name": n, "K": k.tolist(), "R": p[:3, :3].tolist(), "t": p[:3, 3:].tolist(), "distCoef": LENS}
    return {"cameras": [entry(*row) | {"resolution": SIZE, "type": "hd"} for row in rows]}


def shelf():
    def entry(k, pose):
        place = -pose[:3, :3].T @ pose[:3, 3:]
        numbers = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        lens = {"k": [[LENS[0]], [LENS[1]], [LENS[4]]], "p": [[LENS[2]], [LENS[3]]]}
        return numbers | lens | {"R": pose[:3, :3].tolist(), "T": place.tolist()}

    return {str(i): entry(k, pose) for i, (k, pose) in enumerate(zip(K, POSES, strict=True))}


def qualisys():
    """Pixels of a field of view that begins at (3, 2)."""
    cameras = []
    for name, k, pose in zip(NAMES, K, POSES, strict=True):
        turn = np.diag([1.0, -1, -1]) @ pose[:3, :3]
        place = -1000 * pose[:3, :3].T @ pose[:3, 3]
        turns = " ".join(f'r{i + 1}{j + 1}="{turn[i, j]!r}"' for i in range(3) for j in range(3))
        moved = (k[0, 0], k[1, 1], k[0, 2] + 3, k[1, 2] + 2)
        keys = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
        inner = " ".join(f'{key}="{64 * value!r}"' for key, value in zip(keys, map(float, moved), strict=True))
        lens = zip(("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2"), LENS, strict=False)
        inner += " " + " ".join(f'{key}="{value}"' for key, value in lens)
        at = " ".join(f'{axis}="{float(v)!r}"' for axis, v in zip("xyz", place, strict=True))
        view = f'<fov_video left="3" top="2" right="{2 + SIZE[0]}" bottom="{1 + SIZE[1]}"/>'
        cameras.append(f'<camera serial="{name}">{view}<transform {at} {turns}/><intrinsic {inner}/></camera>')
    text = "<calibration><cameras>" + "".join(cameras) + "</cameras></calibration>"
    return text.replace("np.float64(", "").replace(')"', '"')


FORMATS = {
    "Caliscope": ("camera_array.toml", lambda: tables("cameras.{}"), "0123", LENS),
    "Anipose": ("calibration.toml", lambda: tables("cam_{}", "{}"), NAMES, LENS),
    "Pose2Sim": ("Calib.toml", lambda: tables("cam_{}", "{}", "fisheye = false"), NAMES, LENS),
    "Panoptic": ("calibration_160906.json", panoptic, NAMES, LENS),
    "Shelf": ("calibration_shelf.json", shelf, "0123", LENS),
    "Qualisys": ("Calib.qca.txt", qualisys, NAMES, [*LENS[:4], 0.0]),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_cameras_are_read_as_written(kind, tmp_path):
    name, content, names, lens = FORMATS[kind]
    text = content()
    (tmp_path / name).write_text(text if isinstance(text, str) else json.dumps(text))
    for source in (tmp_path / name, tmp_path):
        found = read_calibration(source, lambda name: (1, 1))
        assert [camera.name for camera in found.cameras] == list(names)
        np.testing.assert_allclose([camera.K for camera in found.cameras], K, atol=EXACT)
        np.testing.assert_allclose([camera.cam_from_world for camera in found.cameras], POSES, atol=EXACT)
        np.testing.assert_allclose([camera.distortion for camera in found.cameras], [lens] * 4, atol=EXACT)


@pytest.mark.parametrize("place", ["frame", "file"])
def test_a_whole_K_of_a_frame_or_of_the_file(place, tmp_path):
    files = [f"{name}.png" for name in NAMES]
    written.write_transforms(tmp_path / "transforms.json", K, POSES, files)
    values = json.loads((tmp_path / "transforms.json").read_text())
    for holder in [values, *values["frames"]]:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            holder.pop(key, None)
    for frame, k in zip(values["frames"], K, strict=True):
        (frame if place == "frame" else values)["K"] = (k if place == "frame" else K[0]).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    found = read_calibration(tmp_path / "transforms.json", lambda name: SIZE)
    np.testing.assert_allclose([camera.K for camera in found.cameras], K if place == "frame" else [K[0]] * 4, atol=EXACT)


def write_binary(folder, text):
    """The .bin files of a text model of PINHOLE cameras."""
    lines = lambda name: [x.split() for x in (text / name).read_text().splitlines() if not x.startswith("#")]
    cameras = lines("cameras.txt")
    pack = lambda c: struct.pack("<iiQQ4d", int(c[0]), 1, int(c[2]), int(c[3]), *map(float, c[4:]))
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(map(pack, cameras)))
    rows, data = lines("images.txt"), b""
    for image, seen in zip(rows[::2], rows[1::2], strict=True):
        data += struct.pack("<i7di", int(image[0]), *map(float, image[1:8]), int(image[8])) + image[9].encode() + b"\0"
        data += struct.pack("<Q", len(seen) // 3)
        for k in range(0, len(seen), 3):
            data += struct.pack("<ddq", float(seen[k]), float(seen[k + 1]), int(seen[k + 2]))
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(rows) // 2) + data)
    points = lines("points3D.txt")
    pack = lambda p: struct.pack("<Q3d3BdQii", int(p[0]), *map(float, p[1:4]), 9, 9, 9, 0.5, 1, 1, 2)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(map(pack, points)))


def test_a_binary_model_of_colmap_is_the_text_model(tmp_path):
    world = written.points()
    seen = [written.project(k, pose, world) for k, pose in zip(K, POSES, strict=True)]
    written.write_colmap(tmp_path / "text", K, POSES, [f"{n}.png" for n in NAMES], seen=seen, world_points=world)
    (tmp_path / "binary").mkdir()
    write_binary(tmp_path / "binary", tmp_path / "text")
    one, other = (read_calibration(tmp_path / kind, lambda name: (1, 1)) for kind in ("text", "binary"))
    for a, b in zip(one.cameras, other.cameras, strict=True):
        assert (a.name, a.width, a.height) == (b.name, b.width, b.height)
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
    assert one.observations is not None and other.observations is not None
    np.testing.assert_array_equal(one.observations.pixels, other.observations.pixels)
    np.testing.assert_array_equal(one.observations.points, other.observations.points)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        whole = (tmp_path / "binary" / name).read_bytes()
        (tmp_path / "binary" / name).write_bytes(whole[:-5])
        with pytest.raises(CaptureError, match=f"{name}: not a readable COLMAP model"):
            read_calibration(tmp_path / "binary", lambda name: (1, 1))
        (tmp_path / "binary" / name).write_bytes(whole)


WRONG = {
    "ignored": ("a.toml", tables("cameras.{}", extra="ignore = true"), "every camera is to be ignored"),
    "fisheye": ("a.toml", tables("cam_{}", extra="fisheye = true"), "fisheye lenses are not supported"),
    "no place": ("a.toml", tables("cam_{}").replace("translation", "other"), r"cam_0\.translation: missing"),
    "no TOML": ("a.toml", "[cam_0", "not valid TOML"),
    "entities": ("a.qca.txt", "<!DOCTYPE x [<!ENTITY a 'b'>]>" + qualisys(), "XML with entities"),
    "no focal length": ("a.qca.txt", qualisys().replace("focalLengthV", "other"), r"camera 0\.intrinsic\.focalLengthV"),
    "no list": ("a.json", json.dumps({"cameras": [{"name": "a"}]}), r"cameras\[0\]\.K: missing"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_one_line(case, tmp_path):
    name, text, problem = WRONG[case]
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=problem) as caught:
        read_calibration(tmp_path / name, lambda name: (1, 1))
    assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)
