"""Colors of skin, face, eyes and hair.

They are painted in template coordinates, so that they fit the features of every shape of body.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from humangs_jax.synthetic.fabrics import Material, Spots, band, color, mix
from humangs_jax.synthetic.hair import LONG_CUTS, SHORT_LINE, Haircut, above_line, beard_field
from humangs_jax.synthetic.outfits import drawn
from humangs_jax.synthetic.surfaces import Field, Points, Ripples, lattice

_EYE_X = 0.029
"""Distance of the eyes from the middle, template coordinates."""
_EYE_Y = 0.330
"""Height of the eyes, template coordinates."""
_MOUTH_Y = 0.2629
"""Height of the mouth, template coordinates."""
_HAIR = {
    "black": (0.07, 0.3, (0.05, 0.12)),
    "brown": ((0.05, 0.09), (0.5, 0.7), (0.15, 0.4)),
    "blond": ((0.09, 0.13), (0.35, 0.6), (0.5, 0.76)),
    "red": ((0.03, 0.06), (0.6, 0.8), (0.35, 0.6)),
    "grey": (0.1, 0.05, (0.3, 0.66)),
    "dyed": ((0, 1), 0.55, 0.55),
}
"""Hue, saturation and value of each color of hair, 0 to 1. A pair is a range."""
_Face = tuple[Field, Field, Field, Points]
"""Points of the face: distances |x| from the middle (n,), heights (n,), a number from 0 (behind the
face) to 1 (in front) (n,), and template coordinates (n, 3).
"""


@dataclasses.dataclass(frozen=True)
class Complexion:
    """Colors of skin, hair and eyes, and strengths of what is painted on the face."""

    skin: np.ndarray
    """Color of the skin, (3,), 0 to 1."""
    lips: np.ndarray
    """Color of the lips, (3,), 0 to 1."""
    hair: np.ndarray
    """Color of hair, brows and beard, (3,), 0 to 1."""
    iris: np.ndarray
    """Color of the iris, (3,), 0 to 1."""
    shadow_color: np.ndarray
    """Color of the make-up on the lids, (3,), 0 to 1."""
    brow: float
    """Strength of the brows, 0 to 1."""
    freckles: float
    """Strength of freckles, 0 to 1; 0 for none."""
    wrinkles: float
    """Strength of the wrinkles of age, 0 to 1."""
    shadow: float
    """Strength of the make-up on the lids, 0 to 1."""
    liner: float
    """Strength of the line around the eyes, 0 to 1."""
    blush: float
    """Strength of the make-up on the cheeks, 0 to 1."""
    tan: float
    """How much darker the arms are than skin under clothes, 0 to 1."""


def sample_complexion(rng: np.random.Generator, male: bool, years: float) -> Complexion:
    """Draws colors. Hair of dark skin is mostly dark, and hair of old people is mostly grey."""
    darkness = rng.beta(1.05, 1.15)
    fair = np.asarray([0.86, 0.67, 0.57])
    mid = np.asarray([0.70, 0.49, 0.36])
    dark = np.asarray([0.26, 0.155, 0.105])
    if darkness < 0.5:
        skin = fair + (mid - fair) * min(2 * darkness, 1)
    else:
        skin = mid + (dark - mid) * (2 * darkness - 1)
    undertone = rng.normal(0, 0.035)
    skin = np.clip(
        skin * (1 + rng.normal(0, 0.02, 3)) * [1 + undertone, 1, 1 - 1.3 * undertone], 0.05, 0.92
    )
    made_up = not male and rng.random() < 0.55
    lips = skin * np.asarray([0.90, 0.64, 0.64])
    if made_up and rng.random() < 0.75:
        hue = rng.choice([rng.uniform(0.94, 1.03), rng.uniform(0.935, 0.97)])
        lips = 0.3 * lips + 0.7 * color(hue, rng.uniform(0.45, 0.8), rng.uniform(0.35, 0.75))
    grey = float(np.clip((years - 40) / 35, 0, 0.85))
    # odds of the colors of `_HAIR` with fair and with dark skin
    fair_odds = np.asarray([0.2, 0.35, 0.22, 0.08, 0.06, 0.05])
    dark_odds = np.asarray([0.80, 0.12, 0.01, 0.0, 0.03, 0.03])
    share = np.clip((darkness - 0.22) / 0.2, 0, 1)
    odds = (fair_odds + (dark_odds - fair_odds) * share) * (1 - grey)
    odds[4] += grey
    if years > 60:
        odds[5] *= 0.3
    kind = rng.choice(list(_HAIR), p=odds / odds.sum())
    # all of them are drawn
    colors = {name: [drawn(rng, value) for value in values] for name, values in _HAIR.items()}
    hair = color(*colors[kind])
    brown = darkness > 0.45 or rng.random() < 0.4
    if brown:
        iris = color(0.07, 0.6, rng.uniform(0.1, 0.3))
    else:
        iris = color(rng.uniform(0.25, 0.62), 0.4, 0.5)
    # nail varnish is not shown, but its numbers are drawn: a seed stays the same person
    if made_up and rng.random() < 0.5:
        color(
            rng.choice([rng.uniform(0.9, 1.05), rng.random()]),
            rng.uniform(0.3, 0.8),
            rng.uniform(0.3, 0.8),
        )
    return Complexion(
        skin=skin.astype(np.float32),
        lips=np.asarray(lips, np.float32),
        hair=hair,
        iris=iris,
        shadow_color=color(rng.random(), rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6)),
        brow=rng.uniform(0.55, 0.95),
        freckles=rng.uniform(0.3, 0.8) if darkness < 0.35 and rng.random() < 0.22 else 0.0,
        wrinkles=float(np.clip((years - 35) / 40, 0, 1)),
        shadow=rng.uniform(0.2, 0.7) if made_up and rng.random() < 0.6 else 0.0,
        liner=_liner(rng, made_up, male),
        blush=rng.uniform(0.3, 0.8) if made_up else rng.uniform(0.0, 0.35),
        tan=rng.uniform(0.0, 0.12) * (darkness < 0.6),
    )


def _liner(rng: np.random.Generator, made_up: bool, male: bool) -> float:
    """Draws how dark the edges of the eyelids are, 0 to 1."""
    if made_up:
        return rng.uniform(0.4, 0.9)
    return 0.0 if male else rng.uniform(0.0, 0.25)


def skin_material(rng: np.random.Generator, tones: Complexion, haircut: Haircut) -> Material:
    """Makes the material of the skin, whose tones vary over the body.

    It paints lips, cheeks, brows, lids, nostrils, knuckles and the roots of the hair. Freckles,
    signs of age and a beard's stubble are painted where `tones` and `haircut` have them.
    """
    cloud, blotches = Ripples(rng, 0.07), Ripples(rng, 0.25)
    # what is painted on the face: metres, or factors around 1
    features = {
        "brow_thickness": rng.uniform(0.0024, 0.0056),
        "brow_arch": rng.uniform(0.2, 1.7),
        "brow_height": rng.uniform(-0.0025, 0.0025),
        "lip_width": rng.uniform(0.9, 1.14),
        "lip_fullness": rng.uniform(0.65, 1.25),
        "eye_opening": rng.uniform(0.85, 1.15),
        "nose": rng.uniform(0.85, 1.25),
    }
    seed = int(rng.integers(1 << 20))

    def albedo(s: Spots):
        """Returns the colors (n, 3) of points. Skin is painted first, then tanned arms, palms,
        knees and elbows, then the face.
        """
        x, y, z = np.abs(s.template[:, 0]), s.template[:, 1], s.template[:, 2]
        result = tones.skin * (1 + 0.035 * cloud(s.template) + 0.03 * blotches(s.template))[:, None]
        result = result * (1 - tones.tan * np.clip((x - 0.2) / 0.3, 0, 1) * (y > -0.1))[:, None]
        i = np.flatnonzero((x > 0.6) & (y > -0.1))
        result[i] = _hand(tones, result[i], x[i], y[i])
        knees = _bell((y, -0.764, 0.05)) * (y < -0.5)
        elbows = _bell((x, 0.411, 0.03)) * (y > 0) * (z < 0)
        result = _tinted(result, (0.96, 0.82, 0.8), 0.5 * (knees + elbows))
        i = np.flatnonzero((y > 0.19) & (z > -0.14) & (x < 0.2))
        face = x[i], y[i], np.clip((z[i] - 0.07) / 0.02, 0, 1), s.template[i]
        result[i] = _cheeks_and_eyes(tones, features, result[i], face, seed)
        result[i] = _aged(tones, result[i], face)
        result[i] = _mouth_and_brows(tones, haircut, features, result[i], face, seed)
        return result

    return Material(albedo, wrinkles=0.0, sheen=0.25)


def _bell(*axes: tuple[Field, Field | float | int, float]) -> Field:
    """Returns a bell (n,) that is 1 at a place and falls with the distance from it.

    axes: for each axis the coordinates of the points (n,), the coordinate of the place, and the
    width of the bell.
    """
    return np.exp(-sum(((x - place) / width) ** 2 for x, place, width in axes))


def _tinted(colors: Points, tint: tuple[float, float, float], amount: Field) -> Points:
    return mix(colors, colors * np.asarray(tint), amount)


def _hand(tones: Complexion, result: Points, x: Field, y: Field) -> Points:
    """Returns the colors of points on hands, with paler palms and redder knuckles and finger tips.
    result: the colors before. x: |x|. y: height.
    """
    palm = np.clip((0.085 - y) / 0.012, 0, 1) * np.clip((x - 0.66) / 0.03, 0, 1)
    pale = 0.35 * tones.skin + 0.65 * np.asarray([0.82, 0.62, 0.53], np.float32)
    tip, knuckle = np.clip((x - 0.79) / 0.03, 0, 1), _bell((x, 0.745, 0.008)) * (1 - palm)
    return _tinted(
        mix(result, pale, 0.55 * palm), (0.98, 0.82, 0.8), np.clip(0.5 * tip + 0.5 * knuckle, 0, 1)
    )


def _cheeks_and_eyes(
    tones: Complexion, features: Mapping[str, float], result: Points, face: _Face, seed: int
) -> Points:
    """Paints cheeks, nose, ears and freckles, then sockets, make-up and lashes."""
    x, y, front, template = face
    # cheeks, nose and ears are redder, with or without make-up
    cheeks = _bell((x, 0.043, 0.02), (y, 0.292, 0.018))
    nose = 0.7 * _bell((x, 0, 0.012 * features["nose"]), (y, 0.295, 0.012))
    result = _tinted(result, (1.02, 0.82, 0.80), 0.6 * front * np.clip(cheeks + nose, 0, 1))
    blush = _bell((x, 0.050, 0.018), (y - 0.298, 0.3 * (x - 0.05), 0.014))
    result = _tinted(result, (1.05, 0.68, 0.70), tones.blush * front * blush)
    result = _tinted(result, (1.0, 0.8, 0.77), 0.7 * ((x > 0.0745) & (y > 0.27) & (y < 0.36)))
    # freckles across the nose and the cheeks
    if tones.freckles > 0:
        spots = (
            _bell((y, 0.305, 0.022))
            * front
            * band(lattice(template / 0.0034, seed + 7), 0.68, 2, 0.1)
        )
        result = _tinted(result, (0.72, 0.58, 0.48), tones.freckles * spots)
    result = _tinted(
        result, (0.72, 0.66, 0.66), 0.7 * _bell((x, _EYE_X, 0.017), (y, _EYE_Y, 0.010)) * front
    )
    # shadow on the lids, then lashes, and the liner with its wing over both
    lid = _bell((x - _EYE_X, 0.002, 0.017), (y - _EYE_Y, 0.008, 0.007)) * (y > _EYE_Y)
    result = mix(result, tones.shadow_color, tones.shadow * lid * front)
    rim = np.sqrt(
        ((x - _EYE_X) / 0.0155) ** 2
        + ((y - _EYE_Y - 0.001) / (0.0075 * features["eye_opening"])) ** 2
    )
    lashes = band(rim, 0.75, 1.08 + 0.18 * tones.liner, 0.15)
    result = mix(result, result * 0.22, 0.8 * lashes * (y > _EYE_Y - 0.002) * front)
    wing = band(np.abs(y - _EYE_Y - 0.25 * (x - 0.042)), -1, 0.0016)
    wing = wing * band(x, 0.041, 0.041 + 0.008 * tones.liner) * front
    return mix(
        result, result * 0.2, np.clip(tones.liner * (0.7 * lashes * (y < _EYE_Y) + wing), 0, 1)
    )


def _aged(tones: Complexion, result: Points, face: _Face) -> Points:
    """Paints signs of age: folds at nose and mouth, lines on the forehead, bags, crow's feet."""
    if tones.wrinkles <= 0:
        return result
    x, y, front, _ = face
    fold = np.abs(x - 0.0165 - 0.55 * (0.287 - y)) + 10 * (np.abs(y - 0.272) > 0.018)
    forehead = 0.55 * band(
        np.abs(((y - 0.368 + 0.8 * x * x) / 0.0085) % 1 - 0.5) * 0.0085, -1, 0.0008
    )
    forehead = forehead * band(y, 0.36, 0.392, 0.006) * (x < 0.045)
    feet = band(np.abs((y - _EYE_Y) / np.maximum(x - 0.038, 1e-3) * 2 % 1 - 0.5), -1, 0.12, 0.1)
    feet = feet * band(x, 0.046, 0.056, 0.002) * (np.abs(y - _EYE_Y) < 0.012)
    lines = 0.8 * band(fold, -1, 0.0016, 0.002) + forehead + 0.5 * feet
    bags = _bell((x, 0.028, 0.013), (y, 0.3165, 0.004))
    return _tinted(
        result,
        (0.68, 0.58, 0.55),
        np.clip(tones.wrinkles * front * (0.7 * lines + 0.45 * bags), 0, 0.8),
    )


