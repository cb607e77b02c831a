"""Trains the learned update of refinement (`humangs_jax/refinement/learned.py`) on avatars of the
shipped network.

The samples are made first. They have people of training seeds that the shipped network has not
seen, the network's avatar of each from four photos, and ten views, which include these photos. A
step draws samples and a number of photos for each, runs the iterations, and compares the result of
each iteration with views that are not among the photos. Gradients pass through the iterations, but
not through the errors that an iteration sees. Validation is on other people.
"""

import dataclasses
import functools
import inspect
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import serialization
from tqdm import tqdm

from experiments.harness import Run, entry
from experiments.refinement import body_off
from experiments.results import write_json
from humangs_jax.avatar.animate import without_pixel_footprint
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose
from humangs_jax.core.processes import compiler_options
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import read_npz, write_npz
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.images import to_uint8
from humangs_jax.io.reading import read_json
from humangs_jax.losses.loss_networks import load_lpips
from humangs_jax.losses.losses import structural_dissimilarity
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.weights import load_weights
from humangs_jax.refinement.learned import (
    Refiner,
    Signals,
    graph_of,
    load_refiner,
    photo_signals,
    read_refiner,
    refiner_iteration,
    save_refiner,
    stacked,
    unstacked,
)
from humangs_jax.refinement.objective import parameters_of, posed_gaussians
from humangs_jax.refinement.photos import Photo
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.rendering.splatting import render
from humangs_jax.synthetic.bank import build_bank, load_bank, save_bank
from humangs_jax.synthetic.on_the_fly import OnTheFlyConfig, on_the_fly_example
from humangs_jax.synthetic.subject import seeds_of

FIRST_SEED = 6000
"""First seed of the training range after those of the shipped network."""
PHOTOS, TARGETS = 4, 6
"""Number of photos of a sample, and of its other views."""
COUNTS = (1, 2, 4, 4, 4, 4, 6)
"""Numbers of photos that a step draws from. With 6, the first two other views are photos, too."""
ITERATION_WEIGHT = 0.9
"""Weight of an iteration in the loss, relative to that of the next one."""
WEIGHTS = {"squared": 10.0, "absolute": 1.0, "structural": 0.2, "silhouette": 0.2}
"""{term of the loss: its weight}."""
VALIDATED, VALIDATE_EVERY, SAVE_EVERY = 8, 250, 50
"""Number of validation people, steps between validations, and steps between states on disk."""
MARGIN = 2.0
"""Size of the renderer's buffers as a multiple of what the first Gaussians need."""


@dataclasses.dataclass(frozen=True)
class Refining:
    """Options:
    people: number of people of the samples
    samples: number of samples to train on
    size: side of the views in pixels
    off: millimetres that the bodies of half of the samples are off, see `refinement`; they are
    displaced to the masks
    start: weights to start from, of all layers or some; default: a network that changes nothing;
    "shipped": those of the package
    lpips: weight of LPIPS (AlexNet) in the loss; needs the extra `lpips`
    batch: samples in a step, a thread each
    """

    people: int = 400
    samples: int = 600
    size: int = 256
    off: float = 5.0
    start: str | None = None
    lpips: float = 0.3
    steps: int = 1300
    iterations: int = 3
    batch: int = 2
    learning_rate: float = 1.5e-3


@entry
def train_refiner(run: Run, out: Path, options: Refining = Refining()) -> None:
    """Trains the learned update of refinement. Ctrl-C saves, and the same command continues.

    On two cores of a CPU a sample takes 1.7 s, with the people, and a step of two samples and three
    iterations takes 2.4 s.

    Options:
    out: folder of the samples, the state and the weights (refiner.safetensors)
    """
    counts = ("samples", "people", "steps", "iterations", "batch")
    if min(getattr(options, name) for name in counts) < 1:
        raise ValueError(f"expected at least 1 of {', '.join(f'--{name}' for name in counts)}")
    path = out / "settings.json"
    settings = json.loads(json.dumps(dataclasses.asdict(options), default=str))
    if not path.is_file():
        write_json(path, settings)
    known = read_json(path)
    if known != settings:
        raise ValueError(f"{path}: this run has other settings, {known}: give another folder")
    folders = make_samples(out / "samples", FIRST_SEED, options.people, options.samples, options)
    validation = make_samples(
        out / "validation", FIRST_SEED + options.people, VALIDATED, VALIDATED, options
    )
    train(folders, validation, out, options)


# Samples
# --------------------------------------------------------------------------------------------------


