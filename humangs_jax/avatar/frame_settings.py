"""Settings of how an avatar is filmed: the size of the images, the background, and the place of the
camera.

`FrameSettings` is what `humangs animate` and `humangs render` have in common; their command line is
made from it, so this module imports nothing heavy. `avatar.frames` draws by it.
"""

import dataclasses
import math
from typing import Annotated, Literal

from humangs_jax.core.configuration import ArgumentError, Range, check_range

LARGEST_SIDE = 8192
"""The largest side of an image, pixels: the width of 8192 x 4320, which H.264 and VP9 allow."""


@dataclasses.dataclass(frozen=True)
class FrameSettings:
    """The images: their size, what is behind the person, where the camera stands."""

    size: Annotated[int, Range(1, LARGEST_SIDE)] = 512
    """Side of the images in pixels; --width and --height give other shapes."""
    width: Annotated[int | None, Range(1, LARGEST_SIDE)] = None
    """Width of the images in pixels."""
    height: Annotated[int | None, Range(1, LARGEST_SIDE)] = None
    """Height of the images in pixels."""
    background: str = "white"
    """A color (a CSS name or #rrggbb), or transparent."""
    azimuth: Annotated[float, Range(-36000, 36000)] = 0.0
    """Degrees around the person; 0 looks at the front, 90 at the left side."""
    elevation: Annotated[float, Range(-89, 89)] = 6.0
    """Degrees of the camera above the horizon."""
    distance: Annotated[float | None, Range(0.01, 1000)] = None
    """Metres from the person. Default: the smallest distance from which all of the person is in the
    images.
    """
    fov: Annotated[float, Range(1, 150)] = 30.0
    """Vertical field of view, degrees."""
    splat: Literal["as_trained", "exact", "near_exact", "fast", "inria"] = "as_trained"
    """How Gaussians are rendered: near_exact and fast trade accuracy for time, inria is the
    published rasterizer.
    """
    prune: bool = False
    """Leave out Gaussians that no image shows; to find them, all images are drawn once more (docs:
    video).
    """

    def check(self) -> None:
        # not on construction: the command line would make a box of it
        """Check that all settings are in range, and that the background is a color or
        "transparent".

        Raises: ValueError, which names the setting that is wrong.
        """
        for field in dataclasses.fields(self):
            check_range(FrameSettings, field.name, getattr(self, field.name), field.name)
        self.color()

    @property
    def resolution(self) -> tuple[int, int]:
        """The width and the height of the images, pixels."""
        return self.width or self.size, self.height or self.size

    @property
    def tangents(self) -> tuple[float, float]:
        """The tangents of half the field of view along x and y. Pixels are square."""
        width, height = self.resolution
        tangent = math.tan(math.radians(self.fov) / 2)
        return tangent * width / height, tangent

    def color(self) -> tuple[float, float, float] | None:
        """Returns red, green and blue of the background in [0, 1]; None for a transparent one.

        Raises: ValueError for a text that is no color.
        """
        if self.background == "white":  # without numpy: --help asks for it, too
            return 1.0, 1.0, 1.0
        if self.background.strip().lower() == "transparent":
            return None
        from humangs_jax.io.images import named_color

        try:
            return named_color(self.background)
        except ValueError as error:
            raise ArgumentError(
                "background", f"{str(error).removeprefix('background ')}, or transparent"
            ) from None
