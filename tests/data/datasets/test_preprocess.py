"""`humangs preprocess`: what it writes and skips, and how it goes on after interruptions."""

import importlib
import json
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from command_line import run as in_process
from dataset_files import (
    CAMERAS,
    FRAMES,
    model_arrays,
    write_actorshq,
    write_avatarrex,
    write_model,
    write_thuman,
    write_thuman4,
)
from scipy.spatial.transform import Rotation

from humangs_jax.cli import training
from humangs_jax.cli.training import Preprocess, ScanViews
from humangs_jax.data.capture import load_capture
from humangs_jax.data.datasets.scene_list import read_scene_list
from humangs_jax.data.datasets.subject import open_people, posed_people
from humangs_jax.data.datasets.thuman import Scan
from humangs_jax.data.formats import DATASETS, DataSetFormat
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.data.preprocess import protocol
from humangs_jax.data.preprocess import run as set_run
from humangs_jax.data.preprocess.protocol import AMBIENT, HEADLIGHT, ScanRenderer, smooth_normals
from humangs_jax.data.preprocess.run import PreprocessConfig, preprocess
from humangs_jax.io import atomic
from humangs_jax.io.images import read_image

SIZE = 16
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("body"))


@pytest.fixture(autouse=True)
def few_vertices(monkeypatch):
    """Pads scans to few vertices instead of thousands."""
    monkeypatch.setattr(protocol, "STEP", 16)


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """Returns a folder of two subjects, one of which has a photo that cannot be read."""
    folder = tmp_path_factory.mktemp("videos")
    write_avatarrex(folder / "avatarrex_a")
    write_avatarrex(folder / "avatarrex_b")
    (folder / "avatarrex_b" / "22010708" / "00000002.jpg").write_bytes(b"\xff\xd8 cut off")
    return folder


def settings(layout="scenes", **changes):
    return PreprocessConfig("avatarrex", layout, SIZE, every=1, **changes)


def run(source, out, body, asked, **options):
    return preprocess(source, out, body.file, asked, progress=False, **options)


def test_a_video_becomes_a_scene_in_an_upright_world(videos, tmp_path, body):
    report = run(videos, tmp_path / "out", body, settings())
    views = FRAMES * CAMERAS
    assert (report.made, report.scenes, report.views) == (
        2,
        2,
        2 * views - 1,
    ) and not report.skipped
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["counts"]["unreadable_photos"] == 1
    (problem,) = manifest["scenes"]["avatarrex_b"]["unreadable"].values()
    assert "00000002.jpg" in problem
    scenes = read_scene_list(tmp_path / "out" / "test.json")
    assert list(scenes) == ["avatarrex_a", "avatarrex_b"]
    assert json.loads((tmp_path / "out" / "evaluation_1.json").read_text())["avatarrex_a"]["target"]
    raw = open_people(videos, body, SIZE)[0].subject
    found = open_people(tmp_path / "out", body)[0].subject
    # frame 0 stands upright in the middle; photos and cameras show the same as before
    posed = next(posed_people(body.model, found.parameters([0])))
    spine = posed.joints[12] - posed.joints[0]
    assert spine[1] / np.linalg.norm(spine) > 1 - 1e-6
    np.testing.assert_allclose(
        (posed.vertices.min(0) + posed.vertices.max(0)) / 2, 0, atol=MILLIMETRE
    )
    before = next(posed_people(body.model, raw.parameters([1]))).vertices
    after = next(posed_people(body.model, found.parameters([1]))).vertices
    with np.load(tmp_path / "out" / "avatarrex_a" / "smpl" / "000001.npz") as arrays:
        np.testing.assert_allclose(arrays["v_posed"], after, atol=MILLIMETRE)
    for view, other in ((2, 2), (3, 3)):
        seen = [
            (subject.cam_from_world[i] @ np.concatenate([points, np.ones((len(points), 1))], 1).T)[
                :3
            ]
            for subject, points, i in ((raw, before, view), (found, after, other))
        ]
        np.testing.assert_allclose(*seen, atol=MILLIMETRE)
        np.testing.assert_allclose(
            found.squared_K([other], SIZE), raw.squared_K([view], SIZE), atol=1e-4
        )
    np.testing.assert_array_equal(found.photo(1, SIZE)[0], raw.photo(1, SIZE)[0])
    np.testing.assert_array_equal(found.photo(1, SIZE)[1], raw.photo(1, SIZE)[1])


