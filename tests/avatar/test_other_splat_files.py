"""Formats of Gaussians that are read only: PlayCanvas' SOG, and checkpoints of gsplat."""

import numpy as np
import pytest
from small import random_gaussians
from sog_files import C0, write_sog

import humangs_jax as hg
from humangs_jax.io.reading import FileError
from humangs_jax.rendering.gaussians import covariances
from tests.network.torch_writer import tensors, write_checkpoint


def assert_like(found, expected, scale_step):
    reach = np.abs(np.asarray(expected.means)).max()
    np.testing.assert_allclose(found.means, expected.means, atol=1e-3 * reach)
    exact = np.asarray(covariances(expected))
    assert np.abs(np.asarray(covariances(found)) - exact).max() < scale_step * np.abs(exact).max()
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(found.colors, expected.colors, atol=0.01)
    assert (found.harmonics is None) == (expected.harmonics is None)
    if found.harmonics is not None:
        np.testing.assert_allclose(found.harmonics, expected.harmonics, atol=0.02)


@pytest.mark.parametrize("count", [0, 3, 8, 15])
@pytest.mark.parametrize("kind", ["WEBP", "PNG"])
def test_bundles_of_sog_are_read(count, kind, tmp_path):
    gaussians = random_gaussians(0, 70, count)
    folder = "scene/" if count == 8 else ""
    path = write_sog(tmp_path / "a.sog", gaussians, kind, folder=folder)
    assert_like(hg.load_gaussians(path), gaussians, 0.06)


def test_a_bundle_has_y_down(tmp_path):
    path = write_sog(tmp_path / "a.sog", random_gaussians(0, 70, 0))
    plain, upright = hg.load_gaussians(path), hg.load_gaussians(path, y_up=True)
    np.testing.assert_allclose(upright.means, plain.means * np.asarray([-1, -1, 1]), atol=1e-6)


def emptied(meta, pictures):
    pictures.pop("scales.webp")


WRONG = {
    "version 1": (lambda m, p: m.pop("version"), "meta.json: version None, expected 2: `npx"),
    "too many": (lambda m, p: m.update(count=72), "'means_l.webp': 70 pixels for 72 Gaussians"),
    "no file": (emptied, "'scales.webp': missing in the archive"),
    "degree 4": (
        lambda m, p: m["shN"].update(bands=4),
        "harmonics of degree 4: expected degree 1 to 3",
    ),
    "label": (
        lambda m, p: p["shN_labels.webp"].__setitem__((0, 0, 1), 9),
        r"label \d+ of 128 rows of harmonics",
    ),
    "place": (lambda m, p: p["quats.webp"].__setitem__((0, 0, 3), 9), "expected alpha from 252 on"),
    "another folder": (
        lambda m, p: m["quats"].update(files=["../../etc/passwd"]),
        "'../../etc/passwd': missing in the archive",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_bundles_are_one_line(case, tmp_path):
    change, problem = WRONG[case]
    path = write_sog(tmp_path / "a.sog", random_gaussians(0, 70, 3), change=change)
    with pytest.raises(FileError, match=problem) as caught:
        hg.load_gaussians(path)
    assert "\n" not in str(caught.value)


def checkpoint_of(g):
    """Returns the arrays that gsplat's simple_trainer.py saves."""
    o = np.asarray(g.opacities)
    parts = {
        "means": np.asarray(g.means),
        "scales": np.log(g.scales),
        "quats": 3 * np.asarray(g.quats),
        "opacities": np.log(o) - np.log1p(-o),
        "sh0": (np.asarray(g.colors)[:, None] - 0.5) / C0,
        "shN": np.zeros((len(o), 0, 3)),
    }
    if g.harmonics is not None:
        parts["shN"] = np.asarray(g.harmonics)
    return {name: np.asarray(part, np.float32) for name, part in parts.items()}


@pytest.mark.parametrize("count", [0, 3, 15])
def test_checkpoints_of_gsplat_are_read(count, tmp_path):
    gaussians = random_gaussians(0, 20, count)
    path = tmp_path / "ckpt_29999_rank0.pt"
    write_checkpoint(path, {"step": 29_999, "splats": tensors(checkpoint_of(gaussians))})
    found = hg.load_gaussians(path)
    np.testing.assert_allclose(found.means, gaussians.means, atol=1e-6)
    np.testing.assert_allclose(covariances(found), covariances(gaussians), atol=1e-5)
    np.testing.assert_allclose(found.opacities, gaussians.opacities, atol=1e-5)
    np.testing.assert_allclose(found.colors, gaussians.colors, atol=1e-6)
    if count:
        np.testing.assert_array_equal(found.harmonics, gaussians.harmonics)
    else:
        assert found.harmonics is None


def of_a_network(parts):
    del parts["sh0"]
    parts["features"] = np.zeros((20, 32), np.float32)


BROKEN = {
    "degree 4": (lambda p: p.update(shN=np.zeros((20, 24, 3), np.float32)), "got 24 of degree 4"),
    "a network": (of_a_network, "splats.sh0: trained with --app_opt, whose colors a network makes"),
    "shape": (
        lambda p: p.update(scales=np.zeros((20, 2), np.float32)),
        r"splats.scales: expected floats of shape \(20, 3\)",
    ),
    "integers": (
        lambda p: p.update(opacities=np.zeros(20, np.int64)),
        r"splats.opacities: expected floats of shape \(20,\), got int64",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_wrong_checkpoints_are_one_line(case, tmp_path):
    change, problem = BROKEN[case]
    parts = checkpoint_of(random_gaussians(0, 20, 3))
    change(parts)
    path = write_checkpoint(tmp_path / "a.pt", {"splats": tensors(parts)})
    with pytest.raises(FileError, match=problem):
        hg.load_gaussians(path)


def test_other_checkpoints_are_named_with_what_writes_a_ply(tmp_path):
    path = write_checkpoint(tmp_path / "step.ckpt", {"pipeline": {"step": 3}})
    with pytest.raises(FileError, match=r"no checkpoint of gsplat with 'splats'.*ns-export"):
        hg.load_gaussians(path)
