"""What an accelerator does side by side equals what this CPU does one after the other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_cases import batch_of

from humangs_jax.core.pytree import replace
from humangs_jax.losses.losses import LossConfig
from humangs_jax.training.augmentation import Augmentation
from humangs_jax.training.config import tiny
from humangs_jax.training.state import init_state
from humangs_jax.training.step import local_gradients, seed_numbers, subject_keys

CONFIG = dataclasses.replace(
    tiny(),
    loss=LossConfig(structural_scales=1, distortion=1.0, boundary=0.1),
    augmentation=Augmentation(share=0.5),
)
ROUNDING = 1e-4
"""Error relative to a gradient's length: float32 sums in another order, through a random network.
"""


def gradients_of(state, body, batch):
    keys = subject_keys(seed_numbers(0), state.step, 1)
    # without LLVM's optimisations: it runs once
    quick = {"xla_backend_optimization_level": 0}
    run = jax.jit(local_gradients, static_argnames="config", compiler_options=quick)
    return run(state.params, state.batch_stats, body, batch, keys, config=CONFIG)


@pytest.mark.slow
def test_loss_and_gradients_of_a_step_are_those_of_loops(body, captures, monkeypatch):
    batch = batch_of(body, captures, CONFIG)
    # one photo is padding
    counts = jnp.full(1, len(batch.inputs.images[0]) - 1, jnp.int32)
    batch = replace(batch, inputs=replace(batch.inputs, view_count=counts))
    state = init_state(CONFIG)
    loss, gradients, _, metrics = gradients_of(state, body, batch)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.clear_caches()
    other_loss, other_gradients, _, other_metrics = gradients_of(state, body, batch)
    assert float(other_loss) == pytest.approx(float(loss), rel=ROUNDING)
    for name, value in metrics.items():
        assert float(other_metrics[name]) == pytest.approx(float(value), rel=ROUNDING, abs=1e-6)
    flat = [
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])
        for tree in (gradients, other_gradients)
    ]
    assert np.linalg.norm(flat[1] - flat[0]) < ROUNDING * np.linalg.norm(flat[0])
