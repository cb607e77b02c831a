"""Reads the OpenEXR files that the package writes."""

import numpy as np
import OpenEXR

from humangs_jax.avatar.layers import RGBA, ExrView
from humangs_jax.geometry.camera import Camera

STANDARD_ATTRIBUTES = {"name", "type", "compression", "owner", "view", "comments"}
"""Strings of the header that OpenEXR defines."""


def read_exr(path):
    """Returns the views of a file, one of each part, as float32."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [_view(part) for part in file.parts]


def camera_of(view):
    """Returns the camera of the header."""
    return Camera.from_opencv(view.K, view.cam_from_world, view.rgba.shape[1], view.rgba.shape[0])


def _view(part):
    images = {
        name: np.asarray(channel.pixels, np.float32) for name, channel in part.channels.items()
    }
    rgba = np.stack([images.pop(name) for name in RGBA], axis=-1)
    matrices = [part.header[key] for key in ("K", "cam_from_world")]
    attributes = {
        k: v for k, v in part.header.items() if isinstance(v, str) and k not in STANDARD_ATTRIBUTES
    }
    return ExrView(rgba, images.pop("Z", None), *matrices, part.name(), images, attributes)
