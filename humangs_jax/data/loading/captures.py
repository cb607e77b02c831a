"""Capture folders as a source: subjects are kept decoded as bytes; a folder that cannot be used is left out, and named."""

import dataclasses
import logging
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture import load_capture
from humangs_jax.data.images import to_uint8
from humangs_jax.data.loading.examples import Example, StoredSubject, ViewSampling, draw_views, subject_views
from humangs_jax.data.loading.order import subject_order, view_generator

logger = logging.getLogger("humangs_jax.data.loader")


def find_captures(root: str | Path) -> tuple[Path, ...]:
    """The capture folders directly inside a folder, sorted by name; the folder itself if it is a capture.

    Raises: ValueError if there is none.
    """
    root = Path(root)
    folders = [root] if (root / "capture.json").is_file() else sorted(p.parent for p in root.glob("*/capture.json"))
    folders = [folder for folder in folders if not folder.name.startswith(".")]  # half-written ones
    if not folders:
        raise ValueError(f"{root}: no capture folder here (a folder with a capture.json)")
    return tuple(folders)


def store_capture(path: str | Path, body: BodyModel, views: Sequence[int] | None = None) -> StoredSubject:
    """Read a capture folder whose parameters belong to `body`, or some of its views. Raises: ValueError naming file and field.

    Azimuths are about the middle of the cameras read.
    """
    capture = load_capture(path, body=body, views=views)
    if capture.masks is None:
        raise ValueError(f"{path}: no masks: training needs to know where the person is")
    shape_count = body.shape_directions.shape[-1]
    centers = np.asarray(capture.cameras.center)
    offsets = centers - centers.mean(axis=0)
    return StoredSubject(
        images=to_uint8(capture.images),
        masks=to_uint8(capture.masks),
        K=np.asarray(capture.cameras.K),
        cam_from_world=np.asarray(capture.cameras.cam_from_world),
        frames=np.asarray(capture.frames),
        azimuths=np.arctan2(offsets[:, 0], offsets[:, 2]),
        rotations=np.asarray(capture.poses.rotations),
        translations=np.asarray(capture.poses.translation),
        # coefficients that a capture leaves out are 0: one length for all, so that subjects stack
        betas=np.pad(np.asarray(capture.betas, np.float32), (0, shape_count - len(capture.betas))),
    )


class CaptureCache:
    """Capture folders, checked as a whole when first asked for and kept as bytes up to a limit.

    Of those beyond the limit all but the pixels is kept, and the views that are wanted are read again. Several threads may
    ask at once. broken: folder -> what is wrong with it, in the order of discovery.
    """

    def __init__(self, folders: Sequence[str | Path], body: BodyModel, limit_bytes: int = 4 << 30):
        if not folders:
            raise ValueError("no capture folders")
        self.folders = tuple(Path(folder) for folder in folders)
        self.broken: dict[Path, str] = {}
        self._body, self._free_bytes = body, limit_bytes
        self._stored: dict[Path, StoredSubject] = {}
        self._outlines: dict[Path, StoredSubject] = {}
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.folders)

    def load(self, index: int) -> StoredSubject | None:
        """The subject of folder `index`; None if it is broken, which is told once."""
        folder = self.folders[index]
        with self._lock:
            if folder in self.broken:
                return None
            if folder in self._stored:
                return self._stored[folder]
        try:
            subject = store_capture(folder, self._body)
        except (ValueError, OSError) as error:
            self.report(index, str(error))
            return None
        with self._lock:
            nothing = {name: getattr(subject, name)[:0] for name in ("images", "masks")}
            self._outlines[folder] = subject._replace(**{name: array.copy() for name, array in nothing.items()})
            if folder not in self._stored and folder not in self.broken and subject.size_bytes <= self._free_bytes:
                self._stored[folder] = subject
                self._free_bytes -= subject.size_bytes
        return subject

    def outline(self, index: int) -> StoredSubject | None:
        """The subject of folder `index`, images and masks possibly empty; None if it is broken."""
        with self._lock:
            known = self._outlines.get(self.folders[index])
        return self.load(index) if known is None or self.folders[index] in self.broken else known

    def some_views(self, index: int, views: Sequence[int]) -> StoredSubject:
        """The subject of folder `index` with these views alone, in this order. Raises: ValueError, OSError."""
        with self._lock:
            stored = self._stored.get(self.folders[index])
        if stored is None:
            return store_capture(self.folders[index], self._body, views)
        chosen = np.asarray(views)
        of_views = ("images", "masks", "K", "cam_from_world", "frames", "azimuths")
        return stored._replace(**{name: getattr(stored, name)[chosen] for name in of_views})

    def report(self, index: int, problem: str) -> None:
        """Leave folder `index` out from now on.

        Raises: ValueError, naming the last problem, once every folder is left out.
        """
        folder = self.folders[index]
        with self._lock:
            known = folder in self.broken
            self.broken[folder] = problem
            dropped = self._stored.pop(folder, None)
            self._free_bytes += dropped.size_bytes if dropped is not None else 0
            count = len(self.broken)
        if not known:
            logger.warning("left out %s (%d of %d folders so far): %s", folder, count, len(self), problem)
        if count == len(set(self.folders)):
            raise ValueError(f"none of the {len(self)} capture folders can be used; the last one: {problem}")


@dataclasses.dataclass(frozen=True)
class CaptureSource:
    """Captures as a `Source`. Example e shows subject e mod n of a permutation drawn for each pass over the n folders.

    input_size, target_size: pixels a side of the square views. A broken folder is replaced by the next one in the order.
    """

    cache: CaptureCache
    sampling: ViewSampling
    input_size: int
    target_size: int

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        return self.sampling.input_counts

    @property
    def broken(self) -> Mapping[str, str]:
        """Folders left out so far: path -> what is wrong with it."""
        return {str(folder): problem for folder, problem in self.cache.broken.items()}

    def __len__(self) -> int:
        return len(self.cache)

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """See `Source`."""
        epoch, position = divmod(index, len(self.cache))
        order = subject_order(seed, epoch, len(self.cache))
        for subject_index in np.roll(order, -position).tolist():
            outline = self.cache.outline(subject_index)
            if outline is None:
                continue
            try:
                inputs, targets = draw_views(view_generator(seed, index), outline, input_count, self.sampling)
                seen = self.cache.some_views(subject_index, [*inputs, *targets])
                order_of = range(len(seen.frames))
                return Example(
                    subject_views(seen, order_of[: len(inputs)], self.input_size),
                    subject_views(seen, order_of[len(inputs) :], self.target_size),
                )
            except (ValueError, OSError) as error:
                self.cache.report(subject_index, f"{self.cache.folders[subject_index]}: {error}")
        raise ValueError(f"none of the {len(self.cache)} capture folders can be used")
