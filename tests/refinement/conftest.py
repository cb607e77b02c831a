"""Fixtures with one size of buffers for all fast tests, so that they share compiled programs.

Slow tests plan their own sizes.
"""

import pytest
from refinement_cases import SAME, toy_avatar, toy_capture

from humangs_jax.body.library import load_body
from humangs_jax.body.resolution import decimate
from humangs_jax.refinement import search


@pytest.fixture(autouse=True)
def same_buffers(request, monkeypatch):
    if request.node.get_closest_marker("slow") is None:
        monkeypatch.setattr(search, "planned", lambda avatar, views: SAME)


@pytest.fixture(scope="session")
def body():
    return decimate(load_body(), 400)


@pytest.fixture(scope="session")
def person(body):
    """Returns (avatar to be refined, photos of it in other colors)."""
    return toy_avatar(body, 0.0), toy_capture(body, toy_avatar(body, 0.15), moving=True)


@pytest.fixture(scope="session")
def four(body):
    """Returns (avatar, four photos of it in other colors)."""
    return toy_avatar(body, 0.0), toy_capture(body, toy_avatar(body, 0.15), views=4)
