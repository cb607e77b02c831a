"""Which format a file or folder of cameras has, by what is in it, and its reader."""

from collections.abc import Callable, Mapping
from pathlib import Path

from humangs_jax.data.calibration.calibration import Calibration
from humangs_jax.data.calibration.colmap import read_colmap
from humangs_jax.data.calibration.file_storage import parse_file_storage
from humangs_jax.data.calibration.opencv import EASYMOCAP_FILES, has_camera_maps, read_camera_maps, read_easymocap
from humangs_jax.data.calibration.transforms import read_transforms
from humangs_jax.data.calibration.values import parse_json, read_text
from humangs_jax.data.capture_checks import CaptureError

FILES = ("transforms.json", "calibration_full.json", "calibration.json")
"""Names that a folder is searched for."""
FORMATS = (
    "a COLMAP text model (cameras.txt, images.txt), transforms.json, calibration_full.json, OpenCV's YAML or JSON with K, R "
    "and T of each camera, or EasyMocap's intri.yml and extri.yml"
)


def read_calibration(source: Path, photo_size: Callable[[str], tuple[int, int]]) -> Calibration:
    """The calibration in a file or folder of any supported format.

    photo_size: width and height of the photo of a name, for formats that do not say them.

    Raises: CaptureError, one line that names the file and what was expected.
    """
    if not source.exists():
        raise CaptureError(source, "", "no such file or folder")
    if source.name in EASYMOCAP_FILES:
        source = source.parent
    if source.is_dir():
        return _read_folder(source, photo_size)
    return _read_file(source, photo_size)


def _read_folder(folder, photo_size):
    for model in (folder, folder / "sparse" / "0", folder / "sparse"):
        if (model / "images.txt").is_file() or (model / "cameras.txt").is_file():
            return read_colmap(model)
        if (model / "images.bin").is_file():
            remedy = f"colmap model_converter --input_path {model} --output_path DIR --output_type TXT"
            raise CaptureError(model, "", f"a binary COLMAP model: expected a text model; {remedy}")
    if any((folder / name).is_file() for name in EASYMOCAP_FILES):
        return read_easymocap(folder)
    for name in FILES:
        if (folder / name).is_file():
            return _read_file(folder / name, photo_size)
    raise CaptureError(folder, "", f"no cameras found: expected {FORMATS}")


def _read_file(file, photo_size):
    text = read_text(file)
    if not text.strip():
        raise CaptureError(file, "", f"empty: expected {FORMATS}")
    if text.lstrip().startswith("{"):
        values = parse_json(text, file)
        if "frames" in values:
            return read_transforms(values, file, photo_size)
    if text.lstrip().startswith(("{", "%YAML", "---")) or file.suffix in (".yml", ".yaml"):
        values: Mapping = parse_file_storage(text, file)
        if has_camera_maps(values):
            return read_camera_maps(values, file)
    raise CaptureError(file, "", f"not a known format: expected {FORMATS}")
