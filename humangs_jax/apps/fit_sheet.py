"""A fit as an image: the body over each photo with the keypoints of the fit, and the error over time.

A disc is a keypoint: the person's left blue, right red, middle white. An outlier is a ring. A line leads to the cross of the
body's landmark; where the body fits, disc and cross coincide.
"""

import itertools
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.apps.check import LEFT, LONGEST_SIDE, RIGHT, draw_body
from humangs_jax.avatar.sheets import tile
from humangs_jax.body.joints import FINGERS
from humangs_jax.core.array_types import Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.examination import Examination
from humangs_jax.io.images import to_uint8, write_png

VIEWS = 24
"""Most views on a sheet."""
FINE = 2
"""Factor by which sheets are drawn larger and then shrunk, for smooth lines."""
RADIUS, SMALL = 4, 2
"""Radii of discs on the body, and on hands and face, pixels of a tile."""
WHITE, BLACK, CROSS = (255, 255, 255), (0, 0, 0), (255, 0, 230)
TEXT_SHARE, SMALLEST_TEXT, LARGEST_TEXT = 1 / 60, 10, 22
"""Height of the plot's letters: a share of its width, within limits, pixels."""
LINES = 10
"""The plot's height in letters."""


def fit_sheet(capture: Capture, keypoints: Keypoints, examination: Examination, out: str | Path) -> None:
    """Write a sheet of up to 24 views, evenly chosen, as a PNG; below it the error over time if there are several frames.

    Arguments: examination: of this capture by these keypoints. Raises: OSError if the image cannot be written.
    """
    count = capture.view_count
    chosen = np.unique(np.linspace(0, count - 1, min(count, VIEWS)).round().astype(int)).tolist()
    drawn = [_with_keypoints(_overlay(capture, view), capture, keypoints, examination, view) for view in chosen]
    sheet = tile(np.stack(drawn), labels=[_label(examination, view) for view in chosen])
    if len(examination.frames) > 1:
        sheet = np.concatenate([sheet, plot_over_time(examination.frames, sheet.shape[1])])
    write_png(out, sheet)


def plot_over_time(errors: Float[np.ndarray, " m"], width: int) -> Float[np.ndarray, "height width 3"]:
    """A plot of the median error of each of at least two frames, pixels; NaN leaves a gap."""
    from PIL import Image, ImageDraw, ImageFont

    text = int(np.clip(width * TEXT_SHARE, SMALLEST_TEXT, LARGEST_TEXT))
    plot = Image.new("RGB", (width, LINES * text), WHITE)
    pen, font = ImageDraw.Draw(plot), ImageFont.load_default(text)
    left, right, top, bottom = 3 * text, width - 2 * text, 2 * text, (LINES - 2) * text
    finite = errors[np.isfinite(errors)]
    highest = 1.05 * float(finite.max(initial=0.0)) or 1.0
    x = lambda frame: left + (right - left) * frame / (len(errors) - 1)
    y = lambda error: bottom - (bottom - top) * error / highest
    for tick in _ticks(highest, 4):
        pen.line([(left, y(tick)), (right, y(tick))], fill=(225, 225, 225))
        pen.text((left - 6, y(tick)), f"{tick:g}", fill=BLACK, font=font, anchor="rm")
    for tick in _ticks(len(errors) - 1, width / (6 * text), whole=True):
        pen.line([(x(tick), bottom), (x(tick), bottom + 4)], fill=BLACK)
        pen.text((x(tick), bottom + 6), f"{tick:g}", fill=BLACK, font=font, anchor="mt")
    pen.line([(left, top), (left, bottom), (right, bottom)], fill=BLACK)
    pen.text((left, top - 6), "median error of each frame, pixels", fill=BLACK, font=font, anchor="lb")
    points = [(x(i), y(error)) if np.isfinite(error) else None for i, error in enumerate(errors)]
    color = tuple(to_uint8(np.asarray(LEFT)).tolist())
    for a, b in itertools.pairwise(points):
        if a and b:
            pen.line([a, b], fill=color, width=2)
    for point in points:
        if point:
            pen.circle(point, 2, fill=color)
    return np.asarray(plot) / 255


def _overlay(capture, view):
    """The body over a photo, its longest side as long as that of any tile."""
    shown = capture.select([view]).resized(LONGEST_SIDE)
    pose = capture.pose(int(capture.frames[view]))
    return draw_body(capture.body, jnp.asarray(capture.betas), pose, shown.cameras[0], shown.images[0])[0]


def _with_keypoints(image, capture, keypoints, examination, view):
    """An image with discs, crosses, and the lines between them."""
    from PIL import Image, ImageDraw

    height, width = image.shape[:2]
    canvas = Image.fromarray(to_uint8(image)).resize((FINE * width, FINE * height), Image.Resampling.BILINEAR)
    pen = ImageDraw.Draw(canvas)
    scale = FINE * np.asarray([width / capture.images.shape[2], height / capture.images.shape[1]])
    within = lambda points: np.clip(points * scale, -FINE * width, 2 * FINE * width)
    discs, crosses = within(keypoints.points[view]), within(examination.landmarks[view])
    shown = np.flatnonzero(examination.compared[view])
    radii = [FINE * (SMALL if _is_small(name) else RADIUS) for name in keypoints.set.names]
    for k in shown:
        (x, y), arm = crosses[k], 1.5 * radii[k]
        for line in (
            [tuple(discs[k]), (x, y)],
            [(x - arm, y - arm), (x + arm, y + arm)],
            [(x - arm, y + arm), (x + arm, y - arm)],
        ):
            pen.line(line, fill=CROSS, width=FINE)
    for k in shown:
        color, outlier = _color(keypoints.set.names[k]), examination.outliers[view, k]
        pen.circle(tuple(discs[k]), radii[k] + FINE, fill=None if outlier else color, outline=BLACK, width=FINE)
        if outlier:
            pen.circle(tuple(discs[k]), radii[k], outline=color, width=FINE)
    return np.asarray(canvas.resize((width, height), Image.Resampling.BOX)) / 255


def _is_small(name):
    return name.startswith("face_") or any(
        part in name for part in ("hand_root", *(f"_{finger}_" for finger in FINGERS))
    )


def _color(name):
    side = {"left": LEFT, "right": RIGHT}.get(name.split("_")[0])
    return WHITE if side is None else tuple(to_uint8(np.asarray(side)).tolist())


def _label(examination, view):
    fit = examination.report.views[view]
    return f"{fit.name}  {f'{fit.median:.1f} px' if fit.keypoints else 'no keypoints'}"


def _ticks(highest, count, whole=False):
    """Round numbers from 0 to `highest`, about `count`."""
    rough = highest / count
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(x for x in (1, 2, 5, 10) if x * power >= rough * (1 - 1e-9))
    return np.arange(0, highest * (1 + 1e-9), max(step, 1.0) if whole else step)
