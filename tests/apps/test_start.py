"""`humangs start`: what it finds in a folder, what it reports as missing, and what it makes."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_json
from PIL import Image

from experiments.your_photos import landmarks_in, write_material
from humangs_jax import cli
from humangs_jax.apps import detect, photos_alone, start
from humangs_jax.apps.detect import PersonInPhoto, PhotoPeople
from humangs_jax.apps.from_photos import FromPhotos, avatar_from_photos
from humangs_jax.apps.start import better_body, held_out_psnr, inspect_folder, missing
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.video import write_video
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose
from humangs_jax.body.resolution import decimate
from humangs_jax.capture.detection import people as blazepose
from humangs_jax.capture.keypoints.formats import SeenPerson
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture import capture_from_arrays, load_capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import load_photos
from humangs_jax.geometry.camera import orbit
from humangs_jax.io.images import read_image, to_uint8, write_png
from humangs_jax.io.reading import write_json
from humangs_jax.losses.losses import masked_psnr
from humangs_jax.network.presets import tiny
from tests.refinement.refinement_cases import toy_avatar, toy_capture


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Returns a folder of photos, calibration, masks and keypoints as other programs write them."""
    folder = tmp_path_factory.mktemp("mine") / "photos"
    write_material(folder, load_capture("demo_capture"), np.full((4, 133, 2), 100.0))
    return folder


