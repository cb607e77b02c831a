"""The paper's figures, of trained variants; those that are not trained are left out, with a line that says so."""

import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, figure
from experiments.paper.bench import COUNTS, PHOTOS, REFERENCE, shown, takes_one, variants
from experiments.paper.rows import SHIPPED, Tested, load_networks, measured, trained, views_of
from experiments.results import markdown_table
from humangs_jax.avatar.frames import draw
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.core.pytree import replace
from humangs_jax.evaluation.cases import find_people, weights_method
from humangs_jax.io.images import write_png
from humangs_jax.losses.perceptual import lpips

DEPTHS = ("one depth", REFERENCE)
PATCHES = 8
"""Patches along a side of an image: 64 of 512 pixels."""
LEAST = 16
"""Pixels a side of the smallest patch that LPIPS takes; smaller ones are compared by squared errors."""
SHOWN = 4
"""People, and poses, on the sheet of driven people."""
ACROSS = 8
"""Systems side by side, before the next ones are below."""


@entry
def paper_figures(
    run: Run,
    out: Path,
    options: Tested = Tested(),
    motions: Path | None = None,
    poses: Path | None = None,
    only: tuple[str, ...] = (),
) -> None:
    """The paper's figures, of trained variants.

    varying: PSNR of novel poses over 1, 2, 4 and 6 photos, each photo of another pose where the capture has as many; features:
    histogram of what the features of four depths change in a patch of 64 x 64 pixels of 512 more than half of which is the person
    (LPIPS where patches are large enough); driven: people in the poses of other people; systems: the first person by every system
    of the bench that is trained.

    Options:
    out: folder of the images
    motions: captures whose poses drive the others; default: each other
    poses: captures of several poses, for `varying`; default: --data
    only: which figures
    """
    with tempfile.TemporaryDirectory() as folder:
        options = options.with_people(Path(folder))
        systems, networks = trained(options.runs, options.weights), load_networks(options.lpips)
        out.mkdir(parents=True, exist_ok=True)
        given = SimpleNamespace(**vars(options), out=out, motions=motions, varying=poses)
        numbers = {name: FIGURES[name](systems, networks, given) for name in only or FIGURES}
    run.show(text_of(numbers), numbers)


def text_of(numbers: Mapping[str, Any]) -> str:
    """The curves over photos as a table, and what the histogram says."""
    cell = lambda points, count: f"{points[int(count)]:.2f}" if int(count) in points else ""
    rows = [[name, *(cell(points, x) for x in COUNTS)] for name, points in numbers.get("varying", {}).items()]
    texts = [markdown_table(["PSNR, dB, of another pose, by photos of several", *COUNTS], rows)] if rows else []
    if found := numbers.get("features"):
        said = f"mean {found['mean']:.1e}, skewness {found['skewness']:+.2f}"
        texts.append(f"Without - with features of four depths, {found['kind']}, {found['patches']} patches: {said}.")
    return "\n\n".join(texts)


def varying(systems: dict[str, Any], networks: Any, options: Any) -> dict[str, dict[int, float]]:
    """Unseen poses from photos of varying poses."""
    people = options.varying or options.data
    curves: dict[str, dict[int, float]] = {}
    for name in systems:
        for count in map(int, COUNTS):
            found = measured(
                systems[name], people, count, options.body, networks, views_of(people, count, options.body, varying=True)
            )
            if found is not None and (scores := found["animation"] or found["reconstruction"]):
                curves.setdefault(name, {})[count] = scores["psnr"]
    with figure(options.out / "varying.png", size=(5, 3.4)) as axes:
        for name, points in curves.items():
            axes.plot(list(points), list(points.values()), "o-", label=name)
        axes.set(xlabel="photos of varying poses", ylabel="PSNR, dB")
        axes.legend(fontsize=8)
    return curves


