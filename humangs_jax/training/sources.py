"""Sources of a run's examples: capture folders, data sets, synthetic people made during training,
or several of these.

A run makes a new source at every stage, because image sizes differ.
"""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from humangs_jax.body.model import BodyModel
from humangs_jax.core.checks import FINITE, UNIT, check_values
from humangs_jax.core.pytree import inexact_leaves
from humangs_jax.core.registry import imported
from humangs_jax.data.capture import DEFAULT_BODY
from humangs_jax.data.datasets.subject import FileBody, open_people
from humangs_jax.data.loading import (
    CaptureCache,
    CaptureSource,
    Example,
    Loader,
    Mixture,
    PeopleCache,
    Source,
)
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.sets import MANIFEST
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.sharding import batch_sharding

logger = logging.getLogger(__name__)

SYNTHETIC = "humangs_jax.synthetic"
"""Name of the package of synthetic people. A run without synthetic people does not import it."""
SourceFactory = Callable[[TrainConfig], Source]
"""Function that takes the configuration of a stage, and returns a source of examples of the stage's
sizes.
"""


def stage_loader(
    make_source: SourceFactory, config: TrainConfig, step: int, mesh: Mesh | None = None
) -> Loader:
    """Returns a loader of the batches from `step` on, for the stage that this step belongs to."""
    part = config.at(step)
    sharding = None
    if mesh is not None:
        sharding = batch_sharding(mesh)
    before = config.examples_before(step)
    return Loader(
        make_source(part),
        part.batch_size,
        part.seed,
        sharding,
        first_step=step,
        first_example=before,
    )


def bad_samples(loader: Loader, step: int, batch: Example | None = None) -> list[str]:
    """Returns a line for each bad sample of this process in a step. A sample is bad if it has
    numbers that are not finite, or colors or masks beyond [0, 1].

    batch: the batch of that step, on one device. None: the batch is made again. A run need not keep
    its batches for this, because a loader is a pure function.
    """
    found, kinds = [], {"images": UNIT, "masks": UNIT}
    for i, row in enumerate(loader.rows):
        if batch is None:
            example = loader.example_at(step, row)
        else:
            example = jax.tree.map(lambda x, i=i: x[i], batch)
        leaves = {path: np.asarray(leaf) for path, leaf in inexact_leaves(example)}
        try:
            check_values(
                f"sample {row}",
                {path: (x, kinds.get(path.split(".")[-1], FINITE)) for path, x in leaves.items()},
            )
        except ValueError as error:
            found.append(f"{error} ({loader.describe_at(step, row)})")
    return found


def captured_people(
    folders: Sequence[str | Path], body: BodyModel, body_file: str | Path = DEFAULT_BODY
) -> SourceFactory:
    """Returns a function that makes a source of capture folders, whose parameters belong to `body`.
    Images are decoded once for all stages.
    """
    return _cached_people(CaptureCache(folders, body, body_file=body_file))


def _cached_people(cache: PeopleCache) -> SourceFactory:
    """Returns a function that makes a source of people on disk. Images are decoded once for all
    stages. Depths are unknown.
    """

    def make(config: TrainConfig) -> Source:
        depths = config.loss.depth > 0  # all examples of a mixture have the same arrays
        if depths:
            logger.warning(
                "people on disk have no depths: loss.depth (weight %g) is 0 for them",
                config.loss.depth,
            )
        return CaptureSource(
            cache, config.views, config.model.conventions.image_size, config.target_size, depths
        )

    return make


def mixed_people(parts: Sequence[SourceFactory], weights: Sequence[float | int]) -> SourceFactory:
    """Returns a function that makes a source that draws its examples from several sources, `parts`.
    weights: the share of each part, see `examples.Mixture`.
    """
    return lambda config: Mixture(tuple(part(config) for part in parts), tuple(weights))


def people_on_disk(data: Path, body: FileBody, split: str | None = "train") -> SourceFactory:
    """Returns a function that makes a source of the people in a folder of captures, a scene list or
    a data set (docs/datasets.md).

    body: the body model that the people's parameters belong to. split: the split that all people of
    a synthetic set must belong to, see `synthetic.writer.find_people`. None: any.
    Raises: ValueError if the folder holds none of these, or people of another split.
    """
    if (data / "capture.json").is_file() or any(data.glob("*/capture.json")):
        folders = find_captures(data)
        if split is not None and (data / MANIFEST).is_file():
            folders = imported(f"{SYNTHETIC}.writer:find_people")(data, split)
        return captured_people(folders, body.model, body.file)
    return _cached_people(PeopleCache(open_people(data, body)))


def training_people(
    data: Path | None,
    on_the_fly: int,
    out: Path,
    body: BodyModel,
    body_file: str | Path = DEFAULT_BODY,
) -> SourceFactory:
    """Returns a function that makes a source of people to train on.

    data: folder of people on disk, see `people_on_disk`; or None. on_the_fly: number of synthetic
    people, who are rendered for every step. One process makes these people once, into
    out/people.npz. With both, each kind makes half of the examples.

    Raises: ValueError if there is nobody, or if synthetic people are asked for with another body
    than the shipped one. Also as `people_on_disk`.
    """
    parts = []
    if data is not None:
        parts = [people_on_disk(data, FileBody(body, str(body_file)))]
    if on_the_fly and str(body_file) != DEFAULT_BODY:
        raise ValueError(
            f"synthetic people have the body that comes with the package, not {body_file}"
        )
    if on_the_fly:
        parts.append(imported(f"{SYNTHETIC}.sources:people_of_run")(on_the_fly, out, body))
    if not parts:
        raise ValueError(
            "nobody to train on: expected a folder of captures, or a number of people on the fly"
        )
    if len(parts) == 1:
        return parts[0]
    return mixed_people(parts, [1] * len(parts))
