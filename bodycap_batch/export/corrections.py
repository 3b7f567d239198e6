"""The least-squares solve behind the projection: Gauss-Newton over many ticks at once.

Unknowns of a tick are a shift of the root and, for each solved joint, a rotation of everything below it
about its centre, in world axes. Ticks are tied to their neighbours only, so the normal equations are block
tridiagonal and the solve is linear in time. Long motions are solved in stretches, so that memory does not
grow with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics

_CAMERA_SIGMA = np.repeat([np.deg2rad(0.5), 0.005], 3)
"""Rotation and centre of a localised camera: what easy captures reach (0.3-0.5°, 5 mm)."""

_GRAPH_SIGMA = np.repeat([np.deg2rad(3.0), 0.01], 3)
"""How far a joint may leave the graph: its pose priors are wider (20-45°), its joints' slack is 5 mm."""

_CHANGE_SIGMA = np.repeat([0.002, np.deg2rad(0.3)], 3)
"""Change of the correction over a thirtieth of a second, root shift and rotations: below what a viewer sees
as jitter. It grows with the square root of the time: 1.1 cm and 1.6° over a second."""

_USUAL_HZ = 30.0
"""So many errors a second count as independent: at other rates a tick counts for the time it stands for."""

_SLIPS = 2.0
"""Sigmas beyond which a standing foot slips after all (Huber), as in the graph."""

_OUTLIER_SCALE = 100.0
"""Geman-McClure's c² on the squared error in sigmas: 3 to 4 sigmas on each of six numbers."""

_MAX_STEPS = 12
_ENOUGH = 1e-6
"""Largest step (m, rad) below which the solve is done: a thousandth of what the file resolves."""

_CHUNK_TICKS = 1000

