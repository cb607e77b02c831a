"""Makes an avatar from a folder of photos or from a video. Cameras, masks and keypoints are used if
the folder has them. Those that are missing are found in the photos, which needs LiteRT. This is
what `humangs start` does, as a function.
"""

import dataclasses
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

from humangs_jax.apps import detect, photos_alone
from humangs_jax.apps import start as material_of
from humangs_jax.apps.ahead import calls_after_fit, calls_of_found_people, shipped_weights
from humangs_jax.apps.check import check_capture
from humangs_jax.apps.start import HeldOut, PhotoFolder, held_out_psnr, missing, photos_to_read
from humangs_jax.apps.video_photos import photos_of_video, seconds_of_photos, video_of
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.unseen import guess_line
from humangs_jax.body.library import load_body
from humangs_jax.capture.calibration.importing import ImportReport, import_cameras
from humangs_jax.capture.detection import people as detection
from humangs_jax.capture.fitting.contradiction import find_contradiction
from humangs_jax.capture.fitting.files import FitRecord, write_fitted
from humangs_jax.capture.fitting.fit_capture import FittedCapture, fit_photos
from humangs_jax.capture.fitting.own_poses import (
    find_movement,
    fit_own_poses,
    movement_line,
    record_of_photos,
)
from humangs_jax.capture.fitting.person_cameras import scaled_to_height
from humangs_jax.capture.fitting.silhouette_fit import (
    RefinedCapture,
    cameras_are_unseen,
    refine_capture,
    usual_config,
)
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.processes import Ahead
from humangs_jax.core.progress import stage
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.formats import START_MARK
from humangs_jax.data.hidden import with_hidden_parts
from humangs_jax.data.photos import Photos, load_photos
from humangs_jax.data.prepared import PreparedCapture, prepare_capture
from humangs_jax.io.atomic import (
    check_replaceable,
    check_writable,
    contents,
    only_writer,
    remove_abandoned_lock,
)
from humangs_jax.io.decoded import decoded_once, forget_decoded
from humangs_jax.io.reading import read_json
from humangs_jax.refinement.config import ITERATIONS_ALONE, RefineConfig
from humangs_jax.refinement.refine import refine_with_report
from humangs_jax.viewer.page import write_page

_IGNORE = "ignore"
"""Value of the argument `cameras` that ignores the calibration in the folder of photos."""
BEGIN_ANEW = "--overwrite (in Python overwrite=True) begins anew"
"""Advice where the body of an earlier run is in the way."""


