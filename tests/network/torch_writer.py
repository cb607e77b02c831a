"""Checkpoints as `torch.save` writes them, without torch."""

import collections
import dataclasses
import io
import pickle
import struct
import sys
import types
import zipfile
from unittest import mock

import numpy as np

from humangs_jax.io.tensors import MAGIC_NUMBER, STORAGE_DTYPES, STREAM_VERSION

KINDS = {dtype: kind for kind, dtype in STORAGE_DTYPES.items() if kind != "BFloat16Storage"}


@dataclasses.dataclass
class FakeTensor:
    """What `torch.save` writes for a tensor: a storage by reference, and a view of it (contiguous
    if not said).
    """

    storage: np.ndarray
    kind: str = "FloatStorage"
    shape: tuple | None = None
    strides: tuple | None = None
    offset: int = 0
    part: tuple | None = None
    """(name, start, count) of the part of the storage that the tensor's own storage is; older
    format only.
    """


def tensors(state):
    """A state dict of arrays as tensors."""
    own = {key: np.ascontiguousarray(x).reshape(np.shape(x)) for key, x in state.items()}
    return collections.OrderedDict((key, FakeTensor(x, KINDS[x.dtype])) for key, x in own.items())


def contiguous(shape):
    return tuple(int(np.prod(shape[i + 1 :])) for i in range(len(shape)))


def pickled(content, extra=lambda tensor: ()):
    """The pickle of `content` and the storages of the tensors in it, named by their number."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    rebuild = lambda *_: None
    rebuild.__module__, rebuild.__qualname__, rebuild.__name__ = (
        "torch._utils",
        *["_rebuild_tensor_v2"] * 2,
    )
    utils._rebuild_tensor_v2, torch._utils = rebuild, utils
    for name in STORAGE_DTYPES:
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
            size = value.tensor.storage.size
            kind = getattr(torch, value.tensor.kind)
            return ("storage", kind, str(len(storages) - 1), "cpu", size, *extra(value.tensor))

        def reducer_override(self, value):
            if not isinstance(value, FakeTensor):
                return NotImplemented
            shape = value.storage.shape if value.shape is None else value.shape
            strides = contiguous(shape) if value.strides is None else value.strides
            return rebuild, (
                Reference(value),
                value.offset,
                shape,
                strides,
                False,
                collections.OrderedDict(),
            )

    file = io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        Pickler(file, protocol=2).dump(content)
    return file.getvalue(), storages


def write_checkpoint(path, content, byteorder="little", compression=zipfile.ZIP_STORED):
    """A zip-format checkpoint of whatever `content` is; tensors in it as `FakeTensor`."""
    data, storages = pickled(content)
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/byteorder", byteorder)
        for i, storage in enumerate(storages):
            archive.writestr(f"archive/data/{i}", storage.tobytes())
    return path


def write_stream(
    path, content, magic=MAGIC_NUMBER, version=STREAM_VERSION, little=True, count=lambda size: size
):
    """The same in the older format."""
    data, storages = pickled(content, lambda tensor: (tensor.part,))
    machine = {
        "protocol_version": version,
        "little_endian": little,
        "type_sizes": {"short": 2, "int": 4, "long": 4},
    }
    with open(path, "wb") as file:
        file.write(b"".join(pickle.dumps(x, 2) for x in (magic, version, machine)) + data)
        file.write(pickle.dumps([str(i) for i in range(len(storages))], 2))
        for storage in storages:
            file.write(struct.pack("<q", count(storage.size)) + storage.tobytes())
    return path


def write_python2_stream(path, state, device="cuda:0"):
    """A state dict as Python 2 wrote it in the older format, instruction by instruction: the form
    of lpips' heads.

    Strings are bytes, an OrderedDict is a call with a list of [key, value] lists, and its
    attributes follow.
    """
    text = lambda value: b"U" + bytes([len(value)]) + value.encode()
    count = lambda value: b"J" + struct.pack("<i", value)
    counts = lambda values: b"(" + b"".join(map(count, values)) + b"t"
    metadata = (
        text("_metadata")
        + b"ccollections\nOrderedDict\n(](]("
        + text("")
        + b"}"
        + text("version")
        + b"K\x01seetR"
    )

    def tensor(i, x):
        kind = f"ctorch\n{KINDS[x.dtype]}\n".encode()
        reference = (
            b"("
            + text("storage")
            + kind
            + text(str(i))
            + text(device)
            + b"\x8a\x03"
            + x.size.to_bytes(3, "little")
        )
        view = count(0) + counts(x.shape) + counts(contiguous(x.shape))
        return b"ctorch._utils\n_rebuild_tensor_v2\n(" + reference + b"NtQ" + view + b"\x89NtR"

    pairs = (b"](" + text(key) + tensor(i, x) + b"e" for i, (key, x) in enumerate(state.items()))
    data = (
        b"\x80\x02ccollections\nOrderedDict\n](" + b"".join(pairs) + b"e\x85R}" + metadata + b"sb."
    )
    machine = (
        b"\x80\x02}(" + text("protocol_version") + b"M\xe9\x03" + text("little_endian") + b"\x88u."
    )
    with open(path, "wb") as file:
        file.write(pickle.dumps(MAGIC_NUMBER, 2) + pickle.dumps(STREAM_VERSION, 2) + machine + data)
        file.write(b"\x80\x02](" + b"".join(text(str(i)) for i in range(len(state))) + b"e.")
        for x in state.values():
            file.write(struct.pack("<q", x.size) + x.tobytes())
    return path
