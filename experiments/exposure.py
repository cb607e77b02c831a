"""Measures how alike the colors of a person come out from photos in several lights that share no
point of the body.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import (
    PARTS,
    body_parts,
    exposure_gains,
    gains_of,
    linked_views,
    part_colors,
    points_of,
)
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.synthetic.subject import (
    GENERATOR_VERSION,
    SyntheticSubject,
    make_subject,
    pose_subject,
    seeds_of,
)
from humangs_jax.synthetic.surroundings import Lights, cameras_around, sample_lights
from humangs_jax.synthetic.writer import View, capture_views, sample_pose

LIGHT_STREAM, CAMERA_STREAM, BALANCE_STREAM = 101, 102, 103
"""Independent random streams of a seed."""
BALANCE, METERING = (0.15, 0.05, 0.15), 0.15
"""Standard deviations of the logarithms of a photo's white balance (red, green and blue) and of its
exposure. The light of the photo varies besides.
"""
AMBIENT = 0.85
"""Brightness of a light without directions, which shows a part in the color of its texture."""
SETS = {
    "front, back": (0, 180),
    "two of the front, two of the back": (0, 25, 180, 205),
    "left, right": (90, 270),
    "all around": (0, 90, 180, 270),
}
"""{set of photos: degrees of its cameras around the person, 0: from the front}."""


class Off(NamedTuple):
    """Difference between the colors of two sides of a person, in logarithms."""

    tint: float
    """Root mean square over red, green and blue, without their mean."""
    brightness: float
    """Absolute value of the mean over red, green and blue."""


@entry
def exposure(
    run: Run,
    subjects: int = 12,
    first: int = 0,
    size: int = 320,
    split: Literal["test", "validation"] = "test",
) -> None:
    """Measures how far the colors of one side of a person are off those of the other, in photos
    that each have the light, white balance and exposure of another day.

    The numbers are those of the typical part of the body, against the same photos in one light
    without directions. "common points" corrects by the gains that points give which two photos
    both show. "now" corrects by the gains of the package. "in one light" takes the same photos in
    one light and shows the largest logarithm of the gains that parts add to those of common points.

    Options:
    subjects: how many people
    first: index of the first person within the split
    size: side of the photos in pixels
    split: seeds of the people; constants were chosen on "validation"
    """
    body = load_body()
    settings = {
        "split": split,
        "size": size,
        "balance": BALANCE,
        "metering": METERING,
        "generator": GENERATOR_VERSION,
    }
    cases = {
        str(seed): lambda seed=seed: measured(seed, body, size)
        for seed in seeds_of(split, first, subjects)
    }
    rows = run.rows(cases, settings)

    # root mean squares over the people, and the largest gain where none is needed
    table, numbers = [], {}
    for name in SETS:
        found = [row[name] for row in rows.values()]
        rms = {
            key: np.sqrt(np.mean([np.square(row[key]) for row in found], axis=0)).tolist()
            for key in ("photographed", "common points", "now")
        }
        touched = max(row["in one light"] for row in found)
        numbers[name] = rms | {"in one light": touched}
        values = [f"{rms[key][i]:.3f}" for i in (0, 1) for key in rms]
        table.append([name, *values, f"{touched:.3f}"])
    header = ["photos"]
    header += [f"{what}: {key}" for what in Off._fields for key in rms]
    header += ["in one light"]
    about = (
        f"{len(rows)} people of the {split} seeds, photos of {size} px; root mean squares over the"
        " people, of logarithms."
    )
    text = f"{about}\n\n{markdown_table(header, table)}"
    run.show(text, {"settings": settings, "means": numbers, "people": len(rows)})


def measured(seed: int, body: BodyModel, size: int) -> dict[str, dict[str, object]]:
    """Returns {set of photos: the numbers of a person that `exposure` shows}."""
    # cameras around the person, from the front on
    subject = make_subject(seed, body)
    posed = sample_pose(subject, 0)
    facing = np.asarray(matrix_from_axis_angle(jnp.asarray(posed.rotations[0])))
    azimuth = np.arctan2(facing[0, 2], facing[2, 2])
    degrees = sorted({each for angles in SETS.values() for each in angles})
    rng = np.random.default_rng([seed, CAMERA_STREAM])
    cameras = cameras_around(rng, posed.vertices, azimuth + np.radians(degrees), size)

    def photographed(lights: Sequence[Lights]) -> Capture:
        """Returns the photos from all cameras, each in its light and with a pose of its moment."""
        photos = []
        for i, light in enumerate(lights):
            lit = dataclasses.replace(subject, lights=light)
            person = pose_subject(lit, posed.rotations, posed.translation)
            photos.append(
                capture_views(lit, body, [person], [View(0, str(degrees[i]), cameras[i])])
            )
        return together(photos)

    # the same photos in one light, in flat light, and each on another day
    own = subject.lights
    flat = replace(
        own,
        strengths=0 * own.strengths,
        sky=jnp.full(3, AMBIENT),
        ground=jnp.full(3, AMBIENT),
        gain=jnp.ones(3),
    )
    of_day = [
        other_day(subject, np.random.default_rng([seed, LIGHT_STREAM, i]))
        for i in range(len(degrees))
    ]
    one, truth, days = (
        photographed(lights) for lights in ([own] * len(degrees), [flat] * len(degrees), of_day)
    )
    one = dataclasses.replace(one, frames=np.zeros(len(degrees), np.int32), poses=one.poses[:1])

    rows = {}
    for name, angles in SETS.items():
        views = [degrees.index(angle) for angle in angles]
        # "left, right" has its photos at 90 and 270 degrees, which are two sides
        back = np.asarray([90 < angle <= 270 for angle in angles], int)
        photos = days.select(views)
        # how far colors of points are from their true ones, by what gives the gains
        colors, seen = points_of(photos)
        common = gains_of(colors, seen)
        gains = {"photographed": np.ones_like(common), "common points": common}
        gains["now"] = 1 / exposure_gains(photos)
        in_flat = points_of(truth.select(views))[0]
        parts = body_parts(body)
        row: dict[str, object] = {
            key: off(colors * each[:, None], in_flat, seen, parts, back)
            for key, each in gains.items()
        }
        # in one light the gains should be 1
        same = one.select(views)
        points = points_of(same)
        moved = np.log(exposure_gains(same) * gains_of(*points))
        row["in one light"] = float(np.abs(moved).max())
        row["groups"] = int(linked_views(*points).max()) + 1
        rows[name] = row
    return rows


def other_day(subject: SyntheticSubject, rng: np.random.Generator) -> Lights:
    """Returns a light of another day, with the white balance and exposure of another camera."""
    lights = sample_lights(rng)
    camera = np.exp(rng.normal(0, BALANCE) + rng.normal(0, METERING))
    return replace(lights, gain=lights.gain * jnp.asarray(camera, jnp.float32))


def together(photos: Sequence[Capture]) -> Capture:
    """Joins captures of one photo each into one capture, with a frame for each photo."""
    first = photos[0]

    def joined(name):
        return jax.tree.map(
            lambda *leaves: np.concatenate(leaves), *(getattr(photo, name) for photo in photos)
        )

    return dataclasses.replace(
        first,
        images=joined("images"),
        masks=joined("masks"),
        cameras=joined("cameras"),
        poses=joined("poses"),
        frames=np.arange(len(photos), dtype=np.int32),
        names=tuple(photo.names[0] for photo in photos),
    )


def off(
    colors: Float[np.ndarray, "v n 3"],
    truth: Float[np.ndarray, "v n 3"],
    seen: np.ndarray,
    parts: Int[np.ndarray, " n"],
    sides: Int[np.ndarray, " v"],
) -> Off:
    """Returns how far the colors of one side are off those of the other, compared with their true
    difference: the median over the parts of the body that both sides show.

    Args:
        colors: colors of the points in each view
        truth: the same in a light without directions
        seen: (v, n) which view shows which point
        parts: part of the body of each point
        sides: side of the person of each view, 0 or 1
    """
    found, expected = (part_colors(each, seen, parts, sides) for each in (colors, truth))
    errors = []
    for part in range(len(PARTS)):
        colored = [side[part] for side in (*found, *expected)]
        each = [part_color.color for part_color in colored if part_color is not None]
        if len(each) < len(colored):
            continue
        one, other, true_one, true_other = each
        errors.append((one - other) - (true_one - true_other))
    typical = np.median(errors, axis=0)
    tint = typical - typical.mean()
    return Off(float(np.sqrt(np.mean(tint**2))), float(abs(typical.mean())))
