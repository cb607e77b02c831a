"""Speed against accuracy in one value: how many photos, how the network runs, how long refinement
takes, how frames are drawn.

`PRESETS` are points of the front that python -m experiments tradeoff has measured
(docs/tradeoff.md). `tune` finds one for a machine and a person within a budget. The front
(assets/front.json) says which settings are worth trying, how good they are, and how their times
compare. A few are measured, the cheapest first; times of the others are extrapolated from those.
What is chosen has been measured itself, twice: other programs come and go. Times are without
compilation.
"""

import dataclasses
import itertools
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import resources
from typing import Annotated, Any, Literal

import jax
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import draw, rest_pose_of, splatting_of, turntable_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.shot import Shot
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import (
    Few,
    Iterations,
    PhotoSide,
    Presets,
    Range,
    RefineSteps,
    config_from_json,
    config_to_json,
    configuration,
    knob,
)
from humangs_jax.core.processes import peak_memory
from humangs_jax.core.progress import bar
from humangs_jax.data.body_and_masks import usable_views
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import select_views
from humangs_jax.io.reading import Refused, parse_json, read_text, reading, write_json
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.runtime import Runtime
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import Refinement, refine_with_report
from humangs_jax.rendering.splatting import Rendering

MEASURED = "tradeoff.md"
KIND = "humangs_jax settings"
"""Of a file of settings, its field "kind"."""


@configuration
class Settings:
    """How an avatar is made and drawn. The size of the frames is not in it: it belongs to the
    screen.

    views: photos that are used at most, chosen by `select_views`; None: all. runtime: of the
    network. refine_iterations,
    refine_steps, head_steps: of refinement, see `RefineConfig`; the first two 0 for none.
    refine_size: photos whose longer side is larger are reduced to it for refinement, pixels. splat:
    as `Shot.splat`. prune: as `Shot.prune`.
    """

    views: Few | None = knob(
        None, cost="what the other photos show", gain="time in proportion", measured=MEASURED
    )
    runtime: Runtime = dataclasses.field(default_factory=Runtime)
    refine_iterations: Iterations = knob(
        0, cost="time in proportion", gain="most of what steps gain", measured=MEASURED
    )
    refine_steps: RefineSteps = knob(
        0, cost="time in proportion", gain="detail of the photos", measured=MEASURED
    )
    head_steps: RefineSteps = knob(
        0, cost="time in proportion", gain="detail of faces", measured="benchmarks/quality.md"
    )
    refine_size: PhotoSide | None = knob(
        None, cost="detail of the photos", gain="time of a step", measured=MEASURED
    )
    splat: Literal["as_trained", "exact", "near_exact", "fast", "inria"] = knob(
        "as_trained", cost="see performance.md", gain="time of a frame", measured=MEASURED
    )
    prune: bool = knob(
        False,
        cost="less than 0.001 dB",
        gain="time of frames that are drawn often",
        measured=MEASURED,
    )

    @property
    def refinement(self) -> RefineConfig | None:
        """What `refine` is given; None for no refinement."""
        if not self.refine_iterations and not self.refine_steps:
            return None
        return RefineConfig(
            iterations=self.refine_iterations,
            steps=self.refine_steps,
            seconds=None,
            head_steps=self.head_steps,
            image_size=self.refine_size,
        )

    @property
    def unrefined(self) -> "Settings":
        """The same without refinement."""
        return dataclasses.replace(self, refine_iterations=0, refine_steps=0)

    def network(self, config: HumanGSConfig) -> HumanGSConfig:
        """A network of these weights, run in this way."""
        return dataclasses.replace(config, runtime=self.runtime)

    def photos(self, capture: Capture) -> Capture:
        """The photos that are used."""
        capture = usable_views(capture)
        if self.views is None or self.views >= capture.view_count:
            return capture
        return capture.select(select_views(capture, self.views))

    def shot(self, shot: Shot) -> Shot:
        """A shot, drawn in this way where it does not say how."""
        splat = self.splat if shot.splat == "as_trained" else shot.splat
        return dataclasses.replace(shot, splat=splat, prune=shot.prune or self.prune)


PRESETS: Presets[Settings] = Presets(
    {
        "realtime": Settings(views=4, runtime=Runtime(crop=True, body_vertices=1000), splat="fast"),
        "balanced": Settings(
            views=4,
            runtime=Runtime(crop=True, body_vertices=2000),
            refine_iterations=4,
            refine_size=256,
            splat="near_exact",
        ),
        "quality": Settings(
            views=4,
            runtime=Runtime(crop=True),
            refine_iterations=4,
            refine_size=512,
            splat="near_exact",
        ),
        "best": Settings(
            runtime=Runtime(crop=True), refine_iterations=4, refine_steps=100, refine_size=512
        ),
    },
    "; those of training are in humangs_jax.training.config",
)
"""From the fastest to the slowest; docs/tradeoff.md has what each takes and gains."""


