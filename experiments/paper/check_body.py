"""Compare a body model file with numbers that the public `smplx` package made of it.

    python experiments/paper/check_body.py MODEL.npz ARRAYS.npz [--float32]

MODEL is an SMPL-X model file. ARRAYS holds, for some poses (leading axis), `betas, expression, global_orient,
body_pose, jaw_pose, leye_pose, reye_pose, transl, left/right_hand_pose_45, left/right_hand_pca_12`, the
`vertex_indices` that were kept, and for three hand conventions `axis_flat` (45 numbers, flat_hand_mean True),
`axis_mean` (45 numbers, False) and `pca12_mean` (12 components, False) the `*_vertices`, `*_joints` (metres) and
`*_full_pose` (165 radians). Prints the largest differences; takes seconds. Exit status 1 if one exceeds 1e-5.
"""

import argparse
import sys
from pathlib import Path

TOLERANCE = 1e-5
CONVENTIONS = {  # name: (suffix of the hand arrays, use_pca, flat_hand_mean)
    "axis_flat": ("pose_45", False, True),
    "axis_mean": ("pose_45", False, False),
    "pca12_mean": ("pca_12", True, False),
}
PARTS = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose")


def compare(model: Path, arrays: Path) -> list[tuple[str, int, float, float, float]]:
    """Rows (convention, pose index, vertex, joint and pose difference)."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.model import pose_body, shape_body
    from humangs_jax.body.smplx import assemble_pose, load_hands, load_smplx

    expected = np.load(arrays, allow_pickle=False)
    counts = {"shape_count": expected["betas"].shape[1], "expression_count": expected["expression"].shape[1]}
    body, hands = load_smplx(model, **counts), load_hands(model)

    @jax.jit
    def run(betas, pose):
        posed = pose_body(body, shape_body(body, betas), pose)
        return posed.vertices[expected["vertex_indices"]], posed.joints

    rows = []
    number = lambda key, i: jnp.asarray(expected[key][i])
    for convention, (suffix, use_pca, flat_hand_mean) in CONVENTIONS.items():
        for i in range(len(expected["betas"])):
            pose = assemble_pose(
                use_pca=use_pca,
                flat_hand_mean=flat_hand_mean,
                hands=hands,
                **{part: number(part, i) for part in PARTS},
                **{f"{side}_hand_pose": number(f"{side}_hand_{suffix}", i) for side in ("left", "right")},
                transl=number("transl", i),
            )
            found = run(jnp.concatenate([number("betas", i), number("expression", i)]), pose)
            wanted = [expected[f"{convention}_{name}"][i] for name in ("vertices", "joints", "full_pose")]
            vertices, joints, rotations = (
                float(np.abs(np.asarray(a, np.float64) - b).max())
                for a, b in zip((*found, pose.rotations.reshape(-1)), wanted, strict=True)
            )
            rows.append((convention, i, vertices, joints, rotations))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="SMPL-X model file")
    parser.add_argument("arrays", type=Path, help="npz of inputs and expected outputs")
    parser.add_argument("--float32", action="store_true", help="compute in float32, as users do, instead of float64")
    arguments = parser.parse_args()

    import jax

    jax.config.update("jax_enable_x64", not arguments.float32)
    rows = compare(arguments.model, arguments.arrays)
    print(f"{'convention':12s} {'pose':>4s} {'vertices m':>11s} {'joints m':>11s} {'pose rad':>11s}")
    for convention, i, *errors in rows:
        print(f"{convention:12s} {i:4d} " + " ".join(f"{e:11.2e}" for e in errors))
    worst = max(max(errors) for _, _, *errors in rows)
    print(f"largest difference {worst:.2e}, allowed {TOLERANCE:.0e}: {'ok' if worst <= TOLERANCE else 'FAILED'}")
    sys.exit(worst > TOLERANCE)


if __name__ == "__main__":
    main()
