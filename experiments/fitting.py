"""Measures how exactly bodies are found from 2D keypoints, and where a detector puts its landmarks.

The people are synthetic. Their keypoints are known, and the detections have random errors.
"""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.detection.people import Networks, find_people
from humangs_jax.capture.fitting.landmark_fit import fit_landmarks
from humangs_jax.capture.fitting.residuals.keypoints import Observations, expected_noise
from humangs_jax.capture.fitting.triangulation import triangulate, triangulate_robustly
from humangs_jax.capture.keypoints.keypoints import KEYPOINT_SETS, MEDIAPIPE_33, mirrored_name
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit, project
from humangs_jax.motion import load_motion
from humangs_jax.synthetic.poses import sample_rotations
from humangs_jax.synthetic.subject import make_subject
from humangs_jax.synthetic.surroundings import cameras_around, spread_azimuths

POSE_STREAM, CAMERA_STREAM, ERROR_STREAM = 21, 22, 23
SIZE = 512
"""Pixels a side of the photos."""


@dataclasses.dataclass(frozen=True)
class FitCase:
    """The truth about one person in m frames that c cameras see."""

    betas: np.ndarray
    """(s,) shape coefficients."""
    rotations: np.ndarray
    """(m, j, 3) rotation vectors of the joints."""
    translations: np.ndarray
    """(m, 3) translations in metres."""
    joints: np.ndarray
    """(m, j, 3) joints in the world, metres."""
    landmarks: np.ndarray
    """(m, k, 3) landmarks in the world, metres."""
    K: np.ndarray
    """(m, c, 3, 3) intrinsics of the cameras."""
    cam_from_world: np.ndarray
    """(m, c, 4, 4) extrinsics of the cameras."""


def make_case(seed, body, model, frames, views) -> FitCase:
    """Returns the person of a seed in random poses, each seen by other cameras, as in the published
    protocol.
    """
    # each frame has random streams for its pose and its cameras
    subject = make_subject(seed, body)
    rotations, translations, extrinsics, intrinsics = [], [], [], []
    for frame in range(frames):
        rng = np.random.default_rng([seed, POSE_STREAM, frame])
        pose = sample_rotations(rng, subject.build)
        pose[0] = [0, rng.uniform(-np.pi, np.pi), 0]
        vertices = subject.posed_vertices(pose, np.zeros(3))
        shift = rng.uniform([-1, 0, -1], [1, 0, 1]) - [0, vertices[:, 1].min(), 0]
        rng = np.random.default_rng([seed, CAMERA_STREAM, frame])
        cameras = cameras_around(rng, vertices + shift, spread_azimuths(rng, views), SIZE)
        rotations.append(pose)
        translations.append(shift)
        extrinsics.append(np.asarray(cameras.cam_from_world))
        intrinsics.append(np.asarray(cameras.K))

    rotations = np.asarray(rotations, np.float32)
    translations = np.asarray(translations, np.float32)
    landmarks, joints = _posed(model, subject.betas, rotations, translations)
    return FitCase(
        subject.betas,
        rotations,
        translations,
        joints,
        landmarks,
        np.stack(intrinsics),
        np.stack(extrinsics),
    )


def walking(model, seed) -> FitCase:
    """Returns the person of a seed in the first frames of the shipped walk, seen by four cameras
    that stand still around the person.
    """
    motion, rng = load_motion(), np.random.default_rng([seed, POSE_STREAM])
    rotations, translations = (
        np.asarray(x)[:FRAMES] for x in (motion.rotations, motion.translations)
    )
    betas = rng.normal(0, 0.7, model.joint_directions.shape[-1]).astype(np.float32)
    landmarks, joints = _posed(model, betas, rotations, translations)
    azimuths = rng.uniform(0, 2 * np.pi) + np.arange(4) * (2 * np.pi / 4)
    K, middle = intrinsics_from_fov(1.0, SIZE, SIZE), jnp.asarray(joints.mean((0, 1)))
    cameras = orbit(middle, 3.4, jnp.asarray(azimuths, jnp.float32), 0.15, K, SIZE, SIZE)

    def still(array):
        return np.broadcast_to(np.asarray(array), (FRAMES, *array.shape))

    return FitCase(
        betas,
        rotations,
        translations,
        joints,
        landmarks,
        still(cameras.K),
        still(cameras.cam_from_world),
    )


