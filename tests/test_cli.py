import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from humangs_jax import cli
from humangs_jax.cli import fit
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.io.images import read_image

COMMANDS = ("import", "fit", "check", "demo", "reconstruct", "animate", "render", "export", "synth", "train", "convert")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A copy of the shipped capture: with its four photos, so that the demo's programs are compiled once for both."""
    path = tmp_path_factory.mktemp("captures") / "someone"
    save_capture(path, load_capture("demo_capture"))
    return path


def run(monkeypatch, capsys, *arguments):
    """(exit code, stdout, stderr) of the command line, in this process."""
    monkeypatch.setattr(sys, "argv", ["humangs", *map(str, arguments)])
    try:
        cli.main()
        code = 0
    except SystemExit as exit_:
        code = exit_.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_every_page_that_a_help_text_names_exists():
    docs = Path(__file__).parents[1]
    sources = [file.read_text() for file in Path(cli.__file__).parent.glob("*.py")]
    pages = {page for text in sources for page in re.findall(r"docs/\w+\.md", text)}
    assert len(pages) > 4 and all((docs / page).is_file() for page in pages), pages


def test_help_names_every_command_and_imports_nothing_heavy():
    code = "import sys; from humangs_jax import cli; sys.argv = ['humangs', '--help']\ntry: cli.main()\nexcept SystemExit: pass\n"
    code += "assert 'jax' not in sys.modules and 'flax' not in sys.modules"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert all(name in result.stdout for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, command, "--help")
    assert code == 0 and "--out" in out and "docstring" not in out


def spoil_json(change):
    def spoil(path):
        file = path / "capture.json"
        description = json.loads(file.read_text())
        change(description)
        file.write_text(json.dumps(description))

    return spoil


def spoil_body(change):
    def spoil(path):
        arrays = dict(np.load(path / "body.npz"))
        change(arrays)
        np.savez(path / "body.npz", **arrays)

    return spoil


BAD_CAPTURES = {
    "missing image": (lambda path: next((path / "images").iterdir()).unlink(), "images/"),
    "wrong K shape": (spoil_json(lambda d: d["views"][0].update(K=[[1, 0], [0, 1]])), "views[0].K"),
    "NaN pose": (spoil_body(lambda a: a["rotations"].__setitem__((0, 0, 0), np.nan)), "rotations"),
    "mismatched counts": (spoil_body(lambda a: a.update(translations=np.zeros((7, 3)))), "translations"),
    "frame out of range": (spoil_json(lambda d: d["views"][1].update(frame=5)), "views[1].frame"),
    "singular camera": (
        spoil_json(lambda d: d["views"][0].update(cam_from_world=[[0, 0, 0, 0]] * 3 + [[0, 0, 0, 1]])),
        "cam_from_world",
    ),
    "0 views": (spoil_json(lambda d: d.update(views=[])), "views"),
}


@pytest.mark.parametrize("case", BAD_CAPTURES)
@pytest.mark.parametrize("command", ["reconstruct", "check"])
def test_a_bad_capture_is_one_line_and_nothing_is_written(case, command, folder, tmp_path, monkeypatch, capsys):
    spoil, field = BAD_CAPTURES[case]
    bad, out = tmp_path / "bad", tmp_path / "out"
    shutil.copytree(folder, bad)
    spoil(bad)
    out.mkdir()
    code, printed, error = run(monkeypatch, capsys, command, bad, "--out", out / "result.npz")
    assert code == 2 and printed == ""
    assert error.count("\n") == 1 and error.startswith("humangs: error: ")
    assert field in error and "bad" in error  # names the field and the file
    assert list(out.iterdir()) == []


