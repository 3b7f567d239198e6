"""`bodycap skeleton`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import HeightOption, make_overrides, split_pair
from bodycap_batch.cli.terminal import print_json, print_lines, table_lines

if TYPE_CHECKING:
    from bodycap_batch.formats.bvh import RigOptions
    from bodycap_batch.model.skeleton import Motion, SkeletonModel


@app.command()
def skeleton(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE.bvh", help="BVH file with the skeleton of a subject or a character."),
    ],
    roles: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="JOINT=ROLE",
            help="Give a role to a joint; the role `none` means no role. You can repeat this option.",
        ),
    ] = None,
    tpose_frame: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of the frame with the T-pose (the first frame is 0), if the zero pose is no "
            "pose of a body. Default: the frame nearest to a T-pose.",
        ),
    ] = None,
    height: HeightOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the roles of all joints as JSON.")] = False,
) -> None:
    """Show how a rig is interpreted, before a job uses it.

    Lists the role of each joint, the length and direction of its bone, and the missing roles. Roles follow
    from the names and from the tree. Up and forward follow from the joints, whatever axes the file has.
    The motion does not rotate joints without a role (fingers, twist bones, helpers). The results keep
    hierarchy, OFFSETs, channel order and zero pose of the file.

    \b
    Examples:
      bodycap skeleton hero.bvh
      bodycap skeleton hero.bvh --map Bip_Chest=Spine1 --map prop_01=none
      bodycap skeleton hero.bvh --tpose-frame 0
      bodycap run my_walk/ --skeleton hero.bvh
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.formats.bvh import RigOptions, inspect_rig, missing_roles
    from bodycap_batch.formats.bvh.skeleton_description import describe_joints

    stated = make_overrides(height=height).height_m
    height_m = None if isinstance(stated, str) else stated  # the text asks for a run without a height
    options = RigOptions(roles=_parse_roles(roles or []), tpose_frame=tpose_frame, height_m=height_m)
    rig, motion, problem = inspect_rig(file, options)
    if as_json:
        joints = [dataclasses.asdict(line) for line in describe_joints(rig)]
        findings = {"notes": rig.notes, "warnings": rig.warnings}
        print_json({"joints": joints, "missing": missing_roles(rig), **findings}, indent=1)
    else:
        heading = _heading_lines(file, rig, motion, tpose_frame)
        print_lines((*heading, "", *_joint_table(rig), "", *_closing_lines(rig, options)))
    if problem is not None:
        raise problem


def _parse_roles(words: list[str]) -> dict[str, str]:
    """Return the role of each joint by joint name, from words of the form ``JOINT=ROLE``."""
    hint = "write JOINT=ROLE, for example --map Bip_Chest=Spine1"
    return dict(split_pair(word, form="JOINT=ROLE", field="--map", hint=hint) for word in words)


def _heading_lines(file: Path, rig: SkeletonModel, motion: Motion | None, frame: int | None) -> list[str]:
    import numpy as np

    from bodycap_batch.formats.bvh.skeleton_description import describe_arm_pose
    from bodycap_batch.model.skeleton import rest_pose

    rest = rest_pose(rig)
    tips = rest[:, :3, 3] + (rest[:, :3, :3] @ np.nan_to_num(rig.end_offsets_m)[:, :, None])[..., 0]
    heights = [*rest[:, 2, 3], *tips[:, 2]]
    count = 0 if motion is None else len(motion.root_in_world_m)
    frames = f"{count} frame{'s' * (count != 1)}" + (f" at {motion.fps:g} Hz" if motion and count > 1 else "")
    pose = "rest pose" if frame is None else f"frame {frame}"
    return [
        f"{file.name}: {len(rig.joints)} joints, {frames}",
        f"{pose}: {describe_arm_pose(rig)}; {max(heights) - min(heights):.2f} m from top to bottom",
    ]


def _joint_table(rig: SkeletonModel) -> list[str]:
    from bodycap_batch.formats.bvh.skeleton_description import describe_joints

    rows = [("joint", "role", "bone", "points", "")]
    depth: dict[str, int] = {"": -1}
    for line in describe_joints(rig):
        depth[line.name] = depth[line.parent] + 1
        name = "  " * min(depth[line.name], 12) + line.name
        bone = f"{100.0 * line.bone_m:5.1f} cm" if line.points else ""
        rows.append((name, line.role or "-", bone, line.points, line.note))
    return table_lines(rows)


def _closing_lines(rig: SkeletonModel, options: RigOptions) -> list[str]:
    from bodycap_batch.formats.bvh import missing_roles

    missing = missing_roles(rig)
    lines = [f"roles without a joint: {', '.join(missing)}" if missing else "every role has a joint"]
    lines += [f"note: {text}" for text in rig.notes] + [f"warning: {text}" for text in rig.warnings]
    if options.roles:
        pairs = ", ".join(f"{json.dumps(name)}: {role}" for name, role in options.roles.items())
        lines.append(f"write in the job: skeleton_map: {{{pairs}}}")
    if options.tpose_frame is not None:
        lines.append(f"write in the job: tpose_frame: {options.tpose_frame}")
    return lines
