"""Changes of a capture (other photos, masks, cameras, poses, bodies), and what `reconstruct` makes of it then.

A `Change` takes a capture and gives another; `robustness.py` lists them by name.
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
from humangs_jax.evaluation.cases import draw_views
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.io.images import resized
from humangs_jax.people.subject import make_subject, seeds_of
from humangs_jax.people.writer import View, capture_views, sample_pose

SEED_INDEX, SIZE, VIEWS = 1, 256, 4
"""The first person of the validation seeds that is taken, pixels, photos."""
Change = Callable[[Any], Any]


def subjects(count: int) -> list[Any]:
    """People of the validation seeds, with held-out views of the pose of the photos."""
    body, seeds = load_body(), seeds_of("validation", SEED_INDEX, count)
    return [make_evaluation_subject(seed, body, [VIEWS], SIZE, HeldOut(4, 0, 0)) for seed in seeds]


def photographed(seed: int, capture: Any) -> Any:
    """The capture of a synthetic person with new photos, from its cameras as they are now."""
    person = make_subject(seed, capture.body)
    views = [View(0, label, capture.cameras[i]) for i, label in enumerate(capture.names)]
    return capture_views(person, capture.body, [sample_pose(person, 0)], views)


def outcome(network, capture, held_out) -> dict[str, Any]:
    """What becomes of one capture: {"error"}, or {"warnings", "reach", "psnr", "psnr_fg"}.

    reach: largest distance of a Gaussian from its vertex, in body heights. Raises: AssertionError: a number is not finite.
    """
    try:
        avatar = reconstruct(*network, capture)
        drawn = draw_views(avatar, held_out)
    except ValueError as error:
        return {"error": str(error)}
    gaussians, rest = avatar.gaussians, np.asarray(avatar.rest_vertices)
    for field in ("means", "quats", "scales", "opacities", "colors"):
        assert np.isfinite(getattr(gaussians, field)).all(), field
    own = np.repeat(rest, len(gaussians.means) // len(rest), axis=0)
    height = np.ptp(rest[:, 1])
    reach = float(np.linalg.norm(np.asarray(gaussians.means) - own, axis=-1).max() / height)
    warnings = list(likely_mistakes(capture))
    assert np.isfinite(np.asarray(drawn.images)).all() and np.isfinite(np.asarray(drawn.alpha)).all()
    scores = score_tasks(drawn.images, held_out, alpha=drawn.alpha)["novel"]
    return {"warnings": warnings, "reach": reach} | {name: scores[name] for name in ("psnr", "psnr_fg")}


def photos(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Other colors on the person; white behind."""

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

        back = np.eye(4)
        back[2, 3] = meters - distance
        return cameras(focal(meters / distance), lambda m: back @ m)(capture)

    return moved


def zoom(factor: float) -> Change:
    """The person smaller or larger in the frame, cameras to match."""

    def changed(capture):

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

        images = np.stack([zoomed(image, 1.0) for image in capture.images])
        shapes = np.stack([zoomed(mask, 0.0) for mask in capture.masks])
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


def spoilt(name: str, value: float = np.nan) -> Change:
    """NaN, or another number, in one place of one array."""

    def changed(capture):
        owner, _, field = name.rpartition(".")
        target = getattr(capture, owner) if owner else capture
        array = np.array(getattr(target, field))
        array.reshape(-1)[0] = value
        target = dataclasses.replace(target, **{field: array})
        return dataclasses.replace(capture, **{owner: target}) if owner else target

    return changed


def random_turns(rotations: np.ndarray) -> np.ndarray:
    """Every joint turned at random, up to half a turn."""
    axes = np.random.default_rng(0).normal(size=rotations.shape)
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    return axes * np.random.default_rng(1).uniform(0, np.pi, (*rotations.shape[:-1], 1))


def noise(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    """Normal numbers, the same for every strength."""
    return np.random.default_rng(seed).normal(size=shape)


def turned_by(degrees: float) -> Change:
    """Every camera turned about an axis of its own."""

    def changed(capture):
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

        change = ndimage.grey_dilation if pixels > 0 else ndimage.grey_erosion
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
