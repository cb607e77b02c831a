"""Synthetic people as capture folders: pictures, masks, cameras and body poses on disk, made from nothing but seeds."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.data.capture import Capture, save_capture
from humangs_jax.data.synthetic.cameras import cameras_around, spread_azimuths
from humangs_jax.data.synthetic.poses import sample_rotations
from humangs_jax.data.synthetic.rendering import PosedSubject, pose_subject, render_view
from humangs_jax.data.synthetic.seeds import split_of
from humangs_jax.data.synthetic.subject import SyntheticSubject, make_subject
from humangs_jax.geometry.camera import Camera

HELD_OUT = "held_out"
"""Sub-folder of a subject's folder: a capture of its own with the views that reconstruction may not see."""
POSE_STREAM, CAMERA_STREAM, HELD_OUT_STREAM = 1, 2, 3
"""Independent random streams of a seed; stream 0 makes the person."""
MANIFEST_VERSION = 1


def sample_pose(subject: SyntheticSubject, index: int) -> PosedSubject:
    """The subject in its pose of that number, standing on y = 0. Pose 0 is the one of the input views."""
    rng = np.random.default_rng([subject.seed, POSE_STREAM, index])
    rotations = sample_rotations(rng, subject.build).astype(np.float32)
    grounded = np.zeros(3, np.float32)
    grounded[1] = -subject.posed_vertices(rotations, grounded)[:, 1].min()
    return pose_subject(subject, rotations, grounded)


def render_capture(
    subject: SyntheticSubject, body: BodyModel, poses: list[PosedSubject], cameras: list[Camera]
) -> Capture:
    """A capture whose frame i shows poses[i] through the batch cameras[i]; views sorted by frame."""
    frames = np.repeat(np.arange(len(poses)), [c.K.shape[0] for c in cameras])
    pictures = [
        render_view(p, batch[i]) for p, batch in zip(poses, cameras, strict=True) for i in range(batch.K.shape[0])
    ]
    images, masks = (np.stack(x) for x in zip(*pictures, strict=True))
    rotations, translations = (np.stack([getattr(p, name) for p in poses]) for name in ("rotations", "translation"))
    return Capture(
        images=images,
        masks=masks,
        cameras=jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *cameras),
        frames=frames.astype(np.int32),
        body=body,
        betas=subject.betas,
        poses=jax.vmap(BodyPose)(jnp.asarray(rotations), jnp.asarray(translations)),
        names=tuple(f"{frame}_{i:02d}" for i, frame in enumerate(frames)),
    )


def write_subject(
    folder: str | Path,
    seed: int,
    *,
    body: BodyModel,
    image_size: int = 512,
    input_views: int = 4,
    held_out_views: int = 8,
    novel_poses: int = 0,
) -> None:
    """A capture of `input_views` evenly spread photos of a standing person, and `held_out/` with other views.

    The held-out capture shows the same pose (frame 0) from `held_out_views` other cameras, then each of `novel_poses` other
    poses (frames 1, 2, ...) from as many. Written whole or not at all; an existing folder is replaced.
    """
    subject = make_subject(seed, body)
    pose = sample_pose(subject, 0)
    camera_rng, held_rng = (np.random.default_rng([seed, stream]) for stream in (CAMERA_STREAM, HELD_OUT_STREAM))
    inputs = cameras_around(camera_rng, pose.vertices, spread_azimuths(camera_rng, input_views), image_size)
    others = [pose, *(sample_pose(subject, i + 1) for i in range(novel_poses))] if held_out_views else []
    batches = [
        cameras_around(held_rng, p.vertices, spread_azimuths(held_rng, held_out_views), image_size) for p in others
    ]

    def write(temporary: Path):
        save_capture(temporary, render_capture(subject, body, [pose], [inputs]))
        if held_out_views:
            save_capture(temporary / HELD_OUT, render_capture(subject, body, others, batches))

    _atomically(Path(folder), write)


def write_training_subject(
    folder: str | Path, seed: int, *, body: BodyModel, image_size: int = 256, poses: int = 2, views: int = 12
) -> None:
    """ONE capture of `poses` frames with `views` views each, azimuths evenly spread with jitter. Written whole or not at all."""
    subject = make_subject(seed, body)
    rng = np.random.default_rng([seed, CAMERA_STREAM])
    posed = [sample_pose(subject, i) for i in range(poses)]
    cameras = [cameras_around(rng, p.vertices, spread_azimuths(rng, views), image_size) for p in posed]
    _atomically(Path(folder), lambda temporary: save_capture(temporary, render_capture(subject, body, posed, cameras)))


def synthesize(
    out: str | Path,
    subjects: int,
    first_seed: int = 0,
    *,
    training: bool = True,
    image_size: int = 256,
    views: int = 12,
    poses: int = 2,
    held_out_views: int = 8,
    body: BodyModel | None = None,
    progress: bool = True,
) -> list[Path]:
    """Write `subjects` people, seeds from `first_seed` on, into `out`/<seed>; folders that are there already are kept.

    training: one capture of `poses` x `views` each (`write_training_subject`); otherwise `views` input photos of one pose and
    `held_out_views` held-out ones, `poses` - 1 novel poses among them (`write_subject`).
    Returns the folders. Raises: ValueError if the seeds reach from one range of `seeds.SPLITS` into another, or if `out` was
    written with other settings.
    """
    from tqdm import tqdm

    seeds = range(first_seed, first_seed + subjects)
    split = split_of(seeds[0])
    if split_of(seeds[-1]) != split:
        raise ValueError(f"seeds {seeds[0]}..{seeds[-1]} reach beyond the range '{split}'")
    settings = {"training": training, "image_size": image_size, "views": views, "poses": poses}
    settings |= {} if training else {"held_out_views": held_out_views}
    out = Path(out)
    _check_manifest(out, settings)
    if body is None:
        from humangs_jax.body.library import load_body

        body = load_body()
    folders = [out / f"{seed:07d}" for seed in seeds]
    for seed, folder in tqdm(list(zip(seeds, folders, strict=True)), desc="people", disable=not progress):
        if (folder / "capture.json").is_file():
            continue
        if training:
            write_training_subject(folder, seed, body=body, image_size=image_size, poses=poses, views=views)
        else:
            sizes = {"input_views": views, "held_out_views": held_out_views, "novel_poses": poses - 1}
            write_subject(folder, seed, body=body, image_size=image_size, **sizes)
    _write_manifest(out, settings)
    return folders


def _check_manifest(out, settings):
    file = out / "manifest.json"
    if file.is_file():
        earlier = json.loads(file.read_text())["settings"]
        if earlier != settings:
            raise ValueError(
                f"{file}: written with settings {earlier}, now asked for {settings}: choose another folder"
            )
    else:
        out.mkdir(parents=True, exist_ok=True)
        _write_manifest(out, settings)


def _write_manifest(out, settings):
    """Lists the finished subjects; written aside, then renamed, so that it is never half there."""
    finished = sorted(folder.parent.name for folder in out.glob("[0-9]*/capture.json"))
    content = {"format": "humangs-synthetic", "version": MANIFEST_VERSION, "settings": settings, "subjects": finished}
    temporary = out / f".manifest.{os.getpid()}"
    temporary.write_text(json.dumps(content, indent=1) + "\n")
    temporary.replace(out / "manifest.json")


def _atomically(folder: Path, write: Callable[[Path], None]) -> None:
    """Calls write(temporary folder) and renames it to `folder`."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        write(temporary)
        if folder.is_dir():
            shutil.rmtree(folder)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
