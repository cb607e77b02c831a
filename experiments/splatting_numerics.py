"""The extremes that splatting has to survive, as small scenes: is everything finite, and how far is
float32 from float64?

A case is a scene in float32 (or narrower), and bounds on how far its image and gradients may be
from those of the same numbers in float64. Most scenes are 32 Gaussians in 24 x 16 pixels, so that
one compilation serves nearly all of them.

Gradients are compared in natural units, so that no Gaussian counts for nothing because it is large
or far: with respect to mean / depth, log scale and direction of the quaternion; the others as they
are. Errors are relative to the norm of the same gradient; that of the quaternions, which vanishes
for spheres, to that of the log scales if it is larger. The loss is a random linear function of rgb,
alpha and depth.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import ALPHA_MIN, NEAR
from humangs_jax.rendering.splatting import render

WIDTH, HEIGHT, COUNT = 24, 16, 32
FOCAL, UNTURNED = 24.0, np.eye(4, dtype=np.float32)

IMAGE, GRADIENT = 1e-5, 1e-4
"""Bounds of a case that is nothing special to float32: largest error of a color or of alpha, and
the largest relative L2 error among the eight gradients. Roundings of 6e-8, through a few hundred
operations."""

FAR, FARTHER = (2e-4, 1e-3), (3e-2, 2e-1)
"""The same for a scene 1e3 and 1e5 m from the world's origin: a position is known to 6e-8 of its
distance, 6e-5 and 6e-3 m, where the small Gaussians here are 3e-2 m wide."""

NEEDLE_GRADIENT = 2e-3
"""Scales far below a pixel across and far above the image along: what they matter, in log scale, is
1e-4 of what a visible scale would, and rounding is relative to that."""

CROWD_GRADIENT = 5e-4
"""50,000 alphas at one place: the gradients of all but the first few are sums that cancel to nearly
nothing.
"""

BFLOAT16_GRADIENT, FLOAT16_GRADIENT = 4e-3, 5e-4
"""The gradient is returned in the input's dtype, which rounds it by 2^-9 or 2^-11."""

FLOAT64 = 1e-9
"""The tiled renderer in float64 against the reference, images absolute and gradients relative:
every case.
"""


class Arrays(NamedTuple):
    """The fields of `Gaussians`, as numpy arrays."""

    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is drawn; its dtypes are the input's dtypes. unit: the loss sees depths in it,
    metres.
    """

    gaussians: Arrays
    K: np.ndarray
    pose: np.ndarray
    background: np.ndarray
    width: int = WIDTH
    height: int = HEIGHT
    unit: float = 1.0

    def arguments(self, dtype: type | None = None) -> tuple:
        """(gaussians, K, cam_from_world, background) as JAX arrays, of `dtype` if one is given."""
        leaves = (self.gaussians, self.K, self.pose, self.background)
        gaussians, *rest = jax.tree.map(
            lambda a: jnp.asarray(a if dtype is None else np.asarray(a, dtype)), leaves
        )
        return Gaussians(*gaussians), *rest


@dataclasses.dataclass(frozen=True)
class Case:
    """image, gradient: bounds (see `IMAGE`). drawn: whether anything is to be seen. slow: takes
    seconds.
    """

    group: str
    name: str
    build: Callable[[], Scene]
    image: float = IMAGE
    gradient: float = GRADIENT
    drawn: bool = True
    slow: bool = False


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One case, measured. image: largest error of rgb and alpha. gradient: largest relative L2
    error, that of `worst`.

    depth: relative L2 error of the depth image. coverage: fraction of the pixels with anything on
    them.
    """

    finite: bool
    image: float
    depth: float
    gradient: float
    worst: str
    coverage: float
    overflow: int

    def passes(self, case: Case) -> bool:
        """Whether everything is finite, within the case's bounds, complete, and there to be seen
        (or not).
        """
        within = self.image <= case.image and self.gradient <= case.gradient
        return self.finite and within and (self.coverage > 0) == case.drawn and self.overflow == 0


