"""Chooses at random what a person wears: kinds of garments, their lengths, widths and fabrics.

The geometry is made elsewhere, in `wardrobe`. Lengths are in template coordinates (see `anatomy`):
a height y for a hem, |x| for the end of a sleeve. The tables below hold specifications of random
values, see `drawn`. `row` draws all rows of a table and uses one. A new row therefore changes what
every seed makes: raise `subject.GENERATOR_VERSION` with it.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from humangs_jax.synthetic.anatomy import WRIST
from humangs_jax.synthetic.fabrics import Fabric, sample_fabric
from humangs_jax.synthetic.surfaces import choice

TOPS = (
    "tank",
    "tee",
    "longsleeve",
    "polo",
    "shirt",
    "blouse",
    "sweater",
    "turtleneck",
    "hoodie",
    "jersey",
)
OUTER = ("jacket", "denim_jacket", "blazer", "cardigan", "vest", "puffer", "coat", "hooded_jacket")
BOTTOMS = ("jeans", "chinos", "slim", "wide", "shorts", "cropped", "track", "leggings", "cargo")
SKIRTS = ("short_skirt", "long_skirt", "pleated_skirt")
DRESSES = ("short_dress", "long_dress", "shirt_dress")
HEADWEAR = ("beanie", "cap", "brim_hat", "headscarf")
SHOES = ("sneakers", "flats", "sandals", "ankle_boots", "boots")
KINDS = (
    *(*TOPS, *OUTER, *BOTTOMS, *SKIRTS, *DRESSES, *HEADWEAR, *SHOES),
    *("scarf", "belt", "tie", "glasses", "sunglasses", "backpack", "shoulder_bag", "socks"),
    *("necklace", "watch"),
)
"""All kinds of garments."""


@dataclasses.dataclass(frozen=True)
class Garment:
    """One piece of clothing."""

    kind: str
    """Kind of garment, one of KINDS."""
    fabric: Fabric
    """The cloth, with its color and pattern."""
    sizes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Numbers that the builder of this kind needs, such as "sleeve" or "bottom", by name."""
    details: frozenset[str] = frozenset()
    """Names of the garment's features, such as "hood" or "pockets"."""


Odds = Mapping[str, float | int]


@dataclasses.dataclass(frozen=True)
class _Style:
    """Odds and probabilities of the clothes of one style, such as "casual"."""

    men: float
    """Odds of the style for men."""
    women: float
    """Odds of the style for women."""
    tops: Odds
    """Odds of the kinds of tops."""
    bottoms: Odds
    """Odds of the kinds of trousers."""
    shoes: Odds
    """Odds of the kinds of shoes."""
    coats: Odds = dataclasses.field(default_factory=lambda: {"hooded_jacket": 1, "jacket": 1})
    """Odds of the kinds of coats and jackets."""
    outer: float = 0.06
    """Probability of a coat or jacket over the other clothes."""
    tucked: float = 0.22
    """Probability that the top is tucked in, where its kind allows that."""
    skirt: float = 0.12
    """Probability of a skirt, for women."""
    scarf: float = 0.1
    """Probability of a scarf."""
    headwear: Odds = dataclasses.field(
        default_factory=lambda: {"beanie": 0.05, "cap": 0.07, "brim_hat": 0.05}
    )
    """Probability of each kind of headwear. Women may have a headscarf instead. All other people
    have no headwear.
    """
    no_sunglasses: float = 0.96
    """Probability of no sunglasses."""