@jax.jit
def _pose_all(model, betas, rotations, translations):
    """Returns the landmarks and the joints of all frames."""
    return jax.vmap(lambda r, t: pose_landmarks(model, betas, BodyPose(r, t)))(
        rotations, translations
    )


def _posed(model, betas, rotations, translations):
    """Returns the landmarks (m, k, 3) and the joints (m, j, 3) of all frames as NumPy arrays."""
    posed = _pose_all(model, jnp.asarray(betas), rotations, translations)
    return tuple(np.asarray(x) for x in posed)


def detect(case, seed, noise_px, outliers, outlier_px=100.0):
    """Returns keypoints (m, c, k, 2) in pixels as a detector with errors would give them.

    Args:
        case: the truth
        seed: seed of the errors
        noise_px: standard deviation of the noise of all keypoints
        outliers: share of the keypoints that are displaced
        outlier_px: largest displacement
    """
    rng = np.random.default_rng([seed, ERROR_STREAM])
    turns, shifts = case.cam_from_world[..., :3, :3], case.cam_from_world[..., None, :3, 3]
    seen = np.einsum("mcab,mkb->mcka", turns, case.landmarks) + shifts
    focal, middle = case.K[..., None, [0, 1], [0, 1]], case.K[..., None, :2, 2]
    pixels = seen[..., :2] / seen[..., 2:] * focal + middle
    pixels = pixels + rng.normal(0, 1, pixels.shape) * noise_px
    wild = rng.random(pixels.shape[:-1]) < outliers
    angle = rng.uniform(0, 2 * np.pi, wild.shape)
    radius = outlier_px * np.sqrt(rng.random(wild.shape))
    return pixels + (wild * radius)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def observe(people, seed, noise_px, outliers, model):
    """Returns the observations (people, m, c, ...) of cases, with the errors of a detector."""
    points = np.stack([detect(case, seed + i, noise_px, outliers) for i, case in enumerate(people)])
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), points.shape[:-1])
    noise = np.stack([expected_noise(p, c) for p, c in zip(points, confidences, strict=True)])
    K, cam_from_world = (
        np.stack([getattr(case, name) for case in people]) for name in ("K", "cam_from_world")
    )
    arrays = (points, confidences, K, cam_from_world, noise)
    return jax.vmap(jax.vmap(Observations))(*(jnp.asarray(x, jnp.float32) for x in arrays))


VIEWS, NOISES = (1, 2, 3, 4, 8), (0.0, 1.0, 2.0, 5.0, 10.0)
"""Numbers of views, and standard deviations of the noise in pixels, of the curves."""
ALL = "wholebody133"
"""The set of keypoints with the most landmarks."""
FIRST = 4_000_000
"""Seed of the first person."""


