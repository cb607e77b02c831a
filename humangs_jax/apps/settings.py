"""Settings that trade speed against accuracy: how many photos are used, how the network runs, how
long refinement takes, and how frames are drawn.

`PRESETS` are the best trade-offs that `python -m experiments tradeoff` has measured
(docs/tradeoff.md). `tune` times them on the user's machine for one person, and picks the best one
within a budget.
"""

import dataclasses
import json
import os
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import draw, rest_pose_of, splatting_of, turntable_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import (
    Count,
    Iterations,
    PhotoSide,
    Presets,
    RefineSteps,
    config_from_json,
    config_to_json,
    configuration,
    knob,
)
from humangs_jax.core.processes import peak_memory
from humangs_jax.core.progress import bar
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import PreparedCapture, prepare_capture
from humangs_jax.io.reading import InvalidFileError, parse_json, read_text, reading, write_json
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.runtime import Runtime
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import Refinement, refine_with_report

MEASURED = "tradeoff.md"
_KIND = "humangs_jax settings"
"""Value of the field "kind" in a file of settings."""


@configuration
class Settings:
    """How an avatar is made and drawn. The size of the frames is not among the settings, because it
    depends on the screen.
    """

    views: Count | None = knob(
        None, cost="what the other photos show", gain="time in proportion", measured=MEASURED
    )
    """Largest number of photos that are used. `prepare_capture` chooses them. None: all photos."""
    runtime: Runtime = dataclasses.field(default_factory=Runtime)
    """How the network runs."""
    refine_iterations: Iterations = knob(
        0, cost="time in proportion", gain="most of what steps gain", measured=MEASURED
    )
    """Iterations of the learned update, see `RefineConfig`. 0: none."""
    refine_steps: RefineSteps = knob(
        0, cost="time in proportion", gain="detail of the photos", measured=MEASURED
    )
    """Steps of the optimizer, see `RefineConfig`. 0: none."""
    head_steps: RefineSteps = knob(
        0, cost="time in proportion", gain="detail of faces", measured="benchmarks/quality.md"
    )
    """Further steps on the head alone, see `RefineConfig`. 0: none. There are also none if
    iterations and steps are both 0.
    """
    refine_size: PhotoSide | None = knob(
        None, cost="detail of the photos", gain="time of a step", measured=MEASURED
    )
    """Photos whose longer side exceeds this are reduced to it for refinement, pixels. None: no
    photo is reduced.
    """
    splat: Literal["as_trained", "exact", "near_exact", "fast", "inria"] = knob(
        "as_trained", cost="see performance.md", gain="time of a frame", measured=MEASURED
    )
    """How frames are splatted, see `FrameSettings.splat`."""
    prune: bool = knob(
        False,
        cost="less than 0.001 dB",
        gain="time of frames that are drawn often",
        measured=MEASURED,
    )
    """Whether Gaussians that no image shows are left out, see `FrameSettings.prune`."""

    @property
    def refinement(self) -> RefineConfig | None:
        """The configuration that `refine` takes; None for no refinement."""
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
        """The same settings without refinement."""
        return dataclasses.replace(self, refine_iterations=0, refine_steps=0)

    def network(self, config: HumanGSConfig) -> HumanGSConfig:
        """Returns the configuration of a network with the runtime of these settings."""
        return dataclasses.replace(config, runtime=self.runtime)

    def photos(self, capture: Capture | PreparedCapture) -> PreparedCapture:
        """Returns a prepared capture with the photos that these settings use. Raises: as
        `prepare_capture`.
        """
        return prepare_capture(capture, views=self.views)

    def shot(self, shot: FrameSettings) -> FrameSettings:
        """Returns `shot` with `splat` and `prune` of these settings. The `splat` of `shot` stays
        unless it is "as_trained". `prune` is True if it is True in `shot` or in these settings.
        """
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
"""Presets from the fastest to the slowest. docs/tradeoff.md has the time and the quality of
each.
"""


