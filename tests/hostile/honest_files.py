"""An honest file of each kind: what the hostile ones are made from."""

import functools
import io
import json

import bvh_files
import calibration_files
import dataset_files
import jax
import numpy as np
from PIL import Image
from small import tetrahedron

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.capture.keypoints.keypoints import COCO_17
from humangs_jax.io.mesh import GlbWriter
from humangs_jax.motion.skeleton import shipped_joints
from humangs_jax.network.weights import expected_variables, save_weights
from humangs_jax.synthetic.subject import GENERATOR_VERSION
from humangs_jax.training.config import tiny

K = [[60.0, 0, 5], [0, 60, 6], [0, 0, 1]]
POSE = [[1.0, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 2.6], [0, 0, 0, 1]]
VIEWS = ("000", "001")
tiny_body = functools.partial(tetrahedron, tuple("xyz"))


def saved(name, write):
    """A seed: calls write(path)."""

    def seed(folder):
        write(folder / name)
        return folder / name

    return seed


def npz(name, arrays):
    return saved(name, lambda path: np.savez_compressed(path, **arrays()))


def written(name, data):
    """A seed: a file of bytes, of text, or of what a function returns."""

    def make(folder):
        content = data() if callable(data) else data
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / name

    return make


def pixels(*shape, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, 256, shape).astype(dtype)


def avatar_arrays(g=6, n=4, j=3):
    random = np.random.default_rng(0)
    return {
        "means": random.normal(size=(g, 3)).astype(np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (g, 1)),
        "scales": np.full((g, 3), 0.01, np.float32),
        "opacities": np.full(g, 0.5, np.float32),
        "colors": random.random((g, 3)).astype(np.float32),
        "skinning_weights": np.full((g, j), 1 / j, np.float32),
        "rest_vertices": random.normal(size=(n, 3)).astype(np.float32),
        "rest_joints": random.normal(size=(j, 3)).astype(np.float32),
        "faces": np.int32([[0, 1, 2], [1, 2, 3]]),
    }


AVATAR_HEADER = {
    **{
        "format": "humangs-avatar",
        "version": 1,
        "parents": [-1, 0, 1],
        "joint_names": ["a", "b", "c"],
    },
    **{"skinning": "affine", "rendering": "exact"},
}


def avatar_file():
    return {"header": json.dumps(AVATAR_HEADER)} | avatar_arrays()


def write_weights(path):
    config = tiny().model
    shapes = expected_variables(config)
    save_weights(
        path, jax.tree.map(lambda x: np.zeros(x.shape, np.float32), shapes), config, "float16"
    )


def capture_description(**changes):
    views = [
        {
            "image": f"images/{name}.png",
            "mask": f"masks/{name}.png",
            "frame": i,
            "K": K,
            "cam_from_world": POSE,
        }
        for i, name in enumerate(VIEWS)
    ]
    return {"format": "humangs-capture", "version": 1, "body": "body.npz", "views": views} | changes


def body_parameters():
    return {
        "body": np.asarray("makehuman"),
        "betas": np.zeros(3, np.float32),
        "rotations": np.zeros((2, 5, 3), np.float32),
        "translations": np.zeros((2, 3), np.float32),
        "displacement": np.zeros((4, 3), np.float32),
    }


def write_capture(folder):
    for kind, shape in (("images", (12, 10, 3)), ("masks", (12, 10))):
        (folder / kind).mkdir()
        for name in VIEWS:
            Image.fromarray(pixels(*shape)).save(folder / kind / f"{name}.png")
    (folder / "capture.json").write_text(json.dumps(capture_description()))
    np.savez_compressed(folder / "body.npz", **body_parameters())
    return folder


def transforms(**changes):
    frames = [{"file_path": f"photos/{name}.png", "transform_matrix": POSE} for name in VIEWS]
    return {"fl_x": 60, "cx": 5, "cy": 6, "w": 10, "h": 12, "frames": frames} | changes


def opencv_yaml():
    matrix = lambda name, rows, cols, data: (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data}\n"
    )
    parts = [
        matrix(f"K_{i}", 3, 3, [60.0, 0, 5, 0, 60, 6, 0, 0, 1])
        + matrix(f"R_{i}", 3, 3, [1.0, 0, 0, 0, -1, 0, 0, 0, -1])
        + matrix(f"T_{i}", 3, 1, [0.0, 0.9, 2.6])
        for i in ("a", "b")
    ]
    return "%YAML:1.0\n---\n" + "".join(parts)


