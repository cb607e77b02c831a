"""Measures time and error of the splatting renderer on the shipped person, by image size, preset
and knob, and compares with finite differences.
"""

import dataclasses
import functools
import gc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import temporary_mb
from experiments.harness import Run, entry, figure, staircase
from experiments.results import markdown_table
from experiments.subjects import shipped_person
from experiments.timing import timed
from humangs_jax.avatar.animate import animate
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera, orbit
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import render, render_views

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
DIRECTIONS = ("forward", "forward_backward")
Programs = dict[str, Callable[[], Any]]


class Scene(NamedTuple):
    """Gaussians and a camera of square images."""

    gaussians: Gaussians
    """The Gaussians in the world."""
    camera: Camera
    """The camera that looks at them."""

    def wide(self) -> "Scene":
        """Returns the scene in float64."""
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), self)

    def chosen(self, which: np.ndarray) -> "Scene":
        """Returns the scene with some of its Gaussians."""
        return self._replace(gaussians=jax.tree.map(lambda x: x[which], self.gaussians))


def demo_scene(size: int, count: int | None = None) -> Scene:
    """Returns the shipped person in the pose and with the camera of her first photo.

    Args:
        size: side of the image in pixels
        count: number of Gaussians; they are copies of her Gaussians, moved within their extent, and
            smaller if there are more of them. Default: her Gaussians.
    """
    avatar, capture = shipped_person(), load_capture(DEMO_CAPTURE)
    own = animate(avatar, capture.pose(int(capture.frames[0])))
    gaussians = Gaussians(*(getattr(own, name) for name in PARAMETERS))
    if count is not None:
        rng, g = np.random.default_rng(count), len(own.means)
        gaussians = jax.tree.map(lambda x: x[np.arange(count) % g], gaussians)
        share = np.sqrt(min(1.0, g / count))
        offsets = (1 - share) * gaussians.scales * rng.standard_normal((count, 3), np.float32)
        gaussians = replace(
            gaussians, means=gaussians.means + offsets, scales=share * gaussians.scales
        )
    return Scene(gaussians, capture.cameras[0].resized(size, size))


def compiled(scene: Scene, config: SplatConfig) -> tuple[Programs, dict[str, float]]:
    """Compiles two programs for the scene, and returns them and the MiB that each needs.

    "forward" returns a Rendering. "forward_backward" returns the mean squared error against noise,
    and its gradients as Gaussians. Neither has arguments.
    """
    gaussians, camera = scene
    dtype = gaussians.means.dtype
    config, black = plan_buffers(gaussians, camera, config, 1.0), jnp.zeros(3, dtype)
    noise = np.random.default_rng(1).random((camera.height, camera.width, 3), np.float32)
    goal = jnp.asarray(noise, dtype)

    def forward(gaussians: Gaussians) -> Any:
        return render(gaussians, camera, config, black)

    def loss(gaussians: Gaussians) -> Any:
        return jnp.mean((forward(gaussians).rgb - goal) ** 2)

    programs, memory = {}, {}
    for name, function in zip(DIRECTIONS, (forward, jax.value_and_grad(loss)), strict=True):
        program = jax.jit(function, compiler_options=compiler_options()).lower(gaussians).compile()
        memory[name] = temporary_mb(program)

        def run(program=program):
            return jax.block_until_ready(program(gaussians))

        programs[name] = run
    return programs, memory


