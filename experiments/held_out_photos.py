"""Photos of real people, each held out of an avatar in turn, for `real_people.py`.

A person who moves between photos has another pose in each, which a photo that is held out has to
give, too. So there are two numbers: "own pose", the avatar of the other photos in the pose that was
found with the held-out photo, and "shared pose", in the mean of the poses of the others, which
knows nothing of it.
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
    """PSNRs (dB) and LPIPS of photos by the avatars of the others: means over the views, by pose,
    "own" and "shared".

    A rendering has the exposure of the photo's camera, which is found from all photos.

    Arguments: capture: what the package makes of the photos. make: an avatar from a part of it.
    views: that are held out in turn.
    truth, masks: photos and masks of the person alone on white. Default: those of the capture.
    """
    rows: dict[str, list[Scores]] = {"own": [], "shared": []}
    gains = 1 / exposure_gains(capture)
    for view in views:
        others = [other for other in range(capture.view_count) if other != view]
        rest, shown = capture.select(others), capture.select([view])
        avatar = make(rest)
        # of the others alone the gains are the same but for one factor
        factor = np.exp(np.mean(np.log(gains[others] * exposure_gains(rest)), axis=0))
        told = dataclasses.replace(
            shown,
            images=shown.images if truth is None else truth[[view]],
            masks=shown.masks if masks is None else masks[[view]],
        )
        for pose, drawn in (("own", shown), ("shared", in_shared_pose(rest, shown))):
            found = predict_views(avatar, drawn)
            images = apply_gain(found.images, np.asarray(found.alpha), (factor / gains[view])[None])
            rows[pose].append(photo_scores(images, told))
    return {
        pose: mean_scores(scores) | {"each": [row["psnr_fg"] for row in scores]}
        for pose, scores in rows.items()
    }


def in_shared_pose(rest: Capture, shown: Capture) -> Capture:
    """A view in the mean of the poses of other views."""
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
    """psnr, psnr_fg and psnr_corrected (dB), and LPIPS, of drawn views against the photos of a
    capture, means over them.
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
    """PSNR (dB) of the person after the gain of each channel that brings it nearest to the photo.

    Three numbers of the held-out photo are known then: its exposure and white balance, or the side
    of the room that it shows. A simpler `color_correct` than that of camp_zipnerf, whose
    polynomials of the colors hide more.
    """
    drawn, told = image[mask > 0.5], photo[mask > 0.5]
    gains = (drawn * told).sum(axis=0) / np.maximum((drawn**2).sum(axis=0), 1e-9)
    return -10 * float(np.log10(np.mean((gains * drawn - told) ** 2)))


@functools.cache
def _alex() -> Lpips | None:
    return load_lpips("alex") if "alex" in installed_lpips() else None
