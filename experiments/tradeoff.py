"""Speed against accuracy of the whole path: what each knob costs in decibels and takes in time,
memory and bytes.

Quality is the mean over people of the split "tradeoff", which nothing else has seen: new views in
the pose of the photos and in novel poses. Photos and true images have 512 pixels; frames of another
size are brought to 512 before they are compared. Times are CPU times of all threads, of the first
person, in turns with the default point's, and kept as ratios of medians: other programs stretch
wall times by far more. Refinement is counted in steps. Compilation does not count. Memory: what
making the avatar or refining it adds.
"""

import dataclasses
import functools
import itertools
import json
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import tradeoff_report
from experiments.harness import Run, entry
from experiments.results import write_json
from experiments.subjects import (
    TASKS,
    HeldOut,
    make_evaluation_subject,
    score_tasks,
    shipped_digest,
)
from experiments.timing import timed
from experiments.tradeoff_report import DEFAULT, points
from humangs_jax.apps.settings import reconstruct_with
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import capture_views, draw, splatting_of, without_unseen
from humangs_jax.body.library import load_body
from humangs_jax.core.configuration import config_to_json
from humangs_jax.core.processes import peak_memory
from humangs_jax.core.progress import bar
from humangs_jax.core.pytree import replace
from humangs_jax.evaluation.cases import draw_painted_body, painted_body
from humangs_jax.io.images import resized
from humangs_jax.losses.loss_networks import installed_lpips, load_lpips
from humangs_jax.network.weights import SHIPPED, load_weights
from humangs_jax.refinement.learned import SHIPPED as SHIPPED_REFINER
from humangs_jax.refinement.refine import refine_with_report
from humangs_jax.synthetic.subject import GENERATOR_VERSION, seeds_of

SHOTS = {"held_out": 3, "poses": 2, "pose_views": 1}
"""Held-out views of a person: of the pose of the photos; novel poses; views of each."""
PHOTOS = (1, 2, 3, 4, 6)
TRUE_SIZE = 512
FRAMES, ITERATIONS = 10, 2
"""Timed iterations of drawing a frame, and of making an avatar."""
QUALITY, NET = ("psnr", "ssim", "psnr_fg", "lpips"), "alex"
"""LPIPS of this network, where the extra `lpips` is installed."""


@entry
def tradeoff(
    run: Run,
    out: Path,
    subjects: int = 2,
    only: tuple[str, ...] = (),
    image: Path | None = None,
) -> None:
    """Speed against accuracy of the whole path: some 60 settings, their front, and presets. Half an
    hour on one core.

    Tables: tradeoff, tradeoff_presets

    Options:
    out: JSON of the points; those that are there are not measured again
    subjects: how many people
    only: knobs to measure, beside the default point
    image: draw the fronts to IMAGE_reconstruction.png and IMAGE_frames.png
    """
    knobs = {each.knob: None for each in points()}
    if unknown := set(only) - knobs.keys():
        raise ValueError(f"--only {unknown.pop()}: expected some of {', '.join(knobs)}")
    settings = settings_of()
    result = json.loads(out.read_text()) if out.exists() else {}
    if result.get("settings") != settings:
        result = {"settings": settings, "points": {}}
    rows, wanted = (
        result["points"],
        [p for p in points() if not only or p.knob in (DEFAULT.knob, *only)],
    )
    for each in wanted:
        if described(each) != rows.get(each.name, {}).get("what"):
            rows[each.name] = {"what": described(each), "people": []}
    missing = [(i, p) for i in range(subjects) for p in wanted if len(rows[p.name]["people"]) <= i]
    if missing:
        bench = Bench(subjects)
        # all of one person, then the next: times are of the first
        for done, (i, each) in enumerate(bar(missing, desc="points", unit="point")):
            if done % 20 == 19:
                # compiled programs hold memory maps, of which Linux gives a process 65,530
                jax.clear_caches()
                bench.default_make_ms()  # compiles
            bench.measure(each, i, rows[each.name])
            write_json(out, result)
    tradeoff_report.show(run, result, image)


def settings_of() -> dict[str, Any]:
    net = NET if installed_lpips() else None
    return {
        "weights": shipped_digest(SHIPPED),
        "generator": GENERATOR_VERSION,
        "size": TRUE_SIZE,
        "lpips_net": net,
        **SHOTS,
    }


def described(point) -> dict[str, Any]:
    """A point as data; what it says of weights decides whether an earlier measurement still
    counts.
    """
    learned = (
        {"refiner": shipped_digest(SHIPPED_REFINER)} if point.settings.refine_iterations else {}
    )
    fields = {name: getattr(point, name) for name in ("knob", "size", "start")}
    return learned | fields | {"settings": json.loads(config_to_json(point.settings))}


