"""Who a synthetic person is, before anything is built: body, colouring, hair, clothes, light. A few numbers, drawn in a moment.

`describe` splits what a person IS from the geometry that `subject.make_subject` builds, so that thousands can be counted.
"""

import dataclasses

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float
from humangs_jax.people.complexion import Complexion, sample_complexion
from humangs_jax.people.haircuts import Haircut, sample_haircut
from humangs_jax.people.outfits import Garment, sample_outfit
from humangs_jax.people.shading import Lights, sample_lights

SHAPE_SPREAD = 0.55
"""Standard deviation of the shape coefficients that have no rule of their own; beyond 2 of them nothing is drawn."""
HEIGHTS = {True: (1.765, 0.085), False: (1.645, 0.08)}
"""Mean and standard deviation of the stature in metres of men (True) and women."""
HEIGHT_RANGE = (1.42, 2.08)
TALLEST_WOMAN = 1.95
YEARS = (15.0, 85.0)
YOUNG, OLD = 25.0, 90.0
"""Years at which the body's age coefficient is 0 and 1."""
LENGTHS = ("height", "leg_length", "torso_length")
"""Coefficients that share what is missing to the wanted stature."""


@dataclasses.dataclass(frozen=True)
class Person:
    """seed; betas: (s,) shape coefficients; male: dressed as a man; years; stature in metres, without shoes.

    complexion: colours of skin, hair, eyes. haircut: hair and beard. garments: clothes, shoes and accessories, innermost first.
    lights: what the person stands in.
    """

    seed: int
    betas: Float[np.ndarray, " s"]
    male: bool
    years: float
    stature: float
    complexion: Complexion
    haircut: Haircut
    garments: tuple[Garment, ...]
    lights: Lights


def describe(seed: int, body: BodyModel) -> Person:
    """The person of a seed, unbuilt."""
    rng = np.random.default_rng([seed, 0])
    male, years = bool(rng.random() < 0.5), float(np.clip(YEARS[0] + 70 * rng.beta(1.15, 1.9), *YEARS))
    betas, stature = sample_shape(rng, body, male, years)
    garments = sample_outfit(np.random.default_rng([seed, 11]), male, years)
    colours = np.random.default_rng([seed, 12])
    complexion = sample_complexion(colours, male, years)
    haircut = sample_haircut(np.random.default_rng([seed, 13]), male, years, {g.kind for g in garments})
    lights = sample_lights(np.random.default_rng([seed, 14]))
    return Person(seed, betas, male, years, stature, complexion, haircut, garments, lights)


def sample_shape(
    rng: np.random.Generator, body: BodyModel, male: bool, years: float
) -> tuple[Float[np.ndarray, " s"], float]:
    """(s,) shape coefficients and the stature in metres that they give."""
    names = body.shape_names
    at = {name: i for i, name in enumerate(names)}
    betas = np.clip(rng.normal(0, 1, len(names)), -2, 2) * SHAPE_SPREAD
    betas[at["sex_male"]] = (1 if male else -1) * rng.uniform(0.55, 1.0)
    betas[at["age"]] = (years - YOUNG) / (OLD - YOUNG) if years > YOUNG else 0.03 * (years - YOUNG)
    heavier = 0.25 * np.clip((years - 20) / 30, 0, 1)
    betas[at["weight"]] = np.clip(rng.normal(0.05 + heavier, 0.62), -1.0, 1.8)
    betas[at["muscle"]] = np.clip(rng.normal(0.1 - 0.4 * (years > 60), 0.6), -1.0, 1.5)
    mean, spread = HEIGHTS[male]
    youth = 0.04 * np.clip(18 - years, 0, 3) / 3 + 0.03 * np.clip((years - 60) / 25, 0, 1)
    tall = rng.standard_t(5) if rng.random() < 0.85 else rng.uniform(-2.6, 3.4)
    wanted = np.clip(mean - youth + spread * tall, HEIGHT_RANGE[0], HEIGHT_RANGE[1] if male else TALLEST_WOMAN)
    stature, gains = _stature(body)
    share = np.asarray([gains[at[name]] for name in LENGTHS])
    missing = wanted - (stature + gains @ betas)
    betas[[at[name] for name in LENGTHS]] += missing * share / (share @ share)
    return betas.astype(np.float32), float(wanted)


_STATURES: dict[int, tuple] = {}


def _stature(body):
    """Height of the mean body and metres (s,) that a unit of each coefficient adds; kept for the body used last."""
    if id(body) not in _STATURES:
        template, directions = np.asarray(body.template), np.asarray(body.shape_directions)
        top, bottom = np.argmax(template[:, 1]), np.argmin(template[:, 1])
        gains = (directions[top, 1] - directions[bottom, 1]).astype(float)
        _STATURES.clear()
        _STATURES[id(body)] = (body, float(template[top, 1] - template[bottom, 1]), gains)
    return _STATURES[id(body)][1:]