@pytest.fixture
def mine(photos, tmp_path, monkeypatch):
    """Returns a copy of the folder that a test may change; the package's detector is off."""
    monkeypatch.setattr(blazepose, "available", lambda: False)
    shutil.copytree(photos, tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    return Path("photos")


def test_everything_is_found(mine):
    found = inspect_folder(mine)
    assert (found.images, found.photos, found.size) == (mine / "images", 4, (512, 512))
    assert (found.cameras, found.masks, found.keypoints) == (
        mine,
        mine / "masks",
        mine / "keypoints",
    )
    assert missing(found) == () and str(found).count("\n") == 3


def test_other_layouts_are_found(mine):
    """Found are photos beside the other files, a folder for each camera, COLMAP's workspace, and
    OpenPose's file under another name.
    """
    for path in (mine / "images").iterdir():
        (mine / path.stem).mkdir()
        path.rename(mine / path.stem / "000000.png")
    (mine / "images").rmdir()
    (mine / "colmap" / "sparse" / "0").mkdir(parents=True)
    (mine / "calibration.json").unlink()
    (mine / "colmap" / "sparse" / "0" / "images.txt").write_text("")
    (mine / "keypoints").rename(mine / "my_keypoints")
    (mine / "masks").rename(mine / "matte")
    shutil.copytree(mine / "matte", mine / "colmap" / "dense" / "images")
    found = inspect_folder(mine)
    assert (found.images, found.photos, found.masks) == (mine, 4, mine / "matte")
    assert (found.cameras, found.keypoints) == (mine / "colmap", mine / "my_keypoints")


@pytest.mark.parametrize("name", ["others", "occluders", "unknown"])
def test_masks_of_others_are_found_by_the_name_of_their_folder(name, mine):
    assert inspect_folder(mine).others is None and "in front" not in str(inspect_folder(mine))
    (mine / name).mkdir()
    write_png(mine / name / "a.png", np.ones((8, 8), np.float32))
    found = inspect_folder(mine)
    assert found.others == mine / name and f"in front:  {mine / name}" in str(found)
    assert found.photos == inspect_folder(mine, others=mine / name).photos
    assert not any(each.path.is_relative_to(mine / name) for each in found.unused)
    with pytest.raises(CaptureError, match="nowhere: no such file or folder"):
        inspect_folder(mine, others=mine / "nowhere")


def test_alpha_is_a_mask(mine):
    shutil.rmtree(mine / "masks")
    for path in (mine / "images").iterdir():
        write_png(path, np.concatenate([np.ones((512, 512, 3)), np.zeros((512, 512, 1))], axis=-1))
    found = inspect_folder(mine)
    assert found.alpha and missing(found) == () and "in the photos' alpha channel" in str(found)


@pytest.mark.parametrize("distortion", [0, 0.1])
def test_opaque_alpha_is_no_mask(distortion, mine, capsys):
    edit_json(
        mine / "calibration.json",
        lambda rig: [camera.update(dist=[distortion, 0, 0, 0, 0]) for camera in rig.values()],
    )
    without(mine, "masks", "keypoints")
    for path in (mine / "images").iterdir():
        write_png(path, np.ones((512, 512, 4)))
    found = inspect_folder(mine)
    assert not found.alpha and [each.name for each in missing(found)] == ["masks", "keypoints"]
    assert cli.execute(["start", str(mine), "--out", "me"]) == cli.BAD_DATA
    assert (
        load_photos("me").masks is None and "masks and keypoints missing" in capsys.readouterr().err
    )


TOOLS = {
    "cameras": (
        "colmap automatic_reconstructor --workspace_path photos/colmap --image_path photos/images",
        "EasyMocap",
    ),
    "masks": ("rembg p -m u2net_human_seg -om photos/images photos/masks", "SAM 2"),
    "keypoints": (
        "inferencer_demo.py photos/images --pose2d wholebody --pred-out-dir photos/keypoints",
        "openpose.bin",
    ),
}


def without(folder, *names):
    for name in names:
        if name == "cameras":
            (folder / "calibration.json").unlink()
        else:
            shutil.rmtree(folder / name)


@pytest.mark.parametrize("names", [("cameras",), ("masks",), ("keypoints",), tuple(TOOLS)])
def test_what_is_missing_comes_with_its_tools(names, mine, capsys):
    without(mine, *names)
    if set(names) - {"cameras"}:
        assert "pip install 'humangs_jax[photos]'" in missing(inspect_folder(mine))[-1].how[0]
    code = cli.execute(["start", str(mine), "--out", "me"])
    out, err = capsys.readouterr()
    kinds = " and ".join(", ".join(names).rsplit(", ", 1))
    assert (
        code == cli.BAD_DATA
        and err
        == f"humangs: error: photos: {kinds} missing: make them as above and run the same command"
        " again\n"
    )
    for other, lines in TOOLS.items():
        assert all((line in out) == (other in names) for line in lines), out
    if "cameras" in names:
        assert list(Path().iterdir()) == [mine]
    else:  # what is there was imported
        assert (
            load_photos("me").images.shape == (4, 512, 512, 3) and not Path("me/body.npz").exists()
        )


def test_keypoints_have_to_be_of_photos_without_lens_distortion(mine, capsys):
    without(mine, "keypoints")
    edit_json(
        mine / "calibration.json",
        lambda rig: [camera.update(dist=[0.1, 0, 0, 0, 0]) for camera in rig.values()],
    )
    assert cli.execute(["start", str(mine), "--out", "me"]) == cli.BAD_DATA
    assert "inferencer_demo.py me/images --pose2d" in capsys.readouterr().out


@pytest.fixture
def detected(mine, monkeypatch):
    """Replaces the detector and the fit; returns the list of the arguments that the fit gets."""
    capture, arguments = load_capture("demo_capture"), []
    points = np.nan_to_num(landmarks_in(capture, MEDIAPIPE_33.names))
    shown = []
    for v, name in enumerate(capture.names):
        person = SeenPerson(
            np.concatenate([points[v], np.ones((33, 1))], axis=1), np.zeros((33, 3)), 1.0
        )
        mask = to_uint8(capture.masks[v])
        # larger, but nobody's masks or keypoints are there
        bystander = PersonInPhoto(person, mask[:60, :20], (0, 0), 2e5)
        shown.append(
            PhotoPeople(
                f"{name}.png",
                (512, 512),
                np.ones((48, 48, 3)),
                (bystander, PersonInPhoto(person, mask, (0, 0), 1e5)),
            )
        )

    def stop(self, known, ahead):
        arguments.append(known)
        raise ValueError("the fit")
        yield

    monkeypatch.setattr(blazepose, "available", lambda: True)
    monkeypatch.setattr(detect, "found_in_capture", lambda folder: shown)
    monkeypatch.setattr(FromPhotos, "_fit", stop)
    return arguments


@pytest.mark.parametrize("names", [("keypoints",), ("masks",), ("masks", "keypoints")])
def test_what_is_missing_is_found_in_the_photos_and_what_is_given_wins(
    names, mine, detected, capsys
):
    shutil.rmtree(mine)
    truth = load_capture("demo_capture")
    write_material(mine, truth, landmarks_in(truth))
    without(mine, *names)
    options = ["--person", "1"] if len(names) == 2 else []  # what is given says who is meant
    assert cli.execute(["start", str(mine), "--out", "me", *options]) == cli.BAD_DATA
    out, err = capsys.readouterr()
    assert (
        err == "humangs: error: the fit\n"
        and f"{' and '.join(names)} found in the photos: me/people.png" in out
    )
    (known,) = detected
    assert known.keypoints == (
        Path("me/keypoints.json") if "keypoints" in names else mine / "keypoints"
    )
    assert known.keypoints_by_detector == ("keypoints" in names)
    assert known.masks_by_detector == ("masks" in names)
    imported = load_photos("me")
    np.testing.assert_allclose(imported.masks, truth.masks, atol=1 / 255)


@pytest.mark.slow  # finds the cameras
def test_photos_alone_are_enough(mine, detected, capsys):
    """Cameras, masks and keypoints come from the detected person; only LiteRT is needed."""
    without(mine, *TOOLS)
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "1.7"]) == cli.BAD_DATA
    out, err = capsys.readouterr()
    assert err.endswith("humangs: error: the fit\n") and "cameras from the person: " in out
    (known,) = detected
    assert known.keypoints == Path("me/keypoints.json")
    assert known.keypoints_by_detector and known.masks_by_detector
    imported, truth = load_photos("me"), load_capture("demo_capture")
    assert (imported.frames == 0).all()
    centers, true = (np.asarray(capture.cameras.center) for capture in (imported, truth))
    # of cameras without a common world: distances between them, over the first
    apart = lambda points: np.linalg.norm(points[1:] - points[0], axis=-1)
    np.testing.assert_allclose(
        apart(centers) / apart(centers)[0], apart(true) / apart(true)[0], rtol=0.2
    )


