"""experiments/paper/check_parity.py, with numbers of an independent network (network_oracle.py)."""

import dataclasses
import json
from pathlib import Path

import network_golden as golden
import network_oracle as oracle
import numpy as np
import pytest
from network_oracle import Options
from torch_writer import tensors, write_checkpoint

from experiments.harness import call
from experiments.paper import check_parity

GOLDEN = Path(__file__).parents[3] / "shared" / "golden"
"""Folder of the whole golden data, if it lies beside the checkout."""
VARIANTS = {
    "no class token, one Gaussian, three views of 96": Options(
        class_token=False,
        gaussians=1,
        views=3,
        size=(96, 96),
        patch=12,
        all_views=False,
        skinning_head=True,
    ),
    "no upsampler, skinning head, four views, not square": Options(
        upsampler=False,
        skinning_head=True,
        gaussians=3,
        views=4,
        size=(24, 40),
        layers=2,
        subjects=2,
        all_views=False,
    ),
    "upsampler of six layers, heads without norms, a small patch": Options(
        layers=6,
        qk_norm=False,
        patch=4,
        size=(16, 16),
        gaussians=3,
        width=24,
        texture=(9, 3),
        views=1,
    ),
    "neither class token nor upsampler, one layer": Options(
        class_token=False, upsampler=False, layers=1, gaussians=4
    ),
}
SMALL = VARIANTS["neither class token nor upsampler, one layer"]


def write_triple(folder, options, change=lambda arrays: None):
    state, arrays, config = oracle.triple(options)
    change(arrays)
    write_checkpoint(folder / "a.pt", {"model": tensors(state)})
    np.savez(folder / "a.npz", **arrays)
    (folder / "a.json").write_text(json.dumps(config))
    return folder / "a.pt"


def run(checkpoint, dtype="float32"):
    """Returns (exit status, column of the result)."""
    out = checkpoint.with_name("out.json")
    given = [checkpoint, "--dtypes", dtype, "--json", out]
    code = call(check_parity.parity, [str(each) for each in given])
    return code, json.loads(out.read_text())["numbers"]["parity_stages"][
        f"{dtype}, {checkpoint.stem}"
    ]


def test_the_oracle_is_the_published_network():
    """The authors' own code computed the stages of golden_a."""
    state, _ = golden.read_state_dict(golden.CHECKPOINT)
    arrays = dict(np.load(golden.SUBJECT)) | {"in_lbs_weights": state["tpose_lbs_weights"]}
    options = Options(width=64, head=16, gaussians=5, texture=(16, 4))
    inputs = {name: x.astype(np.float64) for name, x in arrays.items() if name.startswith("in_")}
    found = oracle.Network(state, options).subject(inputs)
    errors = golden.thinned_errors(found, arrays)
    assert len(errors) == 17 and max(errors.values()) < 2e-7, errors  # stored as float32


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_every_option_of_the_network(name, tmp_path):
    options = VARIANTS[name]
    code, result = run(write_triple(tmp_path, options), "float64")
    assert code == 0 and result["bound"] == 1e-6 and result["passed"] is True
    assert len(result["stages"]) == 16 + options.upsampler
    assert max(result["stages"].values()) < 2e-7, result  # the numbers are stored as float32


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_other_precisions(dtype, tmp_path):
    checkpoint = write_triple(tmp_path, dataclasses.replace(SMALL, layers=2, class_token=True))
    code, result = run(checkpoint, dtype)
    assert code == 0 and result["bound"] == {"float32": 2e-5, "bfloat16": 5e-2}[dtype]
    if dtype == "bfloat16":
        assert result["stages"]["mid_encoder_out"] > 1e-4  # else it were float32
        assert result["stages"]["out_ray_d"] < 1e-6


