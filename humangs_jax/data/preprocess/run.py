"""A whole set: which subjects are due, what is written of each, and the lists and the manifest over all of it.

    OUT/manifest.json            settings, finished scenes with what is known of them, skipped ones with the reason, the split
    OUT/NAME/                    a scene with the arrays of the published layout, or a capture of ours
    OUT/skipped/NAME.json        why one was skipped; it is tried again by the next run
    OUT/train.json, test.json, evaluation_N.json    of the layout "scenes"

A scene's folder holds images/ and masks/ of each view, smpl/ of each frame, and scene.json: its entry for the list, and what is
known of it. Everything is written under a temporary name first, so that the folder is whole or not there. Finished folders are
kept, so that the same command continues an interrupted set (`data.sets`). Shards of one set may run at the same time. A run
without shards, after them, finds nothing to make and lists everything.
"""

import dataclasses
import functools
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.core.progress import bar
from humangs_jax.core.registry import imported
from humangs_jax.data.capture import DEFAULT_BODY, parameter_arrays
from humangs_jax.data.capture_checks import CaptureError, checked_json, expect, members
from humangs_jax.data.datasets.scene_list import SceneFrame, scene_entry, write_arrays, write_list
from humangs_jax.data.datasets.subject import BodyParameters, FileBody, PosedPerson, Subject, posed_people, turned
from humangs_jax.data.datasets.thuman import (
    FIT_MESH,
    ThumanSet,
    fit_error,
    fitted_body,
    open_thuman,
    read_fit,
    read_fit_mesh,
    read_scan,
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
    bounding_radius,
    evaluation_indices,
    intrinsics,
    moved,
    scan_alignment,
    scan_cameras,
    split_ids,
    video_alignment,
)
from humangs_jax.data.sets import DATA_SET, begin_set, finished, made, write_manifest
from humangs_jax.io.arrays import write_npz
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import write_json

SKIPPED = "skipped"
SCENE, CAPTURE = "scene.json", "capture.json"
Layout = Literal["scenes", "capture"]
Photo = tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "size size"]]
"""An image on white and its mask."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a preprocessed set is made with."""

    kind: str
    """Of `data.formats.DATASETS`."""
    layout: Layout = "scenes"
    """Of the output."""
    size: int = SIZE
    """Pixels a side."""
    views: int = VIEWS
    """Of a scan."""
    factors: tuple[float, float] = FACTORS
    """Of scans: range of the distance in bounding radii."""
    supersample: int = 3
    """Of scans: samples along a pixel."""
    every: int = EVERY
    """Of videos: the frame step."""
    train: int = TRAIN
    """Scans of the training list."""
    test: int = TEST
    """Scans of the test list."""

    @property
    def mark(self) -> str:
        """The file that a finished folder holds."""
        return SCENE if self.layout == "scenes" else CAPTURE


class View(NamedTuple):
    """A photo to be written. frame: which of the poses it shows. lengths are those of the scene."""

    name: str
    frame: int
    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "4 4"]
    image: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]


@dataclasses.dataclass(frozen=True)
class Report:
    """What is in a set after a run. made: in this run. scenes, views: in all. skipped: name -> reason."""

    out: Path
    made: int
    scenes: int
    views: int
    skipped: dict[str, str]

    def __str__(self) -> str:
        lines = [f"{self.out}: {self.scenes} scenes, {self.views} views ({self.made} scenes made now)"]
        return "\n".join(lines + [f"skipped {name}: {reason}" for name, reason in self.skipped.items()])