_STYLES = {
    "casual": _Style(
        0.36,
        0.27,
        {
            "tee": 4,
            "longsleeve": 2,
            "shirt": 2.5,
            "sweater": 2,
            "hoodie": 2,
            "polo": 1,
            "turtleneck": 0.6,
        },
        {
            "jeans": 5,
            "chinos": 2,
            "slim": 1.5,
            "wide": 1,
            "cropped": 0.6,
            "cargo": 0.8,
            "shorts": 0.6,
        },
        {"sneakers": 5, "ankle_boots": 1.5, "flats": 1.5, "boots": 0.4},
        {
            "jacket": 3,
            "denim_jacket": 2,
            "cardigan": 2,
            "hooded_jacket": 1.5,
            "vest": 0.7,
            "blazer": 0.7,
        },
        outer=0.28,
        skirt=0.22,
    ),
    "formal": _Style(
        0.16,
        0.1,
        {"shirt": 6, "blouse": 2, "turtleneck": 1, "sweater": 1},
        {"chinos": 4, "slim": 2, "wide": 1.3, "jeans": 1},
        {"flats": 6, "ankle_boots": 2},
        {"blazer": 6, "coat": 1.5, "cardigan": 1, "vest": 1},
        outer=0.6,
        tucked=0.7,
        skirt=0.4,
        headwear={"brim_hat": 0.1},
    ),
    "sport": _Style(
        0.14,
        0.1,
        {"tee": 3, "tank": 2, "jersey": 2.5, "hoodie": 1.5, "longsleeve": 1},
        {"track": 3, "shorts": 3, "leggings": 2},
        {"sneakers": 1},
        tucked=0.05,
        scarf=0.03,
        headwear={"cap": 0.35},
    ),
    "winter": _Style(
        0.16,
        0.14,
        {"sweater": 3, "turtleneck": 2, "longsleeve": 2, "shirt": 2, "hoodie": 1.5},
        {"jeans": 4, "chinos": 2, "slim": 2, "wide": 0.7, "cargo": 0.7},
        {"ankle_boots": 3, "boots": 2.5, "sneakers": 1.5},
        {"coat": 4, "puffer": 3, "jacket": 1.5, "hooded_jacket": 1.5},
        outer=0.9,
        scarf=0.4,
        headwear={"beanie": 0.4, "brim_hat": 0.06},
    ),
    "summer": _Style(
        0.12,
        0.12,
        {"tee": 4, "tank": 3, "shirt": 2, "polo": 1.5, "blouse": 1},
        {"shorts": 5, "cropped": 1.5, "wide": 1, "jeans": 1.5},
        {"sneakers": 3, "sandals": 3, "flats": 1.5},
        skirt=0.35,
        scarf=0.03,
        headwear={"cap": 0.2, "brim_hat": 0.22},
        no_sunglasses=0.85,
    ),
    "street": _Style(
        0.06,
        0.04,
        {"hoodie": 4, "tee": 4, "jersey": 2, "shirt": 1},
        {"jeans": 3, "cargo": 3, "wide": 2, "track": 2, "shorts": 1},
        {"sneakers": 5, "ankle_boots": 1},
        {"jacket": 2, "denim_jacket": 2, "hooded_jacket": 2, "puffer": 1},
        outer=0.5,
        tucked=0.05,
        headwear={"cap": 0.35, "beanie": 0.2},
        no_sunglasses=0.85,
    ),
    "dressed": _Style(
        0.0,
        0.25,
        {},
        {},
        {"flats": 3, "sandals": 2, "boots": 1.2, "ankle_boots": 1.2, "sneakers": 1},
        {"cardigan": 3, "blazer": 1.5, "coat": 1.5, "denim_jacket": 1.5},
        outer=0.2,
    ),
}


@dataclasses.dataclass(frozen=True)
class _OneOf:
    """Several specifications: `drawn` draws a value of each, and returns one of the values."""

    options: tuple
    """The specifications."""
    odds: tuple[float, ...] | None = None
    """Probabilities of the specifications, which sum to 1. None: all are equal."""


