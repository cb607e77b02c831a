"""Names of the joints of CMU's skeleton in other programs."""

from bvh_files import CMU

CENTRE = "Hips Spine Chest UpperChest Neck Head"


def renamed(limbs, form="{side}{limb}", **middle):
    """Returns the names of CMU's joints in another program.

    `limbs` are the names of the limbs' joints, `form` says where a name has its side, and `middle`
    gives the other names.
    """
    parts = dict(
        zip(
            ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot"),
            limbs.split(),
            strict=True,
        )
    )
    names = (
        dict(
            zip(
                ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
                CENTRE.split(),
                strict=True,
            )
        )
        | middle
    )

    def sided(ours):
        side, limb = ours.split("_")
        return form.format(side=side.title(), s=side[0], S=side[0].upper(), limb=parts[limb])

    return {ours: sided(ours) if "_" in ours else names[ours] for ours in CMU}


NAMED = {
    "a common beginning": {ours: f"Model_{theirs}" for ours, theirs in CMU.items()},
    "a common end": {ours: f"{theirs}_JNT" for ours, theirs in CMU.items()},
    "SMPL": {ours: ours for ours in CMU},
    "SMPL, L_": {ours: ours.replace("left_", "L_").replace("right_", "R_") for ours in CMU},
    "Unreal": renamed(
        "clavicle upperarm lowerarm hand thigh calf foot ball",
        "{limb}_{s}",
        pelvis="pelvis",
        neck="neck_01",
    ),
    "Unity": renamed("Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes"),
    "VRM": renamed(
        "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot ToeBase",
        "J_Bip_{S}_{limb}",
        pelvis="J_Bip_C_Hips",
    ),
    "Bandai-Namco": renamed(
        "Shoulder UpperArm LowerArm Hand UpperLeg LowerLeg Foot Toes", "{limb}_{S}"
    ),
    "Xsens": renamed(
        "Shoulder UpperArm ForeArm Hand UpperLeg LowerLeg Foot Toe",
        pelvis="Pelvis",
        spine1="L5",
        spine2="L3",
        spine3="T8",
    ),
    "SOMA": renamed("Shoulder Arm ForeArm Hand Leg Shin Foot ToeBase", neck="Neck1"),
    "Rocketbox": renamed(
        "Clavicle UpperArm Forearm Hand Thigh Calf Foot Toe0",
        "Bip01 {S} {limb}",
        pelvis="Bip01 Pelvis",
    ),
    "Rigify": renamed(
        *("shoulder upper_arm forearm hand thigh shin foot toe", "DEF-{limb}.{S}"),
        **{"pelvis": "DEF-spine", "neck": "DEF-spine.004", "head": "DEF-spine.006"}
        | {f"spine{i}": f"DEF-spine.00{i}" for i in (1, 2, 3)},
    ),
    "JNT": renamed(
        "clav uparm loarm hand upleg loleg foot ball",
        "{s}_{limb}_JNT",
        pelvis="c_root_JNT",
        neck="neck_JNT",
    ),
    "Daz": renamed(
        "Collar ShldrBend ForearmBend Hand ThighBend Shin Foot Toe",
        "{s}{limb}",
        pelvis="hip",
        neck="neckLower",
    ),
    "Advanced Skeleton": renamed(
        "Scapula Shoulder Elbow Wrist Hip Knee Ankle Toes",
        "{limb}_{S}",
        pelvis="Root_M",
        head="Head_M",
    ),
    "behind": renamed(
        "Shoulder Arm ForeArm Hand UpLeg Leg Foot ToeBase", "{limb}Left", pelvis="Hips"
    )
    | {ours: f"{theirs}.R" for ours, theirs in CMU.items() if ours.startswith("right")},
    "few spine joints": CMU | {"spine1": "Tail", "spine3": "Chest"},
    "numbers": {ours: f"Joint_{i:02d}" for i, ours in enumerate(CMU)},
    "numbers backwards": {ours: f"bone{40 - i}" for i, ours in enumerate(CMU)},
    "unknown words": {ours: f"part {i * 7919 % 1000}" for i, ours in enumerate(CMU)},
}
NAMED["behind"] |= {
    ours: name.replace("Right", "")
    for ours, name in NAMED["behind"].items()
    if ours.startswith("right")
}
