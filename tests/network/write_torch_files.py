"""Writes data/torch_zip.pth and data/torch_stream.pt. Needs torch; tests do not.

The first is a state dict as `torch.save` writes it, with its numbers as npz. The second is one from
before torch 1.6.

python tests/network/write_torch_files.py
"""

from pathlib import Path

import numpy as np
import torch

DATA = Path(__file__).parent / "data"

if __name__ == "__main__":
    torch.manual_seed(0)
    numbers = torch.arange(12, dtype=torch.float32)
    state = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4)).state_dict()
    state |= {
        "turned": numbers[2:8].view(2, 3).t(),
        "shared": numbers[4:],
        "half": torch.tensor([1, -2.5, 0.1], dtype=torch.float16),
        "brain": torch.tensor([1, -2.5, 0.1], dtype=torch.bfloat16),
        "bool": torch.tensor([True, False]),
        "byte": torch.arange(3, dtype=torch.uint8),
        "empty": torch.zeros(0, 3),
        "parameter": torch.nn.Parameter(torch.ones(2)),
    }
    torch.save(state, DATA / "torch_zip.pth")
    content = {"model": state, "optimizer": {"moment": torch.ones(3)}, "step": 3}
    torch.save(content, DATA / "torch_stream.pt", _use_new_zipfile_serialization=False)
    plain = lambda x: (x.float() if x.dtype == torch.bfloat16 else x).detach().numpy()
    np.savez_compressed(DATA / "torch_numbers.npz", **{key: plain(x) for key, x in state.items()})
