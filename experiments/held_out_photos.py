"""Scores avatars of real people on photos that are held out in turn, for `real_people.py`.

A person who moves between photos has another pose in each photo, and only a photo shows its pose.
So there are two numbers. "own pose" shows the avatar of the other photos in the pose that was found
with the held-out photo. "shared pose" shows it in the mean of the poses of the others, which does
not depend on the held-out photo.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.subjects import Scores, score_tasks
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Float
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import apply_gain, exposure_gains
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.evaluation.means import mean_scores
from humangs_jax.losses.loss_networks import installed_lpips, load_lpips
from humangs_jax.losses.perceptual import Lpips


def held_out_scores(
    capture: Capture,
    make: Callable[[Capture], Avatar],
    views: Sequence[int],
    truth: Float[np.ndarray, "v h w 3"] | None = None,
    masks: Float[np.ndarray, "v h w"] | None = None,
) -> dict[str, dict[str, Any]]:
    """Scores the avatars of the other photos on each view in turn.

    Returns {"own" and "shared" pose: PSNRs in dB and LPIPS}, means over the views. A rendering has
    the exposure of the photo's camera, which is found from all photos.

    Args:
        capture: what the package makes of the photos
        make: function that makes an avatar from a part of the capture
        views: indices of the views that are held out in turn
        truth: photos of the person alone on white; default: those of the capture
        masks: masks of the person; default: those of the capture
    """
    rows: dict[str, list[Scores]] = {"own": [], "shared": []}
    gains = 1 / exposure_gains(capture)
    for view in views:
        others = [other for other in range(capture.view_count) if other != view]
        rest, shown = capture.select(others), capture.select([view])
        avatar = make(rest)
        # the gains from the others alone differ from those of all photos by one factor
        factor = np.exp(np.mean(np.log(gains[others] * exposure_gains(rest)), axis=0))
        expected = shown
        if truth is not None:
            expected = dataclasses.replace(expected, images=truth[[view]])
        if masks is not None:
            expected = dataclasses.replace(expected, masks=masks[[view]])
        for pose, drawn in (("own", shown), ("shared", in_shared_pose(rest, shown))):
            found = predict_views(avatar, drawn)
            images = apply_gain(found.images, np.asarray(found.alpha), (factor / gains[view])[None])
            rows[pose].append(photo_scores(images, expected))
    return {
        pose: mean_scores(scores) | {"each": [row["psnr_fg"] for row in scores]}
        for pose, scores in rows.items()
    }


def in_shared_pose(rest: Capture, shown: Capture) -> Capture:
    """Returns the shown view in the mean of the poses of the other views."""
    frames = np.asarray(rest.frames)
    rotations = rest.poses.rotations[frames].mean(axis=0)
    translation = rest.poses.translation[frames].mean(axis=0)
    count = shown.frame_count
    poses = replace(
        shown.poses,
        rotations=jnp.broadcast_to(rotations, (count, *rotations.shape)),
        translation=jnp.broadcast_to(translation, (count, 3)),
    )
    return dataclasses.replace(shown, poses=poses)


def photo_scores(images: Float[np.ndarray, "v h w 3"], truth: Capture) -> Scores:
    """Returns psnr, psnr_fg and psnr_corrected (dB) and LPIPS of drawn views against the photos of
    a capture, as means over the views.
    """
    still = dataclasses.replace(truth, frames=np.zeros(truth.view_count, np.int32))
    scores = score_tasks(images, still, _alex())["novel"]
    assert truth.masks is not None
    pairs = zip(images, truth.images, truth.masks, strict=True)
    corrected = float(np.mean([psnr_corrected(*pair) for pair in pairs]))
    return {
        "psnr": scores["psnr"],
        "psnr_fg": scores["psnr_fg"],
        "psnr_corrected": corrected,
        "alex": scores["lpips"],
    }


def psnr_corrected(
    image: Float[np.ndarray, "h w 3"],
    photo: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
) -> float:
    """Returns the PSNR (dB) of the person after each channel has the gain that brings it nearest to
    the photo.

    The gains use three numbers of the held-out photo, which stand for its exposure and white
    balance, or for the side of the room that it shows. `color_correct` of camp_zipnerf fits
    polynomials of the colors instead, which hide more errors.
    """
    drawn, true = image[mask > 0.5], photo[mask > 0.5]
    gains = (drawn * true).sum(axis=0) / np.maximum((drawn**2).sum(axis=0), 1e-9)
    return -10 * float(np.log10(np.mean((gains * drawn - true) ** 2)))


@functools.cache
def _alex() -> Lpips | None:
    """Returns LPIPS with AlexNet, or None where its weights are not installed."""
    return load_lpips("alex") if "alex" in installed_lpips() else None
