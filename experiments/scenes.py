"""Scenes of Gaussians as files, what they should look like, and how far an image or a gradient is from that.

A scene is an npz of float32 arrays: `means` (g,3) metres, `quats` (g,4) wxyz, `scales` (g,3) metres, `opacities` (g), `colors`
(g,3), `cam_from_world` (4,4) OpenCV and `K_<size>` (3,3) for square images of that many pixels. "demo" stands for the person of
the shipped demo capture, reconstructed, in the pose and before the camera of its first photo.

A reference is an npz of `image` (size,size,3) on black, and, where it was made, `target_seed` and `grad_<parameter>`: the
gradients of mean((image - target)^2) with target = numpy.random.default_rng(target_seed).random((size,size,3)).
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.geometry.camera import Camera, orbit
from humangs_jax.network.weights import load_weights
from humangs_jax.rendering.gaussians import Gaussians

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


class Scene(NamedTuple):
    """Gaussians and one camera of `size` x `size` pixels, numpy float32. kind: the file's name."""

    kind: str
    size: int
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    K: np.ndarray
    cam_from_world: np.ndarray

    def gaussians(self, dtype: type = np.float32) -> "Gaussians":
        """The five parameters on the device."""
        return Gaussians(*(jnp.asarray(getattr(self, name), dtype) for name in PARAMETERS))

    def camera(self, dtype: type = np.float32) -> "Camera":
        """The camera on the device."""
        return Camera(jnp.asarray(self.K, dtype), jnp.asarray(self.cam_from_world, dtype), self.size, self.size)

    def resized(self, size: int) -> "Scene":
        """The same view on an image of another size."""
        scale = np.asarray([size / self.size, size / self.size, 1], np.float32)
        return self._replace(size=size, K=self.K * scale[:, None])


class Reference(NamedTuple):
    """What a scene should look like. gradients: by parameter name, empty if there are none. seed: of the target."""

    image: np.ndarray
    gradients: dict[str, np.ndarray]
    seed: int


def load_scene(source: str | Path, size: int) -> Scene:
    """A scene file, or "demo".

    Raises: ValueError if the file has no camera of that size.
    """
    if str(source) == "demo":
        return _demo_scene(size)
    with np.load(source, allow_pickle=False) as file:
        if f"K_{size}" not in file.files:
            raise ValueError(f"{source}: no K_{size}; it has {', '.join(file.files)}")
        arrays = [file[name] for name in (*PARAMETERS, f"K_{size}", "cam_from_world")]
    return Scene(Path(source).stem, size, *(np.asarray(array, np.float32) for array in arrays))


def load_reference(path: str | Path, size: int) -> Reference:
    """A reference file.

    Raises: ValueError if it is of another size, or was made with a target that this numpy does not draw.
    """
    with np.load(path, allow_pickle=False) as file:
        image = file["image"]
        if image.shape != (size, size, 3):
            raise ValueError(f"{path}: its image is {image.shape}, expected {(size, size, 3)}")
        seed = int(file["target_seed"]) if "target_seed" in file.files else 1
        gradients = {name: file[f"grad_{name}"] for name in PARAMETERS if f"grad_{name}" in file.files}
        digest = str(file["target_sha256"]) if "target_sha256" in file.files else None
    if digest is not None and digest != hashlib.sha256(make_target(size, seed).tobytes()).hexdigest():
        raise ValueError(f"{path}: this numpy draws another target than its gradients were made with")
    return Reference(image, gradients, seed)


def orbiting(scene: Scene, azimuths: np.ndarray, elevations: np.ndarray | float = 0.0) -> "Camera":
    """Cameras (leading axis v) that look at a scene's middle from as far as its own does; radians."""
    own, middle = scene.camera(), np.median(scene.means, axis=0)
    distance = float(np.linalg.norm(np.asarray(own.center) - middle))
    angles = (jnp.asarray(a, jnp.float32) for a in (azimuths, elevations))
    return orbit(jnp.asarray(middle), distance, *angles, own.K, scene.size, scene.size)


def make_target(size: int, seed: int = 1) -> np.ndarray:
    """The image that the loss compares with: noise in [0, 1), float32."""
    return np.random.default_rng(seed).random((size, size, 3)).astype(np.float32)


def image_errors(image: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """psnr in dB, max_abs_error, and the fraction of pixels with a channel that is off by more than 2e-4."""
    error = np.abs(np.asarray(image, np.float64) - reference)
    return {
        "psnr": float(-10 * np.log10(np.mean(error**2) + 1e-300)),
        "max_abs_error": float(error.max()),
        "fraction_above_2e-4": float((error.max(axis=-1) > 2e-4).mean()),
    }


def gradient_errors(found: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Of one parameter's gradient, all in float64.

    relative_l2: |found - reference| / |reference|. cosine: of the angle between them. signed_bias: mean of found -
    reference over mean of |reference|, nothing but rounding if errors fall to either side alike. gain: the factor
    <found, reference> / <reference, reference> less 1, which a gradient that is systematically too small shows.
    """
    a, b = np.asarray(found, np.float64).ravel(), np.asarray(reference, np.float64).ravel()
    norm, tiny = np.linalg.norm(b), 1e-300
    return {
        "relative_l2": float(np.linalg.norm(a - b) / (norm + tiny)),
        "cosine": float(a @ b / (np.linalg.norm(a) * norm + tiny)),
        "signed_bias": float((a - b).sum() / (np.abs(b).sum() + tiny)),
        "gain": float(a @ b / (b @ b + tiny)) - 1,
    }


def _demo_scene(size: int) -> Scene:

    capture = load_capture(DEMO_CAPTURE)
    avatar = reconstruct(*load_weights(), capture)
    gaussians = animate(avatar, capture.pose(int(capture.frames[0])))
    camera = jax.tree.map(lambda leaf: leaf[0], capture.cameras).resized(size, size)
    arrays = [*(getattr(gaussians, name) for name in PARAMETERS), camera.K, camera.cam_from_world]
    return Scene("demo", size, *(np.asarray(array, np.float32) for array in arrays))
