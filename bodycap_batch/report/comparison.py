"""Compare two motions side by side: joint angles, paths and contacts, as figures and as a page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, runs
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.atomic_files import write_text
from bodycap_batch.formats.bvh import inspect_rig
from bodycap_batch.formats.joint_positions import motion_from_positions, read_joint_positions
from bodycap_batch.formats.joint_table import read_joint_table
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.model.joint_angles import angle_curves, foot_curves
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.report.figures.motion_curves import Take, draw_motion_curves
from bodycap_batch.report.figures.svg import element, path_through, svg_image, text
from bodycap_batch.report.page import render_template

MOTION_FILE = "motion.bvh"
_TRUTH_FILES = ("gt/joints.npz", "joints.npz")
"""True joint positions in a folder without `MOTION_FILE`."""
_NAMES = ("A", "B")
_PATH_SIZE, _PATH_MARGIN = 460.0, 26.0
"""Size and margin of the drawing of the paths, SVG units."""
_PATH_ROLES = ("Hips", "LeftHand", "RightHand")
"""Roles of the joints whose paths are drawn."""
_SCALE_BARS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""Possible lengths of the scale bar, metres."""
_STEP_LEAST_S = 0.1
"""Shortest contact (seconds) that counts as a step. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two takes and the figures of their difference.

    Attributes:
        takes: The two takes, with the second one moved to the start and the direction of the first one.
        sources: The paths that were given.
        figures: Plain JSON values: ``angles`` by name, ``feet`` by name, ``motions`` by take.
    """

    takes: tuple[Take, Take]
    sources: tuple[str, str]
    figures: dict[str, Any]


def load_take(path: Path, name: str, start_s: float = 0.0) -> Take:
    """Read a motion from a BVH file, a results folder or a truth of joint positions.

    In a results folder, ``joints.csv`` says which joints were measured at which time.

    Args:
        path: A BVH file, a file ``joints.npz`` with true joint positions, a folder with ``motion.bvh``, or a
            capture folder with ``gt/joints.npz``.
        name: Name of the take.
        start_s: Time of the first tick on the axis of the comparison, seconds.

    Raises:
        JobError: There is no motion, or a file cannot be read.
    """
    file = path / MOTION_FILE if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        truths = [path / name for name in _TRUTH_FILES if (path / name).is_file()]
        file = truths[0] if truths else file
    if not file.is_file():
        raise JobError(
            "there is no motion to compare",
            path=file,
            hint="give a BVH file, a folder with a motion.bvh, or a truth as gt/joints.npz",
        )
    if file.suffix.lower() == ".npz":
        motion = motion_from_positions(read_joint_positions(file))
        if motion is None:
            raise JobError(
                "the file holds no motion of a body: it has no hips or only one time",
                path=file,
                hint="give a file whose names contain root, and at least two times",
            )
        return Take(name=name, motion=motion, start_s=start_s)
    _, motion, _ = inspect_rig(file)  # the clearance of the feet needs the axes of the body
    if motion is None:
        raise JobError("the BVH file contains no frames", path=file, hint="give a BVH file with a motion")
    table = file.with_name("joints.csv")
    if path.is_dir() and table.is_file():
        motion = replace(motion, observed=_observed(table, motion))
    return Take(name=name, motion=motion, start_s=start_s)