@checked_arguments
def reconstruct_with(
    settings: Settings | str,
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture | PreparedCapture,
    progress: bool = False,
) -> Avatar:
    """Makes an avatar of the person of a capture: calls `reconstruct`, then `refine` if the
    settings ask for it.

    Args:
        settings: the settings, or the name of one of `PRESETS`.
        variables: the variables of the network. `load_weights` returns them with `config`.
        config: the configuration of the network. The settings replace its runtime.
        capture: a capture, or a prepared one as `Settings.photos` returns it. The settings choose
            which of its photos are used.
        progress: whether to show the progress of refinement.

    Returns:
        The avatar.

    Raises:
        ValueError: if there is no preset of this name. Also as `reconstruct` and `refine`.
        KeyboardInterrupt: if refinement was interrupted.

    Examples:
        >>> avatar = hg.reconstruct_with("quality", *hg.load_weights(), capture)
    """
    if isinstance(settings, str):
        if settings not in PRESETS:
            raise ValueError(
                f"settings {settings!r}: expected Settings or one of {', '.join(PRESETS)}"
            )
        settings = PRESETS[settings]
    # the settings choose the photos, the size of the network, and whether it is refined
    photos = settings.photos(capture)
    avatar = reconstruct(variables, settings.network(config), photos)
    if settings.refinement is not None:
        avatar = _uninterrupted(
            refine_with_report(avatar, photos, settings.refinement, progress=progress)
        ).avatar
    return jax.block_until_ready(avatar)


def save_settings(path: str | os.PathLike[str], settings: Settings, **about: Any) -> None:
    """Writes settings as JSON. about: further entries of the file. Raises: OSError."""
    write_json(path, {"kind": _KIND, "settings": parse_json(config_to_json(settings)), **about})


def load_settings(path: str | os.PathLike[str]) -> Settings:
    """Reads settings that `save_settings` has written.

    Raises: FileNotFoundError; FileError that names the file and what is wrong.
    """
    with reading(path, "settings file"):
        content = parse_json(read_text(path))
        if not isinstance(content, dict) or content.get("kind") != _KIND:
            raise InvalidFileError(f'no settings of `humangs tune`: expected "kind": "{_KIND}"')
        try:
            return config_from_json(Settings, json.dumps(content.get("settings")))
        except ValueError as error:
            raise InvalidFileError(str(error)) from error


# Settings for a budget
# --------------------------------------------------------------------------------------------------

