"""The loader is deterministic, continues where it stopped, and names what it leaves out."""

import logging
import re
import shutil
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_bytes, edit_json, edit_npz
from hypothesis import given, settings
from hypothesis import strategies as st
from small import small_body

from humangs_jax.data.capture import capture_from_arrays, load_capture, save_capture
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader, ViewSampling
from humangs_jax.data.loading.captures import find_captures, read_summary
from humangs_jax.data.loading.examples import (
    StoredSubject,
    nearest_view,
    sample_views,
    shrink,
    subject_order,
)
from humangs_jax.data.photos import read_view
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.images import write_png

FLOAT32 = 1e-6
SIZE, VIEWS, POSES = 16, 6, 2
LEVELS = 20  # view i of subject s is one flat grey, byte 20 s + i
SAMPLING = ViewSampling(input_counts=(2,), target_count=2)


BODY = small_body(8, 2, 4)


def write_subject(path, seed, views=VIEWS, masks=True):
    generator = np.random.default_rng(seed)
    azimuths = jnp.asarray(np.linspace(0, 2 * np.pi, views, endpoint=False), jnp.float32)
    K = intrinsics_from_fov(0.8, SIZE, SIZE)
    cameras = orbit(jnp.zeros(3), 3.0, azimuths, 0.1, K, SIZE, SIZE)
    capture = capture_from_arrays(
        np.broadcast_to(
            (LEVELS * seed + np.arange(views))[:, None, None, None] / 255, (views, SIZE, SIZE, 3)
        ),
        np.asarray(K),
        np.asarray(cameras.cam_from_world),
        generator.normal(size=(POSES, 2, 3)) * 0.1,
        generator.normal(size=(POSES, 3)) * 0.1,
        betas=[0.5, -0.5],
        shape_names=("wide", "tall"),
        masks=np.ones((views, SIZE, SIZE)) if masks else None,
        frames=np.arange(views) % POSES,
        background="white",
        body=BODY,
    )
    save_capture(path, capture)


def loader_of(cache, sampling, input_size, target_size, batch_size=1):
    return Loader(CaptureSource(cache, sampling, input_size, target_size), batch_size)


