"""A scene of known cameras and points, and writers of calibrations in every format."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.io.images import write_png

WIDTH, HEIGHT, VIEWS = 64, 48, 4
NAMES = ("a", "b", "c", "d")
FILES = tuple(f"{name}.png" for name in NAMES)
LENS = [0.01, -0.02, 0.001, 0.002, 0.003]
TARGET = np.asarray([0.1, 0.9, -0.2])
Y_UP_FROM_Z_UP = np.asarray([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def scene(views=VIEWS):
    """Returns (K (v, 3, 3), cam_from_world (v, 4, 4)) of cameras that look at TARGET.

    Pixel centres are at +0.5, y is up, lengths are metres.
    """
    K, poses = [], []
    for i in range(views):
        angle, rise = 2 * np.pi * i / views + 0.3, 0.1 + 0.1 * i
        away = np.asarray(
            [np.sin(angle) * np.cos(rise), np.sin(rise), np.cos(angle) * np.cos(rise)]
        )
        right = np.cross(-away, [0, 1, 0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-away, right), -away])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (TARGET + (2.0 + 0.2 * i) * away)
        poses.append(pose)
        K.append([[70 + i, 0, WIDTH / 2 + 1.3], [0, 71 + i, HEIGHT / 2 - 0.8], [0, 0, 1]])
    return np.asarray(K), np.asarray(poses)


def points(count=30):
    return TARGET + np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3))


def project(K, pose, p):
    q = p @ pose[:3, :3].T + pose[:3, 3]
    return (q @ K.T)[:, :2] / q[:, 2:]


def in_source(poses, scale=1.0, turn=None):
    """Returns the matrices for a world of other units and axes.

    A unit is `scale` metres; a point of that world is `turn` times ours.
    """
    poses = poses.copy()
    if turn is not None:
        poses[:, :3, :3] = poses[:, :3, :3] @ turn.T
    poses[:, :3, 3] /= scale
    return poses


def write_photos(folder, names, size=(WIDTH, HEIGHT), grey=False):
    random = np.random.default_rng(1)
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        shape = (size[1], size[0]) if grey else (size[1], size[0], 3)
        write_png(file, random.random(shape))


def quaternion(rotation):
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


def write_colmap(folder, K, poses, names, model="PINHOLE", extra=(), seen=None, world_points=None):
    """Writes cameras.txt, images.txt and points3D.txt, as COLMAP does.

    Args:
        folder: where to; made if needed.
        K: intrinsics of the views (v, 3, 3).
        poses: from the world to the cameras (v, 4, 4).
        names: of the images.
        model: COLMAP's name of the camera model.
        extra: the parameters of the model that follow the principal point.
        seen: for each view the pixels (n, 2) of `world_points`, or None for empty second lines.
        world_points: points (n, 3), or None for no file of them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list with one line of data per camera:"]
    for i, k in enumerate(K, 1):
        one_focal = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        focal = [k[0, 0]] if one_focal else [k[0, 0], k[1, 1]]
        values = " ".join(repr(float(x)) for x in [*focal, k[0, 2], k[1, 2], *extra])
        lines.append(f"{i} {model} {WIDTH} {HEIGHT} {values}")
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    # identifiers do not start at 0 and differ between files
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for i, (pose, name) in enumerate(zip(poses, names, strict=True)):
        values = " ".join(repr(float(x)) for x in [*quaternion(pose[:3, :3]), *pose[:3, 3]])
        lines.append(f"{i + 10} {values} {i + 1} {name}")
        seen_here = []
        if seen is not None:
            seen_here = [f"{x!r} {y!r} {j + 5}" for j, (x, y) in enumerate(seen[i].tolist())]
        # the last one is a pixel without a point
        lines.append(" ".join([*seen_here, "3.5 4.5 -1"]) if seen_here else "")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    if world_points is not None:
        rows = [
            f"{j + 5} {x!r} {y!r} {z!r} 128 128 128 0.5 1 2"
            for j, (x, y, z) in enumerate(world_points.tolist())
        ]
        (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(rows) + "\n")


