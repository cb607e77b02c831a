"""Counts the faults of synthetic people, and draws contact sheets of them."""

import functools
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh
from humangs_jax.synthetic import anatomy, surroundings
from humangs_jax.synthetic.subject import SPLITS, make_subject, padded, pose_subject, render_view
from humangs_jax.synthetic.writer import sample_motion, sample_pose

DEMO = SPLITS["demo"]
DEPTH, HOLLOW_DEPTH = 0.06, 0.01
"""Metres that cloth may lie behind skin that pokes through it, and metres that the missing body
must be nearer than the inner side of cloth that is seen.
"""
FAULTS = {
    "poking": (
        "skin inside of a hem (deeper than 0) is seen although the outer side of cloth is at most 6"
        " cm behind it on the ray"
    ),
    "poking_deep": "of it, skin more than 1 cm inside of the hem",
    "inside": (
        "all skin more than 1 cm inside of a hem that is seen at all, rightly (up a sleeve, under a"
        " skirt) or not: an upper bound of what pokes"
    ),
    "hollow": (
        "the inner side of cloth is seen where the naked body would be at least 1 cm nearer: one"
        " looks into empty clothes"
    ),
    "gaps": "the background is seen where the naked body would be",
}
DEEP = 0.01
"""Metres inside of a hem from which on skin is deep."""


@entry
def people_faults(run: Run, subjects: int = 200, size: int = 256) -> None:
    """Counts the faults of synthetic people in images of random poses from random cameras, as
    shares of the person's pixels.

    Skin that is seen up a sleeve or under a skirt has the inner side of cloth behind it, and is no
    fault. Skin that cloth covers well is not in the mesh, so it cannot poke. Where such cloth is
    open the fault is "hollow". Takes a second a person. Poking is expected to be below 0.1 %.

    Options:
    subjects: people of the training seeds that are built, posed and rendered
    size: side of the pictures in pixels
    """
    body = load_body()
    cases = {str(seed): functools.partial(look_at, body, seed, size) for seed in range(subjects)}
    rows = run.rows(cases, {"size": size})
    numbers, table, pixels = {}, [], np.asarray([row["pixels"] for row in rows.values()])
    for name, definition in FAULTS.items():
        each = np.asarray([row[name] for row in rows.values()])
        mean = float((each * pixels).sum() / pixels.sum())
        most, above = float(each.max()), float((each > 1e-3).mean())
        numbers[name] = {"mean": mean, "worst": most, "above_0.1_percent": above}
        table.append(
            [name.replace("_", ", "), definition, f"{mean:.4%}", f"{most:.2%}", f"{above:.1%}"]
        )
    header = ["fault", "definition", "mean", "worst person", f"of {subjects} people above 0.1 %"]
    run.show(markdown_table(header, table, "lllll"), {"people": subjects} | numbers)


def look_at(body: BodyModel, seed: int, size: int) -> dict[str, float]:
    """Returns the pixels of the person of a seed in an image, and the share of each fault."""
    posed = sample_pose(make_subject(seed, body), 0)
    rng = np.random.default_rng([seed, 77, 0])
    azimuths = surroundings.spread_azimuths(rng, 1)
    camera = surroundings.cameras_around(rng, posed.vertices, azimuths, size)[0]
    pixels, *counts = count_faults(body, posed, camera)
    return {"pixels": float(pixels)} | {
        name: float(x / pixels) for name, x in zip(FAULTS, counts, strict=True)
    }


