"""What people wear, as choices: kinds of garments, their lengths and widths, their fabrics. No geometry.

Lengths are in template coordinates (see `anatomy`): heights y for hems, |x| for the ends of sleeves.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from humangs_jax.people.anatomy import WRIST
from humangs_jax.people.fabrics import Fabric, sample_fabric

TOPS = ("tank", "tee", "longsleeve", "polo", "shirt", "blouse", "sweater", "turtleneck", "hoodie", "jersey")
OUTER = ("jacket", "denim_jacket", "blazer", "cardigan", "vest", "puffer", "coat", "hooded_jacket")
BOTTOMS = ("jeans", "chinos", "slim", "wide", "shorts", "cropped", "track", "leggings", "cargo")
SKIRTS = ("short_skirt", "long_skirt", "pleated_skirt")
DRESSES = ("short_dress", "long_dress", "shirt_dress")
HEADWEAR = ("beanie", "cap", "brim_hat", "headscarf")
SHOES = ("sneakers", "flats", "sandals", "ankle_boots", "boots")
EXTRAS = ("scarf", "belt", "tie", "glasses", "sunglasses", "backpack", "shoulder_bag", "socks", "necklace", "watch")
KINDS = TOPS + OUTER + BOTTOMS + SKIRTS + DRESSES + HEADWEAR + SHOES + EXTRAS


@dataclasses.dataclass(frozen=True)
class Garment:
    """One piece of clothing. kind: one of KINDS. fabric. sizes: what its builder needs. details: features that it has."""

    kind: str
    fabric: Fabric
    sizes: Mapping[str, float] = dataclasses.field(default_factory=dict)
    details: frozenset[str] = frozenset()


STYLES = {
    "casual": (0.36, 0.27),
    "formal": (0.16, 0.1),
    "sport": (0.14, 0.1),
    "winter": (0.16, 0.14),
    "summer": (0.12, 0.12),
    "street": (0.06, 0.04),
    "dressed": (0.0, 0.25),
}
"""Odds of a style for men and women."""


def sample_outfit(rng: np.random.Generator, male: bool, years: float) -> tuple[Garment, ...]:
    """Clothes that go together, innermost first; shoes and what is carried last."""
    odds = np.asarray([value[0 if male else 1] for value in STYLES.values()])
    style = str(rng.choice(list(STYLES), p=odds / odds.sum()))
    outer = rng.random() < {"winter": 0.9, "formal": 0.6, "casual": 0.28, "street": 0.5, "dressed": 0.2}.get(
        style, 0.06
    )
    worn = _dress(rng, outer) if style == "dressed" else _separates(rng, style, male, outer)
    worn += _fastened(rng, style, male, worn)
    if outer:
        worn.append(_outer(rng, style, worn))
    worn += _shoes(rng, style, male, worn)
    worn += _extras(rng, style, male, years, worn)
    return tuple(worn)


def _pick(rng, table):
    names = list(table)
    odds = np.asarray(list(table.values()), float)
    return str(rng.choice(names, p=odds / odds.sum()))


TOP_ODDS = {
    "casual": {"tee": 4, "longsleeve": 2, "shirt": 2.5, "sweater": 2, "hoodie": 2, "polo": 1, "turtleneck": 0.6},
    "formal": {"shirt": 6, "blouse": 2, "turtleneck": 1, "sweater": 1},
    "sport": {"tee": 3, "tank": 2, "jersey": 2.5, "hoodie": 1.5, "longsleeve": 1},
    "winter": {"sweater": 3, "turtleneck": 2, "longsleeve": 2, "shirt": 2, "hoodie": 1.5},
    "summer": {"tee": 4, "tank": 3, "shirt": 2, "polo": 1.5, "blouse": 1},
    "street": {"hoodie": 4, "tee": 4, "jersey": 2, "shirt": 1},
}
BOTTOM_ODDS = {
    "casual": {"jeans": 5, "chinos": 2, "slim": 1.5, "wide": 1, "cropped": 0.6, "cargo": 0.8, "shorts": 0.6},
    "formal": {"chinos": 4, "slim": 2, "wide": 1.3, "jeans": 1},
    "sport": {"track": 3, "shorts": 3, "leggings": 2},
    "winter": {"jeans": 4, "chinos": 2, "slim": 2, "wide": 0.7, "cargo": 0.7},
    "summer": {"shorts": 5, "cropped": 1.5, "wide": 1, "jeans": 1.5},
    "street": {"jeans": 3, "cargo": 3, "wide": 2, "track": 2, "shorts": 1},
}


def _separates(rng, style, male, outer):
    kind = _pick(rng, TOP_ODDS[style])
    if male and kind == "blouse":
        kind = "shirt"
    tucked = rng.random() < {"formal": 0.7, "sport": 0.05, "street": 0.05}.get(style, 0.22)
    tucked = tucked and kind not in ("hoodie", "jersey")
    waist = rng.uniform(-0.235, -0.212)
    top = _top(rng, style, kind, male, waist, tucked, outer)
    skirted = not male and rng.random() < {"formal": 0.4, "summer": 0.35, "casual": 0.22}.get(style, 0.12)
    lower = _skirt(rng, waist, tucked) if skirted else _trousers(rng, style, male, waist, tucked, top)
    if "open" in top.details:
        below = {"sleeve": rng.uniform(0.14, 0.36), "bottom": top.sizes["bottom"] + 0.012, "loose": 0.0, "depth": 0.05}
        return [Garment("tee", sample_fabric(rng, "tee", 0.7), below, frozenset({"crew"})), lower, top]
    return [top, lower]


def _top(rng, style, kind, male, waist, tucked, outer):
    long = WRIST - rng.uniform(0.0, 0.035)
    short = rng.uniform(0.27, 0.40)
    sleeve = {
        "tank": rng.uniform(0.122, 0.15),
        "tee": short,
        "polo": rng.uniform(0.30, 0.38),
        "jersey": rng.choice([short, rng.uniform(0.125, 0.15)], p=[0.7, 0.3]),
        "shirt": rng.choice([long, rng.uniform(0.3, 0.4), rng.uniform(0.44, 0.55)], p=[0.62, 0.23, 0.15]),
        "blouse": rng.choice([long, rng.uniform(0.25, 0.55)]),
    }.get(kind, rng.choice([long, rng.uniform(0.42, 0.6)], p=[0.78, 0.22]))
    if outer:
        sleeve = sleeve if sleeve < 0.4 else min(sleeve, WRIST - 0.01)
    neck = {
        "tee": _pick(rng, {"crew": 6, "vee": 2.5, "scoop": 1.5}),
        "tank": "scoop",
        "jersey": _pick(rng, {"crew": 1, "vee": 1}),
        "shirt": "collar",
        "polo": "collar",
        "blouse": _pick(rng, {"collar": 2, "vee": 2, "crew": 1}),
        "turtleneck": "high",
        "hoodie": "crew",
    }.get(kind, _pick(rng, {"crew": 6, "vee": 2, "scoop": 0.6 if not male else 0}))
    cropped = not male and not tucked and rng.random() < 0.08
    bottom = waist - 0.03 if tucked else rng.uniform(-0.22, -0.2) if cropped else rng.uniform(-0.385, -0.30)
    loose = (
        rng.uniform(0.0, 1.0) ** 1.3 if kind in ("tank", "tee", "longsleeve", "turtleneck") else rng.uniform(0.25, 1.0)
    )
    loose = {"hoodie": 0.5 + 0.5 * loose, "street": 0.4 + 0.6 * loose}.get(kind if kind == "hoodie" else style, loose)
    loose = min(loose, 0.2) if outer or tucked else loose
    plainness = {"tee": 0.5, "sweater": 0.4, "turtleneck": 0.65, "hoodie": 0.65, "shirt": 0.35, "tank": 0.55}.get(
        kind, 0.35
    )
    plainness = 0.55 if style == "formal" else plainness
    details = {neck}
    if kind in ("tee", "hoodie", "longsleeve", "tank") and rng.random() < 0.5:
        details.add("print")
    if kind == "jersey":
        details |= {"number"}
    if kind == "hoodie" and rng.random() < 0.4:
        details.add("zip")
    if kind == "hoodie" and rng.random() < 0.18 and not outer:
        details.add("hood_up")
    if kind in ("sweater", "turtleneck", "hoodie", "longsleeve"):
        details.add("ribbed")
    if kind in ("shirt", "polo", "blouse") and rng.random() < 0.5:
        details.add("pocket")
    if kind == "shirt" and not tucked and not outer and rng.random() < 0.2:
        details.add("open")
    if tucked:
        details.add("tucked")
    sizes = {"sleeve": float(sleeve), "bottom": bottom, "loose": loose, "depth": rng.uniform(0.04, 0.095)}
    return Garment(kind, sample_fabric(rng, kind, plainness), sizes, frozenset(details))


def _trousers(rng, style, male, waist, tucked, top):
    kind = _pick(rng, BOTTOM_ODDS[style])
    if kind == "leggings" and male and rng.random() < 0.7:
        kind = "shorts"
    end = {
        "shorts": rng.uniform(-0.77, -0.56 if not male else -0.62),
        "cropped": rng.uniform(-1.1, -0.93),
    }.get(kind, rng.uniform(-1.172, -1.14))
    width = {
        "wide": rng.uniform(0.025, 0.065),
        "cargo": rng.uniform(0.015, 0.04),
        "track": rng.uniform(0.004, 0.03),
        "jeans": rng.choice([rng.uniform(0.0, 0.01), rng.uniform(0.01, 0.035)]),
        "chinos": rng.uniform(0.004, 0.02),
        "shorts": rng.uniform(0.002, 0.04),
        "slim": 0.002,
        "leggings": 0.0,
    }.get(kind, rng.uniform(0.004, 0.025))
    loose = {"leggings": 0.0, "slim": 0.1, "wide": 0.9, "cargo": 0.9}.get(kind, rng.uniform(0.2, 0.7))
    upper = waist if tucked else max(top.sizes["bottom"] + 0.06, waist - 0.2)
    upper = waist if top.sizes["bottom"] > -0.25 else upper
    details = set()
    if kind in ("jeans", "chinos", "slim", "cargo", "wide", "cropped", "shorts"):
        details.add("pockets")
    if kind in ("track", "leggings") and rng.random() < 0.6:
        details.add("side_stripe")
    if rng.random() < 0.15 and kind in ("jeans", "chinos") and not male:
        end = rng.uniform(-1.12, -1.05)
    if kind == "jeans" and rng.random() < 0.25:
        details.add("turn_up")
    sizes = {"top": upper, "end": end, "width": float(width), "loose": loose, "waist": waist, "tucked": float(tucked)}
    return Garment(kind, sample_fabric(rng, kind, 0.75), sizes, frozenset(details))


def _skirt(rng, waist, tucked):
    kind = _pick(rng, {"short_skirt": 3, "pleated_skirt": 1.5, "long_skirt": 2})
    end = rng.uniform(-1.1, -0.84) if kind == "long_skirt" else rng.uniform(-0.76, -0.57)
    flare = rng.uniform(0.0, 0.05) if rng.random() < 0.35 and kind != "pleated_skirt" else rng.uniform(0.05, 0.16)
    sizes = {"top": waist, "end": end, "flare": flare, "waist": waist, "tucked": float(tucked), **_pleats(rng, kind)}
    return Garment(kind, sample_fabric(rng, kind, 0.35), sizes)


def _pleats(rng, kind):
    if kind == "pleated_skirt":
        return {"pleats": float(rng.integers(14, 24)), "depth": rng.uniform(0.008, 0.014)}
    return {"pleats": float(rng.integers(4, 10)), "depth": rng.uniform(0.004, 0.016)}


def _dress(rng, outer):
    kind = _pick(rng, {"short_dress": 4, "long_dress": 3, "shirt_dress": 1.5})
    end = rng.uniform(-1.14, -0.85) if kind == "long_dress" else rng.uniform(-0.78, -0.56)
    sleeve = rng.choice([rng.uniform(0.118, 0.15), rng.uniform(0.25, 0.4), WRIST - 0.02], p=[0.42, 0.33, 0.25])
    neck = "collar" if kind == "shirt_dress" else _pick(rng, {"crew": 1, "vee": 1.3, "scoop": 1.3})
    sizes = {
        "sleeve": float(sleeve),
        "waist": rng.uniform(-0.235, -0.165),
        "end": end,
        "flare": rng.uniform(0.015, 0.17),
        "depth": rng.uniform(0.04, 0.1),
        "loose": 0.1 if outer else rng.uniform(0.0, 0.4),
        **_pleats(rng, kind),
    }
    details = {neck} | ({"sash"} if rng.random() < 0.35 else set())
    return [Garment(kind, sample_fabric(rng, kind, 0.3), sizes, frozenset(details))]


def _outer(rng, style, worn):
    odds = {
        "casual": {"jacket": 3, "denim_jacket": 2, "cardigan": 2, "hooded_jacket": 1.5, "vest": 0.7, "blazer": 0.7},
        "formal": {"blazer": 6, "coat": 1.5, "cardigan": 1, "vest": 1},
        "winter": {"coat": 4, "puffer": 3, "jacket": 1.5, "hooded_jacket": 1.5},
        "street": {"jacket": 2, "denim_jacket": 2, "hooded_jacket": 2, "puffer": 1},
        "dressed": {"cardigan": 3, "blazer": 1.5, "coat": 1.5, "denim_jacket": 1.5},
    }.get(style, {"hooded_jacket": 1, "jacket": 1})
    kind = _pick(rng, odds)
    is_open = rng.random() < {"puffer": 0.4, "coat": 0.5, "cardigan": 0.85, "vest": 0.5}.get(kind, 0.75)
    bottom = {
        "coat": rng.uniform(-0.9, -0.6),
        "blazer": rng.uniform(-0.43, -0.38),
        "denim_jacket": rng.uniform(-0.34, -0.28),
        "puffer": rng.uniform(-0.42, -0.3),
        "vest": rng.uniform(-0.34, -0.27),
    }.get(kind, rng.uniform(-0.42, -0.31))
    details = {"open" if is_open else "closed"}
    if kind in ("jacket", "denim_jacket", "coat", "vest", "puffer"):
        details.add("pockets")
    if (kind == "puffer" and rng.random() < 0.4) or kind == "hooded_jacket":
        details.add("hood")
    if kind == "coat":
        details.add(_pick(rng, {"lapels": 2, "hood": 0.6, "collar": 1}))
        if not is_open and rng.random() < 0.4:
            details.add("sash")
    if kind == "blazer":
        details.add("lapels")
    if kind in ("jacket", "denim_jacket"):
        details.add("collar")
    sizes = {
        "sleeve": 0.2 if kind == "vest" else WRIST - rng.uniform(0.0, 0.035),
        "bottom": bottom,
        "gap": rng.uniform(0.012, 0.05) if is_open else -1.0,
        "spread": rng.uniform(0.05, 0.35),
        "flare": rng.uniform(0.02, 0.1),
        "loose": rng.uniform(0.2, 1.0),
    }
    if kind == "vest":
        sizes["sleeve"] = rng.uniform(0.145, 0.165)
    fabric = sample_fabric(rng, kind, 0.9 if kind in ("blazer", "coat", "puffer") else 0.72)
    trousers = next((g for g in worn if g.kind in ("chinos", "slim", "wide")), None)
    if kind == "blazer" and trousers is not None and rng.random() < 0.55:
        fabric = trousers.fabric  # a suit
    return Garment(kind, fabric, sizes, frozenset(details))


def _shoes(rng, style, male, worn):
    lower = next(g for g in worn if g.kind in BOTTOMS + SKIRTS + DRESSES)
    odds = {
        "casual": {"sneakers": 5, "ankle_boots": 1.5, "flats": 1.5, "boots": 0.4},
        "formal": {"flats": 6, "ankle_boots": 2},
        "sport": {"sneakers": 1},
        "winter": {"ankle_boots": 3, "boots": 2.5, "sneakers": 1.5},
        "summer": {"sneakers": 3, "sandals": 3, "flats": 1.5},
        "street": {"sneakers": 5, "ankle_boots": 1},
        "dressed": {"flats": 3, "sandals": 2, "boots": 1.2, "ankle_boots": 1.2, "sneakers": 1},
    }[style]
    kind = _pick(rng, odds)
    covered = lower.kind in BOTTOMS and lower.sizes["end"] < -1.0
    if kind == "boots" and (male or (covered and lower.kind not in ("slim", "leggings", "jeans"))):
        kind = "ankle_boots"
    if kind == "boots" and covered and lower.sizes["width"] > 0.01:
        kind = "ankle_boots"
    height = {
        "sneakers": rng.choice([0.09, rng.uniform(0.11, 0.14)], p=[0.8, 0.2]),
        "flats": rng.uniform(0.068, 0.085),
        "sandals": 0.07,
        "ankle_boots": rng.uniform(0.13, 0.17),
        "boots": rng.uniform(0.24, 0.40),
    }[kind]
    sole = {"sneakers": rng.uniform(0.02, 0.036), "flats": rng.uniform(0.008, 0.02)}.get(
        kind, rng.uniform(0.015, 0.035)
    )
    result = []
    if kind in ("sneakers", "ankle_boots") and not covered and rng.random() < 0.75:
        tall = rng.choice([rng.uniform(0.1, 0.17), rng.uniform(0.2, 0.4)], p=[0.75, 0.25])
        result.append(Garment("socks", sample_fabric(rng, "socks", 0.7), {"height": max(float(tall), height + 0.02)}))
    fabric = sample_fabric(rng, kind, 0.9)
    sizes = {"height": float(height), "sole": float(sole), "over": float(kind == "boots")}
    return [*result, Garment(kind, fabric, sizes)]


def _fastened(rng, style, male, worn):
    """Belt and tie: worn below what is worn outside."""
    result = []
    trousers = next((g for g in worn if g.kind in BOTTOMS), None)
    belted = trousers is not None and trousers.sizes["tucked"] and trousers.kind not in ("track", "leggings")
    if belted and rng.random() < 0.7:
        sizes = {"top": trousers.sizes["waist"] - 0.004, "width": rng.uniform(0.028, 0.042)}
        result.append(Garment("belt", sample_fabric(rng, "belt", 1.0), sizes))
    collared = any("collar" in g.details and g.kind == "shirt" and "open" not in g.details for g in worn)
    if style == "formal" and male and collared and rng.random() < 0.55:
        sizes = {"length": rng.uniform(0.3, 0.36), "width": rng.uniform(0.018, 0.032)}
        result.append(Garment("tie", sample_fabric(rng, "tie", 0.3), sizes))
    return result


def _extras(rng, style, male, years, worn):
    kinds = {g.kind for g in worn}
    hooded = any("hood_up" in g.details for g in worn)
    result = []

    def put(kind, plainness, **sizes):
        result.append(Garment(kind, sample_fabric(rng, kind, plainness), sizes))

    if not hooded and rng.random() < {"winter": 0.4, "sport": 0.03, "summer": 0.03}.get(style, 0.1):
        put("scarf", 0.35, thickness=rng.uniform(0.022, 0.038), tails=rng.choice([0.0, rng.uniform(0.15, 0.4)]))
    headwear = {
        "winter": {"beanie": 0.4, "brim_hat": 0.06},
        "sport": {"cap": 0.35},
        "summer": {"cap": 0.2, "brim_hat": 0.22},
        "street": {"cap": 0.35, "beanie": 0.2},
        "formal": {"brim_hat": 0.1},
    }.get(style, {"beanie": 0.05, "cap": 0.07, "brim_hat": 0.05})
    if not male:
        headwear["headscarf"] = 0.06
    choice = rng.random()
    for kind, odds in headwear.items():
        if choice < odds and not hooded and not (kind == "headscarf" and "scarf" in {g.kind for g in result}):
            put(kind, 0.8, brim=rng.uniform(0.045, 0.085), backwards=float(kind == "cap" and rng.random() < 0.12))
            break
        choice -= odds
    eyes = rng.random()
    if eyes < 0.2 + 0.15 * (years > 50):
        put("glasses", 1.0, size=rng.uniform(0.85, 1.2), squareness=rng.uniform(2, 6), wire=rng.uniform(0.0011, 0.0028))
    elif eyes > (0.85 if style in ("summer", "street") else 0.96):
        put(
            "sunglasses", 1.0, size=rng.uniform(1.0, 1.3), squareness=rng.uniform(2, 5), wire=rng.uniform(0.0015, 0.003)
        )
    carried = rng.random()
    if carried < 0.09 and "headscarf" not in {g.kind for g in result}:
        put("backpack", 0.7, size=rng.uniform(0.8, 1.15))
    elif carried < (0.19 if male else 0.27):
        put("shoulder_bag", 0.8, size=rng.uniform(0.6, 1.1), side=rng.choice([-1.0, 1.0]))
    if rng.random() < 0.15:
        put("watch", 1.0, side=rng.choice([-1.0, 1.0]))
    if not male and "scarf" not in {g.kind for g in result} and rng.random() < 0.12 and "turtleneck" not in kinds:
        put("necklace", 1.0, length=rng.uniform(0.0, 0.06))
    return result
