"""AvatarReX: videos of 4 subjects, 16 cameras of 1500 x 2048 (https://github.com/ZhengZerong/AvatarReX).

avatarrex_*/SERIAL/%08d.jpg    SERIAL/mask/pha/%08d.jpg    calibration_full.json    smpl_params.npz
missing_img_files.txt (not always)
"""

from pathlib import Path

from humangs_jax.data.datasets.bodies import FileBody
from humangs_jax.data.datasets.multiview import (
    MISSING,
    PARAMETERS,
    Folders,
    read_cameras,
    read_missing,
    read_parameters,
    video_subject,
)
from humangs_jax.data.datasets.subject import Subject

CALIBRATION = "calibration_full.json"


def find_avatarrex(folder: str | Path) -> tuple[Path, ...]:
    """The subjects in a folder, sorted, or the folder itself; empty if there are none."""
    folder = Path(folder)
    if (folder / CALIBRATION).is_file():
        return (folder,)
    return tuple(sorted(path for path in folder.glob("*/") if (path / CALIBRATION).is_file()))


def open_avatarrex(folder: str | Path, body: FileBody) -> Subject:
    """One subject; nothing but calibration, poses and names of files is read. Raises: CaptureError naming file and key."""
    folder = Path(folder)
    cameras = read_cameras(folder / CALIBRATION)
    folders = {c.name: Folders(folder / c.name, folder / c.name / "mask" / "pha") for c in cameras}
    parameters = read_parameters(folder / PARAMETERS, body)
    return video_subject(folder, cameras, folders, parameters, read_missing(folder / MISSING))