def _mouth_and_brows(
    tones: Complexion,
    haircut: Haircut,
    features: Mapping[str, float],
    result: Points,
    face: _Face,
    seed: int,
) -> Points:
    """Paints lips, nostrils and brows, then the roots of hair and beard.

    The roots also soften the edges of the hair and the beard.
    """
    x, y, front, template = face
    # lips: the upper one is bowed, the lower one fuller, a dark line parts them
    width, ahead = 0.026 * features["lip_width"], template[:, 2] > 0.08
    corner = np.clip(1 - (x / width) ** 2, 0, 1)
    bow = 0.009 * features["lip_fullness"] * corner * (1 - 0.35 * _bell((x, 0, 0.005)))
    low = 0.0115 * features["lip_fullness"] * corner**0.7
    lips = band(y, _MOUTH_Y - low, _MOUTH_Y + bow, 0.002) * (corner > 0) * ahead
    shine = 1 + 0.25 * _bell((y - _MOUTH_Y, -0.006, 0.003), (x, 0, 0.01))
    result = mix(result, tones.lips * shine[:, None], 0.85 * lips)
    line = band(y, _MOUTH_Y - 0.0012, _MOUTH_Y + 0.0012, 0.001) * (x < width) * ahead
    result = mix(result, tones.lips * 0.35, line)
    # nostrils are painted dark
    nostril = _bell((x, 0.0085 * features["nose"], 0.004), (y, 0.2845, 0.0025)) * (
        template[:, 2] > 0.1
    )
    result = mix(result, result * 0.3, np.clip(nostril, 0, 1))
    # brows: an arch of single hairs
    arch = (
        0.3485 + features["brow_height"] + features["brow_arch"] * (0.0045 - 18 * (x - 0.033) ** 2)
    )
    hairs = 0.7 + 0.6 * lattice(
        np.stack([template[:, 0] / 0.0016 + y / 0.004, y / 0.006], -1), seed + 3
    )
    brow = band(
        np.abs(y - arch), -1, features["brow_thickness"] * np.clip(1.5 - x / 0.06, 0.4, 1), 0.002
    )
    brow = brow * band(x, 0.012, 0.05, 0.006) * front
    result = mix(
        result, np.minimum(tones.hair, 0.42) * 0.75, np.clip(tones.brow * brow * hairs, 0, 1)
    )

    # roots of the hair, where a cut covers the scalp or is shaved
    grain = 0.7 + 0.6 * lattice(template / 0.0026, seed + 11)
    above = above_line(template, SHORT_LINE, haircut.receding)
    cover = np.clip((above + 0.006) / 0.016, 0, 1) * (1 - (np.abs(x) > 0.0765) * (y < 0.355))
    scalp = 0.8 if haircut.cut == "buzz" else 0.92
    if haircut.cut == "bald":
        scalp = 0.1 + 0.5 * np.clip((0.352 - y) / 0.012, 0, 1)
    elif haircut.cut in LONG_CUTS:
        cover = cover * (above > 0.0)
    result = mix(result, tones.hair * 0.8, np.clip(scalp * cover * grain, 0, 1))
    # roots of the beard
    chin = {"none": 0.0, "stubble": 0.75}.get(haircut.beard, 0.9)
    if chin > 0:
        kind = "full"
        if haircut.beard in ("moustache", "goatee"):
            kind = haircut.beard
        jaw = np.clip((beard_field(template, kind) + 0.005) / 0.018, 0, 1) * (1 - lips)
        result = mix(
            result, 0.6 * tones.hair + 0.15 * result, np.clip(0.8 * chin * jaw * grain, 0, 1)
        )
    return result


