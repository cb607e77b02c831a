"""Writes docs/knobs.md: every setting that trades accuracy or memory for speed, from the code."""

import ast
import dataclasses
import functools
import inspect
import itertools
import textwrap
import typing
from typing import Any

from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.apps.settings import PRESETS, Settings
from humangs_jax.core.configuration import Range, field_paths, in_words, marks_in
from humangs_jax.network.config import Conventions
from humangs_jax.network.encoder import PatchTransformer
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.vertex_decoder import VertexDecoder
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.rendering.mesh.rasterizer import RasterConfig
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig
from humangs_jax.training.config import PRESETS as RUNS
from humangs_jax.training.config import TrainConfig

PAGE = REPOSITORY / "docs" / "knobs.md"
HEAD = """# Knobs

Every setting of the network, the renderer, the training step and the people on the fly that trades
accuracy or memory for speed. `python -m experiments knobs` writes this page. Decibels compare with
the exact image; times are shares of the default's. The linked page has the measurement and its
conditions.

| knob | default | costs | buys | measured in |
|---|---|---|---|---|
"""
FIELDS_HEAD = """
## Field paths

What `hg.vary` and the `config.json` of a run name: all fields of a `TrainConfig`, with the values
of the preset `tiny`. Without `model.` they are those of a `HumanGSConfig`, which `hg.load_weights`
returns. A part of another kind has other fields.

| path | may be | `tiny` has | what |
|---|---|---|---|
"""
PRESETS_HEAD = """
## Presets

`hg.PRESETS`, `--preset` of `reconstruct`, `animate`, `render`, `demo`; measured in
[tradeoff.md](tradeoff.md).

| preset | settings | `Settings.runtime` |
|---|---|---|
"""


def page() -> str:
    """Returns the text of docs/knobs.md."""
    classes = (
        Runtime,
        Conventions,
        PatchTransformer,
        VertexDecoder,
        SplatConfig,
        RasterConfig,
        RefineConfig,
        TrainConfig,
    )
    rows = [row for cls in (*classes, OnTheFlyConfig, Settings) for row in knob_rows(cls)]
    sections = {HEAD: rows, PRESETS_HEAD: preset_rows(), FIELDS_HEAD: field_rows()}
    return "".join(head + "\n".join(rows) + "\n" for head, rows in sections.items())


def preset_rows() -> list[str]:
    """Returns a row for each preset, with the fields that differ from the defaults."""

    def changes(value: Any, usual: Any) -> list[str]:
        names = [field.name for field in dataclasses.fields(value) if field.name != "runtime"]
        return [
            f"{name} {getattr(value, name)}"
            for name in names
            if getattr(value, name) != getattr(usual, name)
        ]

    rows = []
    for name, preset in PRESETS.items():
        own = ", ".join(changes(preset, Settings()))
        network = ", ".join(changes(preset.runtime, Runtime()))
        rows.append(f"| `{name}` | {own} | {network or 'as trained'} |")
    return rows


def field_rows() -> list[str]:
    """Returns a row for each field of a training run that has no fields inside."""
    run = RUNS["tiny"]()
    rows = []
    for path, value in field_paths(run).items():
        if dataclasses.is_dataclass(value):
            continue
        *places, name = path.split(".")
        cls = type(functools.reduce(getattr, places, run))
        hint = typing.get_type_hints(cls, include_extras=True)[name]
        ranges = "; ".join(dict.fromkeys(map(str, marks_in(hint, Range))))
        allowed = in_words(typing.get_type_hints(cls)[name])
        if ranges:
            allowed = f"{allowed}, {ranges}"
        cells = (f"`{path}`", allowed, f"`{value}`", docstrings(cls).get(name, ""))
        cells = [" ".join(cell.split()).replace("|", "or") for cell in cells]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


@functools.cache
def docstrings(cls: type) -> dict[str, str]:
    """Returns {field: the string below it} of a dataclass and its bases."""
    found = {}
    for each in cls.__mro__[-2::-1]:
        if not dataclasses.is_dataclass(each) or not each.__module__.startswith("humangs_jax"):
            continue
        (written,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
        assert isinstance(written, ast.ClassDef)
        for field, text in itertools.pairwise(written.body):
            if not isinstance(field, ast.AnnAssign) or not isinstance(text, ast.Expr):
                continue
            if isinstance(text.value, ast.Constant):
                found[ast.unparse(field.target)] = str(text.value.value)
    return found


def knob_rows(cls: Any) -> list[str]:
    """Returns a row for each knob of a configuration, a field whose metadata has a gain."""
    source = "../" + cls.__module__.replace(".", "/") + ".py"
    rows = []
    for field in dataclasses.fields(cls):
        if "gain" in field.metadata:
            cost, gain, measured = (field.metadata[name] for name in ("cost", "gain", "measured"))
            default = "on" if dataclasses.is_dataclass(field.default) else field.default
            rows.append(
                f"| [`{cls.__name__}`]({source})`.{field.name}` | {default} | {cost} | {gain} |"
                f" [{measured}]({measured}) |"
            )
    return rows


@entry
def knobs(run: Run) -> None:
    """Writes docs/knobs.md, every setting that trades accuracy or memory for speed."""
    PAGE.write_text(page())
