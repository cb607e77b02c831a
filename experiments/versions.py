"""Measures the speed of the package with versions of Python and JAX, and with flags of XLA."""

import functools
import json
import os
import subprocess

import numpy as np

from experiments.harness import Run, entry
from experiments.results import REPOSITORY, markdown_table

FLAGS = {
    "": "",
    "matrix products by YNN": "--xla_cpu_experimental_ynn_fusion_type=LIBRARY_FUSION_TYPE_DOT",
}
"""{name: value of XLA_FLAGS that is compared}.

By default jax 0.11 and 0.12 do not use the library YNNPACK.
"""
MEASURED = {
    "render_ms": "image, CPU ms",
    "gradient_ms": "with gradients, CPU ms",
    "refine_ms": "refine, steps=0, CPU s",
    "step_ms": "training step, CPU s",
}
"""{measurement: its heading}."""
WORKER = "from experiments.versions import print_times; print_times({train}, {repeats})"
"""Program of a process that measures."""


@entry
def versions(
    run: Run, pythons: tuple[str, ...], rounds: int = 3, repeats: int = 7, train: bool = False
) -> None:
    """Measures the CPU time of rendering, refinement and training with each interpreter and flag,
    in turns.

    Every interpreter needs the package's dependencies. The demo's person at 512 px is drawn with
    and without gradients. The demo's avatar is refined with `steps=0`. The step is that of `small`
    at 256 px. Each turn is a new process. After the first turn programs come from the compile
    cache.

    Options:
    pythons: paths of the interpreters
    rounds: number of turns of every interpreter and flag
    repeats: timed iterations in a turn
    train: also time the step of training, in the first turn (two minutes each)
    """
    # every interpreter with every flag
    variants = {}
    for python in pythons:
        for flag, value in FLAGS.items():
            name = ", ".join(filter(None, (_versions_of(python), flag)))
            variants[name] = (python, value)

    @functools.cache
    def samples() -> dict[str, list[dict[str, float]]]:
        """Measures all turns of all variants."""
        found = {name: [] for name in variants}
        for turn in range(rounds):
            for name, (python, value) in variants.items():
                found[name].append(_times(python, value, train and turn == 0, repeats))
        return found

    def row(name: str) -> dict[str, float]:
        """Returns the medians of a variant over the turns."""
        own = samples()[name]
        keys = [key for key in MEASURED if key in own[0]]
        return {key: float(np.median([each[key] for each in own if key in each])) for key in keys}

    rows = run.rows({name: lambda name=name: row(name) for name in variants}, {"rounds": rounds})
    table = []
    for name, numbers in rows.items():
        cells = [f"{numbers['render_ms']:.1f}", f"{numbers['gradient_ms']:.1f}"]
        cells.append(f"{numbers['refine_ms'] / 1e3:.1f}")
        step = "-"
        if "step_ms" in numbers:
            step = f"{numbers['step_ms'] / 1e3:.1f}"
        table.append([name, *cells, step])
    run.show(markdown_table(["", *MEASURED.values()], table), rows)


def _versions_of(python: str) -> str:
    """Describes the versions of an interpreter and of its JAX."""
    code = (
        "import platform, importlib.metadata as m; print(platform.python_version(),"
        " m.version('jax'))"
    )
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    of_python, of_jax = done.stdout.split()
    return f"Python {of_python}, jax {of_jax}"


def _times(python: str, flags: str, train: bool, repeats: int) -> dict[str, float]:
    """Returns what a process of an interpreter measures.

    Raises: OSError with the end of the process's errors.
    """
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(REPOSITORY)}
    command = [python, "-c", WORKER.format(train=train, repeats=repeats)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=REPOSITORY)
    if done.returncode:
        raise OSError(f"{python}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def print_times(train: bool, repeats: int) -> None:
    """Prints the measurements of this process as a line of JSON."""
    import humangs_jax as hg
    from experiments.splatting import compiled, demo_scene
    from experiments.subjects import shipped_person
    from experiments.timing import prepare_process, timed
    from experiments.training import step_numbers
    from humangs_jax.data.photos import DEMO_CAPTURE

    prepare_process()
    hg.enable_compile_cache()
    programs, _ = compiled(demo_scene(512), hg.SplatConfig())
    found: dict[str, float] = {}
    for key, name in (("render_ms", "forward"), ("gradient_ms", "forward_backward")):
        programs[name]()
        found[key] = float(np.median([timed(programs[name])[1] for _ in range(repeats)]))

    # the first refinement compiles
    avatar, capture = shipped_person(), hg.load_capture(DEMO_CAPTURE)
    refined = [timed(lambda: hg.refine(avatar, capture, steps=0))[1] for _ in range(2)]
    found["refine_ms"] = refined[-1]
    if train:
        found["step_ms"] = step_numbers("small 256", repeats)["cpu_ms"]
    print(json.dumps(found))
