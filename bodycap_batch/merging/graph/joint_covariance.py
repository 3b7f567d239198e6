"""How well each joint's centre is known relative to the root: measurement noise and calibration together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.merging.body.bones import Bone
from bodycap_batch.merging.cameras.track import CameraTrack
from bodycap_batch.merging.graph.error_modes import BodyModel, ErrorModes, adjoint, joint_residual_jacobian
from bodycap_batch.merging.graph.factors import bone_key
from bodycap_batch.merging.graph.linearisation import LinearisedGraph, linearise
from bodycap_batch.model.block_tridiagonal import BlockTridiagonal
from bodycap_batch.model.geometry import invert

_MODES_PER_SOLVE = 48


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedGraph:
    """A motion graph at its solution.

    Attributes:
        graph: The factors: first each track's measurements, one after the other.
        values: The solution.
        body: Bones and hinges.
        tick_times_ns: (T,) the timeline.
        chains: Per bone (time, pose key, velocity key) of each state.
        tracks: The measurements, poses in metres.
        measured_keys: By camera, the key of the pose each measurement is of.
        mounts: joint_from_cam (4,4) by camera, as they were held.
        first_joint: Index of the first joint factor.
    """

    graph: Any
    values: Any
    body: BodyModel
    tick_times_ns: IntArray
    chains: Sequence[Sequence[tuple[int, int, int]]]
    tracks: Sequence[CameraTrack]
    measured_keys: Mapping[str, Sequence[int]]
    mounts: Mapping[str, FloatArray]
    first_joint: int


def joint_covariance(
    solved: SolvedGraph,
    world_from_bone: FloatArray,
    spread: ErrorModes,
    begin: Callable[[str], None] = lambda _: None,
) -> FloatArray:
    """Covariance (T,B,3,3) of each bone's joint centre minus the first bone's, m², in the solution's axes.

    The marginal of the graph knows the noise of the measurements; what was held while it was solved moves
    the solution along with it and is added: J Σ Jᵀ, one direction of one sigma after the other.

    Args:
        solved: The graph.
        world_from_bone: (T,B,4,4) its solution.
        spread: How far off the calibration may be.
        begin: Called with the name of each part of the computation, before which freed memory is released.

    Returns:
        NaN throughout where the graph's equations are singular.
    """
    begin("joint covariances")
    linear = linearise(solved.graph, solved.values)
    begin("normal equations")
    order, bounds = _tick_blocks(solved, linear)
    try:
        chain = BlockTridiagonal((linear.matrix.T @ linear.matrix).tocsr(), order, bounds)
    except np.linalg.LinAlgError:
        # A state that nothing holds: the solution stands, how well it is known cannot be told.
        return np.full((*world_from_bone.shape[:2], 3, 3), np.nan)
    begin("covariances of the measurements")
    shifts = _measurement_residual_jacobian(solved, linear, spread)
    shifts = shifts + joint_residual_jacobian(
        linear, solved.body, solved.first_joint, world_from_bone, spread
    )
    shifts = shifts.tocsc()
    place = np.argsort(order)
    ticks, count = world_from_bone.shape[:2]
    out = np.zeros((ticks, count, 3, 3))

    def readers(tick: int) -> FloatArray:
        """(B-1,3,n) from a tick's states to each joint's centre relative to the first bone's."""
        first = [
            int(place[linear.columns[bone_key(tick, bone)]]) - int(bounds[tick]) for bone in range(count)
        ]
        reader = np.zeros((count - 1, 3, int(bounds[tick + 1] - bounds[tick])))
        reader[:, :, first[0] + 3 : first[0] + 6] = -world_from_bone[tick, 0, :3, :3]
        for bone in range(1, count):
            reader[bone - 1, :, first[bone] + 3 : first[bone] + 6] = world_from_bone[tick, bone, :3, :3]
        return reader

    def read(tick: int, covariance: FloatArray) -> None:
        reader = readers(tick)
        out[tick, 1:] += reader @ covariance @ reader.swapaxes(1, 2)

    chain.marginals(read)
    begin("covariances of the calibration")
    for first in range(0, shifts.shape[1], _MODES_PER_SOLVE):
        # A few directions at a time: all of eleven cameras' at once take gigabytes.
        right = (linear.matrix.T @ shifts[:, first : first + _MODES_PER_SOLVE]).toarray()
        moved = chain.solve(right)
        for tick, each in enumerate(moved):
            shift = readers(tick) @ each
            out[tick, 1:] += shift @ shift.swapaxes(1, 2)
    return out


