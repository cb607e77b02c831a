"""One person of a data set: arrays of all views at once, photos and poses only when they are asked for.

A view is one photo: a camera at one frame. Opening a subject lists folders and reads calibration and body parameters, so that a
sequence of 5,000 frames opens in well under a second. Photos come on white, padded to a centred square and resized.
"""

import concurrent.futures
import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.core.registry import imported
from humangs_jax.data.capture import Capture, capture_from_arrays
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.datasets.bodies import BodyParameters, FileBody
from humangs_jax.data.formats import DATASETS
from humangs_jax.data.loading.examples import StoredSubject
from humangs_jax.io.images import resized, to_uint8

STORED_SIZE = 512
"""Pixels a side of the squares that photos of data sets become; 256 and 128 are box averages of it."""
THREADS = min(8, os.cpu_count() or 1)
"""That decode the photos of one request: JPEG decoding releases the interpreter's lock."""


@dataclasses.dataclass(frozen=True, eq=False)
class Subject:
    """One person, see the module.

    name: what errors and manifests call it. K: (v, 3, 3) pixels of the photo as it is, centres at +0.5. cam_from_world:
    (v, 4, 4), metres, OpenCV. sizes: (v, 2) width and height. frames: (v,) the pose that a view shows, counted from 0.
    cameras: (v,) which camera took it. frame_count: number of poses. view_name: view -> a name such as "cam03_00000120".
    read: view -> image on white (h, w, 3) and mask (h, w), both in [0, 1]. parameters: frames -> shape and these poses.
    missing: reason -> how many photos are left out for it.
    """

    name: str
    K: Float[np.ndarray, "v 3 3"]
    cam_from_world: Float[np.ndarray, "v 4 4"]
    sizes: Int[np.ndarray, "v 2"]
    frames: Int[np.ndarray, " v"]
    cameras: Int[np.ndarray, " v"]
    frame_count: int
    view_name: Callable[[int], str]
    read: Callable[[int], tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]]
    parameters: Callable[[Sequence[int]], BodyParameters]
    missing: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        """Number of views."""
        return len(self.frames)

    def squared_K(self, views: Sequence[int] | Int[np.ndarray, " any"], size: int) -> Float[np.ndarray, "any 3 3"]:
        """Intrinsics of these views padded to squares and resized to `size` pixels."""
        width, height = self.sizes[views].T
        side = self.sizes[views].max(axis=1)
        K = self.K[views].copy()
        K[:, 0, 2] += (side - width) // 2
        K[:, 1, 2] += (side - height) // 2
        K[:, :2] *= (size / side)[:, None, None]
        return K

    def photo(self, view: int, size: int) -> tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "size size"]]:
        """Image on white and mask of one view, padded to a centred square and resized. Raises: ValueError naming the file."""
        image, mask = self.read(view)
        width, height = self.sizes[view].tolist()
        if image.shape[:2] != (height, width) or mask.shape != (height, width):
            got = f"{image.shape[1]} x {image.shape[0]}, mask {mask.shape[1]} x {mask.shape[0]}"
            problem = f"photo {got}, but the calibration says {width} x {height}"
            raise CaptureError(self.name, self.view_name(view), problem)
        side = max(width, height)
        top, left = (side - height) // 2, (side - width) // 2
        pad = ((top, side - height - top), (left, side - width - left))
        image, mask = np.pad(image, (*pad, (0, 0)), constant_values=1.0), np.pad(mask, pad)
        if side != size:
            image, mask = resized(image, size, size), resized(mask, size, size)
        return to_uint8(image), to_uint8(mask)

    def photos(
        self, views: Sequence[int] | Int[np.ndarray, " any"], size: int
    ) -> tuple[UInt8[np.ndarray, "any size size 3"], UInt8[np.ndarray, "any size size"]]:
        """Several of these, decoded in parallel. Raises: as `photo`."""
        views = [int(view) for view in views]
        if len(views) == 1:
            found = [self.photo(views[0], size)]
        else:
            with concurrent.futures.ThreadPoolExecutor(min(THREADS, len(views))) as pool:
                found = list(pool.map(lambda view: self.photo(view, size), views))
        images, masks = zip(*found, strict=True)
        return np.stack(images), np.stack(masks)

    def capture(self, views: Sequence[int] | Int[np.ndarray, " any"], body: FileBody, size: int = STORED_SIZE) -> Capture:
        """These views as a `Capture`, to reconstruct and to animate; its poses are those of the frames that are seen.

        Raises: ValueError naming file and field.
        """
        views = np.asarray(views, int)
        images, masks = self.photos(views, size)
        seen, frames = np.unique(self.frames[views], return_inverse=True)
        betas, rotations, translations = self.parameters(seen.tolist())
        return capture_from_arrays(
            images / np.float32(255),
            self.squared_K(views, size),
            self.cam_from_world[views],
            rotations,
            translations,
            betas=betas,
            shape_names=body.model.shape_names[: len(betas)] or None,
            masks=masks / np.float32(255),
            frames=frames,
            names=[self.view_name(int(view)) for view in views],
            background="white",
            body=body.model,
            body_file=body.file,
            source=self.name,
        )


