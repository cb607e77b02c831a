"""LPIPS in the evaluation script: a number with weights, missing without. The rest is the package's, tested there."""

import importlib.util
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.objectives.backbones import channels, random_weights
from humangs_jax.objectives.lpips import BACKBONES, Lpips, lpips

SCRIPT = Path(__file__).parents[1] / "experiments" / "evaluate_synthetic.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("evaluate_synthetic", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_lpips_is_missing_without_weights(script):
    assert script.lpips_scorer(None)(np.zeros((1, 8, 8, 3)), np.ones((1, 8, 8, 3))) is None
    row = {key: None if "lpips" in key else 0.5 for key in script.COLUMNS}
    assert script.table_row(row).split().count("-") == 2


def test_lpips_is_the_mean_over_views_of_clipped_pictures(script):
    heads = tuple(jnp.ones(count) for count in channels(BACKBONES["alex"]))
    weights = Lpips(random_weights(jax.random.key(0), BACKBONES["alex"]), heads, "alex")
    truth, predicted = np.random.default_rng(0).random((2, 2, 32, 32, 3)).astype(np.float32)
    predicted += 0.5
    found = script.lpips_scorer(weights)(predicted, truth)
    expected = [float(jax.jit(lpips)(weights, *pair)) for pair in zip(np.clip(predicted, 0, 1), truth, strict=True)]
    assert np.isclose(found, np.mean(expected), rtol=1e-6) and found > 0


def test_wrong_weights_are_one_line(script, tmp_path, monkeypatch, capsys):
    (tmp_path / "a.pth").write_bytes(b"something")
    for arguments in (["--lpips-backbone", tmp_path / "a.pth"], ["--lpips-heads", tmp_path / "a.pth"]):
        monkeypatch.setattr(sys, "argv", ["evaluate_synthetic.py", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            script.main()
        assert exit_.value.code == 2 and "a.pth" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow  # a person made, reconstructed and drawn
def test_the_report_says_that_lpips_is_missing(script, tmp_path, monkeypatch):
    options = ["--subjects", "1", "--held-out", "1", "--size", "128", "--json", str(tmp_path / "a.json")]
    monkeypatch.setattr(sys, "argv", ["evaluate_synthetic.py", *options])
    script.main()
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["lpips"] is None and report["lpips_net"] is None and report["subjects"][0]["lpips"] is None
    assert report["psnr"] > report["baseline_psnr"] > 10
