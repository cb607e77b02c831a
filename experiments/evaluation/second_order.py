"""Adam against Levenberg-Marquardt at equal seconds: which refines an avatar better?

    python experiments/evaluation/second_order.py --subjects 2 --json second_order.json [--page docs/refinement.md]

Levenberg-Marquardt as in 3DGS-LM (https://arxiv.org/abs/2409.12892): all photos at once, residuals of colours and coverage, the
damped normal equations solved by a few iterations of preconditioned conjugate gradients, J^T u by a vjp. The renderer has a
reverse-mode rule only, so J v is a difference of two images. The preconditioner is the square of Adam's rates: the
unit of each parameter. A step that raises the loss is undone and damped more.

People, held-out views and scores are those of `refinement.py`; seconds do not count compilation.
"""

import argparse
import functools
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation.options import add_people_options, check_people_options, load_network, seeds_asked_for
from experiments.evaluation.refinement import score_all

ITERATIONS = 5
"""Of conjugate gradients in a step."""
PROBE = 0.3
"""Root mean square of the change, in Adam's rates, by which J v is measured."""
COVERAGE = 0.5
"""Weight of the residuals of coverage beside those of colours."""
DAMPING, LESS, MORE = 1e-4, 0.3, 4.0
"""At the start, and its factors after a good and a bad step."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_people_options(parser, subjects=2)
    parser.add_argument("--seconds", type=float, nargs="+", default=[2, 5, 15, 60], help="lengths of the runs")
    arguments = parser.parse_args()
    check_people_options(parser, arguments)
    rows = measure_people(arguments)
    text = section(rows, arguments)
    print(text)
    if arguments.json:
        write_json(arguments.json, rows)
    if arguments.page:
        publish(arguments.page, "refinement_second_order", text, rows)


def section(rows, arguments):
    """The table of the page."""
    header = ["seconds", *(f"{method}, {score}" for method in rows for score in ("all", "on the person"))]
    table = []
    for i, seconds in enumerate(arguments.seconds):
        cells = [f"{rows[method][i][key]:.2f}" for method in rows for key in ("psnr", "psnr_foreground")]
        table.append([f"{seconds:g}", *cells])
    about = f"PSNR in dB of new views, {arguments.subjects} people of the {arguments.split} seeds, 4 photos of 256 px."
    return f"{about}\n\n{markdown_table(header, table)}"


def measure_people(arguments):
    """{method: one row of mean scores for each length of a run}."""
    import numpy as np
    from tqdm import tqdm

    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.body.library import load_body
    from humangs_jax.refinement.config import RefineConfig
    from humangs_jax.refinement.refine import refine

    body, (variables, config, _) = load_body(), load_network(arguments)
    held_out = HeldOut(arguments.held_out, arguments.poses, arguments.pose_views)
    methods = {
        "Adam": lambda avatar, inputs, length: refine(
            avatar, inputs, RefineConfig(rounds=0, seconds=length, held_out=0.0)
        ),
        "Levenberg-Marquardt": levenberg_marquardt,
    }
    found = {name: [[] for _ in arguments.seconds] for name in methods}
    for seed in tqdm(seeds_asked_for(arguments, body), desc="people"):
        subject = make_evaluation_subject(seed, body, [4], 256, held_out)
        inputs = subject.inputs(4)
        avatar = reconstruct(variables, config, inputs)
        for name, method in methods.items():
            for i, length in enumerate(arguments.seconds):
                scores = score_all(method(avatar, inputs, length), subject.held_out)[0]
                found[name][i].append(scores["novel"])
    mean = lambda rows: {key: float(np.mean([row[key] for row in rows])) for key in ("psnr", "psnr_foreground")}
    return {name: [mean(rows) for rows in lengths] for name, lengths in found.items()}


def levenberg_marquardt(avatar, capture, seconds):
    """The avatar after that many seconds of damped Gauss-Newton steps on all photos."""
    import jax.numpy as jnp

    from humangs_jax.avatar.low_pass import with_low_pass_of
    from humangs_jax.refinement import operations
    from humangs_jax.refinement import refine as refinement
    from humangs_jax.refinement.config import RefineConfig
    from humangs_jax.refinement.crops import crop_to_person
    from humangs_jax.refinement.objective import avatar_of, photos_of

    views, config = crop_to_person(capture), RefineConfig()
    avatar = with_low_pass_of(avatar, views)
    photos, splat = photos_of(views, jnp.ones(views.masks.shape, bool)), operations.planned(avatar, views)
    state = operations.compiled(refinement.start)(avatar, photos, config, splat)
    step = compiled_step()
    damping, began = jnp.float32(DAMPING), None
    parameters = state.parameters
    while began is None or time.perf_counter() - began < seconds:
        parameters, damping, _ = step(parameters, state.trust, damping, avatar, photos, config, splat)
        if began is None:  # the first call compiles
            parameters, damping, began = state.parameters, jnp.float32(DAMPING), time.perf_counter()
        parameters.means.block_until_ready()
    return avatar_of(parameters, avatar)


@functools.cache
def compiled_step():
    """The jitted `lm_step`."""
    import jax

    from humangs_jax.core.compiler_options import compiler_options

    return jax.jit(lm_step, static_argnames=("config", "splat"), compiler_options=compiler_options())


def lm_step(parameters, trust, damping, avatar, photos, config, splat):
    """Parameters and damping after one step, and the loss before it."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.core.pytree import replace
    from humangs_jax.refinement.objective import posed_gaussians
    from humangs_jax.rendering.splatting import render

    # trust: Gaussians that no photo sees do not move
    by_gaussian = lambda x, rate: rate * trust.reshape(-1, *[1] * (x.ndim - 1)) * jnp.ones_like(x)
    names = ("means", "quats", "log_scales", "opacity_logits", "color_logits")
    units = {name: by_gaussian(getattr(parameters, name), getattr(config.rates, name)) for name in names}

    def moved(y):
        return replace(parameters, **{name: getattr(parameters, name) + units[name] * y[name] for name in names})

    def residuals(y):
        def one(photo):
            drawn = render(posed_gaussians(moved(y), avatar, photo, False), photo.cameras, splat)
            return drawn.rgb - photo.images, COVERAGE * (drawn.alpha - photo.masks)

        return jax.lax.map(one, photos)

    dot = lambda a, b: sum(jnp.vdot(x, z) for x, z in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    add = lambda a, s, b: jax.tree.map(lambda x, z: x + s * z, a, b)
    zero = jax.tree.map(jnp.zeros_like, units)
    r, pull_back = jax.vjp(residuals, zero)
    count = sum(leaf.size for leaf in jax.tree.leaves(zero))

    def normal(v):
        length = PROBE * jnp.sqrt(count / jnp.maximum(dot(v, v), 1e-20))
        image = jax.tree.map(lambda a, b: (a - b) / length, residuals(jax.tree.map(lambda x: length * x, v)), r)
        return add(pull_back(image)[0], damping * scale, v)

    gradient = pull_back(r)[0]
    scale = dot(r, r)

    def iterate(_, carry):
        y, remainder, direction, size = carry
        product = normal(direction)
        length = size / jnp.maximum(dot(direction, product), 1e-20)
        y, remainder = add(y, length, direction), add(remainder, -length, product)
        smaller = dot(remainder, remainder)
        return y, remainder, add(remainder, smaller / jnp.maximum(size, 1e-20), direction), smaller

    downhill = jax.tree.map(jnp.negative, gradient)
    y = jax.lax.fori_loop(0, ITERATIONS, iterate, (zero, downhill, downhill, dot(downhill, downhill)))[0]
    after = residuals(y)
    better = dot(after, after) < scale
    kept = jax.tree.map(lambda x: jnp.where(better, x, 0.0), y)
    return moved(kept), damping * jnp.where(better, LESS, MORE), scale


if __name__ == "__main__":
    main()
