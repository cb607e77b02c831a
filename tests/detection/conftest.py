import pytest

from humangs_jax.detection.people import Networks


@pytest.fixture(scope="session")
def networks():
    return Networks()
