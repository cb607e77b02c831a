"""The commands `humangs fit` and `humangs check`, which find the body in photos and check the
result.

Options and output places are checked before the work begins. Results are written at its end.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from humangs_jax.cli.captures import found_here, tell_found
from humangs_jax.cli.options import (
    OutputPath,
    UsageError,
    option_of,
    require_file,
    require_folder,
    require_replaceable,
    tell_deleted,
)
from humangs_jax.cli.screen import stage, suggest, tell, warn, wrote
from humangs_jax.core.configuration import at_least
from humangs_jax.data.formats import KEYPOINTS


@dataclasses.dataclass(frozen=True)
class Detections:
    """Options of the 2D keypoints that a detector has found."""

    keypoints: Annotated[
        Path | None, arg(help=f"Keypoint file or folder: {KEYPOINTS.listed()}.")
    ] = None
    person: int | None = None
    """Number of the person, from 0, if a view has several: the number in the keypoint file, or on
    people.png if there is no such file.
    """

    def read(self, views: Any) -> Any:
        """Reads the keypoints of the views of a `Photos` or `Capture`. Returns None if no file was
        given.

        Raises: see `read_keypoints`.
        """
        from humangs_jax.capture.keypoints.reading import read_keypoints

        if self.keypoints is None:
            return None
        height, width = views.images.shape[1:3]
        return read_keypoints(self.keypoints, views.names, width, height, person=self.person)

    def read_or_recorded(self, capture: Path, views: Any) -> tuple[Any, Any]:
        """Reads the keypoints of the views from --keypoints, or else from an earlier fit of the
        capture.

        Returns the keypoints, and the record of the earlier fit if they are from it. Each is None
        if there is none.

        Raises: as `read_keypoints`, `read_fit_record` and `FitRecord.of_views`.
        """
        from humangs_jax.capture.fitting.files import FIT_FILE, read_fit_record
        from humangs_jax.data.photos import capture_folder

        file = capture_folder(capture) / FIT_FILE
        if self.keypoints is not None or not file.exists():
            return self.read(views), None
        record = read_fit_record(file)
        return record.of_views(views.names), record


@dataclasses.dataclass(frozen=True)
class MaskFit:
    """Options of the fit to masks, for a capture that has a body."""

    to_masks: bool = False
    """Improve cameras, shape and poses by masks and keypoints.

    Keypoints are taken from --keypoints, or from the earlier fit. The result is never worse than
    the start.
    """
    fixed_cameras: bool = False
    """Leave cameras as they are.
    Otherwise a fit to keypoints corrects cameras if the keypoints show that they are turned.
    --to-masks corrects all cameras, if the views determine how.
    """
    tight_clothes: bool = False
    """With --to-masks, let the body fill the masks, to measure a body in tight clothes or none.

    For avatars it is better without.
    """


_Way = Literal["--to-masks", "--keypoints"]
WAYS: dict[_Way, set[str]] = {
    "--to-masks": {"keypoints", "person", "fixed_cameras", "tight_clothes"},
    "--keypoints": {"person", "body", "smoothness", "fixed_cameras"},
}
"""The two ways to fit, named by the option that chooses each, with their other options."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Find the body in photos with cameras.

    Shape and poses are fitted to 2D keypoints: those of --keypoints, or those of the shipped
    detector. --to-masks improves cameras and poses by masks. docs: fitting.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs fit me --keypoints keypoints.json",
        "humangs fit me --to-masks",
    )
    detections: OmitArgPrefixes[Detections]
    mask_fit: OmitArgPrefixes[MaskFit]
    capture: Positional[Path]
    """Folder with capture.json. It need not have a body.npz yet."""
    body: Path | None = None
    """Model file (SMPL-X .npz or .pkl). Default: the shipped body."""
    smoothness: Annotated[float, at_least(0)] = 0.0
    """For sequences: typical acceleration of joints, metres per frame squared, such as 0.02 for
    walking at 24 fps. 0: no smoothing.
    """
    out: Path | None = None
    """Folder for the result. Default: the capture folder itself."""
    overwrite: bool = False
    """Replace an existing result."""

    def run(self) -> None:
        """Fits to masks or to keypoints. The options say which."""
        way: _Way = "--to-masks" if self.mask_fit.to_masks else "--keypoints"
        for option in self._given():
            if option not in WAYS[way] and option_of(option) != way:
                owners = " or ".join(other for other, options in WAYS.items() if option in options)
                raise UsageError(
                    f"{option_of(option)} is for {owners or 'captures'}, not for {way}"
                )
        self._check_places()
        if way == "--to-masks":
            self._fit_to_masks()
        else:
            self._fit_keypoints()

    def _given(self) -> Iterator[str]:
        """Yields the names of the options of fitting whose value is not the default."""
        for part in (self.mask_fit, self.detections, self):
            for field in dataclasses.fields(part):
                value = getattr(part, field.name)
                chosen = not dataclasses.is_dataclass(value) and value != field.default
                if chosen and field.name not in ("capture", "out", "overwrite"):
                    yield field.name

    def _check_places(self) -> None:
        """Checks whether the result can be written, as far as this is known before the capture is
        read.

        Raises: UsageError if it cannot.
        """
        inputs = (self.capture, self.detections.keypoints, self.body)
        in_place = self.out is None or self.out.resolve() == self.capture.resolve()
        if self.out is not None and not in_place:
            require_replaceable(self.out, self.overwrite, "capture.json", inputs)
        elif self.capture.is_dir():
            require_folder(self.capture, "CAPTURE")
            body = self.capture / "body.npz"
            if body.exists() and not self.overwrite:
                raise UsageError(
                    f"{body} exists: --overwrite replaces it, --out FOLDER writes the fit elsewhere"
                )

    def _fit_keypoints(self) -> None:
        with stage("starting"):
            from humangs_jax.body.library import load_body
            from humangs_jax.capture.detection.people import available
            from humangs_jax.capture.fitting.files import check_place, write_fitted
            from humangs_jax.capture.fitting.fit_capture import fit_photos
            from humangs_jax.data.capture import DEFAULT_BODY
            from humangs_jax.data.photos import load_photos

        # all that can be refused is refused before the work
        target = check_place(
            self.capture, self.out, self.overwrite, (self.detections.keypoints, self.body)
        )
        tell_deleted(target, unless=target if self.out is None else self.capture)
        detections = self.detections
        # without a file the shipped detector finds the keypoints
        if detections.keypoints is None:
            if not available():
                raise UsageError(
                    "--keypoints FILE is missing; pip install 'humangs_jax[photos]', and they are"
                    " found here"
                )
            with stage("finding the person"):
                detections = Detections(found_here(self.capture, detections.person))
        with stage("reading photos and keypoints"):
            photos = load_photos(self.capture)
            keypoints = detections.read(photos)
            body = load_body(self.body)
        body_file = DEFAULT_BODY
        if self.body is not None:
            body_file = str(self.body)
        with stage("fitting"):
            fixed = self.mask_fit.fixed_cameras
            fitted = fit_photos(
                photos,
                keypoints,
                body,
                body_file=body_file,
                smoothness=self.smoothness,
                fixed_cameras=fixed,
            )
        with stage("examining the fit"):
            report = fitted.report
        # the report shows what the keypoint file had to say, too
        report = dataclasses.replace(report, warnings=(*report.warnings, *keypoints.warnings))
        with stage("writing"):
            write_fitted(self.capture, target, fitted.capture, report, fitted.record)
        tell(report)
        wrote(target, "body.npz, fit.npz and fit.json")
        suggest("humangs check", target)

    def _fit_to_masks(self) -> None:
        with stage("starting"):
            from humangs_jax.capture.fitting.files import check_place, write_fitted
            from humangs_jax.capture.fitting.silhouette_fit import (
                cameras_are_unseen,
                refine_capture,
                usual_config,
            )
            from humangs_jax.data.capture import load_capture
            from humangs_jax.data.hidden import with_hidden_parts

        target = check_place(self.capture, self.out, self.overwrite, (self.detections.keypoints,))
        tell_deleted(target, unless=target if self.out is None else self.capture)
        with stage("reading photos and keypoints"):
            start = with_hidden_parts(load_capture(self.capture, fit_masks=True))
            # without --keypoints those of an earlier fit
            keypoints, record = self.detections.read_or_recorded(self.capture, start)
        # cameras stay where nothing tells how they should move
        fixed = self.mask_fit.fixed_cameras or cameras_are_unseen(start)
        config = usual_config(
            record is not None,
            fixed_cameras=fixed,
            bare=self.mask_fit.tight_clothes,
            calibrated=start.calibrated,
        )
        with stage("refining cameras and body"):
            refinement = refine_capture(start, keypoints=keypoints, config=config)
        tell(refinement.report)
        # a result that is no better is not written
        if not refinement.report.kept:
            tell("nothing was written: refinement did not improve the capture")
            return
        with stage("writing"):
            write_fitted(self.capture, target, refinement.capture, refinement.report, record)
        wrote(target, "refined cameras and body")
        suggest("humangs check", target)


