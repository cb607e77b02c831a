"""Finds the frames of several videos that show one moment. They are found by time, because rates
differ and phones drop frames.

All videos have to begin at the same moment. Only if the times in a video show that it begins 0.1 to
3 seconds later, this delay is taken into account. The video with the lowest frame rate determines
the moments. Each other camera gives the frame that is nearest in time, or no frame if it has a gap
there.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import counted

NEAR = 0.6
"""Largest distance in time between a frame and its moment, as a share of the median time between
the camera's frames. It is a little more than one half, because the clocks of phones are not steady.
"""
_GAP = 1.5
"""Frames are missing between two frames if the time between them exceeds this many times the usual
time between frames.
"""
_SAME_RATE = 0.01
"""Cameras count as having the same frame rate if the times between their frames differ by less than
this share.
"""
_USUAL_STEP = 1 / 30
"""Time between two frames that is assumed if no video states its times, or if a video has one
frame, seconds.
"""


class Moments(NamedTuple):
    """The frames of several cameras at m moments."""

    times: Float[np.ndarray, " m"]
    """Times of the moments, (m,), seconds from the start of the videos."""
    frames: dict[str, list[int | None]]
    """For each camera, the index of its frame at each moment, counted from 0. None if the camera
    has no frame there.
    """
    counts: dict[str, int]
    """Number of frames of each camera."""
    notes: tuple[str, ...]
    """Notes on how frames were paired, one line each."""
    warnings: tuple[str, ...]
    """Lines about frames that cameras lack."""


def find_moments(times: Mapping[str, Float[np.ndarray, " _n"]]) -> Moments:
    """Returns the moments that several cameras show, and the frame of each camera at each moment.

    Arguments: times: for each camera the times of its n frames, (n,), seconds, at least one. NaN
    where a time is not known.
    """
    steps = {camera: _step(each) for camera, each in times.items()}
    known = [step for step in steps.values() if step is not None]
    slowest = max(known, default=_USUAL_STEP)
    first = min((each[0] for each in times.values()), default=0.0)
    clocks = {camera: _clock(each, steps[camera], slowest, first) for camera, each in times.items()}
    moments = _all_moments(clocks, {camera: step or slowest for camera, step in steps.items()})
    frames = {camera: nearest(each, moments) for camera, each in clocks.items()}
    counts = {camera: len(each) for camera, each in times.items()}
    return Moments(
        moments, frames, counts, _notes(clocks, frames, known), _warnings(clocks, frames, moments)
    )


def _step(times: Float[np.ndarray, " n"]) -> float | None:
    """Returns the mean time between neighbouring frames, gaps left out, seconds. None if there are
    fewer than two frames, or if a time is not known or times do not rise.
    """
    apart = np.diff(times)
    if not len(apart) or not np.isfinite(apart).all() or not (apart > 0).all():
        return None
    return float(np.mean(apart[apart < _GAP * np.median(apart)]))


def _clock(
    times: Float[np.ndarray, " n"], step: float | None, slowest: float, first: float
) -> Float[np.ndarray, " n"]:
    """Returns the time of each frame, (n,), seconds from the start of the videos.

    The first frame of a video is at 0. If the video begins 0.1 to 3 seconds after `first`, the
    earliest time in all videos, its first frame is that much later. step: the video's time between
    frames, seconds. None: the times in `times` are not used, and frames are `slowest` seconds
    apart.
    """
    if step is None:
        return np.arange(len(times)) * slowest
    late = times[0] - first
    # encoders shift first frames by less than 0.1 s; a video that begins more than 3 s later
    # counts time from elsewhere
    start = late if 0.1 < late < 3.0 else 0.0
    return times - times[0] + start


def _all_moments(
    clocks: Mapping[str, Float[np.ndarray, " _n"]], steps: Mapping[str, float]
) -> Float[np.ndarray, " m"]:
    """Returns the times of the moments, (m,), seconds. The moments are the times at which the
    slowest camera has frames. Of several such cameras, the one with the most frames counts. Further
    moments fill the time before its first frame, gaps between its frames, and the time after its
    last frame.

    clocks: times of each camera's frames, seconds. steps: time between each camera's frames,
    seconds.
    """
    slowest = max(steps.values())
    slow = [camera for camera, step in steps.items() if step > (1 - _SAME_RATE) * slowest]
    own = max((clocks[camera] for camera in slow), key=lambda each: len(each))
    earlier = own[0] - slowest * np.arange(round(own[0] / slowest), 0, -1)
    parts = [earlier, own[:1]]
    for before, after in itertools.pairwise(own.tolist()):
        missing = round((after - before) / slowest) if after - before > _GAP * slowest else 1
        parts.append(before + (after - before) * np.arange(1, missing + 1) / missing)
    end = max(each[-1] for each in clocks.values())
    further = max(0, int(np.floor((end - own[-1]) / slowest + NEAR - 0.1)))
    return np.concatenate([*parts, own[-1] + slowest * np.arange(1, further + 1)])


def nearest(times: Float[np.ndarray, " n"], moments: Float[np.ndarray, " m"]) -> list[int | None]:
    """Returns for each moment the index of the camera's nearest frame.

    The index is None if this frame is farther away in time than `NEAR` allows, or if the frame is
    nearer to another moment. times: times of the camera's frames, (n,), seconds. moments: times of
    the moments, (m,), seconds.
    """
    step = float(np.median(np.diff(times))) if len(times) > 1 else _USUAL_STEP
    found = np.searchsorted((times[1:] + times[:-1]) / 2, moments)
    off = np.abs(times[found] - moments)
    best: dict[int, int] = {}
    for place, number in enumerate(found.tolist()):
        other = best.get(number)
        if off[place] <= NEAR * step and (other is None or off[place] < off[other]):
            best[number] = place
    numbers: list[int | None] = [None] * len(moments)
    for number, place in best.items():
        numbers[place] = number
    return numbers


def _notes(
    clocks: Mapping[str, Float[np.ndarray, " _n"]],
    frames: Mapping[str, Sequence[int | None]],
    steps: Sequence[float],
) -> tuple[str, ...]:
    if not steps or max(steps) < (1 + _SAME_RATE) * min(steps):
        return ()
    apart = 0.0
    for numbers in zip(*frames.values(), strict=True):
        seen = [
            clock[number]
            for clock, number in zip(clocks.values(), numbers, strict=True)
            if number is not None
        ]
        if seen:
            apart = max(apart, float(np.ptp(seen)))
    rates = " and ".join(dict.fromkeys(f"{1 / step:.3g}" for step in sorted(steps)))
    line = (
        f"videos of {rates} frames a second: paired by time, views of one moment are at most"
        f" {apart:.3f} s apart"
    )
    return (line,)


def _warnings(
    clocks: Mapping[str, Float[np.ndarray, " _n"]],
    frames: Mapping[str, Sequence[int | None]],
    moments: Float[np.ndarray, " m"],
) -> tuple[str, ...]:
    """Returns warnings about cameras that lack frames.

    A camera gets a line if it has no frame at some moment before its last frame. It gets another
    line if it has no frame at two or more moments after that. Clocks and moments are in seconds.
    """
    found = []
    for camera, numbers in frames.items():
        without = moments[[number is None for number in numbers]]
        inside = without[without < clocks[camera][-1]]
        if len(inside):
            where = f"{inside[0]:.2f} to {inside[-1]:.2f} s"
            found.append(
                f"{camera}: no frame at {counted(len(inside), 'moment')} ({where}): left out there;"
                " were frames dropped?"
            )
        behind = without[without >= clocks[camera][-1]]
        if len(behind) > 1:
            found.append(
                f"{camera}: ends at {clocks[camera][-1]:.2f} s, {counted(len(behind), 'moment')}"
                " before the last video"
            )
    return tuple(found)


def progressions(numbers: Sequence[int]) -> list[tuple[int, int, int]]:
    """Returns the arithmetic progressions, (first, step, last), that ascending numbers consist of.
    The step of a single number is 0.
    """
    found: list[tuple[int, int, int]] = []
    for number in numbers:
        if found:
            first, step, last = found[-1]
            if step == 0 or number == last + step:
                found[-1] = (first, number - last, number)
                continue
        found.append((number, 0, number))
    return found
