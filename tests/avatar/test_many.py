import dataclasses
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from command_line import save_tiny_avatar

from humangs_jax import cli
from humangs_jax.avatar import reconstruct as many
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct_many
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.network import presets
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.weights import save_weights


@pytest.fixture
def avatar(tmp_path):
    save_tiny_avatar(tmp_path / "tiny.npz")
    return Avatar.load(tmp_path / "tiny.npz")


def test_each_capture_is_answered_in_order_and_alone_where_its_batch_fails(monkeypatch, avatar):
    """13 cannot be read, 7 cannot be reconstructed, nor can a batch with it.

    Captures are numbered by their first frame.
    """
    calls, demo = [], load_capture("demo_capture")

    def batch(variables, config, captures):
        calls.append(tuple(number(each) for each in captures))
        if 7 in calls[-1]:
            raise ValueError("captures[0]")
        return [avatar for _ in captures]

    def alone(variables, config, capture):
        calls.append(number(capture))
        if calls[-1] == 7:
            raise ValueError("seven")
        return avatar

    def number(capture):
        return int(capture.names[0])

    def load(number):
        if number == 13:
            raise OSError("thirteen")
        return dataclasses.replace(demo, names=(str(number), *demo.names[1:]))

    monkeypatch.setattr(many, "reconstruct_batch", batch)
    monkeypatch.setattr(many, "reconstruct", alone)
    captures = {
        str(number): (lambda number=number: load(number)) for number in (1, 13, 2, 3, 7, 4, 5)
    }
    found = list(reconstruct_many({}, presets.tiny(), captures, batch=3))
    assert [each.name for each in found] == list(captures)
    errors = {each.name: str(each.error) for each in found if each.avatar is None}
    assert errors == {"13": "thirteen", "7": "seven"}
    assert calls == [(1, 2), (3, 7, 4), 3, 7, 4, 5]
    monkeypatch.setattr(
        many, "reconstruct", lambda *_: load(13)
    )  # what no capture is to blame for ends it
    with pytest.raises(OSError, match="thirteen"):
        list(reconstruct_many({}, presets.tiny(), {"1": lambda: load(1)}))


@pytest.fixture
def people(capture_folder, tmp_path, monkeypatch, avatar):
    """Four captures, one of them spoiled, and a network that always makes the same avatar: the
    names it was asked for.
    """
    for name in ("a", "b", "c", "d"):
        shutil.copytree(capture_folder, tmp_path / "people" / name)
    (tmp_path / "people/b/body.npz").write_bytes(b"spoiled")
    monkeypatch.chdir(tmp_path)
    asked = []

    def stand_in(variables, config, captures, batch=None):
        for name, load in captures.items():
            asked.append(name)
            done = many._loaded(name, load)
            yield done if done.error else done._replace(avatar=avatar)

    monkeypatch.setattr(many, "reconstruct_many", stand_in)
    return asked


def test_a_folder_of_captures_goes_on_after_failures_and_interruptions(people, tmp_path, humangs):
    line = ("reconstruct", "people", "--refine", "0", "--no-check", "--out", "avatars")
    code, _, err = humangs(*line)
    assert code == cli.BAD_DATA and "warning: b: " in err
    assert err.splitlines()[-1] == "humangs: error: 1 of 4 captures failed: b"
    assert {file.name for file in (tmp_path / "avatars").glob("*.npz")} == {
        "a.npz",
        "c.npz",
        "d.npz",
    }
    shutil.copy("people/a/body.npz", "people/b/body.npz")
    (tmp_path / "avatars/d.npz").unlink()
    people.clear()
    assert humangs(*line)[0] == 0 and people == ["b", "d"]
    code, _, err = humangs(*line, "--views", "2")
    assert code == cli.BAD_DATA and "views 'None' -> '2'" in err


def test_an_avatar_that_is_kept_was_made_from_what_its_capture_holds_now(people, tmp_path, humangs):
    shutil.copy("people/a/body.npz", "people/b/body.npz")
    line = ("reconstruct", "people", "--refine", "0", "--no-check", "--out", "avatars")
    assert humangs(*line)[0] == 0
    kept = (tmp_path / "avatars/c.npz").read_bytes()
    photos = sorted((tmp_path / "people/c/images").iterdir())
    shutil.copy(photos[0], photos[1])  # another person under the same name
    people.clear()
    code, _, err = humangs(*line)
    assert code == cli.BAD_DATA and not people
    assert "c.npz: made_from: made from other contents than people/c has now" in err
    assert (tmp_path / "avatars/c.npz").read_bytes() == kept
    (tmp_path / "avatars/c.npz").unlink()
    assert humangs(*line)[0] == 0 and people == ["c"]
    save_tiny_avatar(tmp_path / "avatars/d.npz")  # which does not say what it was made from
    assert "d.npz: made_from" in humangs(*line)[2]


