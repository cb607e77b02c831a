"""The paper's experiments: variants, differences within noise, and tables."""

import dataclasses
import functools
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import run as run_command
from data.datasets import made_up
from safetensors.numpy import save_file

from experiments.harness import call
from experiments.paper import bench, claims, cost, people, rows, tables, train_all
from experiments.training import abstract_batch, random_networks
from humangs_jax.body.library import load_body
from humangs_jax.core.configuration import config_to_json
from humangs_jax.data.capture import load_capture
from humangs_jax.data.preprocess.run import PreprocessConfig, preprocess
from humangs_jax.losses.loss_networks import installed_lpips
from humangs_jax.network.config import paper_parts
from humangs_jax.network.conversion import to_release
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.presets import paper, published
from humangs_jax.training.config import read_config, tiny
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update

PEOPLE = 20


def run(psnr, photos=4, done=True, seed=0, counts=(), curve=(10.0, 12.0, 12.1)):
    """Returns the row of a run whose test people have a mean PSNR of `psnr`."""
    # shared by all runs: people differ more than variants
    spread = np.random.default_rng(0).normal(0, 2, PEOPLE)
    noise = np.random.default_rng(seed + 1).normal(0, 0.05, PEOPLE)
    values = (psnr + spread + noise).tolist()
    scores = {
        "psnr": values,
        "psnr_fg": values,
        "ssim": [0.9] * PEOPLE,
        "lpips_alex": [0.1] * PEOPLE,
    }
    by_count = {
        str(count): {"reconstruction": scores, "animation": scores} for count in (photos, *counts)
    }
    return {
        "curve": list(curve),
        "validation": curve[-1],
        "done": done,
        "photos": photos,
        "steps": 40,
        "operations": 2e15,
        "parameters": 1000,
        "cpu_seconds": 60.0,
        **({"scores": by_count} if done else {}),
    }


def seeded(psnr, spread=0.1, **others):
    return {
        str(seed): run(psnr + spread * step, seed=seed, **others)
        for seed, step in enumerate((-1, 0, 1))
    }


@pytest.fixture
def report():
    painted = {"reconstruction": run(9.0)["scores"]["4"]["reconstruction"]} | {
        "animation": run(8.0)["scores"]["4"]["animation"]
    }
    runs = {
        "paper": seeded(15.0, counts=(1, 2, 6, *bench.NEAR)),
        "ghg": seeded(14.0, counts=(1, 2, 6, *bench.NEAR)),
        "giga": seeded(16.0),
        "lhm": {"0": run(12.5, photos=1)},
        "lvsm": {"0": run(0.0, done=False, curve=(9.0, 9.9))},
        "humanram": {"0": run(5.0, curve=(5.0, 9.0))},
    }
    settings = {"round_steps": 10, "people": 4, "test_people": PEOPLE}
    return {
        "settings": settings,
        "painted": {"validation": 8.0, "test": {"4": painted}},
        "runs": runs,
    }


def test_the_reference_is_the_papers_network_in_small():
    small, published = bench.variants()[bench.REFERENCE].model, paper()
    encoder, reader, decoder = paper_parts(small.architecture)
    theirs = paper_parts(published.architecture)
    sizes = {"width": 768, "layers": 12, "head_width": 64}
    assert encoder.texture == theirs[0].texture and encoder.upsampler.features == "intermediate"
    assert dataclasses.replace(encoder.transformer, **sizes) == theirs[0].transformer
    assert (reader.clone(output_width=768), decoder.clone(hidden=256)) == theirs[1:]
    assert (
        small.with_conventions(image_size=512, body_vertices=None).conventions
        == published.conventions
    )
    config = bench.configuration(bench.variants()[bench.REFERENCE], 0, 100, perceptual=True)
    loss, optimizer = config.loss, config.optimizer
    assert (loss.squared, loss.vgg16, loss.tightness, loss.structural, loss.silhouette) == (
        1,
        1,
        0.1,
        0,
        0,
    )
    assert (optimizer.learning_rate, optimizer.weight_decay, config.batch_size) == (4e-4, 0.05, 8)


