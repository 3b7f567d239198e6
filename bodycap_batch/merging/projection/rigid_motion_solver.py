"""The least-squares problem of the projection onto the rigid skeleton, and its solution.

The unknowns of a tick are a shift of the root and one rotation for each solved joint. Each rotation is about
the centre of its joint, in world axes. It rotates the joint and all descendants of the joint.

Only neighbouring ticks are linked, so the normal equations are block-tridiagonal. The solution takes a time
proportional to the number of ticks. Long motions are solved in overlapping windows, so that the required
memory does not grow with the length of the motion.

In this module, the correction is the difference of the rigid motion from the motion graph.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal
from bodycap_batch.model.geometry import skew, so3_exp, so3_log
from bodycap_batch.model.merge_data import SLIP_HUBER_SIGMAS
from bodycap_batch.model.skeleton import SkeletonModel, forward_kinematics

_CAMERA_SIGMA = np.repeat([np.deg2rad(0.5), 0.005], 3)
"""Six sigmas of a camera pose: the rotation about three axes (radians), then the centre (metres).

Evidence: docs/decisions/export.md.
"""

_GRAPH_SIGMA = np.repeat([np.deg2rad(3.0), 0.01], 3)
"""Six sigmas of the difference of a joint's pose from the motion graph.

The first three are for the rotation (radians), the last three for the joint's centre (metres).

Derivation: the rotation sigma is smaller than the sigmas of the graph's rotation priors (20 to 45°). The
sigma of the centre is larger than the slack of the graph's joints (5 mm).
"""

_CHANGE_SIGMA = np.repeat([0.002, np.deg2rad(0.3)], 3)
"""Six sigmas of the change of the correction in 1/30 s.

The first three are for the shift of the root (metres), the last three for the rotation of a joint (radians).

Derivation: a viewer does not see changes of this size as jitter. The sigmas grow with the square root of the
time, to 1.1 cm and 1.6° in a second.
"""

_INDEPENDENT_HZ = 30.0
"""Assumed number of independent errors per second, hertz.

The errors of successive ticks are correlated. More ticks per second therefore do not add information, and the
weight of a tick is proportional to its duration.
Evidence: docs/decisions/export.md for the weight; none for the value.
"""

_GEMAN_MCCLURE_SQUARED = 100.0
"""Parameter c² of the Geman-McClure loss for a camera pose, in squared sigmas.

Derivation: if each of the six components of the error is 4 sigmas, the whole error has a length of about 10
sigmas. This length is c.
"""

_MAX_STEPS = 12
"""Maximum number of Levenberg-Marquardt steps. Evidence: none."""

_STEP_TOLERANCE = 1e-6
"""Convergence threshold for all components of a step, metres and radians.

Derivation: a viewer cannot see a micrometre or a microradian.
"""

_JACOBIAN_CHUNK_TICKS = 1000
"""Maximum number of ticks whose Jacobians are in memory at the same time.

Evidence: none; the value only limits the required memory.
"""

WINDOW_TICKS = 2000
"""Maximum number of ticks in a window, without the overlaps.

Derivation: with 15 joints and four blocks of 18 kB per tick, a window takes 180 MB at 30 ticks per second and
350 MB at 240 ticks per second.
"""

OVERLAP_S = 4.0
"""Duration of the overlap that extends a window on each side, seconds.

