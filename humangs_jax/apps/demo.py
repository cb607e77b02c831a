"""The demonstration: an unseen person, four photos, one forward pass, some seconds of refinement, new views, a walk."""

import contextlib
import dataclasses
import functools
import json
import os
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.apps.settings import Settings
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.splats import write_ply
from humangs_jax.avatar.frames import capture_renderings, motion_frames, splatting_of
from humangs_jax.avatar.layers import write_renderings_exr
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.shot import Shot
from humangs_jax.avatar.video import contact_sheet, side_by_side, write_video
from humangs_jax.core.configuration import config_to_json
from humangs_jax.core.progress import say, stage
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.motion import Motion, load_motion
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.evaluation.cases import draw_painted_body, painted_body
from humangs_jax.evaluation.scores import score
from humangs_jax.io.atomic import add_files
from humangs_jax.io.reading import read_json, write_json
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine_with_report
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.viewer.page import write_page

REPORT, AVATAR = "report.json", "avatar.npz"
VERSIONS = ("humangs_jax", "jax", "jaxlib", "flax", "numpy")


def run_demo(
    out: str | os.PathLike[str],
    weights: str | os.PathLike[str] | None = None,
    frame_size: int = 256,
    refine: RefineConfig | None = None,
    settings: Settings | None = None,
) -> dict[str, Any]:
    """Run every stage and write its products into `out`; returns what report.json holds.

    refine: how the avatar is fitted to its photos; None: not at all. settings: which photos are used, how the network runs,
    how frames are drawn (their refinement is not used); None: all photos, as the weights were trained.

    Files: inputs.png, novel_views.png (truth, feed-forward, error), novel_views.exr, animation.mp4 and .gif, avatar.npz,
    avatar.ply, avatar.html (see docs/viewer.md), report.json; with `refine` also refined.png (truth, feed-forward, refined), and
    the others are of the refined avatar. Those of a stage appear together at its end. The same call goes on after the stages that
    an interrupted one has finished; once all are there, it begins anew.
    """
    demo = _Demo(Path(out), weights, frame_size, refine, settings or Settings())
    made_with = {
        "version": metadata.version("humangs_jax"),
        "weights": None if weights is None else str(weights),
        "frame_size": frame_size,
        "refine": None if refine is None else json.loads(config_to_json(refine)),
        "settings": json.loads(config_to_json(demo.settings)),
    }
    stages = {"reconstruct": demo.reconstruct, "animate": demo.animate, "write": demo.write}
    if refine is not None:
        stages = {"reconstruct": demo.reconstruct, "refine": demo.refine_avatar, **stages}
    report = _unfinished(demo.out, made_with, list(stages))
    for name, run in stages.items():
        if name in report["finished"]:
            continue
        started = time.perf_counter()

        def write(folder: Path, name: str = name, run: Callable = run, started: float = started) -> None:
            report.update(run(folder, report["timings"]))
            report["finished"].append(name)
            report["total_seconds"] = round(report["total_seconds"] + time.perf_counter() - started, 3)
            write_json(folder / REPORT, report, indent=2)

        add_files(demo.out, write)
    return report


def _unfinished(out: Path, made_with: dict[str, Any], stages: list[str]) -> dict[str, Any]:
    """The report of an interrupted run of the same call, or the beginning of one."""
    with contextlib.suppress(OSError, ValueError):
        report = read_json(out / REPORT)
        finished = report.get("finished") if isinstance(report, dict) and report.get("made_with") == made_with else stages
        if finished != stages and finished == stages[: len(finished)]:
            say(f"{out}: going on after {', '.join(finished)}")
            return report
    return {"made_with": made_with, "finished": [], "timings": {}, "total_seconds": 0.0}


def summary(report: dict[str, Any]) -> str:
    """What `run_demo` found, in one line."""
    quality = (
        f"PSNR {report['psnr']:.2f} dB, SSIM {report['ssim']:.3f}, foreground PSNR {report['psnr_fg']:.2f} dB on "
        f"{report['views']['held_out']} held-out views (vertex-color baseline: {report['baseline_psnr']:.2f} dB)"
    )
    refined = report.get("refined")
    if refined is None:
        return quality
    gain = f"{refined['psnr']:.2f}, foreground {refined['psnr_fg']:.2f} dB"
    return f"{quality}; refined for {refined['seconds']:.0f} s: {gain}"


