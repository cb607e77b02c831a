"""Cameras and poses polished against silhouettes, keypoints and photographs: never worse than where they started.

Silhouettes and keypoints first (`rounds`), then, if asked for, the photographs' colours (`photometric`). Each stage is
kept only if its score is better than before it.
"""

import dataclasses
import functools

import numpy as np

from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.refinement.photometric import PhotometricConfig, by_colors, likeness
from humangs_jax.fitting.refinement.report import Refinement, how_far
from humangs_jax.fitting.refinement.rounds import RoundConfig, Scene

LEAST_GAIN = 0.2
"""Share of the loss that has to go for a change to be kept. Bodies in clothes fit masks a little better where they are wrong: of
four people in clothes who started at the truth, by up to 0.15.
"""
LEAST_DIFFERENCE = 0.005
"""Of the loss, besides: less than half a percent of the silhouettes is the pixels' rounding."""


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Static settings of a refinement. search: of the rounds. photometric: of the stage of colours."""

    search: RoundConfig = dataclasses.field(default_factory=RoundConfig)
    photometric: PhotometricConfig = dataclasses.field(default_factory=PhotometricConfig)


def refine_capture(
    capture: Capture,
    *,
    keypoints: Keypoints | None = None,
    photometric: bool = False,
    config: RefineConfig = RefineConfig(),
) -> Refinement:
    """Refine cameras (rotation, place, focal length), shape and poses of a capture.

    Arguments: keypoints: of the capture's views. photometric: also by the photographs' colours, with the weights that come
    with the package. Views whose mask is empty take no part.

    Raises: CaptureError if there is neither a mask that shows anybody nor a keypoint, or colours are asked for without masks;
    ValueError if the keypoints are of another number of views.
    """
    _check(capture, keypoints, photometric)
    scene = Scene(capture, keypoints, config.search)
    unknowns, outcome, move = scene.run()
    tried = scene.moved(unknowns)
    before, found = scene.score(capture), scene.score(tried)
    best, score = (tried, found) if _better(found, before) else (capture, before)
    outcomes, stages = {"silhouettes": outcome}, [_verdict(before, found, move)]
    first, last = before.named(), score.named()
    if photometric:
        best, score, psnrs, outcomes["photometric"], line = _by_colors(scene, best, score, before, config)
        stages.append(line)
        first, last = first | {"avatar_psnr": psnrs[0]}, score.named() | {"avatar_psnr": psnrs[1]}
    overlaps = zip(before.ious.tolist(), score.ious.tolist(), strict=True)
    return Refinement(
        capture=best,
        before=first,
        after=last,
        kept="start" if best is capture else "refined",
        views=dict(zip(capture.names, overlaps, strict=True)),
        moved=how_far(capture, best),
        stages=tuple(stages),
        outcomes=outcomes,
    )


def _better(found, before):
    return before.loss - found.loss > max(LEAST_GAIN * before.loss, LEAST_DIFFERENCE)


def _verdict(before, found, move):
    known = {"silhouettes": before.iou, "keypoints": before.keypoints}
    stage = " and ".join(name for name, value in known.items() if value is not None)
    verdict = "kept" if _better(found, before) else "no improvement worth it: the start is kept"
    settled = f"the last round moved nothing by more than {move:.2g} of its expected spread"
    return f"{stage}: loss {before.loss:.4f} -> {found.loss:.4f}, {verdict} ({settled})"


def _by_colors(scene, capture, score, before, config):
    """The stage of colours: the better capture, its score, PSNR of the start's avatar and of the better one's, the outcome, a
    line.
    """
    from humangs_jax.network.weights import load_weights

    look = functools.partial(likeness, *load_weights())
    now = look(capture)
    first = now.psnr if capture is scene.capture else look(scene.capture).psnr
    tried, outcome = by_colors(now, capture, config.photometric, config.search)
    then, found = look(tried).psnr, scene.score(tried)
    better = then > now.psnr and found.loss <= before.loss
    line = f"photographs: PSNR of the avatar {now.psnr:.2f} -> {then:.2f} dB, {'kept' if better else 'not kept'}"
    if better:
        return tried, found, (first, then), outcome, line
    return capture, score, (first, now.psnr), outcome, line


def _check(capture, keypoints, photometric):
    """Whether there is anything to refine by."""
    masks = capture.masks is not None and (np.asarray(capture.masks) > 0.5).any()
    if keypoints is not None and len(keypoints.points) != capture.view_count:
        raise ValueError(f"keypoints: of {len(keypoints.points)} views, but the capture has {capture.view_count}")
    seen = keypoints is not None and (keypoints.confidences > 0).any()
    if not masks and not seen:
        raise CaptureError(
            "capture", "masks", "none shows anybody, and there are no keypoints: refinement needs one or the other"
        )
    if photometric and not masks:
        raise CaptureError("capture", "masks", "expected with colours: without them the room is taken for the person")
