"""Mistakes of bookkeeping that keypoints give away: sides, or cameras, that were exchanged.

Views of one moment that are right agree: the rays of a landmark meet. Each exchange that people and detectors make is undone on
trial, the clearest first, and reported if the views agree clearly better without it:

    sides     left and right of the keypoints of one view; from two views on, of which either may be the wrong one
    cameras   of two views, which is the same as their photos; from three views on: two agree as well the other way round
    hands     left and right keypoints of the hands alone, in one view

Left and right exchanged in all views meet as well: only a body that has to fit tells (`find_mirrored`).
"""

import dataclasses
import itertools

import jax
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import KeypointSet
from humangs_jax.fitting.agreement import Order, agreement, arranged, attainable
from humangs_jax.fitting.landmark_fit import FitConfig, LandmarkFit, fit_landmarks
from humangs_jax.fitting.observations import Observations

LEAST_GAIN, CHANCE = 0.1, 0.8
"""Agreement of n keypoints has to grow by LEAST_GAIN + CHANCE / sqrt(n) of what is attainable. Chance: without an exchange, 17
keypoints with 20 % of outliers and three times the expected noise gain up to 0.26, 67 less than nothing.
"""
MANY = 5
"""Of so many views or more, those that are right outvote one exchange: only what then looks better at once is tried."""
ALIKE = 0.9
"""Share of the gain from which another exchange explains as much: in a ring of evenly spaced cameras several are the same one."""
SAME_CAMERA = 1e-3
"""Share of the focal length, and metres, by which a camera that stands still may differ between moments."""
HANDS_SHARE = 0.3
"""Of the distance of the hands' roots from their own wrists: if they are so much nearer to the other ones, they are theirs."""
MIRRORED_SHARE, MIRRORED_GAIN = 0.6, 60.0
"""A mirrored person is meant if it costs less than this share of the given one, or so much less: outliers cost both the same."""


@dataclasses.dataclass(frozen=True)
class Swap:
    """One exchange that explains what does not agree; `str()` is a sentence about it.

    kind: "sides", "cameras", "all sides" or "hands". views: names of those concerned. instead: of those that would explain it as
    well, of cameras pairs ("a and b"). gain: how much more the views agree without it, as a share of what is attainable; of "all
    sides": by which share the cost of the fit falls. moments: of cameras, in how many; the views are those of the first.
    """

    kind: str
    views: tuple[str, ...]
    gain: float
    instead: tuple[str, ...] = ()
    moments: int = 1

    def __str__(self) -> str:
        """What seems to be wrong."""
        if self.kind == "all sides":
            return "left and right of the keypoints seem exchanged in all views: the mirrored person fits much better"
        if self.kind == "hands":
            return f"view {self.views[0]}: the keypoints of the hands seem exchanged: each lies at the other wrist"
        if self.kind == "cameras":
            moments = f", as in {self.moments} moments" if self.moments > 1 else ""
            other = f" (or those of {' or '.join(self.instead)} instead)" if self.instead else ""
            return f"the cameras (or the photos) of views {' and '.join(self.views)} seem exchanged{other}{moments}"
        other = f" (or in {' and '.join(self.instead)} instead)" if self.instead else ""
        return f"view {self.views[0]}: left and right of the keypoints seem exchanged{other}"


def find_swaps(
    observations: Observations, kind: KeypointSet, views: Int[np.ndarray, "m c"], names: tuple[str, ...]
) -> tuple[Swap, ...]:
    """Exchanged sides and cameras, the clearest first; none where a moment has one view, and no cameras where it has two.

    Arguments: observations: a batch of m moments. views: which of `names` each view is, -1: none, as `group_by_moment` has it.
    """
    rig = _Rig(observations, np.asarray(kind.mirror), views, _camera_numbers(observations, views))
    order, exchanges, shares = Order.given(*views.shape), [], np.zeros(views.shape)
    while True:
        state = _State.of(rig, order)
        flips = _clear_flips(rig, state)
        tried = _clear_exchanges(rig, state)
        best = max(tried, key=lambda each: each.gain, default=None)
        if best is not None and best.gain >= sum(flips[m].gain for m in best.moments if m in flips):
            exchanges.append(_cameras(best, tried, views, names))
            order = order.exchanged(best.moments, best.a, best.b)
        elif flips:
            moments, slots = (np.concatenate([getattr(x, key) for x in flips.values()]) for key in ("moments", "a"))
            shares[moments, order.source[moments, slots]] = [flip.share for flip in flips.values()]
            order = order.sides_exchanged(moments, slots)
        else:
            return tuple(sorted([*exchanges, *_sides(rig, state, shares, names)], key=lambda swap: -swap.gain))