@dataclasses.dataclass(eq=False)
class Person:
    """A subject that is opened when it is first asked for, as `loading.captures.PeopleCache` wants it.

    name: of the subject. open: makes the `Subject`, and raises ValueError if it cannot be used. size: of the stored squares.
    """

    name: str
    open: Callable[[], Subject]
    size: int = STORED_SIZE

    @functools.cached_property
    def subject(self) -> Subject:
        """The subject. Raises: ValueError, naming file and field."""
        return self.open()

    def summary(self) -> StoredSubject:
        """All of it but pixels and poses."""
        subject, every = self.subject, np.arange(len(self.subject))
        R, t = subject.cam_from_world[:, :3, :3], subject.cam_from_world[:, :3, 3]
        centers = -np.einsum("vji,vj->vi", R, t)
        offsets = centers - centers.mean(axis=0)
        betas, rotations, translations = subject.parameters([])
        return StoredSubject(
            images=np.zeros((0, self.size, self.size, 3), np.uint8),
            masks=np.zeros((0, self.size, self.size), np.uint8),
            K=subject.squared_K(every, self.size).astype(np.float32),
            cam_from_world=subject.cam_from_world.astype(np.float32),
            frames=subject.frames,
            azimuths=np.arctan2(offsets[:, 0], offsets[:, 2]),
            rotations=rotations.astype(np.float32),
            translations=translations.astype(np.float32),
            betas=betas.astype(np.float32),
        )

    def decode(self, views: Sequence[int]) -> tuple[UInt8[np.ndarray, "any h w 3"], UInt8[np.ndarray, "any h w"]]:
        """Images and masks of these views."""
        return self.subject.photos(views, self.size)

    def posed(self, subject: StoredSubject) -> StoredSubject:
        """These views with the poses that they show alone. Raises: ValueError naming file and field."""
        seen, frames = np.unique(subject.frames, return_inverse=True)
        _, rotations, translations = self.subject.parameters(seen.tolist())
        rotations, translations = rotations.astype(np.float32), translations.astype(np.float32)
        return subject._replace(frames=frames.astype(np.int32), rotations=rotations, translations=translations)


def open_people(path: str | Path, body: FileBody, size: int | None = None) -> tuple[Person, ...]:
    """The people of a data set of any layout that has photos (`data.formats.DATASETS`); each is opened when it is asked for.

    Arguments: size: pixels a side of the stored squares; None: that of the images of a scene list, else `STORED_SIZE`.
    Raises: CaptureError if the folder has none of the layouts.
    """
    path = Path(path)
    for name, data_set in DATASETS.items():
        if not (folders := imported(data_set.find)(path)):
            continue
        if data_set.scans:
            raise CaptureError(path, "", f"scans have no photos: make some with `humangs preprocess {name}`")
        if data_set.lists:
            return data_set(path, body, size)
        opened = lambda folder, open_one=data_set: functools.partial(open_one, folder, body)
        return tuple(Person(str(folder), opened(folder), size or STORED_SIZE) for folder in folders)
    known = ", ".join(each.about for each in DATASETS.where(lambda each: not each.lists).values())
    raise CaptureError(path, "", f"no captures, scene list or data set of {known} (docs/datasets.md)")
