"""For each quantity of a capture, the range in which avatars stay good, and where a capture lies in it.

The ranges are measured by experiments/check_limits.py on synthetic people, with the shipped weights, each quantity
alone; assets/limits.json holds them.
"""

import json
from importlib import resources
from typing import Any

import numpy as np

from humangs_jax.data.capture import Capture
from humangs_jax.data.masks import person_box
from humangs_jax.data.usable_views import MASK_THRESHOLD

LIMITS = "assets/limits.json"
PHOTO_SIZE = 256
"""Side of the photos that the ranges were measured with, pixels, which is what the shipped weights take."""


def load_limits() -> dict[str, Any]:
    """{"bound": dB, "ranges": {quantity: {"unit", "low", "high"}}}; an end that was never reached is None."""
    return json.loads(resources.files("humangs_jax").joinpath(LIMITS).read_text())


def quantities(capture: Capture) -> dict[str, tuple[float, float]]:
    """(least, most) over the views of what a capture itself shows: photos, camera distance in metres, height of the person in
    pixels of a photo that is reduced to `PHOTO_SIZE`.
    """
    frames = np.asarray(capture.frames)
    centers = np.asarray(capture.cameras.center, float)
    pelvis = np.asarray(capture.body.joint_regressor)[0] @ np.asarray(capture.body.template)
    distances = np.linalg.norm(centers - (np.asarray(capture.poses.translation, float)[frames] + pelvis), axis=-1)
    found = {
        "photos": (float(capture.view_count), float(capture.view_count)),
        "distance of the cameras": (float(distances.min()), float(distances.max())),
    }
    if capture.masks is not None:
        scale = PHOTO_SIZE / max(capture.masks.shape[1:])  # the network reduces larger photos
        heights = [float(np.ptp(person_box(mask > MASK_THRESHOLD)[0])) * scale for mask in capture.masks]
        found["height of the person"] = (min(heights), max(heights))
    return found


def limits_table(capture: Capture) -> str:
    """A line a quantity: the range, what this capture has, and a mark where that lies outside."""
    limits, own = load_limits(), quantities(capture)
    lines = [f"ranges in which avatars lose less than {limits['bound']:g} dB, each alone (docs/stability.md):"]
    width = max(len(name) for name in limits["ranges"])
    for name, row in limits["ranges"].items():
        low, high = row["low"], row["high"]
        wanted = _range(low, high, row["unit"])
        has = ""
        if name in own:
            least, most = own[name]
            outside = (low is not None and least < low) or (high is not None and most > high)
            has = f"here {_range(least, most, row['unit'])}{'  !' * outside}"
        lines.append(f"{name:<{width}}  {wanted:<27}{has}".rstrip())
    return "\n".join(lines)


def _range(low, high, unit):
    if low is None and high is None:
        return "any that was tried"
    if low == high:
        return f"{low:.3g} {unit}".strip()
    if low is None:
        return f"up to {high:.3g} {unit}".strip()
    return f"{low:.3g} {unit} or more".replace("  ", " ") if high is None else f"{low:.3g} to {high:.3g} {unit}".strip()
