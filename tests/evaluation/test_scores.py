"""Scores against scikit-image, torchmetrics' definition in numpy, and crops made by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evaluation_cases import capture_from, ellipse, random_lpips, random_views
from rounding import bound
from skimage.metrics import structural_similarity

from humangs_jax.evaluation import scores
from humangs_jax.evaluation.scores import PROTOCOLS, CentredWindow
from humangs_jax.losses.losses import (
    GAUSSIAN,
    TORCHMETRICS,
    UNIFORM,
    boundary_band,
    mean_similarity,
    similarity_map,
)
from humangs_jax.losses.perceptual import lpips

DECIBELS = 1e-4
"""Largest error of a PSNR: 10 / ln 10 times 1e-5, the relative error of the mean of squares."""


def torchmetrics_ssim(x, y):
    """Returns StructuralSimilarityIndexMeasure(data_range=1.0) of torchmetrics.

    Moments have a 2-D kernel and reflected padding, which is cut off again.
    """
    at = np.arange(11) - 5.0
    kernel = np.exp(-0.5 * (at / 1.5) ** 2)
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2

    def moment(a):
        return np.stack(
            [
                np.einsum(
                    "yxij,ij->yx",
                    np.lib.stride_tricks.sliding_window_view(
                        np.pad(a[..., c], 5, mode="reflect"), (11, 11)
                    ),
                    kernel,
                )
                for c in range(3)
            ]
        )

    mean_x, mean_y = moment(x), moment(y)
    variance_x = np.maximum(moment(x * x) - mean_x**2, 0)
    variance_y = np.maximum(moment(y * y) - mean_y**2, 0)
    covariance = moment(x * y) - mean_x * mean_y
    values = (2 * mean_x * mean_y + 0.01**2) * (2 * covariance + 0.03**2)
    values /= (mean_x**2 + mean_y**2 + 0.01**2) * (variance_x + variance_y + 0.03**2)
    return values[:, 5:-5, 5:-5].mean()


SSIM = {
    GAUSSIAN: lambda x, y: structural_similarity(
        x, y, win_size=11, gaussian_weights=True, data_range=1, channel_axis=-1
    ),
    UNIFORM: lambda x, y: structural_similarity(x, y, data_range=1, channel_axis=-1),
    TORCHMETRICS: torchmetrics_ssim,
}


@pytest.mark.parametrize("window", SSIM, ids=["gaussian", "uniform", "torchmetrics"])
def test_ssim_of_a_padded_image_is_that_of_the_image(window):
    """1e-6 is required; float64 reaches 1e-12."""
    predicted, truth, _ = (x[0].astype(np.float64) for x in random_views(3, 1, 48, 40))
    expected = SSIM[window](predicted, truth)
    with jax.enable_x64(True):
        pad = lambda x: jnp.asarray(np.pad(x, [(0, 16), (0, 24), (0, 0)], constant_values=0.3))
        size = jnp.asarray([48, 40])
        similarity = jax.jit(
            lambda x, y: mean_similarity(similarity_map(x, y, window), size - window.size + 1)
        )
        assert abs(float(similarity(pad(predicted), pad(truth))) - expected) < 1e-12
    row = scores.pair_scores(
        jnp.asarray(predicted), jnp.asarray(truth), jnp.asarray([48, 40]), window
    )
    assert abs(float(row["ssim"]) - expected) < bound(1e-6)


def psnr(x, y, weights=None):
    errors = np.square(x.astype(np.float64) - y).mean(axis=-1)
    return -10 * np.log10(np.average(errors, weights=weights))


@pytest.fixture(scope="module")
def networks():
    return {net: random_lpips(net) for net in ("alex", "squeeze")}


@pytest.mark.slow
@pytest.mark.parametrize("net", ["alex", "squeeze"])
def test_lpips_of_a_padded_image_is_that_of_the_image(networks, net):
    (predicted, truth, _), size = (x[0] for x in random_views(5, 1, 64, 64)), (61, 50)
    pair = [x[: size[0], : size[1]] for x in (predicted, truth)]
    padded = [
        np.pad(x, [(0, 64 - size[0]), (0, 64 - size[1]), (0, 0)], constant_values=0.7) for x in pair
    ]
    found = scores._lpips(networks[net], *padded, jnp.asarray(size))
    np.testing.assert_allclose(found, jax.jit(lpips)(networks[net], *pair), rtol=1e-5)


@pytest.mark.slow
def test_backgrounds_masks_and_crops_of_every_protocol():
    """The expected PSNR and SSIM are of images composed and cropped by hand."""
    predicted, truth, masks = (x[0] for x in random_views(1, 1, 128, 128))
    alpha = np.roll(masks, 2, axis=1)
    capture = capture_from(truth[None], masks[None])
    inside = np.nonzero(masks > 0.5)
    box = tuple(slice(axis.min(), axis.max() + 1) for axis in inside)
    weight = masks[..., None]
    for name, protocol in PROTOCOLS.items():
        protocol = dataclasses.replace(protocol, lpips=("alex",))
        # the window of a smaller image: programs are those of the other protocols
        if name == "ghg":
            protocol = dataclasses.replace(protocol, crop=CentredWindow(110, 70, 128))
        white = protocol.background != "black"
        ours = predicted if white else np.clip(predicted - (1 - weight), 0, 1)
        (row,) = scores.score_views(ours[None], capture, protocol, alpha[None], {})
        true = truth if white else np.clip(truth - (1 - weight), 0, 1)
        if name in ("giga", "lhm++"):
            ours = ours * weight + white * (1 - weight)
        pair = (ours, true)
        assert row["psnr_fg"] == pytest.approx(psnr(*pair, masks), abs=DECIBELS)
        assert row["psnr_boundary"] == pytest.approx(
            psnr(*pair, boundary_band(masks)), abs=DECIBELS
        )
        if name == "ghg":
            pair = tuple(protocol.crop.cut(x, masks, 0.0) for x in pair)
        elif name == "giga":
            pair = tuple(x[box] for x in pair)
        assert row["psnr"] == pytest.approx(psnr(*pair), abs=DECIBELS), name
        assert abs(row["ssim"] - SSIM[protocol.ssim](*(x.astype(float) for x in pair))) < bound(
            1e-6
        ), name
        union = (alpha > 0.5) | (masks > 0.5)
        assert row["iou"] == pytest.approx(((alpha > 0.5) & (masks > 0.5)).sum() / union.sum())
        assert row["foreground"] == pytest.approx(masks.mean()) and row["lpips_alex"] is None


@pytest.mark.parametrize("name", ["giga", "lhm++"])
def test_soft_masks_count_once(name, monkeypatch):
    """A person of one color, cut out by the true mask, equals the photo on that background."""
    seen = []
    monkeypatch.setattr(scores, "pair_scores", lambda *pair: seen.append(pair) or {})
    monkeypatch.setattr(scores, "person_scores", lambda *_: ({}, np.zeros((1, 1), bool)))
    color, mask = np.asarray([0.2, 0.5, 0.9], np.float32), ellipse(40, 32)
    photo = color * mask[..., None] + 1 - mask[..., None]
    list(
        scores.score_views(
            (0 * photo + color)[None], capture_from(photo[None], mask[None]), PROTOCOLS[name]
        )
    )
    np.testing.assert_allclose(seen[0][0], seen[0][1], atol=1e-6)


def test_lpips_sees_its_own_crop(monkeypatch):
    predicted, truth, masks = random_views(2, 1)
    protocol = dataclasses.replace(PROTOCOLS["animatable-gaussians"], lpips=("squeeze",))
    seen = []
    monkeypatch.setattr(scores, "_lpips", lambda _, *pair: seen.append(pair) or 0.5)
    (row,) = scores.score_views(
        predicted,
        capture_from(truth, masks),
        protocol,
        networks={"squeeze": random_lpips("squeeze")},
    )
    for image, shown in zip((predicted, truth), seen[0], strict=False):
        np.testing.assert_array_equal(
            shown[:512, :512], protocol.lpips_crop.cut(image[0], masks[0], 1.0)
        )
    assert row["lpips_squeeze"] == 0.5 and seen[0][2].tolist() == [512, 512]


@pytest.mark.slow
def test_patches_are_those_that_are_more_than_half_person(networks):
    """Patches of 64 x 64 lie 32 apart, and each is scored as an image."""
    predicted, truth, masks = (x[0] for x in random_views(4, 1, 200, 152))
    masks = np.clip(2 * masks, 0, 1)
    protocol = dataclasses.replace(PROTOCOLS["lvsm"], lpips=("alex",))
    (row,) = scores.score_views(
        predicted[None], capture_from(truth[None], masks[None]), protocol, networks=networks
    )
    found = []
    for top in range(0, 200 - 63, 32):
        for left in range(0, 152 - 63, 32):
            patch = (slice(top, top + 64), slice(left, left + 64))
            if masks[patch].mean() > 0.5:
                pair = predicted[patch], truth[patch]
                similarity = SSIM[GAUSSIAN](*(x.astype(float) for x in pair))
                found.append(
                    (psnr(*pair), similarity, float(jax.jit(lpips)(networks["alex"], *pair)))
                )
    expected = np.mean(found, axis=0)
    assert row["patches"] == len(found) and 2 < len(found) < 12
    assert row["patch_psnr"] == pytest.approx(expected[0], abs=DECIBELS)
    assert row["patch_ssim"] == pytest.approx(expected[1], abs=1e-5)
    assert row["patch_lpips_alex"] == pytest.approx(expected[2], rel=1e-5)


def test_patches_that_are_mostly_background_do_not_count():
    """Of two patches of 96 x 80 pixels, people fill more than half of the upper one only."""
    predicted, truth, masks = (x.copy() for x in random_views(5, 1))
    masks[:, :40], masks[:, 40:] = 1, 0
    (row,) = scores.score_views(predicted, capture_from(truth, masks), PROTOCOLS["lvsm"])
    assert row["patches"] == 1 and row["patch_psnr"] == pytest.approx(
        psnr(predicted[0, :64, :64], truth[0, :64, :64])
    )


def test_a_photo_on_white_is_the_same_person_on_black():
    """This also holds where the mask is soft: the result is color * mask."""
    random = np.random.default_rng(0)
    color, mask = random.random((9, 7, 3), np.float32), random.random((9, 7), np.float32)[..., None]
    found = scores.on_background(color * mask + 1 - mask, mask[..., 0], PROTOCOLS["ghg"])
    np.testing.assert_allclose(found, color * mask, atol=1e-6)  # of float32


@pytest.mark.slow
def test_images_of_other_sizes_share_the_programs():
    """Crops of many people fall into few sizes, each of which is compiled once."""
    rng = np.random.default_rng(0)
    protocol = PROTOCOLS["giga"]
    compiled = scores.pair_scores.jitted._cache_size
    counts = []
    for height, width in ((65, 75), (70, 80), (78, 66)):
        image = rng.random((1, 100, 100, 3)).astype(np.float32)
        mask = np.zeros((1, 100, 100), np.float32)
        mask[:, :height, :width] = 1
        list(scores.score_views(image, capture_from(image, mask), protocol))
        counts.append(compiled())
    assert counts[0] == counts[1] == counts[2]


def test_what_is_not_defined_is_none_and_says_why():
    predicted, truth, masks = random_views(6, 1, 40, 32)
    protocol = PROTOCOLS["humangs"]
    (bare,) = scores.score_views(predicted, capture_from(truth), protocol)
    assert bare["psnr"] > 10 and [name for name, x in bare.items() if x is not None] == [
        "psnr",
        "ssim",
    ]
    reasons = scores.missing_reasons(protocol, {}, masks=False, alpha=False)
    assert set(reasons) == set(bare) - {"psnr", "ssim"}
    assert (
        "no weights of LPIPS vgg" in reasons["lpips_vgg"]
        and reasons["semi_transparent"] == "the true images have no masks"
    )
    assert "alpha" in scores.missing_reasons(protocol, {}, masks=True, alpha=False)["iou"]
    (nobody,) = scores.score_views(predicted, capture_from(truth, 0 * masks), PROTOCOLS["giga"])
    assert [name for name, x in nobody.items() if x is not None] == ["foreground"] and nobody[
        "foreground"
    ] == 0
    (small,) = scores.score_views(predicted, capture_from(truth, masks), protocol)
    assert small["patches"] == 0 and small["patch_psnr"] is None and small["psnr_fg"] > 0
    with pytest.raises(ValueError, match="needs a mask for every view"):
        list(scores.score_views(predicted, capture_from(truth), PROTOCOLS["ghg"]))
    with pytest.raises(ValueError, match=r"\(1, 39, 32, 3\), the true ones \(1, 40, 32, 3\)"):
        list(scores.score_views(predicted[:, 1:], capture_from(truth), protocol))
    predicted[0, 3, 4, 1] = np.nan
    with pytest.raises(
        ValueError, match=r"predicted images: expected finite numbers, but 1 of 3840 are not"
    ):
        list(scores.score_views(predicted, capture_from(truth), protocol))


def test_the_headline_is_the_mean_over_views():
    predicted, truth, masks = random_views(7, 2)
    found = scores.score(predicted, capture_from(truth, masks))
    assert found.psnr == pytest.approx(
        np.mean([psnr(*pair) for pair in zip(predicted, truth, strict=True)]), abs=1e-4
    )
    assert found.foreground == pytest.approx(masks.mean())
    with pytest.raises(ValueError, match="mask for every view"):
        scores.score(predicted, capture_from(truth))
