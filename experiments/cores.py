"""Measures how splatting uses several cores of a CPU."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.splatting import DIRECTIONS, Scene, demo_scene
from experiments.timing import medians
from humangs_jax.core.processes import compiler_options, in_threads, usable_cores
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render

WAYS = ("one after the other", "each in a thread of its own", "rows of each on host devices")
"""Ways to draw as many images as there are cores."""


@entry
def splatting_cores(run: Run, size: int = 512, repeats: int = 15) -> None:
    """Measures what threads and host devices gain when images are drawn on a CPU, for the shipped
    person.

    XLA draws an image on about one core. Several images can be drawn at the same time by threads.
    One image can be divided into rows, which several host devices draw (`jax.shard_map`). Takes a
    minute.

    Options:
    size: side of the image, pixels
    repeats: timed iterations
    """
    cores = usable_cores()
    jax.config.update("jax_num_cpu_devices", cores)
    rows = run.rows(
        {str(size): lambda: measure(demo_scene(size), cores, repeats)},
        {"cores": cores, "repeats": repeats},
    )
    table = []
    for way, times in rows[str(size)].items():
        cells = [f"{times[direction][clock]:.0f}" for direction in DIRECTIONS for clock in (0, 1)]
        table.append([f"{way} ({cores})", *cells])
    header = ["images", "forward, ms", "CPU ms", "with gradients, ms", "CPU ms"]
    run.show(markdown_table(header, table), rows)


def measure(scene: Scene, cores: int, repeats: int) -> dict[str, dict[str, list[float]]]:
    """Returns {way: {direction: [wall ms, CPU ms] of one image}}."""
    gaussians, camera = scene
    noise = np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32)
    goal = jnp.asarray(noise)
    config = plan_buffers(gaussians, camera)

    def loss(gaussians: Gaussians) -> Any:
        return jnp.mean((render(gaussians, camera, config).rgb - goal) ** 2)

    whole = {
        "forward": _compiled(lambda gaussians: render(gaussians, camera, config).rgb, gaussians),
        "forward_backward": _compiled(jax.value_and_grad(loss), gaussians),
    }
    found: dict[str, dict[str, list[float]]] = {way: {} for way in WAYS}
    for direction, program in whole.items():
        divided = in_rows(scene, goal, cores)[direction]

        def drawn(program=program):
            return jax.block_until_ready(program(gaussians))

        def in_own_threads(drawn=drawn):
            return list(in_threads(drawn, [()] * cores, cores))

        def in_turn(drawn=drawn):
            return [drawn() for _ in range(cores)]

        def on_devices(divided=divided):
            return [divided() for _ in range(cores)]

        ways = dict(zip(WAYS, (in_turn, in_own_threads, on_devices), strict=True))
        for way, times in medians(ways, repeats).items():
            found[way][direction] = [float(time) / cores for time in times]
    return found


def in_rows(scene: Scene, goal: Any, devices: int) -> dict[str, Callable[[], Any]]:
    """Returns programs that draw an image, each device a part of its rows, and that sum the
    gradients of the parts.
    """
    gaussians, camera = scene
    mesh = jax.make_mesh((devices,), ("rows",))
    everywhere, by_rows = PartitionSpec(), PartitionSpec("rows")
    height = camera.height // devices

    def part(i: Any) -> Camera:
        return replace(camera, K=camera.K.at[1, 2].add(-i * height), height=height)

    parts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(part, range(devices)))
    config: SplatConfig = plan_buffers(gaussians, parts)

    def forward(gaussians: Gaussians) -> Any:
        return render(gaussians, part(jax.lax.axis_index("rows")), config).rgb

    def forward_backward(gaussians: Gaussians, goal: Any) -> Any:
        def loss(gaussians):
            return jnp.sum((forward(gaussians) - goal) ** 2) / (3 * camera.width * camera.height)

        return jax.lax.psum(jax.value_and_grad(loss)(gaussians), "rows")

    gaussians = jax.device_put(gaussians, NamedSharding(mesh, everywhere))
    goal = jax.device_put(goal, NamedSharding(mesh, by_rows))
    image = jax.shard_map(
        forward, mesh=mesh, in_specs=everywhere, out_specs=by_rows, check_vma=False
    )
    gradient = jax.shard_map(
        forward_backward,
        mesh=mesh,
        in_specs=(everywhere, by_rows),
        out_specs=everywhere,
        check_vma=False,
    )
    image, gradient = _compiled(image, gaussians), _compiled(gradient, gaussians, goal)
    return {
        "forward": lambda: jax.block_until_ready(image(gaussians)),
        "forward_backward": lambda: jax.block_until_ready(gradient(gaussians, goal)),
    }


def _compiled(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Compiles a function for arguments of these shapes."""
    return jax.jit(function, compiler_options=compiler_options()).lower(*arguments).compile()
