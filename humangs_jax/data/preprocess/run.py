"""Preprocesses a whole data set: decides which subjects are due, writes each of them, and writes
the lists and the manifest of all.

    OUT/manifest.json            settings, finished scenes with what is known of them, skipped ones
                                 with the reason, the split
    OUT/NAME/                    a scene with the arrays of the published layout, or a capture of
                                 ours
    OUT/skipped/NAME.json        why one was skipped; it is tried again by the next run
    OUT/train.json, test.json, evaluation_N.json    of the layout "scenes"

A folder holds images/ and masks/ of each view, and scene.json with what is known of the scene. In
the layout "scenes" it also has smpl/ of each frame, and scene.json has its entry for the list. In
the layout "capture" it has capture.json and body.npz. A folder is written under a temporary name
and renamed when it is complete. Finished folders are kept, so that the same command continues an
interrupted set (`data.sets`). Shards of one set may run at the same time. A later run without
shards makes what is still missing, and lists everything.
"""

import dataclasses
import functools
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.core.progress import bar
from humangs_jax.core.registry import imported
from humangs_jax.data.capture import DEFAULT_BODY, parameter_arrays
from humangs_jax.data.capture_checks import CaptureError, checked_json, expect, members
from humangs_jax.data.datasets.scene_list import SceneFrame, scene_entry, write_arrays
from humangs_jax.data.datasets.subject import (
    THREADS,
    BodyParameters,
    FileBody,
    Photo,
    PosedPerson,
    posed_people,
    turned,
)
from humangs_jax.data.datasets.thuman import (
    FIT_MESH,
    fit_error,
    open_thuman,
    read_fit,
    read_fit_mesh,
    read_scan,
    scan_files,
)
from humangs_jax.data.formats import DATASETS
from humangs_jax.data.photos import write_description
from humangs_jax.data.preprocess.protocol import (
    EVERY,
    FACTORS,
    INPUT_COUNTS,
    NECK,
    PELVIS,
    SIZE,
    TARGETS,
    TEST,
    TRAIN,
    VIEWS,
    ScanRenderer,
    evaluation_indices,
    intrinsics,
    moved,
    scan_alignment,
    scan_cameras,
    split_ids,
    video_alignment,
)
from humangs_jax.data.sets import DATA_SET, begin_set, files_key, finished, made, write_manifest
from humangs_jax.io.arrays import SHORT, file_checksum, write_npz
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import write_json

SKIPPED = "skipped"
SCENE = "scene.json"
"""The file with what is known of a scene. In the layout "scenes" it marks a finished folder."""
CAPTURE = "capture.json"
"""The file that marks a finished folder in the layout "capture"."""
Layout = Literal["scenes", "capture"]


@dataclasses.dataclass(frozen=True)
class PreprocessConfig:
    """What a preprocessed set is made with."""

    kind: str
    """The kind of the data set, a key of `data.formats.DATASETS`."""
    layout: Layout = "scenes"
    """The layout of the output."""
    size: int = SIZE
    """The side of the square images, pixels."""
    views: int = VIEWS
    """The number of views of each scan."""
    factors: tuple[float, float] = FACTORS
    """The range of the cameras' distances, in bounding radii of a scan."""
    supersample: int = 3
    """Samples along each side of a pixel, for scans."""
    every: int = EVERY
    """A frame of a video is taken if its number is a multiple of this."""
    train: int = TRAIN
    """The number of scans in the training list."""
    test: int = TEST
    """The number of scans in the test list."""

    @property
    def mark(self) -> str:
        """Returns the name of the file that shows that a folder is finished."""
        return SCENE if self.layout == "scenes" else CAPTURE


@dataclasses.dataclass(frozen=True)
class Report:
    """What a run has made and skipped, and what the set holds after it."""

    out: Path
    """The folder of the set."""
    made: int
    """The number of scenes made in this run."""
    scenes: int
    """The number of scenes in all."""
    views: int
    """The number of views in all."""
    skipped: dict[str, str]
    """The reasons why people were left out, by their names."""

    def __str__(self) -> str:
        lines = [
            f"{self.out}: {self.scenes} scenes, {self.views} views ({self.made} scenes made now)"
        ]
        return "\n".join(
            lines + [f"skipped {name}: {reason}" for name, reason in self.skipped.items()]
        )