def count_faults(body, posed, camera):
    """Returns (6,) numbers of pixels: those of the person, then those of each of FAULTS."""
    subject = posed.subject
    faces, materials = subject.surface.faces, subject.face_materials

    # skin inside of a hem, and cloth whose outer side is close behind it
    everything = rasterize_mesh(*padded(posed.vertices, faces), camera)
    ids = np.asarray(everything.face_ids)
    seen, depth = ids >= 0, np.asarray(everything.depth)
    weights = np.asarray(everything.barycentrics)
    cover = (subject.cover[faces[ids]] * weights).sum(-1)
    inside = seen & (materials[ids] == 0) & (cover > 0)
    cloth = np.where((materials >= 2)[:, None], faces, 0)
    behind = rasterize_mesh(*padded(posed.vertices, cloth), camera)
    cloth_ids, cloth_depth = np.asarray(behind.face_ids), np.asarray(behind.depth)
    eye = np.asarray(camera.center)
    outer = (cloth_ids >= 0) & _faces_the_eye(posed.vertices, faces, eye)[cloth_ids]
    poking = inside & outer & (cloth_depth - depth < DEPTH)

    # where the naked body would be seen
    pose = BodyPose(jnp.asarray(posed.rotations), jnp.asarray(posed.translation))
    naked = pose_body(body, shape_body(body, jnp.asarray(subject.betas)), pose)
    body_alone = rasterize_mesh(naked.vertices, body.faces, camera)
    bare, bare_depth = np.asarray(body_alone.face_ids) >= 0, np.asarray(body_alone.depth)
    inner = seen & (materials[ids] >= 2) & ~_faces_the_eye(posed.vertices, faces, eye)[ids]
    hollow = inner & bare & (depth - bare_depth > HOLLOW_DEPTH)
    deep = cover > DEEP
    found = (seen, poking, poking & deep, inside & deep, hollow, bare & ~seen)
    return np.asarray([pixels.sum() for pixels in found], float)