def test_large_photos_are_reduced_upright_and_small_ones_stay(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("photos", "reduced")]
    (folders[0] / "left").mkdir(parents=True)
    picture = Image.fromarray(
        np.kron(np.asarray([[0, 255]], np.uint8), np.ones((60, 60), np.uint8))
    )
    picture.save(folders[0] / "left/a.png")
    lying = Image.Exif()
    lying[0x0112] = 6
    picture.resize((240, 120)).save(folders[0] / "b.jpg", exif=lying)
    files = [folders[0] / "left/a.png", folders[0] / "b.jpg"]
    assert photos_alone._reduced(folders[0], files, folders[1]) == []
    monkeypatch.setattr(photos_alone, "LONGEST", 80)
    found = photos_alone._reduced(folders[0], files, folders[1])
    assert [str(file.relative_to(folders[1])) for file in found] == ["left/a.png", "b.png"]
    first, second = (read_image(file)[0][..., 0] for file in found)
    assert (
        first.shape == (40, 80)
        and second.shape == (80, 40)
        and first[0, -1] == 1
        and second[-1, 0] > 0.9 > 0.1 > second[0, 0]
    )
    shutil.copy(files[0], folders[0] / "b.png")  # of the same name, but for the suffix
    assert photos_alone._reduced(folders[0], [*files, folders[0] / "b.png"], folders[1]) == []


