"""Refused command lines: one line that names file and key or the option, and the exit code.

Nothing is written.
"""

import dataclasses
import json
import shutil
from typing import get_type_hints

import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_npz
from command_line import save_tiny_avatar
from small import random_gaussians, small_avatar

from humangs_jax import cli
from humangs_jax.avatar import reconstruct as many
from humangs_jax.avatar.export.gaussians import save_gaussians
from humangs_jax.body.motion import Motion
from humangs_jax.cli import options
from humangs_jax.core.configuration import marks_in
from humangs_jax.data.capture import load_capture, save_capture
from humangs_jax.io.images import write_png
from humangs_jax.motion import save_motion


@pytest.fixture(scope="module")
def things(tmp_path_factory, capture_folder):
    """Returns a folder of files that are not what they are taken for, and of a few sound ones."""
    path = tmp_path_factory.mktemp("things")
    shutil.copytree(capture_folder, path / "someone")
    save_capture(path / "bare", dataclasses.replace(load_capture(capture_folder), masks=None))
    save_tiny_avatar(path / "me.npz")
    # damaged avatars
    data = (path / "me.npz").read_bytes()
    (path / "truncated.npz").write_bytes(data[: len(data) // 2])
    middle = data.index(b"quats.npy") + 100
    (path / "altered.npz").write_bytes(
        data[:middle] + bytes([data[middle] ^ 16]) + data[middle + 1 :]
    )
    arrays = dict(np.load(path / "me.npz"))
    header = json.loads(str(arrays["header"]))
    write = lambda name, **changes: np.savez(path / name, **{**arrays, **changes})
    write("other_numbers.npz", colors=np.full((3, 3), 0.25, np.float32))
    del header["checksum"]
    write("nan.npz", header=json.dumps(header), means=np.full((3, 3), np.nan, np.float32))
    np.savez(path / "no_keys.npz", header=arrays["header"])
    # files of other kinds, and motions of other skeletons and places
    write_png(path / "photo.png", np.ones((8, 8, 3)))
    (path / "cloud.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    np.savez(path / "ten.npz", poses=np.zeros((2, 30)), trans=np.zeros((2, 3)), mocap_framerate=30)
    np.savez(
        path / "far.npz", poses=np.zeros((2, 165)), trans=np.full((2, 3), 1e6), mocap_framerate=30
    )
    np.savez(path / "pickled.npz", poses=np.array([{"a": 1}], dtype=object), trans=np.zeros((1, 3)))
    # folders and captures that lack something
    (path / "folder.npz").mkdir()
    (path / "some").mkdir()
    (path / "some" / "thesis.tex").write_text("mine")
    edit_npz(
        shutil.copytree(capture_folder, path / "broken") / "body.npz",
        rotations=lambda x: np.nan * x,
    )
    next((shutil.copytree(capture_folder, path / "lacking") / "images").iterdir()).unlink()
    # what is sound, and may not be overwritten
    small_avatar().save(path / "three.npz")
    for name, joints in (("jump", 55), ("few", 10), ("steps", 3)):
        save_motion(path / f"{name}.npz", Motion(jnp.zeros((4, joints, 3)), jnp.zeros((4, 3)), 4.0))
    save_gaussians(path / "splats.ply", random_gaussians())
    (path / "a.webm").mkdir()
    (path / "file").write_text("mine")
    (path / "file.npz").write_text("mine")
    np.savez(path / "body.npz", body="makehuman")
    return path


FIT = "fit someone --keypoints k.json"
BAD_DATA = {
    "export truncated.npz": "truncated.npz: not an avatar file",
    "export altered.npz": "altered.npz: not an avatar file",
    "export other_numbers.npz": "other_numbers.npz",
    "export nan.npz": "nan.npz: means: expected",
    "export no_keys.npz": "no_keys.npz: missing keys",
    "export someone/body.npz --out a.ply": "body.npz",
    "animate cloud.ply": "cloud.ply: not an avatar file",
    "animate nobody.npz --out a.mp4": "nobody.npz",
    "animate me.npz --motion ten.npz": "ten.npz: poses: expected",
    "animate me.npz --motion pickled.npz": "pickled.npz: no motion: expected one of the keys",
    "animate me.npz --motion far.npz": "far.npz",
    "reconstruct someone --config missing.json": "missing.json: no such file",
    "view nobody.npz": "nobody.npz: no such file",
    "animate three.npz": "rotations: expected 3 joints, got 55",
    "animate three.npz --motion steps.npz --loop 250000000": "steps.npz: 1,000,000,000 frames",
    "render me.npz --views 1000000000": "the limit frames is 250,000",
    "render three.npz --capture demo_capture": (
        "the capture's poses have 55 joints, the avatar has 3"
    ),
    "render file.ksplat": "file.ksplat: no such file",
    "animate me.npz --camera no.json": "no.json: no such file",
    "render me.npz --camera no.json": "no.json: no such file",
    "render splats.ply --camera no.json": "no.json: no such file",
    "render cloud.ply": "cloud.ply: element vertex: 0 of them",
    "export me.npz --html p.html --motion few.npz": "rotations: expected 55 joints, got 10",
    "export me.npz --out x.ply --motion few.npz": "rotations: expected 55 joints, got 10",
    "export me.npz --out x.ply --motion jump.npz --frames 9:": "none of the 4 frames",
    "reconstruct me.npz": "me.npz",
    "reconstruct nowhere --out a.npz": "nowhere",
    "reconstruct someone --weights someone/body.npz --no-check --out a.npz": "body.npz",
    "reconstruct broken --out a.npz": "broken/body.npz: rotations",
    "reconstruct lacking --out a.npz": "no such image file",
    "convert nobody.pt": "nobody.pt: no such file",
    "start cloud.ply --out new": "cloud.ply: is a file: expected a folder of photos",
    f"{FIT} --out new": "k.json",
    "import cameras none --images someone/images --out new": "none",
}
BAD_USAGE = {
    "animate me.npz --size -5": "--size -5: expected",
    "demo --size 0": "--size 0: expected 16 to 8,192",
    "synth --size 100000": "--size 100000: expected 128, 256 or 512",
    "refine me.npz me --image-size 0": "--image-size 0: expected 16 to 8,192",
    "refine nobody.npz someone --refine 0s": "--refine '0s': expected how long",
    "refine nobody.npz someone --limit 15s": "--limit: is called --refine now",
    "refine me.npz someone --out me.npz": "--out me.npz: is read by this command",
    "animate me.npz --azimuth nan": "--azimuth nan: expected -36,000 to 36,000",
    "animate me.npz --background blu": "--background 'blu': expected a color",
    "animate me.npz --background transparent --out b.mp4": "--out b.mp4: .mp4 has no transparency",
    "animate me.npz --out a.webm": "--out a.webm: is a folder",
    "animate me.npz --fps 0": "--fps 0: expected",
    "animate three.npz --motion steps.npz --start 3": "--start 3, stop 1: expected",
    "animate three.npz --motion steps.npz --loop 0": "--loop 0: expected",
    "render me.npz --height 100000": "--height 100000: expected",
    "render me.npz --exr --channels rgba,depth": "--channels 'depth': expected some of",
    "render me.npz --exr --out b.mp4": "--exr: b.mp4 is a video",
    "render me.npz --capture demo_capture --azimuth 3": "--azimuth: not with --capture",
    "render me.npz --capture demo_capture --views 3": "--views: not with --capture",
    "render me.npz --capture demo_capture --pose a": "--pose: not with --capture",
    "render me.npz --capture demo_capture --out b.mp4": "--out b.mp4: expected a folder",
    "render me.npz --camera c.json --capture someone": (
        "--camera: not with --capture, which has the cameras and poses"
    ),
    "render me.npz --camera c.json --views 3": (
        "--views: not with --camera, which has the cameras"
    ),
    "render splats.ply --camera c.json --azimuth 3": (
        "--azimuth: not with --camera, which has the cameras"
    ),
    "animate me.npz --camera c.json --fov 40": ("--fov: not with --camera, which has the cameras"),
    "animate me.npz --camera c.json --turn 40": "--turn: not with --camera",
    "animate me.npz --camera c.json --no-follow": "--no-follow: not with --camera",
    "render me.npz --capture demo_capture --height 64": "--height: not with --capture",
    "render splats.ply --exr": "--exr: splats.ply is no avatar",
    "render splats.ply --camera transforms.json --out x.mp4": "--camera: expected a folder",
    "render me.npz --preset best --config x.json": "does not go with --preset best",
    "animate": "AVATAR is missing, as in `humangs animate avatar.npz",
    "start": "PHOTOS and --out PATH are missing, as in `humangs start photos --out me",
    "import cameras": (
        "SOURCE, --images PATH and --out PATH are missing, as in `humangs import cameras "
    ),
    "animate me.npz three.npz": "three.npz: not expected here, as in `humangs animate avatar.npz",
    "animate me.npz --size abc": "--size abc: expected a whole number, such as --size 512",
    "animate me.npz --size": "--size: expected a whole number after it",
    "animate me.npz --turn=much": "--turn much: expected a number, such as --turn 0.0",
    "render me.npz --views 2.5": "--views 2.5: expected a whole number",
    "reconstruct someone --views some": "--views some: expected a whole number or auto",
    "demo --preset qualty": (
        "--preset qualty: expected one of realtime, balanced, quality or best: did you mean"
        " quality?"
    ),
    "export me.npz --up x": "--up x: expected one of y, -y or z",
    "import cameras c --images i --out new --up -y": (
        "--up: expected a value after it, as in --up=-y"
    ),
    "preprocess thumam in --out x --body b.npz": (
        "KIND thumam: expected one of thuman, thuman4, avatarrex,"
    ),
    "tune someone": "--reconstruct-ms, --frame-ms, --memory-mb: expected at least one of them",
    "tune someone --frame-ms -1": "--frame-ms -1.0: expected a positive number",
    "tune someone --frame-ms 9 --out tuned.txt": "--out tuned.txt: expected a name ending in .json",
    "convert file --out w.npz": "--out w.npz: expected a name ending in .safetensors",
    "convert file --losses weights.safetensors": (
        "--losses weights.safetensors: the same file as --out"
    ),
    "evaluate someone --predictions someone/images --latex a.html": (
        "--latex a.html: expected a name ending in .tex"
    ),
    "evaluate someone --predictions someone/images --lpips-alex a b c": (
        "--lpips-alex: expected a backbone"
    ),
    "evaluate someone --predictions someone/images --lpips-alex a b": (
        "--lpips-alex: --protocol humangs has no such score: expected LPIPS of vgg"
    ),
    "view me.npz --port 99999": "--port 99999",
    "view me.npz --clip 2": "--clip: expected --motion with it",
    "export me.npz --out x.ply --motion-fps 30": "--motion-fps: expected --motion with it",
    "export me.npz --out x.ply --frame 1": "--frame 1: expected --motion and --out",
    "export me.npz --html x.html --motion jump.npz --frames :": (
        "--frames :: expected --motion and --out"
    ),
    "export me.npz --out x.ply --motion jump.npz --frame 1 --frames :": (
        "--frame 1: does not go with --frames"
    ),
    "export me.npz --out x.glb --mesh --motion jump.npz --frame 1": (
        "a file that holds the whole motion"
    ),
    "export me.npz --out x.ply --mesh": "expected a name ending in .glb, .vrma or .obj",
    "export me.npz --out x.sog": (
        "expected a name ending in .ply, .splat, .spz, .glb, .vrma or .obj"
    ),
    "export me.npz --out x.ply --motion jump.npz --frame 9": "--frame 9: jump.npz has 4 frames",
    "export me.npz --out x.spz --rest": "--rest: x.spz has no such fields",
    "export me.npz --out x.ply --spz-version 4": (
        "--spz-version 4: expected a name of --out that ends in .spz"
    ),
    "preprocess thuman in --out x --body b.npz --views 0": "--views 0",
    "demo --refine inf": "--refine 'inf': expected how long",
    "synth --workers 0": "--workers 0: expected at least 1",
    "synth --sequences --poses 9 --motion-frames 8 --out people": "--poses 9: expected at most",
    "synth --for-training --views 7": "--views 7: does not go with --for-training, which means 12",
    "start me --out new --masks m --without-masks": "--masks m: does not go with --without-masks",
    "train --on-the-fly -1": "--on-the-fly -1: expected at least 0",
    "train": "nobody to train on",
    "reconstruct someone --refine soon --out a.npz": "--refine 'soon': expected how long",
    "reconstruct bare --no-check --refine 15s --out a.npz": "--refine 15s: needs masks",
    "reconstruct x --out folder.npz": "--out folder.npz: is a folder: expected the name of a file",
    "reconstruct x --out file.npz/a.npz": "--out file.npz/a.npz: file.npz is no folder",
    "reconstruct x --out a.zip": "--out a.zip: expected a name ending in .npz",
    "reconstruct x --out body.npz": "--out body.npz: exists and is no avatar",
    "reconstruct x --out /proc/a.npz": "--out /proc/a.npz: cannot write to /proc",
    **{
        f"{line} --out file": "--out file: is a file"
        for line in (
            *(
                "demo",
                "import cameras c --images i",
                "fit capture --keypoints k",
                "start photos",
            ),
        )
    },
    f"{FIT} --out some --overwrite": "the folder holds no capture.json",
    "fit someone --keypoints k --body broken/b.npz --out broken --overwrite": (
        "broken/b.npz lies in it and would be deleted"
    ),
    "fit someone": "body.npz exists: --overwrite replaces it",
    FIT: "body.npz exists: --overwrite replaces it",
    "fit someone --refine": "--refine: is called --to-masks now",
    "fit someone --to-masks --bare": "--bare: is called --tight-clothes now",
    "fit someone --tight-clothes": "--tight-clothes is for --to-masks, not for --keypoints",
    "fit someone --to-masks --smoothness 0.1": (
        "--smoothness is for --keypoints, not for --to-masks"
    ),
    f"{FIT} --smoothness -1 --out new": "--smoothness -1: expected at least 0",
}
REFUSED = [(line, cli.BAD_DATA, problem) for line, problem in BAD_DATA.items()]
REFUSED += [(line, cli.BAD_USAGE, problem) for line, problem in BAD_USAGE.items()]


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("line", "expected", "problem"), REFUSED, ids=[line for line, *_ in REFUSED]
)
def test_what_cannot_be_meant_is_one_line_before_the_work(
    line, expected, problem, things, monkeypatch, humangs
):
    """Bad usage ends with 2, bad data with 1."""
    monkeypatch.chdir(things)
    before = contents(things)
    code, out, err = humangs(*line.split())
    # stages that take seconds are shown: a busy machine shows "starting ..."
    shown = [each for each in err.splitlines() if not each.endswith(" ...")]
    assert len(shown) == 1 and out == "", (out, err)
    assert shown[0].startswith("humangs: error: ") and problem in shown[0], err
    assert code == expected and (
        expected == cli.BAD_DATA or problem[:2] != "--" or f"error: {problem}" in err
    )
    assert contents(things) == before


FOLDERS = {
    "export three.npz --out new/deep/a.ply": "new/deep/a.ply",
    "export three.npz --html new/deep/page.html": "new/deep/page.html",
    "export three.npz --motion steps.npz --out new/deep/a.ply --frames :": "new/deep/a_0003.ply",
}


@pytest.mark.parametrize("line", FOLDERS)
def test_the_folder_of_results_is_made(line, things, tmp_path, monkeypatch, humangs):
    for name in ("three.npz", "steps.npz"):
        shutil.copy(things / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    code, _, err = humangs(*line.split())
    assert code == 0 and (tmp_path / FOLDERS[line]).is_file(), err


def places(command):
    """Returns a command's options that name output files, with a suffix that each may have."""
    hints = get_type_hints(command, include_extras=True)
    found = {name: marks_in(hint, options.OutputPath) for name, hint in hints.items()}
    return {
        name: place.suffixes[0]
        for name, marks in found.items()
        for place in marks
        if place.suffixes
    }


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_places_in_folders_that_do_not_exist_are_accepted_by_every_command(name, tmp_path):
    for suffix in places(cli._command(name)).values():
        options.require_file(tmp_path / "new" / "deep" / f"a{suffix}", (suffix,))
    assert not list(tmp_path.iterdir())


def test_a_capture_that_looks_wrong_is_warned_about(capture_folder, tmp_path, monkeypatch, humangs):
    """The quick part of `check` warns; the command ends after it."""
    monkeypatch.setattr(
        many,
        "reconstruct_batch",
        lambda variables, config, captures, batch: iter([captures[0]()][1:]),
    )
    turned = shutil.copytree(capture_folder, tmp_path / "turned")
    edit_npz(turned / "body.npz", rotations=np.degrees)
    _, _, err = humangs("reconstruct", turned, "--out", tmp_path / "a.npz")
    assert "warning: the poses seem to be in degrees" in err and "humangs check" in err
