"""Dressed people as textured meshes, for renderers that know no materials; and as scans.

Texels between charts repeat the nearest chart, so that bilinear lookups and smaller copies of the texture stay clean at seams.
Folds that are painted into the normals become a second texture. Skinning is cut down to a few joints per vertex.

A scan is such a mesh in a folder, like a scanner's: scan.obj with material.mtl and material_0.png, scan.glb, and scan.json
with seed, shape and pose. Metres, y up, texture coordinates with v up; a vertex is written once per chart that it is in.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Float, UInt8
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.reading import write_json
from humangs_jax.people.kinematics import HEAD
from humangs_jax.people.rendering import PosedSubject, light_points, paint, pose_subject, spots_at
from humangs_jax.people.subject import SyntheticSubject
from humangs_jax.rendering.mesh.atlas import Atlas, fill_gaps, texels, unwrap

JOINTS_PER_VERTEX = 6
"""Bodies have up to 7, smoothed garments up to 12; six lose at most 0.4 % of the weight, under a millimetre in any pose."""
SLOPE_STEP, SLOPE_ZERO = 1 / 100, 128
"""One step of the slope texture's bytes: slopes up to 1.27; byte of no slope."""
FACE_DENSITY = 2.0
"""Texels per metre of skin and eyes of the head, relative to everything else."""
HEAD_JOINTS, SKIN_AND_EYES = (HEAD, 22, 23, 24), (0, 1)
"""Head, jaw and eyes; the materials of a subject that `make_subject` puts first."""


@dataclasses.dataclass(frozen=True)
class BakedSubject:
    """The textures of a person at rest.

    atlas: texture coordinates. albedo: (t, t, 3) bytes, 255 is 1, row 0 on top (v = 1).
    slopes: (t, t, 3) bytes, gradients of painted folds, `SLOPE_ZERO` + steps of `SLOPE_STEP`, axes of `Spots.cloth`.
    """

    atlas: Atlas
    albedo: UInt8[np.ndarray, "t t 3"]
    slopes: UInt8[np.ndarray, "t t 3"]


def bake_subject(subject: SyntheticSubject, texture_size: int = 1024, samples: int = 1) -> BakedSubject:
    """The textures of a subject, texture_size texels a side, each the mean of samples x samples points.

    No chart of the atlas is across two materials; faces (of people) are in finer detail.
    Raises: ValueError if the size is no multiple of the packing's `atlas.CELLS`.
    """
    surface, pieces = subject.surface, subject.face_materials
    strongest = np.argmax(surface.weights[surface.faces[:, 0]], axis=1)
    face = np.isin(strongest, HEAD_JOINTS) & np.isin(pieces, SKIN_AND_EYES)
    density = np.where(face, FACE_DENSITY, 1.0).astype(np.float32)
    atlas = unwrap(surface.vertices, surface.faces, 2 * pieces + face, texture_size, density)
    ids, weights = texels(dataclasses.replace(atlas, size=texture_size * samples))
    covered = ids >= 0
    albedo, slopes = paint(subject, ids[covered], spots_at(subject, ids[covered], weights[covered]))
    values = np.zeros((*ids.shape, 7), np.float32)
    values[covered] = np.concatenate([albedo, slopes, np.ones((len(albedo), 1), np.float32)], axis=1)
    sums = values.reshape(texture_size, samples, texture_size, samples, 7).sum((1, 3))
    filled = fill_gaps(sums[..., :6] / np.maximum(sums[..., 6:], 1), sums[..., 6] > 0)
    albedo, slopes = 255 * np.clip(filled[..., :3], 0, 1), np.clip(filled[..., 3:] / SLOPE_STEP, -127, 127)
    return BakedSubject(atlas, np.round(albedo).astype(np.uint8), np.round(SLOPE_ZERO + slopes).astype(np.uint8))


def strongest_joints(weights: Float[np.ndarray, "n j"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """The `count` joints (n, k) of most weight of each vertex, strongest first, and their weights (n, k) scaled to sum 1."""
    ids = np.argsort(-weights, axis=1, kind="stable")[:, :count]
    kept = np.take_along_axis(weights, ids, axis=1)
    return ids.astype(np.uint8), (kept / kept.sum(1, keepdims=True)).astype(np.float32)


SCAN, TEXTURE, PARAMETERS = "scan", "material_0.png", "scan.json"
"""Names in a scan's folder: of the meshes (without ending), the texture of the OBJ, and what is known of the person."""


def export_scan(
    subject: SyntheticSubject,
    folder: str | Path,
    pose: BodyPose | None = None,
    *,
    lit: bool = False,
    texture_size: int = 2048,
    formats: Sequence[str] = ("obj", "glb"),
) -> Path:
    """Write a subject as a textured mesh, in a pose or (None) in the T-pose at rest; returns the folder.

    lit: the texture carries the subject's light in that pose; otherwise it is albedo. Written whole or not at all; an
    existing folder is replaced. Raises: ValueError if a format is neither "obj" nor "glb".
    """
    if unknown := set(formats) - {"obj", "glb"}:
        raise ValueError(f"scans are written as obj or glb, not as {sorted(unknown)}")
    pose = BodyPose(jnp.zeros((len(subject.build.joints), 3)), jnp.zeros(3)) if pose is None else pose
    posed = pose_subject(subject, *(np.asarray(x, np.float32) for x in (pose.rotations, pose.translation)))
    baked = bake_subject(subject, texture_size)
    texture = lit_texture(posed, baked) if lit else baked.albedo
    known = {"betas": subject.betas, "rotations": posed.rotations, "translation": posed.translation}
    known = {"seed": subject.seed, "lit": lit} | {name: value.tolist() for name, value in known.items()}

    def write(temporary: Path):
        temporary.mkdir()
        _write_mesh(temporary, posed.vertices[baked.atlas.vertices], baked, texture, formats)
        write_json(temporary / PARAMETERS, known, indent=None)

    replace_folder(folder, write, mark=PARAMETERS)
    return Path(folder)


def lit_texture(posed: PosedSubject, baked: BakedSubject) -> UInt8[np.ndarray, "t t 3"]:
    """(t, t, 3) the texture of a pose as its light makes it, seen from outside."""
    ids, weights = texels(baked.atlas)
    known = ids >= 0
    albedo = baked.albedo[known].astype(np.float32) / 255
    slopes = (baked.slopes[known].astype(np.float32) - SLOPE_ZERO) * SLOPE_STEP
    colors = np.zeros((*ids.shape, 3), np.float32)
    colors[known] = light_points(posed, ids[known], weights[known], albedo, slopes)
    return np.round(255 * fill_gaps(colors, known)).astype(np.uint8)


def _write_mesh(folder: Path, vertices: Float[np.ndarray, "u 3"], baked, texture, formats):
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    image = Image.fromarray(texture)
    simple = SimpleMaterial(image=image, diffuse=[255, 255, 255, 255])
    physical = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    for kind, material in (("obj", simple), ("glb", physical)):
        if kind in formats:
            visual = TextureVisuals(uv=baked.atlas.uvs, material=material)
            trimesh.Trimesh(vertices, baked.atlas.faces, visual=visual, process=False).export(folder / f"{SCAN}.{kind}")
