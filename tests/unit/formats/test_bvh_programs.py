"""Roles of the joints of the skeletons that programs write, by their names and by the tree alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh import ROLES, assign_roles
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions

HIK = "=Shoulder LeftArm=Arm LeftForeArm=ForeArm LeftHand=Hand"
HIK_LEG = "LeftUpLeg=UpLeg LeftLeg=Leg LeftFoot=Foot LeftToeBase=ToeBase"
HIK_TRUNK = "Hips=Hips Spine=Spine Spine1=Spine1 Neck=Neck Head=Head"


@dataclass(frozen=True)
class Program:
    """The names of a program; `NAME=ROLE` for the joints with a role, the parent first.

    Attributes:
        trunk: The path from the root to the head.
        arm: Joint that carries the arms, then the left arm.
        leg: Joint that carries the legs, then the left leg.
        sides: What the left and the right names have.
        extra: Further paths of joints without a role, the existing joint first.
    """

    trunk: str
    arm: str
    leg: str
    sides: tuple[str, str] = ("Left", "Right")
    extra: Sequence[str] = ()


PROGRAMS = {
    name: Program(**{**entry, "sides": tuple(entry.get("sides", ("Left", "Right")))})
    for name, entry in yaml.safe_load(
        Path(__file__).with_name("program_names.yaml").read_text(encoding="utf-8")
    ).items()
}
AT = dict(
    zip(load_skeleton("full_body", 1.75).roles, rest_positions(load_skeleton("full_body", 1.75)), strict=True)
)
"""Places of the joints of a standing person, metres, by role."""


@dataclass(frozen=True)
class Built:
    names: list[str]
    parents: list[int]
    roles: list[str]
    offsets: FloatArray


def build(program: Program, prefix: str = "") -> Built:
    """Return the skeleton of a program, in the T-pose of a standing person."""
    names: list[str] = []
    parents: list[int] = []
    roles: list[str] = []
    places: list[FloatArray] = []

    def add(path: list[str], parent: int, side: str) -> None:
        steps = [step.partition("=") for step in path]
        known = [AT[side * (role not in AT) + role] if role else None for _, _, role in steps]
        for index, (name, _, role) in enumerate(steps):
            place = known[index]
            if place is None:
                # A joint without a role lies on the line to the next joint with one, else beyond its parent.
                start = places[parent] if parent >= 0 else np.zeros(3)
                after = next((k for k in range(index, len(steps)) if known[k] is not None), None)
                end = None if after is None else known[after]
                sign = 1.0 if side == "Left" else -1.0
                step = [0.03 * sign, -0.02, 0.02]
                place = (
                    start + step
                    if end is None or after is None
                    else start + (end - start) / (after - index + 1)
                )
                if parent < 0:
                    place = np.zeros(3)
            names.append(prefix + name)
            parents.append(parent)
            roles.append((side if role in LIMB_PARTS else "") + role)
            places.append(np.asarray(place))
            parent = len(names) - 1

    add(program.trunk.split(), -1, "")
    for side, swap in (("Left", False), ("Right", True)):
        for path in (program.arm, program.leg, *program.extra):
            words = path.split()
            if not words or (swap and not any(program.sides[0] in word for word in words[1:])):
                continue
            if swap:
                words = [mirror(word, program.sides) for word in words]
            while prefix + words[1].partition("=")[0] in names:
                words = words[1:]
            add(words[1:], names.index(prefix + words[0].partition("=")[0]), side)
    at = np.array(places)
    offsets = at - np.where(np.array(parents)[:, None] >= 0, at[np.array(parents)], 0.0)
    return Built(names, parents, roles, offsets)


LIMB_PARTS = {role.removeprefix("Left") for role in ROLES if role.startswith("Left")}


def mirror(word: str, sides: tuple[str, str]) -> str:
    """Return the right name of a left one."""
    name, equals, role = word.partition("=")
    left, right = sides
    if len(left) == 1 and left.isalpha() and left.isascii():
        return (right + name[1:] if name.startswith(left) else name) + equals + role
    return name.replace(left, right) + equals + role


def assert_roles(built: Built, found: tuple[str, ...]) -> None:
    expected = {role: name for name, role in zip(built.names, built.roles, strict=True) if role}
    actual = {role: name for name, role in zip(built.names, found, strict=True) if role}
    assert actual == expected


@pytest.mark.parametrize("program", PROGRAMS)
def test_names_of_programs(program: str) -> None:
    built = build(PROGRAMS[program])
    assert_roles(built, assign_roles(built.names, built.parents, built.offsets))


@pytest.mark.parametrize("program", [name for name in PROGRAMS if name != "German"])
def test_names_without_lengths(program: str) -> None:
    """A rest pose of zeros gives no lengths; the names alone say the roles."""
    built = build(PROGRAMS[program])
    assert_roles(built, assign_roles(built.names, built.parents))


FINGERS = [f"LeftHand LeftHand{name}1 LeftHand{name}2 LeftHand{name}3" for name in ("Thumb", "Index")]
BODY = Program("Root " + HIK_TRUNK, f"Spine1 LeftShoulder{HIK}", f"Hips {HIK_LEG}", extra=FINGERS)
TURNS = [so3_exp(np.array(turn)) for turn in ([0, 0, 0], [0, 0, 3.1], [1.57, 0, 0], [0.4, -2.0, 0.9])]


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("name", ["joint_{:03d}", "bone.{:d}", "xx{:d}yy"])
def test_the_tree_alone(turn: FloatArray, name: str) -> None:
    """Limbs are pairs of chains with two long bones; the toes say where left and right are."""
    built = build(BODY)
    unknown = [name.format(number) for number in range(len(built.names))]
    found = assign_roles(unknown, built.parents, built.offsets @ turn.T)
    assert list(found) == built.roles


@pytest.mark.parametrize("sides", [("izq", "der"), ("gauche", "droite"), ("L", "R"), ("_x1", "_x2")])
def test_unknown_words_with_sides(sides: tuple[str, str]) -> None:
    """Sides from the names are used even where the toes point back."""
    built = build(BODY)
    turned = built.offsets * [[-1.0 if "Toe" in role else 1.0] for role in built.roles]
    known = sides[0] != "_x1"
    names = []
    for number, role in enumerate(built.roles):
        side = sides[0] if "Left" in role else sides[1] if "Right" in role else "mid"
        names.append(f"K{number}_{side}")
    found = assign_roles(names, built.parents, turned if known else built.offsets)
    assert list(found) == built.roles


def test_a_short_forearm_and_a_long_collar_bone() -> None:
    """Skeletons of CMU: 22 cm from the chest to the shoulder, 16 cm from the elbow to the wrist."""
    built = build(BODY)
    factors = {"LeftArm": 1.1, "RightArm": 1.1, "LeftHand": 0.62, "RightHand": 0.62}
    offsets = built.offsets * [[factors.get(role, 1.0)] for role in built.roles]
    found = assign_roles([f"j{number}" for number in range(len(offsets))], built.parents, offsets)
    assert list(found) == built.roles


def test_without_toes_nothing_says_the_sides() -> None:
    """A role on the wrong side is worse than no role."""
    built = build(
        Program(HIK_TRUNK, f"Spine1 LeftShoulder{HIK}", "Hips LeftUpLeg=UpLeg LeftLeg=Leg LeftFoot=Foot")
    )
    found = assign_roles([f"j{number}" for number in range(len(built.names))], built.parents, built.offsets)
    assert not [role for role in found if role.startswith(("Left", "Right"))]


SOME = Program(
    HIK_TRUNK,
    "Spine1 LShoulder=Shoulder Lqq=Arm Lxx=ForeArm LHand=Hand",
    "Hips LThigh=UpLeg LShin=Leg LFoot=Foot",
    ("L", "R"),
)


def test_an_unknown_name_on_the_limb_is_no_second_choice() -> None:
    """The joint between a shoulder and a hand is the elbow, whatever it is called."""
    built = build(SOME)
    assert_roles(built, assign_roles(built.names, built.parents, built.offsets))
    kept = [number for number, name in enumerate(built.names) if not name.startswith("R")]
    assert kept == sorted(kept)
    parents = [kept.index(built.parents[number]) if number else -1 for number in kept]
    one = Built([built.names[k] for k in kept], parents, [built.roles[k] for k in kept], built.offsets[kept])
    assert_roles(one, assign_roles(one.names, one.parents, one.offsets))


def test_a_second_meaning_needs_a_whole_limb() -> None:
    joints = ["Hips", "Spine", "LeftShoulder", "LeftHand", "RightShoulder", "RightHand"]
    assert assign_roles(joints, [-1, 0, 1, 2, 1, 4])[2:] == ("", "LeftHand", "", "RightHand")
