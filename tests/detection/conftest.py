import pytest

from humangs_jax.detection.blazepose import Networks


@pytest.fixture(scope="session")
def networks():
    return Networks()
