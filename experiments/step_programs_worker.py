"""Measures for `python -m experiments step_programs` in a process, with the package and the
experiments that the process imports, which may be those of another commit.

    step_programs_worker.py batch FILE               a batch of one person, which all others read
    step_programs_worker.py count FILE PLATFORM      the size of the step's program, as JSON
    step_programs_worker.py time FILE REPEATS        its time on this CPU, as JSON

The step is that of `train_by_clock`. Programs for CUDA are traced and lowered without a GPU.
"""

import dataclasses
import json
import math
import pickle
import sys
import time
from pathlib import Path
from typing import Any
from unittest import mock

import jax
from jax.interpreters.partial_eval import dce_jaxpr

ROUNDS = {"compositing": 4}
"""{beginning of a file's name: how often a loop in the file is assumed to run, if data decide}.
Loops in other files are assumed to run once.
"""
BACKENDS = {"cpu": "cpu", "cuda": "gpu"}
"""{platform that a program is lowered for: JAX's name of the backend}."""
PEOPLE = 8
"""Number of people of a step in the program that is counted."""


def prepared(people: int) -> tuple[Any, tuple[Any, ...], Any]:
    """Returns the configuration of `train_by_clock` for a number of people, the arguments of its
    step after state and batch, and the shipped variables.
    """
    from experiments import train_by_clock
    from humangs_jax.body.library import load_body
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.losses.loss_networks import load_loss_networks
    from humangs_jax.network.weights import load_weights
    from humangs_jax.training.step import seed_numbers

    config = train_by_clock.configured(train_by_clock.Clock(batch=people))
    variables, model = load_weights()
    model = dataclasses.replace(model, runtime=config.model.runtime)
    config = dataclasses.replace(config, model=model)
    networks = load_loss_networks(lpips_net="alex", installed=True)
    return config, (gaussian_body(load_body(), model), networks, seed_numbers(0)), variables


def make_batch(file: Path) -> None:
    """Writes the batch of one step with one person."""
    from experiments import train_by_clock
    from humangs_jax.body.library import load_body
    from humangs_jax.synthetic.bank import build_bank
    from humangs_jax.synthetic.subject import seeds_of

    config, (carrier, *_), _ = prepared(1)
    bank = build_bank(seeds_of("train", 0, 1), load_body(), "train", displaced=carrier)
    examples = train_by_clock.examples_of(config, train_by_clock.Clock(batch=1))
    batch = jax.device_get(jax.jit(examples)(bank, 0))
    file.write_bytes(pickle.dumps(batch))


def count(file: Path, platform: str) -> dict[str, int]:
    """Returns the size of the step's program for a platform, with `PEOPLE` people."""
    from experiments import train_by_clock
    from humangs_jax.training.state import init_state

    def repeated(x: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((PEOPLE, *x.shape[1:]), x.dtype)

    batch = jax.tree.map(repeated, pickle.loads(file.read_bytes()))
    # what asks for the backend while it is traced is answered as on that platform
    with mock.patch.object(jax, "default_backend", lambda: BACKENDS[platform]):
        config, given, variables = prepared(PEOPLE)
        state = jax.eval_shape(lambda v: init_state(config, v), variables)
        step = train_by_clock.stepper(config)
        traced = step.trace(state, state.params, batch, *given, 1.0)
        text = traced.lower(lowering_platforms=(platform,)).as_text()
    jaxpr = traced.jaxpr.jaxpr
    used = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[0]
    return {
        "executed": executed(used, platform),
        "lines": text.count("\n"),
        "while": text.count("stablehlo.while"),
        "convolutions": text.count("stablehlo.convolution"),
    }


def executed(jaxpr: Any, platform: str) -> int:
    """Returns the number of primitives that run. Those of a loop count as often as it runs."""
    return sum(_executed(equation, platform) for equation in jaxpr.eqns)


def _executed(equation: Any, platform: str) -> int:
    """Returns the number of primitives that an equation runs, of a conditional the most."""
    name, given = equation.primitive.name, equation.params
    if name == "scan":
        return given["length"] * executed(given["jaxpr"].jaxpr, platform)
    if name == "while":
        parts = given["cond_jaxpr"], given["body_jaxpr"]
        return _rounds(equation) * sum(executed(part.jaxpr, platform) for part in parts)
    if name == "cond":
        chosen = _branch_of(given, platform)
        branches = given["branches"]
        if chosen is not None:
            branches = [branches[chosen]]
        return max(executed(branch.jaxpr, platform) for branch in branches)
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr", "call"):
        if key in given:
            inner = given[key]
            return executed(getattr(inner, "jaxpr", inner), platform)
    return 1


def _branch_of(given: dict[str, Any], platform: str) -> int | None:
    """Returns the index of the branch that a platform takes, or None where data decide."""
    platforms = given.get("branches_platforms")
    if platforms is None:
        return None
    for index, names in enumerate(platforms):
        if names is None or platform in names:
            return index
    return None


def _rounds(equation: Any) -> int:
    """Returns how often a loop is assumed to run, by the innermost file of `ROUNDS` that wrote
    it.
    """
    traceback = equation.source_info.traceback
    frames = () if traceback is None else traceback.frames
    for frame in frames:
        for beginning, rounds in ROUNDS.items():
            if Path(frame.file_name).name.startswith(beginning):
                return rounds
    return 1


def measure(file: Path, repeats: int) -> dict[str, Any]:
    """Returns the CPU seconds to compile a step with one person, the CPU milliseconds of a step,
    and the metrics of the first step.

    The least time of several steps is taken, because other programs only add to it.
    """
    from experiments import train_by_clock
    from humangs_jax.core.processes import keep_freed_memory
    from humangs_jax.training.state import init_state

    keep_freed_memory()
    config, given, variables = prepared(1)
    batch = jax.device_put(pickle.loads(file.read_bytes()))
    state, average = init_state(config, variables), init_state(config, variables).params
    began = time.process_time()
    lowered = train_by_clock.stepper(config).lower(state, average, batch, *given, 1.0)
    middle = time.process_time()
    step = lowered.compile()
    numbers: dict[str, Any] = {
        "lower": middle - began,
        "compile": time.process_time() - middle,
        "temporary MiB": step.memory_analysis().temp_size_in_bytes / 2**20,
    }

    # the metrics are those of the first step, which begins with the shipped weights
    least, first = math.inf, None
    for _ in range(repeats + 1):
        began = time.process_time()
        state, average, metrics = jax.block_until_ready(step(state, average, batch, *given, 1.0))
        if first is None:
            first = {name: float(value) for name, value in metrics.items()}
        else:
            least = min(least, time.process_time() - began)
    return numbers | {"step": 1e3 * least, "metrics": first}


if __name__ == "__main__":
    command, path, *more = sys.argv[1:]
    if command == "batch":
        make_batch(Path(path))
    elif command == "count":
        print(json.dumps(count(Path(path), more[0])))
    else:
        print(json.dumps(measure(Path(path), int(more[0]))))
