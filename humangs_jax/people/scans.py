"""Dressed people as files like those of a scanner: OBJ with MTL and PNG texture, and GLB, through trimesh.

A scan is a folder: scan.obj with material.mtl and material_0.png, and scan.glb; and scan.json with what is known of the
person: seed, shape, pose. Metres, y up, texture coordinates with v up; a vertex is written once per chart that it is in.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Float, UInt8
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.text import write_json
from humangs_jax.people.atlas import texels
from humangs_jax.people.baking import SLOPE_STEP, SLOPE_ZERO, BakedSubject, bake_subject, fill_gaps
from humangs_jax.people.rendering import PosedSubject, light_points, pose_subject
from humangs_jax.people.subject import SyntheticSubject

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
    joints = len(subject.build.joints)
    rotations = np.zeros((joints, 3), np.float32) if pose is None else np.asarray(pose.rotations, np.float32)
    translation = np.zeros(3, np.float32) if pose is None else np.asarray(pose.translation, np.float32)
    posed = pose_subject(subject, rotations, translation)
    baked = bake_subject(subject, texture_size)
    texture = lit_texture(posed, baked) if lit else baked.albedo
    known = {
        "seed": subject.seed,
        "lit": lit,
        "betas": subject.betas,
        "rotations": rotations,
        "translation": translation,
    }

    def write(temporary: Path):
        temporary.mkdir()
        _write_mesh(temporary, posed.vertices[baked.atlas.vertices], baked, texture, formats)
        listed = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in known.items()}
        write_json(temporary / PARAMETERS, listed, indent=None)

    replace_folder(folder, write)
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
