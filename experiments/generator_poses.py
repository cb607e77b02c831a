"""The pose prior and the sequences, measured; contact sheets of synthetic people."""

import json
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.harness import Run, entry
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.people import anatomy as poses
from humangs_jax.people.anatomy import LIMITS, Build, Rotations
from humangs_jax.people.poses import sample_rotations
from humangs_jax.people.sequences import KINDS, sample_sequence
from humangs_jax.people.subject import DEMO, make_subject, pose_subject, render_view
from humangs_jax.people.writer import sample_motion, sample_pose
from humangs_jax.rendering.mesh.position_map import vertex_normals

OUTSIDE = 2e-3
"""Metres along the normal at which a vertex asks."""
INSIDE = 0.6
"""Winding number above which a point is inside: meshes are not quite closed (mouth, eyes)."""
AT_ONCE = 64


def winding_numbers(
    points: Float[Array, "q 3"], vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]
) -> Float[Array, " q"]:
    """How often the mesh winds around each point (q, 3): sum of the signed solid angles of its faces over 4 pi."""
    corners = vertices[faces]
    dot = lambda x, y: jnp.sum(x * y, axis=-1)

    def one(point):
        a, b, c = (corners[:, i] - point for i in range(3))
        la, lb, lc = (jnp.linalg.norm(x, axis=-1) for x in (a, b, c))
        below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
        return jnp.sum(2 * jnp.arctan2(dot(a, jnp.cross(b, c)), below)) / (4 * jnp.pi)

    return jax.lax.map(one, points, batch_size=AT_ONCE)


class OverlapMeter:
    """Asks the vertices of a body, decimated to `count`; those that are inside in T-pose already do not count."""

    def __init__(self, body: BodyModel, count: int = 1600):
        self.body = decimate(body, count)
        self.rest = shape_body(self.body, jnp.zeros(0))
        self.at_rest = np.zeros(len(self.body.template), bool)
        self.at_rest = self.inside(np.zeros((len(body.parents), 3)))

    def inside(self, rotations: Rotations) -> Bool[np.ndarray, " n"]:
        """The vertices (n,) that a pose of rotation vectors (j, 3) puts inside another part of the body."""
        return np.asarray(_inside(self.body, self.rest, jnp.asarray(rotations, jnp.float32))) & ~self.at_rest


@jax.jit
def _inside(body, rest, rotations):
    vertices = pose_body(body, rest, BodyPose(rotations, jnp.zeros(3))).vertices
    points = vertices + OUTSIDE * vertex_normals(vertices, body.faces)
    return winding_numbers(points, vertices, body.faces) > INSIDE


CREASES = ("shoulder", "collar", "spine3", "pelvis", "hip")
"""Parts whose skin folds into itself where blend skinning bends it, whatever the pose is."""
TOUCHING = 4e-3
"""Metres above its lowest point at which a sole touches the ground."""


@entry
def people_poses(run: Run, poses: int = 200, sequences: int = 12) -> None:
    """The pose prior and the sequences: self-penetration, soles on the ground, sliding.

    80 s of one CPU core. Expect: 0.85 % of the vertices inside another part, nearly all in creases of armpits and groin, 0.11 %
    of them without these parts; planted soles within 6 mm of the ground, which slide by 0.1 mm a frame in walks, less in the
    rest.

    Options:
    poses: of the prior
    sequences: of 60 frames, of all kinds in turn
    """
    body = load_body()
    joints = np.asarray(body.joint_regressor @ body.template, float)
    build = Build(joints, body.parents, torso_radius=0.13, thigh_radius=0.1, shin_radius=0.08, arm_radius=0.035)
    drawn = [sample_rotations(np.random.default_rng(seed), build) for seed in range(poses)]
    kinds = [list(KINDS)[i % len(KINDS)] for i in range(sequences)]
    moved = [sample_sequence(np.random.default_rng(i), build, 60, kind) for i, kind in enumerate(kinds)]
    meter = OverlapMeter(body)
    numbers = {
        "poses": penetration(meter, drawn) | limits(drawn),
        "sequences": penetration(meter, [r for s in moved for r in s.rotations[::10]]),
        "feet": {kind: sliding(body, [s for s in moved if s.kind == kind]) for kind in dict.fromkeys(kinds)},
    }
    run.show(json.dumps(numbers, indent=1), numbers)


def penetration(meter, poses) -> dict:
    """Share of the body's vertices inside another part, and the same without the parts that fold in every pose."""
    part = np.asarray(meter.body.skinning_weights).argmax(1)
    names = np.asarray(meter.body.joint_names)[part]
    folds = np.asarray([any(crease in name for crease in CREASES) for name in names])
    inside = np.stack([meter.inside(rotations) for rotations in poses])
    shares, limbs = inside.mean(1), (inside & ~folds).mean(1)
    where = {name: int(inside[:, names == name].sum()) for name in sorted(set(names))}
    return {
        "count": len(poses),
        "mean_share_inside": float(shares.mean()),
        "max_share_inside": float(shares.max()),
        "mean_share_inside_without_creases": float(limbs.mean()),
        "max_share_inside_without_creases": float(limbs.max()),
        "vertices_by_part": dict(sorted(where.items(), key=lambda item: -item[1])[:8]),
    }


