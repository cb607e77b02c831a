"""What is worn on top and on the feet: hoods, scarves, hats, glasses, bags, necklaces, shoes.

Swept tubes, sheets, boxes and outlines that follow one joint or the nearest skin.
"""

import numpy as np

from humangs_jax.people import hair, tailoring
from humangs_jax.people.anatomy import FLOOR, Anatomy
from humangs_jax.people.fabrics import Material, band, colour, mix, weave
from humangs_jax.people.garments import nearest_weights, rest_height, smooth_weights
from humangs_jax.people.kinematics import HEAD, LEFT_ANKLE, LEFT_EYE, NECK, RIGHT_EYE
from humangs_jax.people.noise import ripples
from humangs_jax.people.outfits import Garment
from humangs_jax.people.surfaces import (
    Outlines,
    Surface,
    ball,
    blurred,
    grid_faces,
    hanging,
    join,
    outlines,
    rigid,
    sweep,
    turn_in_hems,
    unit,
)

RING = 40
"""Points of a ring around neck or head."""


def build(rng: np.random.Generator, anatomy: Anatomy, garment: Garment, ease: float) -> list[tuple[Surface, Material]]:
    """Surfaces and materials of an accessory. ease: distance of the outermost layer from the trunk, metres."""
    kind, sizes = garment.kind, garment.sizes
    cloth = weave(garment.fabric)
    knit = Material(cloth, wrinkles=0.3)
    if kind == "scarf":
        return [(scarf(rng, anatomy, sizes["thickness"], sizes["tails"], ease), knit)]
    if kind == "beanie":
        return [
            (
                hair.scalp_shell(
                    rng, anatomy, rng.uniform(0.014, 0.019), 0.04, hair.CAP_LINE, rim=0.011, crown=rng.uniform(0, 0.03)
                ),
                knit,
            )
        ]
    if kind == "cap":
        crown = hair.scalp_shell(rng, anatomy, 0.016, 0.0, hair.CAP_LINE, rim=0.011, crown=0.008)
        return [
            (
                join([crown, peak(anatomy, sizes["brim"], sizes["backwards"] > 0)]),
                Material(_panelled(cloth), wrinkles=0.05),
            )
        ]
    if kind == "brim_hat":
        crown = hair.scalp_shell(rng, anatomy, 0.017, 0.0, hair.CAP_LINE, rim=0.011, crown=0.05)
        ribbon = _ribboned(cloth, garment.fabric.other)
        return [(join([crown, brim(rng, anatomy, sizes["brim"])]), Material(ribbon, wrinkles=0.05))]
    if kind == "headscarf":
        return [(headscarf(rng, anatomy), knit)]
    if kind in ("glasses", "sunglasses"):
        return glasses(
            anatomy, sizes["size"], sizes["squareness"], sizes["wire"], kind == "sunglasses", garment.fabric.base
        )
    return [(necklace(anatomy, sizes["length"]), Material(_metal(garment.fabric.rng(2)), sheen=0.6))]


def neck_ring(anatomy: Anatomy, lift: float) -> tuple[np.ndarray, np.ndarray]:
    """(RING, 3) rest points around the neck at a lift above the crew neckline, from front over left, and outward directions."""
    template = anatomy.skin.attributes["template"]
    field = tailoring.neckline(template, "crew", 0.0) + lift
    near = np.abs(field) < 0.02
    return _ring(anatomy, near, np.arctan2(template[:, 0], template[:, 2] + 0.005))


def head_ring(anatomy: Anatomy, line: tuple) -> tuple[np.ndarray, np.ndarray]:
    """(RING, 3) rest points around the head at a hairline, from front over left, and outward directions."""
    template = anatomy.skin.attributes["template"]
    near = (np.abs(hair.above_line(template, line)) < 0.012) & (
        (np.abs(template[:, 0]) < 0.078) | (template[:, 1] > 0.357)
    )
    return _ring(anatomy, near, np.arctan2(template[:, 0], template[:, 2] - hair.SKULL[2]))


def _ring(anatomy, near, azimuths):
    """Means of the chosen skin vertices by azimuth, on a smooth closed line."""
    points, azimuths = anatomy.skin.vertices[near], azimuths[near]
    wanted = np.arange(RING) * (2 * np.pi / RING)
    apart = np.abs((azimuths[None] - wanted[:, None] + np.pi) % (2 * np.pi) - np.pi)
    weights = np.exp(-((apart / 0.16) ** 2)) + 1e-9
    ring = weights @ points / weights.sum(1, keepdims=True)
    outwards = ring - ring.mean(0)
    outwards[:, 1] = 0
    return ring, unit(outwards)


