"""Saves and restores the checkpoints of a run: the newest few and the best one. A checkpoint is
complete or does not exist, and it is restored bit for bit.

A checkpoint records a checksum of its arrays. A damaged checkpoint is never used: the run continues
from the newest good one and reports the damaged one.

Checkpoints are written while the run goes on. Each process writes what its devices hold. A run on
other devices can read them.

out/config.json          the configuration of the run
out/checkpoints/STEP             Orbax checkpoints of the TrainState, each with the score of the
                                 validation at its step, if there was one
out/checkpoints/damaged-STEP     those that could not be read, set aside
"""

import contextlib
import dataclasses
import json
import logging
import math
import operator
import zlib
from collections.abc import Generator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.configuration import config_to_json
from humangs_jax.io.atomic import write_text
from humangs_jax.io.reading import FileError, InvalidFileError, read_json, reading
from humangs_jax.training.config import TrainConfig, read_config
from humangs_jax.training.state import TrainState

logger = logging.getLogger("humangs_jax.training")
UNSCORED = -1e9
"""Score of a checkpoint that was saved without a score or with NaN. It is lower than any other."""
ADJUSTABLE = (
    "log_every",
    "validate_every",
    "checkpoint_every",
    "keep_checkpoints",
    "microbatch_size",
)
"""Settings that may change in the middle of a run. They do not change what the run computes, with
one exception: `microbatch_size` decides which subjects share batch statistics.
"""