def test_a_height_without_a_use_is_refused(mine, detected, capsys):
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "1.7"]) == cli.BAD_USAGE
    assert "--height: is for photos without cameras" in capsys.readouterr().err


def test_a_height_in_centimetres_is_refused_before_the_photos_are_looked_at(mine, capsys):
    without(mine, "cameras")
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "178"]) == cli.BAD_USAGE
    assert "--height 178: expected 0.3 to 3" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "value"), [("--scale", "0.01"), ("--up", "+z")])
def test_options_of_a_calibration_are_refused_without_one(option, value, mine, detected, capsys):
    without(mine, "cameras")
    assert cli.execute(["start", str(mine), "--out", "me", f"{option}={value}"]) == cli.BAD_USAGE
    assert f"{option}: is for a calibration, and there is none" in capsys.readouterr().err


def test_without_the_detector_a_height_does_not_hide_how_to_install_it(mine, capsys):
    without(mine, "cameras", "masks", "keypoints")
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "1.78"]) == cli.BAD_DATA
    out, err = capsys.readouterr()
    assert (
        "pip install 'humangs_jax[photos]'" in out and "cameras, masks and keypoints missing" in err
    )


def test_a_body_that_other_options_made_is_not_taken(mine, detected, capsys):
    """The same command continues with the fitted body; another height would have no effect on it,
    and is refused.
    """
    without(mine, "cameras")
    first = FromPhotos(mine, Path("me"), height=1.7)
    Path("me").mkdir()
    for name, content in {"capture.json": {}, "fit.json": {}, **first.mark()}.items():
        write_json(Path("me") / name, content)
    Path("me/body.npz").touch()
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "1.8"]) == cli.BAD_USAGE
    assert (
        "--height: the body in me was made with 1.7: --overwrite (in Python"
        " overwrite=True) begins anew" in capsys.readouterr().err
    )
    assert cli.execute(["start", str(mine), "--out", "me", "--height", "1.7"]) == cli.BAD_DATA
    assert "begins anew" not in capsys.readouterr().err  # it goes on, to a capture without photos


@pytest.mark.parametrize(
    ("calibrated", "sheet"), [(True, "me/people.png"), (False, "me_people.png")]
)
def test_two_people_are_refused_with_the_sheet_that_numbers_them(
    calibrated, sheet, mine, detected, monkeypatch, capsys
):
    without(mine, "masks", "keypoints", *([] if calibrated else ["cameras"]))
    found = detect.found_in_capture(Path("me"))

    def named(names, photos):
        return [dataclasses.replace(p, name=n) for n, p in zip(names, found, strict=True)]

    monkeypatch.setattr(detect, "detect_photos", named)
    assert cli.execute(["start", str(mine), "--out", "me"]) == cli.BAD_DATA
    numbered = f"expected one. Person 0 to 1: numbers on {sheet}"
    unknown = f"which of the people of {sheet} is meant? Nothing tells who of one photo is who"
    assert (numbered if calibrated else unknown) in capsys.readouterr().err
    assert Path(sheet).is_file() and not detected
    assert cli.execute(["start", str(mine), "--out", "me", "--person", "5"]) == cli.BAD_USAGE
    assert f"--person 5: expected 0 to 1, as on {sheet}" in capsys.readouterr().err
    assert Path("me").exists() == calibrated  # what was imported stays