def _tick_blocks(solved: SolvedGraph, linear: LinearisedGraph) -> tuple[IntArray, IntArray]:
    """Columns tick by tick, states between two ticks with the earlier one, and where each tick begins."""
    keys, ticks = [], []
    for chain in solved.chains:
        times = np.array([time for time, _, _ in chain])
        tick = np.clip(np.searchsorted(solved.tick_times_ns, times, side="right") - 1, 0, None)
        keys += [key for _, *both in chain for key in both]
        ticks.append(np.repeat(tick, 2))
    tick = np.concatenate(ticks)
    by_tick = np.argsort(tick, kind="stable")
    start = np.array([linear.columns[key] for key in keys], dtype=np.int64)[by_tick]
    order = (start[:, None] + np.arange(6)).ravel()
    bounds = 6 * np.searchsorted(tick[by_tick], np.arange(len(solved.tick_times_ns) + 1))
    return np.asarray(order), np.asarray(bounds, dtype=np.int64)


def _measurement_residual_jacobian(solved: SolvedGraph, linear: LinearisedGraph, spread: ErrorModes) -> Any:
    """How the residuals of the measurements change when mounts and scale do: rows (R,M), sparse."""
    out = sparse.csr_matrix((linear.matrix.shape[0], len(spread.log_scale)))
    middle = np.concatenate([track.map_from_cam[:, :3, 3] for track in solved.tracks]).mean(axis=0)
    first = 0
    for track in solved.tracks:
        mount, keys = solved.mounts[track.camera], solved.measured_keys[track.camera]
        factors = first + np.arange(len(keys))
        moved = np.repeat(-(adjoint(mount) @ spread.mounts[track.camera])[None], len(keys), axis=0)
        bones = track.map_from_cam @ invert(mount)
        away = track.map_from_cam[:, :3, 3] - middle
        stretched = np.einsum("nji,nj->ni", bones[:, :3, :3], away)
        moved[:, 3:] += stretched[:, :, None] * spread.log_scale
        out = out + linear.sparse_rows(factors, linear.pose_jacobians(factors, 6, keys) @ moved)
        first += len(keys)
    return out


def skeleton_covariance(
    rotation: FloatArray, bones: Sequence[Bone], covariance: FloatArray | None, joints: int
) -> FloatArray | None:
    """Covariance (T,J,3,3) in turned axes, NaN for joints that are no bones, from the bones' (T,B,3,3)."""
    if covariance is None:
        return None
    out = np.full((len(covariance), joints, 3, 3), np.nan)
    out[:, [bone.joint for bone in bones]] = rotation @ covariance @ rotation.T
    return out


def sigma_percentiles(
    roles: Sequence[str], covariance: FloatArray | None, observed: BoolArray
) -> dict[str, dict[str, dict[str, float]]]:
    """Percentiles of the joints' sigmas per axis by role, for measured and for filled ticks apart.

    Args:
        roles: (J,) of the joints.
        covariance: (T,J,3,3), NaN where not solved.
        observed: (T,J) where cameras measured the joint.
    """
    out: dict[str, dict[str, dict[str, float]]] = {}
    if covariance is None:
        return out
    sigma_m = np.sqrt(np.trace(covariance, axis1=2, axis2=3) / 3.0)
    for joint, role in enumerate(roles):
        for name, mask in (("observed", observed[:, joint]), ("filled", ~observed[:, joint])):
            found = sigma_m[mask & np.isfinite(sigma_m[:, joint]), joint]
            if role and len(found) and found.any():
                figures = {f"p{q}": round(float(np.percentile(found, q)), 5) for q in (50, 95)}
                out.setdefault(role, {})[name] = figures
    return out
