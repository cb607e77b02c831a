"""Dresses a body: builds the surfaces and materials of garments, layer on layer.

Clothes and closed shoes hide the skin that lies well inside of their hems. Most of them also hide
the cloth there. Straps, collars, belts, ties and most accessories hide nothing.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from humangs_jax.synthetic import accessories, tailoring, trimmings
from humangs_jax.synthetic.anatomy import CROTCH, WAIST, Anatomy, leg_coordinates
from humangs_jax.synthetic.fabrics import Material, Spots
from humangs_jax.synthetic.outfits import BOTTOMS, DRESSES, OUTER, SHOES, SKIRTS, TOPS, Garment
from humangs_jax.synthetic.surfaces import Field, Points, Surface, compact
from humangs_jax.synthetic.tailoring import HEM_MARGIN, Fit, shell, skirt
from humangs_jax.synthetic.trimmings import PADDED, QUILT, sewn

_Cut = tuple[Callable[..., np.ndarray], *tuple[Any, ...]]
"""A function of `tailoring`, and its arguments after the first one, which is the template points.
"""

_LAYER = 0.006
"""Distance of a layer from the layer below it, metres."""


@dataclasses.dataclass(frozen=True)
class Piece:
    """A part of a dressed person: one surface, of one material."""

    surface: Surface
    """The mesh of the piece."""
    material: Material
    """The material of the piece."""
    hidden: np.ndarray | None = None
    """Whether a later layer covers each vertex, (n,). None: later layers hide nothing of it."""

    def visible(self) -> "Piece":
        """Returns the piece without the faces whose corners are all hidden."""
        if self.hidden is None or not self.hidden.any():
            return self
        kept = ~self.hidden[self.surface.faces].all(1)
        return dataclasses.replace(self, surface=compact(self.surface, kept), hidden=None)


@dataclasses.dataclass
class Outfit:
    """A body and what has been put on it so far."""

    anatomy: Anatomy
    """The body that is dressed."""
    pieces: list[Piece]
    """The pieces of clothes that have been put on, innermost first."""
    cover: np.ndarray
    """How far each body vertex is inside of a hem, (n,), metres. It is negative on bare skin."""
    removed: np.ndarray
    """Whether clothes hide each body vertex, (n,)."""
    rng: np.random.Generator
    """Random generator of the garment that is being put on."""
    trunk: float = 0.0
    """Distance of the outermost layer on the trunk from the skin, metres."""
    legs: float = 0.0
    """Distance of the outermost layer on the legs from the skin, metres."""
    fit: Fit = dataclasses.field(default_factory=lambda: Fit(ease=0.0))
    """Fit of the outermost layer on the trunk."""

    @property
    def template(self) -> np.ndarray:
        """The template coordinates (n, 3) of the body's vertices."""
        return self.anatomy.skin.template

    @property
    def lowest(self) -> float:
        """The template height of the lowest vertex of the innermost piece."""
        return float(self.pieces[0].surface.template[:, 1].min())

    def add(self, surface: Surface, material: Material, layered: bool = True) -> None:
        """Puts a piece on. layered: whether later layers can hide parts of it."""
        shown = None
        if layered:
            shown = np.zeros(len(surface.vertices), bool)
        self.pieces.append(Piece(surface, material, shown))

    def hide(self, cover: Callable[[Points], Field], margin: float, cloth: bool = True) -> None:
        """Hides what the next garment covers: all that lies more than `margin` metres inside of its
        hems.

        cover: function of template points (n, 3) that returns how far they are inside of the
        garment's hems (n,), metres, negative outside. margin: metres; for cloth it is at least
        0.03. cloth: whether cloth is hidden, too. If not, only skin is.
        """
        field = cover(self.template)
        self.cover = np.maximum(self.cover, field)
        self.removed = self.removed | (field > margin)
        for i, piece in enumerate(self.pieces):
            if cloth and piece.hidden is not None:
                below = cover(piece.surface.template) > max(margin, 0.03)
                self.pieces[i] = dataclasses.replace(piece, hidden=piece.hidden | below)

    def put(
        self,
        cuts: Sequence[_Cut],
        fit: Fit,
        material: Material,
        margin: float = HEM_MARGIN,
        finish: Callable[[Surface], Surface] = lambda surface: surface,
        over: bool = True,
    ) -> None:
        """Puts on a shell around the body, and hides what lies below the shell.

        The shell covers the body where all cuts are positive. finish: a function that changes the
        shell's surface. margin, over: as `margin` and `cloth` of `hide`.
        """

        def fields(points: Points) -> list[Field]:
            return [field(points, *arguments) for field, *arguments in cuts]

        surface = finish(shell(self.rng, self.anatomy, fields(self.template), fit))
        self.hide(lambda points: np.min(fields(points), axis=0), margin, over)
        self.add(surface, material)

    def strip(self, field: Field, fit: Fit, material: Material, layered: bool = False) -> None:
        """Puts on a shell around the body that hides nothing. layered: see `add`.

        field: positive where the shell covers the body, (n,).
        """
        self.add(shell(self.rng, self.anatomy, [field], fit), material, layered)


