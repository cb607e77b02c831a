"""How exactly a body is found from 2D keypoints: synthetic people of the fitting seeds, random poses, detections with errors.

    python experiments/fitting/keypoints.py --frames 16 --views 4 --noise-px 2 --outliers 0.2 --json fit.json
    python experiments/fitting/keypoints.py --frames 16 --views 4 --curves --json fit.json
        --plot docs/images/fit_curves.png --docs

Writes mean_joint_error_mm and p95_joint_error_mm over all 55 joints (raw, in the world), of the body's 22 and of the hands', and
seconds_per_frame of all people and frames in one batch, compilation apart; the same without outliers. --curves adds errors over
views and over noise beside plain and robust triangulation of the same keypoints, and other keypoint sets. --resume keeps what an
interrupted run has measured. About 1 minute, with --curves 8, on two cores. --plot needs matplotlib (the `notebooks` extra).
"""

import argparse
import itertools
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fitting.md"
VIEWS, NOISES = (1, 2, 3, 4, 8), (0.0, 1.0, 2.0, 5.0, 10.0)
ALL = "wholebody133"
FIRST = 4_000_000


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=16, help="frames of each person")
    parser.add_argument("--people", type=int, default=4, help="of the fitting seeds")
    parser.add_argument("--views", type=int, default=4, help="cameras of each frame")
    parser.add_argument("--noise-px", type=float, default=2.0, help="standard deviation of detections, pixels of 512")
    parser.add_argument("--outliers", type=float, default=0.2, help="share of points displaced by up to 100 pixels")
    parser.add_argument("--set", default=ALL, choices=("coco17", ALL, "openpose67"), help="which keypoints")
    parser.add_argument("--curves", action="store_true", help="also over views, noise and keypoint sets")
    parser.add_argument("--json", type=Path, required=True, help="numbers")
    parser.add_argument("--resume", action="store_true", help="keep the settings that the file at --json has")
    parser.add_argument("--plot", type=Path, help="picture of the curves (.png)")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/fitting.md")
    arguments = parser.parse_args()
    for name in ("frames", "people", "views"):
        if getattr(arguments, name) < 1:
            parser.error(f"--{name} {getattr(arguments, name)}: expected at least 1")
    if (arguments.plot or arguments.docs) and not arguments.curves:
        parser.error("--plot and --docs show the curves: add --curves")
    if not arguments.json.parent.is_dir():
        parser.error(f"--json {arguments.json}: the folder {arguments.json.parent} does not exist")
    from humangs_jax.core.processes import keep_freed_memory

    keep_freed_memory()
    run(arguments)


def run(arguments) -> None:
    """Everything that was asked for; numbers are written after each setting."""
    bench = Bench(arguments.people, arguments.frames, measured(arguments.json) if arguments.resume else [])
    asked = (arguments.set, arguments.views, arguments.noise_px)
    results = dict(bench.measure(*asked, arguments.outliers))
    results["without_outliers"] = bench.measure(*asked, 0.0)
    write(arguments.json, results)
    if not arguments.curves:
        return
    parts = {
        "over_views": [(ALL, views, 2.0, share) for views in VIEWS for share in (0.0, 0.2)],
        "over_noise": [(ALL, 4, noise, 0.0) for noise in NOISES],
        "over_sets": [(kind, 4, 2.0, share) for kind in ("coco17", "openpose67") for share in (0.0, 0.2)],
    }
    for name, settings in parts.items():
        results[name] = []
        for setting in settings:
            results[name].append(bench.measure(*setting))
            write(arguments.json, results)
    if arguments.plot:
        plot(results, arguments.plot)
    if arguments.docs:
        from experiments.common.results import publish

        publish(PAGE, "fit_keypoints", table(results), results)


def measured(path: Path) -> list[dict]:
    """What an earlier run left in its file, one record a setting."""
    if not path.exists():
        return []
    results = json.loads(path.read_text())
    lists = [results.pop(name, []) for name in ("over_views", "over_noise", "over_sets")]
    return [results.pop("without_outliers", {}), results, *itertools.chain(*lists)]


def write(path: Path, results: dict) -> None:
    """Whole or not at all."""
    from experiments.common.results import write_json

    write_json(path, results)


class Bench:
    """People and their fits; what was made or measured once is kept."""

    def __init__(self, people: int, frames: int, measured: list[dict]) -> None:
        from humangs_jax.body.library import load_body

        self.people, self.frames, self.body = people, frames, load_body()
        self.measured, self.kept = measured, {}

    def cases(self, kind, views):
        """The keypoint model of a set and people seen by that number of views."""
        from experiments.fitting.cases import make_case
        from humangs_jax.body.landmarks import landmark_model
        from humangs_jax.data.keypoints.sets import KEYPOINT_SETS

        if (kind, views) not in self.kept:
            model = landmark_model(self.body, KEYPOINT_SETS[kind].names)
            people = [make_case(FIRST + i, self.body, model, self.frames, views) for i in range(self.people)]
            self.kept[kind, views] = model, people
        return self.kept[kind, views]

    def measure(self, kind: str, views: int, noise: float, outliers: float) -> dict:
        """Errors and times of one setting."""
        setting = {"keypoints": kind, "views": views, "noise_px": noise, "outliers": outliers}
        setting |= {"people": self.people, "frames": self.frames}
        record = next((record for record in self.measured if setting.items() <= record.items()), None)
        if record is None:
            record = setting | self.errors(kind, views, noise, outliers)
            self.measured.append(record)
        print(json.dumps(record), flush=True)
        return record

    def errors(self, kind: str, views: int, noise: float, outliers: float) -> dict:
        """Millimetres, and seconds."""
        import jax
        import numpy as np

        from experiments.fitting.cases import observe
        from humangs_jax.fitting.landmark_fit import FitConfig, fit_landmarks

        model, people = self.cases(kind, views)
        seen = observe(people, FIRST, noise, outliers, model)
        fit_all = jax.vmap(lambda own: fit_landmarks(model, own, FitConfig()))
        start = time.perf_counter()
        jax.block_until_ready(fit_all(seen))
        first = time.perf_counter() - start
        start = time.perf_counter()
        fit = jax.block_until_ready(fit_all(seen))
        seconds = time.perf_counter() - start
        truth = np.stack([case.joints for case in people])
        errors = 1000 * np.linalg.norm(np.asarray(fit.joints) - truth, axis=-1)
        found = joint_errors(errors) | landmark_errors(model, people, seen, fit)
        found["root_aligned_mean_joint_error_mm"] = root_aligned(np.asarray(fit.joints), truth)
        return found | {"seconds_per_frame": seconds / truth[..., 0, 0].size, "first_call_s": first}


