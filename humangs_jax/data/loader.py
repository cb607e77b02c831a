"""Training examples from capture folders: which views of whom is a pure function of (seed, step).

Example e = step * batch + i of a run sees subject number e mod n in a permutation drawn for each pass over the n
folders, and its views are drawn by a generator of their own, so a run that resumes at step t sees exactly what it would
have seen. Subjects are kept decoded as bytes; a thread prepares the next batches meanwhile. A folder that cannot be
used is skipped for the next one in the order, named in the log once, and listed in `CaptureCache.broken`.
"""

import dataclasses
import logging
import queue
import threading
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Float, Int, UInt8
from humangs_jax.body.model import BodyModel
from humangs_jax.data.capture import load_capture
from humangs_jax.data.images import to_uint8
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera
from humangs_jax.pytree import pytree_dataclass

logger = logging.getLogger(__name__)

ORDER_STREAM, VIEW_STREAM, BATCH_STREAM = 0, 1, 2
"""First entry of the seeds: what a generator is for, so that no two purposes share random numbers."""


@dataclasses.dataclass(frozen=True)
class ViewSampling:
    """Which views of a subject are shown and which are asked for.

    input_counts: numbers of input views; one is drawn per step (each compiles once). target_count: views asked for.
    jitter: inputs stand evenly around the subject, each off by up to half this share of the spacing.
    scattered_share: share of examples whose inputs stand anywhere instead.
    mixed_pose_share: share of examples whose inputs may each show another pose (frame).
    Targets are drawn from all other views of the subject, of whatever pose.
    """

    input_counts: tuple[int, ...] = (4,)
    target_count: int = 3
    jitter: float = 0.7
    scattered_share: float = 0.2
    mixed_pose_share: float = 0.3


class StoredSubject(NamedTuple):
    """A decoded capture as bytes on the host; azimuths (v,) of the cameras, radians, are what views are chosen by."""

    images: UInt8[np.ndarray, "v h w 3"]
    masks: UInt8[np.ndarray, "v h w"]
    K: Float[np.ndarray, "v 3 3"]
    cam_from_world: Float[np.ndarray, "v 4 4"]
    frames: Int[np.ndarray, " v"]
    azimuths: Float[np.ndarray, " v"]
    rotations: Float[np.ndarray, "m j 3"]
    translations: Float[np.ndarray, "m 3"]
    betas: Float[np.ndarray, " s"]

    @property
    def size_bytes(self) -> int:
        """Memory that the arrays take."""
        return sum(array.nbytes for array in self)


@pytree_dataclass
class Example:
    """One subject to learn from: the views shown and the views asked for, possibly at another image size."""

    inputs: SubjectViews
    targets: SubjectViews


def find_captures(root: str | Path) -> tuple[Path, ...]:
    """The capture folders directly inside a folder, sorted by name; the folder itself if it is a capture.

    Raises: ValueError if there is none.
    """
    root = Path(root)
    folders = [root] if (root / "capture.json").is_file() else sorted(p.parent for p in root.glob("*/capture.json"))
    if not folders:
        raise ValueError(f"{root}: no capture folder here (a folder with a capture.json)")
    return tuple(folders)


def store_capture(path: str | Path, body: BodyModel) -> StoredSubject:
    """Read a capture folder whose parameters belong to `body`. Raises: ValueError naming file and field."""
    capture = load_capture(path, body=body)
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
    """Capture folders, decoded when first asked for and kept as bytes up to a limit; later ones are read every time.

    broken: folder -> what is wrong with it, in the order of discovery.
    """

    def __init__(self, folders: Sequence[str | Path], body: BodyModel, limit_bytes: int = 4 << 30):
        if not folders:
            raise ValueError("no capture folders")
        self.folders = tuple(Path(folder) for folder in folders)
        self.broken: dict[Path, str] = {}
        self._body, self._free_bytes = body, limit_bytes
        self._stored: dict[Path, StoredSubject] = {}

    def __len__(self) -> int:
        return len(self.folders)

    def load(self, index: int) -> StoredSubject | None:
        """The subject of folder `index`; None if it is broken, which is told once."""
        folder = self.folders[index]
        if folder in self.broken:
            return None
        if folder in self._stored:
            return self._stored[folder]
        try:
            subject = store_capture(folder, self._body)
        except (ValueError, OSError) as error:
            self.report(index, str(error))
            return None
        if subject.size_bytes <= self._free_bytes:
            self._stored[folder] = subject
            self._free_bytes -= subject.size_bytes
        return subject

    def report(self, index: int, problem: str) -> None:
        """Leave folder `index` out from now on.

        Raises: ValueError, naming the last problem, once every folder is left out.
        """
        folder = self.folders[index]
        self.broken[folder] = problem
        self._stored.pop(folder, None)
        logger.warning("left out %s (%d of %d folders so far): %s", folder, len(self.broken), len(self), problem)
        if len(self.broken) == len(set(self.folders)):
            raise ValueError(f"none of the {len(self)} capture folders can be used; the last one: {problem}")


def subject_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " count"]:
    """The order of subjects in one pass over them."""
    return np.random.default_rng([ORDER_STREAM, seed, epoch]).permutation(count)


def nearest_view(subject: StoredSubject, azimuth: float, allowed: np.ndarray) -> int:
    """The allowed view (bool, (v,)) whose camera stands closest to an azimuth."""
    away = np.abs(np.angle(np.exp(1j * (subject.azimuths - azimuth))))
    return int(np.argmin(np.where(allowed, away, np.inf)))


