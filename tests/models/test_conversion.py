import collections
import dataclasses
import os
import pickle
import sys
import types
import zipfile

import numpy as np
import pytest
from network_golden import CHECKPOINT

from humangs_jax.models import conversion
from humangs_jax.models.conversion import infer_config, load_checkpoint, map_tensor, read_state_dict


@dataclasses.dataclass
class FakeTensor:
    """What `torch.save` writes for a tensor: a storage by reference, and a view of it."""

    storage: np.ndarray
    kind: str = "FloatStorage"
    shape: tuple | None = None
    strides: tuple | None = None
    offset: int = 0


def write_checkpoint(path, content, monkeypatch, byteorder="little"):
    """A zip-format checkpoint as torch writes it, without torch."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    rebuild = lambda *_: None
    rebuild.__module__, rebuild.__qualname__, rebuild.__name__ = "torch._utils", *["_rebuild_tensor_v2"] * 2
    utils._rebuild_tensor_v2, torch._utils = rebuild, utils
    for name in conversion.STORAGE_DTYPES:
        setattr(torch, name, type(name, (), {"__module__": "torch"}))
    storages = []

    class Reference:
        def __init__(self, tensor):
            self.tensor = tensor

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            if not isinstance(value, Reference):
                return None
            storages.append(value.tensor.storage)
            size = len(value.tensor.storage)
            return ("storage", getattr(torch, value.tensor.kind), str(len(storages) - 1), "cpu", size)

        def reducer_override(self, value):
            if not isinstance(value, FakeTensor):
                return NotImplemented
            shape = value.storage.shape if value.shape is None else value.shape
            strides = (1,) * len(shape) if value.strides is None else value.strides
            return rebuild, (Reference(value), value.offset, shape, strides, False, collections.OrderedDict())

    with monkeypatch.context() as patch, zipfile.ZipFile(path, "w") as archive:
        patch.setitem(sys.modules, "torch", torch)
        patch.setitem(sys.modules, "torch._utils", utils)
        with archive.open("archive/data.pkl", "w") as file:
            Pickler(file, protocol=2).dump(content)
        archive.writestr("archive/byteorder", byteorder)
        for i, storage in enumerate(storages):
            archive.writestr(f"archive/data/{i}", storage.tobytes())
    return path


def test_sizes_are_read_off_the_golden_checkpoint():
    converted = load_checkpoint(CHECKPOINT)
    config = converted.config
    assert (config.transformer.width, config.transformer.layers, config.transformer.attention.head_width) == (64, 4, 16)
    assert (config.patch_size, config.texture.resolution, config.texture.channels) == (8, 16, 4)
    assert (config.upsampler.hidden, config.upsampler.out) == (16, 64)
    assert (config.decoder.hidden, config.decoder.tight, config.decoder.free) == (32, 1, 4)
    assert config.decoder.skinning_joints is None and converted.skinning_weights.shape == (300, 55)
    assert converted.skipped == 4  # frozen loss networks
    assert config.ray_origins == "twice_normalized" and config.skinning == "rotation"


def test_sizes_of_the_ablations():
    state, _ = read_state_dict(CHECKPOINT)
    state = {key: x for key, x in state.items() if not key.startswith("upsampler.") and key != "cls_token"}
    state["vertex_decoder.lbs_head.2.weight"] = np.zeros((5 * 55, 32), np.float32)
    config = infer_config(state)
    assert not config.upsampler.enabled and not config.transformer.class_token and config.decoder.skinning_joints == 55


def test_tensors_are_views_of_their_storages(tmp_path, monkeypatch):
    numbers = np.arange(12, dtype=np.float32)
    halves = (np.asarray([1.0, -2.5, 0.1], np.float32).view(np.uint32) >> 16).astype(np.uint16)
    model = {
        "turned": FakeTensor(numbers, shape=(2, 3), strides=(1, 4), offset=2),
        "scalar": FakeTensor(np.asarray([7], np.int64), "LongStorage", shape=()),
        "empty": FakeTensor(numbers[:0], shape=(0, 3), strides=(3, 1)),
        "half": FakeTensor(halves, "BFloat16Storage"),
        "loss_computer.vgg": FakeTensor(numbers),
    }
    path = write_checkpoint(tmp_path / "a.pt", {"model": collections.OrderedDict(model), "step": 3}, monkeypatch)
    state, skipped = read_state_dict(path)
    assert skipped == 1 and set(state) == set(model) - {"loss_computer.vgg"}
    assert np.array_equal(state["turned"], [[2, 6, 10], [3, 7, 11]])
    assert state["scalar"].shape == () and state["scalar"] == 7 and state["empty"].shape == (0, 3)
    assert state["half"].dtype == np.float32 and np.allclose(state["half"], [1, -2.5, 0.1], rtol=2**-7)


def test_no_code_of_a_file_runs(tmp_path, monkeypatch):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "owned"),)

    for i, content in enumerate(({"model": {"w": Evil()}}, {"model": {}, "optimizer": Evil()})):
        path = write_checkpoint(tmp_path / f"{i}.pt", content, monkeypatch)
        with pytest.raises(ValueError, match=r"refused to load (posix|nt).mkdir"):
            read_state_dict(path)
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"weights": {}}, "under 'model'"),
        ([1, 2], "under 'model'"),
        ({"model": {"w": 3}}, r"model\['w'\] is no tensor but int"),
        ({"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(5,))}}, "w: shape .* does not fit"),
        ({"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(2,), strides=(-1,), offset=3)}}, "does not fit"),
        ({"model": {"w": FakeTensor(np.zeros(4, np.float32), offset=-1)}}, "does not fit"),
        ({"model": {"w": FakeTensor(np.zeros(4, np.float32), shape=(1 << 40, 2), strides=(0, 1))}}, "does not fit"),
    ],
)
def test_damaged_checkpoints_are_clear_errors(tmp_path, monkeypatch, content, message):
    path = write_checkpoint(tmp_path / "a.pt", content, monkeypatch)
    with pytest.raises(ValueError, match=message):
        read_state_dict(path)


def test_files_that_are_no_checkpoints(tmp_path, monkeypatch):
    other = tmp_path / "a.pt"
    other.write_bytes(b"legacy")
    with pytest.raises(ValueError, match="no zip-format checkpoint"):
        read_state_dict(other)
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("archive/readme", "")
    with pytest.raises(ValueError, match=r"data\.pkl"):
        read_state_dict(other)
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02}q")
    with pytest.raises(ValueError, match=r"a\.pt"):
        read_state_dict(other)
    with pytest.raises(ValueError, match="little-endian"):
        read_state_dict(write_checkpoint(other, {"model": {}}, monkeypatch, byteorder="big"))


def test_unknown_and_missing_tensors_are_named(monkeypatch):
    for key in (
        "transformer_blocks.0.attn.bias.weight",
        "transformer_blocks.x.norm1.weight",
        "decoder.weight",
        "scale",
    ):
        with pytest.raises(ValueError, match=key):
            map_tensor(key, np.zeros(3))
    with pytest.raises(ValueError, match=r"expected 4 axes, got shape \(3,\)"):
        map_tensor("upsampler.fuse.0.weight", np.zeros(3))
    state, _ = read_state_dict(CHECKPOINT)
    with pytest.raises(ValueError, match="canonical target maps"):
        infer_config(state | {"target_pose_tokenizer.1.weight": np.zeros(3)})
    with pytest.raises(ValueError, match=r"no tensor 'neural_texture'"):
        infer_config({key: x for key, x in state.items() if key != "neural_texture"})
    del state["transformer_blocks.2.norm1.weight"]
    monkeypatch.setattr(conversion, "read_state_dict", lambda path: (state, 0))
    with pytest.raises(ValueError, match="block_2/norm1/scale' is missing"):
        load_checkpoint("checkpoint")
