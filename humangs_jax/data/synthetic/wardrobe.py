"""What a person wears: random outfits as surfaces with materials, and which skin they cover."""

import dataclasses

import numpy as np

from humangs_jax.data.synthetic import fabrics, shoes
from humangs_jax.data.synthetic.anatomy import FLOOR, SHOULDER, WAIST, WRIST, Anatomy
from humangs_jax.data.synthetic.fabrics import Material
from humangs_jax.data.synthetic.garments import Fit, Skirt, covered, shell, skirt
from humangs_jax.data.synthetic.surfaces import Surface


@dataclasses.dataclass(frozen=True)
class Piece:
    """One surface of one material."""

    surface: Surface
    material: Material


@dataclasses.dataclass
class Outfit:
    """pieces of cloth, and the body vertices (n,) that they hide."""

    pieces: list[Piece]
    hidden: np.ndarray

    def add(self, surface: Surface, material: Material, hides: np.ndarray | None = None) -> None:
        """Put one more piece on."""
        self.pieces.append(Piece(surface, material))
        if hides is not None:
            self.hidden = self.hidden | hides


def neck_field(template: np.ndarray, style: str, depth: float) -> np.ndarray:
    """Positive below the neckline. Styles: crew, vee, scoop, high."""
    x, y, z = template.T
    radial = np.sqrt(x * x + (z + 0.005) ** 2)
    lift = {"crew": 0.0, "vee": 0.0, "scoop": -0.012, "high": 0.035, "collar": 0.012}[style]
    plane = 0.152 + lift - 0.42 * z - y
    wide = radial - {"crew": 0.085, "vee": 0.085, "scoop": 0.115, "high": 0.09, "collar": 0.085}[style]
    field = np.maximum(plane, np.minimum(wide, 0.17 - y))  # shoulders, but not the head
    if style == "vee":
        opening = np.maximum.reduce([0.13 - depth + np.abs(x) * depth / 0.06 - y, np.abs(x) - 0.06, 0.02 - z])
        field = np.minimum(field, opening)
    if style == "scoop":
        inside = 1 - (x / 0.105) ** 2 - ((y - 0.15) / (0.02 + depth)) ** 2
        field = np.minimum(field, np.maximum(-0.05 * inside, 0.02 - z))
    return field


def sleeve_field(template: np.ndarray, end: float) -> np.ndarray:
    """Positive inside of |x| = end; for sleeveless tops (end < 0.2) an armhole down to the armpit."""
    x, y = np.abs(template[:, 0]), template[:, 1]
    return end + 1.6 * np.maximum(0.03 - y, 0) - x if end < 0.2 else np.where(y > -0.1, end - x, 0.5)


def dress_up(rng: np.random.Generator, anatomy: Anatomy, male: bool) -> Outfit:
    """A random outfit."""
    outfit = Outfit([], np.zeros(len(anatomy.skin.vertices), bool))
    in_a_dress = not male and rng.random() < 0.25
    legs_end = _dress(rng, anatomy, outfit) if in_a_dress else _separates(rng, anatomy, outfit, male)
    _shoes(rng, anatomy, outfit, legs_end)
    return outfit


def _separates(rng, anatomy, outfit, male):
    template = anatomy.skin.attributes["template"]
    tucked = rng.random() < 0.25
    waist = rng.uniform(-0.235, -0.21)
    top_bottom = waist - 0.025 if tucked else rng.uniform(-0.375, -0.30)
    jacket = rng.random() < 0.22
    _top(rng, anatomy, outfit, male, top_bottom, snug=jacket or tucked)
    bottom_layer = 0.013 if tucked else 0.007
    if not male and rng.random() < 0.3:
        end = rng.choice([rng.uniform(-0.72, -0.6), rng.uniform(-1.0, -0.8)], p=[0.6, 0.4])
        cut_of = Skirt(waist, end, bottom_layer, rng.uniform(0.01, 0.13) / (waist - end), *_pleats(rng))
        fabric = fabrics.random_fabric(rng)
        outfit.add(
            skirt(rng, anatomy, cut_of), Material(fabric, wrinkles=0.25, sheen=0.05), _below_skirt(template, waist, end)
        )
        legs_end = None
    else:
        legs_end = _trousers(rng, anatomy, outfit, male, waist, bottom_layer, tucked, top_bottom)
    if jacket:
        _jacket(rng, anatomy, outfit)
    return legs_end


def _pleats(rng):
    return (
        (int(rng.integers(9, 18)), rng.uniform(0.006, 0.016)) if rng.random() < 0.5 else (int(rng.integers(4, 8)), 0.01)
    )


