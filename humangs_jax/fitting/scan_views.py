"""Images of a scan for a keypoint detector, and its keypoints as joints of the scan.

render_scan_views("scan.obj", "views")          a capture folder without a body; run a detector on views/images
joints = joints_from_views("views", keypoints)  then fit_scan("scan.obj", joints=joints, ...)
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture_checks import floats
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import load_photos, write_description
from humangs_jax.fitting.residuals.keypoints import group_by_frame
from humangs_jax.fitting.scan_reading import SCAN_LANDMARKS, read_mesh
from humangs_jax.fitting.similarity import Similarity
from humangs_jax.fitting.triangulation import triangulate_robustly
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.io.atomic import check_replaceable, replace_folder
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import Refused, read_json, reading, write_json
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

SCAN_FILE, PLACEMENT = "scan.json", "world_from_scan"
"""Beside capture.json, and its key: where the scan is in the world of the images."""
ROUNDING = 1e-3
"""How far a rotation may be off: people shorten numbers."""
HEIGHT = 1.7
"""Metres: the scan's longest side in that world (arbitrary)."""
DISTANCE, FIELD_OF_VIEW = 4.0, np.radians(36.0)
"""Distance of the cameras, metres, and their vertical field of view, radians."""
AXES = {f"{sign}{axis}": (s, i) for s, sign in ((1, "+"), (-1, "-")) for i, axis in enumerate("xyz")}


def render_scan_views(
    mesh_path: str | Path, out: str | Path, views: int = 8, size: int = 512, up: str | None = None
) -> Path:
    """Write images of a scan from all around as a capture folder without a body.

    Arguments: up: which axis of the file is up for the person, "+y", "-z", ...; None: the positive one along which the scan is
    longest. Detectors expect standing people: look at the images.
    Raises: ValueError for a mesh that cannot be used (see `read_mesh`), an unknown axis, or a folder that is not empty or
    cannot be replaced (see `check_replaceable`).
    """
    out = Path(out)
    check_replaceable(out)
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"{out}: the folder is not empty: expected a new one")
    mesh = read_mesh(mesh_path, colors=True)
    vertices = np.asarray(mesh.vertices, np.float64)
    align = _into_world(vertices[np.unique(mesh.faces)], up)
    angles = jnp.arange(views) * (2 * jnp.pi / views)
    K = intrinsics_from_fov(FIELD_OF_VIEW, size, size)
    cameras = orbit(jnp.zeros(3), DISTANCE, angles, 0.1, K, size, size)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    drawn = _draw(align(vertices), np.asarray(mesh.faces), colors, cameras, views)
    replace_folder(out, lambda folder: _write(folder, drawn, cameras, align), mark=SCAN_FILE)
    return out


def joints_from_views(folder: str | Path, keypoints: Keypoints) -> dict[str, Float[np.ndarray, "3"]]:
    """Landmarks by name, in the scan's coordinates, on which at least two views agree.

    Arguments: keypoints: of the images that `render_scan_views` wrote to the folder.
    Raises: ValueError if the folder is not one of these, or fewer than three landmarks are found.
    """
    folder = Path(folder)
    align = read_placement(folder / SCAN_FILE)
    observations, _ = group_by_frame(load_photos(folder), keypoints)
    points, counts, _ = triangulate_robustly(jax.tree.map(lambda leaf: leaf[0], observations))
    points = align.inverse()(np.asarray(points, np.float64))
    names = keypoints.set.names
    found = {name: points[i] for i, name in enumerate(names) if counts[i] >= 2 and name in SCAN_LANDMARKS}
    if len(found) < 3:
        raise ValueError(f"{folder}: views agree on {len(found)} landmarks: expected at least three")
    return found


def read_placement(file):
    """The similarity from a scan to the world of its images. Raises: FileError unless it is one."""
    with reading(file, "file of render_scan_views"):
        content = read_json(file)
        if not isinstance(content, dict) or PLACEMENT not in content:
            raise Refused(f"{PLACEMENT}: missing: expected a file that render_scan_views wrote")
        matrix = floats(content[PLACEMENT], file, PLACEMENT, (4, 4))
        scale = float(np.cbrt(max(np.linalg.det(matrix[:3, :3]), 0.0)))
        rigid = scale > 0 and np.abs(matrix[:3, :3] @ matrix[:3, :3].T / scale**2 - np.eye(3)).max() < ROUNDING
        if not rigid or (matrix[3] != (0, 0, 0, 1)).any():
            raise Refused(f"{PLACEMENT}: expected a rotation times a scale above 0, a translation, and 0 0 0 1")
        return Similarity(scale, matrix[:3, :3] / scale, matrix[:3, 3])


def _into_world(vertices, up):
    """The similarity that stands a scan upright around the origin."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if up is not None and up not in AXES:
        raise ArgumentError("up", f"{up}: expected one of {', '.join(AXES)}")
    sign, axis = AXES[up] if up else (1, int((high - low).argmax()))
    above = sign * np.eye(3)[axis]
    forward = np.eye(3)[2 if axis == 1 else (0 if axis == 2 else 1)]
    rotation = np.stack([np.cross(above, forward), above, forward])
    scale = HEIGHT / float((high - low).max())
    return Similarity(scale, rotation, -scale * rotation @ (low + high) / 2)


def _draw(vertices, faces, colors, cameras: Camera, views):
    """Images (h, w, 3) on white, shaded by a light at the camera, and masks (h, w)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    number = lambda x: jnp.asarray(x, jnp.float32)
    for view in range(views):
        camera = cameras[view]
        fragments = rasterize_mesh(number(vertices), jnp.asarray(faces, jnp.int32), camera)
        painted = np.asarray(
            interpolate_attributes(fragments, jnp.asarray(faces, jnp.int32), number(colors), jnp.ones(3))
        )
        face = np.asarray(fragments.face_ids)
        facing = np.abs(normals @ np.asarray(camera.cam_from_world)[2, :3])
        shade = np.where(face >= 0, 0.45 + 0.55 * facing[np.maximum(face, 0)], 1.0)
        yield painted * shade[..., None], (face >= 0).astype(np.float32)


def _write(folder, drawn, cameras, align):
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    listed = []
    for view, (image, mask) in enumerate(drawn):
        files = {kind: f"{kind}s/{view:03d}.png" for kind in ("image", "mask")}
        write_png(folder / files["image"], image)
        write_png(folder / files["mask"], mask)
        matrices = {
            key: np.asarray(getattr(cameras, key)[view], np.float64).tolist() for key in ("K", "cam_from_world")
        }
        listed.append({**files, "frame": 0, **matrices})
    write_description(folder, listed, "white")
    write_json(folder / SCAN_FILE, {"world_from_scan": align.matrix().tolist()}, indent=None)