def test_the_other_layout_is_capture_folders(videos, tmp_path, body):
    shutil.copy(body.file, tmp_path / "SMPLX_TINY.npz")
    run(videos, tmp_path / "out", body, settings("capture"))
    folders = find_captures(tmp_path / "out")
    assert [folder.name for folder in folders] == ["avatarrex_a", "avatarrex_b"]
    capture = load_capture(folders[0])
    assert capture.body.name == "SMPLX_TINY" and capture.view_count == FRAMES * CAMERAS
    raw = open_people(videos, body, SIZE)[0].subject
    K = np.asarray(capture.cameras.K)
    np.testing.assert_allclose(K, raw.squared_K(np.arange(len(raw)), SIZE), atol=1e-4)
    np.testing.assert_allclose(
        np.asarray(capture.betas)[:10], raw.parameters([]).betas[:10], atol=1e-5
    )


def test_a_finished_scene_is_kept_only_of_the_same_files(videos, tmp_path, body):
    source, out = shutil.copytree(videos, tmp_path / "data"), tmp_path / "out"
    run(source, out, body, settings())
    assert run(source, out, body, settings()).made == 0
    photo = source / "avatarrex_a" / "22010708" / "00000001.jpg"
    photo.write_bytes(photo.read_bytes() + b" of somebody else")
    with pytest.raises(ValueError, match=r"avatarrex_a/scene.json: made_from: made from other"):
        run(source, out, body, settings())


def test_a_finished_set_is_kept_and_other_settings_are_refused(videos, tmp_path, body):
    out = tmp_path / "out"
    # two processes make a scene each; a further run makes none
    assert run(videos, out, body, settings(), shard=(0, 2)).scenes == 1
    kept = (out / "avatarrex_a" / "scene.json").stat().st_mtime_ns
    report = run(videos, out, body, settings(), shard=(1, 2))
    assert (report.made, report.scenes) == (1, 2) and len(read_scene_list(out)) == 2
    assert run(videos, out, body, settings()).made == 0
    assert (out / "avatarrex_a" / "scene.json").stat().st_mtime_ns == kept
    # other settings, another body model and other videos are refused; a copy of the model is not
    with pytest.raises(
        ValueError, match=r"manifest.json: settings: .*size 16 -> 32.*another folder"
    ):
        run(videos, out, body, PreprocessConfig("avatarrex", "scenes", 32, every=1))
    other = tmp_path / "other.npz"
    other.write_bytes(Path(body.file).read_bytes())
    assert preprocess(videos, out, other, settings(), progress=False).made == 0
    with zipfile.ZipFile(other, "a") as archive:
        archive.comment = b"another model"
    with pytest.raises(ValueError, match=r"manifest.json: settings: .*\(body '\w+' -> '\w+'\)"):
        preprocess(videos, out, other, settings(), progress=False)
    with pytest.raises(
        ValueError, match=r"manifest.json: settings: .*\(source '\w+' -> 'avatarrex_a'\)"
    ):
        run(videos / "avatarrex_a", out, body, settings())
    (out / "avatarrex_a" / "scene.json").write_text('{"known": {"views": true}}')
    with pytest.raises(
        ValueError, match=r"avatarrex_a/scene.json: known.views: expected an integer, got True"
    ):
        run(videos, out, body, settings())
    # places that cannot hold the set, and a folder without videos
    with pytest.raises(ValueError, match="lies in the data set"):
        run(videos, videos / "out", body, settings())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="not empty"):
        run(videos, tmp_path / "mine", body, settings())
    with pytest.raises(ValueError, match="no subject in the layout of avatarrex"):
        run(tmp_path / "mine", tmp_path / "new", body, settings())


def test_a_kill_leaves_nothing_half_written(videos, tmp_path, body, monkeypatch):
    written, write = [], set_run.write_png

    def die(path, image):
        written.append(path)
        if len(written) > 5:
            raise KeyboardInterrupt
        write(path, image)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(set_run, "write_png", die)
        run(videos, tmp_path / "out", body, settings())
    assert not list((tmp_path / "out").glob("*/scene.json")) and not list(
        (tmp_path / "out").glob(".*")
    )
    # a process that is killed at once leaves a temporary folder, which the next one removes
    abandoned = tmp_path / "out" / f".avatarrex_a.new-{atomic.MACHINE}-999999999-01234567"
    (abandoned / "images").mkdir(parents=True)
    atomic._sweep.cache_clear()
    assert run(videos, tmp_path / "out", body, settings()).scenes == 2
    assert not abandoned.exists()


