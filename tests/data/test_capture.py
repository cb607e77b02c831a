import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_json, edit_npz
from small import tetrahedron

from humangs_jax.data import photos as photos_module
from humangs_jax.data.capture import CaptureError, capture_from_arrays, load_capture, save_capture
from humangs_jax.data.photos import check_photos, load_photos, names_from_paths
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.images import write_png
from humangs_jax.io.reading import read_json, write_json

HEIGHT, WIDTH, VIEWS, FRAMES, JOINTS = 12, 10, 3, 2, 5
HALF_LEVEL = 0.5 / 255 + 1e-6
"""Half a level of 8-bit images, with a margin for rounding."""


def arrays(seed=0):
    random = np.random.default_rng(seed)
    K = intrinsics_from_fov(0.8, WIDTH, HEIGHT)
    cameras = orbit(jnp.zeros(3), 3.0, jnp.arange(VIEWS) * 1.0, 0.1, K, WIDTH, HEIGHT)
    return dict(
        images=random.random((VIEWS, HEIGHT, WIDTH, 3)),
        K=cameras.K,
        cam_from_world=cameras.cam_from_world,
        rotations=random.normal(size=(FRAMES, JOINTS, 3)),
        translations=random.normal(size=(FRAMES, 3)),
        betas=random.normal(size=2),
        masks=random.random((VIEWS, HEIGHT, WIDTH)),
        frames=[0, 1, 1],
        body=tetrahedron(),
        displacement=random.uniform(-0.5, 0.5, (4, 3)),
    )


@pytest.fixture
def folder(tmp_path):
    """Returns the folder of a valid capture of the tiny body."""
    save_capture(tmp_path / "me", capture_from_arrays(**arrays()))
    return tmp_path / "me"


def load(path):
    return load_capture(path, body=tetrahedron())


def assert_same(a, b, atol):
    np.testing.assert_allclose(a.images, b.images, atol=atol, rtol=0)
    np.testing.assert_allclose(a.masks, b.masks, atol=atol, rtol=0)
    for field in ("frames", "betas", "displacement"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    jax.tree.map(np.testing.assert_array_equal, (a.cameras, a.poses), (b.cameras, b.poses))
    assert a.names == b.names


def test_round_trip(tmp_path):
    capture = capture_from_arrays(**arrays(), names=("front", "left-1", "back.2"))
    save_capture(tmp_path / "a" / "me", capture)
    once = load(tmp_path / "a" / "me")
    assert_same(capture, once, HALF_LEVEL)
    save_capture(tmp_path / "b", once)
    assert_same(once, load(tmp_path / "b"), 0)  # a loaded capture is written back exactly
    assert (
        once.images.dtype
        == once.masks.dtype
        == once.betas.dtype
        == once.displacement.dtype
        == np.float32
    )
    assert once.poses.rotations.dtype == jnp.float32
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]  # nothing temporary stays


def test_a_body_without_displacement_has_none_in_its_file(tmp_path):
    save_capture(tmp_path / "me", capture_from_arrays(**{**arrays(), "displacement": None}))
    assert load(tmp_path / "me").displacement is None
    with np.load(tmp_path / "me" / "body.npz") as file:
        assert "displacement" not in file


TOO_MANY = (
    "capture.json: 1,008,000,000 pixels in 84 photos of 4000 x 3000: the limit capture_pixels is"
    " 1,000,000,000"
)


def test_large_captures_are_read_and_endless_ones_refused_before_their_photos_are(
    folder, monkeypatch
):
    """60 photos of 12 megapixels are allowed."""
    monkeypatch.setattr(photos_module, "image_size", lambda path: (4000, 3000))
    (folder / "photos").mkdir()
    views = [{"image": f"photos/{i}.png"} for i in range(84)]
    for view in views:
        (folder / view["image"]).touch()
    check_photos(folder, views[:60], together=True)
    check_photos(folder, views, together=False)  # one after the other, as training does
    with pytest.raises(CaptureError, match=TOO_MANY):
        check_photos(folder, views, together=True)
    with pytest.raises(
        CaptureError, match=r"17 views of each photo \(17 of 1\): the limit views_per_photo is 16"
    ):
        check_photos(folder, views[:1] * 17, together=False)