def _followed(anatomy, vertices, faces, candidates=None):
    """A surface that moves with the skin nearest to it; its template coordinates are its own, around its middle."""
    if candidates is None:
        template = anatomy.skin.attributes["template"]
        candidates = np.flatnonzero((np.abs(template[:, 0]) < 0.2) & (template[:, 1] > -0.35) & (template[:, 1] < 0.2))
    weights = smooth_weights(nearest_weights(anatomy, vertices, candidates), faces, 6)
    around_middle = vertices - [0, anatomy.joints[NECK, 1] - 0.19, 0]
    return Surface(vertices, faces, weights).painted(around_middle, around_middle, 0.12)


def hood(rng: np.random.Generator, anatomy: Anatomy, up: bool) -> Surface:
    """A hood: over the head, or lying in folds around the neck and on the upper back."""
    if up:
        return hair.falling_tube(rng, anatomy, 0.034, 0.1, _hood_opening, wave=0.004, ends=0.1)
    ring, outwards = neck_ring(anatomy, -0.012)
    azimuth = np.arange(RING) * (2 * np.pi / RING)
    behind = 0.5 - 0.5 * np.cos(azimuth)  # 0 in front, 1 at the nape
    thick = 0.010 + 0.020 * behind + 0.016 * behind**4
    tall = 0.016 + 0.012 * behind + 0.030 * behind**4
    path = ring + outwards * (0.4 * thick + 0.022)[:, None]
    path[:, 1] += 0.012 - 0.030 * behind**4 + 0.004 * ripples(rng, 3 * ring, 0.3)
    rolls = np.stack([tall, thick], -1) * (1 + 0.1 * ripples(rng, 4 * ring, 0.2))[:, None]
    vertices, faces = sweep(
        path, np.tile([0.0, 1.0, 0.0], (RING, 1)) + 0.5 * outwards * behind[:, None] ** 3, rolls, 12, closed=True
    )
    return _followed(anatomy, vertices, faces)


def _hood_opening(sides, height):
    """Positive outside of an oval around the face."""
    return ((sides / 1.05) ** 2 + ((height - 0.31) / 0.096) ** 2 - 1) * 0.05


def _veil_opening(sides, height):
    return ((sides / 0.98) ** 2 + ((height - 0.312) / 0.078) ** 2 - 1) * 0.05


def headscarf(rng: np.random.Generator, anatomy: Anatomy) -> Surface:
    """A scarf around head and neck that leaves the face open."""
    return hair.falling_tube(rng, anatomy, 0.022, 0.06, _veil_opening, wave=0.005, ends=rng.uniform(0.08, 0.13))


def scarf(rng: np.random.Generator, anatomy: Anatomy, thickness: float, tails: float, ease: float) -> Surface:
    """Two turns around the neck; tails: metres that its ends hang down in front, 0 for none."""
    parts = []
    for turn, lift in enumerate((-0.004, 0.022)):
        ring, outwards = neck_ring(anatomy, lift)
        lumps = 1 + 0.16 * ripples(rng, 3 * ring + turn, 0.25)
        path = ring + outwards * (0.75 * thickness + min(ease, 0.015))
        path[:, 1] += 0.014 + 0.006 * np.sin(np.arange(RING) * (2 * np.pi / RING) + turn * 2.1)
        widths = np.stack([1.15 * thickness * lumps, 0.85 * thickness / lumps], -1)
        vertices, faces = sweep(path, np.tile([0.0, 1.0, 0.0], (RING, 1)), widths, 12, closed=True)
        parts.append(_followed(anatomy, vertices, faces))
    if tails > 0:
        ring, _ = neck_ring(anatomy, -0.004)
        for side, length in ((1, tails), (-1, tails * rng.uniform(0.6, 1.0))):
            parts.append(_tail(rng, anatomy, ring[0], side, length, thickness, ease))
    return join(parts)


def _tail(rng, anatomy, start, side, length, thickness, ease):
    rows = max(5, int(length / 0.03))
    y = np.linspace(start[1] + 0.01, start[1] - length, rows)
    x = side * (0.028 + 0.012 * np.linspace(0, 1, rows)) + 0.006 * np.sin(np.linspace(0, 3, rows))
    outline = blurred(hanging(anatomy.trunk, 0.2), 2)
    z = outline.radius(y, np.arctan2(x, np.full(rows, 0.12))) + ease + 0.016
    z = np.maximum(z, start[2] + 0.7 * thickness + np.linspace(0, 0.01, rows))
    path = np.stack([x, y, z], -1)
    widths = np.stack([np.full(rows, 0.045 + 0.3 * thickness), np.full(rows, 0.010)], -1)
    widths[0] *= 0.5
    widths[-1, 1] = 0.002
    vertices, faces = sweep(path, np.tile([1.0, 0.0, 0.0], (rows, 1)), widths, 10)
    return _followed(anatomy, vertices, faces)