def write_easymocap(folder):
    calibration_files.write_easymocap(folder, *calibration_files.scene(), calibration_files.NAMES)
    return folder


def write_colmap(folder):
    (folder / "cameras.txt").write_text("# cameras\n1 PINHOLE 10 12 60 60 5 6\n")
    images = [
        f"{i} 0 1 0 0 0 0.9 2.6 1 photos/{name}.png\n5.0 6.0 {i}\n"
        for i, name in enumerate(VIEWS, 1)
    ]
    (folder / "images.txt").write_text("# images\n" + "".join(images))
    (folder / "points3D.txt").write_text(
        "# points\n1 0 0.9 0 9 9 9 0.1 1 0\n2 0.1 0.9 0 9 9 9 0.1 2 0\n"
    )
    return folder


def write_colmap_binary(folder):
    calibration_files.write_binary(folder, write_colmap(folder))
    for file in folder.glob("*.txt"):
        file.unlink()
    return folder


def write_import(folder):
    (folder / "photos").mkdir()
    for name in VIEWS:
        Image.fromarray(pixels(12, 10, 3)).save(folder / "photos" / f"{name}.png")
    (folder / "transforms.json").write_text(json.dumps(transforms()))
    return folder / "transforms.json"


def write_import_folder(folder):
    write_import(folder)
    return folder


def motion_arrays(**changes):
    return {
        "rotations": np.zeros((3, 55, 3)),
        "translations": np.zeros((3, 3)),
        "fps": 30.0,
    } | changes


MDM = {
    "thetas": np.tile(np.eye(3)[:2].reshape(1, 6, 1), (24, 1, 3)),
    "root_translation": np.zeros((3, 3)),
    "text": "walk",
}
KIMODO = {"local_rot_mats": np.tile(np.eye(3), (3, 22, 1, 1)), "root_positions": np.zeros((3, 3))}


def person(count, numbers=3):
    return np.random.default_rng(2).uniform(10, 400, (count, numbers))


def openpose():
    values = person(25)
    values[:, 2] = 0.9
    return json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": values.ravel().tolist()}]})


def annots():
    values = person(25)
    values[:, 2] = 0.9
    return json.dumps(
        {"filename": "000.jpg", "annots": [{"personID": 0, "keypoints": values.tolist()}]}
    )


def coco():
    values = person(17)
    values[:, 2] = 0.9
    entries = [
        {"file_name": f"{n}.png", "category_id": 1, "keypoints": values.ravel().tolist()}
        for n in VIEWS
    ]
    return json.dumps(entries)


def coco_annotations():
    values = person(17)
    values[:, 2] = 2
    images = [
        {"id": i, "file_name": f"{n}.png", "width": 640, "height": 480} for i, n in enumerate(VIEWS)
    ]
    annotations = [
        {"id": i, "image_id": i, "keypoints": values.ravel().tolist()} for i in range(len(VIEWS))
    ]
    return json.dumps({"images": images, "annotations": annotations})


def mmpose():
    frames = [
        {
            "frame_id": i,
            "instances": [{"keypoints": person(17, 2).tolist(), "keypoint_scores": [0.9] * 17}],
        }
        for i in range(len(VIEWS))
    ]
    return json.dumps({"meta_info": {}, "instance_info": frames})


def keypoint_arrays():
    points = np.stack([person(17, 2)] * 2).astype(np.float32)
    return {
        **{"set": np.asarray(COCO_17.name), "names": np.asarray(VIEWS), "points": points},
        "confidences": np.full((2, 17), 0.9, np.float32),
    }


def fit_arrays():
    return keypoint_arrays() | {
        **{"noise": np.ones(2, np.float32), "joint_std": np.ones((2, 5), np.float32)},
        **{
            "determined": np.ones((2, 5), np.float32),
            "shape_covariance": np.eye(3, dtype=np.float32),
        },
        **{"places": np.zeros((17, 3), np.float32), "certainty": np.ones(17, np.float32)},
    }


def lhm():
    parts = {"root_pose": (3,), "body_pose": (21, 3), "trans": (3,), "jaw_pose": (3,)}
    return json.dumps({key: np.zeros(shape).tolist() for key, shape in parts.items()})


def phalp():
    pose = {"global_orient": np.eye(3)[None], "body_pose": np.tile(np.eye(3), (23, 1, 1))}
    return {f"{i}.jpg": {"tid": [1], "smpl": [pose], "camera": [np.zeros(3)]} for i in range(3)}


