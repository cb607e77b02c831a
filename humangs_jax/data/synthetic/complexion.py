"""Skin, face, eyes and hair colours, painted in template coordinates so that they sit on the features of every shape."""

import dataclasses

import numpy as np

from humangs_jax.data.synthetic.fabrics import Material, Spots, band, colour, mix
from humangs_jax.data.synthetic.hair import SHORT_LINE, above_line
from humangs_jax.data.synthetic.noise import Ripples, lattice

EYE_X, EYE_Y, MOUTH_Y = 0.029, 0.330, 0.2629


@dataclasses.dataclass(frozen=True)
class Complexion:
    """Colours (3,) of skin, lips, hair and iris; stubble: darkness of shaven scalp and chin in [0, 1] each."""

    skin: np.ndarray
    lips: np.ndarray
    hair: np.ndarray
    iris: np.ndarray
    scalp_stubble: float
    chin_stubble: float
    brow: float


def sample_complexion(rng: np.random.Generator, male: bool) -> Complexion:
    """Random colouring; fair skin goes with any hair, dark skin with dark hair."""
    darkness = rng.beta(1.2, 1.3)
    fair, mid, dark = np.asarray([0.88, 0.70, 0.60]), np.asarray([0.70, 0.49, 0.36]), np.asarray([0.30, 0.185, 0.13])
    skin = fair + (mid - fair) * min(2 * darkness, 1) if darkness < 0.5 else mid + (dark - mid) * (2 * darkness - 1)
    skin = np.clip(skin * (1 + rng.normal(0, 0.03, 3)), 0.05, 0.9).astype(np.float32)
    lips = skin * np.asarray([0.90, 0.62, 0.62]) if male or rng.random() < 0.5 else skin * np.asarray([0.9, 0.40, 0.42])
    kind = rng.choice(["black", "brown", "blond", "red", "grey", "dyed"], p=_hair_odds(darkness))
    hair = {
        "black": colour(0.07, 0.3, rng.uniform(0.05, 0.12)),
        "brown": colour(rng.uniform(0.05, 0.09), rng.uniform(0.5, 0.7), rng.uniform(0.15, 0.4)),
        "blond": colour(rng.uniform(0.09, 0.13), rng.uniform(0.35, 0.6), rng.uniform(0.6, 0.85)),
        "red": colour(rng.uniform(0.03, 0.06), rng.uniform(0.6, 0.8), rng.uniform(0.35, 0.6)),
        "grey": colour(0.1, 0.04, rng.uniform(0.4, 0.8)),
        "dyed": colour(rng.random(), 0.6, 0.6),
    }[kind]
    iris = (
        colour(0.07, 0.6, 0.2) if darkness > 0.45 or rng.random() < 0.4 else colour(rng.uniform(0.25, 0.62), 0.4, 0.5)
    )
    stubble = rng.uniform(0, 0.5) if male else 0.0
    return Complexion(skin, lips.astype(np.float32), hair, iris, 0.0, stubble, rng.uniform(0.5, 0.95))


def _hair_odds(darkness):
    dark = np.clip((darkness - 0.22) / 0.2, 0, 1)
    fair_odds, dark_odds = (
        np.asarray([0.2, 0.35, 0.22, 0.08, 0.1, 0.05]),
        np.asarray([0.78, 0.12, 0.01, 0.0, 0.06, 0.03]),
    )
    return fair_odds + (dark_odds - fair_odds) * dark


def skin_material(rng: np.random.Generator, tones: Complexion) -> Material:
    """Skin with lips, cheeks, brows, lids, nostrils, stubble and nails' worth of variation."""
    cloud = Ripples(rng, 0.06)
    thickness, arch = rng.uniform(0.0028, 0.005), rng.uniform(0.5, 1.5)

    def albedo(s: Spots):
        x, y, z = np.abs(s.template[:, 0]), s.template[:, 1], s.template[:, 2]
        result = tones.skin * (1 + 0.03 * cloud(s.template))[:, None]
        head = y > 0.19
        if not head.any():
            return result
        i = np.flatnonzero(head & (z > -0.12))
        result[i] = _face(tones, result[i], x[i], y[i], z[i], s.template[i], thickness, arch)
        return result

    return Material(albedo, wrinkles=0.0, sheen=0.25)


