"""Written sets: the protocol's cameras and close ones, resuming, processes, splits."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from humangs_jax.body.library import load_body
from humangs_jax.data.capture import load_capture
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader, ViewSampling
from humangs_jax.io.atomic import replace_folder
from humangs_jax.motion import load_motion
from humangs_jax.synthetic import surroundings, writer
from humangs_jax.synthetic.subject import (
    GENERATOR_VERSION,
    SPLITS,
    make_subject,
    render_view,
    seeds_of,
    split_of,
)
from humangs_jax.synthetic.writer import find_people

DEMO = SPLITS["demo"]
SIZE, EIGHT_BITS = 32, 1.01 / 255
BODY = load_body()
LAYOUT = writer.Layout(SIZE, poses=2, views=3, close_views=1, held_out_views=1, novel_poses=1)


@pytest.fixture(scope="module")
def body():
    return BODY


@pytest.fixture(scope="module")
def folder(tmp_path_factory, body):
    root = tmp_path_factory.mktemp("set")
    writer.write_set(root, 1, LAYOUT, "demo", body=body, progress=False)
    return root


def fast(monkeypatch, made=None):
    """Makes folders hold only their seed: tested is which people are written."""

    def write_person(folder, seed, body, layout):
        if made is not None:
            made.append(seed)
        if seed % 10 == 7:
            raise ValueError("a hole at the hem")
        replace_folder(
            folder,
            lambda f: (f.mkdir(), (f / "capture.json").write_text(str(seed))),
            mark="capture.json",
        )

    monkeypatch.setattr(writer, "write_person", write_person)


def test_a_written_person_has_all_views_in_all_forms(folder, body):
    person, described = folder / f"{DEMO[0]:07d}", make_subject(DEMO[0], body)
    capture = load_capture(person, body=body)
    assert capture.names == ("0_00", "0_01", "0_02", "1_00", "1_01", "1_02", "0_c00", "1_c00")
    np.testing.assert_array_equal(capture.frames, [0, 0, 0, 1, 1, 1, 0, 1])
    np.testing.assert_array_equal(capture.betas, described.betas)
    image, mask = render_view(writer.sample_pose(described, 0), capture.cameras[1])
    assert (
        np.abs(image - capture.images[1]).max() < EIGHT_BITS
        and np.abs(mask - capture.masks[1]).max() < EIGHT_BITS
    )
    held_out = load_capture(person / "held_out", body=body)
    assert held_out.names == ("0_00", "1_00")
    np.testing.assert_array_equal(held_out.pose(0).rotations, capture.pose(0).rotations)
    # a novel pose
    assert np.abs(held_out.pose(1).rotations - capture.pose(1).rotations).max() > 0.05
    gap = np.linalg.norm(
        np.asarray(capture.cameras.center)[:3] - np.asarray(held_out.cameras.center)[0], axis=-1
    )
    assert gap.min() > 1e-3  # no held-out view is an input view
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["generator_version"] == GENERATOR_VERSION and manifest["split"] == "demo"
    assert manifest["subjects"] == [person.name] and manifest["settings"]["image_size"] == SIZE


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_close_cameras_are_close_and_outside(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(300, 3)) * [0.2, 0.5, 0.15] + [0.0, 0.9, 0.0]
    batch = surroundings.close_cameras(rng, vertices, surroundings.spread_azimuths(rng, 6), 64)
    center, radius = surroundings.bounding_sphere(vertices)
    eyes = np.asarray(batch.center)
    nearest = np.linalg.norm(eyes[:, None] - vertices[None], axis=-1).min(1)
    assert (nearest > surroundings.CLEARANCE - 1e-4).all()
    # the middle of the person is at most the spread away from what a camera looks at
    distance = np.linalg.norm(eyes - center, axis=1) / radius
    assert (distance < 1.7 + surroundings.CLOSE_SPREAD + 0.06).all() and distance.mean() < 1.7
    forward = np.asarray(batch.cam_from_world)[:, 2, :3]
    along = np.einsum("vk,vk->v", center - eyes, forward)
    off_axis = np.linalg.norm(center - eyes - along[:, None] * forward, axis=1)
    assert (off_axis < radius * surroundings.CLOSE_SPREAD + 1e-3).all()  # they look at the person
    assert (np.arcsin(-forward[:, 1]) > np.deg2rad(-5.1)).all() and (
        np.arcsin(-forward[:, 1]) < np.deg2rad(15.1)
    ).all()


def test_the_loader_shrinks_a_set_to_smaller_sizes(folder, body):
    def source(size):
        return CaptureSource(
            CaptureCache(find_people(folder, "demo"), body), ViewSampling(), size, size
        )

    small, large = (Loader(source(size), 1).batch_at(0).inputs for size in (SIZE // 2, SIZE))
    blocks = np.asarray(large.images).reshape(1, 4, SIZE // 2, 2, SIZE // 2, 2, 3)
    np.testing.assert_allclose(small.images, blocks.mean((3, 5)), atol=1e-6)
    with pytest.raises(ValueError, match="of the split 'demo', where 'train' was expected"):
        find_people(folder)


@pytest.mark.slow
def test_sequences_are_written_with_their_motion_and_a_scan(tmp_path, body):
    layout = writer.Layout(SIZE, poses=3, views=1, frames=20, scan_texture=128)
    (person,) = writer.write_set(tmp_path, 1, layout, "demo", 2, body=body, progress=False)
    capture, motion = load_capture(person, body=body), load_motion(person / "motion.npz")
    assert motion.rotations.shape == (20, 55, 3) and motion.fps == 30
    np.testing.assert_array_equal(capture.frames, [0, 1, 2])
    for frame, of_motion in enumerate((0, 10, 19)):  # evenly spaced
        np.testing.assert_array_equal(capture.pose(frame).rotations, motion.rotations[of_motion])
        np.testing.assert_array_equal(
            capture.pose(frame).translation, motion.translations[of_motion]
        )
    scan = json.loads((person / "scan" / "scan.json").read_text())
    np.testing.assert_allclose(scan["rotations"], capture.pose(0).rotations, atol=1e-6)
    assert {"scan.obj", "scan.glb", "material.mtl"} <= {
        path.name for path in (person / "scan").iterdir()
    }


def test_sets_are_resumed_only_with_the_same_settings(tmp_path, monkeypatch):
    made = []
    fast(monkeypatch, made)
    layout = writer.Layout(SIZE, views=2)

    def write(count, **changes):
        return writer.write_set(
            tmp_path,
            count,
            **{"layout": layout, "split": "demo", "body": BODY, "progress": False} | changes,
        )

    write(2)
    write(4)
    assert made == list(DEMO[:4])  # nobody twice
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["subjects"] == [f"{seed:07d}" for seed in DEMO[:4]]
    with pytest.raises(ValueError, match=r"image_size 32 -> 64\): choose another folder"):
        write(4, layout=writer.Layout(64, views=2))
    with pytest.raises(ValueError, match="split 'demo' -> 'train'"):
        write(4, split="train")
    with pytest.raises(ValueError, match=r"body '\w+' -> None"):
        write(4, body=None)
    monkeypatch.setattr("humangs_jax.synthetic.writer.GENERATOR_VERSION", GENERATOR_VERSION + 1)
    with pytest.raises(
        ValueError, match=f"generator_version {GENERATOR_VERSION} -> {GENERATOR_VERSION + 1}"
    ):
        write(4)


def test_people_that_cannot_be_made_are_named_and_the_others_written(tmp_path, monkeypatch):
    fast(monkeypatch)
    with pytest.raises(
        ValueError, match=f"1 of 9 people could not be made, the first of them {DEMO[7]}: a hole"
    ):
        writer.write_set(tmp_path, 9, writer.Layout(SIZE), "demo", body=BODY, progress=False)
    assert len(json.loads((tmp_path / "manifest.json").read_text())["subjects"]) == 8


@pytest.mark.slow
def test_processes_write_the_same_files(tmp_path):
    layout = writer.Layout(SIZE, views=1, close_views=1)
    alone, together = tmp_path / "alone", tmp_path / "together"
    writer.write_set(alone, 3, layout, "demo", progress=False)
    writer.write_set(together, 3, layout, "demo", workers=2, progress=False)

    def read(file):
        if file.suffix != ".npz":
            return file.read_bytes()
        return {name: x.tolist() for name, x in np.load(file).items()}

    # an npz tells when it was written
    contents = [
        {file.relative_to(root): read(file) for file in root.rglob("*.*")}
        for root in (alone, together)
    ]
    assert contents[0] == contents[1] and len(contents[0]) == 1 + 3 * (2 + 2 * 2)


@pytest.mark.parametrize(
    ("arguments", "layout", "first"),
    [
        (("--subjects", "3"), writer.Layout(512, 1, 60, 12), 0),
        (
            (
                "--size",
                "128",
                "--poses",
                "4",
                "--sequences",
                "--motion-frames",
                "30",
                "--first",
                "7",
            ),
            writer.Layout(128, 4, 60, 12, frames=30),
            7,
        ),
        (("--for-training",), writer.Layout(256, 2, 12), 0),
    ],
)
def test_the_command_line_asks_for_layouts(arguments, layout, first, tmp_path, monkeypatch):
    from humangs_jax import cli

    asked = []
    monkeypatch.setattr(writer, "write_set", lambda *a, **k: asked.append((a, k)) or [tmp_path])
    monkeypatch.setattr("sys.argv", ["humangs", "synth", "--out", str(tmp_path), *arguments])
    cli.main()
    ((_, _, *rest), keywords) = asked[0]
    assert rest == [layout, "train", first] and keywords["workers"] >= 1


# Nobody of the test split can be drawn in training: all ways to people go through seeds of a split
# ----------------------


@given(st.sampled_from(sorted(SPLITS)), st.integers(-5, 1_000_100), st.integers(-2, 1_000_100))
@settings(deadline=None, max_examples=80)
def test_seeds_of_a_split_are_of_that_split_or_refused(split, first, count):
    try:
        drawn = seeds_of(split, first, count)
    except ValueError as error:
        assert "reach beyond the split" in str(error)
        assert first < 0 or count < 1 or first + count > len(SPLITS[split])
    else:
        assert len(drawn) == count and {split_of(drawn[0]), split_of(drawn[-1])} == {split}


def test_the_splits_share_no_seed():
    """Splits are intervals: after sorting, overlaps are not in order."""
    ranges = sorted(SPLITS.values(), key=lambda r: r.start)
    assert all(a.stop <= b.start for a, b in itertools.pairwise(ranges))
    # seeds are words of keys
    assert all(r.step == 1 and 0 <= r.start < r.stop <= 2**32 for r in ranges)
    assert all(split_of(r[0]) == name == split_of(r[-1]) for name, r in SPLITS.items())
    with pytest.raises(ValueError, match="no range"):
        split_of(SPLITS["demo"].stop)


def test_nobody_is_written_beyond_the_end_of_a_split(tmp_path, monkeypatch):
    made = []
    fast(monkeypatch, made)
    with pytest.raises(ValueError, match="reach beyond the split"):
        writer.write_set(
            tmp_path, 3, LAYOUT, "test", len(SPLITS["test"]) - 2, body=BODY, progress=False
        )
    writer.write_set(
        tmp_path, 2, LAYOUT, "test", len(SPLITS["test"]) - 2, body=BODY, progress=False
    )
    assert [split_of(seed) for seed in made] == ["test", "test"]
