"""Refines by a learned optimizer: in a few iterations, a small recurrent network reads the photos'
errors at every Gaussian and moves it.

As in ReSplat (https://arxiv.org/abs/2510.08575), the input views are drawn, their errors are
gathered at the Gaussians, and a network that also reads the neighbours of a Gaussian changes its
parameters. All iterations have the same weights, and no gradient passes through the errors. Two
points differ. The errors arrive as the gradient of the squared error with respect to each
Gaussian's parameters, and not as features of a frozen network. The neighbours are those in the
T-pose, at two levels: Gaussians, and clusters of Gaussians. A Gaussian that faces between two
cameras can be 20 cm away from the nearest silhouette of a photo. Messages between Gaussians reach
5 cm; clusters carry them on.

The network was trained (`python -m experiments train_refiner`) on views that are not among the
photos. Parts that no photo shows move with their neighbours. Gradient descent on the photos cannot
do that.
"""

import functools
import os
from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.core.arrays import from_host
from humangs_jax.core.processes import Call
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.tensors import read_safetensors
from humangs_jax.refinement.objective import Image, compiled_part, drawn_photo, pulled
from humangs_jax.refinement.photos import Photo
from humangs_jax.rendering.gaussians import UnconstrainedGaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import Rendering

SHIPPED = "assets/refiner.safetensors"
FIELDS = ("means", "quats", "log_scales", "opacity_logits", "color_logits")
COLUMNS = 14
"""The number of parameters of a Gaussian, all `FIELDS` side by side."""
LARGEST_MOVES = np.asarray([0.01] * 3 + [0.1] * 4 + [0.2] * 3 + [0.5] * 4, np.float32)
"""How far an output of 1 moves each parameter, (14,): metres, quaternion components, log scales,
logits of opacity and colors.
"""
NEIGHBORS = 8
CLUSTER_LEVELS = 9
"""How often the set of Gaussians is halved; there are 2^CLUSTER_LEVELS clusters."""
NEAREST_CLUSTERS = 4
"""The number of clusters that each Gaussian reads."""
CLUSTER_BLUR = 0.01
"""Length, metres, that is added to the distance between a Gaussian and a cluster. The cluster's
weight is 1 divided by the sum.
"""
PERSON = 8000.0
"""The number of pixels that a person covers in the photos of training. Sums over pixels are scaled
to it, so that the size of the photos does not matter.
"""
SEEN = 0.02
"""A Gaussian counts fully as seen in a photo if its largest weight on any pixel is at least this.
If the weight is smaller, the Gaussian counts in proportion.
"""
TYPICAL_LOG_SCALE = -4.5
MOST_PHOTOS = 6
"""The largest number of photos that an iteration reads, as in training. The network was not trained
with sums over more photos, and more photos take longer.
"""


@pytree_dataclass
class Signals:
    """The signals of v photos about g Gaussians, or of one photo without the axis v. Sums over
    pixels are scaled to a person of `PERSON` pixels.
    """

    gradients: Float[Array, "*v g 14"]
    """Gradients of the sum of squared errors of colors and coverage, (v, g, 14). For the colors of
    Gaussians, the errors of a pixel are weighted by the mask.
    """
    visibility: Float[Array, "*v g"]
    """The largest weight of each Gaussian on any pixel of the rendering, (v, g)."""
    pixels: Float[Array, "*v g"]
    """The sum of each Gaussian's weights over all pixels of the rendering, (v, g)."""


@pytree_dataclass
class Neighbors:
    """A symmetric graph of points."""

    index: Int[Array, "g k"]
    """The neighbours of each point, (g, k). Unused places hold the point itself."""
    share: Float[Array, "g k"]
    """1 / the number of a point's neighbours where `index` holds a neighbour, and 0 elsewhere, (g,
    k).
    """


@pytree_dataclass
class Graph:
    """The graph of g Gaussians, and the graph of the clusters that they form."""

    gaussians: Neighbors
    """The neighbours of each Gaussian."""
    clusters: Neighbors
    """The neighbours of each cluster."""
    members: Int[Array, "c m"]
    """The Gaussians of each cluster, (c, m)."""
    nearest: Int[Array, "g n"]
    """The clusters nearest to each Gaussian, (g, n)."""
    weights: Float[Array, "g n"]
    """The weights of these clusters by distance, (g, n); they sum to 1."""


