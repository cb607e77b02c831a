"""Checks on small scenes the extremes that splatting has to survive: whether everything is finite,
and how far float32 is from float64.

A case is a scene in float32 or a narrower type, and bounds on how far its image and gradients may
be from those of the same numbers in float64. Most scenes have 32 Gaussians and 24 x 16 pixels, so
that one compilation serves nearly all of them.

Gradients are compared in natural units, so that large and distant Gaussians count as much as
others: with respect to mean / depth, to log scale, and to the direction of the quaternion. Other
gradients have no such unit. Errors are relative to the norm of the same gradient. The gradient of
the quaternions vanishes for spheres, so its error is relative to the gradient of the log scales if
that is larger. The loss is a random linear function of rgb, alpha and depth.
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
"""Bounds of a case that is not special to float32: the largest error of a color or of alpha, and
the largest relative L2 error among the eight gradients. They allow for roundings of 6e-8 through a
few hundred operations.
"""

FAR, FARTHER = (2e-4, 1e-3), (3e-2, 2e-1)
"""The same bounds for a scene 1e3 m and 1e5 m from the world's origin. A position is known to 6e-8
of its distance, which is 6e-5 m and 6e-3 m, and the small Gaussians are 3e-2 m wide.
"""

NEEDLE_GRADIENT = 2e-3
"""Bound for Gaussians that are far below a pixel across and far larger than the image along. Their
gradient in log scale is 1e-4 of that of a visible scale, and rounding is relative to it.
"""

CROWD_GRADIENT = 5e-4
"""Bound for 50,000 alphas at one place. The gradients of all but the first few are sums that cancel
to nearly nothing.
"""

BFLOAT16_GRADIENT, FLOAT16_GRADIENT = 4e-3, 5e-4
"""Bounds for gradients in the input's dtype, which rounds them by 2^-9 or 2^-11."""

FLOAT64 = 1e-9
"""Bound of every case for the tiled renderer in float64 against the reference, absolute for images
and relative for gradients.
"""


class Arrays(NamedTuple):
    """The fields of `Gaussians` as NumPy arrays."""

    means: np.ndarray
    """(n, 3) centres in metres."""
    quats: np.ndarray
    """(n, 4) quaternions of any length."""
    scales: np.ndarray
    """(n, 3) standard deviations in metres."""
    opacities: np.ndarray
    """(n,) opacities."""
    colors: np.ndarray
    """(n, 3) colors."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is drawn. Its arrays have the dtypes of the renderer's input."""

    gaussians: Arrays
    """The Gaussians in the world."""
    K: np.ndarray
    """(3, 3) intrinsics."""
    pose: np.ndarray
    """(4, 4) matrix camera from world."""
    background: np.ndarray
    """(3,) color of the background."""
    width: int = WIDTH
    """Width of the image in pixels."""
    height: int = HEIGHT
    """Height of the image in pixels."""
    unit: float = 1.0
    """Metres of the unit in which the loss sees depths."""

    def arguments(self, dtype: type | None = None) -> tuple:
        """Returns (gaussians, K, cam_from_world, background) as JAX arrays, of `dtype` if it is
        given.
        """
        leaves = (self.gaussians, self.K, self.pose, self.background)
        if dtype is not None:
            leaves = jax.tree.map(lambda array: np.asarray(array, dtype), leaves)
        gaussians, *rest = jax.tree.map(jnp.asarray, leaves)
        return Gaussians(*gaussians), *rest


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene and its bounds."""

    group: str
    """What the case is about."""
    name: str
    """Name within the group."""
    build: Callable[[], Scene]
    """Function that makes the scene."""
    image: float = IMAGE
    """Bound of the image, see `IMAGE`."""
    gradient: float = GRADIENT
    """Bound of the gradients, see `IMAGE`."""
    drawn: bool = True
    """Whether the image shows anything."""
    slow: bool = False
    """Whether the case takes seconds."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Errors of a case that was drawn."""

    finite: bool
    """Whether all numbers are finite."""
    image: float
    """Largest error of rgb and alpha."""
    depth: float
    """Relative L2 error of the depth image."""
    gradient: float
    """Largest relative L2 error of a gradient."""
    worst: str
    """Name of the gradient with that error."""
    coverage: float
    """Share of the pixels that show anything."""
    overflow: int
    """Number of (splat, tile) pairs that did not fit in the buffers."""

    def passes(self, case: Case) -> bool:
        """Whether everything is finite, within the case's bounds, complete, and visible or not as
        the case wants it.
        """
        within = self.image <= case.image and self.gradient <= case.gradient
        return self.finite and within and (self.coverage > 0) == case.drawn and self.overflow == 0


