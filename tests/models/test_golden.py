"""Every stage of the published network against its authors' numbers (see network_golden.py)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import network_golden as golden
import numpy as np
import pytest

from humangs_jax.models.conversion import load_checkpoint

FLOAT32_TOLERANCE = 2e-5
"""Relative to a stage's largest magnitude; ours stays within 2e-6, the release itself in float32 within 5e-6."""
FLOAT64_TOLERANCE = 1e-6
"""The reference is stored as float32: half a rounding step is 6e-8."""
GOLDEN = Path(__file__).parents[3] / "shared" / "golden"
"""The whole golden data, where a checkout has it beside it."""


def compare(checkpoint, arrays, pool, dtype, thinned):
    converted = load_checkpoint(checkpoint)
    config = golden.float32_config(converted.config, pool)
    variables = jax.tree.map(lambda x: jnp.asarray(x, dtype), converted.variables)
    weights, transforms = (jnp.asarray(x, dtype) for x in (converted.skinning_weights, arrays["in_joint_transforms"]))
    compute = jax.jit(golden.stages, static_argnames="config")
    found = compute(variables, golden.inputs(arrays, dtype), config, weights, transforms)
    assert all(x.dtype == dtype for x in found.values())
    return golden.relative_errors(found, arrays, thinned)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_stage_agrees(dtype):
    with jax.enable_x64(dtype == np.float64):
        errors = compare(golden.CHECKPOINT, dict(np.load(golden.SUBJECT)), "all", dtype, thinned=True)
    assert len(errors) == 17
    tolerance = FLOAT64_TOLERANCE if dtype == np.float64 else FLOAT32_TOLERANCE
    assert max(errors.values()) < tolerance, errors


@pytest.mark.skipif(not GOLDEN.exists(), reason="no golden data beside this checkout")
@pytest.mark.parametrize(("name", "pool", "index"), [("a", "all", 1), ("b", "visible", 0), ("b", "visible", 1)])
@pytest.mark.slow
def test_every_stage_agrees_in_full(name, pool, index):
    arrays = golden.subject(dict(np.load(GOLDEN / f"golden_{name}.npz")), index)
    with jax.enable_x64(True):
        errors = compare(GOLDEN / f"golden_{name}.pt", arrays, pool, np.float64, thinned=False)
    assert max(errors.values()) < FLOAT64_TOLERANCE, errors
    errors = compare(GOLDEN / f"golden_{name}.pt", arrays, pool, np.float32, thinned=False)
    assert max(errors.values()) < FLOAT32_TOLERANCE, errors