@dataclasses.dataclass(frozen=True, eq=False)
class _Demo:
    """The stages: each writes its products into a folder, from which they are moved to `out`, and returns its part of the report.

    What an earlier stage has made is read from `out`.
    """

    out: Path
    weights: str | os.PathLike[str] | None
    frame_size: int
    refine: RefineConfig | None
    settings: Settings

    @functools.cached_property
    def inputs(self) -> Capture:
        return self.settings.photos(load_capture(DEMO_CAPTURE))

    @functools.cached_property
    def truth(self) -> Capture:
        return load_capture(f"{DEMO_CAPTURE}/held_out")

    @functools.cached_property
    def motion(self) -> Motion:
        return load_motion()

    def draw(self, avatar: Avatar, background: float = 1.0) -> tuple[Any, list[Rendering]]:
        """The held-out views: cameras, renderings."""
        how = splatting_of(self.settings.shot(Shot()), avatar)
        return capture_renderings(avatar, self.truth, jnp.full(3, background), how)

    def reconstruct(self, folder: Path, timings: dict[str, Any]) -> dict[str, Any]:
        with stage("loading"):
            inputs, truth = _timed(timings, "load_capture", lambda: self.inputs), self.truth
            variables, config = _timed(timings, "load_weights", lambda: load_weights(self.weights))
            config = self.settings.network(config)
        with stage("reconstructing"):
            avatar = _timed(timings, "reconstruct", lambda: reconstruct(variables, config, inputs), twice=True)
            _timed(timings, "animate", lambda: animate(avatar, self.motion.pose(0)), twice=True)
        with stage("rendering"):
            ours = _images(_timed(timings, "render_held_out", lambda: self.draw(avatar), twice=True))
            baseline = score(draw_painted_body(painted_body(inputs), truth), truth)
            scores = dataclasses.asdict(score(ours, truth))
        avatar.save(folder / AVATAR)
        contact_sheet(inputs.images, folder / "inputs.png", labels=[f"photo {i}" for i in range(inputs.view_count)])
        side_by_side(truth.images, ours, folder / "novel_views.png")
        return {
            **{name: round(value, 4) for name, value in scores.items()},
            "baseline_psnr": round(baseline.psnr, 4),
            "baseline_psnr_fg": round(baseline.psnr_fg, 4),
            "lpips": "not computed: no LPIPS weights are available",
            "gaussians": len(avatar.gaussians.means),
            "views": {"input": inputs.view_count, "held_out": truth.view_count},
            "image_size": [inputs.cameras.width, inputs.cameras.height],
            "versions": {name: metadata.version(name) for name in VERSIONS} | {"python": platform.python_version()},
            "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
        }

    def refine_avatar(self, folder: Path, timings: dict[str, Any]) -> dict[str, Any]:
        """Also draws both avatars beside the truth."""
        feed_forward, truth = Avatar.load(self.out / AVATAR), self.truth
        assert self.refine is not None
        with stage("refining"):
            run = refine_with_report(feed_forward, self.inputs, self.refine, progress=True)
            if run.interrupted:
                raise KeyboardInterrupt
            before, drawn = (_images(self.draw(avatar)) for avatar in (feed_forward, run.avatar))
        rows = np.stack([truth.images, before, np.clip(drawn, 0, 1)], axis=1).reshape(-1, *drawn.shape[1:])
        headers = ("truth", "feed-forward", "refined") * 2
        contact_sheet(np.clip(rows, 0, 1), folder / "refined.png", headers=headers, columns=6)
        run.avatar.save(folder / AVATAR)
        numbers = {name: round(value, 4) for name, value in dataclasses.asdict(score(drawn, truth)).items()}
        about = {"steps": run.steps, "seconds": round(run.seconds, 1), "compile_seconds": round(run.compile_seconds, 1)}
        return {"refined": numbers | about}

    def animate(self, folder: Path, timings: dict[str, Any]) -> dict[str, Any]:
        avatar, shot = Avatar.load(self.out / AVATAR), self.settings.shot(Shot(size=self.frame_size, azimuth=25.0))
        with stage("animating"):
            draw = lambda: np.stack(list(motion_frames(avatar, self.motion, shot, turn=40.0)))
            frames = _timed(timings, "animation_frames", draw)
            write_video(folder / "animation.mp4", frames, self.motion.fps)
            write_video(folder / "animation.gif", frames, self.motion.fps)
        return {}

    def write(self, folder: Path, timings: dict[str, Any]) -> dict[str, Any]:
        avatar, start = Avatar.load(self.out / AVATAR), time.perf_counter()
        with stage("writing"):
            write_ply(folder / "avatar.ply", avatar.gaussians)
            write_page(folder / "avatar.html", avatar, self.motion)
            write_renderings_exr(folder / "novel_views.exr", *self.draw(avatar, background=0.0))
        timings["write_files"] = {"seconds": round(time.perf_counter() - start, 3)}
        return {}


def _images(views: tuple[Any, list[Rendering]]) -> np.ndarray:
    return np.stack([np.asarray(rendering.rgb) for rendering in views[1]])


def _timed(timings: dict, name: str, run: Callable[[], Any], twice: bool = False) -> Any:
    """Run a stage and record its seconds; `twice`: separately for compiling (first run less second) and running (second)."""
    start = time.perf_counter()
    result = jax.block_until_ready(run())
    first = time.perf_counter() - start
    timings[name] = {"seconds": round(first, 3)}
    if twice:
        start = time.perf_counter()
        jax.block_until_ready(run())
        second = time.perf_counter() - start
        timings[name] = {"compile": round(max(first - second, 0.0), 3), "run": round(second, 3)}
    return result
