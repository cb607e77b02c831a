"""Compositing in float64 numpy, with bounds on the rounding of float32.

It is written from the formulas of `compositing`. A running error analysis (Higham, section 3.3)
keeps a bound beside every number, in units of the last place u = 2^-24. It holds for both
schedules, for any order of their sums, with or without fused multiplications. Bounds follow the
magnitudes of the terms, not the results, which cancel.
"""

from typing import NamedTuple

import numpy as np
from rounding import SCALE, UNIT

from humangs_jax.rendering.compositing_on_accelerators import CHUNK

EXP = LOG = 4
"""Roundings of an exponential or a logarithm; XLA's are good to two units in the last place."""


class Analysed(NamedTuple):
    """A schedule's values in float64, bounds of their float32 errors, and whether decisions are
    sure.
    """

    features: np.ndarray
    transmittance: np.ndarray
    sums: np.ndarray
    peaks: np.ndarray
    bounds: tuple[np.ndarray, ...]
    decided: bool


def analyse(splats, lists, grid, config, g, g_transmittance) -> Analysed:
    """Returns values and bounds for a schedule's arguments, float32 numbers in float64.

    `g` and `g_transmittance` are the cotangents of features (t, 4, p) and transmittance (t, p).
    """
    items, starts, counts = (np.asarray(a) for a in lists)
    t, p = len(counts), grid.pixels
    features, transmittance = np.zeros((t, 4, p)), np.ones((t, p))
    sums, peaks, decided = np.zeros((len(splats), 10)), np.zeros(len(splats)), True
    b_features, b_transmittance = np.zeros((t, 4, p)), np.zeros((t, p))
    b_sums, b_peaks = np.zeros((len(splats), 10)), np.zeros(len(splats))
    for tile in np.flatnonzero(counts):
        chosen = items[starts[tile] : starts[tile] + counts[tile]]
        row, cotangent, n = splats[chosen], g[tile], counts[tile]
        corner = np.array([tile % grid.columns, tile // grid.columns]) * grid.tile_size
        x, y = (row[:, :2] - corner - 0.5 * grid.tile_size).T[..., None]
        r00, r01, r11, log_opacity = row.T[2:6, :, None]
        px, py = np.asarray(grid.offsets(np.float64))

        # raw = exp(log opacity - u^2 - v^2): the roundings of u and v are those of their four and
        # two terms
        u, v = r00 * (x - px) + r01 * (y - py), r11 * (y - py)
        b_u = 5 * (abs(r00) * (abs(x) + abs(px)) + abs(r01) * (abs(y) + abs(py)))
        b_v = 4 * abs(r11) * (abs(y) + abs(py))
        b_exponent = 2 * abs(u) * b_u + 2 * abs(v) * b_v + 4 * (abs(log_opacity) + u * u + v * v)
        raw, e_raw = np.exp(log_opacity - u * u - v * v), b_exponent + EXP
        clamped = raw >= config.alpha_max
        alpha = np.where(raw < config.alpha_min, 0, np.minimum(raw, config.alpha_max))
        e_alpha = np.where(clamped, 1, e_raw)  # relative, as all that is called e

        # T by products, and by sums of logarithms
        fading = np.log1p(-alpha)
        e_left = alpha * e_alpha / (1 - alpha) + 1
        rank = np.arange(1, n + 1)[:, None]
        e_after = (
            np.cumsum(e_left + 1 + LOG * -fading, axis=0)
            - (rank + n // CHUNK + 1) * np.cumsum(fading, axis=0)
            + EXP
        )
        after = np.exp(np.cumsum(fading, axis=0))
        T, e_T = (
            np.concatenate([np.full((1, p), first), a[:-1]])
            for first, a in ((1.0, after), (0.0, e_after))
        )
        live = after > config.transmittance_stop
        w, e_w = np.where(live, alpha * T, 0), e_alpha + e_T + 1
        reached = np.concatenate([np.ones((1, p), bool), live[:-1]])
        margins = (
            abs(raw - config.alpha_min) / raw / e_raw,
            abs(raw - config.alpha_max) / raw / e_raw,
        )
        margins += (abs(after - config.transmittance_stop) / after / e_after,)
        decided &= all((margin[reached] > UNIT).all() for margin in margins)

        f = row[:, 6:]
        features[tile] = f.T @ w
        b_features[tile] = abs(f).T @ (w * (e_w + n + 1))
        transmittance[tile] = np.exp((fading * live).sum(0))
        b_transmittance[tile] = transmittance[tile] * np.where(live, e_after, 0).max(0)
        column, line = corner[:, None] + 0.5 * grid.tile_size + np.stack([px, py])
        shown = (column < grid.width) & (line < grid.height)
        np.maximum.at(peaks, chosen, (w * shown).max(1))
        np.maximum.at(b_peaks, chosen, (w * e_w * shown).max(1))

        # dL/dlog alpha = ((g . f) T - (Q - sum of w g . f so far) / (1 - alpha)) raw
        total = (cotangent * features[tile]).sum(0) + g_transmittance[tile] * transmittance[tile]
        size = (abs(cotangent) * abs(features[tile])).sum(0) + abs(
            g_transmittance[tile]
        ) * transmittance[tile]
        b_total = (
            (abs(cotangent) * b_features[tile]).sum(0)
            + abs(g_transmittance[tile]) * b_transmittance[tile]
            + 6 * size
        )
        along, along_size = f @ cotangent, abs(f) @ abs(cotangent)
        seen = np.cumsum(w * along, axis=0)
        seen_size = np.cumsum(w * along_size, axis=0)
        behind = total - seen
        b_behind = (
            b_total
            + np.cumsum(w * along_size * (e_w + 5), axis=0)
            + n * seen_size
            + size
            + seen_size
        )
        slope_size = raw * (along_size * T + abs(behind) / (1 - alpha))
        slope = np.where((w > 0) & ~clamped, (along * T - behind / (1 - alpha)) * raw, 0)
        b_slope = raw * (
            along_size * T * (e_T + 5) + (b_behind + abs(behind) * (e_left + 2)) / (1 - alpha)
        )
        b_slope = np.where(slope != 0, b_slope + slope_size * (e_raw + 3), 0)

        # moments about the tile's centre, moved to the splat's: terms as large as |pixel| + |splat|
        def powers(a, b):
            return np.stack(
                [np.ones_like(a * b), a + 0 * b, b + 0 * a, a * a + 0 * b, a * b, b * b + 0 * a]
            )

        moments = powers(px - x, py - y), powers(abs(px) + abs(x), abs(py) + abs(y))
        roundings = p + t + 10
        np.add.at(sums[:, :6], chosen, np.einsum("cnp,np->nc", moments[0], slope))
        np.add.at(
            b_sums[:, :6],
            chosen,
            np.einsum("cnp,np->nc", moments[1], b_slope + roundings * abs(slope)),
        )
        np.add.at(sums[:, 6:], chosen, w @ cotangent.T)
        np.add.at(b_sums[:, 6:], chosen, (w * (e_w + roundings)) @ abs(cotangent).T)
    bounds = tuple(SCALE * UNIT * b for b in (b_features, b_transmittance, b_sums, b_peaks))
    return Analysed(features, transmittance, sums, peaks, bounds, decided)
