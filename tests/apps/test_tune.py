"""Settings for a budget: presets, files of settings, the choice, and the command."""

import dataclasses
import json
import typing
from pathlib import Path

import jax
import pytest
from command_line import run

from humangs_jax.apps import settings as tuning
from humangs_jax.apps.settings import (
    PRESETS,
    Cost,
    Settings,
    load_settings,
    save_settings,
    tune,
)
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.cli.options import Preset
from humangs_jax.data.capture import Capture, load_capture, save_capture
from humangs_jax.network import presets
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.weights import save_weights

TRADEOFF = Path(__file__).parents[2] / "docs" / "results" / "tradeoff.json"


@pytest.mark.parametrize("name", PRESETS)
def test_settings_come_back_from_their_file(name, tmp_path):
    file = tmp_path / "tuned.json"
    save_settings(file, PRESETS[name], measured={"frame_ms": 30.0})
    assert load_settings(file) == PRESETS[name]
    assert json.loads(file.read_text())["measured"] == {"frame_ms": 30.0}


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{", "line 1: not valid JSON"),
        ("[]", 'expected "kind": "humangs_jax settings"'),
        ('{"kind": "humangs_jax settings"}', "config: expected an object, got None"),
        (
            '{"kind": "humangs_jax settings", "settings": {"speed": 9}}',
            "config.speed: Settings has no such field",
        ),
        ('{"kind": "humangs_jax settings", "settings": {"views": "two"}}', "config.views"),
        (
            '{"kind": "humangs_jax settings", "settings": {"views": 0}}',
            "config.views 0: expected 1 to 1,024",
        ),
        ('{"kind": "humangs_jax settings", "settings": {"splat": "blurred"}}', "config.splat"),
    ],
)
def test_what_is_wrong_in_a_file_of_settings_is_one_line(content, problem, tmp_path):
    file = tmp_path / "tuned.json"
    file.write_text(content)
    with pytest.raises(ValueError) as caught:
        load_settings(file)
    text = str(caught.value)
    assert text.startswith(f"{file}: ") and problem in text and "\n" not in text


def test_presets_have_one_set_of_names():
    assert tuple(PRESETS) == typing.get_args(Preset)
    assert (
        not Settings().refinement
        and PRESETS["best"].refinement.steps == PRESETS["best"].refine_steps
    )


def test_what_a_shot_says_wins_over_the_settings():
    settings = Settings(splat="fast", prune=True)
    assert settings.shot(FrameSettings(size=99)) == FrameSettings(size=99, splat="fast", prune=True)
    assert settings.shot(FrameSettings(splat="exact")).splat == "exact"


def test_presets_are_in_the_order_of_their_quality_on_the_page():
    """`tune` takes the last one that is fast enough."""
    points = json.loads(TRADEOFF.read_text())["numbers"]["points"]
    quality = lambda row: row["novel"]["psnr"] + row["animation"]["psnr"]
    qualities = [quality(points[f"preset {name}"]) for name in PRESETS]
    assert qualities == sorted(qualities), qualities


# The choice
# --------------------------------------------------------------------------------------------------

BY_PRESET = {
    "realtime": Cost(100.0, 10.0, 90.0),
    "balanced": Cost(400.0, 20.0, 110.0),
    "quality": Cost(800.0, 25.0, 200.0),
    "best": Cost(3000.0, 30.0, 320.0),
}


def tuned(monkeypatch, masks=(), **budget):
    """Returns what `tune` chooses on a machine on which the presets cost what `BY_PRESET` says."""
    names = {id(settings): name for name, settings in PRESETS.items()}
    monkeypatch.setattr(tuning, "measure", lambda settings, *_: BY_PRESET[names[id(settings)]])
    capture = object.__new__(Capture)  # nothing of it is measured
    object.__setattr__(capture, "masks", masks)
    return tune({}, presets.tiny(), capture, **budget)


