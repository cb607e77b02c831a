"""What `humangs fit` does: read, fit, say how good it is, write. Everything is checked before the work, and written after it."""

import dataclasses
import os
from pathlib import Path

from humangs_jax.body.library import load_body
from humangs_jax.data.capture import DEFAULT_BODY, Capture, load_capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.data.photos import Photos, load_photos
from humangs_jax.fitting.fit_capture import check_place, fit_photographs, write_fitted
from humangs_jax.fitting.landmark_fit import FitConfig

NAMED = 5
"""So many views are listed by name, no more."""


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
    from humangs_jax.fitting.examination import examine

    target = check_place(capture, out, overwrite)
    photographs = load_photos(capture)
    found = read_keypoints_of(photographs, keypoints, person)
    model = load_body(body)
    body_file = DEFAULT_BODY if body is None else str(body)
    config = dataclasses.replace(FitConfig(), smoothness=smoothness)
    fitted = fit_photographs(photographs, found, model, body_file=body_file, config=config)
    record = fitted.record
    known = {name: getattr(record, name) for name in ("deviations", "determined", "noise")}
    examination = examine(fitted.capture, found, **known, mirrored=fitted.mirrored)
    write_fitted(capture, target, fitted.capture, record)
    print(fitted.convergence())
    print(f"\n{examination}")
    for warning in (*_reading_warnings(found), *fitted.warnings):
        print(f"warning: {warning}")
    print(f"{target}: body.npz and fit.npz; `humangs check {target}` shows them")


def refine_in_place(
    capture: Path, out: Path | None, *, keypoints: Path | None, person: int | None, photometric: bool, overwrite: bool
) -> None:
    """`humangs fit CAPTURE --refine`. Raises: ValueError or OSError, one line, with nothing written."""
    from humangs_jax.fitting.refinement.refine import refine_capture

    target = check_place(capture, out, overwrite)
    start = load_capture(capture)
    found = None if keypoints is None else read_keypoints_of(start, keypoints, person)
    refinement = refine_capture(start, keypoints=found, photometric=photometric)
    print(refinement)
    if refinement.kept == "start":
        print("nothing was written: the capture is as good as it gets here")
        return
    write_fitted(capture, target, refinement.capture, None)
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
        raise ValueError("--keypoints of a scan needs --views FOLDER, the pictures that they are of")
    from humangs_jax.fitting.scans.files import check_folder, save_scan_fit
    from humangs_jax.fitting.scans.fit import fit_scan
    from humangs_jax.fitting.scans.joints import read_joints
    from humangs_jax.fitting.scans.views import joints_from_views, render_scan_views

    if views is not None and keypoints is None:
        render_scan_views(scan, views)
        print(
            f"{views}: pictures of the scan; find keypoints in {views / 'images'}, then add --keypoints FILE --out FOLDER"
        )
        return
    if out is None:
        raise ValueError("--out FOLDER is missing: where the body of the scan goes")
    check_folder(out, overwrite)
    known = None
    if joints is not None:
        known = read_joints(joints)
    elif views is not None and keypoints is not None:
        known = joints_from_views(views, read_keypoints_of(load_photos(views), keypoints, person))
    fitted = fit_scan(scan, body=load_body(body), joints=known, clothed=not bare, height=height)
    body_file = DEFAULT_BODY if body is None else os.path.relpath(body.resolve(), out.resolve())
    save_scan_fit(out, fitted, body_file, overwrite=overwrite)
    print(fitted)
    print(f"{out}: body.npz, scan_fit.json and body_in_scan.ply")


def read_keypoints_of(views: Photos | Capture, path: Path, person: int | None) -> Keypoints:
    """Keypoints of the views of a capture. Raises: see `read_keypoints`."""
    height, width = views.images.shape[1:3]
    return read_keypoints(path, views.names, width, height, person=person)


def _reading_warnings(found):
    """What was odd about a file of keypoints that could be read."""
    if found.missing:
        names = ", ".join(found.missing[:NAMED]) + (" ..." if len(found.missing) > NAMED else "")
        yield f"no keypoints of {len(found.missing)} views: {names}"
    if found.not_finite:
        yield f"{found.not_finite} keypoints were no numbers and are left out"
    if found.far_outside:
        yield f"{found.far_outside} keypoints lie far outside of their photo and are left out: of photos of another size?"