@checked_arguments
def reconstruct_with(
    settings: Settings | str,
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture,
    progress: bool = False,
) -> Avatar:
    """An avatar of the person of a capture: `reconstruct`, then `refine` where the settings say so.

    Args:
        settings: of speed against accuracy, or the name of one of `PRESETS`.
        variables: of the network; with `config`, what `load_weights` returns.
        config: of the weights; its runtime is replaced by that of the settings.
        capture: `Settings.photos` of it are used.
        progress: show the bar of refinement.

    Returns:
        The avatar.

    Raises:
        ValueError: as `reconstruct` and `refine`.

    Examples:
        >>> avatar = hg.reconstruct_with("quality", *hg.load_weights(), capture)
    """
    if isinstance(settings, str):
        if settings not in PRESETS:
            raise ValueError(
                f"settings {settings!r}: expected Settings or one of {', '.join(PRESETS)}"
            )
        settings = PRESETS[settings]
    photos = settings.photos(capture)
    avatar = reconstruct(variables, settings.network(config), photos)
    if settings.refinement is not None:
        avatar = _uninterrupted(
            refine_with_report(avatar, photos, settings.refinement, progress=progress)
        ).avatar
    return jax.block_until_ready(avatar)


def save_settings(path: str | os.PathLike[str], settings: Settings, **about: Any) -> None:
    """Write settings as JSON, with what else is to be known about them. Raises: OSError."""
    write_json(path, {"kind": KIND, "settings": parse_json(config_to_json(settings)), **about})


def load_settings(path: str | os.PathLike[str]) -> Settings:
    """Settings that `save_settings` has written.

    Raises: FileNotFoundError; FileError naming the file and what is wrong.
    """
    with reading(path, "settings file"):
        content = parse_json(read_text(path))
        if not isinstance(content, dict) or content.get("kind") != KIND:
            raise Refused(f'no settings of `humangs tune`: expected "kind": "{KIND}"')
        try:
            return config_from_json(Settings, json.dumps(content.get("settings")))
        except ValueError as error:
            raise Refused(str(error)) from error


# Settings for a budget
# ------------------------------------------------------------------------------------------------

MARGIN = 1.25
"""A busy machine is slower later: what is measured times this has to be within the budget."""
MAKES, FRAMES, STEPS = 3, 16, 6
"""Repetitions of a measurement, and steps of refinement that are timed.

The slowest counts, of frames the 90th percentile.
"""


@configuration
class FrontPoint:
    """A point of the front. `make`, `refine` and `frame`: times over those of the sweep's default
    point, of making the avatar without refinement, of refinement, and of a frame. memory_mb as in
    `Cost`. psnr, psnr_poses: dB, of new views in the pose of the photos and in novel poses.
    """

    name: str
    settings: Settings
    make: Annotated[float, Range(0, 1e9)]
    refine: Annotated[float, Range(0, 1e9)]
    frame: Annotated[float, Range(0, 1e9)]
    memory_mb: Annotated[float, Range(0, 1e9)]
    psnr: Annotated[float, Range(-1000, 1000)]
    psnr_poses: Annotated[float, Range(-1000, 1000)]

    @property
    def quality(self) -> float:
        """What points are ranked by, dB."""
        return 0.5 * (self.psnr + self.psnr_poses)


@dataclasses.dataclass(frozen=True)
class Cost:
    """Milliseconds of making an avatar and of a frame; MiB that they add to the process at their
    peak, None: not known.
    """

    make_ms: float
    refine_ms: float
    frame_ms: float
    memory_mb: float | None = None

    @property
    def reconstruct_ms(self) -> float:
        """With refinement."""
        return self.make_ms + self.refine_ms

    def worst(self, other: "Cost") -> "Cost":
        """The larger one of each."""
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        largest: list[Any] = [None if None in pair else max(pair) for pair in pairs]
        return Cost(*largest)


@dataclasses.dataclass(frozen=True)
class Budget:
    """The most that is allowed; None: anything."""

    reconstruct_ms: float | None = None
    frame_ms: float | None = None
    memory_mb: float | None = None

    def allows(self, cost: Cost) -> bool:
        """Whether a cost is within the budget with room to spare (memory needs none: it does not
        depend on other programs).
        """
        pairs = (
            (self.reconstruct_ms, MARGIN * cost.reconstruct_ms),
            (self.frame_ms, MARGIN * cost.frame_ms),
            (self.memory_mb, cost.memory_mb),
        )
        return all(most is None or value is None or value <= most for most, value in pairs)