def matrix_yaml(key, matrix, decimals=None):
    """Returns a matrix as cv2.FileStorage writes it, with data on several lines.

    With `decimals` the data are on one line, as EasyMocap writes them.
    """
    matrix = np.atleast_2d(matrix)
    if decimals is None:
        values = [f"{x:.16e}".replace("000000000000000e+00", "") for x in matrix.ravel()]
        data = ",\n       ".join(", ".join(values[i : i + 3]) for i in range(0, len(values), 3))
        data = f"[ {data} ]"
    else:
        data = "[" + ", ".join(f"{x:.{decimals}f}" for x in matrix.ravel()) + "]"
    rows, cols = matrix.shape
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data}\n"


def integer_centers(K):
    """Returns K for pixel centres at whole numbers."""
    K = K.copy()
    K[..., :2, 2] -= 0.5
    return K


def write_easymocap(folder, K, poses, names, decimals=9, dist=(0.0,) * 5):
    folder.mkdir(parents=True, exist_ok=True)
    header = "%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{name}"\n' for name in names)
    inner, outer = header, header
    for name, k, pose in zip(names, integer_centers(K), poses, strict=True):
        inner += matrix_yaml(f"K_{name}", k, decimals) + matrix_yaml(f"dist_{name}", dist, decimals)
        outer += matrix_yaml(
            f"R_{name}", Rotation.from_matrix(pose[:3, :3]).as_rotvec()[:, None], decimals
        )
        outer += matrix_yaml(f"Rot_{name}", pose[:3, :3], decimals)
        outer += matrix_yaml(f"T_{name}", pose[:3, 3:], decimals)
    (folder / "intri.yml").write_text(inner)
    (folder / "extri.yml").write_text(outer)


def write_opencv_yaml(file, K, poses, names):
    """Writes a YAML file of OpenCV with a map for each camera."""
    text = "%YAML:1.0\n---\n# of a rig\n"
    for name, k, pose in zip(names, integer_centers(K), poses, strict=True):
        inside = (
            matrix_yaml("K", k) + matrix_yaml("R", pose[:3, :3]) + matrix_yaml("T", pose[:3, 3:])
        )
        inside += f"imgSize: [ {WIDTH}, {HEIGHT} ]\n" + matrix_yaml("dist", np.zeros(5))
        text += f"{name}:\n" + "".join(f"   {line}\n" for line in inside.splitlines())
    file.write_text(text)


def write_opencv_json(file, K, poses, names):
    """Writes JSON as cv2.FileStorage does."""

    def entry(m):
        return {
            "type_id": "opencv-matrix",
            "rows": len(m),
            "cols": m.shape[1],
            "dt": "d",
            "data": m.ravel().tolist(),
        }

    values = {"names": list(names)}
    for name, k, pose in zip(names, integer_centers(K), poses, strict=True):
        values |= {
            f"K_{name}": entry(k),
            f"R_{name}": entry(pose[:3, :3]),
            f"T_{name}": entry(pose[:3, 3:]),
        }
    file.write_text(json.dumps(values, indent=4))


def write_calibration_full(file, K, poses, names, **changes):
    values = {
        name: {
            "K": k.ravel().tolist(),
            "R": pose[:3, :3].ravel().tolist(),
            "T": pose[:3, 3].tolist(),
            "distCoeff": [0.0] * 5,
            "imgSize": [WIDTH, HEIGHT],
            "rectifyAlpha": 0.0,
            **changes,
        }
        for name, k, pose in zip(names, integer_centers(K), poses, strict=True)
    }
    file.write_text(json.dumps(values))


def write_transforms(file, K, poses, names, **changes):
    """Writes transforms.json as instant-ngp does, with the intrinsics in each frame."""
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        {
            "file_path": name,
            "transform_matrix": (np.linalg.inv(pose) @ flip).tolist(),
            **{"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]},
        }
        for name, k, pose in zip(names, K, poses, strict=True)
    ]
    file.write_text(
        json.dumps(
            {"w": WIDTH, "h": HEIGHT, "aabb_scale": 16, "k1": 0.0, **changes, "frames": frames}
        )
    )


# Of the scene, with a lens
# ------------------------------------------------------------------------------------------------

K, POSES = scene()
SIZE = [WIDTH, HEIGHT]


def panoptic():
    rows = zip(NAMES, K, POSES, strict=True)

    def entry(n, k, p):
        return {
            "name": n,
            "K": k.tolist(),
            "R": p[:3, :3].tolist(),
            "t": p[:3, 3:].tolist(),
            "distCoef": LENS,
        }

    return {"cameras": [entry(*row) | {"resolution": SIZE, "type": "hd"} for row in rows]}
