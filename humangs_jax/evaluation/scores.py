"""Scores of images under evaluation protocols. A protocol says which backgrounds, crops, networks
and windows are used. The protocols here follow papers that report such numbers.

A protocol is data. Crops work on numpy arrays of one image. They depend on the true mask alone, so
that truth and prediction are cut alike. Scores are pure jitted functions of one image, with some
work on the host around them.

Images are padded below and right to few sizes (`buffers.round_up`) and their own size is passed
along, so that an evaluation of photos and crops of any sizes compiles few programs. Padding changes
no score: windows and pixels beyond the image's own size do not count, and LPIPS sees the zeros
there that its convolutions would add themselves.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, Literal, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Bool, Float, Int, Scalar
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import FINITE, check_values
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import Presets
from humangs_jax.data.capture import Capture
from humangs_jax.data.masks import box_of
from humangs_jax.evaluation.means import Row, mean_scores
from humangs_jax.io.images import resized
from humangs_jax.losses.losses import (
    GAUSSIAN,
    TORCHMETRICS,
    UNIFORM,
    SsimWindow,
    boundary_band,
    decibels,
    masked_psnr,
    mean_similarity,
    semi_transparent,
    silhouette_iou,
    similarity_map,
)
from humangs_jax.losses.perceptual import BACKBONES, Lpips, lpips, smallest_side
from humangs_jax.rendering.buffers import round_up

Background = Literal["white", "black", "dataset"]
Net = Literal["vgg", "alex", "squeeze"]
Image = Float[np.ndarray, "h w 3"]


@runtime_checkable
class Crop(Protocol):
    """A rule that cuts a part out of an image by the true mask."""

    def cut(
        self, image: Image, mask: Float[np.ndarray, "h w"], background: float
    ) -> Float[np.ndarray, "y x 3"]:
        """Returns the part of the image. Crops that add pixels give them the value `background`, 0
        or 1.

        mask: at least one of its pixels is above a half.
        """
        ...


@dataclasses.dataclass(frozen=True)
class WholeFrame:
    """The whole image."""

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Image:
        """See `Crop`."""
        return image


@dataclasses.dataclass(frozen=True)
class MaskBox:
    """The bounding box of the pixels where the mask is above a half."""

    def cut(
        self, image: Image, mask: Float[np.ndarray, "h w"], background: float
    ) -> Float[np.ndarray, "y x 3"]:
        """See `Crop`."""
        (top, bottom), (left, right) = box_of(mask > 0.5)
        return image[top:bottom, left:right]


@dataclasses.dataclass(frozen=True)
class SquareBox:
    """The bounding box of the pixels where the mask is not 0, with a margin that ends at the border
    of the image. The box is padded to a square with the background, and resampled (bilinear,
    without a filter).

    The box has one row less at its lower end and one column less at its right end, as in
    https://github.com/lizhe00/AnimatableGaussians/blob/master/eval/score.py.
    """

    margin: int = 50
    """The margin on each side of the box, pixels."""
    side: int = 512
    """The side of the resampled square, pixels."""

    def cut(
        self, image: Image, mask: Float[np.ndarray, "h w"], background: float
    ) -> Float[np.ndarray, "s s 3"]:
        """See `Crop`."""
        from skimage.transform import resize

        rows, columns = (
            slice(max(0, first - self.margin), end - 1 + self.margin)
            for first, end in box_of(mask > 0)
        )
        part = image[rows, columns]
        largest = max(part.shape[:2])
        missing = [((largest - side) // 2, (largest - side + 1) // 2) for side in part.shape[:2]]
        square = np.pad(part.astype(np.float32), [*missing, (0, 0)], constant_values=background)
        return resize(
            square, (self.side, self.side), order=1, mode="edge", anti_aliasing=False
        ).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class CentredWindow:
    """A window of a resampled image. The window has the same middle as the bounding box of the
    pixels where the mask is not 0. A window that leaves the image is moved into the image. If the
    image is lower or narrower than the window, its whole height or width is taken.

    Source: metrics/compute_metrics.py of
    https://github.com/humansensinglab/Generalizable-Human-Gaussians.
    """

    height: int = 1000
    """The height of the window, pixels."""
    width: int = 500
    """The width of the window, pixels."""
    side: int = 1024
    """The length to which the longer side of the image is resampled first, pixels."""

    def cut(
        self, image: Image, mask: Float[np.ndarray, "h w"], background: float
    ) -> Float[np.ndarray, "y x 3"]:
        """See `Crop`."""
        factor = self.side / max(mask.shape)
        height, width = (max(1, round(factor * side)) for side in mask.shape)
        if factor != 1:
            image, mask = resized(image, width, height), resized(mask, width, height)
        corner = []
        for (first, end), size, side in zip(
            box_of(mask > 0), (self.height, self.width), mask.shape, strict=True
        ):
            start = first - (size - (end - first)) // 2
            corner.append(int(np.clip(start, 0, max(0, side - size))))
        return image[corner[0] : corner[0] + self.height, corner[1] : corner[1] + self.width]


@dataclasses.dataclass(frozen=True)
class EvaluationProtocol:
    """A protocol: which parts of the images are compared, on which background, and by which
    scores.
    """

    background: Background = "white"
    """The background of truth and prediction. "dataset": photos keep their own, and renderings get
    white.
    """
    crop: Crop = WholeFrame()
    """The part of the image that PSNR and SSIM compare."""
    lpips_crop: Crop | None = None
    """The part of the image that LPIPS compares; None: the same part, `crop`."""
    masked: bool = False
    """Whether predictions are first cut out by the true mask. This hides errors of the silhouette.
    """
    lpips: tuple[Net, ...] = ("vgg",)
    """The networks of LPIPS."""
    ssim: SsimWindow = GAUSSIAN
    """The window of SSIM."""
    published_side: int | None = None
    """The side of the square images of the paper, pixels; None: they have no common size. Images of
    other sizes are compared as they are.
    """

    @property
    def behind(self) -> float:
        """The grey value of the background of predictions, 0 or 1."""
        return 0.0 if self.background == "black" else 1.0

    @property
    def crops(self) -> tuple[Crop, ...]:
        """The crops of the protocol: `crop`, then `lpips_crop` if it is not None."""
        if self.lpips_crop is None:
            return (self.crop,)
        return self.crop, self.lpips_crop

    @property
    def needs_masks(self) -> bool:
        """Whether the protocol is undefined without the true masks."""
        return (
            self.masked
            or self.background == "black"
            or not all(isinstance(crop, WholeFrame) for crop in self.crops)
        )


PROTOCOLS: Presets[EvaluationProtocol] = Presets(
    {
        "humangs": EvaluationProtocol(published_side=512),
        "animatable-gaussians": EvaluationProtocol(lpips_crop=SquareBox(), ssim=UNIFORM),
        "ghg": EvaluationProtocol(
            "black", CentredWindow(), lpips=("alex", "vgg"), ssim=UNIFORM, published_side=1024
        ),
        "giga": EvaluationProtocol(
            "black", MaskBox(), masked=True, lpips=("alex",), ssim=TORCHMETRICS
        ),
        "lhm": EvaluationProtocol(lpips=("squeeze",), ssim=TORCHMETRICS),
        "lhm++": EvaluationProtocol(masked=True, lpips=("alex",), ssim=UNIFORM),
        "lvsm": EvaluationProtocol("dataset"),
    }
)
"""The protocols by the name of the system whose paper reports such numbers. docs/evaluation.md has
them as a table.
"""


# Scores
# --------------------------------------------------------------------------------------------------

PATCH = 64
"""Side of the patches, pixels."""
STRIDE = 32
"""Distance between the patches, pixels."""
LEAST_FOREGROUND = 0.5
"""Share of a patch that the foreground must exceed for the patch to count."""
PATCHES_AT_ONCE = 16
"""Number of patches whose LPIPS is computed at once. They have as many pixels as one image of 256 x
256.
"""

Networks = Mapping[str, Lpips]
"""LPIPS networks by name."""


@compiled(static=["window"])
def pair_scores(
    predicted: Float[Array, "h w 3"],
    truth: Float[Array, "h w 3"],
    size: Int[Array, "2"],
    window: SsimWindow,
) -> dict[str, Scalar]:
    """Returns psnr (dB) and ssim of two images in [0, 1]. The first size[0] rows and size[1]
    columns count.
    """
    rows, columns = (jnp.arange(side) < n for side, n in zip(truth.shape[:2], size, strict=True))
    inside = (rows[:, None] & columns).astype(truth.dtype)
    similarity = mean_similarity(similarity_map(predicted, truth, window), size - window.size + 1)
    return {"psnr": masked_psnr(predicted, truth, inside), "ssim": similarity}


@compiled(static=["window"])
def person_scores(
    predicted: Float[Array, "h w 3"],
    truth: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    band: Float[Array, "h w"],
    size: Int[Array, "2"],
    window: SsimWindow,
) -> tuple[dict[str, Scalar], Bool[Array, "y x"]]:
    """Returns psnr_fg, psnr_boundary, patch_psnr (all three in dB) and patch_ssim of images as in
    `pair_scores`, and which patches count.

    mask: the coverage by the person. band: 1 along the person's silhouette. Both are 0 beyond the
    size. The scores of patches are NaN if no patch counts.
    """
    shares = _patch_means(mask, PATCH)
    within = [
        STRIDE * jnp.arange(side) + PATCH <= n for side, n in zip(shares.shape, size, strict=True)
    ]
    kept = (shares > LEAST_FOREGROUND) & within[0][:, None] & within[1]
    errors = jnp.mean(jnp.square(predicted - truth), axis=-1)
    similarities = jnp.mean(similarity_map(predicted, truth, window), axis=-1)

    def mean(x):
        return jnp.sum(jnp.where(kept, x, 0)) / jnp.sum(kept)

    return {
        "psnr_fg": masked_psnr(predicted, truth, mask),
        "psnr_boundary": masked_psnr(predicted, truth, band),
        "patch_psnr": mean(decibels(_patch_means(errors, PATCH))),
        "patch_ssim": mean(_patch_means(similarities, PATCH - window.size + 1)),
    }, kept


def _patch_means(x: Float[Array, "h w"], side: int) -> Float[Array, "y x"]:
    """Returns the mean of every square of `side` pixels; squares are `STRIDE` pixels apart."""
    return lax.reduce_window(x, 0.0, lax.add, (side, side), (STRIDE, STRIDE), "VALID") / side**2


@compiled()
def _alpha_scores(alpha: Float[Array, "h w"], mask: Float[Array, "h w"]) -> dict[str, Scalar]:
    """Returns iou and semi_transparent of a rendering's coverage, see `losses.silhouette_iou` and
    `losses.semi_transparent`.
    """
    return {"iou": silhouette_iou(alpha, mask), "semi_transparent": semi_transparent(alpha, mask)}


def _precise_lpips(weights: Lpips, predicted: Any, truth: Any, size: Any = None) -> Scalar:
    # accelerators round the factors of convolutions by default
    with jax.default_matmul_precision("highest"):
        return lpips(weights, predicted, truth, size)


_lpips = jax.jit(_precise_lpips)
_lpips_of_patches = jax.jit(jax.vmap(_precise_lpips, in_axes=(None, 0, 0)))


def _score_image(
    predicted: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"] | None,
    alpha: Float[np.ndarray, "h w"] | None,
    protocol: EvaluationProtocol,
    networks: Networks,
) -> Row:
    """Returns all scores of one image by name; None for scores that are not defined here, see
    `missing_reasons`.

    predicted, truth: in [0, 1], on the protocol's background. mask: the true mask. alpha: the
    coverage of the prediction.
    """
    # scores of the person need somebody in the mask
    empty = mask is None or not (mask > 0.5).any()
    predicted = np.clip(predicted, 0, 1)
    window = protocol.ssim
    row = dict.fromkeys(score_names(protocol))
    if protocol.masked and mask is not None:
        predicted = predicted * mask[..., None] + protocol.behind * (1 - mask[..., None])
    # the whole image or its crop; LPIPS may have a crop that differs
    for crop in protocol.crops:
        if empty and not isinstance(crop, WholeFrame):
            continue
        pair = [predicted, truth]
        if mask is not None:
            pair = [crop.cut(image, mask, protocol.behind) for image in pair]
        size, least = np.asarray(pair[0].shape[:2], np.int32), min(pair[0].shape[:2])
        pair = [_padded(image) for image in pair]
        if crop is protocol.crops[0] and least >= window.size:
            row |= pair_scores(*pair, size, window)
        for net in protocol.lpips if crop is protocol.crops[-1] else ():
            if net in networks and least >= smallest_side(BACKBONES[net]):
                row[f"lpips_{net}"] = _lpips(networks[net], *pair, size)
    # the silhouette
    if mask is not None:
        row["foreground"] = np.mean(mask)
        if alpha is not None:
            row |= _alpha_scores(_padded(alpha), _padded(mask))
    # the person alone, and patches of the person
    if not empty:
        frame = [_padded(x) for x in (predicted, truth, mask, boundary_band(mask))]
        scores, kept = person_scores(*frame, np.asarray(mask.shape, np.int32), window)
        kept = np.argwhere(np.asarray(kept))
        row |= scores | {"patches": len(kept)}
        if not len(kept):
            row |= {"patch_psnr": None, "patch_ssim": None}
        for net in protocol.lpips:
            if net in networks and len(kept):
                row[f"patch_lpips_{net}"] = _patch_lpips(
                    networks[net], predicted, truth, STRIDE * kept
                )
    return {name: None if value is None else float(value) for name, value in row.items()}


def _padded(image: np.ndarray) -> Array:
    """Returns an image on the device, padded with zeros below and right to a size that many images
    share.
    """
    missing = [(0, round_up(side) - side) for side in image.shape[:2]]
    return from_host(np.pad(image, missing + [(0, 0)] * (image.ndim - 2)), jnp.float32)


def _patch_lpips(
    weights: Lpips, predicted: np.ndarray, truth: np.ndarray, corners: np.ndarray
) -> float:
    """Returns the mean LPIPS of the patches whose upper left corners (row, column) are
    `corners`.
    """
    pairs = [
        np.stack([x[i : i + PATCH, j : j + PATCH] for i, j in corners]) for x in (predicted, truth)
    ]
    total, count = 0.0, len(corners)
    pairs = [
        np.pad(x, [(0, -count % PATCHES_AT_ONCE), (0, 0), (0, 0), (0, 0)], mode="edge")
        for x in pairs
    ]
    for start in range(0, count, PATCHES_AT_ONCE):
        found = _lpips_of_patches(weights, *(x[start : start + PATCHES_AT_ONCE] for x in pairs))
        total += float(jnp.sum(found[: count - start]))
    return total / count


def score_names(protocol: EvaluationProtocol) -> tuple[str, ...]:
    """Returns the names of the scores of an image, in the order in which tables show them."""
    nets = [f"lpips_{net}" for net in protocol.lpips]
    person = ("psnr_fg", "psnr_boundary", "iou", "semi_transparent", "foreground")
    return (
        "psnr",
        "ssim",
        *nets,
        *person,
        "patch_psnr",
        "patch_ssim",
        *(f"patch_{net}" for net in nets),
        "patches",
    )


def missing_reasons(
    protocol: EvaluationProtocol, networks: Networks, masks: bool, alpha: bool
) -> dict[str, str]:
    """Returns, by the name of a score, why this score is missing in all images. masks: whether the
    truth has masks. alpha: whether predictions have alpha.
    """
    reasons = {}
    for name in score_names(protocol):
        net = name.rpartition("lpips_")[2]
        if "lpips" in name and net not in networks:
            reasons[name] = f"no weights of LPIPS {net} were given (docs/loss_networks.md)"
        elif name not in ("psnr", "ssim", f"lpips_{net}") and not masks:
            reasons[name] = "the true images have no masks"
        elif name in ("iou", "semi_transparent") and not alpha:
            reasons[name] = "the predictions have no alpha channel"
    return reasons


def score_views(
    predicted: Float[np.ndarray, "v h w 3"],
    truth: Capture,
    protocol: EvaluationProtocol = PROTOCOLS["humangs"],
    alpha: Float[np.ndarray, "v h w"] | None = None,
    networks: Networks | None = None,
) -> Iterator[Row]:
    """Yields the scores of each view of a capture, see `_score_image`. predicted: images on the
    protocol's background. alpha: their coverage. Pixels that are `unknown` in the capture count as
    predicted right.

    Raises: ValueError if the sizes differ, if a value is not finite, or if the protocol needs masks
    that the capture lacks.
    """
    if predicted.shape != truth.images.shape:
        raise ValueError(
            f"predicted images have shape {predicted.shape}, the true ones {truth.images.shape}"
        )
    check_values("evaluate", {"predicted images": (predicted, FINITE), "alpha": (alpha, FINITE)})
    if truth.masks is None and protocol.needs_masks:
        raise ValueError("the protocol needs a mask for every view, and the capture has none")
    for i in range(truth.view_count):
        mask = None
        if truth.masks is not None:
            mask = np.asarray(truth.masks[i])
        image = on_background(truth.images[i], mask, protocol)
        shown = predicted[i]
        opacity = None if alpha is None else alpha[i]
        if truth.unknown is not None:
            # nothing can be wrong where the person may be hidden
            shown = np.where(truth.unknown[i][..., None], image, shown)
            if opacity is not None:
                opacity = np.where(truth.unknown[i], 0, opacity)
        yield _score_image(shown, image, mask, opacity, protocol, networks or {})


def on_background(
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"] | None,
    protocol: EvaluationProtocol,
) -> Float[np.ndarray, "h w 3"]:
    """Returns a photo of a capture on the background of a protocol. image: on white if there is a
    mask. Without a mask it is returned as it is.
    """
    if protocol.background != "black" or mask is None:
        return image
    return np.clip(image - (1 - mask[..., None]), 0, 1)


@dataclasses.dataclass(frozen=True)
class Scores:
    """Mean scores over the views of a capture."""

    psnr: float
    """PSNR of the whole image, dB."""
    ssim: float
    """SSIM with a Gaussian window, as scikit-image computes it."""
    psnr_fg: float
    """PSNR of the foreground, dB."""
    foreground: float
    """The share of the image that the true mask covers."""


def score(predicted: Float[np.ndarray, "v h w 3"], truth: Capture) -> Scores:
    """Returns the mean scores of images on white, compared with a capture's photos. A score that
    one of the views lacks is NaN.

    Raises: ValueError if the capture has no masks, and as `score_views`.
    """
    if truth.masks is None:
        raise ValueError("the foreground PSNR needs a mask for every view")
    means = mean_scores(score_views(predicted, truth))
    values = (means[field.name] for field in dataclasses.fields(Scores))
    return Scores(*(math.nan if value is None else value for value in values))
