import builtins
import collections
import os
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from torch_writer import FakeTensor, pickled, plain_pickle, stream, write_checkpoint

from humangs_jax.io.restricted_pickle import as_array
from humangs_jax.io.tensors import read_torch_file, read_values

DATA = Path(__file__).parent / "data"


def test_a_file_that_torch_wrote():
    """The file is a state dict of torch 2.15 (write_torch_files.py)."""
    state, skipped = read_torch_file(DATA / "torch_zip.pth")
    truth = dict(np.load(DATA / "torch_numbers.npz"))
    assert skipped == 0 and list(state) == list(truth)
    for key, numbers in truth.items():
        assert state[key].dtype == numbers.dtype and np.array_equal(state[key], numbers), key
    some, skipped = read_torch_file(DATA / "torch_zip.pth", lambda key: key.startswith("0."))
    assert sorted(some) == ["0.bias", "0.weight"] and skipped == len(truth) - 2


def write_pickle(path, data, **members):
    """Writes a checkpoint whose pickle consists of these bytes."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", data)
        for name, content in members.items():
            archive.writestr(f"archive/data/{name}", content)
    return path


def test_tensors_are_views_of_their_storages(tmp_path):
    numbers = np.arange(12, dtype=np.float32)
    halves = (np.asarray([1.0, -2.5, 0.1], np.float32).view(np.uint32) >> 16).astype(np.uint16)
    model = {
        "turned": FakeTensor(numbers, shape=(2, 3), strides=(1, 4), offset=2),
        "scalar": FakeTensor(np.asarray([7], np.int64), "LongStorage", shape=()),
        "empty": FakeTensor(numbers[:0], shape=(0, 3), strides=(3, 1)),
        "half": FakeTensor(halves, "BFloat16Storage"),
        "loss_computer.vgg": FakeTensor(numbers),
    }
    content = {
        "model": collections.OrderedDict(model),
        "optimizer": {"state": FakeTensor(numbers)},
        "step": 3,
    }
    path = write_checkpoint(tmp_path / "a.pt", content)
    state, skipped = read_torch_file(path, lambda key: not key.startswith("loss_computer."))
    assert skipped == 1 and set(state) == set(model) - {"loss_computer.vgg"}
    assert np.array_equal(state["turned"], [[2, 6, 10], [3, 7, 11]])
    assert state["scalar"].shape == () and state["scalar"] == 7 and state["empty"].shape == (0, 3)
    assert state["half"].dtype == np.float32 and np.allclose(
        state["half"], [1, -2.5, 0.1], rtol=2**-7
    )
    assert read_torch_file(path)[1] == 0 and set(read_torch_file(path)[0]) == set(model)


def test_only_storages_of_the_state_dict_are_read(tmp_path):
    content = {
        "model": {"w": FakeTensor(np.ones(3, np.float32))},
        "optimizer": FakeTensor(np.ones(9, np.float32)),
    }
    path = write_checkpoint(tmp_path / "a.pt", content)
    with zipfile.ZipFile(path) as archive:
        members = {
            name: archive.read(name) for name in archive.namelist() if name != "archive/data/1"
        }
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    assert np.array_equal(read_torch_file(path)[0]["w"], np.ones(3))


class Call:
    """An object that is pickled as a call."""

    def __init__(self, function, *arguments):
        self.parts = function, arguments

    def __reduce__(self):
        return self.parts


CALLS = {
    f"{os.system.__module__}.system": Call(os.system, "echo owned > owned"),
    f"{os.mkdir.__module__}.mkdir": Call(os.mkdir, "owned"),
    "builtins.eval": Call(builtins.eval, "__import__('os').mkdir('owned')"),
    "builtins.exec": Call(builtins.exec, "import os; os.mkdir('owned')"),
    "builtins.getattr": Call(getattr, {}, "pop"),
    "Popen": Call(subprocess.Popen, ["mkdir", "owned"]),
    "multiarray._reconstruct": np.zeros(3),
    "multiarray.scalar": np.float64(3),
    "collections.defaultdict": collections.defaultdict(),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("place", ["model", "optimizer"])
def test_no_code_of_a_file_runs(name, place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = {"model": {"w": FakeTensor(np.ones(3, np.float32))}, "optimizer": {}}
    content[place]["evil"] = CALLS[name]
    with pytest.raises(
        ValueError, match=rf"a\.pt: refused to load [\w.]*{name}: no part of a state dict"
    ):
        read_torch_file(write_checkpoint(tmp_path / "a.pt", content))
    assert os.listdir(tmp_path) == ["a.pt"]


@pytest.mark.parametrize(
    "name", ["torch.load", "torch.jit._script", "torch._utils._rebuild_qtensor", "torch.nn.Module"]
)
def test_nor_does_any_other_call_of_torch(name, tmp_path):
    module, _, function = name.rpartition(".")
    data = b"\x80\x02}q\x00X\x05\x00\x00\x00modelc" + f"{module}\n{function}\n".encode() + b")Rs."
    with pytest.raises(ValueError, match=f"refused to load {name}"):
        read_torch_file(write_pickle(tmp_path / "a.pt", data))


def test_what_is_allowed_cannot_be_changed(tmp_path):
    """BUILD with a pair of dicts sets attributes of any object on the stack."""
    for target in (
        b"ctorch._utils\n_rebuild_tensor_v2\n",
        b"ctorch\nFloatStorage\n",
        b"ccollections\nOrderedDict\n",
    ):
        data = b"\x80\x02" + target + b"}}X\x04\x00\x00\x00namei" + b"X\x01\x00\x00\x00xs\x86b."
        data = data.replace(b"namei", b"name")
        with pytest.raises(ValueError, match=r"a\.pt"):
            read_torch_file(write_pickle(tmp_path / "a.pt", data))


BOMB = (1 << 40, 2)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"weights": {}}, "under 'model'"),
        ({"model": [3]}, "under 'model'"),
        ({}, "expected a state dict"),
        (
            {"w": FakeTensor(np.zeros(4, np.float32)), "epoch": 3},
            r"state_dict\['epoch'\] is no tensor but int",
        ),
        ({"model": {"w": 3}}, r"model\['w'\] is no tensor but int"),
        ({"model": {3: 3}}, "no string"),
        (
            {"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(5,))}},
            "w: shape .* does not fit",
        ),
        (
            {
                "model": {
                    "w": FakeTensor(np.zeros(4, np.float32), shape=(2,), strides=(-1,), offset=3)
                }
            },
            "no counts",
        ),
        ({"model": {"w": FakeTensor(np.zeros(4, np.float32), offset=-1)}}, "no counts"),
        (
            {"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(2,), strides=(1, 1))}},
            "1 axes and 2 strides",
        ),
        (
            {"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(2,), strides=(4,))}},
            "w: shape .* does not fit",
        ),
        (
            {"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=BOMB, strides=(0, 1))}},
            "does not fit",
        ),
        (
            {"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=("a",), strides=(1,))}},
            "no counts",
        ),
        (
            {"model": dict.fromkeys("abcdefghi", FakeTensor(np.zeros(9999, np.float32)))},
            "take more than 4 times the size",
        ),
    ],
)
def test_damaged_checkpoints_are_clear_errors(tmp_path, content, message):
    path = write_checkpoint(tmp_path / "a.pt", content)
    with pytest.raises(ValueError, match=message):
        read_torch_file(path)


def test_every_truncation_is_a_clear_error(tmp_path):
    path = write_checkpoint(
        tmp_path / "a.pt", {"model": {"w": FakeTensor(np.arange(40, dtype=np.float32))}}
    )
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.pt"):
            read_torch_file(path)


def damaged(path):
    """Changes one byte of a file at a time; returns (state dicts, number of refusals, bytes)."""
    whole, states, noticed = path.read_bytes(), [], 0
    for position in range(0, len(whole), 3):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x5A]) + whole[position + 1 :])
        try:
            states.append(read_torch_file(path)[0])
        except ValueError:
            noticed += 1
    return states, noticed, len(whole)


def test_every_damaged_byte_is_noticed_or_harmless(tmp_path):
    numbers = np.arange(40, dtype=np.float32)
    path = write_checkpoint(tmp_path / "a.pt", {"model": {"w": FakeTensor(numbers)}})
    states, noticed, size = damaged(path)
    # a time stamp, an unused field
    assert all(np.array_equal(state["w"], numbers) for state in states)
    assert noticed > size / 6


def test_files_that_are_no_checkpoints(tmp_path):
    other = tmp_path / "a.pt"
    with pytest.raises(FileNotFoundError):
        read_torch_file(other)
    other.write_bytes(b"legacy")
    with pytest.raises(ValueError, match=r"a\.pt: no file that torch\.save writes"):
        read_torch_file(other)
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("archive/readme", "")
    with pytest.raises(ValueError, match=r"data\.pkl"):
        read_torch_file(other)
    for data in (b"", b"\x80\x02}q", b"garbage", pickle.dumps({"model": {}})[:-1]):
        with pytest.raises(ValueError, match=r"a\.pt"):
            read_torch_file(write_pickle(other, data))
    with pytest.raises(ValueError, match="little-endian"):
        read_torch_file(write_checkpoint(other, {"model": {}}, byteorder="big"))
    bomb = {"model": {"w": FakeTensor(np.zeros(10**6, np.float32))}}
    with pytest.raises(ValueError, match="unpack to more than"):
        read_torch_file(write_checkpoint(other, bomb, compression=zipfile.ZIP_DEFLATED))


def test_a_file_from_before_torch_1_6_says_what_to_do():
    for read in (read_torch_file, read_values):
        with pytest.raises(ValueError, match=r"torch_stream\.pt: written before torch 1\.6: torch"):
            read(DATA / "torch_stream.pt")


def test_tensors_in_a_plain_pickle(tmp_path):
    """torch writes a stream for each storage, which `pickle` keeps as bytes."""
    numbers = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.asarray([1, 2], np.int64)}
    (tmp_path / "a.pkl").write_bytes(plain_pickle(numbers))
    found = read_values(tmp_path / "a.pkl")
    for key, truth in numbers.items():
        array = as_array(found[key])
        assert array.dtype == truth.dtype and np.array_equal(array, truth), key


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"first": 7}, "not a stream of torch"),
        ({"little": False}, "little-endian"),
        ({"count": 10**9}, "of 1000000000 numbers does not fit"),
        ({"count": -1}, "a storage of a tensor that is none"),
    ],
)
def test_damaged_storages_in_a_plain_pickle(change, words, tmp_path):
    made = lambda array, kind: stream(array, kind, **change)
    data = plain_pickle({"a": np.ones(3, np.float32)}, made)
    (tmp_path / "a.pkl").write_bytes(data)
    with pytest.raises(ValueError, match=rf"a\.pkl: .*({words})"):
        read_values(tmp_path / "a.pkl")


@pytest.mark.parametrize("items", [b"K\x03\x85R.", b"](]eK\x01\x86R.", b"](](K\x02K\x03ee\x85R."])
def test_an_ordered_dict_of_something_is_refused(items, tmp_path):
    data = b"\x80\x02ccollections\nOrderedDict\n" + items
    with pytest.raises(ValueError, match=r"a\.pt: an ordered dict that is made of something"):
        read_torch_file(write_pickle(tmp_path / "a.pt", data))


def test_a_storage_of_two_types_is_refused(tmp_path):
    data, _ = pickled(
        {"a": FakeTensor(np.ones(2, np.float32)), "b": FakeTensor(np.ones(2), "DoubleStorage")}
    )
    data = data.replace(b"X\x01\x00\x00\x001", b"X\x01\x00\x00\x000")
    with pytest.raises(ValueError, match="storage 0 is of two types"):
        read_torch_file(write_pickle(tmp_path / "a.pt", data))


def test_a_missing_storage_is_named(tmp_path):
    path = write_checkpoint(tmp_path / "a.pt", {"model": {"w": FakeTensor(np.ones(3, np.float32))}})
    with zipfile.ZipFile(path) as archive:
        data = archive.read("archive/data.pkl")
    with pytest.raises(ValueError, match="w: storage 0 is missing"):
        read_torch_file(write_pickle(path, data))
    with pytest.raises(ValueError, match="w: storage 0 is missing or damaged"):
        read_torch_file(write_pickle(path, data, **{"0": b"12345"}))


def test_torch_is_not_needed():
    assert "torch" not in sys.modules