def preprocess(
    source: str | Path,
    out: str | Path,
    body_file: str | Path,
    settings: PreprocessConfig,
    shard: tuple[int, int] = (0, 1),
    workers: int = 1,
    progress: bool = True,
) -> Report:
    """Make or continue a set. Returns what was made and what the set holds.

    Arguments: source: the data set; for "thuman" the folder that holds model/ and smplx/.
    body_file: the model of the data set's fits. shard: (i, n): only the i-th of n parts, counted
    from 0, is made. workers: the number of processes that make scans. Videos are made in the
    calling process.
    Raises: ValueError for a wrong shard, if `out` lies in the data set, or holds another set or
    other files, if there is nobody, if a finished scene was made from other files, or, at the end,
    if nobody could be made. Also as `FileBody.load`.
    """
    source, out = Path(source).resolve(), Path(out)
    index, count = shard
    if not 0 <= index < count:
        raise ValueError(f"shard {index}/{count}: expected a number from 0 to {count - 1}")
    if out.resolve() == source or source in out.resolve().parents:
        raise ValueError(f"{out}: lies in the data set {source}: expected another place")
    names, absent = _subjects(source, settings)
    body = FileBody.load(body_file)
    made_with = _made_with(source, body, settings)
    begin_set(out, DATA_SET, made_with, alone=True)
    for name, reason in absent.items():
        _skip(out, name, reason)
    due = {}
    for name, path in list(names.items())[index::count]:
        if (out / name / settings.mark).is_file():
            _check_source(out / name / SCENE, name, path, settings)
        else:
            due[name] = path
    tasks = {name: (out / name, name, path, settings, progress) for name, path in due.items()}
    model_file = None if body.file == DEFAULT_BODY else body.file
    load = functools.partial(FileBody.load, model_file)
    scans, done = DATASETS[settings.kind].scans, 0  # photos of videos are decoded by threads
    try:
        with bar(total=len(due), desc="scans", shown=progress and scans) as shown:
            make = _make_scan if scans else _make_video
            for name, error in made(make, tasks, workers if scans else 1, load):
                shown.update()
                if error is None:
                    done += 1
                    (out / SKIPPED / f"{name}.json").unlink(missing_ok=True)
                else:
                    _skip(out, name, str(error) or type(error).__name__)
    finally:
        manifest = _write_lists(out, [*names, *absent], settings, made_with)
    counts = manifest["counts"]
    if due and not counts["scenes"]:
        reason = next(iter(manifest["skipped"].values()), "nothing was made")
        raise ValueError(
            f"{out}: none of {len(names)} subjects could be made; the first one: {reason}"
        )
    return Report(out, done, counts["scenes"], counts["views"], manifest["skipped"])


def _subjects(source: Path, settings: PreprocessConfig) -> tuple[dict[str, Path], dict[str, str]]:
    data_set = DATASETS[settings.kind]
    if data_set.scans:
        names, skipped = open_thuman(source)
        return dict.fromkeys(names, source), skipped
    folders = imported(data_set.find)(source)
    if not folders:
        raise CaptureError(
            source, "", f"no subject in the layout of {settings.kind} (docs/datasets.md)"
        )

    def named(path):
        if path.is_file():
            return path.stem
        return "_".join(path.relative_to(source).parts) or path.name

    return {named(path): path for path in folders}, {}


# Lists and manifest
# --------------------------------------------------------------------------------------------------


def _made_with(source: Path, body: FileBody, settings: PreprocessConfig) -> dict[str, Any]:
    """Returns the settings that all scenes depend on, as the manifest has them.

    The manifest names only the folder of the data set and not its path, since the data set may lie
    elsewhere on another machine.
    """
    shipped = body.file == DEFAULT_BODY
    known = {
        "source": source.name,
        "body": body.file if shipped else file_checksum(Path(body.file))[:SHORT],
    }
    return {"settings": dataclasses.asdict(settings) | {"factors": list(settings.factors)} | known}


