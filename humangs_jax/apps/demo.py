"""The demonstration: an unseen person, four photos, one forward pass, some seconds of refinement, new views, a walk."""

import dataclasses
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
from humangs_jax.avatar.export.ply import write_ply
from humangs_jax.avatar.frames import capture_renderings, motion_frames, splatting_of
from humangs_jax.avatar.layers import write_renderings_exr
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.sheets import contact_sheet, side_by_side
from humangs_jax.avatar.shot import Shot
from humangs_jax.avatar.video import write_video
from humangs_jax.core.progress import stage
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.motion import Motion, load_motion
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.evaluation.cases import draw_painted_body, painted_body
from humangs_jax.evaluation.scores import score
from humangs_jax.io.atomic import add_files
from humangs_jax.io.reading import write_json
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import refine_with_report
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.viewer.page import write_page

VERSIONS = ("humangs_jax", "jax", "jaxlib", "flax", "numpy")


def run_demo(
    out: str | os.PathLike,
    weights: str | os.PathLike | None = None,
    frame_size: int = 256,
    refine: RefineConfig | None = None,
    settings: Settings | None = None,
) -> dict[str, Any]:
    """Run every stage and write its products into `out`; returns what report.json holds.

    refine: how the avatar is fitted to its photos; None: not at all. settings: which photos are used, how the network runs,
    how frames are drawn (their refinement is not used); None: all photos, as the weights were trained.

    Files: inputs.png, novel_views.png (truth, feed-forward, error), novel_views.exr, animation.mp4 and .gif, avatar.npz,
    avatar.ply, avatar.html (see docs/viewer.md), report.json; with `refine` also refined.png (truth, feed-forward, refined), and
    animation and avatar are the refined ones. All of them appear at the end together; nothing is left behind by a run that fails.
    """
    out = Path(out)
    started, report = time.perf_counter(), {}

    def write(folder: Path) -> None:
        report.update(_write_products(folder, weights, frame_size, refine, settings or Settings()))
        report["total_seconds"] = round(time.perf_counter() - started, 3)
        write_json(folder / "report.json", report, indent=2)

    add_files(out, write)
    return report


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


def _write_products(
    out: Path, weights: str | os.PathLike | None, frame_size: int, refine: RefineConfig | None, settings: Settings
) -> dict[str, Any]:
    timings: dict[str, dict[str, float]] = {}
    with stage("loading"):
        inputs = settings.photos(_timed(timings, "load_capture", lambda: load_capture(DEMO_CAPTURE)))
        truth = load_capture(f"{DEMO_CAPTURE}/held_out")
        variables, config = _timed(timings, "load_weights", lambda: load_weights(weights))
        config, motion = settings.network(config), load_motion()
    with stage("reconstructing"):
        avatar = _timed(timings, "reconstruct", lambda: reconstruct(variables, config, inputs), twice=True)
        _timed(timings, "animate", lambda: animate(avatar, motion.pose(0)), twice=True)
    with stage("rendering"):
        how = splatting_of(settings.shot(Shot()), avatar)
        draw = lambda background: capture_renderings(avatar, truth, background, how)
        cameras, renderings = _timed(timings, "render_held_out", lambda: draw(jnp.ones(3)), twice=True)
        ours = np.stack([np.asarray(r.rgb) for r in renderings])
        scores, refined = score(ours, truth), {}
    if refine is not None:
        with stage("refining"):
            avatar, refined = _refine(avatar, inputs, truth, ours, refine, out / "refined.png", how)
    with stage("animating"):
        shot = settings.shot(Shot(size=frame_size, azimuth=25.0))
        draw_motion = lambda: np.stack(list(motion_frames(avatar, motion, shot, turn=40.0)))
        frames = _timed(timings, "animation_frames", draw_motion)
    with stage("writing"):
        start = time.perf_counter()
        _write_files(out, avatar, inputs, truth, ours, frames, motion)
        write_renderings_exr(out / "novel_views.exr", cameras, draw(jnp.zeros(3))[1])
        timings["write_files"] = {"seconds": round(time.perf_counter() - start, 3)}

    baseline = score(draw_painted_body(painted_body(inputs), truth), truth)
    return {
        **{name: round(value, 4) for name, value in dataclasses.asdict(scores).items()},
        **refined,
        "baseline_psnr": round(baseline.psnr, 4),
        "baseline_psnr_fg": round(baseline.psnr_fg, 4),
        "lpips": "not computed: no LPIPS weights are available",
        "gaussians": len(avatar.gaussians.means),
        "views": {"input": inputs.view_count, "held_out": truth.view_count},
        "image_size": [inputs.cameras.width, inputs.cameras.height],
        "timings": timings,
        "versions": {name: metadata.version(name) for name in VERSIONS} | {"python": platform.python_version()},
        "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
    }


def _write_files(
    out: Path, avatar: Avatar, inputs: Capture, truth: Capture, ours: np.ndarray, frames: np.ndarray, motion: Motion
) -> None:
    contact_sheet(inputs.images, out / "inputs.png", labels=[f"photo {i}" for i in range(inputs.view_count)])
    side_by_side(truth.images, ours, out / "novel_views.png")
    write_video(out / "animation.mp4", frames, motion.fps)
    write_video(out / "animation.gif", frames, motion.fps)
    avatar.save(out / "avatar.npz")
    write_ply(out / "avatar.ply", avatar.gaussians)
    write_page(out / "avatar.html", avatar, motion)


def _refine(
    avatar: Avatar,
    inputs: Capture,
    truth: Capture,
    feed_forward: np.ndarray,
    config: RefineConfig,
    sheet: Path,
    how: SplatConfig,
) -> tuple[Avatar, dict[str, Any]]:
    """The refined avatar, and what the report says of it; draws both beside the truth."""
    run = refine_with_report(avatar, inputs, config, progress=True)
    if run.interrupted:
        raise KeyboardInterrupt
    drawn = np.stack([np.asarray(r.rgb) for r in capture_renderings(run.avatar, truth, how=how)[1]])
    rows = np.stack([truth.images, feed_forward, np.clip(drawn, 0, 1)], axis=1).reshape(-1, *drawn.shape[1:])
    contact_sheet(np.clip(rows, 0, 1), sheet, headers=("truth", "feed-forward", "refined") * 2, columns=6)
    numbers = {name: round(value, 4) for name, value in dataclasses.asdict(score(drawn, truth)).items()}
    about = {"steps": run.steps, "seconds": round(run.seconds, 1), "compile_seconds": round(run.compile_seconds, 1)}
    return run.avatar, {"refined": numbers | about}


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
