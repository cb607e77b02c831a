"""What `reconstruct` makes of inputs at the extremes: an error, a warning or an avatar, and how good that is.

    python experiments/check_extremes.py --json docs/results/extremes.json [--table docs/stability.md] [--cases black inverted]
    python experiments/check_extremes.py --limits [--people 2] [--table docs/stability.md]

One person of the validation seeds, four photos of 256 pixels; each case changes one thing. "warned": the quick check, which
`humangs reconstruct` runs first, says something. "reach": largest distance of a Gaussian from its vertex, in body heights; all
numbers have to be finite. PSNR: held-out views of the same pose, by the true cameras and pose. "error": `reconstruct` refuses
the capture with a line that names the array.

--limits: how far a quantity may be off until the mean PSNR of some people has fallen by `BOUND`, linear between the values
tried. Writes humangs_jax/assets/limits.json for `humangs check --limits`.
"""

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np

from experiments.common.results import markdown_table, publish, write_json

SEED_INDEX, SIZE, VIEWS = 1, 256, 4
Change = Callable[[Any], Any]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", help="words; only cases whose names have one of them")
    parser.add_argument("--json", type=Path, help="the numbers are written here")
    parser.add_argument("--table", type=Path, help="page whose table is written")
    parser.add_argument("--limits", action="store_true", help="ranges of use instead of the cases")
    parser.add_argument("--people", type=int, default=2, help="of --limits")
    arguments = parser.parse_args()
    if arguments.limits:
        results = measure_limits(arguments.people)
        write_json(ASSETS / "limits.json", {"bound": BOUND, "ranges": results["ranges"]})
        text = limits_section(results)
        print(text)
        if arguments.table:
            publish(arguments.table, "limits", text, results)
        return
    results = measure(arguments.cases)
    if arguments.json:
        write_json(arguments.json, results)
    text = section(results)
    print(text)
    if arguments.table:
        publish(arguments.table, "extremes", text, results)


def measure(words: list[str] | None = None) -> dict[str, Any]:
    """{case: {"error"} or {"warnings", "reach", "psnr", "psnr_foreground"}}. Raises: AssertionError: a number is not finite."""
    from tqdm import tqdm

    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.network.weights import load_weights
    from humangs_jax.people.seeds import seeds_of

    (seed,) = seeds_of("validation", SEED_INDEX, 1)
    subject = make_evaluation_subject(seed, load_body(), [VIEWS], SIZE, HeldOut(4, 0, 0))
    network, inputs, results = load_weights(), subject.inputs(VIEWS), {}
    chosen = {name: change for name, change in CASES.items() if not words or any(word in name for word in words)}
    for name, change in tqdm(chosen.items(), desc="cases"):
        held_out = change(subject.held_out) if name in WORLDS else subject.held_out
        results[name] = outcome(network, changed(name, change, inputs, subject.seed), held_out)
    return results


def changed(name: str, change: Change, capture, seed: int):
    """The capture of a case. Where cameras move, the person is photographed anew."""
    capture = change(capture)
    if name not in RENDERED:
        return capture
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import View, capture_views, sample_pose

    person = make_subject(seed, capture.body)
    views = [View(0, label, capture.cameras[i]) for i, label in enumerate(capture.names)]
    return capture_views(person, capture.body, [sample_pose(person, 0)], views)