def _face(tones, result, x, y, z, template, thickness, arch):
    front = np.clip((z - 0.07) / 0.02, 0, 1)
    flush = np.exp(-(((x - 0.043) / 0.02) ** 2) - (((y - 0.292) / 0.018) ** 2)) + 0.6 * np.exp(
        -((x / 0.012) ** 2) - (((y - 0.295) / 0.012) ** 2)
    )
    result = mix(result, result * np.asarray([1.02, 0.82, 0.80]), 0.6 * front * np.clip(flush, 0, 1))
    socket = np.exp(-(((x - EYE_X) / 0.017) ** 2) - (((y - EYE_Y) / 0.010) ** 2))
    result = mix(result, result * np.asarray([0.72, 0.66, 0.66]), 0.7 * socket * front)
    rim = np.sqrt(((x - EYE_X) / 0.0155) ** 2 + ((y - EYE_Y - 0.001) / 0.0075) ** 2)
    result = mix(result, result * 0.25, 0.8 * band(rim, 0.75, 1.08, 0.15) * (y > EYE_Y - 0.002) * front)
    corner = 1 - (x / 0.026) ** 2
    bow = 0.009 * np.clip(corner, 0, 1) * (1 - 0.35 * np.exp(-((x / 0.005) ** 2)))
    lips = band(y, MOUTH_Y - 0.0115 * np.clip(corner, 0, 1) ** 0.7, MOUTH_Y + bow, 0.002) * (corner > 0) * (z > 0.08)
    result = mix(result, tones.lips, 0.85 * lips)
    line = band(y, MOUTH_Y - 0.0012, MOUTH_Y + 0.0012, 0.001) * (x < 0.026) * (z > 0.08)
    result = mix(result, tones.lips * 0.35, line)
    nostril = np.exp(-(((x - 0.0085) / 0.004) ** 2) - (((y - 0.2845) / 0.0025) ** 2)) * (z > 0.1)
    result = mix(result, result * 0.3, np.clip(nostril, 0, 1))
    brow_line = 0.3485 + arch * (0.0045 - 18 * (x - 0.033) ** 2)
    inside = band(x, 0.012, 0.05, 0.006)
    brow = band(np.abs(y - brow_line), -1, thickness * np.clip(1.5 - x / 0.06, 0.4, 1), 0.002) * inside * front
    brow_colour = np.minimum(tones.hair, 0.5) * 0.8
    result = mix(result, brow_colour, tones.brow * brow)
    grain = 0.75 + 0.5 * lattice(template / 0.003, 11)
    if tones.scalp_stubble > 0:
        cover = np.clip(above_line(template, SHORT_LINE) / 0.012, 0, 1) * (1 - (np.abs(x) > 0.0765) * (y < 0.355))
        result = mix(result, tones.hair, np.clip(tones.scalp_stubble * cover * grain, 0, 1))
    if tones.chin_stubble > 0:
        jaw = np.clip((0.281 + 0.3 * np.maximum(x - 0.04, 0) - y) / 0.008, 0, 1) * np.clip((y - 0.205) / 0.01, 0, 1)
        jaw = jaw * np.clip((z - 0.03) / 0.03, 0, 1) * (1 - lips)
        result = mix(result, 0.5 * tones.hair + 0.3 * result, np.clip(0.6 * tones.chin_stubble * jaw * grain, 0, 1))
    return result


def eye_material(tones: Complexion) -> Material:
    """White, iris, pupil and a catch-light that belongs to the surface."""

    def albedo(s: Spots):
        d = s.template
        angle = np.arccos(np.clip(d[:, 2] / np.maximum(np.linalg.norm(d, axis=1), 1e-6), -1, 1))
        white = np.asarray([0.84, 0.82, 0.80], np.float32)
        result = mix(white, tones.iris, band(angle, -1, 0.47, 0.05))
        result = mix(result, tones.iris * 0.4, band(angle, 0.40, 0.48, 0.05))
        result = mix(result, np.asarray([0.02, 0.02, 0.02], np.float32), band(angle, -1, 0.21, 0.05))
        glint = np.sqrt((d[:, 0] - 0.15) ** 2 + (d[:, 1] - 0.2) ** 2)
        return mix(result, np.asarray([0.85, 0.85, 0.85], np.float32), band(glint, -1, 0.08, 0.05) * (d[:, 2] > 0))

    return Material(albedo)


def hair_material(rng: np.random.Generator, base: np.ndarray, streak: float) -> Material:
    """Strands: fine streaks around the head, coarse ones on top."""
    seed = int(rng.integers(1 << 20))
    tips = base * rng.uniform(0.7, 1.4)

    def albedo(s: Spots):
        angle = np.arctan2(s.template[:, 0], s.template[:, 2] - 0.02)
        radial = np.sqrt(s.template[:, 0] ** 2 + (s.template[:, 2] - 0.02) ** 2)
        fine = lattice(np.stack([angle / 0.045, s.template[:, 1] / 0.06, radial / 0.03], -1), seed)
        coarse = lattice(np.stack([angle / 0.25, s.template[:, 1] / 0.12], -1), seed + 1)
        bright = 1 + streak * (1.1 * (fine - 0.5) + 0.7 * (coarse - 0.5))
        down = np.clip((0.3 - s.template[:, 1]) / 0.35, 0, 1)
        return mix(base, tips, down) * bright[:, None]

    return Material(albedo, wrinkles=0.0, sheen=0.4)
