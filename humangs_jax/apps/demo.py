"""Runs the demonstration: reconstructs an unseen person from four photos in one forward pass,
refines the avatar for some seconds, and draws new views and a walk.
"""

import contextlib
import dataclasses
import os
import platform
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from humangs_jax.apps.settings import Settings
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import export
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import capture_renderings, motion_frames, splatting_of
from humangs_jax.avatar.layers import write_renderings_exr
from humangs_jax.avatar.reconstruct import calls_of_reconstruct, reconstruct
from humangs_jax.avatar.video import contact_sheet, side_by_side, write_video
from humangs_jax.core.arrays import from_host
from humangs_jax.core.processes import Ahead, Call
from humangs_jax.core.progress import COMPILING, stage
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.view_choice import best_views
from humangs_jax.evaluation.cases import (
    calls_of_painted_body,
    draw_painted_body,
    painted_body,
)
from humangs_jax.evaluation.scores import score
from humangs_jax.io.atomic import add_files, check_ours
from humangs_jax.io.reading import read_json, write_json
from humangs_jax.motion import load_motion
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import Refinement, calls_of_refine, refine_with_report
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.viewer.page import write_page

_PICTURES = (
    "inputs.png",
    "novel_views.png",
    "refined.png",
    "animation.mp4",
    "animation.gif",
    "novel_views.exr",
)
FILES = ("report.json", *_PICTURES, "avatar.npz", "avatar.ply", "avatar.html")
"""Names of the files that the demonstration writes; refined.png only with refinement. The first one
marks a folder that the demonstration has written.
"""
REPORTED = frozenset(("psnr", "views", "baseline_psnr"))
"""Keys that every report.json has. A folder whose report.json has all of them counts as written by
the demonstration.
"""


def run_demo(
    out: str | os.PathLike[str],
    weights: str | os.PathLike[str] | None = None,
    frame_size: int = 256,
    refine: RefineConfig | None = None,
    settings: Settings | None = None,
) -> dict[str, Any]:
    """Makes an avatar of the shipped person. Writes files into `out`, all at the end, and returns
    the content of report.json.

    Files are inputs.png, novel_views.png (truth, feed-forward, error), novel_views.exr,
    animation.mp4 and .gif, avatar.npz, avatar.ply, avatar.html (see docs/viewer.md) and
    report.json. With `refine` there is also refined.png (truth, feed-forward, refined), and the
    animation, novel_views.exr and the files of the avatar are made from the refined avatar.

    Arguments:
        weights: file of the network's weights; None: the shipped ones.
        frame_size: side of the animation's frames, pixels.
        refine: how the avatar is refined by its photos; None: not at all.
        settings: settings that decide which photos are used, how the network runs, and how frames
            are drawn. Their refinement is ignored. None: `Settings()`.

    Raises: ValueError if `out` has files of these names that the demonstration did not write, or
    for a wrong file of weights; OSError; KeyboardInterrupt if refinement was interrupted.
    """
    report: dict[str, Any] = {}
    settings = settings or Settings()
    _check_place(Path(out))

    def write(folder):
        with Ahead() as ahead:
            made = _write_demo(folder, weights, frame_size, refine, settings, ahead)
        return report.update(made)

    add_files(Path(out), write, first=FILES[0])
    return report


def _check_place(out: Path) -> None:
    """Checks that the demonstration can write into a folder. The folder must be from an earlier
    demonstration, or have none of the files that will be written.

    Raises: ValueError, see `io.atomic.check_ours`.
    """
    known = None
    with contextlib.suppress(OSError, ValueError):
        known = read_json(out / FILES[0])
    if not (isinstance(known, dict) and known.keys() >= REPORTED):
        check_ours((out / name for name in FILES), lambda file: False)


def summary(report: dict[str, Any]) -> str:
    """Returns the quality that `run_demo` has measured, in one line. report: what `run_demo`
    returns.
    """
    quality = (
        f"PSNR {report['psnr']:.2f} dB, SSIM {report['ssim']:.3f}, foreground PSNR"
        f" {report['psnr_fg']:.2f} dB on {report['views']['held_out']} held-out views (vertex-color"
        f" baseline: {report['baseline_psnr']:.2f} dB)"
    )
    refined = report.get("refined")
    if refined is None:
        return quality
    gain = f"{refined['psnr']:.2f}, foreground {refined['psnr_fg']:.2f} dB"
    return f"{quality}; refined for {refined['seconds']:.0f} s: {gain}"


def _calls_until_refined(
    variables: Variables, config: HumanGSConfig, inputs: Capture, truth: Capture
) -> Iterator[Call]:
    """Yields the calls of the reconstruction and then of the painted body, for background
    compilation.
    """
    yield from calls_of_reconstruct(variables, config, inputs)
    yield from calls_of_painted_body(inputs, truth)