def graph_of(means: Float[np.ndarray, "g 3"]) -> Graph:
    """Returns the graph of Gaussians with these means, metres. Runs on the host."""
    members = clusters_of(means)
    centers = means[members].mean(axis=1)
    distances, nearest = KDTree(centers).query(means, NEAREST_CLUSTERS)
    weights = 1 / (distances + CLUSTER_BLUR)
    weights /= weights.sum(axis=1, keepdims=True)
    indices = from_host(members, jnp.int32), from_host(nearest, jnp.int32)
    return Graph(
        neighbors_of(means), neighbors_of(centers), *indices, from_host(weights, jnp.float32)
    )


def graph_like(g: int) -> Graph:
    """Returns a graph of zeros, whose arrays have the shapes of the graph of g Gaussians."""

    def neighbors(count: int) -> Neighbors:
        index = np.zeros((count, NEIGHBORS))
        return Neighbors(from_host(index, jnp.int32), from_host(index, jnp.float32))

    clusters = 2**CLUSTER_LEVELS
    members, nearest = np.zeros((clusters, -(-g // clusters))), np.zeros((g, NEAREST_CLUSTERS))
    indices = from_host(members, jnp.int32), from_host(nearest, jnp.int32)
    return Graph(neighbors(g), neighbors(clusters), *indices, from_host(nearest, jnp.float32))


def clusters_of(means: Float[np.ndarray, "g 3"]) -> Int[np.ndarray, "c m"]:
    """Returns the indices of the Gaussians in each of 2**CLUSTER_LEVELS clusters of equal size. All
    Gaussians are one cluster at first, and clusters are halved along their longest side
    `CLUSTER_LEVELS` times.

    Some Gaussians occur more than once if their number is not a multiple of the number of clusters.
    """
    count = 2**CLUSTER_LEVELS
    members = np.resize(np.arange(len(means)), (1, count * -(-len(means) // count)))
    for _ in range(CLUSTER_LEVELS):
        points = means[members]
        axis = np.ptp(points, axis=1).argmax(axis=-1)[:, None, None]
        order = np.argsort(np.take_along_axis(points, axis, axis=-1)[..., 0], axis=1, kind="stable")
        members = np.take_along_axis(members, order, axis=1).reshape(2 * len(members), -1)
    return members


def neighbors_of(means: Float[np.ndarray, "g 3"], count: int = NEIGHBORS) -> Neighbors:
    """Returns the graph that joins two points if each is among the `count` nearest of the other.
    Runs on the host.
    """
    total = len(means)
    own = np.arange(total)[:, None]
    nearest = KDTree(means).query(means, min(count + 1, total))[1].reshape(total, -1)[:, 1:]
    pairs = np.sort((own * total + nearest).ravel())
    reverse = nearest * total + own
    if pairs.size:
        mutual = pairs[np.minimum(np.searchsorted(pairs, reverse), len(pairs) - 1)] == reverse
    else:
        mutual = reverse > 0
    share = mutual / np.maximum(mutual.sum(axis=1, keepdims=True), 1)
    return Neighbors(
        from_host(np.where(mutual, nearest, own), jnp.int32), from_host(share, jnp.float32)
    )


@jax.custom_vjp
def neighbor_mean(values: Float[Array, "g c"], neighbors: Neighbors) -> Float[Array, "g c"]:
    """Returns the mean of the values of each point's neighbours, (g, c). It is 0 for a point
    without neighbours.

    Because the graph is symmetric, the gradient is a gather, too. A scatter would be slow on a CPU.
    """
    return jnp.sum(values[neighbors.index] * neighbors.share[..., None], axis=1)


def _mean_forward(values: Array, neighbors: Neighbors) -> tuple[Array, Neighbors]:
    return neighbor_mean(values, neighbors), neighbors


def _mean_backward(neighbors: Neighbors, cotangent: Array) -> tuple[Array, None]:
    shared = cotangent * jnp.max(neighbors.share, axis=1, keepdims=True)
    present = neighbors.share > 0
    return jnp.sum(shared[neighbors.index] * present[..., None], axis=1), None


neighbor_mean.defvjp(_mean_forward, _mean_backward)


class Refiner(nn.Module):
    """The recurrent network of one iteration."""

    width: int = 48
    """The number of features of a Gaussian."""
    layers: int = 2
    """How often Gaussians exchange messages with their neighbours."""
    cluster_layers: int = 3
    """How often clusters exchange messages with their neighbours."""
    per_photo: int = 32
    """The number of features of a Gaussian in one photo."""

    @nn.compact
    def __call__(
        self,
        values: Float[Array, "g 14"],
        start: Float[Array, "g 14"],
        hidden: Float[Array, "g w"],
        signals: Signals,
        graph: Graph,
        center: Float[Array, "3"],
    ) -> tuple[Float[Array, "g 14"], Float[Array, "g w"]]:
        """Returns the values and the hidden features after an iteration.

        values: the parameters side by side. start: the parameters before the first iteration.
        hidden: the features of the iteration before, 0 at first. center: the mean of the joints at
        rest, metres.
        """

        def dense(name, width):
            return nn.Dense(width, name=name)

        # what each photo says about a Gaussian; photos that hardly show it count less
        errors = _relative_errors(values, signals)
        seen = jnp.minimum(signals.visibility / SEEN, 1.0)[..., None]
        logs = jnp.log(signals.pixels[..., None] + 0.1)
        photo = jnp.concatenate([errors, signals.visibility[..., None], logs], axis=-1)
        photo = nn.relu(dense("photo_0", self.per_photo)(photo))
        photo = dense("photo_1", self.per_photo)(photo) * seen
        # photos are pooled, so that their order does not matter
        pooled = [
            jnp.sum(photo, axis=0) / 2,
            jnp.max(photo, axis=0),
            jnp.sum(seen, axis=0) / 4,
            jnp.max(seen, axis=0),
            jnp.sum(errors * seen, axis=0) / jnp.maximum(jnp.sum(seen, axis=0), 1e-3),
        ]
        # what the Gaussian is like, and how far it has moved
        own = [
            values[:, :3] - center,
            values[:, 3:7],
            values[:, 7:10] - TYPICAL_LOG_SCALE,
            values[:, 10:11],
            nn.sigmoid(values[:, 11:]),
            (values - start) / LARGEST_MOVES,
        ]
        features = dense("enter", self.width)(jnp.concatenate([*pooled, *own, hidden], axis=-1))
        # messages from far by the clusters, from near by the neighbours
        features = features + self.from_clusters(features, graph)
        for i in range(self.layers):
            normed = nn.LayerNorm(name=f"norm_{i}")(features)
            message = neighbor_mean(
                nn.relu(dense(f"message_{i}", self.width)(normed)), graph.gaussians
            )
            update = nn.relu(
                dense(f"update_{i}_0", self.width)(jnp.concatenate([normed, message], axis=-1))
            )
            features = features + dense(f"update_{i}_1", self.width)(update)
        # an untrained network moves nothing
        normed = nn.LayerNorm(name="norm")(features)
        moves = nn.Dense(COLUMNS, kernel_init=nn.initializers.zeros, name="moves")(normed)
        return values + moves * LARGEST_MOVES, features

    def from_clusters(self, features: Float[Array, "g w"], graph: Graph) -> Float[Array, "g w"]:
        """Returns the features of the clusters around each Gaussian, (g, w). First the clusters
        exchange messages with their neighbours, and with the mean of all clusters.
        """

        def dense(name):
            return nn.Dense(self.width, name=f"cluster_{name}")

        def norm(name):
            return nn.LayerNorm(name=f"cluster_{name}")

        clusters = dense("enter")(norm("norm")(jnp.mean(features[graph.members], axis=1)))
        for i in range(self.cluster_layers):
            normed = norm(f"norm_{i}")(clusters)
            message = nn.relu(dense(f"message_{i}")(normed))
            everywhere = jnp.broadcast_to(jnp.mean(message, axis=0), message.shape)
            heard = jnp.concatenate(
                [normed, neighbor_mean(message, graph.clusters), everywhere], axis=-1
            )
            clusters = clusters + dense(f"update_{i}_1")(nn.relu(dense(f"update_{i}_0")(heard)))
        around = jnp.sum(
            norm("norm_out")(clusters)[graph.nearest] * graph.weights[..., None], axis=1
        )
        return nn.Dense(self.width, kernel_init=nn.initializers.zeros, name="cluster_out")(around)


def _relative_errors(values: Float[Array, "g 14"], signals: Signals) -> Float[Array, "v g 14"]:
    """Returns the gradients divided by a Gaussian's weight on the pixels, and squashed into (-3,
    3). Gradients with respect to the means are multiplied by the Gaussian's longest axis. Gradients
    of color logits become gradients of colors.
    """
    colors = nn.sigmoid(values[:, 11:])
    longest = jnp.exp(jnp.max(values[:, 7:10], axis=-1, keepdims=True))
    units = [
        jnp.tile(longest, 3),
        jnp.ones((len(values), 8), values.dtype),
        1 / (colors * (1 - colors) + 0.01),
    ]
    errors = (
        30 * signals.gradients * jnp.concatenate(units, axis=-1) / (signals.pixels[..., None] + 1.0)
    )
    return 3 * errors / (1 + jnp.abs(errors))


def stacked(parameters: UnconstrainedGaussians) -> Float[Array, "g 14"]:
    """Returns the parameters of the Gaussians side by side."""
    return jnp.concatenate(
        [getattr(parameters, name).reshape(len(parameters.means), -1) for name in FIELDS], axis=-1
    )


def unstacked(values: Float[Array, "g 14"], like: UnconstrainedGaussians) -> UnconstrainedGaussians:
    """Returns the parameters that `stacked` has put side by side, in the shapes of `like`."""
    shapes = {name: getattr(like, name) for name in FIELDS}
    ends = np.cumsum([x[0].size for x in shapes.values()])
    parts = jnp.split(values, ends[:-1], axis=-1)
    return replace(
        like,
        **{
            name: part.reshape(x.shape)
            for (name, x), part in zip(shapes.items(), parts, strict=True)
        },
    )


def learned_update(
    parameters: UnconstrainedGaussians,
    avatar: Avatar,
    photos: Sequence[Photo],
    graph: Graph,
    iterations: int,
    splat: SplatConfig,
) -> tuple[UnconstrainedGaussians, Int[Array, ""]]:
    """Returns the parameters after `iterations` of the learned update, and the number of (splat,
    tile) pairs that the buffers had no room for. splat: has `visibility=True`. At most
    `MOST_PHOTOS` of the photos are used, evenly spaced.
    """
    start = values = side_by_side(parameters)
    hidden = from_host(np.zeros((len(values), Refiner.width), values.dtype))
    overflow = from_host(0, jnp.int32)
    used = min(len(photos), MOST_PHOTOS)
    chosen = [photos[i * len(photos) // used] for i in range(used)]
    for _ in range(iterations):
        each = [photo_signals(parameters, avatar, photo, splat) for photo in chosen]
        parameters, values, hidden, overflow = _iteration_by(
            load_refiner(), parameters, values, start, hidden, overflow, each, graph, avatar
        )
    return parameters, overflow


def calls_of_update(
    parameters: UnconstrainedGaussians,
    avatar: Avatar,
    photos: Sequence[Photo],
    graph: Graph,
    splat: SplatConfig,
) -> Iterator[Call]:
    """Yields the programs of `learned_update` that take long to compile, with their arguments, in
    the order of their use.
    """
    photo, used = photos[0], min(len(photos), MOST_PHOTOS)
    drawing = parameters, avatar, photo, splat
    yield drawn_photo, drawing
    image, pull_back, rendering = drawn_photo.eval_shape(*drawing)
    yield pulled, (pull_back, image)
    gradient, pixels = pulled.eval_shape(pull_back, image)
    signals = _signals_from.eval_shape(gradient, gradient, pixels, rendering, photo)
    values = side_by_side.eval_shape(parameters)
    hidden, overflow = np.zeros((len(values), Refiner.width), values.dtype), np.zeros((), np.int32)
    each = [(signals, rendering.overflow)] * used
    of_all = load_refiner(), parameters, values, values, hidden, overflow, each, graph, avatar
    yield _iteration_by, of_all


@compiled_part
def side_by_side(parameters: UnconstrainedGaussians) -> Float[Array, "g 14"]:
    """Returns `stacked` parameters, as a compiled program."""
    return stacked(parameters)


@compiled_part
def _iteration_by(
    variables: PyTree,
    parameters: UnconstrainedGaussians,
    values: Float[Array, "g 14"],
    start: Float[Array, "g 14"],
    hidden: Float[Array, "g w"],
    overflow: Int[Array, ""],
    each: Sequence[tuple[Signals, Int[Array, ""]]],
    graph: Graph,
    avatar: Avatar,
) -> tuple[UnconstrainedGaussians, Float[Array, "g 14"], Float[Array, "g w"], Int[Array, ""]]:
    """Returns the parameters, the values, the hidden features, and the overflow so far, after an
    iteration. each: the `photo_signals` of each photo.
    """
    signals, missing = jax.tree.map(lambda *x: jnp.stack(x), *each)
    values, hidden = refiner_iteration(variables, values, start, hidden, signals, graph, avatar)
    return unstacked(values, parameters), values, hidden, overflow + jnp.sum(missing)


def photo_signals(
    parameters: UnconstrainedGaussians, avatar: Avatar, photo: Photo, splat: SplatConfig
) -> tuple[Signals, Int[Array, ""]]:
    """Returns the signals of one photo, without the axis v, and the number of (splat, tile) pairs
    that the buffers had no room for.

    `gradients` are of the errors on the pixels that count (`Photo.counted`). `visibility` and
    `pixels` are over all pixels.

    splat: has `visibility=True`.
    """
    image, pull_back, rendering = drawn_photo(parameters, avatar, photo, splat)
    gradient, _ = pulled(pull_back, _squared_errors(image, photo))
    foreground, _ = pulled(pull_back, _foreground_errors(image, photo))
    _, pixels = pulled(pull_back, _colors_alone(image))
    return _signals_from(gradient, foreground, pixels, rendering, photo), rendering.overflow


@compiled_part
def _squared_errors(image: Image, photo: Photo) -> Image:
    """Returns the gradient of the sum of squared errors of colors and alpha, over the pixels that
    count, with respect to the image.
    """
    rgb = jnp.where(photo.counted[..., None], image[0] - photo.image, 0)
    return 2 * rgb, 2 * jnp.where(photo.counted, image[1] - photo.mask, 0)


@compiled_part
def _foreground_errors(image: Image, photo: Photo) -> Image:
    """Returns the gradient of the squared color errors, weighted by the mask, with respect to the
    image. A Gaussian in front of the background should fade and not take the background's color.
    """
    rgb, alpha = _squared_errors(image, photo)
    return rgb * photo.mask[..., None], jnp.zeros_like(alpha)


@compiled_part
def _colors_alone(image: Image) -> Image:
    """Returns the gradient of the sum of all colors with respect to the image."""
    return jnp.ones_like(image[0]), jnp.zeros_like(image[1])


@compiled_part
def _signals_from(
    gradient: UnconstrainedGaussians,
    foreground: UnconstrainedGaussians,
    pixels: Float[Array, " g"],
    rendering: Rendering,
    photo: Photo,
) -> Signals:
    """Returns the signals of a photo. gradient, foreground, pixels: the results of
    `_squared_errors`, `_foreground_errors` and `_colors_alone`, each pulled back to the Gaussians.
    """
    assert rendering.visibility is not None
    scale = PERSON / jnp.maximum(jnp.sum(photo.mask), 1.0)
    gradient = replace(gradient, color_logits=foreground.color_logits)
    # a change of all three colors of a Gaussian changes the sum of an image by three times its
    # weights
    return Signals(scale * stacked(gradient), rendering.visibility, scale * pixels / 3)


@compiled_part
def refiner_iteration(
    variables: PyTree,
    values: Float[Array, "g 14"],
    start: Float[Array, "g 14"],
    hidden: Float[Array, "g w"],
    signals: Signals,
    graph: Graph,
    avatar: Avatar,
) -> tuple[Float[Array, "g 14"], Float[Array, "g w"]]:
    """Returns the values and hidden features after one iteration of the `Refiner` on an avatar."""
    center = jnp.mean(avatar.rest_joints, axis=0)
    return cast(Any, Refiner().apply(variables, values, start, hidden, signals, graph, center))


def save_refiner(path: str | os.PathLike[str], variables: PyTree) -> None:
    """Writes the variables of a `Refiner` as a safetensors file. If writing fails, the path stays
    as it was. Raises: OSError.
    """
    from safetensors.numpy import save

    tensors = {
        f"{layer}/{name}": np.asarray(x)
        for layer, own in variables["params"].items()
        for name, x in own.items()
    }
    write_bytes(path, save(tensors))


def read_refiner(path: str | os.PathLike[str]) -> PyTree:
    """Returns the variables that `save_refiner` wrote.

    Raises: FileNotFoundError; FileError if it is no safetensors file; ValueError if the name of a
    tensor is not LAYER/NAME.
    """
    variables: dict[str, Any] = {}
    for key, tensor in read_safetensors(path)[0].items():
        layer, name = key.split("/")
        variables.setdefault(layer, {})[name] = from_host(tensor, jnp.float32)
    return {"params": variables}


@functools.cache
def load_refiner() -> PyTree:
    """Returns the variables of the `Refiner` that comes with the package."""
    with resources.as_file(resources.files("humangs_jax").joinpath(SHIPPED)) as path:
        return read_refiner(path)