def test_masks_put_photos_on_white_once(tmp_path):
    a = arrays()
    on_white = a["images"] * a["masks"][..., None] + 1 - a["masks"][..., None]
    np.testing.assert_allclose(capture_from_arrays(**a).images, on_white, atol=1e-6)
    np.testing.assert_allclose(
        capture_from_arrays(**a, background="white").images, a["images"], atol=1e-7
    )
    save_capture(tmp_path / "me", capture_from_arrays(**{**a, "masks": None}))
    assert load(tmp_path / "me").masks is None
    mask = a["masks"][0]
    write_png(tmp_path / "me" / "mask.png", mask)
    edit_description(
        tmp_path / "me", lambda d: [view.update(mask="mask.png") for view in d["views"]]
    )
    expected = a["images"] * mask[..., None] + 1 - mask[..., None]
    np.testing.assert_allclose(load(tmp_path / "me").images, expected, atol=2 * HALF_LEVEL)


def test_select_and_pose():
    capture = capture_from_arrays(**arrays())
    some = capture.select([2, 0])
    np.testing.assert_array_equal(some.images, capture.images[[2, 0]])
    np.testing.assert_array_equal(some.cameras.cam_from_world[1], capture.cameras.cam_from_world[0])
    assert some.names == (capture.names[2], capture.names[0]) and list(some.frames) == [1, 0]
    assert some.displacement is capture.resized(5).displacement is capture.displacement
    assert some.view_count == 2 and some.frame_count == capture.frame_count == FRAMES
    np.testing.assert_array_equal(capture.pose(1).rotations, capture.poses.rotations[1])
    assert capture.pose(1).translation.shape == (3,)
    for frame in (FRAMES, FRAMES + 3):  # JAX would take the last one
        with pytest.raises(
            IndexError, match=f"index {frame} is out of range for a batch of {FRAMES}"
        ):
            capture.pose(frame)


def test_alpha_is_the_mask_and_goes_onto_white(folder):
    from PIL import Image

    random = np.random.default_rng(3)
    pixels = random.integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8)
    description = json.loads((folder / "capture.json").read_text())
    for view in description["views"]:
        Image.fromarray(pixels).save(folder / view["image"])
        del view["mask"]
    (folder / "capture.json").write_text(json.dumps(description))
    capture = load(folder)
    alpha = pixels[..., 3:] / 255
    np.testing.assert_allclose(capture.masks[0], alpha[..., 0], atol=1e-6)
    np.testing.assert_allclose(
        capture.images[0], pixels[..., :3] / 255 * alpha + 1 - alpha, atol=1e-6
    )


def test_frame_may_be_left_out_for_a_single_pose(folder):
    edit_npz(folder / "body.npz", rotations=np.zeros((1, JOINTS, 3)), translations=np.zeros((1, 3)))
    edit_description(folder, lambda d: [view.pop("frame") for view in d["views"]])
    assert list(load(folder).frames) == [0, 0, 0]


def test_frames_of_photos_without_poses_are_counted_from_0(folder):
    edit_description(folder, lambda d: [view.update(frame=-1) for view in d["views"]])
    with pytest.raises(CaptureError, match=r"views\[0\]\.frame: expected 0 or more, got -1"):
        load_photos(folder)


def test_views_of_one_name_stay_apart(folder):
    (folder / "cam1").mkdir()
    (folder / "cam2").mkdir()
    for i in range(2):
        shutil.copy(folder / "images" / f"00{i}.png", folder / f"cam{i + 1}" / "0000.png")
        edit_description(folder, lambda d, i=i: d["views"][i].update(image=f"cam{i + 1}/0000.png"))
    names = load(folder).names
    assert names == ("cam1_0000", "cam2_0000", "images_002")


def test_names_that_become_equal_stay_apart():
    assert names_from_paths(["a b.png", "a_b.png"]) == ("000_a_b", "001_a_b")
    assert names_from_paths(["x/a b.png", "y/a_b.png"]) == ("x_a_b", "y_a_b")
    assert names_from_paths(["a b.png", "c.png"]) == ("a_b", "c")
    assert names_from_paths(["..png", ".a.png", "a.png"]) == ("000_000", "001_a", "002_a")


def test_a_body_file_is_referred_to_by_a_relative_path(folder, tmp_path, monkeypatch):
    from humangs_jax.data import capture as module

    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "BODY.npz").write_bytes(b"")
    asked = []
    monkeypatch.setattr(
        module, "_load_model", lambda file, name, folder=None: asked.append(name) or tetrahedron()
    )
    a = {**arrays(), "body_file": tmp_path / "models" / "BODY.npz"}
    save_capture(tmp_path / "deep" / "er", capture_from_arrays(**a))
    assert np.load(tmp_path / "deep" / "er" / "body.npz")["body"].item() == "../../models/BODY.npz"
    capture = load_capture(tmp_path / "deep" / "er")
    assert asked == ["../../models/BODY.npz"]
    save_capture(tmp_path / "flat", capture)
    assert np.load(tmp_path / "flat" / "body.npz")["body"].item() == "../models/BODY.npz"


