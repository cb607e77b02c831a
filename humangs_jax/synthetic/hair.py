"""Draws haircuts and beards at random, and builds their surfaces: shells, tubes, buns and tails.

Hats and hoods are built by the same functions. A hairline is a template height for each azimuth
around the skull (0 in front, pi at the nape), the same on both sides.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.synthetic import surfaces
from humangs_jax.synthetic.anatomy import Anatomy, Joint, Vector, smoothstep
from humangs_jax.synthetic.outfits import HEADWEAR, drawn, row
from humangs_jax.synthetic.surfaces import (
    Boundaries,
    Field,
    Points,
    Surface,
    around,
    blurred,
    boundaries,
    cut,
    rigid,
    ripples,
    smooth,
)
from humangs_jax.synthetic.tailoring import finished, nearest_weights

CUTS = {
    "cropped": (0.22, 0.03, (0.005, 0.010)),
    "short": (0.26, 0.10, (0.012, 0.022)),
    "quiff": (0.10, 0.01, (0.010, 0.016)),
    "curly": (0.08, 0.12, (0.024, 0.045)),
    "afro": (0.05, 0.05, (0.045, 0.085)),
    "buzz": (0.09, 0.01, 0.008),
    "bald": (0.07, 0.004, 0.008),
    "bob": (0.012, 0.17, (0.012, 0.024)),
    "long": (0.025, 0.25, (0.010, 0.022)),
    "ponytail": (0.02, 0.11, 0.008),
    "bun": (0.03, 0.08, 0.008),
    "braid": (0.01, 0.05, 0.008),
}
"""Cuts by name: odds for men, odds for women, and thickness or its range, metres."""
LONG_CUTS = ("bob", "long")
"""Cuts that fall over the ears."""
_SHELLS = {
    "curly": (0.3, 0.035, 0),
    "afro": (0.1, 0.05, 0),
    "quiff": (0.2, 0.05, 1),
    "short": (0.22, 0.035, 1),
}
"""Short cuts by name: height of the bumps of hair as a share of the thickness, width of the bumps,
metres, and 1 if the hair is parted, else 0.
"""
_TAILS = {"ponytail": ((0.2, 0.38), 0.0), "braid": ((0.28, 0.42), 0.028)}
"""Tails by name: range of the length, and distance between knots (0 for none), metres."""
_FRINGES = {"straight": 0.28, "parted": 0.34, "side": 0.38}
"""Fringes of longer hair, and their odds."""
BEARDS = {"none": 0.5, "stubble": 0.2, "moustache": 0.05, "goatee": 0.09, "full": 0.16}
"""Beards, and their odds for men."""


@dataclasses.dataclass(frozen=True)
class Haircut:
    """The hair and the beard of a person."""

    cut: str
    """Name of the cut, one of CUTS."""
    fringe: str
    """Kind of fringe, one of _FRINGES."""
    side: float
    """Side of the parting, +1 for left or -1 for right. The fringe is mirrored for -1."""
    thickness: float
    """Thickness of the hair on the scalp, metres."""
    bottom: float
    """Template height where long hair ends."""
    wave: float
    """Height of the waves of long hair, metres."""
    receding: float
    """Shift of the hairline upwards, metres."""
    beard: str
    """Kind of beard, one of BEARDS."""
    beard_length: float
    """Length of the beard, metres."""
    grain: float
    """Contrast of single strands, 0 to 1."""


def sample_haircut(rng: np.random.Generator, male: bool, years: float, worn: set[str]) -> Haircut:
    """Draws a haircut and a beard. worn: kinds of garments; the cut fits under their headwear."""
    # what a hat would not leave room for is not drawn, or is thinner
    headwear = bool(worn & set(HEADWEAR))
    odds = {name: value[0 if male else 1] for name, value in CUTS.items()}
    if male and years > 45:
        odds["bald"] *= 3.0
    if headwear:
        odds |= dict.fromkeys(("curly", "afro", "quiff", "bun"), 0)
    cut = drawn(rng, odds)
    thickness = row(rng, {name: value[2] for name, value in CUTS.items()}, cut)
    if headwear:
        thickness = min(thickness, 0.010)
    # bottom and waves matter to long hair only
    if cut == "bob":
        bottom = rng.uniform(0.15, 0.2)
    else:
        bottom = rng.uniform(-0.17, 0.1)
    wave = rng.choice([rng.uniform(0.002, 0.004), rng.uniform(0.006, 0.014)], p=[0.55, 0.45])
    if male:
        receding = rng.uniform(-0.004, 0.012 + 0.012 * (years > 45))
    else:
        receding = rng.uniform(-0.006, 0.004)
    beard = "none"
    if male and years > 17:
        beard = drawn(rng, BEARDS)
    long = 0.35 if rng.random() < 0.8 else 1.0
    fringe, side = drawn(rng, _FRINGES), float(rng.choice([-1, 1]))
    beard_length = rng.uniform(0.0025, 0.004) + long * rng.uniform(0.0, 0.016)
    grain = rng.uniform(0.5, 0.95)
    return Haircut(
        cut,
        fringe,
        side,
        float(thickness),
        bottom,
        float(wave),
        receding,
        beard,
        beard_length,
        grain,
    )


SKULL = np.asarray([0.0, 0.345, 0.02])
"""Middle of the skull in template coordinates."""
_CROWN = 0.4356
"""Height of the crown, template coordinates."""
_NECK_HEIGHT = 0.189
"""Height of the neck, template coordinates."""
_SKULL_RADIUS = 0.09
"""Radius of the skull, metres. An angle times this is a length around the skull."""
_BRIM = 0.385
"""Height of the hairline at the forehead, above which hair is a dome, template coordinates."""
_CHIN = 0.24
"""Height of the chin, template coordinates. Above is the head, below are neck and shoulders."""
_NAPE = 0.23
"""Height of the nape, below which hair begins to stand off the neck, template coordinates."""
_SHOULDERS = 0.17
"""Height of the shoulders beside the neck, below which hair lies on them, template coordinates."""
_LOWEST = -0.3
"""Height of the lowest silhouette below falling hair, template coordinates."""
_FACE = 0.125
"""Depth (z) in front of which there is only the middle of the face, template coordinates."""
_EAR_SIDE = 0.0735
"""Distance from the middle (|x|) beyond which there are only ears, template coordinates."""
_EAR_HEIGHTS = (0.26, 0.36)
"""Heights between which the ears lie, template coordinates."""
_HEAD_SIDE = 0.1
"""Distance from the middle (|x|) within which the head lies, template coordinates."""
_BACK_SIDE = 0.12
"""Distance from the middle (|x|) within which hair lies on the back, template coordinates."""
_FRONT_HEM = 0.15
"""Height where hair ends on the shoulders in front, template coordinates."""
_HEM_AZIMUTHS = (0, 1.2, 1.75, 2.2, np.pi)
"""Azimuths of the corners of the hem of long hair, radians. In order: middle and end of the front,
behind the ear, beginning and middle of the back.
"""

SHORT_LINE = (
    [0.0, 0.55, 0.95, 1.2, 1.36, 1.42, 1.86, 1.95, 2.3, 3.15],
    [0.392, 0.388, 0.368, 0.325, 0.312, 0.353, 0.353, 0.275, 0.234, 0.226],
)
"""The hairline: azimuths, and heights at them. In order: forehead, temple, sideburn before the ear,
above and behind the ear, nape.
"""
CAP_LINE = ([0.0, 0.8, 1.5, 2.2, 3.15], [0.375, 0.37, 0.345, 0.325, 0.315])
"""The edge of a cap: azimuths, and heights at them."""

_FRINGE_LINES = {
    "straight": (
        [-3.15, -1.2, -1.12, -0.9, -0.5, 0.0, 0.5, 0.9, 1.12, 1.2, 3.15],
        [-9.0, -9.0, 0.30, 0.362, 0.384, 0.388, 0.384, 0.362, 0.30, -9.0, -9.0],
    ),
    "parted": (
        [-3.15, -1.16, -1.08, -0.85, -0.5, -0.1, 0.0, 0.1, 0.5, 0.85, 1.08, 1.16, 3.15],
        [-9.0, -9.0, 0.30, 0.35, 0.388, 0.414, 0.419, 0.414, 0.388, 0.35, 0.30, -9.0, -9.0],
    ),
    "side": (
        [-3.15, -1.2, -1.1, -0.8, -0.3, 0.25, 0.55, 0.75, 0.95, 1.1, 1.18, 3.15],
        [-9.0, -9.0, 0.30, 0.352, 0.374, 0.402, 0.415, 0.405, 0.37, 0.30, -9.0, -9.0],
    ),
}
"""Edges of fringes by name: signed azimuths, and the heights above which longer hair covers the
face. A straight fringe is blunt, a parted one is parted in the middle, and a side one is combed to
the right.
"""


def style(
    rng: np.random.Generator, anatomy: Anatomy, haircut: Haircut, over: float = 0.0
) -> list[Surface]:
    """Builds the surfaces of a haircut and a beard.

    over: how far the clothes under the hair stand off the skin, metres.
    """
    kind, parts = haircut.cut, []
    # long hair falls as a tube, short hair is a shell of the scalp
    if kind in LONG_CUTS:
        opening, wave = _fringe(rng, haircut), haircut.wave
        parts.append(
            falling_tube(
                rng, anatomy, haircut.thickness, haircut.bottom, opening, wave=wave, over=over
            )
        )
    elif kind not in ("buzz", "bald"):
        bumps, size, parted = _SHELLS.get(kind, (0.12, 0.035, 1))
        quiff = 0.0
        if kind == "quiff":
            quiff = rng.uniform(0.012, 0.026)
        side, shift = haircut.side * parted, haircut.receding
        parts.append(
            scalp_shell(
                rng, anatomy, haircut.thickness, bumps, size, shift=shift, quiff=quiff, side=side
            )
        )
    if kind in _TAILS:
        length, knots = _TAILS[kind]
        parts.append(_tail(rng, anatomy, rng.uniform(*length), knots))
    if kind == "bun":
        parts.append(_bun(anatomy, rng.uniform(0.032, 0.05), rng.uniform(0.0, 1.1)))
    if haircut.beard in ("moustache", "goatee", "full"):
        parts.append(_beard(rng, anatomy, haircut.beard_length, haircut.beard))
    return parts


_Opening = Callable[[Field, Field], Field]
"""A function of azimuths in [-pi, pi) and template heights, both (n,). It returns (n,) numbers that
are positive where hair or cloth is, and negative where the face is free.
"""


def _fringe(rng: np.random.Generator, haircut: Haircut) -> _Opening:
    """Returns the `_Opening` of a fringe. Its values are heights above the edge of the fringe,
    metres.
    """
    angles, heights = (np.asarray(x) for x in _FRINGE_LINES[haircut.fringe])
    phase = rng.uniform(0, 6.28, 3)

    def above(azimuths, height):
        """Returns the height of points above the edge, which is wavy."""
        a = azimuths * haircut.side
        waves = zip((0.0035, 0.0025, 0.003), (23, 41, 9), phase, strict=True)
        return (
            height
            - np.interp(a, angles, heights)
            - sum(size * np.sin(n * a + p) for size, n, p in waves)
        )

    return above


def ears(template: Points) -> np.ndarray:
    """Returns for each vertex whether it is on the outer part of an ear, (n,)."""
    x, y, z = np.abs(template[:, 0]), template[:, 1], template[:, 2]
    return (x > 0.0765) & (y > 0.265) & (y < 0.36) & (z < 0.03)


def above_line(template: Points, line: tuple, shift: float = 0.0) -> Field:
    """Returns the height of each point above a hairline, (n,), metres in template coordinates.
    Points that are not on the head get -1.

    line: azimuths and heights. shift: metres by which the line is raised.
    """
    # 0 in front, pi at the nape
    azimuths = np.abs(np.arctan2(np.abs(template[:, 0]), template[:, 2] - SKULL[2]))
    above = template[:, 1] - np.interp(azimuths, *line) - shift
    return np.where((template[:, 1] > 0.2) & (np.abs(template[:, 0]) < 0.12), above, -1.0)


def scalp_shell(
    rng: np.random.Generator,
    anatomy: Anatomy,
    thickness: float,
    bumps: float,
    size: float = 0.05,
    hat: bool = False,
    shift: float = 0.0,
    crown: float = 0.0,
    quiff: float = 0.0,
    side: float | int = 0,
) -> Surface:
    """Builds short hair or a hat: the scalp, moved outwards by a thickness.

    The thickness is in metres, and gets smaller towards the hairline.

    bumps: height of the bumps as a share of the thickness. size: width of the bumps, metres. hat:
    whether to make a hat, with a straight edge that stands off. shift: metres by which the hairline
    is raised. crown, quiff: metres by which the top and the front rise further. side: +1 for a
    parting on the left of the head, -1 on the right, 0 for none.
    """
    template = anatomy.skin.template
    above = above_line(template, CAP_LINE if hat else SHORT_LINE, shift)
    rim = 0.011 if hat else 0.0025
    # a hairline is irregular, the edge of a hat is not
    if not hat:
        above = above + 0.0035 * ripples(rng, template, 0.018) * (np.abs(template[:, 0]) < 0.07)
    surface = cut(anatomy.skin.with_attributes(above=above), above)
    # smooth normals keep the thickness even where the head is not
    normals = surfaces.unit(smooth(surface.attributes["normals"], surface.faces, 8))
    full = smoothstep(-0.002, 0.022, surface.attributes["above"])
    grown = thickness * full * (1 + bumps * ripples(rng, surface.template, size))
    grown = np.maximum(grown, rim) + 0.3 * rim
    base = smooth(surface.vertices, surface.faces, 3, keep_hems=True)
    x, y, z = surface.template.T
    top = smoothstep(0.385, 0.425, y)
    # a parting is a groove, and the hair on its far side is fuller
    if side:
        parting = np.exp(-(((x - side * 0.035) / 0.009) ** 2)) * top * (z > -0.02)
        grown = (
            grown
            * (1 - 0.55 * parting)
            * (1 + 0.25 * top * np.clip(-side * (x - side * 0.035) / 0.06, -1, 1))
        )
    points = base + grown[:, None] * normals
    raised = quiff * smoothstep(0.02, 0.085, z) * smoothstep(0.375, 0.41, y)
    points = points + raised[:, None] * np.asarray([0.0, 0.95, 0.35])
    points[:, 1] += crown * smoothstep(0.39, 0.42, y)
    return finished(surface.moved(points), 2, 0.006)


def falling_tube(
    rng: np.random.Generator,
    anatomy: Anatomy,
    thickness: float,
    bottom: float,
    opening: _Opening,
    wave: float = 0.004,
    ends: float = _FRONT_HEM,
    over: float = 0.0,
) -> Surface:
    """Builds long hair, a hood or a headscarf: the enlarged skull, from which a tube falls.

    thickness: metres by which the skull is enlarged. bottom: template height where the tube ends at
    the back. opening: where the face is free. wave: height of waves, metres. ends: template height
    where the tube ends in front. over: how far the clothes under the tube stand off the skin,
    metres.
    """
    to_rest, center = _skull(anatomy)
    head, back = _silhouettes(anatomy)
    scale = 1 + thickness / _SKULL_RADIUS
    top = _CROWN + (_CROWN - SKULL[1]) * (scale - 1)
    row_height, angle, faces = surfaces.tube(_ring_heights(top, bottom), surfaces.circle(60))
    height = to_rest(row_height)

    # the head is enlarged about the middle of the skull: `inner` are heights before that
    inner = center[1] + (height - center[1]) / scale
    summit = center[1] + (to_rest(top) - center[1]) / scale
    brim = to_rest(_BRIM)
    # above the brim it is an ellipsoid, which closes at the summit
    risen = np.clip((inner - brim) / (summit - brim), 0, 1)
    dome = np.sqrt(np.clip(1 - risen**2, 0, 1))
    radius = scale * dome * head.radius(np.minimum(inner, brim), angle)

    # below the head it lies on the back, 34 mm above what is worn there
    distance = (0.034 + over) * smoothstep(-_NAPE, -_SHOULDERS, -row_height)
    on_back = back.radius(height, angle) + distance
    radius = np.maximum(radius, on_back * (row_height < _CHIN))

    # waves are about 0.4 rad wide and 0.3 m long; they begin at the middle of the skull
    waves = ripples(rng, around(3, angle, height * 4), 1.2)
    radius = radius + smoothstep(0.0, 0.12, SKULL[1] - row_height) * wave * waves

    # its paint is that of a cylinder around the skull
    vertices = around(radius, angle, height, center[[0, 2]]).astype(np.float32)
    surface = Surface(vertices, faces, _falling_weights(anatomy, vertices, row_height))
    template = around(_SKULL_RADIUS, angle, row_height, SKULL[[0, 2]]).astype(np.float32)
    cloth = template - np.asarray([0, 0, SKULL[2]], np.float32)
    surface = surface.painted(template, cloth, _SKULL_RADIUS)

    # the opening for the face and the hem are cut
    above_hem = row_height - _hem(rng, angle, bottom, ends)
    surface = cut(surface, np.minimum(opening(_signed(angle), row_height), above_hem))
    softened = smooth(surface.vertices, surface.faces, 1, keep_hems=True)
    return finished(surface.moved(softened), 2, 0.008)


def _silhouettes(anatomy: Anatomy) -> tuple[Boundaries, Boundaries]:
    """Returns two stacks of silhouettes: of the head, and of neck, shoulders and back. All centres
    are on the vertical axis through the middle of the skull.

    The silhouettes of the head leave out the ears and the middle of the face. Downwards their radii
    shrink by at most 0.25 m per metre, like hair that hangs from the widest part of the head.
    """
    x, y, z = anatomy.skin.template.T
    side = np.abs(x)
    on_ear = (side > _EAR_SIDE) & (y > _EAR_HEIGHTS[0]) & (y < _EAR_HEIGHTS[1])
    on_head = (y > _CHIN) & (side < _HEAD_SIDE) & ~on_ear & (z < _FACE)
    on_back = (side < _BACK_SIDE) & (y < _CHIN) & (y > _LOWEST - 0.05)

    # slices are thinner on the head, and the highest one is where the crown still has an area
    to_rest, center = _skull(anatomy)
    levels = np.concatenate(
        [np.arange(_LOWEST, _CHIN, 0.02), np.linspace(_CHIN, _CROWN - 0.0015, 24)]
    )
    axis = np.repeat(center[None, [0, 2]], len(levels), 0)

    def measured(chosen, window):
        """Returns the silhouettes of chosen vertices. window: half a slice's thickness, metres."""
        points = anatomy.skin.vertices[chosen]
        return boundaries(points[:, 1], points[:, [0, 2]], to_rest(levels), axis, window)

    head = surfaces.hanging(blurred(measured(on_head, 0.012)), 0.25)
    back = blurred(measured(on_back, 0.02), 2)
    return head, back


