"""Reading untrusted files: limits, the line of an error, paths, archives."""

import ast
import dataclasses
import errno
import re
import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import load_gaussians
from humangs_jax.capture.keypoints.reading import read_detections
from humangs_jax.io import reading as module
from humangs_jax.io.arrays import read_npz
from humangs_jax.io.images import read_image
from humangs_jax.io.mesh import GlbWriter, parse_glb, read_obj
from humangs_jax.io.reading import (
    FileError,
    InvalidFileError,
    Limits,
    check_limit,
    check_unpacked,
    inside,
    limits,
    parse_json,
    read_bytes,
    read_json,
    reading,
    set_limits,
    shown,
    walk,
)
from humangs_jax.motion import load_motion

DOCS = Path(__file__).parents[2] / "docs" / "security.md"


@pytest.fixture(autouse=True)
def usual_limits():
    set_limits(None)
    yield
    set_limits(None)


def test_the_page_lists_the_limits_in_force():
    rows = re.findall(r"^\| `(\w+)` \| ([\d,]+) \|", DOCS.read_text(), re.MULTILINE)
    found = {name: int(value.replace(",", "")) for name, value in rows}
    assert found == {name: int(value) for name, value in dataclasses.asdict(Limits()).items()}
    assert "| `ratio` | 100 | Largest unpacked size" in DOCS.read_text()


def test_limits_are_those_of_the_environment(monkeypatch):
    monkeypatch.setenv(module.ENVIRONMENT, "pixels=2e8, photos_outside=1")
    assert limits() == Limits(pixels=200_000_000, photos_outside=True)
    for text in ("pixel=3", "pixels", "pixels=many", "pixels=1e999"):
        set_limits(None)
        monkeypatch.setenv(module.ENVIRONMENT, text)
        with pytest.raises(ValueError, match=rf"HUMANGS_LIMITS: '{text}': expected NAME=NUMBER"):
            limits()


TOO_LONG = (
    r"a\.json: 203 bytes: the limit text_bytes is 100 \(HUMANGS_LIMITS=text_bytes=203 raises it;"
    r" docs/security\.md\)$"
)


def test_a_limit_is_named_and_can_be_changed(tmp_path):
    (tmp_path / "a.json").write_text("[" + "1," * 100 + "1]")
    assert len(read_json(tmp_path / "a.json")) == 101
    set_limits(Limits(text_bytes=100))
    with pytest.raises(FileError, match=TOO_LONG):
        read_json(tmp_path / "a.json")
    set_limits(Limits(nesting=2))
    assert parse_json("[[1], {}]") == [[1], {}]
    with pytest.raises(InvalidFileError, match="limit nesting is 2"):
        parse_json('[{"a": [1]}]')
    with pytest.raises(InvalidFileError, match="limit joints is"):
        check_limit("joints", 2000, "joints")


def test_a_file_unpacks_to_so_many_times_its_size_or_to_what_any_file_may():
    """The greater of the two counts, not their sum, and never more than the limit of arrays."""
    set_limits(Limits(plain_bytes=1000, ratio=10, array_bytes=5000))
    for size, most in ((1, 1000), (100, 1000), (101, 1010), (400, 4000), (600, 5000)):
        check_unpacked(size, most)
        with pytest.raises(InvalidFileError, match=r"plain_bytes|array_bytes"):
            check_unpacked(size, most + 1)


ZOO = [
    RecursionError("maximum recursion depth exceeded"),
    MemoryError(),
    zipfile.BadZipFile("File is not a zip file"),
    EOFError(),
    KeyError("x"),
    UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    RuntimeError("two\nlines"),
    PermissionError(13, "Permission denied"),
    StopIteration(),
    InvalidFileError("expected something else"),
    ValueError("x" * 10_000),
]


@pytest.mark.parametrize("error", ZOO, ids=lambda error: type(error).__name__)
def test_every_exception_is_one_line_that_names_the_file(error):
    class Own(FileError):
        pass

    for kind in (FileError, Own):
        with pytest.raises(kind) as caught, reading("folder/a.bin", "thing", kind):
            raise error
        text = str(caught.value)
        assert text.startswith("folder/a.bin: ") and "\n" not in text and 20 < len(text) < 1100
        with (
            pytest.raises(Own, match=r"^folder/a\.bin: ") as outer,
            reading("folder", "capture", Own),
            reading("folder/a.bin", "thing"),
        ):
            raise error
        assert str(outer.value) == text  # the inner file is named, once