# What is wrong on disk: one line, file and field
# ---------------------------------------------------------------------


def edit_description(folder, change):
    edit_json(folder / "capture.json", change)


def view(i, **changes):
    return lambda f: edit_description(f, lambda d: d["views"][i].update(changes))


def drop(i, key):
    return lambda f: edit_description(f, lambda d: d["views"][i].pop(key))


def top(**changes):
    return lambda f: edit_description(f, lambda d: d.update(changes))


def parameters(**changes):
    return lambda f: edit_npz(f / "body.npz", **changes)


def with_nan(shape, index):
    array = np.zeros(shape)
    array[index] = np.nan
    return array


def png(name, shape, level=0.5):
    return lambda f: write_png(f / name, np.full(shape, level, np.float32))


MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()
NOT_FINITE = [[float("nan"), 0, 5], [0, 9, 5], [0, 0, 1]]

BAD = {
    "format": (top(format="colmap"), "capture.json: format", "colmap"),
    "background": (top(background="black"), "capture.json: background", "black"),
    "unknown top key": (top(unit="mm"), "capture.json: unit", "unknown"),
    "image missing": (
        lambda f: (f / "images/001.png").unlink(),
        "images/001.png",
        "no such image file",
    ),
    "image unreadable": (
        lambda f: (f / "images/001.png").write_bytes(b"?"),
        "images/001.png",
        "not a readable image",
    ),
    "image sizes differ": (
        lambda f: (png("images/001.png", (9, 9, 3))(f), png("masks/001.png", (9, 9))(f)),
        "images/001.png: size",
        "9 x 9",
    ),
    "mask size": (png("masks/001.png", (9, 9)), "masks/001.png: size", "9 x 9"),
    "mask of 0 and 1": (
        png("masks/001.png", (HEIGHT, WIDTH), 1 / 255),
        "masks/001.png: values",
        "255",
    ),
    "mask for some": (drop(1, "mask"), "capture.json: views[1].mask", "all or none"),
    "K transposed": (
        view(1, K=[[9, 0, 0], [0, 9, 0], [5, 5, 1]]),
        "capture.json: views[1]: K",
        "fx",
    ),
    "camera mirrored": (
        view(1, cam_from_world=MIRRORED),
        "capture.json: views[1]: cam_from_world",
        "mirrored",
    ),
    "frame too high": (view(1, frame=FRAMES), "capture.json: views[1].frame", "0 to 1"),
    "frame left out": (drop(1, "frame"), "capture.json: views[1].frame", "2 poses"),
    "unknown parameter": (parameters(scale=1.0), "body.npz: scale", "unknown"),
    "no rotations": (parameters(rotations=None), "body.npz: rotations", "missing"),
    "rotations shape": (
        parameters(rotations=np.zeros((FRAMES, JOINTS * 3))),
        "body.npz: rotations",
        "(frames, 5, 3)",
    ),
    "pose NaN": (
        parameters(rotations=with_nan((FRAMES, JOINTS, 3), (1, 2, 0))),
        "body.npz: rotations",
        "[1, 2, 0]",
    ),
    "translation count": (
        parameters(translations=np.zeros((5, 3))),
        "body.npz: translations",
        "(2, 3)",
    ),
    "betas too long": (parameters(betas=np.ones(4)), "body.npz: betas", "has 3 such directions"),
    "displacement in millimetres": (
        parameters(displacement=np.full((4, 3), -10.0)),
        "body.npz: displacement",
        "0.5 in magnitude",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_folder_is_one_line_with_file_and_field(folder, case):
    load(folder)  # valid before
    spoil, place, expected = BAD[case]
    spoil(folder)
    with pytest.raises(CaptureError) as caught:
        load(folder)
    message = str(caught.value)
    assert (
        "\n" not in message and message.startswith(f"{folder}/{place}") and expected in message
    ), message


def test_no_folder_and_no_model_file(folder, tmp_path):
    with pytest.raises(CaptureError, match=r"nowhere/capture.json: no such file"):
        load(tmp_path / "nowhere")
    edit_npz(folder / "body.npz", body=np.asarray("../SMPLX.npz"))
    with pytest.raises(CaptureError, match=r"body.npz: body: no model file at .*SMPLX.npz"):
        load_capture(folder)
    pytest.importorskip("humangs_jax.body.library")
    (folder.parent / "SMPLX.npz").write_bytes(b"not a model")
    with pytest.raises(CaptureError, match=r"body.npz: body: .*SMPLX.npz cannot be used as a body"):
        load_capture(folder)


BAD_ARRAYS = {
    "uint8 range": (
        dict(images=np.full((VIEWS, HEIGHT, WIDTH, 3), 200)),
        "images: expected values in [0, 1]",
    ),
    "mask shape": (dict(masks=np.zeros((VIEWS, WIDTH, HEIGHT))), "masks: expected shape"),
    "frames range": (dict(frames=[0, 1, 2]), "frames[2]: expected 0 to 1"),
    "frames missing": (dict(frames=None), "frames: expected a frame for each view"),
    "names": (dict(names=["a", "a", "b"]), "names: expected 3 different names"),
    "name with slash": (dict(names=["a", "../b", "c"]), "names: expected letters"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_arrays_are_one_line(case):
    changes, expected = BAD_ARRAYS[case]
    with pytest.raises(CaptureError) as caught:
        capture_from_arrays(**{**arrays(), **changes})
    assert str(caught.value).startswith(f"arrays: {expected}") and "\n" not in str(caught.value)


# The kind of the shape coefficients
# ----------------------------------------------------------------------------------

SMPLX_NAMES = (*(f"shape_{i}" for i in range(2)), "expression_0")
OWN_NAMES = ("sex", "age", "height")


def named(names):
    return dataclasses.replace(tetrahedron(), shape_names=names)


KINDS = {
    "fewer of SMPL-X's": (SMPLX_NAMES, [0.5], None, [0.5]),
    "SMPL-X's shape, more than the model has, but 0": (
        SMPLX_NAMES,
        [0.5, -1, 0, 0],
        None,
        [0.5, -1],
    ),
    "an expression by name": (SMPLX_NAMES, [2, 0.5], ["expression_0", "shape_1"], [0, 0.5, 2]),
    "all of the body's own": (OWN_NAMES, [1, 2, 3], None, [1, 2, 3]),
    "some of the body's own": (OWN_NAMES, [1, 2], ["height", "sex"], [2, 0, 1]),
    "names that it has not, but 0": (OWN_NAMES, [0, 2], ["shape_0", "age"], [0, 2]),
    "no shape at all": (OWN_NAMES, np.zeros(10), None, [0, 0, 0]),
}
"""Kinds of files: names of the body's directions, betas, names of betas, and betas in the body's
order.
"""
WRONG_KINDS = {
    "SMPL-X's shape on expressions": (
        SMPLX_NAMES,
        [1, 1, 1],
        None,
        "betas: 3 coefficients, but body 'tiny' has 2",
    ),
    "SMPL-X's shape for another body": (
        OWN_NAMES,
        [1, 1],
        None,
        "betas: 'shape_0' is no shape direction of body 'tiny'",
    ),
    "another body's": (SMPLX_NAMES, [1, 1], ["age", "sex"], "betas: 'age' is no shape direction"),
    "a name too few": (OWN_NAMES, [1, 1], ["age"], "shape_names: expected 2 different names"),
    "a name twice": (OWN_NAMES, [1, 1], ["age", "age"], "shape_names: expected 2 different names"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_betas_are_of_a_known_kind(kind, tmp_path):
    names, betas, their_names, expected = KINDS[kind]
    given = {**arrays(), "betas": betas, "shape_names": their_names, "body": named(names)}
    capture = capture_from_arrays(**given)
    np.testing.assert_array_equal(capture.betas, expected)
    save_capture(tmp_path / "me", capture)
    # the file names them: their order is free
    again = load_capture(tmp_path / "me", body=named(names[::-1]))
    full = np.pad(capture.betas, (0, len(names) - len(capture.betas)))
    np.testing.assert_array_equal(
        np.pad(again.betas, (0, len(names) - len(again.betas))), full[::-1]
    )


@pytest.mark.parametrize("kind", WRONG_KINDS)
def test_betas_of_another_kind_are_refused(kind):
    names, betas, their_names, expected = WRONG_KINDS[kind]
    with pytest.raises(CaptureError, match=expected):
        capture_from_arrays(
            **{**arrays(), "betas": betas, "shape_names": their_names, "body": named(names)}
        )


# Nothing is written when something is wrong
# --------------------------------------------------------------------------


def spoiled(**changes):
    return dataclasses.replace(capture_from_arrays(**arrays()), **changes)


def bad_captures():
    capture = capture_from_arrays(**arrays())
    half = capture.cameras.resized(5, 6)
    poses = jax.tree.map(lambda x: x * jnp.nan, capture.poses)
    return {
        "images": spoiled(images=capture.images * np.float32(255)),
        "masks": spoiled(masks=capture.masks * np.float32(np.nan)),
        "cameras: expected the image size": spoiled(cameras=half),
        "cameras.K: expected shape (3, 3, 3)": spoiled(cameras=capture.select([0, 1]).cameras),
        "poses.rotations": spoiled(poses=poses),
        "frames: expected 0 to": spoiled(frames=np.full(VIEWS, 7)),
        "names": spoiled(names=("a", "b", "c/d")),
        "betas": spoiled(betas=np.ones(7, np.float32)),
        "displacement": spoiled(displacement=np.ones((4, 3), np.float32)),
    }


def test_bad_captures_write_nothing(tmp_path):
    for field, bad in bad_captures().items():
        with pytest.raises(CaptureError) as caught:
            save_capture(tmp_path / "sub" / "me", bad)
        assert str(caught.value).startswith(f"capture: {field}")
    assert list(tmp_path.iterdir()) == []


def test_existing_folders(folder, tmp_path):
    capture = capture_from_arrays(**arrays(1))
    before = (folder / "capture.json").read_bytes()
    with pytest.raises(CaptureError, match="not empty"):
        save_capture(folder, capture)
    assert (folder / "capture.json").read_bytes() == before
    (folder / "old.txt").write_text("gone")
    save_capture(folder, capture, overwrite=True)
    assert_same(load(folder), capture, HALF_LEVEL)
    assert not (folder / "old.txt").exists()

    photos = tmp_path / "photos"
    photos.mkdir()
    save_capture(photos, capture)  # an empty folder is as good as none
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("dear")
    with pytest.raises(CaptureError, match="refusing to overwrite"):
        save_capture(other, capture, overwrite=True)
    with pytest.raises(CaptureError, match="is a file"):
        save_capture(other / "thesis.tex", capture, overwrite=True)
    assert (other / "thesis.tex").read_text() == "dear"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["me", "other", "photos"]


def test_a_failed_write_leaves_what_was_there(folder, monkeypatch):
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    monkeypatch.setattr(json, "dumps", lambda *a, **k: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save_capture(folder, capture_from_arrays(**arrays(1)), overwrite=True)
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    assert [p.name for p in folder.parent.iterdir()] == ["me"]


def test_whether_cameras_are_calibrated_is_written_and_read(tmp_path):
    capture = load_capture("demo_capture").resized(32)
    assert capture.calibrated
    estimated = dataclasses.replace(capture.select([1, 2]), calibrated=False)
    save_capture(tmp_path / "me", estimated)
    found = load_capture(tmp_path / "me")
    assert (
        not found.calibrated
        and not load_photos(tmp_path / "me").calibrated
        and not found.select([0]).calibrated
    )
    save_capture(tmp_path / "again", found.resized(16))
    assert not load_capture(tmp_path / "again").calibrated
    save_capture(tmp_path / "other", capture)
    assert "calibrated" not in read_json(tmp_path / "other" / "capture.json")
    edit_json(
        tmp_path / "me" / "capture.json", lambda description: description.update(calibrated="no")
    )
    with pytest.raises(
        CaptureError, match=r"capture\.json: calibrated: expected true or false, got 'no'"
    ):
        load_capture(tmp_path / "me")


MARKS = ({"calibrated": False}, False), ({"calibrated": True}, True), ({}, True), ([], True)


@pytest.mark.parametrize(("mark", "calibrated"), MARKS)
def test_of_an_older_capture_the_run_that_made_it_tells_whether_cameras_are_calibrated(
    mark, calibrated, tmp_path
):
    save_capture(tmp_path / "me", load_capture("demo_capture", views=[0]).resized(32))
    write_json(tmp_path / "me" / "start.json", mark)
    assert load_capture(tmp_path / "me").calibrated == calibrated


def test_photos_that_overshoot_by_a_rounding_are_used_and_written(tmp_path):
    """Resampling may leave 1.0004; it is read, used and written as 1."""
    given = arrays()
    given["images"] = np.where(given["images"] > 0.5, np.float32(1.0004), given["images"])
    capture = capture_from_arrays(**given)
    assert capture.images.max() == 1
    capture.check("capture")
    save_capture(tmp_path / "me", capture)
    assert load(tmp_path / "me").images.max() == 1
