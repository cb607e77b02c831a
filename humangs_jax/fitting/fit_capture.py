"""From photographs with cameras and keypoints to a capture with a body, and its place on disk."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np

from humangs_jax.body.landmarks import landmark_model
from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture import DEFAULT_BODY, Capture, parameter_arrays
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import Photos, capture_folder, read_description
from humangs_jax.fitting.fit_record import FIT_FILE, FitRecord, write_fit_record
from humangs_jax.fitting.landmark_fit import STAGES, FitConfig, LandmarkFit, fit_landmarks
from humangs_jax.fitting.observations import group_by_moment
from humangs_jax.fitting.swaps import Swap, find_mirrored
from humangs_jax.fitting.uncertainty import fit_uncertainty
from humangs_jax.io.atomic import replace_file, replace_folder


@dataclasses.dataclass(frozen=True, eq=False)
class FittedCapture:
    """A fit in memory: the capture with its body, what to keep beside it, what the solver did, and what seems wrong."""

    capture: Capture
    record: FitRecord
    fit: LandmarkFit
    mirrored: tuple[Swap, ...]
    warnings: tuple[str, ...]

    def convergence(self) -> str:
        """A table: of each stage, how many moments converged, the steps, and the cost before and after, as means."""
        lines = ["stage    converged  steps  cost before -> after"]
        for stage in (*STAGES, "person"):
            outcome = self.fit.outcomes[stage]
            done, steps, before, after = (
                np.atleast_1d(np.asarray(getattr(outcome, name))) for name in ("converged", "steps", "before", "after")
            )
            lines.append(
                f"{stage:<8} {f'{done.sum()} of {done.size}':>9}  {steps.mean():>5.0f}  {before.mean():.4g} -> {after.mean():.4g}"
            )
        return "\n".join(lines)


def fit_photographs(
    photographs: Photos,
    keypoints: Keypoints,
    body: BodyModel,
    *,
    body_file: str = DEFAULT_BODY,
    config: FitConfig | None = None,
) -> FittedCapture:
    """Find shape and poses of the person in photographs.

    Arguments: keypoints: of each view, in the order of the photographs. body_file: where the body comes from, see `Capture`.
    Raises: ValueError if the numbers of views differ, no view has a keypoint that the body has, or the body's root is not its
    first joint.
    """
    config = config or FitConfig()
    if len(keypoints.points) != len(photographs.names):
        raise ValueError(
            f"keypoints of {len(keypoints.points)} views, but there are {len(photographs.names)} photographs"
        )
    if body.parents.index(-1) != 0:
        raise ValueError(
            f"body '{body.name}': expected the root to be its first joint, got joint {body.parents.index(-1)}"
        )
    model = landmark_model(body, keypoints.set.names)
    observations, _ = group_by_moment(photographs, keypoints)
    seen = np.asarray(observations.confidences) * np.asarray(model.known) > 0
    if not seen.any():
        raise ValueError("no view has a keypoint that the body has: nothing to fit")
    fit = fit_landmarks(model, observations, config)
    found = fit_uncertainty(model, observations, fit, config)
    capture = Capture(**vars(photographs), body=body, betas=np.asarray(fit.betas), poses=fit.poses, body_file=body_file)
    record = FitRecord(
        keypoints,
        photographs.names,
        np.asarray(fit.noise),
        found.joint_deviations,
        found.determined,
        found.shape_covariance,
    )
    mirrored = find_mirrored(model, observations, keypoints.set, fit, config)
    return FittedCapture(capture, record, fit, mirrored, _blind_moments(seen))


FEW = 6
"""Keypoints below which a moment's pose is mostly the prior's."""


def _blind_moments(seen):
    """What to say of moments (m, c, k) with few keypoints or a single view."""
    warnings = []
    for moment, views in enumerate(seen):
        points, cameras = int(views.any(0).sum()), int(views.any(1).sum())
        if points < FEW:
            warnings.append(
                f"moment {moment}: {points} keypoints are seen: its pose is what is usual, not what was photographed"
            )
        elif cameras == 1:
            warnings.append(f"moment {moment}: seen by one view: distance and height can hardly be told apart")
    return tuple(warnings)


# On disk -------------------------------------------------------------------------------------------------------------


def check_place(source: str | Path, out: str | Path | None, overwrite: bool) -> Path:
    """The folder that a fit of the capture `source` is written to, checked before the work begins.

    Arguments: out: None: the capture folder itself. Raises: ValueError if something would be overwritten unasked.
    """
    source = capture_folder(source)
    target = source if out is None else Path(out)
    if target.resolve() == source.resolve():
        if (target / _body_name(source)).exists() and not overwrite:
            raise ValueError(
                f"{target / _body_name(source)} exists: --overwrite replaces it, --out FOLDER writes the fit elsewhere"
            )
    elif target.exists() and (target.is_file() or any(target.iterdir())) and not overwrite:
        raise ValueError(f"--out {target}: exists and is not empty; --overwrite replaces it")
    elif overwrite and target.is_dir() and any(target.iterdir()) and not (target / "capture.json").is_file():
        raise ValueError(f"--out {target}: holds no capture.json: refusing to overwrite what is no capture")
    if target.resolve() in source.resolve().parents:
        raise ValueError(f"--out {target}: {source} lies inside of it, and would be lost")
    return target


def write_fitted(source: str | Path, target: str | Path, capture: Capture, record: FitRecord | None) -> None:
    """Write cameras and body of a capture: into the capture folder `source` itself, or with its pictures into another folder.

    Pictures are copied as they are. record: of a fit to keypoints; None: a fit.npz of the source goes on being true of nothing,
    and is left out or removed.
    """
    source, target = capture_folder(source), Path(target)
    description = read_description(source / "capture.json")
    name = description["body"]
    described = json.dumps(_with_cameras(description, capture), indent=1) + "\n"
    arrays = parameter_arrays(capture, target)
    if target.resolve() == source.resolve():
        if record is None:
            (target / FIT_FILE).unlink(missing_ok=True)
        else:
            write_fit_record(target / FIT_FILE, record)
        replace_file(target / name, lambda path: np.savez(path, **arrays))  # ty: ignore[invalid-argument-type]
        replace_file(target / "capture.json", lambda path: _write_text(path, described))
        return

    def write(folder: Path):
        folder.mkdir()
        for file in sorted({view[key] for view in description["views"] for key in ("image", "mask") if key in view}):
            _copy(source, folder, file)
        (folder / "capture.json").write_text(described, encoding="utf-8")
        np.savez(folder / name, **arrays)  # ty: ignore[invalid-argument-type]
        if record is not None:
            write_fit_record(folder / FIT_FILE, record)

    replace_folder(target, write)


def _write_text(path, text):
    path.write_text(text, encoding="utf-8")


def _with_cameras(description, capture):
    """capture.json with the cameras of the capture, as far as they have changed."""
    views = []
    for i, view in enumerate(description["views"]):
        new = {name: np.asarray(getattr(capture.cameras, name)[i], float) for name in ("K", "cam_from_world")}
        same = {name: np.array_equal(np.asarray(view[name], np.float32), value) for name, value in new.items()}
        views.append(view | {name: value.tolist() for name, value in new.items() if not same[name]})
    return description | {"views": views}


def _copy(source, folder, file):
    target = folder / file
    if not target.resolve().is_relative_to(folder.resolve()):
        raise CaptureError(
            source / "capture.json", file, "lies outside of the capture folder: fit it in place, without --out"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / file, target)


def _body_name(source):
    return read_description(source / "capture.json")["body"]