def _on_head(anatomy, vertices, faces, template):
    return rigid(vertices, faces, HEAD, len(anatomy.joints)).painted(template, template, 0.09)


def _flange(anatomy, ring, outwards, widths, droop, closed):
    """A sheet from a ring outwards: widths (m,) metres, droop (m,) metres down at its edge."""
    steps = np.linspace(0, 1, 5)
    out = ring[None] + (steps[:, None] * widths[None])[..., None] * outwards[None]
    out[..., 1] -= steps[:, None] ** 2 * droop[None]
    count = len(ring)
    faces = grid_faces(len(steps), count, closed=closed)
    flat = np.repeat((0.4 + 0.05 * steps)[:, None], count, 1).reshape(-1)
    vertices = out.reshape(-1, 3)
    center = anatomy.joints[HEAD]
    template = np.stack([vertices[:, 0] - center[0], flat, vertices[:, 2] - center[2]], -1)
    return turn_in_hems(_on_head(anatomy, vertices, np.ascontiguousarray(faces), template), 0.004)


def brim(rng: np.random.Generator, anatomy: Anatomy, width: float) -> Surface:
    """The brim of a hat, wider in front."""
    ring, outwards = head_ring(anatomy, hair.CAP_LINE)
    azimuth = np.arange(RING) * (2 * np.pi / RING)
    shape = width * (1 + 0.12 * np.cos(azimuth))
    droop = rng.uniform(-0.012, 0.02) - 0.016 * np.cos(2 * azimuth) * rng.uniform(0.2, 1)
    start = ring + outwards * 0.012
    start[:, 1] += 0.004
    return _flange(anatomy, start, outwards, shape, droop, closed=True)


def peak(anatomy: Anatomy, length: float, backwards: bool) -> Surface:
    """The peak of a cap."""
    ring, outwards = head_ring(anatomy, hair.CAP_LINE)
    first = RING // 2 if backwards else 0
    chosen = np.arange(first - 7, first + 8) % RING
    across = np.linspace(-1, 1, len(chosen))
    start = ring[chosen] + outwards[chosen] * 0.011
    start[:, 1] += 0.004
    forward = np.tile([0.0, 0.0, -1.0 if backwards else 1.0], (len(chosen), 1)) + 0.25 * outwards[chosen]
    widths = (0.030 + length * 0.75) * np.sqrt(np.clip(1 - 0.92 * across**2, 0, 1))
    return _flange(anatomy, start, unit(forward), widths, 0.010 + 0.016 * across**2, closed=False)


def _panelled(cloth):
    """Six panels of a cap with a button on top."""

    def albedo(s):
        angle = np.arctan2(s.template[:, 0], s.template[:, 2] - 0.02)
        seam = np.abs((angle / (np.pi / 3) + 0.5) % 1 - 0.5) * (np.pi / 3) * 0.08
        result = cloth(s)
        return mix(result, result * 0.6, band(seam, -1, 0.0016) * (s.template[:, 1] > 0.34))

    return albedo


def _ribboned(cloth, ink):
    """A hat with a ribbon above its brim."""

    def albedo(s):
        above = hair.above_line(s.template, hair.CAP_LINE)
        on_crown = np.hypot(s.template[:, 0], s.template[:, 2] - 0.02) < 0.118
        return mix(cloth(s), ink, band(above, 0.002, 0.026, 0.002) * on_crown)

    return albedo


def _metal(rng):
    base = colour(0.12, 0.5, 0.75) if rng.random() < 0.5 else colour(0.6, 0.04, 0.72)
    return lambda s: np.broadcast_to(base, (len(s.cloth), 3)).astype(np.float32)


