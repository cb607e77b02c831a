"""Writes synthetic people, made from seeds, as capture folders: images, masks, cameras and poses.

out/manifest.json                    settings of the set and finished subjects, see `data.sets`
out/SEED/                            a capture (docs/capture_format.md): views of one person in one
                                     or several poses
out/SEED/held_out/                   if `Layout.held_out_views` is not 0: a separate capture with
                                     the views that reconstruction may not see
out/SEED/motion.npz                  if `Layout.frames` is not 0: the whole motion. The capture
                                     shows some of its frames
out/SEED/scan/                       if `Layout.scan_texture` is not 0: the first pose as a lit,
                                     textured mesh, see `bank`
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.body.motion import Motion
from humangs_jax.core.progress import bar as progress_bar
from humangs_jax.core.progress import say
from humangs_jax.data.capture import Capture, save_capture
from humangs_jax.data.capture_checks import checked_json
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.sets import (
    DATA_SET,
    MANIFEST,
    SYNTHETIC,
    begin_set,
    finished,
    made,
    read_manifest,
    write_manifest,
)
from humangs_jax.evaluation.kept import body_key
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.atomic import check_writable, replace_folder
from humangs_jax.motion import save_motion
from humangs_jax.synthetic.bank import export_scan
from humangs_jax.synthetic.poses import sample_rotations
from humangs_jax.synthetic.sequences import sample_sequence
from humangs_jax.synthetic.subject import (
    GENERATOR_VERSION,
    PosedSubject,
    SyntheticSubject,
    make_subject,
    pose_subject,
    render_view,
    seeds_of,
    split_of,
)
from humangs_jax.synthetic.surfaces import Points
from humangs_jax.synthetic.surroundings import (
    Angles,
    cameras_around,
    close_cameras,
    spread_azimuths,
)

HELD_OUT = "held_out"
"""Name of the sub-folder for held-out views in a subject's folder."""
CAPTURE = "capture.json"
"""Name of the last file that is written of a capture."""


class Stream:
    """Numbers of the random streams of a seed from which poses, motions and cameras are drawn.
    Stream 0 and the streams from 11 on are for the person and for banks of people.
    """

    POSES, CAMERAS, HELD_OUT_CAMERAS, CLOSE_CAMERAS, MOTION = range(1, 6)


@dataclasses.dataclass(frozen=True)
class Layout:
    """What is written for each person."""

    image_size: int = 512
    """Side of the images, pixels. The loader makes smaller ones by averaging."""
    poses: int = 1
    """Number of poses of each person."""
    views: int = 60
    """Number of cameras of the published protocol that see each pose."""
    close_views: int = 0
    """Number of close cameras for each pose, besides `views`. They are nearer to the person than
    the cameras of `views`, and see only a part of the person.
    """
    held_out_views: int = 0
    """Number of cameras in held_out/ for each of its poses: the first pose and the novel poses."""
    novel_poses: int = 0
    """Number of further poses that only held_out/ shows."""
    frames: int = 0
    """Number of frames of the motion, at 30 per second. The capture shows `poses` evenly spaced
    frames of it. 0: there is no motion, and poses are independent.
    """
    scan_texture: int = 0
    """Side of the scan's texture, texels. 0: no scan is written."""


@dataclasses.dataclass(frozen=True)
class View:
    """A camera and the pose that it sees."""

    frame: int
    """Index of the pose."""
    name: str
    """Name of the view and of the image."""
    camera: Camera
    """The camera."""


def sample_pose(subject: SyntheticSubject, index: int) -> PosedSubject:
    """Poses the subject in the random pose number `index`, with the lowest point on y = 0."""
    rng = np.random.default_rng([subject.seed, Stream.POSES, index])
    return stand(subject, sample_rotations(rng, subject.build))


def stand(subject: SyntheticSubject, rotations: np.ndarray) -> PosedSubject:
    """Poses the subject with its lowest point on y = 0. rotations: (j, 3), axis-angle, radians."""
    rotations, translation = np.asarray(rotations, np.float32), np.zeros(3, np.float32)
    translation[1] = -subject.posed_vertices(rotations, translation)[:, 1].min()
    return pose_subject(subject, rotations, translation)