def ordinary(seed: int = 0, count: int = COUNT, width: int = WIDTH, height: int = HEIGHT) -> Scene:
    """Gaussians 2 to 4 m before a camera that is slightly turned: the scene that every extreme
    starts from.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 4, count)
    means = np.stack(
        [*(rng.uniform(-0.5, 0.5, (2, count)) * z * np.array([[width], [height]]) / FOCAL), z],
        axis=-1,
    )
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(np.log(0.03), np.log(0.4), (count, 3))),
        rng.uniform(0.1, 0.95, count),
        rng.uniform(0, 1, (count, 3)),
    )
    K = np.array([[FOCAL, 0, 0.52 * width], [0, 1.1 * FOCAL, 0.45 * height], [0, 0, 1]], np.float32)
    pose = np.eye(4)
    angle = 0.05
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:3, 3] = [0.05, -0.02, 0.1]
    gaussians = Arrays(*(np.asarray(a, np.float32) for a in arrays))
    return Scene(
        gaussians, K, pose.astype(np.float32), np.array([0.2, 0.5, 0.9], np.float32), width, height
    )


def changed(scene: Scene, **arrays: np.ndarray) -> Scene:
    gaussians = scene.gaussians._replace(
        **{name: np.asarray(a, np.float32) for name, a in arrays.items()}
    )
    return dataclasses.replace(scene, gaussians=gaussians)


def scaled(size: float) -> Scene:
    """Scales around `size` metres, each Gaussian with its own three."""
    scene = ordinary()
    return changed(scene, scales=size * scene.gaussians.scales / 0.1)


def stretched(long: float, middle: float, short: float) -> Scene:
    """Needles or discs, turned any way."""
    return changed(ordinary(), scales=np.broadcast_to([long, middle, short], (COUNT, 3)))


def opaque(opacity: float) -> Scene:
    return changed(ordinary(), opacities=np.full(COUNT, opacity))


def turned(norm: float) -> Scene:
    quats = ordinary().gaussians.quats.astype(np.float64)
    return changed(ordinary(), quats=norm * quats / np.linalg.norm(quats, axis=1, keepdims=True))


def at_depth(z: float, size: float, offset: float = 0.0) -> Scene:
    """Gaussians on one plane before an unturned camera, spread over the image, `size` pixels large.

    offset: how much farther every second Gaussian lies, metres.
    """
    scene = ordinary()
    depth = np.full(COUNT, float(z))
    depth[1::2] += offset
    slopes = scene.gaussians.means[:, :2] / scene.gaussians.means[:, 2:]
    means = np.concatenate([slopes * np.abs(depth[:, None]), depth[:, None]], axis=1)
    scales = scene.gaussians.scales / 0.1 * size * abs(z) / FOCAL
    return dataclasses.replace(changed(scene, means=means, scales=scales), pose=UNTURNED)


def across_near_plane() -> Scene:
    """Large Gaussians whose centres lie within a few centimetres before and behind the near
    plane.
    """
    z = NEAR + np.linspace(-0.03, 0.08, COUNT)
    means = np.concatenate([ordinary().gaussians.means[:, :2] * 0.02, z[:, None]], axis=1)
    scene = changed(ordinary(), means=means, scales=0.2 * ordinary().gaussians.scales)
    return dataclasses.replace(scene, pose=UNTURNED)


def seen_through(focal: float, zoomed: bool) -> Scene:
    """Another focal length. zoomed: the scene shrinks with the field of view, so the image stays
    about the same.
    """
    scene = ordinary()
    K = scene.K.copy()
    K[:2, :2] *= focal / FOCAL
    if zoomed:
        factor = np.array([FOCAL / focal, FOCAL / focal, 1.0])
        means, scales = scene.gaussians.means * factor, scene.gaussians.scales * FOCAL / focal
        pose = scene.pose * np.array([[1, 1, 1, FOCAL / focal]] * 2 + [[1, 1, 1, 1]] * 2)
        scene = dataclasses.replace(
            changed(scene, means=means, scales=scales), pose=pose.astype(np.float32)
        )
    return dataclasses.replace(scene, K=K)


def far_from_origin(distance: float) -> Scene:
    """Scene and camera moved together, away from the world's origin."""
    scene = ordinary()
    pose = scene.pose.astype(np.float64)
    pose[:3, 3] -= pose[:3, :3] @ np.array([distance, 0, 0])
    moved = changed(scene, means=scene.gaussians.means + np.array([distance, 0, 0]))
    return dataclasses.replace(moved, pose=pose.astype(np.float32))


