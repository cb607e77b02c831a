"""People to evaluate on: who they are, their photos and held-out views, the network, and what their
rows depend on.

Photos are from a ring of `RING` cameras of the published protocol, evenly spaced but for the
generator's jitter, number 0 the most frontal one. N photos are every (RING / N)-th camera, so each
person is rendered once for all numbers of photos. Held-out cameras and novel poses are those of
`humangs_jax.synthetic.writer.write_person` for the same seed; images have 8 bits as on disk.

A row of scores is {"novel": scores, "animation": scores}: held-out views in the pose of the photos,
and in poses that no photo shows; means over views, under the protocol "humangs".
"""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.evaluation.means import mean_scores
from humangs_jax.evaluation.scores import PROTOCOLS, score_views
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.quaternion import matrix_from_axis_angle
from humangs_jax.io.images import to_uint8
from humangs_jax.losses.loss_networks import installed_lpips, load_lpips
from humangs_jax.losses.perceptual import Lpips
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.weights import SHIPPED, load_weights
from humangs_jax.synthetic.subject import GENERATOR_VERSION, PosedSubject, make_subject, seeds_of
from humangs_jax.synthetic.surroundings import cameras_around, spread_azimuths
from humangs_jax.synthetic.writer import Stream, View, capture_views, sample_pose

RING = 12
"""Cameras that photos are taken from; numbers of photos divide it."""
TASKS = {"novel": "novel views", "animation": "novel poses"}
Scores = dict[str, float | None]


@dataclasses.dataclass(frozen=True)
class People:
    """Options:
    subjects: how many people
    held_out: views to compare with, in the pose of the photos
    poses: novel poses
    pose_views: views to compare with, of each novel pose
    size: side of the photos in pixels
    first: index of the first person within the split
    split: seeds of the people; choices are made on "validation"
    weights: weights file; the shipped ones if not given
    lpips_net: network under LPIPS, of the extra `lpips`
    """

    subjects: int = 8
    held_out: int = 8
    poses: int = 2
    pose_views: int = 4
    size: int = 256
    first: int = 0
    split: Literal["test", "validation"] = "test"
    weights: Path | None = None
    lpips_net: Literal["vgg", "alex"] = "alex"

    def start(self) -> "Start":
        """Reads what is needed. Raises: ValueError that names the option that is out of range."""
        if (
            min(self.subjects, self.held_out, self.pose_views) < 1
            or min(self.first, self.poses) < 0
        ):
            raise ValueError(
                "--subjects, --held-out and --pose-views must be at least 1, --first and --poses at"
                " least 0"
            )
        backbone = installed_lpips().get(self.lpips_net)
        lpips = load_lpips(self.lpips_net) if backbone else None
        body, (variables, config) = load_body(), load_weights(self.weights)
        seeds = list(seeds_of(self.split, self.first, self.subjects))
        settings = {
            "weights": file_digest(self.weights) if self.weights else shipped_digest(SHIPPED),
            "tokens": config.tokens,
            "split": self.split,
            "image_size": self.size,
            "held_out": self.held_out,
            "poses": self.poses,
            "pose_views": self.pose_views,
            "ring": RING,
            "generator": GENERATOR_VERSION,
            "lpips_net": self.lpips_net if lpips else None,
            "lpips_weights": file_digest(backbone) if backbone else None,
        }
        held_out = HeldOut(self.held_out, self.poses, self.pose_views)
        return Start(body, variables, config, seeds, held_out, self.size, lpips, settings)


class Start(NamedTuple):
    """What an evaluation begins with. settings: what the rows depend on."""

    body: BodyModel
    variables: Variables
    config: HumanGSConfig
    seeds: list[int]
    held_out: "HeldOut"
    size: int
    lpips: Lpips | None
    settings: dict[str, Any]

    def subject(
        self, seed: int, counts: Sequence[int], size: int | None = None
    ) -> "EvaluationSubject":
        """The person of a seed, with photos for these numbers of views: see
        `make_evaluation_subject`.
        """
        return make_evaluation_subject(seed, self.body, counts, size or self.size, self.held_out)

    def rows(
        self,
        run: Run,
        measure: Callable[[int], Any],
        settings: Mapping[str, Any] | None = None,
        again: bool = False,
    ) -> list[Any]:
        """What `measure` gives of the seed of each person, see `Run.rows`."""
        cases = {str(seed): functools.partial(measure, seed) for seed in self.seeds}
        return list(run.rows(cases, self.settings | dict(settings or {}), again).values())

    def about(self) -> str:
        s = self.settings
        return (
            f"{len(self.seeds)} people of the {s['split']} seeds, {self.size} x {self.size} pixels,"
            f" white; {s['held_out']} held-out views in the pose of the photos, {s['poses']} x"
            f" {s['pose_views']} in novel poses; weights {s['weights'][:12]}, tokens: {s['tokens']}"
            + (f"; LPIPS {s['lpips_net']}." if s["lpips_net"] else ".")
        )


