"""Builds accessories and shoes: hoods, scarves, hats, glasses, bags, necklaces, shoes.

Their surfaces are swept tubes, sheets, boxes and stacks of silhouettes. Each follows the head or
the skin near it.
"""

import functools
from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.synthetic import hair, surfaces, tailoring
from humangs_jax.synthetic.anatomy import FLOOR, Anatomy, Joint, Vector
from humangs_jax.synthetic.fabrics import Fabric, Material, Spots, band, color, mix
from humangs_jax.synthetic.outfits import Garment
from humangs_jax.synthetic.surfaces import (
    Faces,
    Field,
    Points,
    Surface,
    circle,
    grid_faces,
    join,
    ripples,
    sweep,
    unit,
)

_RING = 40
"""Number of points of a ring around neck or head."""
_COLUMNS = 32
"""Number of points of a ring of a shoe."""
_AZIMUTH = circle(_RING)
"""Azimuths of the points of a ring, radians."""
_SIDEWAYS, _UP, _FORWARD = np.eye(3)


def build(
    rng: np.random.Generator, anatomy: Anatomy, garment: Garment, ease: float
) -> list[tuple[Surface, Material]]:
    """Builds the surfaces of glasses, a necklace, a scarf or headwear, each with its material.

    garment: its kind says which of these is built. ease: distance of the outermost layer of clothes
    from the trunk, metres.
    """
    kind, sizes, fabric = garment.kind, garment.sizes, garment.fabric
    hat = functools.partial(hair.scalp_shell, rng, anatomy, hat=True)
    # what is not made of its fabric
    if kind in ("glasses", "sunglasses"):
        return _glasses(anatomy, garment)
    if kind == "necklace":
        if fabric.rng(2).random() < 0.5:
            metal = color(0.12, 0.5, 0.75)
        else:
            metal = color(0.6, 0.04, 0.72)
        return [(_necklace(anatomy, sizes["length"]), _painted(metal, 0.6))]
    # hats with a brim or a peak
    if kind in ("cap", "brim_hat"):
        if kind == "cap":
            shell = hat(0.016, 0.0, crown=0.008)
        else:
            shell = hat(0.017, 0.0, crown=0.05)
        paint = _panelled if kind == "cap" else _ribboned
        albedo = functools.partial(paint, fabric)
        return [(join([shell, _hat_edge(rng, anatomy, garment)]), Material(albedo, wrinkles=0.05))]
    # the rest is of soft cloth
    if kind == "scarf":
        surface = _scarf(rng, anatomy, sizes["thickness"], sizes["tails"], ease)
    elif kind == "beanie":
        surface = hat(rng.uniform(0.014, 0.019), 0.04, crown=rng.uniform(0, 0.03))
    else:  # a headscarf
        opening, ends = _face_opening(0.312, 0.98, 0.078), rng.uniform(0.08, 0.13)
        surface = hair.falling_tube(rng, anatomy, 0.022, 0.06, opening, wave=0.005, ends=ends)
    return [(surface, Material(fabric.colors, wrinkles=0.3))]


def _painted(dye: Vector, sheen: float) -> Material:
    return Material(
        lambda s: np.broadcast_to(np.asarray(dye, np.float32), (len(s.cloth), 3)), sheen=sheen
    )


def _panelled(fabric: Fabric, s: Spots) -> Points:
    """Returns the colors (n, 3) of a cap of six panels, which are sewn together."""
    angle, colors = np.arctan2(s.template[:, 0], s.template[:, 2] - 0.02), fabric.colors(s)
    seam = np.abs((angle / (np.pi / 3) + 0.5) % 1 - 0.5) * (np.pi / 3) * 0.08
    return mix(colors, colors * 0.6, band(seam, -1, 0.0016) * (s.template[:, 1] > 0.34))


def _ribboned(fabric: Fabric, s: Spots) -> Points:
    """Returns the colors (n, 3) of a hat with a ribbon around the crown."""
    above = hair.above_line(s.template, hair.CAP_LINE)
    on_crown = np.hypot(s.template[:, 0], s.template[:, 2] - 0.02) < 0.118
    return mix(fabric.colors(s), fabric.other, band(above, 0.002, 0.026, 0.002) * on_crown)


_Ring = tuple[Float[np.ndarray, "ring 3"], Float[np.ndarray, "ring 3"]]
"""`_RING` points at rest, metres, and for each point a horizontal unit vector outwards. The ring
begins in front and runs over the left side.
"""


