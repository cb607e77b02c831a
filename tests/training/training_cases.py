"""A body of 64 vertices, made-up captures of it, and what runs on them within seconds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.data.capture import capture_from_arrays, save_capture
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.perceptual import VGG16, VGG19, Lpips, Vgg19, channels
from humangs_jax.network.config import paper_parts

SIDES, RINGS, SIZE, VIEWS, POSES = 8, 8, 32, 6, 2


def without_upsampler(model):
    """Returns the network without upsampler: vertices read the token maps."""
    encoder, reader, _ = paper_parts(model.architecture)
    return model.with_parts(
        encoder=dataclasses.replace(encoder, upsampler=None),
        reader=dataclasses.replace(reader, output_width=None),
    )


def tube():
    """Returns an upright tube of 1.6 m that bends in the middle; its shape direction is girth."""
    height = np.repeat(np.linspace(-0.8, 0.8, RINGS), SIDES)
    angle = np.tile(np.arange(SIDES) * 2 * np.pi / SIDES, RINGS)
    around = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    template = 0.25 * around + height[:, None] * [0, 1, 0]
    ring, side = np.divmod(np.arange((RINGS - 1) * SIDES), SIDES)
    a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    faces = np.concatenate(
        [np.stack([a, b, a + SIDES], -1), np.stack([b, b + SIDES, a + SIDES], -1)]
    )
    upper = np.clip(0.5 + 2 * height, 0, 1)
    regressor = np.stack([height < -0.7, np.abs(height) < 0.2]).astype(float)
    return BodyModel(
        template=jnp.asarray(template, jnp.float32),
        shape_directions=jnp.asarray(0.05 * around[..., None], jnp.float32),
        pose_directions=None,
        joint_regressor=jnp.asarray(regressor / regressor.sum(axis=1, keepdims=True), jnp.float32),
        skinning_weights=jnp.asarray(np.stack([1 - upper, upper], -1), jnp.float32),
        faces=jnp.asarray(faces),
        parents=(-1, 0),
        joint_names=("foot", "middle"),
        shape_names=("girth",),
        name="tube",
    )


def draw_points(points, colors, camera):
    """Returns (image on white, mask) of points painted from far to near.

    It is in numpy, so that nothing needs compiling.
    """
    K, cam_from_world = np.asarray(camera.K), np.asarray(camera.cam_from_world)
    seen = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    order = np.argsort(-seen[:, 2])
    x, y = (np.floor(seen[:, :2] / seen[:, 2:] @ K[:2, :2].T + K[:2, 2]).astype(int)[order]).T
    inside = (x >= 0) & (x < SIZE) & (y >= 0) & (y < SIZE)
    image, mask = np.ones((SIZE, SIZE, 3)), np.zeros((SIZE, SIZE))
    image[y[inside], x[inside]] = colors[order][inside]
    mask[y[inside], x[inside]] = 1
    return image, mask


def write_subject(path, body, seed):
    """Writes a capture of a body with random shape, poses and colors, drawn as points."""
    generator = np.random.default_rng(seed)
    betas = generator.normal(size=1).astype(np.float32)
    rest = shape_body(body, jnp.asarray(betas))
    rotations = 0.3 * generator.normal(size=(POSES, 2, 3)).astype(np.float32)
    K = intrinsics_from_fov(0.8, SIZE, SIZE)
    cameras = orbit(
        jnp.zeros(3), 2.6, jnp.arange(VIEWS) * 2 * jnp.pi / VIEWS + 0.1 * seed, 0.1, K, SIZE, SIZE
    )
    # forty points on every face, colored between its corners
    weights = generator.dirichlet([1, 1, 1], 40)
    corner_colors = generator.random((len(body.template), 3))
    faces = np.asarray(body.faces)
    fill = lambda values: np.einsum("wk,fkc->wfc", weights, values[faces]).reshape(-1, 3)
    images, masks, frames = [], [], []
    for view in range(VIEWS):
        frames.append(view % POSES)
        posed = pose_body(body, rest, BodyPose(jnp.asarray(rotations[frames[-1]]), jnp.zeros(3)))
        image, mask = draw_points(
            fill(np.asarray(posed.vertices)), fill(corner_colors), cameras[view]
        )
        images.append(image)
        masks.append(mask)
    capture = capture_from_arrays(
        np.stack(images),
        np.asarray(K),
        np.asarray(cameras.cam_from_world),
        rotations,
        np.zeros((POSES, 3)),
        betas=betas,
        masks=np.stack(masks),
        frames=frames,
        background="white",
        body=body,
    )
    save_capture(path, capture)


@dataclasses.dataclass(frozen=True)
class Spoilt(CaptureSource):
    """Captures of which one example is not finite, and another one is not in [0, 1]."""

    spoilt_at: int = -1
    bright_at: int = -1

    def example(self, seed, index, input_count):
        example = jax.tree.map(np.array, super().example(seed, index, input_count))
        if index == self.spoilt_at:
            example.targets.images[0, 1, 2, 0] = np.nan  # no background that the network skips
        if index == self.bright_at:
            example.inputs.masks[1] *= 255
        return example


def source_of(cache, config, **spoilt):
    return Spoilt(
        cache, config.views, config.model.conventions.image_size, config.target_size, **spoilt
    )


def batch_of(body, captures, config, step=0):
    return Loader(source_of(CaptureCache(captures, body), config), config.batch_size).batch_at(step)


def random_networks():
    """Returns random loss networks: VGG-19, and LPIPS over VGG-16."""
    # not on the path of the programs that tests start
    from experiments.training import (
        random_weights,
    )

    keys = jax.random.split(jax.random.key(0))
    heads = tuple(jnp.full(count, 1 / count) for count in channels(VGG16))
    return LossNetworks(
        Vgg19(random_weights(keys[0], VGG19)), Lpips(random_weights(keys[1], VGG16), heads, "vgg")
    )
