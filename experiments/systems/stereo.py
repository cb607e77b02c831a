"""GPS-Gaussian-style: every pixel of the two photos nearest to a target becomes a Gaussian, at a
depth found by stereo.

Theirs (Zheng et al. 2024, https://arxiv.org/abs/2312.02155): of cameras around a person the two
beside the target are rectified; their features are compared along the rows, and a recurrent network
of the kind of RAFT-Stereo finds disparities; a U-Net on photos, features and depths gives rotation,
scale and opacity of a Gaussian a pixel, whose color is the pixel's. Depths are supervised by scans
first. There is no body: it shows other views of the pose in the photos, and CANNOT be animated.

Our reading: a photo is compared with the photo whose direction is nearest to its own, whatever the
target is, so that a person is modelled once; features meet at a fixed number of distances along the
ray of each pixel (a plane sweep, Collins 1996), not in rectified rows; a U-Net on what they have in
common gives scores of these distances, whose mean under a softmax is the depth, in one step, and
the rest of the Gaussian; depths are learned from images alone. The posed body gives the range of
distances and nothing else. Photos here are a quarter of a circle apart where there are four; theirs
45 degrees.
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
"""Of a quaternion, the logarithms of scales, and an opacity."""
COVERAGE, SCALING = 0.7, 2.0
"""First standard deviation over the distance between pixels; bound of what the logarithm of a scale
may change.
"""
SHARPNESS = 5.0
"""Of the softmax over what the features of two photos have in common, a cosine."""
ABSENT = -2.0
"""Less than any cosine."""


@pytree_dataclass
class PixelGaussians:
    """gaussians: (v, h w, ...) in the world, a set a photo. directions: (v, 3) unit, from the
    person to the cameras; middle: (3,) of the person, metres. present: (v,) photos that are no
    padding.
    """

    gaussians: Gaussians
    directions: Float[Array, "v 3"]
    middle: Float[Array, "3"]
    present: Bool[Array, " v"]


@part
class StereoDecoder(Decoder):
    """Photos -> a Gaussian a pixel."""

    widths: tuple[Width, ...] = (32, 48, 96)
    """Of both U-Nets; the first is the number of features that are compared."""
    planes: Count = 64
    """Distances."""
    margin: Spread = 0.15
    """Of the range of distances around the body, normalised units."""

    def __post_init__(self):
        """Raises ValueError for widths that no U-Net has."""
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
        near = jnp.where(
            inputs.present & ~jnp.eye(len(images), dtype=bool), directions @ directions.T, ABSENT
        )
        partners = jnp.argmax(near, axis=1)
        # features that are compared, of unit length
        photos = jnp.concatenate([2 * images - 1, inputs.foreground[..., None]], axis=-1)
        maps = safe_normalize(
            UNet(self.widths, self.widths[:1], name="features")(photos), jnp.zeros(self.widths[0])
        )

        def sweep(
            camera: Camera, points: Float[Array, "n 3"], own: Array, other: Array, partner: Camera
        ) -> tuple[Array, ...]:
            """How alike each pixel is to the other photo, for planes around the body."""
            origin, rays = pixel_rays(camera)
            reach = jnp.linalg.norm(points - origin, axis=-1)
            low, high = jnp.min(reach) - self.margin * unit, jnp.max(reach) + self.margin * unit
            distances = low + (high - low) * jnp.linspace(0, 1, self.planes)

            def common(distance: Array) -> Array:
                """How alike the pixels are if they were that far away."""
                pixels, _ = project_vertices(partner, (origin + distance * rays).reshape(-1, 3))
                there = sample_bilinear(other, texel_indices(pixels, size, size, grid)).reshape(
                    own.shape
                )
                return SHARPNESS * jnp.sum(own * there, axis=-1)

            return jnp.moveaxis(jax.lax.map(common, distances), 0, -1), distances, origin, rays

        # the network reads photos, features and costs, and gives scores and Gaussians a pixel
        others = jax.tree.map(lambda x: x[partners], (maps, cameras))
        costs, distances, origins, rays = jax.vmap(sweep)(cameras, vertices, maps, *others)
        raw = UNet(self.widths, (self.planes, sum(CHANNELS)), name="gaussians")(
            jnp.concatenate([photos, maps, costs], axis=-1)
        )

        def pixels(
            image: Array, seen: Array, raw: Array, cost: Array, distances: Array, *seen_from: Array
        ) -> Gaussians:
            """A Gaussian a pixel of a photo, at the distance that the costs and scores expect."""
            origin, rays, focal = seen_from
            scores, quats, scales, opacities = jnp.split(
                raw, self.planes + np.cumsum([0, *CHANNELS[:2]]), axis=-1
            )
            reach = (jax.nn.softmax(cost + scores) @ distances)[..., None]

            def flat(x):
                return x.reshape(-1, x.shape[-1])

            return Gaussians(
                means=flat(origin + reach * rays),
                quats=quaternion.normalize(
                    flat(quats) + jnp.asarray(quaternion.IDENTITY, raw.dtype)
                ),
                scales=flat(
                    COVERAGE * reach / focal * jnp.exp(SCALING * jnp.tanh(scales / SCALING))
                ),
                opacities=jnp.where(
                    seen, jax.nn.sigmoid(opacities[..., 0] + INITIAL_OPACITY), 0.0
                ).reshape(-1),
                colors=flat(image),
            )

        of_views = (
            images,
            inputs.foreground,
            raw,
            costs,
            distances,
            origins,
            rays,
            cameras.K[:, 0, 0],
        )
        scene = PixelGaussians(jax.vmap(pixels)(*of_views), directions, middle, inputs.present)
        return HumanGSOutputs(no_gaussians(), scene=scene)


@part
class NearestPairDriver(TargetDecoder):
    """Draws the Gaussians of the two photos that are nearest to a target. Nothing is learned."""

    moves = False

    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """The outputs: which photos are near, their cameras say."""
        return outputs

    @nn.nowrap
    def draw(self, variables, outputs, body, photos, targets, backgrounds, config) -> Drawn:
        posed = jax.vmap(lambda center: nearest_pair(outputs.scene, center))(targets.cameras.center)
        return draw_posed(posed, targets, backgrounds, config)._replace(
            opacities=posed.opacities.reshape(-1)
        )

    @nn.nowrap
    def show(
        self, variables, config, inputs, targets, background
    ) -> tuple[np.ndarray, Float[np.ndarray, "v h w"]]:
        """See `parts.TargetDecoder`.

        The pose of a target changes nothing; their world has to be y-up.
        """
        scene = reconstructed(variables, config, inputs)[0].scene
        return drawn(
            (nearest_pair(scene, center) for center in targets.cameras.center),
            targets.cameras,
            background,
            config,
        )


def nearest_pair(scene: PixelGaussians, center: Float[Array, "3"]) -> Gaussians:
    """Of the two photos from which the person is seen most like from a point, metres.

    Raises: ValueError for a single photo.
    """
    if len(scene.present) < 2:
        raise ValueError("1 photo: this system takes at least 2")
    towards = safe_normalize(center - scene.middle, jnp.zeros(3))
    pair = jax.lax.top_k(jnp.where(scene.present, scene.directions @ towards, ABSENT), 2)[1]
    chosen = jax.tree.map(lambda x: x[pair].reshape(-1, *x.shape[2:]), scene.gaussians)
    absent = jnp.repeat(~scene.present[pair], len(chosen.opacities) // 2)
    return replace(chosen, opacities=jnp.where(absent, 0.0, chosen.opacities))
