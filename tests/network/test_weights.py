import dataclasses
import json
import os

import jax
import numpy as np
import pytest
from network_cases import TINY, random_variables
from safetensors.numpy import load_file, save_file

from humangs_jax.core.configuration import config_from_json, config_to_json
from humangs_jax.network import presets, weights
from humangs_jax.network.config import paper_parts
from humangs_jax.network.weights import load_weights, save_weights

ENCODER, _, _ = paper_parts(TINY.architecture)
VARIABLES = random_variables(TINY)
TEXTURE = "params/encoder/tokenizer/texture"


@pytest.fixture
def file(tmp_path):
    save_weights(tmp_path / "weights.safetensors", VARIABLES, TINY)
    return tmp_path / "weights.safetensors"


def rewrite(file, change, **metadata):
    """Writes the file again with other tensors or another header."""
    tensors = load_file(file)
    header = {
        "format": weights.FORMAT,
        "version": weights.VERSION,
        "architecture": config_to_json(TINY.architecture),
        "conventions": config_to_json(TINY.conventions),
    } | metadata
    change(tensors)
    save_file(tensors, file, header)


def test_round_trip(file):
    variables, config = load_weights(file)
    assert config == TINY.trained and jax.tree.structure(variables) == jax.tree.structure(VARIABLES)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(*map(jax.tree.leaves, (variables, VARIABLES)), strict=True)
    )
    assert os.listdir(file.parent) == [file.name]


def test_half_precision_halves_the_file_and_loads_as_float32(file, tmp_path):
    half = tmp_path / "half.safetensors"
    save_weights(half, VARIABLES, TINY, "float16")
    variables, _ = load_weights(half)
    for ours, exact in zip(*map(jax.tree.leaves, (variables, VARIABLES)), strict=True):
        assert ours.dtype == np.float32 and np.allclose(ours, exact, rtol=2**-11, atol=1e-7)
    assert half.stat().st_size < 0.65 * file.stat().st_size  # the header stays
    huge = jax.tree.map(lambda x: x * 1e6, VARIABLES)
    with pytest.raises(ValueError, match="overflows float16"):
        save_weights(half, huge, TINY, "float16")
    assert load_weights(half)[1] == TINY.trained  # the file that was there stays


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop(TEXTURE), f"'{TEXTURE}' is missing"),
        (lambda t: t.update(extra=np.zeros(2, np.float32)), "'extra' is unknown"),
        (
            lambda t: t.update({TEXTURE: t[TEXTURE][:, :4].copy()}),
            rf"'{TEXTURE}' has shape \(3, 4, 8, 2\)",
        ),
        (
            lambda t: t[TEXTURE].__setitem__((0, 0, 0, 0), np.nan),
            f"'{TEXTURE}' holds numbers that are not finite",
        ),
    ],
)
def test_tensors_that_do_not_fit_are_named(file, change, message):
    rewrite(file, change)
    with pytest.raises(ValueError, match=message):
        load_weights(file)


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"format": "other"}, "found format 'other'"),
        ({"version": "9"}, "version '9'"),
        ({"architecture": "{"}, "not JSON"),
        ({"conventions": json.dumps({"poll": "all"})}, "config.poll: Conventions has no such"),
        ({"conventions": json.dumps({"pool": "some"})}, "config.pool: .*got 'some'"),
        ({"conventions": json.dumps({"image_size": 100})}, "not a multiple of patch_size"),
        ({"architecture": json.dumps({"encoder": {"kind": "os.system"}})}, "config.encoder.kind"),
        (
            {"architecture": json.dumps({"encoder": {"kind": "antigravity.Encoder"}})},
            "import their module first",
        ),
        (
            {"architecture": json.dumps({"encoder": {"kind": "VertexDecoder"}})},
            "a registered Encoder, one of ",
        ),
        (
            {"architecture": json.dumps({"encoder": {"kind": "PatchTransformer", "a": 1}})},
            "encoder.a",
        ),
    ],
)
def test_bad_headers_are_clear_errors(file, metadata, message):
    rewrite(file, lambda t: None, **metadata)
    with pytest.raises(ValueError, match=message):
        load_weights(file)


def test_no_file_and_no_weights(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_weights(tmp_path / "nowhere.safetensors")
    garbage = tmp_path / "garbage.safetensors"
    garbage.write_bytes(b"\x10\0\0\0\0\0\0\0not safetensors at all")
    with pytest.raises(ValueError, match="not a readable safetensors"):
        load_weights(garbage)
    monkeypatch.setattr(weights, "SHIPPED", "assets/nothing.safetensors")
    with pytest.raises(FileNotFoundError, match="ships no weights"):
        load_weights()


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    wrong = TINY.with_parts(
        encoder=dataclasses.replace(ENCODER, texture=presets.TriplaneConfig(4, 2))
    )
    with pytest.raises(ValueError, match=TEXTURE):
        save_weights(tmp_path / "w.safetensors", VARIABLES, wrong)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_configurations_survive_json(name):
    config = presets.PRESETS[name]()
    assert config_from_json(type(config), config_to_json(config)) == config
    assert config_from_json(type(config), "{}") == type(config)()