def find_exchanged_hands(keypoints: Keypoints, names: tuple[str, ...]) -> tuple[Swap, ...]:
    """Views in which the hands' keypoints are at each other's wrists, as of hand detectors that are run on the wrong crops."""
    wanted = ("left_hand_root", "right_hand_root", "left_wrist", "right_wrist")
    if not set(wanted) <= set(keypoints.set.names):
        return ()
    rows = [keypoints.set.names.index(name) for name in wanted]
    left, right, left_wrist, right_wrist = np.moveaxis(keypoints.points[:, rows], 1, 0)
    seen = (keypoints.confidences[:, rows] > 0).all(1)
    apart = lambda a, b: np.linalg.norm(a - b, axis=-1)
    own, other = (apart(left, a) + apart(right, b) for a, b in ((left_wrist, right_wrist), (right_wrist, left_wrist)))
    exchanged = np.flatnonzero(seen & (other < HANDS_SHARE * own))
    return tuple(Swap("hands", (names[view],), float(1 - other[view] / own[view])) for view in exchanged)


def find_mirrored(
    model: LandmarkModel,
    observations: Observations,
    kind: KeypointSet,
    fit: LandmarkFit,
    config: FitConfig,
) -> tuple[Swap, ...]:
    """Left and right exchanged in all views: the keypoints are mirrored and fitted once more.

    Arguments: fit: of these observations by this configuration, so that nothing has to be compiled.
    """
    given = Order.given(observations.points.shape[0], observations.points.shape[1])
    everywhere = dataclasses.replace(given, mirrored=~given.mirrored)
    mirrored = arranged(observations, np.asarray(kind.mirror), everywhere)
    # of the last stage whose unit is the expected noise: the person's is the noise that each fit found for itself
    cost, other = (float(x.outcomes["hands"].after.sum()) for x in (fit, fit_landmarks(model, mirrored, config)))
    better = other < MIRRORED_SHARE * cost or other < cost - MIRRORED_GAIN
    return (Swap("all sides", (), 1 - other / cost),) if better else ()


@dataclasses.dataclass(frozen=True, eq=False)
class _Rig:
    """What is given. cameras: (m, c) equal numbers for one camera that stands still, -1: no view."""

    observations: Observations
    mirror: Int[np.ndarray, " k"]
    views: Int[np.ndarray, "m c"]
    cameras: Int[np.ndarray, "m c"]


@dataclasses.dataclass(frozen=True, eq=False)
class _State:
    """An order and how well the views agree in it.

    total: (m,). views: (m, c) that have keypoints. sides: (m, c) and pairs: (m, c, c) that are worth a trial.
    """

    order: Order
    confidences: Float[np.ndarray, "m c k"]
    total: Float[np.ndarray, " m"]
    views: Bool[np.ndarray, "m c"]
    sides: Bool[np.ndarray, "m c"]
    pairs: Bool[np.ndarray, "m c c"]

    @classmethod
    def of(cls, rig: _Rig, order: Order) -> "_State":
        seen = arranged(rig.observations, rig.mirror, order)
        found = jax.tree.map(np.asarray, agreement(seen, rig.mirror))
        confidences = np.asarray(seen.confidences)
        views = np.asarray((confidences > 0).any(-1))
        count = views.sum(-1)[:, None]
        own = np.diagonal(found.crossed, axis1=1, axis2=2)
        sides = (count < MANY) | (found.mirrored > own)
        better = found.crossed + found.crossed.swapaxes(1, 2) > own[:, :, None] + own[:, None]
        pairs = (count > 2)[..., None] & ((count < MANY)[..., None] | better)
        sides, pairs = sides & views & (count > 1), pairs & views[:, :, None] & views[:, None]
        return cls(order, confidences, found.own.sum(-1), views, sides, pairs)


@dataclasses.dataclass(frozen=True, eq=False)
class _Trial:
    """An exchange in some moments, of cameras a and b, or (b is None) of the sides of camera a.

    gain: agreement that it adds; share: of what is attainable, of `count` keypoints.
    """

    gain: float
    share: float
    count: int
    moments: Int[np.ndarray, " e"]
    a: Int[np.ndarray, " e"]
    b: Int[np.ndarray, " e"] | None = None

    @property
    def clear(self) -> bool:
        return self.share > LEAST_GAIN + CHANCE / max(self.count, 1) ** 0.5


def _gains(rig, state, order):
    """(m,) agreement that another order adds."""
    return np.asarray(agreement(arranged(rig.observations, rig.mirror, order), rig.mirror).own).sum(-1) - state.total


