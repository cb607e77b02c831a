"""Speed against accuracy in one value: how many photos, how the network runs, how long refinement takes, how frames are drawn.

`PRESETS` are points of the front that experiments/tradeoff/sweep.py has measured (docs/tradeoff.md). `humangs tune` finds
one for a machine, a person and a budget.
"""

import dataclasses
import json
import os
from typing import Any, Literal

import jax

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.shot import Shot
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import (
    Few,
    Iterations,
    PhotoSide,
    Presets,
    RefineSteps,
    config_from_json,
    config_to_json,
    configuration,
    knob,
)
from humangs_jax.data.capture import Capture
from humangs_jax.data.usable_views import usable_views
from humangs_jax.data.view_selection import select_views
from humangs_jax.io.reading import Refused, parse_json, read_text, reading, write_json
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.runtime import RUNTIMES, Runtime
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine_with_report

MEASURED = "tradeoff.md"
KIND = "humangs_jax settings"
"""Of a file of settings, its field "kind"."""


@configuration
class Settings:
    """How an avatar is made and drawn. The size of the frames is not in it: it belongs to the screen.

    views: photos that are used at most, chosen by `select_views`; None: all. runtime: of the network. refine_iterations,
    refine_steps: of refinement, see `RefineConfig`, 0 and 0 for none; refine_size: photos whose longer side is larger are reduced
    to it for refinement, pixels. splat: as `Shot.splat`. prune: as `Shot.prune`.
    """

    views: Few | None = knob(None, cost="what the other photos show", gain="time in proportion", measured=MEASURED)
    runtime: Runtime = dataclasses.field(default_factory=Runtime)
    refine_iterations: Iterations = knob(
        0, cost="time in proportion", gain="most of what steps gain", measured=MEASURED
    )
    refine_steps: RefineSteps = knob(0, cost="time in proportion", gain="detail of the photos", measured=MEASURED)
    refine_size: PhotoSide | None = knob(None, cost="detail of the photos", gain="time of a step", measured=MEASURED)
    splat: Literal["as_trained", "exact", "near_exact", "fast", "inria"] = knob(
        "as_trained", cost="see performance.md", gain="time of a frame", measured=MEASURED
    )
    prune: bool = knob(False, cost="3 of 255 levels", gain="time of frames that are drawn often", measured="video.md")

    @property
    def refinement(self) -> RefineConfig | None:
        """What `refine` is given; None for no refinement."""
        if not self.refine_iterations and not self.refine_steps:
            return None
        return RefineConfig(
            iterations=self.refine_iterations, steps=self.refine_steps, seconds=None, image_size=self.refine_size
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
        "realtime": Settings(views=4, runtime=RUNTIMES["realtime"], splat="fast"),
        "balanced": Settings(
            views=4, runtime=RUNTIMES["balanced"], refine_iterations=4, refine_size=256, splat="near_exact"
        ),
        "quality": Settings(
            views=4, runtime=RUNTIMES["quality"], refine_iterations=4, refine_size=512, splat="near_exact"
        ),
        "best": Settings(runtime=RUNTIMES["best"], refine_iterations=4, refine_steps=100, refine_size=512),
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

    Arguments: settings: or the name of one of `PRESETS`. config: of the weights; its runtime is replaced by that of the
    settings. capture: `Settings.photos` are used. progress: show the bar of refinement.

    Raises: ValueError as `reconstruct` and `refine`.
    """
    if isinstance(settings, str):
        if settings not in PRESETS:
            raise ValueError(f"settings {settings!r}: expected Settings or one of {', '.join(PRESETS)}")
        settings = PRESETS[settings]
    photos = settings.photos(capture)
    avatar = reconstruct(variables, settings.network(config), photos)
    if settings.refinement is not None:
        run = refine_with_report(avatar, photos, settings.refinement, progress=progress)
        if run.interrupted:
            raise KeyboardInterrupt
        avatar = run.avatar
    return jax.block_until_ready(avatar)


def save_settings(path: str | os.PathLike, settings: Settings, **about: Any) -> None:
    """Write settings as JSON, with what else is to be known about them. Raises: OSError."""
    write_json(path, {"kind": KIND, "settings": parse_json(config_to_json(settings)), **about})


def load_settings(path: str | os.PathLike) -> Settings:
    """Settings that `save_settings` has written. Raises: FileNotFoundError; FileError naming the file and what is wrong."""
    with reading(path, "settings file"):
        content = parse_json(read_text(path))
        if not isinstance(content, dict) or content.get("kind") != KIND:
            raise Refused(f'no settings of `humangs tune`: expected "kind": "{KIND}"')
        try:
            return config_from_json(Settings, json.dumps(content.get("settings")))
        except ValueError as error:
            raise Refused(str(error)) from error