_DEFAULT_SHEET = Path("check.png")
"""File that `humangs check` writes by default."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Draw the body over each photo, and name what looks wrong.

    For a capture of `humangs fit`, also draw its keypoints, and say how far off the body is and
    what the views do not determine.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs check me --out check.png",
        "humangs check me --keypoints keypoints.json",
    )
    capture: Positional[Path]
    """Folder with capture.json."""
    detections: OmitArgPrefixes[Detections]
    out: Annotated[Path, OutputPath((".png",))] = _DEFAULT_SHEET
    """The contact sheet to write, .png. The sheet of keypoints is NAME_fit.png beside it."""

    def run(self) -> None:
        sheet = self.out.with_name(f"{self.out.stem}_fit{self.out.suffix}")
        require_file(sheet, (".png",))
        with stage("starting"):
            from humangs_jax.apps.check import check_capture
            from humangs_jax.io.atomic import check_ours
            from humangs_jax.io.images import is_own_output

            # files that nobody named must not replace those of others
            unasked = [sheet]
            if self.out == _DEFAULT_SHEET:
                unasked.append(self.out)
            check_ours(unasked, is_own_output, "choose another name by --out, or move it away")
            from humangs_jax.capture.detection.people import available
            from humangs_jax.capture.fitting.files import UnknownViewError
            from humangs_jax.data.capture import load_capture
            from humangs_jax.data.hidden import with_hidden_parts

        with stage("reading the capture"):
            capture = with_hidden_parts(load_capture(self.capture, fit_masks=True))
            try:
                keypoints, record = self.detections.read_or_recorded(self.capture, capture)
            # an older fit may be of other photos
            except UnknownViewError as error:
                warn(f"{error}; the check does without that fit")
                keypoints, record = None, None
        # the detector finds what the capture lacks
        if available() and (capture.masks is None or keypoints is None):
            capture, keypoints = self._found(capture, keypoints)
        with stage("drawing the body"):
            report = check_capture(capture, self.out, keypoints)
        tell(report)
        wrote(self.out, "the body over the photos")
        ok = report.ok
        # a second sheet shows the keypoints
        if keypoints is not None:
            with stage("examining the fit"):
                from humangs_jax.apps.check import fit_sheet
                from humangs_jax.capture.fitting.fit_capture import examine

                examination = examine(capture, keypoints, record)
                fit_sheet(capture, keypoints, examination, sheet)
            tell(f"\n{examination.report}")
            wrote(sheet, "the keypoints over the photos")
            ok = ok and examination.report.ok
        if ok:
            suggest("humangs reconstruct", self.capture, "--out avatar.npz")

    def _found(self, capture: Any, keypoints: Any) -> tuple[Any, Any]:
        """Finds missing masks and keypoints in the photos. Returns the capture with masks, and the
        keypoints.

        No file is written, except the sheet of people if it is unclear who is meant.
        """
        import numpy as np

        from humangs_jax.apps import detect
        from humangs_jax.data.photos import capture_folder

        folder = capture_folder(self.capture)
        try:
            with stage("finding the person"):
                people, person = detect.person_in_capture(
                    folder, capture, keypoints, self.detections.person
                )
        except ValueError as error:
            warn(f"{error}; the check does without what it would have found")
            return capture, keypoints
        tell_found(people, person)
        if capture.masks is None:
            masks = np.stack([detect.person_mask(photo, person) for photo in people])
            capture = dataclasses.replace(capture, masks=masks)
        return capture, detect.keypoints_of(people, person) if keypoints is None else keypoints