_STRETCH_TICKS = 2000
"""Solved at once, besides the overlaps: with 15 joints, four blocks of 18 kB a tick, that takes 180 MB at 30
ticks a second, 350 at 240."""
_OVERLAP_S = 4.0
"""Either side of a stretch: 0.3° in 1/30 s against 3° are forgotten by a tenth in it, to e^-12 here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """A camera on a bone, measured at the ticks (T,); `world_from_cam` counts where `found`."""

    camera: str
    joint: int
    joint_from_cam: FloatArray
    world_from_cam: FloatArray
    found: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Planted:
    """A joint that should stay where it is from one tick to the next, to `sigma_m`, where `held` (T-1,)."""

    joint: int
    held: BoolArray
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What the corrected motion should meet: graph poses (T,J,4,4) of the solved joints, cameras, ground.

    Its ticks follow each other at `fps` a second.
    """

    fps: float
    skeleton: SkeletonModel
    solved: IntArray
    world_from_joint: FloatArray
    cameras: tuple[Tracked, ...]
    planted: tuple[Planted, ...] = ()

    def reach(self) -> FloatArray:
        """(J,S) one where a solved joint turns a joint: itself and its ancestors."""
        out = np.zeros((len(self.skeleton.joints), len(self.solved)))
        for joint in range(len(out)):
            ancestor = joint
            while ancestor >= 0:
                out[joint, self.solved == ancestor] = 1.0
                ancestor = int(self.skeleton.parents[ancestor])
        return out

    @property
    def tick_share(self) -> float:
        """How much a tick's errors count for: as many ticks as stand for the same time count alike."""
        return _USUAL_HZ / self.fps

    def between(self, low: int, high: int) -> Problem:
        """The same of ticks `low` to before `high` alone."""
        ticks = slice(low, high)
        cameras = (
            replace(each, world_from_cam=each.world_from_cam[ticks], found=each.found[ticks])
            for each in self.cameras
        )
        planted = (replace(each, held=each.held[low : high - 1]) for each in self.planted)
        return replace(
            self,
            world_from_joint=self.world_from_joint[ticks],
            cameras=tuple(cameras),
            planted=tuple(planted),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Correction:
    """A rigid motion: root (T,3) and local rotations (T,J,3,3)."""

    root: FloatArray
    local: FloatArray


def solve_correction(problem: Problem, start: Correction) -> Correction:
    """Fit the rigid motion, a long one stretch by stretch."""
    count, overlap = len(start.root), round(_OVERLAP_S * problem.fps)
    root, local = np.empty_like(start.root), np.empty_like(start.local)
    cuts = np.linspace(0, count, max(1, -(-count // _STRETCH_TICKS)) + 1).round().astype(int).tolist()
    for first, last in pairwise(cuts):
        low, high = max(first - overlap, 0), min(last + overlap, count)
        part = Correction(root=start.root[low:high], local=start.local[low:high])
        found = _solve_stretch(problem.between(low, high), part)
        own = slice(first - low, last - low)
        root[first:last], local[first:last] = found.root[own], found.local[own]
    return Correction(root=root, local=local)


def _solve_stretch(problem: Problem, start: Correction) -> Correction:
    """Levenberg-Marquardt: a step that does not help is shortened."""
    reach = problem.reach()
    now, damping = start, 1e-6
    cost = _cost(problem, now)
    for _ in range(_MAX_STEPS):
        blocks, coupling, gradient = _normal_equations(problem, now, reach)
        step = _solve_tridiagonal(blocks, coupling, -gradient, damping)
        trial = _moved(problem, now, step)
        trial_cost = _cost(problem, trial)
        if trial_cost <= cost:
            now, cost, damping = trial, trial_cost, max(damping * 0.1, 1e-9)
        else:
            damping *= 100.0
        if np.abs(step).max(initial=0.0) < _ENOUGH:
            break
    return now


def _moved(problem: Problem, now: Correction, step: FloatArray) -> Correction:
    """Apply a step (T, 3+3S): shift the root, turn solved joints by rotation vectors in world axes."""
    rotation = forward_kinematics(problem.skeleton, now.root, now.local)[..., :3, :3]
    local = now.local.copy()
    for column, joint in enumerate(problem.solved):
        turn = step[:, 3 + 3 * column : 6 + 3 * column]
        if joint > 0:
            parent = rotation[:, problem.skeleton.parents[joint]]
            turn = np.einsum("tji,tj->ti", parent, turn)
        local[:, joint] = so3_exp(turn) @ local[:, joint]
    return Correction(root=now.root + step[:, :3], local=local)


def _camera_error(tracked: Tracked, world: FloatArray, ticks: slice) -> tuple[FloatArray, FloatArray]:
    """Errors (T,6) in sigmas, zero where not measured, and the exported centres (T,3)."""
    exported = world[:, tracked.joint] @ tracked.joint_from_cam
    measured = tracked.world_from_cam[ticks]
    turn = so3_log(exported[:, :3, :3] @ np.swapaxes(measured[:, :3, :3], -1, -2))
    error = np.concatenate([turn, exported[:, :3, 3] - measured[:, :3, 3]], axis=1) / _CAMERA_SIGMA
    return np.where(tracked.found[ticks, None], error, 0.0), exported[:, :3, 3]


def _graph_error(problem: Problem, world: FloatArray, ticks: slice) -> FloatArray:
    """Errors (T,S,6) of the solved joints against the graph, rotation first, in rad and m."""
    graph, rigid = problem.world_from_joint[ticks][:, problem.solved], world[:, problem.solved]
    turn = so3_log(rigid[..., :3, :3] @ np.swapaxes(graph[..., :3, :3], -1, -2))
    return np.concatenate([turn, rigid[..., :3, 3] - graph[..., :3, 3]], axis=-1)


def _change(problem: Problem, now: Correction, graph: FloatArray) -> FloatArray:
    """What may change only slowly (T, 3+3S): the root's shift and the joints' turns off the graph."""
    shift = now.root - problem.world_from_joint[:, 0, :3, 3]
    return np.concatenate([shift, graph[..., :3].reshape(len(shift), -1)], axis=1) / _change_sigma(problem)


def _change_sigma(problem: Problem) -> FloatArray:
    """(3+3S,) of the change from one tick to the next."""
    sigma = _CHANGE_SIGMA * np.sqrt(problem.tick_share)
    return np.concatenate([sigma[:3], np.tile(sigma[3:], len(problem.solved))])


def _cost(problem: Problem, now: Correction) -> float:
    everything = slice(None)
    world = forward_kinematics(problem.skeleton, now.root, now.local)
    graph = _graph_error(problem, world, everything)
    cost = float(((graph / _GRAPH_SIGMA) ** 2).sum())
    for tracked in problem.cameras:
        squared = (_camera_error(tracked, world, everything)[0] ** 2).sum(axis=1)
        cost += float((_OUTLIER_SCALE * squared / (_OUTLIER_SCALE + squared)).sum())
    cost *= problem.tick_share
    cost += float((np.diff(_change(problem, now, graph), axis=0) ** 2).sum())
    for planted in problem.planted:
        size = np.linalg.norm(_slip(planted, world), axis=1)
        cost += float(np.where(size < _SLIPS, size**2, _SLIPS * (2.0 * size - _SLIPS)).sum())
    return cost


def _slip(planted: Planted, world: FloatArray) -> FloatArray:
    """How far (T-1,3) a joint moves from tick to tick while it should not, in sigmas."""
    moved = np.diff(world[:, planted.joint, :3, 3], axis=0)
    return np.asarray(np.where(planted.held[:, None], moved / planted.sigma_m, 0.0))


def _normal_equations(
    problem: Problem, now: Correction, reach: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Diagonal blocks (T,n,n), the blocks (T-1,n,n) that tie neighbours, and the gradient (T,n)."""
    world = forward_kinematics(problem.skeleton, now.root, now.local)
    ticks, size = len(world), 3 + 3 * len(problem.solved)
    blocks, gradient = np.zeros((ticks, size, size)), np.zeros((ticks, size))
    for first in range(0, ticks, _CHUNK_TICKS):
        chunk = slice(first, min(first + _CHUNK_TICKS, ticks))
        for jacobian, error in _rows(problem, world[chunk], reach, chunk):
            transposed = problem.tick_share * np.swapaxes(jacobian, -1, -2)
            blocks[chunk] += transposed @ jacobian
            gradient[chunk] += (transposed @ error[..., None])[..., 0]
    change = _change(problem, now, _graph_error(problem, world, slice(None)))
    turns = np.zeros((size, size))
    turns[:3, :3] = np.eye(3)
    turns[3:, 3:] = np.kron(reach[problem.solved], np.eye(3))
    turns /= _change_sigma(problem)[:, None]
    coupling = turns.T @ turns
    neighbours = np.full(ticks, 2.0)
    neighbours[[0, -1]] = 1.0 if ticks > 1 else 0.0
    blocks += neighbours[:, None, None] * coupling
    pull = np.zeros_like(gradient)
    pull[:-1] -= np.diff(change, axis=0)
    pull[1:] += np.diff(change, axis=0)
    gradient += pull @ turns
    ties = np.broadcast_to(-coupling, (ticks - 1, size, size))
    if problem.planted:
        ties = ties.copy()
        _plant(problem, world, reach, (blocks, ties, gradient))
    return blocks, ties, gradient


def _plant(
    problem: Problem, world: FloatArray, reach: FloatArray, system: tuple[FloatArray, FloatArray, FloatArray]
) -> None:
    """Add the standing feet to the normal equations."""
    blocks, ties, gradient = system
    for planted in problem.planted:
        (held,) = np.nonzero(planted.held)
        slip = _slip(planted, world)[held]
        root_weight = np.sqrt(_SLIPS / np.maximum(np.linalg.norm(slip, axis=1), _SLIPS))
        rows = []
        for ticks in (held, held + 1):
            centres = world[ticks][:, problem.solved][..., :3, 3]
            jacobian = _jacobian(centres, world[ticks, planted.joint, :3, 3], reach[planted.joint])[:, 3:]
            rows.append(jacobian * (root_weight / planted.sigma_m)[:, None, None])
        before, after = rows
        error = (slip * root_weight[:, None])[..., None]
        blocks[held] += np.swapaxes(before, 1, 2) @ before
        blocks[held + 1] += np.swapaxes(after, 1, 2) @ after
        ties[held] -= np.swapaxes(before, 1, 2) @ after
        gradient[held] -= (np.swapaxes(before, 1, 2) @ error)[..., 0]
        gradient[held + 1] += (np.swapaxes(after, 1, 2) @ error)[..., 0]


def _rows(
    problem: Problem, world: FloatArray, reach: FloatArray, ticks: slice
) -> list[tuple[FloatArray, FloatArray]]:
    """Jacobians (T,6,n) and errors (T,6) in sigmas of every joint and camera."""
    centres = world[:, problem.solved][..., :3, 3]
    out = []
    graph = _graph_error(problem, world, ticks)
    for column, joint in enumerate(problem.solved):
        jacobian = _jacobian(centres, world[:, joint, :3, 3], reach[joint])
        out.append((jacobian / _GRAPH_SIGMA[:, None], graph[:, column] / _GRAPH_SIGMA))
    for tracked in problem.cameras:
        error, centre = _camera_error(tracked, world, ticks)
        root_weight = _OUTLIER_SCALE / (_OUTLIER_SCALE + (error**2).sum(axis=1)) * tracked.found[ticks]
        jacobian = _jacobian(centres, centre, reach[tracked.joint]) / _CAMERA_SIGMA[:, None]
        out.append((jacobian * root_weight[:, None, None], error * root_weight[:, None]))
    return out


def _jacobian(centres: FloatArray, point: FloatArray, reach: FloatArray) -> FloatArray:
    """Turn and shift (T,6,n) of a body point by the unknowns.

    Args:
        centres: (T,S,3) what the solved joints turn about.
        point: (T,3) the point.
        reach: (S,) one where a solved joint carries the point.
    """
    ticks, solved = centres.shape[:2]
    out = np.zeros((ticks, 6, 3 + 3 * solved))
    out[:, 3:, :3] = np.eye(3)
    for column in np.flatnonzero(reach):
        place = slice(3 + 3 * column, 6 + 3 * column)
        out[:, :3, place] = np.eye(3)
        x, y, z = (point - centres[:, column]).T
        out[:, 3:, place] = np.stack([0 * x, z, -y, -z, 0 * x, x, y, -x, 0 * x], axis=1).reshape(-1, 3, 3)
    return out


def _solve_tridiagonal(
    blocks: FloatArray, coupling: FloatArray, right: FloatArray, damping: float
) -> FloatArray:
    """Solve the damped block-tridiagonal system.

    Args:
        blocks: (T,n,n) on the diagonal.
        coupling: (T-1,n,n) of each tick with the next one.
        right: (T,n).
        damping: Relative increase of the matrix's diagonal.
    """
    damped = blocks * (1.0 + damping * np.eye(right.shape[1]))
    system = BlockTridiagonal.from_blocks(damped, coupling)
    return np.concatenate(system.solve(right.reshape(-1, 1))).reshape(right.shape)