def _source_key(name: str, source: Path, settings: PreprocessConfig) -> str:
    """Returns a checksum of the files that a scene is made from, see `sets.files_key`."""
    if DATASETS[settings.kind].scans:
        scan, fit = scan_files(source, name)
        return files_key(source, (*scan.parent.iterdir(), *fit.parent.iterdir()))
    files = [source] if source.is_file() else source.rglob("*")
    return files_key(source.parent, files)


def _check_source(file: Path, name: str, source: Path, settings: PreprocessConfig) -> None:
    """Check that a finished scene was made from the files that the data set holds now. The check
    passes if there is no scene.json, or if it has no checksum. file: the scene.json.

    Raises: CaptureError if the files differ.
    """
    if not file.is_file():
        return
    recorded = _read_scene(file, settings).get("made_from")
    if recorded not in (None, _source_key(name, source, settings)):
        problem = (
            f"made from other files than {source} has now: move the folder away, or choose another"
            " --out"
        )
        raise CaptureError(file, "made_from", problem)


def _skip(out: Path, name: str, reason: str) -> None:
    (out / SKIPPED).mkdir(exist_ok=True)
    write_json(out / SKIPPED / f"{name}.json", {"reason": reason})


def _read_scene(file: Path, settings: PreprocessConfig) -> dict[str, Any]:
    """Read and check the scene.json of a finished folder.

    Raises: CaptureError naming the file, and the key if a value is wrong.
    """
    content = checked_json(file)
    (known,) = members(content, file, known=dict)
    members(known, file, "known", views=int)
    for key in {"missing", "unreadable"} & known.keys():
        expect(known[key], dict, file, f"known.{key}")
    for reason, count in known.get("missing", {}).items():
        expect(count, int, file, f"known.missing.{reason}")
    if settings.layout == "scenes":
        (entry,) = members(content, file, entry=dict)
        members(entry, file, "entry", frames=list)
    return content


def _write_lists(
    out: Path, names: Sequence[str], settings: PreprocessConfig, made_with: dict[str, Any]
) -> dict[str, Any]:
    """Write the manifest of all finished scenes and, in the layout "scenes", their lists. Returns
    the manifest.
    """
    # all that lies in the folder counts, whichever run has made it
    scenes = {
        name: _read_scene(out / name / SCENE, settings) for name in finished(out, settings.mark)
    }
    skipped = {
        file.stem: members(checked_json(file), file, reason=str)[0]
        for file in sorted((out / SKIPPED).glob("*.json"))
        if file.stem not in scenes
    }
    # the split is that of all names, so that it does not depend on what is finished
    if DATASETS[settings.kind].scans:
        train, test = split_ids(names, settings.train, settings.test)
    else:
        train, test = [], sorted(names)
    split = {
        "train": [name for name in train if name in scenes],
        "test": [name for name in test if name in scenes],
    }
    # lists of the published layout
    if settings.layout == "scenes":
        for part, chosen in split.items():
            if chosen or part == "test":  # compact: 2,300 scenes of 60 views are 50 MB
                write_json(
                    out / f"{part}.json", [scenes[name]["entry"] for name in chosen], indent=None
                )
        counts = {name: len(scenes[name]["entry"]["frames"]) for name in split["test"]}
        for inputs in INPUT_COUNTS:
            if counts and min(counts.values()) >= inputs + TARGETS:
                write_json(
                    out / f"evaluation_{inputs}.json",
                    evaluation_indices(counts, inputs),
                    indent=None,
                )
    # the manifest says what is known of all people, whatever the layout
    known = {name: scene["known"] for name, scene in scenes.items()}
    counts = {
        "scenes": len(scenes),
        "views": sum(each["views"] for each in known.values()),
        "skipped": len(skipped),
        "unreadable_photos": sum(len(each.get("unreadable", ())) for each in known.values()),
        "missing_photos": sum(sum(each.get("missing", {}).values()) for each in known.values()),
    }
    return write_manifest(
        out, DATA_SET, made_with, counts=counts, split=split, scenes=known, skipped=skipped
    )


# One scene
# --------------------------------------------------------------------------------------------------


