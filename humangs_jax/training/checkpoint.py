"""Checkpoints of a run: the newest few and the best, each complete or not there, bit for bit what was saved.

They are written while the run goes on, by all processes together, each what its devices hold; a run on other devices reads
them as well.

out/config.json          the configuration of the run
out/checkpoints/STEP     Orbax checkpoints of the TrainState, with the score of their validation
"""

import contextlib
import dataclasses
import json
import logging
from collections.abc import Generator
from pathlib import Path

import jax
import jax.numpy as jnp

from humangs_jax.core.configuration import config_to_json
from humangs_jax.io.atomic import write_text
from humangs_jax.training.config import TrainConfig, read_config
from humangs_jax.training.state import TrainState

UNSCORED = -1e9
"""Score of a checkpoint that was saved before any validation: worse than every other."""
ADJUSTABLE = ("log_every", "validate_every", "checkpoint_every", "keep_checkpoints", "microbatch_size")
"""What may change in the middle of a run without changing its numbers (but for shared batch statistics)."""


class Checkpoints:
    """The checkpoints in a folder. `keep`: how many of the newest stay, besides the one of the highest score.

    read_only: nothing is written, deleted or tidied up.
    """

    def __init__(self, folder: str | Path, keep: int = 2, read_only: bool = False):
        import orbax.checkpoint as ocp
        from orbax.checkpoint.checkpoint_managers import AnyPreservationPolicy, BestN, LatestN

        def score(metrics):
            return metrics["score"]

        self._ocp = ocp
        kept = AnyPreservationPolicy([LatestN(keep), BestN(get_metric_fn=score, n=1)])
        options = ocp.CheckpointManagerOptions(
            best_fn=score,
            preservation_policy=kept,
            enable_async_checkpointing=True,
            create=not read_only,
            read_only=read_only,
        )
        with _quiet():
            self._manager = ocp.CheckpointManager(Path(folder).resolve(), options=options)

    @property
    def steps(self) -> list[int]:
        """Steps of which there is a checkpoint, ascending."""
        return sorted(self._manager.all_steps())

    @property
    def best_step(self) -> int | None:
        """The step of the highest score, None without checkpoints."""
        return self._manager.best_step()

    def score(self, step: int) -> float | None:
        """The score that a checkpoint was saved with."""
        metrics = self._manager.metrics(step)
        return None if metrics is None or metrics["score"] == UNSCORED else metrics["score"]

    def save(self, state: TrainState, score: float | None = None) -> None:
        """Write the state under its step, in the background: see `wait`. The state may be donated afterwards.

        A step that is there already is left as it is.
        """
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        if (
            jax.default_backend() == "cpu"
        ):  # where what is written would be the very memory that the next step overwrites
            state = jax.tree.map(jnp.copy, state)
        metrics = {"score": UNSCORED if score is None else float(score)}
        with _quiet():
            self._manager.save(step, args=self._ocp.args.StandardSave(_as_dict(state)), metrics=metrics)

    def wait(self) -> None:
        """Return when all that was saved is on disk. Raises: what went wrong in the background."""
        with _quiet():
            self._manager.wait_until_finished()

    def restore(self, like: TrainState, step: int | None = None) -> TrainState:
        """The state of a step (None: the newest). `like`: a state of the same run, for structure, shapes and devices.

        Raises: FileNotFoundError if there is no such checkpoint; ValueError if it is of another model.
        """
        step = self._manager.latest_step() if step is None else step
        if step is None or step not in self._manager.all_steps():
            raise FileNotFoundError(
                f"{self._manager.directory}: no checkpoint{'' if step is None else f' of step {step}'}"
            )
        abstract = jax.tree.map(self._ocp.utils.to_shape_dtype_struct, _as_dict(like))
        with _quiet():
            restored = self._manager.restore(step, args=self._ocp.args.StandardRestore(abstract))
        return TrainState(**jax.tree.map(_placed_as, restored, _as_dict(like)))

    def close(self) -> None:
        """Wait for what is being written, and release what Orbax holds."""
        with _quiet():
            self._manager.close()


def save_config(out: str | Path, config: TrainConfig, write: bool = True) -> None:
    """Write out/config.json, or check the one that is there. write: only check otherwise.

    Raises: ValueError, naming a field, if the folder belongs to a run of another configuration.
    """
    path = Path(out) / "config.json"
    if path.is_file():
        earlier, now = (_flat(json.loads(config_to_json(run))) for run in (load_config(out), config))
        for name in sorted((earlier.keys() | now.keys()) - set(ADJUSTABLE)):
            if earlier.get(name) != now.get(name):
                raise ValueError(
                    f"{path}: this run was started with {name} = {earlier.get(name)}, not {now.get(name)}: use another --out"
                )
    if write:
        write_text(path, config_to_json(config, indent=1))


def load_config(out: str | Path) -> TrainConfig:
    """The configuration of the run in a folder. Raises: FileNotFoundError; ValueError, naming file and field."""
    path = Path(out) / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no run here")
    return read_config(path)


def _placed_as(value, like):
    """Through numpy: the buffers are XLA's own then, and may be donated. Uncommitted stays uncommitted: no recompiling."""
    if not value.is_fully_addressable:
        return value
    host = jax.device_get(value)
    return jax.device_put(host, like.sharding) if like.committed else jnp.asarray(host)


def _as_dict(state):
    return {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}


def _flat(tree, prefix=""):
    """{"loss.squared": 1.0, ...} from nested dicts."""
    items = {}
    for name, value in tree.items():
        items |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return items


@contextlib.contextmanager
def _quiet() -> Generator[None, None, None]:
    """Without Orbax's chatter, which goes through absl's logger."""
    absl = logging.getLogger("absl")
    level = absl.level
    absl.setLevel(logging.ERROR)
    try:
        yield
    finally:
        absl.setLevel(level)
