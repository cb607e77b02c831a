"""The experiments of the paper: variants that belong together, differences within noise, tables."""

import argparse
import json

import numpy as np
import pytest

from experiments.harness import call
from experiments.paper import bench, claims, cost, figures, tables, train_all


@pytest.fixture(scope="module")
def queue():
    return bench.variants(40)


def run(psnr, photos=4, **others):
    scores = {"psnr": psnr + 6, "psnr_fg": psnr, "ssim": 0.9, **others}
    return {"by_views": {str(photos): scores}, "photos": photos, "parameters": 1_200_000, "steps": 40, "cpu_seconds": 60.4}


def test_variants_are_compared_with_variants_and_differ_from_them(queue):
    for name, variant in queue.items():
        assert variant.config.steps == 40 and variant.config.target_size == variant.config.model.conventions.image_size
        if variant.against is not None:
            against = queue[variant.against]
            assert variant.config != against.config and variant.claim
            assert variant.config.views == against.config.views  # the same photos
            assert against.against is None or against.against == "humangs", name
    assert list(queue)[:2] == ["back-projection", "cross-attention"]
    pair = [queue[name].config.model for name in list(queue)[:2]]
    assert pair[0].with_parts(reader=pair[1].architecture.reader) == pair[1]  # they differ in the reader alone
    assert len({bench.folder_of(name) for name in queue}) == len(queue)
    assert bench.view_counts("lhm", queue["lhm"].config) == (1,)
    assert bench.view_counts("no global token", queue["no global token"].config) == (1, 2, 4, 6)


def test_differences_inside_the_interval_of_the_seeds_are_noise(queue):
    rows = {"humangs": run(20.0), "humangs, another seed": run(20.3), "no shells": run(19.8)}
    # one pair: Student's t with one degree of freedom, 12.706
    assert bench.seed_interval(rows) == pytest.approx(12.706 * 0.3, rel=1e-3)
    pairs = rows | {"back-projection": run(19.0), "back-projection, another seed": run(19.4)}
    assert bench.seed_interval(pairs) == pytest.approx(4.303 * 0.125**0.5, rel=1e-3)
    assert bench.seed_interval({"humangs": run(20.0)}) is None
    words = [bench.verdict(difference, 0.3) for difference in (0.2, -0.3, 0.4, -0.4)]
    assert words == ["within noise", "within noise", "better", "worse"] and bench.verdict(1.0, None) == "noise unknown"
    rows |= {"pooling over all views": run(15.0), "lhm": run(12.5, photos=1), "humangs, 1 photo": run(18.0, photos=1)}
    painted = {"1": {"psnr_fg": 8.0}, "4": {"psnr_fg": 9.7}}
    text = train_all.table(rows, queue, {"validation": ["a", "b"]}, painted)
    lines = {cells[0].strip(): cells for line in text.splitlines() if (cells := line.strip("| ").split("|"))}
    assert [lines["no shells"][i].strip() for i in (5, 6, 7)] == ["humangs", "-0.20", "within noise"]
    said = {"pooling over all views": "worse", "humangs, another seed": "noise", "lhm": "not trained"}
    assert {name: lines[name][7].strip() for name in said} == said
    assert "2 unseen people" in text and "+-3.81 dB" in text
    assert bench.untrained(rows, painted) == ["lhm"]


def test_verdicts_of_claims_need_trained_systems_and_intervals_on_one_side():
    numbers = claims.Numbers()
    numbers.interval, numbers.gray = {"psnr": 0.1}, ["lhm"]
    assert numbers.judge(0.2, 0.3) == (claims.CONSISTENT, "")
    assert numbers.judge(0.2, 0.05) == (claims.NOT_TESTED, "the interval contains 0")
    assert numbers.judge(0.2, -0.3) == (claims.CONTRADICTED, "")
    assert numbers.judge(0.2, needs=["lhm", "humangs"]) == (claims.NOT_TESTED, "`lhm` is not trained")
    assert numbers.judge(-0.2, needs=["lhm"]) == (claims.CONTRADICTED, "`lhm` is not trained")


def test_the_page_of_the_paper_says_what_the_results_say():
    numbers = claims.Numbers()
    said = {row.claim: row.verdict for row in claims.claims(numbers)}
    assert set(said.values()) == set(claims.VERDICTS)
    assert said == bench.results("paper_claims")["verdicts"] and numbers.gray == bench.results("paper_claims")["untrained"]
    page = bench.PAGE.read_text()
    assert page.index(claims.CONTRADICTED, page.index("| holds? |")) < page.index(claims.CONSISTENT, page.index("| holds? |"))
    assert not any(line.rstrip(" |").endswith("yes") for line in page.splitlines() if line.startswith("|"))


def test_runs_of_other_settings_are_not_mixed(tmp_path):
    path = tmp_path / "results.json"
    assert train_all.kept(path, {"steps": 1}) == {}
    path.write_text('{"settings": {"steps": 2}, "runs": {}}')
    with pytest.raises(ValueError, match="other settings"):
        train_all.kept(path, {"steps": 1})


