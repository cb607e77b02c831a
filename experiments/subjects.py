"""Makes the people to evaluate on, with their photos and held-out views, loads the network, and
scores drawn views.

Photos are from a ring of `RING` cameras of the published protocol. They are evenly spaced except
for the generator's jitter, and number 0 is the most frontal one. N photos are every (RING / N)-th
camera, so that each person is rendered once for all numbers of photos. Held-out cameras and novel
poses are those of `humangs_jax.synthetic.writer.write_person` for the same seed. Images have 8 bits
as on disk.

A row of scores is {"novel": scores, "animation": scores}, for held-out views in the pose of the
photos and in poses that no photo shows. Scores are means over views, under the protocol "humangs".
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
"""Number of cameras that photos are taken from. Numbers of photos divide it."""
TASKS = {"novel": "novel views", "animation": "novel poses"}
"""{task: its name in tables}."""
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
        """Loads the body, the network and LPIPS, and chooses the seeds.

        Raises: ValueError if an option is out of range.
        """
        too_few = min(self.subjects, self.held_out, self.pose_views) < 1
        if too_few or min(self.first, self.poses) < 0:
            raise ValueError(
                "--subjects, --held-out and --pose-views must be at least 1, --first and --poses at"
                " least 0"
            )
        # LPIPS is left out where its weights are not installed
        backbone = installed_lpips().get(self.lpips_net)
        lpips, lpips_net, lpips_weights = None, None, None
        if backbone:
            lpips = load_lpips(self.lpips_net)
            lpips_net, lpips_weights = self.lpips_net, file_digest(backbone)
        weights = file_digest(self.weights) if self.weights else shipped_digest(SHIPPED)
        body, (variables, config) = load_body(), load_weights(self.weights)
        seeds = list(seeds_of(self.split, self.first, self.subjects))
        settings = {
            "weights": weights,
            "tokens": config.tokens,
            "split": self.split,
            "image_size": self.size,
            "held_out": self.held_out,
            "poses": self.poses,
            "pose_views": self.pose_views,
            "ring": RING,
            "generator": GENERATOR_VERSION,
            "lpips_net": lpips_net,
            "lpips_weights": lpips_weights,
        }
        held_out = HeldOut(self.held_out, self.poses, self.pose_views)
        return Start(body, variables, config, seeds, held_out, self.size, lpips, settings)


class Start(NamedTuple):
    """What an evaluation begins with."""

    body: BodyModel
    """The body of all people."""
    variables: Variables
    """Variables of the network."""
    config: HumanGSConfig
    """Configuration of the network."""
    seeds: list[int]
    """Seeds of the people."""
    held_out: "HeldOut"
    """Views and poses to compare with."""
    size: int
    """Side of the photos in pixels."""
    lpips: Lpips | None
    """Network of LPIPS, None if its weights are not installed."""
    settings: dict[str, Any]
    """What the rows depend on."""

    def subject(
        self, seed: int, counts: Sequence[int], size: int | None = None
    ) -> "EvaluationSubject":
        """Returns the person of a seed with photos for these numbers of views, see
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
        """Returns what `measure` returns for the seed of each person, see `Run.rows`."""
        cases = {str(seed): functools.partial(measure, seed) for seed in self.seeds}
        return list(run.rows(cases, self.settings | dict(settings or {}), again).values())

    def about(self) -> str:
        """Describes the people, the views and the network in a sentence."""
        s = self.settings
        text = (
            f"{len(self.seeds)} people of the {s['split']} seeds, {self.size} x {self.size} pixels,"
            f" white; {s['held_out']} held-out views in the pose of the photos, {s['poses']} x"
            f" {s['pose_views']} in novel poses; weights {s['weights'][:12]}, tokens: {s['tokens']}"
        )
        if s["lpips_net"]:
            text += f"; LPIPS {s['lpips_net']}"
        return f"{text}."


def shipped_person(max_edge_length: float | None = None) -> Avatar:
    """Returns the person of the demo from four photos, feed-forward.

    `max_edge_length` in metres splits the body further than the weights want, None: not further.
    """
    variables, config = load_weights()
    config = config.with_runtime(max_edge_length=max_edge_length)
    return reconstruct(variables, config, load_capture(DEMO_CAPTURE))


def shipped_digest(asset: str) -> str:
    """Returns the SHA-256 sum of a file that ships with the package."""
    with resources.as_file(resources.files("humangs_jax").joinpath(asset)) as path:
        return file_digest(path)