Derivation: the correction has a sigma of 3°, and its change in 1/30 s has a sigma of 0.3°. The influence of a
tick on other ticks therefore decreases by a tenth every 1/30 s. After 4 s the influence is e^-12.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTarget:
    """The poses that a camera should have at T ticks. They come from the camera's path in the world.

    Attributes:
        camera: Camera name.
        joint: Index of the joint at which the camera's bone starts.
        joint_from_cam: (4,4) mount of the camera.
        world_from_cam: (T,4,4) camera poses in the world, metres.
        found: (T,) True for the ticks with a camera pose.
    """

    camera: str
    joint: int
    joint_from_cam: FloatArray
    world_from_cam: FloatArray
    found: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class StandingJoint:
    """A joint that should not move while its foot stands.

    Attributes:
        joint: Index of the joint.
        held: (T-1,) True if the joint should not move from a tick to the next tick.
        sigma_m: Standard deviation of the joint's movement between two ticks, metres per axis.
    """

    joint: int
    held: BoolArray
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProjectionProblem:
    """The terms of the least-squares problem for T ticks.

    Attributes:
        fps: Number of ticks per second.
        skeleton: The rigid skeleton, with J joints.
        solved: (S,) indices of the joints that the motion graph solved.
        world_from_joint: (T,J,4,4) joint poses of the motion graph in the world, metres.
        cameras: Poses of the cameras.
        standing: Joints that should not move while their feet stand.
    """

    fps: float
    skeleton: SkeletonModel
    solved: IntArray
    world_from_joint: FloatArray
    cameras: tuple[CameraTarget, ...]
    standing: tuple[StandingJoint, ...] = ()

    def ancestor_matrix(self) -> FloatArray:
        """Return the ancestor matrix (J,S) with one row per joint and one column per solved joint.

        An entry is 1 if the column's joint is the row's joint or an ancestor of the row's joint, else 0.
        """
        out = np.zeros((len(self.skeleton.joints), len(self.solved)))
        for joint in range(len(out)):
            out[joint, np.isin(self.solved, self.skeleton.path_to_root(joint))] = 1.0
        return out

    @property
    def tick_weight(self) -> float:
        """Weight of the errors of one tick. It is proportional to the duration of a tick."""
        return _INDEPENDENT_HZ / self.fps

    def for_ticks(self, low: int, high: int) -> ProjectionProblem:
        """Return the problem restricted to the ticks [low, high)."""
        ticks = slice(low, high)
        cameras = (
            replace(target, world_from_cam=target.world_from_cam[ticks], found=target.found[ticks])
            for target in self.cameras
        )
        standing = (replace(joint, held=joint.held[low : high - 1]) for joint in self.standing)
        return replace(
            self,
            world_from_joint=self.world_from_joint[ticks],
            cameras=tuple(cameras),
            standing=tuple(standing),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RigidMotion:
    """A motion of the rigid skeleton, in which all bones have constant lengths.

    Attributes:
        root: (T,3) root position in the world, metres.
        local: (T,J,3,3) rotations parent_from_joint; the rotation of the root is world_from_root.
    """

    root: FloatArray
    local: FloatArray


def solve_rigid_motion(
    problem: ProjectionProblem,
    start: RigidMotion,
    *,
    window_ticks: int = WINDOW_TICKS,
    overlap_s: float = OVERLAP_S,
) -> RigidMotion:
    """Return the rigid motion with the smallest cost. A long motion is solved in overlapping windows.

    Args:
        problem: The terms of the cost.
        start: The initial motion.
        window_ticks: Maximum number of ticks in a window, without the overlaps.
        overlap_s: Duration of the overlap that extends a window on each side, seconds.

    Returns:
        The rigid motion at all ticks.
    """
    count, overlap = len(start.root), round(overlap_s * problem.fps)
    root, local = np.empty_like(start.root), np.empty_like(start.local)
    for first, last in windows(count, window_ticks):
        low, high = max(first - overlap, 0), min(last + overlap, count)
        part = RigidMotion(root=start.root[low:high], local=start.local[low:high])
        solution = _solve_window(problem.for_ticks(low, high), part)
        inner = slice(first - low, last - low)
        root[first:last], local[first:last] = solution.root[inner], solution.local[inner]
    return RigidMotion(root=root, local=local)


def windows(ticks: int, window_ticks: int) -> list[tuple[int, int]]:
    """Divide all ticks into windows of nearly equal length.

    Args:
        ticks: Number of all ticks.
        window_ticks: Maximum number of ticks in a window.

    Returns:
        The windows [first, last), without overlaps.
    """
    cuts = np.linspace(0, ticks, max(1, -(-ticks // window_ticks)) + 1).round().astype(int).tolist()
    return list(pairwise(cuts))


def _solve_window(problem: ProjectionProblem, start: RigidMotion) -> RigidMotion:
    """Minimise the cost by Levenberg-Marquardt steps, and return the solved motion.

    A step that increases the cost is rejected.
    """
    ancestors = problem.ancestor_matrix()
    motion, damping = start, 1e-6
    current_cost = cost(problem, motion)
    for _ in range(_MAX_STEPS):
        step = _solve_tridiagonal(normal_equations(problem, motion, ancestors), damping)
        trial = retract(problem, motion, step)
        trial_cost = cost(problem, trial)
        if trial_cost <= current_cost:
            motion, current_cost, damping = trial, trial_cost, max(damping * 0.1, 1e-9)
        else:
            damping *= 100.0
        if np.abs(step).max(initial=0.0) < _STEP_TOLERANCE:
            break
    return motion


def retract(problem: ProjectionProblem, motion: RigidMotion, step: FloatArray) -> RigidMotion:
    """Return the motion after a step.

    Args:
        problem: The problem, which contains the skeleton and the solved joints.
        motion: The motion before the step.
        step: (T,3+3S) shift of the root in metres, then a rotation vector in world axes for each of the S
            solved joints.

    Returns:
        The motion after the step.
    """
    rotation = forward_kinematics(problem.skeleton, motion.root, motion.local)[..., :3, :3]
    local = motion.local.copy()
    for column, joint in enumerate(problem.solved):
        rotvec = step[:, 3 + 3 * column : 6 + 3 * column]
        if joint > 0:
            parent = rotation[:, problem.skeleton.parents[joint]]
            rotvec = np.einsum("tji,tj->ti", parent, rotvec)
        local[:, joint] = so3_exp(rotvec) @ local[:, joint]
    return RigidMotion(root=motion.root + step[:, :3], local=local)


def _camera_error(target: CameraTarget, world: FloatArray, ticks: slice) -> tuple[FloatArray, FloatArray]:
    """Return the errors of a camera, and the camera's centres on the rigid skeleton.

    Args:
        target: The poses of the camera.
        world: (T,J,4,4) joint poses of the rigid skeleton at `ticks`, metres.
        ticks: Indices of the T ticks among all ticks of `target`.

    Returns:
        Two arrays. The first array (T,6) contains the errors of the camera poses in sigmas, rotation first.
        The error is zero at a tick without a camera pose. The second array (T,3) contains the camera centres
        on the rigid skeleton, in the world.
    """
    rigid = world[:, target.joint] @ target.joint_from_cam
    measured = target.world_from_cam[ticks]
    rotvec = so3_log(rigid[:, :3, :3] @ np.swapaxes(measured[:, :3, :3], -1, -2))
    error = np.concatenate([rotvec, rigid[:, :3, 3] - measured[:, :3, 3]], axis=1) / _CAMERA_SIGMA
    return np.where(target.found[ticks, None], error, 0.0), rigid[:, :3, 3]


def _graph_error(problem: ProjectionProblem, world: FloatArray, ticks: slice) -> FloatArray:
    """Return the differences of the solved joints from the motion graph.

    Args:
        problem: The problem, which contains the poses of the motion graph.
        world: (T,J,4,4) joint poses of the rigid skeleton at `ticks`, metres.
        ticks: Indices of the T ticks among all ticks of `problem`.

    Returns:
        (T,S,6) rotation (radians), then translation (metres), from the motion graph to the rigid skeleton.
    """
    graph, rigid = problem.world_from_joint[ticks][:, problem.solved], world[:, problem.solved]
    rotvec = so3_log(rigid[..., :3, :3] @ np.swapaxes(graph[..., :3, :3], -1, -2))
    return np.concatenate([rotvec, rigid[..., :3, 3] - graph[..., :3, 3]], axis=-1)


def _scaled_correction(
    problem: ProjectionProblem, motion: RigidMotion, graph_error: FloatArray
) -> FloatArray:
    """Return the correction, divided by the sigmas of its change from tick to tick.

    Args:
        problem: The problem, which contains the poses of the motion graph.
        motion: The rigid motion.
        graph_error: (T,S,6) differences of the solved joints from the motion graph.

    Returns:
        (T,3+3S) shift of the root, then rotation of each solved joint.
    """
    shift = motion.root - problem.world_from_joint[:, 0, :3, 3]
    rotations = graph_error[..., :3].reshape(len(shift), -1)
    return np.concatenate([shift, rotations], axis=1) / _change_sigma(problem)


def _change_sigma(problem: ProjectionProblem) -> FloatArray:
    """Return the standard deviations (3+3S,) of the change of the correction from tick to tick."""
    sigma = _CHANGE_SIGMA * np.sqrt(problem.tick_weight)
    return np.concatenate([sigma[:3], np.tile(sigma[3:], len(problem.solved))])


def cost(problem: ProjectionProblem, motion: RigidMotion) -> float:
    """Return the robust least-squares cost of a rigid motion.

    Args:
        problem: The terms of the cost.
        motion: The rigid motion.

    Returns:
        The cost, without the factor one half.
    """
    everything = slice(None)
    world = forward_kinematics(problem.skeleton, motion.root, motion.local)
    graph_error = _graph_error(problem, world, everything)
    out = float(((graph_error / _GRAPH_SIGMA) ** 2).sum())
    for target in problem.cameras:
        squared = (_camera_error(target, world, everything)[0] ** 2).sum(axis=1)
        out += float((_GEMAN_MCCLURE_SQUARED * squared / (_GEMAN_MCCLURE_SQUARED + squared)).sum())
    out *= problem.tick_weight
    out += float((np.diff(_scaled_correction(problem, motion, graph_error), axis=0) ** 2).sum())
    for joint in problem.standing:
        size = np.linalg.norm(_slip(joint, world), axis=1)
        linear = SLIP_HUBER_SIGMAS * (2.0 * size - SLIP_HUBER_SIGMAS)
        out += float(np.where(size < SLIP_HUBER_SIGMAS, size**2, linear).sum())
    return out


def _slip(standing: StandingJoint, world: FloatArray) -> FloatArray:
    """Return the movement (T-1,3) of a joint between ticks, in sigmas; zero if the foot does not stand."""
    movement = np.diff(world[:, standing.joint, :3, 3], axis=0)
    return np.asarray(np.where(standing.held[:, None], movement / standing.sigma_m, 0.0))


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """The block-tridiagonal normal equations of T ticks with n = 3+3S unknowns each.

    Attributes:
        blocks: (T,n,n) blocks on the diagonal.
        coupling: (T-1,n,n) blocks that link each tick with the next tick.
        gradient: (T,n) half of the gradient of the cost.
    """

    blocks: FloatArray
    coupling: FloatArray
    gradient: FloatArray


def normal_equations(
    problem: ProjectionProblem, motion: RigidMotion, ancestors: FloatArray
) -> NormalEquations:
    """Return the normal equations, linearised at a motion.

    Args:
        problem: The terms of the cost.
        motion: The motion at which the cost is linearised.
        ancestors: (J,S) the ancestor matrix of the problem.

    Returns:
        The normal equations of all ticks.
    """
    world = forward_kinematics(problem.skeleton, motion.root, motion.local)
    ticks, size = len(world), 3 + 3 * len(problem.solved)
    blocks, gradient = np.zeros((ticks, size, size)), np.zeros((ticks, size))
    for first in range(0, ticks, _JACOBIAN_CHUNK_TICKS):
        chunk = slice(first, min(first + _JACOBIAN_CHUNK_TICKS, ticks))
        for jacobian, error in _weighted_residuals(problem, world[chunk], ancestors, chunk):
            transposed = problem.tick_weight * np.swapaxes(jacobian, -1, -2)
            blocks[chunk] += transposed @ jacobian
            gradient[chunk] += (transposed @ error[..., None])[..., 0]
    correction = _scaled_correction(problem, motion, _graph_error(problem, world, slice(None)))
    correction_jacobian = np.zeros((size, size))
    correction_jacobian[:3, :3] = np.eye(3)
    correction_jacobian[3:, 3:] = np.kron(ancestors[problem.solved], np.eye(3))
    correction_jacobian /= _change_sigma(problem)[:, None]
    information = correction_jacobian.T @ correction_jacobian
    neighbour_count = np.full(ticks, 2.0)
    neighbour_count[[0, -1]] = 1.0 if ticks > 1 else 0.0
    blocks += neighbour_count[:, None, None] * information
    change_gradient = np.zeros_like(gradient)
    change_gradient[:-1] -= np.diff(correction, axis=0)
    change_gradient[1:] += np.diff(correction, axis=0)
    gradient += change_gradient @ correction_jacobian
    coupling = np.broadcast_to(-information, (ticks - 1, size, size))
    if problem.standing:
        coupling = coupling.copy()
    equations = NormalEquations(blocks, coupling, gradient)
    _add_standing_joints(problem, world, ancestors, equations)
    return equations


def _add_standing_joints(
    problem: ProjectionProblem, world: FloatArray, ancestors: FloatArray, equations: NormalEquations
) -> None:
    """Add the terms of the standing joints to the normal equations, in place."""
    for standing in problem.standing:
        (held,) = np.nonzero(standing.held)
        slip = _slip(standing, world)[held]
        size = np.maximum(np.linalg.norm(slip, axis=1), SLIP_HUBER_SIGMAS)
        sqrt_weight = np.sqrt(SLIP_HUBER_SIGMAS / size)
        jacobians = []
        for ticks in (held, held + 1):
            centres = world[ticks][:, problem.solved][..., :3, 3]
            point = world[ticks, standing.joint, :3, 3]
            jacobian = _jacobian(centres, point, ancestors[standing.joint])[:, 3:]
            jacobians.append(jacobian * (sqrt_weight / standing.sigma_m)[:, None, None])
        before, after = jacobians
        error = (slip * sqrt_weight[:, None])[..., None]
        equations.blocks[held] += np.swapaxes(before, 1, 2) @ before
        equations.blocks[held + 1] += np.swapaxes(after, 1, 2) @ after
        equations.coupling[held] -= np.swapaxes(before, 1, 2) @ after
        equations.gradient[held] -= (np.swapaxes(before, 1, 2) @ error)[..., 0]
        equations.gradient[held + 1] += (np.swapaxes(after, 1, 2) @ error)[..., 0]


def _weighted_residuals(
    problem: ProjectionProblem, world: FloatArray, ancestors: FloatArray, ticks: slice
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the weighted Jacobian (T,6,n) and the weighted error (T,6) of each solved joint and each camera.

    The errors are in sigmas.
    """
    centres = world[:, problem.solved][..., :3, 3]
    out = []
    graph_error = _graph_error(problem, world, ticks)
    for column, joint in enumerate(problem.solved):
        jacobian = _jacobian(centres, world[:, joint, :3, 3], ancestors[joint])
        out.append((jacobian / _GRAPH_SIGMA[:, None], graph_error[:, column] / _GRAPH_SIGMA))
    for target in problem.cameras:
        error, centre = _camera_error(target, world, ticks)
        squared = (error**2).sum(axis=1)
        sqrt_weight = _GEMAN_MCCLURE_SQUARED / (_GEMAN_MCCLURE_SQUARED + squared) * target.found[ticks]
        jacobian = _jacobian(centres, centre, ancestors[target.joint]) / _CAMERA_SIGMA[:, None]
        out.append((jacobian * sqrt_weight[:, None, None], error * sqrt_weight[:, None]))
    return out


def _jacobian(centres: FloatArray, point: FloatArray, is_ancestor: FloatArray) -> FloatArray:
    """Return the derivatives of the pose of a point on the body with respect to the unknowns.

    Args:
        centres: (T,S,3) centres of the solved joints in the world.
        point: (T,3) position of the point in the world.
        is_ancestor: (S,) 1 if the point rotates together with the solved joint, else 0.

    Returns:
        (T,6,n) Jacobian of rotation and position, rotation first, for the n unknowns of each tick.
    """
    ticks, solved = centres.shape[:2]
    out = np.zeros((ticks, 6, 3 + 3 * solved))
    out[:, 3:, :3] = np.eye(3)
    for column in np.flatnonzero(is_ancestor):
        unknowns = slice(3 + 3 * column, 6 + 3 * column)
        out[:, :3, unknowns] = np.eye(3)
        out[:, 3:, unknowns] = skew(centres[:, column] - point)
    return out


def _solve_tridiagonal(equations: NormalEquations, damping: float) -> FloatArray:
    """Return the step (T,n) that solves the damped normal equations.

    Args:
        equations: The normal equations.
        damping: Relative increase of the diagonal of the matrix.

    Returns:
        (T,n) step.
    """
    damped = equations.blocks * (1.0 + damping * np.eye(equations.gradient.shape[1]))
    system = BlockTridiagonal.from_blocks(damped, equations.coupling)
    step = np.concatenate(system.solve(-equations.gradient.reshape(-1, 1)))
    return np.asarray(step.reshape(equations.gradient.shape))
