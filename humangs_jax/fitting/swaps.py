"""Bookkeeping errors that keypoints reveal: exchanged sides, or exchanged cameras.

Views of one frame that are right agree: the rays of a landmark meet. Each exchange that people and detectors make is undone on
trial, the clearest first, and reported if the views then agree clearly better:

    sides     left and right of the keypoints of one view; needs two views, of which either may be the wrong one
    cameras   of two views, which is the same as their photos; needs three views

Left and right exchanged in all views agree as well: that is not found.

A view agrees with a landmark by how near its keypoint is to the best of the points that pairs of views propose
(`triangulation.triangulate_robustly`), so that outliers count little.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import KeypointSet
from humangs_jax.fitting.residuals.keypoints import Observations
from humangs_jax.fitting.state import camera_numbers
from humangs_jax.fitting.triangulation import agreement, triangulate_robustly

LEAST_GAIN, CHANCE = 0.1, 0.8
"""Agreement of n keypoints has to grow by LEAST_GAIN + CHANCE / sqrt(n) of what is attainable. By chance, without an exchange, 17
keypoints with 20 % of outliers and three times the expected noise gain up to 0.26; 67 keypoints gain nothing.
"""
MANY = 5
"""With this many views or more the right ones outvote an exchange: only exchanges that look better at once are tried."""
ALIKE = 0.9
"""Another exchange with this share of the gain explains as much: in a ring of evenly spaced cameras several are equivalent."""
SAME_CAMERA = 1e-3
"""Share of the focal length, and metres, by which a camera that stands still may differ between frames."""


@dataclasses.dataclass(frozen=True)
class Swap:
    """One exchange that explains a disagreement; `str()` is a sentence about it.

    views: names of the views. instead: alternatives that explain it as well; for cameras pairs ("a and b"). frames: for cameras,
    in how many; the views are those of the first.
    """

    kind: Literal["sides", "cameras"]
    views: tuple[str, ...]
    instead: tuple[str, ...] = ()
    frames: int = 1

    def __str__(self) -> str:
        if self.kind == "cameras":
            frames = f", as in {self.frames} frames" if self.frames > 1 else ""
            other = f" (or those of {' or '.join(self.instead)} instead)" if self.instead else ""
            return f"the cameras (or the photos) of views {' and '.join(self.views)} seem exchanged{other}{frames}"
        other = f" (or in {' and '.join(self.instead)} instead)" if self.instead else ""
        return f"view {self.views[0]}: left and right of the keypoints seem exchanged{other}"


def find_swaps(
    observations: Observations, kind: KeypointSet, views: Int[np.ndarray, "m c"], names: tuple[str, ...]
) -> tuple[Swap, ...]:
    """Exchanged cameras, and then sides. Frames need two views for sides and three for cameras.

    Arguments: observations: a batch of m frames. views: index into `names` of each view, -1: none, see `group_by_frame`.
    """
    mirror, cameras = np.asarray(kind.mirror), _camera_numbers(observations, views)
    order, exchanges = given(*views.shape), []
    while True:
        flips, tried = _clear_trials(observations, mirror, cameras, order)
        best = max(tried, key=lambda each: each.gain, default=None)
        if best is not None and best.gain >= sum(flips[m].gain for m in best.frames if m in flips):
            exchanges.append(_cameras(best, tried, views, names))
            order = order.exchanged(best.frames, best.a, best.b)
        elif flips:
            frames, slots = (np.concatenate([getattr(x, key) for x in flips.values()]) for key in ("frames", "a"))
            order = order.exchanged(frames, slots, None)
        else:
            return (*exchanges, *_sides(observations, views, order, names))


# How well views agree --------------------------------------------------------------------------------------------------


class Order(NamedTuple):
    """Which keypoints the c cameras of m frames get.

    source: (m, c) camera that they come from. mirrored: (m, c) by source, whether left and right are exchanged.
    """

    source: Int[np.ndarray, "m c"]
    mirrored: Bool[np.ndarray, "m c"]

    def exchanged(self, frames: Int[np.ndarray, " e"], a: Int[np.ndarray, " e"], b: Int[np.ndarray, " e"] | None) -> "Order":
        """The order with the keypoints of cameras a and b exchanged in some frames, or without b left and right of camera a's."""
        source, mirrored = self.source.copy(), self.mirrored.copy()
        if b is None:
            mirrored[frames, source[frames, a]] ^= True
        else:
            source[frames, a], source[frames, b] = self.source[frames, b], self.source[frames, a]
        return Order(source, mirrored)