def test_missing_files_keep_their_type():
    with pytest.raises(FileNotFoundError, match=r"^nowhere\.json: no such file$"):
        read_json("nowhere.json")
    with pytest.raises(KeyboardInterrupt), reading("a", "thing"):
        raise KeyboardInterrupt


def test_only_regular_files_of_bounded_size_are_opened(tmp_path):
    import os

    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero", "."):
        with pytest.raises(InvalidFileError):
            read_bytes(tmp_path / name)
    with open(tmp_path / "large", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InvalidFileError, match="limit file_bytes"):
        read_bytes(tmp_path / "large")


def test_paths_stay_inside_of_their_folder(tmp_path):
    folder = tmp_path / "me"
    (folder / "images").mkdir(parents=True)
    (tmp_path / "secret.png").write_bytes(b"")
    (folder / "images" / "link.png").symlink_to(tmp_path / "secret.png")
    (folder / "images" / "near.png").symlink_to(folder / "a.png")
    (folder / "round").symlink_to(folder / "round")
    for name in ("a.png", "images/a.png", "images/../a.png", "./a.png", "images/near.png"):
        assert inside(folder, name) == folder / name
    out = [
        "../secret.png",
        "/etc/passwd",
        "images/link.png",
        "images/../../secret.png",
        "a\0b",
        "round/x",
        str(tmp_path),
    ]
    for name in out:
        with pytest.raises(InvalidFileError, match=r"outside of|is no path"):
            inside(folder, name)
        with pytest.raises(InvalidFileError):
            inside(folder, name, photo=True)
    set_limits(Limits(photos_outside=True))
    assert inside(folder, "../secret.png", photo=True) == folder / "../secret.png"
    with pytest.raises(InvalidFileError, match="outside of"):
        inside(folder, "../secret.png")  # what is no photo stays inside


def test_a_linked_folder_is_its_own_folder(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "me").symlink_to(tmp_path / "real")
    assert inside(tmp_path / "me", "a.png") == tmp_path / "me" / "a.png"


def doubled(times):
    value = ()
    for _ in range(times):
        value = (value, value)
    return value


def test_values_of_files_are_shown_in_few_words_whatever_they_hold():
    within = []
    within += [within] * 5
    for value in (
        within,
        doubled(80),
        {"a": within},
        "x" * 10**6,
        10**5000,
        [{}] * 10**6,
        1.5,
        None,
        object(),
    ):
        assert len(shown(value)) < 300
    assert (shown("a\x1b"), shown(3), shown([1, "b"]), shown(None)) == (
        r"'a\x1b'",
        "3",
        "[1, 'b']",
        "None",
    )


@pytest.mark.parametrize(
    "value, text",
    [
        (np.float64(1.5), "1.5"),
        (np.float32(0.1), "0.1"),
        (np.float16("nan"), "nan"),
        (np.int32(-3), "-3"),
        (np.uint8(7), "7"),
        (np.bool(True), "True"),
        ([np.float64(1.5), {"a": np.int64(2)}], "[1.5, {'a': 2}]"),
        (1.5, "1.5"),
        (False, "False"),
    ],
)
def test_numbers_of_numpy_are_shown_as_numbers(value, text):
    assert shown(value) == text


def test_a_folder_is_searched_once_however_many_links_lead_to_it(tmp_path, caplog):
    for name in ("a", "b"):
        (tmp_path / "in" / name).mkdir(parents=True)
        (tmp_path / "in" / name / "x.png").touch()
    (tmp_path / "in" / ".hidden").touch()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "y.png").touch()
    for name, target in {"up": "in", "again": "in/a", "out": "out"}.items():
        (tmp_path / "in" / name).symlink_to(tmp_path / target)
    found = [path.relative_to(tmp_path).as_posix() for path in sorted(walk(tmp_path / "in"))]
    assert found == ["in/a/x.png", "in/b/x.png"]
    assert "in/out: leads out of" in caplog.text
    assert [
        path.parent.name for path in walk(tmp_path / "in", lambda folder: folder.name != "b")
    ] == ["b"]
    set_limits(Limits(photos_outside=True))
    assert len(list(walk(tmp_path / "in"))) == 3
    set_limits(Limits(entries=3))
    with pytest.raises(InvalidFileError, match="4 files and folders: the limit entries is 3"):
        list(walk(tmp_path / "in"))


