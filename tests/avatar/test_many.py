"""`humangs reconstruct` of a folder of captures, and `reconstruct_batch`, on the tiny network."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct_batch
from humangs_jax.data.capture import save_capture
from humangs_jax.network import presets
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.weights import save_weights


@pytest.fixture(scope="module")
def network():
    config = presets.tiny().with_conventions(body_vertices=500)
    return init_humangs(jax.random.key(0), config), config


@pytest.fixture(scope="module")
def small(demo):
    return dataclasses.replace(demo.resized(64), names=demo.names)


@pytest.fixture
def people(tmp_path, monkeypatch, network, small):
    """Returns a folder with three captures of two to four photos, and weights; b is damaged."""
    monkeypatch.chdir(tmp_path)
    save_weights(tmp_path / "tiny.safetensors", *network)
    for name, photos in {"a": 2, "b": 2, "c": 3, "d": 4}.items():
        save_capture(tmp_path / "people" / name, small.select(np.arange(photos)))
    (tmp_path / "people/b/body.npz").write_bytes(b"spoiled")
    return tmp_path


WORDS = ("reconstruct", "people", "--weights", "tiny.safetensors", "--refine", "0", "--no-check")


def written(folder):
    return {file.name: file.stat().st_mtime_ns for file in folder.glob("avatars/*.npz")}


@pytest.mark.slow
def test_a_folder_of_captures_goes_on_with_what_is_missing_and_mixes_nothing(people, humangs):
    code, _, err = humangs(*WORDS, "--batch", "2")
    assert code == cli.BAD_DATA and "warning: b: " in err
    assert err.splitlines()[-1] == "humangs: error: 1 of 4 captures failed: b"
    before = written(people)
    assert set(before) == {"a.npz", "c.npz", "d.npz"}
    for name in ("a", "d"):  # in a batch or alone
        assert humangs(WORDS[0], f"people/{name}", *WORDS[2:], "--out", f"{name}.npz")[0] == 0
        alone, batched = Avatar.load(f"{name}.npz"), Avatar.load(f"avatars/{name}.npz")
        # batched products round
        np.testing.assert_allclose(batched.gaussians.means, alone.gaussians.means, atol=1e-5)
    shutil.copy("people/a/body.npz", "people/b/body.npz")
    (people / "avatars/d.npz").unlink()
    for shard in ("0/3", "1/3", "2/3"):
        assert humangs(*WORDS, "--shard", shard)[0] == 0
    after = written(people)
    assert {name for name in after if after[name] != before.get(name)} == {"b.npz", "d.npz"}
    # other settings, other weights of that name, other photos of that name
    code, _, err = humangs(*WORDS, "--views", "2")
    assert code == cli.BAD_DATA and "views 'None' -> '2'" in err
    weights = (people / "tiny.safetensors").read_bytes()
    (people / "tiny.safetensors").write_bytes(weights[:-1] + bytes([weights[-1] ^ 1]))
    assert "asked for now (weights 'tiny.safetensors (" in humangs(*WORDS)[2]
    (people / "tiny.safetensors").write_bytes(weights)
    photos = sorted((people / "people/c/images").iterdir())
    shutil.copy(photos[0], photos[1])
    code, _, err = humangs(*WORDS)
    assert code == cli.BAD_DATA and written(people) == after
    assert "c.npz: made_from: made from other contents than people/c has now" in err


@pytest.mark.slow
def test_each_capture_is_answered_in_order_and_alone_where_its_batch_fails(network, small):
    """The second capture cannot be read. The third can be read, and fails in every batch."""

    def unreadable():
        raise OSError("thirteen")

    bright = dataclasses.replace(small, images=small.images * 255)
    captures = [lambda: small, unreadable, lambda: bright, small]
    found = list(reconstruct_batch(*network, captures, batch=3))
    assert [each.avatar is None for each in found] == [False, True, True, False]
    assert [each.capture is None for each in found] == [False, True, True, False]
    errors = [str(each.error) for each in found]
    assert errors[1] == "thirteen" and "images: expected numbers in" in errors[2]


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("reconstruct people --out x.npz", "--out x.npz: expected a folder"),
        (
            "reconstruct people/a people/b/../a",
            "people/a and people/b/../a: expected captures of different names",
        ),
        ("reconstruct people/a people/a", "people/a: given twice"),
        ("reconstruct people people/a", "people/a: given twice"),
        ("reconstruct", "CAPTURES: expected at least one folder"),
        ("reconstruct people --shard 3/3", "--shard 3/3: expected I/N"),
        (
            "reconstruct people/a --shard 3/8",
            "--shard 3/8: expected several captures, or a folder of them",
        ),
        ("reconstruct people/a --batch 0", "--batch 0: expected at least 1"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_the_work(
    line, problem, tmp_path, monkeypatch, humangs
):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        (tmp_path / "people" / name).mkdir(parents=True)
        (tmp_path / "people" / name / "capture.json").write_text("{}")
    code, out, err = humangs(*line.split())
    assert (code, out) == (cli.BAD_USAGE, "") and problem in err
    assert [path.name for path in tmp_path.iterdir()] == ["people"]