def sample_motion(subject: SyntheticSubject, frames: int, kind: str | None = None) -> Motion:
    """Makes the subject's motion, see `sequences`.

    The lowest point, with shoes, is at a height of about 0 most of the time. kind: None for a
    random one.

    Raises: as `sample_sequence`.
    """
    sequence = sample_sequence(
        np.random.default_rng([subject.seed, Stream.MOTION]), subject.build, frames, kind
    )
    rotations = sequence.rotations.astype(np.float32)
    translations = sequence.translations.astype(np.float32)
    # the height above the ground, of every fifth frame
    asked = range(0, frames, 5)
    lowest = [subject.posed_vertices(rotations[i], translations[i])[:, 1].min() for i in asked]
    translations[:, 1] -= np.median(lowest)
    return Motion(jnp.asarray(rotations), jnp.asarray(translations), sequence.fps)


def capture_views(
    subject: SyntheticSubject, body: BodyModel, poses: list[PosedSubject], views: list[View]
) -> Capture:
    """Renders the views, and returns them as a capture."""
    rendered = [render_view(poses[view.frame], view.camera) for view in views]
    images, masks = (np.stack(x) for x in zip(*rendered, strict=True))
    rotations, translations = (
        np.stack([getattr(p, name) for p in poses]) for name in ("rotations", "translation")
    )
    return Capture(
        images=images,
        masks=masks,
        cameras=stack_cameras([view.camera for view in views]),
        frames=np.asarray([view.frame for view in views], np.int32),
        body=body,
        betas=subject.betas,
        poses=jax.vmap(BodyPose)(jnp.asarray(rotations), jnp.asarray(translations)),
        names=tuple(view.name for view in views),
    )


def write_person(folder: str | Path, seed: int, body: BodyModel, layout: Layout) -> None:
    """Writes one person. An existing capture in the folder is replaced. If writing fails, the
    folder stays as before.

    Raises: ValueError if the folder has files but no capture, if the body is not the package's
    body, if the layout has no views, or if the size of the scan's texture is no multiple of 128;
    OSError.
    """
    subject = make_subject(seed, body)
    # poses are independent, or evenly spaced frames of one motion
    motion = None
    if layout.frames:
        motion = sample_motion(subject, layout.frames)
    if motion is None:
        posed = [sample_pose(subject, i) for i in range(layout.poses)]
    else:
        shown = np.linspace(0, layout.frames - 1, layout.poses).round().astype(int)
        posed = [
            pose_subject(
                subject, np.asarray(motion.rotations[i]), np.asarray(motion.translations[i])
            )
            for i in shown
        ]
    # held-out views show the first pose and further ones that no input has
    others = [
        posed[0],
        *(sample_pose(subject, layout.poses + i) for i in range(layout.novel_poses)),
    ]
    size = layout.image_size
    # each kind of camera has its stream: more of one does not change the others
    views = _views([seed, Stream.CAMERAS], cameras_around, layout.views, posed, size)
    views += _views(
        [seed, Stream.CLOSE_CAMERAS], close_cameras, layout.close_views, posed, size, mark="c"
    )
    held_out = _views(
        [seed, Stream.HELD_OUT_CAMERAS], cameras_around, layout.held_out_views, others, size
    )

    def write(temporary: Path):
        save_capture(temporary, capture_views(subject, body, posed, views))
        if held_out:
            save_capture(temporary / HELD_OUT, capture_views(subject, body, others, held_out))
        if motion is not None:
            save_motion(temporary / "motion.npz", motion)
        if layout.scan_texture:
            export_scan(posed[0], temporary / "scan", layout.scan_texture)

    replace_folder(folder, write, mark=CAPTURE)


