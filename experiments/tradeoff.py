"""Measures speed against accuracy of the whole path: what each knob costs in decibels, and how much
time, memory and space on disk it takes.

Quality is the mean over people of the split "tradeoff", which nothing else has used, for new views
in the pose of the photos and in novel poses. Photos and true images have 512 pixels. Frames of
another size are resized to 512 before they are compared.

Times are CPU times of all threads for the first person, in turns with the default point. They are
kept as ratios of medians, because other programs change wall times by far more. Refinement is
counted in steps. Compilation does not count. Memory is what making the avatar or refining it adds.
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
"""Number of held-out views in the pose of the photos, of novel poses, and of views of each."""
PHOTOS = (1, 2, 3, 4, 6)
"""Numbers of photos that points use."""
TRUE_SIZE = 512
"""Side of the photos and the true images in pixels."""
FRAMES, ITERATIONS = 10, 2
"""Timed iterations of drawing a frame, and of making an avatar."""
QUALITY, NET = ("psnr", "ssim", "psnr_fg", "lpips"), "alex"
"""Scores of a point, and the network of LPIPS, where the extra `lpips` is installed."""


@entry
def tradeoff(
    run: Run,
    out: Path,
    subjects: int = 2,
    only: tuple[str, ...] = (),
    image: Path | None = None,
) -> None:
    """Measures speed against accuracy of the whole path for some 60 settings, and shows the best of
    them and the presets. Takes half an hour on one core.

    Tables: tradeoff, tradeoff_presets

    Options:
    out: JSON of the points; points in it are not measured again
    subjects: number of people
    only: knobs to measure, beside the default point
    image: draw the fronts to IMAGE_reconstruction.png and IMAGE_frames.png
    """
    knobs = {each.knob: None for each in points()}
    unknown = set(only) - knobs.keys()
    if unknown:
        raise ValueError(f"--only {unknown.pop()}: expected some of {', '.join(knobs)}")
    settings = settings_of()
    result = json.loads(out.read_text()) if out.exists() else {}
    if result.get("settings") != settings:
        result = {"settings": settings, "points": {}}

    # points that have changed are measured again
    rows = result["points"]
    wanted = [each for each in points() if not only or each.knob in (DEFAULT.knob, *only)]
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
    """Returns what all points depend on."""
    net = NET if installed_lpips() else None
    return {
        "weights": shipped_digest(SHIPPED),
        "generator": GENERATOR_VERSION,
        "size": TRUE_SIZE,
        "lpips_net": net,
        **SHOTS,
    }


def described(point) -> dict[str, Any]:
    """Returns a point as data. An earlier measurement counts only if its data are the same."""
    found = {}
    if point.settings.refine_iterations:
        found["refiner"] = shipped_digest(SHIPPED_REFINER)
    found |= {name: getattr(point, name) for name in ("knob", "size", "start")}
    return found | {"settings": json.loads(config_to_json(point.settings))}


def random_start(avatar: Any, seed: int) -> Any:
    """Returns an avatar with as many round Gaussians of random colors on the body's surface."""
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
    """The people, the network, and the default point, with which other points take turns."""

    def __init__(self, subjects: int):
        self.variables, self.config = load_weights()
        body, seeds = load_body(), seeds_of("tradeoff", 0, subjects)
        held_out = HeldOut(SHOTS["held_out"], SHOTS["poses"], SHOTS["pose_views"])

        @functools.cache
        def person(i):
            return make_evaluation_subject(seeds[i], body, PHOTOS, TRUE_SIZE, held_out)

        self.person = person
        self.default = DEFAULT
        self.lpips = load_lpips(NET) if installed_lpips() else None
        self.kept: dict[Any, Any] = {}
        self.default_avatar = self.made(DEFAULT, 0)

    def measure(self, point, i: int, row: dict[str, Any]) -> None:
        """Adds a person's scores to the row of a point. The first person also gives times, memory
        and the size of the file.
        """
        avatar = self.made(point, i)
        scores = self.scores(point, avatar, self.person(i))
        if i == 0 and point.start == "vertex-color baseline":
            row |= self.painted_times()
        elif i == 0:
            with tempfile.TemporaryDirectory() as folder:
                avatar.save(Path(folder) / "avatar.npz")
                row["file_mb"] = (Path(folder) / "avatar.npz").stat().st_size / 2**20
            drawn = self.pruned(point, avatar, self.person(0).held_out)
            row |= self.make_times(point) | self.frame_times(point, drawn)
            row["gaussians"] = len(drawn.gaussians.means)
        row["people"].append({task: {key: scores[task][key] for key in QUALITY} for task in TASKS})

    # Avatars and their images
    # ----------------------------------------------------------------------------------------

    def photos(self, settings, i=0):
        """Returns as many photos of a person as settings take, or all."""
        return self.person(i).inputs(settings.views or PHOTOS[-1])

    def made(self, point, i):
        """Returns the avatar of a point. Points that only differ in drawing share an avatar."""
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
        """Returns the scores by task of frames that are resized to the size of the truth."""
        truth = person.held_out
        if point.start == "vertex-color baseline":
            return score_tasks(draw_painted_body(avatar, truth), truth, self.lpips)
        avatar = self.pruned(point, avatar, truth)
        poses, cameras = capture_views(avatar, truth)
        cameras = cameras.resized(point.size, point.size)
        renderings = draw(avatar, poses, cameras, how=self.how(point, avatar))
        drawn = [np.clip(np.asarray(each.rgb), 0, 1) for each in renderings]
        if point.size != TRUE_SIZE:
            drawn = [resized(image, TRUE_SIZE, TRUE_SIZE) for image in drawn]
        return score_tasks(np.stack(drawn), truth, self.lpips)

    def pruned(self, point, avatar, held_out):
        """Returns an avatar without what the held-out views do not show, if the point prunes."""
        if not point.settings.prune:
            return avatar
        poses, cameras = capture_views(avatar, held_out)
        return without_unseen(avatar, poses, cameras, self.how(point, avatar))

    @staticmethod
    def how(point, avatar):
        """Returns the configuration of splatting of a point."""
        return splatting_of(point.settings.shot(FrameSettings()), avatar)

    # Times and memory
    # ----------------------------------------------------------------------------------------------

    def make(self, settings):
        """Reconstructs the first person once, without refinement."""
        photos = self.photos(settings)
        return reconstruct_with(settings.unrefined, self.variables, self.config, photos)

    def default_make_ms(self) -> float:
        """Returns the CPU milliseconds of a reconstruction of the default point, measured now."""
        return timed(lambda: self.make(self.default.settings))[1]

    def make_times(self, point) -> dict[str, Any]:
        """Measures how an avatar is made.

        Returns the time with refinement as a multiple of the default's reconstruction, the share of
        refinement in it, and the memory that is added in MiB; for the default point also its ms.
        """
        # a point that differs only in refinement takes the time of the default point
        settings, usual = point.settings, self.default.settings
        same = (settings.views, settings.runtime) == (usual.views, usual.runtime)
        own, default = 1.0, 1.0
        if point is self.default or not same:
            pairs = []
            for _ in range(ITERATIONS):
                pairs.append((timed(lambda: self.make(settings))[1], self.default_make_ms()))
            own, default = np.median(pairs, axis=0)
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
        if point is self.default:
            times["reconstruct_ms"] = float(own)
        return times

    def refining(self, settings) -> tuple[float, float | None]:
        """Returns the time of a refinement as a multiple of the default's reconstruction, without
        compilation, and the MiB that it adds.
        """
        photos, avatar = self.photos(settings), self.make(settings)

        def run(config):
            return refine_with_report(avatar, photos, config)

        # a short refinement compiles
        short = dataclasses.replace(settings, refine_steps=min(settings.refine_steps, 1))
        run(short.refinement)
        default = [self.default_make_ms() for _ in range(ITERATIONS)]
        with peak_memory() as peak:
            own = timed(lambda: run(settings.refinement))[1]
        default += [self.default_make_ms() for _ in range(ITERATIONS)]
        return own / float(np.median(default)), peak[0]

    def frame_times(self, point, drawn) -> dict[str, Any]:
        """Returns the time of a frame as a multiple of the default's; for the default point also
        its ms.
        """
        ours = self.frames(drawn, point.size, self.how(point, drawn))
        usual = self.default_frames()
        pairs = []
        for _ in range(FRAMES + 1):
            pairs.append([timed(functools.partial(next, each))[1] for each in (ours, usual)])
        # the first frames compile
        own, default = np.median(pairs[1:], axis=0)
        if point is self.default:
            return {"frame": 1.0, "frame_ms": float(default)}
        return {"frame": float(own / default)}

    def default_frames(self):
        """Yields frames of the default point without end."""
        how = self.how(self.default, self.default_avatar)
        return self.frames(self.default_avatar, self.default.size, how)

    def frames(self, avatar, size, how):
        """Yields frames without end, in the poses of the held-out views."""
        poses, views = capture_views(avatar, self.person(0).held_out)
        cameras = views.resized(size, size)

        def turns():
            return itertools.cycle(range(len(poses.rotations)))

        def pose(i):
            return jax.tree.map(lambda x: x[i], poses)

        endless = (pose(i) for i in turns()), (cameras[i] for i in turns())
        renderings = draw(avatar, *endless, how=how, at_once=1)
        return (jax.block_until_ready(rendering) for rendering in renderings)

    def painted_times(self) -> dict[str, Any]:
        """Returns the times of the vertex-color baseline, whose mesh is rasterized, as multiples of
        the default's.
        """
        photos, held_out = self.person(0).inputs(4), self.person(0).held_out
        one = held_out.select([0])
        colors = painted_body(photos)
        draw_painted_body(colors, one)
        makes = [
            (timed(lambda: np.asarray(painted_body(photos)))[1], self.default_make_ms())
            for _ in range(ITERATIONS)
        ]
        usual = self.default_frames()
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
