"""The gradient of every loss term against finite differences, in float64.

    python experiments/training/loss_gradients.py --json OUT --page docs/stability.md [--quick]

"of its own inputs": renderings, opacities and offsets are random numbers, and each is varied. "of the network": the whole
training step of the smallest network on a synthetic person, whose parameters, all of them, are varied. An error is that of the
derivatives in three random directions, each at the best of a few step sizes, as a relative L2 norm. Networks of losses (VGG-19,
LPIPS) have random weights. --quick: without the network.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs

TABLE = "loss_gradients"
DIRECTIONS = 3
STEPS = (1e-4, 1e-5, 1e-6, 1e-8, 1e-9)
"""Of central differences, relative to the size of what is varied. Thousands of Gaussians move: within the longer steps some
exchange places in the depth order, and colors jump."""
NETWORKS = ("perceptual", "lpips")
"""Terms that need a network of their own."""
SIDE, TARGETS, VERTICES = 32, 2, 800


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="of the terms' own inputs only")
    add_outputs(parser, TABLE)
    arguments = parser.parse_args()
    import jax

    with jax.enable_x64(True):
        names = term_names()
        columns = {"of its own inputs": agreement(*own_case(names), names)}
        if not arguments.quick:
            columns["of the network"] = agreement(*network_case(names), names)
    numbers = {name: {column: found[name] for column, found in columns.items()} for name in names}
    rows = [[name, *(f"{error:.0e}" for error in row.values())] for name, row in numbers.items()]
    write_outputs(arguments, TABLE, markdown_table(["term", *columns], rows), numbers)


def term_names() -> list[str]:
    """All terms of `LossConfig`."""
    from humangs_jax.training.config import LossConfig

    settings = ("structural_scales", "random_background")
    return [field.name for field in dataclasses.fields(LossConfig) if field.name not in settings]


def loss_of(names: list[str]) -> Any:
    """A `LossConfig` with these terms and no others, for small images."""
    from humangs_jax.training.config import LossConfig

    weights = dict.fromkeys(term_names(), 0.0) | dict.fromkeys(names, 1.0)
    return LossConfig(**weights, structural_scales=1, random_background=0.0)


def agreement(
    values: Any, point: Any, names: list[str], directions: int = DIRECTIONS, steps: Sequence[float] = STEPS
) -> dict[str, float]:
    """{term: relative error of its derivatives}. values: point -> {term: number}; differentiable. point: a tree of float64."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    vector = jax.jit(lambda point: jnp.stack([values(point)[name] for name in names]))
    gradient = jax.jit(jax.grad(lambda point, weights: jnp.dot(weights, vector(point))))
    rng = np.random.default_rng(0)
    size = lambda x: np.sqrt(np.mean(np.square(x)))
    ways = [jax.tree.map(lambda x: rng.normal(size=x.shape) * size(np.asarray(x)), point) for _ in range(directions)]
    inner = lambda a, b: sum(np.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    gradients = [jax.device_get(gradient(point, weights)) for weights in np.eye(len(names))]
    derivatives = np.asarray([[inner(g, way) for way in ways] for g in gradients])
    best = np.full((len(names), directions), np.inf)
    along = lambda way, step: vector(jax.tree.map(lambda x, d: x + step * d, point, way))
    for step in steps:
        found = [np.asarray(along(way, step) - along(way, -step)) / (2 * step) for way in ways]
        best = np.fmin(best, np.abs(np.stack(found, axis=1) - derivatives))
    errors = np.linalg.norm(best, axis=1) / np.linalg.norm(derivatives, axis=1)
    return dict(zip(names, errors.tolist(), strict=True))


def own_case(names: list[str], side: int = SIDE) -> tuple[Any, Any]:
    """(values, point) of the terms alone, on made-up renderings."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.data.views import SubjectViews
    from humangs_jax.geometry.camera import Camera
    from humangs_jax.losses.losses import FAR_SURFACE, ray_spread
    from humangs_jax.network.parts import HumanGSOutputs
    from humangs_jax.rendering.gaussians import Gaussians
    from humangs_jax.rendering.splatting import Rendering
    from humangs_jax.training.forward import DrawnTargets
    from humangs_jax.training.step import loss_terms

    rng = np.random.default_rng(1)
    pixels, vertices = (TARGETS, side, side), 5
    uniform = lambda *shape: rng.uniform(0.1, 0.9, shape)
    depth = 2 + uniform(*pixels)
    point = {
        "rgb": uniform(*pixels, 3),
        "alpha": uniform(*pixels),
        "depth": depth,
        "spread": 0.1 * uniform(*pixels),
        "opacities": uniform(3 * vertices),
        "tight_offsets": rng.normal(size=(vertices, 1, 3)),
        "shell_spread": uniform(vertices, 3),
    }
    views = lambda *shape: jnp.zeros((TARGETS, *shape))
    targets = SubjectViews(
        images=jnp.asarray(uniform(*pixels, 3)),
        masks=jnp.asarray(uniform(*pixels)),
        cameras=jax.vmap(lambda K, pose: Camera(K, pose, side, side))(views(3, 3), views(4, 4)),
        rotations=views(1, 3),
        translations=views(3),
        betas=jnp.zeros(1),
        depths=jnp.asarray(depth + FAR_SURFACE * rng.uniform(-1.5, 1.5, pixels)),
    )
    config = loss_of(names)
    networks = loss_networks(config)

    def values(point):
        point = {name: jnp.asarray(x) for name, x in point.items()}
        alpha, mean = point["alpha"], point["depth"]
        one = lambda rgb, alpha, depth: Rendering(rgb, alpha, depth, jnp.zeros((), jnp.int32))
        rendering = jax.vmap(one)(point["rgb"], alpha, mean)
        spread = ray_spread(alpha, mean, mean**2 + point["spread"])
        count = len(point["opacities"])
        fill = lambda *shape: jnp.zeros((count, *shape), alpha.dtype)
        gaussians = Gaussians(fill(3), fill(4), fill(3), point["opacities"], fill(3))
        outputs = HumanGSOutputs(gaussians, point["tight_offsets"], shell_spread=point["shell_spread"])
        return loss_terms(DrawnTargets(rendering, spread), outputs, targets.images, targets, config, networks)

    return values, point


def loss_networks(config: Any) -> Any:
    """The `LossNetworks` that a `LossConfig` needs, with random weights."""
    from experiments.training.cases import random_networks
    from humangs_jax.training.config import TrainConfig

    return random_networks(TrainConfig(loss=config))


def network_case(names: list[str]) -> tuple[Any, Any]:
    """(values, point) of the smallest network's training step. The point is its parameters."""
    import tempfile

    import jax
    import jax.numpy as jnp
    import numpy as np

    from experiments.training.cases import settings, written_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.core.pytree import replace
    from humangs_jax.data.loader import CaptureCache, CaptureSource
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.losses.losses import FAR_SURFACE
    from humangs_jax.network.humangs import init_humangs
    from humangs_jax.training.forward import draw_targets, reconstruct_example, white_backgrounds
    from humangs_jax.training.step import subject_loss

    config = settings("tiny", SIDE, 2, TARGETS)
    model = config.model.with_conventions(body_vertices=VERTICES).with_runtime(token_capacity=0)
    config = dataclasses.replace(config, model=model, loss=loss_of(names))
    networks, key, body = loss_networks(config.loss), jax.random.key(0), load_body()
    with tempfile.TemporaryDirectory() as folder:
        person = written_subject(Path(folder), config, body)
        source = CaptureSource(CaptureCache([person], body), config.views, SIDE, SIDE)
        example = source.example(0, 0, 2)
    rng = np.random.default_rng(2)

    def wide(tree):
        cast = lambda x: x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x
        return jax.tree.map(lambda x: jnp.asarray(cast(np.asarray(x))), tree)

    variables = wide(init_humangs(key, model))
    body, example = wide(gaussian_body(body, model)), wide(example)
    batch_stats = variables["batch_stats"]
    # a fresh network has zeros, to which nothing upstream of them has a derivative
    point = jax.tree.map(lambda x: x + 0.05 * rng.normal(size=x.shape), variables["params"])

    @jax.jit
    def depths(point):
        outputs, _ = reconstruct_example(
            {"params": point, "batch_stats": batch_stats}, body, example.inputs, config, True
        )
        drawn = draw_targets(outputs, body, example.inputs, example.targets, white_backgrounds(example.targets), config)
        return drawn.rendering.depth

    depth = depths(point)
    surface = depth + FAR_SURFACE * rng.uniform(-1.5, 1.5, depth.shape)
    example = replace(example, targets=replace(example.targets, depths=surface))

    def values(point):
        _, (_, terms) = subject_loss(point, batch_stats, body, example, key, config, networks)
        return terms

    return values, point


if __name__ == "__main__":
    main()