class View(NamedTuple):
    """A view to be written. Lengths are in units of the scene."""

    name: str
    """The name of its files."""
    frame: int
    """The pose that it shows, counted from 0."""
    K: Float[np.ndarray, "3 3"]
    """The camera matrix, (3, 3), pixels."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """From the world to the camera, (4, 4)."""
    photo: Photo | None
    """The image and the mask; None once they are written."""

    @property
    def files(self) -> tuple[str, str]:
        """The files of the photo and of its mask."""
        return f"images/{self.name}.png", f"masks/{self.name}.png"


@dataclasses.dataclass(frozen=True, eq=False)
class Content:
    """The data of one scene from which its files are written."""

    transform: Float[np.ndarray, "4 4"]
    """From the source's world to the scene's, (4, 4), written as `mesh_transform`."""
    posed: Iterable[PosedPerson]
    """The person in each frame, before the transform."""
    faces: np.ndarray
    """Vertex indices of the body, (f, 3)."""
    parameters: BodyParameters
    """The body parameters of all frames, metres."""
    scale: float
    """Units of the scene per metre."""
    views: Iterator[View]
    """The views in the scene's world (after the transform), lengths in units of the scene."""
    known: dict[str, Any]
    """Entries of the manifest. They are complete once all of `views` have been taken."""


def _make_scan(
    body: FileBody,
    folder: Path,
    name: str,
    source: Path,
    settings: PreprocessConfig,
    progress: bool,
) -> None:
    content = scan_content(source, name, body, settings)
    _write(folder, content, body, settings, _source_key(name, source, settings))


def scan_content(source: Path, name: str, body: FileBody, settings: PreprocessConfig) -> Content:
    """Returns the content of a scan's scene. Each view is rendered when it is asked for.

    Raises: ValueError naming the file, and the key if a value is wrong.
    """
    # the scan is turned and moved to the body that was fitted to it
    scan_file, fit_file = scan_files(source, name)
    fit = read_fit(fit_file, body)
    fitted = next(posed_people(body.model, fit.parameters, fit.scale))
    mesh, faces = read_fit_mesh(fit_file.with_name(FIT_MESH))
    error = fit_error(fitted, mesh, fit)
    scan = read_scan(scan_file)
    transform = scan_alignment(scan.vertices, fitted.joints[PELVIS], fitted.joints[NECK])
    vertices = moved(transform, scan.vertices)
    radius = float(np.linalg.norm(vertices, axis=1).max())
    # cameras depend on the scan's number alone, or on its name
    if name.isdecimal():
        number = int(name)
    else:
        number = zlib.crc32(os.fsencode(name))
    cameras = scan_cameras(number, radius, settings.views, settings.factors)
    renderer, K = ScanRenderer.of(scan, vertices), intrinsics(settings.size)

    def render(pose):
        return renderer.render(pose, settings.size, settings.supersample)

    known = {
        "fit_kind": fit.kind,
        "fit_error_mm": [round(1e3 * each, 4) for each in error],
        "units_per_metre": fit.scale,
        "radius": radius,
    }
    views = (View(f"{i:03d}", 0, K, pose, render(pose)) for i, pose in enumerate(cameras))
    posed = dataclasses.replace(fitted, vertices=mesh)
    return Content(transform, [posed], faces, fit.parameters, fit.scale, views, known)