def crowd(count: int, opacity: tuple[float, float], spread: float) -> Scene:
    """`count` Gaussians on one pixel of an 8 x 8 image (a single tile, so a single list), thinner
    than a pixel.

    opacity: range. spread: of their centres, pixels.
    """
    rng = np.random.default_rng(1)
    scene = ordinary(count=count, width=8, height=8)
    z = rng.uniform(2, 4, count)
    place = 3.5 + rng.uniform(-spread / 2, spread / 2, (count, 2))
    slopes = (place - scene.K[:2, 2]) / scene.K[[0, 1], [0, 1]]
    means = np.concatenate([slopes * z[:, None], z[:, None]], axis=1)
    scales = np.exp(rng.uniform(np.log(0.001), np.log(0.02), (count, 3)))
    scene = changed(scene, means=means, scales=scales, opacities=rng.uniform(*opacity, count))
    return dataclasses.replace(scene, pose=UNTURNED)


def over_everything(count: int = COUNT) -> Scene:
    """One Gaussian that covers the image many times over; the others are invisible."""
    scene = ordinary(count=count)
    means, scales, opacities = (
        np.array(a) for a in (scene.gaussians.means, scene.gaussians.scales, np.zeros(count))
    )
    means[0], scales[0], opacities[0] = [0.1, 0.2, 3.0], [50.0, 80.0, 30.0], 0.7
    return changed(scene, means=means, scales=scales, opacities=opacities)


def behind() -> Scene:
    means = ordinary().gaussians.means
    return changed(ordinary(), means=means * np.array([1, 1, -1]))


def coincident(reverse: bool = False) -> Scene:
    """All at one depth, overlapping: the image depends on their order, which is that of their
    index.
    """
    scene = at_depth(3.0, 3.0)
    order = np.arange(COUNT)[::-1] if reverse else np.arange(COUNT)
    return dataclasses.replace(scene, gaussians=jax.tree.map(lambda a: a[order], scene.gaussians))


def narrow(dtype: DTypeLike, *others: str) -> Scene:
    """Gaussians, and other arrays of the scene, in another dtype."""
    scene = ordinary()

    def cast(name):
        return jax.tree.map(lambda a: np.asarray(a, dtype), getattr(scene, name))

    return dataclasses.replace(scene, **{name: cast(name) for name in ("gaussians", *others)})


def narrow_everything(dtype: DTypeLike) -> Scene:
    return narrow(dtype, "K", "pose", "background")


