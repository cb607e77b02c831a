"""Scores of one person: an avatar and the painted body against held-out views, in the pose of the photographs and in others."""

import dataclasses
from collections.abc import Callable

import numpy as np

from experiments.evaluation.results import TASKS, Scores
from experiments.evaluation.subjects import EvaluationSubject
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.evaluate import draw_painted_body, painted_body, score
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.capture import Capture
from humangs_jax.network.humangs import HumanGSConfig, Variables
from humangs_jax.objectives.lpips import Lpips

MeanLpips = Callable[[np.ndarray, np.ndarray], float | None]
"""Of pictures (v, h, w, 3) against true ones; None where LPIPS has no weights."""


@dataclasses.dataclass(frozen=True, eq=False)
class Drawn:
    """The held-out views of a person as drawn: ours (v, h, w, 3) and the painted body (v, h, w, 3), in [0, 1]."""

    ours: np.ndarray
    painted: np.ndarray


def draw_person(variables: Variables, config: HumanGSConfig, subject: EvaluationSubject, count: int) -> Drawn:
    """Reconstruct from so many photographs, and paint the body with the same ones."""
    inputs = subject.inputs(count)
    avatar = reconstruct(variables, config, inputs)
    return Drawn(draw_avatar(avatar, subject.held_out), draw_painted_body(painted_body(inputs), subject.held_out))


def draw_avatar(avatar: Avatar, views: Capture) -> np.ndarray:
    """An avatar in the poses and from the cameras of a capture, (v, h, w, 3) in [0, 1]."""
    return np.stack([np.clip(np.asarray(r.rgb), 0, 1) for r in capture_renderings(avatar, views)[1]])


def task_views(held_out: Capture) -> dict[str, np.ndarray]:
    """Indices of the held-out views by task: those in the pose of the photographs, which is frame 0, and the others."""
    still = np.asarray(held_out.frames) == 0
    return dict(zip(TASKS, (np.flatnonzero(still), np.flatnonzero(~still)), strict=True))


def score_tasks(pictures: np.ndarray, held_out: Capture, lpips_of: MeanLpips) -> dict[str, Scores]:
    """Scores of one set of drawn held-out views, by task; tasks without views are left out."""
    scores = {}
    for task, views in task_views(held_out).items():
        if len(views):
            truth = held_out.select(views)
            lpips = lpips_of(pictures[views], truth.images)
            scores[task] = {**dataclasses.asdict(score(pictures[views], truth)), "lpips": lpips}
    return scores


def score_person(drawn: Drawn, held_out: Capture, lpips_of: MeanLpips) -> dict[str, Scores]:
    """Scores by task, those of the painted body beside ours under names that begin with "baseline_"."""
    ours, painted = (score_tasks(x, held_out, lpips_of) for x in (drawn.ours, drawn.painted))
    compared = ("psnr", "ssim", "psnr_foreground", "lpips")
    return {task: ours[task] | {f"baseline_{name}": painted[task][name] for name in compared} for task in ours}


def lpips_scorer(weights: Lpips | None) -> MeanLpips:
    """The mean LPIPS of pictures (v, h, w, 3), clipped to [0, 1], against true ones; None for any without weights."""
    if weights is None:
        return lambda predicted, truth: None
    import jax

    from humangs_jax.objectives.lpips import lpips

    distance = jax.jit(lpips)

    def mean(predicted, truth):
        pairs = zip(np.clip(np.asarray(predicted), 0, 1), np.asarray(truth), strict=True)
        return float(np.mean([distance(weights, *pair) for pair in pairs]))

    return mean