def test_a_subject_that_cannot_be_read_is_skipped_with_the_reason(videos, tmp_path, body):
    source, out = tmp_path / "source", tmp_path / "out"
    shutil.copytree(videos, source)
    good = (source / "avatarrex_a" / "smpl_params.npz").read_bytes()
    (source / "avatarrex_a" / "smpl_params.npz").write_bytes(good[:100])
    report = run(source, out, body, settings())
    assert (
        report.scenes == 1
        and "smpl_params.npz: not a readable npz archive" in report.skipped["avatarrex_a"]
    )
    assert "skipped avatarrex_a" in str(report)
    (source / "avatarrex_a" / "smpl_params.npz").write_bytes(good)  # repaired: tried again
    report = run(source, out, body, settings())
    assert report.scenes == 2 and not report.skipped
    shutil.rmtree(source / "avatarrex_b")
    (source / "avatarrex_a" / "smpl_params.npz").write_bytes(b"")
    with pytest.raises(ValueError, match=r"none of 1 subjects could be made.*smpl_params.npz"):
        run(source, tmp_path / "none", body, settings())


def test_scans_become_scenes_by_the_command(tmp_path, body, capsys):
    source = write_thuman(tmp_path / "thuman", model_arrays())
    (source / "smplx" / "0002" / "mesh_smplx.obj").unlink()
    views = ScanViews(views=2, near=True, train=1, test=1)
    command = Preprocess(
        "thuman", source, views, tmp_path / "out", Path(body.file), size=SIZE, workers=1
    )
    command.run()
    assert "2 scenes, 4 views" in capsys.readouterr().out
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert "mesh_smplx.obj: no such file" in manifest["skipped"]["0002"]
    assert (
        manifest["settings"]["factors"] == [2.0, 2.0]
        and manifest["scenes"]["0001"]["fit_kind"] == "B"
    )
    people = {}
    for part in ("train", "test"):
        if (tmp_path / "out" / f"{part}.json").is_file():
            people |= {
                p.name.rsplit(" ", 1)[1]: p.subject
                for p in open_people(tmp_path / "out" / f"{part}.json", body)
            }
    for name, subject in people.items():
        known = manifest["scenes"][name]
        distance = subject.cam_from_world[:, 2, 3] * known["units_per_metre"]
        np.testing.assert_allclose(distance, 2 * known["radius"], rtol=1e-4)
        image, mask = subject.photo(0, SIZE)
        assert 0.05 < (mask > 0).mean() < 0.6 and (image[mask == 0] == 255).all()
    captures = Preprocess(
        "thuman",
        source,
        views,
        tmp_path / "captures",
        Path(body.file),
        size=SIZE,
        workers=1,
        layout="capture",
    )
    captures.run()
    name, wanted = next(iter(people.items()))
    capture = load_capture(tmp_path / "captures" / name)
    np.testing.assert_allclose(
        np.asarray(capture.cameras.cam_from_world), wanted.cam_from_world, atol=MILLIMETRE
    )

    # as matrices: a turn by more than half a circle is also one the other way round
    def matrices(rotations):
        return Rotation.from_rotvec(np.asarray(rotations, float).reshape(-1, 3)).as_matrix()

    found = matrices(capture.poses.rotations)
    np.testing.assert_allclose(found, matrices(wanted.parameters([0]).rotations), atol=1e-4)
    np.testing.assert_allclose(
        np.asarray(capture.poses.translation), wanted.parameters([0]).translations, atol=MILLIMETRE
    )


def test_the_split_is_that_of_all_scans_also_where_one_lacks_a_file(tmp_path, body):
    source = write_thuman(tmp_path / "thuman", model_arrays())
    names = sorted(folder.name for folder in (source / "model").iterdir())
    options = PreprocessConfig("thuman", "scenes", SIZE, views=2, train=len(names) - 1, test=1)
    run(source, tmp_path / "all", body, options)
    whole = json.loads((tmp_path / "all" / "manifest.json").read_text())["split"]
    (source / "smplx" / whole["train"][0] / "mesh_smplx.obj").unlink()
    run(source, tmp_path / "less", body, options)
    less = json.loads((tmp_path / "less" / "manifest.json").read_text())["split"]
    assert less == {"train": whole["train"][1:], "test": whole["test"]}


