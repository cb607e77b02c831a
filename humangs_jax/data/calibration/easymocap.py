"""EasyMocap's intri.yml and extri.yml, in one folder.

https://chingswy.github.io/easymocap-public-doc/database/1_camera.html
"""

from humangs_jax.data.calibration.calibration import Calibration, Source
from humangs_jax.data.calibration.opencv import flat_cameras, parse_file_storage
from humangs_jax.data.capture_checks import checked_text
from humangs_jax.data.formats import CameraFormat


def read(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of both files. Raises: CaptureError naming file and key."""
    files = source.path / "intri.yml", source.path / "extri.yml"
    inner, outer = (parse_file_storage(checked_text(file), file) for file in files)
    cameras = flat_cameras(inner, outer, files, outer.get("names", inner.get("names")))
    return source.calibration(format, cameras, file=files[1])
