"""Clothes built: every `Garment` becomes surfaces with materials, layer on layer, and hides what lies well below it."""

import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.people import accessories, tailoring, trimmings
from humangs_jax.people.accessories import pair
from humangs_jax.people.anatomy import CROTCH, WAIST, Anatomy, leg_coordinates
from humangs_jax.people.fabrics import Material, weave
from humangs_jax.people.garments import HEM_MARGIN, Fit, Skirt, shell, skirt
from humangs_jax.people.outfits import BOTTOMS, DRESSES, OUTER, SHOES, SKIRTS, TOPS, Garment
from humangs_jax.people.surfaces import Surface, compact

Cover = Callable[[np.ndarray], np.ndarray]
"""Template points (n, 3) -> (n,) metres inside of a garment's hems, negative outside."""

LAYER = 0.006
"""What one layer is further out than the one below it, metres."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """One surface of one material. hidden: (n,) vertices that a later layer covers; None if it knows no template coordinates."""

    surface: Surface
    material: Material
    hidden: np.ndarray | None = None

    def visible(self) -> "Piece":
        """Without the faces whose corners are all hidden."""
        if self.hidden is None or not self.hidden.any():
            return self
        kept = ~self.hidden[self.surface.faces].all(1)
        return dataclasses.replace(self, surface=compact(self.surface, kept), hidden=None)


@dataclasses.dataclass
class Outfit:
    """What has been put on so far. cover: (n,) how far inside of some hem each body vertex is, metres; negative on bare skin.

    removed: (n,) body vertices that nobody can see. trunk, legs: distances from the skin of the outermost layer, metres.
    fit: of the outermost layer on the trunk.
    """

    anatomy: Anatomy
    pieces: list[Piece]
    cover: np.ndarray
    removed: np.ndarray
    trunk: float = 0.0
    legs: float = 0.0
    fit: Fit = dataclasses.field(default_factory=lambda: Fit(ease=0.0))

    def add(self, surface: Surface, material: Material, layered: bool = True) -> None:
        """Put one more piece on. layered: whether later layers can hide parts of it."""
        self.pieces.append(Piece(surface, material, np.zeros(len(surface.vertices), bool) if layered else None))

    def hide(self, cover: Cover, margin: float, cloth: bool = True) -> None:
        """Take away what lies further than a margin inside of a garment that is put on next: skin, and cloth if it is below."""
        field = cover(self.anatomy.skin.attributes["template"])
        self.cover = np.maximum(self.cover, field)
        self.removed = self.removed | (field > margin)
        for i, piece in enumerate(self.pieces):
            if cloth and piece.hidden is not None:
                below = cover(piece.surface.attributes["template"]) > max(margin, 0.03)
                self.pieces[i] = dataclasses.replace(piece, hidden=piece.hidden | below)


def dress_up(rng: np.random.Generator, anatomy: Anatomy, garments: tuple[Garment, ...]) -> Outfit:
    """The garments on the body. Each has random numbers of its own, spawned in order."""
    count = len(anatomy.skin.vertices)
    outfit = Outfit(anatomy, [], np.full(count, -1.0), np.zeros(count, bool))
    for garment, own in zip(garments, rng.spawn(len(garments)), strict=True):
        _builder(garment.kind)(own, outfit, garment)
    outfit.pieces = [piece.visible() for piece in outfit.pieces]
    return outfit


def _builder(kind):
    for kinds, build in (
        (TOPS, _top),
        (OUTER, _outer),
        (BOTTOMS, _trousers),
        (SKIRTS, _skirt),
        (DRESSES, _dress),
        (SHOES, _shoes),
    ):
        if kind in kinds:
            return build
    return {
        "belt": _belt, "tie": _tie, "socks": _socks, "watch": _watch, "backpack": _backpack, "shoulder_bag": _shoulder_bag,
    }.get(kind, _accessory)  # fmt: skip


def _put(rng, outfit, fields, fit, material, margin=HEM_MARGIN, finish=lambda surface: surface, over=True):
    """A shell where all fields (functions of template points) are positive, and what it hides."""

    def covered(points):
        return np.min([field(points) for field in fields], axis=0)

    template = outfit.anatomy.skin.attributes["template"]
    surface = finish(shell(rng, outfit.anatomy, [field(template) for field in fields], fit))
    outfit.hide(covered, margin, over)
    outfit.add(surface, material)


def _sewn(rng, garment, bottom=None, sleeve=None):
    """The garment's fabric with what its details ask for."""
    base = garment.fabric.base
    colours = weave(garment.fabric)
    own = garment.fabric.rng(1)
    colours = trimmings.hemmed(
        colours, () if bottom is None else (bottom + 0.018,), None if sleeve is None else sleeve - 0.016
    )
    colours = trimmings.seamed(colours)
    if "ribbed" in garment.details and bottom is not None and sleeve is not None:
        colours = trimmings.ribbed(colours, bottom, sleeve)
    if "print" in garment.details or "number" in garment.details:
        colours = trimmings.printed(own, colours, base, number="number" in garment.details)
    if "side_stripe" in garment.details:
        colours = trimmings.side_striped(own, colours, base)
    return colours