def test_wrong_options_are_one_line_too(folder, tmp_path, monkeypatch, capsys):
    for arguments in (
        ("reconstruct", tmp_path / "nowhere"),
        ("reconstruct", folder, "--out", tmp_path / "no" / "such" / "folder.npz"),
        ("animate", tmp_path / "no_avatar.npz", "--out", tmp_path / "a.mp4"),
        ("animate", tmp_path / "no_avatar.npz", "--out", tmp_path / "a.txt"),
        ("export", folder / "body.npz", "--out", tmp_path / "a.ply"),
        ("reconstruct", folder, "--weights", folder / "body.npz", "--out", tmp_path / "a.npz"),
        ("reconstruct", folder, "--refine", "soon", "--out", tmp_path / "a.npz"),
        ("refine", tmp_path / "no_avatar.npz", folder, "--limit", "0s"),
        ("synth", "--subjects", "0", "--out", tmp_path / "people"),
    ):
        code, _, error = run(monkeypatch, capsys, *arguments)
        assert code == 2 and error.count("\n") == 1, (arguments, error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_from_photos_to_images(folder, tmp_path, monkeypatch, capsys):
    """reconstruct, render, animate, export and check, one after the other, as a user would."""
    import plyfile

    monkeypatch.chdir(tmp_path)
    for arguments in (
        ("reconstruct", folder, "--out", "avatar.npz"),
        ("refine", "avatar.npz", folder, "--limit", "2steps", "--image-size", "64", "--live", "--out", "refined.npz"),
        ("render", "refined.npz", "--out", "views", "--views", "2", "--size", "64", "--exr"),
        ("export", "avatar.npz", "--out", "avatar.ply"),
        ("check", folder, "--out", "check.png"),
    ):
        code, _, error = run(monkeypatch, capsys, *arguments)
        assert code == 0, error
    image, _ = read_image("views/view_000.png")
    assert image.shape == (64, 64, 3) and image.std() > 10 / 255 and image[0].min() > 0.98  # tails of hair
    assert Path("views/views.exr").stat().st_size > 1000
    assert len(plyfile.PlyData.read("avatar.ply")["vertex"].data) > 10_000
    assert read_image("check.png")[0].std() > 10 / 255


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either a CAPTURE folder or --scan MESH"),
        (["FOLDER", "--scan", "scan.obj"], "give either a CAPTURE folder or --scan MESH"),
        (["FOLDER"], "--keypoints FILE is missing"),
        (["FOLDER", "--keypoints", "k.json"], "body.npz exists: --overwrite replaces it"),
        (["FOLDER", "--photometric"], "--photometric is for --refine, not for --keypoints"),
        (["FOLDER", "--bare"], "--bare is for --scan"),
        (["FOLDER", "--refine", "--smoothness", "0.1"], "--smoothness is for --keypoints, not for --refine"),
        (["FOLDER", "--keypoints", "k.json", "--out", "new"], "k.json"),
        (
            ["FOLDER", "--keypoints", "k.json", "--smoothness", "-1", "--out", "new"],
            "--smoothness -1.0: expected at least 0",
        ),
        (["--scan", "scan.obj", "--refine"], "--refine is for captures, not for --scan"),
        (["--scan", "scan.obj"], "--out FOLDER is missing"),
        (["--scan", "scan.obj", "--out", "new"], "scan.obj"),
        (["--scan", "scan.obj", "--views", "v"], "scan.obj"),
        (["--scan", "scan.obj", "--keypoints", "k.json", "--out", "new"], "needs --views FOLDER"),
        (["--scan", "scan.obj", "--joints", "j.json", "--views", "v"], "--joints and --views: give one"),
    ],
)
def test_fit_says_what_is_missing(folder, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    arguments = [folder if argument == "FOLDER" else argument for argument in arguments]
    code, _, err = run(monkeypatch, capsys, "fit", *arguments)
    assert code == 2 and message in err and err.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_fit_deletes_no_folder_with_something_of_its_own_or_of_the_user(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    capture = Path("out/capture.json")
    for name in ("docs/me.obj", "docs/scan_fit.json", "papers/thesis.tex", "out/k.json", capture):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("mine")
    shutil.copyfile(folder / "capture.json", capture)
    before = sorted(tmp_path.rglob("*"))
    for arguments, message in (
        (("--scan", "docs/me.obj", "--out", "docs"), "docs/me.obj lies in it and would be deleted"),
        (("--scan", "docs/me.obj", "--out", "papers"), "the folder holds no scan_fit.json"),
        ((folder, "--keypoints", "out/k.json", "--out", "papers"), "the folder holds no capture.json"),
        ((folder, "--keypoints", "out/k.json", "--out", "out"), "out/k.json lies in it and would be deleted"),
        ((folder, "--keypoints", "k", "--body", "out/k.json", "--out", "out"), "out/k.json lies in it"),
    ):
        code, _, error = run(monkeypatch, capsys, "fit", *arguments, "--overwrite")
        assert code == 2 and message in error and error.count("\n") == 1, (arguments, error)
    assert sorted(tmp_path.rglob("*")) == before
    code, printed, _ = run(monkeypatch, capsys, "fit", "--scan", "none.obj", "--out", "docs", "--overwrite")
    assert code == 2 and "this is deleted: me.obj, scan_fit.json" in printed and sorted(tmp_path.rglob("*")) == before


def test_the_options_of_each_way_to_fit_exist():
    parts = (fit.Detections, fit.Scan, fit.Refinement, fit.Fit)
    options = {field.name for part in parts for field in dataclasses.fields(part)}
    for way, others in fit.WAYS.items():
        assert others | {way.removeprefix("--")} <= options


def test_training_goes_on_from_weights_as_they_were_trained(tmp_path, monkeypatch, capsys):
    """Their network and the way their Gaussians are drawn; the run's other knobs stay."""
    from humangs_jax.network import presets, weights
    from humangs_jax.training import loop, sources

    started = []
    model = presets.tiny().with_conventions(rendering="inria")
    monkeypatch.setattr(weights, "load_weights", lambda path: ({}, model))
    monkeypatch.setattr(sources, "training_people", lambda *arguments: None)
    monkeypatch.setattr(loop, "train", lambda settings, *arguments, **options: started.append(settings))
    for config in ("tiny", "published"):
        code, _, error = run(monkeypatch, capsys, "train", "--config", config, "--init-weights", "w", "--out", tmp_path)
        assert code == 0, error
    assert all(settings.splat.square and settings.splat.radius_sigma == 3 for settings in started)
    assert [settings.model.conventions.rendering for settings in started] == ["inria", "inria"]


def test_import_of_what_is_no_calibration_is_one_line(folder, tmp_path, monkeypatch, capsys):
    code, _, err = run(
        monkeypatch,
        capsys,
        "import",
        "cameras",
        tmp_path / "none",
        "--images",
        folder / "images",
        "--out",
        tmp_path / "new",
    )
    assert code == 2 and "none" in err and err.count("\n") == 1
    assert not (tmp_path / "new").exists()