class Checkpoints:
    """The checkpoints in a folder. `keep`: number of newest checkpoints that stay, besides the one
    with the highest score.

    read_only: nothing is written, deleted or set aside.
    Raises: FileError if `read_only` is set and the score of a checkpoint cannot be read.
    """

    def __init__(self, folder: str | Path, keep: int = 2, read_only: bool = False):
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

        folder, self._ocp, self._read_only = Path(folder).resolve(), ocp, read_only
        score = operator.itemgetter("score")
        kept = AnyPreservationPolicy([LatestN(keep), BestN(get_metric_fn=score, n=1)])
        options = ocp.CheckpointManagerOptions(
            best_fn=score,
            preservation_policy=kept,
            enable_async_checkpointing=True,
            create=not read_only,
            read_only=read_only,
        )
        unreadable = _without_score(folder)
        if unreadable:
            if read_only:
                raise FileError(
                    unreadable[0], "", "a damaged checkpoint: continue the run to have it set aside"
                )
            _set_aside(unreadable)
        logging.getLogger("absl").addFilter(_not_of_orbax)
        self._manager = ocp.CheckpointManager(folder, options=options)

    @property
    def steps(self) -> list[int]:
        """Steps that have a checkpoint, ascending."""
        return sorted(self._manager.all_steps())

    @property
    def best_step(self) -> int | None:
        """Step of the checkpoint with the highest score. None if there are no checkpoints."""
        return self._manager.best_step()

    def score(self, step: int) -> float | None:
        """Returns the score that a checkpoint was saved with. None if it was saved without a score
        or with NaN.
        """
        metrics = self._manager.metrics(step)
        unscored = metrics is None or metrics["score"] == UNSCORED or math.isnan(metrics["score"])
        return None if unscored else metrics["score"]

    def save(self, state: TrainState, score: float | None = None) -> None:
        """Writes the state under its step, in the background: see `wait`. The state may be donated
        afterwards.

        If that step has a checkpoint already, nothing is written. Raises: as `wait`, for this
        checkpoint or the one before.
        """
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        # where the next step would overwrite the memory that is being written
        if jax.default_backend() == "cpu":
            state = jax.tree.map(jnp.copy, state)
        scored = score is not None and not math.isnan(score)
        metrics = {"score": float(score) if scored else UNSCORED, CHECKSUM: _checksum(state)}
        with self._writing():
            self._manager.save(
                step, args=self._ocp.args.StandardSave(_as_dict(state)), metrics=metrics
            )

    def wait(self) -> None:
        """Waits until all checkpoints are on disk.

        Raises: FileError if one could not be written, as on a full disk.
        """
        with self._writing():
            self._manager.wait_until_finished()

    @contextlib.contextmanager
    def _writing(self) -> Generator[None]:
        try:
            yield
        except Exception as error:  # of many types: Orbax's own, TensorStore's, Python's
            raise FileError(
                self._manager.directory, "", f"a checkpoint cannot be written: {error}"
            ) from error

    def restore(self, like: TrainState, step: int | None = None) -> TrainState:
        """Returns the state of a step. If `step` is None, it is the newest state that is not
        damaged.

        like: a state of the same run, for structure, shapes and devices. Checkpoints that cannot be
        used are logged. They are set aside if an older one can be used, unless `read_only`.
        Raises: FileNotFoundError if there is no such checkpoint; FileError (a ValueError) if none
        can be used, because they are damaged or of another model.
        """
        self.wait()
        folder = Path(self._manager.directory)
        if step is None:
            steps = self.steps[::-1]
        elif step in self.steps:
            steps = [step]
        else:
            steps = []
        if not steps:
            wanted = "" if step is None else f" of step {step}"
            raise FileNotFoundError(f"{folder}: no checkpoint{wanted}")
        # the newest that is whole; newer ones, which are damaged, are then set aside
        damaged: list[Path] = []
        for candidate in steps:
            state, problem = self._restore(candidate, like)
            if state is not None:
                if damaged and not self._read_only:
                    _set_aside(damaged)
                    self._manager.reload()
                return state
            damaged.append(folder / str(candidate))
            logger.warning("%s: going back to the checkpoint before", problem)
        raise FileError(
            folder,
            "",
            f"none of {len(damaged)} checkpoints can be used, the last one tried: {problem}",
        )

    def _restore(self, step: int, like: TrainState) -> tuple[TrainState | None, str]:
        """Returns the state of a step and "", or None and a text that says what is wrong. All
        processes get the same result.
        """
        path, wanted = Path(self._manager.directory) / str(step), _as_dict(like)
        state, problem = None, ""
        try:
            with reading(path, "checkpoint"):
                described = self._ocp.StandardCheckpointHandler().metadata(
                    self._manager.directory / str(step) / "default"
                )
                # another model has other shapes: it is refused before anything is read
                shapes = sorted(
                    x.shape for x in jax.tree.leaves(getattr(described, "tree", described))
                )
                if shapes != sorted(x.shape for x in jax.tree.leaves(wanted)):
                    raise InvalidFileError("its arrays are those of another model")
                abstract = jax.tree.map(self._ocp.utils.to_shape_dtype_struct, wanted)
                restored = self._manager.restore(
                    step, args=self._ocp.args.StandardRestore(abstract)
                )
                state = TrainState(**jax.tree.map(_placed_as, restored, wanted))
        except (FileError, FileNotFoundError) as error:
            problem = str(error)
        # a checkpoint may be whole and still hold other numbers
        recorded = (self._manager.metrics(step) or {}).get(CHECKSUM)
        found = None if state is None else _checksum(state)
        if state is not None and recorded != found:
            state = None
            problem = (
                f"{path}: damaged: its arrays have the checksum {found}, recorded is {recorded}"
            )
        # one process that cannot read it stops all, or they would go on from different steps
        if not _everywhere(state is not None).all():
            state, problem = None, problem or f"{path}: damaged, as another process found"
        return state, problem

    def close(self) -> None:
        """Waits for checkpoints that are being written, and releases what Orbax holds. Raises: as
        `wait`.
        """
        with self._writing():
            self._manager.close()


CHECKSUM = "checksum"
"""Key of the checksum among the metrics of a checkpoint."""


def _everywhere(value: Any) -> np.ndarray:
    """Returns the values of all processes, one after the other along a new first axis."""
    if jax.process_count() == 1:
        return np.asarray(value)[None]
    from jax.experimental import multihost_utils

    return np.asarray(multihost_utils.process_allgather(np.asarray(value)))


def _checksum(state: TrainState) -> str:
    """Returns a checksum of all arrays, 64 bits in hexadecimal. It is a weighted sum of their
    entries, read as unsigned integers. The weights are odd, and depend on an entry's array and
    place.

    If any one entry changes, the checksum changes. It does not depend on how arrays are divided
    among devices, because each process adds the shards that it holds.
    """
    total = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(_as_dict(state)):
        own = [
            _weighted_sum(shard, leaf.shape)
            for shard in leaf.addressable_shards
            if shard.replica_id == 0
        ]
        total += (zlib.crc32(jax.tree_util.keystr(path).encode()) | 1) * sum(own)
    total %= 1 << 64
    halves = _everywhere(np.asarray([total >> 32, total & 0xFFFFFFFF], np.uint32))
    return f"{sum((int(high) << 32) + int(low) for high, low in halves) % (1 << 64):016x}"


