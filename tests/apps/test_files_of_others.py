"""No command replaces a file that another program wrote, even if its own has the same name."""

import json
from pathlib import Path

import numpy as np
import pytest

from humangs_jax import cli
from humangs_jax.apps import demo, detect
from humangs_jax.avatar.export import mesh
from humangs_jax.avatar.video import write_video
from humangs_jax.io.atomic import add_files
from humangs_jax.io.images import MASK, is_own_picture, mark_of, write_png
from tests.apps.test_detect import found, photo

DEMO = Path(detect.__file__).parents[1] / "assets" / "demo_capture"
GREY = np.full((30, 40, 3), 0.5)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Returns the working folder; a detector finds one person in the photos `a` and `b`."""
    monkeypatch.chdir(tmp_path)
    for name in "ab":
        Path("photos").mkdir(exist_ok=True)
        write_png(f"photos/{name}.png", GREY)
    people = [photo(f"{name}.png", found(1, 90.0)) for name in "ab"]
    monkeypatch.setattr(detect, "found_in_photos", lambda folder: people)
    return tmp_path


@pytest.mark.parametrize("name", ["keypoints.json", "people.png", "masks/b.png"])
def test_detect_replaces_what_it_wrote_and_nothing_else(name, here, capsys):
    file = Path("photos") / name
    file.parent.mkdir(exist_ok=True)
    if name == "keypoints.json":
        file.write_text('{"people": []}')
    else:
        write_png(file, np.zeros((30, 40)))
    before = file.read_bytes()
    command = ["detect", "photos", "--out", "photos"]
    assert cli.execute(command) == cli.BAD_DATA
    assert (
        f"photos/{name}: exists, and was not written by humangs: choose another folder, or"
        " --overwrite" in capsys.readouterr().err
    )
    assert (
        file.read_bytes() == before
        and sum(path.is_file() for path in Path("photos").rglob("*")) == 3
    )
    assert cli.execute([*command, "--overwrite"]) == 0 and file.read_bytes() != before
    assert mark_of("photos/masks/a.png") == MASK and is_own_picture("photos/people.png")
    assert cli.execute(command) == 0  # its own


def test_a_sheet_of_numbers_replaces_no_picture_of_others(tmp_path):
    two = [photo("a.png", found(1, 90.0), found(2, 80.0))]
    write_png(tmp_path / "me_people.png", GREY)
    before = (tmp_path / "me_people.png").read_bytes()
    with pytest.raises(
        ValueError, match=r"me_people\.png: exists, and was not written by humangs: several people"
    ):
        detect.choose(two, None, tmp_path / "me_people.png")
    assert (tmp_path / "me_people.png").read_bytes() == before


def test_frames_replace_and_delete_own_pictures_only(tmp_path):
    write_video(tmp_path / "frames", [GREY] * 3, 10)
    write_video(tmp_path / "frames", [GREY] * 2, 10)
    assert len(list((tmp_path / "frames").iterdir())) == 2
    write_png(tmp_path / "frames" / "frame_00007.png", GREY)
    with pytest.raises(
        ValueError, match=r"frame_00007\.png: exists, and was not written by humangs"
    ):
        write_video(tmp_path / "frames", [GREY] * 2, 10)


def test_files_are_added_all_or_none_where_one_is_of_others(tmp_path):
    (tmp_path / "b").write_text("mine")

    def write(folder):
        for name in "abc":
            (folder / name).write_text("new")

    with pytest.raises(ValueError, match="b: exists, and was not written by humangs"):
        add_files(tmp_path, write, ours=lambda file: False)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"b": "mine"}
    add_files(tmp_path, write, without=["z"], first="c", ours=lambda file: file.name == "b")
    assert (tmp_path / "b").read_text() == "new"


@pytest.mark.parametrize("suffix", [".png", ".mtl"])
def test_an_obj_takes_no_name_of_others_for_its_texture(suffix, tmp_path):
    (tmp_path / "me").with_suffix(suffix).write_bytes(b"my photo")
    with pytest.raises(
        ValueError,
        match=rf"me\{suffix}: exists, and was not written by humangs: .*another name for the \.obj",
    ):
        mesh.check_beside(tmp_path / "me.obj")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"my photo"]


def test_the_demo_replaces_an_earlier_one_and_nothing_else(tmp_path):
    (tmp_path / "avatar.npz").write_text("mine")
    with pytest.raises(ValueError, match=r"avatar\.npz: exists, and was not written by humangs"):
        demo.run_demo(tmp_path)
    assert (tmp_path / "avatar.npz").read_text() == "mine"
    (tmp_path / "report.json").write_text(json.dumps(dict.fromkeys(demo.REPORTED, 0)))
    demo._check_place(tmp_path)


@pytest.mark.parametrize(
    ("name", "options"),
    [("check.png", []), ("check_fit.png", []), ("x_fit.png", ["--out", "x.png"])],
)
def test_check_takes_no_name_that_nobody_asked_for_from_a_picture(
    name, options, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_png(name, GREY)
    before = Path(name).read_bytes()
    assert cli.execute(["check", str(DEMO), *options]) == cli.BAD_DATA
    assert (
        f"{name}: exists, and was not written by humangs: choose another name by --out"
        in capsys.readouterr().err
    )
    assert Path(name).read_bytes() == before


def test_the_files_of_an_obj_have_names_without_spaces(tmp_path):
    """Many readers of `.obj` end a name at a space."""
    written = mesh.write_material(
        tmp_path / "me and  you.obj",
        mesh.BodyMesh(
            *(np.eye(3, dtype=np.float32) for _ in range(2)),
            faces=np.asarray([[0, 1, 2]]),
            uvs=np.zeros((3, 2), np.float32),
            texture=np.zeros((4, 4, 3), np.uint8),
            weights=np.ones((3, 1), np.float32),
            source=np.arange(3),
        ),
    )
    assert written.name == "me_and_you.mtl"
    assert "map_Kd me_and_you.png\n" in written.read_text()
    mesh.check_beside(tmp_path / "me and  you.obj")
    (tmp_path / "me_and_you.png").write_bytes(b"my photo")
    with pytest.raises(ValueError, match=r"me_and_you\.png: exists"):
        mesh.check_beside(tmp_path / "me and  you.obj")
