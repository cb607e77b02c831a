"""What a checkpoint of a training state costs: how long the run waits for it, how long until it is on disk, restoring it.

    python experiments/training/checkpoints.py --presets small published --json OUT --page docs/scaling.md

States of random numbers are saved and restored by `humangs_jax/training/checkpoint.py`. "the run waits" is the call of `save`
alone (on a CPU it copies the state first: the next step overwrites it), "to disk" all from that call until the files are there,
as if the run did nothing meanwhile. Restoring reads files that the system has just written and still holds in memory. CPU time is
of all threads. `--folder` is on the disk to measure. Memory: four times the state; `published` has a state of
1.2 GB and takes a minute.
"""

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import peak_rss_mb, prepare_process, timed
from experiments.common.results import add_outputs, markdown_table, write_outputs

PARTS = ("save", "to disk", "restore")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["small"], help="published, paper, small or tiny")
    parser.add_argument("--repeats", type=int, default=3, help="checkpoints timed, after one that is not")
    parser.add_argument("--folder", type=Path, help="where checkpoints are written, and deleted again: a temporary one")
    add_outputs(parser, "checkpoints")
    arguments = parser.parse_args()
    prepare_process()
    results = []
    for preset in arguments.presets:
        with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
            results.append(measure(preset, Path(folder), arguments.repeats))
    write_outputs(arguments, "checkpoints", table(results), results)


def measure(preset: str, folder: Path, repeats: int) -> dict[str, Any]:
    """Bytes of the state and of a checkpoint; (wall ms, CPU ms) of every part, medians."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.core.pytree import replace
    from humangs_jax.training.checkpoint import Checkpoints
    from humangs_jax.training.config import PRESETS

    if preset not in PRESETS:
        raise SystemExit(f"--presets {preset}: expected one of {', '.join(PRESETS)}")
    state = random_state(PRESETS[preset]())
    load = os.getloadavg()[0]
    checkpoints = Checkpoints(folder, keep=1)
    samples = {part: [] for part in PARTS}
    for step in range(1 + repeats):
        state = replace(state, step=jnp.asarray(step, jnp.int32))
        blocking = np.asarray(timed(lambda state=state: checkpoints.save(state)))
        background = np.asarray(timed(checkpoints.wait))
        restore = np.asarray(timed(lambda state=state: jax.block_until_ready(checkpoints.restore(state))))
        for part, sample in zip(PARTS, (blocking, blocking + background, restore), strict=True):
            samples[part].append(sample)
    newest = folder / str(checkpoints.steps[-1])
    size = sum(path.stat().st_size for path in newest.rglob("*") if path.is_file())
    checkpoints.close()
    return {
        "preset": preset,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "state_bytes": sum(x.nbytes for x in jax.tree.leaves(state)),
        "disk_bytes": size,
        "ms": {part: list(map(float, np.median(sample[1:], axis=0))) for part, sample in samples.items()},
        "peak_rss_mb": peak_rss_mb(),
        "repeats": repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def random_state(config: Any) -> Any:
    """A training state in which no number is like another: files are compressed, and a fresh state's moments are zeros."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.training.state import init_state

    rng = np.random.default_rng(0)
    number = lambda x: jnp.issubdtype(x.dtype, jnp.inexact)
    draw = lambda x: jnp.asarray(rng.standard_normal(x.shape, np.float32)) if number(x) else jnp.zeros(x.shape, x.dtype)
    return jax.block_until_ready(jax.tree.map(draw, jax.eval_shape(lambda: init_state(config))))


def table(results: list[dict[str, Any]]) -> str:
    """Markdown: one line per preset, and how it was measured."""
    rows = []
    for row in results:
        times = [f"{wall / 1e3:.2f}, {cpu / 1e3:.2f}" for wall, cpu in (row["ms"][part] for part in PARTS)]
        sizes = [f"{row['state_bytes'] / 1e6:.0f}", f"{row['disk_bytes'] / 1e6:.0f}"]
        rows.append([row["preset"], *sizes, *times, f"{row['peak_rss_mb']:.0f}"])
    header = ["wall, CPU s", "state, MB", "on disk, MB", "the run waits", "to disk", "restore", "peak MiB"]
    how = "; ".join(
        f"{row['preset']}: {row['device']}, jax {row['jax']}, load {row['load_average']:.1f}, {row['repeats']} timed"
        for row in results
    )
    return f"{markdown_table(header, rows)}\n\n{how[0].upper()}{how[1:]}."


if __name__ == "__main__":
    main()