def _weighted_sum(shard: Any, shape: tuple[int, ...]) -> int:
    data = np.asarray(shard.data)
    words = data.reshape(-1).view(f"u{data.itemsize}").astype(np.uint64)
    axes = [
        np.arange(size) + (part.start or 0)
        for size, part in zip(data.shape, shard.index, strict=True)
    ]
    if shape:
        places = np.ravel_multi_index(np.ix_(*axes), shape).reshape(-1)
    else:
        places = np.zeros(1)
    return int(((2 * places.astype(np.uint64) + 1) * words).sum(dtype=np.uint64))


def _without_score(folder: Path) -> list[Path]:
    """Returns the folders of the checkpoints whose score cannot be read. Orbax would raise an error
    for the first of them.
    """
    found = []
    for step in sorted(
        path for path in folder.glob("[0-9]*") if path.name.isdecimal() and path.is_dir()
    ):
        try:
            readable = isinstance(read_json(step / "metrics" / "metrics")["score"], int | float)
        except (OSError, ValueError, LookupError, TypeError):
            readable = False
        if not readable:
            found.append(step)
    return found


def _set_aside(steps: list[Path]) -> None:
    """Renames damaged checkpoints, so that their steps can be saved again. Nothing is deleted."""
    for step in steps if jax.process_index() == 0 else ():
        numbers = ("", *(f"-{i}" for i in range(1, 1000)))
        places = (step.with_name(f"damaged-{step.name}{i}") for i in numbers)
        aside = next(place for place in places if not place.exists())
        step.rename(aside)
        logger.warning("%s: a damaged checkpoint, set aside as %s", step, aside.name)
    _everywhere(0)  # all processes wait for it


def save_config(out: str | Path, config: TrainConfig, write: bool = True) -> None:
    """Writes out/config.json, after a check against the file that is there. write: whether to write
    the file, or only to check.

    The settings `ADJUSTABLE` may differ from the file. A finished run may get more steps. It then
    continues with the learning rate of the longer run.

    Raises: ValueError, which names a field, if another setting differs; ValueError if the file that
    is there holds no configuration; OSError if the file cannot be written.
    """
    path = Path(out) / "config.json"
    if path.is_file():
        earlier, now = (
            _flat(json.loads(config_to_json(run))) for run in (load_config(out), config)
        )
        finished = (Path(out) / "checkpoints" / str(earlier["steps"])).is_dir()
        if finished and now["steps"] > earlier["steps"]:
            longer = {"steps"}
        else:
            longer = set()
        for name in sorted((earlier.keys() | now.keys()) - set(ADJUSTABLE) - longer):
            if earlier.get(name) != now.get(name):
                other = f"{name} = {earlier.get(name)}, not {now.get(name)}"
                raise ValueError(f"{path}: this run was started with {other}: use another folder")
    if write:
        write_text(path, config_to_json(config, indent=1))


def load_config(out: str | Path) -> TrainConfig:
    """Returns the configuration of the run in a folder.

    Raises: FileNotFoundError if there is no config.json; ValueError, which names the file, if it
    holds no configuration of a run.
    """
    path = Path(out) / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no run here")
    return read_config(path)


def _placed_as(value: jax.Array, like: jax.Array) -> jax.Array:
    """Returns a restored array on the devices of `like`. An array that is partly on devices of
    other processes is returned as it is.

    If `like` is uncommitted, so is the result, and nothing is compiled again. It is a copy, whose
    buffer is XLA's own and can be donated. A committed result may share its memory with `value` on
    CPUs. A donation then does not use its buffer again.
    """
    if not value.is_fully_addressable:
        return value
    host = jax.device_get(value)
    if like.committed:
        return jax.device_put(host, like.sharding)
    return jnp.asarray(host)


def _as_dict(state: TrainState) -> dict[str, Any]:
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def _flat(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Returns nested dicts as one dict with paths as keys: {"loss.squared": 1.0, ...}."""
    items = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            items |= _flat(value, f"{prefix}{name}.")
        else:
            items[f"{prefix}{name}"] = value
    return items


def _not_of_orbax(record: logging.LogRecord) -> bool:
    """Returns whether absl's logger shows a record: False for Orbax, which logs every step and
    prints in full the errors that it also raises.
    """
    return "orbax" not in Path(record.pathname).parts