def make_samples(out: Path, first: int, people: int, count: int, options: Refining) -> list[Path]:
    """Makes samples of the training seeds from `first` on, and returns their folders with
    avatar.npz and views.npz. Samples that exist are kept.
    """
    folders = [out / f"{i:05d}" for i in range(count)]
    missing = [folder for folder in folders if not (folder / "views.npz").is_file()]
    if not missing:
        return folders

    # the people of all samples, which are rendered on the fly
    body, weights, path = load_body(), load_weights(), out / "people.npz"
    if not path.is_file():
        out.mkdir(parents=True, exist_ok=True)
        seeds, processes = seeds_of("train", first, people), os.cpu_count() or 1
        save_bank(path, build_bank(seeds, body, "train", processes=processes, progress=True))
    bank, make = load_bank(path), jax.jit(on_the_fly_example, static_argnames="config")
    config = OnTheFlyConfig(
        input_views=PHOTOS, target_views=TARGETS, input_size=options.size, target_size=options.size
    )
    for folder in tqdm(missing, desc="samples"):
        example = jax.device_get(make(bank, jax.random.key(int(folder.name)), config))
        photos, targets = jax.tree.map(jnp.asarray, (example.inputs, example.targets))
        both = jax.tree.map(lambda *x: jnp.concatenate(x), photos, targets)
        # the bodies of every second sample are off
        poses, betas = BodyPose(both.rotations, both.translations), photos.betas
        if int(folder.name) % 2 and options.off:
            poses, betas = body_off(poses, betas, options.off, int(folder.name))
        capture = Capture(
            images=example.inputs.images,
            masks=example.inputs.masks,
            cameras=both.cameras[:PHOTOS],
            frames=np.arange(PHOTOS),
            body=body,
            betas=betas,
            poses=poses[:PHOTOS],
            names=tuple(map(str, range(PHOTOS))),
        )
        folder.mkdir(parents=True, exist_ok=True)
        without_pixel_footprint(reconstruct(*weights, capture)).save(folder / "avatar.npz")
        arrays = {name: to_uint8(getattr(both, name)) for name in ("images", "masks")}
        arrays |= {
            "rotations": np.asarray(poses.rotations),
            "translations": np.asarray(poses.translation),
        }
        arrays |= {"K": both.cameras.K, "cam_from_world": both.cameras.cam_from_world}
        write_npz(folder / "views.npz", arrays)
    return folders


@dataclasses.dataclass(frozen=True)
class Sample:
    """An avatar to refine, and the views of its person."""

    avatar: Any
    """The avatar of the network."""
    start: Any
    """Parameters of its Gaussians."""
    views: list[Any]
    """All views as `Photo`, the photos first."""
    graph: Any
    """Neighbours of the Gaussians."""


def read_sample(folder: Path) -> Sample:
    """Reads a sample from its folder."""
    avatar, arrays = Avatar.load(folder / "avatar.npz"), read_npz(folder / "views.npz")[0]
    images, masks = (jnp.asarray(arrays[name], jnp.float32) / 255 for name in ("images", "masks"))
    cameras = Camera(
        jnp.asarray(arrays["K"]),
        jnp.asarray(arrays["cam_from_world"]),
        images.shape[1],
        images.shape[2],
    )
    pose = jnp.asarray(arrays["rotations"]), jnp.asarray(arrays["translations"])
    views = list(jax.vmap(Photo)(images, masks, jnp.ones(masks.shape, bool), cameras, *pose))
    start = parameters_of(avatar.gaussians)
    return Sample(avatar, start, views, graph_of(np.asarray(avatar.gaussians.means)))


# Training
# --------------------------------------------------------------------------------------------------


@functools.cache
def compiled(function: Any) -> Any:
    """Returns a function compiled by JAX. Its argument `splat`, if it has one, is static."""
    static = [name for name in ("splat",) if name in inspect.signature(function).parameters]
    return jax.jit(function, static_argnames=static, compiler_options=compiler_options())


def run_iterations(
    variables: Any, sample: Sample, photos: int, iterations: int, splat: Any
) -> tuple[list[Any], list[Any]]:
    """Returns the stacked parameters after each iteration, and the signals that each iteration
    saw.
    """
    start = values = stacked(sample.start)
    hidden, after, seen = jnp.zeros((len(start), Refiner.width)), [], []
    for _ in range(iterations):
        parameters = unstacked(values, sample.start)
        each = [
            compiled(photo_signals)(parameters, sample.avatar, view, splat=splat)[0]
            for view in sample.views[:photos]
        ]
        seen.append(jax.tree.map(lambda *x: jnp.stack(x), *each))
        values, hidden = compiled(refiner_iteration)(
            variables, values, start, hidden, seen[-1], sample.graph, sample.avatar
        )
        after.append(values)
    return after, seen


