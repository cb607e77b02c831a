"""Cuts and drapes clothes: shells of cloth around the body, and tubes (skirts) around the legs.

A cut is a function of template coordinates (n, 3), see `anatomy`. It returns a field (n,) that is
positive where there is cloth. A shell starts as the skin inside of the cuts. It is smoothed,
because cloth does not follow navels, and moved outwards to the convex silhouettes of trunk and
limbs. It keeps a least distance from the skin.
"""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.synthetic import surfaces
from humangs_jax.synthetic.anatomy import (
    ANKLE,
    ARM_HEIGHT,
    FLOOR,
    Anatomy,
    Joint,
    sewn_coordinates,
    smoothstep,
)
from humangs_jax.synthetic.surfaces import (
    Boundaries,
    Field,
    Points,
    Surface,
    blurred,
    hanging,
    polar,
    ripples,
    smooth,
)

TRUNK_HALF_WIDTH = 0.25
"""In T-pose, points with a larger |x| than this belong to arms, template coordinates."""
NECKLINES = {
    "crew": (0.0, 0.085),
    "vee": (0.0, 0.085),
    "scoop": (-0.012, 0.115),
    "high": (0.052, 0.085),
    "collar": (0.012, 0.085),
}
"""Necklines by name. Each has the height by which the plane of the neckline is raised, and the
distance from the axis of the neck beyond which shoulders are always covered, both in metres.
"""
HEM_MARGIN = 0.012
"""Skin is removed if it is further inside of a hem than this, metres in template coordinates. Some
garments have other margins.
"""


def neckline(template: Points, style: str, depth: float) -> Field:
    """Returns a field (n,) that is positive below a neckline.

    style: one of NECKLINES. depth: of a vee or a scoop, metres.
    """
    x, y, z = template.T
    radial = np.sqrt(x * x + (z + 0.005) ** 2)
    lift, wide = NECKLINES[style]
    plane = 0.152 + lift - 0.42 * z - y
    field = np.maximum(plane, np.minimum(radial - wide, 0.17 - y))  # shoulders, but not the head
    if style == "vee":
        opening = np.maximum.reduce(
            [0.13 - depth + np.abs(x) * depth / 0.06 - y, np.abs(x) - 0.06, 0.02 - z]
        )
        field = np.minimum(field, opening)
    if style == "scoop":
        inside = 1 - (x / 0.105) ** 2 - ((y - 0.15) / (0.02 + depth)) ** 2
        field = np.minimum(field, np.maximum(-0.05 * inside, 0.02 - z))
    return field


def sleeves(template: Points, end: float) -> Field:
    """Returns a field (n,) that is positive everywhere except on arms beyond |x| = end.

    With end < 0.2 the top is sleeveless. The edge of its armholes then moves outwards below y =
    0.03.
    """
    x, y = np.abs(template[:, 0]), template[:, 1]
    if end < 0.2:
        return end + 1.6 * np.maximum(0.03 - y, 0) - x
    return np.where(y > -0.1, end - x, 0.5)


def above(template: Points, level: float) -> Field:
    """Returns a field (n,) that is positive above a height."""
    return template[:, 1] - level


def trousers(template: Points, top: float, end: float) -> Field:
    """Returns a field (n,) that is positive on hips and legs between two heights."""
    x, y, _ = template.T
    return np.minimum.reduce([top - y, y - end, TRUNK_HALF_WIDTH - np.abs(x)])


def front_opening(template: Points, gap: float, spread: float) -> Field:
    """Returns a field (n,) that is positive everywhere except in an opening down the front.

    gap: half of the opening's width at the chest, metres. spread: growth of half of the width,
    metres per metre downwards. The opening is also wider at the neck.
    """
    x, y, z = template.T
    wide = gap + spread * np.maximum(-0.05 - y, 0) + 0.25 * np.maximum(y - 0.04, 0) * (y < 0.25)
    return np.maximum(np.abs(x) - wide, 0.03 - z)


def collar(template: Points, low: float, high: float, gap: float = 0.012) -> Field:
    """Returns a field (n,) that is positive on a band around the neck, open in front.

    low, high: template heights of the lower and the upper edge at z = 0. Both edges are tilted like
    a neckline. gap: half of the width of the opening, metres.
    """
    x, y, z = template.T
    radial, plane = np.sqrt(x * x + (z + 0.005) ** 2), y + 0.42 * z
    return np.minimum.reduce(
        [plane - low, high - plane, 0.125 - radial, np.where(z > 0, np.abs(x) - gap, 0.1)]
    )