def glasses(
    anatomy: Anatomy, size: float, squareness: float, wire: float, dark: bool, ink: np.ndarray
) -> list[tuple[Surface, Material]]:
    """Two rims, a bridge and temples to the ears; dark lenses for the sun."""
    eyes = anatomy.joints[[LEFT_EYE, RIGHT_EYE]]
    middle, apart = eyes.mean(0), np.abs(eyes[0, 0])
    template, vertices = anatomy.skin.attributes["template"], anatomy.skin.vertices
    brow = (np.abs(template[:, 0]) < 0.055) & (np.abs(vertices[:, 1] - middle[1]) < 0.022) & (template[:, 2] > 0.05)
    front = np.quantile(vertices[brow, 2], 0.97) + 0.003
    ear = (
        (np.abs(template[:, 0]) > 0.068)
        & (np.abs(template[:, 1] - 0.343) < 0.012)
        & (np.abs(template[:, 2] - 0.005) < 0.02)
    )
    half, tall = min(0.0255 * size, apart * 0.93), 0.0195 * size
    angle = np.arange(28) * (2 * np.pi / 28)
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** squareness + np.abs(s) ** squareness) ** (-1 / squareness)
    parts, lenses = [], []
    for side in (1, -1):
        x, y = side * apart * 1.06 + half * radius * c, middle[1] - 0.004 + tall * radius * s
        bow = 9.0 * np.abs(x) ** 2.0 * 0.6
        path = np.stack([x, y, front - bow], -1)
        widths = np.full((28, 2), wire)
        parts.append(sweep(path, np.tile([0.0, 0.0, 1.0], (28, 1)), widths, 6, closed=True))
        hinge = np.asarray([side * (apart * 1.06 + half), middle[1] + 0.006, front - 9.0 * (apart + half) ** 2 * 0.6])
        on_ear = vertices[ear & (template[:, 0] * side > 0)]
        hook = np.median(on_ear, 0) + np.asarray([side * 0.004, 0.006, 0]) if len(on_ear) else hinge - [0, 0, 0.09]
        line = hinge + np.linspace(0, 1, 6)[:, None] * (hook - hinge)
        line = np.concatenate([line, [hook + np.asarray([0, -0.014, -0.014])]])
        parts.append(sweep(line, np.tile([0.0, 1.0, 0.0], (7, 1)), np.full((7, 2), 1.1 * wire), 6))
        if dark:
            inner = np.concatenate([[path.mean(0) + np.asarray([0, 0, 0.002])], path])
            fan = np.stack([np.zeros(28, int), 1 + np.arange(28), 1 + (np.arange(28) + 1) % 28], -1)
            lenses.append((inner.astype(np.float32), fan.astype(np.int32)))
    across = np.linspace(-1, 1, 7)
    inner_edge = apart * 1.06 - half
    bridge = np.stack(
        [inner_edge * across, middle[1] + 0.004 + 0.003 * (1 - across**2), front + 0.002 + 0 * across], -1
    )
    parts.append(sweep(bridge, np.tile([0.0, 1.0, 0.0], (7, 1)), np.full((7, 2), wire), 6))

    def painted(dye):
        return lambda s: np.broadcast_to(np.asarray(dye, np.float32), (len(s.cloth), 3)).astype(np.float32)

    result = [(join([_on_head(anatomy, v, f, v - middle) for v, f in parts]), Material(painted(ink), sheen=0.4))]
    if dark:
        lens = join([_on_head(anatomy, v, f, v - middle) for v, f in lenses])
        result.append((lens, Material(painted(colour(0.08, 0.3, 0.06)), sheen=0.7)))
    return result


def necklace(anatomy: Anatomy, length: float) -> Surface:
    """A chain around the neck that hangs lower in front."""
    ring, outwards = neck_ring(anatomy, 0.01)
    azimuth = np.arange(RING) * (2 * np.pi / RING)
    front = np.clip(np.cos(azimuth), 0, 1) ** 2
    path = ring + outwards * 0.003
    path[:, 1] -= length * front
    path[:, 2] += 0.35 * length * front
    vertices, faces = sweep(path, np.tile([0.0, 1.0, 0.0], (RING, 1)), np.full((RING, 2), 0.0022), 6, closed=True)
    return _followed(anatomy, vertices, faces)


