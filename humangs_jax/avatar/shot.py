"""How an avatar is filmed: the size of the images, what is behind the person, where the camera stands.

`Shot` is what `humangs animate` and `humangs render` have in common; their command line is made from it, so this module imports
nothing heavy. `avatar.frames` draws by it.
"""

import dataclasses
import math
from typing import Literal

from humangs_jax.core.configuration import ArgumentError

LARGEST_SIDE = 8192
"""Pixels: the largest level of H.264 and VP9."""


@dataclasses.dataclass(frozen=True)
class Shot:
    """The images: their size, what is behind the person, where the camera stands."""

    size: int = 512
    """Side of the images in pixels; --width and --height give other shapes."""
    width: int | None = None
    """Width of the images in pixels."""
    height: int | None = None
    """Height of the images in pixels."""
    background: str = "white"
    """A color (a CSS name or #rrggbb), or transparent."""
    azimuth: float = 0.0
    """Degrees around the person; 0 looks at the front, 90 at the left side."""
    elevation: float = 6.0
    """Degrees of the camera above the horizon."""
    distance: float | None = None
    """Metres from the person. Default: as near as all that is shown of the person fits."""
    fov: float = 30.0
    """Vertical field of view, degrees."""
    splat: Literal["as_trained", "exact", "near_exact", "fast", "inria"] = "as_trained"
    """How Gaussians are drawn: near_exact and fast trade accuracy for time (docs/performance.md), inria is the published
    rasterizer. Default: as the avatar's weights were trained."""
    prune: bool = False
    """Leave out Gaussians that weigh less than 1/255 on every pixel of every image. To find them all images are drawn once more:
    docs/video.md has what it saves."""

    def check(self) -> None:
        """Raises: ValueError naming what is out of range."""  # not on construction: the command line would make a box of it
        for name in ("size", "width", "height"):
            value = getattr(self, name)
            if value is not None and not 1 <= value <= LARGEST_SIDE:
                raise ArgumentError(name, f"{value}: expected 1 to {LARGEST_SIDE} pixels")
        ranges = {"azimuth": (-36000, 36000), "elevation": (-89, 89), "fov": (1, 150), "distance": (0.01, 1000)}
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ArgumentError(name, f"{value}: expected a number from {low} to {high}")
        self.color()

    @property
    def resolution(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width or self.size, self.height or self.size

    @property
    def tangents(self) -> tuple[float, float]:
        """Tangents of half the field of view along x and y; pixels are square."""
        width, height = self.resolution
        tangent = math.tan(math.radians(self.fov) / 2)
        return tangent * width / height, tangent

    def color(self) -> tuple[float, float, float] | None:
        """Red, green and blue of the background in [0, 1]; None: transparent. Raises: ValueError for what is no color."""
        if self.background == "white":  # without numpy: --help asks for it, too
            return 1.0, 1.0, 1.0
        if self.background.strip().lower() == "transparent":
            return None
        from humangs_jax.io.images import named_color

        try:
            return named_color(self.background)
        except ValueError as error:
            raise ArgumentError("background", f"{str(error).removeprefix('background ')}, or transparent") from None