@entry
def fit_keypoints(run: Run, people: int = 4, frames: int = 16, curves: bool = True) -> None:
    """Measures how exactly a body is found from 2D keypoints of synthetic people of the fitting
    seeds in random poses, with the errors of a detector.

    The table has errors over views, over noise and over keypoint sets: of all 55 joints in the
    world, of the 22 of the body and of those of the hands. Beside them are plain and robust
    triangulation of the same keypoints. Seconds per frame are those of all people and frames in one
    batch, without compilation. Takes 8 minutes on two cores.

    Options:
    people: number of people of the fitting seeds
    frames: frames of each person
    curves: vary views, noise and sets; otherwise only four views of COCO-WholeBody
    """
    if min(people, frames) < 1:
        raise ValueError("--people and --frames: expected at least 1")

    # settings (keypoint set, views, noise in pixels, share of outliers), and their names
    asked = [(ALL, 4, 2.0, share) for share in (0.2, 0.0)]
    if curves:
        asked += [(ALL, views, 2.0, share) for views in VIEWS for share in (0.0, 0.2)]
        asked += [(ALL, 4, noise, 0.0) for noise in NOISES]
        asked += [
            (kind, 4, 2.0, share) for kind in ("coco17", "openpose67") for share in (0.0, 0.2)
        ]
    settings = {
        each: f"{each[0]}, {each[1]} views, {each[2]:g} px, {each[3]:.0%}" for each in asked
    }
    cases = {
        name: functools.partial(_errors, people, frames, each) for each, name in settings.items()
    }
    rows = run.rows(cases, {"people": people, "frames": frames})

    def shown(value):
        return "-" if value is None else f"{value:.1f}"

    # a line for each setting, and a sentence about times
    table = []
    for (kind, views, noise, share), name in settings.items():
        errors = [shown(rows[name].get(key)) for key in COLUMNS]
        table.append([kind, views, f"{noise:g}", f"{share:.0%}", *errors])
    four = rows[settings[(ALL, 4, 2.0, 0.2)]]
    summary = (
        f"{people} people of {frames} frames each in one batch: {four['seconds_per_frame']:.2f} s a"
        f" frame with four views, after a first call of {four['first_call_s']:.0f} s that compiles."
    )
    if curves:
        alone = rows[settings[(ALL, 1, 2.0, 0.0)]]["root_aligned_mean_joint_error_mm"]
        summary += f" With one view and the pelvis put in its place the mean is {alone:.0f} mm."
    header = ["keypoints", "views", "noise, px", "outliers", *COLUMNS.values()]
    run.show(f"{markdown_table(header, table)}\n\n{summary}", rows)


@functools.cache
def _model(kind):
    """Returns the landmark model of a keypoint set."""
    return landmark_model(load_body(), KEYPOINT_SETS[kind].names)


@functools.cache
def _people(kind, views, count, frames):
    """Returns the first people in random poses."""
    return [make_case(FIRST + i, load_body(), _model(kind), frames, views) for i in range(count)]


def _errors(count, frames, setting):
    """Fits all people with a setting, and returns errors in millimetres and times in seconds."""
    # the first fit compiles
    kind, views, noise, outliers = setting
    model, people = _model(kind), _people(kind, views, count, frames)
    seen = observe(people, FIRST, noise, outliers, model)
    fit_all = jax.vmap(lambda own: fit_landmarks(model, own))
    times = [time.perf_counter()]
    for _ in range(2):
        fit = jax.block_until_ready(fit_all(seen))
        times.append(time.perf_counter())

    # errors in the world, and with the pelvis where the true one is: what a single view can know
    truth, joints = np.stack([case.joints for case in people]), np.asarray(fit.joints)
    errors = 1000 * np.linalg.norm(joints - truth, axis=-1)
    moved = truth + joints[..., :1, :] - truth[..., :1, :]
    aligned_errors = 1000 * np.linalg.norm(joints - moved, axis=-1)
    found = {
        "mean_joint_error_mm": float(errors.mean()),
        "p95_joint_error_mm": float(np.quantile(errors, 0.95)),
        "mean_body_joint_error_mm": float(errors[..., :22].mean()),
        "mean_hand_joint_error_mm": float(errors[..., 25:].mean()),
        "worst_frame_mean_mm": float(errors.mean(-1).max()),
    }
    found |= landmark_errors(model, people, seen, fit)
    found["root_aligned_mean_joint_error_mm"] = float(aligned_errors.mean())
    return found | {
        "seconds_per_frame": (times[2] - times[1]) / (count * frames),
        "first_call_s": times[1] - times[0],
    }


