"""Settings for a budget: presets, files of settings, the choice, and the command."""

import dataclasses
import json
import typing

import jax
import pytest
from command_line import run
from hypothesis import assume, given
from hypothesis import strategies as st

from humangs_jax.apps import settings as tuning
from humangs_jax.apps.settings import (
    MARGIN,
    PRESETS,
    Budget,
    Cost,
    FrontPoint,
    Settings,
    choose,
    load_front,
    load_settings,
    predict,
    save_settings,
    tune,
)
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.shot import Shot
from humangs_jax.cli.options import Preset
from humangs_jax.data.capture import Capture, load_capture, save_capture
from humangs_jax.network import presets
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.weights import save_weights


@pytest.mark.parametrize("name", PRESETS)
def test_settings_come_back_from_their_file(name, tmp_path):
    file = tmp_path / "tuned.json"
    save_settings(file, PRESETS[name], measured={"frame_ms": 30.0})
    assert load_settings(file) == PRESETS[name]
    assert json.loads(file.read_text())["measured"] == {"frame_ms": 30.0}


@pytest.mark.parametrize(
    ("content", "said"),
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
def test_what_is_wrong_in_a_file_of_settings_is_one_line(content, said, tmp_path):
    file = tmp_path / "tuned.json"
    file.write_text(content)
    with pytest.raises(ValueError) as caught:
        load_settings(file)
    text = str(caught.value)
    assert text.startswith(f"{file}: ") and said in text and "\n" not in text


def test_presets_have_one_set_of_names():
    assert tuple(PRESETS) == typing.get_args(Preset)
    assert (
        not Settings().refinement
        and PRESETS["best"].refinement.steps == PRESETS["best"].refine_steps
    )


def test_what_a_shot_says_wins_over_the_settings():
    settings = Settings(splat="fast", prune=True)
    assert settings.shot(Shot(size=99)) == Shot(size=99, splat="fast", prune=True)
    assert settings.shot(Shot(splat="exact")).splat == "exact"


def test_every_preset_is_a_point_of_the_front_that_ships():
    """With the settings that the sweep has measured; the best one is called so."""
    front = {point.name: point for point in load_front()}
    assert {name: front[name].settings for name in PRESETS} == PRESETS
    qualities = [front[name].quality for name in PRESETS]
    assert qualities == sorted(qualities), qualities


# The choice
# --------------------------------------------------------------------------------------------------

shares = st.floats(0.05, 20)


@st.composite
def fronts(draw):
    count = draw(st.integers(1, 8))
    rows = [
        (
            draw(shares),
            draw(st.just(0.0) | shares),
            draw(shares),
            draw(st.floats(10, 2000)),
            draw(st.floats(15, 30)),
        )
        for _ in range(count)
    ]
    return [
        FrontPoint(str(i), Settings(), m, r, f, mib, q, q - 1)
        for i, (m, r, f, mib, q) in enumerate(rows)
    ]


def searched(front, machine, budget):
    """(answer, names measured) of the search with a machine that says what a point costs."""
    measured = {}
    while (point := choose(front, measured, budget)) is not None and point.name not in measured:
        measured[point.name] = machine(point)
    return point, measured


@given(
    fronts(), shares, shares, shares, st.floats(1, 3000), st.floats(1, 3000), st.floats(10, 2000)
)
def test_the_choice_is_the_best_within_the_budget_where_ratios_carry_over(
    front, make, refine, frame, most, each, memory
):
    machine = lambda p: Cost(
        100 * make * p.make, 100 * refine * p.refine, 10 * frame * p.frame, p.memory_mb
    )
    budget = Budget(most, each, memory)
    for point in front:  # where a point is at the edge of the budget, rounding decides
        cost = machine(point)
        assume(
            all(
                abs(a / b - 1) > 1e-6
                for a, b in ((MARGIN * cost.reconstruct_ms, most), (MARGIN * cost.frame_ms, each))
            )
        )
        assume(abs(cost.memory_mb / memory - 1) > 1e-6)
    allowed = [point for point in front if budget.allows(machine(point))]
    found, measured = searched(front, machine, budget)
    if not allowed:
        assert found is None
    else:
        assert found.quality == max(point.quality for point in allowed) and budget.allows(
            measured[found.name]
        )


@given(fronts(), st.randoms(use_true_random=False), st.floats(1, 3000))
def test_what_is_chosen_has_been_measured_within_the_budget_on_any_machine(front, random, most):
    machine = lambda p: Cost(
        random.uniform(1, 3000), random.uniform(0, 3000) if p.refine else 0.0, 1.0
    )
    budget = Budget(reconstruct_ms=most)
    found, measured = searched(front, machine, budget)
    assert len(measured) <= len(front)
    assert found is None or MARGIN * measured[found.name].reconstruct_ms <= most


def test_a_choice_that_is_slower_the_second_time_is_not_taken(monkeypatch):
    fast, good = (
        FrontPoint(n, Settings(views=v), float(v), 0.0, 1.0, 100.0, q, q)
        for n, v, q in (("a", 1, 20.0), ("b", 2, 25.0))
    )
    times = {1: [30.0, 31.0], 2: [70.0, 90.0]}
    measure = lambda settings, *_: Cost(times[settings.views].pop(0), 0.0, 10.0, None)
    monkeypatch.setattr(tuning, "measure", measure)
    capture = object.__new__(Capture)  # nothing of it is measured
    object.__setattr__(capture, "masks", ())
    tuned = tune({}, presets.tiny(), capture, reconstruct_ms=100.0, size=32, front=[fast, good])
    assert tuned.point is fast and tuned.cost == Cost(31.0, 0.0, 10.0) and not any(times.values())
    assert tuned.measured["b"].reconstruct_ms == 90


def test_costs_are_extrapolated_from_the_nearest_measured_point():
    front = [
        FrontPoint(name, Settings(), make, 0.0, frame, 100.0, 20.0, 19.0)
        for name, make, frame in (("a", 1.0, 1.0), ("b", 4.0, 1.0), ("c", 8.0, 2.0))
    ]
    measured = {"a": Cost(100.0, 0.0, 10.0, 50.0), "b": Cost(300.0, 0.0, 10.0, 60.0)}
    assert predict(front[2], front, measured) == Cost(600.0, 0.0, 20.0, 50.0)
    assert choose(front, {}, Budget(frame_ms=1.0)).name == "a"  # the cheapest first


def test_what_is_given_up_is_said():
    low, best = (
        FrontPoint(n, Settings(views=2), 1.0, 0.0, 1.0, 100.0, q, q - 2)
        for n, q in (("low", 20.0), ("best", 26.5))
    )
    text = str(tuning.Tuned(low, Cost(210.0, 0.0, 12.5, 300.0), best, {}))
    assert (
        text.startswith("low") and "takes 210 ms a reconstruction, 12.5 ms a frame, 300 MiB" in text
    )
    assert (
        "gives up 6.5 dB in the pose of the photos and 6.5 dB in novel poses against 'best'" in text
    )
    assert "is the best of all settings" in str(tuning.Tuned(best, Cost(1.0, 0.0, 1.0), best, {}))


def test_without_masks_nothing_that_refines_is_tried(monkeypatch):
    tried = []
    monkeypatch.setattr(
        tuning, "measure", lambda settings, *_: tried.append(settings) or Cost(1.0, 0.0, 1.0)
    )
    capture = object.__new__(Capture)
    object.__setattr__(capture, "masks", None)
    tuned = tune({}, presets.tiny(), capture, frame_ms=1e9)
    assert tuned.point.settings.refinement is tuned.best.settings.refinement is None and not any(
        each.refinement for each in tried
    )


# The command
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_tuning_for_real(tmp_path, monkeypatch, capsys):
    """The smallest network finds the better of two settings in a large budget, none in a tiny one;
    `reconstruct`, `animate` and `render` take the file.
    """
    monkeypatch.chdir(tmp_path)
    config, demo = presets.tiny().with_conventions(body_vertices=500), load_capture("demo_capture")
    capture = dataclasses.replace(demo.resized(64), names=demo.names)
    save_capture(tmp_path / "someone", capture)
    variables = init_humangs(jax.random.key(0), config)
    save_weights(tmp_path / "tiny.safetensors", variables, config)
    small = Runtime(image_size=32)
    front = [
        FrontPoint(
            "one photo",
            Settings(views=1, runtime=small, splat="fast"),
            0.5,
            0.0,
            0.8,
            100.0,
            20.0,
            19.0,
        ),
        FrontPoint(
            "refined",
            Settings(runtime=small, refine_iterations=1, refine_steps=3),
            1.0,
            2.0,
            1.0,
            150.0,
            24.0,
            21.0,
        ),
    ]
    assert (
        tune(
            variables, config, capture, reconstruct_ms=1e8, frame_ms=1e8, size=32, front=front
        ).point.name
        == "refined"
    )
    monkeypatch.setattr(tuning, "load_front", lambda: front)
    command = (
        "tune",
        "someone",
        "--weights",
        "tiny.safetensors",
        "--size",
        "32",
        "--out",
        "tuned.json",
    )

    code, _, err = run(monkeypatch, capsys, *command, "--reconstruct-ms", "0.001")
    assert code == 1 and "no setting is within the budget" in err.splitlines()[-1]
    assert not (tmp_path / "tuned.json").exists()

    code, out, err = run(
        monkeypatch, capsys, *command, "--reconstruct-ms", "1e7", "--frame-ms", "1e6"
    )
    assert code == 0, err
    assert "refined\n" in out and "is the best of all settings" in out
    assert load_settings(tmp_path / "tuned.json") == front[1].settings

    run_with = lambda *words: run(monkeypatch, capsys, *words, "--config", "tuned.json")
    code, _, err = run_with("reconstruct", "someone", "--weights", "tiny.safetensors", "--no-check")
    assert code == 0 and len(Avatar.load("avatar.npz").gaussians.means), err
    save_capture(tmp_path / "unmasked", dataclasses.replace(capture, masks=None))
    words = (
        "reconstruct",
        "unmasked",
        "--weights",
        "tiny.safetensors",
        "--no-check",
        "--out",
        "plain.npz",
    )
    code, out, err = run(monkeypatch, capsys, *words, "--preset", "quality")
    assert code == 0 and "no masks: the avatar is not refined" in out + err, err
    code, _, err = run_with("render", "avatar.npz", "--size", "32", "--views", "2")
    assert code == 0 and len(list((tmp_path / "views").glob("*.png"))) == 2, err
