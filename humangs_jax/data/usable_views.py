"""Which views of a capture show the person; all that reads photos leaves the others out, by name.

A mask that is empty, or nowhere near the body, does not only say nothing: the network takes its white photo for the person, and
refinement makes the avatar transparent there.
"""

import logging

import numpy as np

from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.surface_points import points_in_image, surface_points

logger = logging.getLogger(__name__)

MASK_THRESHOLD = 0.5
"""A pixel belongs to the person when its mask is above this."""
LEAST_SHARE = 0.05
"""Of the body in the frame that lies on the mask. In the demo's photos the head alone has 6 to 7 %, an inverted mask 1.4 %."""
POINTS = 1000
"""On the skin."""


def usable_views(capture: Capture) -> Capture:
    """The capture with the views of `usable_indices`; the same object where these are all."""
    usable = usable_indices(capture)
    return capture if len(usable) == capture.view_count else capture.select(usable)


def usable_indices(capture: Capture) -> list[int]:
    """The views that show the person: all but those of `unusable_views`, which a warning names. All of them without masks.

    Raises: CaptureError, one line that names the views, if none is left.
    """
    found = unusable_views(capture)
    if not found:
        return list(range(capture.view_count))
    told = "; ".join(
        f"{', '.join(capture.names[i] for i in found if found[i] == reason)}: {reason}"
        for reason in dict.fromkeys(found.values())
    )
    if len(found) == capture.view_count:
        raise CaptureError("capture", "masks", f"no view is left that shows the person: {told}")
    count = f"{len(found)} of {capture.view_count} views {'is' if len(found) == 1 else 'are'}"
    logger.warning("%s left out: %s", count, told)
    return [i for i in range(capture.view_count) if i not in found]


def unusable_views(capture: Capture) -> dict[int, str]:
    """The views whose mask is empty or hardly meets the posed body, and which of the two."""
    found = dict.fromkeys(empty_views(capture), "the mask is empty")
    if capture.masks is None or len(found) == capture.view_count:
        return found
    apart = [i for i, share in enumerate(shares_on_masks(capture)) if share < LEAST_SHARE and i not in found]
    found |= dict.fromkeys(apart, "mask and posed body hardly meet (`humangs check` draws both)")
    return dict(sorted(found.items()))


def empty_views(capture: Capture) -> list[int]:
    """The views whose mask shows nobody."""
    masks = () if capture.masks is None else capture.masks
    return [i for i, mask in enumerate(masks) if not (np.asarray(mask) > MASK_THRESHOLD).any()]


def shares_on_masks(capture: Capture) -> list[float]:
    """For each view the share of the body in the frame that lies on the mask; 0 where none of it is in the frame.

    1 for a body that is not finite: that is another fault, which whoever poses it names.
    """
    assert capture.masks is not None
    rotations, translations = np.asarray(capture.poses.rotations), np.asarray(capture.poses.translation)
    frames = [int(frame) for frame in capture.frames]
    points = surface_points(capture.body, np.asarray(capture.betas), rotations, translations, frames, POINTS)
    K, cam_from_world = np.asarray(capture.cameras.K), np.asarray(capture.cameras.cam_from_world)
    shares = []
    for i, frame in enumerate(frames):
        mask = np.asarray(capture.masks[i])
        height, width = mask.shape
        if not np.isfinite(points[frame]).all():
            shares.append(1.0)
            continue
        x, y = points_in_image(points[frame], K[i], cam_from_world[i], width, height).astype(int).T
        shares.append(float((mask[y, x] > MASK_THRESHOLD).mean()) if len(x) else 0.0)
    return shares