def test_a_video_becomes_photos_beside_the_capture(tmp_path, monkeypatch, capsys):
    """A second run uses the photos of the first and those that were added. Another video of the
    same name is refused.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(blazepose, "available", lambda: False)
    Path("clips").mkdir()
    scenes = np.random.default_rng(0).uniform(0.1, 0.9, (3, 4, 6, 3))
    write_video(
        Path("v.mp4"), [np.kron(scenes[i // 5], np.ones((12, 12, 1))) for i in range(15)], 10
    )
    Path("v.mp4").rename("clips/me.MP4")
    command = ["start", "clips/me.MP4", "--out", "out/me", "--no-browser"]
    assert cli.execute(command) == cli.BAD_DATA  # there are no cameras
    assert "clips/me.MP4: 3 of 15 frames" in capsys.readouterr().out
    photos = sorted(Path("out/me_photos/images").iterdir())
    assert [int(path.stem[-8:]) // 5 for path in photos] == [0, 1, 2]
    Path("out/me_photos/masks").mkdir()
    shutil.copy(photos[0], "out/me_photos/masks")
    before = {path: path.stat().st_mtime_ns for path in photos}
    # the only video of a folder
    assert cli.execute([command[0], "clips", *command[2:]]) == cli.BAD_DATA
    out = capsys.readouterr().out
    assert "3 of 15 frames" in out and "masks:     out/me_photos/masks" in out
    assert {path: path.stat().st_mtime_ns for path in photos} == before
    with Path("clips/me.MP4").open("ab") as file:
        file.write(bytes(8))
    assert cli.execute(command) == cli.BAD_DATA
    assert "out/me_photos: exists, and is not of me.MP4 as it is now" in capsys.readouterr().err


def test_what_is_no_video_of_a_person_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("clips").mkdir()
    write_video(Path("clips/black.mp4"), [np.zeros((16, 16, 3))] * 3, 10)
    for files, problem in (
        ({}, "black.mp4: none of its 3 frames shows anything"),
        ({"black.mp4": b"no video"}, "black.mp4: not a readable video"),
        ({"b.mov": b""}, "clips: 2 videos and no photo: expected photos or one video"),
    ):
        for name, content in files.items():
            Path("clips", name).write_bytes(content)
        assert cli.execute(["start", "clips", "--out", "me"]) == cli.BAD_DATA
        message = capsys.readouterr().err
        assert problem in message and message.count("\n") == 1
        assert list(Path().iterdir()) == [Path("clips")]


def test_folders_without_photos_and_captures_are_refused(mine):
    Path("empty").mkdir()
    for folder, problem in (
        (Path("empty"), "empty: no photo: expected"),
        (Path("nowhere"), "nowhere: no such folder"),
        (mine / "calibration.json", "is a file: expected a folder of photos"),
    ):
        with pytest.raises(CaptureError, match=problem):
            inspect_folder(folder)
    (mine / "capture.json").write_text("{}")
    with pytest.raises(CaptureError, match="is a capture already"):
        inspect_folder(mine)
    (mine / "capture.json").unlink()
    with pytest.raises(CaptureError, match=r"none\.json: no such file or folder"):
        inspect_folder(mine, keypoints=Path("none.json"))


@pytest.mark.parametrize(
    "files",
    [
        ("capture.json", "body.npz"),
        ("capture.json", "pose.npz"),
        ("capture.json", "body.npz", "fit.json"),
    ],
)
def test_a_capture_of_something_else_is_not_replaced(files, mine, capsys):
    Path("me").mkdir()
    for name in files:
        Path("me", name).write_text("mine")
    assert cli.execute(["start", str(mine), "--out", "me"]) == cli.BAD_USAGE
    assert "--out me: the folder is not empty" in capsys.readouterr().err
    assert {path.name: path.read_text() for path in Path("me").iterdir()} == dict.fromkeys(
        files, "mine"
    )


def test_masks_that_are_there_may_be_left_out(mine, capsys):
    shutil.rmtree(mine / "keypoints")
    for _ in range(2):  # what the first run has imported is replaced
        assert cli.execute(["start", str(mine), "--out", "me", "--without-masks"]) == cli.BAD_DATA
        assert "masks:     missing" in capsys.readouterr().out
        assert load_photos("me").masks is None


def test_a_notebook_reads_the_same_steps(mine, detected):
    """A step prints what `humangs start` shows, and an error names the argument."""
    shutil.rmtree(mine)
    truth = load_capture("demo_capture")
    write_material(mine, truth, landmarks_in(truth))
    without(mine, "keypoints")
    steps = []
    with pytest.raises(ValueError, match="the fit"):
        for step in avatar_from_photos(str(mine), "me", person=1):
            steps.append(step)
    assert "cameras:" in str(steps[0]) and steps[0].file is None and steps[0].avatar is None
    assert "keypoints found in the photos: me/people.png shows them" in [str(x) for x in steps]
    with pytest.raises(ArgumentError, match="height: is for photos without cameras"):
        list(avatar_from_photos(mine, "me", height=1.7, overwrite=True))
    with pytest.raises(ArgumentError, match="masks m: does not go with without_masks"):
        list(avatar_from_photos(mine, "me", masks="m", without_masks=True))


@pytest.mark.slow
def test_from_photos_to_the_page(mine, capsys, monkeypatch):
    import webbrowser

    shutil.rmtree(mine)
    truth = load_capture("demo_capture")
    write_material(mine, truth, landmarks_in(truth))
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert cli.execute(["start", str(mine), "--out", "me"]) == 0, capsys.readouterr().err
    out, _ = capsys.readouterr()
    assert (
        "keypoints, median error" in out
        and "silhouette IoU" in out
        and "next: humangs animate me/avatar.npz" in out
    )
    assert "4 iterations and 0 steps" in out and "dB in the foreground" in out
    assert opened == [(Path("me").resolve() / "avatar.html").as_uri()]
    assert len(Avatar.load("me/avatar.npz").gaussians.means) > 10_000
    fitted = load_capture("me")
    # the world of the calibration, OpenCV's, was turned back to y up
    np.testing.assert_allclose(
        fitted.cameras.cam_from_world, truth.cameras.cam_from_world, atol=1e-4
    )
    error = np.linalg.norm(
        np.asarray(fitted.pose(0).translation) - np.asarray(truth.pose(0).translation)
    )
    assert error < 0.05
    assert {path.name for path in Path("me").iterdir()} >= {
        "check.png",
        "avatar.html",
        "fit.json",
        "body.npz",
    }
    assert cli.execute(["start", str(mine), "--out", "me"]) == cli.BAD_USAGE  # finished
    Path("me/avatar.html").unlink()  # as after an interrupt
    written = Path("me/body.npz").stat().st_mtime_ns
    assert cli.execute(["start", str(mine), "--out", "me"]) == 0 and Path("me/avatar.html").exists()
    assert "me has a body: going on from there" in capsys.readouterr().out
    assert Path("me/body.npz").stat().st_mtime_ns == written


# The photo that an avatar has not seen
# ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 400)


@pytest.fixture(scope="module")
def toy(body):
    """Returns a capture of an avatar without errors."""
    return toy_capture(body, toy_avatar(body, 0.0), views=4)


def reconstructed(monkeypatch, body, wrong):
    """Replaces the reconstruction by an avatar that is off by `wrong` of the capture."""
    monkeypatch.setattr(start, "SIZE", 64)
    made = lambda _, __, photos: toy_avatar(body, wrong(photos.capture))
    monkeypatch.setattr(start, "reconstruct", made)


def test_one_of_four_photos_is_kept_from_the_network_and_compared_with(body, toy, monkeypatch):
    given = []
    reconstructed(monkeypatch, body, lambda others: given.append(others.names) or 0.0)
    found = held_out_psnr({}, tiny(), toy, None)
    # a copy in its place
    assert set(toy.names) - set(given[0]) == {found.name} and len(given[0]) == 4
    assert found.psnr > 25 and found.name in str(found)
    reconstructed(monkeypatch, body, lambda _: 0.15)
    assert held_out_psnr({}, tiny(), toy, None).psnr < found.psnr - 3
    for few in (toy.select([0, 1, 2]), dataclasses.replace(toy, masks=None)):
        assert held_out_psnr({}, tiny(), few, None) is None


def test_the_psnr_of_the_person_is_that_of_evaluations():
    image, photo = np.random.default_rng(0).random((2, 20, 30, 3), np.float32)
    mask = np.linspace(0, 1, 600, dtype=np.float32).reshape(20, 30)
    expected = float(masked_psnr(*map(jnp.asarray, (image, photo, mask))))
    assert start._psnr_of_person(image, photo, mask) == pytest.approx(expected, abs=1e-4)
    assert start._psnr_of_person(photo, photo, mask) == 100


def test_the_body_with_the_better_avatar_is_taken(body, toy, monkeypatch):
    other, wrong = dataclasses.replace(toy, body_file="other"), {}
    reconstructed(monkeypatch, body, lambda photos: wrong[photos.body_file])
    for first, second, taken in ((0.15, 0.0, other), (0.0, 0.15, toy), (0.0, 0.0, toy)):
        wrong |= {toy.body_file: first, "other": second}
        found, estimate = better_body({}, tiny(), toy, other, None)
        assert found is taken and estimate.psnr > 25
    few = toy.select([0, 1])
    assert better_body({}, tiny(), few, other, None) == (few, None)


@pytest.mark.parametrize(
    ("gains", "asked", "better"),
    [
        ((-3.0, 0.2, 0.3), 3, True),  # the pose of the first photo is off
        ((0.2, -0.3, -0.3), 3, False),
        ((0.2, 0.2), 2, True),
        ((2.0,), 1, True),
    ],
)
def test_no_photo_alone_rejects_a_body(gains, asked, better, toy, monkeypatch):
    other, numbers = dataclasses.replace(toy, body_file="other"), []

    def scored(variables, config, photos, refinement, number=0, watch=None):
        numbers.append(number)
        of_other = photos.given is other
        return start.HeldOut(photos.given.names[number], 20.0, 30.0 + of_other * gains[number])

    monkeypatch.setattr(start, "held_out_psnr", scored)
    found, estimate = better_body({}, tiny(), toy, other, None)
    assert found is (other if better else toy) and estimate.name == toy.names[0]
    assert sorted(set(numbers)) == list(range(asked))


def test_the_photo_that_is_held_out_of_a_person_who_turns_is_the_one_with_the_nearest_other():
    """Turning the person before one camera is the same as moving the camera around the person."""
    angles = np.radians([0.0, 90.0, 200.0, 215.0])
    around = orbit(
        jnp.zeros(3), 3.0, jnp.asarray(-angles), 0.1, jnp.diag(jnp.asarray([8.0, 8.0, 1.0])), 8, 8
    )
    before = orbit(
        jnp.zeros(3), 3.0, jnp.zeros(4), 0.1, jnp.diag(jnp.asarray([8.0, 8.0, 1.0])), 8, 8
    )
    still, order = np.zeros((4, 1, 3), np.float32), np.asarray([2, 0, 3, 1])
    turning = still.copy()
    turning[order, 0, 1] = angles
    poses = lambda rotations: jax.vmap(BodyPose)(jnp.asarray(rotations), jnp.zeros((4, 3)))
    K, matrices = before.K, before.cam_from_world
    capture = capture_from_arrays(
        np.ones((4, 8, 8, 3)), K, matrices, np.zeros((1, 55, 3)), np.zeros((1, 3))
    )

    def distances(cameras, rotations):
        return start._distances(
            dataclasses.replace(
                capture, cameras=cameras, poses=poses(rotations), frames=order.astype(np.int32)
            )
        )

    found = distances(before, turning)
    np.testing.assert_allclose(found, distances(around, still), atol=1e-5)
    assert set(np.argwhere(found == found.min())[0].tolist()) == {2, 3}
