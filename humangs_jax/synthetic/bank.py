"""Bakes dressed people into textured meshes, writes these as scans, and stacks them into banks.

A baked person can be drawn by a renderer that knows no materials. Texels between charts repeat the
nearest chart, so that bilinear lookups and smaller copies of the texture stay clean at seams. Folds
that are painted into the normals become a second texture. In a bank, each vertex follows only the
few joints with the largest weights.

A scan is a baked and lit mesh in a folder, like that of a scanner: scan.obj with material.mtl and
material_0.png, scan.glb, and scan.json with seed, shape and pose. Lengths are in metres, y is up,
and texture coordinates have v up. A vertex is written once for each chart that it is in.

A bank holds the arrays of people, padded to equal shapes. It is made on the host once, and
`on_the_fly_example` reads it on the device. All people of a bank are from ONE range of seeds (see
`subject.SPLITS`), so that no key of a training bank makes a person of the test range. A person
takes about 3 MB at 512 texels a side.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Float, Int, UInt, UInt8
from humangs_jax.core.processes import in_processes
from humangs_jax.core.progress import bar
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.core.records import array_fields
from humangs_jax.data.capture import Capture
from humangs_jax.data.vertex_offsets import fit_vertex_offsets, silhouette
from humangs_jax.geometry.camera import project
from humangs_jax.io.arrays import check_array, check_indices, check_joints, read_npz, write_npz
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.reading import reading, write_json
from humangs_jax.rendering.mesh.atlas import Atlas, fill_gaps, texels, unwrap
from humangs_jax.synthetic.anatomy import Joint, joint_positions
from humangs_jax.synthetic.poses import sample_rotations
from humangs_jax.synthetic.subject import (
    GENERATOR_VERSION,
    PosedSubject,
    SyntheticSubject,
    check_body,
    light_points,
    make_subject,
    paint,
    split_of,
    spots_at,
)
from humangs_jax.synthetic.surfaces import vertex_normals
from humangs_jax.synthetic.surroundings import cameras_around, spread_azimuths

# Baking
# --------------------------------------------------------------------------------------------------


JOINTS_PER_VERTEX = 6
"""Number of joints that are kept for each vertex. Bodies have up to 6, smoothed garments up to 12.
Six lose at most about 0.5 % of the weight.
"""
SLOPE_STEP = 1 / 100
"""Slope of one step of the slope texture's bytes, which hold slopes up to 1.27."""
SLOPE_ZERO = 128
"""The byte that stands for a slope of 0."""
FACE_DENSITY = 2.0
"""Texels per metre on skin and eyes of the head, divided by the texels per metre elsewhere."""


@dataclasses.dataclass(frozen=True)
class BakedSubject:
    """The textures of a person at rest."""

    atlas: Atlas
    """Texture coordinates of the mesh."""
    albedo: UInt8[np.ndarray, "t t 3"]
    """Colors without light, (t, t, 3), as bytes where 255 is 1. Row 0 is on top (v = 1)."""
    slopes: UInt8[np.ndarray, "t t 3"]
    """Gradients of painted folds along the axes of `Spots.cloth`, (t, t, 3), as bytes. A byte is
    `SLOPE_ZERO` plus the slope in steps of `SLOPE_STEP`.
    """


def bake_subject(
    subject: SyntheticSubject, texture_size: int = 1024, samples: int = 1
) -> BakedSubject:
    """Bakes the materials of a subject into textures.

    Each chart of the atlas has one material. The person's face has finer detail than the rest.

    texture_size: texels a side. samples: each texel is the mean of samples x samples points.

    Raises: ValueError if `texture_size` is no positive multiple of `atlas.CELLS`.
    """
    surface, pieces = subject.surface, subject.face_materials
    strongest = np.argmax(surface.weights[surface.faces[:, 0]], axis=1)
    # skin and eyes, the first two pieces, that head, jaw or eyes move
    face = np.isin(strongest, (Joint.HEAD, 22, 23, 24)) & np.isin(pieces, (0, 1))
    density = np.where(face, FACE_DENSITY, 1.0).astype(np.float32)
    atlas = unwrap(surface.vertices, surface.faces, 2 * pieces + face, texture_size, density)
    ids, weights = texels(dataclasses.replace(atlas, size=texture_size * samples))
    covered = ids >= 0
    albedo, slopes = paint(subject, ids[covered], spots_at(subject, ids[covered], weights[covered]))
    values = np.zeros((*ids.shape, 7), np.float32)
    values[covered] = np.concatenate(
        [albedo, slopes, np.ones((len(albedo), 1), np.float32)], axis=1
    )
    sums = values.reshape(texture_size, samples, texture_size, samples, 7).sum((1, 3))
    filled = fill_gaps(sums[..., :6] / np.maximum(sums[..., 6:], 1), sums[..., 6] > 0)
    albedo = 255 * np.clip(filled[..., :3], 0, 1)
    slopes = np.clip(filled[..., 3:] / SLOPE_STEP, -127, 127)
    return BakedSubject(
        atlas, np.round(albedo).astype(np.uint8), np.round(SLOPE_ZERO + slopes).astype(np.uint8)
    )


