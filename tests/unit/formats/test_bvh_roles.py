"""Anatomical roles of the joints of common skeletons."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.formats.bvh import assign_roles

LIMBS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
ROLES = (
    "Hips",
    "Spine",
    "Spine1",
    "Neck",
    "Head",
    *(side + limb for side in ("Left", "Right") for limb in LIMBS),
)

HUMANIK = "LeftShoulder LeftArm LeftForeArm LeftHand LeftUpLeg LeftLeg LeftFoot LeftToeBase"
RIGS = {
    # name: trunk (hips, helpers..., chest), neck and head, then the left limbs in order ("-" = missing)
    "humanik": ("Hips Spine Spine1", "Neck Head", HUMANIK),
    "mixamo": (
        "mixamorig:Hips mixamorig:Spine mixamorig:Spine1 mixamorig:Spine2",
        "mixamorig:Neck mixamorig:Head",
        " ".join("mixamorig:" + name for name in HUMANIK.split()),
    ),
    "motionbuilder": (
        "Character1_Hips Character1_Spine Character1_Spine1",
        "Character1_Neck Character1_Head",
        " ".join("Character1_" + name for name in HUMANIK.split()),
    ),
    "unreal": (
        "pelvis spine_01 spine_02 spine_03",
        "neck_01 head",
        "clavicle_l upperarm_l lowerarm_l hand_l thigh_l calf_l foot_l ball_l",
    ),
    "biped": (
        "Bip01_Pelvis Bip01_Spine Bip01_Spine1",
        "Bip01_Neck Bip01_Head",
        "Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand "
        "Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0",
    ),
    "collar and elbow": (
        "Hips Chest Chest2",
        "Neck Head",
        "LeftCollar LeftShoulder LeftElbow LeftWrist LeftHip LeftKnee LeftAnkle LeftToe",
    ),
    "no collar": (
        "Hips Chest",
        "Neck Head",
        "- LeftShoulder LeftElbow LeftWrist LeftHip LeftKnee LeftAnkle -",
    ),
    "smpl": (
        "Pelvis Spine1 Spine2 Spine3",
        "Neck Head",
        "L_Collar L_Shoulder L_Elbow L_Wrist L_Hip L_Knee L_Ankle L_Foot",
    ),
    "poser": ("hip abdomen chest", "neck head", "lCollar lShldr lForeArm lHand lThigh lShin lFoot -"),
    "asf": (
        "root lowerback upperback thorax",
        "lowerneck head",
        "lclavicle lhumerus lradius lwrist lfemur ltibia lfoot ltoes",
    ),
    "rigify": (
        "hips spine chest",
        "neck head",
        "shoulder.L upper_arm.L forearm.L hand.L thigh.L shin.L foot.L toe.L",
    ),
}


def right(name: str) -> str:
    for left, other in (("Left", "Right"), ("_L_", "_R_"), ("L_", "R_"), (".L", ".R"), ("_l", "_r")):
        if left in name:
            return name.replace(left, other)
    return name if name == "-" else "r" + name[1:]


def build(rig: str, prefix: str = "") -> tuple[list[str], list[int], dict[str, str]]:
    """Return joints, parents and the expected joint of each role."""
    trunk, top, left = (part.split() for part in RIGS[rig])
    joints, parents = list(trunk), list(range(-1, len(trunk) - 1))
    expected = {"Hips": trunk[0], "Spine1": trunk[-1], "Neck": top[0], "Head": top[-1]}
    if len(trunk) > 2:
        expected["Spine"] = trunk[1]

    def chain(names: list[str], parent: int) -> None:
        for name in names:
            joints.append(name)
            parents.append(parent)
            parent = len(joints) - 1

    chain(top, len(trunk) - 1)
    for side, title in ((left, "Left"), ([right(name) for name in left], "Right")):
        chain([name for name in side[:4] if name != "-"], len(trunk) - 1)
        chain([name for name in side[4:] if name != "-"], 0)
        expected |= {title + limb: name for limb, name in zip(LIMBS, side, strict=True) if name != "-"}
    return [prefix + name for name in joints], parents, {r: prefix + n for r, n in expected.items()}


def found(joints: list[str], parents: list[int]) -> dict[str, str]:
    return {role: name for name, role in zip(joints, assign_roles(joints, parents), strict=True) if role}


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("prefix", ["", "actor:"])
def test_known_skeletons(rig: str, prefix: str) -> None:
    joints, parents, expected = build(rig, prefix)
    assert found(joints, parents) == expected


def test_roles_are_humanik_names_each_once() -> None:
    joints, parents, _ = build("humanik")
    roles = [role for role in assign_roles(joints, parents) if role]
    assert sorted(roles) == sorted(ROLES)


def test_helpers_twists_and_fingers_have_no_role() -> None:
    joints, parents, expected = build("unreal")
    for extra in ("upperarm_twist_01_l", "lowerarm_twist_01_l", "index_01_l", "ik_hand_l", "hand_end"):
        joints.append(extra)
        parents.append(joints.index("upperarm_l"))
    assert found(joints, parents) == expected


def test_clavicles_on_the_neck_leave_the_chest_below_it() -> None:
    """In 3ds Max's Biped, the collar bones are children of the neck."""
    joints, parents, expected = build("biped")
    for side in "LR":
        parents[joints.index(f"Bip01_{side}_Clavicle")] = joints.index("Bip01_Neck")
    assert found(joints, parents) == expected


def test_a_joint_with_a_bone_is_preferred_to_a_helper_of_zero_length() -> None:
    joints = ["Hips", "lowerback", "Chest", "Chest2", "lowerneck", "Neck", "Head", "LeftArm", "RightArm"]
    parents = [-1, 0, 1, 2, 3, 4, 5, 3, 3]
    offsets = np.ones((9, 3))
    offsets[[1, 4]] = 0.0
    roles = assign_roles(joints, parents, offsets)
    assert roles == ("Hips", "", "Spine", "Spine1", "", "Neck", "Head", "LeftArm", "RightArm")
    assert assign_roles(joints, parents)[1] == "Spine"


def test_a_tree_without_body_names_has_no_roles() -> None:
    assert assign_roles(["root", "a", "b"], [-1, 0, 1]) == ("Hips", "", "")
    assert assign_roles(["tail"], [-1]) == ("",)
