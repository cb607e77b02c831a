"""Finds exchanges that keypoints reveal: exchanged sides, cameras or hands.

Correct views of one frame agree: the rays of a landmark meet. The search tries to undo exchanges
that people and detectors often make. The best trial counts as a found exchange if the views agree
clearly better in it, and the search goes on with corrected keypoints. It ends when no trial is
clearly better. Kinds of exchanges are:

    sides     left and right of the keypoints of one view; needs two views, and either of the two
              may be the wrong one
    cameras   the cameras of two views; exchanged photos look the same; needs three views
    hands     left and right keypoints of the hands alone, in one view; found without trials, by
              the distances from the wrists

If left and right are exchanged in all views, the views agree too, and nothing is found.

Pairs of views propose a point for each landmark, and the best proposal is taken
(`triangulation.triangulate_robustly`). A view agrees with a landmark if its keypoint is near this
point. So outliers count little.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.capture.fitting.residuals.keypoints import Observations
from humangs_jax.capture.fitting.state import camera_numbers
from humangs_jax.capture.fitting.triangulation import agreement, triangulate_robustly
from humangs_jax.capture.keypoints.keypoints import Keypoints, KeypointSet
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import replace


@dataclasses.dataclass(frozen=True)
class _Clear:
    """Limits that decide whether an exchange clearly explains a disagreement."""

    least_gain: float = 0.1
    """An exchange is clear if it adds more than the share least_gain + chance / sqrt(n) of the
    largest possible agreement of n keypoints. These are the exchanged keypoints of landmarks that
    at least two views see.
    """
    chance: float = 0.8
    """See `least_gain`. This term allows for what an exchange gains by chance. In correct views
    with 20 % of outliers and three times the expected noise, an exchange of 17 keypoints gains up
    to 0.26 of the largest possible agreement, and an exchange of 67 keypoints gains nothing.
    """
    many: int = 5
    """In frames with at least this many views, an exchange is tried only if it improves the
    agreement with the points that were triangulated before the exchange. This suffices, because the
    other views outvote the exchanged ones.
    """
    alike: float = 0.9
    """Another exchange is an alternative if it gains more than this share of what the best one
    gains. In a ring of evenly spaced cameras several exchanges are equivalent.
    """


_CLEAR = _Clear()


@dataclasses.dataclass(frozen=True)
class Swap:
    """One exchange that explains a disagreement. `str()` returns a sentence about it."""

    kind: Literal["sides", "cameras", "hands"]
    """What is exchanged."""
    views: tuple[str, ...]
    """Names of the views that are exchanged. If cameras are exchanged in several frames, these are
    their views in the first of these frames.
    """
    instead: tuple[str, ...] = ()
    """Alternatives that explain the disagreement about as well. They are names of views, or for
    cameras pairs of names ("a and b").
    """
    frames: int = 1
    """Number of frames in which the cameras are exchanged."""

    def __str__(self) -> str:
        if self.kind == "hands":
            return (
                f"view {self.views[0]}: the keypoints of the hands seem exchanged: each lies at the"
                " other wrist"
            )
        if self.kind == "cameras":
            frames = f", as in {self.frames} frames" if self.frames > 1 else ""
            other = f" (or those of {' or '.join(self.instead)} instead)" if self.instead else ""
            return (
                f"the cameras (or the photos) of views {' and '.join(self.views)} seem"
                f" exchanged{other}{frames}"
            )
        other = f" (or in {' and '.join(self.instead)} instead)" if self.instead else ""
        return f"view {self.views[0]}: left and right of the keypoints seem exchanged{other}"


def find_swaps(
    observations: Observations,
    kind: KeypointSet,
    views: Int[np.ndarray, "m c"],
    names: tuple[str, ...],
) -> tuple[Swap, ...]:
    """Returns exchanged cameras in the order in which they were found, and then exchanged sides in
    the order of frames and views. Sides are found in frames with at least two views, cameras in
    frames with at least three.

    Args:
        observations: keypoints, a batch of m frames.
        kind: set of the keypoints.
        views: index of each view in `names`, (m, c). -1 where there is no view, see
            `group_by_frame`.
        names: names of all views.
    """
    mirror, cameras = np.asarray(kind.mirror), _camera_numbers(observations, views)
    order, exchanges = given(*views.shape), []
    while True:
        search = _Search(observations, mirror, cameras, order)
        flips, tried = search.flips(), search.exchanges()
        best = max(tried, key=lambda each: each.gain, default=None)
        if best is not None and best.gain >= sum(flips[m].gain for m in best.frames if m in flips):
            exchanges.append(_cameras(best, tried, views, names))
            order = order.exchanged(best.frames, best.a, best.b)
        elif flips:
            frames = np.concatenate([flip.frames for flip in flips.values()])
            slots = np.concatenate([flip.a for flip in flips.values()])
            order = order.exchanged(frames, slots, None)
        else:
            return (*exchanges, *_sides(observations, views, order, names))


def find_exchanged_hands(keypoints: Keypoints, names: tuple[str, ...]) -> tuple[Swap, ...]:
    """Returns a swap for each view in which the keypoints of each hand lie at the other hand's
    wrist. The result is empty if the set of keypoints lacks roots of hands or wrists.
    """
    wanted = ("left_hand_root", "right_hand_root", "left_wrist", "right_wrist")
    if not set(wanted) <= set(keypoints.set.names):
        return ()
    rows = [keypoints.set.names.index(name) for name in wanted]
    hands, wrists = np.split(keypoints.points[:, rows], 2, axis=1)
    own, other = (np.linalg.norm(hands - at, axis=-1).sum(1) for at in (wrists, wrists[:, ::-1]))
    # roots of exchanged hands are plainly nearer to the other wrists
    exchanged = (keypoints.confidences[:, rows] > 0).all(1) & (other < 0.3 * own)
    return tuple(Swap("hands", (names[view],)) for view in np.flatnonzero(exchanged))


# How well views agree
# --------------------------------------------------------------------------------------------------


class Order(NamedTuple):
    """Which keypoints each of c cameras has in m frames."""

    source: Int[np.ndarray, "m c"]
    """Index of the camera whose keypoints are used, (m, c)."""
    mirrored: Bool[np.ndarray, "m c"]
    """Whether left and right of a camera's keypoints are exchanged, (m, c). The second axis is the
    camera that the keypoints come from.
    """

    def exchanged(
        self,
        frames: Int[np.ndarray, " e"],
        a: Int[np.ndarray, " e"],
        b: Int[np.ndarray, " e"] | None,
    ) -> "Order":
        """Returns the order after another exchange in some frames.

        Cameras a and b exchange their keypoints. If b is None, left and right of the keypoints that
        camera a has are exchanged.
        """
        source, mirrored = self.source.copy(), self.mirrored.copy()
        if b is None:
            mirrored[frames, source[frames, a]] ^= True
        else:
            source[frames, a], source[frames, b] = self.source[frames, b], self.source[frames, a]
        return Order(source, mirrored)


def given(frames: int, views: int) -> Order:
    """Returns the order without any exchange."""
    return Order(np.tile(np.arange(views), (frames, 1)), np.zeros((frames, views), bool))


def _arranged(
    observations: Observations, mirror: Int[np.ndarray, " k"], order: Order
) -> Observations:
    """Returns the keypoints of m frames after the exchanges of an `Order`. The cameras stay. If the
    order exchanges left and right anywhere, the result has no 3D landmarks.

    mirror: index of each keypoint's mirror image, (k,).
    """
    rows = np.arange(len(order.source))[:, None]
    columns = np.where(order.mirrored[rows, order.source, None], mirror, np.arange(len(mirror)))

    def pick(values):
        """Returns values of the keypoints, (m, c, k, ...), after the exchanges of the order."""
        return from_host(np.asarray(values)[rows[..., None], order.source[..., None], columns])

    # where left and right are exchanged the detector may have seen the body turned round: its
    # depths say nothing then
    world = None
    if observations.world is not None and not order.mirrored.any():
        world = pick(observations.world)
    return replace(
        observations,
        points=pick(observations.points),
        confidences=pick(observations.confidences),
        world=world,
    )


class Agreement(NamedTuple):
    """How well the keypoints of c views agree with robustly triangulated points. Agreement is a sum
    of confidences over the keypoints, in which a larger error gives less weight.

    The points are triangulated from the keypoints as they are, and not again for each exchange.
    """

    own: Float[Array, " c"]
    """Agreement of each view, (c,)."""
    crossed: Float[Array, "c c"]
    """Agreement of view i if it had the keypoints of view j, (c, c). Axes are i and j."""
    mirrored: Float[Array, " c"]
    """Agreement of each view if left and right of its keypoints were exchanged, (c,)."""


@compiled()
def agreements(
    observations: Observations, mirror: Int[Array, " k"] | Int[np.ndarray, " k"]
) -> Agreement:
    """Returns how well the views of each frame agree, a batch of m. mirror: index of each
    keypoint's mirror image, (k,).
    """

    def of_frame(seen):
        points, counts, weights = triangulate_robustly(seen)

        def near(keypoints, confidences):
            """Returns how well each view would agree with the triangulated points if it had these
            keypoints, (c,). Only points that are triangulated from at least two views count.

            keypoints: (k, 2), pixels. confidences: (k,).
            """
            alike = replace(
                seen,
                points=jnp.broadcast_to(keypoints, seen.points.shape),
                confidences=jnp.broadcast_to(confidences, seen.confidences.shape),
            )
            return jnp.sum((counts >= 2) * agreement(alike, points), axis=-1)

        crossed = jax.vmap(near, out_axes=1)(seen.points, seen.confidences)
        mirrored = jnp.diagonal(
            jax.vmap(near, out_axes=1)(seen.points[:, mirror], seen.confidences[:, mirror])
        )
        return Agreement(jnp.sum(weights, axis=-1), crossed, mirrored)

    return jax.lax.map(of_frame, observations)


# Trials
# --------------------------------------------------------------------------------------------------


class _Trial(NamedTuple):
    """An exchange in some frames, and how much agreement it gains."""

    gain: float
    """Agreement that the exchange adds."""
    frames: Int[np.ndarray, " e"]
    """Indices of the frames, (e,)."""
    a: Int[np.ndarray, " e"]
    """Camera whose keypoints are exchanged in each frame, (e,)."""
    b: Int[np.ndarray, " e"] | None
    """Camera with which camera a exchanges its keypoints in each frame, (e,). None if left and
    right of camera a are exchanged.
    """


class _Search:
    """Keypoints in an order, how well their views agree, and which exchanges are worth a trial.

    Attributes: cameras: number of the camera, (m, c), equal for views of one camera that stands
    still, -1 where there is no view. total: agreement of each frame, (m,). views: which views have
    keypoints, (m, c). several: which of these are in frames with at least three of them, (m, c).
    sides, (m, c), and pairs, (m, c, c): which exchanges are tried.
    """

    def __init__(
        self,
        observations: Observations,
        mirror: Int[np.ndarray, " k"],
        cameras: Int[np.ndarray, "m c"],
        order: Order,
    ) -> None:
        self.observations, self.mirror = observations, mirror
        self.cameras, self.order = cameras, order
        seen = _arranged(observations, mirror, order)
        found = jax.tree.map(np.asarray, agreements(seen, mirror))
        self.confidences = np.asarray(seen.confidences)
        self.total, self.views = found.own.sum(-1), (self.confidences > 0).any(-1)
        # with many views, only what looks better at once is worth a trial
        count, own = self.views.sum(-1)[:, None], np.diagonal(found.crossed, axis1=1, axis2=2)
        self.sides = self.views & (count > 1) & ((count < _CLEAR.many) | (found.mirrored > own))
        self.several = self.views & (count > 2)
        better = found.crossed + found.crossed.swapaxes(1, 2) > own[:, :, None] + own[:, None]
        self.pairs = (
            self.several[:, :, None]
            & self.several[:, None]
            & ((count < _CLEAR.many)[..., None] | better)
        )

    def gains(
        self,
        frames: Int[np.ndarray, " e"],
        a: Int[np.ndarray, " e"],
        b: Int[np.ndarray, " e"] | None = None,
    ) -> Float[np.ndarray, " e"]:
        """Returns how much agreement an exchange adds in each of its frames, (e,).

        Arguments: frames, a, b: as in `Order.exchanged`.
        """
        order = self.order.exchanged(frames, a, b)
        own = agreements(_arranged(self.observations, self.mirror, order), self.mirror).own
        return (np.asarray(own).sum(-1) - self.total)[frames]

    def is_clear(self, trial: _Trial, of: Bool[np.ndarray, " k"]) -> bool:
        """Returns whether an exchange gains enough. The gain is compared with the largest possible
        agreement of the exchanged views: the sum of the confidences of their keypoints. Only
        landmarks that at least two views see count.

        of: which keypoints the exchange concerns, (k,).
        """
        seen = (self.confidences > 0) & of
        shared = seen & (seen.sum(axis=1, keepdims=True) > 1)
        slots = [slot for slot in (trial.a, trial.b) if slot is not None]

        def total(values: np.ndarray) -> float:
            """Returns the sum of values over the views that are exchanged."""
            return float(sum(values[trial.frames, slot].sum() for slot in slots))

        attainable, count = total((self.confidences * shared).sum(-1)), total(shared.sum(-1))
        least = _CLEAR.least_gain + _CLEAR.chance / max(count, 1) ** 0.5
        return trial.gain / max(attainable, 1e-6) > least

    def flips(self) -> dict[int, _Trial]:
        """Returns for each frame a trial in which the sides of one view are exchanged. It is the
        trial that gains most. Frames without a clear trial are left out.
        """
        found: dict[int, _Trial] = {}
        sided = self.mirror != np.arange(len(self.mirror))
        for slot in np.flatnonzero(self.sides.any(0)):
            frames = np.flatnonzero(self.sides[:, slot])
            gains = self.gains(frames, np.full(len(frames), slot))
            for frame, gain in zip(frames.tolist(), gains.tolist(), strict=True):
                trial = _Trial(gain, np.asarray([frame]), np.asarray([slot]), None)
                if self.is_clear(trial, sided) and (frame not in found or gain > found[frame].gain):
                    found[frame] = trial
        return found

    def exchanges(self) -> list[_Trial]:
        """Returns the clear exchanges of two cameras. If `pairs` has two cameras in some frame,
        they are tried in all of their frames together, and in each of these frames alone.
        """
        # pairs of cameras that look exchanged in some frame are tried in all of their frames
        suspected = {self._pair(*at) for at in np.argwhere(self.pairs).tolist()}
        tried: dict[tuple[int, ...], list[_Trial]] = {}
        for a, b in itertools.combinations(range(self.views.shape[1]), 2):
            both = np.flatnonzero(self.several[:, a] & self.several[:, b])
            frames = [m for m in both.tolist() if self._pair(m, a, b) in suspected]
            if frames:
                slots = np.full(len(frames), a), np.full(len(frames), b)
                gains = self.gains(np.asarray(frames), *slots)
                for frame, gain in zip(frames, gains.tolist(), strict=True):
                    one = _Trial(gain, np.asarray([frame]), np.asarray([a]), np.asarray([b]))
                    tried.setdefault(self._pair(frame, a, b), []).append(one)
        # an exchange of cameras concerns all frames; one of photos a single frame
        together = [_together(trials) for trials in tried.values()]
        alone = [trial for trials in tried.values() if len(trials) > 1 for trial in trials]
        every = np.ones(len(self.mirror), bool)
        return [trial for trial in (*together, *alone) if self.is_clear(trial, every)]

    def _pair(self, frame: int, a: int, b: int) -> tuple[int, ...]:
        """Returns the numbers of two cameras at a moment, sorted. a and b: their columns in
        `self.cameras`, whose rows are the frames.
        """
        return tuple(sorted(self.cameras[frame, [a, b]].tolist()))


def _together(trials: Sequence[_Trial]) -> _Trial:
    """Returns one trial that joins the exchanges of two cameras in several frames."""
    frames, a, b = (
        np.concatenate([getattr(trial, key) for trial in trials]) for key in ("frames", "a", "b")
    )
    return _Trial(sum(trial.gain for trial in trials), frames, a, b)


def _cameras(
    best: _Trial, tried: Sequence[_Trial], views: Int[np.ndarray, "m c"], names: Sequence[str]
) -> Swap:
    """Returns the best exchange as a swap. Other exchanges in the same frames that gain nearly as
    much are its alternatives.
    """

    def named(trial: _Trial) -> tuple[str, ...]:
        """Returns the names of the two views in the first frame of an exchange."""
        assert trial.b is not None
        return tuple(names[v] for v in sorted(views[trial.frames[0], [trial.a[0], trial.b[0]]]))

    alike = [each for each in tried if each is not best and each.gain > _CLEAR.alike * best.gain]
    others = [
        " and ".join(named(each)) for each in alike if np.array_equal(each.frames, best.frames)
    ]
    return Swap("cameras", named(best), tuple(others), len(best.frames))


def _sides(
    observations: Observations, views: Int[np.ndarray, "m c"], order: Order, names: Sequence[str]
) -> list[Swap]:
    """Returns a swap for each view with exchanged sides. If these are half of a frame's views, the
    other half are its alternatives.
    """
    found = []
    seen = np.any(np.asarray(observations.confidences) > 0, axis=-1)
    for own, mirrored, exists in zip(views, order.mirrored, seen, strict=True):
        others = own[exists & ~mirrored]
        instead = tuple(names[v] for v in others) if len(others) == mirrored.sum() else ()
        found += [Swap("sides", (names[v],), instead) for v in own[mirrored]]
    return found


def _camera_numbers(
    observations: Observations, views: Int[np.ndarray, "m c"]
) -> Int[np.ndarray, "m c"]:
    """Returns the number of each view's camera, (m, c). Views of one camera that stands still have
    the same number. -1 where there is no view.
    """
    there = np.nonzero(views >= 0)
    matrices = (
        np.asarray(x, np.float64)[there] for x in (observations.K, observations.cam_from_world)
    )
    numbers = np.full(views.shape, -1)
    # a camera stands still up to a thousandth of the focal length, and a millimetre
    numbers[there] = camera_numbers(*matrices, 1e-3)
    return numbers
