"""Settings that every test shares."""

import jax
from hypothesis import HealthCheck, settings

jax.config.update("jax_platforms", "cpu")  # numbers in the tests are the CPU's

settings.register_profile("humangs", deadline=None, max_examples=15, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("humangs")