def landmark_errors(model, people, seen, fit) -> dict:
    """Returns the mean millimetres between the true landmarks and the fitted and triangulated ones.

    Triangulation is left out where there is one view.
    """
    truth, known = np.stack([case.landmarks for case in people]), np.asarray(model.known)

    def off(points):
        return float(1000 * np.linalg.norm(np.asarray(points) - truth, axis=-1)[..., known].mean())

    found = {"mean_landmark_error_mm": off(fit.landmarks)}
    if seen.points.shape[2] > 1:
        plain = jax.jit(jax.vmap(jax.vmap(triangulate)))
        robust = jax.jit(jax.vmap(jax.vmap(triangulate_robustly)))
        found |= {
            "triangulated_mm": off(plain(seen)[0]),
            "robustly_triangulated_mm": off(robust(seen)[0]),
        }
    return found


COLUMNS = {
    "mean_joint_error_mm": "joints, mean mm",
    "p95_joint_error_mm": "95 %",
    "mean_body_joint_error_mm": "body",
    "mean_hand_joint_error_mm": "hands",
    "mean_landmark_error_mm": "landmarks: fit",
    "triangulated_mm": "triangulated",
    "robustly_triangulated_mm": "robustly",
}
"""{number of a row: its heading in the table}."""


FRAMES, OTHER = 7, (0.8, 0.0, 0.5)
"""Frames of the walk, and where somebody else stands relative to the person, metres."""
CASES = {
    "all frames seen": (4, 1.0, ()),
    "frame 3 without keypoints": (4, 1.0, (3,)),
    "the last frame without keypoints": (4, 1.0, (6,)),
    "frames 2 to 4 without keypoints": (4, 1.0, (2, 3, 4)),
    "frame 3 seen by one view": (4, 1.0, (3,)),
    "frame 3 is somebody else": (4, 1.0, (3,)),
    "a fifth of frame 3 up to 100 px off": (4, 1.0, (3,)),
    "one camera": (1, 1.0, ()),
    "one camera, frame 3 without keypoints": (1, 1.0, (3,)),
    "4 px of noise": (4, 4.0, ()),
}
"""{case: (views, noise of the detections in pixels of 512, frames that are spoilt)}."""


@entry
def fit_sequences(
    run: Run,
    smoothness: tuple[float, ...] = (0.005, 0.02),
    people: int = 3,
    cases: tuple[str, ...] = (),
) -> None:
    """Measures what `humangs fit --smoothness` makes of sequences with frames that are badly seen.
    The sequence is the shipped walk with known keypoints.

    The table has mean errors over all 55 joints, of the frames that the case leaves alone and of
    those that it spoils. Where no frame is spoilt it also has the error of the accelerations, which
    shows how much the joints tremble. Frames are fitted one by one and with smooth motion. Takes 15
    minutes.

    Options:
    smoothness: expected acceleration, metres per frame squared
    people: number of people of the fitting seeds
    cases: names of the cases; default: all
    """
    # every case, fitted one by one and with each smoothness
    model, made = _model(ALL), [walking(_model(ALL), seed) for seed in range(FIRST, FIRST + people)]
    ways = {"alone": 0.0} | {f"smooth {s:g}": s for s in smoothness}
    names = cases or tuple(CASES)
    each = {
        f"{name}: {way}": functools.partial(measure, model, made, name, s)
        for name in names
        for way, s in ways.items()
    }
    rows = run.rows(each, {"people": people, "kind": ALL})

    def show(value):
        if value is None:
            return "-"
        return f"{value:.0f}" if value >= 99.5 else f"{value:.1f}"

    # a line for each case
    keys = {"others_mm": "frames left alone", "spoilt_mm": "spoilt", "tremble_mm": "acceleration"}
    table = [
        [name, *(show(rows[f"{name}: {way}"][key]) for key in keys for way in ways)]
        for name in names
    ]
    header = ["case"]
    for what in keys.values():
        header += [f"{what}: one by one", *(f"{s:g}" for s in smoothness)]
    about = (
        f"{people} people, {FRAMES} frames, {ALL}, one by one and with these values of"
        " `--smoothness`; mean errors in millimetres, and millimetres per frame squared."
    )
    run.show(f"{markdown_table(header, table)}\n\n{about}", rows)


