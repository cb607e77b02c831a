"""Every number of a configuration has a range, and every way to make one checks it."""

import dataclasses
import json
import re
import typing
from typing import Annotated

import numpy as np
import pytest

import experiments.systems  # noqa: F401
from humangs_jax.apps import settings
from humangs_jax.core.configuration import (
    _PARTS,
    Range,
    _ranges,
    config_from_json,
    config_to_json,
    configuration,
    vary,
)
from humangs_jax.network.runtime import Conventions, Runtime
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig
from humangs_jax.training import config


def reachable(cls, found):
    if cls not in found:
        found.add(cls)
        waiting = list(typing.get_type_hints(cls).values())
        while waiting:
            annotation = waiting.pop()
            if dataclasses.is_dataclass(annotation):
                reachable(annotation, found)
            waiting += typing.get_args(annotation)
    return found


ALL = set()
CONFIGURATIONS = (
    settings.Settings,
    config.TrainConfig,
    settings.RefineConfig,
    OnTheFlyConfig,
)
for each in (*CONFIGURATIONS, *_PARTS.values()):
    reachable(each, ALL)


def is_number(annotation):
    return annotation in (int, float) or any(
        is_number(part) for part in typing.get_args(annotation)
    )


@pytest.mark.parametrize(
    "cls", sorted(ALL, key=lambda cls: cls.__name__), ids=lambda cls: cls.__name__
)
def test_every_number_has_a_range(cls):
    numbers = {
        name for name, annotation in typing.get_type_hints(cls).items() if is_number(annotation)
    }
    assert numbers == set(_ranges(cls))


def test_the_list_is_not_empty():
    assert len(ALL) > 30


@configuration
class Fit:
    steps: Annotated[int, Range(1, 1000)] = 5
    shares: tuple[Annotated[float, Range(0, 1)], ...] = (0.5,)
    most: Annotated[int, Range(1, 9)] | None = None
    pairs: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self):
        if self.most == 7:
            raise ValueError("seven")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"steps": 0}, "steps 0: expected 1 to 1,000"),
        ({"steps": 10**6}, "steps 1000000: expected 1 to 1,000"),
        ({"steps": np.int64(0)}, "steps 0: expected 1 to 1,000"),
        ({"shares": (0.5, 1.5)}, "shares 1.5: expected 0 to 1"),
        ({"shares": (float("nan"),)}, "shares nan: expected 0 to 1"),
        ({"shares": (0.5,) * 1000}, "shares: expected at most 256"),
        ({"most": -1}, "most -1: expected 1 to 9"),
        ({"most": 7}, "seven"),
    ],
)
def test_numbers_out_of_range_are_one_line(changes, problem):
    with pytest.raises(ValueError) as caught:
        Fit(**changes)
    assert str(caught.value) == problem or str(caught.value).startswith(f"Fit.{problem}")
    with pytest.raises(ValueError) as caught:
        dataclasses.replace(Fit(), **changes)
    assert "\n" not in str(caught.value)


def test_a_file_names_the_path_of_the_field():
    assert config_from_json(Fit, '{"steps": 9, "most": null}') == Fit(steps=9)
    for text, problem in (
        ('{"steps": 0}', "config.steps 0: expected 1 to 1,000"),
        ('{"shares": [2]}', "config.shares 2: expected 0 to 1"),
        ('{"shares": ' + json.dumps([0] * 300) + "}", "config.shares: expected at most 256"),
        ('{"shares": [0.5, "x"]}', "config.shares[1]: expected float, got 'x'"),
        ('{"pairs": [[], ["a", 1]]}', "config.pairs[1][1]: expected "),
        ('{"pairs": [' + json.dumps(["a"] * 300) + "]}", "config.pairs[0]: expected at most 256"),
    ):
        with pytest.raises(ValueError) as caught:
            config_from_json(Fit, text)
        assert str(caught.value).startswith(problem)
    nested = json.loads(config_to_json(settings.PRESETS["best"]))
    nested["runtime"]["body_vertices"] = 0
    with pytest.raises(
        ValueError, match=r"config\.runtime\.body_vertices 0: expected 1 to 10,000,000"
    ):
        config_from_json(settings.Settings, json.dumps(nested))


HOSTILE = (
    0,
    -1,
    1,
    3,
    10**6,
    10**9,
    2**63,
    0.5,
    -0.5,
    1e-300,
    1e300,
    np.nan,
    np.inf,
    None,
    True,
    "x",
    [],
    {},
)


def leaves(value, path=()):
    if isinstance(value, dict | list) and value:
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(each, (*path, key))
    else:
        yield path


@pytest.mark.parametrize(
    "whole",
    [settings.PRESETS["best"], pytest.param(config.tiny(), marks=pytest.mark.slow)],
    ids=lambda x: type(x).__name__,
)
def test_any_value_in_any_field_is_read_or_refused_in_one_line(whole):
    text, refused = config_to_json(whole), 0
    for path in leaves(json.loads(text)):
        for value in HOSTILE:
            content = json.loads(text)
            *parents, last = path
            place = content
            for key in parents:
                place = place[key]
            place[last] = value
            try:
                config_from_json(type(whole), json.dumps(content))
            except ValueError as error:
                refused += 1
                assert len(str(error).splitlines()) == 1
    assert refused > 100


def test_fields_are_varied_by_their_paths():
    run = config.PRESETS["tiny"]()
    varied = vary(run, {"model.runtime.crop": not run.model.runtime.crop, "loss.squared": 0.25})
    assert varied.loss.squared == 0.25 and varied.model.runtime.crop != run.model.runtime.crop
    assert (
        vary(
            varied, {"model.runtime.crop": run.model.runtime.crop, "loss.squared": run.loss.squared}
        )
        == run
    )
    for path, like in {
        "loss.squard": "; did you mean loss.squared?",
        "architecture.encoder.class_token": (
            "; did you mean model.architecture.encoder.transformer.class_token?"
        ),
        "near": "; did you mean model.runtime.raster.near or splat.near?",
        "steps.a": "; did you mean steps?",
        "nonsense": "",
    }.items():
        with pytest.raises(
            ValueError, match=re.escape(f"{path}: TrainConfig has no such field{like} (all")
        ):
            vary(run, {path: 1.0})
    with pytest.raises(ValueError, match="squared"):
        vary(run, {"loss.squared": -1.0})


def test_files_with_earlier_names_of_fields_are_read():
    text = '{"skinning_reach": 0.04, "low_pass": 0.01, "longest_edge": 0.03}'
    read = config_from_json(Conventions, text)
    assert read == Conventions(leg_blend_distance=0.04, pixel_footprint=0.01, max_edge_length=0.03)
    assert config_from_json(Runtime, '{"longest_edge": 0.02}') == Runtime(max_edge_length=0.02)
    assert config_from_json(Conventions, config_to_json(read)) == read
    with pytest.raises(ValueError, match=r"config\.longest_edge: Runtime has no such field"):
        config_from_json(Runtime, '{"longest_edge": 0.02, "max_edge_length": 0.03}')