def _make_video(
    body: FileBody,
    folder: Path,
    name: str,
    source: Path,
    settings: PreprocessConfig,
    progress: bool,
) -> None:
    """Make the scene of a video from all cameras, and from the frames whose number is a multiple of
    the setting `every`.
    """
    # the frames to take
    subject = DATASETS[settings.kind](source, body)
    chosen = np.flatnonzero(subject.frames % settings.every == 0)
    if not len(chosen):
        raise ValueError(f"{subject.name}: no photo of every {settings.every}th frame")
    # the person of the first frame stands upright at the origin; cameras move along
    start = next(posed_people(body.model, subject.parameters([0])))
    transform = video_alignment(start.vertices, start.joints[PELVIS], start.joints[NECK])
    frames, shown = np.unique(subject.frames[chosen], return_inverse=True)
    K, inverse = subject.squared_K(chosen, settings.size), np.linalg.inv(transform)
    parameters = subject.parameters(frames.tolist())
    known: dict[str, Any] = {"missing": dict(subject.missing), "unreadable": {}}

    # photos are read some at a time, as they are written; those that cannot be read are noted
    def views() -> Iterator[View]:
        with bar(total=len(chosen), desc=name, unit="photo", shown=progress) as done:
            for first in range(0, len(chosen), THREADS):
                for i, photo in enumerate(
                    subject.tried(chosen[first : first + THREADS], settings.size), first
                ):
                    done.update()
                    view = subject.view_name(int(chosen[i]))
                    if isinstance(photo, Exception):
                        known["unreadable"][view] = str(photo)
                    else:
                        yield View(
                            view,
                            int(shown[i]),
                            K[i],
                            subject.cam_from_world[chosen[i]] @ inverse,
                            photo,
                        )

    posed = posed_people(body.model, parameters)
    content = Content(
        transform, posed, np.asarray(body.model.faces), parameters, 1.0, views(), known
    )
    _write(folder, content, body, settings, _source_key(name, source, settings))


def _write(
    folder: Path, content: Content, body: FileBody, settings: PreprocessConfig, made_from: str
) -> None:
    """Write the photos and masks of a scene, then the files of the layout. The folder appears when
    it is complete. made_from: what `_source_key` returns.
    """

    def write(temporary: Path) -> None:
        for kind in ("images", "masks"):
            (temporary / kind).mkdir(parents=True)
        views = []
        for view in content.views:
            for path, pixels in zip(view.files, view.photo or (), strict=True):
                write_png(temporary / path, pixels / np.float32(255))
            views.append(view._replace(photo=None))
        if not views:
            raise ValueError(
                f"{folder.name}: no photo can be read:"
                f" {next(iter(content.known['unreadable'].values()), '')}"
            )
        known = {"views": len(views), "frames": len(content.parameters.rotations), **content.known}
        described: dict[str, Any] = {"known": known, "made_from": made_from}
        if settings.layout == "scenes":
            described = {"entry": _write_scene(temporary, folder.name, content, views)} | described
        write_json(temporary / SCENE, described, indent=None)
        if settings.layout == "capture":
            _write_capture(temporary, folder, content, views, body)

    replace_folder(folder, write, mark=settings.mark)


def _write_scene(
    folder: Path, name: str, content: Content, views: Sequence[View]
) -> dict[str, Any]:
    """Write the arrays of each frame, and return the scene's entry for the list."""
    (folder / "smpl").mkdir()
    for i, posed in enumerate(content.posed):
        transforms = content.transform @ posed.joint_transforms
        vertices = moved(content.transform, posed.vertices)
        write_arrays(
            folder / "smpl" / f"{i:06d}.npz", vertices, posed.rest, content.faces, transforms
        )
    frames = []
    for view in views:
        image, arrays, mask = (
            f"{name}/{path}"
            for path in (view.files[0], f"smpl/{view.frame:06d}.npz", view.files[1])
        )
        frames.append(SceneFrame(image, view.cam_from_world, view.K, arrays, mask))
    return scene_entry(name, content.transform, frames)


def _write_capture(
    folder: Path, target: Path, content: Content, views: Sequence[View], body: FileBody
) -> None:
    """Write body.npz and capture.json of a scene. Lengths are in metres, and poses and cameras in
    the aligned world. folder: where the files are written. target: the folder that they will be in.
    """
    matrix = content.transform.copy()
    matrix[:3, 3] /= content.scale
    pelvis = body.rest_joints(content.parameters.betas)[0]
    betas, rotations, translations = turned(content.parameters, matrix, pelvis)
    write_npz(
        folder / "body.npz",
        parameter_arrays(target, body.model, body.file, betas, rotations, translations),
    )
    described = []
    for view in views:
        pose = view.cam_from_world.copy()
        pose[:3, 3] /= content.scale
        files = dict(zip(("image", "mask"), view.files, strict=True))
        described.append(
            {**files, "frame": view.frame, "K": view.K.tolist(), "cam_from_world": pose.tolist()}
        )
    write_description(folder, described, "white")