def drawn(rng: np.random.Generator, specification: Any, **named: float) -> Any:
    """Draws the random value that a specification describes.

    There are four kinds of specifications. A pair (low, high) gives a uniform number in this range.
    A dict of odds gives one of its names. An `_OneOf` gives the value of one of its options. A name
    in `named` gives the value that it has there. Anything else, such as a number, is returned as it
    is.
    """
    if isinstance(specification, tuple):
        return rng.uniform(*specification)
    if isinstance(specification, Mapping):
        return choice(rng, specification)
    if isinstance(specification, _OneOf):
        return rng.choice(
            [drawn(rng, option, **named) for option in specification.options], p=specification.odds
        )
    return named.get(specification, specification)


def row(rng: np.random.Generator, table: Mapping[str, Any], kind: str, **named: float) -> Any:
    """Draws the values of all rows of a table of specifications, and returns the value of the row
    `kind`.

    If there is no such row, returns the value of the row "other", or None without that row, too.
    """
    values = {name: drawn(rng, specification, **named) for name, specification in table.items()}
    return values.get(kind, values.get("other"))


_SLEEVES = {
    "tank": (0.122, 0.15),
    "tee": "short",
    "polo": (0.30, 0.38),
    "jersey": _OneOf(("short", (0.125, 0.15)), (0.7, 0.3)),
    "shirt": _OneOf(("long", (0.3, 0.4), (0.44, 0.55)), (0.62, 0.23, 0.15)),
    "blouse": _OneOf(("long", (0.25, 0.55))),
    "other": _OneOf(("long", (0.42, 0.6)), (0.78, 0.22)),
}
_NECKS = {
    "tee": {"crew": 6, "vee": 2.5, "scoop": 1.5},
    "tank": "scoop",
    "jersey": {"crew": 1, "vee": 1},
    "shirt": "collar",
    "polo": "collar",
    "blouse": {"collar": 2, "vee": 2, "crew": 1},
    "turtleneck": "high",
    "hoodie": "crew",
    "other": {"crew": 6, "vee": 2, "scoop": 0.6},
}
"""Specifications of the necklines of tops, by kind of top. "other" is for the other kinds; men then
have no scoop.
"""
_TOP_DETAILS = (
    ("print", ("tee", "hoodie", "longsleeve", "tank"), 0.5),
    ("number", ("jersey",), 1),
    ("zip", ("hoodie",), 0.4),
    ("hood_up", ("hoodie",), 0.18),
    ("ribbed", ("sweater", "turtleneck", "hoodie", "longsleeve"), 1),
    ("pocket", ("shirt", "polo", "blouse"), 0.5),
    ("open", ("shirt",), 0.2),
)
"""Features of tops: name, kinds of tops that can have it, probability for those kinds."""
_LEG_ENDS = {"shorts": (-0.77, -0.56), "cropped": (-1.1, -0.93), "other": (-1.172, -1.14)}
_LEG_WIDTHS = {
    "wide": (0.025, 0.065),
    "cargo": (0.015, 0.04),
    "track": (0.004, 0.03),
    "jeans": _OneOf(((0.0, 0.01), (0.01, 0.035))),
    "chinos": (0.004, 0.02),
    "shorts": (0.002, 0.04),
    "slim": 0.002,
    "leggings": 0.0,
    "other": (0.004, 0.025),
}
_COAT_ENDS = {
    "coat": (-0.9, -0.6),
    "blazer": (-0.43, -0.38),
    "denim_jacket": (-0.34, -0.28),
    "puffer": (-0.42, -0.3),
    "vest": (-0.34, -0.27),
    "other": (-0.42, -0.31),
}
_COAT_DETAILS = {
    "jacket": {"collar", "pockets"},
    "denim_jacket": {"collar", "pockets"},
    "coat": {"pockets"},
    "vest": {"pockets"},
    "puffer": {"pockets"},
    "hooded_jacket": {"hood"},
    "blazer": {"lapels"},
}
_SHAFTS = {
    "sneakers": _OneOf((0.09, (0.11, 0.14)), (0.8, 0.2)),
    "flats": (0.068, 0.085),
    "sandals": 0.07,
    "ankle_boots": (0.13, 0.17),
    "boots": (0.24, 0.40),
}


