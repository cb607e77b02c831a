"""The page of an evaluation: one HTML file that needs no network. Inputs, truth, ours and error of the worst images, every score
of every image, sortable. Its code lies beside this module in report/.
"""

import base64
import heapq
import html
import io
import json
import re
from importlib import resources
from typing import Any

import numpy as np

from humangs_jax.avatar.sheets import error_colors
from humangs_jax.core.array_types import Float
from humangs_jax.evaluation.tables import COLUMNS
from humangs_jax.io.images import resized, to_uint8

SIDE, INPUT_SIDE = 320, 128
"""Longest side of the images on the page, pixels."""
QUALITY = 88
"""Of the JPEGs."""
LARGEST_ERROR = 0.25
"""Mean absolute difference of the channels that gets the last color."""
_MARK = re.compile(r"\{\{(\w+)\}\}")


class Gallery:
    """The images of a page, made small as they come: those of the `limit` lowest PSNR, and the inputs of every person shown."""

    def __init__(self, limit: int):
        self._limit = limit
        self._shots: list[tuple[float, int, dict[str, str]]] = []  # a heap, best first
        self._inputs: dict[str, list[str]] = {}

    def add(
        self, row: int, psnr: float | None, truth: Float[np.ndarray, "h w 3"], ours: Float[np.ndarray, "h w 3"]
    ) -> None:
        """An image and its truth; row: its number among the rows."""
        key = 0.0 if psnr is None else -psnr
        if len(self._shots) >= self._limit and (not self._shots or key <= self._shots[0][0]):
            return
        ours = np.clip(ours, 0, 1)
        error = error_colors(np.abs(truth - ours).mean(axis=-1), LARGEST_ERROR)
        images = {"truth": truth, "ours": ours, "error": error}
        shot = (key, row, {name: _data_url(image, SIDE) for name, image in images.items()})
        (heapq.heappushpop if len(self._shots) >= self._limit else heapq.heappush)(self._shots, shot)

    def add_inputs(self, person: str, images: Float[np.ndarray, "v h w 3"]) -> None:
        """What the method saw of a person."""
        self._inputs[person] = [_data_url(image, INPUT_SIDE) for image in images] if self._limit else []

    @property
    def shots(self) -> dict[int, dict[str, str]]:
        """By row: truth, ours and error."""
        return {row: images for _, row, images in self._shots}

    @property
    def inputs(self) -> dict[str, list[str]]:
        """By person."""
        return self._inputs


def _data_url(image, side):
    from PIL import Image

    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    if factor < 1:
        image = resized(image, max(1, round(factor * width)), max(1, round(factor * height)))
    file = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(file, format="JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode()}"


def page_html(evaluation: dict[str, Any], notes: list[str], gallery: Gallery) -> str:
    """The page as text. evaluation: what `Evaluation.to_json` gives."""
    shown = {
        person for row, image in enumerate(evaluation["images"]) if row in gallery.shots for person in [image["person"]]
    }
    data = evaluation | {
        "notes": notes,
        "columns": {name: column._asdict() for name, column in COLUMNS.items()},
        "shots": gallery.shots,
        "inputs": {person: images for person, images in gallery.inputs.items() if person in shown},
        "largest_error": LARGEST_ERROR,
    }
    folder = resources.files("humangs_jax") / "evaluation" / "report"
    read = lambda name: (folder / name).read_text(encoding="utf-8").strip()
    parts = {
        "title": html.escape(f"{evaluation['name']}, protocol {evaluation['protocol']['name']}"),
        "style": read("style.css"),
        "script": read("report.js"),
        "data": json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),  # a name may not end the script
    }
    return _MARK.sub(lambda mark: parts[mark[1]], read("index.html"))