def lapel(template: Points, gap: float, spread: float, bottom: float) -> Field:
    """Returns a field (n,) that is positive on two tapering strips beside an opening in front.

    They go from the collar down to height `bottom`. gap, spread: of the opening, see
    `front_opening`.
    """
    x, y, z = template.T
    width = np.clip((y - bottom) * 0.42, 0, 0.075) * np.clip((0.2 - y) / 0.05, 0, 1)
    inner = front_opening(template, gap, spread)
    return np.minimum.reduce(
        [inner, width - inner, y - bottom, 0.19 - y, 0.4 * (z - 0.0), 0.14 - np.abs(x)]
    )


def hips_and_legs(template: Points, top: float, bottom: float) -> Field:
    """Returns a field (n,) that is positive on what a tube around hips and legs hides.

    top, bottom: heights of the tube. Legs are not hidden up to 16 cm above the hem, because they
    may be seen from below.
    """
    x, y, _ = template.T
    return np.minimum.reduce([top - 0.03 - y, y - bottom - 0.16, TRUNK_HALF_WIDTH - np.abs(x)])


def shaft(template: Points, height: float) -> Field:
    """Returns a field (n,) that is positive on feet and legs below a height over the floor."""
    return FLOOR + height - template[:, 1]


def straps(template: Points, low_front: float, low_back: float) -> Field:
    """Returns a field (n,) that is positive on two straps over the shoulders.

    low_front, low_back: heights where they end, in front and at the back.
    """
    x, y, z = template.T
    low = np.where(z > -0.01, low_front, low_back)
    return np.minimum.reduce([0.021 - np.abs(np.abs(x) - 0.092), y - low, 0.2 - y])


def sash(template: Points, shoulder: float, hip: float, half_width: float) -> Field:
    """Returns a field (n,) that is positive on a strip across the trunk.

    The strip goes from x = shoulder at the top to x = hip on the other side. half_width: metres.
    """
    x, y, _ = template.T
    along = np.asarray([hip - shoulder, -0.30 - 0.17])
    along = along / np.linalg.norm(along)
    across = (x - shoulder) * along[1] - (y - 0.17) * along[0]
    # the side of the trunk is steep
    half_width = half_width * (1 - 0.6 * np.clip((x * np.sign(hip) - 0.06) / 0.08, 0, 1))
    return np.minimum.reduce(
        [half_width - np.abs(across), y + 0.29, np.where(y > -0.02, 0.186, 0.25) - np.abs(x)]
    )


def necktie(template: Points, length: float, width: float) -> Field:
    """Returns a field (n,) that is positive on a tie: a strip down the chest with a knot on top.

    The strip widens downwards and ends in a point at y = 0.1 - length. length: metres. width: half
    of the strip's largest width, metres.
    """
    x, y, z = template.T
    top, bottom = 0.137 - 0.42 * z, 0.1 - length
    knot = 0.007 * np.exp(-(((y - top + 0.012) / 0.014) ** 2))
    half = width * (0.42 + 0.58 * np.clip((top - y) / length, 0, 1)) + knot
    return np.minimum.reduce([half - np.abs(x), y - bottom - np.abs(x), top - y, 4 * (z - 0.02)])


def bracelet(template: Points, side: float, low: float, high: float) -> Field:
    """Returns a field (n,) that is positive on one arm between two distances |x| from the middle.

    side: +1 for left, -1 for right.
    """
    x, y, _ = template.T
    return np.where(y > -0.1, np.minimum(side * x - low, high - side * x), -1.0)


def sandal_straps(template: Points) -> tuple[Field, Field]:
    """Returns two fields (n,), positive on a strap across the toes and on one around the ankle."""
    y, z = template[:, 1] - FLOOR, template[:, 2]
    over_toes = np.minimum.reduce([0.02 - np.abs(z - 0.09 + 0.3 * y), 0.075 - y, y - 0.004])
    return over_toes, 0.009 - np.abs(y - 0.088 - 0.25 * z)


@dataclasses.dataclass(frozen=True)
class Fit:
    """How a shell hangs on the body. Lengths are in metres."""

    ease: float
    """Distance of the cloth from the smoothed skin and from the silhouettes."""
    hang: float = 3.0
    """Slope by which hanging cloth may narrow downwards, metres per metre; large values cling."""
    sleeve: float = 0.0
    """Distance from the arm that is added at the wrist. Towards the shoulder it falls to 0."""
    leg: float = 0.0
    """Distance from the leg that is added at the ankle. Towards the crotch it falls to 0."""
    leg_hang: float = 3.0
    """Slope by which the cloth of each leg may narrow downwards, metres per metre, as `hang`."""
    fold: float = 0.004
    """Height of the folds; 0 for none."""
    hem: float = 0.008
    """Depth of the hem that is turned in."""
    quilt: float = 0.0
    """Distance between padded rings; 0 for none."""
    inner: float = 0.0
    """Least distance from the skin, which leaves room for the clothes below."""
    calm: float = 9.0
    """Height above which there are no folds, as y in cloth coordinates."""
    skirted: bool = False
    """Whether the shell goes around both legs together, as tops do. Otherwise it goes around each
    leg.
    """