def preprocess(
    source: str | Path,
    out: str | Path,
    body_file: str | Path,
    settings: Settings,
    shard: tuple[int, int] = (0, 1),
    workers: int = 1,
    progress: bool = True,
) -> Report:
    """Make or continue a set.

    Arguments: source: the data set; of "thuman" the folder that holds model/ and smplx/. body_file: the model of its
    fits. shard: (i, n): the i-th of n parts, from 0. workers: processes, for scans.
    Raises: ValueError if there is nobody, `out` holds another set, or (at the end) nobody could be made.
    """
    source, out = Path(source).resolve(), Path(out)
    index, count = shard
    if not 0 <= index < count:
        raise ValueError(f"shard {index}/{count}: expected a number from 0 to {count - 1}")
    if out.resolve() == source or source in out.resolve().parents:
        raise ValueError(f"{out}: lies in the data set {source}: expected another place")
    names, absent = _subjects(source, settings)
    body = FileBody.load(body_file)
    begin_set(out, DATA_SET, _made_with(settings), alone=True)
    for name, reason in absent.items():
        _skip(out, name, reason)
    due = {name: path for name, path in list(names.items())[index::count] if not (out / name / settings.mark).is_file()}
    make = _make_scans if DATASETS[settings.kind].scans else _make_videos
    done = 0
    try:
        for name, error in make(out, due, body, settings, workers, progress):
            if error is None:
                done += 1
                (out / SKIPPED / f"{name}.json").unlink(missing_ok=True)
            else:
                _skip(out, name, str(error) or type(error).__name__)
    finally:
        manifest = _finish(out, [*names, *absent], settings)
    counts = manifest["counts"]
    if due and not counts["scenes"]:
        reason = next(iter(manifest["skipped"].values()), "nothing was made")
        raise ValueError(f"{out}: none of {len(names)} subjects could be made; the first one: {reason}")
    return Report(out, done, counts["scenes"], counts["views"], manifest["skipped"])


def _subjects(source: Path, settings: Settings) -> tuple[dict[str, Path], dict[str, str]]:
    data_set = DATASETS[settings.kind]
    if data_set.scans:
        found = open_thuman(source)
        return dict.fromkeys(found.names, source), dict(found.skipped)
    folders = imported(data_set.find)(source)
    if not folders:
        raise CaptureError(source, "", f"no subject in the layout of {settings.kind} (docs/datasets.md)")
    named = lambda path: path.stem if path.is_file() else "_".join(path.relative_to(source).parts) or path.name
    return {named(path): path for path in folders}, {}


Made = Iterator[tuple[str, Exception | None]]


def _make_videos(out: Path, due: dict[str, Path], body: FileBody, settings: Settings, workers: int, progress: bool) -> Made:
    """One after the other; photos are decoded by threads."""
    for name, folder in due.items():
        try:
            subject = DATASETS[settings.kind](folder, body)
            total = int((subject.frames % settings.every == 0).sum())
            with bar(total=total, desc=name, unit="photo", shown=progress) as shown:
                write_video(out / name, name, subject, body, settings, shown.update)
        except (ValueError, ArithmeticError) as error:  # not OSError: a full disk ends everything
            yield name, error
        else:
            yield name, None


def _make_scans(out: Path, due: dict[str, Path], body: FileBody, settings: Settings, workers: int, progress: bool) -> Made:
    """Several processes, which have one thread each."""
    tasks = {name: (out / name, name, source, settings) for name, source in due.items()}
    load = functools.partial(FileBody.load, None if body.file == DEFAULT_BODY else body.file)
    with bar(total=len(due), desc="scans", shown=progress) as shown:
        for name, error in made(_make_scan, tasks, workers, load):
            shown.update()
            yield name, error


def _make_scan(body: FileBody, folder: Path, name: str, source: Path, settings: Settings) -> None:
    write_scan(folder, name, ThumanSet(source, (name,), {}), body, settings)


# Lists and manifest -----------------------------------------------------------------------------------------------------


def _made_with(settings: Settings) -> dict[str, Any]:
    return {"settings": dataclasses.asdict(settings) | {"factors": list(settings.factors)}}


def _skip(out: Path, name: str, reason: str) -> None:
    (out / SKIPPED).mkdir(exist_ok=True)
    write_json(out / SKIPPED / f"{name}.json", {"reason": reason})


def _finish(out: Path, names: Sequence[str], settings: Settings) -> dict[str, Any]:
    """Lists and manifest of what is there; again if other shards have added to it meanwhile."""
    done, manifest = None, {}
    for _ in range(2):  # not until nothing is added: that may be hours
        if (found := finished(out, settings.mark)) != done:
            done = found
            scenes = {name: _read_scene(out / name / SCENE, settings) for name in done}
            manifest = _write_lists(out, names, scenes, settings)
    return manifest


def _read_scene(file: Path, settings: Settings) -> dict[str, Any]:
    """What a finished folder says of itself. Raises: CaptureError naming file and key."""
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


