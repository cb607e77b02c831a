"""TOML of Caliscope, Anipose and Pose2Sim: a table of each camera: matrix, distortions, rotation (vector), translation, size."""

import functools
import tomllib
from collections.abc import Mapping
from typing import Any

from humangs_jax.data.calibration.calibration import Calibration, Source
from humangs_jax.data.calibration.opencv import one_camera
from humangs_jax.data.capture_checks import CaptureError, expect
from humangs_jax.data.formats import CameraFormat
from humangs_jax.io.reading import Refused, check_limit, check_nesting

KEYS = {"matrix": "K", "rotation": "R", "translation": "T", "distortions": "dist", "size": "imgSize", "fisheye": "fisheye"}
"""Names in the tables, and those of OpenCV's files."""


def recognizes(source: Source) -> bool:
    """Whether a file is called so and has tables of cameras."""
    return source.path.suffix.lower() == ".toml" and bool(_tables(source))


def read(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of a file, but for those to be ignored or never placed. Raises: CaptureError naming the key."""
    cameras, file = [], source.path
    for key, table in _tables(source).items():
        if table.get("ignore") is True:
            continue
        values = {ours: table[theirs] for theirs, ours in KEYS.items() if theirs in table}
        theirs = {ours: name for name, ours in KEYS.items()}
        field = lambda name, key=key, theirs=theirs: f"{key}.{theirs.get(name, name)}"
        name = str(table.get("name", key.rsplit(".", 1)[-1]))
        cameras.append(one_camera(name, values, values, (file, file), field))
    if not cameras:
        raise CaptureError(file, "", "every camera is to be ignored")
    return source.calibration(format, cameras)


@functools.lru_cache(maxsize=1)
def _tables(source: Source) -> dict[str, Mapping[str, Any]]:
    """The tables that have a matrix, or nearly."""
    check_limit("slow_text_bytes", len(source.text), "characters of TOML")
    try:
        content = tomllib.loads(source.text)
    except tomllib.TOMLDecodeError as error:
        raise Refused(f"not valid TOML: {error}") from error
    check_nesting(content)
    found = {}
    for key, value in content.items():
        if isinstance(value, dict) and key == "cameras":
            found |= {f"cameras.{name}": expect(each, dict, source.path, f"cameras.{name}") for name, each in value.items()}
        elif isinstance(value, dict) and ("matrix" in value or "rotation" in value):
            found[key] = value
    return found