def dress_up(rng: np.random.Generator, anatomy: Anatomy, garments: tuple[Garment, ...]) -> Outfit:
    """Puts the garments on the body, in order. Each has a separate random stream."""
    count = len(anatomy.skin.vertices)
    outfit = Outfit(anatomy, [], np.full(count, -1.0), np.zeros(count, bool), rng)
    for garment, own in zip(garments, rng.spawn(len(garments)), strict=True):
        outfit.rng = own
        _BUILDERS.get(garment.kind, _accessory)(outfit, garment)
    outfit.pieces = [piece.visible() for piece in outfit.pieces]
    return outfit


def _bodice(
    outfit: Outfit,
    neck: str,
    sizes: Sequence[float],
    fit: Fit,
    material: Material,
    margin: float,
    opening: Sequence[_Cut] = (),
) -> None:
    """Puts cloth on trunk and arms, over everything so far.

    sizes: depth of the neckline, and template coordinates where the sleeves and the cloth on the
    trunk end. opening: further cuts, such as an open front.
    """
    depth, sleeve, bottom = sizes
    cuts = [
        (tailoring.neckline, neck, depth),
        (tailoring.sleeves, sleeve),
        (tailoring.above, bottom),
    ]
    outfit.put([*cuts, *opening], fit, material, margin)
    outfit.trunk, outfit.fit = fit.ease, fit


def _neck(garment: Garment) -> str:
    """Returns the name of the neckline of a top or a dress."""
    return next(neck for neck in tailoring.NECKLINES if neck in garment.details)


def _collar(
    outfit: Outfit,
    material: Material,
    fit: Fit,
    extra: float = 0.004,
    sizes: Sequence[float] = (0.125, 0.178, 0.012),
) -> None:
    """Puts on a collar that stands off from its garment.

    extra: distance from the garment, metres. sizes: low, high and gap of `tailoring.collar`.
    """
    flat = dataclasses.replace(fit, ease=fit.ease + extra, fold=0.0, hem=0.01, quilt=0.0)
    outfit.strip(tailoring.collar(outfit.template, *sizes), flat, material)


