"""Gradients from photos through network, skinning and rendering to the loss, in float64.

Differentiated are the network's parameters, the photos, the cameras, the posed and canonical
vertices and position maps of the inputs, and pose, shape and camera of every target. Depth maps and
foreground only decide. `prepare_inputs`, which rasterizes, is left out: training stops gradients
there.

The loss has jumps and kinks: a splat's alpha crosses 1/255 on a pixel, two splats change places, a
unit of a ReLU turns on, a position leaves a texel. A jump within a step spoils its difference.
Differences to both sides and smaller steps are therefore tried as well; none of them lets a wrong
gradient pass.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.body.library import load_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.losses.loss_networks import NO_NETWORKS
from humangs_jax.losses.losses import loss_terms
from humangs_jax.network.config import paper_parts
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables
from humangs_jax.training.config import LossConfig, TrainConfig
from humangs_jax.training.forward import draw_targets, white_backgrounds

VERTICES, JOINTS, VIEWS, TARGETS, SIZE, TARGET_SIZE = 200, 55, 2, 2, 32, 24
CHANGES = (1e-8, 1e-9, 1e-10, 5e-11)
"""Changes of the loss that the steps aim at.

The loss is about 0.4, its rounding a few 1e-17. The last one is for kinks close to the point: only
one side is smooth there, and its error falls with the step (1e-5 at 1e-10).
"""
AGREEMENT = 5e-6
"""Largest difference, relative to the derivative: what rounding leaves of a change of 1e-10."""
SMALLEST_DERIVATIVE = 1e-6
"""Least derivative where everything moves by its own size.

That of the neural texture is 1e-5; a part that is cut off has none.
"""
SEEN = (0.05, 0.5)
"""Least and largest mean coverage of the images, so that a person is seen."""
FLOAT32_COSINE = 0.999
DTYPES = (jnp.float32, jnp.float64)
PARAMETER_GROUPS = ("texture", "tokenizer", "transformer", "upsampler", "decoder")
OTHERS = ("images", "input_geometry", "target_pose", "target_cameras")
GEOMETRY = ("cameras", "posed_vertices", "canonical_vertices", "position_maps")
FLAGS = ("remat", "train", "scan", "bare")
INSIDE = 0.93
"""Texture position of pixels beside the body: 3.255 texels from the middle."""
POSE = ("rotations", "translations", "betas")


@dataclasses.dataclass(frozen=True)
class Case:
    """What the network and its inputs are.

    Style "published" has the conventions of the published network: mixed pixel grid, rotation
    skinning, unbounded offsets, Gouraud maps. The other style has those of the small network:
    corrected photo colors, affine skinning, bounded offsets. `train` uses the statistics of the
    batch. `bare` has neither class token nor upsampler, and a head that corrects skinning weights.
    """

    style: str
    tokens: str
    pool: str
    remat: bool
    train: bool = False
    scan: bool = False
    bare: bool = False

    def __str__(self):
        return "-".join(
            [self.style, self.tokens, self.pool, *(flag for flag in FLAGS if getattr(self, flag))]
        )

    @property
    def config(self) -> TrainConfig:
        """The configuration of training, with a tiny network."""
        model = tiny()
        published = self.style == "published"
        encoder, reader, decoder = paper_parts(model.architecture)
        transformer = dataclasses.replace(encoder.transformer, class_token=not self.bare)
        decoder = dataclasses.replace(
            decoder,
            residual_color=not published,
            offset_scale=None if published else 0.25,
            skinning_joints=JOINTS if self.bare else None,
        )
        # parts, then conventions, as the fields of the case say
        model = model.with_parts(
            encoder=dataclasses.replace(
                encoder, transformer=transformer, upsampler=None if self.bare else encoder.upsampler
            ),
            reader=dataclasses.replace(
                reader,
                output_width=None if self.bare else reader.output_width,
                sample_rgb=not published,
            ),
            decoder=decoder,
        )
        model = model.with_conventions(
            pool=self.pool,
            pixel_grid="mixed" if published else "half_pixel",
            skinning="rotation" if published else "affine",
            position_map="gouraud" if published else "plain",
            ray_origins="twice_normalized" if published else "normalized",
        )
        remat = "full" if self.remat else "none"
        model = model.with_runtime(
            tokens=self.tokens, token_capacity=40, remat=remat, scan=self.scan
        )
        return TrainConfig(
            model=model, loss=LossConfig(structural_scales=2), target_size=TARGET_SIZE
        )


PUBLISHED = Case("published", "all", "all", remat=False)
SMALL = Case("small", "foreground", "visible", remat=True, train=True, scan=True)
FAST = (PUBLISHED, SMALL)
SLOW = [
    Case("published", "foreground", "visible", remat=True),
    Case("published", "all", "visible", remat=True, train=True),
    Case("small", "all", "all", remat=True, train=True, scan=True),
    *(
        Case(style, "foreground", "visible", remat=False, bare=True)
        for style in ("published", "small")
    ),
]

pytestmark = pytest.mark.usefixtures("float64")


def as_dtype(tree, dtype):
    """Returns the tree in numpy; JAX would compile an operation for every shape of a leaf."""
    cast = lambda x: x.astype(dtype) if np.issubdtype(x.dtype, np.floating) else x
    return jax.tree.map(lambda x: cast(np.asarray(x)), tree)


def as_jax(tree):
    return jax.tree.map(jnp.asarray, tree)


@functools.cache
def body():
    return as_jax(as_dtype(decimate(load_body(), VERTICES), np.float64))


def cameras(count, size, distance, azimuth):
    K = intrinsics_from_fov(0.9, size, size).astype(jnp.float64)
    azimuths = azimuth + 2.1 * jnp.arange(count, dtype=jnp.float64)
    return orbit(jnp.asarray([0.0, 0.95, 0.0], jnp.float64), distance, azimuths, 0.2, K, size, size)


def random_views(seed, count, size, betas):
    """Returns views of noise in a pose, far from the targets, so that each pixel counts."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size] / size - 0.5
    masks = np.broadcast_to((x / 0.25) ** 2 + (y / 0.45) ** 2 < 1, (count, size, size)).astype(
        np.float64
    )
    return SubjectViews(
        images=jnp.asarray(rng.uniform(0.1, 0.9, (count, size, size, 3))),
        masks=jnp.asarray(masks),
        cameras=cameras(count, size, 2.3, 0.3 * seed),
        rotations=jnp.asarray(0.25 * rng.normal(size=(count, JOINTS, 3))),
        translations=jnp.asarray(0.05 * rng.normal(size=(count, 3))),
        betas=betas,
    )