def strongest_joints(
    weights: Float[np.ndarray, "n j"], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """For each vertex, keeps the `count` joints that have the largest weights there.

    Returns: indices of the joints (n, k), strongest first, and their weights (n, k), scaled so that
    the weights of a vertex sum to 1. k is `count`, or the number of joints if that is smaller.
    """
    ids = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(weights, ids, axis=1)
    return ids.astype(np.uint8), (kept / kept.sum(1, keepdims=True)).astype(np.float32)


def export_scan(posed: PosedSubject, folder: str | Path, texture_size: int = 2048) -> None:
    """Writes a posed subject as a mesh whose texture contains the light.

    An existing scan in the folder is replaced. If writing fails, the folder stays as before.
    texture_size: texels a side.

    Raises: ValueError if `texture_size` is no positive multiple of `atlas.CELLS`, or if the folder
    has files but no scan; OSError.
    """
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    subject, baked = posed.subject, bake_subject(posed.subject, texture_size)
    # the light of the pose is in the texture, so viewers must not shade it again
    image = Image.fromarray(lit_texture(posed, baked))
    materials = {
        "obj": SimpleMaterial(image=image, diffuse=[255, 255, 255, 255]),
        "glb": PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0),
    }
    # what is known of the person lies beside the meshes
    known = {"betas": subject.betas, "rotations": posed.rotations, "translation": posed.translation}
    known = {"seed": subject.seed, "lit": True} | {
        name: value.tolist() for name, value in known.items()
    }

    def write(temporary: Path):
        temporary.mkdir()
        for kind, material in materials.items():
            visual = TextureVisuals(uv=baked.atlas.uvs, material=material)
            mesh = trimesh.Trimesh(
                posed.vertices[baked.atlas.vertices],
                baked.atlas.faces,
                visual=visual,
                process=False,
            )
            mesh.export(temporary / f"scan.{kind}")
        write_json(temporary / "scan.json", known, indent=None)

    replace_folder(folder, write, mark="scan.json")


def lit_texture(posed: PosedSubject, baked: BakedSubject) -> UInt8[np.ndarray, "t t 3"]:
    """Returns the texture (t, t, 3) of a posed subject, with its light. All faces are lit as if
    they were seen from outside.
    """
    ids, weights = texels(baked.atlas)
    known = ids >= 0
    albedo = baked.albedo[known].astype(np.float32) / 255
    slopes = (baked.slopes[known].astype(np.float32) - SLOPE_ZERO) * SLOPE_STEP
    colors = np.zeros((*ids.shape, 3), np.float32)
    colors[known] = light_points(posed, ids[known], weights[known], albedo, slopes)
    return np.round(255 * fill_gaps(colors, known)).astype(np.uint8)


# Banks
# --------------------------------------------------------------------------------------------------


_FORMAT = "humangs-people"
"""Name of the format in its files."""
_VERSION = 2
"""Version of the format that is written and read."""
UV_STEPS = 65535
"""Texture coordinates are stored as integers from 0 to this, which stands for 1."""
_MOST_MATERIALS = 32
"""Largest number of materials of a person; arrays of materials have this length."""


