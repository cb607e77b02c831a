"""How like a person an avatar is where no photo was: reconstructed and refined without one photo, and compared with it."""

from typing import NamedTuple

import numpy as np

from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.array_types import Float, PyTree
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import equal_exposure
from humangs_jax.data.usable_views import usable_views
from humangs_jax.data.views import cropped
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.evaluation.scores import score
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine

LEAST_PHOTOS, SIZE = 4, 512
LONGEST = 1024
"""Pixels: larger photos are reduced, whose crops around the person would be all the same."""
CLEARLY = 0.1
"""Decibels by which a second body has to be better."""


class HeldOut(NamedTuple):
    """Of the photo with that name. psnr: dB over the person."""

    name: str
    psnr: float

    def __str__(self) -> str:
        """One line."""
        return f"a photo that was held out ({self.name}) is reproduced with {self.psnr:.1f} dB in the foreground"


def held_out_psnr(
    variables: PyTree, config: HumanGSConfig, capture: Capture, refinement: RefineConfig | None
) -> HeldOut | None:
    """How well the photo that has the nearest other one is reproduced by an avatar of the others, over the person, in a crop of
    `SIZE` pixels; None for fewer than four photos or without masks. Body and cameras are those of all photos. In its place is a
    second copy of the nearest photo: the programs for that number of photos are compiled already.
    """
    capture = usable_views(capture)
    if max(capture.images.shape[1:3]) > LONGEST:
        capture = capture.resized(LONGEST)
    capture = equal_exposure(capture)
    if capture.masks is None or capture.view_count < LEAST_PHOTOS:
        return None
    views = np.arange(capture.view_count)
    apart = _distances(capture)
    view = int(apart.min(axis=1).argmin())
    others = capture.select(np.where(views == view, int(apart[view].argmin()), views))
    avatar = reconstruct(variables, config, others)
    if refinement is not None:
        avatar = refine(avatar, others, refinement)
    photo = cropped(capture.select([view]), SIZE)
    return HeldOut(capture.names[view], float(score(draw_views(avatar, photo).images, photo).psnr_fg))


def better_body(
    variables: PyTree, config: HumanGSConfig, first: Capture, second: Capture, refinement: RefineConfig | None
) -> tuple[Capture, HeldOut | None]:
    """The capture whose body makes the better avatar, judged by a photo that is held out of it, and what that photo says.

    More of the masks is covered by a body that fills clothes; the avatar is not better for it. Without enough photos the first.
    """
    one = held_out_psnr(variables, config, first, refinement)
    two = None if one is None else held_out_psnr(variables, config, second, refinement)
    return (second, two) if one is not None and two is not None and two.psnr > one.psnr + CLEARLY else (first, one)


def _distances(capture: Capture) -> Float[np.ndarray, "v v"]:
    """Between the cameras, seen from the person; a photo is none of its own neighbours."""
    towards = np.asarray(capture.cameras.center) - np.asarray(capture.poses.translation)[np.asarray(capture.frames)]
    towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    return np.linalg.norm(towards[:, None] - towards, axis=-1) + 9 * np.eye(len(towards))
