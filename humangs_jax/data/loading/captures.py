"""A source of examples from people on disk. Decoded images are kept as bytes. People that cannot be
used are left out and reported.
"""

import dataclasses
import logging
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import UInt8
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import DEFAULT_BODY, load_capture, read_parameters
from humangs_jax.data.capture_checks import CaptureError, body_parameters, checked_camera
from humangs_jax.data.loading.examples import (
    Example,
    StoredSubject,
    ViewSampling,
    sample_views,
    shrink,
    subject_order,
    subject_views,
    view_generator,
)
from humangs_jax.data.photos import (
    check_photos,
    read_checked,
    read_description,
    read_frames_and_matrices,
)
from humangs_jax.io.images import check_image, to_uint8

logger = logging.getLogger("humangs_jax.data.loading")


def find_captures(root: str | Path) -> tuple[Path, ...]:
    """Returns the capture folders directly inside a folder, sorted by name; the folder itself if it
    is a capture. Folders whose names begin with a dot are left out.

    Raises: ValueError if there is none.
    """
    root = Path(root)
    if (root / "capture.json").is_file():
        folders = [root]
    else:
        folders = sorted(p.parent for p in root.glob("*/capture.json"))
    folders = [folder for folder in folders if not folder.name.startswith(".")]  # half-written ones
    if not folders:
        raise ValueError(f"{root}: no capture folder here (a folder with a capture.json)")
    return tuple(folders)


def read_summary(
    path: str | Path, body: BodyModel, body_file: str | Path = DEFAULT_BODY
) -> StoredSubject:
    """Returns everything of a capture but its pixels. The arrays of images and masks have the right
    height and width, but 0 views. Shape coefficients that the capture leaves out are 0. A
    displacement is dropped.

    Images and masks are opened, and their sizes are compared. PNG files are checked by their
    checksums, other files by decoding them.

    Arguments: body: the body that the capture must have. body_file: the file that `body` comes
    from, see `Capture`.

    Raises: CaptureError naming the file, and the field if a value is wrong. A view with neither a
    mask nor an alpha channel is refused, because training needs to know where the person is. A
    capture with another body is refused, too.
    """
    folder = Path(path)
    file = folder / "capture.json"
    description = read_description(file)
    parameter_file = folder / description["body"]
    name, parameters = read_parameters(parameter_file)
    if not _same_body(name, folder, body_file):
        problem = (
            f"{name!r}, but all captures of a run have one body, {str(body_file)!r}: expected"
            " parameters of that"
        )
        raise CaptureError(parameter_file, "body", problem)
    # bodies of training are bare
    betas, rotations, translations, _ = body_parameters(body, **parameters, file=parameter_file)
    views, size = description["views"], None
    check_photos(folder, views, together=False)
    for view in views:
        image, mask = folder / view["image"], folder / view.get("mask", "")
        shape, has_alpha = read_checked(check_image, image)
        size = size or shape
        if shape != size:
            raise CaptureError(
                image, "size", f"{shape}, but the first view has {size}: expected one size"
            )
        if "mask" not in view and not has_alpha:
            raise CaptureError(folder, "", "no masks: training needs to know where the person is")
        if "mask" not in view:
            continue
        masked = read_checked(check_image, mask)[0]
        if masked != size:
            raise CaptureError(
                mask, "size", f"{masked}, but its image has {size}: expected the same"
            )
    assert size is not None  # a description has views
    width, height = size
    frames, K, cam_from_world = read_frames_and_matrices(views, len(rotations), file)
    for i in range(len(views)):
        checked_camera(K[i], cam_from_world[i], width, height, file, f"views[{i}]")
    # coefficients that a capture leaves out are 0: one length for all, so that subjects stack
    betas = np.pad(betas, (0, body.shape_directions.shape[-1] - len(betas)))
    return StoredSubject.without_photos(
        (height, width), K, cam_from_world, frames, rotations, translations, betas
    )


def _same_body(name: str, folder: Path, body_file: str | Path) -> bool:
    """Returns whether a capture in `folder` has the body of `body_file`. name: the name or the path
    of the body in the capture.
    """
    if DEFAULT_BODY in (name, str(body_file)):
        return name == str(body_file)
    return (folder / name).resolve() == Path(body_file).resolve()


@runtime_checkable
class StoredPerson(Protocol):
    """One person on disk, from a capture folder or a data set (`datasets.subject.Person`)."""

    @property
    def name(self) -> Path | str:
        """The name of the person in the log and in `broken`."""
        ...

    def summary(self) -> StoredSubject:
        """Returns everything of the person but the pixels. Poses may be missing, too.

        Raises: ValueError or OSError if the person cannot be used.
        """
        ...

    def decode(
        self, views: Sequence[int]
    ) -> tuple[UInt8[np.ndarray, "n h w 3"], UInt8[np.ndarray, "n h w"]]:
        """Returns the images and masks of some views, in this order, as bytes.

        Raises: as `summary`.
        """
        ...

    def posed(self, subject: StoredSubject) -> StoredSubject:
        """Returns a subject with at least the poses that its views show. subject: some views of the
        summary; its poses may be missing.

        Raises: as `summary`.
        """
        ...


