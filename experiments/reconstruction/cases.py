"""What the reconstruction benchmarks share: a subject seen by any number of cameras, networks, and their programs.

The subject is the person that ships with the package, as the shipped weights see them: reconstructed from the four demo
photos, drawn from cameras of the published protocol (1.8 bounding radii away, vertical field of view 60 degrees). What
the photos show changes no cost but one: how many patches the person touches.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.costs import costs_of

DISTANCE_FACTOR = 1.8
"""The nearest of the published protocol (1.8 to 2.2)."""
ELEVATION = np.deg2rad(5.0)
MATMUL_SHAPE = (4096, 768, 3072)
"""A product of the published network's MLP at 256 x 256: what "matrix-product peak" means here."""
LOG_SCALE, HEAD_SCALE = -4.6, 0.05
"""Bias of the scales before their softplus, and how much weaker random geometry heads are than other random layers."""


@functools.cache
def demo_avatar() -> tuple[Any, Any]:
    """(avatar, capture) of the demo."""
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.data.capture import load_capture
    from humangs_jax.data.photos import DEMO_CAPTURE
    from humangs_jax.network.weights import load_weights

    capture = load_capture(DEMO_CAPTURE)
    return reconstruct(*load_weights(), capture), capture


def benchmark_views(views: int, size: int) -> tuple[Any, Any]:
    """(body, `SubjectViews`) of the benchmark subject: cameras evenly around, one pose."""
    import jax.numpy as jnp

    from humangs_jax.avatar.animate import animate
    from humangs_jax.avatar.frames import draw_gaussians
    from humangs_jax.body.model import pose_body, shape_body
    from humangs_jax.data.views import SubjectViews
    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
    from humangs_jax.people.cameras import VERTICAL_FOV, bounding_sphere

    avatar, capture = demo_avatar()
    pose, body = capture.pose(0), capture.body
    betas = jnp.asarray(capture.betas)
    posed = np.asarray(pose_body(body, shape_body(body, betas), pose).vertices)
    center, radius = bounding_sphere(posed)
    K = intrinsics_from_fov(VERTICAL_FOV, size, size)
    azimuths = jnp.arange(views, dtype=jnp.float32) * (2 * np.pi / views)
    target = jnp.asarray(center, jnp.float32)
    cameras = orbit(target, float(DISTANCE_FACTOR * radius), azimuths, float(ELEVATION), K, size, size)
    gaussians = animate(avatar, pose)
    drawn = list(draw_gaussians(iter([gaussians] * views), (cameras[i] for i in range(views))))
    repeat = lambda x: jnp.broadcast_to(jnp.asarray(x), (views, *np.shape(x)))
    return body, SubjectViews(
        images=jnp.stack([jnp.clip(x.rgb, 0, 1) for x in drawn]),
        masks=jnp.stack([x.alpha for x in drawn]),
        cameras=cameras,
        rotations=repeat(pose.rotations),
        translations=repeat(pose.translation),
        betas=betas,
    )


def benchmark_inputs(config: Any, views: int, size: int) -> Any:
    """`HumanGSInputs` of the benchmark subject, as a network of this configuration wants them."""
    import jax

    from humangs_jax.data.views import gaussian_body, prepare_inputs

    body, photos = benchmark_views(views, size)
    prepare = jax.jit(prepare_inputs, static_argnames="config")
    return jax.block_until_ready(prepare(gaussian_body(body, config), photos, config))


def foreground(inputs: Any, config: Any) -> tuple[Any, int, float]:
    """(configuration for foreground tokens with room for these photos, tokens that the person touches, their share)."""
    import jax

    from humangs_jax.network.humangs import needed_tokens
    from humangs_jax.rendering.buffers import round_up

    touched = int(jax.jit(needed_tokens, static_argnames="config")(inputs, config))
    patches = int(np.prod(inputs.images.shape[:3])) // config.architecture.encoder.patch_size**2
    config = config.with_runtime(tokens="foreground", token_capacity=round_up(touched))
    return config, touched, touched / patches


def random_variables(config: Any, seed: int = 0) -> Any:
    """Variables in which every number matters, of Gaussians about a centimetre large.

    Drawn by numpy: initialising the published network compiles for 10 s.
    """
    import jax
    import jax.numpy as jnp

    from humangs_jax.network.weights import expected_variables

    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        if path[-1].key in ("scale", "var"):
            return jnp.ones(leaf.shape, jnp.float32)
        fan_in = int(np.prod(leaf.shape[:-1])) if leaf.ndim > 1 else 100
        return jnp.asarray(rng.standard_normal(leaf.shape, np.float32) * fan_in**-0.5)

    variables = jax.tree_util.tree_map_with_path(draw, expected_variables(config))
    geometry = variables["params"]["decoder"]["geometry_out"]
    resting = jnp.asarray([0, 0, 0, 1, 0, 0, 0, *[LOG_SCALE] * 3], jnp.float32)
    geometry["kernel"] *= HEAD_SCALE
    geometry["bias"] = jnp.tile(resting, config.architecture.decoder.gaussians_per_vertex)
    return variables


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float, int]:
    """(compiled program, seconds that tracing and compiling took, operations)."""
    import jax

    start = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    program = traced.lower().compile()
    return program, time.perf_counter() - start, costs_of(traced).flops


def matmul_program(dtype: str) -> tuple[Callable[[], Any], float]:
    """(a plain matrix product in that dtype, its floating-point operations)."""
    import jax
    import jax.numpy as jnp

    rows, inner, columns = MATMUL_SHAPE
    rng = np.random.default_rng(0)
    a = jnp.asarray(rng.standard_normal((rows, inner)), dtype)
    b = jnp.asarray(rng.standard_normal((inner, columns)), dtype)
    product = jax.jit(lambda a, b: a @ b).lower(a, b).compile()
    return lambda: jax.block_until_ready(product(a, b)), 2.0 * rows * inner * columns
