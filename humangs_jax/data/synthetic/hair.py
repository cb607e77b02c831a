"""Hair: shells grown from the scalp, tubes that fall over neck and back, buns, ponytails, beards; and knitted caps.

A hairline is a template height for each azimuth around the skull (0 in front, pi at the nape), the same on both sides.
"""

import numpy as np

from humangs_jax.data.synthetic import slices
from humangs_jax.data.synthetic.anatomy import Anatomy, smoothstep
from humangs_jax.data.synthetic.garments import nearest_weights, smooth_weights
from humangs_jax.data.synthetic.noise import ripples
from humangs_jax.data.synthetic.poses import HEAD, NECK, SPINE3
from humangs_jax.data.synthetic.surfaces import (
    Surface,
    cut,
    grid_faces,
    join,
    smooth,
    turn_in_hems,
    unit,
)

SKULL = np.asarray([0.0, 0.345, 0.02])
"""Middle of the skull in template coordinates."""
CROWN, NECK_HEIGHT = 0.4356, 0.189

SHORT_LINE = (
    [0.0, 0.55, 0.95, 1.2, 1.36, 1.42, 1.86, 1.95, 2.3, 3.15],
    [0.392, 0.388, 0.368, 0.325, 0.312, 0.353, 0.353, 0.275, 0.234, 0.226],
)
"""Azimuths and heights: forehead, temple, sideburn before the ear, above and behind the ear, nape."""
LONG_LINE = ([0.0, 0.5, 0.9, 1.12, 1.2, 3.15], [0.394, 0.388, 0.362, 0.30, -9.0, -9.0])
"""Covers the ears; no lower end."""
CAP_LINE = ([0.0, 0.8, 1.5, 2.2, 3.15], [0.375, 0.37, 0.345, 0.325, 0.315])
TUBE_COLUMNS = 60


def azimuth(template: np.ndarray) -> np.ndarray:
    """(n,) angle around the skull in [0, pi]: 0 in front, pi at the nape."""
    return np.abs(np.arctan2(np.abs(template[:, 0]), template[:, 2] - SKULL[2]))


def above_line(template: np.ndarray, line: tuple, shift: float = 0.0) -> np.ndarray:
    """(n,) height above a hairline; strongly negative away from the head."""
    above = template[:, 1] - np.interp(azimuth(template), *line) - shift
    return np.where((template[:, 1] > 0.2) & (np.abs(template[:, 0]) < 0.12), above, -1.0)


def scalp_shell(
    rng, anatomy: Anatomy, thickness: float, bumps: float, line: tuple = SHORT_LINE, shift: float = 0.0
) -> Surface:
    """Short hair: the scalp moved out by a thickness (metres) that runs out at the hairline, with bumps (share of it)."""
    above = above_line(anatomy.skin.attributes["template"], line, shift)
    surface = cut(anatomy.skin.with_attributes(above=above), above)
    normals = unit(smooth(surface.attributes["normals"], surface.faces, 8))
    full = smoothstep(-0.002, 0.022, surface.attributes["above"])
    grown = thickness * full * (1 + bumps * ripples(rng, surface.attributes["template"], 0.05)) + 0.0025
    base = smooth(surface.vertices, surface.faces, 3, keep_hems=True)
    return _finish(surface.moved(base + grown[:, None] * normals), 0.006)