def _trial(gains, most, count, moments, a, b=None):
    """The trial of an exchange with these gains (e,) in e moments, of what is attainable most (m, c) and count (m, c)."""
    total = lambda values: values[moments, a].sum() + (0 if b is None else values[moments, b].sum())
    gain = float(gains.sum())
    return _Trial(gain, gain / max(float(total(most)), 1e-6), int(total(count)), moments, a, b)


def _clear_flips(rig, state):
    """By moment, the view whose sides are exchanged most clearly."""
    most, count = attainable(state.confidences, rig.mirror != np.arange(len(rig.mirror)))
    found: dict[int, _Trial] = {}
    for slot in np.flatnonzero(state.sides.any(0)):
        moments = np.flatnonzero(state.sides[:, slot])
        gains = _gains(rig, state, state.order.sides_exchanged(moments, np.full(len(moments), slot)))
        for moment in moments:
            trial = _trial(gains[[moment]], most, count, np.asarray([moment]), np.asarray([slot]))
            if trial.clear and (moment not in found or trial.gain > found[moment].gain):
                found[moment] = trial
    return found


def _clear_exchanges(rig, state):
    """Exchanges of two cameras in all of their moments together, and in each alone."""
    most, count = attainable(state.confidences, np.ones(len(rig.mirror), bool))
    several = state.views & (state.views.sum(-1, keepdims=True) > 2)
    cameras = lambda moment, a, b: tuple(sorted(rig.cameras[moment, [a, b]].tolist()))
    suspected = {cameras(*at) for at in np.argwhere(state.pairs)}
    tried: dict[tuple[int, ...], list[tuple[float, int, int, int]]] = {}
    for a, b in itertools.combinations(range(most.shape[1]), 2):
        moments = np.flatnonzero(several[:, a] & several[:, b])
        moments = np.asarray([moment for moment in moments if cameras(moment, a, b) in suspected], int)
        if len(moments):
            of = [np.full(len(moments), slot) for slot in (a, b)]
            gains = _gains(rig, state, state.order.exchanged(moments, *of))
            for moment in moments:
                tried.setdefault(cameras(moment, a, b), []).append((gains[moment], moment, a, b))
    alone = [[each] for of in tried.values() if len(of) > 1 for each in of]
    columns = [map(np.asarray, zip(*group, strict=True)) for group in (*tried.values(), *alone)]
    trials = [_trial(gains, most, count, *where) for gains, *where in columns]
    return [trial for trial in trials if trial.clear]


def _cameras(best, tried, views, names):
    """The swap of the best exchange, and the others of the same moments that gain as much."""
    name = lambda trial: tuple(names[v] for v in sorted(views[trial.moments[0], [trial.a[0], trial.b[0]]]))
    alike = [each for each in tried if each is not best and each.gain > ALIKE * best.gain]
    others = [" and ".join(name(each)) for each in alike if np.array_equal(each.moments, best.moments)]
    return Swap("cameras", name(best), best.share, tuple(others), len(best.moments))


def _sides(rig, state, shares, names):
    """A swap of each view whose sides are exchanged in the end; where that is half of the views, it may be the other half."""
    found = []
    seen = np.any(np.asarray(rig.observations.confidences) > 0, axis=-1)
    for views, mirrored, exists, gains in zip(rig.views, state.order.mirrored, seen, shares, strict=True):
        others = views[exists & ~mirrored]
        instead = tuple(names[v] for v in others) if len(others) == mirrored.sum() else ()
        found += [
            Swap("sides", (names[v],), gain, instead)
            for v, gain in zip(views[mirrored], gains[mirrored].tolist(), strict=True)
        ]
    return found


def _camera_numbers(observations, views):
    """(m, c) equal for views of one camera that stands still; -1 where there is no view."""
    focal = np.asarray(observations.K)[..., :1, 0]
    flat = lambda matrices: np.asarray(matrices).reshape(*views.shape, -1)
    cameras = np.concatenate([np.log(focal), flat(observations.K) / focal, flat(observations.cam_from_world)], axis=-1)
    numbers, known = np.full(views.shape, -1), np.empty((0, cameras.shape[-1]))
    for moment, slot in np.argwhere(views >= 0):
        same = np.flatnonzero(np.abs(known - cameras[moment, slot]).max(axis=-1) < SAME_CAMERA)
        numbers[moment, slot] = same[0] if len(same) else len(known)
        if not len(same):
            known = np.concatenate([known, cameras[moment, slot][None]])
    return numbers