def random_variables(config):
    """Returns variables in which every number matters; Gaussians are as large as their distance."""
    rng = np.random.default_rng(0)
    shapes = expected_variables(config)

    def draw(path, leaf):
        names = [entry.key for entry in path]
        noise = rng.normal(size=leaf.shape)
        if names[-1] in ("scale", "var"):
            return 1 + 0.1 * np.abs(noise)
        if names[-1] == "bias" and names[-2] == "geometry_out":
            bias = [0, 0, 0, 1, 0, 0, 0, -3, -3, -3]  # softplus(-3) is 5 cm
            return np.tile(bias, len(noise) // len(bias)) + 0.2 * noise * (
                np.abs(np.tile(bias, len(noise) // 10)) > 0
            )
        small = 0.1 if names[-2] in ("geometry_out",) else 1.0
        fan_in = np.prod(leaf.shape[:-1]) if leaf.ndim > 1 else 100
        return small * noise / np.sqrt(fan_in)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def group_of(path):
    names = [entry.key for entry in path]
    if "texture" in names:
        return "texture"
    if "class_token" in names:
        return "tokenizer"
    return next(
        {"reader": "upsampler"}.get(name, name)
        for name in names
        if name not in ("params", "encoder")
    )


@functools.cache
def in_a_hurry():
    """Returns options with which XLA compiles fast.

    Compilation costs ten times what optimised code would save. jax 0.12 lacks one of the options.
    """
    options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(jnp.sin, compiler_options=options)(0.0)
    except RuntimeError:
        options.pop("xla_cpu_use_fusion_emitters")
    return options


@functools.cache
def subject(position_map):
    """Returns (inputs of the network, targets) of one person."""
    betas = jnp.asarray(np.random.default_rng(5).normal(size=4))
    prepare = jax.jit(prepare_inputs, static_argnames="config", compiler_options=in_a_hurry())
    config = tiny().with_conventions(position_map=position_map)
    return prepare(body(), random_views(1, VIEWS, SIZE, betas), config=config), random_views(
        2, TARGETS, TARGET_SIZE, betas
    )


def starting_point(inputs, targets, params):
    """Returns everything that is differentiated, by group.

    Pixels beside the body have a position on the border of the texture, where steps in and out
    differ. They are moved inside, between texels.
    """
    positions = jnp.where((inputs.depth_maps >= 0)[..., None], inputs.position_maps, INSIDE)
    return {
        "params": params,
        "images": inputs.images,
        "input_geometry": {name: getattr(inputs, name) for name in GEOMETRY}
        | {"position_maps": positions},
        "target_pose": {name: getattr(targets, name) for name in POSE},
        "target_cameras": targets.cameras,
    }


@functools.cache
def compiled(case, dtype):
    """Returns a compiled function, a point and what is fixed.

    The function maps (point, fixed) to ((loss, facts), gradients).
    """
    config = case.config
    variables = random_variables(config.model)
    inputs, targets = subject(config.model.conventions.position_map)
    point = starting_point(inputs, targets, variables["params"])
    point, fixed, own_body = as_dtype(
        (point, (inputs, targets, variables["batch_stats"]), body()), dtype
    )

    # what is differentiated replaces its part of the inputs, targets and variables
    def loss(point, fixed):
        inputs, targets, batch_stats = fixed
        inputs = replace(inputs, images=point["images"], **point["input_geometry"])
        targets = replace(targets, cameras=point["target_cameras"], **point["target_pose"])
        variables = {"params": point["params"], "batch_stats": batch_stats}
        outputs, _ = apply_humangs(variables, inputs, config.model, case.train)
        given = as_jax(own_body), targets, targets, white_backgrounds(targets), config
        drawn = draw_targets(variables, outputs, *given)
        terms = loss_terms(
            drawn, targets.images, targets.masks, targets.depths, config.loss, NO_NETWORKS
        )
        total = sum(getattr(config.loss, name) * term for name, term in terms.items())
        return total, {
            "overflow": jnp.sum(drawn.rendering.overflow),
            "dropped": outputs.dropped_tokens,
            "alpha": drawn.rendering.alpha,
        }

    differentiated = jax.jit(jax.value_and_grad(loss, has_aux=True), compiler_options=in_a_hurry())
    return differentiated.lower(point, fixed).compile(), point, fixed


def by_group(point):
    """Returns the paths of a point's leaves by group: a part of the network, or another input."""
    found = {}
    for path, _ in jax.tree_util.tree_leaves_with_path(point):
        name = path[0].key
        found.setdefault(group_of(path[1:]) if name == "params" else name, set()).add(path)
    return found


def root_mean_square(x):
    return np.sqrt(np.mean(np.square(x)))


def random_direction(point, paths, rng):
    """Returns random moves of the leaves at `paths`, each of about its leaf's size, 0 elsewhere."""

    def draw(path, leaf):
        return rng.normal(size=leaf.shape) * root_mean_square(leaf) * (path in paths)

    return jax.tree_util.tree_map_with_path(draw, point)


def inner(a, b):
    return sum(
        float(np.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.mark.slow
@pytest.mark.parametrize("case", (*FAST, *SLOW), ids=str)
def test_gradients_agree_with_differences(case):
    function, point, fixed = compiled(case, jnp.float64)
    (loss, facts), gradients = jax.device_get(function(point, fixed))
    assert int(facts["overflow"]) == int(facts["dropped"]) == 0
    assert SEEN[0] < np.mean(facts["alpha"]) < SEEN[1]
    rng = np.random.default_rng(3)
    assert set(by_group(point)) == {*PARAMETER_GROUPS, *OTHERS} - (
        {"upsampler"} if case.bare else set()
    )
    for group, paths in by_group(point).items():
        direction = random_direction(point, paths, rng)
        derivative = inner(gradients, direction)
        # its standard deviation over directions of this size
        weighted = jax.tree.map(lambda x, d: x * root_mean_square(d), gradients, direction)
        expected = np.sqrt(inner(weighted, weighted))
        assert expected > SMALLEST_DERIVATIVE, f"nothing depends on {group}"

        def value(step, direction=direction):
            return float(
                function(jax.tree.map(lambda x, d: x + step * d, point, direction), fixed)[0][0]
            )

        errors = []
        for change in CHANGES:
            step = change / expected
            forward, backward = (value(step) - loss) / step, (loss - value(-step)) / step
            differences = np.asarray([(forward + backward) / 2, forward, backward])
            errors.append(np.abs(differences - derivative).min() / expected)
            if errors[-1] < AGREEMENT:
                break
        assert errors[-1] < AGREEMENT, f"{group}: {errors}"


@pytest.mark.slow
@pytest.mark.parametrize("case", FAST, ids=str)
def test_gradients_in_float32_point_the_same_way(case):
    gradients = [
        function(point, fixed)[1] for function, point, fixed in (compiled(case, x) for x in DTYPES)
    ]
    for group, paths in by_group(gradients[0]).items():
        chosen = [
            np.concatenate(
                [
                    np.ravel(leaf)
                    for path, leaf in jax.tree_util.tree_leaves_with_path(x)
                    if path in paths
                ]
            )
            for x in gradients
        ]
        cosine = np.dot(*chosen) / np.prod([np.linalg.norm(x) for x in chosen])
        assert cosine > FLOAT32_COSINE, group
