"""The published network's numbers at every stage, as files of the tests.

`data/golden_a.pt` is a checkpoint of the published network with random weights at small sizes, in
the released format. `data/golden_a_subject_0.npz` has the reference's numbers for one subject; some
stages are thinned out (see `THINNED`). `golden_b` has one view and eight layers, and pools visible
vertices only (`POOLS`). Both come from the project's golden data, which the authors' release
computed in float64 and stored as float32. `python tests/network/network_golden.py GOLDEN_DIRECTORY`
makes the npz files again.
"""

import sys
from pathlib import Path

import numpy as np

from experiments.paper import check_parity
from humangs_jax.network.conversion import read_state_dict

DATA = Path(__file__).parent / "data"
CHECKPOINT = DATA / "golden_a.pt"
SUBJECT = DATA / "golden_a_subject_0.npz"
POOLS = {"golden_a": "all", "golden_b": "visible"}
"""Views over which a vertex's features are pooled, which a checkpoint does not record."""

every = lambda step, axes=1, before=0: (slice(None),) * before + (slice(None, None, step),) * axes
THINNED = {
    "out_ray_d": every(4, 2, 2),
    "out_pose_feature": every(4, 2, 2),
    "mid_feature_map_stride4": every(2, 1, 1),
    "mid_decoder_input": every(4),
    "mid_raw_geometry": every(4),
    "mid_raw_appearance": every(4),
    "asset_lbs_weights": every(20),
    **{
        f"asset_{name}": every(7)
        for name in ("means3D", "rotations", "scales", "colors", "opacity")
    },
    "posed_means3D": every(7),
    "posed_rotations": every(7),
}
"""Indices of each stage that the files of the tests keep."""


def carried(name):
    """Returns the paths (checkpoint, stages of one subject) of "golden_a" or "golden_b"."""
    return DATA / f"{name}.pt", DATA / f"{name}_subject_0.npz"


def load_subject(name="golden_a"):
    """Returns the subject's arrays in the golden files' layout (b = 1), stages thinned out."""
    checkpoint, subject = carried(name)
    arrays = dict(np.load(subject))
    arrays = {name: x if name in check_parity.PER_VIEW else x[None] for name, x in arrays.items()}
    return arrays | {"in_lbs_weights": read_state_dict(checkpoint)[0]["tpose_lbs_weights"]}


def thinned_errors(found, carried):
    """Returns relative errors of the stages that the files of the tests keep."""
    expected = {name: x for name, x in carried.items() if not name.startswith("in_")}
    return check_parity.relative_errors(
        {name: found[name][THINNED.get(name, ())] for name in expected}, expected
    )


if __name__ == "__main__":
    for golden in POOLS:
        arrays = dict(np.load(Path(sys.argv[1]) / f"{golden}.npz"))
        views = arrays["in_image"].shape[1]
        del arrays["in_lbs_weights"]  # the checkpoint carries them
        first = {
            name: x[:views] if name in check_parity.PER_VIEW else x[0] for name, x in arrays.items()
        }
        np.savez_compressed(
            carried(golden)[1], **{name: x[THINNED.get(name, ())] for name, x in first.items()}
        )
