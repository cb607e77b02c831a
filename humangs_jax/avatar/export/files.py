"""An avatar to a file, or a motion to a sequence of files: the suffix decides the format."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gltf import write_glb
from humangs_jax.avatar.export.mesh import body_mesh
from humangs_jax.avatar.export.mesh_gltf import write_mesh_glb
from humangs_jax.avatar.export.obj import write_material, write_obj
from humangs_jax.avatar.export.ply import write_ply
from humangs_jax.avatar.export.splat import write_splat
from humangs_jax.avatar.export.spz import write_spz
from humangs_jax.avatar.export.world import Up, grounded_gaussians, turned
from humangs_jax.body.model import BodyPose, RestBody
from humangs_jax.data.motion import Motion, grounded
from humangs_jax.rendering.gaussians import Gaussians

GAUSSIANS: dict[str, Callable[[Path, Gaussians], None]] = {
    ".ply": write_ply,
    ".splat": write_splat,
    ".spz": write_spz,
    ".glb": write_glb,
}
"""Writers of files of Gaussians by suffix."""
MESHES = (".glb", ".obj")
"""Suffixes of files of meshes."""
USUAL_UP: dict[str, Up] = {".ply": "-y", ".splat": "-y", ".spz": "y", ".glb": "y", ".obj": "y"}
"""The axis that the readers of a format take for up."""
DIGITS = 4
"""Of the numbers in the names of a sequence."""


def frame_range(text: str, count: int) -> range:
    """The frames that "a:b:step" names as Python does, of `count`; each part may be missing. Raises: ValueError."""
    parts = text.split(":")
    if not 2 <= len(parts) <= 3 or not all(re.fullmatch(r"\s*(-?\d{1,9})?\s*", part) for part in parts):
        raise ValueError(f"{text!r}: expected frames as a:b:step, such as 0:100:5 or : for all")
    numbers = [int(part) if part.strip() else None for part in parts]
    if len(numbers) > 2 and numbers[2] is not None and numbers[2] < 1:
        raise ValueError(f"{text!r}: expected a step of 1 or more")
    frames = range(count)[slice(*numbers)]
    if not frames:
        raise ValueError(f"{text!r}: none of the {count} frames, which are counted from 0")
    return frames


def export(
    path: Path,
    avatar: Avatar,
    motion: Motion | None = None,
    numbers: Sequence[int] | None = None,
    *,
    mesh: bool = False,
    up: Up | None = None,
    rest_fields: bool = False,
    name: str = "motion",
) -> list[Path]:
    """Write an avatar in T-pose, in one pose, or in the poses of a motion; returns the files. Each appears whole or not at all.

    Arguments:
        path: with a suffix of GAUSSIANS or, with `mesh`, of MESHES.
        motion: None for the T-pose. A `.glb` of the mesh holds all of it as animation.
        numbers: of the motion's frames: "x.ply" becomes "x_0007.ply". All stand on one floor: who jumps leaves it. None: the
            motion has one frame, whose feet are on 0.
        up: the axis that points up; None for USUAL_UP. rest_fields: see `write_ply`. name: of the animation.

    Raises: ValueError for another suffix, or if `numbers` are not one for each frame of the motion.
    """
    _check(path, motion, numbers, mesh)
    suffix = path.suffix.lower()
    up = up or USUAL_UP[suffix]
    if motion is not None and (mesh or numbers is not None):
        motion = grounded(motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents)
    if mesh and suffix == ".glb":
        write_mesh_glb(path, avatar, body_mesh(avatar), motion, name, up)
        return [path]
    poses = [None] if motion is None else [motion.pose(i) for i in range(len(motion.translations))]
    paths = [path] if numbers is None else [path.with_stem(f"{path.stem}_{number:0{DIGITS}d}") for number in numbers]
    if mesh:
        write = _mesh_writer(path, avatar, up)
    else:
        write = _gaussian_writer(avatar, up, rest_fields, each_on_the_floor=numbers is None)
    for file, pose in zip(paths, poses, strict=True):
        write(file, pose)
    return paths


def _check(path, motion, numbers, mesh):
    """Before any file is written."""
    suffixes = MESHES if mesh else tuple(GAUSSIANS)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a name ending in {' or '.join(suffixes)}{' for a mesh' if mesh else ''}")
    if mesh and path.suffix.lower() == ".glb":
        return
    frames = 1 if motion is None else len(motion.translations)
    if frames != (1 if numbers is None else len(numbers)):
        given = "no numbers" if numbers is None else f"{len(numbers)} numbers"
        raise ValueError(f"numbers: expected one for each of the {frames} frames, got {given}")


def _gaussian_writer(avatar, up, rest_fields, each_on_the_floor):
    def write(path: Path, pose: BodyPose | None) -> None:
        gaussians = avatar.gaussians if pose is None else animate(avatar, pose)
        gaussians = turned(grounded_gaussians(gaussians) if each_on_the_floor else gaussians, up)
        if path.suffix.lower() == ".ply":
            write_ply(path, gaussians, spherical_harmonics_rest=rest_fields)
        else:
            GAUSSIANS[path.suffix.lower()](path, gaussians)

    return write


def _mesh_writer(path, avatar, up):
    mesh = body_mesh(avatar)
    material = write_material(path, mesh)
    floor = np.asarray([0, mesh.vertices[:, 1].min(), 0], np.float32)

    def write(file: Path, pose: BodyPose | None) -> None:
        shown = dataclasses.replace(mesh, vertices=mesh.vertices - floor) if pose is None else mesh.posed(avatar, pose)
        write_obj(file, shown, material, up)

    return write
