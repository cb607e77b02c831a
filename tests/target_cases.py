"""The systems that run again for every target, at small sizes, and views of a tube."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from system_cases import small_system
from training_cases import POSES, tube

from experiments.systems import SYSTEMS
from experiments.systems.surface_map import SurfaceMap
from humangs_jax.body.model import Texels
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import TriplaneConfig
from humangs_jax.network.transformer import TransformerConfig

PIXELS, DRIVEN = ("lvsm", "lvsm_latents", "humanram"), ("giga", "animatable", "lca")
SIZE, TEXELS = 32, 8
BLOCKS = TransformerConfig(width=16, layers=4, head_width=8, class_token=False, mlp_ratio=1)
PATCH = 8


@functools.cache
def small(name: str) -> HumanGSConfig:
    # scan: compiles in less time
    config = SYSTEMS[name]("bench").with_runtime(scan=True, token_capacity=0)
    parts = config.architecture
    change = dataclasses.replace
    if name in PIXELS:
        sizes = {}
        if name == "humanram":
            sizes = {"texture": TriplaneConfig(resolution=8, channels=2), "fusion": 8}
        sizes |= {"latents": 6} if name == "lvsm_latents" else {}
        config = config.with_parts(driver=change(parts.driver, transformer=BLOCKS, **sizes))
    elif name == "lca":
        config = small_system("lhm_views").with_parts(
            driver=change(parts.driver, hidden=8, layers=1, joints=2)
        )
    else:
        surface = SurfaceMap(parts.surface_map.kind, TEXELS)
        moved = {
            field: change(getattr(parts, field), surface_map=surface)
            for field in ("reader", "decoder")[name != "giga" :]
        }
        sizes = {"pose_width": 8, "pose_tokens": 2, "joints": 2} if name == "giga" else {}
        config = config.with_parts(**moved, driver=change(parts.driver, widths=(4, 8), **sizes))
    return config.with_conventions(image_size=SIZE, body_vertices=None, max_edge_length=None)


def mapped_tube(config: HumanGSConfig):
    """Returns the tube with a random map of its surface; half of the texels show nothing.

    A real map takes seconds to compile.
    """
    body, wanted = tube(), config.architecture.surface_map
    if wanted is None:
        return body
    rng = np.random.default_rng(0)
    faces = np.asarray(body.faces)[rng.integers(len(body.faces), size=wanted.shape)]
    weights = (
        rng.dirichlet([1, 1, 1], wanted.shape) * (np.arange(wanted.shape[1]) % 2 == 0)[:, None]
    )
    return replace(
        body, texels=Texels(jnp.asarray(faces, jnp.int32), jnp.asarray(weights, jnp.float32))
    )


def views(seed: int = 0, count: int = 2, size: int = SIZE) -> SubjectViews:
    """Returns photos of noise of the tube in `POSES` poses, from all around."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.random(shape), jnp.float32)
    rotations = 0.6 * (draw(POSES, 2, 3) - 0.5)
    cameras = orbit(
        jnp.zeros(3),
        2.6,
        2 * jnp.pi * jnp.arange(count) / count,
        0.1,
        intrinsics_from_fov(0.8, size, size),
        size,
        size,
    )
    return SubjectViews(
        images=draw(count, size, size, 3),
        masks=jnp.ones((count, size, size)),
        cameras=cameras,
        rotations=rotations[jnp.arange(count) % POSES],
        translations=0.1 * draw(count, 3),
        betas=jnp.zeros(1),
    )