TRAM = {
    "pred_rotmat": np.tile(np.eye(3), (3, 24, 1, 1)),
    "pred_trans": np.zeros((3, 1, 3)),
    "frame": np.arange(3),
}


def mhr():
    points = np.random.default_rng(3).normal(size=(2, 127, 3))
    return {
        "pred_joint_coords": points,
        "pred_cam_t": np.zeros((2, 3)),
        "pred_global_rots": np.tile(np.eye(3), (2, 127, 1, 1)),
    }


def write_easymocap_motion(folder):
    person = {
        "id": 0,
        "Rh": [[0.0, 0, 0]],
        "Th": [[0.0, 0, 1]],
        "poses": [[0.0] * 72],
        "shapes": [[0.0] * 10],
    }
    for i in range(3):
        (folder / f"{i:06d}.json").write_text(json.dumps([person]))
    return folder


def splats():
    """What gsplat's trainer saves of four Gaussians."""
    shapes = {
        "means": (3,),
        "quats": (4,),
        "scales": (3,),
        "opacities": (),
        "sh0": (1, 3),
        "shN": (3, 3),
    }
    return {name: np.full((4, *shape), 0.5, np.float32) for name, shape in shapes.items()}


def text_ply():
    """Of Gaussians, in text."""
    names = [*"xyz", *(f"{kind}_{i}" for kind in ("f_dc", "scale") for i in range(3)), "opacity"]
    names += [f"rot_{i}" for i in range(4)]
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 4",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    return "\n".join([*header, *[" ".join(["0.5"] * len(names))] * 4, ""])


def compressed_ply():
    """Of PlayCanvas, with harmonics."""
    bounds = [
        f"{end}_{name}"
        for end in ("min", "max")
        for name in (*"xyz", "scale_x", "scale_y", "scale_z")
    ]
    words = [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "element chunk 1",
        *(f"property float {name}" for name in bounds),
    ]
    header += [
        "element vertex 4",
        *words,
        "element sh 4",
        *(f"property uchar f_rest_{i}" for i in range(9)),
        "end_header\n",
    ]
    body = (
        np.repeat(np.float32([-1, 1]), 6).tobytes()
        + np.arange(16, dtype="<u4").tobytes()
        + bytes(36)
    )
    return "\n".join(header).encode() + body