def joint_errors(errors) -> dict:
    """Of errors (people, m, j), millimetres."""
    import numpy as np

    return {
        "mean_joint_error_mm": float(errors.mean()),
        "p95_joint_error_mm": float(np.quantile(errors, 0.95)),
        "mean_body_joint_error_mm": float(errors[..., :22].mean()),
        "mean_hand_joint_error_mm": float(errors[..., 25:].mean()),
        "worst_frame_mean_mm": float(errors.mean(-1).max()),
    }


def root_aligned(joints, truth) -> float:
    """Mean error, millimetres, with the pelvis of each where the true one is: what a single view can know."""
    import numpy as np

    moved = joints - joints[..., :1, :] + truth[..., :1, :]
    return float(1000 * np.linalg.norm(moved - truth, axis=-1).mean())


def landmark_errors(model, people, seen, fit) -> dict:
    """Millimetres between true landmarks and fitted or triangulated ones; None of triangulation from one view."""
    import jax
    import numpy as np

    from humangs_jax.fitting.triangulation import triangulate, triangulate_robustly

    truth, known = np.stack([case.landmarks for case in people]), np.asarray(model.known)
    off = lambda points: float(1000 * np.linalg.norm(np.asarray(points) - truth, axis=-1)[..., known].mean())
    found = {"mean_landmark_error_mm": off(fit.landmarks)}
    if seen.points.shape[2] > 1:
        plain, robust = (jax.jit(jax.vmap(jax.vmap(f))) for f in (triangulate, triangulate_robustly))
        found |= {"triangulated_mm": off(plain(seen)[0]), "robustly_triangulated_mm": off(robust(seen)[0])}
    return found


COLUMNS = {
    "mean_joint_error_mm": "joints, mean mm",
    "p95_joint_error_mm": "95 %",
    "mean_body_joint_error_mm": "body",
    "mean_hand_joint_error_mm": "hands",
    "mean_landmark_error_mm": "landmarks: fit",
    "triangulated_mm": "triangulated",
    "robustly_triangulated_mm": "robustly",
}


def table(results) -> str:
    """The rows of the page, and what the batch took."""
    from experiments.common.results import markdown_table

    rows = {}
    for r in (*results["over_views"], *results["over_noise"], *results["over_sets"]):
        setting = (r["keypoints"], r["views"], f"{r['noise_px']:g}", f"{r['outliers']:.0%}")
        rows[setting] = [*setting, *("-" if r.get(name) is None else f"{r[name]:.1f}" for name in COLUMNS)]
    alone = next(r for r in results["over_views"] if r["views"] == 1)
    seconds = max(r["seconds_per_frame"] for r in results["over_views"] if r["views"] == 4)
    said = (
        f"{results['people']} people of {results['frames']} frames each in one batch: {seconds:.2f} s a frame with four views, "
        f"after a first call of {results['first_call_s']:.0f} s that compiles. With one view and the pelvis put in its place the "
        f"mean is {alone['root_aligned_mean_joint_error_mm']:.0f} mm."
    )
    return (
        markdown_table(["keypoints", "views", "noise, px", "outliers", *COLUMNS.values()], list(rows.values()))
        + f"\n\n{said}"
    )


def plot(results, path: Path) -> None:
    """Error over views and over noise, fit beside triangulation."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True)
    panels = [
        ([r for r in results["over_views"] if not r["outliers"]], "views", "2 px of noise"),
        ([r for r in results["over_views"] if r["outliers"]], "views", "2 px of noise, 20 % outliers"),
        (results["over_noise"], "noise_px", "4 views"),
    ]
    lines = {
        "triangulated_mm": ("plain triangulation", "tab:gray"),
        "robustly_triangulated_mm": ("robust triangulation", "tab:orange"),
        "mean_landmark_error_mm": ("fit", "tab:blue"),
    }
    for axis, (rows, over, title) in zip(axes, panels, strict=True):
        for name, (label, color) in lines.items():
            points = [(r[over], r[name]) for r in rows if r.get(name) is not None]
            axis.plot(*zip(*points, strict=True), "o-", label=label, color=color)
        axis.set(
            xlabel="views" if over == "views" else "noise, pixels of 512", ylabel="landmarks, mean mm", title=title
        )
        axis.set_yscale("symlog" if over == "noise_px" else "log")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