def sample_outfit(rng: np.random.Generator, male: bool, years: float) -> tuple[Garment, ...]:
    """Returns clothes that go together, innermost first. Shoes and accessories come last."""
    name = drawn(rng, {name: style.men if male else style.women for name, style in _STYLES.items()})
    style = _STYLES[name]
    outer = rng.random() < style.outer
    if name == "dressed":
        worn = _dress(rng, outer)
    else:
        worn = _separates(rng, name, male, outer)
    worn += _fastened(rng, name, male, worn)
    if outer:
        worn.append(_outer(rng, style, worn))
    worn += _shoes(rng, style, male, worn)
    worn += _extras(rng, style, male, years, worn)
    return tuple(worn)


def _made(
    rng: np.random.Generator,
    kind: str,
    plainness: float,
    details: Iterable[str] = (),
    **sizes: float,
) -> Garment:
    """Makes a garment of a random fabric. plainness: see `sample_fabric`."""
    return Garment(kind, sample_fabric(rng, kind, plainness), sizes, frozenset(details))


def _separates(rng: np.random.Generator, name: str, male: bool, outer: bool) -> list[Garment]:
    """Chooses a top, and trousers or a skirt; an open shirt has a tee under it."""
    style = _STYLES[name]
    kind = drawn(rng, style.tops)
    if male and kind == "blouse":
        kind = "shirt"
    tucked = rng.random() < style.tucked and kind not in ("hoodie", "jersey")
    waist = rng.uniform(-0.235, -0.212)
    top = _top(rng, name, kind, male, waist, tucked, outer)
    skirted = not male and rng.random() < style.skirt
    if skirted:
        lower = _skirt(rng, waist, tucked)
    else:
        lower = _trousers(rng, style, male, waist, tucked, top)
    if "open" in top.details:
        below = {
            "sleeve": rng.uniform(0.14, 0.36),
            "bottom": top.sizes["bottom"] + 0.012,
            "loose": 0.0,
            "depth": 0.05,
        }
        return [_made(rng, "tee", 0.7, {"crew"}, **below), lower, top]
    return [top, lower]


def _top(
    rng: np.random.Generator,
    style: str,
    kind: str,
    male: bool,
    waist: float,
    tucked: bool,
    outer: bool,
) -> Garment:
    """Chooses sizes, details and fabric of a top.

    outer: whether a coat or jacket is worn over the top.
    """
    long, short = WRIST - rng.uniform(0.0, 0.035), rng.uniform(0.27, 0.40)
    sleeve = row(rng, _SLEEVES, kind, long=long, short=short)
    necks = _NECKS
    if male:
        necks = _NECKS | {"other": {"crew": 6, "vee": 2, "scoop": 0}}
    details = {row(rng, necks, kind)}
    cropped = not male and not tucked and rng.random() < 0.08
    # a tucked top ends just below the waist; cropped ones are rare
    if tucked:
        bottom = waist - 0.03
    elif cropped:
        bottom = rng.uniform(-0.22, -0.2)
    else:
        bottom = rng.uniform(-0.385, -0.30)
    # only plain tops may be tight
    wide = kind not in ("tank", "tee", "longsleeve", "turtleneck")
    if wide:
        loose = rng.uniform(0.25, 1.0)
    else:
        loose = rng.uniform(0.0, 1.0) ** 1.3
    if kind == "hoodie":
        loose = 0.5 + 0.5 * loose
    elif style == "street":
        loose = 0.4 + 0.6 * loose
    # details that another garment would hide, or that need an open front, are left out
    for detail, kinds, odds in _TOP_DETAILS:
        possible = kind in kinds and not (detail == "open" and (tucked or outer))
        if possible and (odds == 1 or rng.random() < odds) and not (detail == "hood_up" and outer):
            details.add(detail)
    if tucked:
        details.add("tucked")
    # what is worn under or in something else is close to the body
    sleeve = float(min(sleeve, WRIST - 0.01) if outer else sleeve)
    if outer or tucked:
        loose = min(loose, 0.2)
    # how often tops are in one dye
    plain = {"tee": 0.5, "sweater": 0.4, "turtleneck": 0.65, "hoodie": 0.65, "tank": 0.55}
    plainness = 0.55 if style == "formal" else plain.get(kind, 0.35)
    depth = rng.uniform(0.04, 0.095)
    return _made(
        rng, kind, plainness, details, sleeve=sleeve, bottom=bottom, loose=loose, depth=depth
    )