def _ring_heights(top: float, bottom: float) -> Float[np.ndarray, " r"]:
    """Returns the template heights of the rings of a dome and of the tube that falls from it, from
    the top down. The dome ends at the middle of the skull. The tube ends just above `bottom`, or
    above 0.3 if `bottom` is higher.
    """
    dome = SKULL[1] + (top - SKULL[1]) * np.sin(np.linspace(np.pi / 2, 0, 12))
    tube = np.arange(SKULL[1] - 0.02, min(bottom, 0.3), -0.022)
    return np.concatenate([dome, tube])


def _signed(angle: Field) -> Field:
    """Returns angles (n,) as azimuths in [-pi, pi), radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _hem(rng: np.random.Generator, angle: Field, bottom: float, ends: float) -> Field:
    """Returns the template heights (n,) of an irregular hem at angles (n,). bottom, ends: heights
    of the hem at the back and in front.
    """
    corners = [ends, ends, max(bottom, ends), bottom, bottom]
    even = np.interp(np.abs(_signed(angle)), _HEM_AZIMUTHS, corners)
    return even + 0.012 * ripples(rng, around(5, angle, 0 * angle), 1.5)


def _bun(anatomy: Anatomy, radius: float, elevation: float) -> Surface:
    """Builds a ball of hair on the back of the head. radius: metres. elevation: angle of the ball
    above the horizontal, radians.
    """
    direction = np.asarray([0, np.sin(elevation), -np.cos(elevation)])
    center = _skull(anatomy)[1] + direction * (0.095 + 0.55 * radius)
    directions, faces = surfaces.ball(12, 20)
    vertices = center + directions * (radius * np.asarray([1.0, 0.9, 0.85]))
    return _painted(rigid(vertices, faces, Joint.HEAD, len(anatomy.joints)))


def _tail(rng: np.random.Generator, anatomy: Anatomy, length: float, knots: float) -> Surface:
    """Builds a tapering tail of hair that hangs down the back. length: metres.

    knots: distance between the knots of a braid, metres; 0 for a tail without knots.
    """
    start = np.asarray([0, _skull(anatomy)[0](0.36), anatomy.joints[Joint.HEAD, 2] - 0.105])
    rows = 40 if knots else 16
    columns = 14
    t = np.linspace(0, 1, rows)
    sway = 0.012 * np.sin(3 * t + rng.uniform(0, 6)) * t
    line = start + np.stack(
        [sway, -length * t**1.3, -0.05 * np.sin(np.pi * np.minimum(t * 1.6, 1) / 1.3) - 0.01], -1
    )
    radius = np.interp(t, [0, 0.12, 0.4, 0.8, 1], [0.016, 0.026, 0.030, 0.020, 0.004])
    if knots:
        radius = 0.85 * radius * (1 + 0.22 * np.cos(2 * np.pi * length * t / knots))
    vertices, faces = surfaces.sweep(line, np.asarray([1.0, 0.0, 0.0]), radius[:, None], columns)
    weights = np.zeros((len(vertices), anatomy.skin.weights.shape[1]), np.float32)
    follow = smoothstep(0.1, 1.0, np.repeat(t, columns)) * 0.8
    weights[:, Joint.HEAD], weights[:, Joint.SPINE3] = 1 - follow, follow
    return _painted(Surface(vertices, faces, weights))


def beard_field(template: Points, kind: str) -> Field:
    """Returns a field (n,) that is positive where a beard of a kind grows."""
    x, y, z = np.abs(template[:, 0]), template[:, 1], template[:, 2]
    lips = 1 - (x / 0.027) ** 2 - ((y - 0.262) / 0.0115) ** 2
    cheek = 0.279 + 0.30 * np.maximum(x - 0.03, 0) - 0.1 * np.maximum(0.02 - x, 0)
    field = np.minimum.reduce([cheek - y, y - 0.2, z - 0.012, -0.02 * lips])
    if kind == "goatee":
        field = np.minimum(field, 0.031 - x)
    if kind == "moustache":
        field = np.minimum.reduce([field, 0.034 - x, y - 0.2625 + 0.25 * np.maximum(x - 0.02, 0)])
    return np.where((y > 0.19) & (x < 0.08) & (z > 0.0), field, -1.0)


def _beard(rng: np.random.Generator, anatomy: Anatomy, thickness: float, kind: str) -> Surface:
    """Builds a beard that gets thinner towards the cheeks. thickness: metres."""
    template = anatomy.skin.template
    field = beard_field(template, kind)
    ragged = np.where(field > -0.5, field + 0.002 * ripples(rng, template, 0.012), -1.0)
    surface = cut(anatomy.skin.with_attributes(above=field), ragged)
    normals = surfaces.unit(smooth(surface.attributes["normals"], surface.faces, 4))
    full = smoothstep(0.0, 0.016, surface.attributes["above"])
    chin = smoothstep(0.25, 0.225, surface.template[:, 1])
    bumps = 1 + 0.25 * ripples(rng, surface.template, 0.02)
    grown = thickness * full * (0.6 + 0.8 * chin) * bumps + 0.0010
    return finished(surface.moved(surface.vertices + grown[:, None] * normals), 2, 0.002)


def _painted(surface: Surface) -> Surface:
    """Adds template and cloth coordinates to hair that is not cut from the scalp.

    Cloth coordinates are positions relative to the middle of the hair. Template coordinates are the
    same positions around `SKULL`.
    """
    flat = surface.vertices - surface.vertices.mean(0)
    return surface.painted(flat + SKULL, flat, _SKULL_RADIUS)


def eyeballs(anatomy: Anatomy) -> Surface:
    """Builds the two eyeballs.

    Their `template` attribute is the unit direction from the middle of the ball.
    """
    parts, (directions, faces) = [], surfaces.ball(14, 22)
    directions = directions.astype(np.float32)
    for joint in (Joint.LEFT_EYE, Joint.RIGHT_EYE):
        center = anatomy.joints[joint]
        lids = np.sort(np.linalg.norm(anatomy.skin.vertices - center, axis=1))[:12]
        eye = rigid(center + directions * lids.mean() * 0.985, faces, joint, len(anatomy.joints))
        parts.append(eye.painted(directions, directions, 1.0))
    return surfaces.join(parts)


def _skull(anatomy: Anatomy) -> tuple[Callable[..., np.ndarray], Vector]:
    """Returns a function and a point (3,), metres. The function maps template heights of head and
    neck to heights of the person at rest. The point is the middle of the person's skull.
    """
    neck = anatomy.joints[Joint.NECK, 1]
    factor = (anatomy.skin.vertices[:, 1].max() - neck) / (_CROWN - _NECK_HEIGHT)

    def to_rest(y):
        return neck + (y - _NECK_HEIGHT) * factor

    return to_rest, np.asarray([0.0, to_rest(SKULL[1]), anatomy.joints[Joint.HEAD, 2] - 0.01])


def _falling_weights(
    anatomy: Anatomy, vertices: Points, template_y: Field
) -> Float[np.ndarray, "n j"]:
    """Returns the skinning weights (n, j) of something that falls from the head. At the top it
    follows the head, further down the nearest skin.

    template_y: template heights of the vertices (n,).
    """
    x, y, _ = anatomy.skin.template.T
    near = np.flatnonzero((np.abs(x) < 0.15) & (y > -0.3) & (y < 0.26))[::2]
    head = np.zeros((len(vertices), anatomy.skin.weights.shape[1]), np.float32)
    head[:, Joint.HEAD] = 1
    own = smoothstep(0.06, 0.25, template_y)[:, None]
    lower = template_y < 0.26
    trunk = head.copy()
    trunk[lower] = nearest_weights(anatomy, vertices[lower], near)
    return (head * own + trunk * (1 - own)).astype(np.float32)
