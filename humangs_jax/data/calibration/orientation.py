"""Photos with an EXIF orientation flag: phones store a portrait photo on its side, and the flag says so.

Half of the other programs obey the flag, half do not. What an import writes has none: pixels are turned upright, and with them
the camera, if it was calibrated for the pixels as stored (COLMAP ignores the flag). A calibration of the turned photo (OpenCV
obeys it) is told by its size. No camera sees a mirrored photo: where the flag asks for that, too, the photo is turned alone.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import CalibratedCamera, Calibration
from humangs_jax.data.calibration.photos import Photo, photo_size
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import read_checked
from humangs_jax.io.images import orientation, oriented

UNMIRRORED = {1: 1, 2: 1, 3: 3, 4: 3, 5: 6, 6: 6, 7: 8, 8: 8}
"""Flags, and those that turn alike without mirroring."""
QUARTERS = {1: 0, 6: 1, 3: 2, 8: 3}
"""Clockwise quarter turns that a flag asks for."""
MIRROR = 2


@dataclasses.dataclass(frozen=True)
class Turn:
    """How the pixels of a photo and of its mask become what is imported.

    flag: of the photo. photo, mask: flags to obey, one after the other. camera: the flag by which the camera is turned, 1 for a
    calibration of the turned photo. size: width and height after it. certain: whether sizes tell what was calibrated.
    """

    flag: int
    photo: int
    mask: tuple[int, ...]
    camera: int
    size: tuple[int, int]
    certain: bool = True

    @property
    def rewrites(self) -> bool:
        """Whether the files cannot be copied as they are."""
        return self.flag != 1 or any(flag != 1 for flag in self.mask)

    def image(self, pixels: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "height width *c"]:
        """The photo, or its alpha channel, upright."""
        return oriented(pixels, self.photo)

    def of_mask(self, pixels: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "height width"]:
        """The mask, upright."""
        for flag in self.mask:
            pixels = oriented(pixels, flag)
        return pixels


def find_turns(calibration: Calibration, photos: Sequence[Photo]) -> tuple[Turn, ...]:
    """One for each photo.

    Raises: CaptureError unless photos have the size that was calibrated, and masks that of their photo; and for a camera that was
    calibrated for pixels as stored, but whose photos have different flags.
    """
    turns = tuple(_find_turn(calibration.cameras[photo.camera], photo, calibration.upright) for photo in photos)
    first: dict[int, tuple[Photo, Turn]] = {}
    for photo, turn in zip(photos, turns, strict=True):
        other, known = first.setdefault(photo.camera, (photo, turn))
        if known.camera != turn.camera:
            problem = f"EXIF orientation {turn.flag}, but {other.image.name} of the same camera has {known.flag}"
            raise CaptureError(photo.image, "", f"{problem}: expected one; turn the photos before calibrating")
    return turns


def _find_turn(camera, photo, upright):
    flag, stored = read_checked(orientation, photo.image), photo_size(photo.image)
    shown = stored if flag < 5 else stored[::-1]
    calibrated = stored if camera.width is None else (camera.width, camera.height)
    if camera.width is None and flag >= 5:  # the principal point is near the middle
        calibrated = min(stored, shown, key=lambda size: np.abs(camera.K[:2, 2] / size - 0.5).max())
    if calibrated not in (stored, shown):
        told = "" if flag == 1 else f" (EXIF orientation {flag})"
        problem = f"was calibrated with {calibrated[0]} x {calibrated[1]}: expected the same"
        if calibrated == stored[::-1]:
            problem += "; was it turned (an EXIF orientation that got lost)?"
        raise CaptureError(photo.image, "size", f"{stored[0]} x {stored[1]}{told}, {problem}")
    as_stored = calibrated == stored and not upright
    own = UNMIRRORED[flag] if as_stored else flag
    size = stored if own < 5 else stored[::-1]
    mask = () if photo.mask is None else _mask_flags(photo, flag, own, stored, shown, mirrored=own != flag)
    return Turn(flag, own, mask, own if as_stored else 1, size, certain=flag == 1 or stored != shown or upright)


def _mask_flags(photo, flag, own, stored, shown, mirrored):
    """A mask with a flag, or of the size of the turned photo, shows it as turned; else as stored."""
    back = (MIRROR,) if mirrored else ()
    mask_flag, size = read_checked(orientation, photo.mask), photo_size(photo.mask)
    if mask_flag != 1:
        size = size if mask_flag < 5 else size[::-1]
        if size == shown:
            return mask_flag, *back
    elif flag == 1 and size == stored:
        return ()
    elif size == shown:  # where both sizes are the same: most tools that make masks obey the flag
        return back
    elif size == stored:
        return (own,)
    wanted = " or ".join(f"{width} x {height}" for width, height in dict.fromkeys((shown, stored)))
    raise CaptureError(photo.mask, "size", f"{size[0]} x {size[1]}, but its photo has {wanted}: expected the same")


def turned_cameras(calibration: Calibration, photos: Sequence[Photo], turns: Sequence[Turn]) -> Calibration:
    """The calibration, in the convention of captures, of the photos as they are imported, sizes included."""
    cameras, seen = list(calibration.cameras), calibration.observations
    pixels = None if seen is None else seen.pixels.copy()
    for i, turn in {photo.camera: turn for photo, turn in zip(photos, turns, strict=True)}.items():
        width, height = turn.size if QUARTERS[turn.camera] % 2 == 0 else turn.size[::-1]
        camera = dataclasses.replace(cameras[i], width=width, height=height)
        for _ in range(QUARTERS[turn.camera]):
            if seen is not None and pixels is not None:
                own = seen.cameras == i
                pixels[own] = np.stack([camera.height - pixels[own, 1], pixels[own, 0]], axis=-1)
            camera = _quarter_turned(camera)
        cameras[i] = camera
    if seen is not None and pixels is not None:
        seen = dataclasses.replace(seen, pixels=pixels)
    return dataclasses.replace(calibration, cameras=tuple(cameras), observations=seen)


def _quarter_turned(camera: CalibratedCamera) -> CalibratedCamera:
    """The camera of the photo turned clockwise: pixel (x, y) moves to (height - y, x), and so do the camera's axes."""
    assert camera.width is not None and camera.height is not None
    turn = np.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    move = turn.copy()
    move[0, 2] = camera.height
    pose, distortion = camera.cam_from_world.copy(), camera.distortion
    pose[:3] = turn @ pose[:3]
    if distortion is not None:  # (p2, p1) is a vector of the image plane
        k1, k2, p1, p2, k3 = distortion
        distortion = np.asarray([k1, k2, p2, -p1, k3])
    return dataclasses.replace(
        camera,
        K=move @ camera.K @ turn.T + 0.0,
        cam_from_world=pose + 0.0,
        width=camera.height,
        height=camera.width,
        distortion=distortion,
    )


