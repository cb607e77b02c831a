import numpy as np
import pytest
from safetensors.numpy import save_file
from torch_writer import tensors, write_checkpoint

from humangs_jax.io.tensors import is_safetensors, read_tensors

STATE = {
    "a.weight": np.arange(6, dtype=np.float32).reshape(2, 3),
    "b": np.asarray([1, 2], np.int64),
}
WRITERS = {
    "safetensors": lambda path: save_file(STATE, path),
    "zip": lambda path: write_checkpoint(path, tensors(STATE)),
}


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("name", ["a.pt", "a.pth", "a.safetensors", "a"])
def test_the_name_of_a_file_does_not_matter(kind, name, tmp_path):
    WRITERS[kind](tmp_path / name)
    assert is_safetensors(tmp_path / name) == (kind == "safetensors")
    found, skipped = read_tensors(tmp_path / name)
    assert skipped == 0 and found.keys() == STATE.keys()
    assert all(
        np.array_equal(found[key], x) and found[key].dtype == x.dtype for key, x in STATE.items()
    )
    some, skipped = read_tensors(tmp_path / name, lambda key: key == "b")
    assert list(some) == ["b"] and skipped == 1


def test_headers_of_any_length(tmp_path):
    """A header's length may equal another format's first bytes: 640 is 80 02, a pickle's start."""
    for length in range(600, 680, 8):
        save_file(STATE, tmp_path / "a", {"padding": "x" * (length - 200)})
        assert (
            is_safetensors(tmp_path / "a")
            and read_tensors(tmp_path / "a")[0].keys() == STATE.keys()
        )


@pytest.mark.parametrize("kind", WRITERS)
def test_truncated_files_are_named(kind, tmp_path):
    WRITERS[kind](tmp_path / "a.bin")
    whole = (tmp_path / "a.bin").read_bytes()
    for length in (0, 3, 9, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.bin").write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.bin"):
            read_tensors(tmp_path / "a.bin")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_tensors(tmp_path / "nowhere")