def draw_views(
    generator: np.random.Generator, subject: StoredSubject, input_count: int, sampling: ViewSampling
) -> tuple[list[int], list[int]]:
    """Disjoint indices of input and target views.

    Raises: ValueError if the subject has too few views for the largest of the input counts, whichever this one is: a
    subject is usable or not, independent of the step.
    """
    count, needed = len(subject.frames), max(sampling.input_counts) + sampling.target_count
    if count < needed:
        raise ValueError(f"{count} views, but inputs and targets need {needed}")
    spacing = 2 * np.pi / input_count
    azimuths = generator.uniform(0, 2 * np.pi) + spacing * (
        np.arange(input_count) + sampling.jitter * generator.uniform(-0.5, 0.5, input_count)
    )
    if generator.random() < sampling.scattered_share:
        azimuths = generator.uniform(0, 2 * np.pi, input_count)
    poses = np.unique(subject.frames)
    slots = np.full(input_count, generator.choice(poses))
    if generator.random() < sampling.mixed_pose_share:
        slots = generator.choice(poses, input_count)
    free, inputs = np.ones(count, bool), []
    for azimuth, frame in zip(azimuths, slots, strict=True):
        allowed = free & (subject.frames == frame)
        inputs.append(nearest_view(subject, azimuth, allowed if allowed.any() else free))
        free[inputs[-1]] = False
    return inputs, generator.choice(np.flatnonzero(free), sampling.target_count, replace=False).tolist()


def shrink(images: UInt8[np.ndarray, "v h w *c"], size: int) -> Float[np.ndarray, "v size size *c"]:
    """Bytes box-averaged to size x size, in [0, 1]. Raises: ValueError unless both sides are one multiple of it."""
    height, width = images.shape[1:3]
    factor = height // size
    if factor < 1 or (height, width) != (factor * size, factor * size):
        raise ValueError(f"images of {width} x {height} cannot be box-averaged to {size} x {size}")
    if factor > 1:
        blocks = images.reshape(len(images), size, factor, size, factor, *images.shape[3:])
        images = blocks.mean(axis=(2, 4), dtype=np.float32)
    return images.astype(np.float32) / np.float32(255)


def subject_views(subject: StoredSubject, indices: Sequence[int], size: int) -> SubjectViews:
    """Some views of a stored subject at size x size pixels. Raises: ValueError, see `shrink`."""
    chosen = np.asarray(indices)
    height, width = subject.images.shape[1:3]
    matrices = jnp.asarray(subject.K[chosen]), jnp.asarray(subject.cam_from_world[chosen])
    cameras = jax.vmap(lambda K, cam_from_world: Camera(K, cam_from_world, width, height))(*matrices)
    frames = subject.frames[chosen]
    return SubjectViews(
        images=jnp.asarray(shrink(subject.images[chosen], size)),
        masks=jnp.asarray(shrink(subject.masks[chosen], size)),
        cameras=cameras.resized(size, size),
        rotations=jnp.asarray(subject.rotations[frames]),
        translations=jnp.asarray(subject.translations[frames]),
        betas=jnp.asarray(subject.betas),
    )


@dataclasses.dataclass(frozen=True)
class ExampleSource:
    """Batches by step number. input_size, target_size: pixels a side of the square views."""

    cache: CaptureCache
    sampling: ViewSampling
    input_size: int
    target_size: int
    batch_size: int = 1
    seed: int = 0

    def batch_at(self, step: int) -> Example:
        """The batch of a step: an `Example` with a leading axis of `batch_size` on every leaf."""
        counts = self.sampling.input_counts
        input_count = counts[int(np.random.default_rng([BATCH_STREAM, self.seed, step]).integers(len(counts)))]
        examples = [self.example_at(step * self.batch_size + i, input_count) for i in range(self.batch_size)]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *examples)

    def example_at(self, index: int, input_count: int) -> Example:
        """The index-th example of the run; the next usable subject in the order replaces a broken one."""
        epoch, position = divmod(index, len(self.cache))
        order = subject_order(self.seed, epoch, len(self.cache))
        for subject_index in np.roll(order, -position).tolist():
            subject = self.cache.load(subject_index)
            if subject is None:
                continue
            generator = np.random.default_rng([VIEW_STREAM, self.seed, index])
            try:
                inputs, targets = draw_views(generator, subject, input_count, self.sampling)
                return Example(
                    subject_views(subject, inputs, self.input_size), subject_views(subject, targets, self.target_size)
                )
            except ValueError as error:
                self.cache.report(subject_index, f"{self.cache.folders[subject_index]}: {error}")
        raise ValueError(f"none of the {len(self.cache)} capture folders can be used")

    def batches(self, start: int, stop: int, ahead: int = 2) -> Generator[tuple[int, Example], None, None]:
        """(step, batch) for start <= step < stop, `ahead` batches prepared by a thread; its errors are raised here.

        Closing the generator (or leaving the loop over it) ends the thread.
        """
        ready: queue.Queue = queue.Queue(maxsize=ahead)
        stopped = threading.Event()

        def put(item):
            while not stopped.is_set():
                try:
                    ready.put(item, timeout=0.1)
                    return
                except queue.Full:
                    continue

        def produce():
            try:
                for step in range(start, stop):
                    if stopped.is_set():
                        return
                    put((step, self.batch_at(step), None))
                put((stop, None, None))
            except Exception as error:  # a thread must hand over whatever ends it
                put((stop, None, error))

        thread = threading.Thread(target=produce, name="humangs-loader", daemon=True)
        thread.start()
        try:
            while True:
                step, batch, error = ready.get()
                if error is not None:
                    raise error
                if batch is None:
                    return
                yield step, batch
        finally:
            stopped.set()
            thread.join()
