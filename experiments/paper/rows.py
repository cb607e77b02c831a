"""Has the printed rows of the paper's tables, and measures rows of weights on people of a folder or
data set.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.paper.bench import (
    animatable,
    folder_of,
    last_weights,
    shown,
    takes_one,
    trained_names,
)
from humangs_jax.data.capture import load_capture
from humangs_jax.data.datasets.subject import FileBody, open_people
from humangs_jax.data.loading.captures import find_captures
from humangs_jax.evaluation.cases import Case, Choice, choose_views, find_people
from humangs_jax.evaluation.means import mean_scores, person_means
from humangs_jax.evaluation.run import evaluate
from humangs_jax.io.reading import read_json
from humangs_jax.network.weights import load_weights

SHIPPED = "HumanGS, shipped"
"""Name of the weights that come with the package."""
PAPER = "paper"
"""Marks a row of the printed paper in every table."""
HUMANRAM, LVSM, GHG, OURS = "HumanRAM", "LVSM", "GHG", "HumanGS"
ANIMATION = {
    "LHM (single view)": (23.72, 0.95, 0.045, 4.59, 0.053),
    HUMANRAM: (24.58, 0.96, 0.042, None, 0.287),
    "Animatable Gaussians": (25.51, 0.96, 0.041, 12000, 0.245),
    OURS: (25.24, 0.96, 0.04, 0.29, 0.048),
}
"""Table 1, AvatarReX: PSNR, SSIM, LPIPS, seconds to model, seconds a frame."""
RECONSTRUCTION = {
    HUMANRAM: ((28.98, 0.97, 0.021), (25.10, 0.96, 0.029)),
    LVSM: ((24.38, 0.96, 0.036), None),
    GHG: ((22.49, 0.95, 0.043), None),
    OURS: ((27.99, 0.97, 0.025), (25.53, 0.96, 0.029)),
}
"""Table 2, THuman4.0: reconstruction, and reconstruction + animation."""
DOMAINS = {
    HUMANRAM: ((33.16, 0.98, 0.018), (27.76, 0.97, 0.029)),
    LVSM: ((27.13, 0.95, 0.051), (20.86, 0.94, 0.056)),
    GHG: ((26.91, 0.96, 0.039), (22.69, 0.93, 0.088)),
    "GHG, released weights": ((22.80, 0.91, 0.067), None),
    "GST, released weights": ((21.58, 0.92, 0.091), None),
    OURS: ((30.81, 0.98, 0.024), (27.27, 0.97, 0.033)),
    "GIGA, on its split": ((20.19, 0.794, 0.070), None),
    "HumanGS, on GIGA's split": ((26.00, 0.945, 0.061), None),
}
"""Table 3, reconstruction: in the domain of training (THuman2.1), and in another one (AvatarReX).
"""
VIEWS = {
    HUMANRAM: (
        (25.44, 0.946, 0.052),
        (27.39, 0.950, 0.044),
        (29.10, 0.960, 0.039),
        (29.90, 0.966, 0.036),
    ),
    LVSM: (
        (17.78, 0.900, 0.101),
        (22.64, 0.930, 0.066),
        (25.96, 0.950, 0.055),
        (27.03, 0.950, 0.051),
    ),
    GHG: (
        (21.71, 0.920, 0.094),
        (22.43, 0.930, 0.089),
        (22.69, 0.930, 0.088),
        (22.72, 0.930, 0.088),
    ),
    OURS: (
        (24.07, 0.936, 0.068),
        (25.71, 0.946, 0.059),
        (27.19, 0.950, 0.054),
        (27.84, 0.950, 0.051),
    ),
}
"""THuman2.1 near, with 1, 2, 4 and 6 photos."""
GAUSSIANS = {
    "THuman2.1": ((30.66, 0.970, 0.028), (30.81, 0.980, 0.024)),
    "THuman2.1 near": ((27.09, 0.950, 0.062), (27.19, 0.950, 0.054)),
    "AvatarReX": ((25.20, 0.960, 0.044), (25.24, 0.960, 0.040)),
    "THuman4.0": ((25.42, 0.960, 0.034), (25.53, 0.960, 0.029)),
}
"""1 Gaussian a vertex, and 1 tight + 4 free."""
FASTER_MODELLING = 15
"""Times that HumanGS models faster than LHM: 4.59 s against 0.29."""

AT_ONCE = 200
"""Largest number of views that are in memory together."""
Views = dict[str, dict[str, list[int]]]
"""{person: {"context": the views that are inputs, "target": the views that are compared}}."""


def views_of(people: Path, photos: int, body: Path | None, varying: bool) -> Views | None:
    """Chooses inputs and targets of people who have no held_out/. Returns None if they have it.

    Args:
        people: folder or scene list
        photos: number of inputs
        body: body model of a data set
        varying: whether each input shows another pose and side, and targets show poses that no
            input shows, where there are enough poses
    """
    # the frames and cameras of each person
    names, found = find_people(people, None, {}, body).names, {}
    if any(people.glob("*/capture.json")) or (people / "capture.json").is_file():
        folders = find_captures(people)
        if (folders[0] / "held_out").is_dir():
            return None
        given = [(x.frames, x.cameras.cam_from_world) for x in map(load_capture, folders)]
    else:
        opened = [each.subject for each in open_people(people, FileBody.load(body))]
        given = [(subject.frames, subject.cam_from_world) for subject in opened]

    for name, (frames, poses) in zip(names, given, strict=True):
        frames, poses = np.asarray(frames), np.asarray(poses)
        context, target = [], []
        if varying:
            context, target = varied(frames, photos)
        if not target:
            context, target = choose_views(name, frames, poses, Choice(photos))
        found[name] = {"context": context, "target": target}
    return found


def varied(frames: np.ndarray, photos: int) -> tuple[list[int], list[int]]:
    """Chooses inputs that show different frames, each by another camera, and as targets all views
    of the other frames.

    Frames are taken in turns where there are fewer than photos. Both lists are empty if there is
    only one frame.
    """
    poses = np.unique(frames)
    seen = poses[:-1]
    if len(poses) > photos:
        seen = poses[[i * len(poses) // photos for i in range(photos)]]
    if not len(seen):
        return [], []
    context: list[int] = []
    for i in range(photos):
        own = np.flatnonzero(frames == seen[i % len(seen)])
        free = [int(x) for x in np.roll(own, -(i * len(own) // photos)) if int(x) not in context]
        context += free[:1]
    return context, np.flatnonzero(~np.isin(frames, seen)).tolist()


def cases(people: Path, photos: int, body: Path | None, views: Views | None) -> Iterator[Case]:
    """Yields the cases of people. A person with more than `AT_ONCE` targets comes in parts."""
    # the people read `chosen` whenever a case is loaded
    chosen = None if views is None else dict(views)
    found = find_people(people, photos, chosen, body)
    for i, name in enumerate(found.names):
        if views is None or chosen is None:
            yield found.load(i)
        elif name in views:
            targets = views[name]["target"]
            for start in range(0, len(targets), AT_ONCE):
                chosen[name] = views[name] | {"target": targets[start : start + AT_ONCE]}
                yield found.load(i)


def trained(runs: Path | None, given: tuple[str, ...] = ()) -> dict[str, tuple[Any, Any]]:
    """Returns {name: (variables, configuration)} of the variants that are trained in `runs`, of
    weights NAME=FILE, and of the shipped weights.
    """
    found = {}
    if runs is not None:
        for name in trained_names(read_json(runs / "results.json")):
            found[name] = load_weights(last_weights(runs / folder_of(name) / "0"))
    for text in given:
        name, mark, file = text.partition("=")
        if not mark:
            raise ValueError(f"--weights {text!r}: expected NAME=FILE")
        found[name] = load_weights(file)
    return found | {SHIPPED: load_weights()}


def measured(
    weights: tuple[Any, Any],
    people: Path,
    photos: int,
    body: Path | None,
    networks: Any,
    views: Views | None = None,
) -> dict[str, Any] | None:
    """Returns the mean scores of views in the pose of the photos and in other poses, and the
    seconds to model a person and to draw a frame.

    Returns None if the system does not take this number of photos. The first person is run twice,
    and only the second run is timed, because the first one compiles.
    """
    config, rows = weights[1], []
    if takes_one(config) and photos > 1:
        return None
    seconds: dict[str, list[float]] = {"model": [], "frame": []}

    def method(case: Any, background: float) -> Any:
        if not seconds["frame"]:
            shown(weights, case, background)
        predicted, modelled, drawn = shown(weights, case, background)
        seconds["model"].append(modelled)
        seconds["frame"].append(drawn / case.truth.view_count)
        return predicted

    for case in cases(people, photos, body, views):
        # a frame that an input shows is no new pose
        def frames(capture):
            return set(np.asarray(capture.frames).tolist())

        seen = set()
        if case.inputs:
            seen = {pose_of(case.inputs, i) for i in frames(case.inputs)}
        same = {i: pose_of(case.truth, i) in seen for i in frames(case.truth)}
        scored = evaluate([case], method=method, lpips=networks).rows
        rows += [(same[row.frame], row) for row in scored]

    # means by pose, and by person within
    means: dict[str, Any] = {"photos": photos}
    for task, first in (("reconstruction", True), ("animation", False)):
        own = list(person_means([row for same, row in rows if same == first]).values())
        means[task] = None
        if own and (first or animatable(config)):
            means[task] = mean_scores(own)
    # a driver runs the whole network for each target
    means["model_s"] = None
    if config.architecture.driver is None:
        means["model_s"] = sum(seconds["model"]) / len(seconds["model"])
    means["frame_s"] = sum(seconds["frame"]) / len(seconds["frame"])
    return means


def pose_of(capture: Any, frame: int) -> bytes:
    """Returns the rounded numbers of the pose of a frame, by which equal poses are found."""
    return b"".join(
        np.asarray(x, np.float32).round(5).tobytes() for x in jax.tree.leaves(capture.pose(frame))
    )


def triple(scores: Any) -> str:
    """Formats PSNR / SSIM / LPIPS of a measured row or of a printed one, with a dash for what is
    missing.
    """
    if scores is None:
        return "-"
    values = scores
    if not isinstance(scores, tuple):
        values = (scores["psnr"], scores["ssim"], scores.get("lpips_vgg"))
    texts = []
    for value, digits in zip(values, (2, 3, 3), strict=True):
        texts.append("-" if value is None else f"{value:.{digits}f}")
    return " / ".join(texts)