def eye_material(tones: Complexion) -> Material:
    """Makes the material of eyeballs: white, iris, pupil and a painted highlight."""
    white, black, bright = (
        np.asarray(dye, np.float32) for dye in ([0.84, 0.82, 0.80], [0.02] * 3, [0.85] * 3)
    )

    def albedo(s: Spots):
        d = s.template
        angle = np.arccos(np.clip(d[:, 2] / np.maximum(np.linalg.norm(d, axis=1), 1e-6), -1, 1))
        result = mix(white, tones.iris, band(angle, -1, 0.47, 0.05))
        result = mix(result, tones.iris * 0.4, band(angle, 0.40, 0.48, 0.05))
        result = mix(result, black, band(angle, -1, 0.21, 0.05))
        glint = np.sqrt((d[:, 0] - 0.15) ** 2 + (d[:, 1] - 0.2) ** 2)
        return mix(result, bright, band(glint, -1, 0.08, 0.05) * (d[:, 2] > 0))

    return Material(albedo)


def hair_material(rng: np.random.Generator, base: np.ndarray, haircut: Haircut) -> Material:
    """Makes the material of hair. Fine and coarse streaks run down from the crown, and a bright
    ring goes around the head.

    Curly hair has fine and coarse noise instead. base: color of the hair (3,).
    """
    seed = int(rng.integers(1 << 20))
    tips = base * rng.uniform(0.75, 1.35)
    curls = haircut.cut in ("curly", "afro")
    ring = rng.uniform(0.385, 0.405)

    def albedo(s: Spots):
        x, y, z = s.template[:, 0], s.template[:, 1], s.template[:, 2] - 0.02
        angle, radial = np.arctan2(x, z), np.sqrt(x * x + z * z)
        if curls:
            fine, coarse = lattice(s.template / 0.006, seed), lattice(s.template / 0.02, seed + 1)
            shine = np.zeros(1, np.float32)
        else:
            strand, run = angle / 0.04, (y - 0.6 * radial) / 0.09
            fine = lattice(np.stack([strand + 0.8 * np.sin(run), run, radial / 0.05], -1), seed)
            coarse = lattice(np.stack([strand / 5, run / 2], -1), seed + 1)
            shine = np.exp(-(((y - ring + 0.012 * (coarse - 0.5)) / 0.016) ** 2)) * (0.4 + fine)
        bright = 1 + haircut.grain * (1.2 * (fine - 0.5) + 0.9 * (coarse - 0.5)) + 0.5 * shine
        down = np.clip((0.3 - y) / 0.35, 0, 1)
        return (
            mix(base, tips, down) * np.clip(bright, 0.25, 2.2)[:, None] + (0.035 * shine)[..., None]
        )

    return Material(albedo, wrinkles=0.0, sheen=0.15 if curls else 0.45)