def _neck_ring(anatomy: Anatomy, lift: float) -> _Ring:
    """Returns the ring around the neck that is `lift` metres above a crew neckline."""
    return _ring(
        anatomy,
        np.abs(tailoring.neckline(anatomy.skin.template, "crew", 0.0) + lift) < 0.02,
        -0.005,
    )


def _ring(anatomy: Anatomy, near: Bool[np.ndarray, " n"], middle: float) -> _Ring:
    """Returns a smooth ring through the skin near chosen vertices.

    Each point of the ring has an azimuth, and is a mean of the chosen vertices. The weight of a
    vertex falls with the difference between its azimuth and that of the point. Azimuths are about
    the vertical axis at x = 0, z = middle, in template coordinates. near: whether a vertex is
    chosen, (n,).
    """
    x, _, z = anatomy.skin.template[near].T
    points, azimuths = anatomy.skin.vertices[near], np.arctan2(x, z - middle)
    apart = np.abs((azimuths[None] - _AZIMUTH[:, None] + np.pi) % (2 * np.pi) - np.pi)
    weights = np.exp(-((apart / 0.16) ** 2)) + 1e-9
    ring = weights @ points / weights.sum(1, keepdims=True)
    outwards = ring - ring.mean(0)
    outwards[:, 1] = 0
    return ring, unit(outwards)


def _followed(
    anatomy: Anatomy,
    path: Float[np.ndarray, "m 3"],
    across: Float[np.ndarray, "*_m 3"],
    widths: Float[np.ndarray, "m 2"] | float,
    columns: int,
    closed: bool = True,
) -> Surface:
    """Sweeps a tube along a path. The tube moves with the nearest skin.

    Its template and cloth coordinates are positions, shifted so that the neck has the height 0.19
    m. The arguments after `anatomy` are those of `surfaces.sweep`.
    """
    (x, y, _) = anatomy.skin.template.T
    (vertices, faces) = sweep(path, across, widths, columns, closed)
    candidates = np.flatnonzero((np.abs(x) < 0.2) & (y > -0.35) & (y < 0.2))
    weights = tailoring.smooth_weights(
        tailoring.nearest_weights(anatomy, vertices, candidates), faces, 6
    )
    around_middle = vertices - [0, anatomy.joints[Joint.NECK, 1] - 0.19, 0]
    return Surface(vertices, faces, weights).painted(around_middle, around_middle, 0.12)


def hood(rng: np.random.Generator, anatomy: Anatomy, up: bool) -> Surface:
    """Builds a hood. It is over the head if `up`, else it lies in folds around the neck and on the
    upper back.
    """
    if up:
        return hair.falling_tube(
            rng, anatomy, 0.034, 0.1, _face_opening(0.31, 1.05, 0.096), wave=0.004, ends=0.1
        )
    ring, outwards = _neck_ring(anatomy, -0.012)
    behind = 0.5 - 0.5 * np.cos(_AZIMUTH)  # 0 in front, 1 at the nape
    thick = 0.010 + 0.020 * behind + 0.016 * behind**4
    tall = 0.016 + 0.012 * behind + 0.030 * behind**4
    path = ring + outwards * (0.4 * thick + 0.022)[:, None]
    path[:, 1] += 0.012 - 0.030 * behind**4 + 0.004 * ripples(rng, 3 * ring, 0.3)
    rolls = np.stack([tall, thick], -1) * (1 + 0.1 * ripples(rng, 4 * ring, 0.2))[:, None]
    return _followed(anatomy, path, _UP + 0.5 * outwards * behind[:, None] ** 3, rolls, 12)


def _face_opening(
    middle: float, half_width: float, half_height: float
) -> Callable[[Field, Field], Field]:
    """Returns a function of azimuths (radians) and template heights. Its values are positive
    outside of an oval for the face. middle, half_height: heights. half_width: radians.
    """
    return lambda sides, height: (
        ((sides / half_width) ** 2 + ((height - middle) / half_height) ** 2 - 1) * 0.05
    )


def _scarf(
    rng: np.random.Generator, anatomy: Anatomy, thickness: float, tails: float, ease: float
) -> Surface:
    """Builds a scarf that goes twice around the neck.

    tails: length of the ends that hang down in front, metres; 0 for none. ease: as in `build`.
    """
    parts = []
    for turn, lift in enumerate((-0.004, 0.022)):
        ring, outwards = _neck_ring(anatomy, lift)
        lumps = 1 + 0.16 * ripples(rng, 3 * ring + turn, 0.25)
        path = ring + outwards * (0.75 * thickness + min(ease, 0.015))
        path[:, 1] += 0.014 + 0.006 * np.sin(_AZIMUTH + turn * 2.1)
        widths = np.stack([1.15 * thickness * lumps, 0.85 * thickness / lumps], -1)
        parts.append(_followed(anatomy, path, _UP, widths, 12))
    if tails > 0:
        ring, _ = _neck_ring(anatomy, -0.004)
        for side, length in ((1, tails), (-1, tails * rng.uniform(0.6, 1.0))):
            parts.append(_tail(rng, anatomy, ring[0], side, length, thickness, ease))
    return join(parts)