def outcome(network, capture, held_out) -> dict[str, Any]:
    """What becomes of one capture."""
    from experiments.evaluation.subjects import score_tasks
    from humangs_jax.apps.quick_check import likely_mistakes
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.evaluation.cases import draw_views

    try:
        avatar = reconstruct(*network, capture)
    except ValueError as error:
        return {"error": str(error)}
    gaussians, rest = avatar.gaussians, np.asarray(avatar.rest_vertices)
    for field in ("means", "quats", "scales", "opacities", "colors"):
        assert np.isfinite(getattr(gaussians, field)).all(), field
    own = np.repeat(rest, len(gaussians.means) // len(rest), axis=0)
    height = np.ptp(rest[:, 1])
    reach = float(np.linalg.norm(np.asarray(gaussians.means) - own, axis=-1).max() / height)
    warnings = list(likely_mistakes(capture))
    drawn = draw_views(avatar, held_out)
    assert np.isfinite(np.asarray(drawn.images)).all() and np.isfinite(np.asarray(drawn.alpha)).all()
    scores = score_tasks(drawn.images, held_out, alpha=drawn.alpha)["novel"]
    return {"warnings": warnings, "reach": reach} | {name: scores[name] for name in ("psnr", "psnr_foreground")}


def section(results: dict[str, Any]) -> str:
    """The table."""
    rows = []
    for name, row in results.items():
        if "error" in row:
            rows.append([name, "error", "", "", "", row["error"].removeprefix("reconstruct: capture: ")])
            continue
        numbers = [f"{row['reach']:.2f}", f"{row['psnr']:.1f}", f"{row['psnr_foreground']:.1f}"]
        rows.append([name, "warned" if row["warnings"] else "avatar", *numbers, (row["warnings"] or [""])[0]])
    return markdown_table(["case", "result", "reach", "PSNR", "on the person", "first line"], rows, "llrrrl")


# Changes of a capture ---------------------------------------------------------------------------------------------------


def photos(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other colours on the person; white behind."""

    def changed(capture):
        masks = capture.masks[..., None]
        return dataclasses.replace(capture, images=masks * np.clip(change(capture.images), 0, 1) + (1 - masks))

    return changed


def masks(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other masks, white where they are 0."""

    def changed(capture):
        found = change(capture.masks)
        shown = found[..., None] * capture.images + (1 - found[..., None])
        return dataclasses.replace(capture, masks=found, images=shown)

    return changed


def cameras(K: Callable = lambda K: K, matrix: Callable = lambda m: m) -> Change:
    """Other cameras for the same photos."""

    def changed(capture):
        old = capture.cameras
        intrinsics = np.stack([K(np.array(x)) for x in old.K]).astype(np.float32)
        extrinsics = np.stack([matrix(np.array(x)) for x in old.cam_from_world]).astype(np.float32)
        return dataclasses.replace(capture, cameras=dataclasses.replace(old, K=intrinsics, cam_from_world=extrinsics))

    return changed


def focal(factor: float) -> Callable:
    """K with another focal length."""
    return lambda K: K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


def far(meters: float) -> Change:
    """Cameras moved back along their axes, with the focal lengths that leave the person as large as before."""

    def moved(capture):
        distance = float(np.mean([np.asarray(m)[2, 3] for m in capture.cameras.cam_from_world]))

        def back(m):
            m[2, 3] += meters - distance
            return m

        return cameras(focal(meters / distance), back)(capture)

    return moved


def zoom(factor: float) -> Change:
    """The person smaller or larger in the frame, cameras to match."""

    def changed(capture):
        from humangs_jax.io.images import resized

        side = capture.images.shape[1]
        inner = max(1, round(side * min(factor, 1)))

        def zoomed(image, empty):
            if factor < 1:
                small = np.full_like(image, empty)
                start = (side - inner) // 2
                small[start : start + inner, start : start + inner] = resized(image, inner, inner)
                return small
            cut = round(side / factor)
            start = (side - cut) // 2
            return resized(image[start : start + cut, start : start + cut], side, side)

        images = np.clip([zoomed(image, 1.0) for image in capture.images], 0, 1).astype(np.float32)
        shapes = np.clip([zoomed(mask, 0.0) for mask in capture.masks], 0, 1).astype(np.float32)
        about = np.array([[factor, 0, side / 2 * (1 - factor)], [0, factor, side / 2 * (1 - factor)], [0, 0, 1]])
        moved = cameras(lambda K: about @ K)(capture)
        return dataclasses.replace(moved, images=images, masks=shapes)

    return changed


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other rotations of the joints for the same photos."""

    def changed(capture):
        rotations = np.asarray(change(np.array(capture.poses.rotations)), np.float32)
        return dataclasses.replace(capture, poses=dataclasses.replace(capture.poses, rotations=rotations))

    return changed


def tall(factor: float) -> Change:
    """A body, and a world, of another size."""

    def changed(capture):
        body = dataclasses.replace(
            capture.body,
            template=capture.body.template * factor,
            shape_directions=capture.body.shape_directions * factor,
        )
        moved = dataclasses.replace(capture.poses, translation=capture.poses.translation * factor)

        def away(m):
            m[:3, 3] *= factor
            return m

        return dataclasses.replace(cameras(matrix=away)(capture), body=body, poses=moved)

    return changed


def at_the_pelvis(capture):
    """Every camera inside of the body."""
    pelvis = np.asarray(capture.poses.translation[0]) + np.array([0, 0.9, 0])

    def inside(m):
        m[:3, 3] = -m[:3, :3] @ pelvis
        return m

    return cameras(matrix=inside)(capture)


def turned(m):
    """The camera looks the other way."""
    return np.diag([-1.0, 1.0, -1.0, 1.0]) @ m


def without_weights(capture):
    """Skinning weights that sum to 0."""
    body = dataclasses.replace(capture.body, skinning_weights=0 * capture.body.skinning_weights)
    return dataclasses.replace(capture, body=body)


def betas(value: float) -> Change:
    """All shape coefficients the same."""
    return lambda capture: dataclasses.replace(capture, betas=np.full_like(np.asarray(capture.betas), value))


def spoilt(name: str) -> Change:
    """NaN in one place of one array."""

    def changed(capture):
        owner, _, field = name.rpartition(".")
        target = getattr(capture, owner) if owner else capture
        array = np.array(getattr(target, field))
        array.reshape(-1)[0] = np.nan
        target = dataclasses.replace(target, **{field: array})
        return dataclasses.replace(capture, **{owner: target}) if owner else target

    return changed


def random_turns(rotations: np.ndarray) -> np.ndarray:
    """Every joint turned at random, up to half a turn."""
    axes = np.random.default_rng(0).normal(size=rotations.shape)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return axes * np.random.default_rng(1).uniform(0, np.pi, (*rotations.shape[:-1], 1))


NOISE = np.random.default_rng(0)
CASES: dict[str, Change] = {
    "as it is": lambda capture: capture,
    "4 stops over": photos(lambda x: 16 * x),
    "4 stops under": photos(lambda x: x / 16),
    "black": photos(np.zeros_like),
    "white": photos(np.ones_like),
    "noise": photos(lambda x: NOISE.random(x.shape).astype(np.float32)),
    "focal length x 2": cameras(focal(2.0)),
    "focal length / 2": cameras(focal(0.5)),
    "focal length x 10": cameras(focal(10.0)),
    "focal length / 10": cameras(focal(0.1)),
    "cameras inside the body": at_the_pelvis,
    "cameras at 100 m": far(100.0),
    "cameras look away": cameras(matrix=turned),
    "person of 1 pixel": zoom(1 / 150),
    "person of a twentieth of the frame": zoom(0.06),
    "person cut at the frame": zoom(3.0),
    "4 m tall": tall(2.3),
    "0.4 m tall": tall(0.23),
    "poses past joint limits": poses(lambda x: 3 * x),
    "every joint at random": poses(random_turns),
    "masks empty": masks(np.zeros_like),
    "masks full": masks(np.ones_like),
    "masks inverted": masks(lambda x: 1 - x),
    "no masks": lambda capture: dataclasses.replace(capture, masks=None),
    "1 view": lambda capture: capture.select([0]),
    "32 views": lambda capture: capture.select(list(range(VIEWS)) * 8),
    "one view four times": lambda capture: capture.select([0] * VIEWS),
    "skinning weights of 0": without_weights,
    "betas 0": betas(0.0),
    "betas 100": betas(100.0),
    "NaN in images": spoilt("images"),
    "NaN in masks": spoilt("masks"),
    "NaN in betas": spoilt("betas"),
    "NaN in K": spoilt("cameras.K"),
    "NaN in cam_from_world": spoilt("cameras.cam_from_world"),
    "NaN in rotations": spoilt("poses.rotations"),
    "NaN in translation": spoilt("poses.translation"),
}

ASSETS = Path(__file__).parents[1] / "humangs_jax" / "assets"
BOUND = 1.0
"""Decibels of PSNR."""


def noise(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Normal numbers, the same for every strength."""
    return np.random.default_rng(seed).normal(size=shape)


def turned_by(degrees: float) -> Change:
    """Every camera turned about an axis of its own."""

    def changed(capture):
        import jax.numpy as jnp

        from humangs_jax.geometry.quaternion import matrix_from_axis_angle

        count = capture.view_count
        axes = noise(2, (count, 3))
        axes *= np.radians(degrees) / np.linalg.norm(axes, axis=-1, keepdims=True)
        turns = iter(np.asarray(matrix_from_axis_angle(jnp.asarray(axes))))

        def turn(m):
            m[:3] = next(turns) @ m[:3]
            return m

        return cameras(matrix=turn)(capture)

    return changed


def moved_by(centimeters: float) -> Change:
    """The body moved, in one direction."""

    def changed(capture):
        step = noise(3, (3,))
        translation = np.asarray(capture.poses.translation) + (centimeters / 100 * step / np.linalg.norm(step))
        moved = dataclasses.replace(capture.poses, translation=translation.astype(np.float32))
        return dataclasses.replace(capture, poses=moved)

    return changed


def grown(pixels: int) -> Change:
    """Masks dilated (or eroded, below 0); what they show of the background is grey."""
    side = 2 * abs(pixels) + 1

    def changed(capture):
        from scipy.ndimage import grey_dilation, grey_erosion

        change = grey_dilation if pixels > 0 else grey_erosion
        found = np.stack([change(mask, (side, side)) for mask in capture.masks])
        inside = np.minimum(found, capture.masks)[..., None]
        true = (capture.images - (1 - capture.masks[..., None])) / np.maximum(capture.masks[..., None], 1e-6)
        around = (found[..., None] - inside) * 0.5
        images = np.clip(inside * true + around + (1 - found[..., None]), 0, 1).astype(np.float32)
        return dataclasses.replace(capture, images=images, masks=found)

    return changed


def person_of(pixels: float) -> Change:
    """The person that high in every photo, about."""

    def changed(capture):
        heights = [np.ptp(np.flatnonzero((mask > 0.5).any(axis=1))) + 1 for mask in capture.masks]
        return zoom(pixels / float(np.mean(heights)))(capture)

    return changed


LIMITS: dict[str, tuple[str, float | None, dict[float, Change]]] = {
    "photos": ("", 4, {n: lambda c, n=n: c.select(list(range(0, VIEWS, VIEWS // n))) for n in (1, 2)}),
    "noise": (
        "standard deviation",
        0,
        {x: photos(lambda image, x=x: image + x * noise(4, image.shape)) for x in (0.05, 0.1, 0.2, 0.4)},
    ),
    "distance of the cameras": ("m", None, {x: far(x) for x in (1.2, 1.6, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 30.0)}),
    "height of the person": ("pixels of 256", None, {x: person_of(x) for x in (25, 50, 75, 100, 130, 160, 190)}),
    "masks too large or small": ("pixels of 256", 0, {x: grown(x) for x in (-6, -3, -1, 1, 3, 6)}),
    "focal length": ("%", 0, {x: cameras(focal(1 + x / 100)) for x in (-10, -5, -2, 2, 5, 10)}),
    "cameras turned": ("degrees", 0, {x: turned_by(x) for x in (0.25, 0.5, 1, 2, 4)}),
    "joints turned": (
        "degrees",
        0,
        {x: poses(lambda r, x=x: r + np.radians(x) / 3**0.5 * noise(5, r.shape)) for x in (1, 2, 4, 8, 16)},
    ),
    "body moved": ("cm", 0, {x: moved_by(x) for x in (0.5, 1, 2, 4, 8)}),
    "shape coefficients": (
        "standard deviations",
        0,
        {
            x: lambda c, x=x: dataclasses.replace(
                c, betas=np.asarray(c.betas) + np.float32(x * noise(6, c.betas.shape))
            )
            for x in (0.25, 0.5, 1, 2)
        },
    ),
}
"""{quantity: (unit, the value at which nothing is changed, {value: change})}. None: it is somewhere among the values."""


def measure_limits(people: int) -> dict[str, Any]:
    """{"losses": {quantity: {value: dB}}, "ranges": {quantity: {"unit", "low", "high"}}}."""
    from tqdm import tqdm

    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.network.weights import load_weights
    from humangs_jax.people.seeds import seeds_of

    body, network = load_body(), load_weights()
    seeds = seeds_of("validation", SEED_INDEX, people)
    subjects = [make_evaluation_subject(seed, body, [VIEWS], SIZE, HeldOut(4, 0, 0)) for seed in seeds]

    def score(name, change):
        captures = [changed(name, change, subject.inputs(VIEWS), subject.seed) for subject in subjects]
        pairs = zip(captures, subjects, strict=True)
        return np.mean([outcome(network, capture, subject.held_out)["psnr"] for capture, subject in pairs])

    plain = score("", lambda capture: capture)
    losses = {
        name: {value: float(plain - score(name, change)) for value, change in tqdm(changes.items(), desc=name)}
        for name, (_, _, changes) in LIMITS.items()
    }
    return {"losses": losses, "ranges": {name: interval(name, losses[name]) for name in LIMITS}}


def interval(name: str, losses: dict[float, float]) -> dict[str, Any]:
    """The range around the best value in which the loss stays below `BOUND`; None for an end that was not reached."""
    unit, zero, _ = LIMITS[name]
    points = sorted((losses | ({} if zero is None else {zero: 0.0})).items())
    middle = min(range(len(points)), key=lambda i: points[i][1])

    def end(step):
        i = middle
        while 0 <= i + step < len(points):
            (x, loss), (y, more) = points[i], points[i + step]
            if more > BOUND:
                return x + (y - x) * (BOUND - loss) / (more - loss)
            i += step
        return None

    low, high = end(-1), end(1)
    low = 0.0 if low is None and points[0][0] == 0 else low  # errors that have no sign
    if name == "photos" and low is not None:
        low = math.ceil(low)
    return {"unit": unit, "low": low, "high": high}


def limits_section(results: dict[str, Any]) -> str:
    """The table: ranges, and the losses behind them."""
    rows = []
    for name, losses in results["losses"].items():
        row = results["ranges"][name]
        ends = ["-" if row[end] is None else f"{row[end]:.3g}" for end in ("low", "high")]
        tried = ", ".join(f"{value:g}: {loss:.1f}" for value, loss in sorted(losses.items()))
        rows.append([f"{name}, {row['unit']}".rstrip(", "), *ends, tried])
    return markdown_table(["quantity", "from", "to", "dB lost at each value tried"], rows, "lrrl")


WORLDS = ("4 m tall", "0.4 m tall")
"""Cases that change the held-out views as well."""
RENDERED = ("cameras at 100 m", "distance of the cameras")
"""Cases and quantities with new photos from the cameras as they are changed."""

if __name__ == "__main__":
    main()
