"""Measures how good the motion of a video is: faces and fingers of synthetic people, whose truth is
known, and one camera of a real capture against all four.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.harness import Run, entry
from experiments.real_capture import CAMERAS, VideoCamera, read_cameras, unpacked
from experiments.results import markdown_table
from humangs_jax.apps.video_motion import fit_video, look_at_video, rate_and_count
from humangs_jax.body.joints import BODY_NAMES, FINGERS, JOINT_NAMES
from humangs_jax.body.landmarks import landmark_model
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body, without_expression
from humangs_jax.capture.detection.face_and_hands import SHAPE_NAMES, FaceAndHands, hand_columns
from humangs_jax.capture.detection.people import Networks, find_people
from humangs_jax.capture.fitting.landmark_fit import LandmarkFit, fit_landmarks
from humangs_jax.capture.fitting.motion_fit import MotionFit
from humangs_jax.capture.fitting.residuals.keypoints import make_observations
from humangs_jax.capture.keypoints.formats import SeenPerson, columns_of
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, MEDIAPIPE_69
from humangs_jax.geometry.camera import look_at
from humangs_jax.io.images import DIAGONAL_35MM
from humangs_jax.synthetic.subject import SPLITS, expressed_subject, make_subject, render_view
from humangs_jax.synthetic.writer import sample_pose, stand

FITTING = SPLITS["fitting"]
STRONG = {
    "jaw": ("jawOpen",),
    "smile": ("mouthSmileLeft", "mouthSmileRight"),
    "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "brows": ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    "frown": ("browDownLeft", "browDownRight"),
    "pucker": ("mouthPucker",),
}
"""{expression that is varied: the shapes that move together in it}."""
BOTH = "brows less frown"
"""Name of the difference of two expressions, which says how high the brows are."""
FACE_SIDE, HEAD_PIXELS, HEAD_METRES = 512, 150, 0.24
"""Side of a picture in pixels, height of the head in it in pixels, and a usual height of a head."""
FEET = [BODY_NAMES.index(name) for name in ("left_foot", "right_foot")]
"""The balls of the feet among the joints of the body."""
LOW_SHARE, LOW = 0.1, 0.02
"""A foot stands while its ball is at most `LOW` metres above the quantile `LOW_SHARE` of its
heights.
"""
SMOOTHNESS = 0.002
"""Expected acceleration of the body that all cameras give, metres a frame^2: 7 m/s^2."""
ARMS_DOWN = 1.25
"""Radians by which the shoulders lower the arms of the T-pose."""


@entry
def motion_faces(run: Run, people: int = 8, faces: int = 12) -> None:
    """Correlates the scores of expressions with the coefficients that synthetic faces were rendered
    with. A correlation is that over all faces of a person.

    Heads are 150 pixels high in pictures of 512. Two or three of the strong expressions are mixed
    at a time.

    Options:
    people: number of people
    faces: number of faces of each person
    """
    body, networks, parts = load_body(), Networks(), FaceAndHands()
    assert body.expressions is not None
    names = body.expressions.names
    correlations, found = {name: [] for name in (*STRONG, BOTH)}, 0
    for seed in list(FITTING)[100 : 100 + people]:
        subject, rng = make_subject(seed, body), np.random.default_rng(seed)
        truth, scores = [], []
        for _ in range(faces):
            amounts = rng.uniform(0, 1, len(STRONG)) * (rng.uniform(0, 1, len(STRONG)) < 0.4)
            coefficients = np.zeros(len(names), np.float32)
            for amount, shapes in zip(amounts, STRONG.values(), strict=True):
                coefficients[[names.index(name) for name in shapes]] = amount
            picture = face_picture(expressed_subject(subject, body, coefficients), rng)
            seen = find_people(networks, picture)
            score = parts.face(picture, seen[0].pixels) if seen else None
            if score is not None:
                truth.append(amounts)
                scores.append(score)
        found += len(scores)
        asked = dict(zip(STRONG, np.asarray(truth).T, strict=True))
        given = {
            name: np.asarray(scores)[:, [SHAPE_NAMES.index(shape) for shape in shapes]].mean(1)
            for name, shapes in STRONG.items()
        }
        # brows that are raised and lowered at once are where both have left them
        for each in (asked, given):
            each[BOTH] = each["brows"] - each["frown"]
        for name in correlations:
            correlations[name].append(float(np.corrcoef(given[name], asked[name])[0, 1]))
    numbers = {
        name: {"mean": float(np.nanmean(each)), "least": float(np.nanmin(each))}
        for name, each in correlations.items()
    }
    rows = [[name, f"{each['mean']:.2f}", f"{each['least']:.2f}"] for name, each in numbers.items()]
    header = ["expression", "correlation, mean over people", "least"]
    share = found / (people * faces)
    text = f"{markdown_table(header, rows)}\n\nFaces were found in {share:.0%} of the pictures."
    run.show(text, {"expressions": numbers, "found": share, "people": people, "faces": faces})


def face_picture(subject, rng):
    """Draws the head and shoulders of a person from the front, turned by up to 20 degrees."""
    rotations = np.zeros((len(JOINT_NAMES), 3))
    for side, sign in (("left", -1), ("right", 1)):
        rotations[JOINT_NAMES.index(f"{side}_shoulder"), 2] = sign * ARMS_DOWN
    posed = stand(subject, rotations)
    top = posed.vertices[:, 1].max()
    target = np.asarray([0.0, top - 1.4 * HEAD_METRES, 0.0])
    azimuth, distance = np.radians(rng.uniform(-20, 20)), 1.6
    eye = target + distance * np.asarray([np.sin(azimuth), 0.05, np.cos(azimuth)])
    focal = HEAD_PIXELS * distance / HEAD_METRES
    middle = FACE_SIDE / 2
    K = jnp.asarray([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    place = [jnp.asarray(x, jnp.float32) for x in (eye, target, [0, 1, 0])]
    return render_view(posed, look_at(*place, K, FACE_SIDE, FACE_SIDE))[0].astype(np.float32)


FULL_SIDE, FULL_METRES = 1536, 2.1
"""Side of a picture of a whole person in pixels, and in metres at the person."""
HAND_VIEWS = (0.0, 50.0, -60.0, 120.0)
"""Degrees of the cameras around a person, 0: from the front."""


@entry
def motion_fingers(run: Run, people: int = 1, poses: int = 2) -> None:
    """Measures the joints of the fingers of synthetic people, fitted to photos of four known
    cameras with and without landmarks of hands.

    Without these landmarks only the prior of poses says how fingers bend. Errors are distances from
    the true joints after the palm is moved and turned onto the true palm.

    Options:
    people: number of people
    poses: number of poses of each person
    """
    body, networks, parts = load_body(), Networks(), FaceAndHands()
    errors, seen_hands = {"without": [], "with": []}, 0
    for seed in list(FITTING)[200 : 200 + people]:
        subject = make_subject(seed, body)
        stood = [sample_pose(subject, index) for index in range(poses)]
        rest = shape_body(body, jnp.asarray(subject.betas))
        truth = []
        for each in stood:
            pose = BodyPose(jnp.asarray(each.rotations), jnp.asarray(each.translation))
            truth.append(np.asarray(pose_body(body, rest, pose).joints))

        # what is seen of the person and the hands, in every pose by every camera
        shown = [posed for posed in stood for _ in HAND_VIEWS]
        cameras = [full_camera(posed, azimuth) for posed in stood for azimuth in HAND_VIEWS]
        rows = []
        for posed, camera in zip(shown, cameras, strict=True):
            picture = render_view(posed, camera)[0].astype(np.float32)
            person = next(iter(find_people(networks, picture)), None)
            if person is None:
                rows.append(None)
                continue
            hands = parts.hands(picture, person.pixels, person.visibility)
            seen_hands += sum(hand is not None for hand in hands)
            points = np.column_stack([person.pixels, person.visibility])
            columns = hand_columns(hands, person.world)
            rows.append(SeenPerson(points, person.world, 1.0, columns))

        # fits without and with the landmarks of hands
        for name, kind in (("without", MEDIAPIPE_33), ("with", MEDIAPIPE_69)):
            joints = fitted_joints(body, rows, cameras, kind)
            errors[name] += [finger_errors(*pair) for pair in zip(joints, truth, strict=True)]
    numbers = {name: 1000 * float(np.mean(each)) for name, each in errors.items()}
    rows = [[f"{name} landmarks of hands", f"{value:.1f}"] for name, value in numbers.items()]
    share = seen_hands / (2 * people * poses * len(HAND_VIEWS))
    text = markdown_table(["fit", "finger joints, mean error, mm"], rows)
    text += f"\n\nOf all hands in the photos {share:.0%} were found."
    run.show(text, {"mm": numbers, "hands_found": share, "people": people, "poses": poses})


def fitted_joints(body, rows, cameras, kind):
    """Fits the body to the landmarks of a set, and returns the joints (poses, j, 3) in metres.

    `rows` are what was seen, and `cameras` are the cameras, of all views of a pose after each
    other.
    """
    poses = len(rows) // len(HAND_VIEWS)

    def stacked(arrays):
        return np.asarray(arrays).reshape(poses, len(HAND_VIEWS), *arrays[0].shape)

    columns = [columns_of(seen, kind is MEDIAPIPE_69) for seen in rows]
    columns = np.asarray(columns).reshape(poses, len(HAND_VIEWS), len(kind.names), 6)
    observations = make_observations(
        columns[..., :2] + 0.5,
        columns[..., 2],
        stacked([np.asarray(camera.K) for camera in cameras]),
        stacked([np.asarray(camera.cam_from_world) for camera in cameras]),
    )
    model = landmark_model(body, kind.names, kind.places)
    return np.asarray(fit_landmarks(model, observations).joints)


def full_camera(posed, azimuth):
    """Returns a camera that sees a whole person from this many degrees around the front."""
    target = (posed.vertices.min(0) + posed.vertices.max(0)) / 2
    angle, distance = np.radians(azimuth), 3.0
    eye = target + distance * np.asarray([np.sin(angle), 0.1, np.cos(angle)])
    focal, middle = FULL_SIDE * distance / FULL_METRES, FULL_SIDE / 2
    K = jnp.asarray([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    place = [jnp.asarray(x, jnp.float32) for x in (eye, target, [0, 1, 0])]
    return look_at(*place, K, FULL_SIDE, FULL_SIDE)


def finger_errors(joints, truth):
    """Returns the mean distance in metres of the finger joints of both hands from the true ones,
    after each palm is moved and turned onto the true palm.
    """
    found = []
    for side in ("left", "right"):

        def number(name, side=side):
            return JOINT_NAMES.index(f"{side}_{name}")

        palm = [number("wrist"), *(number(f"{each}1") for each in FINGERS if each != "thumb")]
        fingers = [number(f"{each}{k}") for each in FINGERS for k in (2, 3)]
        middle, true_middle = joints[palm].mean(0), truth[palm].mean(0)
        turn, _ = Rotation.align_vectors(truth[palm] - true_middle, joints[palm] - middle)
        moved = turn.apply(joints[fingers] - middle) + true_middle
        found.append(np.linalg.norm(moved - truth[fingers], axis=-1))
    return float(np.mean(found))


@entry
def motion_cameras(run: Run, folder: Path, timed_frames: int = 240) -> None:
    """Compares the motion that each of four cameras finds alone with the body that all four find
    together, in the real capture of `real_capture`, a man who balances on a beam.

    "joints" is the mean distance of the body's joints from those of the body of all four, measured
    from the pelvis. The motion was given the man's height, or, in "with his body", his joints.
    "turned" is the distance after all frames of a video are turned by one rotation, which takes out
    the error that a single camera makes about its tilt. "third difference" is a mean length over
    joints and frames. "feet" is how far the ball of a foot that is on the beam moves across the
    beam in a frame.

    Options:
    folder: folder with the unpacked wheel of pose2sim, see real_capture
    timed_frames: number of frames of the first video, played forwards and backwards, whose motion
        the command finds in a separate process; 0: none
    """
    demo, body = unpacked(folder), without_expression(load_body())
    lenses, seen_by, found = read_cameras(demo / "calibration" / "Calib.qca.txt"), {}, {}
    numbers: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as place:
        for name in CAMERAS:
            video = demo / "videos" / f"{name}.mp4"
            # each video is looked at once; frames are looked at smaller than they are
            kept = Path(place) / f"{name}.npz"
            seen, size = look_at_video(video, rate_and_count(video)[1], None, kept)
            seen_by[name] = (lenses[name], max(size) / max(video_size(video)), seen)

        # the truth is the body of all four cameras
        all_four = body_of_all(body, list(seen_by.values()))
        truth = np.asarray(all_four.joints)[:, : len(BODY_NAMES)]
        rest = shape_body(body, all_four.betas)
        height = float(np.ptp(np.asarray(rest.vertices)[:, 1]))

        # the motions of each camera alone, given the height and given the body
        for name, (lens, scale, _) in seen_by.items():
            # from the picture's pixels to millimetres of film
            looked = scale * np.asarray(video_size(demo / "videos" / f"{name}.mp4"))
            options: dict[str, Any] = {
                "focal_mm": DIAGONAL_35MM * scale * lens.K[0, 0] / np.hypot(*looked),
                "kept": Path(place) / f"{name}.npz",
            }
            video = demo / "videos" / f"{name}.mp4"
            found[name] = [
                in_the_calibration(fit_video(video, **options, **known).fit, lens)[: len(truth)]
                for known in ({"height": height}, {"rest_joints": np.asarray(rest.joints)})
            ]
        if timed_frames:
            numbers["command"] = command_time(
                demo / "videos" / f"{CAMERAS[0]}.mp4", timed_frames, Path(place)
            )

    # distances from the truth, and how still the motions are
    beam, standing = along_and_on(truth)
    numbers["all four"] = {
        "third_difference_mm": third_difference(truth),
        "feet_mm": feet_slide(truth, beam, standing),
    }
    from_pelvis = truth - truth[:, :1]
    for name, (by_height, by_body) in found.items():
        own = by_height - by_height[:, :1]
        turn, _ = Rotation.align_vectors(from_pelvis.reshape(-1, 3), own.reshape(-1, 3))
        numbers[name] = {
            "joints_mm": distance(own, from_pelvis),
            "own_body_mm": distance(by_body - by_body[:, :1], from_pelvis),
            "turned_mm": distance(own @ turn.as_matrix().T, from_pelvis),
            "third_difference_mm": third_difference(by_height),
            "feet_mm": feet_slide(by_height, beam, standing),
        }
    keys = ("joints_mm", "own_body_mm", "turned_mm", "third_difference_mm", "feet_mm")
    numbers["mean"] = {
        key: float(np.mean([numbers[name][key] for name in CAMERAS])) for key in keys
    }

    # a line for each camera; the body of all four has no distance from itself
    def shown(value):
        return "" if value is None else f"{value:.1f}"

    rows = [
        [name, *(shown(numbers[name].get(key)) for key in keys)]
        for name in (*CAMERAS, "mean", "all four")
    ]
    header = ["camera", "joints, mm", "with his body", "turned", "third difference, mm a frame^3"]
    text = markdown_table([*header, "feet, mm a frame"], rows)
    if timed_frames:
        taken = numbers["command"]
        text += (
            f"\n\n`humangs motion` of {timed_frames} frames: {taken['wall']:.0f} s,"
            f" {taken['cpu']:.0f} s of CPU time."
        )
    run.show(text, numbers)


def in_the_calibration(fit: MotionFit, lens: VideoCamera) -> np.ndarray:
    """Returns the joints of the body in the axes of the calibration's world, in metres from an
    unknown point.
    """
    turn = lens.cam_from_world[:3, :3].T @ fit.cam_from_world[:3, :3]
    return fit.joints[:, : len(BODY_NAMES)] @ turn.T


def video_size(video: Path) -> tuple[int, int]:
    """Returns width and height of a video's frames in pixels."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(video))
    size = next(reader)["size"]
    reader.close()
    return size