def _below_skirt(template, top, bottom):
    """Legs under a skirt are gone down to a hand's breadth above its hem: they may be seen from below."""
    on_body = np.abs(template[:, 0]) < 0.25
    return on_body & (template[:, 1] < top - 0.03) & (template[:, 1] > bottom + 0.06)


def _top(rng, anatomy, outfit, male, bottom, snug):
    template = anatomy.skin.attributes["template"]
    kind = rng.choice(["tee", "long", "shirt", "sweater", "hoodie", "tank"], p=[0.33, 0.16, 0.19, 0.15, 0.09, 0.08])
    sleeve = {
        "tee": rng.uniform(0.29, 0.40),
        "tank": rng.uniform(0.128, 0.15),
        "shirt": rng.choice([rng.uniform(0.32, 0.4), WRIST - 0.015], p=[0.35, 0.65]),
    }.get(kind, rng.choice([WRIST - 0.02, rng.uniform(0.45, 0.6)], p=[0.75, 0.25]))
    neck = {
        "tee": rng.choice(["crew", "vee", "scoop"], p=[0.6, 0.25, 0.15]),
        "tank": "scoop",
        "shirt": "collar",
        "hoodie": "crew",
    }.get(kind, rng.choice(["crew", "high", "vee"], p=[0.6, 0.2, 0.2]))
    fields = [
        neck_field(template, neck, rng.uniform(0.04, 0.09)),
        sleeve_field(template, sleeve),
        template[:, 1] - bottom,
    ]
    loose = 0.0 if snug else rng.uniform(0.0, 1.0) if kind not in ("sweater", "hoodie") else rng.uniform(0.5, 1.0)
    fit = Fit(
        ease=0.009 + 0.016 * loose,
        hang=rng.choice([0.05, 0.2, 0.5]) if loose > 0.3 else 2.0,
        sleeve=0.004 + (0.035 if sleeve < 0.45 else 0.018) * loose,
        fold=0.002 + 0.004 * loose,
    )
    fabric = fabrics.random_fabric(rng, plainness=0.45 if kind in ("tee", "sweater", "hoodie") else 0.2)
    if kind in ("tee", "hoodie", "long") and rng.random() < 0.4:
        fabric = fabrics.with_print(rng, fabric)
    if kind == "shirt" or (kind == "hoodie" and rng.random() < 0.5):
        fabric = fabrics.with_buttons(rng, fabric, bottom, 0.2)
    material = Material(fabric, wrinkles=0.25 + 0.35 * loose, sheen=0.04)
    outfit.add(shell(rng, anatomy, fields, fit), material, covered(fields))
    if kind in ("shirt", "hoodie"):
        _collar(rng, anatomy, outfit, material, fit, high=kind == "hoodie")


def _collar(rng, anatomy, outfit, material, fit, high):
    """A band that stands around the neck (open in front), thick for a hood."""
    template = anatomy.skin.attributes["template"]
    x, y, z = template.T
    radial = np.sqrt(x * x + (z + 0.005) ** 2)
    plane = y + 0.42 * z
    opening = np.where(z > 0, np.abs(x) - 0.012, 0.1)
    fields = [plane - 0.125, (0.185 if high else 0.178) - plane, 0.125 - radial, opening]
    outer = dataclasses.replace(
        fit, ease=0.03 if high else fit.ease + 0.004, fold=0.003 if high else 0.0, hem=0.016 if high else 0.01
    )
    outfit.add(shell(rng, anatomy, fields, outer), material)


def _jacket(rng, anatomy, outfit):
    template = anatomy.skin.attributes["template"]
    x, y, z = template.T
    bottom, gap = rng.uniform(-0.375, -0.32), rng.uniform(0.015, 0.045)
    opening = np.maximum(np.abs(x) - gap - 0.25 * np.maximum(y + 0.05, 0) * (y < 0.2), 0.03 - z)
    fields = [neck_field(template, "crew", 0.0), sleeve_field(template, WRIST - 0.03), y - bottom, opening]
    fit = Fit(ease=0.027, hang=rng.choice([0.05, 0.3]), sleeve=0.012, fold=0.003, hem=0.014)
    fabric = fabrics.random_fabric(rng, plainness=0.6)
    outfit.add(shell(rng, anatomy, fields, fit), Material(fabric, wrinkles=0.35, sheen=0.08), covered(fields, 0.03))


