"""Measures for `python -m experiments speed` in a process, with the package that the process
imports.

It is run as a file, also for the package of another commit, so it uses almost only public names.
"""

import json
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import humangs_jax as hg
from humangs_jax.core.processes import compiler_options, keep_freed_memory

SIDE = 1024
"""Side of the matrices of a plain product, float32."""
IMAGE = 512
"""Side of the image that is drawn, pixels."""


def cpu(function: Callable[[], object]) -> float:
    """Returns the CPU milliseconds of one call, of all threads."""
    began = time.process_time()
    jax.block_until_ready(function())
    return 1e3 * (time.process_time() - began)


def usual(function: Callable[[], object], repeats: int) -> float:
    """Returns the CPU milliseconds of a call that has nothing to compile.

    The least of several is taken, because other programs only add to it.
    """
    function()
    return min(cpu(function) for _ in range(repeats))


def measure(repeats: int) -> dict[str, float]:
    """Returns {name: CPU milliseconds} of everything that is compared."""
    # the unit
    keep_freed_memory()
    matrix = jax.random.normal(jax.random.key(0), (SIDE, SIDE))
    product = jax.jit(jnp.matmul)
    found = {"product": usual(lambda: product(matrix, matrix), repeats)}

    variables, config = hg.load_weights()
    capture = hg.load_capture("demo_capture")

    def means():
        return hg.reconstruct(variables, config, capture).gaussians.means

    found["reconstruct"] = usual(means, repeats)

    avatar = hg.reconstruct(variables, config, capture)
    gaussians = hg.animate(avatar, capture.pose(0))
    camera = capture.resized(IMAGE).cameras[0]
    splat = hg.plan_buffers(gaussians, camera)

    def draw(g):
        return hg.render(g, camera, splat).rgb

    # an image and its gradient, with the time to compile them
    programs = {"render": draw, "gradient": jax.grad(lambda g: jnp.mean(draw(g) ** 2))}
    for name, function in programs.items():
        lowered = jax.jit(function).lower(gaussians)
        began = time.process_time()
        compiled = lowered.compile(compiler_options=compiler_options())
        found[f"compile_{name}"] = 1e3 * (time.process_time() - began)
        found[name] = usual(lambda run=compiled: run(gaussians), repeats)
    return found


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]))))
