"""`humangs fit` and `humangs check`: find the body of one's own photos or scans, and look at the result.

Everything is checked before the work begins, and written after it.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

from tyro.conf import OmitArgPrefixes, Positional

from humangs_jax.cli.options import require_at_least, require_parent, tell_deleted

LISTED = 5
"""Names of views in a warning, at most."""


@dataclasses.dataclass(frozen=True)
class Detections:
    """2D keypoints of a detector."""

    keypoints: Path | None = None
    """Keypoint file or folder of OpenPose, COCO, COCO-WholeBody, MMPose or AlphaPose (docs/fitting.md)."""
    person: int | None = None
    """Which person of the keypoint file, from 0, if a view has several."""

    def read(self, views: Any) -> Any:
        """The keypoints of the views of a `Photos` or `Capture`, None if no file was given. Raises: see `read_keypoints`."""
        from humangs_jax.data.keypoints.reading import read_keypoints

        if self.keypoints is None:
            return None
        height, width = views.images.shape[1:3]
        return read_keypoints(self.keypoints, views.names, width, height, person=self.person)


@dataclasses.dataclass(frozen=True)
class Scan:
    """A person in a scan."""

    scan: Path | None = None
    """A mesh with a person in it, of any scale and orientation."""
    joints: Path | None = None
    """3D landmarks of the scan by name (.json or .npz). Without these and --views, the pose is searched."""
    views: Path | None = None
    """Folder of images of the scan. They are rendered there; then, with --keypoints, those that the keypoints are of."""
    height: float | None = None
    """Height of the person in the scan without shoes, metres. It sets the scale of the scan."""
    bare: bool = False
    """The person in the scan wears no clothes."""


@dataclasses.dataclass(frozen=True)
class Refinement:
    """Refinement of a capture that has a body."""

    refine: bool = False
    """Improve cameras, shape and poses; with --keypoints, against these too. The result is never worse than the start."""
    fixed_cameras: bool = False
    """Move shape and poses only: for calibrated cameras, where the body is wider or narrower than the masks."""
    photometric: bool = False
    """Also compare photos and renderings of a reconstruction while refining."""


Way = Literal["--scan", "--refine", "--keypoints"]
WAYS: dict[Way, set[str]] = {
    "--scan": {"keypoints", "person", "body", "joints", "views", "height", "bare"},
    "--refine": {"keypoints", "person", "photometric", "fixed_cameras"},
    "--keypoints": {"person", "body", "smoothness"},
}
"""The three ways to fit, by the option that chooses each, and their other options."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Find the body of one's own photos: from keypoints of a detector, or inside of a scan; or refine what is there.

    humangs fit CAPTURE --keypoints FILE: shape and poses from photos with cameras (humangs import cameras) and 2D keypoints.
    humangs fit CAPTURE --refine: improve cameras and poses of a capture with its masks. humangs fit --scan MESH --out FOLDER.
    """

    detections: OmitArgPrefixes[Detections]
    scan: OmitArgPrefixes[Scan]
    refinement: OmitArgPrefixes[Refinement]
    capture: Positional[Path | None] = None
    """Folder with capture.json; its body.npz need not exist."""
    body: Path | None = None
    """Model file (SMPL-X .npz or .pkl). Default: the shipped body."""
    smoothness: float = 0.0
    """Typical acceleration of joints in metres per frame squared, for sequences (walking at 24 frames a second: 0.02). 0:
    frames are fitted one by one."""
    out: Path | None = None
    """Folder for the result. Default: the capture folder itself."""
    overwrite: bool = False
    """Replace what is there."""

    def run(self) -> None:
        """Fit in the way that was asked for."""
        if (self.capture is None) == (self.scan.scan is None):
            raise ValueError("give either a CAPTURE folder or --scan MESH")
        way: Way = "--scan" if self.scan.scan else "--refine" if self.refinement.refine else "--keypoints"
        for option in self._given():
            if option not in WAYS[way] and f"--{option}" != way:
                owners = " or ".join(other for other, options in WAYS.items() if option in options)
                raise ValueError(f"--{option} is for {owners or 'captures'}, not for {way}")
        if way == "--scan":
            self._fit_scan()
        elif way == "--refine":
            self._refine()
        else:
            self._fit_keypoints()

    def _given(self):
        """Options of the ways of fitting whose value is not the default, in the order of the help."""
        for part in (self.refinement, self.scan, self.detections, self):
            for field in dataclasses.fields(part):
                chosen = not dataclasses.is_dataclass(value := getattr(part, field.name)) and value != field.default
                if chosen and field.name not in ("capture", "out", "overwrite"):
                    yield field.name

    def _fit_keypoints(self):
        from humangs_jax.body.library import load_body
        from humangs_jax.data.capture import DEFAULT_BODY
        from humangs_jax.data.photos import load_photos
        from humangs_jax.fitting.files import check_place, write_fitted
        from humangs_jax.fitting.fit_capture import fit_photos
        from humangs_jax.fitting.landmark_fit import FitConfig

        assert self.capture is not None  # `run` has checked it
        if self.detections.keypoints is None:
            raise ValueError("--keypoints FILE is missing (or --refine, to improve the body that a capture has)")
        require_at_least(0, smoothness=self.smoothness)
        target = check_place(self.capture, self.out, self.overwrite, (self.detections.keypoints, self.body))
        tell_deleted(target, unless=target if self.out is None else self.capture)
        photos = load_photos(self.capture)
        keypoints = self.detections.read(photos)
        body_file = DEFAULT_BODY if self.body is None else str(self.body)
        config = dataclasses.replace(FitConfig(), smoothness=self.smoothness)
        fitted = fit_photos(photos, keypoints, load_body(self.body), body_file=body_file, config=config)
        warnings = (*fitted.report.warnings, *_reading_warnings(keypoints))
        report = dataclasses.replace(fitted.report, warnings=warnings)
        write_fitted(self.capture, target, fitted.capture, report, fitted.record)
        print(report)
        print(f"{target}: body.npz, fit.npz and fit.json; `humangs check {target}` shows them")

    def _refine(self):
        from humangs_jax.data.capture import load_capture
        from humangs_jax.fitting.files import check_place, write_fitted
        from humangs_jax.fitting.refine import refine_capture
        from humangs_jax.fitting.refine_rounds import CaptureRefineConfig

        assert self.capture is not None  # `run` has checked it
        target = check_place(self.capture, self.out, self.overwrite, (self.detections.keypoints,))
        tell_deleted(target, unless=target if self.out is None else self.capture)
        start = load_capture(self.capture)
        keypoints = self.detections.read(start)
        config = CaptureRefineConfig(fixed_cameras=self.refinement.fixed_cameras)
        refinement = refine_capture(start, keypoints=keypoints, photometric=self.refinement.photometric, config=config)
        print(refinement.report)
        if not refinement.report.kept:
            print("nothing was written: refinement did not improve the capture")
            return
        write_fitted(self.capture, target, refinement.capture, refinement.report)
        print(f"{target}: refined cameras and body; `humangs check {target}` shows them")

    def _fit_scan(self):
        scan, keypoints = self.scan, self.detections.keypoints
        if scan.joints is not None and scan.views is not None:
            raise ValueError("--joints and --views: give one of them, both say where the joints are")
        if keypoints is not None and scan.views is None:
            raise ValueError("--keypoints of a scan needs --views FOLDER, the images that they are of")
        from humangs_jax.body.library import load_body
        from humangs_jax.data.capture import DEFAULT_BODY
        from humangs_jax.data.photos import load_photos
        from humangs_jax.fitting.files import check_scan_folder, save_scan_fit
        from humangs_jax.fitting.scan_fit import fit_scan
        from humangs_jax.fitting.scan_reading import read_joints
        from humangs_jax.fitting.scan_views import joints_from_views, render_scan_views

        assert scan.scan is not None  # `run` has checked it
        if scan.views is not None and keypoints is None:
            render_scan_views(scan.scan, scan.views)
            found = f"find keypoints in {scan.views / 'images'}, then add --keypoints FILE --out FOLDER"
            print(f"{scan.views}: images of the scan; {found}")
            return
        if self.out is None:
            raise ValueError("--out FOLDER is missing: where the body of the scan goes")
        check_scan_folder(self.out, self.overwrite, (scan.scan, scan.joints, scan.views, keypoints, self.body))
        tell_deleted(self.out)
        joints = None if scan.joints is None else read_joints(scan.joints)
        if scan.views is not None:
            joints = joints_from_views(scan.views, self.detections.read(load_photos(scan.views)))
        body = load_body(self.body)
        fitted = fit_scan(scan.scan, body=body, joints=joints, clothed=not scan.bare, height=scan.height)
        body_file = DEFAULT_BODY if self.body is None else os.path.relpath(self.body.resolve(), self.out.resolve())
        save_scan_fit(self.out, fitted, body_file, overwrite=self.overwrite)
        print(fitted.report)
        print(f"{self.out}: body.npz, scan_fit.json and body_in_scan.ply")


def _reading_warnings(keypoints):
    """Problems of a keypoint file that could be read."""
    if keypoints.missing:
        names = ", ".join(keypoints.missing[:LISTED]) + (" ..." if len(keypoints.missing) > LISTED else "")
        yield f"no keypoints of {len(keypoints.missing)} views: {names}"
    if keypoints.shifted:
        yield f"frames and photos are counted from different numbers and were matched in order: {keypoints.shifted}"
    if keypoints.not_finite:
        yield f"{keypoints.not_finite} keypoints are not finite numbers and are ignored"
    if keypoints.far_outside:
        yield f"{keypoints.far_outside} keypoints lie far outside of their photo and are ignored: of photos of another size?"


@dataclasses.dataclass(frozen=True)
class Check:
    """Draw the posed body over each photo of a capture: a wrong pose or camera convention is easy to see.

    For a capture that `humangs fit` made, also its keypoints, how far off the body is, and what the views do not determine.
    """

    capture: Positional[Path]
    """Folder with capture.json."""
    detections: OmitArgPrefixes[Detections]
    out: Path = Path("check.png")
    """The contact sheet to write; that of the keypoints is NAME_fit.png beside it."""

    def run(self) -> None:
        from humangs_jax.apps.check import check_capture
        from humangs_jax.data.capture import load_capture
        from humangs_jax.data.photos import capture_folder
        from humangs_jax.fitting.files import FIT_FILE, read_fit_record

        capture = load_capture(self.capture)
        require_parent(self.out)
        keypoints, record = self.detections.read(capture), None
        record_file = capture_folder(self.capture) / FIT_FILE
        if keypoints is None and record_file.exists():
            record = read_fit_record(record_file)
        print(check_capture(capture, self.out))
        if record is not None or keypoints is not None:
            from humangs_jax.apps.fit_sheet import fit_sheet
            from humangs_jax.fitting.examination import examine_record

            examination, keypoints = examine_record(capture, record, keypoints)
            sheet = self.out.with_name(f"{self.out.stem}_fit{self.out.suffix}")
            fit_sheet(capture, keypoints, examination, sheet)
            print(f"\n{examination.report}\n{sheet}: the keypoints over the photos")