def stored_subject(path, body):
    """Returns a whole capture folder as the loader sees it."""
    return CaptureCache([path], body).some_views(0, range(len(read_summary(path, body).frames)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("subjects")
    for i in range(4):
        write_subject(root / f"s{i}", i)
    return root


@pytest.fixture
def source(folder):
    return loader_of(
        CaptureCache(find_captures(folder), BODY), SAMPLING, SIZE, SIZE // 2, batch_size=2
    )


def greys(views):
    """Returns (subject, view) of every image, which its grey level tells."""
    return [divmod(round(255 * float(image.mean())), LEVELS) for image in views.images]


def same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def fake_subject(views, poses, seed=0):
    azimuths = np.random.default_rng(seed).uniform(-np.pi, np.pi, views)
    empty = np.zeros((0,))
    return StoredSubject(
        empty, empty, empty, empty, np.arange(views) % poses, azimuths, empty, empty, empty
    )


def test_batches_are_a_function_of_seed_and_step(folder, source):
    again = loader_of(
        CaptureCache(find_captures(folder), BODY), SAMPLING, SIZE, SIZE // 2, batch_size=2
    )
    again.batch_at(9)  # whatever was asked for before must not matter
    assert same(source.batch_at(5), again.batch_at(5))
    assert not same(source.batch_at(5), source.batch_at(6))


def test_a_pass_shows_every_subject_once(source):
    shown = [greys(source.source.example(0, i, 2).inputs)[0][0] for i in range(8)]
    assert sorted(shown[:4]) == sorted(shown[4:]) == [0, 1, 2, 3]
    assert len({tuple(subject_order(0, epoch, 20)) for epoch in range(5)}) == 5


def test_views_carry_their_own_pose_camera_and_size(folder, source):
    stored = stored_subject(folder / "s3", BODY)
    for index in range(4):
        example = source.source.example(0, index, 2)
        assert example.inputs.images.shape == (2, SIZE, SIZE, 3)
        assert example.targets.images.shape == (2, SIZE // 2, SIZE // 2, 3)
        assert example.targets.cameras.width == SIZE // 2
        for views, scale in ((example.inputs, 1.0), (example.targets, 0.5)):
            for i, (subject, view) in enumerate(greys(views)):
                if subject == 3:
                    np.testing.assert_array_equal(
                        views.rotations[i], stored.rotations[view % POSES]
                    )
                    np.testing.assert_array_equal(
                        views.cameras.cam_from_world[i], stored.cam_from_world[view]
                    )
                    np.testing.assert_allclose(
                        views.cameras.K[i, :2], scale * stored.K[view, :2], rtol=FLOAT32
                    )
        np.testing.assert_allclose(example.inputs.betas, [0.5, -0.5, 0, 0])


@given(st.integers(0, 1000), st.integers(1, 6), st.integers(1, 3))
@settings(deadline=None, max_examples=50)
def test_inputs_and_targets_are_disjoint_and_of_the_subject(seed, input_count, poses):
    sampling = ViewSampling(input_counts=(input_count,), target_count=3)
    subject = fake_subject(12, poses, seed)
    inputs, targets = sample_views(np.random.default_rng(seed), subject, input_count, sampling)
    assert len(set(inputs)) == input_count and len(set(targets)) == 3
    assert not set(inputs) & set(targets)
    assert set(inputs) | set(targets) <= set(range(12))


def test_inputs_of_one_pose_stand_around_the_subject():
    azimuths = np.linspace(-np.pi, np.pi, 24, endpoint=False)
    subject = fake_subject(24, 2)._replace(azimuths=azimuths)
    sampling = ViewSampling(jitter=0.0, scattered_share=0.0, mixed_pose_share=0.0)
    for seed in range(20):
        inputs, _ = sample_views(np.random.default_rng(seed), subject, 4, sampling)
        assert len(set(subject.frames[inputs])) == 1
        gaps = np.diff(np.sort(azimuths[inputs]))
        # cameras of a pose stand pi / 6 apart
        np.testing.assert_allclose(gaps, np.pi / 2, atol=0.3)


def test_mixed_poses_are_mixed():
    sampling = ViewSampling(mixed_pose_share=1.0)
    frames = [
        len(set(s.frames[sample_views(np.random.default_rng(i), s, 4, sampling)[0]]))
        for i, s in enumerate([fake_subject(24, 2)] * 20)
    ]
    assert max(frames) == 2


def test_nearest_view_wraps_around():
    subject = fake_subject(3, 1)._replace(azimuths=np.asarray([-3.1, 0.0, 2.0]))
    assert nearest_view(subject, 3.1, np.ones(3, bool)) == 0
    assert nearest_view(subject, 3.1, np.asarray([False, True, True])) == 2


def test_shrinking_averages_boxes():
    images = np.random.default_rng(0).integers(0, 256, (2, 8, 8, 3)).astype(np.uint8)
    np.testing.assert_allclose(
        shrink(images, 2)[1, 0, 1], images[1, :4, 4:].mean(axis=(0, 1)) / 255, rtol=1e-5
    )
    np.testing.assert_allclose(
        shrink(images, 3)[..., 1].mean(axis=(1, 2)),
        images[..., 1].mean(axis=(1, 2)) / 255,
        rtol=1e-5,
    )
    np.testing.assert_array_equal(shrink(images, 8), images.astype(np.float32) / np.float32(255))
    assert shrink(images[:0], 2).shape == (0, 2, 2, 3)
    for wrong, size in ((images, 9), (images[:, :6], 3)):
        with pytest.raises(
            ValueError, match=f"8 x {wrong.shape[1]} cannot be averaged to {size} x {size}"
        ):
            shrink(wrong, size)


def test_a_broken_folder_is_skipped_counted_and_named(folder, tmp_path, caplog):
    write_subject(tmp_path / "few", 5, views=3)
    write_subject(tmp_path / "nomask", 6, masks=False)
    write_subject(tmp_path / "torn", 7)
    next((tmp_path / "torn").glob("images/*")).write_bytes(b"no image")
    folders = (*find_captures(tmp_path), folder / "s1")
    source = loader_of(CaptureCache(folders, BODY), SAMPLING, SIZE, SIZE)
    with caplog.at_level(logging.WARNING):
        for index in range(8):
            assert greys(source.source.example(0, index, 2).inputs)[0][0] == 1
    assert {path.name for path in source.source.cache.broken} == {"few", "nomask", "torn"}
    assert "3 views, but inputs and targets need 4" in source.source.cache.broken[tmp_path / "few"]
    assert "no masks" in source.source.cache.broken[tmp_path / "nomask"]
    assert len(caplog.records) == 3
    assert all(
        any(name in r.getMessage() for r in caplog.records) for name in ("few", "nomask", "torn")
    )


def test_captures_of_another_body_are_left_out(tmp_path):
    """Their joints and coefficients have the same shapes: they would be posed as the right ones."""
    write_subject(tmp_path / "ours", 1)
    write_subject(tmp_path / "smplx", 2)
    edit_npz(tmp_path / "smplx" / "body.npz", body="../SMPLX_NEUTRAL.npz")
    source = loader_of(CaptureCache(find_captures(tmp_path), BODY), SAMPLING, SIZE, SIZE)
    assert [greys(source.source.example(0, index, 2).inputs)[0][0] for index in range(4)] == [1] * 4
    assert (
        "body: '../SMPLX_NEUTRAL.npz', but all captures of a run"
        in source.source.cache.broken[tmp_path / "smplx"]
    )
    others = CaptureCache(find_captures(tmp_path), BODY, body_file=tmp_path / "SMPLX_NEUTRAL.npz")
    assert others.summary(1) is not None and others.summary(0) is None


def test_nothing_but_broken_folders_is_an_error_of_the_loop(tmp_path):
    write_subject(tmp_path / "few", 5, views=3)
    source = loader_of(CaptureCache(find_captures(tmp_path), BODY), SAMPLING, SIZE, SIZE)
    with pytest.raises(ValueError, match=r"none of the 1 capture folders can be used.*need 4"):
        next(source.batches(0, 1))


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0, 20 * SIZE * SIZE * 4, 1 << 30])
def test_only_drawn_views_are_read_and_the_memory_limit_costs_time_alone(
    folder, monkeypatch, limit
):
    read = []

    def reading(*arguments):
        # threads of tests before this one may still be at it
        if threading.current_thread() is threading.main_thread():
            read.append(arguments)
        return read_view(*arguments)

    monkeypatch.setattr("humangs_jax.data.photos.read_view", reading)

    def examples(cache):
        return [
            loader_of(cache, SAMPLING, SIZE, SIZE // 2, batch_size=2).batch_at(s) for s in range(6)
        ]

    cache = CaptureCache(find_captures(folder), BODY, limit_bytes=limit)
    first = examples(cache)
    counts = [len(read)]
    again = examples(cache)
    counts.append(len(read) - counts[0])
    drawn = 6 * 2 * 4  # 2 views shown and 2 asked for
    distinct = len({(path, view["image"]) for path, view, _ in read})
    if limit == 0:
        assert counts == [drawn, drawn]
    elif limit == 1 << 30:
        assert counts == [distinct, 0]
    else:  # of 20 views there is room
        assert counts[1] < counts[0] <= drawn and counts[1] > 0
    stored = [stored_subject(path, BODY) for path in find_captures(folder)]
    for batch, same_batch in zip(first, again, strict=True):
        assert same(batch, same_batch)
        for (subject, view), image in zip(
            [
                g
                for row in range(2)
                for g in greys(jax.tree.map(lambda x, row=row: x[row], batch.inputs))
            ],
            np.asarray(batch.inputs.images).reshape(-1, SIZE, SIZE, 3),
            strict=True,
        ):
            np.testing.assert_array_equal(image, stored[subject].images[view] / np.float32(255))


def test_an_image_that_only_decoding_finds_broken_costs_its_examples_alone(
    folder, tmp_path, monkeypatch
):
    """The order of calls does not matter: a resumed run does not know what an earlier one found."""
    write_subject(tmp_path / "s2", 2)
    folders = (folder / "s0", tmp_path / "s2")

    def reading(path, *arguments):
        if path == tmp_path / "s2" and arguments[0]["image"].endswith("003.png"):
            raise OSError("003.png: bad bytes with a right checksum")
        return read_view(path, *arguments)

    monkeypatch.setattr("humangs_jax.data.photos.read_view", reading)
    new = lambda: loader_of(CaptureCache(folders, BODY), SAMPLING, SIZE, SIZE)
    whole = new()
    examples = [whole.source.example(0, i, 2) for i in range(40)]
    subjects = [greys(example.inputs)[0][0] for example in examples]
    assert 40 > subjects.count(0) > 20 and subjects.count(2) > 0
    seen = {
        view
        for example in examples
        for views in (example.inputs, example.targets)
        for view in greys(views)
    }
    assert (2, 3) not in seen and (2, 4) in seen
    assert list(whole.source.cache.broken) == [tmp_path / "s2"]
    assert all(same(examples[i], new().source.example(0, i, 2)) for i in range(0, 40, 3))


def test_views_whose_mask_is_empty_are_targets_but_no_inputs(folder, tmp_path):
    write_subject(tmp_path / "s2", 2)
    write_png(tmp_path / "s2/masks/003.png", np.zeros((SIZE, SIZE)))
    source = loader_of(
        CaptureCache((folder / "s0", tmp_path / "s2"), BODY), SAMPLING, SIZE, SIZE
    ).source
    examples = [source.example(0, i, 2) for i in range(60)]
    assert (2, 3) not in {view for example in examples for view in greys(example.inputs)}
    assert (2, 3) in {view for example in examples for view in greys(example.targets)}
    assert (
        source.broken[str(tmp_path / "s2")]
        == "views[3]: mask: empty: no photo to reconstruct the person from"
    )


def flip(data):
    return data[:-20] + bytes([data[-20] ^ 1]) + data[-19:]


def write_small(path):
    write_png(
        path, np.zeros((SIZE // 2, SIZE, 3)[: 2 + (path.parent.name == "images")], np.float32)
    )


BROKEN = {
    "002.png: not a readable image": lambda root: edit_bytes(root / "images" / "002.png", flip),
    "005.png: no such image file": lambda root: (root / "images" / "005.png").unlink(),
    "003.png: size: (16, 8), but the first": lambda root: write_small(root / "images" / "003.png"),
    "000.png: size: (16, 8), but its image": lambda root: write_small(root / "masks" / "000.png"),
    "views[4].frame: expected 0 to 1": lambda root: edit_json(
        root / "capture.json", lambda d: d["views"][4].update(frame=2)
    ),
    "no such file": lambda root: (root / "body.npz").unlink(),
}


@pytest.mark.parametrize("problem", BROKEN)
def test_a_summary_finds_every_fault_without_decoding(problem, folder, tmp_path, monkeypatch):
    monkeypatch.setattr("humangs_jax.data.photos.read_view", None)
    whole = read_summary(folder / "s1", BODY)
    assert whole.images.shape == (0, SIZE, SIZE, 3) and whole.frames.tolist() == [0, 1, 0, 1, 0, 1]
    root = shutil.copytree(folder / "s1", tmp_path / "s1")
    BROKEN[problem](root)
    with pytest.raises(ValueError, match=re.escape(problem)):
        read_summary(root, BODY)


def test_some_views_of_a_capture(folder):
    whole, some = (load_capture(folder / "s1", body=BODY, views=v) for v in (None, [4, 1]))
    np.testing.assert_array_equal(some.images, whole.images[[4, 1]])
    np.testing.assert_array_equal(some.masks, whole.masks[[4, 1]])
    np.testing.assert_array_equal(
        some.cameras.cam_from_world, whole.cameras.cam_from_world[jnp.asarray([4, 1])]
    )
    assert some.names == ("004", "001") and some.frames.tolist() == [0, 1]
    np.testing.assert_array_equal(some.poses.rotations, whole.poses.rotations)


def test_a_folder_without_captures_is_named(tmp_path):
    with pytest.raises(ValueError, match="no capture folder here"):
        find_captures(tmp_path)


# The release's rule
# --------------------------------------------------------------------------------------------------


WINDOW = ViewSampling(input_counts=(4,), target_count=4, rule="window")


def test_the_window_rule_is_the_release_s():
    """Of 60 views the ends of a window come first, 25 to 59 views apart, then different views
    inside it.
    """
    distances, subject = set(), fake_subject(60, 1)
    for seed in range(3000):
        inputs, targets = sample_views(np.random.default_rng(seed), subject, 4, WINDOW)
        first, last, *inside = inputs + targets
        distances.add(last - first)
        assert len(inputs) == len(targets) == 4 and len({*inputs, *targets}) == 8
        assert all(first < view < last for view in inside) and first >= 0 and last < 60
    assert distances == set(range(25, 60))


@pytest.mark.parametrize("count", [8, 12, 120])
def test_the_window_rule_scales_with_the_number_of_views(count):
    for seed in range(200):
        inputs, targets = sample_views(
            np.random.default_rng(seed), fake_subject(count, 1), 4, WINDOW
        )
        assert len({*inputs, *targets}) == 8 and min(inputs) >= 0 and max(inputs) < count
        assert (
            max(7, round(25 * count / 60))
            <= inputs[1] - inputs[0]
            <= max(7, round(59 * count / 60))
        )
    with pytest.raises(ValueError, match="7 views, but inputs and targets need 8"):
        sample_views(np.random.default_rng(0), fake_subject(7, 1), 4, WINDOW)