def features(systems: dict[str, Any], networks: Any, arguments: Any) -> dict[str, Any]:
    """What the features of four depths change, by patches."""
    if missing := [name for name in DEPTHS if name not in systems]:
        print(f"features: {missing[0]!r} is not trained", file=sys.stderr)
        return {}
    people, changes, kind = find_people(arguments.data, PHOTOS, None, arguments.body), [], "squared error"
    methods = [weights_method(*systems[name]) for name in DEPTHS]
    for index in range(len(people.names)):
        case = people.load(index)
        if case.truth.masks is None:
            raise ValueError(f"{case.name}: the patches of a person are found by masks, and there are none")
        without, with_them = (method(case, 1.0).images for method in methods)
        for truth, mask, a, b in zip(case.truth.images, case.truth.masks, without, with_them, strict=True):
            side = max(1, truth.shape[0] // PATCHES)
            kind = "LPIPS" if networks and side >= LEAST else "squared error"
            error = patch_lpips(networks[0]) if kind == "LPIPS" else patch_error
            changes += [error(truth, a, box) - error(truth, b, box) for box in patches(mask, side)]
    with figure(arguments.out / "features.png", size=(5, 3.4)) as axes:
        axes.hist(changes, bins=60, color="#1f6f8b")
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel(f"{kind} without - with features of four depths")
    centred = np.asarray(changes) - np.mean(changes)
    skew = float(np.mean(centred**3) / max(np.mean(centred**2) ** 1.5, 1e-30))
    return {"kind": kind, "patches": len(changes), "mean": float(np.mean(changes)), "skewness": skew}


def patches(mask: np.ndarray, side: int) -> list[tuple[slice, slice]]:
    """Squares more than half of which the mask covers."""
    corners = [(y, x) for y in range(0, mask.shape[0] - side + 1, side) for x in range(0, mask.shape[1] - side + 1, side)]
    boxes = [(slice(y, y + side), slice(x, x + side)) for y, x in corners]
    return [box for box in boxes if mask[box].mean() > 0.5]


def patch_error(truth: np.ndarray, shown: np.ndarray, box: tuple[slice, slice]) -> float:
    """Mean squared error."""
    return float(np.mean((truth[box] - shown[box]) ** 2))


def patch_lpips(network: Any) -> Callable[..., float]:
    """LPIPS of a patch."""
    compare = jax.jit(lpips)
    return lambda truth, shown, box: float(compare(network, shown[box], truth[box]))


def driven(systems: dict[str, Any], networks: Any, arguments: Any) -> dict[str, list[str]]:
    """A row a person: one photo, then the person in poses of others, seen from the camera of that photo."""
    weights = systems.get(REFERENCE, systems[SHIPPED])
    people = find_people(arguments.data, PHOTOS, None, arguments.body)
    others = find_people(arguments.motions, PHOTOS, None, arguments.body) if arguments.motions else people
    rows = []
    for index in range(min(SHOWN, len(people.names))):
        case = people.load(index)
        if case.inputs is None:
            raise ValueError(f"{case.name}: no photos to reconstruct from")
        own = jax.tree.map(lambda x: x[:1], case.inputs.poses)
        avatar, camera = reconstruct(*weights, case.inputs), case.inputs.cameras[0]
        row = [case.inputs.images[0]]
        for step in range(1, SHOWN + 1):
            poses = others.load((index + step) % len(others.names)).truth.poses
            pose = jax.tree.map(lambda x: x[-1:], poses)  # the last one: an novel pose where there is one
            standing = replace(pose, translation=own.translation)  # where the person stood, before the same camera
            cameras = jax.tree.map(lambda x: x[None], camera)
            row.append(np.clip(np.asarray(next(iter(draw(avatar, standing, cameras, jnp.ones(3)))).rgb), 0, 1))
        rows.append(np.concatenate(row, axis=1))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1.0) for row in rows]
    write_png(arguments.out / "driven.png", np.concatenate(rows))
    return {"people": list(people.names[:SHOWN])}


def systems_shown(systems: dict[str, Any], networks: Any, arguments: Any) -> dict[str, list[str]]:
    """A column a system, the truth first."""
    left_out = {SHIPPED, *(name for name, variant in variants().items() if variant.about)}  # the first was trained far longer
    names = [name for name in systems if name not in left_out]
    columns: dict[str, Any] = {}
    for name in names:
        photos = 1 if takes_one(systems[name][1]) else PHOTOS
        case = find_people(arguments.data, photos, None, arguments.body).load(0)
        frames = np.asarray(case.truth.frames)
        views = sorted({int(np.argmax(frames == frame)) for frame in (frames.min(), frames.max())})
        columns["truth"] = [case.truth.images[view] for view in views]
        predicted = shown(systems[name], case)[0]
        columns[f"{name}\n{photos} photo{'s' * (photos > 1)}"] = [predicted.images[view] for view in views]
    rows, width = len(columns["truth"]), min(len(columns), ACROSS)
    blocks = -(-len(columns) // width)
    with figure(arguments.out / "systems.png", width, (1.3 * width, 1.6 * blocks * rows), rows=blocks * rows) as axes:
        for axis in axes.flat:
            axis.set_axis_off()
        for i, (title, images) in enumerate(columns.items()):
            column = axes[i // width * rows :, i % width]
            column[0].set_title(title, fontsize=7)
            for axis, image in zip(column, images, strict=False):
                axis.imshow(np.clip(image, 0, 1))
    return {"systems": names}


FIGURES: dict[str, Callable[[dict[str, Any], Any, Any], Any]] = {
    "varying": varying,
    "features": features,
    "driven": driven,
    "systems": systems_shown,
}