def _write_demo(
    folder: Path,
    weights: str | os.PathLike[str] | None,
    frame_size: int,
    refine: RefineConfig | None,
    settings: Settings,
    ahead: Ahead,
) -> dict[str, Any]:
    """Writes the files of the demonstration into a folder, and returns the content of
    report.json.
    """
    began, timings = time.perf_counter(), dict[str, Any]()
    with stage("loading"):
        inputs = _timed(timings, "load_capture", lambda: load_capture(DEMO_CAPTURE))
        if settings.views is not None:
            inputs = inputs.select(best_views(inputs, settings.views))
        truth, motion = load_capture(f"{DEMO_CAPTURE}/held_out"), load_motion()
        variables, config = _timed(timings, "load_weights", lambda: load_weights(weights))
        config = settings.network(config)

    ahead.add(_calls_until_refined(variables, config, inputs, truth))

    def held_out(avatar: Avatar, background: float = 1.0) -> tuple[Any, list[Rendering]]:
        how = splatting_of(settings.shot(FrameSettings()), avatar)
        return capture_renderings(avatar, truth, from_host(np.full(3, background)), how)

    with stage("reconstructing"):
        avatar = _timed(
            timings, "reconstruct", lambda: reconstruct(variables, config, inputs), twice=True
        )
        _timed(timings, "animate", lambda: animate(avatar, motion.pose(0)), twice=True)
    if refine is not None:
        ahead.add(calls_of_refine(avatar, inputs, refine))
    with stage("rendering"):
        ours = _images(_timed(timings, "render_held_out", lambda: held_out(avatar), twice=True))
        baseline = score(draw_painted_body(painted_body(inputs), truth), truth)
    # pictures of the photos, and of held-out views beside the truth
    contact_sheet(
        inputs.images,
        folder / "inputs.png",
        labels=[f"photo {i}" for i in range(inputs.view_count)],
    )
    side_by_side(truth.images, ours, folder / "novel_views.png")
    packages = ("humangs_jax", "jax", "jaxlib", "flax", "numpy")
    versions = {name: metadata.version(name) for name in packages}
    report = _scores(ours, truth) | {
        "baseline_psnr": round(baseline.psnr, 4),
        "baseline_psnr_fg": round(baseline.psnr_fg, 4),
        "gaussians": len(avatar.gaussians.means),
        "views": {"input": inputs.view_count, "held_out": truth.view_count},
        "image_size": [inputs.cameras.width, inputs.cameras.height],
        "versions": versions | {"python": platform.python_version()},
        "device": f"{jax.devices()[0].platform}: {jax.devices()[0].device_kind}",
        "timings": timings,
    }
    if refine is not None:
        run = _refined(avatar, inputs, refine)
        avatar, refined = run.avatar, _images(held_out(run.avatar))
        rows = np.stack([truth.images, ours, refined], axis=1).reshape(-1, *ours.shape[1:])
        contact_sheet(
            np.clip(rows, 0, 1),
            folder / "refined.png",
            headers=("truth", "feed-forward", "refined") * 2,
            columns=6,
        )
        counts = {name: getattr(run, name) for name in ("iterations", "steps", "head_steps")}
        times = {name: round(getattr(run, name), 1) for name in ("seconds", "compile_seconds")}
        report["refined"] = _scores(refined, truth) | counts | times
    with stage("animating"):
        shot = settings.shot(FrameSettings(size=frame_size, azimuth=25.0))

        def draw():
            return np.stack(list(motion_frames(avatar, motion, shot, turn=40.0)))

        frames = _timed(timings, "animation_frames", draw)
        for name in ("animation.mp4", "animation.gif"):
            write_video(folder / name, frames, motion.fps)
    with stage("writing"):
        avatar.save(folder / "avatar.npz")
        export(folder / "avatar.ply", avatar)  # in the world of its viewers, as `humangs export`
        write_page(folder / "avatar.html", avatar, motion)
        write_renderings_exr(folder / "novel_views.exr", *held_out(avatar, background=0.0))
    report["total_seconds"] = round(time.perf_counter() - began, 3)
    write_json(folder / "report.json", report, indent=2)
    return report


def _refined(avatar: Avatar, photos: Capture, refine: RefineConfig) -> Refinement:
    """Returns the refined avatar with its report. Raises: KeyboardInterrupt if refinement was
    interrupted.
    """
    with stage("refining"):
        run = refine_with_report(avatar, photos, refine, progress=True)
        if run.interrupted:
            raise KeyboardInterrupt
    return run


def _images(views: tuple[Any, list[Rendering]]) -> np.ndarray:
    return np.stack([np.asarray(rendering.rgb) for rendering in views[1]])


def _scores(images: np.ndarray, truth: Capture) -> dict[str, Any]:
    return {
        name: round(value, 4) for name, value in dataclasses.asdict(score(images, truth)).items()
    }


def _timed(timings: dict, name: str, run: Callable[[], Any], twice: bool = False) -> Any:
    """Runs a stage, records its time in `timings`, seconds, and returns the result. twice: whether
    the stage runs a second time. Then the time of the second run is recorded as "run", and the time
    by which the first run was longer as "compile".
    """
    start = time.perf_counter()
    compiling = stage(COMPILING) if twice else contextlib.nullcontext()
    with compiling:
        result = jax.block_until_ready(run())
    first = time.perf_counter() - start
    timings[name] = {"seconds": round(first, 3)}
    if twice:
        start = time.perf_counter()
        jax.block_until_ready(run())
        second = time.perf_counter() - start
        timings[name] = {"compile": round(max(first - second, 0.0), 3), "run": round(second, 3)}
    return result
