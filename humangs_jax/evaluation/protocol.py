"""How images are compared: background, crops, networks and windows, as the papers that report such numbers do it.

A protocol is data; `scores` follows it. Crops work on numpy arrays of one image and are the same for truth and prediction:
they look at the true mask alone.
"""

import dataclasses
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import Presets
from humangs_jax.data.masks import box_of
from humangs_jax.io.images import resized
from humangs_jax.losses.ssim import GAUSSIAN, TORCHMETRICS, UNIFORM, SsimWindow

Background = Literal["white", "black", "dataset"]
Net = Literal["vgg", "alex", "squeeze"]
Image = Float[np.ndarray, "h w 3"]


@runtime_checkable
class Crop(Protocol):
    """A part of an image, found by the true mask."""

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Float[np.ndarray, "y x 3"]:
        """The part; `background` (0 or 1) fills what lies outside of the image. The mask is not empty."""
        ...


@dataclasses.dataclass(frozen=True)
class WholeFrame:
    """The image as it is."""

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Image:
        """See `Crop`."""
        return image


@dataclasses.dataclass(frozen=True)
class MaskBox:
    """The bounding box of the pixels where the mask is above a half."""

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Float[np.ndarray, "y x 3"]:
        """See `Crop`."""
        (top, bottom), (left, right) = box_of(mask > 0.5)
        return image[top:bottom, left:right]


@dataclasses.dataclass(frozen=True)
class SquareBox:
    """The bounding box of the pixels where the mask is not 0, `margin` pixels wider where the image goes on, made a square of
    background, and resampled to `side` pixels (bilinear, without a filter).

    The box ends before the last row and column plus the margin, as in
    https://github.com/lizhe00/AnimatableGaussians/blob/master/eval/score.py.
    """

    margin: int = 50
    side: int = 512

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Float[np.ndarray, "s s 3"]:
        """See `Crop`."""
        from skimage.transform import resize

        rows, columns = box_of(mask > 0)
        (top, bottom), (left, right) = (
            np.clip([first - self.margin, end - 1 + self.margin], 0, side)
            for (first, end), side in zip((rows, columns), mask.shape, strict=True)
        )
        part = image[top:bottom, left:right]
        largest = max(part.shape[:2])
        square = np.full((largest, largest, 3), background, np.float32)
        down, across = ((largest - side) // 2 for side in part.shape[:2])
        square[down : down + part.shape[0], across : across + part.shape[1]] = part
        return resize(square, (self.side, self.side), order=1, mode="edge", anti_aliasing=False).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class CentredWindow:
    """The image with its longer side brought to `side` pixels, and of that a window of height x width: the bounding box of the
    pixels where the mask is not 0 in its middle, moved into the image where it leaves it (metrics/compute_metrics.py of
    https://github.com/humansensinglab/Generalizable-Human-Gaussians). A smaller image is taken whole.
    """

    height: int = 1000
    width: int = 500
    side: int = 1024

    def cut(self, image: Image, mask: Float[np.ndarray, "h w"], background: float) -> Float[np.ndarray, "y x 3"]:
        """See `Crop`."""
        factor = self.side / max(mask.shape)
        height, width = (max(1, round(factor * side)) for side in mask.shape)
        if factor != 1:
            image, mask = resized(image, width, height), resized(mask, width, height)
        corner = []
        for (first, end), size, side in zip(box_of(mask > 0), (self.height, self.width), mask.shape, strict=True):
            start = first - (size - (end - first)) // 2
            corner.append(int(np.clip(start, 0, max(0, side - size))))
        return image[corner[0] : corner[0] + self.height, corner[1] : corner[1] + self.width]


@dataclasses.dataclass(frozen=True)
class EvaluationProtocol:
    """One way to compare.

    background: behind the person, in truth and prediction. "dataset": the photos as they are; renderings get white.
    crop: what PSNR and SSIM see. lpips_crop: what LPIPS sees; None: the same.
    masked: predictions are cut out by the true mask first, which hides errors of the silhouette.
    lpips: networks under LPIPS. ssim: its window.
    published_side: pixels a side of the published images; others are compared as they are.
    """

    background: Background = "white"
    crop: Crop = WholeFrame()
    lpips_crop: Crop | None = None
    masked: bool = False
    lpips: tuple[Net, ...] = ("vgg",)
    ssim: SsimWindow = GAUSSIAN
    published_side: int | None = None

    @property
    def behind(self) -> float:
        """The grey that predictions stand before."""
        return 0.0 if self.background == "black" else 1.0

    @property
    def needs_masks(self) -> bool:
        """Whether it is not defined without the true masks."""
        crops = (self.crop, self.lpips_crop or self.crop)
        return self.masked or self.background == "black" or any(not isinstance(crop, WholeFrame) for crop in crops)


PROTOCOLS: Presets[EvaluationProtocol] = Presets(
    {
        "humangs": EvaluationProtocol(published_side=512),
        "animatable-gaussians": EvaluationProtocol(lpips_crop=SquareBox(), ssim=UNIFORM),
        "ghg": EvaluationProtocol("black", CentredWindow(), lpips=("alex", "vgg"), ssim=UNIFORM, published_side=1024),
        "giga": EvaluationProtocol("black", MaskBox(), masked=True, lpips=("alex",), ssim=TORCHMETRICS),
        "lhm": EvaluationProtocol(lpips=("squeeze",), ssim=TORCHMETRICS),
        "lhm++": EvaluationProtocol(masked=True, lpips=("alex",), ssim=UNIFORM),
        "lvsm": EvaluationProtocol("dataset"),
    }
)
"""By the name of the system whose paper reports such numbers; docs/evaluation.md has them as a table."""


def find_protocol(protocol: str | EvaluationProtocol) -> EvaluationProtocol:
    """A protocol by name, or the one given. Raises: ValueError for an unknown name."""
    if isinstance(protocol, EvaluationProtocol):
        return protocol
    if protocol not in PROTOCOLS:
        raise ValueError(f"no protocol {protocol!r}: expected one of {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol]