def _top(rng, outfit, garment):
    sizes, kind = garment.sizes, garment.kind
    sleeve, bottom, loose = sizes["sleeve"], sizes["bottom"], sizes["loose"]
    neck = next(n for n in tailoring.NECKLINES if n in garment.details)
    is_open = "open" in garment.details
    fields = [
        lambda t: tailoring.neckline(t, neck, sizes["depth"]),
        lambda t: tailoring.sleeves(t, sleeve),
        lambda t: tailoring.above(t, bottom),
    ]
    if is_open:
        fields.append(lambda t: tailoring.front_opening(t, 0.03, 0.12))
    ease = max((0.008 if "tucked" in garment.details else 0.012) + 0.016 * loose, outfit.trunk + LAYER)
    fit = Fit(
        ease=ease,
        hang=rng.choice([0.05, 0.2, 0.5]) if loose > 0.3 else 2.0,
        sleeve=0.003 + (0.035 if sleeve < 0.45 else 0.016) * loose,
        fold=0.0015 + 0.0055 * loose,
        inner=outfit.trunk + 0.5 * LAYER if outfit.trunk else 0.0,
        skirted=True,
    )
    colours = _sewn(rng, garment, bottom, sleeve if sleeve > 0.2 else None)
    own = garment.fabric.rng(2)
    if "pocket" in garment.details:
        colours = trimmings.pocketed(own, colours, "chest")
    if (kind == "shirt" or (kind == "blouse" and "collar" in garment.details)) and not is_open:
        colours = trimmings.buttoned(own, colours, garment.fabric.base, bottom, 0.2)
    if kind == "polo":
        colours = trimmings.buttoned(own, colours, garment.fabric.base, 0.02, 0.2)
    if "zip" in garment.details:
        colours = trimmings.zipped(own, colours, bottom, 0.2)
    material = Material(colours, wrinkles=0.25 + 0.45 * loose, sheen=0.04)
    _put(rng, outfit, fields, fit, material, HEM_MARGIN + 0.03 * loose)
    outfit.trunk, outfit.fit = ease, fit
    if kind in ("shirt", "polo", "blouse") and "collar" in garment.details:
        _collar(rng, outfit, material, fit)
    if kind == "hoodie":
        outfit.add(accessories.hood(rng, outfit.anatomy, "hood_up" in garment.details), material, layered=False)


def _collar(rng, outfit, material, fit, extra=0.004, low=0.125, high=0.178, gap=0.012):
    template = outfit.anatomy.skin.attributes["template"]
    cut_of = dataclasses.replace(fit, ease=fit.ease + extra, fold=0.0, hem=0.01, quilt=0.0)
    outfit.add(
        shell(rng, outfit.anatomy, [tailoring.collar(template, low, high, gap)], cut_of), material, layered=False
    )


