"""Changes of a capture (other photos, masks, cameras, poses, bodies), and what `reconstruct` makes
of the changed capture.

A `Change` takes a capture and returns another. `robustness.py` lists the changes by name.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from experiments.subjects import HeldOut, make_evaluation_subject, score_tasks
from humangs_jax.apps.quick_check import likely_mistakes
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.io.images import resized
from humangs_jax.synthetic.subject import make_subject, seeds_of
from humangs_jax.synthetic.writer import View, capture_views, sample_pose

SEED_INDEX, SIZE, VIEWS = 1, 256, 4
"""Index of the first person within the validation seeds, side of the photos in pixels, and number
of photos.
"""
Change = Callable[[Any], Any]


def subjects(count: int) -> list[Any]:
    """Returns people of the validation seeds, with held-out views of the pose of the photos."""
    body, seeds = load_body(), seeds_of("validation", SEED_INDEX, count)
    return [make_evaluation_subject(seed, body, [VIEWS], SIZE, HeldOut(4, 0, 0)) for seed in seeds]


def photographed(seed: int, capture: Any) -> Any:
    """Returns the capture of a synthetic person with new photos, drawn from the capture's
    cameras.
    """
    person = make_subject(seed, capture.body)
    views = [View(0, label, capture.cameras[i]) for i, label in enumerate(capture.names)]
    return capture_views(person, capture.body, [sample_pose(person, 0)], views)


def outcome(network, capture, held_out) -> dict[str, Any]:
    """Reconstructs a capture and returns {"error"}, or {"warnings", "reach", "psnr", "psnr_fg"}.

    "reach" is the largest distance of a Gaussian from its vertex, in body heights. The PSNRs are
    of the held-out views, dB.

    Raises: AssertionError if a number of the avatar or of the drawn views is not finite.
    """
    try:
        avatar = reconstruct(*network, capture)
        drawn = predict_views(avatar, held_out)
    except ValueError as error:
        return {"error": str(error)}
    gaussians, rest = avatar.gaussians, np.asarray(avatar.rest_vertices)
    for field in ("means", "quats", "scales", "opacities", "colors"):
        assert np.isfinite(getattr(gaussians, field)).all(), field
    own = np.repeat(rest, len(gaussians.means) // len(rest), axis=0)
    height = np.ptp(rest[:, 1])
    reach = float(np.linalg.norm(np.asarray(gaussians.means) - own, axis=-1).max() / height)
    warnings = list(likely_mistakes(capture))
    assert np.isfinite(np.asarray(drawn.images)).all()
    assert np.isfinite(np.asarray(drawn.alpha)).all()
    scores = score_tasks(drawn.images, held_out, alpha=drawn.alpha)["novel"]
    return {"warnings": warnings, "reach": reach} | {
        name: scores[name] for name in ("psnr", "psnr_fg")
    }


def change(function: Callable[..., Any]) -> Callable[..., Change]:
    """Turns `function(capture, *how)` into a function that is called `function(*how)(capture)`."""
    return lambda *how, **named: lambda capture: function(capture, *how, **named)


@change
def photos(capture, changed: Callable[[np.ndarray], np.ndarray]):
    """Changes the colors of the person, on white."""
    masks = capture.masks[..., None]
    return dataclasses.replace(
        capture, images=masks * np.clip(changed(capture.images), 0, 1) + (1 - masks)
    )


@change
def masks(capture, changed: Callable[[np.ndarray], np.ndarray]):
    """Changes the masks, and makes the photos white where the new masks are 0."""
    found = changed(capture.masks)
    images = found[..., None] * capture.images + (1 - found[..., None])
    return dataclasses.replace(capture, masks=found, images=images)


@change
def cameras(capture, K: Callable = lambda K: K, matrix: Callable = lambda m: m):
    """Changes the cameras by functions of K (3, 3) and of the matrix camera from world (4, 4)."""
    old = capture.cameras
    intrinsics = np.stack([K(np.array(x)) for x in old.K]).astype(np.float32)
    extrinsics = np.stack([matrix(np.array(x)) for x in old.cam_from_world]).astype(np.float32)
    return dataclasses.replace(
        capture, cameras=dataclasses.replace(old, K=intrinsics, cam_from_world=extrinsics)
    )


def focal(factor: float) -> Callable:
    """Returns the function of K that multiplies the focal lengths by a factor."""
    return lambda K: K * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


@change
def far(capture, meters: float):
    """Moves the cameras back along their axes to this distance, with focal lengths that leave the
    person as large as before.
    """
    distance = float(np.mean([np.asarray(m)[2, 3] for m in capture.cameras.cam_from_world]))
    back = np.eye(4)
    back[2, 3] = meters - distance
    return cameras(focal(meters / distance), lambda m: back @ m)(capture)


@change
def zoom(capture, factor: float):
    """Makes the person smaller or larger in the frame, and changes the cameras to match."""
    side = capture.images.shape[1]
    inner, cut = max(1, round(side * min(factor, 1))), round(side / factor)

    def zoomed(image, empty):
        if factor >= 1:
            start = (side - cut) // 2
            return resized(image[start : start + cut, start : start + cut], side, side)
        small, start = np.full_like(image, empty), (side - inner) // 2
        small[start : start + inner, start : start + inner] = resized(image, inner, inner)
        return small

    images = np.stack([zoomed(image, 1.0) for image in capture.images])
    shapes = np.stack([zoomed(mask, 0.0) for mask in capture.masks])
    about = np.array(
        [[factor, 0, side / 2 * (1 - factor)], [0, factor, side / 2 * (1 - factor)], [0, 0, 1]]
    )
    return dataclasses.replace(cameras(lambda K: about @ K)(capture), images=images, masks=shapes)


@change
def poses(capture, changed: Callable[[np.ndarray], np.ndarray]):
    """Changes the rotations (frames, joints, 3) of the poses, as rotation vectors."""
    rotations = np.asarray(changed(np.array(capture.poses.rotations)), np.float32)
    return dataclasses.replace(
        capture, poses=dataclasses.replace(capture.poses, rotations=rotations)
    )


def _placed(place: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Returns the change that replaces the translation of each camera: (4, 4) -> (3,)."""
    return cameras(matrix=lambda m: np.block([[m[:3, :3], place(m)[:, None]], [m[3:]]]))