def outputs(programs: Programs, kept: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Returns {"image" or parameter: the image or the gradient} in float64.

    `kept` is a mask over all Gaussians if some were left out, whose gradients are 0.
    """
    found = {"image": np.asarray(programs["forward"]().rgb, np.float64)}
    gradients = programs["forward_backward"]()[1]
    for name in PARAMETERS:
        gradient = np.asarray(getattr(gradients, name), np.float64)
        found[name] = gradient
        if kept is not None:
            found[name] = np.zeros((len(kept), *gradient.shape[1:]))
            found[name][kept] = gradient
    return found


def exact_outputs(scene: Scene) -> dict[str, np.ndarray]:
    """Returns the outputs of the exact renderer in float64."""
    with jax.enable_x64(True):
        return outputs(compiled(scene.wide(), DEFAULT_CONFIG)[0])


def differences(found: dict[str, np.ndarray], truth: dict[str, np.ndarray]) -> dict[str, float]:
    """Returns PSNR and largest error of the image, and the worst relative L2 error of a
    gradient.
    """
    error = np.abs(found["image"] - truth["image"])

    def relative(name):
        size = np.linalg.norm(truth[name])
        return float(np.linalg.norm(found[name] - truth[name]) / (size + 1e-300))

    worst = max(map(relative, PARAMETERS))
    psnr = float(-10 * np.log10(np.mean(error**2) + 1e-300))
    return {"psnr": psnr, "max_abs_error": float(error.max()), "gradient_relative_l2": worst}


@entry
def splatting(run: Run, sizes: tuple[int, ...] = (256, 512, 1024), repeats: int = 9) -> None:
    """Measures time, memory and error of the splatting renderer by the size of the image, for the
    shipped person in float32 on black.

    Errors are differences from float64. They come from decisions that float32 takes otherwise: an
    alpha at 1/255, a pixel at its stop, two equal depths. The loss is the mean squared error
    against noise. Of the gradients of the five parameters the worst is shown. Takes a minute.

    Options:
    sizes: sides of the images, pixels
    repeats: timed iterations
    """

    # errors and times of an image size
    def measure(size: int) -> dict[str, Any]:
        scene = demo_scene(size)
        programs, memory = compiled(scene, DEFAULT_CONFIG)
        errors = differences(outputs(programs), exact_outputs(scene))
        times = {
            name: float(np.median([timed(programs[name])[1] for _ in range(repeats)]))
            for name in DIRECTIONS
        }
        return errors | {name: {"mib": memory[name], "cpu_ms": times[name]} for name in DIRECTIONS}

    cases = {str(size): functools.partial(measure, size) for size in sizes}
    rows = run.rows(cases, {"repeats": repeats})
    table = []
    for size, row in rows.items():
        both = [row[name] for name in DIRECTIONS]
        cells = [f"{size} x {size}", *(f"{each['cpu_ms']:.0f}" for each in both)]
        cells += [f"{both[1]['mib']:.0f}", f"{row['psnr']:.1f}", f"{row['max_abs_error']:.0e}"]
        table.append([*cells, f"{row['gradient_relative_l2']:.0e}"])
    header = ["image", "forward, CPU ms", "with gradients", "MiB"]
    header += ["PSNR to float64, dB", "largest error", "gradients"]
    run.show(markdown_table(header, table), rows)


# Knobs
# --------------------------------------------------------------------------------------------------

KNOBS: dict[str, tuple[Any, ...]] = {
    "tile_size": (4, 16),
    "block": (16, 64),
    "chunk": (4, 16),
    "alpha_min": (1 / 128, 1 / 64, 1 / 32),
    "transmittance_stop": (1e-3, 1e-2, 1e-1),
    "radius_sigma": (3.0, 2.5, 2.0, 1.5),
}
"""{knob of `SplatConfig`: its values}."""
SCHEDULE = ("tile_size", "block", "chunk")
"""Knobs that do not change the image, which are left out of the plot."""
HIDDEN = (0.01, 0.03, 0.1)
"""Thresholds of the largest weight of a Gaussian on any pixel of any camera, below which it is
dropped (`splatting.visible_gaussians`).
"""
VIEWS = 24
"""Number of cameras that show what is hidden, besides the one that is drawn."""
COMBINED: tuple[dict[str, Any], ...] = (
    {"radius_sigma": 2.0, "transmittance_stop": 3e-3},
    {"radius_sigma": 1.5, "transmittance_stop": 3e-3},
    {"hidden": 0.01, "radius_sigma": 2.75, "transmittance_stop": 1e-3},
    {"hidden": 0.03, "radius_sigma": 2.5, "transmittance_stop": 1e-3},
    {"hidden": 0.1, "radius_sigma": 1.75, "transmittance_stop": 3e-3},
)
"""Several knobs at once; "hidden" as in `HIDDEN`."""


class Setting(NamedTuple):
    """A point of the trade-off."""

    knob: str
    """The knob that differs from exact, "preset" or "combined"."""
    label: str
    """Name of the point in the table."""
    config: SplatConfig
    """Configuration of the renderer."""
    dropped: np.ndarray | None = None
    """(g,) mask of the Gaussians that are left out, or None."""


def settings_of(scene: Scene, only: Sequence[str] = ()) -> list[Setting]:
    """Returns all points to measure but the exact one, or those of some knobs."""
    found = []
    for name, config in SPLAT_PRESETS.items():
        if name != "exact":
            found.append(Setting("preset", name, config))
    for knob, values in KNOBS.items():
        found += [Setting(knob, f"{knob} {short(v)}", SplatConfig(**{knob: v})) for v in values]
    if not only or {"hidden", "combined"} & set(only):
        weights = largest_weights(scene)
        found += [Setting("hidden", f"hidden {t:g}", SplatConfig(), weights < t) for t in HIDDEN]
        for fields in COMBINED:
            label = ", ".join(
                f"{name.replace('transmittance_', '')} {value:g}" for name, value in fields.items()
            )
            dropped, knobs = None, dict(fields)
            if "hidden" in fields:
                dropped = weights < knobs.pop("hidden")
            config = SplatConfig(**knobs)
            found.append(Setting("combined", label, config, dropped))
    return [s for s in found if not only or s.knob in only]


def short(value: Any) -> str:
    """Formats a value of a knob, as 1/64 rather than 0.015625."""
    if not isinstance(value, float):
        return str(value)
    inverse = round(1 / value)
    if 10 < inverse < 500 and inverse % 10 and inverse * value == 1:
        return f"1/{inverse}"
    return f"{value:g}"


def largest_weights(scene: Scene) -> np.ndarray:
    """Returns (g,) the largest weight of each Gaussian on any pixel of the scene's camera and of
    cameras around the scene.
    """
    (gaussians, own), config = scene, SplatConfig(visibility=True)
    middle = jnp.median(gaussians.means, axis=0)
    azimuths = jnp.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    elevations = jnp.tile(jnp.asarray([0.0, 0.4, -0.4]), VIEWS // 3)
    distance = float(jnp.linalg.norm(own.center - middle))
    cameras = orbit(middle, distance, azimuths, elevations, own.K, own.width, own.height)
    others = np.asarray(render_views(gaussians, cameras, config).visibility)
    drawn = np.asarray(render(gaussians, own, config).visibility)
    return np.maximum(drawn, others.max(axis=0))


@entry
def splatting_tradeoff(
    run: Run,
    size: int = 512,
    repeats: int = 7,
    only: tuple[str, ...] = (),
    image: Path | None = None,
) -> None:
    """Measures what each knob of the splatting renderer gains in time and costs in accuracy, on the
    shipped person.

    Every setting takes turns with the exact one, call by call, in one process. Its time is the
    median of the quotients. Its error is the difference from float64, as in `splatting`. "hidden"
    leaves out the Gaussians that weigh less than a threshold on every pixel of the camera and of 24
    cameras around the person. Takes 4 minutes.

    Options:
    size: side of the image, pixels
    repeats: timed iterations
    only: knobs to measure (also: hidden, combined, preset)
    image: figure to write, with the Pareto front
    """
    scene = demo_scene(size)

    # made only if a case is measured
    @functools.cache
    def start():
        return exact_outputs(scene), compiled(scene, DEFAULT_CONFIG)[0]

    cases = {
        each.label: functools.partial(measure, scene, start, each, repeats)
        for each in settings_of(scene, only)
    }
    rows = run.rows(
        {"exact": lambda: measure_exact(*start(), repeats)} | cases,
        {"size": size, "repeats": repeats},
    )
    result = {
        "size": size,
        "gaussians": len(scene.gaussians.means),
        "settings": list(rows.values()),
    }
    run.show(knobs_table(result), result)
    if image:
        plot(image, result)


def measure_exact(truth: dict[str, np.ndarray], exact: Programs, repeats: int) -> dict[str, Any]:
    """Returns the CPU milliseconds of the exact programs, and their errors."""
    times = {
        name: float(np.median([timed(exact[name])[1] for _ in range(repeats + 1)]))
        for name in DIRECTIONS
    }
    return {"knob": "exact", "label": "exact"} | times | differences(outputs(exact), truth)


def measure(
    scene: Scene, start: Callable[[], Any], setting: Setting, repeats: int
) -> dict[str, Any]:
    """Returns the times of a setting as shares of the exact ones, and its errors."""
    (truth, exact), kept = start(), None
    if setting.dropped is not None:
        kept = ~setting.dropped
        scene = scene.chosen(kept)
    programs, _ = compiled(scene, setting.config)
    row: dict[str, Any] = {"knob": setting.knob, "label": setting.label}
    row |= differences(outputs(programs, kept), truth)
    for name in DIRECTIONS:
        pairs = np.asarray(
            [(timed(exact[name])[1], timed(programs[name])[1]) for _ in range(repeats)]
        )
        row[name] = float(np.median(pairs[:, 1] / pairs[:, 0]))
    del programs
    gc.collect()
    return row


def knobs_table(result: dict[str, Any]) -> str:
    """Formats a row for each setting, with presets in bold."""
    rows = []
    for row in result["settings"]:
        label = f"**{row['label']}**" if row["knob"] == "preset" else row["label"]
        if row["knob"] == "exact":
            times = [f"{row[name]:.0f} ms" for name in DIRECTIONS]
        else:
            times = [f"{row[name]:.2f}" for name in DIRECTIONS]
        errors = (
            f"{row['psnr']:.1f}",
            f"{row['max_abs_error']:.1g}",
            f"{row['gradient_relative_l2']:.1g}",
        )
        rows.append([label, *times, *errors])
    header = ["setting", "forward, CPU", "with gradients, CPU"]
    header += ["PSNR, dB", "largest error", "gradients"]
    title = (
        f"{result['gaussians']:,} Gaussians at {result['size']}; times relative to the exact ones."
    )
    return f"{title}\n\n{markdown_table(header, rows)}"


def plot(path: Path, result: dict[str, Any]) -> None:
    """Draws time relative to exact against PSNR, with a line for each knob, the presets, and the
    front of all settings.
    """
    exact, *others = result["settings"]
    rows = [exact | {"knob": "preset", "forward": 1.0}]
    rows += [row for row in others if row["knob"] not in SCHEDULE and row["label"] != "inria"]
    with figure(path, 1, (8, 4.4)) as axis:
        steps = staircase([(row["forward"], row["psnr"]) for row in rows])
        axis.step(
            *zip(*steps, strict=True), where="post", color="0.8", lw=3, label="best of all settings"
        )
        # a line for each knob, then a star for each preset
        knobs = dict.fromkeys(row["knob"] for row in rows if row["knob"] != "preset")
        for i, knob in enumerate(knobs):
            points = [(row["forward"], row["psnr"]) for row in rows if row["knob"] == knob]
            style = "s" if knob == "combined" else "o-"
            axis.plot(*zip(*points, strict=True), style, ms=4, lw=0.9, color=f"C{i}", label=knob)
        for row in (row for row in rows if row["knob"] == "preset"):
            point = row["forward"], row["psnr"]
            axis.plot(*point, "*", ms=13, color="black", zorder=3)
            axis.annotate(
                row["label"], point, (-8, 6), textcoords="offset points", weight="bold", ha="right"
            )
        axis.set(
            xlabel="CPU time of an image relative to exact", ylabel="PSNR to the exact image, dB"
        )
        axis.set_title(
            f"{result['gaussians']:,} Gaussians, {result['size']} x {result['size']} pixels",
            fontsize=9,
        )
        axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


# Finite differences
# --------------------------------------------------------------------------------------------------

STEPS = (1e-3, 1e-4)
"""Steps of the differences, radians and metres."""
AWAY = (0.02, -0.03, 0.01, 0.02, 0.01, -0.03)
"""Twist from the camera to that of the target: three angles in radians, three shifts in metres."""
CUTS = {
    "as drawn: alpha_min 1/255, transmittance_stop 1e-4": {},
    "alpha_min 1e-6": {"alpha_min": 1e-6},
    "alpha_min 1e-6, transmittance_stop 0": {"alpha_min": 1e-6, "transmittance_stop": 0.0},
}


@entry
def splatting_finite_differences(run: Run, size: int = 128) -> None:
    """Compares finite differences of an image's error with the gradient of the camera, which shows
    what the cuts of splatting leave out.

    The shipped person is drawn in the pose and with the camera of the first photo, in float64. The
    loss is the mean squared error to the image of a camera that is a little off. Differences are
    central, for the six numbers of a camera twist in radians and metres.

    Options:
    size: side of the image, pixels
    """
    scene = demo_scene(size)
    with jax.enable_x64(True):
        found = camera_differences(scene.wide())
    rows = [[name, *(f"{difference:.2%}" for difference in each)] for name, each in found.items()]
    run.show(markdown_table(["cuts", *(f"step {step:g}" for step in STEPS)], rows), found)


def camera_differences(scene: Scene) -> dict[str, list[float]]:
    """Returns {setting of `CUTS`: relative L2 differences of the twist's gradient, for each of
    `STEPS`}.
    """
    gaussians, camera = scene

    # the image of the camera after a twist
    def drawn(twist: Any, gaussians: Gaussians, config: SplatConfig) -> Any:
        x, y, z = twist[:3]
        turn = jax.scipy.linalg.expm(jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
        moved = replace(
            camera, cam_from_world=transform.make(turn, twist[3:]) @ camera.cam_from_world
        )
        return render(gaussians, moved, config).rgb

    target = jax.jit(drawn)(
        jnp.asarray(AWAY), gaussians, plan_buffers(gaussians, camera, margin=1.5)
    )
    both = jax.jit(jax.value_and_grad(lambda *given: jnp.mean(jnp.square(drawn(*given) - target))))
    results = {}
    for name, cuts in CUTS.items():
        cut = dataclasses.replace(SplatConfig(), **cuts)
        config = plan_buffers(gaussians, camera, cut, margin=1.5)
        gradient = np.asarray(both(jnp.zeros(6), gaussians, config)[1])

        def value(twist, config=config):
            return float(both(jnp.asarray(twist), gaussians, config)[0])

        results[name] = []
        for step in STEPS:
            slopes = [(value(step * axis) - value(-step * axis)) / (2 * step) for axis in np.eye(6)]
            difference = np.linalg.norm(slopes - gradient) / np.linalg.norm(gradient)
            results[name].append(float(difference))
    return results