class MissingError(ValueError):
    """Something that an avatar needs is missing. The steps yielded before say how to make it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """Something that `avatar_from_photos` has found or made. `humangs start` shows it as
    `str(step)`.
    """

    text: str
    """The message, in one line or several."""
    file: Path | None = None
    """The file that was written; None if none was."""
    warning: bool = False
    """Whether something looks wrong."""
    photos: PreparedCapture | None = None
    """The prepared photos, whose `capture` has the fitted body; None in steps before the avatar is
    made.
    """
    avatar: Avatar | None = None
    """The finished avatar, in the last step; None before."""

    def __str__(self) -> str:
        """Returns "warning: TEXT" for a warning, "FILE: TEXT" if a file was written, else the text
        alone.
        """
        if self.warning:
            return f"warning: {self.text}"
        if self.file is None:
            return self.text
        return f"{self.file}: {self.text}"


@dataclasses.dataclass(frozen=True)
class Known:
    """What is known about the photos of a capture when the body is fitted to them."""

    folder: Path
    """Folder from which the photos were imported."""
    cameras: Path | None
    """The calibration; None: the cameras were found from the person."""
    keypoints: Path
    """File or folder of the keypoints."""
    keypoints_by_detector: bool
    """Whether the detector of this package found the keypoints. Then they are only those of the
    chosen person.
    """
    masks_by_detector: bool
    """Whether the detector of this package found the masks. Then they follow the edges in the
    photos already.
    """


def avatar_from_photos(
    photos: str | Path,
    out: str | Path,
    *,
    cameras: str | Path | None = None,
    masks: str | Path | None = None,
    others: str | Path | None = None,
    keypoints: str | Path | None = None,
    person: int | None = None,
    height: float | None = None,
    scale: float | None = None,
    up: str | None = None,
    without_masks: bool = False,
    fit_masks: bool = True,
    refinement: RefineConfig | None = ITERATIONS_ALONE,
    overwrite: bool = False,
) -> Iterator[Step]:
    """Makes an avatar from photos or a video of a person, step by step, as `humangs start` does.

    Files are written into `out`: the capture with its body, check.png, avatar.npz and avatar.html.
    A call that was interrupted can be repeated. It goes on from the fitted body if the interrupted
    call left one in `out`.

    Args:
        photos: folder of photos, which may also have cameras, masks and keypoints. Or a video, or a
            folder with one video: its best frames are written into a folder beside `out`.
        out: the capture folder to write.
        cameras: file or folder of the calibration, if it is not in `photos`. "ignore": the
            calibration in `photos` is ignored, and the cameras are found from the person.
        masks: folder of the masks, if it is not in `photos`.
        others: folder of masks of what is in front of the person, if it is not in `photos`.
        keypoints: file or folder of keypoints, if it is not in `photos`.
        person: number of the person, if several people are in the photos. It is the number in the
            file of keypoints, or on people.png if there is no such file.
        height: height of the person, metres. It gives the scale if there is no calibration. None:
            the height of an average person.
        scale: metres per unit of the calibration. None: see `import_cameras`.
        up: axis of the calibration's world that points up, such as "+z". None: the axis that the
            calibration's format defines.
        without_masks: whether masks are not used, because there is only white behind the person.
        fit_masks: whether the boundaries of masks are moved to the edges in the photos.
        refinement: how the avatar is refined. None: not at all.
        overwrite: whether to begin anew even if `out` has a body or an avatar.

    Yields:
        What was found and made, one step after the other. The last step has the avatar.

    Raises:
        ValueError: if something is missing or wrong. The message is one line that names the file or
            the argument.
        OSError: if another process writes `out`, or if a file cannot be written.
        KeyboardInterrupt: if refinement was interrupted.

    Examples:
        >>> *steps, last = hg.avatar_from_photos("photos", "me", height=1.78)
        >>> hg.show(last.avatar)
    """

    def as_path(value):
        """Returns the value as a path; None for None."""
        return None if value is None else Path(value)

    # the parts of the work are methods, which share these arguments
    run = FromPhotos(
        photos=Path(photos),
        out=Path(out),
        cameras=as_path(cameras),
        masks=as_path(masks),
        others=as_path(others),
        keypoints=as_path(keypoints),
        person=person,
        height=height,
        scale=scale,
        up=up,
        without_masks=without_masks,
        fit_masks=fit_masks,
        refinement=refinement,
        overwrite=overwrite,
    )
    yield from run.steps()


@dataclasses.dataclass(frozen=True)
class FromPhotos:
    """The arguments of `avatar_from_photos`. Its methods are the parts of the work, and most of
    them yield what they have found.
    """

    photos: Path
    """Folder of photos, or a video."""
    out: Path
    """The capture folder to write."""
    cameras: Path | None = None
    """File or folder of the calibration. None: the calibration in the folder of photos, if there is
    one. `_IGNORE`: no calibration is used.
    """
    masks: Path | None = None
    """Folder of masks. None: the masks in the folder of photos, if there are any."""
    others: Path | None = None
    """Folder of masks of what is in front of the person. None: such masks in the folder of photos,
    if there are any.
    """
    keypoints: Path | None = None
    """File or folder of keypoints. None: the keypoints in the folder of photos, if there are
    any.
    """
    person: int | None = None
    """Number of the person, if there are several. None: the only one, or the only large one."""
    height: float | None = None
    """Height of the person, metres, if there is no calibration. None: an average person's."""
    scale: float | None = None
    """Metres per unit of the calibration. None: see `import_cameras`."""
    up: str | None = None
    """The axis of the calibration's world that points up. None: the axis that the calibration's
    format defines.
    """
    without_masks: bool = False
    """Whether masks are ignored, because there is only white behind the person."""
    fit_masks: bool = True
    """Whether the boundaries of masks are moved to the edges in the photos."""
    refinement: RefineConfig | None = ITERATIONS_ALONE
    """How the avatar is refined; None: not at all."""
    overwrite: bool = False
    """Whether to begin anew even if `out` has a body or an avatar."""

    def steps(self) -> Iterator[Step]:
        """Does all of the work, from the photos to the page, and yields the steps.

        Raises: as `avatar_from_photos`.
        """
        if self.masks is not None and self.without_masks:
            raise ArgumentError("masks", f"{self.masks}: does not go with without_masks")
        self.resumes()  # what is wrong with the folder is reported before the work
        folder = yield from self._folder()
        ignored = self.cameras == Path(_IGNORE)
        material = material_of.inspect_folder(
            folder,
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
        yield Step(str(material))
        with only_writer(self.out, replaced=True), decoded_once(), Ahead() as ahead:
            yield from self._go_on(material, ahead)

    def _check_lengths(self, material: PhotoFolder) -> None:
        """Checks that the options for size and up axis suit the photos.

        Raises: ArgumentError for a height if there is a calibration, or for a scale or an up axis
        if there is none.
        """
        if material.cameras is not None and self.height is not None:
            raise ArgumentError(
                "height", ": is for photos without cameras: the calibration has a scale"
            )
        if material.cameras is None:
            for argument, value in (("scale", self.scale), ("up", self.up)):
                if value is not None:
                    problem = ": is for a calibration, and there is none (a height sets the scale)"
                    raise ArgumentError(argument, problem)

    def mark(self, **more: Any) -> dict[str, dict[str, Any]]:
        """Returns the name and the content of the file that marks a folder as made by a run. The
        content has the path of the photos, and the options that a later run has to repeat. more:
        further entries.
        """
        return {
            START_MARK: {"photos": str(self.photos.resolve()), "options": self._decisive(), **more}
        }

    def _decisive(self) -> dict[str, Any]:
        """Returns the options on which the body depends, as plain values."""
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
        """Checks that an earlier run made its body with the same options. mark: content of its file
        `START_MARK`.

        Raises: ArgumentError for the first option that differs.
        """
        earlier = None
        if isinstance(mark, dict):
            earlier = mark.get("options")
        if not isinstance(earlier, dict):  # of a version that did not record them
            return
        for name, value in self._decisive().items():
            if name in earlier and earlier[name] != value:
                how = "without it" if earlier[name] is None else f"with {earlier[name]}"
                problem = f": the body in {self.out} was made {how}: {BEGIN_ANEW}"
                raise ArgumentError(name, problem)

    def _go_on(self, material: PhotoFolder, ahead: Ahead) -> Iterator[Step]:
        """Fits the body and makes the avatar. Uses the body of an earlier run if there is one."""
        # a body that is there is used again
        if self.resumes():
            self._check_same_options(read_json(self.out / START_MARK))
            with stage("reading the fit of an earlier run"):
                capture = with_hidden_parts(load_capture(self.out, fit_masks=self.fit_masks))
            yield Step(f"{self.out} has a body: going on from there ({BEGIN_ANEW})")
            yield from self._finish(capture, None)
            return
        if self.overwrite:
            deleted = contents(self.out)
            if deleted:
                replaced = f"once the work is done, {self.out} is replaced"
                yield Step(f"{replaced}; this is deleted: {deleted}")
        # without cameras the person gives them
        if material.cameras is None and detection.available():
            ahead.add(calls_of_found_people(material.photos))
            known = yield from self._photos_alone(material)
        else:
            known = yield from self._with_cameras(material)
        capture, estimate = yield from self._fit(known, ahead)
        yield from self._finish(capture, estimate)

    def _with_cameras(self, material: PhotoFolder) -> Generator[Step, None, Known]:
        """Imports photos and cameras, and finds missing keypoints and masks. If something else is
        missing, it yields how to make it.

        Raises: MissingError if something is missing that cannot be found in the photos.
        """
        photos, masked = None, self.without_masks
        if material.cameras is not None:
            report = yield from self._import(material)
            masked = masked or report.masks
            # keypoints have to be of the photos that the import wrote, where it changed them
            if report.undistorted or report.turned or report.heic:
                photos = self.out / "images"
        needed = [each for each in missing(material, photos) if each.name != "masks" or not masked]
        # what the detector finds is not asked for
        findable = ()
        if detection.available():
            findable = "masks", "keypoints"
        detected = [each.name for each in needed if each.name in findable]
        needed = [each for each in needed if each.name not in detected]
        if needed:
            yield Step("\nto be made:\n" + "\n".join(map(str, needed)))
            if detected:
                found = " and ".join(detected)
                yield Step(f"{found}: found in the photos, once the rest is there")
            names = " and ".join(", ".join(each.name for each in needed).rsplit(", ", 1))
            raise MissingError(
                f"{self.photos}: {names} missing: make them as above and run the same command again"
            )
        if detected:
            yield from self._detect(material, detected)
        return self._known(material, masks_by_detector="masks" in detected)

    def _photos_alone(self, material: PhotoFolder) -> Generator[Step, None, Known]:
        """Finds the person in the photos, and the cameras from the person. Writes the capture."""
        with stage("finding the person and the cameras"):
            given = (material.keypoints, material.masks, material.alpha, material.others)
            own_masks = not (self.without_masks or material.alpha or material.masks)
            found = photos_alone.import_photos(
                material.images,
                self.out,
                person=self.person,
                height=self.height,
                keypoints=material.keypoints,
                masks=material.masks,
                others=material.others,
                own_masks=own_masks,
                reduce=not any(given),
                also=self.mark(),
            )
        yield Step("\n".join(found.lines))
        for remark in (*detect.remarks(found.people, found.person), *found.warnings):
            yield Step(remark, warning=True)
        yield Step("who was found in the photos", file=self.out / detect.SHEET_FILE)
        return self._known(material, masks_by_detector=own_masks)

    def _detect(self, material: PhotoFolder, wanted: list[str]) -> Iterator[Step]:
        """Finds keypoints, masks or both in the photos of the capture, and writes them."""
        with stage("finding the person"):
            photos = load_photos(self.out)
            given = None
            if material.keypoints is not None:
                given = _keypoints(photos, material.keypoints, self.person)
            people, person = detect.person_in_capture(self.out, photos, given, self.person)
        with stage("writing what was found"):
            detect.write_found(self.out, people, person, masks="masks" in wanted, to_capture=True)
        for remark in detect.remarks(people, person):
            yield Step(remark, warning=True)
        sheet = self.out / detect.SHEET_FILE
        yield Step(f"{' and '.join(wanted)} found in the photos: {sheet} shows them")

    def _known(self, material: PhotoFolder, *, masks_by_detector: bool) -> Known:
        """Returns what the fit needs to know. If the folder has no keypoints, the keypoints are
        those that the detector has written.
        """
        return Known(
            folder=material.folder,
            cameras=material.cameras,
            keypoints=material.keypoints or self.out / detect.KEYPOINTS_FILE,
            keypoints_by_detector=material.keypoints is None,
            masks_by_detector=masks_by_detector,
        )

    def _folder(self) -> Generator[Step, None, Path]:
        """Returns the folder of photos. For a video, its best frames are written into a folder
        beside `out`.
        """
        video = video_of(self.photos)
        if video is None:
            return self.photos
        if self.out.name not in ("", ".."):
            out = self.out
        else:
            out = self.out.resolve()
        folder = out.with_name(f"{out.name}_photos")
        with stage("choosing frames of the video"):
            told = photos_of_video(video, folder)
        yield Step(str(told))
        return folder

    def resumes(self) -> bool:
        """Returns whether an earlier run left a body from which this one can go on.

        Raises: ArgumentError if `out` is a file, or a folder that cannot be written or may not be
        replaced.
        """
        ours = (self.out / START_MARK).is_file()
        begun = ours and not (self.out / "body.npz").exists()
        finished = begun or self.overwrite or (self.out / "avatar.html").exists()
        fitted = ours and (self.out / "fit.json").exists() and not finished
        cameras = None if self.cameras == Path(_IGNORE) else self.cameras
        inputs = (self.photos, cameras, self.masks, self.others, self.keypoints)
        replaced = self.overwrite or begun or fitted
        if self.out.exists() and not self.out.is_dir():
            raise ArgumentError("out", f"{self.out}: is a file: expected the name of a folder")
        try:
            check_writable(self.out)
            check_replaceable(self.out, replaced, "capture.json", inputs)
        except (OSError, ValueError) as error:
            remove_abandoned_lock(self.out)  # a killed run may have left it after its last file
            raise ArgumentError("out", str(error)) from error
        return fitted

    def _import(self, material: PhotoFolder) -> Generator[Step, None, ImportReport]:
        """Imports photos and cameras into the capture."""
        with stage("importing photos and cameras"):
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
                also=self.mark(),
            )
        # the folder scan has named these files already
        named = {each.path for each in material.unused}
        unused = tuple(each for each in report.unused if each.path not in named)
        yield Step(str(dataclasses.replace(report, unused=unused)))
        # keypoints of the photos before the import do not fit those after it
        images, keypoints = self.out / "images", material.keypoints
        if report.undistorted and keypoints is not None:
            should = f"{keypoints} should be of the photos in {images}"
            yield Step(f"lens distortion was removed: {should}", warning=True)
        if report.turned and keypoints is not None:
            should = f"{keypoints} should be of those in {images}"
            yield Step(f"photos were turned upright: {should}", warning=True)
        return report

    def _fit(
        self, known: Known, ahead: Ahead
    ) -> Generator[Step, None, tuple[Capture, HeldOut | None]]:
        """Fits the body to keypoints and masks, and writes it into the capture. Returns the
        capture, and how well its avatar reproduces a held-out photo; None if this was not measured.

        Raises: ArgumentError if the calibration contradicts the keypoints; as `load_photos`,
        `read_keypoints` and `fit_photos`; OSError if the fit cannot be written.
        """
        with stage("fitting the body"):
            fit_masks = self.fit_masks and not known.masks_by_detector
            photos = load_photos(self.out, fit_masks=fit_masks)
            person = None if known.keypoints_by_detector else self.person
            keypoints = _keypoints(photos, known.keypoints, person)
            against = None
            if photos.calibrated:
                against = find_contradiction(photos, keypoints)
            if against:
                raise ArgumentError(
                    "cameras",
                    f"{known.cameras}: {against}: correct it, or go on without it by {_IGNORE!r}",
                )
            if photos.masks is not None:
                ahead.add(calls_after_fit(photos, keypoints))
            fitted = fit_photos(photos, keypoints, load_body())
        with stage("examining the fit"):
            report = fitted.report
            report = dataclasses.replace(report, warnings=(*report.warnings, *keypoints.warnings))
        yield Step(f"\n{report}")
        capture, record, estimate = fitted.capture, fitted.record, None
        if capture.masks is not None and (capture.masks > 0.5).any():
            with stage("refining the body by the masks"):
                bodies = _bodies_to_masks(fitted)
            bodies, record = yield from self._with_own_poses(known.folder, bodies, record)
            with stage("comparing bodies by a held-out photo"):
                loose, tight = bodies
                capture, estimate = material_of.better_body(
                    *shipped_weights(), loose.capture, tight.capture, ITERATIONS_ALONE, ahead
                )
            report = (tight if capture is tight.capture else loose).report
            yield Step(f"\n{report}")
        if self.height is not None:
            capture = scaled_to_height(capture, self.height)
        write_fitted(self.out, self.out, capture, report, record)
        # the refined body shows more exactly where something is in front of it
        return with_hidden_parts(capture), estimate

    def _with_own_poses(
        self, photos: Path, bodies: list[RefinedCapture], record: FitRecord
    ) -> Generator[Step, None, tuple[list[RefinedCapture], FitRecord]]:
        """Fits a pose to each photo, if all photos share one pose but show that the person moved
        between them. Returns the new bodies and the record of their fit. If no poses are fitted, it
        returns `bodies` and `record`.

        Arguments: photos: folder from which the photos were imported, for their times. bodies: for
        loose and tight clothes.
        """
        first = bodies[0].capture
        if first.frame_count > 1 or first.view_count < 2:
            return bodies, record
        with stage("looking for movement between the photos"):
            seconds = seconds_of_photos(photos, first.names)
            if not find_movement(first, record.keypoints, seconds).shown:
                return bodies, record
        with stage("fitting a pose for each photo"):
            moved = [fit_own_poses(each.capture, record.keypoints, seconds) for each in bodies]
        yield Step(movement_line(moved[0].capture))
        return moved, record_of_photos(record, first.frames)

    def _finish(self, capture: Capture, estimate: HeldOut | None) -> Iterator[Step]:
        """Checks the capture, then makes, refines and writes the avatar. estimate: how well a
        refined avatar of this body reproduces a held-out photo. It is measured here if it is None,
        or if the avatar is not refined.

        Raises: CaptureError if no photo shows the person; KeyboardInterrupt if refinement was
        interrupted.
        """
        forget_decoded()  # the capture has the photos
        with stage("preparing the photos"):
            weights = shipped_weights()
            nobody, photos = None, None
            try:
                photos = prepare_capture(capture)
            except CaptureError as error:
                nobody = error
        # where no view shows the person, the sheet shows why
        if photos is None:
            yield from self._check(capture)
            assert nobody is not None
            raise nobody
        with stage("preparing the body"):
            read = prepare_capture(photos_to_read(photos), weights[1])
        yield from self._check(read)
        with stage("reconstructing"):
            avatar = reconstruct(*weights, read)
        # refinement compares with masks, and is left out without them
        if self.refinement is not None and photos.capture.masks is not None:
            with stage("refining"):
                refined = refine_with_report(avatar, photos, self.refinement, progress=True)
                avatar = refined.avatar
            yield Step(refined.summary(), photos=photos)
            if refined.interrupted:
                raise KeyboardInterrupt
        # the number tells a user what to expect of views that no photo shows
        alike = self.refinement is not None
        if estimate is None or not alike:
            with stage("holding one photo out"):
                how = ITERATIONS_ALONE if alike else None
                estimate = held_out_psnr(*weights, photos, how)
        if estimate is not None:
            yield Step(str(estimate), photos=photos)
        # name the parts that no photo shows
        guess = guess_line(photos.capture)
        if guess is not None:
            yield Step(guess, photos=photos)
        with stage("writing the page"):
            file, page = self.out / "avatar.npz", self.out / "avatar.html"
            avatar.save(file)
            write_page(page, avatar, title=self.photos.resolve().name)
        made = f"{len(avatar.gaussians.means):,} Gaussians from {photos.capture.view_count} photos"
        yield Step(made, file=file, photos=photos)
        yield Step("the avatar in a browser", file=page, photos=photos, avatar=avatar)

    def _check(self, capture: Capture | PreparedCapture) -> Iterator[Step]:
        """Draws the body over the photos, and yields how well body and photos agree."""
        with stage("checking"):
            report = check_capture(capture, self.out / "check.png")
        yield Step(f"\n{report}")
        yield Step("the body over the photos: look at it", file=self.out / "check.png")


def _bodies_to_masks(fitted: FittedCapture) -> list[RefinedCapture]:
    """Returns two refinements of the fitted body by the masks, each made from the fitted capture:
    one for loose clothes and one for tight clothes, in this order.
    """
    capture = fitted.capture
    # calibrated cameras move where the keypoints have shown that they are off
    if capture.calibrated:
        fixed = not fitted.camera_errors
    else:
        fixed = cameras_are_unseen(capture)
    found = []
    for tight in (False, True):
        config = usual_config(
            fitted=True, fixed_cameras=fixed, tight=tight, calibrated=capture.calibrated
        )
        found.append(refine_capture(capture, keypoints=fitted.record.keypoints, config=config))
    return found


def _keypoints(photos: Photos, file: Path, person: int | None) -> Keypoints:
    """Reads the keypoints of photos. person: number of the person, if the file has several."""
    height, width = photos.images.shape[1:3]
    return read_keypoints(file, photos.names, width, height, person=person)
