import json

import jax.numpy as jnp
import numpy as np
import pytest
from exr_files import camera_of, read_exr

from humangs_jax.avatar.layers import ExrView, write_exr
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

HEIGHT, WIDTH = 13, 9  # odd and unequal: a transposed or strided write cannot pass


def matrices(i):
    K = intrinsics_from_fov(0.7, WIDTH, HEIGHT)
    camera = orbit(jnp.zeros(3), 3.0, jnp.arange(3) * 0.7, 0.1, K, WIDTH, HEIGHT)[i]
    return dict(K=np.asarray(camera.K), cam_from_world=np.asarray(camera.cam_from_world))


def make_view(i, **changes):
    random = np.random.default_rng(i)
    values = dict(
        rgba=random.random((HEIGHT, WIDTH, 4), np.float32),
        depth=random.random((HEIGHT, WIDTH), np.float32) * 1e4,
        **matrices(i),
        name=f"cam{i}",
        channels={
            f"position.{axis}": random.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
            for axis in "XYZ"
        },
        attributes={"humangs": json.dumps({"frame": i})},
    )
    return ExrView(**{**values, **changes})


def assert_same(a, b):
    assert a.name == b.name and dict(a.attributes) == dict(b.attributes)
    np.testing.assert_array_equal(a.rgba, b.rgba)
    np.testing.assert_array_equal(a.depth, b.depth)
    assert a.channels.keys() == b.channels.keys()
    for name in a.channels:
        np.testing.assert_array_equal(a.channels[name], b.channels[name])
    np.testing.assert_array_equal(camera_of(a).K, camera_of(b).K)
    np.testing.assert_array_equal(camera_of(a).cam_from_world, camera_of(b).cam_from_world)
    assert (camera_of(a).width, camera_of(a).height) == (camera_of(b).width, camera_of(b).height)


def test_several_views_round_trip_exactly(tmp_path):
    views = [make_view(i) for i in range(3)]
    views[0].rgba[0, :3, 0] = [np.inf, -0.0, 1e-42]  # float32 to the last bit, denormals included
    write_exr(tmp_path / "novel_views.exr", views)
    for a, b in zip(views, read_exr(tmp_path / "novel_views.exr"), strict=True):
        assert_same(a, b)
        assert b.rgba.dtype == b.depth.dtype == np.float32
    assert [p.name for p in tmp_path.iterdir()] == ["novel_views.exr"]


STRIDED = {
    "flipped rows": lambda x: x[::-1],
    "transposed": lambda x: np.swapaxes(x, 0, 1),
    "every other": lambda x: x[::2, ::2],
}


@pytest.mark.parametrize("how", STRIDED)
def test_strided_arrays_are_written_right(tmp_path, how):
    whole = make_view(0)
    change = STRIDED[how]
    view = make_view(
        0,
        rgba=change(whole.rgba),
        depth=change(whole.depth),
        channels={"n.X": change(whole.rgba)[..., 1]},
    )
    assert not view.depth.flags.c_contiguous
    write_exr(tmp_path / "a.exr", [view])
    (back,) = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back.rgba, view.rgba)
    np.testing.assert_array_equal(back.depth, view.depth)
    np.testing.assert_array_equal(back.channels["n.X"], view.rgba[..., 1])


def test_other_types_become_float32(tmp_path):
    view = make_view(
        0, rgba=make_view(0).rgba.astype(np.float64), depth=make_view(0).depth.astype(np.float16)
    )
    write_exr(tmp_path / "a.exr", [view])
    (back,) = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back.rgba, view.rgba.astype(np.float32))
    np.testing.assert_array_equal(back.depth, view.depth.astype(np.float32))


def test_half_precision_keeps_metres(tmp_path):
    """Colors, normals and parts have 16 bits; depths and positions are exact."""
    channels = dict(make_view(0).channels) | {
        "normal.X": make_view(0).rgba[..., 0],
        "part": np.full((HEIGHT, WIDTH), 55.0),
    }
    view = make_view(0, channels=channels)
    write_exr(tmp_path / "half.exr", [view], half=True)
    write_exr(tmp_path / "float.exr", [view])
    (back,) = read_exr(tmp_path / "half.exr")
    np.testing.assert_array_equal(back.depth, view.depth)
    np.testing.assert_array_equal(back.channels["position.X"], channels["position.X"])
    np.testing.assert_array_equal(back.rgba, view.rgba.astype(np.float16).astype(np.float32))
    np.testing.assert_array_equal(
        back.channels["normal.X"], channels["normal.X"].astype(np.float16).astype(np.float32)
    )
    np.testing.assert_array_equal(back.channels["part"], 55)
    assert (back.rgba != view.rgba).any()
    assert (tmp_path / "half.exr").stat().st_size < (tmp_path / "float.exr").stat().st_size


def test_a_missing_folder_is_made(tmp_path):
    write_exr(tmp_path / "new" / "a.exr", [make_view(0)])
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.exr"]