_HEADROOM = 1.25
"""Measured times are multiplied by this before they are compared with the budget, because a busy
machine is slower later.
"""
FRAMES = 16
"""Number of frames that are timed for each preset. The 90th percentile of their times is compared
with the budget.
"""


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a preset costs on this machine with this person."""

    reconstruct_ms: float
    """Time in which the avatar is made, with refinement, milliseconds."""
    frame_ms: float
    """Time of a frame, milliseconds: the 90th percentile of `FRAMES` frames."""
    memory_mb: float | None = None
    """Memory that making the avatar and drawing its frames add to the process at their peak, MiB.
    None where this cannot be measured.
    """


@dataclasses.dataclass(frozen=True)
class Tuned:
    """The preset that `tune` has found."""

    name: str
    """Name of the best preset within the budget."""
    measured: dict[str, Cost]
    """Costs of the presets that were timed, by name."""

    @property
    def settings(self) -> Settings:
        """The settings of the best preset, for `reconstruct_with`."""
        return PRESETS[self.name]

    def __str__(self) -> str:
        """Returns one line with the preset and its costs."""
        return f"{self.name}: {_shown(self.measured[self.name])}"


def tune(
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture,
    *,
    reconstruct_ms: float | None = None,
    frame_ms: float | None = None,
    memory_mb: float | None = None,
    size: int = 512,
    progress: bool = False,
) -> Tuned:
    """Finds the best preset within a budget, timed on this machine with this person.

    Presets are timed from the fastest to the slowest, until one exceeds the budget. Compilation
    does not count. Without masks, presets that refine are not tried.

    Args:
        variables: the variables of the network. `load_weights` returns them with `config`.
        config: the configuration of the network.
        capture: the person to reconstruct.
        reconstruct_ms: longest time in which the avatar may be made, with refinement, milliseconds.
            None: no limit.
        frame_ms: longest time that a frame may take, milliseconds. None: no limit.
        memory_mb: most memory that making the avatar and drawing its frames may add to the process,
            MiB. None: no limit.
        size: side of the frames, pixels.
        progress: whether to show a progress bar.

    Returns:
        The preset (`.name`, `.settings`), and the costs of all presets that were timed
        (`.measured`).

    Raises:
        ValueError: if no preset is within the budget; the message has the costs of the fastest.
            Also if memory is limited where it cannot be measured, and as `reconstruct_with`.
        KeyboardInterrupt: if refinement was interrupted.

    Examples:
        >>> tuned = hg.tune(*hg.load_weights(), capture, frame_ms=33)
        >>> avatar = hg.reconstruct_with(tuned.settings, *hg.load_weights(), capture)
    """
    # refinement needs masks
    presets = {
        name: settings
        for name, settings in PRESETS.items()
        if capture.masks is not None or settings.refinement is None
    }
    measured: dict[str, Cost] = {}
    best = None
    # from the fastest on: slower ones would only exceed the budget further
    for name, settings in bar(presets.items(), desc="tune", unit="preset", shown=progress):
        cost = measured[name] = measure(settings, variables, config, capture, size)
        if memory_mb is not None and cost.memory_mb is None:
            raise ValueError("memory_mb: how much memory is used cannot be measured on this system")
        exceeded = (
            reconstruct_ms is not None and _HEADROOM * cost.reconstruct_ms > reconstruct_ms,
            frame_ms is not None and _HEADROOM * cost.frame_ms > frame_ms,
            memory_mb is not None and (cost.memory_mb or 0) > memory_mb,
        )
        if any(exceeded):
            break
        best = name
    # say what the fastest takes, so that the budget can be set
    if best is None:
        name, cost = next(iter(measured.items()))
        raise ValueError(
            f"no preset is within the budget: {name!r}, the fastest, takes {_shown(cost)} of {size}"
            f" pixels, and {_HEADROOM - 1:.0%} of room is kept for a busy machine"
        )
    return Tuned(best, measured)


def measure(
    settings: Settings,
    variables: Variables,
    config: HumanGSConfig,
    capture: Capture,
    size: int = 512,
) -> Cost:
    """Measures what settings cost on this machine: makes an avatar of the capture, and draws frames
    of it from all around. size: side of the frames, pixels. Raises: as `reconstruct_with`.
    """

    def make():
        return reconstruct_with(settings, variables, config, capture)

    # The first avatar and the first frame compile; what follows is timed.
    avatar = make()
    shot = settings.shot(FrameSettings(size=size))
    poses, cameras = turntable_views(avatar, rest_pose_of(avatar), FRAMES + 1, shot)

    def pose(i):
        return jax.tree.map(lambda x: x[i], poses)

    how = splatting_of(shot, avatar)
    drawn = draw(avatar, map(pose, range(FRAMES + 1)), cameras, how=how, at_once=1)

    def frame():
        return jax.block_until_ready(next(drawn))

    frame()
    with peak_memory() as peak:
        # two avatars are timed for each preset; the slower one counts
        reconstruct_ms = max(_milliseconds(make) for _ in range(2))
        frame_ms = float(np.quantile([_milliseconds(frame) for _ in range(FRAMES)], 0.9))
    # The process's own memory says nothing about that of a GPU or TPU.
    on_host = jax.default_backend() == "cpu"
    return Cost(reconstruct_ms, frame_ms, peak[0] if on_host else None)


def _shown(cost: Cost) -> str:
    text = f"{cost.reconstruct_ms:.0f} ms a reconstruction, {cost.frame_ms:.1f} ms a frame"
    if cost.memory_mb is None:
        return text
    return f"{text}, {cost.memory_mb:.0f} MiB"


def _uninterrupted(run: Refinement) -> Refinement:
    if run.interrupted:
        raise KeyboardInterrupt
    return run


def _milliseconds(run: Callable[[], object]) -> float:
    began = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - began)