@dataclasses.dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` found. cost: of the point, the worse of two measurements. best: the point of the
    highest quality, whatever it costs. measured: all costs that were measured, by the name of the
    point.
    """

    point: FrontPoint
    cost: Cost
    best: FrontPoint
    measured: dict[str, Cost]

    def __str__(self) -> str:
        """What was chosen, what it takes, and what it gives up against the best point, by the
        committed sweep.
        """
        takes = (
            f"{self.cost.reconstruct_ms:.0f} ms a reconstruction, {self.cost.frame_ms:.1f} ms a"
            " frame"
        )
        takes += "" if self.cost.memory_mb is None else f", {self.cost.memory_mb:.0f} MiB"
        if self.point.name == self.best.name:
            gives = "is the best of all settings"
        else:
            lost, in_poses = (
                self.best.psnr - self.point.psnr,
                self.best.psnr_poses - self.point.psnr_poses,
            )
            gives = (
                f"gives up {lost:.1f} dB in the pose of the photos and {in_poses:.1f} dB in novel"
                " poses"
            )
            gives += f" against {self.best.name!r}"
        return f"{self.point.name}\ntakes {takes}\n{gives}, on the people of docs/tradeoff.md"


def load_front() -> list[FrontPoint]:
    """The front that comes with the package, cheapest reconstruction first."""
    text = resources.files("humangs_jax").joinpath("assets/front.json").read_text()
    points = [
        config_from_json(FrontPoint, json.dumps(point)) for point in parse_json(text)["points"]
    ]
    return sorted(points, key=lambda point: point.make + point.refine)


def predict(point: FrontPoint, front: Sequence[FrontPoint], measured: Mapping[str, Cost]) -> Cost:
    """The cost of a point that was not measured: for each part, that of the measured point nearest
    to it, times their ratio.

    measured: at least one; by name.
    """
    known = [(other, measured[other.name]) for other in front if other.name in measured]

    def part(name: str, of_cost: str) -> Any:
        wanted = getattr(point, name)
        pairs = [
            (getattr(other, name), getattr(cost, of_cost))
            for other, cost in known
            if getattr(other, name) > 0
        ]
        if wanted == 0 or not pairs:
            return 0.0  # refinement that nothing measured has: tried, and then measured
        ratio, found = min(pairs, key=lambda pair: abs(math.log(pair[0] / wanted)))
        return None if found is None else found * wanted / ratio

    return Cost(
        part("make", "make_ms"),
        part("refine", "refine_ms"),
        part("frame", "frame_ms"),
        part("memory_mb", "memory_mb"),
    )


def choose(
    front: Sequence[FrontPoint], measured: Mapping[str, Cost], budget: Budget
) -> FrontPoint | None:
    """The point to go on with: the best whose cost, measured or predicted, the budget allows. It is
    the answer if it has been measured, and is to be measured next if not. None: no point is within
    the budget. Pure.
    """
    if not measured:
        return min(front, key=lambda point: (point.make + point.refine, point.frame))
    cost = lambda point: measured.get(point.name) or predict(point, front, measured)
    allowed = [point for point in front if budget.allows(cost(point))]
    return max(allowed, key=lambda point: point.quality, default=None)


def tune(
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture,
    *,
    reconstruct_ms: float | None = None,
    frame_ms: float | None = None,
    memory_mb: float | None = None,
    size: int = 512,
    front: Sequence[FrontPoint] | None = None,
    progress: bool = False,
) -> Tuned:
    """The best settings within a budget, measured on this machine with this person.

    Args:
        variables: of the network, with `config`: `load_weights`.
        config: see `variables`.
        capture: whom to reconstruct.
        reconstruct_ms: the most that making the avatar may take, with refinement, milliseconds.
        frame_ms: the most that a frame may take, milliseconds.
        memory_mb: the most memory that this may add to the process, MiB.
        size: side of the frames, pixels.
        front: points to choose from; None: those that come with the package. Those that ask for
            more photos than the capture has are tried with all it has, and without masks those that
            refine are not.
        progress: show a bar.

    Returns:
        The settings (`.point.settings`, for `reconstruct_with`) and what they cost.

    Raises:
        ValueError: if no setting is within the budget, saying what the cheapest takes; or if memory
            is limited where it cannot be measured.

    Examples:
        >>> tuned = hg.tune(*hg.load_weights(), capture, frame_ms=33)
        >>> avatar = hg.reconstruct_with(tuned.point.settings, *hg.load_weights(), capture)
    """
    budget = Budget(reconstruct_ms, frame_ms, memory_mb)
    front = load_front() if front is None else front
    front = [
        point for point in front if capture.masks is not None or point.settings.refinement is None
    ]
    measured: dict[str, Cost] = {}
    confirmed = set()
    with bar(total=len(front), desc="tune", unit="setting", shown=progress) as shown:
        while (point := choose(front, measured, budget)) is not None:
            if point.name in confirmed:
                return Tuned(
                    point, measured[point.name], max(front, key=lambda each: each.quality), measured
                )
            shown.set_postfix_str(point.name)
            cost = measure(point.settings, variables, config, capture, size)
            if point.name in measured:
                cost = cost.worst(measured[point.name])
                confirmed.add(point.name)
            measured[point.name] = cost
            if budget.memory_mb is not None and measured[point.name].memory_mb is None:
                raise ValueError(
                    "memory_mb: how much memory is used cannot be measured on this system"
                )
            shown.update()
    least = {
        name: min(getattr(cost, name) for cost in measured.values())
        for name in ("reconstruct_ms", "frame_ms")
    }
    memory = [cost.memory_mb for cost in measured.values() if cost.memory_mb is not None]
    needs = (
        f"{least['reconstruct_ms']:.0f} ms a reconstruction, {least['frame_ms']:.1f} ms a frame of"
        f" {size} pixels"
    )
    needs += f", {min(memory):.0f} MiB" if memory else ""
    raise ValueError(
        f"no setting is within the budget: the least that was measured is {needs}, and"
        f" {MARGIN - 1:.0%} of room is kept for a busy machine; smaller frames are faster"
    )


def measure(
    settings: Settings,
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture,
    size: int = 512,
) -> Cost:
    """What settings cost here: an avatar of this capture, and frames of it from all around.

    Compiling and choosing photos, which happen once for a set of cameras, do not count.
    """
    photos = settings.photos(capture)
    make = lambda: reconstruct_with(settings.unrefined, variables, config, photos)
    avatar = make()  # compiles
    make_ms = max(_milliseconds(make) for _ in range(MAKES))
    refine = lambda how: _uninterrupted(refine_with_report(avatar, photos, how)).seconds
    refine_ms, parts = 0.0, refinement_parts(settings)
    for how, times in parts:
        refine_ms += 1e3 * times * max(refine(how) for _ in range(2))
    frames = frames_of(avatar, settings, size)
    next(frames)
    frame_ms = float(np.quantile([_milliseconds(lambda: next(frames)) for _ in range(FRAMES)], 0.9))
    with peak_memory() as peak:
        make()
        for how, _ in parts:
            refine(how)
        next(frames)
    on_host = (
        jax.default_backend() == "cpu"
    )  # what the process takes is known, what a device takes is not
    return Cost(make_ms, refine_ms, frame_ms, peak[0] if on_host else None)


def refinement_parts(settings: Settings) -> list[tuple[RefineConfig, float]]:
    """Short runs of refinement, and how often each has to be counted: the iterations, and a few
    steps for all.
    """
    few = min(settings.refine_steps, STEPS)
    iterations = dataclasses.replace(settings, refine_steps=0).refinement
    steps = dataclasses.replace(
        settings, refine_iterations=0, refine_steps=few, head_steps=0
    ).refinement
    if steps is not None:
        steps = dataclasses.replace(
            steps, held_out=0.0
        )  # a trial may find that no more steps are worth it
    return [
        (c, times)
        for c, times in ((iterations, 1.0), (steps, settings.refine_steps / max(few, 1)))
        if c is not None
    ]


def frames_of(avatar: Avatar, settings: Settings, size: int) -> Iterator[Rendering]:
    """Renderings without end, around the avatar in its T-pose.

    Nothing is pruned: that is of a motion and its cameras.
    """
    shot = settings.shot(Shot(size=size))
    poses, cameras = turntable_views(avatar, rest_pose_of(avatar), 8, shot)
    turns = [itertools.cycle(range(8)) for _ in range(2)]
    pose = lambda i: jax.tree.map(lambda x: x[i], poses)
    drawn = draw(
        avatar, map(pose, turns[0]), (cameras[i] for i in turns[1]), how=splatting_of(shot, avatar)
    )
    return (jax.block_until_ready(rendering) for rendering in drawn)


def _uninterrupted(run: Refinement) -> Refinement:
    if run.interrupted:
        raise KeyboardInterrupt
    return run


def _milliseconds(run: Callable[[], object]) -> float:
    began = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - began)
