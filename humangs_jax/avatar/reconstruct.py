"""Reconstructs an avatar from photos with body poses in one forward pass, for one person or for
many in one batch.

Programs are compiled once per bucket: numbers of views and of foreground tokens are rounded up to
few sizes (`buffers.round_up`), and padding is masked.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import with_pixel_footprint
from humangs_jax.avatar.avatar import (
    Avatar,
    Light,
    light_coefficients,
    light_terms,
    log_brightness,
    turned_normals,
)
from humangs_jax.avatar.unseen import with_guesses
from humangs_jax.body.model import (
    BodyModel,
    BodyPose,
    RestBody,
    blend_leg_weights,
    blend_transforms,
    joint_transforms,
)
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.loops import over
from humangs_jax.core.processes import Call, compile_ahead
from humangs_jax.core.progress import compiling
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import (
    PreparedCapture,
    allows_vertex_offsets,
    prepare_capture,
)
from humangs_jax.data.views import (
    SubjectViews,
    gaussian_body,
    has_mesh_of,
    pad_views,
    prepare_inputs,
    subject_rest,
    to_network_views,
)
from humangs_jax.geometry import transform
from humangs_jax.io.reading import check_limit
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import needed_tokens
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.parts import HumanGSInputs, HumanGSOutputs, Variables
from humangs_jax.network.vertex_decoder import corrected_skinning_weights
from humangs_jax.rendering.buffers import round_up
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

LEGS = tuple(
    tuple(f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "foot"))
    for side in ("left", "right")
)
SMALLEST_VOLUME = 0.2
"""A blended transform is inverted only if its determinant is larger than this. Where two limbs are
turned against each other, blended transforms collapse. Gaussians there keep their weights.
"""
POSED = "the posed vertices, which all arrays of the body move"
BATCH = 8
"""Number of captures that `reconstruct_batch` takes at a time by default. Larger batches take more
memory, and gain little.
"""


@checked_arguments
def reconstruct(
    variables: Variables, config: HumanGSConfig, capture: Capture | PreparedCapture
) -> Avatar:
    """Reconstruct the person of a capture.

    Photos are brought to the network's image size, their exposure is made equal, and views whose
    mask does not show the person are left out. Numbers of views and of foreground tokens are
    rounded up to few sizes; a program is compiled for each.

    Worlds that are not y-up are turned for the network. The avatar then has no light, because its
    directions would be those of another world.

    If the network looks only at the person's pixels, what no photo shows is guessed from what
    photos show (`avatar.unseen`). Before that the body is displaced, unless `Runtime.displacement`
    is False. If the capture has a displacement, it is used. If it has only masks, vertices are
    moved to the edges of the masks: always if `Runtime.displacement` is True, else only if the body
    does not fit the masks. If the masks show a skirt, the body gets one (`data.skirt`).

    If the network has a driver, which corrects Gaussians for each frame, the avatar is without
    these corrections.

    Args:
        variables: the variables of the network. `load_weights` returns them with `config`.
        config: the configuration of the network.
        capture: photos, cameras, poses, and masks if there are some; or what `prepare_capture` made
            of it.

    Returns:
        The avatar in the T-pose of the person's own shape.

    Raises:
        ValueError: if the network makes no Gaussians, if no view of the capture shows the person,
            or if the capture has more views than the limit `network_views`. Also if a camera has
            distortion or a lens other than a pinhole, or if an array of the capture has a wrong
            shape, or values that are not finite or out of range. The message names this array.

    Examples:
        >>> avatar = hg.reconstruct(*hg.load_weights(), hg.load_capture("demo_capture"))
    """
    _check(capture, "capture")
    prepared = prepare_capture(capture, config)
    body = prepared.body
    assert body is not None  # prepared for a network
    views, sized = _for_network(prepared.capture, prepared.displacement, config)
    with compiling(("reconstruct", config, views.images.shape)):
        # where masks alone say how many tokens there are, two programs are compiled side by side
        if sized is not None:
            shapes = _prepare.eval_shape(body, views, config)
            compile_ahead(_reconstruct, variables, sized, body, views, shapes)

        # the body as each photo shows it, then the network
        inputs = _prepare(body, views, config)
        check_values("reconstruct: capture", {POSED: (inputs.posed_vertices, FINITE)})
        if sized is None:
            sized = fit_buffers(inputs.foreground, inputs.view_count, config)
        avatar, _ = _reconstruct(variables, sized, body, views, inputs)
    if prepared.turned:
        return replace(avatar, light=None)
    return avatar


def calls_of_reconstruct(
    variables: Variables, config: HumanGSConfig, capture: Capture
) -> Iterator[Call]:
    """Yields the jitted calls that `reconstruct` makes for a capture with masks. The compiled
    programs also fit other bodies with as many vertices and without a skirt. Nothing is yielded if
    the sizes in the programs depend on where the body is.
    """
    body, moved = gaussian_body(capture.body, config), None
    if allows_vertex_offsets(config):
        moved = np.zeros(body.template.shape, np.float32)
    views, sized = _for_network(capture, moved, config)
    if sized is not None:
        inputs = _prepare.eval_shape(body, views, config)
        yield _reconstruct, (variables, sized, body, views, inputs)
        yield _prepare, (body, views, config)


def _for_network(
    photos: Capture, displacement: Float[np.ndarray, "n 3"] | None, config: HumanGSConfig
) -> tuple[SubjectViews, HumanGSConfig | None]:
    """Returns the photos in the form that the network takes, and the configuration with room for
    their tokens. The configuration is None if the masks alone do not tell the number of tokens.
    """
    # few numbers of views are compiled: the others are padded
    size, crop = config.image_size, config.runtime.crop
    views = to_network_views(photos, size, crop, displacement)
    bucket = round_up(photos.view_count, smallest=1)
    if bucket > photos.view_count:
        views = pad_views(views, bucket)
    # masks say it where every photo has one and the network reads the person's pixels alone
    person = np.asarray(views.masks) > MASK_THRESHOLD
    if config.conventions.pixels != "person" or not person.any(axis=(1, 2)).all():
        return views, None
    return views, fit_buffers(from_host(person), views.view_count, config)


class Reconstructed(NamedTuple):
    """A capture of a batch, with its avatar or with the error that it caused."""

    capture: PreparedCapture | None = None
    """The capture as it was used; None if there is an error."""
    avatar: Avatar | None = None
    """The avatar; None if there is an error."""
    error: Exception | None = None
    """The error that the capture caused; None if it caused none."""


@checked_arguments
def reconstruct_batch(
    variables: Variables,
    config: HumanGSConfig,
    captures: Sequence[Capture | PreparedCapture | Callable[[], Capture | PreparedCapture]],
    batch: int = BATCH,
) -> Iterator[Reconstructed]:
    """Reconstruct several people, `batch` at a time in one program, whatever their numbers of
    views.

    A batch uses a machine better than one person does, on CPUs too, but needs memory in proportion
    to the number of people. People in skirts are reconstructed alone, because their bodies have
    more vertices. The other people of a batch are reconstructed together with the first of them if
    they have the same body model, and if y is up either in both worlds or in neither. Anyone else
    is reconstructed alone. A capture that cannot be used does not stop the others.

    Args:
        variables: the variables of the network. `load_weights` returns them with `config`.
        config: the configuration of the network.
        captures: the captures, of people whose shapes may differ, or functions that return one
            capture each. A function is called when its turn comes.
        batch: captures at a time.

    Yields:
        Each capture with its avatar, in the order of the captures. If a function raises a
        ValueError or OSError, or if a capture cannot be used, the item has this error instead.

    Raises:
        ValueError: for a `batch` below 1, when the first item is asked for.
        TypeError: if an item of `captures` is neither a capture nor a function that returns one.

    Examples:
        >>> made = hg.reconstruct_batch(*hg.load_weights(), captures)
        >>> failed = [each for each in made if each.error]
    """
    if batch < 1:
        raise ArgumentError("batch", f"{batch}: expected at least 1")
    for start in range(0, len(captures), batch):
        # what is wrong with one capture is kept in its place
        done = []
        for given in captures[start : start + batch]:
            try:
                capture: Any = given() if callable(given) else given
                _check(capture, "capture")
                done.append(Reconstructed(prepare_capture(capture, config)))
            except (ValueError, OSError) as error:
                done.append(Reconstructed(error=error))

        # people who share a mesh and a way up are one batch; if one of them fails, each is alone
        bare = [each.capture for each in done if each.capture and not each.capture.skirt]
        alike = [
            each for each in bare if each.turned == bare[0].turned and _same_body(each, bare[0])
        ]
        avatars: dict[int, Avatar] = {}
        if len(alike) > 1:
            with contextlib.suppress(ValueError):
                body, views, sized = stack_captures(config, alike)
                with compiling(("reconstruct_batch", sized, views.images.shape)):
                    found, _ = jax.vmap(reconstruct_views, in_axes=(None, None, None, 0))(
                        variables, sized, body, views
                    )
                avatars = {id(each): avatar for each, avatar in zip(alike, found, strict=True)}

        for each in done:
            if each.capture is None:
                yield each
                continue
            try:
                avatar = avatars.get(id(each.capture))
                if avatar is None:
                    avatar = reconstruct(variables, config, each.capture)
                yield each._replace(avatar=avatar)
            except ValueError as error:
                yield Reconstructed(error=error)


@checked_arguments
def stack_captures(
    config: HumanGSConfig, captures: Sequence[Capture | PreparedCapture]
) -> tuple[BodyModel, SubjectViews, HumanGSConfig]:
    """Stack the photos of several people, for a program that you write and compile.

    Skirts, which `reconstruct` adds, are left out.

    Args:
        config: the configuration of the network.
        captures: the captures of people who all have the same body model.

    Returns:
        Three values: the body that carries the Gaussians; the photos as the network wants them
        (leading axis b, padded to one number of views); and `config` with room for the tokens of
        these photos, and without light if no world is y-up.

    Raises:
        ValueError: if there is no capture, if `reconstruct` would refuse one of the captures, or if
            the body models differ. Also if `config` wants light and only some of the worlds are
            y-up, because in a batch all avatars have a light or none has.

    Examples:
        >>> body, views, config = hg.stack_captures(config, captures)
        >>> batched = jax.vmap(hg.reconstruct_views, in_axes=(None, None, None, 0))
        >>> avatars, dropped = batched(variables, config, body, views)  # all as one batch
    """
    if not captures:
        raise ValueError("captures: none given")
    for index, capture in enumerate(captures):
        _check(capture, f"captures[{index}]")
    everybody = [prepare_capture(capture, config) for capture in captures]
    for index, prepared in enumerate(everybody):
        if not _same_body(prepared, everybody[0]):
            raise ValueError(
                f"captures[{index}]: its body is not the one of captures[0]; a batch shares one"
                " body model"
            )

    # light needs to know which way is up
    turned = [prepared.turned for prepared in everybody]
    if config.conventions.light and any(turned):
        if not all(turned):
            raise ValueError(
                f"captures[{turned.index(True)}]: its world is not y-up, so that its avatar has no"
                " light, but others have: stack them apart, or use reconstruct_batch"
            )
        config = config.with_conventions(light=False)

    # one number of views, of shape coefficients and of vertices for all
    body = gaussian_body(everybody[0].capture.body, config)
    bucket = round_up(max(each.capture.view_count for each in everybody), smallest=1)
    coefficients = max(len(each.capture.betas) for each in everybody)
    subjects = []
    for prepared in everybody:
        moved = prepared.displacement
        if moved is not None:
            moved = moved[: len(body.template)]
        elif allows_vertex_offsets(config):
            moved = np.zeros(body.template.shape, body.template.dtype)  # of photos without masks
        size, crop = config.image_size, config.runtime.crop
        views = pad_views(to_network_views(prepared.capture, size, crop, moved), bucket)
        betas = jnp.pad(views.betas, (0, coefficients - len(views.betas)))  # those left out are 0
        subjects.append(replace(views, betas=betas))
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *subjects)

    # room for the tokens of the photos that need most
    inputs = _prepare_batch(body, views, config)
    check_values("reconstruct: captures", {POSED: (inputs.posed_vertices, FINITE)})
    return body, views, fit_buffers(inputs.foreground, inputs.view_count, config)


def fit_buffers(
    foreground: Bool[Array, "*b v h w"], view_count: Int[Array, "*b"] | None, config: HumanGSConfig
) -> HumanGSConfig:
    """Returns the configuration with room for the foreground tokens of one subject or of a batch.

    foreground: which pixels are foreground. view_count: the number of views that are no padding.
    None: all views.
    """
    patch, capacity = config.architecture.encoder.patch_size, 0
    if config.tokens != "all":
        capacity = round_up(int(needed_tokens(foreground, view_count, patch)))
    return config.with_runtime(token_capacity=capacity)


@checked_arguments
def reconstruct_views(
    variables: Variables, config: HumanGSConfig, body: BodyModel, views: SubjectViews
) -> tuple[Avatar, Int[Array, ""]]:
    """Returns the avatar of one subject's views. This is the pure function behind `reconstruct`;
    batch it with `jax.vmap`.

    Weights files do not record a token capacity. The default has room for all patches, so that
    every patch costs time. `stack_captures` returns a configuration with the capacity that its
    photos need.

    Args:
        variables: the variables of the network. `load_weights` returns them with `config`.
        config: the configuration of the network.
        body: the body that carries the Gaussians, as `stack_captures` returns it.
        views: photos at the network's size, cameras and poses, for one subject of
            `stack_captures`.

    Returns:
        The avatar, and how many foreground patches did not fit into
        `config.runtime.token_capacity`.

    Raises:
        ValueError: if the body is not the one that this configuration wants, if the photos do not
            have the image size of the configuration, or if the network makes no Gaussians.

    Examples:
        >>> batched = jax.vmap(hg.reconstruct_views, in_axes=(None, None, None, 0))
        >>> avatars, dropped = batched(variables, config, body, views)
    """
    # a body or photos of another size would give an avatar without an error
    made = "body, views, config = stack_captures(config, captures) makes what it wants"
    (height, width), side = views.images.shape[1:3], config.image_size
    if {height, width, views.cameras.height, views.cameras.width} != {side}:
        raise ValueError(
            f"reconstruct_views: photos of {width} x {height}, config wants {side} x {side}; {made}"
        )
    if not has_mesh_of(body, config):
        raise ValueError(
            f"reconstruct_views: a body of {len(body.template)} vertices that gaussian_body(body,"
            f" config) has not made; {made}"
        )
    return _reconstruct(variables, config, body, views)


@compiled()
def _reconstruct(
    variables: Variables,
    config: HumanGSConfig,
    body: BodyModel,
    views: SubjectViews,
    inputs: HumanGSInputs | None = None,
) -> tuple[Avatar, Int[Array, ""]]:
    if inputs is None:
        inputs = prepare_inputs(body, views, config)
    outputs, _ = apply_humangs(variables, inputs, config)
    outputs = with_guesses(outputs, inputs, body, config)
    return completed_avatar(outputs, body, views, config), outputs.dropped_tokens


def make_avatar(
    outputs: HumanGSOutputs, body: BodyModel, rest: RestBody, config: HumanGSConfig
) -> Avatar:
    """Returns the avatar that the outputs of the network describe: their canonical Gaussians on the
    body of a person. rest: the body of the person in the T-pose.

    Raises: ValueError if there are no Gaussians.
    """
    if outputs.is_empty:
        name = type(config.architecture.decoder).__name__
        raise ValueError(
            f"{name} draws images without Gaussians: there is no avatar to make or animate"
        )
    weights = outputs.skinning_weights
    per_vertex = outputs.gaussians.means.shape[0] // body.template.shape[0]
    if weights is None:
        weights = corrected_skinning_weights(
            body.skinning_weights, outputs.skinning_offsets, per_vertex
        )
    return Avatar(
        gaussians=outputs.gaussians,
        skinning_weights=weights,
        rest_vertices=rest.vertices,
        rest_joints=rest.joints,
        faces=body.faces,
        parents=body.parents,
        joint_names=body.joint_names,
        skinning=config.conventions.skinning,
        rendering=config.conventions.rendering,
    )


def completed_avatar(
    outputs: HumanGSOutputs, body: BodyModel, views: SubjectViews, config: HumanGSConfig
) -> Avatar:
    """Returns the avatar of `make_avatar`, completed as the conventions of the configuration ask
    for. The conventions may change the skinning weights between the legs, and add the light of the
    photos and the low-pass.

    Raises: as `make_avatar`.
    """
    conventions = config.conventions
    avatar = make_avatar(outputs, body, subject_rest(body, views.betas, views.displacement), config)
    if conventions.leg_blend_distance is not None and outputs.skinning_weights is None:
        avatar = with_blended_leg_weights(
            avatar,
            BodyPose(views.rotations[0], views.translations[0]),
            conventions.leg_blend_distance,
        )
    if conventions.light and outputs.skinning_weights is None:
        avatar = with_light(avatar, views)
    if conventions.pixel_footprint is not None:
        avatar = with_pixel_footprint(avatar, conventions.pixel_footprint)
    return avatar


def with_light(avatar: Avatar, views: SubjectViews) -> Avatar:
    """Returns the avatar with the light of its photos (`avatar.light`).

    Gradients do not pass through the light.
    """
    # normals of the Gaussians as each photo has them
    fixed, views = jax.lax.stop_gradient((avatar, views))
    vertices, gaussians = fixed.rest_vertices, fixed.gaussians
    per_vertex = len(gaussians.means) // len(vertices)
    normals = jnp.repeat(vertex_normals(vertices, fixed.faces), per_vertex, axis=0)

    def terms_in(rotations, translation):
        joints = joint_transforms(fixed.rest_joints, fixed.parents, rotations, translation)
        return light_terms(
            turned_normals(normals, blend_transforms(fixed.skinning_weights, joints)[:, :3, :3])
        )

    # the mean over the real views of what light depends on
    if views.view_count is None:
        count = len(views.images)
    else:
        count = views.view_count
    share = (jnp.arange(len(views.images)) < count) / count
    terms = jnp.sum(
        share[:, None, None] * jax.vmap(terms_in)(views.rotations, views.translations), axis=0
    )

    def pooled(values):
        return jnp.sum(values.reshape(len(vertices), per_vertex, -1), axis=1)

    weights = pooled(gaussians.opacities)

    def mean(values):
        return pooled(values * gaussians.opacities[:, None]) / jnp.maximum(weights, 1e-6)

    # the coefficients are fitted to the vertices, as the mean of their Gaussians
    coefficients = light_coefficients(vertices, mean(gaussians.colors), weights[:, 0], mean(terms))
    return replace(avatar, light=Light(coefficients, normals, log_brightness(terms, coefficients)))


def with_blended_leg_weights(avatar: Avatar, pose: BodyPose, reach: float) -> Avatar:
    """Returns the avatar with the skinning weights of `blend_leg_weights`. The means in T-pose are
    changed so that Gaussians keep their places in `pose`, the pose of the first photo. reach: as
    `blend_leg_weights` takes it, metres.

    Gaussians whose blended transform collapses keep their weights, see `SMALLEST_VOLUME`. The
    shapes of Gaussians are not corrected. Gradients do not pass through the weights.
    """
    # the new weights
    gaussians, vertices, own = avatar.gaussians, avatar.rest_vertices, avatar.skinning_weights
    per_vertex = len(gaussians.means) // len(vertices)
    points = jax.lax.stop_gradient(gaussians.means)
    distances = jnp.linalg.norm(points - jnp.repeat(vertices, per_vertex, axis=0), axis=-1)
    legs = jnp.asarray([[name in names for name in avatar.joint_names] for names in LEGS])
    spread = blend_leg_weights(points, distances, own, vertices, own[::per_vertex], legs, reach)

    # the linear part of a blended transform, inverted by its cofactors
    transforms = joint_transforms(
        avatar.rest_joints, avatar.parents, pose.rotations, pose.translation
    )
    before, after = blend_transforms(own, transforms), blend_transforms(spread, transforms)
    columns = jnp.moveaxis(after[:, :3, :3], -1, 0)
    crossed = jnp.stack([jnp.cross(columns[i - 2], columns[i - 1]) for i in range(3)], axis=1)
    volumes = jnp.sum(columns[0] * crossed[:, 0], axis=-1)
    safe = volumes > SMALLEST_VOLUME

    # the places in T-pose from which the new transforms lead to the old places in the pose
    moved = transform.apply(before, gaussians.means) - after[:, :3, 3]
    held = jnp.einsum(
        "gab,gb->ga",
        crossed / jnp.where(safe, volumes, 1)[:, None, None],
        moved,
        precision=transform.EXACT,
    )
    means = jnp.where(safe[:, None], held, gaussians.means)
    weights = jnp.where(safe[:, None], spread, own)
    return replace(avatar, gaussians=replace(gaussians, means=means), skinning_weights=weights)


def _check(given: Capture | PreparedCapture, name: str) -> None:
    """Check that `given` is a capture that can be reconstructed.

    Raises: TypeError for other types; ValueError for too many views, or for a capture that is not
    valid.
    """
    capture = given.capture if isinstance(given, PreparedCapture) else given
    if not isinstance(capture, Capture):
        raise TypeError(f"{name}: expected Capture, got {type(capture).__name__}")
    check_limit("network_views", capture.view_count, f"photos in {name}")
    capture.check(f"reconstruct: {name}")
    # what poses move has to be finite, too
    body = capture.body
    arrays = {"template": body.template, "skinning_weights": body.skinning_weights}
    check_values(f"reconstruct: {name}", {f"body.{key}": (x, FINITE) for key, x in arrays.items()})


def _same_body(one: PreparedCapture, other: PreparedCapture) -> bool:
    """Returns whether two people have equal body models, even if these were read from file
    twice.
    """
    mine, theirs = one.capture.body, other.capture.body
    return mine is theirs or (
        jax.tree.structure(mine) == jax.tree.structure(theirs)
        and jax.tree.all(jax.tree.map(np.array_equal, mine, theirs))
    )


_prepare = compiled()(prepare_inputs)


@compiled()
def _prepare_batch(body: BodyModel, batch: SubjectViews, config: HumanGSConfig) -> HumanGSInputs:
    """Returns the network's inputs for each person of a batch, see `prepare_inputs`."""
    pixels = math.prod(batch.images.shape[1:4])
    return over(lambda views: prepare_inputs(body, views, config), batch, pixels)
