"""How well the joints are known: covariances of their centres and sigmas of the hinges' flexion.

Both contain the noise of the measurements and the errors of the calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.graph.error_modes import ErrorModes, joint_residual_jacobian
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.linearisation import LinearisedGraph, linearise
from bodycap_batch.merging.graph.motion_graph import JointUncertainty, MotionGraph
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal
from bodycap_batch.model.geometry import invert, se3_adjoint
from bodycap_batch.model.merge_report import Percentiles

_MODES_PER_SOLVE = 48
"""Number of error modes that are propagated at the same time. All modes of eleven cameras together would need
gigabytes."""


def joint_covariance(
    graph: MotionGraph,
    world_from_bone: FloatArray,
    error_modes: ErrorModes,
    begin: Callable[[str], None] = lambda _: None,
) -> JointUncertainty:
    """Return the covariances of the joints' centres, and the variances of the hinges' flexion.

    Each covariance is the sum of two parts. The first part is the marginal covariance of the graph, which
    contains the noise of the measurements. The second part is J Σ Jᵀ, the effect of errors of the
    calibration. The solver held the calibration fixed. Σ is the covariance of the calibration, given by its
    error modes. J contains the derivatives of the joint centres with respect to the calibration. The function
    computes J Σ Jᵀ by propagating each error mode to the joints.

    Args:
        graph: The solved graph.
        world_from_bone: (T,B,4,4) solved poses of the bones.
        error_modes: Error modes of the calibration.
        begin: Called with the name of each part of the computation before the part starts. It may return
            freed memory to the operating system.

    Returns:
        The uncertainty; NaN if the equations of the graph are singular.
    """
    begin("joint covariances")
    linear = linearise(graph.graph, graph.values)
    begin("normal equations")
    order, bounds = _columns_by_tick(graph, linear)
    try:
        normal = BlockTridiagonal.from_sparse((linear.matrix.T @ linear.matrix).tocsr(), order, bounds)
    except np.linalg.LinAlgError:
        # The measurements do not determine some state of the graph, so the covariance does not exist.
        nothing = np.full(world_from_bone.shape[:2], np.nan)
        return JointUncertainty(np.full((*nothing.shape, 3, 3), np.nan), nothing)
    begin("covariances of the measurements")
    changes = _measurement_residual_jacobian(graph, linear, error_modes)
    changes = changes + joint_residual_jacobian(
        linear, graph.body, graph.first_joint, world_from_bone, error_modes
    )
    changes = changes.tocsc()
    position = np.argsort(order)
    ticks, count = world_from_bone.shape[:2]
    out = np.zeros((ticks, count, 3, 3))
    hinges = graph.body.hinges
    flexion = np.full((ticks, count), np.nan)
    lowers = [hinge.lower for hinge in hinges]
    flexion[:, lowers] = 0.0

    def first_columns(tick: int) -> list[int]:
        """Return the first column of each bone's pose among the unknowns of the tick's states."""
        return [
            int(position[linear.columns[bone_key(tick, bone)]]) - int(bounds[tick]) for bone in range(count)
        ]

    def flexion_jacobian_at(tick: int) -> FloatArray:
        """Return the derivatives (H,n) of the flexion of each hinge: the turn about the axis of the hinge."""
        first = first_columns(tick)
        jacobian = np.zeros((len(hinges), int(bounds[tick + 1] - bounds[tick])))
        for row, hinge in enumerate(hinges):
            axis = hinge.axis()
            upper, lower = world_from_bone[tick, [hinge.upper, hinge.lower], :3, :3]
            jacobian[row, first[hinge.upper] : first[hinge.upper] + 3] = -axis
            jacobian[row, first[hinge.lower] : first[hinge.lower] + 3] = lower.T @ upper @ axis
        return jacobian

    def jacobian_at(tick: int) -> FloatArray:
        """Return the derivatives (B-1,3,n) of relative joint centres.

        The derivatives are with respect to the n unknowns of the tick's states.
        """
        first = first_columns(tick)
        jacobian = np.zeros((count - 1, 3, int(bounds[tick + 1] - bounds[tick])))
        jacobian[:, :, first[0] + 3 : first[0] + 6] = -world_from_bone[tick, 0, :3, :3]
        for bone in range(1, count):
            jacobian[bone - 1, :, first[bone] + 3 : first[bone] + 6] = world_from_bone[tick, bone, :3, :3]
        return jacobian

    def add_marginal(tick: int, covariance: FloatArray) -> None:
        jacobian = jacobian_at(tick)
        out[tick, 1:] += jacobian @ covariance @ jacobian.swapaxes(1, 2)
        turn = flexion_jacobian_at(tick)
        flexion[tick, lowers] += np.einsum("hi,ij,hj->h", turn, covariance, turn)

    normal.marginals(add_marginal)
    begin("covariances of the calibration")
    for first in range(0, changes.shape[1], _MODES_PER_SOLVE):
        rhs = (linear.matrix.T @ changes[:, first : first + _MODES_PER_SOLVE]).toarray()
        for tick, states in enumerate(normal.solve(rhs)):
            moved = jacobian_at(tick) @ states
            out[tick, 1:] += moved @ moved.swapaxes(1, 2)
            flexion[tick, lowers] += np.square(flexion_jacobian_at(tick) @ states).sum(axis=1)
    return JointUncertainty(out, flexion)


def _columns_by_tick(graph: MotionGraph, linear: LinearisedGraph) -> tuple[IntArray, IntArray]:
    """Return the columns of the graph's Jacobian in the order of the ticks.

    Returns:
        (C,) column indices, tick by tick. A state between two ticks belongs to the earlier tick. Then (T+1,)
        the start of each tick's columns in them, and C at the end.
    """
    keys, ticks = [], []
    for chain in graph.chains:
        times = np.array([state.time_ns for state in chain])
        tick = np.clip(np.searchsorted(graph.tick_times_ns, times, side="right") - 1, 0, None)
        keys += [key for state in chain for key in (state.pose_key, state.velocity_key)]
        ticks.append(np.repeat(tick, 2))
    tick = np.concatenate(ticks)
    by_tick = np.argsort(tick, kind="stable")
    start = np.array([linear.columns[key] for key in keys], dtype=np.int64)[by_tick]
    order = (start[:, None] + np.arange(6)).ravel()
    bounds = 6 * np.searchsorted(tick[by_tick], np.arange(len(graph.tick_times_ns) + 1))
    return np.asarray(order), np.asarray(bounds, dtype=np.int64)


def _measurement_residual_jacobian(
    graph: MotionGraph, linear: LinearisedGraph, error_modes: ErrorModes
) -> Any:
    """Return the sparse change (R,M) of the measurements' residuals for each of the M error modes."""
    out = sparse.csr_matrix((linear.matrix.shape[0], len(error_modes.log_scale)))
    middle = np.concatenate([track.map_from_cam[:, :3, 3] for track in graph.tracks]).mean(axis=0)
    first = 0
    for track in graph.tracks:
        mount, keys = graph.mounts[track.camera], graph.measured_keys[track.camera]
        factors = first + np.arange(len(keys))
        by_mount = -(se3_adjoint(mount) @ error_modes.mounts[track.camera])
        change = np.repeat(by_mount[None], len(keys), axis=0)
        bones = track.map_from_cam @ invert(mount)
        from_middle = track.map_from_cam[:, :3, 3] - middle
        by_scale = np.einsum("nji,nj->ni", bones[:, :3, :3], from_middle)
        change[:, 3:] += by_scale[:, :, None] * error_modes.log_scale
        out = out + linear.sparse_rows(factors, linear.pose_jacobians(factors, 6, keys) @ change)
        first += len(keys)
    return out