def _trousers(rng, anatomy, outfit, male, waist, ease, tucked, top_bottom):
    template = anatomy.skin.attributes["template"]
    kind = rng.choice(["jeans", "slim", "wide", "shorts", "cropped", "track"], p=[0.3, 0.18, 0.17, 0.17, 0.08, 0.1])
    end = {"shorts": rng.uniform(-0.75, -0.58), "cropped": rng.uniform(-1.08, -0.95)}.get(
        kind, rng.uniform(-1.165, -1.14)
    )
    top = waist if tucked else max(top_bottom + 0.06, waist - 0.2)
    fields = [top - template[:, 1], template[:, 1] - end, 0.25 - np.abs(template[:, 0])]
    leg, leg_hang = {
        "wide": (rng.uniform(0.025, 0.06), 0.02),
        "slim": (0.002, 1.0),
        "jeans": (rng.uniform(0.0, 0.012), 0.12),
    }.get(kind, (rng.uniform(0.004, 0.025), rng.choice([0.05, 0.1])))
    fit = Fit(ease=ease, hang=0.6, leg=leg, leg_hang=leg_hang, fold=0.003 if kind != "wide" else 0.005)
    if kind == "jeans":
        base = fabrics.colour(rng.uniform(0.57, 0.63), rng.uniform(0.3, 0.75), rng.uniform(0.15, 0.6))
        fabric = fabrics.denim(rng, base, None)
    else:
        fabric = fabrics.random_fabric(rng, plainness=0.6)
    if kind == "track":
        fabric = fabrics.with_side_stripe(fabric, fabrics.random_colour(rng))
    if tucked:
        fabric = fabrics.with_band(
            fabric, fabrics.colour(0.07, rng.uniform(0.2, 0.7), rng.uniform(0.06, 0.35)), waist - 0.035, waist - 0.003
        )
    outfit.add(
        shell(rng, anatomy, fields, fit),
        Material(fabric, wrinkles=0.4, sheen=0.03),
        covered(fields) | _hips(template, top, end),
    )
    return end


def _hips(template, top, end):
    """Skin between shirt and trousers, below both."""
    return (np.abs(template[:, 0]) < 0.22) & (template[:, 1] < WAIST - 0.06) & (template[:, 1] > max(end, -0.5))


def _dress(rng, anatomy, outfit):
    template = anatomy.skin.attributes["template"]
    waist = rng.uniform(-0.235, -0.17)
    end = rng.choice(
        [rng.uniform(-0.74, -0.6), rng.uniform(-0.95, -0.8), rng.uniform(-1.14, -1.05)], p=[0.45, 0.3, 0.25]
    )
    sleeve = rng.choice([rng.uniform(0.125, 0.15), rng.uniform(0.27, 0.4), WRIST - 0.02], p=[0.4, 0.35, 0.25])
    neck = rng.choice(["crew", "vee", "scoop"])
    fields = [
        neck_field(template, neck, rng.uniform(0.04, 0.09)),
        sleeve_field(template, sleeve),
        template[:, 1] - (waist - 0.02),
    ]
    fit = Fit(ease=0.008, hang=1.0, sleeve=0.015, fold=0.002)
    fabric = fabrics.random_fabric(rng)
    if rng.random() < 0.4:
        fabric = fabrics.with_band(fabric, fabrics.random_colour(rng), waist - 0.01, waist + rng.uniform(0.02, 0.05))
    material = Material(fabric, wrinkles=0.25, sheen=0.05)
    outfit.add(shell(rng, anatomy, fields, fit), material, covered(fields))
    cut_of = Skirt(waist, end, 0.011, rng.uniform(0.02, 0.17) / (waist - end), *_pleats(rng))
    outfit.add(skirt(rng, anatomy, cut_of), material, _below_skirt(template, waist, end))
    return None


def _shoes(rng, anatomy, outfit, legs_end):
    template = anatomy.skin.attributes["template"]
    kind = rng.choice(["sneaker", "flat", "ankle", "boot"], p=[0.5, 0.2, 0.2, 0.1])
    if kind == "boot" and legs_end is not None and legs_end < -1.0:
        kind = "ankle"
    height = {"sneaker": 0.092, "flat": 0.078, "ankle": rng.uniform(0.13, 0.16), "boot": rng.uniform(0.2, 0.32)}[kind]
    sole = {"sneaker": rng.uniform(0.018, 0.03), "flat": 0.01}.get(kind, rng.uniform(0.015, 0.03))
    base = fabrics.random_colour(rng)
    if kind != "sneaker" and rng.random() < 0.7:
        base = fabrics.colour(0.07, rng.uniform(0.1, 0.7), rng.uniform(0.06, 0.4))
    trim = fabrics.colour(0.1, 0.05, rng.choice([0.12, 0.8])) if kind == "sneaker" else base * 0.5
    surface = shoes.pair(anatomy, height, sole, 0.006)
    outfit.add(
        surface, Material(fabrics.leather(rng, base, trim, 0.004), sheen=0.15), template[:, 1] < FLOOR + height - 0.012
    )


__all__ = ["SHOULDER", "Outfit", "Piece", "dress_up"]
