"""The README's ten lines, executed as they stand."""

from pathlib import Path

import numpy as np

README = Path(__file__).parents[2] / "README.md"
LEAST_PSNR = 25.7
"""dB of a photo that the network was given, drawn again: 26.0 where this was written."""


def ten_lines():
    """The first block of Python in the README."""
    return README.read_text().split("```python\n")[1].split("```")[0]


def test_the_ten_lines_run_as_they_stand():
    lines = ten_lines()
    assert 8 <= len([line for line in lines.splitlines() if line.strip()]) <= 10
    names: dict = {}
    exec(compile(lines, str(README), "exec"), names)
    image, capture = np.asarray(names["image"]), names["capture"]
    assert image.shape == (512, 512, 3) and image.dtype == np.float32
    error = image - np.asarray(capture.images[0])
    assert -10 * np.log10(np.mean(error**2)) > LEAST_PSNR
    assert len(names["gaussians"].means) == len(names["avatar"].gaussians.means)
    assert len(names["body"].joint_names) == 55