def _tail(
    rng: np.random.Generator,
    anatomy: Anatomy,
    start: Vector,
    side: int,
    length: float,
    thickness: float,
    ease: float,
) -> Surface:
    """Builds an end of a scarf that hangs down on the chest. side: 1 for left, -1 for right."""
    rows = max(5, int(length / 0.03))
    y = np.linspace(start[1] + 0.01, start[1] - length, rows)
    x = side * (0.028 + 0.012 * np.linspace(0, 1, rows)) + 0.006 * np.sin(np.linspace(0, 3, rows))
    boundary = surfaces.blurred(surfaces.hanging(anatomy.trunk, 0.2), 2)
    z = boundary.radius(y, np.arctan2(x, np.full(rows, 0.12))) + ease + 0.016
    z = np.maximum(z, start[2] + 0.7 * thickness + np.linspace(0, 0.01, rows))
    widths = np.tile([0.045 + 0.3 * thickness, 0.010], (rows, 1))
    widths[0] *= 0.5
    widths[-1, 1] = 0.002
    return _followed(anatomy, np.stack([x, y, z], -1), _SIDEWAYS, widths, 10, closed=False)


def _on_head(anatomy: Anatomy, vertices: Points, faces: Faces, template: Points) -> Surface:
    return surfaces.rigid(vertices, faces, Joint.HEAD, len(anatomy.joints)).painted(
        template, template, 0.09
    )


def _hat_edge(rng: np.random.Generator, anatomy: Anatomy, garment: Garment) -> Surface:
    """Builds the brim of a hat or the peak of a cap. It is a sheet from the edge of the hat
    outwards.
    """
    template = anatomy.skin.template
    size = garment.sizes["brim"]
    closed = garment.kind == "brim_hat"
    # points on the ears are not of the edge of the hat
    no_ear = (np.abs(template[:, 0]) < 0.078) | (template[:, 1] > 0.357)
    ring, out = _ring(
        anatomy, no_ear & (np.abs(hair.above_line(template, hair.CAP_LINE)) < 0.012), hair.SKULL[2]
    )
    # a brim goes around the head; a peak is in front only, or behind
    if closed:
        start, widths = ring + out * 0.012, size * (1 + 0.12 * np.cos(_AZIMUTH))
        droop = rng.uniform(-0.012, 0.02) - 0.016 * np.cos(2 * _AZIMUTH) * rng.uniform(0.2, 1)
    else:
        backwards, across = garment.sizes["backwards"] > 0, np.linspace(-1, 1, 15)
        middle = _RING // 2 if backwards else 0
        chosen = (middle + np.arange(-7, 8)) % _RING
        start = ring[chosen] + out[chosen] * 0.011
        facing = -_FORWARD if backwards else _FORWARD
        out = unit(np.tile(facing, (15, 1)) + 0.25 * out[chosen])
        widths = (0.030 + size * 0.75) * np.sqrt(np.clip(1 - 0.92 * across**2, 0, 1))
        droop = 0.010 + 0.016 * across**2
    start[:, 1] += 0.004
    # the sheet droops more the further out it is
    steps = np.linspace(0, 1, 5)[:, None]
    sheet = start[None] + (steps * widths[None])[..., None] * out[None]
    sheet[..., 1] -= steps**2 * droop[None]
    vertices, faces = sheet.reshape(-1, 3), grid_faces(len(steps), len(start), closed=closed)
    # coordinates of the paint, around the head
    template = vertices - anatomy.joints[Joint.HEAD]
    template[:, 1] = np.repeat(0.4 + 0.05 * steps, len(start))
    return surfaces.turn_in_hems(_on_head(anatomy, vertices, faces, template), 0.004)