def through_iterations(
    variables: Any, start: Any, seen: list[Any], graph: Any, avatar: Any, cotangents: Any
) -> Any:
    """Returns the gradient with respect to the variables, from those with respect to the parameters
    after each iteration.
    """

    def iterations(variables):
        values, hidden, after = start, jnp.zeros((len(start), Refiner.width)), []
        for signals in seen:
            values, hidden = refiner_iteration(
                variables, values, start, hidden, signals, graph, avatar
            )
            after.append(values)
        return after

    return jax.vjp(iterations, variables)[1](cotangents)[0]


def view_loss(
    values: Any, like: Any, avatar: Any, view: Any, perceptual: Any, splat: Any
) -> tuple[Any, Any]:
    """Returns the loss of one view, relative to the person's share of the image, and (mean squared
    error, LPIPS).

    `perceptual` is (weight, network) of LPIPS. None: LPIPS is left out, and is 0.
    """
    drawn = render(posed_gaussians(unstacked(values, like), avatar, view), view.camera, splat)
    terms = {
        "squared": jnp.square(drawn.rgb - view.image),
        "absolute": jnp.abs(drawn.rgb - view.image),
        "structural": structural_dissimilarity(drawn.rgb, view.image),
        "silhouette": jnp.abs(drawn.alpha - view.mask),
    }
    loss = sum(weight * jnp.mean(terms[name]) for name, weight in WEIGHTS.items())
    distance = jnp.zeros(())
    if perceptual is not None:
        distance = lpips(perceptual[1], jnp.clip(drawn.rgb, 0, 1), view.image)
        loss = loss + perceptual[0] * distance
    squared = jnp.mean(jnp.square(jnp.clip(drawn.rgb, 0, 1) - view.image))
    return 0.15 * loss / jnp.mean(view.mask), (squared, distance)


@functools.cache
def view_gradient() -> Any:
    """Returns the compiled function from the arguments of `view_loss` to its result and its
    gradient with respect to the parameters.
    """
    differentiated = jax.value_and_grad(view_loss, has_aux=True)
    return jax.jit(differentiated, static_argnames="splat", compiler_options=compiler_options())


def validate(
    variables: Any, folders: list[Path], iterations: int, perceptual: Any, splat: Any
) -> list[list[float]]:
    """Returns [PSNR, LPIPS] of views that are not among the photos, before the iterations and after
    each of them, as means over samples.
    """
    rows = []
    for folder in folders:
        sample = read_sample(folder)
        after, _ = run_iterations(variables, sample, PHOTOS, iterations, splat)

        def scored(values, sample=sample):
            found = [
                view_gradient()(values, sample.start, sample.avatar, view, perceptual, splat=splat)
                for view in sample.views[PHOTOS:]
            ]
            # the result of the loss has the errors as its second part
            errors = [result[1] for result, _ in found]
            return [
                (-10 * np.log10(float(squared)), float(distance)) for squared, distance in errors
            ]

        rows.append([np.mean(scored(values), axis=0) for values in (stacked(sample.start), *after)])
    return np.mean(rows, axis=0).round(4).tolist()


def step_gradient(
    variables: Any,
    folders: list[Path],
    iterations: int,
    perceptual: Any,
    splat: Any,
    seed: tuple[int, int],
) -> Any:
    """Returns the gradient of one sample, which the seed chooses.

    Each iteration is compared with another view, and the last one with two.
    """
    rng = np.random.default_rng(seed)
    sample = read_sample(folders[rng.integers(len(folders))])
    photos = int(rng.choice(COUNTS))
    after, seen = run_iterations(variables, sample, photos, iterations, splat)
    first = max(photos, PHOTOS)
    targets = list(first + rng.permutation(len(sample.views) - first))
    cotangents = []
    for i, values in enumerate(after):
        count = 2 if i == iterations - 1 else 1
        chosen = [sample.views[targets[(i + j) % len(targets)]] for j in range(count)]
        each = [
            view_gradient()(values, sample.start, sample.avatar, view, perceptual, splat=splat)[1]
            for view in chosen
        ]
        cotangents.append(ITERATION_WEIGHT ** (iterations - 1 - i) * sum(each) / count)
    return compiled(through_iterations)(
        variables, stacked(sample.start), seen, sample.graph, sample.avatar, cotangents
    )


