"""The body model and the mesh rasterizer against numbers that others made."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from humangs_jax.body.model import pose_body, shape_body
from humangs_jax.body.smplx import assemble_pose, load_hands, load_smplx
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.position_map import gouraud_position_map, plain_position_map
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

TOLERANCE = 1e-5
CONVENTIONS = {  # name: (suffix of the hand arrays, use_pca, flat_hand_mean)
    "axis_flat": ("pose_45", False, True),
    "axis_mean": ("pose_45", False, False),
    "pca12_mean": ("pca_12", True, False),
}
PARTS = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose")


def compare_body(model: Path, arrays: Path) -> list[tuple[str, int, float, float, float]]:
    """Rows (convention, pose index, vertex, joint and pose difference)."""
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


@entry
def check_body(run: Run, model: Path, arrays: Path, float32: bool = False) -> int:
    """A body model file against numbers that the public `smplx` package made of it; exit status 1 beyond 1e-5.

    ARRAYS holds, for some poses (leading axis), `betas, expression, global_orient, body_pose, jaw_pose, leye_pose, reye_pose,
    transl, left/right_hand_pose_45, left/right_hand_pca_12`, the `vertex_indices` that were kept, and for three hand conventions
    `axis_flat` (45 numbers, flat_hand_mean True), `axis_mean` (45 numbers, False) and `pca12_mean` (12 components, False) the
    `*_vertices`, `*_joints` (metres) and `*_full_pose` (165 radians).

    Options:
    model: SMPL-X model file
    arrays: npz of inputs and expected outputs
    float32: compute in float32, as users do, instead of float64
    """
    jax.config.update("jax_enable_x64", not float32)
    rows = compare_body(model, arrays)
    print(f"{'convention':12s} {'pose':>4s} {'vertices m':>11s} {'joints m':>11s} {'pose rad':>11s}")
    for convention, i, *errors in rows:
        print(f"{convention:12s} {i:4d} " + " ".join(f"{e:11.2e}" for e in errors))
    worst = max(max(errors) for _, _, *errors in rows)
    print(f"largest difference {worst:.2e}, allowed {TOLERANCE:.0e}: {'ok' if worst <= TOLERANCE else 'FAILED'}")
    return int(worst > TOLERANCE)


OTHER_FACE_SHARE = 2e-3
RELATIVE_DEPTH = 1e-4
POSITION = 2e-3
MAPS = ("other face", "depth", "barycentrics", "plain", "gouraud")


def compare_mesh(arrays: Path) -> list[tuple[float, ...]]:
    """For every view the numbers of MAPS."""
    with np.load(arrays, allow_pickle=False) as file:
        expected = dict(file)
    posed, canonical = jnp.asarray(expected["posed_vertices"]), jnp.asarray(expected["canonical_vertices"])
    faces = jnp.asarray(expected["faces"].astype(np.int32))
    height, width = expected["face_ids"].shape[1:]
    rows = []
    for view, (fx, fy, cx, cy) in enumerate(expected["fxfycxcy"]):
        cam_from_world = np.linalg.inv(expected["c2w"][view].astype(np.float64))
        camera = Camera.from_opencv([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], cam_from_world, width, height)
        fragments = rasterize_mesh(posed, faces, camera)
        found = {
            "depth": fragments.depth,
            "barycentrics": fragments.barycentrics,
            "position_map_plain": plain_position_map(posed, canonical, faces, camera)[0],
            "position_map_gouraud": gouraud_position_map(posed, canonical, faces, camera)[0],
        }
        face_ids, covered = np.asarray(fragments.face_ids), expected["face_ids"][view] >= 0
        same = face_ids == expected["face_ids"][view]
        other = (~same).sum() / max(covered.sum(), 1)

        def difference(name, where, view=view, found=found):
            wanted = expected[name][view].astype(np.float64)
            return np.abs(np.asarray(found[name], np.float64) - wanted)[where]

        relative = difference("depth", same) / np.abs(expected["depth"][view][same])
        largest = [
            float(error.max(initial=0))
            for error in (
                relative,
                difference("barycentrics", same & covered),
                difference("position_map_plain", same),
                difference("position_map_gouraud", same),
            )
        ]
        rows.append((float(other), *largest))
    return rows


@entry
def check_mesh(run: Run, arrays: Path) -> int:
    """The mesh rasterizer and both position maps against arrays of the release; exit status 1 beyond the bounds.

    ARRAYS holds `canonical_vertices` and `posed_vertices` (n,3), `faces` (f,3), cameras `c2w` (v,4,4, OpenCV) and `fxfycxcy`
    (v,4), all in normalised units, and what the release's rasterizer saw: `face_ids`, `depth` (v,h,w; -1 outside),
    `barycentrics` (v,h,w,3), `position_map_plain` and `position_map_gouraud` (v,h,w,3; 1 outside). Bounds: 0.2 % of covered
    pixels that show another face, at all others a depth off by 1e-4 of itself, a position by 2e-3. Barycentric coordinates
    (float16) are shown only: on faces smaller than a pixel they magnify the rounding of pixel positions. Expected on mesh_a: no
    other face, depth 2e-6, plain map 2.5e-4 (stored as float16), Gouraud map 3e-5.

    Options:
    arrays: npz of a mesh, cameras and expected maps
    """
    rows = compare_mesh(arrays)
    print("view " + " ".join(f"{name:>12s}" for name in MAPS))
    for view, row in enumerate(rows):
        print(f"{view:4d} {row[0]:12.3%} " + " ".join(f"{error:12.2e}" for error in row[1:]))
    limits = (OTHER_FACE_SHARE, RELATIVE_DEPTH, float("inf"), POSITION, POSITION)
    agrees = all(error <= limit for row in rows for error, limit in zip(row, limits, strict=True))  # False for NaN
    print("ok" if agrees else "FAILED")
    return int(not agrees)