def _outer(rng, outfit, garment):
    sizes, kind = garment.sizes, garment.kind
    gap, spread, bottom, loose = sizes["gap"], sizes["spread"], sizes["bottom"], sizes["loose"]
    long = kind == "coat"
    shell_bottom = WAIST - 0.045 if long else bottom
    fields = [
        lambda t: tailoring.neckline(t, "vee" if "lapels" in garment.details else "crew", 0.09),
        lambda t: tailoring.sleeves(t, sizes["sleeve"]),
        lambda t: tailoring.above(t, shell_bottom),
    ]
    if gap > 0:
        fields.append(lambda t: tailoring.front_opening(t, gap, spread))
    padded = kind in ("puffer", "vest")
    ease = max(outfit.trunk + 0.009 + 0.008 * loose, 0.022 if padded else 0.0)
    fit = Fit(
        ease=ease,
        hang=1.5 if long else rng.choice([0.05, 0.3]) if kind != "blazer" else 0.8,
        sleeve=0.01 + 0.012 * loose,
        fold=0.002 if padded or kind == "blazer" else 0.002 + 0.003 * loose,
        hem=0.014,
        quilt=0.075 if padded else 0.0,
        skirted=True,
        inner=outfit.trunk + 0.5 * LAYER,
    )
    colours = _sewn(rng, garment, bottom, sizes["sleeve"] if kind != "vest" else None)
    own = garment.fabric.rng(2)
    if padded:
        colours = trimmings.quilted(colours, 0.075)
    if "pockets" in garment.details:
        colours = trimmings.pocketed(own, colours, "chest" if kind == "denim_jacket" else "jacket")
    if kind in ("jacket", "puffer", "hooded_jacket", "vest"):
        colours = trimmings.zipped(own, colours, bottom, 0.2, max(gap, 0.0))
    elif gap < 0:
        colours = trimmings.buttoned(own, colours, garment.fabric.base, bottom, 0.2)
    if "sash" in garment.details:
        colours = trimmings.banded(colours, garment.fabric.base * 0.6, WAIST - 0.02, WAIST + 0.02)
    material = Material(
        colours, wrinkles=0.15 if kind == "blazer" else 0.3 + 0.2 * loose, sheen=0.12 if padded else 0.05
    )
    _put(rng, outfit, fields, fit, material, 0.03)
    outfit.trunk, outfit.fit = ease, fit
    if long:
        width = max(outfit.legs, ease) + 0.002
        tube = Skirt(WAIST + 0.02, bottom, width, sizes["flare"], 5, 0.008, gap, 0.5 * spread)
        surface = skirt(rng, outfit.anatomy, tube)
        if gap < 0:
            outfit.hide(lambda t: tailoring.hips_and_legs(t, WAIST, bottom), 0.02)
        outfit.add(surface, dataclasses.replace(material, draped=True))
    if "lapels" in garment.details:
        template = outfit.anatomy.skin.attributes["template"]
        edge = max(gap, 0.004)
        strip = dataclasses.replace(fit, ease=ease + 0.006, fold=0.0, hem=0.005, inner=ease + 0.003)
        field = tailoring.lapel(template, edge, spread if gap > 0 else 0.0, rng.uniform(-0.16, -0.08))
        dark = Material(trimmings.darkened(colours, 0.88), sheen=0.06)
        outfit.add(shell(rng, outfit.anatomy, [field], strip), dark, layered=False)
        _collar(rng, outfit, dark, strip, 0.001, 0.12, 0.17, max(edge, 0.03))
    elif "hood" in garment.details or kind == "hooded_jacket":
        outfit.add(accessories.hood(rng, outfit.anatomy, False), material, layered=False)
    elif kind not in ("cardigan", "blazer"):
        _collar(rng, outfit, material, fit, 0.003, 0.12, 0.185 if padded else 0.175, max(gap, 0.01))


def _trousers(rng, outfit, garment):
    sizes, kind = garment.sizes, garment.kind
    top, end, loose = sizes["top"], sizes["end"], sizes["loose"]
    tucked = sizes["tucked"] > 0
    fields = [lambda t: tailoring.trousers(t, top, end)]
    ease = outfit.trunk + 0.004 if tucked else 0.005
    hang = {"wide": 0.02, "slim": 1.0, "leggings": 3.0, "jeans": 0.12}.get(kind, rng.choice([0.05, 0.1]))
    fit = Fit(
        ease=ease if kind != "leggings" or tucked else 0.004,
        hang=0.6,
        leg=sizes["width"],
        leg_hang=hang,
        fold=0.0012 if kind in ("leggings", "slim") else 0.0025 + 0.0035 * loose,
        calm=9.0 if tucked else float(outfit.pieces[0].surface.attributes["template"][:, 1].min()) + 0.02,
    )
    colours = _sewn(rng, garment, end)
    own = garment.fabric.rng(2)
    if "pockets" in garment.details:
        colours = trimmings.pocketed(own, colours, "jeans")
    if kind == "cargo":
        colours = trimmings.pocketed(own, colours, "cargo")
    if "turn_up" in garment.details:
        pale = 0.5 * garment.fabric.base + 0.35
        colours = trimmings.below(colours, pale.astype(np.float32), end + 0.045)
    material = Material(colours, wrinkles=0.15 + 0.4 * loose, sheen=0.03)
    in_two_legs = lambda surface: surface.with_attributes(cloth=leg_coordinates(surface.attributes["template"]))
    seat = _hips(outfit.anatomy.skin.attributes["template"], top, end)
    _put(
        rng,
        outfit,
        fields,
        fit,
        material,
        HEM_MARGIN + 0.03 * loose * (kind in ("wide", "shorts")),
        in_two_legs,
        tucked,
    )
    outfit.removed = outfit.removed | (seat & (outfit.cover > 0))
    outfit.legs = ease + sizes["width"]
    if not tucked:  # the top hangs over it
        _let_hang_over(outfit, 0.03)