def train(folders: list[Path], validation: list[Path], out: Path, options: Refining) -> None:
    """Trains from the first step or from OUT/state.msgpack, and writes OUT/refiner.safetensors."""
    sample = read_sample(folders[0])
    splat = planned([read_sample(folder) for folder in validation])
    variables = first_variables(sample, options.start)
    perceptual = (options.lpips, load_lpips("alex")) if options.lpips else None
    rate = optax.warmup_cosine_decay_schedule(
        0.0,
        options.learning_rate,
        min(50, options.steps // 2),
        options.steps,
        0.02 * options.learning_rate,
    )
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=1e-4))
    state: dict[str, Any] = {
        "variables": variables,
        "optimizer": optimizer.init(variables),
        "step": 0,
    }
    # an earlier run is continued
    path = out / "state.msgpack"
    if path.is_file():
        state = serialization.from_bytes(state, path.read_bytes())

    @jax.jit
    def updated(gradient, optimizer_state, variables):
        change, optimizer_state = optimizer.update(gradient, optimizer_state, variables)
        return optax.apply_updates(variables, change), optimizer_state

    bar = tqdm(initial=int(state["step"]), total=options.steps, desc="steps")
    with bar, ThreadPoolExecutor(options.batch) as threads:
        try:
            while int(state["step"]) < options.steps:
                step = int(state["step"])
                if step % VALIDATE_EVERY == 0:
                    scores = validate(
                        state["variables"], validation, options.iterations, perceptual, splat
                    )
                    bar.write(f"step {step}: {scores} PSNR, LPIPS before and after each iteration")
                # the gradients of a batch, a thread for each example
                one = functools.partial(
                    step_gradient,
                    state["variables"],
                    folders,
                    options.iterations,
                    perceptual,
                    splat,
                )
                gradients = list(threads.map(one, [(step, i) for i in range(options.batch)]))
                gradient = jax.tree.map(lambda *x: sum(x) / len(x), *gradients)
                variables, opt_state = updated(gradient, state["optimizer"], state["variables"])
                state = {"variables": variables, "optimizer": opt_state, "step": step + 1}
                bar.update()
                if (step + 1) % SAVE_EVERY == 0:
                    write_bytes(path, serialization.to_bytes(jax.device_get(state)))
        except KeyboardInterrupt:
            bar.write("interrupted: the same command goes on")
    write_bytes(path, serialization.to_bytes(jax.device_get(state)))
    if int(state["step"]) == options.steps:
        scores = validate(state["variables"], validation, options.iterations, perceptual, splat)
        print(f"step {options.steps}: {scores} PSNR, LPIPS before and after each iteration")
        save_refiner(out / "refiner.safetensors", state["variables"])


def first_variables(sample: Sample, start: str | None) -> Any:
    """Returns the variables that training starts from, see `Refining.start`.

    Raises: ValueError if the weights to start from are of another network.
    """
    values = stacked(sample.start)
    none, hidden = jnp.zeros((1, len(values))), jnp.zeros((len(values), Refiner.width))
    nothing = Signals(jnp.zeros((1, *values.shape)), none, none)
    variables = Refiner().init(
        jax.random.key(0), values, values, hidden, nothing, sample.graph, jnp.zeros(3)
    )
    if not start:
        return variables

    # weights to start from may have fewer layers than a `Refiner` has now
    loaded = load_refiner() if start == "shipped" else read_refiner(start)
    given = loaded["params"]
    new = variables["params"]
    for layer, own in given.items():
        if layer not in new or jax.tree.map(jnp.shape, new[layer]) != jax.tree.map(jnp.shape, own):
            raise ValueError(f"{start}: expected weights of a `Refiner`")
    return {"params": new | given}


def planned(samples: list[Sample]) -> Any:
    """Returns the configuration of splatting with room for every view of these samples."""
    like = SPLAT_PRESETS[samples[0].avatar.rendering]
    plans = [
        plan_buffers(posed_gaussians(sample.start, sample.avatar, view), view.camera, like, MARGIN)
        for sample in samples
        for view in sample.views
    ]

    def most(name):
        return max(getattr(plan, name) for plan in plans)

    return dataclasses.replace(
        plans[0], max_pairs=most("max_pairs"), max_rows=most("max_rows"), visibility=True
    )