def _cases() -> list[Case]:
    one = functools.partial

    def ulp(towards):
        return float(np.nextafter(np.float32(NEAR), np.float32(towards)))

    return [
        Case("ordinary", "nothing special", ordinary),
        *(Case("scales", f"{s:.0e} m", one(scaled, s)) for s in (1e-7, 1e-5, 1e-3, 1e-1, 1e1, 1e3)),
        Case("scales", "footprints beyond 1e9 pixels", one(scaled, 1e12), drawn=False),
        Case("needles", "1 m : 1 cm", one(stretched, 1.0, 1e-2, 1e-2)),
        Case("needles", "1 m : 1e-4 m", one(stretched, 1.0, 1e-4, 1e-4)),
        Case("needles", "1 m : 1e-6 m", one(stretched, 1.0, 1e-6, 1e-6)),
        Case("needles", "1e3 m : 1e-3 m", one(stretched, 1e3, 1e-3, 1e-3), IMAGE, NEEDLE_GRADIENT),
        Case("needles", "discs, 1 m : 1e-6 m", one(stretched, 1.0, 1.0, 1e-6)),
        Case("needles", "zero scales", one(stretched, 0.0, 0.0, 0.0)),
        Case("opacity", "0", one(opaque, 0.0), drawn=False),
        Case("opacity", "just under 1/255", one(opaque, ALPHA_MIN * (1 - 1e-6)), drawn=False),
        Case("opacity", "1 - 1e-7", one(opaque, 1 - 1e-7)),
        Case("opacity", "1", one(opaque, 1.0)),
        *(
            Case("quaternions", f"norm {n:.0e}" if n else "zero", one(turned, n))
            for n in (0, 1e-30, 1e-20, 1e15, 1e30)
        ),
        Case("near plane", "just behind (one ulp)", one(at_depth, ulp(0), 1.0), drawn=False),
        Case("near plane", "on it", one(at_depth, NEAR, 1.0), drawn=False),
        Case("near plane", "just before (one ulp)", one(at_depth, ulp(1), 1.0)),
        Case("near plane", "just before, sizes of metres", one(at_depth, ulp(1), 2400.0)),
        Case("near plane", "across", across_near_plane),
        Case("far away", "1e6 m, sizes of pixels", one(at_depth, 1e6, 1.0, 1e3)),
        Case("far away", "1e6 m, sizes of millimetres", one(at_depth, 1e6, 1e-9, 1e3)),
        Case("far away", "camera and scene 1e3 m from the origin", one(far_from_origin, 1e3), *FAR),
        Case(
            "far away",
            "camera and scene 1e5 m from the origin",
            one(far_from_origin, 1e5),
            *FARTHER,
        ),
        Case("crowds", "2,000 opaque on a pixel", one(crowd, 2_000, (0.5, 1.0), 0.5)),
        Case("crowds", "2,000 faint on a pixel", one(crowd, 2_000, (0.004, 0.006), 0.5)),
        Case(
            "crowds",
            "50,000 opaque on a pixel",
            one(crowd, 50_000, (0.5, 1.0), 0.5),
            IMAGE,
            CROWD_GRADIENT,
            slow=True,
        ),
        Case(
            "crowds", "50,000 faint on a pixel", one(crowd, 50_000, (0.004, 0.006), 0.5), slow=True
        ),
        Case(
            "crowds",
            "50,000 at the threshold, none ends the list",
            one(crowd, 50_000, (0.004, 0.0042), 8.0),
            slow=True,
        ),
        Case("images", "one Gaussian over everything, 31 invisible", over_everything),
        Case("images", "one Gaussian over everything", one(over_everything, 1), slow=True),
        Case("images", "no Gaussians", one(ordinary, 0, 0), drawn=False),
        Case("images", "all behind the camera", behind, drawn=False),
        Case("images", "1 x 1", one(ordinary, 0, COUNT, 1, 1)),
        Case("images", "41 x 9", one(ordinary, 0, COUNT, 41, 9), slow=True),
        Case("images", "7 x 30", one(ordinary, 0, COUNT, 7, 30), slow=True),
        Case("order", "coincident depths", coincident),
        Case("order", "coincident depths, reversed", one(coincident, True)),
        *(
            Case("focal length", f"{f:.0e} px", one(seen_through, f, False))
            for f in (1, 1e2, 1e4, 1e6)
        ),
        *(
            Case("focal length", f"{f:.0e} px, zoomed", one(seen_through, f, True))
            for f in (1, 1e2, 1e4, 1e6)
        ),
        Case(
            "dtypes",
            "bfloat16 Gaussians",
            one(narrow, jnp.bfloat16),
            IMAGE,
            BFLOAT16_GRADIENT,
            slow=True,
        ),
        Case(
            "dtypes",
            "bfloat16 everything",
            one(narrow_everything, jnp.bfloat16),
            IMAGE,
            BFLOAT16_GRADIENT,
            slow=True,
        ),
        Case(
            "dtypes",
            "float16 Gaussians",
            one(narrow, np.float16),
            IMAGE,
            FLOAT16_GRADIENT,
            slow=True,
        ),
    ]


CASES = {f"{case.group}: {case.name}": case for case in _cases()}

NAMES = ("means", "quats", "scales", "opacities", "colors", "K", "cam_from_world", "background")


@functools.partial(jax.jit, static_argnames=("draw", "width", "height"))
def evaluate(draw, gaussians, K, pose, background, unit, width, height):
    """Rendering, and the gradients of a random linear function of its rgb, alpha and depth with
    respect to everything.
    """
    rng = np.random.default_rng(7)
    weights = [
        rng.normal(size=shape) for shape in ((height, width, 3), (height, width), (height, width))
    ]

    def loss(gaussians, K, pose, background):
        rendering = draw(gaussians, Camera(K, pose, width, height), background=background)
        images = rendering.rgb, rendering.alpha, rendering.depth / unit
        return sum(
            jnp.sum(w.astype(a.dtype) * a) for w, a in zip(weights, images, strict=True)
        ), rendering

    (_, rendering), gradients = jax.value_and_grad(loss, argnums=(0, 1, 2, 3), has_aux=True)(
        gaussians, K, pose, background
    )
    return rendering, gradients


def tiled(scene: Scene, draw: Callable = render, dtype: type | None = None):
    """(rendering, gradients) of a renderer, from the scene's own dtypes or in another one."""
    out = evaluate(
        draw, *scene.arguments(dtype), scene.unit, width=scene.width, height=scene.height
    )
    return jax.tree.map(np.asarray, out)


def tiled_in_float64(scene: Scene, draw: Callable = render):
    """The same from the same numbers in float64."""
    with jax.enable_x64(True):
        return tiled(scene, draw, np.float64)