def test_one_wrong_number_in_any_stage_fails():
    """The stages are computed once, and each gets an error in turn."""
    _, arrays, _ = oracle.triple(SMALL)
    expected = {name: x for name, x in arrays.items() if not name.startswith("in_")}
    found = {name: x.astype(np.float64) for name, x in expected.items()}
    assert max(check_parity.relative_errors(found, expected).values()) == 0
    for name, x in expected.items():
        spoilt = x.copy()
        spoilt.flat[x.size // 2] += 1e-3 * np.abs(x).max()
        assert check_parity.relative_errors(found, expected | {name: spoilt})[name] > 5e-4
    negative = expected | {"posed_rotations": -expected["posed_rotations"]}
    assert check_parity.relative_errors(found, negative)["posed_rotations"] == 0
    negative = expected | {"asset_rotations": -expected["asset_rotations"]}
    assert check_parity.relative_errors(found, negative)["asset_rotations"] > 0.5


@pytest.mark.slow
def test_what_is_not_compared_fails(tmp_path, capsys):
    def change(arrays):
        arrays["mid_something"] = np.zeros(3, np.float32)
        arrays["mid_tokens"] = arrays["mid_tokens"][:, :-1]
        arrays["asset_colors"][0, 0, 0] += 0.1
        del arrays["posed_means3D"]

    code, result = run(write_triple(tmp_path, SMALL, change))
    stages = result["stages"]
    assert (
        code == 1
        and result["passed"] is False
        and stages["mid_something"] is None
        and stages["mid_tokens"] is None
    )
    assert (
        stages["asset_colors"] > 0.05
        and stages["mid_block_0"] < 2e-5
        and "posed_means3D" not in stages
    )
    printed = capsys.readouterr().out
    assert printed.count("NOT COMPARED") == 2 and printed.count("TOO LARGE") == 1


def test_ties_of_posed_rotations_are_free_and_nothing_else_is():
    """One blended transform has two solutions, of which one is 1e-3 better conditioned."""
    readings = np.zeros((1, 1, 4, 4))
    readings[0, 0, :2] = [[0.6, 0.5, 0, 0], [0.4, 0.7, 0, 0]]
    found = {
        "posed_rotations": readings[:, :, 0],
        check_parity.TIES: readings,
        check_parity.TIE_LEVELS: np.asarray([[[1.001, 1, 0.2, 0]]]),
    }

    def error(reference, bound):
        return check_parity.relative_errors(
            found, {"posed_rotations": np.asarray(reference).reshape(1, 1, 4)}, bound
        )["posed_rotations"]

    assert error([0.6, 0.5, 0, 0], 0) == 0 and error([-0.4, -0.7, 0, 0], 2e-3) == 0
    assert error([0.4, 0.7, 0, 0], 5e-4) > 0.2 and error([0, 0, 0, 0.7], 2e-3) > 0.2


def test_nothing_not_a_number_passes():
    reference = {"mid_tokens": np.ones(3)}
    for ours, theirs in (
        (np.asarray([1, np.nan, 1]), np.ones(3)),
        (np.ones(3), np.asarray([1, np.nan, 1])),
    ):
        assert check_parity.relative_errors({"mid_tokens": ours}, {"mid_tokens": theirs}) == {
            "mid_tokens": None
        }
    assert check_parity.relative_errors({}, reference) == {"mid_tokens": None}
    assert check_parity.relative_errors({"x": np.full(2, 3.0)}, {"x": np.zeros(2)}) == {"x": 3.0}


def spoil(change):
    return lambda path: np.savez(
        path.with_suffix(".npz"), **change(dict(np.load(path.with_suffix(".npz"))))
    )


def reconfigure(part, **settings):
    def change(path):
        config = json.loads(path.with_suffix(".json").read_text())
        section = config["training"] if part == "training" else config["model"][part]
        section.update(settings)
        path.with_suffix(".json").write_text(json.dumps(config))

    return change


UNUSABLE = {
    "no checkpoint": (lambda path: path.unlink(), "a.pt"),
    "no arrays": (lambda path: path.with_suffix(".npz").write_bytes(b"no zip"), "a.npz"),
    "no JSON": (lambda path: path.with_suffix(".json").write_text("{"), "a.json"),
    "an input missing": (
        spoil(lambda a: {k: x for k, x in a.items() if k != "in_c2w"}),
        "'in_c2w' is missing",
    ),
    "an input of another shape": (
        spoil(lambda a: a | {"in_c2w": a["in_c2w"][:, :1]}),
        "in_c2w has shape",
    ),
    "no stages": (spoil(lambda a: {k: x for k, x in a.items() if k.startswith("in_")}), "no stage"),
    "other sizes": (reconfigure("transformer", n_layer=3), "model.transformer.n_layer is 3"),
    "another K": (reconfigure("vertex_decoder", num_free_gaussians=0), "1 tight and 0 free"),
    "canonical maps": (reconfigure("training", use_canonical_maps=True), "use_canonical_maps"),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_unusable_inputs_are_one_line(case, tmp_path, capsys):
    change, message = UNUSABLE[case]
    checkpoint = write_triple(tmp_path, SMALL)
    change(checkpoint)
    with pytest.raises(SystemExit) as exit_:
        run(checkpoint)
    assert exit_.value.code == 2 and message in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out.json").exists()


@pytest.mark.skipif(not GOLDEN.exists(), reason="no golden data beside this checkout")
@pytest.mark.slow
@pytest.mark.parametrize("dtype", check_parity.BOUNDS)
@pytest.mark.parametrize("name", ["golden_a", "golden_b"])
def test_the_golden_data_in_full(name, dtype):
    assert call(check_parity.parity, [str(GOLDEN / f"{name}.pt"), "--dtypes", dtype]) == 0