def test_tables_have_the_printed_rows_and_ours_beside_them(tmp_path):
    asked = []

    def measure(name, people, photos):
        asked.append((name, people, photos))
        scores = {"psnr": 20.0 + photos, "ssim": 0.9, "lpips_vgg": None}
        found = {"photos": photos, "reconstruction": scores, "animation": scores, "model_s": 0.5, "frame_s": 0.01}
        return found if people and name == "humangs" else None

    arguments = argparse.Namespace(people=tmp_path, other=[], near=None, split=None, fits=tmp_path / "fits.json")
    arguments.gray = []
    fit = {"animation": {"psnr": 21.0, "ssim": 0.9, "lpips_vgg": None}, "fit_s": 300.0, "frame_s": 0.5}
    arguments.fits.write_text(json.dumps({"numbers": {"paper_fits": {"a": fit, "b": fit}}}))
    texts = {name: table(["humangs", "lhm"], measure, arguments) for name, table in tables.TABLES.items()}
    assert "| humangs | 4 photos | 24.00 / 0.900 / - |  |  |" in texts["animation"]
    assert "| HumanGS | paper | 25.24 / 0.960 / 0.040 | 0.29 | 0.048 |" in texts["animation"]
    others, alone = texts["animation"].split("\n\n")
    assert "animatable" not in others and "| animatable | fitted to each of 2 other people | 21.00 / 0.900 / - |" in alone
    assert "| humangs | standard | 21.00 / 0.900 / - |" in texts["views"]
    assert "| LVSM | paper | 24.38 / 0.960 / 0.036 | - |" in texts["reconstruction"]
    assert "| humangs | 4 photos | 24.00 / 0.900 / - | - |" in texts["domains"]
    assert "| humangs | 4 photos |" in texts["gaussians"] and ("lhm", tmp_path, 4) in asked


def test_other_kinds_of_people_are_columns_and_another_split_a_row(tmp_path):
    def measure(name, people, photos):
        scores = {"psnr": 20.0 + len(people.name), "ssim": 0.9, "lpips_vgg": None}
        return {"photos": photos, "reconstruction": scores}

    people, other, third, unseen = (tmp_path / name for name in ("p", "walking", "hats", "unseen"))
    arguments = argparse.Namespace(people=people, other=[other, third], split=[tmp_path, unseen], gray=["lhm"])
    assert "| lhm | 4 photos, not trained | 21.00" in tables.domains(["lhm"], measure, arguments)
    text = tables.domains(["humangs"], measure, arguments)
    assert "in domain | cross-domain: walking | cross-domain: hats |" in text
    assert "| humangs | 4 photos | 21.00 / 0.900 / - | 27.00 / 0.900 / - | 24.00 / 0.900 / - |" in text
    assert "| humangs, on the other split | 4 photos | 26.00 / 0.900 / - | - | - |" in text
    assert "| HumanGS | paper | 30.81 / 0.980 / 0.024 | 27.27 / 0.970 / 0.033 |  |" in text


def test_a_cost_table_has_the_ratio_of_the_readers():
    readers = {
        "back-projection": {"cpu_ms": 2.0, "operations": 1e7, "temporary_mb": 1.0},
        "cross-attention": {"cpu_ms": 30.0, "operations": 9e9, "temporary_mb": 44.0},
    }
    network = {"photos": 4, "vertices": 10, "parameters": 1e8, "operations": 2e12}
    result = {
        "rows": [{"views": 4, "vertices": 10000, "size": 256, **readers}],
        "width": 128,
        "networks": {"humangs": network, "lhm": network | {"operations": 8e12}},
    }
    text = cost.text_of(result)
    assert "| 4 | 10000 | 256 | 2.0 | 30 | 15 | 10 | 9000 | 900 | 1.0 | 44 |" in text
    assert (
        "| lhm, joint attention alone | 4 | 10 | 100 | 8.00 | 4.0 |" in text
        and "| LHM (single view), printed seconds |  |  |  | 4.6 | 16 |" in text
    )


@pytest.mark.slow
def test_the_cost_of_the_readers_is_measured(tmp_path):
    files = tmp_path / "cost.json", tmp_path / "cost.png"
    options = ["--quick", "--repeats", "1", "--json", str(files[0]), "--image", str(files[1])]
    assert call(cost.paper_cost, options) == 0
    rows = json.loads(files[0].read_text())["numbers"]["paper_cost"]["rows"]
    assert [(row["views"], row["vertices"]) for row in rows] == [(1, 1000), (2, 1000), (1, 3000)]
    attention = [row["cross-attention"]["operations"] for row in rows]
    tokens, width = 8 * 8, 128
    by_hand = 2 * 1000 * (39 * width + 2 * width**2 + 8 * width**2) + 4 * tokens * width**2 + 4 * 1000 * tokens * width
    assert attention[0] == pytest.approx(by_hand, rel=0.01)
    assert all(row["back-projection"]["operations"] < 0.02 * row["cross-attention"]["operations"] for row in rows)
    assert files[1].stat().st_size > 1000


def test_patches_are_those_that_the_person_fills():
    mask = np.zeros((32, 32))
    mask[8:20, 8:16] = 1
    found = figures.patches(mask, 8)
    assert [(rows.start, columns.start) for rows, columns in found] == [(8, 8)]  # the one below is half full
    truth = np.zeros((32, 32, 3))
    assert figures.patch_error(truth, truth + 0.5, found[0]) == pytest.approx(0.25)


def test_photos_of_varying_poses_are_of_as_many_poses_as_there_are(tmp_path, monkeypatch):
    frames = argparse.Namespace(frames=np.repeat([0, 1, 2], 4))
    monkeypatch.setattr(figures, "find_captures", lambda folder: [folder / "person"])
    monkeypatch.setattr(figures, "load_capture", lambda folder: frames)
    chosen = figures.varied(tmp_path, 4)["person"]
    assert frames.frames[chosen["context"]].tolist() == [0, 1, 0, 1] and len(set(chosen["context"])) == 4
    assert frames.frames[chosen["target"]].tolist() == [2] * 4  # an novel pose
    (tmp_path / "person" / "held_out").mkdir(parents=True)
    assert figures.varied(tmp_path, 4) is None
