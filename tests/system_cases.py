"""The systems of `experiments.systems` at the smallest sizes, with every stage."""

import dataclasses

import jax
import numpy as np

from experiments.systems import SYSTEMS
from experiments.systems.surface_map import SurfaceMap
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.transformer import TransformerConfig

WIDTH, HEAD = 16, 8
SMALL = {
    "transformer": TransformerConfig(width=WIDTH, layers=1, head_width=HEAD, class_token=False),
    "width": WIDTH,
    "head_width": HEAD,
    "layers": 1,
    "blocks": 2,
    "mlp_ratio": 1,
    "groups": 4,
    "group_size": 16,
    "hidden": WIDTH,
    "initial_log_scale": -2.0,  # 13 cm: vertices of the bodies of tests are that far apart
    "widths": (4, 8),
    "surface_map": SurfaceMap("atlas", 8),
}
"""Values that fields of parts get, where a part has the field."""


def close(a, b, bound=2e-5):
    """Compares two pytrees of one structure; `bound` is the largest absolute difference."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=bound)


def small_system(name: str) -> HumanGSConfig:
    config = SYSTEMS[name]("bench")
    parts = config.architecture
    shrunk = {}
    for field in ("encoder", "reader", "decoder"):
        part = getattr(parts, field)
        own = {
            key: value
            for key, value in SMALL.items()
            if key in {f.name for f in dataclasses.fields(part)}
        }
        shrunk[field] = dataclasses.replace(part, **own)
    config = config.with_parts(**shrunk).with_runtime(token_capacity=0)
    return config.with_conventions(
        image_size=32, body_vertices=None, max_edge_length=None, tokens="all"
    )
