"""Makes the examples to learn from: some views of a subject are the input, others the targets. The
module also has the order of examples, and mixtures of sources.

All of it is numpy, and pure functions of (seed, number). If all batches have one size, row i of the
batch of a step is example number step * size + i. So a run resumes from its step alone. Each
purpose draws from a separate stream of random numbers.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.core.configuration import Count, Share, Spread, configuration
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import resized

WINDOW = (25, 59)
"""Least and greatest distance between the two ends of a window, as numbers of views, for a subject
that has `WINDOW_OF` views. See the rule "window" of `ViewSampling`.
"""
WINDOW_OF = 60


@configuration
class ViewSampling:
    """Which views of a subject are input and which are targets."""

    input_counts: tuple[Count, ...] = (4,)
    """Numbers of input views. Each step draws one of them; each is compiled once."""
    target_count: Count = 3
    """The number of target views."""
    jitter: Spread = 0.7
    """Largest random change of an input's azimuth, as a share of half the spacing. Without it,
    inputs stand evenly around the subject.
    """
    scattered_share: Share = 0.2
    """The share of examples whose inputs stand at random azimuths, not evenly around the
    subject.
    """
    mixed_pose_share: Share = 0.3
    """The share of examples in which the pose (frame) of each input is drawn separately. In the
    others all inputs show one pose, if there are enough views of it.
    """
    rule: Literal["random", "window"] = "random"
    """How inputs and targets are drawn.

    "random": inputs stand around the subject. Targets are drawn from all other views, of any pose.

    "window": the rule of the release. A random window in the order of the views is drawn. For a
    subject with 60 views, its two ends are 25 to 59 views apart, and in proportion for others. The
    two ends are taken first, then random views between them. The views that are taken first are
    inputs, the others are targets. jitter, scattered_share and mixed_pose_share are not used.
    """


class StoredSubject(NamedTuple):
    """A capture on the host. Images and masks are bytes; in a summary they hold no views."""

    images: UInt8[np.ndarray, "v h w 3"]
    """The photos on white, (v, h, w, 3)."""
    masks: UInt8[np.ndarray, "v h w"]
    """The coverage by the person, (v, h, w)."""
    K: Float[np.ndarray, "v 3 3"]
    """The camera matrices, (v, 3, 3), pixels."""
    cam_from_world: Float[np.ndarray, "v 4 4"]
    """From the world to the cameras, (v, 4, 4), metres, OpenCV axes."""
    frames: Int[np.ndarray, " v"]
    """The pose that each view shows, (v,)."""
    azimuths: Float[np.ndarray, " v"]
    """The azimuths of the cameras around their middle, (v,), radians. Views are chosen by them."""
    rotations: Float[np.ndarray, "m j 3"]
    """Axis-angle rotations of the m poses, (m, j, 3), radians."""
    translations: Float[np.ndarray, "m 3"]
    """Translations of the poses, (m, 3), metres."""
    betas: Float[np.ndarray, " s"]
    """Shape coefficients, (s,)."""

    @classmethod
    def without_photos(
        cls,
        size: tuple[int, int],
        K: np.ndarray,
        cam_from_world: np.ndarray,
        frames: np.ndarray,
        *body: np.ndarray,
    ) -> "StoredSubject":
        """Returns a subject whose arrays of images and masks hold no views yet. size: the height
        and the width of the photos, pixels. body: rotations, translations, betas.
        """
        centers = -np.einsum("vji,vj->vi", cam_from_world[:, :3, :3], cam_from_world[:, :3, 3])
        offsets = centers - centers.mean(axis=0)
        images, masks = np.zeros((0, *size, 3), np.uint8), np.zeros((0, *size), np.uint8)
        azimuths = np.arctan2(offsets[:, 0], offsets[:, 2])
        arrays = (np.asarray(x, np.float32) for x in (K, cam_from_world))
        return cls(
            images, masks, *arrays, frames, azimuths, *(np.asarray(x, np.float32) for x in body)
        )


@pytree_dataclass
class Example:
    """One subject to learn from. Targets may have another image size than inputs."""

    inputs: SubjectViews
    """The views that the network sees."""
    targets: SubjectViews
    """The views that its avatar is compared with."""


@runtime_checkable
class Source(Protocol):
    """Examples by number. A source may be capture folders, written sets, people made on the fly, or
    a mixture of these.

    `example` is a pure function of its arguments and of the files behind the source: the same on
    every host, in every thread, in any order. Its leaves are numpy arrays, or arrays on a device if
    they were made there.
    """

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        ...

    @property
    def broken(self) -> Mapping[str, str]:
        """The first fault that was found in each person so far, by the person's name. People
        without a fault are not listed.
        """
        ...

    def __len__(self) -> int:
        """Returns the number of examples (subjects) in one pass."""
        ...

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """Returns the index-th example that a run of this seed takes from this source, with
        `input_count` input views.

        Raises: ValueError if nothing of the source can be used.
        """
        ...

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """Returns in words which person, or which person and views, this example shows, for
        reports. It may take as long as `example`.
        """
        ...


def nearest_view(subject: StoredSubject, azimuth: float, allowed: np.ndarray) -> int:
    """Returns the allowed view whose camera stands closest to an azimuth (radians). allowed: bool,
    (v,).
    """
    away = np.abs(np.angle(np.exp(1j * (subject.azimuths - azimuth))))
    return int(np.argmin(np.where(allowed, away, np.inf)))


def sample_views(
    generator: np.random.Generator, subject: StoredSubject, input_count: int, sampling: ViewSampling
) -> tuple[list[int], list[int]]:
    """Returns the indices of the input views and of the target views, which are disjoint.

    Raises: ValueError if the subject has fewer views than the largest of the input counts plus the
    number of targets, even if `input_count` is smaller. So whether a subject is usable does not
    depend on the step.
    """
    count, needed = len(subject.frames), max(sampling.input_counts) + sampling.target_count
    if count < needed:
        raise ValueError(f"{count} views, but inputs and targets need {needed}")
    if sampling.rule == "window":
        drawn = _draw_from_window(generator, count, input_count + sampling.target_count)
        return drawn[:input_count], drawn[input_count:]
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
    return inputs, generator.choice(
        np.flatnonzero(free), sampling.target_count, replace=False
    ).tolist()


def _draw_from_window(generator: np.random.Generator, count: int, wanted: int) -> list[int]:
    """Returns `wanted` of `count` views: the two ends of a random window, then random views inside
    of it.
    """
    smallest, largest = (min(count - 1, round(count * views / WINDOW_OF)) for views in WINDOW)
    distance = int(generator.integers(max(smallest, wanted - 1), max(largest, wanted - 1) + 1))
    first = int(generator.integers(count - distance))
    inside = first + 1 + generator.choice(distance - 1, wanted - 2, replace=False)
    return [first, first + distance, *inside.tolist()]


def shrink(images: UInt8[np.ndarray, "v h w *c"], size: int) -> Float[np.ndarray, "v size size *c"]:
    """Returns images of bytes averaged by area to size x size pixels, in [0, 1].

    Raises: ValueError unless the images are squares of at least that size.
    """
    height, width = images.shape[1:3]
    if not size <= height == width:
        raise ValueError(f"images of {width} x {height} cannot be averaged to {size} x {size}")
    found = np.empty((len(images), size, size, *images.shape[3:]), np.float32)
    for small, image in zip(found, images, strict=True):
        small[:] = resized(image, size, size)
    return found / np.float32(255)


def subject_views(
    subject: StoredSubject, indices: Sequence[int], size: int, depths: bool = False
) -> SubjectViews:
    """Returns some views of a stored subject at size x size pixels, with numpy leaves.

    depths: whether the views get depths, all of them unknown.

    Raises: ValueError, see `shrink`.
    """
    chosen = np.asarray(indices)
    height, width = subject.images.shape[1:3]
    scale = np.asarray([size / width, size / height, 1.0], np.float32)
    frames = subject.frames[chosen]
    return _on_host(
        SubjectViews,
        images=shrink(subject.images[chosen], size),
        masks=shrink(subject.masks[chosen], size),
        cameras=_on_host(
            Camera,
            K=subject.K[chosen] * scale[:, None],
            cam_from_world=subject.cam_from_world[chosen],
            width=size,
            height=size,
        ),
        rotations=subject.rotations[frames],
        translations=subject.translations[frames],
        betas=subject.betas,
        depths=np.zeros((len(chosen), size, size), np.float32) if depths else None,
    )


def _on_host(cls: type, **fields: Any) -> Any:
    """Returns a pytree of numpy leaves. The constructor of `cls` would insist on arrays on a
    device.
    """
    tree = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(tree, name, value)
    return tree


# Order
# --------------------------------------------------------------------------------------------------

ORDER_STREAM = 0
"""The first entry of the seed for the order of an epoch. Each purpose has another first entry, so
that no two purposes share random numbers.
"""
VIEW_STREAM = 1
"""The first entry of the seed for the views of an example."""
BATCH_STREAM = 2
"""The first entry of the seed for the number of views of a batch."""
MIX_STREAM = 3
"""The first entry of the seed for the order of mixed sources."""
SUBJECT_STREAM = 4
"""The first entry of the seed for the people that are made while training."""

MIX_BLOCK = 256
"""Number of examples in a block. The shares of mixed sources are the same in each block. Each
source has at least one example in a block, however small its weight is.
"""


def subject_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " count"]:
    """Returns the order of subjects in one pass over them: a permutation of 0 to `count` - 1."""
    return np.random.default_rng([ORDER_STREAM, seed, epoch]).permutation(count)


def view_generator(seed: int, index: int) -> np.random.Generator:
    """Returns the random generator for the views of the index-th example of a source."""
    return np.random.default_rng([VIEW_STREAM, seed, index])


def input_count_at(seed: int, step: int, counts: Sequence[int]) -> int:
    """Returns the number of input views of a step."""
    return counts[int(np.random.default_rng([BATCH_STREAM, seed, step]).integers(len(counts)))]


def block_counts(weights: Sequence[float | int]) -> Int[np.ndarray, " sources"]:
    """Returns how many of `MIX_BLOCK` examples come from each source; every source has at least
    one.

    Raises: ValueError unless there are 1 to `MIX_BLOCK` weights, all positive and finite.
    """
    shares = np.asarray(weights, np.float64)
    if (
        len(shares) == 0
        or len(shares) > MIX_BLOCK
        or not (np.isfinite(shares).all() and (shares > 0).all())
    ):
        raise ValueError(
            f"weights of mixed sources: expected positive numbers, got {list(weights)}"
        )
    exact = MIX_BLOCK * shares / shares.sum()
    counts = np.maximum(np.floor(exact), 1).astype(int)
    while counts.sum() != MIX_BLOCK:  # by largest remainder
        step = 1 if counts.sum() < MIX_BLOCK else -1
        error = step * (exact - counts)
        counts[np.argmax(np.where(counts + step >= 1, error, -np.inf))] += step
    return counts


def source_at(seed: int, index: int, counts: Int[np.ndarray, " sources"]) -> tuple[int, int]:
    """Returns which source the index-th example comes from, and its number among the examples of
    that source.

    Each block of `MIX_BLOCK` examples has the same number of examples of each source, in a random
    order. Each source provides its examples 0, 1, 2, ... without a gap.
    """
    block, position = divmod(index, MIX_BLOCK)
    labels = np.repeat(np.arange(len(counts)), counts)
    labels = np.random.default_rng([MIX_STREAM, seed, block]).permutation(labels)
    source = int(labels[position])
    return source, block * int(counts[source]) + int((labels[:position] == source).sum())


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Sources mixed by weight, see `source_at`.

    Raises: ValueError if there are not as many weights as sources, or for weights that
    `block_counts` refuses. Also if the sources have different `input_counts`, since all examples of
    a step have the same number of inputs.
    """

    sources: tuple[Source, ...]
    """The sources."""
    weights: tuple[float | int, ...]
    """A positive weight for each source. Only the ratios between weights matter."""

    def __post_init__(self):
        if len(self.sources) != len(self.weights):
            raise ValueError(f"{len(self.sources)} sources, but {len(self.weights)} weights")
        block_counts(self.weights)
        if len({source.input_counts for source in self.sources}) > 1:
            raise ValueError(
                f"input_counts differ: {[source.input_counts for source in self.sources]}"
            )

    @functools.cached_property
    def _counts(self) -> Int[np.ndarray, " sources"]:
        return block_counts(self.weights)

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        return self.sources[0].input_counts

    @property
    def broken(self) -> Mapping[str, str]:
        """The first fault that was found in each person of all sources so far, by the person's
        name.
        """
        return {name: problem for source in self.sources for name, problem in source.broken.items()}

    def __len__(self) -> int:
        return sum(len(source) for source in self.sources)

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """See `Source`."""
        source, number = source_at(seed, index, self._counts)
        return self.sources[source].example(seed, number, input_count)

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """See `Source`."""
        source, number = source_at(seed, index, self._counts)
        return self.sources[source].describe(seed, number, input_count)