def limits(poses) -> dict:
    """Spread of the joints' angles (degrees), and the largest share of a limit that is used."""
    angles = np.linalg.norm(np.stack(poses), axis=-1)
    used = {joint: angles[:, joint].max() / limit for joint, limit in enumerate(LIMITS) if limit > 0}
    spread = np.rad2deg(np.stack(poses).std(0)).mean(1)
    return {
        "largest_share_of_a_limit": float(max(used.values())),
        "mean_spread_of_body_joints_degrees": float(spread[:22].mean()),
        "mean_spread_of_finger_joints_degrees": float(spread[25:].mean()),
    }


def sliding(body, sequences) -> dict:
    """How far the touching points of planted soles move in a frame, and how high planted soles are."""
    part = np.asarray(body.skinning_weights).argmax(1)
    feet = [np.flatnonzero(np.isin(part, (7 + side, 10 + side))) for side in (0, 1)]
    rest = shape_body(body, jnp.zeros(0))
    pose = jax.jit(lambda r, t: pose_body(body, rest, BodyPose(r, t)).vertices)
    slides, heights, lowest_ever = [], [], np.inf
    for s in sequences:
        vertices = [
            np.asarray(pose(jnp.asarray(r, jnp.float32), jnp.asarray(t, jnp.float32)))
            for r, t in zip(s.rotations, s.translations, strict=True)
        ]
        for side in (0, 1):
            low = np.asarray([v[feet[side], 1].min() for v in vertices])
            heights += low[s.planted[:, side]].tolist()
            lowest_ever = min(lowest_ever, low.min())
            for f in np.flatnonzero(s.planted[:-1, side] & s.planted[1:, side]):
                now, then = vertices[f][feet[side]], vertices[f + 1][feet[side]]
                touching = (now[:, 1] < low[f] + TOUCHING) & (then[:, 1] < low[f + 1] + TOUCHING)
                slides += np.linalg.norm((then - now)[touching][:, [0, 2]], axis=1).tolist()
    return {
        "sequences": len(sequences),
        "mean_slide_mm_per_frame": 1e3 * float(np.mean(slides)),
        "p99_slide_mm_per_frame": 1e3 * float(np.quantile(slides, 0.99)),
        "planted_sole_mm": [1e3 * float(np.min(heights)), 1e3 * float(np.max(heights))],
        "lowest_point_mm": 1e3 * float(lowest_ever),
    }


FRONT_BACK_SIZE, VIEW_SIZE, CLOSE_SIZE = (184, 228), (148, 176), (256, 256)
"""Width and height of one image, pixels."""
COLUMNS = 16
MOTION_FRAMES = 75
QUALITY = 85
TELE = 0.42
"""Vertical field of view of images that show the whole person, radians."""


@entry
def people_sheets(
    run: Run,
    out: Path = Path("docs/images"),
    sheets: tuple[Literal["front_back", "views", "close", "sequences"], ...] = (
        "front_back",
        "views",
        "close",
        "sequences",
    ),
    subjects: int = 64,
    scale: float = 1.0,
    suffix: Literal[".jpg", ".png"] = ".jpg",
) -> None:
    """Contact sheets of synthetic people: front and back, 16 of them all around, 8 heads and hands, 8 sequences of 8 frames.

    All four take 90 s of one CPU core. The same command gives the same images bit for bit on the same machine.

    Options:
    out: folder to write into
    sheets: which
    subjects: people on the first sheet, of the demo seeds
    scale: size of the pictures
    suffix: kind of file
    """
    body = load_body()
    out.mkdir(parents=True, exist_ok=True)
    counts = {"front_back": subjects, "views": 16, "close": 8, "sequences": 8}
    makers = {"front_back": front_back, "views": all_around, "close": close_ups, "sequences": motions}
    for i, name in enumerate(counts):
        if name in sheets:
            sheet = makers[name](body, DEMO[100 * i : 100 * i + counts[name]], scale)
            pixels, file = np.round(np.clip(sheet, 0, 1) * 255).astype(np.uint8), out / f"people_{name}{suffix}"
            Image.fromarray(pixels).save(file, quality=QUALITY)  # of a JPEG
            print(f"{file}: {sheet.shape[1]} x {sheet.shape[0]}, {file.stat().st_size / 1e3:.0f} kB")