def ordinary(seed: int = 0, count: int = COUNT, width: int = WIDTH, height: int = HEIGHT) -> Scene:
    """Returns Gaussians 2 to 4 m in front of a camera that is slightly turned, the scene that all
    extremes start from.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(2, 4, count)
    places = rng.uniform(-0.5, 0.5, (2, count)) * z * np.array([[width], [height]]) / FOCAL
    means = np.stack([*places, z], axis=-1)
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
    """Returns a scene with other arrays of its Gaussians, in float32."""
    gaussians = scene.gaussians._replace(
        **{name: np.asarray(a, np.float32) for name, a in arrays.items()}
    )
    return dataclasses.replace(scene, gaussians=gaussians)


def scaled(size: float) -> Scene:
    """Returns a scene whose scales are around `size` metres and differ by axis and Gaussian."""
    scene = ordinary()
    return changed(scene, scales=size * scene.gaussians.scales / 0.1)


def stretched(long: float, middle: float, short: float) -> Scene:
    """Returns a scene of needles or discs in random directions, with these scales in metres."""
    return changed(ordinary(), scales=np.broadcast_to([long, middle, short], (COUNT, 3)))


def opaque(opacity: float) -> Scene:
    """Returns a scene whose Gaussians all have one opacity."""
    return changed(ordinary(), opacities=np.full(COUNT, opacity))


def turned(norm: float) -> Scene:
    """Returns a scene whose quaternions all have one norm."""
    quats = ordinary().gaussians.quats.astype(np.float64)
    return changed(ordinary(), quats=norm * quats / np.linalg.norm(quats, axis=1, keepdims=True))


def at_depth(z: float, size: float, offset: float = 0.0) -> Scene:
    """Returns Gaussians on one plane in front of an unturned camera, spread over the image.

    Args:
        z: depth of the plane in metres
        size: typical scale in pixels
        offset: metres by which every second Gaussian lies farther away
    """
    scene = ordinary()
    depth = np.full(COUNT, float(z))
    depth[1::2] += offset
    slopes = scene.gaussians.means[:, :2] / scene.gaussians.means[:, 2:]
    means = np.concatenate([slopes * np.abs(depth[:, None]), depth[:, None]], axis=1)
    scales = scene.gaussians.scales / 0.1 * size * abs(z) / FOCAL
    return dataclasses.replace(changed(scene, means=means, scales=scales), pose=UNTURNED)


def across_near_plane() -> Scene:
    """Returns large Gaussians whose centres lie within a few centimetres on both sides of the near
    plane.
    """
    z = NEAR + np.linspace(-0.03, 0.08, COUNT)
    means = np.concatenate([ordinary().gaussians.means[:, :2] * 0.02, z[:, None]], axis=1)
    scene = changed(ordinary(), means=means, scales=0.2 * ordinary().gaussians.scales)
    return dataclasses.replace(scene, pose=UNTURNED)


def seen_through(focal: float, zoomed: bool) -> Scene:
    """Returns a scene with another focal length in pixels.

    If `zoomed`, the scene shrinks with the field of view, so that the image stays about the same.
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
    """Returns a scene whose Gaussians and camera are `distance` metres from the world's origin."""
    scene = ordinary()
    pose = scene.pose.astype(np.float64)
    pose[:3, 3] -= pose[:3, :3] @ np.array([distance, 0, 0])
    moved = changed(scene, means=scene.gaussians.means + np.array([distance, 0, 0]))
    return dataclasses.replace(moved, pose=pose.astype(np.float32))