def test_variants_differ_from_the_reference_in_what_they_are_about():
    queue = bench.variants()
    models = [(variant.model, json.dumps(str(variant.fields))) for variant in queue.values()]
    assert len(set(models)) == len(models) and len(
        {bench.folder_of(name) for name in queue}
    ) == len(queue)
    back, cross = queue["back_projection"].model, queue["cross_attention"].model
    # they differ in the reader alone
    assert back.with_parts(reader=cross.architecture.reader) == cross
    assert all(bench.configuration(x, 0, 8).loss.squared == 1 for x in queue.values())
    order = train_all.queue(3)
    assert order[0] == ("paper", 0) and len(set(order)) == len(order) == 3 * len(queue)
    assert {name for name, _ in order[-3:]} == {"gps"} and bench.tests_of("gps", queue["gps"]) == (
        "4",
    )
    assert (
        order.index(("paper", 2)) < order.index(("no global token", 0)) < order.index(("lvsm", 1))
    )
    assert (
        bench.tests_of("lhm", queue["lhm"]) == ("1",)
        and len(bench.tests_of("ghg", queue["ghg"])) == 8
    )


def test_a_run_ends_when_a_round_gains_nothing_and_counts_if_it_beats_the_painted_body():
    enough = lambda *curve: bench.enough(list(curve), 8.0)
    # below the painted body
    assert not enough() and not enough(9.0) and not enough(9.0, 9.5) and not enough(5.0, 5.1)
    assert (
        enough(10.0)
        and enough(9.0, 9.1)
        and enough(9.0, 9.5, 9.4)
        and enough(*[1.0] * bench.MOST_ROUNDS)
    )
    rising = run(1.0, curve=(9.0, 9.9))
    assert bench.is_trained(rising, 7.9) and not bench.is_trained(rising, 8.0)
    assert not bench.is_trained(rising | {"done": False}, 1.0)
    flat = run(1.0, curve=(9.0, 9.1))
    assert bench.is_trained(flat, 9.0) and not bench.is_trained(flat, 20.0)
    assert not bench.is_trained(flat | {"validation": 8.9}, 9.0)  # lost with the perceptual loss


def test_an_interval_covers_people_and_seeds(report):
    runs = report["runs"]
    found = bench.difference(runs, ("paper", 4), ("ghg", 4))
    assert (
        found.mean == pytest.approx(1.0, abs=0.05)
        and found.seeds == (3, 3)
        and found.people == PEOPLE
    )
    # 3 pairs of groups with a standard deviation of 0.1: 8 degrees or so; people are paired, so
    # that their spread does not count
    by_hand = 2.4 * 0.1 * (2 / 3) ** 0.5
    assert found.half == pytest.approx(by_hand, rel=0.15)
    alone = bench.difference(
        {name: {"0": runs[name]["0"]} for name in runs}, ("paper", 4), ("ghg", 4)
    )
    assert alone.half is None and str(alone) == f"{alone.mean:+.2f}"
    assert bench.difference(runs, ("lhm", 1), ("paper", 4)).half > found.half  # one seed of three


def test_verdicts_follow_from_intervals_and_need_trained_runs_of_three_seeds(report):
    pair = lambda a, b, count=4: claims.Pair((a, count), (b, count))
    assert claims.judge(report, [pair("paper", "ghg"), pair("paper", "ghg", 1)]) == (
        claims.REPRODUCED,
        "",
    )
    assert claims.judge(report, [pair("paper", "ghg"), pair("paper", "giga")]) == (
        claims.CONTRADICTED,
        "",
    )
    report["runs"]["ghg"] = seeded(15.0, counts=(1, 2, 6, *bench.NEAR))
    assert claims.judge(report, [pair("paper", "ghg")]) == (
        claims.NOT_TESTED,
        "an interval contains 0",
    )
    verdict = claims.judge(report, [claims.Pair(("paper", 4), ("lhm", 1)), pair("paper", "lvsm")])
    assert verdict == (claims.NOT_TESTED, "`lhm` has 1 of 3 seeds, `lvsm` is not trained: 40 steps")
    assert "not trained: 0 steps" in claims.judge(report, [pair("paper", "gst")])[1]
    text = claims.in_words(report, claims.Pair(("paper", 4), ("giga", 4)))
    assert text.startswith("`paper` 4 - `giga` 4: -1.0") and text.endswith(" dB") and "+-" in text


def test_every_claim_is_judged_and_names_variants_that_exist(report):
    known = {
        (name, test) for name, x in bench.variants().items() for test in bench.tests_of(name, x)
    }
    for claim in claims.claims():
        assert all(
            {(name, str(test)) for name, test in (pair.a, pair.b)} <= known for pair in claim.pairs
        ), claim.claim
    rows = claims.judged(report, claims.claims())
    assert {row[3] for row in rows} == set(claims.VERDICTS)


