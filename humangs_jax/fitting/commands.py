"""What `humangs fit` does: read, fit, report, write. Everything is checked before the work, and written after it."""

import dataclasses
import os
from pathlib import Path

from humangs_jax.body.library import load_body
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.capture_reading import DEFAULT_BODY
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.data.photographs import Photographs, load_photographs
from humangs_jax.fitting.files import check_place, check_scan_folder, save_scan_fit, write_fitted
from humangs_jax.fitting.fit_capture import fit_photographs
from humangs_jax.fitting.landmark_fit import FitConfig

NAMED = 5
"""Views that are listed by name, at most."""


def fit_from_keypoints(
    capture: Path,
    keypoints: Path,
    out: Path | None,
    *,
    body: Path | None,
    person: int | None,
    smoothness: float,
    overwrite: bool,
) -> None:
    """`humangs fit CAPTURE --keypoints FILE`. Raises: ValueError or OSError, one line, with nothing written."""
    target = check_place(capture, out, overwrite)
    photographs = load_photographs(capture)
    found = read_keypoints_of(photographs, keypoints, person)
    model = load_body(body)
    body_file = DEFAULT_BODY if body is None else str(body)
    config = dataclasses.replace(FitConfig(), smoothness=smoothness)
    fitted = fit_photographs(photographs, found, model, body_file=body_file, config=config)
    report = dataclasses.replace(fitted.report, warnings=(*fitted.report.warnings, *_reading_warnings(found)))
    write_fitted(capture, target, fitted.capture, report, fitted.record)
    print(report)
    print(f"{target}: body.npz, fit.npz and fit.json; `humangs check {target}` shows them")


def refine_in_place(
    capture: Path, out: Path | None, *, keypoints: Path | None, person: int | None, photometric: bool, overwrite: bool
) -> None:
    """`humangs fit CAPTURE --refine`. Raises: ValueError or OSError, one line, with nothing written."""
    from humangs_jax.fitting.refine import refine_capture

    target = check_place(capture, out, overwrite)
    start = load_capture(capture)
    found = None if keypoints is None else read_keypoints_of(start, keypoints, person)
    refinement = refine_capture(start, keypoints=found, photometric=photometric)
    print(refinement.report)
    if not refinement.report.kept:
        print("nothing was written: refinement did not improve the capture")
        return
    write_fitted(capture, target, refinement.capture, refinement.report)
    print(f"{target}: refined cameras and body; `humangs check {target}` shows them")


def fit_from_scan(
    scan: Path,
    out: Path | None,
    *,
    body: Path | None,
    joints: Path | None,
    views: Path | None,
    keypoints: Path | None,
    person: int | None,
    height: float | None,
    bare: bool,
    overwrite: bool,
) -> None:
    """`humangs fit --scan MESH`. Raises: ValueError or OSError, one line, with nothing written."""
    if joints is not None and views is not None:
        raise ValueError("--joints and --views: give one of them, both say where the joints are")
    if keypoints is not None and views is None:
        raise ValueError("--keypoints of a scan needs --views FOLDER, the images that they are of")
    from humangs_jax.fitting.scan_fit import fit_scan
    from humangs_jax.fitting.scan_reading import read_joints
    from humangs_jax.fitting.scan_views import joints_from_views, render_scan_views

    if views is not None and keypoints is None:
        render_scan_views(scan, views)
        print(
            f"{views}: images of the scan; find keypoints in {views / 'images'}, then add --keypoints FILE --out FOLDER"
        )
        return
    if out is None:
        raise ValueError("--out FOLDER is missing: where the body of the scan goes")
    check_scan_folder(out, overwrite)
    known = None
    if joints is not None:
        known = read_joints(joints)
    elif views is not None and keypoints is not None:
        known = joints_from_views(views, read_keypoints_of(load_photographs(views), keypoints, person))
    fitted = fit_scan(scan, body=load_body(body), joints=known, clothed=not bare, height=height)
    body_file = DEFAULT_BODY if body is None else os.path.relpath(body.resolve(), out.resolve())
    save_scan_fit(out, fitted, body_file, overwrite=overwrite)
    print(fitted.report)
    print(f"{out}: body.npz, scan_fit.json and body_in_scan.ply")


def read_keypoints_of(views: Photographs | Capture, path: Path, person: int | None) -> Keypoints:
    """Keypoints of the views of a capture. Raises: see `read_keypoints`."""
    height, width = views.images.shape[1:3]
    return read_keypoints(path, views.names, width, height, person=person)


def _reading_warnings(found):
    """What is odd about a keypoint file that could be read."""
    if found.missing:
        names = ", ".join(found.missing[:NAMED]) + (" ..." if len(found.missing) > NAMED else "")
        yield f"no keypoints of {len(found.missing)} views: {names}"
    if found.not_finite:
        yield f"{found.not_finite} keypoints are not finite and are left out"
    if found.far_outside:
        yield f"{found.far_outside} keypoints lie far outside of their photo and are left out: of photos of another size?"