def _let_hang_over(outfit, margin):
    """An untucked top hides what it hangs over, but for a margin inside of its hem."""
    top = outfit.pieces[0]
    lowest = float(top.surface.attributes["template"][:, 1].min())
    trousers = outfit.pieces[-1]
    template = trousers.surface.attributes["template"]
    hidden = (template[:, 1] > lowest + margin) & (np.abs(template[:, 0]) < tailoring.TRUNK_HALF_WIDTH)
    outfit.pieces[-1] = dataclasses.replace(trousers, hidden=trousers.hidden | hidden)


def _hips(template, top, end):
    """Skin between shirt and trousers, below both."""
    x, y, _ = template.T
    return (np.abs(x) < 0.22) & (y < WAIST - 0.06) & (y > max(end + 0.02, CROTCH - 0.075))


def _skirt(rng, outfit, garment):
    sizes = garment.sizes
    tucked = sizes["tucked"] > 0
    ease = outfit.trunk + 0.004 if tucked else 0.004
    tube = Skirt(sizes["top"], sizes["end"], ease, _flare(sizes), int(sizes["pleats"]), sizes["depth"])
    if not tucked:  # as far as the top reaches
        reach = sizes["top"] - float(outfit.pieces[0].surface.attributes["template"][:, 1].min())
        tube = dataclasses.replace(tube, cling=max(0.0, reach + 0.02))
    colours = trimmings.hemmed(weave(garment.fabric), (sizes["end"] + 0.02,))
    colours = trimmings.banded(colours, garment.fabric.base * 0.8, sizes["top"] - 0.035, sizes["top"])
    surface = skirt(rng, outfit.anatomy, tube)
    outfit.hide(lambda t: tailoring.hips_and_legs(t, sizes["top"], sizes["end"]), 0.0, tucked)
    outfit.add(surface, Material(colours, wrinkles=0.35, sheen=0.05, draped=True))
    outfit.legs = ease + 0.02
    if not tucked:
        _let_hang_over(outfit, 0.055)


def _flare(sizes):
    """Metres wider per metre down, so that the hem of a short skirt stands off as far as a long one's."""
    return sizes["flare"] / max(0.3, -0.2 - sizes["end"])


def _dress(rng, outfit, garment):
    sizes = garment.sizes
    waist, end = sizes["waist"], sizes["end"]
    neck = next(n for n in tailoring.NECKLINES if n in garment.details)
    fields = [
        lambda t: tailoring.neckline(t, neck, sizes["depth"]),
        lambda t: tailoring.sleeves(t, sizes["sleeve"]),
        lambda t: tailoring.above(t, waist - 0.02),
    ]
    fit = Fit(ease=0.008, hang=1.0, sleeve=0.004 + 0.03 * sizes["loose"], fold=0.002)
    colours = trimmings.hemmed(weave(garment.fabric), (end + 0.02,))
    own = garment.fabric.rng(2)
    if garment.kind == "shirt_dress":
        colours = trimmings.buttoned(own, colours, garment.fabric.base, end, 0.2)
    if "sash" in garment.details:
        colours = trimmings.banded(colours, garment.fabric.other, waist - 0.01, waist + own.uniform(0.02, 0.05))
    material = Material(colours, wrinkles=0.3, sheen=0.05)
    _put(rng, outfit, fields, fit, material, HEM_MARGIN + 0.02 * sizes["loose"])
    outfit.trunk, outfit.fit = fit.ease, fit
    tube = Skirt(waist, end, 0.010, _flare(sizes), int(sizes["pleats"]), sizes["depth"])
    surface = skirt(rng, outfit.anatomy, tube)
    outfit.hide(lambda t: tailoring.hips_and_legs(t, waist + 0.03, end), 0.0)
    outfit.add(surface, dataclasses.replace(material, draped=True))
    outfit.legs = 0.03
    if garment.kind == "shirt_dress":
        _collar(rng, outfit, material, fit)


def _socks(rng, outfit, garment):
    fields = [lambda t: tailoring.shaft(t, garment.sizes["height"])]
    material = Material(trimmings.ribbed_shaft(weave(garment.fabric)), wrinkles=0.1)
    _put(rng, outfit, fields, Fit(ease=0.003, fold=0.001, hem=0.003), material, 0.008)


