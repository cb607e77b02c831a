"""An avatar to a file, or a motion to a sequence of files: the suffix decides the format."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import EXPORTS, Up, chosen_format
from humangs_jax.avatar.export.gaussians import BACKWARDS, grounded_gaussians, rotated, turned
from humangs_jax.body.model import RestBody
from humangs_jax.core.registry import alternatives
from humangs_jax.data.motion import Motion, grounded

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
    path: str | os.PathLike[str],
    avatar: Avatar,
    motion: Motion | None = None,
    numbers: Sequence[int] | None = None,
    *,
    mesh: bool = False,
    up: Up | None = None,
    rest_fields: bool = False,
    name: str = "motion",
) -> list[Path]:
    """Write an avatar in T-pose, in one pose, or in the poses of a motion. Each file appears whole or not at all.

    Args:
        path: with a suffix of `EXPORTS`.
        avatar: one person.
        motion: None for the T-pose. A `.glb` of the mesh holds all of it as animation.
        numbers: of the motion's frames: "x.ply" becomes "x_0007.ply". All stand on one floor: who jumps leaves it. None:
            the motion has one frame, whose feet are on 0.
        mesh: as a mesh where the suffix has formats of Gaussians, too.
        up: the axis that points up; None for the format's own.
        rest_fields: see `write_ply`.
        name: of the animation.

    Returns:
        The files, without those that a format puts beside them (`.mtl` and `.png` of an `.obj`).

    Raises:
        ValueError: for another suffix, a format without what is asked for, or if `numbers` are not one for each frame.

    Examples:
        >>> hg.export("person.glb", avatar, hg.load_motion("dance.bvh"), mesh=True)
    """
    path = Path(path)
    form = chosen_format(path.suffix, mesh)
    if form is None:
        known = EXPORTS.where(lambda each: each.mesh >= mesh).suffixes
        raise ValueError(f"{path}: expected a name ending in {alternatives(known)}{' for a mesh' if mesh else ''}")
    if rest_fields and not form.rest_fields:
        holding = EXPORTS.where(lambda each: each.rest_fields).suffixes
        raise ValueError(f"{path}: has no rest fields: expected a name ending in {alternatives(holding)}")
    frames = 1 if motion is None else len(motion.translations)
    if not form.animated and frames != (1 if numbers is None else len(numbers)):
        given = "no numbers" if numbers is None else f"{len(numbers)} numbers"
        raise ValueError(f"numbers: expected one for each of the {frames} frames, got {given}")
    if motion is not None and (form.mesh or numbers is not None):
        motion = grounded(motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents)
    one = form.animated or numbers is None
    files = [path] if one else [path.with_stem(f"{path.stem}_{number:0{DIGITS}d}") for number in numbers or ()]
    if form.mesh:
        form(path, files, avatar, motion, up or form.up, name)
        return files
    for i, file in enumerate(files):
        gaussians = avatar.gaussians if motion is None else animate(avatar, motion.pose(i))
        gaussians = turned(grounded_gaussians(gaussians) if numbers is None else gaussians, up or form.up)
        gaussians = rotated(gaussians, BACKWARDS) if form.backwards else gaussians
        form(file, gaussians, **({"rest_fields": True} if rest_fields else {}))
    return files
