"""A person to evaluate on: photos from a ring of cameras, and held-out views of the same pose and of others.

The ring has `RING` cameras of the published protocol around the person, evenly spaced but for the generator's jitter, number 0
the most frontal one. N photos are every (RING / N)-th camera of the ring, so each person is rendered once for all numbers of
photos. Held-out cameras and unseen poses are those of `humangs_jax.people.writer.write_subject` for the same seed, and images
have 8 bits as they would have on disk.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaluation.results import TASKS, Scores
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.evaluate import draw_painted_body, painted_body, score
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.io.images import to_uint8
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.objectives.lpips import Lpips
from humangs_jax.people.cameras import cameras_around, spread_azimuths
from humangs_jax.people.rendering import PosedSubject
from humangs_jax.people.subject import make_subject
from humangs_jax.people.writer import CAMERA_STREAM, HELD_OUT_STREAM, View, capture_views, sample_pose

RING = 12
"""Cameras that photos are taken from; numbers of photos divide it."""


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """What a reconstruction is compared with: `views` of the pose of the photos, `pose_views` of each of `poses` others."""

    views: int = 8
    poses: int = 2
    pose_views: int = 4


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluationSubject:
    """A person. photos: of pose 0, by position on the ring. held_out: frame 0 is that pose, frames 1, ... are others."""

    seed: int
    photos: Capture
    positions: tuple[int, ...]
    held_out: Capture

    def inputs(self, count: int) -> Capture:
        """Evenly spaced photos of the ring, the frontal one first. Raises ValueError if they were not rendered."""
        wanted = ring_positions(count)
        if missing := set(wanted) - set(self.positions):
            raise ValueError(f"{count} photos need ring positions {sorted(missing)}, which the capture lacks")
        return self.photos.select([self.positions.index(position) for position in wanted])

    def with_body(self, body: BodyModel) -> "EvaluationSubject":
        """The same images with the parameters of another body, which has the same directions of shape; the poses go to its
        joints by name, and joints that have none of that name rest.
        """
        captures = {name: with_body(getattr(self, name), body) for name in ("photos", "held_out")}
        return dataclasses.replace(self, **captures)


def with_body(capture: Capture, body: BodyModel) -> Capture:
    """A capture with another body, its poses carried over by the names of the joints."""
    names = capture.body.joint_names
    rotations = np.asarray(capture.poses.rotations)
    carried = np.zeros((len(rotations), len(body.joint_names), 3), rotations.dtype)
    for joint, name in enumerate(body.joint_names):
        if name in names:
            carried[:, joint] = rotations[:, names.index(name)]
    poses = jax.vmap(BodyPose)(jnp.asarray(carried), capture.poses.translation)
    return dataclasses.replace(capture, body=body, poses=poses)


def ring_positions(count: int) -> tuple[int, ...]:
    """Which cameras of the ring take `count` photos. Raises ValueError unless the count divides `RING`."""
    if count < 1 or RING % count:
        raise ValueError(f"{count} photos are not evenly spaced among {RING} cameras")
    return tuple(range(0, RING, RING // count))


def make_evaluation_subject(
    seed: int, body: BodyModel, counts: Sequence[int], image_size: int = 256, held_out: HeldOut | None = None
) -> EvaluationSubject:
    """The person of a seed, rendered from every camera that one of the numbers of photos asks for."""
    held_out = held_out or HeldOut()
    subject = make_subject(seed, body)
    posed = [sample_pose(subject, i) for i in range(1 + held_out.poses)]
    rng = np.random.default_rng([seed, CAMERA_STREAM])
    ring = cameras_around(rng, posed[0].vertices, spread_azimuths(rng, RING), image_size)
    frontal = frontal_camera(posed[0], ring)
    positions = tuple(sorted({position for count in counts for position in ring_positions(count)}))
    photos = [View(0, f"photo_{i:02d}", ring[(frontal + i) % RING]) for i in positions]

    rng = np.random.default_rng([seed, HELD_OUT_STREAM])
    others = []
    for frame, pose in enumerate(posed):
        count = held_out.pose_views if frame else held_out.views
        cameras = cameras_around(rng, pose.vertices, spread_azimuths(rng, count), image_size)
        others += [View(frame, f"{frame}_{i:02d}", cameras[i]) for i in range(count)]
    return EvaluationSubject(
        seed,
        photos=_as_stored(capture_views(subject, body, posed[:1], photos)),
        positions=positions,
        held_out=_as_stored(capture_views(subject, body, posed, others)),
    )


def frontal_camera(posed: PosedSubject, cameras: Camera) -> int:
    """Index of the camera that looks the person in the face, as seen from above."""
    facing = np.asarray(matrix_from_axis_angle(jnp.asarray(posed.rotations[0])))[:, 2]
    middle = 0.5 * (posed.vertices.min(0) + posed.vertices.max(0))
    towards = np.asarray([cameras[i].center for i in range(RING)]) - middle
    towards, facing = towards[:, [0, 2]], facing[[0, 2]]
    return int(np.argmax(towards @ facing / np.linalg.norm(towards, axis=1)))


def _as_stored(capture):
    """The capture with images and masks of 8 bits."""
    rounded = {name: to_uint8(getattr(capture, name)).astype(np.float32) / 255 for name in ("images", "masks")}
    return dataclasses.replace(capture, **rounded)


MeanLpips = Callable[[np.ndarray, np.ndarray], float | None]
"""Of images (v, h, w, 3) against true ones; None where LPIPS has no weights."""


@dataclasses.dataclass(frozen=True, eq=False)
class Drawn:
    """The held-out views of a person as drawn: ours (v, h, w, 3) and the painted body (v, h, w, 3), in [0, 1]."""

    ours: np.ndarray
    painted: np.ndarray


def draw_person(variables: Variables, config: HumanGSConfig, subject: EvaluationSubject, count: int) -> Drawn:
    """Reconstruct from that number of photos, and paint the body with the same ones."""
    inputs = subject.inputs(count)
    avatar = reconstruct(variables, config, inputs)
    return Drawn(draw_avatar(avatar, subject.held_out), draw_painted_body(painted_body(inputs), subject.held_out))


def draw_avatar(avatar: Avatar, views: Capture) -> np.ndarray:
    """An avatar in the poses and from the cameras of a capture, (v, h, w, 3) in [0, 1]."""
    return np.stack([np.clip(np.asarray(r.rgb), 0, 1) for r in capture_renderings(avatar, views)[1]])


def task_views(held_out: Capture) -> dict[str, np.ndarray]:
    """Indices of the held-out views by task: those in the pose of the photos, which is frame 0, and the others."""
    still = np.asarray(held_out.frames) == 0
    return dict(zip(TASKS, (np.flatnonzero(still), np.flatnonzero(~still)), strict=True))


def score_tasks(pictures: np.ndarray, held_out: Capture, lpips_of: MeanLpips) -> dict[str, Scores]:
    """Scores of one set of drawn held-out views, by task; tasks without views are left out."""
    scores = {}
    for task, views in task_views(held_out).items():
        if len(views):
            truth = held_out.select(views)
            lpips = lpips_of(pictures[views], truth.images)
            scores[task] = {**dataclasses.asdict(score(pictures[views], truth)), "lpips": lpips}
    return scores


def score_person(drawn: Drawn, held_out: Capture, lpips_of: MeanLpips) -> dict[str, Scores]:
    """Scores by task, those of the painted body beside ours under names with the prefix "baseline_"."""
    ours, painted = (score_tasks(x, held_out, lpips_of) for x in (drawn.ours, drawn.painted))
    compared = ("psnr", "ssim", "psnr_foreground", "lpips")
    return {task: ours[task] | {f"baseline_{name}": painted[task][name] for name in compared} for task in ours}


def lpips_scorer(weights: Lpips | None) -> MeanLpips:
    """The mean LPIPS of images (v, h, w, 3), clipped to [0, 1], against true ones; None for any without weights."""
    if weights is None:
        return lambda predicted, truth: None
    import jax

    from humangs_jax.objectives.lpips import lpips

    distance = jax.jit(lpips)

    def mean(predicted, truth):
        pairs = zip(np.clip(np.asarray(predicted), 0, 1), np.asarray(truth), strict=True)
        return float(np.mean([distance(weights, *pair) for pair in pairs]))

    return mean