def falling_tube(
    rng, anatomy: Anatomy, thickness: float, bottom: float, line: tuple = LONG_LINE, wave: float = 0.004
) -> Surface:
    """Long hair or a cap: the skull's outline scaled up, then falling to the template height `bottom` at the back.

    At the sides it ends on the shoulders.
    """
    skin, template = anatomy.skin, anatomy.skin.attributes["template"]
    to_rest = _rest_heights(anatomy)
    center = np.asarray([0.0, to_rest(SKULL[1]), anatomy.joints[HEAD, 2] - 0.01])
    scale = 1 + thickness / 0.09
    ears = (np.abs(template[:, 0]) > 0.0735) & (template[:, 1] > 0.26) & (template[:, 1] < 0.36)
    head = (template[:, 1] > 0.24) & (np.abs(template[:, 0]) < 0.1) & ~ears & (template[:, 2] < 0.125)
    levels = np.concatenate([np.arange(-0.3, 0.24, 0.02), np.linspace(0.24, CROWN - 0.0015, 24)])
    spine = np.repeat(center[None, [0, 2]], len(levels), 0)
    points = skin.vertices[head]
    skull = slices.blurred(slices.outlines(points[:, 1], points[:, [0, 2]], to_rest(levels), spine, 0.012))
    falling = slices.hanging(skull, 0.25)
    trunk = (np.abs(template[:, 0]) < 0.12) & (template[:, 1] < 0.24) & (template[:, 1] > -0.35)
    points = skin.vertices[trunk]
    back = slices.blurred(slices.outlines(points[:, 1], points[:, [0, 2]], to_rest(levels), spine, 0.02), 2)

    angle = np.arange(TUBE_COLUMNS) * (2 * np.pi / TUBE_COLUMNS)
    top = CROWN + (CROWN - SKULL[1]) * (scale - 1)
    dome = SKULL[1] + (top - SKULL[1]) * np.sin(np.linspace(np.pi / 2, 0, 12))
    rows = np.concatenate([dome, np.arange(SKULL[1] - 0.02, min(bottom, 0.3), -0.022)])
    row_height, around = (x.reshape(-1) for x in np.meshgrid(rows, angle, indexing="ij"))
    height = to_rest(row_height)
    inner = center[1] + (height - center[1]) / scale
    brim, summit = to_rest(0.385), center[1] + (to_rest(top) - center[1]) / scale
    vault = np.sqrt(np.clip(1 - np.clip((inner - brim) / (summit - brim), 0, 1) ** 2, 0, 1))  # the dome above the brim
    radius = scale * vault * falling.radius(np.minimum(inner, brim), around)
    below = smoothstep(0.0, 0.12, SKULL[1] - row_height)
    radius = np.maximum(
        radius, (back.radius(height, around) + 0.034 * smoothstep(-0.23, -0.17, -row_height)) * (row_height < 0.24)
    )
    radius = radius + below * wave * ripples(
        rng, np.stack([3 * np.sin(around), height * 4, 3 * np.cos(around)], -1), 1.2
    )
    vertices = np.stack([center[0] + radius * np.sin(around), height, center[2] + radius * np.cos(around)], -1)
    sides = np.abs((around + np.pi) % (2 * np.pi) - np.pi)
    ends = np.interp(sides, [0, 1.2, 1.75, 2.2, np.pi], [0.15, 0.15, max(bottom, 0.15), bottom, bottom])
    ends = ends + 0.012 * ripples(rng, np.stack([5 * np.sin(around), 0 * around, 5 * np.cos(around)], -1), 1.5)
    field = np.minimum(row_height - np.interp(sides, *line), row_height - ends)
    flat = np.stack([0.09 * np.sin(around), row_height, SKULL[2] + 0.09 * np.cos(around)], -1).astype(np.float32)
    weights = _falling_weights(anatomy, vertices.astype(np.float32), row_height)
    faces = grid_faces(len(rows), TUBE_COLUMNS, closed=True)
    surface = Surface(vertices.astype(np.float32), faces, weights, {"template": flat})
    surface = surface.with_attributes(
        cloth=np.concatenate(
            [flat - np.asarray([0, 0, 0.02], np.float32), np.full((len(flat), 1), 0.09, np.float32)], 1
        )
    )
    surface = cut(surface, field)
    return _finish(surface.moved(smooth(surface.vertices, surface.faces, 1, keep_hems=True)), 0.008)


def bun(rng, anatomy: Anatomy, radius: float, elevation: float) -> Surface:
    """A ball of hair on the back of the head."""
    to_rest = _rest_heights(anatomy)
    direction = np.asarray([0, np.sin(elevation), -np.cos(elevation)])
    center = np.asarray([0, to_rest(SKULL[1]), anatomy.joints[HEAD, 2] - 0.01]) + direction * (0.095 + 0.55 * radius)
    return _rigid(anatomy, _ball(center, radius * np.asarray([1.0, 0.9, 0.85])), HEAD)


def ponytail(rng, anatomy: Anatomy, length: float) -> Surface:
    """A tapering tail from the back of the head down the back."""
    to_rest = _rest_heights(anatomy)
    start = np.asarray([0, to_rest(0.36), anatomy.joints[HEAD, 2] - 0.105])
    t = np.linspace(0, 1, 14)
    line = start + np.stack([0 * t, -length * t**1.3, -0.05 * np.sin(np.pi * np.minimum(t * 1.6, 1) / 1.3) - 0.01], -1)
    radius = np.interp(t, [0, 0.12, 0.4, 0.8, 1], [0.016, 0.026, 0.032, 0.024, 0.004])
    angle = np.arange(16) * (2 * np.pi / 16)
    ring = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    vertices = (line[:, None] + radius[:, None, None] * ring[None]).reshape(-1, 3).astype(np.float32)
    weights = np.zeros((len(vertices), anatomy.skin.weights.shape[1]), np.float32)
    follow = smoothstep(0.1, 1.0, np.repeat(t, 16)) * 0.8
    weights[:, HEAD], weights[:, SPINE3] = 1 - follow, follow
    return _painted(Surface(vertices, grid_faces(14, 16, closed=True), weights))


