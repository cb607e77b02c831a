"""Makes plain people, which small networks learn to reconstruct on two cores.

All people have clothes of one cut in plain dyes, one light and eight poses. Bodies, skin, dyes and
cameras differ. Each person is seen in two of the poses.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.core.progress import bar
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import save_capture
from humangs_jax.data.loading import CaptureSource, Example, PeopleCache
from humangs_jax.data.loading.captures import CaptureFolder, find_captures
from humangs_jax.data.loading.examples import StoredSubject
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.atomic import replace_folder
from humangs_jax.synthetic.fabrics import Fabric, random_color
from humangs_jax.synthetic.outfits import Garment
from humangs_jax.synthetic.poses import sample_rotations
from humangs_jax.synthetic.subject import Person, PosedSubject, describe, make_subject, seeds_of
from humangs_jax.synthetic.surroundings import cameras_around, sample_lights, spread_azimuths
from humangs_jax.synthetic.writer import HELD_OUT, View, capture_views, stand
from humangs_jax.training.sources import SourceFactory

SIZE, POSES = 32, 8
"""Side of the photos in pixels, and number of poses, which all people share."""
CLOTHES_STREAM, POSE_STREAM, CAMERA_STREAM, COLOR_STREAM = 30, 31, 32, 33
"""Random streams of a seed."""
LIGHT_SEED = 5
"""Seed of the light."""
NEARER = 0.6
"""Distance of the cameras of near people as a share of the usual one. Parts of the person leave the
frame.
"""
CLOTHES = {
    "longsleeve": ({"sleeve": 0.6, "bottom": -0.33, "loose": 0.4, "depth": 0.05}, {"crew"}),
    "chinos": (
        {"top": -0.26, "end": -1.16, "width": 0.01, "loose": 0.4, "waist": -0.22, "tucked": 0.0},
        set(),
    ),
    "flats": ({"height": 0.07, "sole": 0.015, "over": 0.0}, set()),
}
"""{garment: (its sizes, its details)}, see `synthetic/outfits.py`."""


def plain(seed: int, body: BodyModel) -> Person:
    """Returns the person of a seed in plain clothes, with short hair, in the one light."""
    rng, person = np.random.default_rng([seed, CLOTHES_STREAM]), describe(seed, body)
    garments = []
    for kind, (sizes, details) in CLOTHES.items():
        color = random_color(rng)
        fabric = Fabric("plain", color, color, int(rng.integers(1 << 31)))
        garments.append(Garment(kind, fabric, sizes, frozenset(details)))
    haircut = dataclasses.replace(person.haircut, cut="buzz", beard="none")
    lights = sample_lights(np.random.default_rng(LIGHT_SEED))
    return dataclasses.replace(person, garments=tuple(garments), haircut=haircut, lights=lights)


def write_plain(
    out: Path,
    split: str,
    count: int,
    views: int,
    held_out: int = 0,
    size: int = SIZE,
    near: bool = False,
) -> Path:
    """Writes people of a split as captures, and returns `out`. Existing folders are kept.

    Args:
        out: folder of the captures
        split: seeds of the people
        count: number of people
        views: photos of each of the two poses
        held_out: if not 0, the capture has only the first pose, and held_out/ has this many views
            of each pose
        size: side of the photos in pixels
        near: whether the cameras are nearer than usual
    """
    body = load_body()
    for seed in bar(seeds_of(split, 0, count), desc=out.name, unit="person"):
        folder = out / f"{seed:07d}"
        if (folder / "capture.json").is_file():
            continue
        # two poses of the person
        subject = make_subject(seed, body, plain(seed, body))
        rng = np.random.default_rng([seed, CAMERA_STREAM])
        chosen = rng.choice(POSES, 2, replace=False)
        generators = [np.random.default_rng([POSE_STREAM, int(pose)]) for pose in chosen]
        posed = [stand(subject, sample_rotations(each, subject.build)) for each in generators]
        seen = _views(rng, posed[:1] if held_out else posed, views, size, near)
        unseen = _views(rng, posed, held_out, size, near)

        def write(temporary: Path, subject=subject, posed=posed, seen=seen, unseen=unseen) -> None:
            save_capture(temporary, capture_views(subject, body, posed[: 1 + (not unseen)], seen))
            if unseen:
                save_capture(temporary / HELD_OUT, capture_views(subject, body, posed, unseen))

        replace_folder(folder, write, mark="capture.json")
    return out


def _views(
    rng: np.random.Generator, posed: list[PosedSubject], count: int, size: int, near: bool
) -> list[View]:
    """Returns `count` views of each pose, from cameras all around."""
    if not count:
        return []
    views = []
    for frame, one in enumerate(posed):
        cameras = cameras_around(rng, one.vertices, spread_azimuths(rng, count), size)
        if near:
            middle = 0.5 * (one.vertices.min(0) + one.vertices.max(0))
            cameras = _closer(cameras, middle)
        views += [View(frame, f"{frame}_{i:02d}", cameras[i]) for i in range(count)]
    return views


def _closer(cameras: Camera, middle: np.ndarray) -> Camera:
    """Moves cameras along their rays to the middle (3,) of the person, to `NEARER` of the
    distance.
    """
    pose = np.array(cameras.cam_from_world)
    at = pose[:, :3, :3] @ middle + pose[:, :3, 3]
    pose[:, :3, 3] -= (1 - NEARER) * at
    return replace(cameras, cam_from_world=jnp.asarray(pose))


class OnePose(CaptureFolder):
    """A capture of which only the views of the first pose are used, for systems that cannot show
    another pose.
    """

    def summary(self) -> StoredSubject:
        """Returns what is known of the views of the first pose."""
        found = super().summary()
        first = found.frames == found.frames[0]
        names = ("K", "cam_from_world", "frames", "azimuths")
        return found._replace(**{name: getattr(found, name)[first] for name in names})


class Recolored(CaptureSource):
    """A source whose examples have their color channels in random order, which makes six times the
    dyes.
    """

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """Returns an example with the same order of the channels in all images."""
        example = super().example(seed, index, input_count)
        order = np.random.default_rng([COLOR_STREAM, seed, index]).permutation(3)

        def change(views):
            return replace(views, images=views.images[..., order])

        return replace(example, inputs=change(example.inputs), targets=change(example.targets))


def on_disk(folder: Path, one_pose: bool = False, recolored: bool = False) -> SourceFactory:
    """Returns a function from a run's configuration to the source of the people of a folder.

    Args:
        folder: folder of captures
        one_pose: whether only views of the first pose are used
        recolored: whether examples have their color channels in random order
    """
    body = load_body()
    kind = OnePose if one_pose else CaptureFolder
    source = Recolored if recolored else CaptureSource
    cache = PeopleCache([kind(path, body) for path in find_captures(folder)])
    return lambda config: source(
        cache, config.views, config.model.image_size, config.target_size, config.loss.depth > 0
    )