def _glasses(anatomy: Anatomy, garment: Garment) -> list[tuple[Surface, Material]]:
    """Builds glasses: two rims, a bridge, temples to the ears; sunglasses also have dark lenses."""
    size, squareness, wire = (garment.sizes[name] for name in ("size", "squareness", "wire"))
    dark = garment.kind == "sunglasses"
    eyes = anatomy.joints[[Joint.LEFT_EYE, Joint.RIGHT_EYE]]
    middle, apart = eyes.mean(0), np.abs(eyes[0, 0])
    template, vertices = anatomy.skin.template, anatomy.skin.vertices
    x, y, z = template.T
    # how far in front of the face glasses sit, and where the ears are
    brow = (np.abs(x) < 0.055) & (np.abs(vertices[:, 1] - middle[1]) < 0.022) & (z > 0.05)
    front = np.quantile(vertices[brow, 2], 0.97) + 0.003
    ear = (np.abs(x) > 0.068) & (np.abs(y - 0.343) < 0.012) & (np.abs(z - 0.005) < 0.02)
    half, tall = min(0.0255 * size, apart * 0.93), 0.0195 * size
    # one outline for both rims, from round to square
    c, s = np.cos(circle(28)), np.sin(circle(28))
    radius = (np.abs(c) ** squareness + np.abs(s) ** squareness) ** (-1 / squareness)
    parts, lenses = [], []
    # each side has a rim, a hinge and a temple that hooks behind the ear
    for side in (1, -1):
        x, y = side * apart * 1.06 + half * radius * c, middle[1] - 0.004 + tall * radius * s
        path = np.stack([x, y, front - 9.0 * np.abs(x) ** 2.0 * 0.6], -1)
        parts.append(sweep(path, _FORWARD, wire, 6, closed=True))
        hinge = np.asarray(
            [
                side * (apart * 1.06 + half),
                middle[1] + 0.006,
                front - 9.0 * (apart + half) ** 2 * 0.6,
            ]
        )
        on_ear = vertices[ear & (template[:, 0] * side > 0)]
        hook = hinge - [0, 0, 0.09]
        if len(on_ear):
            hook = np.median(on_ear, 0) + np.asarray([side * 0.004, 0.006, 0])
        line = hinge + np.linspace(0, 1, 6)[:, None] * (hook - hinge)
        parts.append(
            sweep(
                np.concatenate([line, [hook + np.asarray([0, -0.014, -0.014])]]), _UP, 1.1 * wire, 6
            )
        )
        # clear lenses are not modelled
        if dark:
            inner = np.concatenate([[path.mean(0) + np.asarray([0, 0, 0.002])], path])
            fan = np.stack([np.zeros(28, int), 1 + np.arange(28), 1 + (np.arange(28) + 1) % 28], -1)
            lenses.append((inner.astype(np.float32), fan.astype(np.int32)))
    # the bridge joins the rims above the nose
    across, flat = np.linspace(-1, 1, 7), np.full(7, front + 0.002)
    bridge = np.stack(
        [(apart * 1.06 - half) * across, middle[1] + 0.004 + 0.003 * (1 - across**2), flat], -1
    )
    parts.append(sweep(bridge, _UP, wire, 6))
    glass = (lenses, _painted(color(0.08, 0.3, 0.06), 0.7))
    made = [(parts, _painted(garment.fabric.base, 0.4))]
    if dark:
        made.append(glass)
    return [
        (join([_on_head(anatomy, v, f, v - middle) for v, f in pieces]), material)
        for pieces, material in made
    ]


def _necklace(anatomy: Anatomy, length: float) -> Surface:
    """Builds a chain around the neck that hangs down in front by `length` metres."""
    ring, outwards = _neck_ring(anatomy, 0.01)
    front = np.clip(np.cos(_AZIMUTH), 0, 1) ** 2
    path = ring + outwards * 0.003
    path[:, 1] -= length * front
    path[:, 2] += 0.35 * length * front
    return _followed(anatomy, path, _UP, 0.0022, 6)


