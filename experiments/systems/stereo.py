"""Parts of GPS-Gaussian-style systems: every pixel of the two photos nearest to a target becomes a
Gaussian, at a depth found by stereo.

GPS-Gaussian (Zheng et al. 2024, https://arxiv.org/abs/2312.02155) takes the two cameras beside the
target among those around a person, and rectifies them. Their features are compared along the rows,
and a recurrent network like RAFT-Stereo finds disparities. A U-Net on photos, features and depths
predicts rotation, scale and opacity of a Gaussian for each pixel, which has the pixel's color.
Depths are first supervised by scans. There is no body, so the system shows other views of the pose
in the photos, and CANNOT be animated.

In our reading a photo is compared with the photo from the nearest direction, for all targets, so
that a person is modelled once. Features are compared at a fixed number of distances along the ray
of each pixel (a plane sweep, Collins 1996), not in rectified rows. A U-Net on the similarities
predicts scores of these distances, whose mean under a softmax is the depth, and the rest of the
Gaussian. Depths are learned from images alone. The posed body is used only for the range of
distances. Four photos here are a quarter of a circle apart, GPS-Gaussian's 45 degrees.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.systems.pixel_queries import no_gaussians
from experiments.systems.targets import drawn, reconstructed
from experiments.systems.unet import UNet, check_scales
from humangs_jax.core.array_types import Array, Bool, Float, PyTree
from humangs_jax.core.configuration import Count, Spread, Width, part
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.camera import Camera, pixel_rays
from humangs_jax.network.maps import sample_bilinear, texel_indices
from humangs_jax.network.parts import (
    Decoder,
    Drawn,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Target,
    TargetDecoder,
    subject_unit,
)
from humangs_jax.network.reader import project_vertices
from humangs_jax.network.vertex_decoder import INITIAL_OPACITY
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.training.forward import draw_posed

CHANNELS = 4, 3, 1
"""Numbers of a quaternion, of the logarithms of scales, and of an opacity."""
COVERAGE, SCALING = 0.7, 2.0
"""Initial standard deviation as a share of the distance between pixels, and bound of the change of
the logarithm of a scale.
"""
SHARPNESS = 5.0
"""Factor of the cosine between the features of two photos in the softmax over distances."""
ABSENT = -2.0
"""A number that is less than any cosine."""


@pytree_dataclass
class PixelGaussians:
    """Gaussians of the pixels of v photos."""

    gaussians: Gaussians
    """(v, h w, ...) Gaussians in the world, a set for each photo."""
    directions: Float[Array, "v 3"]
    """Unit vectors from the person to the cameras."""
    middle: Float[Array, "3"]
    """Middle of the person in metres."""
    present: Bool[Array, " v"]
    """Whether a photo is no padding."""


@part
class StereoDecoder(Decoder):
    """A decoder that makes a Gaussian for each pixel of the photos."""

    widths: tuple[Width, ...] = (32, 48, 96)
    """Numbers of features of both U-Nets. The first is the number of features that are compared."""
    planes: Count = 64
    """Number of distances."""
    margin: Spread = 0.15
    """Distance by which the range exceeds that of the body on both sides, normalised units."""

    def __post_init__(self):
        """Raises a ValueError for widths that no U-Net has."""
        super().__post_init__()
        check_scales("decoder.widths", self.widths)

    @nn.compact
    def __call__(
        self, features: PyTree, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.Decoder`. A photo without another one is compared with itself."""
        images, cameras, vertices = inputs.images, inputs.cameras, inputs.posed_vertices
        size, grid = (cameras.width, cameras.height), ctx.conventions.pixel_grid
        unit = subject_unit(inputs.canonical_vertices)
        # each photo is compared with the one that sees the person from the nearest direction
        middle = jnp.mean(vertices[0], axis=0)
        directions = safe_normalize(cameras.center - middle, jnp.zeros(3))
        other = inputs.present & ~jnp.eye(len(images), dtype=bool)
        near = jnp.where(other, directions @ directions.T, ABSENT)
        partners = jnp.argmax(near, axis=1)
        # features that are compared, of unit length
        photos = jnp.concatenate([2 * images - 1, inputs.foreground[..., None]], axis=-1)
        compared = UNet(self.widths, self.widths[:1], name="features")(photos)
        maps = safe_normalize(compared, jnp.zeros(self.widths[0]))

        def sweep(
            camera: Camera, points: Float[Array, "n 3"], own: Array, other: Array, partner: Camera
        ) -> tuple[Array, ...]:
            """Returns how alike each pixel and the other photo are at each distance around the
            body, the distances, and the origin and the rays of the pixels.
            """
            origin, rays = pixel_rays(camera)
            reach = jnp.linalg.norm(points - origin, axis=-1)
            low, high = jnp.min(reach) - self.margin * unit, jnp.max(reach) + self.margin * unit
            distances = low + (high - low) * jnp.linspace(0, 1, self.planes)

            def common(distance: Array) -> Array:
                """Returns how alike the pixels and the other photo are at one distance."""
                pixels, _ = project_vertices(partner, (origin + distance * rays).reshape(-1, 3))
                there = sample_bilinear(other, texel_indices(pixels, size, size, grid))
                there = there.reshape(own.shape)
                return SHARPNESS * jnp.sum(own * there, axis=-1)

            return jnp.moveaxis(jax.lax.map(common, distances), 0, -1), distances, origin, rays

        # the network predicts scores and a Gaussian for each pixel from photos, features and costs
        others = jax.tree.map(lambda x: x[partners], (maps, cameras))
        costs, distances, origins, rays = jax.vmap(sweep)(cameras, vertices, maps, *others)
        raw = UNet(self.widths, (self.planes, sum(CHANNELS)), name="gaussians")(
            jnp.concatenate([photos, maps, costs], axis=-1)
        )

        def pixels(
            image: Array, seen: Array, raw: Array, cost: Array, distances: Array, *seen_from: Array
        ) -> Gaussians:
            """Returns a Gaussian for each pixel of a photo, at the mean distance by costs and
            scores.
            """
            origin, rays, focal = seen_from
            ends = self.planes + np.cumsum([0, *CHANNELS[:2]])
            scores, quats, scales, opacities = jnp.split(raw, ends, axis=-1)
            reach = (jax.nn.softmax(cost + scores) @ distances)[..., None]

            def flat(x):
                return x.reshape(-1, x.shape[-1])

            turned = flat(quats) + jnp.asarray(quaternion.IDENTITY, raw.dtype)
            growth = jnp.exp(SCALING * jnp.tanh(scales / SCALING))
            alpha = jax.nn.sigmoid(opacities[..., 0] + INITIAL_OPACITY)
            return Gaussians(
                means=flat(origin + reach * rays),
                quats=quaternion.normalize(turned),
                scales=flat(COVERAGE * reach / focal * growth),
                opacities=jnp.where(seen, alpha, 0.0).reshape(-1),
                colors=flat(image),
            )

        seen_from = origins, rays, cameras.K[:, 0, 0]
        of_views = images, inputs.foreground, raw, costs, distances, *seen_from
        scene = PixelGaussians(jax.vmap(pixels)(*of_views), directions, middle, inputs.present)
        return HumanGSOutputs(no_gaussians(), scene=scene)


