"""The terms of the training loss, of images alone."""

import importlib

import jax
import jax.numpy as jnp

from humangs_jax.losses.loss_networks import NO_NETWORKS
from humangs_jax.network.parts import Drawn
from humangs_jax.rendering.splatting import Rendering


def terms_of_images(drawn, images, **weights):
    """Returns the unweighted terms by name, of drawn images (v, h, w, 3) against photos."""
    losses = importlib.import_module("humangs_jax.losses.losses")
    covered = jnp.ones(images.shape[:3])
    shown = lambda rgb, alpha: Rendering(rgb, alpha, alpha, jnp.zeros((), jnp.int32))
    rendering = jax.vmap(shown)(jnp.asarray(drawn), covered)
    config = losses.LossConfig(structural_scales=1, **weights)
    return losses.loss_terms(
        Drawn(rendering), jnp.asarray(images), covered, None, config, NO_NETWORKS
    )