def _bag(anatomy, center, half, turn, near):
    """A rounded box with half axes (3,), turned about the vertical, that moves as the skin near it does on average."""
    d, faces = ball(14, 24)
    unit_box = d / (np.sum(np.abs(d) ** 4.0, -1, keepdims=True) ** (1 / 4.0))
    points = unit_box * np.asarray(half)
    c, s = np.cos(turn), np.sin(turn)
    vertices = (points @ np.asarray([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + center).astype(np.float32)
    weights = np.repeat(anatomy.skin.weights[near].mean(0, keepdims=True), len(vertices), 0)
    return Surface(vertices, faces, weights).painted(unit_box, points, 0.15)


def backpack(anatomy: Anatomy, size: float, ease: float) -> Surface:
    """A rounded box on the back."""
    template = anatomy.skin.attributes["template"]
    near = (np.abs(template[:, 0]) < 0.1) & (template[:, 1] > -0.2) & (template[:, 1] < 0.08) & (template[:, 2] < -0.05)
    half = np.asarray([0.145, 0.21, 0.075]) * size
    y = float(rest_height(anatomy, np.asarray([0.10]))[0]) - half[1]
    levels = y + np.linspace(-0.6, 0.8, 9) * half[1]
    behind = anatomy.trunk.radius(levels, np.full(9, np.pi)).max()
    return _bag(anatomy, np.asarray([0, y, -behind - ease - half[2] - 0.004]), half, np.pi, np.flatnonzero(near))


def shoulder_bag(anatomy: Anatomy, size: float, side: float, ease: float) -> Surface:
    """A flat rounded box at the hip."""
    template = anatomy.skin.attributes["template"]
    near = (template[:, 0] * side > 0.1) & (template[:, 0] * side < 0.24) & (np.abs(template[:, 1] + 0.22) < 0.05)
    half = np.asarray([0.15, 0.11, 0.05]) * size
    y = float(rest_height(anatomy, np.asarray([-0.29]))[0]) - 0.75 * half[1]
    angle = side * 1.75
    levels = y + np.linspace(-0.3, 1, 7) * half[1]
    reach = anatomy.hips_and_legs.radius(levels, np.full(7, angle)).mean() + ease + half[2] + 0.008
    center = np.asarray([reach * np.sin(angle), y, reach * np.cos(angle)])
    return _bag(anatomy, center, half, angle, np.flatnonzero(near))


COLUMNS = 32


def pair_of_shoes(anatomy: Anatomy, height: float, sole: float, ease: float) -> Surface:
    """Both shoes. height: of the shaft above the floor; sole: its thickness; ease: metres between foot and leather."""
    return join([_shoe(anatomy, side, height, sole, ease) for side in (0, 1)])


def _shoe(anatomy, side, height, sole, ease):
    template = anatomy.skin.attributes["template"]
    sign = 1 if side == 0 else -1
    own = np.flatnonzero((template[:, 0] * sign > 0) & (template[:, 1] < FLOOR + height + 0.06))
    points = anatomy.skin.vertices[own]
    floor = points[:, 1].min()
    shaft = (
        np.linspace(0.085, height, max(3, int((height - 0.085) / 0.03) + 1)) if height > 0.1 else np.asarray([height])
    )
    low = np.asarray([0.004, 0.012, 0.022, 0.033, 0.045, 0.058, 0.072])
    levels = floor + np.concatenate([low[low < height - 0.004], shaft])
    shape = _outlines(points, levels)
    shape = hanging(shape, 0.6)  # the sole is as wide as what is above it
    angle = np.arange(COLUMNS) * (2 * np.pi / COLUMNS)
    rows = [
        (floor - sole, 0, 0.0),
        (floor - sole, 0, 0.0),
        (floor - 0.3 * sole, 0, 0.004),
        (floor + 0.004, 0, 0.004),
        (floor + 0.006, 0, 0.0),
    ]
    rows += [(level, i, 0.0) for i, level in enumerate(levels) if i > 0]
    rings = []
    for k, (y, i, extra) in enumerate(rows):
        radius = shape.radius(np.full(COLUMNS, levels[i]), angle) + ease + extra
        radius = np.zeros(COLUMNS) if k == 0 else radius
        rings.append(
            np.stack(
                [
                    shape.centers[i, 0] + radius * np.sin(angle),
                    np.full(COLUMNS, y),
                    shape.centers[i, 1] + radius * np.cos(angle),
                ],
                -1,
            )
        )
    vertices = np.concatenate(rings).astype(np.float32)
    faces = grid_faces(len(rows), COLUMNS, closed=True)[:, ::-1]
    weights = nearest_weights(anatomy, vertices, own)
    weights = smooth_weights(weights, faces, 3)
    ankle = anatomy.joints[LEFT_ANKLE + side]
    local = vertices - np.asarray([ankle[0], floor, ankle[2]])
    return turn_in_hems(Surface(vertices, np.ascontiguousarray(faces), weights).painted(local, local, 0.06), 0.01)


def _outlines(points, levels):
    """Thin slices of the foot; thick ones, averaged, of the shin, where the body has few vertices."""
    thin, thick = (outlines(points[:, 1], points[:, [0, 2]], levels, None, window) for window in (0.012, 0.03))
    shin = np.clip((levels - levels[0] - 0.08) / 0.03, 0, 1)[:, None]
    smooth = blurred(thick, 2)
    mixed = [a + (b - a) * shin for a, b in ((thin.centers, thick.centers), (thin.radii, smooth.radii))]
    return Outlines(levels, *mixed)