def on_skeleton(bones: Sequence[Bone], values: FloatArray, joints: int) -> FloatArray:
    """Return values (T,B,...) of the graph's bones by joint of the skeleton (T,J,...); NaN for other joints.

    Args:
        bones: The graph's bones.
        values: (T,B,...) values of the bones.
        joints: Number J of joints of the skeleton.
    """
    out = np.full((len(values), joints, *values.shape[2:]), np.nan)
    out[:, [bone.joint for bone in bones]] = values
    return out


def sigma_percentiles(
    roles: Sequence[str], sigma: FloatArray, observed: BoolArray, digits: int
) -> dict[str, dict[str, Percentiles]]:
    """Return percentiles of sigmas, separately for observed and filled ticks.

    Args:
        roles: Roles of the J joints.
        sigma: (T,J) sigmas, NaN for joints without one.
        observed: (T,J) whether cameras measured each joint at each tick. The other ticks are filled.
        digits: Number of decimals.

    Returns:
        By role of a joint, then by "observed" or "filled", percentiles of the sigma.
    """
    out: dict[str, dict[str, Percentiles]] = {}
    for joint, role in enumerate(roles):
        for name, mask in (("observed", observed[:, joint]), ("filled", ~observed[:, joint])):
            found = sigma[mask & np.isfinite(sigma[:, joint]), joint]
            if role and len(found) and found.any():
                p50, p95 = (round(float(np.percentile(found, q)), digits) for q in (50, 95))
                out.setdefault(role, {})[name] = Percentiles(p50=p50, p95=p95)
    return out