def shell(
    rng: np.random.Generator, anatomy: Anatomy, fields: list[np.ndarray], fit: Fit
) -> Surface:
    """Makes a garment that covers the skin where all fields are positive.

    fields: each has a number for each vertex of the body (n,).
    """
    skin = anatomy.skin
    surface = skin.with_attributes(
        skin_point=skin.vertices,
        arm=anatomy.arm,
        leg=anatomy.leg,
        **{f"field{i}": f for i, f in enumerate(fields)},
    )
    for i in range(len(fields)):
        surface = surfaces.cut(surface, surface.attributes[f"field{i}"])
    return finished(_drape(rng, anatomy, surface, fit), 4, fit.hem)


def finished(surface: Surface, iterations: int, hem: float) -> Surface:
    """Returns a surface with smoothed skinning weights and hems that are turned in.

    Only the attributes `template` and `cloth` are kept. iterations: how often weights are smoothed.
    hem: depth that is turned in, metres.
    """
    weights = smooth_weights(surface.weights, surface.faces, iterations)
    kept = {name: surface.attributes[name] for name in ("template", "cloth")}
    return surfaces.turn_in_hems(Surface(surface.vertices, surface.faces, weights, kept), hem)


def smooth_weights(weights: np.ndarray, faces: np.ndarray, iterations: int) -> np.ndarray:
    """Returns skinning weights (n, j) smoothed over a surface; rows sum to 1."""
    used = weights.max(0) > 0
    smoothed = np.zeros_like(weights)
    smoothed[:, used] = smooth(weights[:, used], faces, iterations)
    return smoothed / smoothed.sum(1, keepdims=True)


def _drape(rng: np.random.Generator, anatomy: Anatomy, surface: Surface, fit: Fit) -> Surface:
    """Moves a surface that is cut out of the skin to where its cloth hangs."""
    # a smooth surface at the distance of the ease
    below, arm, leg = (surface.attributes[name] for name in ("skin_point", "arm", "leg"))
    normals = surfaces.unit(smooth(surface.attributes["normals"], surface.faces, 2))
    points = smooth(below, surface.faces, 8, keep_hems=True) + fit.ease * normals
    # on the trunk, out to the silhouettes of the slices above
    below_armpit = 1 - smoothstep(
        -0.03, 0.06, points[:, 1] - anatomy.joints[Joint.LEFT_SHOULDER, 1] + ARM_HEIGHT
    )
    angle, radius = polar(points[:, [0, 2]], np.zeros((1, 2)))
    wanted = hanging(anatomy.trunk, fit.hang).radius(points[:, 1], angle) + fit.ease
    share = (1 - arm) * (1 if fit.skirted else 1 - leg) * below_armpit
    grown = radius + share * np.maximum(wanted - radius, 0)
    points = points.astype(np.float64)
    points[:, [0, 2]] *= (grown / np.maximum(radius, 1e-4))[:, None]
    # on arms and legs, out to theirs, wider towards cuffs and hems
    for side, sign in ((0, 1), (1, -1)):
        boundary, along = anatomy.arms[side], np.abs(points[:, 0])
        start, end = boundary.levels[0] + 0.12, boundary.levels[-1] - 0.1
        wider = fit.ease, fit.sleeve * np.clip((along - start) / (end - start), 0, 1)
        points = _push(points, (1, 2), along, boundary, arm * (sign * points[:, 0] > 0), *wider)
        if not fit.skirted:
            shape = anatomy.legs[side]
            inner = dataclasses.replace(
                shape, radii=np.where(shape.levels[:, None] > -0.5, 0.0, shape.radii)
            )
            wider = fit.ease, fit.leg * np.clip((-0.45 - points[:, 1]) / 0.65, 0, 1)
            own = leg * (sign * points[:, 0] > 0)
            points = _push(points, (0, 2), points[:, 1], hanging(inner, fit.leg_hang), own, *wider)
    points = smooth(points, surface.faces, 3, keep_hems=True)
    # smoother between the buttocks and below the belly
    x, y, _ = surface.template.T
    seat = np.exp(-((x / 0.045) ** 2)) * smoothstep(0.22, 0.28, -y) * (y > -0.5)
    if seat.any():
        smoother = smooth(points, surface.faces, 15, keep_hems=True)
        points = points + seat[:, None] * (smoother - points)
    # folds, by coordinates that are as smooth as the points
    outer = surfaces.vertex_normals(points, surface.faces)
    cloth = smooth(surface.attributes["cloth"], surface.faces, 10, keep_hems=True)
    template = smooth(surface.template, surface.faces, 8, keep_hems=True)
    heights = _fold_heights(rng, sewn_coordinates(cloth, template), arm, leg, fit)
    points = points + heights[:, None] * outer
    # nothing comes nearer to the skin than what is worn below
    distance = np.sum((points - below) * surface.attributes["normals"], -1)
    least = max(0.55 * fit.ease, fit.inner)
    points = points + np.maximum(least - distance, 0)[:, None] * surface.attributes["normals"]
    hems = np.unique(surfaces.boundary_edges(surface.faces))
    points[hems] = smooth(points, surface.faces, 4, keep_hems=True)[hems]
    # trouser legs do not cross the middle
    side, thighs = np.sign(x), leg > 0.6
    points[:, 0] = np.where(thighs, side * np.maximum(side * points[:, 0], 0.004), points[:, 0])
    return surface.moved(points).with_attributes(cloth=cloth, template=template)