def _trousers(
    rng: np.random.Generator, style: _Style, male: bool, waist: float, tucked: bool, top: Garment
) -> Garment:
    """Chooses trousers of a style; `top` decides how low they may sit."""
    kind = drawn(rng, style.bottoms)
    if kind == "leggings" and male and rng.random() < 0.7:
        kind = "shorts"
    end = row(rng, _LEG_ENDS | {"shorts": (-0.77, -0.62)} if male else _LEG_ENDS, kind)
    width = row(rng, _LEG_WIDTHS, kind)
    looseness = {"leggings": 0.0, "slim": 0.1, "wide": 0.9, "cargo": 0.9, "other": (0.2, 0.7)}
    loose = row(rng, looseness, kind)
    # a tucked or cropped top shows the waist; under a longer one trousers may sit lower
    upper = waist
    if not tucked and top.sizes["bottom"] <= -0.25:
        upper = max(top.sizes["bottom"] + 0.06, waist - 0.2)
    details = set()
    if kind not in ("track", "leggings"):
        details.add("pockets")
    elif rng.random() < 0.6:
        details.add("side_stripe")
    # some trousers are cropped or turned up
    if rng.random() < 0.15 and kind in ("jeans", "chinos") and not male:
        end = rng.uniform(-1.12, -1.05)
    if kind == "jeans" and rng.random() < 0.25:
        details.add("turn_up")
    sizes = {
        "top": upper,
        "end": end,
        "width": float(width),
        "loose": loose,
        "waist": waist,
        "tucked": float(tucked),
    }
    return _made(rng, kind, 0.75, details, **sizes)


def _skirt(rng: np.random.Generator, waist: float, tucked: bool) -> Garment:
    """Chooses a skirt, narrow or flared, that begins at height `waist`."""
    kind = drawn(rng, {"short_skirt": 3, "pleated_skirt": 1.5, "long_skirt": 2})
    if kind == "long_skirt":
        end = rng.uniform(-1.1, -0.84)
    else:
        end = rng.uniform(-0.76, -0.57)
    narrow = rng.random() < 0.35 and kind != "pleated_skirt"
    if narrow:
        flare = rng.uniform(0.0, 0.05)
    else:
        flare = rng.uniform(0.05, 0.16)
    sizes = {
        "top": waist,
        "end": end,
        "flare": flare,
        "waist": waist,
        "tucked": float(tucked),
        **_pleats(rng, kind),
    }
    return _made(rng, kind, 0.35, (), **sizes)


def _pleats(rng: np.random.Generator, kind: str) -> dict[str, float]:
    """Draws the number of pleats of a skirt and their depth in metres, by name."""
    count, depth = (4, 10), (0.004, 0.016)
    if kind == "pleated_skirt":
        count, depth = (14, 24), (0.008, 0.014)
    return {"pleats": float(rng.integers(*count)), "depth": rng.uniform(*depth)}