def random_start(avatar: Any, seed: int) -> Any:
    """Round Gaussians of random colors where the body's surface is, as many as the avatar has."""
    rng, count = np.random.default_rng(seed), len(avatar.gaussians.means)
    means = jnp.repeat(avatar.rest_vertices, count // len(avatar.rest_vertices), axis=0)
    gaussians = replace(
        avatar.gaussians,
        means=means + jnp.asarray(0.005 * rng.normal(size=means.shape), jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        scales=jnp.full((count, 3), 0.01),
        opacities=jnp.full(count, 0.5),
        colors=jnp.asarray(rng.random((count, 3)), jnp.float32),
        pixel_footprint=None,
    )
    return replace(avatar, gaussians=gaussians, light=None)


class Bench:
    """The people, the network, and the default point, with which others take turns."""

    def __init__(self, subjects: int):
        (self.variables, self.config), body, seeds = (
            load_weights(),
            load_body(),
            seeds_of("tradeoff", 0, subjects),
        )
        held_out = HeldOut(SHOTS["held_out"], SHOTS["poses"], SHOTS["pose_views"])
        self.person = functools.cache(
            lambda i: make_evaluation_subject(seeds[i], body, PHOTOS, TRUE_SIZE, held_out)
        )
        self.default = DEFAULT
        self.lpips = load_lpips(NET) if installed_lpips() else None
        self.kept: dict[Any, Any] = {}
        self.default_avatar = self.made(DEFAULT, 0)

    def measure(self, point, i: int, row: dict[str, Any]) -> None:
        """Adds a person's scores to a point's row; with the first, also times, memory and bytes."""
        avatar = self.made(point, i)
        scores = self.scores(point, avatar, self.person(i))
        if i == 0 and point.start == "vertex-color baseline":
            row |= self.painted_times()
        elif i == 0:
            with tempfile.TemporaryDirectory() as folder:
                avatar.save(Path(folder) / "avatar.npz")
                row["file_mb"] = (Path(folder) / "avatar.npz").stat().st_size / 2**20
            drawn = self.pruned(point, avatar, self.person(0).held_out)
            row |= (
                self.make_times(point)
                | self.frame_times(point, drawn)
                | {"gaussians": len(drawn.gaussians.means)}
            )
        row["people"].append({task: {key: scores[task][key] for key in QUALITY} for task in TASKS})

    # Avatars and their images
    # ----------------------------------------------------------------------------------------

    def photos(self, settings, i=0):
        """As many photos of a person as settings take, or all."""
        return self.person(i).inputs(settings.views or PHOTOS[-1])

    def made(self, point, i):
        """The avatar of a point; those that only differ in how they are drawn are made once."""
        settings = dataclasses.replace(point.settings, splat="as_trained", prune=False)
        key = (settings, point.start, i)
        if key not in self.kept:
            photos = self.photos(settings, i)
            if point.start == "vertex-color baseline":
                avatar = painted_body(photos)
            else:
                avatar = reconstruct_with(settings.unrefined, self.variables, self.config, photos)
                if point.start == "random colors":
                    avatar = random_start(avatar, self.person(i).seed)
                if settings.refinement is not None:
                    avatar = refine_with_report(avatar, photos, settings.refinement).avatar
            if len(self.kept) > 8:
                self.kept.pop(next(k for k in self.kept if k[0] != self.default.settings))
            self.kept[key] = avatar
        return self.kept[key]

    def scores(self, point, avatar, person):
        """Scores by task, of frames brought to the size of the truth."""
        truth = person.held_out
        if point.start == "vertex-color baseline":
            return score_tasks(draw_painted_body(avatar, truth), truth, self.lpips)
        avatar = self.pruned(point, avatar, truth)
        poses, cameras = capture_views(avatar, truth)
        cameras = cameras.resized(point.size, point.size)
        drawn = [
            np.clip(np.asarray(r.rgb), 0, 1)
            for r in draw(avatar, poses, cameras, how=self.how(point, avatar))
        ]
        if point.size != TRUE_SIZE:
            drawn = [resized(image, TRUE_SIZE, TRUE_SIZE) for image in drawn]
        return score_tasks(np.stack(drawn), truth, self.lpips)

    def pruned(self, point, avatar, held_out):
        """Without what the held-out views do not show, where the point says so."""
        if not point.settings.prune:
            return avatar
        poses, cameras = capture_views(avatar, held_out)
        return without_unseen(avatar, poses, cameras, self.how(point, avatar))

    @staticmethod
    def how(point, avatar):
        return splatting_of(point.settings.shot(FrameSettings()), avatar)

    # Times and memory
    # ----------------------------------------------------------------------------------------------

    def make(self, settings):
        """One reconstruction of the first person, without refinement."""
        return reconstruct_with(
            settings.unrefined, self.variables, self.config, self.photos(settings)
        )

    def default_make_ms(self) -> float:
        """Of the default point, now."""
        return timed(lambda: self.make(self.default.settings))[1]

    def make_times(self, point) -> dict[str, Any]:
        """Time of making the avatar over the default's, with refinement; the default's ms; peak
        memory, MiB.
        """
        settings, usual = point.settings, self.default.settings
        same = (settings.views, settings.runtime) == (usual.views, usual.runtime)
        pairs = []
        for _ in range(0 if same and point is not self.default else ITERATIONS):
            pairs.append((timed(lambda: self.make(settings))[1], self.default_make_ms()))
        own, default = np.median(pairs, axis=0) if pairs else (1.0, 1.0)
        ratio = float(own / default)
        if point is self.default:
            ratio = 1.0
        if point.start == "random colors":
            ratio = 0.0
        with peak_memory() as peak:
            self.make(settings)
        refined, memory = 0.0, peak[0]
        if settings.refinement is not None:
            refined, more = self.refining(settings)
            memory = max(memory or 0.0, more or 0.0)
        times = {"reconstruct": ratio + refined, "refine_share": refined, "memory_mb": memory}
        return times | ({"reconstruct_ms": float(own)} if point is self.default else {})

    def refining(self, settings) -> tuple[float, float | None]:
        """Time of a refinement over the default's reconstruction, without compilation, and its
        MiB.
        """
        photos, avatar = self.photos(settings), self.make(settings)

        def run(config):
            return refine_with_report(avatar, photos, config)

        run(
            dataclasses.replace(settings, refine_steps=min(settings.refine_steps, 1)).refinement
        )  # compiles
        default = [self.default_make_ms() for _ in range(ITERATIONS)]
        with peak_memory() as peak:
            own = timed(lambda: run(settings.refinement))[1]
        default += [self.default_make_ms() for _ in range(ITERATIONS)]
        return own / float(np.median(default)), peak[0]

    def frame_times(self, point, drawn) -> dict[str, Any]:
        """Time of a frame over the default's, and the default's ms."""
        ours = self.frames(drawn, point.size, self.how(point, drawn))
        usual = self.frames(
            self.default_avatar, self.default.size, self.how(self.default, self.default_avatar)
        )
        pairs = [[timed(lambda f=f: next(f))[1] for f in (ours, usual)] for _ in range(FRAMES + 1)][
            1:
        ]
        own, default = np.median(pairs, axis=0)
        return (
            {"frame": 1.0, "frame_ms": float(default)}
            if point is self.default
            else {"frame": float(own / default)}
        )

    def frames(self, avatar, size, how):
        """Frames without end, in the poses of the held-out views."""
        poses, views = capture_views(avatar, self.person(0).held_out)
        cameras = views.resized(size, size)

        def turns():
            return itertools.cycle(range(len(poses.rotations)))

        def pose(i):
            return jax.tree.map(lambda x: x[i], poses)

        renderings = draw(
            avatar, (pose(i) for i in turns()), (cameras[i] for i in turns()), how=how
        )
        return (jax.block_until_ready(rendering) for rendering in renderings)

    def painted_times(self) -> dict[str, Any]:
        """Of the vertex-color baseline: the mesh with its colors, rasterized."""
        photos, held_out = self.person(0).inputs(4), self.person(0).held_out
        one = held_out.select([0])
        colors = painted_body(photos)
        draw_painted_body(colors, one)
        makes = [
            (timed(lambda: np.asarray(painted_body(photos)))[1], self.default_make_ms())
            for _ in range(ITERATIONS)
        ]
        usual = self.frames(
            self.default_avatar, self.default.size, self.how(self.default, self.default_avatar)
        )
        next(usual)
        frames = [
            (timed(lambda: draw_painted_body(colors, one))[1], timed(lambda: next(usual))[1])
            for _ in range(FRAMES)
        ]
        make, frame = (np.median(pairs, axis=0) for pairs in (makes, frames))
        return {
            "reconstruct": float(make[0] / make[1]),
            "refine_share": 0.0,
            "frame": float(frame[0] / frame[1]),
        }