def _top(outfit: Outfit, garment: Garment) -> None:
    """Puts on a top: the bodice, and for some kinds a collar or a hood that lies on it."""
    sizes, kind, details = garment.sizes, garment.kind, garment.details
    sleeve, bottom, loose = sizes["sleeve"], sizes["bottom"], sizes["loose"]
    # looser tops stand off further, hang more, and have higher folds; short sleeves stand off too
    least = 0.008 if "tucked" in details else 0.012
    hang = 2.0
    if loose > 0.3:
        hang = outfit.rng.choice([0.05, 0.2, 0.5])
    wide = 0.035 if sleeve < 0.45 else 0.016
    fit = Fit(
        ease=max(least + 0.016 * loose, outfit.trunk + _LAYER),
        hang=hang,
        sleeve=0.003 + wide * loose,
        fold=0.0015 + 0.0055 * loose,
        inner=outfit.trunk + 0.5 * _LAYER if outfit.trunk else 0.0,
        skirted=True,
    )
    cuffs = sleeve - 0.016 if sleeve > 0.2 else None
    material = Material(sewn(garment, bottom + 0.018, cuffs), 0.25 + 0.45 * loose, sheen=0.04)
    # an open front is one more cut through the bodice
    opening = []
    if "open" in details:
        opening = [(tailoring.front_opening, 0.03, 0.12)]
    margin = HEM_MARGIN + 0.03 * loose
    ends = sizes["depth"], sleeve, bottom
    _bodice(outfit, _neck(garment), ends, fit, material, margin, opening)
    if kind in ("shirt", "polo", "blouse") and "collar" in details:
        _collar(outfit, material, fit)
    if kind == "hoodie":
        hood = accessories.hood(outfit.rng, outfit.anatomy, "hood_up" in details)
        outfit.add(hood, material, layered=False)


def _outer(outfit: Outfit, garment: Garment) -> None:
    """Puts on a jacket or a coat: the bodice, and on most kinds lapels, a hood or a collar.

    A coat also has a tube below the waist.
    """
    sizes, kind, details = garment.sizes, garment.kind, garment.details
    gap, spread, bottom = sizes["gap"], sizes["spread"], sizes["bottom"]
    fit = _outer_fit(outfit, garment)
    cuffs = None if kind == "vest" else sizes["sleeve"] - 0.016
    stitches = sewn(garment, bottom + 0.018, cuffs)
    wrinkles = 0.15 if kind == "blazer" else 0.3 + 0.2 * sizes["loose"]
    material = Material(stitches, wrinkles, sheen=0.12 if kind in PADDED else 0.05)
    # an open front is one more cut through the bodice
    opening = []
    if gap > 0:
        opening = [(tailoring.front_opening, gap, spread)]
    neck = "vee" if "lapels" in details else "crew"
    low = WAIST - 0.045 if kind == "coat" else bottom
    _bodice(outfit, neck, (0.09, sizes["sleeve"], low), fit, material, 0.03, opening)
    # a coat goes on below the waist as a tube
    if kind == "coat":
        width = max(outfit.legs, fit.ease) + 0.002
        heights, pleats = (WAIST + 0.02, bottom), (5, 0.008)
        tube = skirt(
            outfit.rng,
            outfit.anatomy,
            heights,
            width,
            sizes["flare"],
            pleats,
            gap,
            0.5 * spread,
        )
        if gap < 0:
            outfit.hide(lambda t: tailoring.hips_and_legs(t, WAIST, bottom), 0.02)
        outfit.add(tube, dataclasses.replace(material, draped=True))
    # what lies on the bodice
    if "lapels" in details:
        edge, low = max(gap, 0.004), outfit.rng.uniform(-0.16, -0.08)
        raised, below = fit.ease + 0.006, fit.ease + 0.003
        strip = dataclasses.replace(fit, ease=raised, fold=0.0, hem=0.005, inner=below)
        dark = Material(lambda s: 0.88 * stitches(s), sheen=0.06)  # seen against its pile
        wide = spread if gap > 0 else 0.0
        outfit.strip(tailoring.lapel(outfit.template, edge, wide, low), strip, dark)
        _collar(outfit, dark, strip, 0.001, (0.12, 0.17, max(edge, 0.03)))
    elif "hood" in details or kind == "hooded_jacket":
        outfit.add(accessories.hood(outfit.rng, outfit.anatomy, False), material, layered=False)
    elif kind not in ("cardigan", "blazer"):
        high = 0.185 if kind in PADDED else 0.175
        _collar(outfit, material, fit, 0.003, (0.12, high, max(gap, 0.01)))