@pytree_dataclass
class PeopleBank:
    """Stacked arrays of p dressed people, whose meshes are padded to one size.

    The padding is a repeated vertex, and faces without area.
    """

    seeds: Int[Array, " p"]
    """Seed of each person, (p,)."""
    betas: Float[Array, "p s"]
    """Shape coefficients of the bodies, (p, s)."""
    joints: Float[Array, "p j 3"]
    """Joints at rest, (p, j, 3), metres."""
    vertex_counts: Int[Array, " p"]
    """Number of vertices of each mesh without padding, (p,)."""
    vertices: Float[Array, "p n 3"]
    """Vertices at rest, (p, n, 3), metres."""
    normals: Float[Array, "p n 3"]
    """Unit normals at rest, (p, n, 3)."""
    joint_ids: UInt8[Array, "p n k"]
    """Indices of the joints that move each vertex, (p, n, k)."""
    joint_weights: Float[Array, "p n k"]
    """Skinning weights of these joints, (p, n, k); rows sum to 1."""
    faces: UInt[Array, "p f 3"]
    """Triangles, (p, f, 3)."""
    uvs: UInt[Array, "p f 3 2"]
    """Texture coordinates of the faces' corners, (p, f, 3, 2), as integers from 0 to `UV_STEPS`,
    with v DOWN.
    """
    face_pieces: UInt8[Array, "p f"]
    """Index of the piece that each face belongs to, (p, f). A person has at most m pieces. Each
    piece has one material.
    """
    sheen: Float[Array, "p m"]
    """Strength of the soft highlight of each piece, (p, m), 0 to 1."""
    groups: UInt8[Array, "p m"]
    """Group of each piece, (p, m); pieces of one group are dyed alike."""
    dyeable: Float[Array, "p m"]
    """1 where a piece is cloth that may have another color, else 0, (p, m)."""
    texture: UInt8[Array, "p t t 6"]
    """Albedo (3) and slopes (3) of each person as bytes, (p, t, t, 6), see `BakedSubject`."""
    rotations: Float[Array, "p q j 3"]
    """Poses of each person, (p, q, j, 3), axis-angle, radians."""
    nearest: Int[Array, "p q"]
    """For each pose, the index of the same person's pose that is most similar to it, (p, q)."""
    displacements: Float[Array, "p b 3"]
    """Offsets that move a body's vertices to the silhouettes of the dressed person (see
    `data.vertex_offsets`), (p, b, 3), metres. b is 0 in a bank without displacements.
    """
    parents: tuple[int, ...] = static_field(default=())
    """Index of each joint's parent. Static."""
    mirrored_joints: tuple[int, ...] = static_field(default=())
    """Index of the joint on the other side of each joint. Static."""
    split: str = static_field(default="")
    """Name of the range that the seeds are from, see `subject.SPLITS`. Static."""
    generator: int = static_field(default=GENERATOR_VERSION)
    """`GENERATOR_VERSION` of the code that made the people. Static."""

    @property
    def people(self) -> int:
        """The number of people."""
        return self.betas.shape[0]


def build_bank(
    seeds: list[int] | range,
    body: BodyModel,
    split: str,
    *,
    texture_size: int = 512,
    pose_count: int = 16,
    displaced: BodyModel | None = None,
    processes: int = 1,
    progress: bool = False,
) -> PeopleBank:
    """Makes a bank of the people of some seeds.

    All seeds must lie in the range `split` of `subject.SPLITS`.

    texture_size: texels a side, a multiple of 128; 512 suits images up to 256 pixels, 1024 images
    of 512. pose_count: number of poses of each person. displaced: the body whose vertices are
    displaced, as `data.views.gaussian_body` makes it. None: the bank has no displacements.
    processes: number of processes that make people; if more than one, they use the CPU and load the
    shipped body themselves.

    Raises: ValueError if there are no seeds, if a seed lies in another range, if the body is not
    the package's body, if the size of the textures is no multiple of 128, or if a person has too
    many pieces or vertices; OSError if a process is killed.
    """
    seeds = list(seeds)
    if not seeds:
        raise ValueError("no seeds")
    _check_range(seeds, split)
    check_body(body)  # worker processes load the package's body themselves
    make = functools.partial(
        _person, texture_size=texture_size, pose_count=pose_count, displaced=displaced
    )
    if processes == 1:
        made = ((i, make(seed, body)) for i, seed in enumerate(seeds))
    else:
        made = in_processes(
            make, {i: (seed,) for i, seed in enumerate(seeds)}, processes, _shipped_body
        )
    people = dict(bar(made, total=len(seeds), desc="bank", shown=progress))
    return _stacked([people[i] for i in range(len(seeds))], body, split)


def save_bank(path: str | Path, bank: PeopleBank) -> None:
    """Writes a bank as one .npz file. If writing fails, the path stays as it was.

    Raises: OSError.
    """
    fields = {name: np.asarray(getattr(bank, name)) for name in (*_ARRAYS, *_STATIC)}
    write_npz(path, fields | {"format": np.asarray(_FORMAT), "version": np.asarray(_VERSION)})


