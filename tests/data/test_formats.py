"""A new format needs a module and a row of a table.

Help, reading, `start`, errors and docs then know it.
"""

import importlib
import json
import sys
import types

import numpy as np
import pytest

from experiments.render_tables import format_table
from humangs_jax import cli
from humangs_jax.apps.start import inspect_folder
from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.keypoints.keypoints import DetectedImage, detections_of
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.cli import captures, fit, start
from humangs_jax.data.cameras import CalibratedCamera, read_calibration
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.formats import CAMERAS, KEYPOINTS, CameraFormat, SourceFormat
from tests.capture import calibration_files as written


@pytest.fixture
def made_up(monkeypatch):
    """Returns a function that adds a format to a table and sets the functions of its module."""
    module = types.ModuleType("made_up")
    monkeypatch.setitem(sys.modules, "made_up", module)

    def set_up(table, format, **functions):
        vars(module).update(functions)
        monkeypatch.setitem(table, "mine", format)
        for each in (captures, fit, start):
            importlib.reload(each)

    before = {each: dict(vars(each)) for each in (captures, fit, start)}
    yield set_up
    for each, own in before.items():  # the same classes again, which others have imported
        vars(each).clear()
        vars(each).update(own)


def help_of(capsys, *command):
    with pytest.raises(SystemExit):
        cli.execute([*command, "--help"])
    return capsys.readouterr().out


def test_a_format_of_cameras_is_one_row(tmp_path, made_up, capsys):
    K, poses = written.scene()
    cameras = [
        CalibratedCamera(f"c{i}", k, pose, written.WIDTH, written.HEIGHT)
        for i, (k, pose) in enumerate(zip(K, poses, strict=True))
    ]
    made_up(
        CAMERAS,
        CameraFormat(
            "Rig of ours", "made_up:read", files=("*.rig",), up="+y", pixel_centers="half"
        ),
        recognizes=lambda source: source.text.startswith("RIG"),
        read=lambda source, format: source.calibration(format, cameras),
    )
    written.write_photos(tmp_path, [f"c{i}.png" for i in range(len(cameras))])
    (tmp_path / "studio.rig").write_text("RIG")
    assert inspect_folder(tmp_path).cameras == tmp_path
    # read from the folder and from the file, shown in the help, in the docs and in the error
    for i, source in enumerate((tmp_path, tmp_path / "studio.rig")):
        report = import_cameras(source, tmp_path, tmp_path.with_name(f"out{i}"))
        assert (
            report.read_as.startswith("read as: Rig of ours (")
            and "; +y up;" in report.read_as
            and not report.warnings
        )
    for command in (("import", "cameras"), ("start",)):
        assert "Rig of ours (*.rig)" in " ".join(help_of(capsys, *command).replace("│", "").split())
    assert "| Rig of ours | `*.rig` |  | +0.5 | +y | camera |\n" in format_table("cameras")
    (tmp_path / "other.txt").write_text("?")
    with pytest.raises(
        CaptureError, match=r"not a known format: expected COLMAP.*; Rig of ours \(\*\.rig\)$"
    ):
        read_calibration(tmp_path / "other.txt", lambda name: (1, 1))


def test_a_format_of_keypoints_is_one_row(tmp_path, made_up, capsys):
    people = np.arange(3 * 17, dtype=float).reshape(1, 17, 3) / 50
    people[..., :2] *= 100
    made_up(
        KEYPOINTS,
        SourceFormat("Tracker of ours", "made_up:read", files=("tracks",), content="17 points"),
        recognizes=lambda source: isinstance(source.json, dict) and "tracks" in source.json,
        read=lambda source, format: detections_of(
            [DetectedImage(source.name, source.path, tuple(people))]
        ),
    )
    (tmp_path / "tracks").mkdir()
    (tmp_path / "tracks" / "front.json").write_text(json.dumps({"tracks": []}))
    written.write_photos(tmp_path, ["front.png"])
    assert inspect_folder(tmp_path).keypoints == tmp_path / "tracks"
    found = read_keypoints(tmp_path / "tracks", ["front"], 200, 200)
    np.testing.assert_allclose(found.points[0], people[0, :, :2] + 0.5)
    for command in ("fit", "start", "check"):
        assert "; Tracker of ours." in " ".join(help_of(capsys, command).replace("│", "").split())
    assert "| Tracker of ours | `tracks` | 17 points |\n" in format_table("keypoints")


def test_the_first_row_that_recognizes_a_file_reads_it(tmp_path, made_up):
    """Files that are read together are recognised by their names, alone or in a folder."""
    made_up(
        CAMERAS, CameraFormat("Greedy", "made_up:read"), recognizes=lambda source: True, read=None
    )
    written.write_transforms(
        tmp_path / "transforms.json", *written.scene(), [f"{i}.png" for i in range(4)]
    )
    (tmp_path / "model").mkdir()
    written.write_colmap(tmp_path / "model", *written.scene(), [f"{i}.png" for i in range(4)])
    size = lambda name: (1, 1)
    assert (
        read_calibration(tmp_path / "transforms.json", size).format == CAMERAS["transforms"].about
    )
    for source in (tmp_path / "model", tmp_path / "model" / "images.txt"):
        assert read_calibration(source, size).format == CAMERAS["colmap"].about