@change
def tall(capture, factor: float):
    """Scales the body and the world by a factor."""
    scaled = {
        name: getattr(capture.body, name) * factor for name in ("template", "shape_directions")
    }
    moved = dataclasses.replace(capture.poses, translation=capture.poses.translation * factor)
    away = _placed(lambda m: factor * m[:3, 3])(capture)
    return dataclasses.replace(away, body=dataclasses.replace(capture.body, **scaled), poses=moved)


def at_the_pelvis(capture):
    """Moves every camera inside of the body."""
    pelvis = np.asarray(capture.poses.translation[0]) + np.array([0, 0.9, 0])
    return _placed(lambda m: -m[:3, :3] @ pelvis)(capture)


def turned(m):
    """Returns the matrix (4, 4) of a camera that looks the other way."""
    return np.diag([-1.0, 1.0, -1.0, 1.0]) @ m


def without_weights(capture):
    """Sets all skinning weights of the body to 0."""
    body = dataclasses.replace(capture.body, skinning_weights=0 * capture.body.skinning_weights)
    return dataclasses.replace(capture, body=body)


@change
def betas(capture, value: float):
    """Sets all shape coefficients to the same value."""
    return dataclasses.replace(capture, betas=np.full_like(np.asarray(capture.betas), value))


@change
def spoilt(capture, name: str, value: float = np.nan):
    """Sets the first number of one array to NaN or another value.

    `name` is a field of the capture, or FIELD.FIELD of a part of it.
    """
    owner, _, field = name.rpartition(".")
    if owner:
        part = spoilt(field, value)(getattr(capture, owner))
        return dataclasses.replace(capture, **{owner: part})
    array = np.array(getattr(capture, field))
    array.reshape(-1)[0] = value
    return dataclasses.replace(capture, **{field: array})


def random_turns(rotations: np.ndarray) -> np.ndarray:
    """Returns random rotation vectors of the same shape, of up to half a turn."""
    axes = np.random.default_rng(0).normal(size=rotations.shape)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return axes * np.random.default_rng(1).uniform(0, np.pi, (*rotations.shape[:-1], 1))


def noise(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Returns normal random numbers, which are the same for every strength of a change."""
    return np.random.default_rng(seed).normal(size=shape)


@change
def turned_by(capture, degrees: float):
    """Turns every camera by an angle, each about another axis."""
    axes = noise(2, (capture.view_count, 3))
    axes *= np.radians(degrees) / np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = iter(np.asarray(matrix_from_axis_angle(jnp.asarray(axes))))
    return cameras(matrix=lambda m: np.concatenate([next(turns) @ m[:3], m[3:]]))(capture)


@change
def moved_by(capture, centimeters: float):
    """Moves the body of all poses in one direction."""
    step = noise(3, (3,))
    shift = centimeters / 100 * step / np.linalg.norm(step)
    translation = (np.asarray(capture.poses.translation) + shift).astype(np.float32)
    moved = dataclasses.replace(capture.poses, translation=translation)
    return dataclasses.replace(capture, poses=moved)


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Dilates a mask by this many pixels, or erodes it if they are negative."""
    if pixels == 0:
        return mask
    change = ndimage.grey_dilation if pixels > 0 else ndimage.grey_erosion
    side = 2 * abs(pixels) + 1
    return change(mask, (side, side))


@change
def masks_grown(capture, pixels: int):
    """Dilates the masks, or erodes them if `pixels` is negative.

    Background that a larger mask shows is grey.
    """
    found = np.stack([grown(mask, pixels) for mask in capture.masks])
    masks = capture.masks[..., None]
    inside = np.minimum(found[..., None], masks)
    true = (capture.images - (1 - masks)) / np.maximum(masks, 1e-6)
    around = (found[..., None] - inside) * 0.5
    images = np.clip(inside * true + around + (1 - found[..., None]), 0, 1).astype(np.float32)
    return dataclasses.replace(capture, images=images, masks=found)


@change
def person_of(capture, pixels: float):
    """Zooms so that the person's mean height in the photos is about this many pixels."""
    heights = [np.ptp(np.flatnonzero((mask > 0.5).any(axis=1))) + 1 for mask in capture.masks]
    return zoom(pixels / float(np.mean(heights)))(capture)