def crowd(count: int, opacity: tuple[float, float], spread: float) -> Scene:
    """Returns `count` Gaussians on one pixel of an 8 x 8 image, thinner than a pixel.

    The image is a single tile, so that all of them are in one list.

    Args:
        count: number of Gaussians
        opacity: range of their opacities
        spread: range of their centres in pixels
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
    """Returns a scene with a Gaussian that is much larger than the image, and invisible others."""
    scene = ordinary(count=count)
    means, scales = np.array(scene.gaussians.means), np.array(scene.gaussians.scales)
    opacities = np.zeros(count)
    means[0], scales[0], opacities[0] = [0.1, 0.2, 3.0], [50.0, 80.0, 30.0], 0.7
    return changed(scene, means=means, scales=scales, opacities=opacities)


def behind() -> Scene:
    """Returns a scene whose Gaussians are all behind the camera."""
    means = ordinary().gaussians.means
    return changed(ordinary(), means=means * np.array([1, 1, -1]))


def coincident(reverse: bool = False) -> Scene:
    """Returns Gaussians that overlap at one depth, so that the image depends on their order, which
    is that of their indices.
    """
    scene = at_depth(3.0, 3.0)
    order = np.arange(COUNT)[::-1] if reverse else np.arange(COUNT)
    return dataclasses.replace(scene, gaussians=jax.tree.map(lambda a: a[order], scene.gaussians))


def narrow(dtype: DTypeLike, *others: str) -> Scene:
    """Returns a scene with its Gaussians, and other arrays by name, in another dtype."""
    scene = ordinary()

    def cast(name):
        return jax.tree.map(lambda a: np.asarray(a, dtype), getattr(scene, name))

    return dataclasses.replace(scene, **{name: cast(name) for name in ("gaussians", *others)})


def narrow_everything(dtype: DTypeLike) -> Scene:
    """Returns a scene with all its arrays in another dtype."""
    return narrow(dtype, "K", "pose", "background")


def _cases() -> list[Case]:
    """Returns all cases, by group."""
    one = functools.partial

    # the number next to the near plane
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
"""Names of the gradients in the order of the leaves."""


@functools.partial(jax.jit, static_argnames=("draw", "width", "height"))
def evaluate(draw, gaussians, K, pose, background, unit, width, height):
    """Returns a rendering, and the gradients of a random linear function of its rgb, alpha and
    depth with respect to everything.
    """
    rng = np.random.default_rng(7)
    shapes = (height, width, 3), (height, width), (height, width)
    weights = [rng.normal(size=shape) for shape in shapes]

    def loss(gaussians, K, pose, background):
        rendering = draw(gaussians, Camera(K, pose, width, height), background=background)
        images = rendering.rgb, rendering.alpha, rendering.depth / unit
        pairs = zip(weights, images, strict=True)
        return sum(jnp.sum(weight.astype(x.dtype) * x) for weight, x in pairs), rendering

    with_gradients = jax.value_and_grad(loss, argnums=(0, 1, 2, 3), has_aux=True)
    (_, rendering), gradients = with_gradients(gaussians, K, pose, background)
    return rendering, gradients


def tiled(scene: Scene, draw: Callable = render, dtype: type | None = None):
    """Returns the rendering and the gradients of a renderer, in the scene's dtypes or in another
    one.
    """
    out = evaluate(
        draw, *scene.arguments(dtype), scene.unit, width=scene.width, height=scene.height
    )
    return jax.tree.map(np.asarray, out)


def tiled_in_float64(scene: Scene, draw: Callable = render):
    """Returns the rendering and the gradients of a renderer from the same numbers in float64."""
    with jax.enable_x64(True):
        return tiled(scene, draw, np.float64)


reference_in_float64 = functools.partial(tiled_in_float64, draw=render_reference)


def relative_l2(found: np.ndarray, expected: np.ndarray) -> float:
    """Returns |found - expected| / |expected|.

    It is 0 if both are equal, and infinite if `found` is not finite, or if only `expected` is 0.
    """
    found, expected = (np.asarray(a, np.float64).ravel() for a in (found, expected))
    if not np.isfinite(found).all():
        return np.inf
    error, largest = np.linalg.norm(found - expected), np.abs(expected).max(initial=0)
    if error == 0:
        return 0.0
    if not largest > 0:  # 0 or NaN
        return np.inf
    # the division keeps squares from an overflow
    return float(error / (largest * np.linalg.norm(expected / largest)))


def natural(scene: Scene, gradients: tuple) -> dict[str, np.ndarray]:
    """Returns the gradients by name, in float64 and in the units of the module's docstring."""

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
    """Compares a (rendering, gradients) of a scene with the expected one."""

    def wide(a):
        return np.asarray(a, np.float64)

    (image, gradients), (exact, exact_gradients) = found, expected
    pairs = natural(scene, gradients), natural(scene, exact_gradients)
    errors = {name: relative_l2(pairs[0][name], pairs[1][name]) for name in NAMES}
    turn, stretch = (np.linalg.norm(pairs[1][name]) for name in ("quats", "scales"))
    absolute = float(np.linalg.norm(pairs[0]["quats"] - pairs[1]["quats"]))
    errors["quats"] = min(errors["quats"], absolute / (float(max(turn, stretch)) or np.inf))
    worst = max(errors, key=errors.__getitem__)
    pixels = (image.rgb, exact.rgb), (image.alpha, exact.alpha)
    return Outcome(
        finite=all(np.isfinite(wide(leaf)).all() for leaf in jax.tree.leaves(found)),
        image=float(max(np.abs(wide(a) - b).max() for a, b in pixels)),
        depth=relative_l2(image.depth, exact.depth),
        gradient=errors[worst],
        worst=worst,
        coverage=float(np.mean(wide(image.alpha) > 0)),
        overflow=int(image.overflow),
    )