def write_glb_motion(path):
    """A skeleton of CMU's names whose hips turn in two frames."""
    rest, names, writer = shipped_joints(), bvh_files.CMU, GlbWriter()
    joints = [name for name in JOINT_NAMES if name in names]
    above = {name: JOINT_NAMES[PARENTS[JOINT_NAMES.index(name)]] for name in joints[1:]}
    place = lambda name: rest[JOINT_NAMES.index(name)]
    nodes = [
        {
            "name": names[n],
            "translation": (place(n) - (place(above[n]) if n in above else 0)).tolist(),
        }
        for n in joints
    ]
    for name, node in zip(joints, nodes, strict=True):
        if children := [joints.index(other) for other in joints if above.get(other) == name]:
            node["children"] = children
    matrices = np.tile(np.eye(4), (len(joints), 1, 1))
    matrices[:, 3, :3] = [-place(name) for name in joints]  # column by column, as glTF has them
    inverse = writer.array("MAT4", matrices.reshape(-1, 16))
    times, turns = (
        writer.array("SCALAR", np.arange(2.0)),
        writer.array("VEC4", np.tile([0.0, 0, 0, 1], (2, 1))),
    )
    channel = {"sampler": 0, "target": {"node": 0, "path": "rotation"}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": turns}]}
    skin = {"joints": list(range(len(joints))), "inverseBindMatrices": inverse}
    writer.write(path, {"nodes": nodes, "skins": [skin], "animations": [animation]})


SHAPES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft", "eyeBlinkRight", "odd")


def write_glb_face(path, vrm=False):
    """A face in two frames: weights of the shapes of a mesh, or expressions of a VRM animation."""
    writer, weights = GlbWriter(), np.linspace(0, 1, 2 * len(SHAPES))
    times = writer.array("SCALAR", np.arange(2.0))
    if not vrm:
        output = writer.array("SCALAR", weights)
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        animation = {"channels": [channel], "samplers": [{"input": times, "output": output}]}
        mesh = {"primitives": [], "extras": {"targetNames": list(SHAPES)}}
        writer.write(path, {"nodes": [{"mesh": 0}], "meshes": [mesh], "animations": [animation]})
        return
    channels, samplers = [], []
    for i, values in enumerate(weights.reshape(2, -1).T):
        output = writer.array("VEC3", values[:, None] * (1.0, 0, 0))
        samplers.append({"input": times, "output": output})
        channels.append({"sampler": i, "target": {"node": i, "path": "translation"}})
    custom = {name: {"node": i} for i, name in enumerate(SHAPES[:-1])}
    expressions = {"custom": custom, "preset": {"happy": {"node": len(SHAPES) - 1}}}
    extension = {"specVersion": "1.0", "humanoid": {"humanBones": {}}, "expressions": expressions}
    document = {
        "nodes": [{"name": name} for name in SHAPES],
        "extensions": {"VRMC_vrm_animation": extension},
        "animations": [{"channels": channels, "samplers": samplers}],
    }
    writer.write(path, document)


def face_table():
    """As Live Link Face writes it."""
    names = ("EyeBlinkLeft", "JawOpen", "MouthSmileLeft", "MouthSmileRight", "TongueOut", "HeadYaw")
    lines = [f"09:41:07:{i:02}.{i}00,61,{','.join(['0.25'] * len(names))}" for i in range(3)]
    return "\n".join([f"Timecode,BlendShapeCount,{','.join(names)}", *lines, ""])


def face_scores():
    """As programs with MediaPipe write them."""
    scores = [{"index": i, "score": 0.5, "categoryName": name} for i, name in enumerate(SHAPES)]
    return {"fps": 25, "frames": [{"faceBlendshapes": [{"categories": scores}]}, {}]}


def sphere():
    import trimesh

    return trimesh.creation.icosphere(subdivisions=2, radius=0.5)


def photo_bytes():
    stream = io.BytesIO()
    Image.fromarray(pixels(64, 64, 3)).save(stream, format="PNG")
    return stream.getvalue()


def textured_obj(folder, texture="texture.png", material="scan.mtl"):
    (folder / "scan.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {texture}\n")
    mesh = sphere()
    lines = [f"mtllib {material}", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    lines += [f"vt {x + 0.5} {y + 0.5}" for x, y, _ in mesh.vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in mesh.faces]
    (folder / "scan.obj").write_text("\n".join(lines))
    return folder / "scan.obj"


def write_obj(folder):
    Image.fromarray(pixels(4, 4, 3)).save(folder / "texture.png")
    return textured_obj(folder)


def bank_arrays():
    p, n, f, q, j, k = 2, 8, 4, 2, 5, 4
    return {
        **{
            "format": np.asarray("humangs-people"),
            "version": np.asarray(2),
            "split": np.asarray("train"),
        },
        **{
            "generator": np.asarray(1),
            "parents": np.asarray([-1, 0, 1, 2, 3]),
            "mirrored_joints": np.arange(j),
        },
        **{"seeds": np.asarray([0, 1], np.int32), "betas": np.zeros((p, 3), np.float32)},
        **{"joints": np.zeros((p, j, 3), np.float32), "vertex_counts": np.full(p, n, np.int32)},
        **{"vertices": np.zeros((p, n, 3), np.float32), "normals": np.zeros((p, n, 3), np.float16)},
        **{
            "joint_ids": np.zeros((p, n, k), np.uint8),
            "joint_weights": np.full((p, n, k), 0.25, np.float16),
        },
        **{"faces": np.zeros((p, f, 3), np.uint16), "uvs": np.zeros((p, f, 3, 2), np.uint16)},
        **{"face_pieces": np.zeros((p, f), np.uint8), "sheen": np.zeros((p, 32), np.float32)},
        **{"groups": np.zeros((p, 32), np.uint8), "dyeable": np.zeros((p, 32), np.float32)},
        **{
            "texture": np.zeros((p, 8, 8, 6), np.uint8),
            "rotations": np.zeros((p, q, j, 3), np.float32),
        },
        **{"nearest": np.zeros((p, q), np.int32), "displacements": np.zeros((p, 0, 3), np.float16)},
    }


def data_set(write, *arguments, **options):
    """A seed: the folder of a data set."""

    def seed(folder):
        write(folder, *arguments, **options)
        return folder

    return seed


STATE = {
    "a.weight": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.asarray([1, 2], np.int64),
}
MODEL = dataset_files.model_arrays()
MANIFEST = {"generator_version": GENERATOR_VERSION} | {
    "format": "humangs-synthetic",
    "version": 2,
    "split": "train",
    "settings": {},
}
