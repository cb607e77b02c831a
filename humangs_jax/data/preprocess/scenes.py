"""One scan or one video -> a folder: a scene with the arrays of the published layout, or a capture of ours.

A scene's folder holds images/ and masks/ of each view, smpl/ of each frame, and scene.json: its entry for the list, and what is
known of it. Everything is written under a temporary name first, so that the folder is whole or not there.
"""

import dataclasses
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float, UInt8
from humangs_jax.data.capture import parameter_arrays
from humangs_jax.data.datasets.bodies import BodyParameters, FileBody, PosedPerson, posed_people, turned
from humangs_jax.data.datasets.scene_list import SceneFrame, scene_entry, write_arrays
from humangs_jax.data.datasets.subject import Subject
from humangs_jax.data.datasets.thuman import (
    FIT_MESH,
    ThumanSet,
    fit_error,
    fitted_body,
    read_fit,
    read_fit_mesh,
    read_scan,
)
from humangs_jax.data.photos import write_description
from humangs_jax.data.preprocess.protocol import (
    EVERY,
    FACTORS,
    NECK,
    PELVIS,
    SIZE,
    TEST,
    TRAIN,
    VIEWS,
    bounding_radius,
    intrinsics,
    moved,
    scan_alignment,
    scan_cameras,
    video_alignment,
)
from humangs_jax.data.preprocess.rendering import ScanRenderer
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import write_png
from humangs_jax.io.npz import write_npz
from humangs_jax.io.reading import write_json

SCENE, CAPTURE = "scene.json", "capture.json"
Layout = Literal["scenes", "capture"]


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a preprocessed set is made with.

    kind: "thuman", "thuman4" or "avatarrex". layout: of the output. size: pixels a side.
    Of scans: views, factors (range of the distance in bounding radii), supersample (samples along a pixel), train and test
    (scans of each split). Of videos: every (the frame step).
    """

    kind: str
    layout: Layout = "scenes"
    size: int = SIZE
    views: int = VIEWS
    factors: tuple[float, float] = FACTORS
    supersample: int = 3
    every: int = EVERY
    train: int = TRAIN
    test: int = TEST

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


def _photos(subject, views, size):
    """Photos or, in their place, what is wrong with one."""
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


def _write(folder, name, content, body, settings):
    write = _write_scene if settings.layout == "scenes" else _write_capture
    replace_folder(
        folder, lambda temporary: write(temporary, folder, name, content, body, settings), mark=settings.mark
    )


def _write_images(folder, view):
    """Their paths relative to the folder."""
    paths = tuple(f"{kind}/{view.name}.png" for kind in ("images", "masks"))
    for path, pixels in zip(paths, (view.image, view.mask), strict=True):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        write_png(folder / path, pixels / np.float32(255))
    return paths


def _write_scene(folder, target, name, content, body, settings):
    (folder / "smpl").mkdir(parents=True)
    arrays = []
    for posed in content.posed:
        arrays.append(f"smpl/{len(arrays):06d}.npz")
        transforms = content.transform @ posed.joint_transforms
        write_arrays(
            folder / arrays[-1], moved(content.transform, posed.vertices), posed.rest, content.faces, transforms
        )
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


def _write_capture(folder, target, name, content, body, settings):
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