@dataclasses.dataclass(frozen=True)
class CaptureFolder:
    """A capture folder as a `StoredPerson`."""

    name: Path
    """The path of the folder."""
    body: BodyModel
    """The body model that the capture must have."""
    body_file: str | Path = DEFAULT_BODY
    """The file that the body model was read from."""

    def summary(self) -> StoredSubject:
        """Returns everything of the capture but its pixels, see `read_summary`."""
        return read_summary(self.name, self.body, self.body_file)

    def decode(
        self, views: Sequence[int]
    ) -> tuple[UInt8[np.ndarray, "n h w 3"], UInt8[np.ndarray, "n h w"]]:
        """Returns the images and masks of some views. Raises: CaptureError."""
        capture = load_capture(self.name, body=self.body, views=views)
        if capture.masks is None:
            raise CaptureError(
                self.name, "", "alpha channels without a transparent pixel: expected masks"
            )
        return to_uint8(capture.images), to_uint8(capture.masks)

    def posed(self, subject: StoredSubject) -> StoredSubject:
        """Returns the subject as it is, since the summary has all poses."""
        return subject


class PeopleCache:
    """The people of a source on disk. Each is checked when it is first asked for. Images are
    decoded when they are needed, and kept as bytes, up to `limit_bytes` for all people together.
    Several threads may ask at once.

    broken: the first fault that was found in a person, by the person's name. The names are in the
    order in which faults were found. Raises: ValueError if there are no people.
    """

    def __init__(self, people: Sequence[StoredPerson], limit_bytes: int = 4 << 30):
        if not people:
            raise ValueError("no capture folders")
        self.people = tuple(people)
        self.broken: dict[Path | str, str] = {}
        self._free_bytes = limit_bytes
        self._summaries: dict[Path | str, StoredSubject | None] = {}  # None: left out
        self._images: dict[tuple[Path | str, int], tuple[np.ndarray, np.ndarray]] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.people)

    def name(self, index: int) -> Path | str:
        """Returns the name of person `index` in errors."""
        return self.people[index].name

    def summary(self, index: int) -> StoredSubject | None:
        """Returns person `index` without images, see `StoredPerson`. Returns None if the person is
        left out, see `report`.

        Raises: ValueError if the person's files are wrong, and now everybody is left out.
        """
        name = self.name(index)
        with self._lock:
            if name in self._summaries:
                return self._summaries[name]
        try:
            summary = self.people[index].summary()
        except (ValueError, OSError) as error:
            self.report(index, str(error))
            return None
        with self._lock:
            return self._summaries.setdefault(name, summary)

    def some_views(self, index: int, views: Sequence[int]) -> StoredSubject:
        """Returns person `index` with only these views, in this order.

        Raises: as `StoredPerson.summary`.
        """
        person, name = self.people[index], self.name(index)
        with self._lock:
            summary = self._summaries.get(name)
            decoded = {
                view: self._images[name, view] for view in views if (name, view) in self._images
            }
        if summary is None:
            summary = person.summary()
        missing = [view for view in views if view not in decoded]
        if missing:
            for view, image, mask in zip(missing, *person.decode(missing), strict=True):
                decoded[view] = image, mask
                self._keep(name, view, image, mask)
        chosen = np.asarray(views)
        images, masks = (
            np.stack(column) for column in zip(*(decoded[view] for view in views), strict=True)
        )
        of_views = {
            name: getattr(summary, name)[chosen]
            for name in ("K", "cam_from_world", "frames", "azimuths")
        }
        return person.posed(summary._replace(images=images, masks=masks, **of_views))

    def note(self, index: int, problem: str) -> None:
        """Record in `broken` what is wrong with person `index`. Only the first problem of a person
        is kept and logged. Other views of the person are still used.
        """
        name = self.name(index)
        with self._lock:
            known = name in self.broken
            self.broken.setdefault(name, problem)
            count = len(self.broken)
        if not known:
            logger.warning(
                "left out %s (%d of %d folders so far): %s", name, count, len(self), problem
            )

    def report(self, index: int, problem: str) -> None:
        """Record a problem as `note` does, and leave person `index` out from now on. The problem
        must depend on the files alone, so that the order of examples stays reproducible.

        Raises: ValueError, which names this problem, if now everybody is left out.
        """
        self.note(index, problem)
        with self._lock:
            self._summaries[self.name(index)] = None
            nobody = all(
                person.name in self._summaries and self._summaries[person.name] is None
                for person in self.people
            )
        if nobody:
            raise ValueError(
                f"none of the {len(self)} capture folders can be used; the last one: {problem}"
            )

    def _keep(
        self,
        name: Path | str,
        view: int,
        image: UInt8[np.ndarray, "h w 3"],
        mask: UInt8[np.ndarray, "h w"],
    ) -> None:
        size = image.nbytes + mask.nbytes
        with self._lock:
            if (name, view) not in self._images and size <= self._free_bytes:
                # copies: a slice would keep the memory of all views that were read with it
                self._images[name, view] = image.copy(), mask.copy()
                self._free_bytes -= size