def given(frames: int, views: int) -> Order:
    """Every camera has its own keypoints."""
    return Order(np.tile(np.arange(views), (frames, 1)), np.zeros((frames, views), bool))


def arranged(observations: Observations, mirror: Int[np.ndarray, " k"], order: Order) -> Observations:
    """The keypoints of m frames in an order. mirror: index of each keypoint's mirror image."""
    rows = np.arange(len(order.source))[:, None]
    columns = np.where(order.mirrored[rows, order.source, None], mirror, np.arange(len(mirror)))
    pick = lambda values: jnp.asarray(np.asarray(values)[rows[..., None], order.source[..., None], columns])
    # where left and right are exchanged the detector may have seen the body turned round: its depths say nothing then
    world = None if observations.world is None or order.mirrored.any() else pick(observations.world)
    return replace(observations, points=pick(observations.points), confidences=pick(observations.confidences), world=world)


class Agreement(NamedTuple):
    """How well c views agree with the points that they agree on best: confidences summed over keypoints, less for larger errors.

    own: (c,) with the keypoints as they are. crossed: (c, c) if the first view had the second's keypoints, and mirrored: (c,)
    with left and right exchanged, both without new triangulation.
    """

    own: Float[Array, " c"]
    crossed: Float[Array, "c c"]
    mirrored: Float[Array, " c"]


@jax.jit
def _agreements(observations: Observations, mirror: Int[Array, " k"] | Int[np.ndarray, " k"]) -> Agreement:
    """How well the views of each frame agree, a batch of m. mirror: index of each keypoint's mirror image."""

    def of_frame(seen):
        points, counts, weights = triangulate_robustly(seen)

        def near(keypoints, confidences):
            """Agreement (c,) of all views if each had these keypoints (k, 2)."""
            everywhere = lambda own, of: jnp.broadcast_to(own, of.shape)
            alike = replace(
                seen, points=everywhere(keypoints, seen.points), confidences=everywhere(confidences, seen.confidences)
            )
            return jnp.sum((counts >= 2) * agreement(alike, points), axis=-1)

        crossed = jax.vmap(near, out_axes=1)(seen.points, seen.confidences)
        mirrored = jnp.diagonal(jax.vmap(near, out_axes=1)(seen.points[:, mirror], seen.confidences[:, mirror]))
        return Agreement(jnp.sum(weights, axis=-1), crossed, mirrored)

    return jax.lax.map(of_frame, observations)


# Trials --------------------------------------------------------------------------------------------------------------


class _Trial(NamedTuple):
    """An exchange in some frames, of cameras a and b, or of the sides of camera a if b is None. gain: agreement that it adds."""

    gain: float
    frames: Int[np.ndarray, " e"]
    a: Int[np.ndarray, " e"]
    b: Int[np.ndarray, " e"] | None