@pytest.mark.parametrize(
    ("budget", "name"),
    [
        ({"reconstruct_ms": 1e9}, "best"),
        ({"reconstruct_ms": 1001.0}, "quality"),  # 25 % of room
        ({"reconstruct_ms": 999.0}, "balanced"),
        ({"frame_ms": 20.0}, "realtime"),
        ({"reconstruct_ms": 1e9, "memory_mb": 200.0}, "quality"),
    ],
)
def test_the_best_preset_within_the_budget_is_chosen(monkeypatch, budget, name):
    found = tuned(monkeypatch, **budget)
    assert found.name == name and found.settings == PRESETS[name]
    later = list(PRESETS)[list(PRESETS).index(name) + 2 :]
    assert not set(later) & set(found.measured), "what is slower still is not timed"


def test_where_nothing_is_within_the_budget_the_fastest_is_named(monkeypatch):
    with pytest.raises(ValueError, match="'realtime', the fastest, takes 100 ms a reconstruction"):
        tuned(monkeypatch, frame_ms=1.0)


def test_without_masks_no_preset_that_refines_is_tried(monkeypatch):
    found = tuned(monkeypatch, masks=None, frame_ms=1e9)
    assert found.name == "realtime" and list(found.measured) == ["realtime"]


# The command
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_tuning_for_real(tmp_path, monkeypatch, capsys):
    """A large budget gives the better of two presets, a tiny one none.

    `reconstruct` and `render` read the file that is written.
    """
    monkeypatch.chdir(tmp_path)
    config, demo = presets.tiny().with_conventions(body_vertices=500), load_capture("demo_capture")
    capture = dataclasses.replace(demo.resized(64), names=demo.names)
    save_capture(tmp_path / "someone", capture)
    variables = init_humangs(jax.random.key(0), config)
    save_weights(tmp_path / "tiny.safetensors", variables, config)
    # only two presets, both quick enough for a test
    small = Runtime(image_size=32)
    fast = Settings(views=1, runtime=small, splat="fast")
    refined = Settings(runtime=small, refine_iterations=1, refine_steps=3)
    monkeypatch.setitem(PRESETS, "realtime", fast)
    monkeypatch.setitem(PRESETS, "balanced", refined)
    for name in ("quality", "best"):
        monkeypatch.delitem(PRESETS, name)
    found = tune(variables, config, capture, reconstruct_ms=1e8, frame_ms=1e8, size=32)
    assert found.name == "balanced" and set(found.measured) == {"realtime", "balanced"}
    weights = ("--weights", "tiny.safetensors")
    command = ("tune", "someone", *weights, "--size", "32", "--out", "tuned.json")

    # a budget that no preset keeps to, then one that both keep to
    code, _, err = run(monkeypatch, capsys, *command, "--reconstruct-ms", "0.001")
    assert code == 1 and "no preset is within the budget" in err.splitlines()[-1]
    assert not (tmp_path / "tuned.json").exists()

    code, out, err = run(
        monkeypatch, capsys, *command, "--reconstruct-ms", "1e7", "--frame-ms", "1e6"
    )
    assert code == 0, err
    assert "balanced: " in out and " ms a reconstruction, " in out
    assert load_settings(tmp_path / "tuned.json") == refined

    # the commands take the written file
    run_with = lambda *words: run(monkeypatch, capsys, *words, "--config", "tuned.json")
    code, _, err = run_with("reconstruct", "someone", *weights, "--no-check")
    assert code == 0 and len(Avatar.load("avatar.npz").gaussians.means), err
    save_capture(tmp_path / "unmasked", dataclasses.replace(capture, masks=None))
    words = ("reconstruct", "unmasked", *weights, "--no-check", "--out", "plain.npz")
    code, out, err = run(monkeypatch, capsys, *words, "--preset", "balanced")
    assert code == 0 and "no masks: the avatar is not refined" in out + err, err
    code, _, err = run_with("render", "avatar.npz", "--size", "32", "--views", "2")
    assert code == 0 and len(list((tmp_path / "views").glob("*.png"))) == 2, err
