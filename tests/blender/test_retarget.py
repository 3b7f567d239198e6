"""The motion on another character: Rigify's metarig, and a Mixamo-named skeleton of other proportions."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import JobError
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.formats.fbx import find_blender
from bodycap_batch.formats.gltf import write_glb
from bodycap_batch.model.bone_axes import align_axes_with_bones
from bodycap_batch.model.skeleton import Motion
from tests.bodies import merged
from tests.steps import SIDES, walking

pytestmark = pytest.mark.blender
SCRIPT = Path(__file__).with_name("retarget_and_look.py")
PROPORTIONS = {"UpLeg": 0.85, "Leg": 0.80, "Arm": 1.15, "ForeArm": 1.10, "Hand": 1.0, "Spine1": 1.15}
"""Ratios of bone lengths of the other character: short legs, long arms and trunk."""


def other_proportions() -> Motion:
    """Return one frame of a character with other proportions, in its T-pose."""
    motion, _ = walking(2)
    body = motion.skeleton
    parts = [role.removeprefix("Left").removeprefix("Right") for role in body.roles]
    # The bone of a joint ends at its child, so the child's offset has the joint's ratio.
    gain = [1.0, *(PROPORTIONS.get(parts[body.parents[j]], 1.0) for j in range(1, len(parts)))]
    offsets = body.offsets_m * np.array(gain)[:, None]
    legs = [body.roles.index(f"Left{part}") for part in ("Leg", "Foot")]
    offsets[0, 2] += sum(float(body.offsets_m[j, 2] - offsets[j, 2]) for j in legs)
    still = np.tile(np.eye(3), (2, len(parts), 1, 1))
    skeleton = replace(body, offsets_m=offsets)
    at = np.tile(offsets[0], (2, 1))
    motion = replace(motion, skeleton=skeleton, root_in_world_m=at, local_rotation=still)
    return align_axes_with_bones(apply_layout(motion, ExportOptions(names="mixamo")))


@dataclass(frozen=True)
class Result:
    scale: float
    joints: dict[str, np.ndarray]
    wanted: dict[str, np.ndarray]
    turns: dict[str, np.ndarray]
    stands: np.ndarray


@pytest.fixture(scope="module", params=["metarig", "mixamo"])
def result(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Result:
    try:
        blender = find_blender()
    except JobError as error:
        pytest.skip(f"{error.message}; {error.hint}")
    folder = tmp_path_factory.mktemp(request.param)
    motion, stands = walking(90)
    merge, clocks = merged(motion, projected=False)
    inputs = ExportInputs(out_dir=folder, maps=(), trajectories=(), clocks=clocks, merge=merge)
    export_results(inputs, ExportOptions(formats=("glb", "blender")), StageContext(work_dir=folder))
    character = "metarig"
    if request.param == "mixamo":
        character = str(folder / "character.glb")
        write_glb(character, other_proportions())
    facts = folder / "facts.json"
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [str(blender), str(SCRIPT), str(folder), character, str(facts)],
        capture_output=True, text=True, check=False, timeout=300, env=clean,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    data = json.loads(facts.read_text())
    arrays = {key: {r: np.array(v) for r, v in data[key].items()} for key in ("joints", "wanted", "turns")}
    return Result(data["scale"], **arrays, stands=stands)


def test_the_character_has_other_proportions(result: Result) -> None:
    assert abs(result.scale - 1.0) > 0.02


def test_standing_feet_do_not_slide(result: Result) -> None:
    for number, side in enumerate(SIDES):
        stands = result.stands[:, number]
        ends = np.flatnonzero(np.diff(np.concatenate([[0], stands.astype(int), [0]])))
        for first, last in ends.reshape(-1, 2):
            ankle = result.joints[f"{side}Foot"][first:last]
            assert np.ptp(ankle, axis=0).max() < 0.02


def test_hands_reach_the_scaled_places(result: Result) -> None:
    for side in SIDES:
        off = np.linalg.norm(result.joints[f"{side}Hand"] - result.wanted[f"{side}Hand"], axis=1)
        assert off.max() < 0.05


def test_the_path_is_scaled(result: Result) -> None:
    hips = (result.joints["LeftUpLeg"] + result.joints["RightUpLeg"]) / 2
    wanted = (result.wanted["LeftUpLeg"] + result.wanted["RightUpLeg"]) / 2
    np.testing.assert_allclose(hips, wanted, atol=1e-3)


def test_nothing_flips_and_knees_bend_forward(result: Result) -> None:
    """No bone turns by more than 60° in 1/30 s; each knee stays before the line from hip to ankle."""
    for role, quats in result.turns.items():
        turn = 2 * np.degrees(np.arccos(np.clip(np.abs((quats[1:] * quats[:-1]).sum(axis=1)), 0, 1)))
        assert turn.max() < 60.0, role
    for side in SIDES:
        hip, knee, ankle = (result.joints[f"{side}{part}"] for part in ("UpLeg", "Leg", "Foot"))
        along = (ankle - hip) / np.linalg.norm(ankle - hip, axis=1, keepdims=True)
        before = knee - hip - np.sum((knee - hip) * along, axis=1, keepdims=True) * along
        assert before[:, 1].max() < 0.0