def _fold_heights(
    rng: np.random.Generator, cloth: Float[np.ndarray, "n 4"], arm: Field, leg: Field, fit: Fit
) -> Field:
    """Returns how far folds move the cloth outwards (n,), metres.

    There are soft waves, drapes that fall from chest and hips, and rings where joints and cuffs
    gather cloth.
    """
    along, around = cloth[:, 1], np.arctan2(cloth[:, 0], cloth[:, 2]) * cloth[:, 3]
    heights = fit.fold * ripples(rng, cloth[:, :3], wavelength=0.11)
    if fit.fold == 0:
        return heights
    wander = ripples(rng, cloth[:, :3], wavelength=0.3)
    drapes = np.sin(2 * np.pi * around / 0.09 + 2.5 * wander) * np.clip(-along / 0.35, 0, 1)
    heights = heights + 0.8 * fit.fold * drapes * (1 - arm) * np.where(leg > 0.5, 0.35, 1.0)
    slanted = along + 0.25 * around + 0.012 * ripples(rng, cloth[:, :3], wavelength=0.12)
    rings = np.sin(2 * np.pi * slanted / 0.055) * (
        0.6 + 0.4 * ripples(rng, cloth[:, :3], wavelength=0.1)
    )

    def bend(height, wide):
        """Returns a bump (n,) along the body: 1 at y = -height in cloth coordinates. wide: width,
        metres.
        """
        return np.exp(-(((along + height) / wide) ** 2))

    elbows = arm * (bend(0.14, 0.07) + 0.8 * bend(0.34, 0.06))
    knees = leg * (bend(0.79, 0.07) + 1.3 * bend(1.12, 0.07) + 0.6 * bend(0.46, 0.05))
    heights = heights + 1.3 * fit.fold * rings * (elbows + knees)
    heights = heights * (1 - smoothstep(fit.calm - 0.08, fit.calm, along))
    if fit.quilt > 0:
        heights = heights + 0.011 * (np.abs(np.sin(np.pi * along / fit.quilt)) - 0.4)
    return heights


def _push(
    points: Points,
    across: tuple[int, int],
    along: Field,
    boundary: Boundaries,
    amount: Field,
    ease: float,
    extra: Field,
) -> Points:
    """Moves points away from an axis to at least `ease + extra` metres outside of silhouettes.

    across: indices of the two coordinates across the axis. along: positions of the points on the
    axis (n,). amount: share of the move for each point (n,), 0 to 1.
    """
    center, axes = boundary.center(along), list(across)
    angle, radius = polar(points[:, axes], center)
    missing = np.maximum(boundary.radius(along, angle) + ease + extra - radius, 0)
    scale = 1 + amount * missing / np.maximum(radius, 1e-4)
    points = points.copy()
    points[:, axes] = center + (points[:, axes] - center) * scale[:, None]
    return points