def _write_lists(out: Path, names: Sequence[str], scenes: dict[str, dict[str, Any]], settings: Settings) -> dict[str, Any]:
    skipped = {
        file.stem: members(checked_json(file), file, reason=str)[0]
        for file in sorted((out / SKIPPED).glob("*.json"))
        if file.stem not in scenes
    }
    train, test = split_ids(names, settings.train, settings.test) if DATASETS[settings.kind].scans else ([], sorted(names))
    split = {"train": [name for name in train if name in scenes], "test": [name for name in test if name in scenes]}
    if settings.layout == "scenes":
        for part, chosen in split.items():
            if chosen or part == "test":
                write_list(out / f"{part}.json", [scenes[name]["entry"] for name in chosen])
        counts = {name: len(scenes[name]["entry"]["frames"]) for name in split["test"]}
        for inputs in INPUT_COUNTS:
            if counts and min(counts.values()) >= inputs + TARGETS:
                write_json(out / f"evaluation_{inputs}.json", evaluation_indices(counts, inputs), indent=None)
    known = {name: scene["known"] for name, scene in scenes.items()}
    counts = {
        "scenes": len(scenes),
        "views": sum(each["views"] for each in known.values()),
        "skipped": len(skipped),
        "unreadable_photos": sum(len(each.get("unreadable", ())) for each in known.values()),
        "missing_photos": sum(sum(each.get("missing", {}).values()) for each in known.values()),
    }
    return write_manifest(out, DATA_SET, _made_with(settings), counts=counts, split=split, scenes=known, skipped=skipped)


# One scene ------------------------------------------------------------------------------------------------------------


Tick = Callable[[], object]


def write_scan(folder: Path, name: str, thuman: ThumanSet, body: FileBody, settings: Settings) -> None:
    """A scan as the settings say. Raises: ValueError naming file and key."""
    _write(folder, name, scan_content(name, thuman, body, settings), body, settings)


def scan_content(name: str, thuman: ThumanSet, body: FileBody, settings: Settings) -> "Content":
    """What is written of a scan; its views are rendered when they are asked for. Raises: ValueError naming file and key."""
    fit = read_fit(thuman.fit_file(name), body)
    fitted = fitted_body(fit, body)
    mesh, faces = read_fit_mesh(fit.file.with_name(FIT_MESH))
    error = fit_error(fitted, mesh, fit)
    scan = read_scan(thuman.scan_file(name))
    transform = scan_alignment(scan.vertices, fitted.joints[PELVIS], fitted.joints[NECK])
    vertices = moved(transform, scan.vertices)
    radius = bounding_radius(vertices)
    number = int(name) if name.isdecimal() else zlib.crc32(os.fsencode(name))
    cameras = scan_cameras(number, radius, settings.views, settings.factors)
    renderer, K = ScanRenderer.of(scan, vertices), intrinsics(settings.size)

    def views() -> Iterator[View]:
        for i, pose in enumerate(cameras):
            yield View(f"{i:03d}", 0, K, pose, *renderer.render(pose, settings.size, settings.supersample))

    known = {
        "fit_kind": fit.kind,
        "fit_error_mm": [round(1e3 * each, 4) for each in error],
        "units_per_metre": fit.scale,
        "radius": radius,
    }
    posed = dataclasses.replace(fitted, vertices=mesh)
    parameters = BodyParameters(fit.betas, fit.rotations[None], fit.translation[None])
    return Content(transform, [posed], faces, parameters, fit.scale, views(), known)


def write_video(folder: Path, name: str, subject: Subject, body: FileBody, settings: Settings, tick: Tick) -> None:
    """Frames of a video from all cameras, `every` apart. tick: called after each photo. Raises: ValueError naming the file."""
    chosen = np.flatnonzero(subject.frames % settings.every == 0)
    if not len(chosen):
        raise ValueError(f"{subject.name}: no photo of every {settings.every}th frame")
    start = next(posed_people(body.model, subject.parameters([0])))
    transform = video_alignment(start.vertices, start.joints[PELVIS], start.joints[NECK])
    frames, shown = np.unique(subject.frames[chosen], return_inverse=True)
    K, inverse = subject.squared_K(chosen, settings.size), np.linalg.inv(transform)
    parameters = subject.parameters(frames.tolist())
    known: dict[str, Any] = {"missing": dict(subject.missing), "unreadable": {}}

    def views() -> Iterator[View]:
        step = os.cpu_count() or 1
        for first in range(0, len(chosen), step):
            part = range(first, min(first + step, len(chosen)))
            for i, photo in zip(part, _photos(subject, chosen[part], settings.size), strict=True):
                tick()
                view = int(chosen[i])
                if isinstance(photo, Exception):
                    known["unreadable"][subject.view_name(view)] = str(photo)
                    continue
                pose = subject.cam_from_world[view] @ inverse
                yield View(subject.view_name(view), int(shown[i]), K[i], pose, *photo)

    posed = posed_people(body.model, parameters)
    content = Content(transform, posed, np.asarray(body.model.faces), parameters, 1.0, views(), known)
    _write(folder, name, content, body, settings)