def test_threads_parse_one_header_at_a_time(tmp_path, monkeypatch):
    """CPython 3.11 sometimes fails if threads parse at once, and runs left out healthy captures."""
    arrays = {name: np.full((2, 3), i) for i, name in enumerate("abc")}
    np.savez(tmp_path / "some.npz", **arrays)
    inside, most = [], []

    def slow(*arguments, **named):
        inside.append(threading.get_ident())
        time.sleep(1e-3)
        most.append(len(set(inside)))
        inside.remove(threading.get_ident())
        return parse(*arguments, **named)

    parse = ast.parse
    monkeypatch.setattr(ast, "parse", slow)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: read_npz(tmp_path / "some.npz"), range(12)))
    assert len(most) == 36 and max(most) == 1
    for read, pickled in results:
        assert not pickled
        for name, array in arrays.items():
            np.testing.assert_array_equal(read[name], array)


def test_textures_outside_of_the_folder_of_a_mesh_are_left_out(tmp_path, caplog):
    folder = tmp_path / "me"
    folder.mkdir()
    for place in (tmp_path, folder):
        Image.new("RGB", (4, 4), "red").save(place / "red.png")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    (folder / "scan.obj").write_text(f"mtllib scan.mtl\nusemtl skin\n{corners}")
    for texture, found in {"red.png": True, "../red.png": False}.items():
        (folder / "scan.mtl").write_text(f"newmtl skin\nmap_Kd {texture}\n")
        (mesh,) = read_obj(folder / "scan.obj")
        image = mesh.visual.material.image
        assert found == (image is not None and image.size == (4, 4))
    assert "'../red.png' lies outside of" in caplog.text


@pytest.mark.parametrize(
    ("material", "texture"),
    [
        ("my scan.mtl", "my red.png"),
        ('"my scan.mtl"', '"my red.png"'),
        ("my\\ scan.mtl", "-s 1 1 1 -clamp on my red.png"),
        ("my scan.mtl", "parts\\my red.png"),
        ("plain.mtl other.mtl", "my red.png"),
    ],
)
def test_materials_and_textures_are_found_by_names_with_spaces_quotes_and_options(
    tmp_path, material, texture
):
    (tmp_path / "parts").mkdir()
    for place in (tmp_path, tmp_path / "parts"):
        Image.new("RGB", (4, 4), "red").save(place / "my red.png")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    (tmp_path / "scan.obj").write_text(f"mtllib {material}\nusemtl skin\n{corners}")
    for name in ("my scan.mtl", "plain.mtl"):
        (tmp_path / name).write_text(f"newmtl skin\nmap_Kd {texture}\n")
    (mesh,) = read_obj(tmp_path / "scan.obj")
    assert mesh.visual.material.image.size == (4, 4)


def test_a_file_without_permission_says_that_and_not_what_is_in_it(tmp_path, monkeypatch):
    """Every reader must say so; an error about the contents would be wrong."""

    def refuse(path, *arguments, **options):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    doors = {
        "a.npz": Avatar.load,
        "b.npz": load_motion,
        "c.ply": load_gaussians,
        "d.json": read_detections,
    }
    doors |= {"e.json": read_json, "f.bvh": load_motion, "g.png": read_image}
    for name in doors:
        (tmp_path / name).write_bytes(b"PK")
    monkeypatch.setattr("builtins.open", refuse)
    for name, read in doors.items():
        with pytest.raises(FileError) as error:
            read(tmp_path / name)
        assert str(error.value) == f"{tmp_path / name}: no permission to read it"


@pytest.mark.parametrize("name", ["a.npz", "a.npy", "a.pkl", "a.bvh", "a.glb", "a.csv", "a.json"])
def test_a_pointer_of_git_lfs_is_named(tmp_path, name):
    """Git leaves it in place of a large file where LFS is not installed."""
    (tmp_path / name).write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 12345\n"
    )
    with pytest.raises(FileError, match=rf"{name}: not the file itself but its pointer of Git LFS"):
        load_motion(tmp_path / name)


def test_a_glb_that_is_cut_short_says_so(tmp_path):
    writer = GlbWriter()
    writer.array("SCALAR", np.arange(100.0))
    writer.write(tmp_path / "a.glb", {"nodes": [{"name": "Hips"}]})
    data = (tmp_path / "a.glb").read_bytes()
    for length in (100, len(data) - 60):
        with pytest.raises(InvalidFileError, match="a GLB file that is cut short"):
            parse_glb(data[:length])
    with pytest.raises(InvalidFileError, match="a GLB file with damaged JSON"):
        parse_glb(data.replace(b"Hips", b"\xff" * 4))
    assert parse_glb(data)[0]["nodes"] == [{"name": "Hips"}]