def test_a_data_set_is_one_line_of_the_table(tmp_path, body, monkeypatch, capsys):
    """The command's choices and help, `preprocess`, and the loader of people know a new row."""
    found = lambda folder: tuple(sorted(folder.glob("*.toy")))
    opened = lambda path, own: open_people(path.with_suffix(""), own)[0].subject
    monkeypatch.setitem(DATASETS, "toy", DataSetFormat("made up", opened, find=found))
    write_avatarrex(tmp_path / "raw" / "a" / "avatarrex_a")
    (tmp_path / "raw" / "a.toy").touch()
    monkeypatch.setattr(training, "Preprocess", training.Preprocess)  # reloading replaces it
    importlib.reload(training)
    help_text = " ".join(
        in_process(monkeypatch, capsys, "preprocess", "--help")[1].replace("│", " ").split()
    )
    assert ",toy}" in help_text and "; toy: made up" in help_text
    words = (
        "preprocess",
        "toy",
        tmp_path / "raw",
        "--out",
        tmp_path / "out",
        "--body",
        body.file,
        "--size",
        SIZE,
    )
    code, out, error = in_process(monkeypatch, capsys, *words)
    assert code == 0 and "1 scenes, 2 views" in out, error
    assert [person.name for person in open_people(tmp_path / "raw", body)] == [
        str(tmp_path / "raw" / "a.toy")
    ]


def test_sequences_of_several_actors_have_names_of_their_own(tmp_path, body):
    for actor in ("Actor01", "Actor02"):
        write_actorshq(tmp_path / "raw" / actor / "Sequence1")
    report = preprocess(
        tmp_path / "raw",
        tmp_path / "out",
        body.file,
        PreprocessConfig("actorshq", size=SIZE),
        progress=False,
    )
    assert report.scenes == 2
    assert list(read_scene_list(tmp_path / "out")) == ["Actor01_Sequence1", "Actor02_Sequence1"]


def test_the_working_folder_may_be_the_data_set(videos, tmp_path, body, monkeypatch):
    monkeypatch.chdir(videos / "avatarrex_a")
    report = run(".", tmp_path / "out", body, settings())
    assert report.scenes == 1 and (tmp_path / "out" / "avatarrex_a" / "scene.json").is_file()


def test_a_face_before_the_camera_has_the_color_of_its_texture():
    corners = np.asarray([[-5.0, -5, 0], [5, -5, 0], [5, 5, 0], [-5, 5, 0]])
    faces = np.asarray([[0, 1, 2], [0, 2, 3]], np.int32)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[::2] = 200  # finer than the samples: on average 100
    scan = Scan(corners, faces, ((corners[:, :2] + 5) / 10).astype(np.float32), texture)
    np.testing.assert_allclose(
        smooth_normals(corners, faces), np.tile([0, 0, 1], (4, 1)), atol=1e-12
    )
    pose = np.diag([1.0, -1, -1, 1])
    pose[2, 3] = 8
    image, mask = ScanRenderer.of(scan, corners).render(pose, SIZE, 1)
    assert (mask == 255).all()
    across = np.hypot(
        *np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE / 2) * np.tan(np.pi / 6)] * 2)
    )
    light = AMBIENT + HEADLIGHT / np.sqrt(1 + across**2)
    np.testing.assert_allclose(image, np.repeat(np.rint(100 * light)[..., None], 3, -1), atol=1)


def test_listed_missing_photos_are_in_the_manifest(tmp_path, body):
    write_thuman4(tmp_path / "subject00")
    preprocess(
        tmp_path,
        tmp_path.parent / "out4",
        body.file,
        PreprocessConfig("thuman4", size=SIZE, every=2),
        progress=False,
    )
    manifest = json.loads((tmp_path.parent / "out4" / "manifest.json").read_text())
    assert (
        manifest["counts"]["missing_photos"] == 1
        and manifest["scenes"]["subject00"]["views"] == 2 * CAMERAS
    )
    image, _ = read_image(tmp_path.parent / "out4" / "subject00" / "images" / "cam00_00000002.png")
    assert image.shape == (SIZE, SIZE, 3)
