"""The Python of README.md and of the pages that begin with it, executed as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
LEAST_PSNR = 25.7
"""dB of a photo that the network was given, rendered again: 26.0 where this was written, before refinement."""
README_WORDS = 700
"""Of README.md, with its code, table and citation: it is read in three minutes."""


def run(page):
    """The names that all blocks of Python of a page leave."""
    names: dict = {}
    for block in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL):
        exec(compile(block, page, "exec"), names)
    return names


def test_the_blocks_of_the_readme_run():
    names = run("README.md")
    image, capture = np.asarray(names["image"]), names["capture"]
    assert image.shape == (512, 512, 3) and image.dtype == np.float32
    error = image - np.asarray(capture.images[0])
    assert -10 * np.log10(np.mean(error**2)) > LEAST_PSNR
    assert len(names["gaussians"].means) == len(names["avatar"].gaussians.means)
    assert float(np.abs(names["gradient"].colors).max()) > 0
    assert names["ablation"] != names["config"]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= README_WORDS


@pytest.mark.slow
@pytest.mark.parametrize("page", ["docs/how_it_works.md", "docs/splatting.md", "docs/ablations.md"])
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(page)
