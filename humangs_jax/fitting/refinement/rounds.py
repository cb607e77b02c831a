"""Rounds of refinement, like those of iterated closest points: draw the body, see which point of its outline belongs to which
line of the mask's, move cameras, shape and poses a few steps of damped least squares, look again, and look less far.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.landmarks import landmark_model
from humangs_jax.body.skinning import EXACT
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.observations import Observations, expected_noise
from humangs_jax.fitting.refinement.equations import Evidence, solve, surface_points
from humangs_jax.fitting.refinement.outlines import BodyPicture, body_outline, body_picture, mask_outline, mesh_edges
from humangs_jax.fitting.refinement.score import Score, keypoint_distances, overlap, posed_vertices, score_of
from humangs_jax.fitting.refinement.silhouettes import MaskView, distances, match
from humangs_jax.fitting.refinement.unknowns import (
    Spreads,
    Start,
    Unknowns,
    body_poses,
    moved_cameras,
    moved_shape,
    nothing_moved,
    same_cameras,
    same_focals,
    segments,
)
from humangs_jax.fitting.solvers import Outcome
from humangs_jax.geometry.camera import Camera

DEVIATION = 1.4826
"""Standard deviations of a normal distribution in its median absolute deviation."""
LEAST_NOISE = 0.7
"""Pixels: outlines of masks are no better."""


@dataclasses.dataclass(frozen=True)
class RoundConfig:
    """Static settings of the rounds.

    spreads: how far off the start is expected to be. shared_focal: focal lengths that start equal stay equal. coefficients:
    of the shape, where the capture has fewer. rounds: how often correspondences are looked for, steps: of the solver in each.
    points: of an outline. independent: equations that all points of a view count for, since neighbours err together. reach:
    how far points look in the first and in the last round, shares of the person's height in the picture. cuts: multiples of
    the reach at which the loss flattens, outwards and inwards of the mask. longest_side: larger photographs are shrunk to so
    many pixels.
    """

    spreads: Spreads = dataclasses.field(default_factory=Spreads)
    shared_focal: bool = True
    coefficients: int = 10
    rounds: int = 10
    steps: int = 4
    points: int = 300
    independent: float = 30.0
    reach: tuple[float, float] = (0.08, 0.015)
    cuts: tuple[float, float] = (1.0, 0.5)
    longest_side: int = 512


class Scene:
    """What stays the same over the rounds: masks at the size that is looked at, and the start. Empty masks show nothing."""

    def __init__(self, capture: Capture, keypoints: Keypoints | None, config: RoundConfig) -> None:
        self.capture, self.keypoints, self.config = capture, keypoints, config
        self.cameras, self.masks = _shrunk(capture, config.longest_side)
        self.faces = np.asarray(capture.body.faces)
        self.edges = mesh_edges(self.faces)
        self.views = [MaskView(mask, mask_outline(mask, config.points)) for mask in self.masks]
        self.model = None if keypoints is None else landmark_model(capture.body, keypoints.set.names)
        self.observations = None if keypoints is None else _observations(self.cameras, capture, keypoints)
        self.height = _person_height(self.masks, self.observations)
        self.start = start_of(capture, self.cameras, config)

    def run(self) -> tuple[Unknowns, Outcome, float]:
        """The unknowns after all rounds, what the solver did in each (a batch), and the largest move of the last round, in
        expected standard deviations.
        """
        config, unknowns, outcomes, move = self.config, nothing_moved(self.start), [], 0.0
        first, last = config.reach
        for turn in range(config.rounds):
            evidence = self.look(unknowns, self.height * first * (last / first) ** (turn / max(config.rounds - 1, 1)))
            before = unknowns
            unknowns, outcome = solve(
                self.model, self.start, evidence, unknowns, config.spreads, config.independent, config.steps
            )
            outcomes.append(outcome)
            move = _largest_move(unknowns, before)
        return unknowns, jax.tree.map(lambda *leaves: jnp.stack(leaves), *outcomes), move

    def look(self, unknowns: Unknowns, reach: float) -> Evidence:
        """What the views show, with what belongs together within `reach` pixels of the body as it is now."""
        count = self.config.points
        outlines = [
            body_outline(picture, self.faces, self.edges, count) for picture in self.pictures(self.moved(unknowns))
        ]
        matches = [match(outline, view, reach, count) for outline, view in zip(outlines, self.views, strict=True)]
        return Evidence(
            points=surface_points(self.capture.body, outlines, count, len(self.start.betas)),
            matches=jax.tree.map(lambda *leaves: jnp.stack(leaves), *matches),
            noise=jnp.asarray(_noise(outlines, matches), jnp.float32),
            cuts=reach * jnp.asarray(self.config.cuts, jnp.float32),
            keypoints=self.observations,
        )

    def pictures(self, capture: Capture) -> list[BodyPicture]:
        """The body in every view, as a capture of these photographs has it."""
        cameras = capture.cameras.resized(self.cameras.width, self.cameras.height)
        vertices = posed_vertices(capture.body, jnp.asarray(capture.betas), capture.poses)
        faces = capture.body.faces
        return [body_picture(vertices[int(frame)], faces, cameras[i]) for i, frame in enumerate(capture.frames)]

    def score(self, capture: Capture) -> Score:
        """How well the body agrees with masks and keypoints, as a capture of these photographs has it."""
        pairs = zip(self.pictures(capture), self.masks, strict=True)
        ious = np.asarray([overlap(picture.covered, mask) for picture, mask in pairs])
        errors = None
        if self.model is not None and self.keypoints is not None:
            errors = keypoint_distances(capture, self.model, self.keypoints)
        return score_of(ious, errors, self.height * capture.cameras.width / self.cameras.width)

    def moved(self, unknowns: Unknowns) -> Capture:
        """The capture with cameras, shape and poses moved."""
        return moved_capture(self.capture, self.start, self.config.spreads, unknowns)


def start_of(capture: Capture, cameras: Camera, config: RoundConfig) -> Start:
    """Where refinement of a capture starts. cameras: those of the views, of pictures of any size."""
    body = capture.body
    named = [j for j, name in enumerate(body.joint_names) if name in BODY_NAMES]
    joints = np.asarray([j for j in named or range(len(body.parents)) if body.parents[j] >= 0], np.int32)
    available = body.shape_directions.shape[-1]
    wanted = max(len(capture.betas), min(config.coefficients, available))
    directions = body.shape_directions[..., :wanted]
    camera = same_cameras(cameras)
    return Start(
        K=cameras.K,
        cam_from_world=cameras.cam_from_world,
        camera=jnp.asarray(camera),
        focal=jnp.asarray(same_focals(cameras, camera, config.shared_focal)),
        frame=jnp.asarray(capture.frames),
        betas=jnp.pad(jnp.asarray(capture.betas, jnp.float32), (0, wanted - len(capture.betas))),
        poses=capture.poses,
        joints=jnp.asarray(joints),
        rest_joints=jnp.matmul(body.joint_regressor, body.template, precision=EXACT),
        joint_directions=jnp.einsum("jn,nas->jas", body.joint_regressor, directions, precision=EXACT),
        segment=jnp.asarray(segments(body.parents, joints)),
        parents=body.parents,
    )


def moved_capture(capture: Capture, start: Start, spreads: Spreads, unknowns: Unknowns) -> Capture:
    """A capture with cameras, shape and poses moved from their `start`, whatever the size of the pictures there."""
    cameras, betas, poses = _moved(replace(start, K=capture.cameras.K), spreads, unknowns)
    K, cam_from_world = cameras
    return dataclasses.replace(
        capture,
        cameras=replace(capture.cameras, K=K, cam_from_world=cam_from_world),
        betas=np.asarray(betas),
        poses=poses,
    )


@functools.partial(jax.jit, static_argnames="spreads")
def _moved(start, spreads, unknowns):
    return (
        moved_cameras(start, spreads, unknowns),
        moved_shape(start, spreads, unknowns),
        body_poses(start, spreads, unknowns),
    )


def _noise(outlines, matches):
    """How far bodies are off their masks, pixels: clothes make masks less sure, and so does a body that is not yet there."""
    off = [
        np.asarray(distances(m, jnp.asarray(outline.positions, jnp.float32)))[np.asarray(m.weights) > 0]
        for outline, m in zip(outlines, matches, strict=True)
        if len(outline.positions)
    ]
    off = np.concatenate([np.zeros(0), *off])
    return max(DEVIATION * float(np.median(np.abs(off))), LEAST_NOISE) if len(off) else 1.0


def _largest_move(unknowns, before):
    moves = jax.tree.map(lambda a, b: float(jnp.max(jnp.abs(a - b), initial=0.0)), unknowns, before)
    return max(jax.tree.leaves(moves))


def _shrunk(capture, longest):
    """Cameras and masks with the longest side of at most so many pixels; masks of nothing where the capture has none."""
    height, width = capture.images.shape[1:3]
    masks = np.zeros((capture.view_count, height, width), np.float32) if capture.masks is None else capture.masks
    share = longest / max(height, width)
    if share >= 1:
        return capture.cameras, masks
    from PIL import Image

    size = (max(1, round(width * share)), max(1, round(height * share)))
    shrink = lambda mask: np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX))
    return capture.cameras.resized(*size), np.stack([shrink(mask) for mask in masks])


def _person_height(masks, observations):
    """Of the person in the picture, pixels: median over the views of what masks, or keypoints, extend over."""
    sizes = [max(np.ptp(x) for x in np.nonzero(mask > 0.5)) for mask in masks if (mask > 0.5).any()]
    if not sizes and observations is not None:
        pairs = zip(np.asarray(observations.points)[:, 0], np.asarray(observations.confidences)[:, 0] > 0, strict=True)
        sizes = [np.ptp(points[seen], axis=0).max() for points, seen in pairs if seen.any()]
    return float(np.median(sizes)) if sizes else float("nan")


def _observations(cameras, capture, keypoints):
    """Keypoints at the size that is looked at, a batch of views."""
    scale, seen = cameras.width / capture.cameras.width, keypoints.confidences > 0
    points = np.where(seen[..., None], keypoints.points, 0.0) * scale
    noise = expected_noise(points[None], keypoints.confidences[None])
    return jax.vmap(Observations)(
        jnp.asarray(points, jnp.float32)[:, None],
        jnp.asarray(keypoints.confidences, jnp.float32)[:, None],
        cameras.K[:, None],
        cameras.cam_from_world[:, None],
        jnp.broadcast_to(jnp.asarray(noise, jnp.float32), (len(points),)),
    )