def test_the_page_of_the_paper_says_what_the_results_say():
    report, cost_numbers = bench.results("paper"), bench.results("paper_cost")
    rows = claims.judged(report, [*claims.claims(), *claims.of_cost(cost_numbers)])
    assert {row[0]: row[3] for row in rows} == bench.results("paper_claims")["verdicts"]
    page = bench.PAGE.read_text()
    verdicts = [
        line.split("|")[4].split(":")[0].strip()
        for line in page.splitlines()
        if line.count("|") == 5
    ]
    places = [claims.VERDICTS.index(verdict) for verdict in verdicts if verdict in claims.VERDICTS]
    assert places == sorted(places) and len(places) == len(rows)  # contradictions first


def test_runs_of_other_settings_are_not_mixed(tmp_path):
    path = tmp_path / "results.json"
    assert train_all.kept(path, {"people": 1})["runs"] == {}
    path.write_text('{"settings": {"people": 2}, "runs": {}}')
    with pytest.raises(ValueError, match="other settings"):
        train_all.kept(path, {"people": 1})


@pytest.mark.slow
def test_people_are_plain_and_a_system_without_poses_sees_one_of_them(tmp_path):
    folder = people.write_plain(tmp_path / "p", "demo", 1, 6, size=64)
    near = people.write_plain(tmp_path / "near", "demo", 1, 6, 4, near=True)
    capture, close = (load_capture(next(x.glob("3*"))) for x in (folder, near))
    assert capture.images.shape == (12, 64, 64, 3)
    assert close.images.shape == (6, people.SIZE, people.SIZE, 3)
    assert close.masks.mean() > 1.3 * capture.masks.mean()
    assert load_capture(next(near.glob("3*")) / "held_out").frame_count == 2
    # all people stand in the same light
    body = load_body()
    lights = [people.plain(seed, body).lights for seed in (3_000_000, 3_000_001)]
    jax.tree.map(np.testing.assert_array_equal, *lights)
    # with one pose, the targets show the pose of the photos
    config = bench.configuration(bench.variants()["lvsm"], 0, 4)
    make = lambda **how: people.on_disk(folder, **how)(config)
    both, one = make(), make(one_pose=True)

    def targets(source):
        return {
            x.targets.rotations.tobytes() != x.inputs.rotations[:1].tobytes()
            for i in range(12)
            for x in [source.example(0, i, 4)]
        }

    assert targets(one) == {False} and targets(both) == {False, True}
    # recolored people have their color channels in another order, by example
    colored = make(recolored=True)
    plain, changed = both.example(0, 3, 4), colored.example(0, 3, 4)
    orders = itertools.permutations(range(3))
    assert any(
        np.array_equal(plain.inputs.images[..., list(order)], changed.inputs.images)
        for order in orders
    )
    assert len({colored.example(0, i, 4).inputs.images.tobytes() for i in range(6)}) > 1


@pytest.mark.slow
@pytest.mark.skipif("alex" not in installed_lpips(), reason="needs humangs_jax[lpips]")
def test_the_queue_trains_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "MOST_ROUNDS", 2)
    out = tmp_path / "runs"
    assert call(train_all.paper, [str(out), "--quick", "--only", "gps"]) == 0
    report = json.loads((out / "results.json").read_text())
    row = report["runs"]["gps"]["0"]
    assert row["done"] and row["steps"] == 4 * len(row["curve"]) + 1 and row["operations"] > 0
    assert (
        list(row["scores"]["4"]) == ["reconstruction"]
        and len(row["scores"]["4"]["reconstruction"]["lpips_alex"]) == 2
    )
    before = (out / "results.json").stat().st_mtime_ns
    # nothing is left to do
    assert call(train_all.paper, [str(out), "--quick", "--only", "gps"]) == 0
    assert (out / "results.json").stat().st_mtime_ns == before


@pytest.mark.slow
def test_the_cost_of_the_readers_is_measured(tmp_path):
    files = tmp_path / "cost.json", tmp_path / "cost.png"
    options = ["--quick", "--repeats", "1", "--json", str(files[0]), "--image", str(files[1])]
    assert call(cost.paper_cost, options) == 0
    rows = json.loads(files[0].read_text())["numbers"]["paper_cost"]["rows"]
    assert [(row["views"], row["vertices"]) for row in rows] == [(1, 1000), (2, 1000), (1, 3000)]
    attention = [row["cross-attention"]["operations"] for row in rows]
    tokens, width = 8 * 8, 128
    by_hand = (
        2 * 1000 * (39 * width + 2 * width**2 + 8 * width**2)
        + 4 * tokens * width**2
        + 4 * 1000 * tokens * width
    )
    assert attention[0] == pytest.approx(by_hand, rel=0.01)
    assert all(
        row["back-projection"]["operations"] < 0.02 * row["cross-attention"]["operations"]
        for row in rows
    )
    assert files[1].stat().st_size > 1000