def _shoes(rng, outfit, garment):
    sizes, anatomy = garment.sizes, outfit.anatomy
    height, sole = sizes["height"], sizes["sole"]
    colours = trimmings.leather(garment.fabric.rng(2), garment.kind, garment.fabric.base, 0.004)
    material = Material(colours, sheen=0.2 if garment.kind != "sneakers" else 0.08)
    if garment.kind == "sandals":
        outfit.add(pair(anatomy, 0.024, sole, 0.004), material, layered=False)
        template = anatomy.skin.attributes["template"]
        for field in tailoring.sandal_straps(template):
            outfit.add(shell(rng, anatomy, [field], Fit(ease=0.005, fold=0.0, hem=0.004)), material, layered=False)
        return
    ease = 0.017 if sizes["over"] else 0.006
    surface = pair(anatomy, height, sole, ease)
    outfit.hide(lambda t: tailoring.shaft(t, height), 0.012)
    if not sizes["over"]:
        outfit.pieces = [_unhidden_legs(piece) for piece in outfit.pieces]
    outfit.add(surface, material, layered=False)


def _unhidden_legs(piece):
    """Trouser legs hang over low shoes: the shoe hides nothing of them, only socks."""
    if piece.hidden is None or piece.surface.attributes["template"][:, 1].min() < -1.2:
        return piece
    low = piece.surface.attributes["template"][:, 1] < -0.9
    return dataclasses.replace(piece, hidden=piece.hidden & ~low)


def _belt(rng, outfit, garment):
    top, width = garment.sizes["top"], garment.sizes["width"]
    template = outfit.anatomy.skin.attributes["template"]
    fit = Fit(ease=outfit.trunk + 0.009, hang=0.6, fold=0.0, hem=0.006, inner=outfit.trunk + 0.007)
    colours = trimmings.buckled(weave(garment.fabric), top - 0.5 * width, width)
    outfit.add(
        shell(rng, outfit.anatomy, [tailoring.trousers(template, top, top - width)], fit), Material(colours, sheen=0.15)
    )


def _tie(rng, outfit, garment):
    template = outfit.anatomy.skin.attributes["template"]
    field = tailoring.necktie(template, garment.sizes["length"], garment.sizes["width"])
    raised = outfit.trunk + 0.005 + outfit.fit.fold
    fit = dataclasses.replace(outfit.fit, ease=raised, inner=raised - 0.002, fold=0.0, hem=0.004)
    outfit.add(shell(rng, outfit.anatomy, [field], fit), Material(weave(garment.fabric), sheen=0.15))


def _watch(rng, outfit, garment):
    template = outfit.anatomy.skin.attributes["template"]
    field = tailoring.bracelet(template, garment.sizes["side"], 0.628, 0.650)
    material = Material(weave(garment.fabric), sheen=0.3)
    outfit.add(shell(rng, outfit.anatomy, [field], Fit(ease=0.003, fold=0.0, hem=0.002)), material, layered=False)


def _strapped(outfit):
    """Straps lie on what is worn."""
    raised = outfit.trunk + 0.009 + 1.5 * outfit.fit.fold
    return dataclasses.replace(
        outfit.fit, ease=raised, inner=raised - 0.002, fold=0.0, hem=0.006, quilt=0.0, skirted=True
    )


def _backpack(rng, outfit, garment):
    material = Material(
        trimmings.zipped_bag(garment.fabric.rng(2), weave(garment.fabric), garment.fabric.base), wrinkles=0.1
    )
    outfit.add(accessories.backpack(outfit.anatomy, garment.sizes["size"], outfit.trunk), material, layered=False)
    template = outfit.anatomy.skin.attributes["template"]
    fit = _strapped(outfit)
    strip = shell(rng, outfit.anatomy, [tailoring.straps(template, -0.16, -0.03)], fit)
    outfit.add(strip, Material(weave(garment.fabric)), layered=False)


def _shoulder_bag(rng, outfit, garment):
    side, size = garment.sizes["side"], garment.sizes["size"]
    material = Material(
        trimmings.zipped_bag(garment.fabric.rng(2), weave(garment.fabric), garment.fabric.base), sheen=0.12
    )
    outer = max(outfit.trunk, min(outfit.legs, 0.02))
    outfit.add(accessories.shoulder_bag(outfit.anatomy, size, side, outer), material, layered=False)
    template = outfit.anatomy.skin.attributes["template"]
    fit = _strapped(outfit)
    strip = shell(rng, outfit.anatomy, [tailoring.sash(template, -side * 0.105, side * 0.165, 0.014)], fit)
    outfit.add(strip, Material(weave(garment.fabric), sheen=0.12), layered=False)


def _accessory(rng, outfit, garment):
    for surface, material in accessories.build(rng, outfit.anatomy, garment, outfit.trunk):
        outfit.add(surface, material, layered=False)