def load_bank(path: str | Path) -> PeopleBank:
    """Reads a bank. Raises: FileNotFoundError; FileError if the file holds no bank, a damaged bank
    or a bank of another version of the format.
    """
    with reading(path, "bank of people"):
        arrays, _ = read_npz(path)
        if str(arrays.get("format")) != _FORMAT:
            raise ValueError(f"{path}: not a bank of people")
        version = int(arrays["version"])
        if version != _VERSION:
            raise ValueError(
                f"{path}: a bank of version {version}; this program reads version {_VERSION}"
            )
        missing = {*_ARRAYS, *_STATIC} - set(arrays)
        if missing:
            raise ValueError(f"{path}: a bank without {sorted(missing)}")
        _check_arrays(arrays)
        _check_range(arrays["seeds"].tolist(), str(arrays["split"]), f"{path}: ")
        fields: dict[str, Any] = {name: jnp.asarray(arrays[name]) for name in _ARRAYS}
        for name in ("parents", "mirrored_joints"):
            fields[name] = tuple(arrays[name].tolist())
        return PeopleBank(**fields, split=str(arrays["split"]), generator=int(arrays["generator"]))


_STATIC = ("parents", "mirrored_joints", "split", "generator")
_ARRAYS = tuple(name for name in PeopleBank.__annotations__ if name not in _STATIC)


def _check_arrays(arrays: dict[str, np.ndarray]) -> None:
    """Checks that sizes fit each other, numbers are real and finite, and indices exist.

    Raises: InvalidFileError if one of these does not hold.
    """
    sizes: dict[str, int] = {}
    fields = array_fields(PeopleBank)
    for name in _ARRAYS:
        check_array(name, arrays[name], fields[name].shape(arrays[name], sizes))
    bounds = {
        "faces": sizes["n"],
        "joint_ids": sizes["j"],
        "nearest": sizes["q"],
        "face_pieces": sizes["m"],
    }
    for name, bound in bounds.items():
        check_indices(name, arrays[name], arrays[name].shape, bound)
    check_joints(arrays["parents"].tolist(), [""] * sizes["j"])
    check_indices("mirrored_joints", arrays["mirrored_joints"], (sizes["j"],), sizes["j"])


def _check_range(seeds: Sequence[int], split: str, where: str = "") -> None:
    for seed in seeds:
        if split_of(seed) != split:
            raise ValueError(
                f"{where}seed {seed} belongs to the range '{split_of(seed)}', not to '{split}'"
            )


@functools.cache
def _shipped_body() -> BodyModel:
    return load_body()


def _person(
    seed: int,
    body: BodyModel | None = None,
    *,
    texture_size: int,
    pose_count: int,
    displaced: BodyModel | None,
) -> dict[str, np.ndarray]:
    """Returns the arrays of one person for a bank, by name, without padding.

    body: None for the shipped body. Other arguments are those of `build_bank`.
    """
    subject = make_subject(seed, _shipped_body() if body is None else body)
    supersample = 2 if texture_size <= 512 else 1  # fine patterns on coarse texels
    baked = bake_subject(subject, texture_size, supersample)
    surface, atlas, materials = subject.surface, baked.atlas, subject.materials
    if len(materials) > _MOST_MATERIALS or len(surface.vertices) > np.iinfo(np.uint16).max:
        raise ValueError(
            f"seed {seed}: {len(materials)} pieces, {len(surface.vertices)} vertices: too many"
        )
    u, v = np.moveaxis(atlas.uvs[atlas.faces], -1, 0)

    def pad(values: Sequence[Any], kind: type) -> np.ndarray:
        """Pads numbers of the materials with zeros to `_MOST_MATERIALS`."""
        return np.pad(np.asarray(values), (0, _MOST_MATERIALS - len(materials))).astype(kind)

    identities = [id(material) for material in materials]
    # stream 20 of a seed draws poses: others than those of written sets
    generators = (np.random.default_rng([seed, 20, i]) for i in range(pose_count))
    rotations = np.stack([sample_rotations(rng, subject.build) for rng in generators]).astype(
        np.float32
    )
    places = np.stack([joint_positions(subject.build, r.astype(np.float64))[1] for r in rotations])
    # distance of each pose from the others
    away = np.linalg.norm(places[:, None] - places[None], axis=-1).mean(-1)
    joint_ids, joint_weights = strongest_joints(surface.weights, JOINTS_PER_VERTEX)
    displacements = np.zeros((0, 3), np.float16)
    if displaced is not None:
        displacements = to_silhouettes(subject, displaced, rotations[0])
    return {
        "seeds": np.asarray(seed, np.int32),
        "betas": subject.betas,
        "joints": subject.build.joints.astype(np.float32),
        "vertex_counts": np.asarray(len(surface.vertices), np.int32),
        "vertices": surface.vertices.astype(np.float32),
        "normals": vertex_normals(surface.vertices, surface.faces).astype(np.float16),
        "joint_ids": joint_ids,
        "joint_weights": joint_weights.astype(np.float16),
        "faces": surface.faces.astype(np.uint16),
        "uvs": np.round(UV_STEPS * np.stack([u, 1 - v], -1)).astype(np.uint16),
        "face_pieces": subject.face_materials.astype(np.uint8),
        "sheen": pad([material.sheen for material in materials], np.float32),
        "groups": pad([identities.index(i) for i in identities], np.uint8),
        "dyeable": pad([material.wrinkles > 0 for material in materials], np.float32),
        "texture": np.concatenate([baked.albedo, baked.slopes], axis=-1),
        "rotations": rotations,
        "nearest": np.argmin(away + 1e9 * np.eye(pose_count), axis=1).astype(np.int32),
        "displacements": displacements,
    }