def front_back(body, seeds, scale):
    """Rows of people from the front, each over a row of the same people from behind."""
    cells = []
    for seed in seeds:
        posed = _person(seed, body)
        turn = posed.rotations[0, 1]
        cells.append([_whole(posed, turn + a, FRONT_BACK_SIZE, scale) for a in (0.25, np.pi + 0.25)])
    rows = []
    for start in range(0, len(cells), COLUMNS):
        chosen = cells[start : start + COLUMNS]
        rows += [[pair[0] for pair in chosen], [pair[1] for pair in chosen]]
    return _grid(rows)


def all_around(body, seeds, scale):
    """One row a person, eight views around; two people side by side."""
    rows = []
    for seed in seeds:
        posed = _person(seed, body)
        azimuths = posed.rotations[0, 1] + np.arange(8) * (np.pi / 4)
        rows.append([_whole(posed, a, VIEW_SIZE, scale) for a in azimuths])
    half = (len(rows) + 1) // 2
    return _grid([a + b for a, b in zip(rows[:half], rows[half:] or rows[:half], strict=False)])


def close_ups(body, seeds, scale):
    """A row of heads, a row of the same heads from the side, a row of hands."""
    rows = [[], [], []]
    for seed in seeds:
        posed = _person(seed, body)
        world, joints = poses.joint_positions(posed.subject.build, posed.rotations.astype(float))
        joints = joints + posed.translation
        facing = _azimuth(world[poses.HEAD] @ [0, 0, 1])
        middle = joints[poses.HEAD] + world[poses.HEAD] @ [0, 0.085, 0.02]
        rows[0].append(_near(posed, middle, 0.17, facing + 0.35, 0.05, scale))
        rows[1].append(_near(posed, middle, 0.17, facing + 1.6, 0.05, scale))
        hand = poses.LEFT_WRIST if seed % 2 else poses.RIGHT_WRIST
        knuckles = joints[poses.LEFT_HAND + 3 if seed % 2 else poses.RIGHT_HAND + 3]
        outwards = _azimuth(knuckles - joints[poses.SPINE2])
        rows[2].append(_near(posed, 0.4 * joints[hand] + 0.6 * knuckles, 0.15, outwards, 0.1, scale))
    return _grid(rows)


def motions(body, seeds, scale):
    """One row a sequence, eight frames over two and a half seconds, the camera beside the walker; two sequences side by side."""
    rows = []
    for seed in seeds:
        subject = make_subject(seed, body)
        motion = sample_motion(subject, MOTION_FRAMES)
        rotations, translations = np.asarray(motion.rotations), np.asarray(motion.translations)
        frames = np.linspace(0, len(rotations) - 1, 8).astype(int)
        start = pose_subject(subject, rotations[0], translations[0])
        facing = _azimuth(poses_world(subject, rotations[0]) @ [0, 0, 1])
        posed = [start if i == 0 else pose_subject(subject, rotations[i], translations[i]) for i in frames]
        rows.append([_whole(p, facing + 0.7, VIEW_SIZE, scale) for p in posed])
    half = (len(rows) + 1) // 2
    return _grid([a + b for a, b in zip(rows[:half], rows[half:] or rows[:half], strict=False)])


def poses_world(subject, rotations):
    """(3, 3) rotation of the pelvis."""
    return poses.joint_positions(subject.build, rotations.astype(float))[0][poses.PELVIS]


def _person(seed, body, pose=0):

    return sample_pose(make_subject(seed, body), pose)


def _azimuth(direction):

    return float(np.arctan2(direction[0], direction[2]))


def _camera(target, distance, azimuth, elevation, fov, size, scale):

    width, height = (2 * round(s * scale / 2) for s in size)
    K = intrinsics_from_fov(fov, width, height)
    azimuths = jnp.asarray([azimuth], jnp.float32)
    return orbit(jnp.asarray(target, jnp.float32), float(distance), azimuths, float(elevation), K, width, height)[0]


def _whole(posed, azimuth, size, scale):
    """The whole person, feet near the lower edge; all people at one scale, 2.3 metres to the image's height."""
    low, high = posed.vertices.min(0), posed.vertices.max(0)
    reach = max(2.25, 1.1 * (high[1] - low[1]))
    target = [0.5 * (low[0] + high[0]), low[1] + 0.455 * reach, 0.5 * (low[2] + high[2])]
    distance = 0.5 * reach / np.tan(0.5 * TELE) + 0.3
    return render_view(posed, _camera(target, distance, azimuth, 0.05, TELE, size, scale))[0]


def _near(posed, target, reach, azimuth, elevation, scale):
    """A close-up of `reach` metres around a point, from a metre away."""
    fov = 2 * np.arctan(reach / 1.2)
    return render_view(posed, _camera(target, 1.2, azimuth, elevation, fov, CLOSE_SIZE, scale))[0]


def _grid(rows):
    """(h, w, 3) image of rows of images of one size; short rows are filled with white."""
    columns = max(len(row) for row in rows)
    blank = np.ones_like(rows[0][0])
    return np.concatenate([np.concatenate(row + [blank] * (columns - len(row)), axis=1) for row in rows], axis=0)
