"""The benchmark script on a small scene whose expected image is the reference's, in float64."""

import contextlib
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import splatting, splatting_tradeoff
from experiments.harness import call
from experiments.scenes import gradient_errors
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.reference import render_reference

SIZE, COUNT = 40, 60
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
FLOAT32_PSNR = 80.0  # roundings of 1e-7; a decision at 1/255 that falls the other way on one pixel costs 1e-4
FLOAT32_GRADIENT = 1e-3
STORED_AS_FLOAT32 = 1e-6

YARDSTICK = """
import time
from typing import NamedTuple, Any
class Scene(NamedTuple):
    kind: str; size: int; means: Any; quats: Any; scales: Any; opacities: Any; colors: Any; K: Any; cam_from_world: Any
class Yardstick:
    def __init__(self, scene):
        assert scene.means.shape[1:] == (3,) and scene.K.shape == (3, 3) and scene.cam_from_world.shape == (4, 4)
        self.shape = (scene.size, scene.size, 3)
    def forward(self):
        time.sleep(0.01)
    def forward_backward(self, target):
        assert target.shape == self.shape and target.dtype == "float32"
        time.sleep(0.02)
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with scene.npz, reference.npz and a yardstick that only sleeps."""
    folder = tmp_path_factory.mktemp("benchmark")
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(COUNT, 4))
    arrays = {
        "means": rng.uniform(-0.4, 0.4, (COUNT, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": np.exp(rng.uniform(-4, -2, (COUNT, 3))),
        "opacities": rng.uniform(0.1, 0.95, COUNT),
        "colors": rng.uniform(size=(COUNT, 3)),
        "cam_from_world": np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1.0]]),
        f"K_{SIZE}": np.array([[120.0, 0, SIZE / 2], [0, 120, SIZE / 2], [0, 0, 1]]),
    }
    arrays = {name: array.astype(np.float32) for name, array in arrays.items()}
    np.savez(folder / "scene.npz", **arrays)
    target = np.random.default_rng(7).random((SIZE, SIZE, 3)).astype(np.float32)
    with jax.enable_x64(True):
        double = {name: jnp.asarray(array, jnp.float64) for name, array in arrays.items()}
        camera = Camera(double[f"K_{SIZE}"], double["cam_from_world"], SIZE, SIZE)
        gaussians = Gaussians(*(double[name] for name in PARAMETERS))

        def loss(gaussians):
            image = render_reference(gaussians, camera, background=jnp.zeros(3)).rgb
            return jnp.mean((image - target) ** 2), image

        gradients, image = jax.jit(jax.grad(loss, has_aux=True))(gaussians)
        reference = {f"grad_{name}": np.asarray(getattr(gradients, name), np.float32) for name in PARAMETERS}
        np.savez(folder / "reference.npz", image=np.asarray(image, np.float32), target_seed=7, **reference)
    (folder / "yardstick.py").write_text(YARDSTICK)
    return folder


def run(folder, *options):
    out = folder / "out.json"
    given = ["--scene", folder / "scene.npz", "--size", SIZE, "--json", out, *options]
    with restored_options():
        assert call(splatting.splatting_benchmark, [str(option) for option in given]) == 0
    return json.loads(out.read_text())["numbers"]["splatting_benchmark"]


@contextlib.contextmanager
def restored_options():
    """The experiment sets options of the process."""
    names = ("jax_enable_x64", "jax_enable_compilation_cache")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.slow
def test_reports_times_beside_the_yardstick_and_errors(files, capsys):
    result = run(files, "--reference", files / "reference.npz", "--yardstick", files, "--repeats", "2")
    times = result["times"]
    assert set(times) == {f"{who}{name}" for who in ("", "yardstick ") for name in ("forward", "forward_backward")}
    assert all(pair["ms"] > 0 for pair in times.values())
    assert 10 < times["yardstick forward"]["ms"] < 20 < times["yardstick forward_backward"]["ms"]
    assert times["yardstick forward"]["cpu_ms"] < 5  # it sleeps
    assert all(0 < fact["compile_s"] < 60 for fact in result["facts"].values()) and result["peak_rss_mb"] > 100
    assert FLOAT32_PSNR < result["psnr"] < 200
    assert 0 <= result["fraction_above_2e-4"] < 0.01 and 0 < result["max_abs_error"] < 0.02
    for measure in ("relative_l2", "cosine", "signed_bias", "gain"):
        assert set(result[f"gradient_{measure}"]) == set(PARAMETERS)
    assert all(0 < error < FLOAT32_GRADIENT for error in result["gradient_relative_l2"].values())
    assert all(0.99999 < cosine <= 1 + 1e-9 for cosine in result["gradient_cosine"].values())
    assert all(abs(bias) < FLOAT32_GRADIENT for bias in result["gradient_signed_bias"].values())
    assert result["config"]["tile_size"] == 8 and result["gaussians"] == COUNT
    printed, (ours, theirs) = capsys.readouterr().out, (times["forward"], times["yardstick forward"])
    assert f"| {result['psnr']:.1f} |" in printed and f"| {result['scene']} {SIZE}" in printed
    assert f"| {ours['ms'] / theirs['ms']:.2f}, " in printed


@pytest.mark.slow
def test_draws_in_float64_without_a_yardstick(files):
    result = run(files, "--reference", files / "reference.npz", "--float64", "--repeats", "0")
    assert result["times"] == {} and result["dtype"] == "float64"
    assert result["max_abs_error"] < STORED_AS_FLOAT32
    assert all(error < STORED_AS_FLOAT32 for error in result["gradient_relative_l2"].values())


def test_without_a_reference_errors_are_null():
    class Drawn:
        rgb = np.zeros((4, 4, 3))

    found = splatting.errors({"forward": Drawn}, None)
    assert found["psnr"] is None and found["gradient_cosine"] == dict.fromkeys(PARAMETERS)


def test_errors_of_gradients_see_bias_and_gain():
    exact = np.random.default_rng(0).normal(size=1000)
    found = gradient_errors(0.9 * exact + 0.01, exact)
    mean = np.abs(exact).mean()
    assert found["signed_bias"] == pytest.approx((0.01 - 0.1 * exact.mean()) / mean)
    assert found["gain"] == pytest.approx(-0.1, abs=0.01)
    assert found["relative_l2"] == pytest.approx(math.hypot(0.1, 0.01), rel=0.05)
    assert gradient_errors(-exact, exact)["cosine"] == pytest.approx(-1)


def test_pareto_front_holds_what_nothing_beats():
    rows = [{"time": t, "psnr": p} for t, p in ((1, 100), (0.5, 40), (0.6, 39), (0.8, 60), (0.8, 55), (1.2, 99))]
    assert [(r["time"], r["psnr"]) for r in splatting_tradeoff.pareto(rows, "time")] == [(0.5, 40), (0.8, 60), (1, 100)]
    assert [splatting_tradeoff.short(v) for v in (1 / 64, 0.05, 1e-3, 8, 2.5)] == ["1/64", "0.05", "0.001", "8", "2.5"]


def test_slope_of_linear_growth_is_one():
    rows = [{"size": n, "forward_cpu_ms": 3.0 * n} for n in (1, 2, 8)]
    assert splatting.slope(rows, "forward") == pytest.approx(1)