def _dress(rng: np.random.Generator, outer: bool) -> list[Garment]:
    """Chooses a dress. outer: whether a coat or jacket is worn over it."""
    kind = drawn(rng, {"short_dress": 4, "long_dress": 3, "shirt_dress": 1.5})
    if kind == "long_dress":
        end = rng.uniform(-1.14, -0.85)
    else:
        end = rng.uniform(-0.78, -0.56)
    sleeve = float(
        drawn(rng, _OneOf(((0.118, 0.15), (0.25, 0.4), WRIST - 0.02), (0.42, 0.33, 0.25)))
    )
    neck = "collar"
    if kind != "shirt_dress":
        neck = drawn(rng, {"crew": 1, "vee": 1.3, "scoop": 1.3})
    sizes = {
        "sleeve": sleeve,
        "waist": rng.uniform(-0.235, -0.165),
        "end": end,
        "flare": rng.uniform(0.015, 0.17),
    }
    sizes |= {
        "depth": rng.uniform(0.04, 0.1),
        "loose": 0.1 if outer else rng.uniform(0.0, 0.4),
        **_pleats(rng, kind),
    }
    return [_made(rng, kind, 0.3, [neck, "sash"] if rng.random() < 0.35 else [neck], **sizes)]


def _outer(rng: np.random.Generator, style: _Style, worn: Sequence[Garment]) -> Garment:
    """Chooses a jacket or a coat over the clothes `worn`; a blazer may match the trousers."""
    kind = drawn(rng, style.coats)
    often_open = {"puffer": 0.4, "coat": 0.5, "cardigan": 0.85, "vest": 0.5}
    is_open = rng.random() < often_open.get(kind, 0.75)
    bottom = row(rng, _COAT_ENDS, kind)
    details = {"open" if is_open else "closed"} | _COAT_DETAILS.get(kind, set())
    if kind == "puffer" and rng.random() < 0.4:
        details.add("hood")
    if kind == "coat":
        details.add(drawn(rng, {"lapels": 2, "hood": 0.6, "collar": 1}))
        if not is_open and rng.random() < 0.4:
            details.add("sash")
    sizes = {"sleeve": 0.2 if kind == "vest" else WRIST - rng.uniform(0.0, 0.035), "bottom": bottom}
    sizes |= {
        "gap": rng.uniform(0.012, 0.05) if is_open else -1.0,
        "spread": rng.uniform(0.05, 0.35),
    }
    sizes |= {"flare": rng.uniform(0.02, 0.1), "loose": rng.uniform(0.2, 1.0)}
    if kind == "vest":
        sizes["sleeve"] = rng.uniform(0.145, 0.165)
    coat = _made(rng, kind, 0.9 if kind in ("blazer", "coat", "puffer") else 0.72, details, **sizes)
    # a blazer and its trousers may be a suit
    trousers = [each.fabric for each in worn if each.kind in ("chinos", "slim", "wide")]
    if kind == "blazer" and trousers and rng.random() < 0.55:
        return dataclasses.replace(coat, fabric=trousers[0])
    return coat


def _shoes(
    rng: np.random.Generator, style: _Style, male: bool, worn: Sequence[Garment]
) -> list[Garment]:
    """Chooses shoes, and socks where they can be seen.

    Only women wear tall boots, and not with trousers that are too wide for such boots. Ankle boots
    take their place.
    """
    lower = next(g for g in worn if g.kind in BOTTOMS + SKIRTS + DRESSES)
    kind = drawn(rng, style.shoes)
    covered = lower.kind in BOTTOMS and lower.sizes["end"] < -1.0
    narrow = not covered or (
        lower.kind in ("slim", "leggings", "jeans") and lower.sizes["width"] <= 0.01
    )
    if kind == "boots" and (male or not narrow):
        kind = "ankle_boots"
    height = row(rng, _SHAFTS, kind)
    soles = {"sneakers": (0.02, 0.036), "flats": (0.008, 0.02), "other": (0.015, 0.035)}
    sole = row(rng, soles, kind)
    result = []
    if kind in ("sneakers", "ankle_boots") and not covered and rng.random() < 0.75:
        tall = drawn(rng, _OneOf(((0.1, 0.17), (0.2, 0.4)), (0.75, 0.25)))
        result.append(_made(rng, "socks", 0.7, height=max(float(tall), height + 0.02)))
    return [
        *result,
        _made(rng, kind, 0.9, height=float(height), sole=float(sole), over=float(kind == "boots")),
    ]