def turn_notes(photos: Sequence[Photo], turns: Sequence[Turn]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What was done, and warnings about what sizes cannot tell; a line each."""
    flagged = [(photo, turn) for photo, turn in zip(photos, turns, strict=True) if turn.flag != 1]
    if not flagged:
        return (), ()
    count = f"{len(flagged)} photo{'' if len(flagged) == 1 else 's'}"
    whole = "the calibration is of the turned photos"
    stored = [turn for _, turn in flagged if turn.camera != 1 or turn.photo != turn.flag]
    if stored:
        whole = "their cameras, too: the calibration is of the pixels as stored"
    notes, warnings = [f"turned upright by the EXIF orientation: {count} ({whole})"], []
    unsure = [(photo, turn) for photo, turn in flagged if not turn.certain]
    if unsure:
        photo, turn = unsure[0]
        more = f" and {len(unsure) - 1} more" if len(unsure) > 1 else ""
        of_masks = ", the mask to be of the turned photo" if photo.mask is not None else ""
        warnings.append(
            f"EXIF orientation {turn.flag} of {photo.image.name}{more}: the calibration is taken to be of the pixels as "
            f"stored{of_masks}; their sizes do not tell. If that is wrong, save the photos turned"
        )
    mirrored = [photo.image.name for photo, turn in flagged if turn.photo != turn.flag]
    if mirrored:
        warnings.append(f"EXIF asks to mirror {mirrored[0]}: turned, not mirrored, as no camera sees so")
    return tuple(notes), tuple(warnings)