def beard(rng, anatomy: Anatomy, thickness: float) -> Surface:
    """A beard on chin and jaw."""
    t = anatomy.skin.attributes["template"]
    x, y, z = np.abs(t[:, 0]), t[:, 1], t[:, 2]
    lips = 1 - (x / 0.03) ** 2 - ((y - 0.2625) / 0.0145) ** 2
    field = np.minimum.reduce(
        [0.283 - 0.2 * np.maximum(0.035 - x, 0) + 0.25 * np.maximum(x - 0.035, 0) - y, y - 0.2, z - 0.02, -0.02 * lips]
    )
    field = np.where((y > 0.19) & (x < 0.08), field, -1.0)
    surface = cut(anatomy.skin.with_attributes(above=field), field)
    normals = unit(smooth(surface.attributes["normals"], surface.faces, 4))
    full = smoothstep(0.0, 0.012, surface.attributes["above"])
    grown = thickness * full * (1 + 0.3 * ripples(rng, surface.attributes["template"], 0.02)) + 0.0012
    return _finish(surface.moved(surface.vertices + grown[:, None] * normals), 0.003)


def _finish(surface, depth):
    weights = smooth_weights(surface.weights, surface.faces, 2)
    kept = {name: surface.attributes[name] for name in ("template", "cloth")}
    return turn_in_hems(Surface(surface.vertices, surface.faces, weights, kept), depth)


def _painted(surface):
    """Template and cloth coordinates of hair that does not come from the scalp: its own position."""
    flat = surface.vertices - surface.vertices.mean(0)
    cloth = np.concatenate([flat, np.full((len(flat), 1), 0.09)], 1).astype(np.float32)
    return surface.with_attributes(template=(flat + SKULL).astype(np.float32), cloth=cloth)


def _rigid(anatomy, vertices_and_faces, joint):
    vertices, faces = vertices_and_faces
    weights = np.zeros((len(vertices), anatomy.skin.weights.shape[1]), np.float32)
    weights[:, joint] = 1
    return _painted(Surface(vertices, faces, weights))


def _ball(center, radii, rows=12, columns=20):
    polar, around = (
        x.reshape(-1)
        for x in np.meshgrid(np.linspace(0, np.pi, rows), np.arange(columns) * 2 * np.pi / columns, indexing="ij")
    )
    directions = np.stack([np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], -1)
    return (center + directions * radii).astype(np.float32), grid_faces(rows, columns, closed=True)


def eyeballs(anatomy: Anatomy) -> Surface:
    """Two balls in the sockets; their `template` attribute is the unit direction from the ball's middle."""
    parts = []
    for joint in (23, 24):
        center = anatomy.joints[joint]
        lids = np.sort(np.linalg.norm(anatomy.skin.vertices - center, axis=1))[:12]
        directions, faces = _ball(np.zeros(3), np.ones(3), 14, 22)
        weights = np.zeros((len(directions), anatomy.skin.weights.shape[1]), np.float32)
        weights[:, joint] = 1
        cloth = np.concatenate([directions, np.ones((len(directions), 1), np.float32)], 1)
        attributes = {"template": directions, "cloth": cloth}
        parts.append(
            Surface((center + directions * lids.mean() * 0.985).astype(np.float32), faces, weights, attributes)
        )
    return join(parts)


def _rest_heights(anatomy):
    """Template heights of head and neck -> rest heights of the person."""
    neck = anatomy.joints[NECK, 1]
    factor = (anatomy.skin.vertices[:, 1].max() - neck) / (CROWN - NECK_HEIGHT)
    return lambda y: neck + (y - NECK_HEIGHT) * factor


def _falling_weights(anatomy, vertices, template_y):
    """The head's above the jaw; further down more and more of what lies below."""
    template = anatomy.skin.attributes["template"]
    near = np.flatnonzero((np.abs(template[:, 0]) < 0.15) & (template[:, 1] > -0.3) & (template[:, 1] < 0.26))[::2]
    head = np.zeros((len(vertices), anatomy.skin.weights.shape[1]), np.float32)
    head[:, HEAD] = 1
    own = smoothstep(0.06, 0.25, template_y)[:, None]
    lower = template_y < 0.26
    trunk = head.copy()
    trunk[lower] = nearest_weights(anatomy, vertices[lower], near)
    return (head * own + trunk * (1 - own)).astype(np.float32)
