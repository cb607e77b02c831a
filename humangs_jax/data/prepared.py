"""Makes all decisions about the photos of a person once, before they are used: which views show the
person, their exposure, which way is up, and the body that carries the Gaussians.

`reconstruct`, `refine` and `check_capture` take a `PreparedCapture` as well as a `Capture`, which
they prepare themselves.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.pytree import short_repr
from humangs_jax.data.body_and_masks import report_left_out, views_without_person
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import equalize_exposure
from humangs_jax.data.skirt import add_skirt
from humangs_jax.data.vertex_offsets import fit_vertex_offsets
from humangs_jax.data.view_choice import best_views
from humangs_jax.data.views import (
    gaussian_body,
    on_gaussian_body,
    remesh_key,
    turned_world,
    world_up,
)
from humangs_jax.network.config import HumanGSConfig


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class PreparedCapture:
    """A capture with all decisions about its use. `prepare_capture` makes it."""

    given: Capture
    """The capture as it came: all its views, in its own colors and its own world."""
    capture: Capture
    """The views to use, in equal exposure, in a world with y up. All of them show the person."""
    left_out: dict[str, str]
    """The reasons why views do not show the person, by the names of the views. These views are not
    in `capture`.
    """
    up: str
    """The axis that points up in the world of `given`: "y", "z", "-z" and the like; "y" if that is
    not certain.
    """
    chosen: bool = False
    """Whether views were chosen by `select`. If not, all views that show the person are used."""
    body: BodyModel | None = None
    """The body that carries the Gaussians, with a skirt where the photos show one.

    None if the capture was prepared without a network, and after `select` and `resized`. `refine`
    needs no body.
    """
    displacement: Float[np.ndarray, "n 3"] | None = None
    """The displacements of the vertices of the shaped `body` in the T-pose, (n, 3), metres. None:
    the capture has neither masks nor a displacement, the network does not allow it, or there is no
    body.
    """
    skirt: bool = False
    """Whether `body` has a skirt. The skirt's vertices are the last ones of the body."""
    network: tuple[Any, ...] | None = None
    """The settings of the network that `body` and `displacement` depend on. None: there is no
    body.
    """

    __repr__ = short_repr

    @property
    def shown(self) -> Capture:
        """The views of `given` that show the person, as they came."""
        kept = [i for i, name in enumerate(self.given.names) if name not in self.left_out]
        if len(kept) == self.given.view_count:
            return self.given
        return self.given.select(kept)

    @property
    def turned(self) -> bool:
        """Whether the world of `capture` has other axes than the world of `given`."""
        return self.up != "y"

    def select(self, views: Sequence[int] | Int[np.ndarray, " any"]) -> "PreparedCapture":
        """Returns a prepared capture that uses only these views of `capture`, in this order. The
        body is left out, because it depends on the views.
        """
        chosen = self.capture.select(views)
        return PreparedCapture(self.given, chosen, self.left_out, self.up, chosen=True)

    def resized(self, longest: int) -> "PreparedCapture":
        """Returns a prepared capture whose photos have `longest` pixels along their longest side.
        The body is left out, because it depends on the photos.
        """
        smaller = self.capture.resized(longest)
        return PreparedCapture(self.given, smaller, self.left_out, self.up, self.chosen)

    def with_body(self, config: HumanGSConfig) -> "PreparedCapture":
        """Returns a copy whose fields `body`, `displacement`, `skirt` and `network` are set for the
        network of `config`. The body carries the network's Gaussians.
        """
        capture = self.capture
        body = gaussian_body(capture.body, config)
        moved, skirted = None, None

        # how far the body moves: as the capture says, else to the edges of the masks
        if allows_vertex_offsets(config) and capture.displacement is not None:
            moved = np.asarray(on_gaussian_body(capture.displacement, capture.body, config))
        elif allows_vertex_offsets(config) and capture.masks is not None:
            moved = fit_vertex_offsets(body, capture, always=config.runtime.displacement is True)

        # a skirt, where the masks show one
        if moved is not None:
            skirted = add_skirt(body, capture, moved)
        if skirted is not None:
            body, moved = skirted
        return dataclasses.replace(
            self,
            body=body,
            displacement=moved,
            skirt=skirted is not None,
            network=_network_key(config),
        )


@checked_arguments
def prepare_capture(
    capture: Capture | PreparedCapture,
    config: HumanGSConfig | None = None,
    *,
    views: int | str | None = None,
) -> PreparedCapture:
    """Decide which photos are used, and how. `reconstruct`, `refine` and `check_capture` can then
    share the result.

    A `PreparedCapture` is not prepared again. If `views` is "auto" or less than the number of its
    views, some of its views are chosen. If it has no body for the network of `config`, it gets one.
    Otherwise it is returned as it is.

    Args:
        capture: photos, cameras, poses, and masks if there are some.
        config: the configuration of the network that will read the photos. None: the body is not
            prepared.
        views: the largest number of photos that are used. The photos that together show the body
            best are chosen. "auto": photos are chosen until a further one would add little
            (`view_choice.LEAST_GAIN`). None: all.

    Returns:
        The prepared capture.

    Raises:
        CaptureError: one line that names the views, if none shows the person.
        ValueError: for `views` below 1, or a word other than "auto"; with a `config`, also as
            `data.views.gaussian_body`.

    Examples:
        >>> variables, config = hg.load_weights()
        >>> photos = hg.prepare_capture(hg.load_capture("demo_capture"), config)
        >>> avatar = hg.refine(hg.reconstruct(variables, config, photos), photos)
    """
    if isinstance(views, str) and views != "auto":
        raise ArgumentError("views", f'{views!r}: expected a number from 1, "auto" or None')
    # which views show the person
    prepared, is_new = capture, False
    if isinstance(prepared, Capture):
        is_new, reasons = True, views_without_person(prepared)
        report_left_out(prepared.names, reasons)
        left_out = {prepared.names[view]: reason for view, reason in reasons.items()}
        shown = prepared
        if reasons:
            shown = shown.select([i for i in range(shown.view_count) if i not in reasons])
        prepared = PreparedCapture(prepared, shown, left_out, up="y")

    # the best of them, if not all are to be used
    most = None if isinstance(views, str) else views
    if views is not None and (most is None or most < prepared.capture.view_count):
        best = best_views(prepared.capture, most)
        if len(best) < prepared.capture.view_count:
            prepared = prepared.select(best)

    # equal exposure, then the world with y up, if person and cameras stand along another axis
    if is_new:
        shown = equalize_exposure(prepared.capture)
        poses, cameras = shown.poses, shown.cameras
        up = world_up(np.asarray(poses.rotations)[shown.frames, 0], cameras)
        if up != "y":
            pelvis = np.asarray(shape_body(shown.body, from_host(shown.betas)).joints[0])
            poses, cameras = turned_world(poses, cameras, up, pelvis)
            shown = dataclasses.replace(shown, poses=poses, cameras=cameras)
        prepared = dataclasses.replace(prepared, capture=shown, up=up)

    # the body that carries the Gaussians of the network
    if config is None or prepared.network == _network_key(config):
        return prepared
    return prepared.with_body(config)


def allows_vertex_offsets(config: HumanGSConfig) -> bool:
    """Returns whether the body may be displaced and get a skirt. It may if the network looks only
    at the person's pixels and `runtime.displacement` is not False.
    """
    return config.runtime.displacement is not False and config.conventions.pixels == "person"


def _network_key(config: HumanGSConfig) -> tuple[Any, ...]:
    always = config.runtime.displacement is True
    return remesh_key(config), allows_vertex_offsets(config), always
