"""Compare the mesh rasterizer and both position maps with arrays that another rasterizer made.

    python experiments/paper/check_mesh.py ARRAYS.npz

ARRAYS holds `canonical_vertices` and `posed_vertices` (n,3), `faces` (f,3), cameras `c2w` (v,4,4, OpenCV) and
`fxfycxcy` (v,4), all in normalised units, and what the release's rasterizer saw: `face_ids`, `depth` (v,h,w; -1 outside),
`barycentrics` (v,h,w,3), `position_map_plain` and `position_map_gouraud` (v,h,w,3; 1 outside). Takes seconds. Prints, for
every view, the share of covered pixels that show another face, and the largest differences at all other pixels.

Exit status 1 if that share exceeds 0.2 %, if a depth differs by more than 1e-4 of itself, or a position by more than 2e-3.
Expected on mesh_a: no other face, depth 2e-6, plain map 2.5e-4 (stored as float16), Gouraud map 3e-5. Barycentric
coordinates (float16 too) are shown only: on faces smaller than a pixel they magnify the rounding of pixel positions.
"""

import argparse
import sys
from pathlib import Path

OTHER_FACE_SHARE = 2e-3
RELATIVE_DEPTH = 1e-4
POSITION = 2e-3
COLUMNS = ("other face", "depth", "barycentrics", "plain", "gouraud")


def compare(arrays: Path) -> list[tuple[float, ...]]:
    """For every view the numbers of COLUMNS."""
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.geometry.camera import Camera
    from humangs_jax.rendering.mesh.position_map import gouraud_position_map, plain_position_map
    from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arrays", type=Path, help="npz of a mesh, cameras and expected maps")
    rows = compare(parser.parse_args().arrays)
    print("view " + " ".join(f"{name:>12s}" for name in COLUMNS))
    for view, row in enumerate(rows):
        print(f"{view:4d} {row[0]:12.3%} " + " ".join(f"{error:12.2e}" for error in row[1:]))
    limits = (OTHER_FACE_SHARE, RELATIVE_DEPTH, float("inf"), POSITION, POSITION)
    agrees = all(error <= limit for row in rows for error, limit in zip(row, limits, strict=True))  # False for NaN
    limits = f"at most {OTHER_FACE_SHARE:.1%} other faces, depth {RELATIVE_DEPTH:.0e}, positions {POSITION:.0e}"
    print(f"{limits}: {'ok' if agrees else 'FAILED'}")
    sys.exit(not agrees)


if __name__ == "__main__":
    main()
