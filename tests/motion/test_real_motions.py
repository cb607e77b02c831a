"""Motions that other programs wrote (tests/data/files) have the values of their own numbers."""

import csv
import json
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.motion import load_motion
from humangs_jax.motion.rules import joint_places
from humangs_jax.motion.skeleton import shipped_joints

FILES = Path(__file__).parents[1] / "data" / "files"
DEGREES = 8.0
"""Largest angle between the file's upper arm and ours: rest poses of people differ a little."""


def test_an_animation_of_univrm_lifts_the_arm_that_the_file_lifts_and_smiles():
    """Its bones have turned axes, as Blender's have."""
    path = FILES / "three-vrm/test.vrma"
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    nodes = json.loads(data[20 : 20 + length])["nodes"]
    above = {child: i for i, node in enumerate(nodes) for child in node.get("children", ())}
    upper, lower = (
        next(i for i, node in enumerate(nodes) if node["name"] == name)
        for name in ("rightUpperArm", "rightLowerArm")
    )
    chain, turn = [above[upper]], Rotation.identity()
    while chain[-1] in above:
        chain.append(above[chain[-1]])
    for node in chain[::-1]:
        turn = turn * Rotation.from_quat(nodes[node].get("rotation", [0, 0, 0, 1]))
    key = Rotation.from_quat([0.7071, 0, 0, 0.7071])  # the second key of the arm, the first is 0
    arm = nodes[lower]["translation"]
    expected = [turn.apply(arm), (turn * key).apply(arm)]

    motion = load_motion(path)
    assert motion.fps == 2.0 and len(motion.rotations) == 7
    rotations = np.asarray(motion.rotations, float)
    places = joint_places(shipped_joints(), rotations, np.asarray(motion.translations, float))
    ends = [JOINT_NAMES.index(f"right_{name}") for name in ("shoulder", "elbow")]
    for frame, wanted in enumerate(expected):
        found = np.diff(places[frame, ends], axis=0)[0]
        cosine = found @ wanted / np.linalg.norm(found) / np.linalg.norm(wanted)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < DEGREES, frame
    smile = np.asarray(motion.expressions_of(("mouthSmileLeft",))[:, 0])
    assert smile[0] == 0 and smile.max() > 0.5


def test_a_take_of_live_link_face_has_its_numbers_and_its_rate():
    path = FILES / "livelinkface/alex_rom_3.csv"
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    motion = load_motion(path)
    assert motion.fps == 30.0 and len(motion.rotations) == len(rows) == 3  # every second of 60
    for name, column in {"jawOpen": "JawOpen", "eyeBlinkLeft": "EyeBlinkLeft"}.items():
        wanted = [float(row[column]) for row in rows]
        found = np.asarray(motion.expressions_of((name,))[:, 0])
        np.testing.assert_allclose(found, wanted, atol=1e-6)