def write_set(
    out: str | Path,
    subjects: int,
    layout: Layout,
    split: str = "train",
    first: int = 0,
    *,
    workers: int = 1,
    body: BodyModel | None = None,
    progress: bool = True,
) -> list[Path]:
    """Writes people `first` .. `first + subjects - 1` of a split into `out`/SEED.

    Finished folders are kept.

    workers: number of processes. If more than one, they use the CPU and write the same files, and
    the calling script must be guarded by `if __name__ == "__main__"`. body: None for the body that
    comes with the package. progress: whether a bar is shown.

    Returns: the folders.

    Raises: ValueError if `subjects` is less than 1 or the people reach beyond the split, if the
    manifest in `out` cannot be read, if `out` was written with other settings, for another split or
    body or by another version of the generator, or at the end if some people could not be made;
    OSError if a file cannot be written or a process is killed; KeyError if there is no such split.
    """
    out, seeds = Path(out), seeds_of(split, first, subjects)
    # a set is made with one set of settings, which its manifest keeps
    made_with = {
        "generator_version": GENERATOR_VERSION,
        "split": split,
        "settings": dataclasses.asdict(layout),
        "body": body_key(body),
    }
    check_writable(out)
    begin_set(out, SYNTHETIC, made_with)
    folders = {seed: out / f"{seed:07d}" for seed in seeds}
    # folders that are finished are not made again
    due = {
        seed: (folder, seed, layout)
        for seed, folder in folders.items()
        if not (folder / CAPTURE).is_file()
    }
    failed: dict[int, Exception] = {}
    listed = time.monotonic()
    try:
        with progress_bar(
            total=subjects, initial=subjects - len(due), desc="people", shown=progress
        ) as bar:
            # one person that fails does not stop the others
            for seed, error in made(_write, due, workers, functools.partial(_given, body)):
                if error is not None:
                    failed[seed] = error
                    say(f"seed {seed}: {error}", lines=False)
                bar.update(1)
                # twice a minute the manifest names what is finished, in case this is interrupted
                if time.monotonic() - listed > 30.0:
                    write_manifest(out, SYNTHETIC, made_with, subjects=finished(out, CAPTURE))
                    listed = time.monotonic()
    finally:
        write_manifest(out, SYNTHETIC, made_with, subjects=finished(out, CAPTURE))
    if failed:
        seed, error = next(iter(failed.items()))
        raise ValueError(
            f"{out}: {len(failed)} of {subjects} people could not be made, the first of them"
            f" {seed}: {error}"
        )
    return list(folders.values())


def _given(body: BodyModel | None) -> BodyModel:
    return load_body() if body is None else body


def _write(body: BodyModel, folder: Path, seed: int, layout: Layout) -> None:
    write_person(folder, seed, body, layout)


def _views(
    stream: Sequence[int],
    place: Callable[[np.random.Generator, Points, Angles, int], Camera],
    count: int,
    poses: Sequence[PosedSubject],
    size: int,
    mark: str = "",
) -> list[View]:
    """Makes `count` views of each pose.

    stream: seed of the random numbers. place: function that makes the cameras of one pose. size:
    side of the images, pixels. mark: a part of the views' names.
    """
    rng, views = np.random.default_rng(stream), []
    shown = poses if count else ()
    for frame, posed in enumerate(shown):
        cameras = place(rng, posed.vertices, spread_azimuths(rng, count), size)
        views += [View(frame, f"{frame}_{mark}{i:02d}", cameras[i]) for i in range(count)]
    return views


def find_people(root: str | Path, split: str | None = "train") -> tuple[Path, ...]:
    """Returns the capture folders in `root`, sorted by name, or `root` itself if it is a capture.

    split: the split that all people must belong to if `root` is a synthetic set. None: any. It is
    ignored if `root` has no manifest, as with real captures, and for sets of `humangs preprocess`.

    Raises: ValueError if a synthetic set has a person of another split or of none, if its manifest
    cannot be read, or if there is no capture.
    """
    root = Path(root)
    folders = find_captures(root)
    if split is not None and (root / MANIFEST).is_file():
        content = checked_json(root / MANIFEST)
        if isinstance(content, dict) and content.get("format") == DATA_SET.format:
            return folders
        read_manifest(root, SYNTHETIC)
        for folder in folders:
            other = split
            if folder.name.isdigit():
                other = split_of(int(folder.name))
            if other != split:
                raise ValueError(
                    f"{folder}: a subject of the split '{other}', where '{split}' was expected"
                )
    return folders