class CaptureCache(PeopleCache):
    """The people of capture folders.

    body_file: the file that `body` comes from. Captures that name another body are broken.
    """

    def __init__(
        self,
        folders: Sequence[str | Path],
        body: BodyModel,
        limit_bytes: int = 4 << 30,
        body_file: str | Path = DEFAULT_BODY,
    ):
        super().__init__(
            [CaptureFolder(Path(folder), body, body_file) for folder in folders], limit_bytes
        )


@dataclasses.dataclass(frozen=True)
class CaptureSource:
    """People on disk as a `Source`. For each pass over the n people, an order of them is drawn.
    Example e shows the person at place e mod n of the order of its pass. A person that cannot be
    used is replaced by the next one in the order.
    """

    cache: PeopleCache
    """The people, as they are kept on disk and in memory."""
    sampling: ViewSampling
    """How the views of an example are chosen."""
    input_size: int
    """The side of the square input views, pixels."""
    target_size: int
    """The side of the square target views, pixels."""
    depths: bool = False
    """Whether examples have arrays of depths, in which all depths are unknown. So they can be mixed
    with examples of other sources that have depths.
    """

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        return self.sampling.input_counts

    @property
    def broken(self) -> Mapping[str, str]:
        """The first fault that was found in each person so far, by the person's name. If only a
        photo of a person is wrong, other views are still used.
        """
        return {str(name): problem for name, problem in self.cache.broken.items()}

    def __len__(self) -> int:
        return len(self.cache)

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """See `Source`."""
        return self._found(seed, index, input_count)[1]

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """Returns the name of the person that the example shows, see `Source`."""
        return str(self._found(seed, index, input_count)[0])

    def unusable(self) -> dict[str, str]:
        """Returns the names of the people that cannot be used, each with the reason: their files
        are wrong, they have too few views (see `sample_views`), or their photos are too small or
        not square.

        No decoded photo is kept. Faults of single photos that were found before are in the result,
        too.

        Raises: ValueError if the files of all people are wrong.
        """
        problems = {}
        for i in range(len(self.cache)):
            summary = self.cache.summary(i)
            if summary is None:
                continue
            try:
                self._drawn(view_generator(0, 0), summary, max(self.input_counts))
            except ValueError as error:
                problems[str(self.cache.name(i))] = str(error)
        return {**self.broken, **problems}

    def _drawn(
        self, generator: np.random.Generator, summary: StoredSubject, input_count: int
    ) -> tuple[list[int], list[int]]:
        """Returns the numbers of the input and target views of one person.

        Raises: ValueError if there are too few views, or if the photos are too small or not square.
        """
        views = sample_views(generator, summary, input_count, self.sampling)
        for size in (self.input_size, self.target_size):
            shrink(summary.images, size)  # of no views: whether images of this size can be shrunk
        return views

    def _found(self, seed: int, index: int, input_count: int) -> tuple[Path | str, Example]:
        epoch, position = divmod(index, len(self.cache))
        order = subject_order(seed, epoch, len(self.cache))
        for subject_index in np.roll(order, -position).tolist():
            summary = self.cache.summary(subject_index)
            if summary is None:
                continue
            try:
                generator = view_generator(seed, index)
                inputs, targets = self._drawn(generator, summary, input_count)
            except ValueError as error:
                self.cache.report(subject_index, f"{self.cache.name(subject_index)}: {error}")
                continue
            try:
                seen = self.cache.some_views(subject_index, [*inputs, *targets])
                # a white photo would be read as the person
                shown = [(mask > MASK_THRESHOLD * 255).any() for mask in seen.masks[: len(inputs)]]
                if not all(shown):
                    empty = inputs[shown.index(False)]
                    raise CaptureError(
                        f"views[{empty}]", "mask", "empty: no photo to reconstruct the person from"
                    )
            except (ValueError, OSError) as error:
                # this example goes to the next subject; others, of other views, do not: the order
                # depends on files alone
                self.cache.note(subject_index, str(error))
                continue
            first, last = range(len(inputs)), range(len(inputs), len(seen.images))
            example = Example(
                subject_views(seen, first, self.input_size, self.depths),
                subject_views(seen, last, self.target_size, self.depths),
            )
            return self.cache.name(subject_index), example
        raise ValueError(f"none of the {len(self.cache)} capture folders can be used")
