"""Whether Gaussians that nothing shows serve an avatar better where its photos are fitted worst."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, means
from experiments.results import cells, markdown_table
from experiments.subjects import RING, TASKS, People, Start, score_tasks, shipped_digest
from humangs_jax.avatar.animate import animate, skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.learned import SHIPPED
from humangs_jax.refinement.refine import refine
from humangs_jax.rendering.gaussians import covariances, inverse_sigmoid
from humangs_jax.rendering.splatting import plan_buffers, render, visible_gaussians
from humangs_jax.scenes.mcmc import DEAD, divided

PHOTOS = 4
"""Number of photos."""
JITTER = 0.5
"""Standard deviations by which a copy is moved, since copies on one place have one gradient."""
STAYED, MOVED = "more steps", "relocated, more steps"
SHOWN = {"psnr": ("PSNR", 2), "psnr_fg": ("foreground PSNR", 2), "lpips": ("LPIPS", 4)}
"""Scores of the table: heading and digits."""


@entry
def relocation(
    run: Run,
    people: People = People(16, held_out=6, poses=1, pose_views=4, size=512),
    steps: int = 60,
) -> None:
    """Refinement with MCMC's relocation (Kheradmand et al. 2024) in the middle, and without it.

    An avatar of four photos is refined by the iterations and by steps of Adam. Then its Gaussians
    that are dead (opacity at most 0.005) or hidden (no pixel of any of twelve cameras around the
    person shows them) become copies of others. These are drawn at random, by the error of the
    pixels that show them. A copy keeps the skinning of its original. As many steps follow.

    Options:
    steps: steps of Adam before the relocation, and after it
    """
    if steps < 1:
        raise ValueError(f"--steps: expected at least 1, got {steps}")
    start = people.start()
    settings = {"steps": steps, "photos": PHOTOS, "refiner": shipped_digest(SHIPPED)}
    rows = start.rows(run, lambda seed: _measured(start, seed, steps), settings)

    mean, table = means(rows), []
    for task, name in TASKS.items():
        for way in (STAYED, MOVED):
            gains = [row[task][MOVED]["psnr_fg"] - row[task][STAYED]["psnr_fg"] for row in rows]
            least = "" if way == STAYED else f"{min(gains):+.2f}"
            table.append([name, way, *cells(mean[task][way], SHOWN), least])
    header = ["views", "refinement", *(heading for heading, _ in SHOWN.values()), "least gain"]
    text = (
        f"{len(rows)} people of the {start.settings['split']} seeds, {PHOTOS} photos of"
        f" {start.size} px, {steps} steps before and after. Dead are"
        f" {100 * mean['dead']:.2f} % of the Gaussians, hidden {100 * mean['hidden']:.1f} %. Least"
        " gain: foreground PSNR of the worst person, dB."
    )
    shown = markdown_table(header, table, "ll" + "r" * (len(SHOWN) + 1))
    run.show(f"{text}\n\n{shown}", {"settings": start.settings | settings, "means": mean})


def _measured(start: Start, seed: int, steps: int) -> dict[str, Any]:
    """Scores of one person by task and way, and the shares of dead and hidden Gaussians."""
    subject = start.subject(seed, (PHOTOS, RING))
    photos = subject.inputs(PHOTOS)
    first = RefineConfig(steps=steps, seconds=None, held_out=0.0)
    more = dataclasses.replace(first, iterations=0, head_steps=0)

    begun = refine(reconstruct(start.variables, start.config, photos), photos, first)
    dead, hidden = unused_gaussians(begun, subject.photos)
    moved = relocated(begun, dead | hidden, pixel_errors(begun, photos), seed)

    row: dict[str, Any] = {"dead": float(dead.mean()), "hidden": float((hidden & ~dead).mean())}
    row |= {task: {} for task in TASKS}
    for way, avatar in ((STAYED, begun), (MOVED, moved)):
        drawn = predict_views(refine(avatar, photos, more), subject.held_out)
        scores = score_tasks(drawn.images, subject.held_out, start.lpips, drawn.alpha)
        for task in TASKS:
            row[task][way] = {name: scores[task][name] for name in SHOWN}
    return row


def unused_gaussians(avatar: Avatar, around: Capture) -> tuple[np.ndarray, np.ndarray]:
    """Which Gaussians are dead, (g,), and which no pixel of these views shows, (g,)."""
    posed = animate(avatar, around.poses[0])
    plan = plan_buffers(posed, around.cameras)
    seen = visible_gaussians(posed, around.cameras, plan)
    return np.asarray(avatar.gaussians.opacities) <= DEAD, ~np.asarray(seen)


def pixel_errors(avatar: Avatar, photos: Capture) -> np.ndarray:
    """The sum of the squared errors of the pixels of all photos, divided among the Gaussians by
    their shares of the pixels, (g,).
    """
    posed = skin(avatar, photos.poses[0])
    plan = plan_buffers(posed, photos.cameras)
    labels = jnp.zeros((len(posed.means), 1))

    @jax.jit
    def errors_of_view(camera, photo):
        error = jnp.mean((render(posed, camera, plan).rgb - photo) ** 2, axis=-1)

        # the gradient of a sum of drawn features is the sum of the weights they are drawn with
        def weighted(features):
            drawn = render(posed, camera, plan, features=features).features
            assert drawn is not None
            return jnp.sum(drawn[..., 0] * error)

        return jax.grad(weighted)(labels)[:, 0]

    views = [errors_of_view(photos.cameras[i], photo) for i, photo in enumerate(photos.images)]
    return np.sum(views, axis=0)


def relocated(avatar: Avatar, unused: np.ndarray, errors: np.ndarray, seed: int) -> Avatar:
    """The avatar with unused Gaussians as copies of others, chosen by their errors. Copies share
    the opacity of their original as in equation 9 of the paper.
    """
    rng = np.random.default_rng(seed)
    odds = np.where(unused, 0.0, np.maximum(errors, 0.0))
    source = np.arange(len(unused))
    source[unused] = rng.choice(len(unused), unused.sum(), p=odds / odds.sum())
    copies = np.bincount(source, minlength=len(unused))[source]

    chosen = avatar.select(source)
    gaussians = chosen.gaussians
    logits, shrink = divided(
        inverse_sigmoid(gaussians.opacities, 1e-6), jnp.asarray(copies, jnp.float32)
    )
    split = jnp.asarray(copies > 1)
    normal = jnp.asarray(rng.normal(size=gaussians.means.shape), jnp.float32)
    factors = jnp.linalg.cholesky(covariances(gaussians) + 1e-12 * jnp.eye(3))
    moves = JITTER * jnp.einsum("gij,gj->gi", factors, normal)
    gaussians = replace(
        gaussians,
        means=gaussians.means + jnp.where(jnp.asarray(unused)[:, None], moves, 0.0),
        opacities=jnp.where(split, jax.nn.sigmoid(logits), gaussians.opacities),
        scales=gaussians.scales * jnp.where(split, shrink, 1.0)[:, None],
    )
    return replace(chosen, gaussians=gaussians)
