"""Sheets of labelled images, and comparisons with the error in color.

Images are (h, w, 3) float arrays in [0, 1].
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.images import to_uint8, write_png

LARGEST_ERROR = 0.25
"""Mean absolute difference of the channels that gets the last of `ERROR_COLORS`."""
GAP = 4
"""Pixels of white between tiles."""
TEXT_SHARE, SMALLEST_TEXT, LARGEST_TEXT = 1 / 14, 10, 22
"""Height of the letters: a share of the width of a tile, within limits, pixels."""
ERROR_COLORS = ((1, 1, 1), (1, 0.87, 0.35), (0.93, 0.38, 0.13), (0.6, 0.04, 0.2), (0.12, 0, 0.12))
"""Colors of errors from none to the largest, evenly spaced: white first, like the background, then darker
at every step, so that the order is also visible in grey."""


def contact_sheet(
    images: Float[np.ndarray, "v h w 3"],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
    headers: Sequence[str] | None = None,
    columns: int | None = None,
) -> None:
    """Write a grid of images as a PNG; see `tile`."""
    write_png(path, tile(images, labels=labels, headers=headers, columns=columns))


def side_by_side(
    truth: Float[np.ndarray, "v h w 3"],
    ours: Float[np.ndarray, "v h w 3"],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
) -> None:
    """Write a PNG with truth, ours and the error of every view, and the scale of the error below.

    labels: one per view.

    Raises: ValueError if there is no view.
    """
    errors = error_colors(np.abs(truth - ours).mean(axis=-1), LARGEST_ERROR)
    triples = np.stack([truth, ours, errors], axis=1).reshape(-1, *truth.shape[1:])
    headers = ("truth", "ours", "error")
    columns = 3 if len(truth) <= 3 else 6
    texts = None if labels is None else [text for label in labels for text in (label, "", "")]
    sheet = tile(triples, labels=texts, headers=headers * (columns // 3), columns=columns)
    scale = error_legend(sheet.shape[1], _text_height(truth.shape[2]), LARGEST_ERROR)
    write_png(path, np.concatenate([sheet, scale]))


def tile(
    images: Float[np.ndarray, "v h w 3"],
    *,
    labels: Sequence[str] | None = None,
    headers: Sequence[str] | None = None,
    columns: int | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """A white sheet with the images in rows.

    Arguments:
        labels: one per image, written above it; what does not fit is cut off. headers: one per column.
        columns: images in a row; about as many as rows if left out.

    Raises: ValueError if there is no image, or the number of labels or headers does not fit.
    """
    count, height, width = images.shape[:3]
    if count == 0:
        raise ValueError("images: expected at least one, got none")
    columns = int(np.ceil(np.sqrt(count))) if columns is None else min(columns, max(count, 1))
    if columns < 1:
        raise ValueError(f"columns: expected at least 1, got {columns}")
    if labels is not None and len(labels) != count:
        raise ValueError(f"labels: expected {count}, one per image, got {len(labels)}")
    if headers is not None and len(headers) != columns:
        raise ValueError(f"headers: expected {columns}, one per column, got {len(headers)}")
    text = _text_height(width)
    strip = 0 if labels is None else text + 2 * GAP
    top = 0 if headers is None else text + 2 * GAP
    rows = -(-count // columns)
    sheet = np.ones((top + rows * (strip + height + GAP) + GAP, columns * (width + GAP) + GAP, 3))
    corners = [(top + GAP + (i // columns) * (strip + height + GAP), GAP + (i % columns) * (width + GAP)) for i in range(count)]
    for image, (y, x) in zip(images, corners, strict=True):
        sheet[y + strip : y + strip + height, x : x + width] = image
    texts = [(label, x, y, width) for label, (y, x) in zip(labels or (), corners, strict=False)]
    texts += [(header, GAP + i * (width + GAP), GAP, width) for i, header in enumerate(headers or ())]
    return write_texts(sheet, texts, text)


def write_texts(
    sheet: Float[np.ndarray, "height width 3"], texts: Sequence[tuple[str, int, int, int]], text_height: int
) -> Float[np.ndarray, "height width 3"]:
    """The sheet with black texts; each is (text, left, top, width in pixels that it may take)."""
    from PIL import Image, ImageDraw, ImageFont

    if not any(text for text, *_ in texts):
        return sheet
    canvas = Image.fromarray(to_uint8(sheet))
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(text_height)
    for text, x, y, room in texts:
        shown = text
        while shown and pen.textlength(shown, font=font) > room:
            shown = shown[:-2] + "…" if len(shown) > 2 else ""
        pen.text((x, y), shown, fill=(0, 0, 0), font=font)
    # only what was written on is rounded to 8 bits
    return np.where(np.asarray(canvas) == to_uint8(sheet), sheet, np.asarray(canvas) / 255)


def error_colors(errors: Float[np.ndarray, "*shape"], largest: float | int) -> Float[np.ndarray, "*shape 3"]:
    """Colors of non-negative errors: `ERROR_COLORS`, linear in between; errors above `largest` get the last."""
    if not largest > 0:
        raise ValueError(f"largest error: expected a positive number, got {largest}")
    stops = np.linspace(0, largest, len(ERROR_COLORS))
    return np.stack([np.interp(errors, stops, channel) for channel in zip(*ERROR_COLORS, strict=True)], axis=-1)


def error_legend(width: int, text_height: int, largest: float | int) -> Float[np.ndarray, "height width 3"]:
    """A strip with the scale of `error_colors` and its ends in numbers."""
    legend = np.ones((2 * GAP + text_height, width, 3))
    left, right = width // 3, max(2 * width // 3, width // 3 + 2)
    legend[GAP : GAP + text_height, left:right] = error_colors(np.linspace(0, largest, right - left), largest)
    texts = [("absolute error: 0", max(left - 9 * text_height, GAP), GAP // 2, left - GAP)]
    texts += [(f"{largest:g} and more", right + GAP, GAP // 2, width - right - GAP)]
    return write_texts(legend, texts, text_height)


def _text_height(width: int) -> int:
    return int(np.clip(width * TEXT_SHARE, SMALLEST_TEXT, LARGEST_TEXT))
