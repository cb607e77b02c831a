"""`humangs start`: makes an avatar from a folder of photos and shows it in the browser."""

import dataclasses
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from humangs_jax.cli.options import UsageError, first_refinement, off, require_replaceable
from humangs_jax.cli.screen import stage, suggest, tell, warn, wrote
from humangs_jax.core.configuration import Range, at_least
from humangs_jax.data.formats import CAMERAS, KEYPOINTS

if TYPE_CHECKING:
    from humangs_jax.apps.from_photos import Step


@dataclasses.dataclass(frozen=True)
class Start:
    """Make an avatar from photos or a video, and show it in the browser.

    Cameras, masks and keypoints are used if the folder has them, and estimated otherwise. Run it
    again after you have added something. docs: your_photos.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs start photos --out me --height 1.78",
        "humangs start photos --cameras calibration.json --out me",
    )
    photos: Positional[Path]
    """Folder of photos, which may also have cameras, masks and keypoints.

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
    """Folder of the masks, if they are not in the folder of photos."""
    others: Path | None = None
    """Folder of masks of other people and of things in front of the person, if it is elsewhere.

    These pixels of the photos are ignored.
    """
    keypoints: Annotated[
        Path | None, arg(help=f"Keypoints, if they are elsewhere: {KEYPOINTS.listed()}.")
    ] = None
    person: Annotated[int | None, at_least(0)] = None
    """Number of the person, from 0, if a view has several: the number in the keypoint file, or on
    people.png if there is no such file.
    """
    height: Annotated[float | None, Range(0.3, 3)] = None
    """Height of the person without shoes, metres. It gives the scale if there is no calibration.

    Default: an average person's.
    """
    scale: float | None = None
    """Metres per unit of the calibration. Default: the unit of its format, or one that fits."""
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
    """How long to fit the avatar to the photos: 15s (or 15), 100steps, or 0.

    Default, with masks: iterations and the head.
    """
    browser: Annotated[bool, off("open the page at the end")] = True
    """Open the page at the end."""
    overwrite: bool = False
    """Begin anew, even if --out has a body or a finished avatar."""

    def run(self) -> None:
        refinement = first_refinement(self.refine)
        if self.refine not in (None, "0") and self.without_masks:
            raise UsageError("--refine needs masks: leave out --without-masks")
        if self.masks is not None and self.without_masks:
            raise UsageError(f"--masks {self.masks}: does not go with --without-masks")
        # the rest of what may be wrong with --out is known after the imports
        require_replaceable(self.out, True, "capture.json")
        with stage("starting"):
            from humangs_jax.apps.from_photos import MissingError, avatar_from_photos

        own = ("photos", "out", "refine", "browser")
        options = {name: value for name, value in vars(self).items() if name not in own}
        try:
            for step in avatar_from_photos(self.photos, self.out, refinement=refinement, **options):
                self._show(step)
        except MissingError:
            suggest("humangs start", self.photos, "--out", self.out)
            raise
        if self.browser:
            webbrowser.open((self.out / "avatar.html").resolve().as_uri())
        suggest("humangs animate", self.out / "avatar.npz", "--motion FILE --out video.mp4")

    def _show(self, step: "Step") -> None:
        if step.warning:
            warn(step.text)
        elif step.file is not None:
            wrote(step.file, step.text)
        else:
            tell(step.text)