@part
class NearestPairDriver(TargetDecoder):
    """Draws the Gaussians of the two photos that are nearest to a target, and learns nothing."""

    moves = False

    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns the outputs unchanged. Only cameras say which photos are near."""
        return outputs

    @nn.nowrap
    def draw(self, variables, outputs, body, photos, targets, backgrounds, config) -> Drawn:
        """See `parts.TargetDecoder`."""
        posed = jax.vmap(lambda center: nearest_pair(outputs.scene, center))(targets.cameras.center)
        found = draw_posed(posed, targets, backgrounds, config)
        return found._replace(opacities=posed.opacities.reshape(-1))

    @nn.nowrap
    def show(
        self, variables, config, inputs, targets, background
    ) -> tuple[np.ndarray, Float[np.ndarray, "v h w"]]:
        """See `parts.TargetDecoder`.

        The pose of a target changes nothing. The world of the targets has to be y-up.
        """
        scene = reconstructed(variables, config, inputs)[0].scene
        pairs = (nearest_pair(scene, center) for center in targets.cameras.center)
        return drawn(pairs, targets.cameras, background, config)


def nearest_pair(scene: PixelGaussians, center: Float[Array, "3"]) -> Gaussians:
    """Returns the Gaussians of the two photos whose directions are nearest to that of a point (3,)
    in metres.

    Raises: ValueError for a single photo.
    """
    if len(scene.present) < 2:
        raise ValueError("1 photo: this system takes at least 2")
    towards = safe_normalize(center - scene.middle, jnp.zeros(3))
    pair = jax.lax.top_k(jnp.where(scene.present, scene.directions @ towards, ABSENT), 2)[1]
    chosen = jax.tree.map(lambda x: x[pair].reshape(-1, *x.shape[2:]), scene.gaussians)
    absent = jnp.repeat(~scene.present[pair], len(chosen.opacities) // 2)
    return replace(chosen, opacities=jnp.where(absent, 0.0, chosen.opacities))