def _outer_fit(outfit: Outfit, garment: Garment) -> Fit:
    """Returns the fit of a jacket or coat. Padded garments stand off. Padded garments and blazers
    have low folds.
    """
    kind, loose, padded = garment.kind, garment.sizes["loose"], garment.kind in PADDED
    if kind == "coat":
        hang = 1.5
    elif kind == "blazer":
        hang = 0.8
    else:
        hang = outfit.rng.choice([0.05, 0.3])
    return Fit(
        ease=max(outfit.trunk + 0.009 + 0.008 * loose, 0.022 if padded else 0.0),
        hang=hang,
        sleeve=0.01 + 0.012 * loose,
        fold=0.002 if padded or kind == "blazer" else 0.002 + 0.003 * loose,
        hem=0.014,
        quilt=QUILT if padded else 0.0,
        skirted=True,
        inner=outfit.trunk + 0.5 * _LAYER,
    )


def _trousers(outfit: Outfit, garment: Garment) -> None:
    """Puts on trousers, over a top that is tucked in, or below one that hangs over them."""
    sizes, kind = garment.sizes, garment.kind
    top, end, loose, tucked = sizes["top"], sizes["end"], sizes["loose"], sizes["tucked"] > 0
    # loose ones have higher folds, which end below a top that hangs over them
    ease = outfit.trunk + 0.004 if tucked else 0.005
    hangs = {"wide": 0.02, "slim": 1.0, "leggings": 3.0, "jeans": 0.12}
    hang = hangs.get(kind, outfit.rng.choice([0.05, 0.1]))
    distance = 0.004 if kind == "leggings" and not tucked else ease
    fold = 0.0025 + 0.0035 * loose
    if kind in ("leggings", "slim"):
        fold = 0.0012
    fit = Fit(
        ease=distance,
        hang=0.6,
        leg=sizes["width"],
        leg_hang=hang,
        fold=fold,
        calm=9.0 if tucked else outfit.lowest + 0.02,
    )
    material = Material(sewn(garment, end + 0.018), wrinkles=0.15 + 0.4 * loose, sheen=0.03)

    def in_two_legs(surface: Surface) -> Surface:
        return surface.with_attributes(cloth=leg_coordinates(surface.template))

    margin = HEM_MARGIN + 0.03 * loose * (kind in ("wide", "shorts"))
    outfit.put([(tailoring.trousers, top, end)], fit, material, margin, in_two_legs, tucked)
    # skin between shirt and trousers, below both
    x, y, _ = outfit.template.T
    seat = (np.abs(x) < 0.22) & (y < WAIST - 0.06) & (y > max(end + 0.02, CROTCH - 0.075))
    outfit.removed = outfit.removed | (seat & (outfit.cover > 0))
    outfit.legs = ease + sizes["width"]
    if not tucked:
        _let_hang_over(outfit, 0.03)


def _let_hang_over(outfit: Outfit, margin: float) -> None:
    """Hides the part of the last piece that lies under the top.

    margin: height of the strip above the top's hem in which the last piece is not hidden, metres.
    """
    lower = outfit.pieces[-1]
    x, y, _ = lower.surface.template.T
    hidden = (y > outfit.lowest + margin) & (np.abs(x) < tailoring.TRUNK_HALF_WIDTH)
    outfit.pieces[-1] = dataclasses.replace(lower, hidden=lower.hidden | hidden)