def skirt(
    rng: np.random.Generator,
    anatomy: Anatomy,
    heights: tuple[float, float],
    ease: float,
    flare: float,
    pleats: tuple[float | int, float],
    gap: float = -1.0,
    spread: float = 0.0,
    cling: float = 0.0,
) -> Surface:
    """Makes a skirt: a tube around the hips and both legs.

    heights: template heights of the top and the bottom. ease: distance from hips and legs, metres.
    flare: growth of the radius, metres per metre downwards. pleats: number of pleats, and their
    depth in metres. gap: half of the width of an opening in front, metres; negative for none.
    spread: growth of half of the opening's width, metres per metre downwards. cling: length from
    the top over which the skirt does not flare, metres.
    """
    top, bottom = heights
    # rows are at most 35 mm high
    rows = max(3, int(np.ceil((top - bottom) / 0.035)) + 1)
    template_y, angle, faces = surfaces.tube(np.linspace(top, bottom, rows), surfaces.circle(72))
    height, drop = rest_height(anatomy, template_y), top - template_y
    below = drop - cling
    boundary = blurred(hanging(anatomy.hips_and_legs, 0.15))
    radius = boundary.radius(height, angle) + ease + flare * np.maximum(below, 0)
    # narrower below a top that hangs over it
    radius = radius - 0.009 * np.clip(1 - below / 0.06, 0, 1) * (cling > 0)
    waves = ripples(rng, surfaces.around(1, angle, 0.3 * height), wavelength=0.9)
    loose = np.clip(below / 0.25, 0, 1) * (drop / max(top - bottom, 1e-6)) ** 0.5
    radius = radius + loose * (
        pleats[1] * np.cos(pleats[0] * angle) + 0.012 * (1 + 4 * flare) * waves
    )
    vertices = surfaces.around(radius, angle, height).astype(np.float32)
    template = surfaces.around(0.16, angle, template_y, (0, 0.02))
    surface = Surface(vertices, faces, _skirt_weights(anatomy, vertices, template_y))
    surface = surface.painted(template, template - [0, 0, 0.02], 0.16)
    if gap > 0:
        front = np.where(vertices[:, 2] > 0, np.abs(vertices[:, 0]) - gap - spread * drop, 1.0)
        surface = surfaces.cut(surface, front)
    return surfaces.turn_in_hems(surface, 0.008)


def rest_height(anatomy: Anatomy, template_y: np.ndarray) -> np.ndarray:
    """Converts template heights on trunk and legs to heights of the person at rest, metres."""
    x, y, _ = anatomy.skin.template.T
    own = (np.abs(x) < 0.2) & (y < 0.14) & (y > ANKLE)
    bins = np.floor((y[own] - ANKLE) / 0.03).astype(int)
    counts = np.maximum(np.bincount(bins), 1)
    template = np.bincount(bins, y[own]) / counts
    rest = np.bincount(bins, anatomy.skin.vertices[own, 1]) / counts
    known = np.bincount(bins) > 0
    inside = np.interp(template_y, template[known], rest[known])
    below, above = template_y - template[known][0], template_y - template[known][-1]
    return inside + np.minimum(below, 0) + np.maximum(above, 0)


def _skirt_weights(
    anatomy: Anatomy, vertices: Points, template_y: Field
) -> Float[np.ndarray, "n j"]:
    """Returns the skinning weights (n, j) of a skirt.

    At the waist they are the trunk's weights. Further down they are blended into weights of thigh
    and shin. template_y: template heights of the vertices (n,).
    """
    x, y, _ = anatomy.skin.template.T
    near = np.flatnonzero((np.abs(x) < 0.2) & (y < 0.0) & (y > -0.4))[::2]
    trunk = nearest_weights(anatomy, vertices, near)
    left = smoothstep(-0.09, 0.09, vertices[:, 0])
    thigh = 0.96 * smoothstep(0.27, 0.47, -template_y)
    shin = 0.92 * smoothstep(0.68, 0.9, -template_y)
    legs = np.zeros_like(trunk)
    for side, share in ((0, left), (1, 1 - left)):
        legs[:, Joint.LEFT_HIP + side], legs[:, Joint.LEFT_KNEE + side] = (
            share * (1 - shin),
            share * shin,
        )
    return (trunk * (1 - thigh)[:, None] + legs * thigh[:, None]).astype(np.float32)


def nearest_weights(anatomy: Anatomy, points: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Returns the mean skinning weights (n, j) of the six body vertices nearest to each point.

    candidates: indices of the body's vertices that are considered.
    """
    body = anatomy.skin.vertices[candidates]
    squared = np.sum(points**2, -1)[:, None] - 2 * points @ body.T + np.sum(body**2, -1)[None]
    nearest = np.argpartition(squared, 6, axis=1)[:, :6]
    return anatomy.skin.weights[candidates][nearest].mean(1)