def _faces_the_eye(vertices, faces, eye):
    """Returns whether the outer side of each face is turned to the eye (3,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.sum(np.cross(b - a, c - a) * (eye - a), -1) > 0


# Contact sheets
# --------------------------------------------------------------------------------------------------

FRONT_BACK_SIZE, MOTION_SIZE, CLOSE_SIZE = (184, 228), (148, 176), (256, 256)
"""Width and height of one image, pixels."""
COLUMNS = 16
MOTION_FRAMES = 75
QUALITY = 85
TELE = 0.42
"""Vertical field of view of images that show the whole person, radians."""


@entry
def people_sheets(run: Run, out: Path = Path("docs/images")) -> None:
    """Writes contact sheets of synthetic people: 64 from front and back, heads and hands of 8, and
    8 sequences of 8 frames.

    All three take a minute of one CPU core. The same command gives the same images bit for bit on
    the same machine.

    Options:
    out: folder to write into
    """
    body = load_body()
    out.mkdir(parents=True, exist_ok=True)
    makers = {
        "front_back": (front_back, DEMO[:64]),
        "close": (close_ups, DEMO[200:208]),
        "sequences": (motions, DEMO[300:308]),
    }
    for name, (maker, seeds) in makers.items():
        sheet, file = maker(body, seeds), out / f"people_{name}.jpg"
        pixels = np.round(np.clip(sheet, 0, 1) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(file, quality=QUALITY)
        print(f"{file}: {sheet.shape[1]} x {sheet.shape[0]}, {file.stat().st_size / 1e3:.0f} kB")


def front_back(body, seeds):
    """Draws rows of people from the front, each over a row of the same people from behind."""
    cells = []
    for seed in seeds:
        posed = sample_pose(make_subject(seed, body), 0)
        turn = posed.rotations[0, 1]
        cells.append([_whole(posed, turn + a, FRONT_BACK_SIZE) for a in (0.25, np.pi + 0.25)])
    chunks = [cells[start : start + COLUMNS] for start in range(0, len(cells), COLUMNS)]
    return _grid([[pair[side] for pair in chosen] for chosen in chunks for side in (0, 1)])


def close_ups(body, seeds):
    """Draws a row of heads, a row of the same heads from the side, and a row of hands."""
    rows = [[], [], []]
    for seed in seeds:
        posed = sample_pose(make_subject(seed, body), 0)
        world, joints = anatomy.joint_positions(posed.subject.build, posed.rotations.astype(float))
        joints = joints + posed.translation
        facing = _azimuth(world[anatomy.Joint.HEAD] @ [0, 0, 1])
        middle = joints[anatomy.Joint.HEAD] + world[anatomy.Joint.HEAD] @ [0, 0.085, 0.02]
        rows[0].append(_near(posed, middle, 0.17, facing + 0.35, 0.05))
        rows[1].append(_near(posed, middle, 0.17, facing + 1.6, 0.05))
        if seed % 2:
            wrist, hand = anatomy.Joint.LEFT_WRIST, anatomy.Joint.LEFT_HAND
        else:
            wrist, hand = anatomy.Joint.RIGHT_WRIST, anatomy.Joint.RIGHT_HAND
        knuckles = joints[hand + 3]
        outwards = _azimuth(knuckles - joints[anatomy.Joint.SPINE2])
        rows[2].append(_near(posed, 0.4 * joints[wrist] + 0.6 * knuckles, 0.15, outwards, 0.1))
    return _grid(rows)


def motions(body, seeds):
    """Draws eight frames of each sequence over two and a half seconds, from a camera beside the
    walker.

    A row of the sheet shows two sequences.
    """
    rows = []
    for seed in seeds:
        subject = make_subject(seed, body)
        motion = sample_motion(subject, MOTION_FRAMES)
        rotations, translations = np.asarray(motion.rotations), np.asarray(motion.translations)
        world, _ = anatomy.joint_positions(subject.build, rotations[0].astype(float))
        pelvis = world[anatomy.Joint.PELVIS]
        facing = _azimuth(pelvis @ [0, 0, 1])
        posed = [
            pose_subject(subject, rotations[i], translations[i])
            for i in np.linspace(0, len(rotations) - 1, 8).astype(int)
        ]
        rows.append([_whole(p, facing + 0.7, MOTION_SIZE) for p in posed])
    half = len(rows) // 2
    return _grid([a + b for a, b in zip(rows[:half], rows[half:], strict=True)])


def _azimuth(direction):
    """Returns the azimuth of a direction (3,) in radians, 0 along z."""
    return float(np.arctan2(direction[0], direction[2]))


def _seen(posed, target, distance, azimuth, elevation, fov, size):
    """Draws a person from a camera around a target, (h, w, 3)."""
    K, azimuths = intrinsics_from_fov(fov, *size), jnp.asarray([azimuth], jnp.float32)
    camera = orbit(
        jnp.asarray(target, jnp.float32), float(distance), azimuths, float(elevation), K, *size
    )[0]
    return render_view(posed, camera)[0]


def _whole(posed, azimuth, size):
    """Draws the whole person with the feet near the lower edge, (h, w, 3).

    An image is 2.25 metres high, so that all people have one scale, or more for a tall person.
    """
    low, high = posed.vertices.min(0), posed.vertices.max(0)
    reach = max(2.25, 1.1 * (high[1] - low[1]))
    target = [0.5 * (low[0] + high[0]), low[1] + 0.455 * reach, 0.5 * (low[2] + high[2])]
    return _seen(posed, target, 0.5 * reach / np.tan(0.5 * TELE) + 0.3, azimuth, 0.05, TELE, size)


def _near(posed, target, reach, azimuth, elevation):
    """Draws a close-up of `reach` metres around a point, from 1.2 metres away."""
    return _seen(posed, target, 1.2, azimuth, elevation, 2 * np.arctan(reach / 1.2), CLOSE_SIZE)


def _grid(rows):
    """Joins rows of images of one size into an image (h, w, 3), and fills short rows with white."""
    columns = max(len(row) for row in rows)
    blank = np.ones_like(rows[0][0])
    return np.concatenate(
        [np.concatenate(row + [blank] * (columns - len(row)), axis=1) for row in rows], axis=0
    )