def _fastened(
    rng: np.random.Generator, style: str, male: bool, worn: Sequence[Garment]
) -> list[Garment]:
    """Chooses a belt, a tie, both or nothing. A coat or jacket goes over them."""
    result = []
    trousers = next((g for g in worn if g.kind in BOTTOMS), None)
    belted = (
        trousers is not None
        and trousers.sizes["tucked"]
        and trousers.kind not in ("track", "leggings")
    )
    if belted and rng.random() < 0.7:
        top = trousers.sizes["waist"] - 0.004
        result.append(_made(rng, "belt", 1.0, top=top, width=rng.uniform(0.028, 0.042)))
    collared = any(
        "collar" in g.details and g.kind == "shirt" and "open" not in g.details for g in worn
    )
    if style == "formal" and male and collared and rng.random() < 0.55:
        result.append(
            _made(rng, "tie", 0.3, length=rng.uniform(0.3, 0.36), width=rng.uniform(0.018, 0.032))
        )
    return result


def _extras(
    rng: np.random.Generator, style: _Style, male: bool, years: float, worn: Sequence[Garment]
) -> list[Garment]:
    """Chooses accessories: scarf, headwear, glasses, bag, watch, necklace. Any may be missing."""
    kinds = {g.kind for g in worn}
    hooded = any("hood_up" in g.details for g in worn)
    result: list[Garment] = []

    def put(kind, plainness, **sizes):
        result.append(_made(rng, kind, plainness, **sizes))
        kinds.add(kind)

    # a hood leaves no room for a scarf or a hat
    if not hooded and rng.random() < style.scarf:
        put(
            "scarf",
            0.35,
            thickness=rng.uniform(0.022, 0.038),
            tails=rng.choice([0.0, rng.uniform(0.15, 0.4)]),
        )
    # at most one kind of headwear, chosen by one number
    left = rng.random()
    headwear = style.headwear
    if not male:
        headwear = {**headwear, "headscarf": 0.06}
    for kind, odds in headwear.items():
        if left < odds and not hooded and not (kind == "headscarf" and "scarf" in kinds):
            put(
                kind,
                0.8,
                brim=rng.uniform(0.045, 0.085),
                backwards=float(kind == "cap" and rng.random() < 0.12),
            )
            break
        left -= odds
    # glasses or sunglasses, never both
    eyes = rng.random()
    if eyes < 0.2 + 0.15 * (years > 50):
        put(
            "glasses",
            1.0,
            size=rng.uniform(0.85, 1.2),
            squareness=rng.uniform(2, 6),
            wire=rng.uniform(0.0011, 0.0028),
        )
    elif eyes > style.no_sunglasses:
        put(
            "sunglasses",
            1.0,
            size=rng.uniform(1.0, 1.3),
            squareness=rng.uniform(2, 5),
            wire=rng.uniform(0.0015, 0.003),
        )
    # at most one bag
    carried = rng.random()
    if carried < 0.09 and "headscarf" not in kinds:
        put("backpack", 0.7, size=rng.uniform(0.8, 1.15))
    elif carried < (0.19 if male else 0.27):
        put("shoulder_bag", 0.8, size=rng.uniform(0.6, 1.1), side=rng.choice([-1.0, 1.0]))
    if rng.random() < 0.15:
        put("watch", 1.0, side=rng.choice([-1.0, 1.0]))
    if not male and "scarf" not in kinds and rng.random() < 0.12 and "turtleneck" not in kinds:
        put("necklace", 1.0, length=rng.uniform(0.0, 0.06))
    return result