def _observed(table: Path, motion: Motion) -> BoolArray:
    """Return which joints were measured at which tick, from ``joints.csv``; True for unknown joints.

    The table has the ticks and names of the solved motion. The file for animation may have another rate and
    other names, so joints are matched by role and ticks by time.
    """
    try:
        facts = json.loads(table.with_name("metrics.json").read_bytes())["motion"]
        role_of = {name: joint["role"] for name, joint in facts["joints"].items()}
        start_s = float(facts["start_s"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise JobError(
            f"the figures of the motion cannot be read: {error}",
            path=table.with_name("metrics.json"),
            hint="run the job again",
        ) from error
    solved = read_joint_table(table)
    of_role = {role_of.get(name, ""): joint for joint, name in enumerate(solved.joints)}
    out = np.ones_like(motion.observed)
    times_s = np.arange(len(out)) / motion.fps + start_s
    nearest = np.clip(np.searchsorted(solved.times_s, times_s - 0.5 / motion.fps), 0, len(solved.times_s) - 1)
    for joint, role in enumerate(motion.skeleton.roles):
        if role and role in of_role:
            out[:, joint] = solved.observed[nearest, of_role[role]]
    return out


def compare(first: Path, second: Path, shift_s: float = 0.0) -> Comparison:
    """Compare two motions.

    Both begin at time 0; `shift_s` moves the second one. The second one is moved and turned about the
    vertical so that its path begins where the first one's begins, and leads in the same direction.

    Args:
        first: A BVH file or a results folder.
        second: The same, for example a truth.
        shift_s: Seconds that are added to the times of the second motion.

    Raises:
        JobError: A motion is missing or cannot be read, or the two have no time in common.
    """
    a, b = load_take(first, "A"), load_take(second, "B", shift_s)
    times = a.times_s(), b.times_s()
    low, high = float(max(each[0] for each in times)), float(min(each[-1] for each in times))
    if high - low <= 0.0:
        raise JobError(
            "the two motions have no time in common",
            hint="choose another --shift: it is added to the times of the second motion",
        )
    b = replace(b, motion=_aligned(a, b, low, high))
    names = [{curve.name: curve for curve in angle_curves(take.motion)} for take in (a, b)]
    grid = np.arange(low, high + 1e-9, 1.0 / min(a.motion.fps, b.motion.fps))
    angles = {}
    for name in (each for each in names[0] if each in names[1]):
        values = [
            np.interp(grid, each, found[name].degrees) for each, found in zip(times, names, strict=True)
        ]
        shares = [float(found[name].measured.mean()) for found in names]
        angles[name] = {**_difference(values[0], values[1]), "measured_a": shares[0], "measured_b": shares[1]}
    figures = {
        "common_s": float(high - low),
        "angles": angles,
        "feet": {take.name: _steps(take) for take in (a, b)},
        "motions": {take.name: _extent(take.motion) for take in (a, b)},
    }
    return Comparison(takes=(a, b), sources=(str(first), str(second)), figures=figures)


def _difference(first: FloatArray, second: FloatArray) -> dict[str, float | None]:
    """Return mean absolute difference, mean difference, correlation and both ranges, degrees."""
    moves = min(float(first.std()), float(second.std())) > 1e-6
    return {
        "mean_abs_deg": float(np.abs(first - second).mean()),
        "mean_deg": float((first - second).mean()),
        "correlation": float(np.corrcoef(first, second)[0, 1]) if moves else None,
        "range_a_deg": float(np.ptp(first)),
        "range_b_deg": float(np.ptp(second)),
    }


def _steps(take: Take) -> dict[str, dict[str, float]]:
    """Return for each foot the share of time that it stands, its steps and its lowest place."""
    least = _STEP_LEAST_S * take.motion.fps
    return {
        foot.name: {
            "stands": float(foot.stands.mean()),
            "steps": sum(stop - start >= least for start, stop in runs(foot.stands)),
            "lowest_cm": float(100.0 * foot.clearance_m.min()),
        }
        for foot in foot_curves(take.motion)
    }


def _extent(motion: Motion) -> dict[str, float]:
    """Return duration, rate, length of the hips' path on the floor and mean speed."""
    path = _hips(motion)[:, :2]
    length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    seconds = (len(path) - 1) / motion.fps
    return {
        "seconds": seconds,
        "fps": motion.fps,
        "path_m": length,
        "speed_m_s": length / seconds if seconds > 0.0 else 0.0,
    }


def _hips(motion: Motion) -> FloatArray:
    joint = motion.skeleton.index_of_role("Hips") or 0
    return np.asarray(motion.world_from_joint()[:, joint, :3, 3])


def _aligned(a: Take, b: Take, low: float, high: float) -> Motion:
    """Return the second motion, moved on the floor and turned about the vertical to fit the first one's path.

    Source: the rotation that minimises the squared distances of the hips on the floor, in closed form.
    """
    grid = np.linspace(low, high, 200)
    paths = []
    for take in (a, b):
        hips = _hips(take.motion)
        paths.append(np.stack([np.interp(grid, take.times_s(), hips[:, k]) for k in (0, 1)], axis=1))
    centred = [path - path.mean(axis=0) for path in paths]
    angle = np.arctan2(
        (centred[1][:, 0] * centred[0][:, 1] - centred[1][:, 1] * centred[0][:, 0]).sum(),
        (centred[1] * centred[0]).sum(),
    )
    if np.linalg.norm(centred[1]) < 1e-6 or np.linalg.norm(centred[0]) < 1e-6:
        angle = 0.0
    turn = so3_exp([0.0, 0.0, angle])
    shift = np.append(paths[0].mean(axis=0) - paths[1].mean(axis=0) @ turn[:2, :2].T, 0.0)
    local = b.motion.local_rotation.copy()
    local[:, 0] = turn @ local[:, 0]
    return replace(b.motion, root_in_world_m=b.motion.root_in_world_m @ turn.T + shift, local_rotation=local)


def draw_paths(takes: Sequence[Take]) -> str:
    """Draw the paths of hips and hands of two takes, seen from above."""
    lines: list[tuple[int, str, FloatArray]] = []
    for number, take in enumerate(takes):
        centres = take.motion.world_from_joint()[..., :3, 3]
        for role in _PATH_ROLES:
            joint = take.motion.skeleton.index_of_role(role)
            if joint is not None:
                lines.append((number, role, centres[:, joint, :2]))
    if not lines:
        return ""
    points = np.concatenate([line for _, _, line in lines])
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float(max(np.max(high - low), 0.2))
    scale = (_PATH_SIZE - 2 * _PATH_MARGIN) / extent
    middle = (low + high) / 2.0
    parts = [element("rect", class_="plate", x=0.0, y=0.0, width=_PATH_SIZE, height=_PATH_SIZE)]
    for number, role, line in lines:
        x = _PATH_SIZE / 2 + scale * (line[:, 0] - middle[0])
        y = _PATH_SIZE / 2 - scale * (line[:, 1] - middle[1])
        kind = f"curve take{number}" + ("" if role == "Hips" else " hand")
        parts.append(element("path", class_=kind, d=path_through(zip(x, y, strict=True))))
        parts.append(element("circle", class_=f"contact take{number}", cx=float(x[0]), cy=float(y[0]), r=3.0))
    bar = max(length for length in _SCALE_BARS_M if length <= max(extent / 2.0, _SCALE_BARS_M[0]))
    bottom = _PATH_SIZE - 8.0
    parts.append(element("line", class_="key", x1=10.0, x2=10.0 + scale * bar, y1=bottom, y2=bottom))
    parts.append(text(14.0, bottom - 6.0, f"{bar:g} m", class_="tick"))
    return svg_image(
        _PATH_SIZE, _PATH_SIZE, "".join(parts), "Paths of hips and hands from above", class_="paths"
    )


def write_comparison(comparison: Comparison, path: Path) -> Path:
    """Write the comparison as one page that works offline, and return its path.

    Raises:
        StoreError: The file cannot be written.
    """
    times = [take.times_s() for take in comparison.takes]
    span = (min(float(t[0]) for t in times), max(float(t[-1]) for t in times))
    page = render_template(
        "comparison.html",
        sources=dict(zip(_NAMES, comparison.sources, strict=True)),
        figures=comparison.figures,
        curves=draw_motion_curves(comparison.takes, span),
        paths=draw_paths(comparison.takes),
    )
    write_text(path, page)
    return path