def to_silhouettes(
    subject: SyntheticSubject, body: BodyModel, rotations: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "b 3"]:
    """Returns displacements of a body's vertices (b, 3), metres. They are fitted to silhouettes of
    the dressed person.

    Four cameras around the person see the silhouettes in one pose. rotations: the pose, (j, 3),
    axis-angle, radians.
    """
    views, side = 4, 960  # pixels
    rng, nowhere = np.random.default_rng([subject.seed, 23]), np.zeros(3, np.float32)
    vertices = subject.posed_vertices(rotations, nowhere)
    cameras = cameras_around(rng, vertices, spread_azimuths(rng, views), side)
    pixels = np.asarray(
        jax.vmap(project, in_axes=(0, None))(cameras, jnp.asarray(vertices, jnp.float32))[0]
    )
    masks = np.stack([silhouette(view, subject.surface.faces, (side, side)) for view in pixels])
    frames, names = np.zeros(views, int), tuple(map(str, range(views)))
    poses = jax.tree.map(lambda x: x[None], BodyPose(jnp.asarray(rotations), jnp.asarray(nowhere)))
    images = np.broadcast_to(masks[..., None], (*masks.shape, 3))
    return fit_vertex_offsets(
        body, Capture(images, masks, cameras, frames, body, subject.betas, poses, names)
    ).astype(np.float16)


def _stacked(people: Sequence[dict[str, np.ndarray]], body: BodyModel, split: str) -> PeopleBank:
    """Pads the arrays of people to one size, and stacks them into a bank."""
    # the sizes of the largest mesh, rounded up: few shapes are compiled
    vertices = -(-max(len(p["vertices"]) for p in people) // 1024) * 1024
    faces = -(-max(len(p["faces"]) for p in people) // 2048) * 2048

    def padded(name, array):
        if name in ("faces", "uvs", "face_pieces"):
            return np.pad(array, [(0, faces - len(array))] + [(0, 0)] * (array.ndim - 1))
        if name in ("vertices", "normals", "joint_ids", "joint_weights"):
            return np.concatenate([array, np.repeat(array[:1], vertices - len(array), axis=0)])
        return array

    fields: dict[str, Any] = {
        name: jnp.asarray(np.stack([padded(name, p[name]) for p in people])) for name in _ARRAYS
    }
    return PeopleBank(
        **fields,
        parents=body.parents,
        mirrored_joints=mirrored_joints(body.joint_names),
        split=split,
    )


def mirrored_joints(names: tuple[str, ...]) -> tuple[int, ...]:
    """Returns for each joint the index of the joint on the other side.

    A joint in the middle has its own index. Raises: ValueError if one of a pair is missing.
    """
    other = {"left": "right", "right": "left"}
    swapped = []
    for name in names:
        side, _, part = name.partition("_")
        swapped.append(f"{other[side]}_{part}" if side in other else name)
    return tuple(names.index(name) for name in swapped)
