"""One size of buffers for all tests of the normal lane, so that they share compiled programs; slow tests plan their own."""

import pytest

from humangs_jax.refinement import operations, refine
from humangs_jax.rendering.splat_config import SplatConfig


@pytest.fixture(autouse=True)
def same_buffers(request, monkeypatch):
    if request.node.get_closest_marker("slow") is None:
        for module in (operations, refine):
            monkeypatch.setattr(
                module, "planned", lambda avatar, photos: SplatConfig(max_pairs=1 << 14, max_rows=1 << 13)
            )