def test_a_set_of_avatars_of_another_release_or_of_other_shipped_weights_is_refused(
    people, monkeypatch, humangs
):
    shutil.copy("people/a/body.npz", "people/b/body.npz")
    line = ("reconstruct", "people", "--refine", "0", "--no-check", "--out", "avatars")
    assert humangs(*line)[0] == 0
    monkeypatch.setattr("humangs_jax.network.weights.shipped_checksum", lambda: "0" * 64)
    monkeypatch.setattr("humangs_jax.__version__", "9.9")
    code, _, err = humangs(*line)
    assert code == cli.BAD_DATA
    assert "-> '9.9'" in err and "-> 'None (0000" in err


def test_an_avatar_of_a_set_whose_refinement_is_interrupted_is_made_again(
    people, tmp_path, monkeypatch, capsys
):
    shutil.copy("people/a/body.npz", "people/b/body.npz")
    stopped = ["b"]

    def refined(avatar, photos, how, **_):
        interrupted = people[-1:] == stopped
        summary = lambda: "refined"
        return SimpleNamespace(avatar=avatar, interrupted=interrupted, summary=summary)

    monkeypatch.setattr("humangs_jax.refinement.refine.refine_with_report", refined)
    line = ["reconstruct", "people", "--refine", "500steps", "--no-check", "--out", "avatars"]
    assert cli.execute(line) == cli.INTERRUPTED
    assert "b.npz: not written, its refinement was interrupted" in capsys.readouterr().out
    assert [file.name for file in (tmp_path / "avatars").glob("*.npz")] == ["a.npz"]
    people.clear()
    stopped.clear()
    assert cli.execute(line) == 0 and people == ["b", "c", "d"]
    stopped.append("a")
    assert cli.execute(["reconstruct", "people/a", *line[2:-1], "a.npz"]) == cli.INTERRUPTED
    assert (tmp_path / "a.npz").is_file()  # of one avatar what there is so far is written


def test_a_set_of_avatars_made_with_other_weights_of_that_name_is_refused(
    people, tmp_path, monkeypatch, humangs
):
    monkeypatch.setattr(
        "humangs_jax.network.weights.load_weights", lambda path: ({}, presets.tiny())
    )
    (tmp_path / "w.safetensors").write_bytes(b"one")
    line = ("reconstruct", "people", "--refine", "0", "--no-check", "--weights", "w.safetensors")
    humangs(*line)
    (tmp_path / "w.safetensors").write_bytes(b"another")
    code, _, err = humangs(*line)
    assert (
        code == cli.BAD_DATA
        and "written with settings other than asked for now (weights 'w.safetensors (" in err
    )


def test_shards_are_all_captures_once(people, humangs):
    for shard in ("0/3", "1/3", "2/3"):
        humangs(
            "reconstruct",
            "people",
            "--refine",
            "0",
            "--no-check",
            "--out",
            "avatars",
            "--shard",
            shard,
        )
    assert people == ["a", "d", "b", "c"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("reconstruct people --out x.npz", "--out x.npz: expected a folder"),
        (
            "reconstruct people/a people/b/../a",
            "people/b/../a and people/a: expected captures of different names",
        ),
        ("reconstruct", "CAPTURES: expected at least one folder"),
        ("reconstruct people --shard 3/3", "--shard 3/3: expected I/N"),
        (
            "reconstruct people/a --shard 3/8",
            "--shard 3/8: expected several captures, or a folder of them",
        ),
        ("reconstruct people/a --batch 0", "--batch 0: expected at least 1"),
    ],
)
def test_what_cannot_be_meant_is_said_before_the_work(line, said, people, humangs):
    code, out, err = humangs(*line.split())
    assert (code, out) == (cli.BAD_USAGE, "") and said in err and not people


@pytest.mark.slow
def test_batches_are_the_avatars_of_single_captures(tmp_path, monkeypatch, humangs):
    monkeypatch.chdir(tmp_path)
    config = presets.tiny().with_conventions(body_vertices=500)
    save_weights(tmp_path / "tiny.safetensors", init_humangs(jax.random.key(0), config), config)
    demo = load_capture("demo_capture")
    small = dataclasses.replace(demo.resized(64), names=demo.names)
    for number, name in enumerate(("a", "b", "c"), start=2):
        save_capture(tmp_path / "people" / name, small.select(np.arange(number)))
    words = ("--weights", "tiny.safetensors", "--refine", "0", "--no-check")
    assert humangs("reconstruct", "people", "--batch", "2", *words)[0] == 0
    for name in ("a", "b", "c"):
        assert humangs("reconstruct", f"people/{name}", *words, "--out", f"{name}.npz")[0] == 0
        alone, batched = Avatar.load(f"{name}.npz"), Avatar.load(f"avatars/{name}.npz")
        np.testing.assert_allclose(
            batched.gaussians.means, alone.gaussians.means, atol=1e-5
        )  # batched products round
