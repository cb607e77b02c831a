"""docs/knobs.md: every setting that trades accuracy or memory for speed, from the code itself."""

import dataclasses
from typing import Any

from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.apps.settings import PRESETS, Settings
from humangs_jax.network.config import Conventions
from humangs_jax.network.encoder import PatchTransformer
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.vertex_decoder import VertexDecoder
from humangs_jax.people.on_the_fly import OnTheFlyConfig
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.rendering.mesh.rasterizer import RasterConfig
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.training.config import TrainConfig

PAGE = REPOSITORY / "docs" / "knobs.md"
HEAD = """# Knobs

Every setting of the network, the renderer, the training step and the people on the fly that trades accuracy or memory for speed.
`python -m experiments knobs` writes this page. Decibels compare with the exact image; times are shares of the default's.
The linked page has the measurement and its conditions.

| knob | default | costs | buys | measured in |
|---|---|---|---|---|
"""
PRESETS_HEAD = """
## Presets

`hg.PRESETS`, `--preset` of `reconstruct`, `animate`, `render`, `demo`; measured in [tradeoff.md](tradeoff.md).

| preset | settings | `Settings.runtime` |
|---|---|---|
"""


def page() -> str:
    """The page in Markdown."""
    classes = (
        Runtime,
        Conventions,
        PatchTransformer,
        VertexDecoder,
        SplatConfig,
        RasterConfig,
        RefineConfig,
        TrainConfig,
        OnTheFlyConfig,
        Settings,
    )
    rows = [row for cls in classes for row in knob_rows(cls)]
    return HEAD + "\n".join(rows) + "\n" + PRESETS_HEAD + "\n".join(preset_rows()) + "\n"


def preset_rows() -> list[str]:
    """A row for each preset: what differs from the defaults."""

    def changes(value: Any, usual: Any) -> list[str]:
        names = [field.name for field in dataclasses.fields(value) if field.name != "runtime"]
        return [f"{name} {getattr(value, name)}" for name in names if getattr(value, name) != getattr(usual, name)]

    plain = Settings(), Runtime()
    rows = []
    for name, preset in PRESETS.items():
        own, network = ", ".join(changes(preset, plain[0])), ", ".join(changes(preset.runtime, plain[1]))
        rows.append(f"| `{name}` | {own} | {network or 'as trained'} |")
    return rows


def knob_rows(cls: Any) -> list[str]:
    """A row for each knob of a configuration."""
    source = "../" + cls.__module__.replace(".", "/") + ".py"
    rows = []
    for field in dataclasses.fields(cls):
        if "gain" in field.metadata:
            cost, gain, measured = (field.metadata[name] for name in ("cost", "gain", "measured"))
            default = field.default if not dataclasses.is_dataclass(field.default) else "on"
            rows.append(
                f"| [`{cls.__name__}`]({source})`.{field.name}` | {default} | {cost} | {gain} | [{measured}]({measured}) |"
            )
    return rows


@entry
def knobs(run: Run) -> None:
    """Writes docs/knobs.md: every setting that trades accuracy or memory for speed, from the code itself."""
    PAGE.write_text(page())