def test_photos_of_varying_poses_are_of_as_many_poses_as_there_are():
    frames = np.repeat(np.arange(12), 4)
    context, target = rows.varied(frames, 4)
    assert frames[context].tolist() == [0, 3, 6, 9] and [i % 4 for i in context] == [0, 1, 2, 3]
    assert not set(frames[context]) & set(frames[target]) and len(target) == 32
    few = np.repeat([0, 1, 2], 4)  # the last pose is new
    context, target = rows.varied(few, 4)
    assert (
        few[context].tolist() == [0, 1, 0, 1]
        and len(set(context)) == 4
        and few[target].tolist() == [2] * 4
    )
    assert rows.varied(np.zeros(8, int), 4) == ([], [])


def checkpoint(path):
    """Writes a small network's checkpoint as the authors store theirs."""
    encoder, reader, decoder = paper_parts(tiny().model.architecture)
    encoder, reader = encoder.clone(patch_size=64), reader.clone(sample_rgb=False, shells=())
    decoder = decoder.clone(frame="canonical", residual_color=False)
    state = to_release(
        init_humangs(
            jax.random.key(0),
            published().with_parts(encoder=encoder, reader=reader, decoder=decoder),
        )
    )
    state |= {"tpose_lbs_weights": np.zeros((10, 55), np.float32)}
    save_file({key: np.array(value) for key, value in state.items()}, path)
    return path


@pytest.mark.slow
def test_a_table_is_one_command_on_a_data_set(tmp_path, monkeypatch, capsys):
    """Rows are a converted checkpoint, a network that the command trained, and the shipped weights.

    They are scored on scenes of THuman, and on the same scenes from nearer.
    """
    raw, converted = tmp_path / "raw", tmp_path / "converted.safetensors"
    data, body = made_up.WRITERS["thuman"](raw, vertices=800, texture_size=128), raw / "body.npz"
    code, _, error = run_command(
        monkeypatch, capsys, "convert", checkpoint(tmp_path / "a.safetensors"), "--out", converted
    )
    assert code == 0, error
    for name, factors in (("scenes", (1.0, 1.75)), ("near", (2.0, 2.0))):
        settings = PreprocessConfig("thuman", size=64, views=10, factors=factors, supersample=1)
        settings = dataclasses.replace(settings, train=1, test=1)
        preprocess(data, tmp_path / name, str(body), settings, progress=False)
    (tmp_path / "config.json").write_text(config_to_json(dataclasses.replace(tiny(), steps=2)))
    words = (
        f"--data {tmp_path}/scenes/test.json --other {tmp_path}/near/test.json --body {body}"
        f" --weights converted={converted} --train {tmp_path}/mine"
        f" --train-on {tmp_path}/scenes/train.json --config {tmp_path}/config.json"
        f" --only domains --json {tmp_path}/out.json"
    )
    assert call(tables.tables, words.split()) == 0
    numbers = json.loads((tmp_path / "out.json").read_text())["numbers"]["tables"]["rows"]
    for row in ("converted", "mine", rows.SHIPPED):
        assert 0 < numbers[f"{row}, scenes, 4"]["reconstruction"][0] < 60
    scenes, near = (numbers[f"converted, {name}, 4"] for name in ("scenes", "near"))
    assert near["reconstruction"] != scenes["reconstruction"]


@pytest.mark.slow
def test_training_at_the_published_size_starts():
    """Both stages of `--config paper` are traced for a step: eight people at 256 pixels, four at
    512.
    """
    config, body = read_config("paper"), load_body()
    state, networks = (
        jax.eval_shape(lambda: init_state(config)),
        jax.eval_shape(lambda: random_networks(config)),
    )
    assert sum(x.size for x in jax.tree.leaves(state.variables["params"])) == pytest.approx(
        98.8e6, rel=1e-3
    )
    for start, people_a_step, side in ((0, 8, 256), (60_000, 4, 512)):
        part = config.at(start)
        batch = abstract_batch(part, len(body.parents), body.shape_directions.shape[-1])
        assert (
            batch.inputs.images.shape
            == batch.targets.images.shape
            == (people_a_step, 4, side, side, 3)
        )
        new, metrics = jax.eval_shape(
            functools.partial(update, config=part), state, batch, body, networks, seed_numbers(0)
        )
        assert (
            jax.tree.map(jnp.shape, new.params) == jax.tree.map(jnp.shape, state.params)
            and metrics["loss"].shape == ()
        )
