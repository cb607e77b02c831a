"""The gradient of every loss term against differences, in float64."""

import jax
import pytest

from experiments.training_checks import NETWORKS, agreement, network_case, own_case, term_names

OWN = 1e-7
"""Central differences of step h: h^2 of truncation and 1e-16 / h of rounding; terms with corners have some within a step."""
WHOLE = 1e-4
"""Of thousands of pixels some cross a corner (an absolute value, a ReLU, a Gaussian's least alpha) within a step, and some
Gaussians exchange places in the depth order."""
PLAIN = [name for name in term_names() if name not in NETWORKS]


@pytest.mark.slow
def test_terms_on_their_own_inputs():
    with jax.enable_x64(True):
        errors = agreement(*own_case(PLAIN, 12), PLAIN)
    assert set(errors) == set(PLAIN) and all(error < OWN for error in errors.values()), errors


@pytest.mark.slow
def test_terms_with_networks_of_their_own():
    with jax.enable_x64(True):
        errors = agreement(*own_case(list(NETWORKS)), list(NETWORKS), directions=1, steps=(1e-6, 1e-8))
    assert set(errors) == set(NETWORKS) and all(error < WHOLE for error in errors.values()), errors


@pytest.mark.slow
def test_terms_of_the_whole_network():
    """Those with networks of their own are in the script: minutes of convolutions in float64."""
    with jax.enable_x64(True):
        errors = agreement(*network_case(PLAIN), PLAIN, directions=1, steps=(1e-6, 1e-8, 1e-9))
    assert set(errors) == set(PLAIN) and all(error < WHOLE for error in errors.values()), errors