def _clear_trials(
    observations: Observations, mirror: Int[np.ndarray, " k"], cameras: Int[np.ndarray, "m c"], order: Order
) -> tuple[dict[int, _Trial], list[_Trial]]:
    """The exchanges of keypoints in an order that are clear: by frame that of the sides of one view which adds most; and those of
    two cameras, in all of their frames together, and in each alone.

    Arguments: cameras: (m, c) equal numbers for one camera that stands still, -1: no view.
    """
    seen = arranged(observations, mirror, order)
    found = jax.tree.map(np.asarray, _agreements(seen, mirror))
    confidences, frame_count = np.asarray(seen.confidences), len(cameras)
    shown = (confidences > 0).any(-1)
    count, own = shown.sum(-1)[:, None], np.diagonal(found.crossed, axis1=1, axis2=2)

    def gains(frames, a, b=None):
        """(e,) agreement that an exchange adds in each of its frames."""
        after = _agreements(arranged(observations, mirror, order.exchanged(frames, a, b)), mirror).own
        return (np.asarray(after).sum(-1) - found.own.sum(-1))[frames]

    def clear(gain, of, frames, a, b=None):
        """The exchange of the keypoints `of`, or None: attainable is that all agree that another view sees."""
        known = (confidences > 0) & of
        shared = known & (known.sum(axis=1, keepdims=True) > 1)
        total = lambda values: float(sum(values[frames, slots].sum() for slots in (a, b) if slots is not None))
        most, number = total((confidences * shared).sum(-1)), total(shared.sum(-1))
        share = gain / max(most, 1e-6)
        return _Trial(gain, frames, a, b) if share > LEAST_GAIN + CHANCE / max(number, 1) ** 0.5 else None

    flips: dict[int, _Trial] = {}
    sides = shown & (count > 1) & ((count < MANY) | (found.mirrored > own))
    sided, every = mirror != np.arange(len(mirror)), np.ones(len(mirror), bool)
    for slot in np.flatnonzero(sides.any(0)):
        frames = np.flatnonzero(sides[:, slot])
        for frame, gain in zip(frames.tolist(), gains(frames, np.full(len(frames), slot)).tolist(), strict=True):
            trial = clear(gain, sided, np.asarray([frame]), np.asarray([slot]))
            if trial is not None and (frame not in flips or gain > flips[frame].gain):
                flips[frame] = trial

    better = found.crossed + found.crossed.swapaxes(1, 2) > own[:, :, None] + own[:, None]
    several = shown & (count > 2)
    pairs = several[:, :, None] & several[:, None] & ((count < MANY)[..., None] | better)
    numbers = lambda frame, a, b: tuple(sorted(cameras[frame, [a, b]].tolist()))
    suspected = {numbers(*at) for at in np.argwhere(pairs)}
    tried: dict[tuple[int, ...], list[tuple[float, int, int, int]]] = {}
    for a, b in itertools.combinations(range(cameras.shape[1]), 2):
        both = [m for m in range(frame_count) if several[m, a] and several[m, b] and numbers(m, a, b) in suspected]
        if both:
            frames = np.asarray(both)
            for frame, gain in zip(both, gains(frames, np.full(len(frames), a), np.full(len(frames), b)), strict=True):
                tried.setdefault(numbers(frame, a, b), []).append((float(gain), frame, a, b))
    alone = [[each] for group in tried.values() if len(group) > 1 for each in group]
    exchanges = []
    for group in (*tried.values(), *alone):
        own_gains, *where = map(np.asarray, zip(*group, strict=True))
        exchanges.append(clear(float(own_gains.sum()), every, *where))
    return flips, [trial for trial in exchanges if trial is not None]


def _cameras(best: _Trial, tried: Sequence[_Trial], views: Int[np.ndarray, "m c"], names: Sequence[str]) -> Swap:
    """The swap of the best exchange, and the others of the same frames that gain as much."""
    name = lambda trial: tuple(names[v] for v in sorted(views[trial.frames[0], [trial.a[0], trial.b[0]]]))
    alike = [each for each in tried if each is not best and each.gain > ALIKE * best.gain]
    others = [" and ".join(name(each)) for each in alike if np.array_equal(each.frames, best.frames)]
    return Swap("cameras", name(best), tuple(others), len(best.frames))


def _sides(observations: Observations, views: Int[np.ndarray, "m c"], order: Order, names: Sequence[str]) -> list[Swap]:
    """A swap for each view whose sides are exchanged; if these are half of the views, it may be the other half."""
    found = []
    seen = np.any(np.asarray(observations.confidences) > 0, axis=-1)
    for own, mirrored, exists in zip(views, order.mirrored, seen, strict=True):
        others = own[exists & ~mirrored]
        instead = tuple(names[v] for v in others) if len(others) == mirrored.sum() else ()
        found += [Swap("sides", (names[v],), instead) for v in own[mirrored]]
    return found


def _camera_numbers(observations: Observations, views: Int[np.ndarray, "m c"]) -> Int[np.ndarray, "m c"]:
    """(m, c) equal for views of one camera that stands still; -1 where there is no view."""
    there = np.nonzero(views >= 0)
    matrices = (np.asarray(x, np.float64)[there] for x in (observations.K, observations.cam_from_world))
    numbers = np.full(views.shape, -1)
    numbers[there] = camera_numbers(*matrices, SAME_CAMERA)
    return numbers