def bag(anatomy: Anatomy, garment: Garment, ease: float) -> Surface:
    """Builds a bag: a rounded box on the back, or a flat one at the hip.

    The whole bag moves with the mean skinning weights of the skin near it. ease: distance of
    clothes from the skin there, metres.
    """
    x, y, z = anatomy.skin.template.T
    size = garment.sizes["size"]
    # where the bag is, and the skin that it moves with
    if garment.kind == "backpack":
        near = (np.abs(x) < 0.1) & (y > -0.2) & (y < 0.08) & (z < -0.05)
        half, turn = np.asarray([0.145, 0.21, 0.075]) * size, np.pi
        height = float(tailoring.rest_height(anatomy, np.asarray([0.10]))[0]) - half[1]
        behind = anatomy.trunk.radius(
            height + np.linspace(-0.6, 0.8, 9) * half[1], np.full(9, np.pi)
        ).max()
        center = np.asarray([0, height, -behind - ease - half[2] - 0.004])
    else:
        side = garment.sizes["side"]
        near = (x * side > 0.1) & (x * side < 0.24) & (np.abs(y + 0.22) < 0.05)
        half, turn = np.asarray([0.15, 0.11, 0.05]) * size, side * 1.75
        height = float(tailoring.rest_height(anatomy, np.asarray([-0.29]))[0]) - 0.75 * half[1]
        around = anatomy.hips_and_legs.radius(
            height + np.linspace(-0.3, 1, 7) * half[1], np.full(7, turn)
        )
        reach = around.mean() + ease + half[2] + 0.008
        center = np.asarray([reach * np.sin(turn), height, reach * np.cos(turn)])
    # a ball whose exponent makes it a box with round edges
    directions, faces = surfaces.ball(14, 24)
    unit_box = directions / (np.sum(np.abs(directions) ** 4.0, -1, keepdims=True) ** (1 / 4.0))
    points, c, s = unit_box * half, np.cos(turn), np.sin(turn)
    vertices = (points @ np.asarray([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + center).astype(np.float32)
    # a bag is stiff: all of it moves as the skin near it does on average
    weights = np.repeat(anatomy.skin.weights[near].mean(0, keepdims=True), len(vertices), 0)
    return Surface(vertices, faces, weights).painted(unit_box, points, 0.15)


def pair_of_shoes(anatomy: Anatomy, height: float, sole: float, ease: float) -> Surface:
    """Builds both shoes.

    height: height of the shaft above the floor. sole: thickness of the sole. ease: distance between
    foot and leather. All are in metres.
    """
    return join([_shoe(anatomy, side, height, sole, ease) for side in (0, 1)])


def _shoe(anatomy: Anatomy, side: int, height: float, sole: float, ease: float) -> Surface:
    """Builds one shoe of rings around the foot and the shin. side: 0 for left, 1 for right."""
    x, y, _ = anatomy.skin.template.T
    own = np.flatnonzero((x * (1 - 2 * side) > 0) & (y < FLOOR + height + 0.06))
    points = anatomy.skin.vertices[own]
    floor = points[:, 1].min()
    # heights of the rings, closest at the sole
    shaft = [height]
    if height > 0.1:
        shaft = np.linspace(0.085, height, max(3, int((height - 0.085) / 0.03) + 1))
    low = np.asarray([0.004, 0.012, 0.022, 0.033, 0.045, 0.058, 0.072])
    levels = floor + np.concatenate([low[low < height - 0.004], shaft])
    # thin slices of the foot; thick ones, averaged, of the shin, where the body has few vertices
    thin, thick = (
        surfaces.boundaries(points[:, 1], points[:, [0, 2]], levels, None, window)
        for window in (0.012, 0.03)
    )
    shin = np.clip((levels - levels[0] - 0.08) / 0.03, 0, 1)[:, None]
    pairs = (thin.centers, thick.centers), (thin.radii, surfaces.blurred(thick, 2).radii)
    shape = surfaces.Boundaries(levels, *(a + (b - a) * shin for a, b in pairs))
    shape = surfaces.hanging(shape, 0.6)  # the sole is as wide as what is above it
    # the sole: it reaches beyond the leather
    below = ((-sole, 0.0), (-sole, 0.0), (-0.3 * sole, 0.004), (0.004, 0.004), (0.006, 0.0))
    rows = [(floor + y, 0, extra) for y, extra in below] + [
        (level, i + 1, 0.0) for i, level in enumerate(levels[1:])
    ]
    rings = []
    for y, i, extra in rows:
        radius = shape.radius(np.full(_COLUMNS, levels[i]), circle(_COLUMNS)) + ease + extra
        if not rings:
            radius = 0 * radius
        rings.append(
            surfaces.around(radius, circle(_COLUMNS), np.full(_COLUMNS, y), shape.centers[i])
        )
    vertices = np.concatenate(rings).astype(np.float32)
    faces = np.ascontiguousarray(grid_faces(len(rows), _COLUMNS, closed=True)[:, ::-1])
    weights = tailoring.smooth_weights(tailoring.nearest_weights(anatomy, vertices, own), faces, 3)
    local = vertices - np.where([True, False, True], anatomy.joints[Joint.LEFT_ANKLE + side], floor)
    return surfaces.turn_in_hems(
        Surface(vertices, faces, weights).painted(local, local, 0.06), 0.01
    )