def _skirt(outfit: Outfit, garment: Garment) -> None:
    """Puts on a skirt with a waistband, over a top that is tucked in, or below any other top."""
    sizes, tucked = garment.sizes, garment.sizes["tucked"] > 0
    top, end = sizes["top"], sizes["end"]
    ease = outfit.trunk + 0.004 if tucked else 0.004
    cling = 0.0 if tucked else max(0.0, top - outfit.lowest + 0.02)  # as far as the top reaches
    stitches = sewn(garment, end + 0.02, seams=False)

    def waistband(s: Spots) -> Points:
        return trimmings.banded(stitches(s), s, garment.fabric.base * 0.8, top - 0.035, top)

    surface = skirt(outfit.rng, outfit.anatomy, (top, end), ease, *_hem_of(sizes), cling=cling)
    outfit.hide(lambda t: tailoring.hips_and_legs(t, top, end), 0.0, tucked)
    outfit.add(surface, Material(waistband, wrinkles=0.35, sheen=0.05, draped=True))
    outfit.legs = ease + 0.02
    if not tucked:
        _let_hang_over(outfit, 0.055)


def _hem_of(sizes: Mapping[str, float]) -> tuple[float, tuple[int, float]]:
    """Returns the flare and the pleats of a skirt.

    The flare is the metres by which the radius grows per metre down. Short skirts have a larger
    flare, so that hems of all lengths stand off alike. The pleats are their number and their depth
    in metres.
    """
    return sizes["flare"] / max(0.3, -0.2 - sizes["end"]), (int(sizes["pleats"]), sizes["depth"])


def _dress(outfit: Outfit, garment: Garment) -> None:
    """Puts on a dress: a bodice down to the waist, and a skirt of the same fabric."""
    sizes, waist, end = garment.sizes, garment.sizes["waist"], garment.sizes["end"]
    fit = Fit(ease=0.008, hang=1.0, sleeve=0.004 + 0.03 * sizes["loose"], fold=0.002)
    material = Material(sewn(garment, end + 0.02, seams=False), wrinkles=0.3, sheen=0.05)
    bodice = sizes["depth"], sizes["sleeve"], waist - 0.02
    _bodice(outfit, _neck(garment), bodice, fit, material, HEM_MARGIN + 0.02 * sizes["loose"])
    surface = skirt(outfit.rng, outfit.anatomy, (waist, end), 0.010, *_hem_of(sizes))
    outfit.hide(lambda t: tailoring.hips_and_legs(t, waist + 0.03, end), 0.0)
    outfit.add(surface, dataclasses.replace(material, draped=True))
    outfit.legs = 0.03
    if garment.kind == "shirt_dress":
        _collar(outfit, material, fit)


def _socks(outfit: Outfit, garment: Garment) -> None:
    """Puts on socks of a ribbed fabric."""

    def ribbed(s: Spots) -> Points:
        ribs = 0.94 + 0.06 * np.cos(2 * np.pi * s.around / 0.008)
        return garment.fabric.colors(s) * ribs[:, None]

    material = Material(ribbed, wrinkles=0.1)
    fit = Fit(ease=0.003, fold=0.001, hem=0.003)
    outfit.put([(tailoring.shaft, garment.sizes["height"])], fit, material, 0.008)


def _shoes(outfit: Outfit, garment: Garment) -> None:
    """Puts on shoes, or the soles and straps of sandals."""
    height, sole, over = (garment.sizes[name] for name in ("height", "sole", "over"))
    sheen = 0.2 if garment.kind != "sneakers" else 0.08
    material = Material(lambda s: trimmings.leather(s, garment), sheen=sheen)
    if garment.kind == "sandals":
        soles = accessories.pair_of_shoes(outfit.anatomy, 0.024, sole, 0.004)
        outfit.add(soles, material, layered=False)
        for field in tailoring.sandal_straps(outfit.template):
            outfit.strip(field, Fit(ease=0.005, fold=0.0, hem=0.004), material)
        return
    surface = accessories.pair_of_shoes(outfit.anatomy, height, sole, 0.017 if over else 0.006)
    outfit.hide(lambda t: tailoring.shaft(t, height), 0.012)
    if not over:
        # trouser legs hang over low shoes, which hide nothing of them, only socks
        for i, piece in enumerate(outfit.pieces):
            if piece.hidden is None:
                continue
            y = piece.surface.template[:, 1]
            if y.min() >= -1.2:
                outfit.pieces[i] = dataclasses.replace(piece, hidden=piece.hidden & (y >= -0.9))
    outfit.add(surface, material, layered=False)