def command_time(video: Path, frames: int, folder: Path) -> dict[str, float]:
    """Returns the seconds of `humangs motion` on this many frames of a video, played forwards and
    backwards, with an empty cache of compiled programs.
    """
    import imageio_ffmpeg

    long = folder / "long.mp4"
    swing = "[0]split=4[a][b][c][d];[b]reverse[e];[d]reverse[f];[a][e][c][f]concat=n=4"
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(video)]
    cut = ["-filter_complex", swing, "-frames:v", str(frames), str(long)]
    subprocess.run([*ffmpeg, *cut], check=True)
    environment = os.environ | {"HUMANGS_COMPILE_CACHE": str(folder / "cache")}
    command = [sys.executable, "-m", "humangs_jax", "motion", str(long)]
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [*command, "--out", str(folder / "long.npz")],
        check=True,
        env=environment,
        stdout=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return {"frames": frames, "wall": time.perf_counter() - began, "cpu": cpu}


def body_of_all(
    body: BodyModel, cameras: list[tuple[VideoCamera, float, dict[str, np.ndarray]]]
) -> LandmarkFit:
    """Fits the body and its motion to the landmarks of all cameras together, as `humangs fit
    --smoothness` does, in metres in the world of the calibration.

    Args:
        body: the body to fit
        cameras: for each camera its lens, the size of the frames that were looked at as a share of
            the video's, and the arrays of what was seen
    """
    count = min(len(seen["points"]) for _, _, seen in cameras)
    points, confidences = [], []
    for lens, scale, seen in cameras:
        straight = lens.undistorted(seen["points"][:count].astype(float).reshape(-1, 2) / scale)
        points.append(straight.reshape(count, -1, 2))
        confidences.append(seen["confidences"][:count])
    matrices = [np.stack([lens.K for lens, _, _ in cameras])] * count
    places = [np.stack([lens.cam_from_world for lens, _, _ in cameras])] * count
    observations = make_observations(
        np.stack(points, axis=1),
        np.stack(confidences, axis=1),
        np.stack(matrices),
        np.stack(places),
    )
    kind = MEDIAPIPE_69
    model = landmark_model(body, kind.names, kind.places, kind.certainty)
    return fit_landmarks(model, observations, smoothness=SMOOTHNESS)


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the mean distance in mm of corresponding points, which are in metres."""
    return 1000 * float(np.linalg.norm(a - b, axis=-1).mean())


def third_difference(joints: np.ndarray) -> float:
    """Returns the mean length of the third differences of joints over time, mm a frame^3."""
    return 1000 * float(np.linalg.norm(np.diff(joints, n=3, axis=0), axis=-1).mean())


def along_and_on(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the direction (3,) of the beam, along which the feet step, and whether each foot
    (frames - 1, 2) stands on it from a frame to the next.

    A foot stands while its ball is low. y is up.
    """
    feet = joints[:, FEET]
    heights = feet[..., 1]
    low = heights < np.quantile(heights, LOW_SHARE, axis=0) + LOW
    standing = low[1:] & low[:-1]
    moved = np.diff(feet, axis=0)[standing] * [1.0, 0.0, 1.0]
    return np.linalg.svd(moved)[2][0], standing


def feet_slide(joints: np.ndarray, beam: np.ndarray, standing: np.ndarray) -> float:
    """Returns how far standing feet move across the beam in the mean, mm a frame."""
    moved = np.diff(joints[:, FEET], axis=0)[standing]
    across = moved - (moved @ beam)[:, None] * beam
    return 1000 * float(np.linalg.norm(across, axis=-1).mean())
