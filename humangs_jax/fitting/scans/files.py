"""The folder of a fit to a scan."""

import json
from pathlib import Path

import numpy as np

from humangs_jax.data.capture import DEFAULT_BODY
from humangs_jax.fitting.scans.result import ScanFit, body_in_scan
from humangs_jax.io.atomic import replace_folder

BODY_FILE, REPORT_FILE, MESH_FILE = "body.npz", "scan_fit.json", "body_in_scan.ply"
"""Of a result: the body in our world, as captures have it; how it lies in the scan; its mesh in the scan's coordinates."""


def save_scan_fit(folder: str | Path, fit: ScanFit, body_file: str = DEFAULT_BODY, *, overwrite: bool = False) -> None:
    """Write body.npz (as in captures), scan_fit.json and body_in_scan.ply; all or nothing.

    Arguments: body_file: what body.npz calls the model. Raises: see `check_folder`.
    """
    check_folder(Path(folder), overwrite)
    replace_folder(folder, lambda temporary: _write(temporary, fit, body_file))


def check_folder(folder: Path, overwrite: bool) -> None:
    """Raises: ValueError if it is a file, not empty and not to be overwritten, or holds something else than a fit to a scan."""
    if folder.is_file():
        raise ValueError(f"{folder}: is a file: expected a folder")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not overwrite:
        raise ValueError(f"{folder}: the folder is not empty: choose another one or ask to overwrite it")
    if not (folder / REPORT_FILE).is_file():
        raise ValueError(f"{folder}: holds no {REPORT_FILE}: refusing to overwrite what is no fit to a scan")


def _write(folder: Path, fit: ScanFit, body_file: str) -> None:
    import trimesh

    folder.mkdir()
    pose = fit.pose
    np.savez(
        folder / BODY_FILE,
        body=body_file,
        betas=fit.betas,
        rotations=np.asarray(pose.rotations)[None],
        translations=np.asarray(pose.translation)[None],
    )
    trimesh.Trimesh(body_in_scan(fit), np.asarray(fit.body.faces), process=False).export(folder / MESH_FILE)
    align = fit.world_from_scan
    report = {
        "world_from_scan": align.matrix().tolist(),
        "scale": align.scale,
        "rotation": align.rotation.tolist(),
        "translation": align.translation.tolist(),
        "up": fit.up,
        "start": fit.start,
        "converged": fit.converged,
        "scan_outside_of_skin_mm": dict(zip(("5%", "50%", "95%"), fit.quantiles_mm, strict=True)),
        "share_of_scan_near_the_body": fit.covered,
    }
    (folder / REPORT_FILE).write_text(json.dumps(report, indent=2) + "\n")