def _belt(outfit: Outfit, garment: Garment) -> None:
    """Puts on a belt with a buckle, over the trousers."""
    top, width = garment.sizes["top"], garment.sizes["width"]
    fit = Fit(ease=outfit.trunk + 0.009, hang=0.6, fold=0.0, hem=0.006, inner=outfit.trunk + 0.007)
    material = Material(lambda s: trimmings.buckled(s, garment), sheen=0.15)
    outfit.strip(tailoring.trousers(outfit.template, top, top - width), fit, material, layered=True)


def _tie(outfit: Outfit, garment: Garment) -> None:
    """Puts on a tie that lies on the folds of the shirt."""
    field = tailoring.necktie(outfit.template, garment.sizes["length"], garment.sizes["width"])
    raised = outfit.trunk + 0.005 + outfit.fit.fold
    fit = dataclasses.replace(outfit.fit, ease=raised, inner=raised - 0.002, fold=0.0, hem=0.004)
    outfit.strip(field, fit, Material(garment.fabric.colors, sheen=0.15), layered=True)


def _watch(outfit: Outfit, garment: Garment) -> None:
    """Puts a watch on one wrist."""
    field = tailoring.bracelet(outfit.template, garment.sizes["side"], 0.628, 0.650)
    fit = Fit(ease=0.003, fold=0.0, hem=0.002)
    outfit.strip(field, fit, Material(garment.fabric.colors, sheen=0.3))


def _bag(outfit: Outfit, garment: Garment) -> None:
    """Puts on a backpack or a shoulder bag, and its straps, which lie on the clothes."""
    on_back = garment.kind == "backpack"

    def colors(s):
        return trimmings.bagged(s, garment)

    # the bag, and where its straps run
    if on_back:
        ease = outfit.trunk
        material = Material(colors, 0.1)
        straps = tailoring.straps(outfit.template, -0.16, -0.03)
    else:
        side, ease = garment.sizes["side"], max(outfit.trunk, min(outfit.legs, 0.02))
        material = Material(colors, 0.0, 0.12)
        straps = tailoring.sash(outfit.template, -side * 0.105, side * 0.165, 0.014)
    surface = accessories.bag(outfit.anatomy, garment, ease)
    outfit.add(surface, material, layered=False)
    # the straps lie on the folds of what is below them
    raised = outfit.trunk + 0.009 + 1.5 * outfit.fit.fold
    flat = dataclasses.replace(
        outfit.fit,
        ease=raised,
        inner=raised - 0.002,
        fold=0.0,
        hem=0.006,
        quilt=0.0,
        skirted=True,
    )
    outfit.strip(straps, flat, Material(garment.fabric.colors, sheen=material.sheen))


def _accessory(outfit: Outfit, garment: Garment) -> None:
    """Puts on glasses, a necklace, a scarf or headwear, as `accessories.build` makes them. They
    hide nothing.
    """
    for surface, material in accessories.build(outfit.rng, outfit.anatomy, garment, outfit.trunk):
        outfit.add(surface, material, layered=False)


_BUILDERS = {
    **dict.fromkeys(TOPS, _top),
    **dict.fromkeys(OUTER, _outer),
    **dict.fromkeys(BOTTOMS, _trousers),
    **dict.fromkeys(SKIRTS, _skirt),
    **dict.fromkeys(DRESSES, _dress),
    **dict.fromkeys(SHOES, _shoes),
    **dict.fromkeys(("backpack", "shoulder_bag"), _bag),
    **{"belt": _belt, "tie": _tie, "socks": _socks, "watch": _watch},
}
"""The function that puts on each kind of garment. `_accessory` puts on all other kinds."""
