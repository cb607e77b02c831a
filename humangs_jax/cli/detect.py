"""`humangs detect`: keypoints and masks of the person in photos."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from humangs_jax.cli.options import require_at_least, require_folder
from humangs_jax.cli.screen import stage, suggest, tell, warn, wrote

if TYPE_CHECKING:
    from humangs_jax.apps.detect import PhotoPeople


def tell_found(photos: "list[PhotoPeople]", person: int) -> None:
    """Say which photos are without the person, and what was repaired."""
    from humangs_jax.apps.detect import absent, cut_off, repaired

    if any(photo.colors for photo in photos):
        warn(f"several people in a photo: number {person} is the same by the colors of upper body and legs alone")
    for name in absent(photos, person):
        warn(f"{name}: the person was not found in it")
    for name in cut_off(photos, person):
        warn(f"{name}: a part of the person is outside of the photo")
    for name in repaired(photos, person):
        warn(f"{name}: left and right of the person were exchanged, as the other views show: repaired")


def found_here(capture: Path, person: int | None) -> Path:
    """The file of keypoints in a capture folder. What it lacks is found in its photos: keypoints, and masks if there are none.

    Arguments: person: the number on the sheet, where several may be meant; then they are found again.
    """
    from humangs_jax.apps import detect
    from humangs_jax.data.photos import capture_folder, load_photos

    folder = capture_folder(capture)
    file = folder / detect.KEYPOINTS_FILE
    photos = load_photos(folder)
    if not file.exists() or person is not None or photos.masks is None:
        people, number = detect.person_in_capture(folder, photos, person=person)
        detect.add_to_capture(folder, people, number, masks=photos.masks is None)
        tell_found(people, number)
        what = "keypoints" if photos.masks is not None else "keypoints and masks"
        tell(f"{what} found in the photos: {folder / detect.SHEET_FILE} shows them")
    return file


@dataclasses.dataclass(frozen=True)
class Detect:
    """Find the person in photos: 33 keypoints and a mask for each, and a sheet on which everybody has a number.

    Needs `pip install 'humangs_jax[photos]'`. In a capture folder, whose cameras are known, people are matched by how well they
    triangulate; in other photos by their size, or by their colors where several are large. docs/your_photos.md shows the way.
    """

    photos: Positional[Path]
    """Folder of the photos, or a capture folder that has no body yet."""
    out: Path
    """Folder for keypoints.json, masks/, people.png (the sheet) and people.json (everybody)."""
    person: int | None = None
    """Which person, by the number on the sheet, where several are of nearly one size."""

    def run(self) -> None:
        require_at_least(0, person=self.person)
        require_folder(self.out)
        with stage("starting"):
            from humangs_jax.apps import detect

        with stage("finding people"):
            photos = detect.found_in_photos(self.photos)
        person = detect.chosen(photos, self.person, self.out)
        with stage("writing"):
            detect.write_found(self.out, photos, person)
        tell_found(photos, person)
        wrote(self.out / detect.KEYPOINTS_FILE, f"keypoints of the person in {len(photos)} photos")
        wrote(self.out / detect.MASKS, "what of each photo is the person")
        wrote(self.out / detect.SHEET_FILE, "look at it")
        suggest("humangs fit CAPTURE --keypoints", self.out / detect.KEYPOINTS_FILE)