def shipped_person(max_edge_length: float | None = None) -> Avatar:
    """The person of the demo from four photos, feed-forward."""
    variables, config = load_weights()
    return reconstruct(
        variables, config.with_runtime(max_edge_length=max_edge_length), load_capture(DEMO_CAPTURE)
    )


def shipped_digest(asset: str) -> str:
    with resources.as_file(resources.files("humangs_jax").joinpath(asset)) as path:
        return file_digest(path)


def file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """What a reconstruction is compared with: `views` of the pose of the photos, `pose_views` of
    each of `poses` others.
    """

    views: int = 8
    poses: int = 2
    pose_views: int = 4


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluationSubject:
    """A person. photos: of pose 0, by position on the ring. held_out: frame 0 is that pose, frames
    1, ... are others.
    """

    seed: int
    photos: Capture
    positions: tuple[int, ...]
    held_out: Capture

    def inputs(self, count: int) -> Capture:
        """Evenly spaced photos of the ring, the frontal one first.

        Raises ValueError if they were not rendered.
        """
        wanted = ring_positions(count)
        if missing := set(wanted) - set(self.positions):
            raise ValueError(
                f"{count} photos need ring positions {sorted(missing)}, which the capture lacks"
            )
        return self.photos.select([self.positions.index(position) for position in wanted])

    def with_body(self, body: BodyModel) -> "EvaluationSubject":
        """The same images with the parameters of another body, which has the same directions of
        shape; the poses go to its joints by name, and joints that have none of that name rest.
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
    """Which cameras of the ring take `count` photos.

    Raises ValueError unless the count divides `RING`.
    """
    if count < 1 or RING % count:
        raise ValueError(f"{count} photos are not evenly spaced among {RING} cameras")
    return tuple(range(0, RING, RING // count))


def make_evaluation_subject(
    seed: int,
    body: BodyModel,
    counts: Sequence[int],
    image_size: int = 256,
    held_out: HeldOut | None = None,
) -> EvaluationSubject:
    """The person of a seed, rendered from every camera that one of the numbers of photos asks
    for.
    """
    held_out = held_out or HeldOut()
    subject = make_subject(seed, body)
    posed = [sample_pose(subject, i) for i in range(1 + held_out.poses)]
    rng = np.random.default_rng([seed, Stream.CAMERAS])
    ring = cameras_around(rng, posed[0].vertices, spread_azimuths(rng, RING), image_size)
    frontal = frontal_camera(posed[0], ring)
    positions = tuple(sorted({position for count in counts for position in ring_positions(count)}))
    photos = [View(0, f"photo_{i:02d}", ring[(frontal + i) % RING]) for i in positions]

    rng = np.random.default_rng([seed, Stream.HELD_OUT_CAMERAS])
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
    rounded = {
        name: to_uint8(getattr(capture, name)).astype(np.float32) / 255
        for name in ("images", "masks")
    }
    return dataclasses.replace(capture, **rounded)


def task_views(held_out: Capture) -> dict[str, np.ndarray]:
    """Indices of the held-out views by task: those in the pose of the photos, which is frame 0, and
    the others.
    """
    still = np.asarray(held_out.frames) == 0
    return dict(zip(TASKS, (np.flatnonzero(still), np.flatnonzero(~still)), strict=True))


def score_tasks(
    drawn: np.ndarray,
    held_out: Capture,
    lpips: Lpips | None = None,
    alpha: np.ndarray | None = None,
) -> dict[str, Scores]:
    """Mean scores of drawn held-out views (v, h, w, 3) by task, under the protocol "humangs"; tasks
    without views are left out.

    alpha: their coverage (v, h, w), for semi-transparent foreground and silhouettes.
    """
    net = "vgg" if lpips is None else lpips.net
    protocol = dataclasses.replace(PROTOCOLS["humangs"], lpips=(net,))
    rows = list(
        score_views(drawn, held_out, protocol, alpha, {} if lpips is None else {net: lpips})
    )
    means = {
        task: mean_scores(rows[i] for i in views)
        for task, views in task_views(held_out).items()
        if len(views)
    }
    return {task: scores | {"lpips": scores.pop(f"lpips_{net}")} for task, scores in means.items()}
