"""`humangs start`: from a folder of photos to an avatar in the browser."""

import dataclasses
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import Positional, arg

from humangs_jax.cli.captures import keypoints_of, tell_found
from humangs_jax.cli.options import (
    ITERATIONS_ALONE,
    UsageError,
    first_refinement,
    off,
    require_replaceable,
    tell_deleted,
)
from humangs_jax.cli.screen import stage, suggest, tell, warn, wrote
from humangs_jax.core.configuration import Range, at_least
from humangs_jax.data.formats import CAMERAS, KEYPOINTS, START_MARK

if TYPE_CHECKING:
    from humangs_jax.apps.start import HeldOut, Material
    from humangs_jax.capture.calibration.importing import ImportReport
    from humangs_jax.capture.fitting.files import FitRecord
    from humangs_jax.capture.fitting.refine import RefinedCapture
    from humangs_jax.data.capture import Capture
    from humangs_jax.data.prepared import PreparedCapture
    from humangs_jax.network.config import HumanGSConfig

MARK = START_MARK
"""File in a capture folder that `humangs start` imported: a later run may replace it until it has a
body, and go on from there.
"""


IGNORE = Path("ignore")
"""As --cameras: the calibration in the folder of photos is not used."""


@dataclasses.dataclass(frozen=True)
class Start:
    """From photos or a video of a person to an avatar in the browser.

    Cameras, masks and keypoints are used where they are there, and estimated where they are not.
    Run it again when something was added. docs: your_photos.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs start photos --out me --height 1.78",
        "humangs start photos --cameras calibration.json --out me",
    )
    photos: Positional[Path]
    """Folder of photos, perhaps with cameras, masks and keypoints in it.

    Or a video: its best frames become OUT_photos.
    """
    out: Path
    """The capture folder to write, with avatar.npz, avatar.html and check.png in it."""
    cameras: Annotated[
        Path | None,
        arg(
            help=f"Calibration, if it is elsewhere: {CAMERAS.listed()}. Or ignore: use none of"
            " those in the folder, and find the cameras from the person."
        ),
    ] = None
    masks: Path | None = None
    """Folder of the masks, if it is elsewhere."""
    others: Path | None = None
    """Folder of masks of other people and of things in front of the person, if it is elsewhere.

    Nothing is concluded from these pixels.
    """
    keypoints: Annotated[
        Path | None, arg(help=f"Keypoints, if they are elsewhere: {KEYPOINTS.listed()}.")
    ] = None
    person: Annotated[int | None, at_least(0)] = None
    """Which person of the keypoint file, from 0, if a view has several; without such a file, of
    those on people.png.
    """
    height: Annotated[float | None, Range(0.3, 3)] = None
    """Height of the person without shoes, metres: the scale where there is no calibration.

    Default: an average person's.
    """
    scale: float | None = None
    """Metres per unit of the calibration. Default: 1."""
    up: str | None = None
    """Axis of the calibration's world that points up, like --up=+z or --up=-y.

    Default: the format's.
    """
    without_masks: bool = False
    """Use no masks: the photos have nothing but white behind the person."""
    fit_masks: Annotated[
        bool, off("move masks that are too large or too small to the edges in the photos")
    ] = True
    """Move masks that are too large or too small to the edges in the photos."""
    refine: str | None = None
    """Fit the avatar to the photos for so long: 15s (or 15), 100steps, or 0.

    Default, with masks: iterations and the head.
    """
    browser: Annotated[bool, off("open the page at the end")] = True
    """Open the page at the end."""
    overwrite: bool = False
    """Start again, also where --out already has a body or a finished avatar."""

    def run(self) -> None:
        limits = first_refinement(self.refine)
        if self.refine not in (None, "0") and self.without_masks:
            raise UsageError("--refine needs masks: leave out --without-masks")
        if self.masks is not None and self.without_masks:
            raise UsageError(f"--masks {self.masks}: does not go with --without-masks")
        self._resumes()  # what is wrong with --out is reported before the work
        with stage("starting"):
            from humangs_jax.apps.start import look
            from humangs_jax.io.atomic import only_writer
            from humangs_jax.io.decoded import decoded_once

        ignored = self.cameras == IGNORE
        material = look(
            self._photos(),
            cameras=None if ignored else self.cameras,
            masks=self.masks,
            keypoints=self.keypoints,
            others=self.others,
        )
        if ignored:
            material = dataclasses.replace(material, cameras=None)
        if self.without_masks:
            material = dataclasses.replace(material, masks=None)
        self._check_lengths(material)
        tell(material)
        with only_writer(self.out, replaced=True), decoded_once():
            self._go_on(material, limits)

    def _check_lengths(self, material: "Material") -> None:
        """Raises: UsageError for an option that sets a scale or a direction which something else
        sets.
        """
        if material.cameras is not None and self.height is not None:
            raise UsageError(
                "--height: is for photos without cameras: the calibration has a scale (--scale)"
            )
        if material.cameras is None:
            for option, value in (("--scale", self.scale), ("--up", self.up)):
                if value is not None:
                    raise UsageError(
                        f"{option}: is for a calibration, and there is none (--height sets the"
                        " scale)"
                    )

    def _mark(self, **more: Any) -> dict[str, dict[str, Any]]:
        """The file that says which run made the folder: its photos, and the options that a later
        run has to repeat.
        """
        return {MARK: {"photos": str(self.photos.resolve()), "options": self._decisive(), **more}}

    def _decisive(self) -> dict[str, Any]:
        """Options that decide what the body is, as plain values."""
        names = (
            "cameras",
            "masks",
            "others",
            "keypoints",
            "person",
            "height",
            "scale",
            "up",
            "without_masks",
            "fit_masks",
        )
        values = {name: getattr(self, name) for name in names}
        return {
            name: str(value.resolve()) if isinstance(value, Path) else value
            for name, value in values.items()
        }

    def _check_same_options(self, mark: Any) -> None:
        """Raises: UsageError if the body of the earlier run was made with other options than this
        run has.
        """
        earlier = None
        if isinstance(mark, dict):
            earlier = mark.get("options")
        if not isinstance(earlier, dict):  # of a version that did not record them
            return
        for name, value in self._decisive().items():
            if name in earlier and earlier[name] != value:
                option, before = f"--{name.replace('_', '-')}", earlier[name]
                how = "without it" if before is None else f"with {before}"
                raise UsageError(
                    f"{option}: the body in {self.out} was made {how}: --overwrite begins anew"
                )

    def _go_on(self, material: "Material", limits: dict[str, Any] | None) -> None:
        """From where an earlier run came to an end, if there was one."""
        from humangs_jax.apps.start import missing
        from humangs_jax.capture.detection.people import available
        from humangs_jax.io.reading import read_json

        # a body that is there is used again
        if self._resumes():
            mark = read_json(self.out / MARK)
            self._check_same_options(mark)
            with stage("reading the fit of an earlier run"):
                from humangs_jax.data.capture import load_capture
                from humangs_jax.data.hidden import with_hidden_parts

                capture = with_hidden_parts(load_capture(self.out, fit_masks=self.fit_masks))
            tell(f"{self.out} has a body: going on from there (--overwrite begins anew)")
            self._finish(capture, None, limits)
            return
        if self.overwrite:
            tell_deleted(self.out)
        # without cameras the person gives them
        if material.cameras is None and available():
            self._from_photos_alone(material, limits)
            return
        # with cameras: import them, and name what is still to be made
        report = None
        if material.cameras is not None:
            report = self._import(material)
        changed = report is not None and (report.undistorted or report.turned or report.heic)
        masked = self.without_masks or (report is not None and report.masks)
        needed = missing(material, self.out / "images" if changed else None)
        needed = [each for each in needed if not (masked and each.name == "masks")]
        # what the detector finds is not asked for
        detected = [
            each.name for each in needed if each.name in ("masks", "keypoints") and available()
        ]
        needed = [each for each in needed if each.name not in detected]
        if needed:
            tell("\nto be made:\n" + "\n".join(map(str, needed)))
            if detected:
                tell(f"{' and '.join(detected)}: found in the photos, once the rest is there")
            suggest("humangs start", self.photos, "--out", self.out)
            names = " and ".join(", ".join(each.name for each in needed).rsplit(", ", 1))
            raise ValueError(
                f"{self.photos}: {names} missing: make them as above and run the same command again"
            )
        if detected:
            material = self._detect(material, detected)
        self._finish(*self._fit(material), limits)

    def _from_photos_alone(self, material: "Material", limits: dict[str, Any] | None) -> None:
        with stage("finding the person and the cameras"):
            from humangs_jax.apps.detect import SHEET_FILE
            from humangs_jax.apps.photos_alone import import_photos

            given = (material.keypoints, material.masks, material.alpha, material.others)
            own_masks = not (self.without_masks or material.alpha or material.masks)
            found = import_photos(
                material.images,
                self.out,
                person=self.person,
                height=self.height,
                keypoints=material.keypoints,
                masks=material.masks,
                others=material.others,
                own_masks=own_masks,
                reduce=not any(given),
                also=self._mark(),
            )
        tell("\n".join(found.lines))
        tell_found(found.people, found.person)
        for warning in found.warnings:
            warn(warning)
        wrote(self.out / SHEET_FILE, "who was found in the photos")
        material = self._with_found(material, own_masks)
        self._finish(*self._fit(material), limits)

    def _detect(self, material: "Material", wanted: list[str]) -> "Material":
        with stage("finding the person"):
            from humangs_jax.apps import detect
            from humangs_jax.data.photos import load_photos

            photos = load_photos(self.out)
            given = keypoints_of(photos, material.keypoints, self.person)
            people, person = detect.person_in_capture(self.out, photos, given, self.person)
        with stage("writing what was found"):
            detect.write_found(self.out, people, person, masks="masks" in wanted, to_capture=True)
        tell_found(people, person)
        tell(
            f"{' and '.join(wanted)} found in the photos: {self.out / detect.SHEET_FILE} shows them"
        )
        return self._with_found(material, "masks" in wanted)

    def _with_found(self, material: "Material", masks: bool) -> "Material":
        """The material with what was found in the photos: keypoints where there are none, and
        perhaps masks.
        """
        from humangs_jax.apps.detect import KEYPOINTS_FILE, MASKS

        keypoints = material.keypoints or self.out / KEYPOINTS_FILE
        if masks:
            material = dataclasses.replace(material, masks=self.out / MASKS)
        return dataclasses.replace(material, keypoints=keypoints)

    def _photos(self) -> Path:
        """The folder of photos; that of a video is beside --out."""
        from humangs_jax.apps.video_photos import photos_of_video, video_of

        video = video_of(self.photos)
        if video is None:
            return self.photos
        out = self.out if self.out.name not in ("", "..") else self.out.resolve()
        with stage("choosing frames of the video"):
            folder = out.with_name(f"{out.name}_photos")
            told = photos_of_video(video, folder)
        tell(told)
        return folder

    def _resumes(self) -> bool:
        """Whether an earlier run left a body to go on from.

        Raises: UsageError if --out may not be replaced.
        """
        ours = (self.out / MARK).is_file()
        begun = ours and not (self.out / "body.npz").exists()
        finished = begun or self.overwrite or (self.out / "avatar.html").exists()
        fitted = ours and (self.out / "fit.json").exists() and not finished
        cameras = None if self.cameras == IGNORE else self.cameras
        inputs = (self.photos, cameras, self.masks, self.others, self.keypoints)
        require_replaceable(self.out, self.overwrite or begun or fitted, "capture.json", inputs)
        return fitted

    def _finish(
        self, capture: "Capture", estimate: "HeldOut | None", limits: dict[str, Any] | None
    ) -> None:
        from humangs_jax.io.decoded import forget_decoded

        forget_decoded()  # the capture has the photos
        with stage("preparing the photos"):
            from humangs_jax.apps.start import photos_to_read
            from humangs_jax.data.capture_checks import CaptureError
            from humangs_jax.data.prepared import prepare_capture
            from humangs_jax.network.weights import load_weights

            weights = load_weights()
            try:
                photos = prepare_capture(capture)
            except CaptureError:  # no view shows the person: the sheet shows why
                self._check(capture)
                raise
            read = prepare_capture(photos_to_read(photos), weights[1])
        self._check(read)
        self._reconstruct(weights, photos, read, None if limits is None else estimate, limits)

    def _import(self, material: "Material") -> "ImportReport":
        with stage("importing photos and cameras"):
            from humangs_jax.capture.calibration.importing import import_cameras

            assert material.cameras is not None
            report = import_cameras(
                material.cameras,
                material.images,
                self.out,
                masks=material.masks,
                others=material.others,
                scale=self.scale,
                up=self.up,
                overwrite=True,
                also=self._mark(),
            )
        # the folder scan has named these files already
        told = {each.path for each in material.unused}
        tell(
            dataclasses.replace(
                report, unused=tuple(each for each in report.unused if each.path not in told)
            )
        )
        # keypoints of the photos before the import do not fit those after it
        if report.undistorted and material.keypoints is not None:
            warn(
                f"lens distortion was removed: {material.keypoints} should be of the photos in"
                f" {self.out / 'images'}"
            )
        if report.turned and material.keypoints is not None:
            warn(
                f"photos were turned upright: {material.keypoints} should be of those in"
                f" {self.out / 'images'}"
            )
        return report

    def _fit(self, material: "Material") -> "tuple[Capture, HeldOut | None]":
        with stage("fitting the body"):
            from humangs_jax.apps.detect import MASKS
            from humangs_jax.apps.start import better_body
            from humangs_jax.body.library import load_body
            from humangs_jax.capture.fitting.contradiction import find_contradiction
            from humangs_jax.capture.fitting.files import write_fitted
            from humangs_jax.capture.fitting.fit_capture import fit_photos
            from humangs_jax.capture.fitting.refine import (
                cameras_are_unseen,
                refine_capture,
                usual_config,
            )
            from humangs_jax.data.hidden import with_hidden_parts
            from humangs_jax.data.photos import load_photos
            from humangs_jax.network.weights import load_weights
            from humangs_jax.refinement.config import RefineConfig

            assert material.keypoints is not None
            # the detector's own masks are at the photos' edges already
            photos = load_photos(
                self.out, fit_masks=self.fit_masks and material.masks != self.out / MASKS
            )
            found_here = material.keypoints.parent == self.out  # of the one person who was chosen
            keypoints = keypoints_of(
                photos, material.keypoints, None if found_here else self.person
            )
            against = None
            if photos.calibrated:
                against = find_contradiction(photos, keypoints)
            if against:
                raise ValueError(
                    f"{material.cameras}: {against}: correct it, or go on without it by"
                    " --cameras ignore"
                )
            fitted = fit_photos(photos, keypoints, load_body())
        with stage("examining the fit"):
            report = fitted.report
            report = dataclasses.replace(report, warnings=(*report.warnings, *keypoints.warnings))
        tell(f"\n{report}")
        capture, record, estimate = fitted.capture, fitted.record, None
        if capture.masks is not None and (capture.masks > 0.5).any():
            with stage("refining the body by the masks"):
                # calibrated ones move where the keypoints have shown that they are off
                if capture.calibrated:
                    fixed = not fitted.camera_errors
                else:
                    fixed = cameras_are_unseen(capture)
                bodies = [
                    refine_capture(
                        capture,
                        keypoints=record.keypoints,
                        config=usual_config(
                            fitted=True,
                            fixed_cameras=fixed,
                            tight=tight,
                            calibrated=capture.calibrated,
                        ),
                    )
                    for tight in (False, True)
                ]
            bodies, record = self._with_own_poses(material.folder, bodies, record)
            with stage("comparing bodies by a held-out photo"):
                weights, iterations = load_weights(), RefineConfig(**ITERATIONS_ALONE)
                loose, tight = bodies
                capture, estimate = better_body(*weights, loose.capture, tight.capture, iterations)
            report = (tight if capture is tight.capture else loose).report
            tell(f"\n{report}")
        if self.height is not None:
            from humangs_jax.capture.fitting.person_cameras import scaled_to_height

            capture = scaled_to_height(capture, self.height)
        write_fitted(self.out, self.out, capture, report, record)
        # the refined body shows more exactly where something is in front of it
        return with_hidden_parts(capture), estimate

    def _with_own_poses(
        self, photos: Path, bodies: "list[RefinedCapture]", record: "FitRecord"
    ) -> "tuple[list[RefinedCapture], FitRecord]":
        """Bodies with a pose for each photo, and the record of the fit to match, if photos that
        share a pose show that the person moved between them; else what was given.
        """
        first = bodies[0].capture
        if first.frame_count > 1 or first.view_count < 2:
            return bodies, record
        with stage("looking for movement between the photos"):
            from humangs_jax.apps.video_photos import seconds_of_photos
            from humangs_jax.capture.fitting.own_poses import (
                find_movement,
                fit_own_poses,
                movement_line,
                record_of_photos,
            )

            seconds = seconds_of_photos(photos, first.names)
            if not find_movement(first, record.keypoints, seconds).shown:
                return bodies, record
        with stage("fitting a pose for each photo"):
            moved = [fit_own_poses(each.capture, record.keypoints, seconds) for each in bodies]
        tell(movement_line(moved[0].capture))
        return moved, record_of_photos(record, first.frames)

    def _check(self, capture: "Capture | PreparedCapture") -> None:
        with stage("checking"):
            from humangs_jax.apps.check import check_capture

            report = check_capture(capture, self.out / "check.png")
        tell(f"\n{report}")
        wrote(self.out / "check.png", "the body over the photos: look at it")

    def _reconstruct(
        self,
        weights: "tuple[Any, HumanGSConfig]",
        photos: "PreparedCapture",
        read: "PreparedCapture",
        estimate: "HeldOut | None",
        limits: dict[str, Any] | None,
    ) -> None:
        """Make, refine and write the avatar. photos: all that show the person. read: those that the
        network reads.
        """
        with stage("reconstructing"):
            from humangs_jax.avatar.reconstruct import reconstruct
            from humangs_jax.avatar.unseen import guess_line
            from humangs_jax.viewer.page import write_page

            avatar = reconstruct(*weights, read)
        # refinement compares with masks, and is left out without them
        if limits is not None and photos.capture.masks is not None:
            with stage("refining"):
                from humangs_jax.refinement.config import RefineConfig
                from humangs_jax.refinement.refine import refine_with_report

                refinement = refine_with_report(
                    avatar, photos, RefineConfig(**limits), progress=True
                )
                avatar = refinement.avatar
            tell(refinement.summary())
            if refinement.interrupted:
                raise KeyboardInterrupt
        # the number tells a user what to expect of views that no photo shows
        if estimate is None:
            with stage("holding one photo out"):
                from humangs_jax.apps.start import held_out_psnr
                from humangs_jax.refinement.config import RefineConfig

                estimate = held_out_psnr(
                    *weights, photos, None if limits is None else RefineConfig(**ITERATIONS_ALONE)
                )
        if estimate is not None:
            tell(estimate)
        # name the parts that no photo shows
        guess = guess_line(photos.capture)
        if guess is not None:
            tell(guess)
        with stage("writing the page"):
            avatar.save(self.out / "avatar.npz")
            page = self.out / "avatar.html"
            write_page(page, avatar, title=self.photos.resolve().name)
        wrote(
            self.out / "avatar.npz",
            f"{len(avatar.gaussians.means):,} Gaussians from {photos.capture.view_count} photos",
        )
        wrote(page, "the avatar in a browser")
        if self.browser:
            webbrowser.open(page.resolve().as_uri())
        suggest("humangs animate", self.out / "avatar.npz", "--motion FILE --out video.mp4")