reference_in_float64 = functools.partial(tiled_in_float64, draw=render_reference)


def relative_l2(found: np.ndarray, expected: np.ndarray) -> float:
    """|found - expected| / |expected|; 0 if both are 0, infinite if only the second is or the first
    is not finite.
    """
    found, expected = (np.asarray(a, np.float64).ravel() for a in (found, expected))
    if not np.isfinite(found).all():
        return np.inf
    error, largest = np.linalg.norm(found - expected), np.abs(expected).max(initial=0)
    if error == 0:
        return 0.0
    return float(error / (largest * np.linalg.norm(expected / largest))) if largest > 0 else np.inf


def natural(scene: Scene, gradients: tuple) -> dict[str, np.ndarray]:
    """Gradients by name, in float64 and in the units of the module docstring."""

    def wide(tree):
        return jax.tree.map(lambda a: np.asarray(a, np.float64), tree)

    gaussians, pose = wide(scene.gaussians), wide(scene.pose)
    by_name = dict(zip(NAMES, jax.tree.leaves(wide(gradients)), strict=True))
    units = {
        "means": np.abs(gaussians.means @ pose[2, :3] + pose[2, 3])[:, None],
        "scales": gaussians.scales,
        "quats": np.linalg.norm(gaussians.quats, axis=1, keepdims=True),
    }
    return {name: gradient * units.get(name, 1.0) for name, gradient in by_name.items()}


def compare(scene: Scene, found: tuple, expected: tuple) -> Outcome:
    """One (rendering, gradients) with another."""

    def wide(a):
        return np.asarray(a, np.float64)

    (image, gradients), (exact, exact_gradients) = found, expected
    pairs = natural(scene, gradients), natural(scene, exact_gradients)
    errors = {name: relative_l2(pairs[0][name], pairs[1][name]) for name in NAMES}
    turn, stretch = (np.linalg.norm(pairs[1][name]) for name in ("quats", "scales"))
    absolute = float(np.linalg.norm(pairs[0]["quats"] - pairs[1]["quats"]))
    errors["quats"] = min(errors["quats"], absolute / (float(max(turn, stretch)) or np.inf))
    worst = max(errors, key=errors.__getitem__)
    return Outcome(
        finite=all(np.isfinite(wide(leaf)).all() for leaf in jax.tree.leaves(found)),
        image=float(
            max(
                np.abs(wide(a) - b).max()
                for a, b in ((image.rgb, exact.rgb), (image.alpha, exact.alpha))
            )
        ),
        depth=relative_l2(image.depth, exact.depth),
        gradient=errors[worst],
        worst=worst,
        coverage=float(np.mean(wide(image.alpha) > 0)),
        overflow=int(image.overflow),
    )


def measure(case: Case, in_float64: bool = False) -> Outcome:
    """Draws one case in float32 (or float64) and by the reference in float64, and compares."""
    scene = case.build()
    return compare(
        scene, tiled_in_float64(scene) if in_float64 else tiled(scene), reference_in_float64(scene)
    )


@entry
def splatting_numerics(run: Run, only: str = "") -> int:
    """The extremes of splatting: is everything finite, and how far is float32 from float64?

    Every case is rendered, with the gradients of a random loss with respect to everything, by the
    tiled renderer in float32 and by the reference in float64 from the same numbers; and by the
    tiled renderer in float64, which shows that only rounding remains. Exit status 1 if a number is
    not finite, a bound is exceeded, or something is visible that should not be. Three minutes.

    Options:
    only: cases whose names contain this
    """
    rows, numbers, number = [], [], lambda x: "0" if x == 0 else f"{x:.0e}"
    for name, case in CASES.items():
        if only in name:
            single, double = measure(case), measure(case, in_float64=True)
            passes = single.passes(case) and max(double.image, double.gradient) <= FLOAT64
            numbers.append(
                {
                    "case": name,
                    "image_bound": case.image,
                    "gradient_bound": case.gradient,
                    "passes": passes,
                }
            )
            numbers[-1] |= {
                "float32": dataclasses.asdict(single),
                "float64": dataclasses.asdict(double),
            }
            rows.append(
                [
                    name + ("" if passes else " **FAILED**"),
                    number(single.image),
                    number(single.gradient),
                    single.worst,
                ]
            )
    run.show(markdown_table(("case", "image error", "gradient error", "of"), rows), numbers)
    return 0 if rows and all(row["passes"] for row in numbers) else 1
