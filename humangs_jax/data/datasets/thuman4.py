"""THuman4.0: videos of 3 subjects, 24 cameras of 1330 x 1150 (https://github.com/ZhengZerong/THUman4.0-Dataset).

subject0x/images/camNN/%08d.jpg    masks/camNN/%08d.jpg    calibration.json    smpl_params.npz    missing_img_files.txt
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

CALIBRATION = "calibration.json"


def find_thuman4(folder: str | Path) -> tuple[Path, ...]:
    """The subjects in a folder, sorted, or the folder itself; empty if there are none."""
    is_one = lambda path: (path / CALIBRATION).is_file() and (path / "images").is_dir()
    folder = Path(folder)
    return (folder,) if is_one(folder) else tuple(sorted(p for p in folder.glob("*/") if is_one(p)))


def open_thuman4(folder: str | Path, body: FileBody) -> Subject:
    """One subject; nothing but calibration, poses and names of files is read. Raises: CaptureError naming file and key."""
    folder = Path(folder)
    cameras = read_cameras(folder / CALIBRATION)
    folders = {c.name: Folders(folder / "images" / c.name, folder / "masks" / c.name) for c in cameras}
    parameters = read_parameters(folder / PARAMETERS, body)
    return video_subject(folder, cameras, folders, parameters, read_missing(folder / MISSING))
