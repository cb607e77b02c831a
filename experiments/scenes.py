"""Fits scenes of Gaussians to photos of a garden made from a seed, with relocation of Gaussians and
with Adam alone.
"""

import dataclasses
import resource
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.geometry.camera import Camera, orbit
from humangs_jax.losses.losses import decibels
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import render_views
from humangs_jax.scenes.config import SCENE_SPLAT, SceneConfig
from humangs_jax.scenes.fitting import SceneFit, fit_scene

HELD_OUT = 4
"""Number of photos that no fit sees."""
FOUND = 0.03
"""Metres by which the points that structure from motion would find are off."""
ROUGHLY = 1.0
"""Metres by which the points of "true number, roughly" are off."""
NUMBERS = 24
"""Number of relocations after which the capacity is reached."""


@entry
def scene_fits(
    run: Run,
    gaussians: int = 200_000,
    photos: int = 40,
    size: tuple[int, ...] = (640, 360),
    steps: tuple[int, ...] = (3_000,),
    points: float = 0.05,
    grown: float = 0.15,
    seed: int = 20_261,
    checkpoints: Path | None = None,
    only: tuple[str, ...] = (),
) -> None:
    """Fits photos of a garden of Gaussians from few points, from none, and from the true number of
    points.

    "true number" begins with a grey Gaussian 3 cm off each Gaussian of the scene, and shows what
    Adam alone reaches from there. "true number, roughly" begins 1 m off.

    Options:
    gaussians: number of Gaussians of the scene, and capacity of the fits
    photos: number of photos that are fitted
    size: width and height of the photos, pixels
    steps: steps of each fit, of one photo each; of several numbers each gives rows
    points: share of the scene's Gaussians that structure from motion finds
    grown: share of the steps after which a growing fit has reached its capacity
    seed: seed of the scene
    checkpoints: folder with checkpoints, from which interrupted fits continue
    only: names of the cases
    """
    scene = garden(gaussians, seed)
    cameras = around(photos + HELD_OUT, *size)
    # gloss may exceed 1, which no photo shows
    truth = np.clip(np.asarray(render_views(scene, cameras, SCENE_SPLAT, "black").rgb), 0, 1)
    shown, hidden = np.arange(photos), np.arange(photos, photos + HELD_OUT)

    # points that structure from motion would find, and the configurations of the fits
    rng = np.random.default_rng(seed + 1)
    found = np.asarray(scene.means) + rng.normal(0, FOUND, scene.means.shape)
    few = found[rng.choice(gaussians, int(points * gaussians), replace=False)]
    roughly = np.asarray(scene.means) + rng.normal(0, ROUGHLY, scene.means.shape)
    cases = {}
    for count in steps:
        growing = SceneConfig(
            capacity=gaussians,
            steps=count,
            start=len(few),
            relocate_every=max(1, int(grown * count) // NUMBERS),
            growth=float((gaussians / len(few)) ** (1.2 / NUMBERS)),
            relocate_until=0.85,
        )
        alone = dataclasses.replace(
            growing, relocate_until=0.0, noise=0.0, opacity_penalty=0.0, scale_penalty=0.0
        )
        ways = {
            "true number, Adam alone": (found, alone),
            "true number, roughly, Adam alone": (roughly, alone),
            "true number, roughly, fit_scene": (roughly, growing),
            "few points, Adam alone": (few, dataclasses.replace(alone, capacity=len(few))),
            "few points, fit_scene": (few, growing),
            "no points, fit_scene": (None, growing),
        }
        end = f", {count:,} steps" if len(steps) > 1 else ""
        cases |= {name + end: way for name, way in ways.items() if not only or name in only}

    def fit(name):
        return lambda: measured(
            *cases[name], truth, cameras, shown, hidden, checkpoint_of(checkpoints, name)
        )

    chosen = {name: fit(name) for name in cases}
    settings = {"gaussians": gaussians, "photos": photos, "size": size, "steps": steps}
    rows = run.rows(chosen, {**settings, "points": points, "grown": grown, "seed": seed})
    table = markdown_table(
        ["", "Gaussians", "photos, dB", "held out, dB", "s", "GiB"],
        [[name, *row] for name, row in rows.items()],
    )
    run.show(table, {name: dict(zip(COLUMNS, row, strict=True)) for name, row in rows.items()})


COLUMNS = ("gaussians", "photos", "held_out", "seconds", "gib")
"""Names of the numbers of a row."""


def checkpoint_of(folder: Path | None, name: str) -> Path | None:
    """Returns the checkpoint of a case in a folder, which is made, or None without a folder."""
    if folder is None:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{name.replace(', ', '_').replace(' ', '_').replace(',', '')}.npz"


def measured(
    points: np.ndarray | None,
    config: SceneConfig,
    truth: np.ndarray,
    cameras: Camera,
    shown: np.ndarray,
    hidden: np.ndarray,
    checkpoint: Path | None,
) -> list[str]:
    """Fits a scene, and returns the cells of its row: Gaussians, PSNR of the fitted photos and of
    those held out in dB, seconds, and peak memory of the process in GiB.

    Args:
        points: (n, 3) points to begin with, None: without points
        config: configuration of the fit
        truth: (v, h, w, 3) all photos
        cameras: cameras of all photos
        shown: indices of the photos that are fitted
        hidden: indices of the photos that are held out
        checkpoint: file to continue from

    Raises: KeyboardInterrupt if the fit was interrupted.
    """
    began = time.perf_counter()
    fit: SceneFit = fit_scene(
        truth[shown], cameras[shown], points, config, checkpoint=checkpoint, progress=True
    )
    if fit.interrupted:
        raise KeyboardInterrupt
    seconds = time.perf_counter() - began

    # views that no fit has seen
    drawn = render_views(fit.gaussians, cameras[hidden], SCENE_SPLAT, "black").rgb
    errors = jnp.mean(jnp.square(drawn - truth[hidden]), axis=(1, 2, 3))
    held_out = float(np.mean([float(decibels(error)) for error in errors]))
    gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    count = f"{len(fit.gaussians.opacities):,}"
    return [count, f"{fit.psnr:.2f}", f"{held_out:.2f}", f"{seconds:.0f}", f"{gib:.1f}"]


def around(count: int, width: int, height: int) -> Camera:
    """Returns cameras on a circle around the table, at random heights and in random order."""
    rng = np.random.default_rng(count)
    azimuths = rng.permutation(count) * 2 * np.pi / count
    K = jnp.asarray([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    elevations = jnp.asarray(rng.uniform(0.15, 0.5, count), jnp.float32)
    azimuths = jnp.asarray(azimuths, jnp.float32)
    return orbit(jnp.asarray([0.0, 0.2, 0.0]), 3.2, azimuths, elevations, K, width, height)


def garden(count: int, seed: int) -> Gaussians:
    """Makes a table with a vase on a lawn, with a hedge around it.

    The Gaussians are flat, round and thin, and have textures. Those of the vase are glossy.
    """
    # which thing each Gaussian belongs to
    rng = np.random.default_rng(seed)
    kinds = rng.choice(5, count, p=[0.3, 0.2, 0.1, 0.3, 0.1])
    angle, u, v = rng.uniform(0, 2 * np.pi, count), rng.random(count), rng.random(count)

    # where it is, metres
    radius = 4.5 * np.sqrt(u)
    lawn = np.stack([radius * np.cos(angle), -0.6 + 0.04 * v, radius * np.sin(angle)], axis=-1)
    disk = 0.9 * np.sqrt(u)
    table = np.stack([disk * np.cos(angle), 0.03 * (v - 0.5), disk * np.sin(angle)], axis=-1)
    height, swell = 0.02 + 0.6 * v, 0.12 + 0.08 * np.sin(6 * v)
    vase = np.stack([swell * np.cos(angle), height, swell * np.sin(angle)], axis=-1)
    out = 4.5 + 0.5 * u
    hedge = np.stack([out * np.cos(angle), -0.6 + 2.2 * v, out * np.sin(angle)], axis=-1)
    leg = np.floor(4 * u) * np.pi / 2
    legs_x = 0.6 * np.cos(leg) + 0.03 * np.cos(angle)
    legs_z = 0.6 * np.sin(leg) + 0.03 * np.sin(angle)
    legs = np.stack([legs_x, -0.6 * v, legs_z], axis=-1)
    means = np.stack([lawn, table, vase, hedge, legs])[kinds, np.arange(count)]
    spacing = 2.6 / np.sqrt(count) * np.asarray([3.0, 0.7, 0.3, 3.0, 0.35])[kinds]
    scales = spacing[:, None] * np.exp(rng.normal(0, 0.4, (count, 3)))

    # colors with waves of three lengths
    waves = rng.normal(size=(3, 3, 3)) * np.asarray([3.0, 9.0, 25.0])[:, None, None]
    shades = [np.sin(means @ wave + rng.uniform(0, 6, 3)) for wave in waves]
    base = np.asarray(
        [
            [0.25, 0.45, 0.15],
            [0.55, 0.4, 0.25],
            [0.3, 0.4, 0.7],
            [0.15, 0.35, 0.12],
            [0.4, 0.3, 0.2],
        ]
    )
    colors = np.clip(base[kinds] + 0.12 * sum(shades) + rng.normal(0, 0.03, (count, 3)), 0, 1)
    gloss = 0.15 * rng.normal(size=(1, 3, 3)) * (kinds == 2)[:, None, None]
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        scales,
        rng.uniform(0.5, 0.98, count),
        colors,
    )
    return Gaussians(
        *(jnp.asarray(array, jnp.float32) for array in arrays),
        harmonics=jnp.asarray(gloss, jnp.float32),
    )
