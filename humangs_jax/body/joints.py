"""Names and parents of SMPL-X's 55 joints, which the shipped body shares."""

DEFAULT_FPS = 30.0
"""Frames per second of a motion if its file has no frame rate."""


BODY_NAMES = (
    *(
        "pelvis",
        "left_hip",
        "right_hip",
        "spine1",
        "left_knee",
        "right_knee",
        "spine2",
        "left_ankle",
        "right_ankle",
    ),
    *(
        "spine3",
        "left_foot",
        "right_foot",
        "neck",
        "left_collar",
        "right_collar",
        "head",
        "left_shoulder",
    ),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
FINGERS = ("index", "middle", "pinky", "ring", "thumb")

JOINT_NAMES = (
    *BODY_NAMES,
    *("jaw", "left_eye", "right_eye"),
    *(
        f"{side}_{finger}{knuckle}"
        for side in ("left", "right")
        for finger in FINGERS
        for knuckle in (1, 2, 3)
    ),
)
"""Names of the 55 joints: 22 of the body, jaw and eyes, then 15 per hand from the palm outwards."""


def _hand_parents(wrist: int, first: int) -> list[int]:
    """Returns the parents of the 15 joints of a hand: five fingers of three joints each. wrist: the
    parent of each finger's first joint. first: index of the first of the 15 joints.
    """
    return [parent for j in range(first, first + 15, 3) for parent in (wrist, j, j + 1)]


PARENTS = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19),
    *(15, 15, 15),
    *_hand_parents(20, 25),
    *_hand_parents(21, 40),
)
"""Parent of each joint, -1 for the pelvis; every finger starts at its wrist."""