def measure(model, people, name: str, smoothness: float) -> dict:
    """Fits a case and returns mean errors in millimetres, and the smoothness that the fits used.

    The errors are those of the frames left alone, of the spoilt ones and of accelerations. They are
    None where the case has no such frames, and the accelerations where a frame is spoilt.
    """
    _, _, spoilt = CASES[name]
    seen = spoiled(model, people, name)
    fit = jax.vmap(lambda own: fit_landmarks(model, own, smoothness))(seen)
    truth = np.stack([case.joints for case in people])
    errors = 1000 * np.linalg.norm(np.asarray(fit.joints) - truth, axis=-1).mean(-1)
    bad = np.isin(np.arange(FRAMES), spoilt)
    wild = 1000 * np.linalg.norm(np.diff(np.asarray(fit.joints) - truth, 2, axis=1), axis=-1)
    found = {
        "others_mm": float(errors[:, ~bad].mean()),
        "spoilt_mm": None,
        "worst_frame_mm": float(errors[:, ~bad].max()),
        "tremble_mm": None,
        "held_to": None,
    }
    if bad.any():
        found["spoilt_mm"] = float(errors[:, bad].mean())
    else:
        found["tremble_mm"] = float(wild.mean())
    if smoothness:
        found["held_to"] = [float(x) for x in fit.smoothness]
    return found


