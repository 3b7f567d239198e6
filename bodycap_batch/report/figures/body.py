"""The skeleton before and after its optimisation (the paper's figure 8), seen from the front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import interpolate_pose, invert
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.report.figures.svg import element, picture, polyline, text
from bodycap_batch.report.inputs import ReportInputs

_MOMENTS = 4
_NEIGHBOURS_S = 0.1
"""Poses further apart are not interpolated between: at this, three frames of a 30 fps camera."""
_CELL_W, _CELL_H, _SCALE = 236.0, 250.0, 112.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Before:
    """Where one camera alone puts its bone: the camera's measured pose and the mount as it was assumed.

    Attributes:
        camera: Camera name.
        joint: Index of the bone's joint.
        ticks: (N,) ticks of the motion at or between two measured poses that follow each other.
        world_from_joint: (N,4,4) the bone.
    """

    camera: str
    joint: int
    ticks: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    world_from_joint: FloatArray

    def off_m(self, world_from_joint: FloatArray) -> FloatArray:
        """(N,) distance of its joint from that of the motion, whose joint poses are (T,J,4,4)."""
        solved = world_from_joint[self.ticks, self.joint, :3, 3]
        return np.asarray(np.linalg.norm(self.world_from_joint[:, :3, 3] - solved, axis=1))


def before_optimisation(inputs: ReportInputs) -> list[Before]:
    """Each camera's bone as the assumed mounts alone would have it."""
    merge = inputs.merge
    if merge is None:
        return []
    found = []
    for mount in inputs.mounts:
        joint = merge.skeleton.index_of_role(mount.role)
        path = inputs.path(mount.camera)
        if joint is None or path is None or path.gauge != "world":
            continue
        times = inputs.clocks[mount.camera].common_times_ns(path.times_ns)[path.localised]
        poses = path.gauge_from_cam[path.localised]
        ticks = merge.times_ns()
        if len(times) == 0:
            continue
        right = np.clip(np.searchsorted(times, ticks), 0, len(times) - 1)
        left = np.where(times[right] == ticks, right, np.maximum(right - 1, 0))
        span = times[right] - times[left]
        inside = (ticks >= times[0]) & (ticks <= times[-1]) & (span <= _NEIGHBOURS_S * 1e9)
        near = np.flatnonzero(inside)
        if len(near) == 0:
            continue
        alpha = (ticks - times[left])[near] / np.maximum(span[near], 1)
        measured = interpolate_pose(poses[left[near]], poses[right[near]], alpha)
        bones = measured @ invert(mount.joint_from_cam)
        found.append(Before(camera=mount.camera, joint=joint, ticks=near, world_from_joint=bones))
    return found


def before_and_after(inputs: ReportInputs, tones: dict[str, str]) -> str:
    """A few moments from the body's own front, before in the cameras' colours, after in ink."""
    merge = inputs.merge
    before = before_optimisation(inputs)
    if merge is None or not before:
        return ""
    everywhere = before[0].ticks
    for each in before[1:]:
        everywhere = np.intersect1d(everywhere, each.ticks)
    ticks = everywhere if len(everywhere) >= _MOMENTS else before[0].ticks
    if len(ticks) == 0:
        return ""
    chosen = ticks[np.linspace(0, len(ticks) - 1, _MOMENTS + 2)[1:-1].round().astype(int)]
    poses = merge.motion.world_from_joint()[chosen]
    parts = [
        _moment(merge, before, int(tick), poses[index], index, tones) for index, tick in enumerate(chosen)
    ]
    title = "Skeleton before (coloured, dashed) and after optimisation, from the front, at four moments"
    return picture(_MOMENTS * _CELL_W, _CELL_H + 24.0, "".join(parts), title, class_="bodies")


def _moment(
    merge: MergeResult,
    before: list[Before],
    tick: int,
    world_from_joint: FloatArray,
    column: int,
    tones: dict[str, str],
) -> str:
    root = world_from_joint[0]
    left = root[:3, 0] * [1.0, 1.0, 0.0]
    across = left / max(float(np.linalg.norm(left)), 1e-9)

    def flat(points: FloatArray) -> list[tuple[float, float]]:
        # Seen from the front: the body's left is on the right, as with a person one faces.
        x = (points - root[:3, 3]) @ across * _SCALE + (column + 0.5) * _CELL_W
        y = 18.0 + (1.95 - points[:, 2]) * _SCALE
        return list(zip(x.tolist(), y.tolist(), strict=True))

    skeleton, parts = merge.skeleton, []
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            line = world_from_joint[[parent, joint], :3, 3]
            kind = "bone" if merge.solved[joint] and merge.solved[parent] else "bone guessed"
            parts.append(element("path", class_=kind, d=polyline(flat(line))))
    for tip in np.flatnonzero(np.isfinite(skeleton.end_offsets_m).all(axis=1)):
        kind = "bone" if merge.solved[tip] else "bone guessed"
        line = _stub(world_from_joint[tip], skeleton.end_offsets_m[tip])
        parts.append(element("path", class_=kind, d=polyline(flat(line))))
    for each in before:
        index = np.flatnonzero(each.ticks == tick)
        if len(index) == 0:
            continue
        pose, tone = each.world_from_joint[index[0]], tones[each.camera]
        for offset in _offsets(merge, each.joint):
            parts.append(
                element(
                    "path",
                    class_="bone before",
                    style=f"stroke:{tone}",
                    d=polyline(flat(_stub(pose, offset))),
                )
            )
        x, y = flat(pose[None, :3, 3])[0]
        parts.append(element("circle", cx=x, cy=y, r=3.5, fill=tone))
    seconds = merge.times_ns()[tick] * 1e-9
    middle = (column + 0.5) * _CELL_W
    return "".join(parts) + text(
        middle, _CELL_H + 18.0, f"{seconds:.2f} s", class_="tick", text_anchor="middle"
    )


def _stub(pose: FloatArray, offset: FloatArray) -> FloatArray:
    return np.stack([pose[:3, 3], pose[:3, :3] @ offset + pose[:3, 3]])


def _offsets(merge: MergeResult, joint: int) -> list[FloatArray]:
    """The bone's far ends in its own frame."""
    skeleton = merge.skeleton
    children = np.flatnonzero(skeleton.parents == joint)
    if len(children):
        return [skeleton.offsets_m[child] for child in children]
    return [skeleton.end_offsets_m[joint]]