def file_digest(path: Path) -> str:
    """Returns the SHA-256 sum of a file as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """What a reconstruction is compared with."""

    views: int = 8
    """Number of views of the pose of the photos."""
    poses: int = 2
    """Number of other poses."""
    pose_views: int = 4
    """Number of views of each of the other poses."""


@dataclasses.dataclass(frozen=True, eq=False)
class EvaluationSubject:
    """A person with photos and held-out views."""

    seed: int
    """Seed of the person."""
    photos: Capture
    """Photos of pose 0."""
    positions: tuple[int, ...]
    """Position of each photo on the ring."""
    held_out: Capture
    """Held-out views. Frame 0 has the pose of the photos, frames 1, ... have other poses."""

    def inputs(self, count: int) -> Capture:
        """Returns `count` evenly spaced photos of the ring, the frontal one first.

        Raises: ValueError if they were not rendered.
        """
        wanted = ring_positions(count)
        missing = set(wanted) - set(self.positions)
        if missing:
            raise ValueError(
                f"{count} photos need ring positions {sorted(missing)}, which the capture lacks"
            )
        return self.photos.select([self.positions.index(position) for position in wanted])

    def with_body(self, body: BodyModel) -> "EvaluationSubject":
        """Returns the same images with the parameters of another body, see `with_body`.

        The other body must have the same directions of shape.
        """
        captures = {name: with_body(getattr(self, name), body) for name in ("photos", "held_out")}
        return dataclasses.replace(self, **captures)


def with_body(capture: Capture, body: BodyModel) -> Capture:
    """Returns a capture with another body, whose joints get the rotations of the joints of the same
    names. Joints with other names are not turned.
    """
    names = capture.body.joint_names
    rotations = np.asarray(capture.poses.rotations)
    carried = np.zeros((len(rotations), len(body.joint_names), 3), rotations.dtype)
    for joint, name in enumerate(body.joint_names):
        if name in names:
            carried[:, joint] = rotations[:, names.index(name)]
    poses = jax.vmap(BodyPose)(jnp.asarray(carried), capture.poses.translation)
    return dataclasses.replace(capture, body=body, poses=poses)


def ring_positions(count: int) -> tuple[int, ...]:
    """Returns the positions on the ring of `count` photos.

    Raises: ValueError unless the count divides `RING`.
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
    """Renders the person of a seed from every camera that one of the numbers of photos needs, and
    from held-out cameras.

    Args:
        seed: seed of the person
        body: body of the person
        counts: numbers of photos
        image_size: side of the images in pixels
        held_out: views to compare with; default: those of `HeldOut`
    """
    # photos of pose 0 by cameras on the ring
    held_out = held_out or HeldOut()
    subject = make_subject(seed, body)
    posed = [sample_pose(subject, i) for i in range(1 + held_out.poses)]
    rng = np.random.default_rng([seed, Stream.CAMERAS])
    ring = cameras_around(rng, posed[0].vertices, spread_azimuths(rng, RING), image_size)
    frontal = frontal_camera(posed[0], ring)
    positions = tuple(sorted({position for count in counts for position in ring_positions(count)}))
    photos = [View(0, f"photo_{i:02d}", ring[(frontal + i) % RING]) for i in positions]

    # held-out views of all poses by other cameras
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
    """Returns the index of the camera that is most nearly in front of the person, seen from
    above.
    """
    facing = np.asarray(matrix_from_axis_angle(jnp.asarray(posed.rotations[0])))[:, 2]
    middle = 0.5 * (posed.vertices.min(0) + posed.vertices.max(0))
    towards = np.asarray([cameras[i].center for i in range(RING)]) - middle
    towards, facing = towards[:, [0, 2]], facing[[0, 2]]
    return int(np.argmax(towards @ facing / np.linalg.norm(towards, axis=1)))


def _as_stored(capture):
    """Returns the capture with images and masks rounded to 8 bits."""
    rounded = {
        name: to_uint8(getattr(capture, name)).astype(np.float32) / 255
        for name in ("images", "masks")
    }
    return dataclasses.replace(capture, **rounded)


def task_views(held_out: Capture) -> dict[str, np.ndarray]:
    """Returns the indices of the held-out views of each task: those in the pose of the photos,
    which is frame 0, and the others.
    """
    still = np.asarray(held_out.frames) == 0
    return dict(zip(TASKS, (np.flatnonzero(still), np.flatnonzero(~still)), strict=True))


def score_tasks(
    drawn: np.ndarray,
    held_out: Capture,
    lpips: Lpips | None = None,
    alpha: np.ndarray | None = None,
) -> dict[str, Scores]:
    """Returns {task: mean scores} of drawn held-out views, under the protocol "humangs".

    Tasks without views are left out. LPIPS is None without its network.

    Args:
        drawn: (v, h, w, 3) drawn views
        held_out: the true views
        lpips: network of LPIPS
        alpha: (v, h, w) coverage, for semi-transparent foreground and silhouettes
    """
    net, networks = "vgg", {}
    if lpips is not None:
        net, networks = lpips.net, {lpips.net: lpips}
    protocol = dataclasses.replace(PROTOCOLS["humangs"], lpips=(net,))
    rows = list(score_views(drawn, held_out, protocol, alpha, networks))
    means = {
        task: mean_scores(rows[i] for i in views)
        for task, views in task_views(held_out).items()
        if len(views)
    }
    return {task: scores | {"lpips": scores.pop(f"lpips_{net}")} for task, scores in means.items()}