def spoiled(model, people, name: str):
    """Returns the observations (people, m, c, ...) of a case."""
    views, noise, spoilt = CASES[name]
    seen = observe(people, FIRST, noise, 0.0, model)
    points, confidences = np.array(seen.points), np.array(seen.confidences)
    rows = list(spoilt)
    # spoil frames as the name of the case says
    if "without" in name:
        confidences[:, rows] = 0
    elif "one view" in name:
        confidences[:, rows, 1:] = 0
    elif "somebody else" in name:
        # the next person, beside and in another frame of the walk
        neighbours = [moved(case, OTHER) for case in people[1:] + people[:1]]
        others = observe(neighbours, FIRST + 1, noise, 0.0, model)
        later = [(row + FRAMES // 2) % FRAMES for row in rows]
        points[:, rows] = np.asarray(others.points)[:, later]
    elif "px off" in name:
        points[:, rows] = np.asarray(observe(people, FIRST, noise, 0.2, model).points)[:, rows]

    # only the views of the case
    points, confidences = points[:, :, :views], confidences[:, :, :views]
    noises = np.stack([expected_noise(p, c) for p, c in zip(points, confidences, strict=True)])
    return replace(
        seen,
        points=points,
        confidences=confidences,
        K=seen.K[:, :, :views],
        cam_from_world=seen.cam_from_world[:, :, :views],
        noise=noises,
    )


def moved(case, by):
    """Returns a case whose person stands elsewhere, shifted by (3,) metres."""
    by = np.asarray(by, np.float32)
    return dataclasses.replace(case, joints=case.joints + by, landmarks=case.landmarks + by)


CLEAR, SCALE, ITERATIONS, STEP = 0.5, 0.02, 15, 0.01
"""Least visibility of a landmark, scale of the robust weights in metres, iterations of reweighting,
and step of the derivatives in metres.
"""
RIDGE, WRONG = 1e-3, 0.05
"""Weight that keeps offsets near 0 along directions that no view shows, and the median error, as a
share of the person's height, above which a view is left out.
"""


@entry
def landmark_places(run: Run, captures: tuple[Path, ...]) -> None:
    """Measures where a detector puts its landmarks on bodies that are known. These are the places
    of `KeypointSet.places`.

    Every landmark is looked for in every view of the captures, whose bodies and cameras are taken
    for the truth. The offset from the base of its place, in the axes of the bones that carry it, is
    the one that explains all pixels best (robust least squares over all people; left and right are
    one landmark and its mirror image). `humangs synth` makes captures.

    Options:
    captures: capture folders, or folders of them
    """
    # what the views of all captures say about each landmark
    networks, seen = Networks(), {place.name: [] for place in MEDIAPIPE_33.places}
    for each in captures:
        for file in sorted(each.glob("**/capture.json")):
            for name, row in landmark_rows(networks, file.parent):
                seen[name].append(row)

    # a landmark and its mirror image are solved together, by the name that comes first
    places, rows = {}, []
    for name, own in seen.items():
        other = mirrored_name(name)
        if other in places:
            continue
        mirrored = []
        if name != other:
            mirrored = [(change * [-1, 1, 1], error) for change, error in seen[other]]
        if own or mirrored:
            offset, scatter = solved_offset(own + mirrored)
            places[name] = {
                "millimetres": np.round(offset, 1).tolist(),
                "scatter": round(scatter, 1),
            }
            rows.append([name, *(f"{x:.0f}" for x in offset), f"{scatter:.0f}"])
    header = ["landmark, left or middle", "to the left", "up", "forwards", "scatter, mm"]
    run.show(markdown_table(header, rows), {"places": places})


def landmark_rows(networks, folder):
    """Yields (name, (change of the image with the offset (2, 3), error (2,))) of the clear
    landmarks of a capture.

    Errors are in metres at the distance of the person. Views without a person, or with a detection
    that is far off, are left out.
    """
    # the model without offsets, and with a small offset along each axis
    capture, kind = load_capture(folder), MEDIAPIPE_33
    plain = tuple(place._replace(offset=(0.0, 0.0, 0.0)) for place in kind.places)
    model = landmark_model(capture.body, kind.names, plain)
    moved = [
        replace(model, points=replace(model.points, rest=model.points.rest + STEP * row))
        for row in jnp.eye(3)
    ]
    for view in range(capture.view_count):
        people = find_people(networks, np.asarray(capture.images[view], np.float32))
        if not people:
            continue
        pose, camera = capture.pose(int(capture.frames[view])), capture.cameras[view]
        betas = jnp.asarray(capture.betas)
        points = [pose_landmarks(each, betas, pose)[0] for each in (model, *moved)]
        projected = jax.vmap(functools.partial(project, camera))(jnp.stack(points))
        pixels, depths = (np.asarray(x, float) for x in projected)
        changes = np.moveaxis(pixels[1:] - pixels[0], 0, -1) / STEP
        errors = people[0].pixels + 0.5 - pixels[0]
        if np.median(np.linalg.norm(errors, axis=-1)) > WRONG * np.ptp(pixels[0], axis=0).max():
            continue
        scale = float(camera.K[0, 0]) / depths[0]
        for i in np.flatnonzero((people[0].visibility > CLEAR) & np.asarray(model.known, bool)):
            yield kind.names[i], (changes[i] / scale[i], errors[i] / scale[i])


def solved_offset(rows):
    """Returns the offset (3,) that explains the errors best, and the median length of the errors
    that are left, in millimetres.
    """
    changes, errors = (np.stack(each) for each in zip(*rows, strict=True))
    weights, offset = np.ones(len(rows)), np.zeros(3)
    for _ in range(ITERATIONS):
        matrix = np.einsum("n,nij,nik->jk", weights, changes, changes) + RIDGE * np.eye(3)
        offset = np.linalg.solve(matrix, np.einsum("n,nij,ni->j", weights, changes, errors))
        left = np.linalg.norm(errors - changes @ offset, axis=-1)
        weights = 1 / (1 + np.square(left / SCALE))
    return 1000 * offset, 1000 * float(np.median(left))