def _photos(subject: Subject, views: Int[np.ndarray, " n"], size: int) -> list[Photo | Exception]:
    import concurrent.futures

    def photo(view):
        try:
            return subject.photo(int(view), size)
        except (ValueError, OSError) as error:
            return error

    with concurrent.futures.ThreadPoolExecutor(len(views)) as pool:
        return list(pool.map(photo, views))


@dataclasses.dataclass(frozen=True, eq=False)
class Content:
    """What is written of a scene.

    transform: (4, 4) `mesh_transform`. posed: of each frame, before it. parameters: of each frame, in metres. scale: units per
    metre. views: in the world after the transform, in units. known: for the manifest; complete when the views have run out.
    """

    transform: Float[np.ndarray, "4 4"]
    posed: Iterable[PosedPerson]
    faces: np.ndarray
    parameters: BodyParameters
    scale: float
    views: Iterator[View]
    known: dict[str, Any]


def _write(folder: Path, name: str, content: Content, body: FileBody, settings: Settings) -> None:
    write = _write_scene if settings.layout == "scenes" else _write_capture
    replace_folder(folder, lambda temporary: write(temporary, folder, name, content, body, settings), mark=settings.mark)


def _write_images(folder: Path, view: View) -> tuple[str, ...]:
    paths = tuple(f"{kind}/{view.name}.png" for kind in ("images", "masks"))
    for path, pixels in zip(paths, (view.image, view.mask), strict=True):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_png(folder / path, pixels / np.float32(255))
    return paths


def _write_scene(folder: Path, target: Path, name: str, content: Content, body: FileBody, settings: Settings) -> None:
    (folder / "smpl").mkdir(parents=True)
    arrays = []
    for posed in content.posed:
        arrays.append(f"smpl/{len(arrays):06d}.npz")
        transforms = content.transform @ posed.joint_transforms
        write_arrays(folder / arrays[-1], moved(content.transform, posed.vertices), posed.rest, content.faces, transforms)
    frames = []
    for view in content.views:
        image, mask = _write_images(folder, view)
        path = f"{target.name}/{arrays[view.frame]}"
        frames.append(SceneFrame(f"{target.name}/{image}", view.cam_from_world, view.K, path, f"{target.name}/{mask}"))
    if not frames:
        raise ValueError(f"{name}: no photo can be read: {next(iter(content.known['unreadable'].values()), '')}")
    known = {"views": len(frames), "frames": len(arrays), **content.known}
    entry = scene_entry(name, content.transform, frames)
    write_json(folder / SCENE, {"entry": entry, "known": known}, indent=None)


def _write_capture(folder: Path, target: Path, name: str, content: Content, body: FileBody, settings: Settings) -> None:
    """In metres; the poses are those of the aligned world."""
    folder.mkdir()
    matrix = content.transform.copy()
    matrix[:3, 3] /= content.scale
    pelvis = body.rest_joints(content.parameters.betas)[0]
    betas, rotations, translations = turned(content.parameters, matrix, pelvis)
    described = []
    for view in content.views:
        image, mask = _write_images(folder, view)
        pose = view.cam_from_world.copy()
        pose[:3, 3] /= content.scale
        matrices = {"K": view.K.tolist(), "cam_from_world": pose.tolist()}
        described.append({"image": image, "mask": mask, "frame": view.frame, **matrices})
    if not described:
        raise ValueError(f"{name}: no photo can be read: {next(iter(content.known['unreadable'].values()), '')}")
    write_npz(folder / "body.npz", parameter_arrays(target, body.model, body.file, betas, rotations, translations))
    known = {"views": len(described), "frames": len(rotations), **content.known}
    write_json(folder / SCENE, {"known": known}, indent=None)
    write_description(folder, described, "white")