def measure(case: Case, in_float64: bool = False) -> Outcome:
    """Draws a case in its dtypes or in float64, and compares with the reference in float64."""
    scene = case.build()
    found = tiled_in_float64(scene) if in_float64 else tiled(scene)
    return compare(scene, found, reference_in_float64(scene))


@entry
def splatting_numerics(run: Run, only: str = "") -> int:
    """Checks at the extremes of splatting whether everything is finite, and how far float32 is from
    float64.

    Every case is rendered, with the gradients of a random loss with respect to everything, by the
    tiled renderer in float32 and by the reference in float64 from the same numbers. The tiled
    renderer in float64 shows that only rounding remains. The exit status is 1 if a number is not
    finite, a bound is exceeded, or something is visible that should not be. Takes three minutes.

    Options:
    only: cases whose names contain this
    """
    rows, numbers = [], []

    def number(x):
        return "0" if x == 0 else f"{x:.0e}"

    # each case in float32, and in float64 to see that the rest is rounding
    for name, case in CASES.items():
        if only not in name:
            continue
        single, double = measure(case), measure(case, in_float64=True)
        passes = single.passes(case) and max(double.image, double.gradient) <= FLOAT64
        numbers.append(
            {
                "case": name,
                "image_bound": case.image,
                "gradient_bound": case.gradient,
                "passes": passes,
                "float32": dataclasses.asdict(single),
                "float64": dataclasses.asdict(double),
            }
        )
        title = name if passes else f"{name} **FAILED**"
        rows.append([title, number(single.image), number(single.gradient), single.worst])
    run.show(markdown_table(("case", "image error", "gradient error", "of"), rows), numbers)
    return 0 if rows and all(row["passes"] for row in numbers) else 1
