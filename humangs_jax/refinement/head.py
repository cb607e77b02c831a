"""Refines one region alone, usually the head, by steps on crops of the photos around it. People
look at the head for detail.

Only Gaussians of the head move. Gaussians around it are drawn, but stay. Colors are compared inside
of the masks, and alpha beyond a mask costs more than in steps on the whole person, so that little
coverage grows at the silhouette.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import with_pixel_footprint_of
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import posed
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Bool, Float, Int, Scalar
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.prepared import PreparedCapture
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import project
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.objective import (
    Image,
    avatar_of,
    compiled_part,
    drawn_photo,
    image_loss,
    pulled,
)
from humangs_jax.refinement.photos import MARGIN, Photo, crop_to_person, photos_of, windows
from humangs_jax.refinement.search import BUFFERS, HOST_SETTINGS, Clock, planned, unconstrained
from humangs_jax.refinement.steps import RefineState, started, update
from humangs_jax.rendering.splat_config import SplatConfig

LEAST_SIDE = 512
"""Steps on the head are made only if the longer side of the photos has at least this many pixels.
In such photos heads show more detail than the iterations reach.
"""
LARGEST_HEAD = 112
"""The side that the largest head should have in the photos, pixels. Photos are reduced so that the
head has about this size, see also `LOOK`.
"""
LOOK = 1024
"""The largest longer side of the photos in which heads are looked for, pixels. Crops are made of
photos of at most twice this side.
"""
SIDES = 32
"""The sides of the crops are multiples of this number of pixels."""
SIMILAR = 1.25
"""If the largest head is smaller or larger than wanted by more than this factor, crops are made of
photos of another size.
"""
EXCESS = 1.0
"""Weight of alpha beyond the mask in the loss."""
OPAQUE = 0.1
"""Gaussians of the head with more opacity than this have to lie in the crops, except outliers
(`OUTLIERS`).
"""
OUTLIERS = 1.0
"""Percent of the opaque Gaussians of the head that may lie outside of the crops, at each side."""
FAR = 1e4
"""Bound of the coordinates of points outside of photos, pixels."""
PARTS = 10
"""The number of parts of a run. Between two parts the bar moves."""


class Crops(NamedTuple):
    """Crops of the photos around the head, and the Gaussians that they show."""

    moved: Bool[np.ndarray, " g"]
    """Which Gaussians belong to the head, (g,)."""
    drawn: Int[np.ndarray, " d"]
    """The indices of the Gaussians that are drawn, (d,), ascending. These are all that the crops
    show, all of the head, and further ones until d is a power of two. If there are not enough, all
    Gaussians are drawn.
    """
    views: SubjectViews
    """The crops."""
    finer: bool
    """Whether the crops have smaller pixels than the photos of the other steps."""
    splat: SplatConfig
    """How the crops are drawn, with buffers."""


def shows_heads(capture: Capture, config: RefineConfig) -> bool:
    """Returns whether the photos are large enough for steps on the head, and whether heads are
    where poses and cameras place them.

    If the cameras were found from the person and all photos share one pose, heads are off by
    centimetres. Steps would then fit a blurred face. A pose for each photo avoids this.
    """
    longest = max(capture.images.shape[1:3])
    in_place = capture.calibrated or capture.frame_count >= capture.view_count > 1
    return in_place and min(longest, config.image_size or longest) >= LEAST_SIDE


def sharpened(
    avatar: Avatar, trust: Float[Array, " g"], crops: Crops, config: RefineConfig, clock: Clock
) -> Avatar:
    """Returns the avatar after `config.head_steps` steps on its head. A call with 0 steps compiles
    all programs that calls with more steps need.

    avatar: its scales contain the low-pass of the photos. trust: see `RefineState`.
    """
    count, settings = config.head_steps, dataclasses.replace(config, **HOST_SETTINGS)
    # the Gaussians that the crops show; no step is made yet, all programs are compiled
    with clock.compiling():
        photos, drawn = photos_of(crops.views), avatar.select(crops.drawn)
        if crops.finer:
            drawn = with_pixel_footprint_of(drawn, crops.views)
        parameters = unconstrained(drawn.gaussians)
        share = from_host(np.asarray(trust)[crops.drawn] * crops.moved[crops.drawn])
        state = started(parameters, share, settings, crops.splat)
        state = replace(
            state,
            done=from_host(0, np.int32),
            total=from_host(count, np.int32),
            share=from_host(1, np.float32),
        )
        state = _advanced(state, 0, photos, drawn, settings, clock)
    # the steps, in parts, so that the bar moves
    for part in range(1, PARTS + 1):
        state = _advanced(state, part * count // PARTS, photos, drawn, settings, clock)
        clock.show(part / PARTS)
    # what has moved goes back to its rows of the whole avatar
    own, new = avatar.gaussians, avatar_of(state.parameters, drawn).gaussians
    rows = np.flatnonzero(crops.moved[crops.drawn])

    def put(before: Array, after: Array) -> Array:
        merged = np.array(before)
        merged[crops.drawn[rows]] = np.asarray(after)[rows]
        return from_host(merged)

    return replace(avatar, gaussians=jax.tree.map(put, own, new))


def _advanced(
    state: RefineState,
    stop: int,
    photos: Photo,
    avatar: Avatar,
    settings: RefineConfig,
    clock: Clock,
) -> RefineState:
    """Returns the state at step `stop`. Its buffers have room for everything."""

    def advanced(splat: SplatConfig) -> tuple[RefineState, Array]:
        begin = replace(state, splat=splat, overflow=from_host(0, np.int32))
        new = _steps(begin, photos, avatar, from_host(stop, np.int32), settings)
        return new, new.overflow

    return clock.with_room(advanced, state.splat)


@compiled_part
def _steps(
    state: RefineState, photos: Photo, avatar: Avatar, stop: Int[Array, ""], config: RefineConfig
) -> RefineState:
    """Returns the state at step `stop`. Each step takes one photo, in turns. The overflow of the
    result is the sum over these steps.
    """

    def one(state: RefineState) -> RefineState:
        photo = jax.tree.map(lambda x: x[state.done % len(photos.image)], photos)
        image, pull_back, rendering = drawn_photo(state.parameters, avatar, photo, state.splat)
        gradient, _ = pulled(pull_back, jax.grad(head_loss)(image, photo, config))
        return update(
            replace(state, overflow=state.overflow + rendering.overflow), gradient, config
        )

    return jax.lax.while_loop(lambda state: state.done < stop, one, state)


def head_loss(image: Image, photo: Photo, config: RefineConfig) -> Scalar:
    """Returns `image_loss`, where colors count inside the mask only, plus `EXCESS` times the mean
    excess of alpha over the mask.
    """
    rgb = photo.image + photo.mask[..., None] * (image[0] - photo.image)
    return image_loss((rgb, image[1]), photo, config) + EXCESS * jnp.mean(
        jnp.maximum(image[1] - photo.mask, 0)
    )


def head_crops(avatar: Avatar, photos: PreparedCapture, config: RefineConfig) -> Crops | None:
    """Returns crops of the photos around the region. None if the avatar has no opaque Gaussians
    there, or if no photo shows the region.
    """
    # the Gaussians that the joints of the region move; faint ones may lie outside of the crops
    columns = [
        i
        for i, name in enumerate(avatar.joint_names)
        if any(part in name.lower() for part in config.region)
    ]
    moved = np.asarray(avatar.skinning_weights)[:, columns].sum(axis=1) > 0.5
    sure = moved & (np.asarray(avatar.gaussians.opacities) > OPAQUE)
    if not sure.any():
        return None
    # photos at the size at which heads are about as large as they should be
    longest = max(photos.capture.images.shape[1:3])
    others = min(longest, config.image_size or longest)
    size = min(others, LOOK)
    views = crop_to_person(photos, size)
    seen, middles, side = _squares(_pixels(avatar, views)[:, sure], views)
    wanted = min(longest, 2 * size, round(size * LARGEST_HEAD / side))
    if not 1 / SIMILAR < wanted / size < SIMILAR:
        size, views = wanted, crop_to_person(photos, wanted)
        seen, middles, side = _squares(_pixels(avatar, views)[:, sure], views)
    if not len(seen):
        return None
    # squares of one size around the head, in the photos that show it
    half = -(-(side + 2 * MARGIN) // SIDES) * SIDES // 2 - MARGIN
    boxes = [[(int(at) - half, int(at) + half) for at in middles[i]] for i in seen]
    views = replace(
        views, rotations=taken(views.rotations, seen), translations=taken(views.translations, seen)
    )
    images, masks, cameras = windows(
        np.asarray(views.images)[seen], np.asarray(views.masks)[seen], views.cameras[seen], boxes
    )
    unknown = None
    if views.unknown is not None:
        hidden = np.asarray(views.unknown)[seen]
        unknown = windows(np.asarray(views.images)[seen], hidden, views.cameras[seen], boxes)[1] > 0
    views = replace(views, images=images, masks=masks, cameras=cameras, unknown=unknown)
    # all Gaussians that the crops may show are drawn; powers of two are few programs
    pixels, borders = _pixels(avatar, views), np.asarray([cameras.width, cameras.height])
    shown = ((pixels > -MARGIN) & (pixels < borders + MARGIN)).all(axis=-1).any(axis=0) | moved
    drawn = np.sort(np.argsort(~shown, kind="stable")[: _power(int(shown.sum()))])
    splat = planned(avatar, views)  # of all Gaussians, by programs that there are already
    buffers = {name: _power(getattr(splat, name)) for name in BUFFERS}
    return Crops(
        moved, drawn, views, size > others, dataclasses.replace(splat, visibility=False, **buffers)
    )


def _power(number: int) -> int:
    """Returns the smallest power of two that is not below `number`. With few different sizes, few
    programs are compiled.
    """
    return 1 << max(0, number - 1).bit_length()


def _pixels(avatar: Avatar, views: SubjectViews) -> Float[np.ndarray, "v g 2"]:
    """Returns the positions (x, y) at which the views show the centres of the Gaussians, (v, g, 2),
    pixels. They are infinite for Gaussians behind a camera.
    """
    found = []
    for rotations, translation, camera in zip(
        views.rotations, views.translations, views.cameras, strict=True
    ):
        pixels, depths = _projected(camera, posed(avatar, BodyPose(rotations, translation)).means)
        found.append(np.where(np.asarray(depths)[:, None] > 0, pixels, np.inf))
    return np.stack(found)


_projected = compiled()(project)


def _squares(
    pixels: Float[np.ndarray, "v g 2"], views: SubjectViews
) -> tuple[Int[np.ndarray, " s"], Float[np.ndarray, "v 2"], int]:
    """Returns the numbers of the views that show the points, (s,); the middle (y, x) of the points
    in each view, (v, 2), pixels; and the side of a square, pixels, that contains the points in each
    of the s views.

    A view shows the points if their middle lies in the image and the side of their square is no
    longer than the image's longer side. `OUTLIERS` percent of the points at each side are ignored.
    """
    low, high = np.percentile(np.clip(pixels, -FAR, FAR), (OUTLIERS, 100 - OUTLIERS), axis=1)[
        ..., ::-1
    ]
    middles, sides, frame = (low + high) / 2, (high - low).max(axis=1), views.masks.shape[1:]
    seen = np.flatnonzero(((middles >= 0) & (middles < frame)).all(axis=1) & (sides <= max(frame)))
    return seen, middles, max(1, int(np.ceil(sides[seen].max(initial=1))))
