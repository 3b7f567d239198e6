"""Where further maps lie in the main one, by Gauss-Newton over a calibration that follows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.calibration_covariance import (
    measurement_jacobian,
    rescale_sigmas,
    scale_jacobian,
    variance_factors,
)
from bodycap_batch.merging.body_calibration.calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.mount_covariance import LinearisedCalibration, RowType
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.model.geometry import Similarity, so3_exp

_LOOSENED = (16.0, 4.0, 1.0)
"""Slack of the joints in turn: a start that is a decimetre off must pull, not be taken for gross errors."""
_STEPS = 8
_CLOSE = 1e-3
"""Share of the cost by which a step changes it that is the last."""


class Placing:
    """A calibration whose further maps may move: their similarities by Gauss-Newton, all else eliminated.

    Args:
        calibration: At a provisional place of all maps.
        groups: The cameras of each further map.
        scale: Metres per unit of the main map, provisional.
        reach_sigma: Of its logarithm.
        stated: What the job itself says of it.
    """

    def __init__(
        self,
        calibration: CalibrationGraph,
        groups: Sequence[tuple[str, ...]],
        scale: float,
        *,
        reach_sigma: float,
        stated: Sequence[ScaleSource] = (),
    ) -> None:
        self._calibration, self._scale = calibration, scale
        self._sources: tuple[ScaleSource, ...] = (
            ScaleSource(name="reach", scale=scale, sigma_log=reach_sigma),
            *stated,
        )
        cameras = calibration.samples.cameras
        self._members = [[cameras.index(name) for name in group] for group in groups]
        self.moved = [Similarity(1.0, np.eye(3), np.zeros(3)) for _ in groups]
        self._covariance = np.zeros((0, 0))

    def solve(self) -> None:
        """Move the maps until the body's cost no longer falls, its joints stiffer step by step."""
        for slack in _LOOSENED:
            self._calibration.slack_factor = slack
            self._descend()
        mounts, shifts = self._linearised()
        rescale_sigmas(self._calibration, mounts, mounts.reduced(shifts))
        self._descend()
        self._covariance = self._step(0.0)[1]

    def scale(self) -> ScaleSource:
        """The solved scale of the main map."""
        sigma = float(np.sqrt(self._covariance[0, 0]))
        return ScaleSource(name="body", scale=self._scale, sigma_log=sigma)

    def know(self, sources: Sequence[ScaleSource]) -> None:
        """Weigh what else knows the scale into the solution."""
        if sources:
            self._sources += tuple(sources)
            self._descend()
            self._covariance = self._step(0.0)[1]

    def _descend(self) -> None:
        cost = self._cost()
        damping = 1e-4
        for _ in range(_STEPS):
            change, _ = self._step(damping)
            before = self._calibration.samples, self._scale, list(self.moved)
            self._apply(change)
            trial = self._cost()
            close = abs(trial - cost) < _CLOSE * max(cost, 1.0)
            if trial > cost:
                self._calibration.set_samples(before[0])
                _, self._scale, self.moved = before
                self._calibration.solve(self._scale)
                damping = max(100.0 * damping, 1e-2)
            else:
                cost, damping = trial, 0.1 * damping
            if close:
                break

    def sigmas(self, index: int) -> tuple[float, float]:
        """Sigma per axis of a map's rotation (rad) and its cameras' positions (m), over the samples."""
        centres, middle = self._centres(index)
        mine = slice(1 + 7 * index, 8 + 7 * index)
        values, vectors = np.linalg.eigh(self._covariance[mine, mine])
        half = vectors * np.sqrt(np.maximum(values, 0.0))
        off = (centres - middle)[:, :, None]
        arms = np.cross(half[None, :3].swapaxes(1, 2), off.swapaxes(1, 2)).swapaxes(1, 2)
        shifts = arms + off * half[None, 3:4] + half[None, 4:]
        position = (shifts**2).sum(axis=(1, 2)).mean()
        return float(np.sqrt((half[:3] ** 2).sum() / 3.0)), float(np.sqrt(position / 3.0))

    def _centres(self, index: int) -> tuple[FloatArray, FloatArray]:
        samples, members = self._calibration.samples, self._members[index]
        centres = self._scale * samples.map_from_cam[members][samples.valid[members], :3, 3]
        return centres, centres.mean(axis=0)

    def _step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Change (1 + 7 G) of log scale and maps that lowers the cost, and its covariance."""
        mounts, shifts = self._linearised()
        solved = mounts.reduced(shifts)
        count = shifts.shape[1]
        told = np.zeros((len(self._sources), solved.jacobian.shape[1]))
        told[:, -count] = [1.0 / source.sigma_log for source in self._sources]
        influence = np.vstack([solved.jacobian, told])
        right = np.append(mounts.linear.right, -self._from_sources())
        normal = influence.T @ influence
        variance = variance_factors(self._calibration.samples, mounts, solved)[
            np.append(mounts.row_types, np.full(len(told), RowType.PRIOR))
        ]
        gain = _solved(normal, influence.T)
        # A posture that is the wearer's habit, not the prior's, bends mounts and maps alike.
        habit = (mounts.posture_bias_jacobian().T @ gain[:, : -len(told)].T).T
        covariance = (gain * variance) @ gain.T + habit @ habit.T
        free = np.arange(len(normal) - count, len(normal))
        normal[free, free] *= 1.0 + damping
        change = _solved(normal, influence.T @ right)[-count:]
        return np.asarray(change, dtype=np.float64), np.asarray(covariance[-count:, -count:])

    def _linearised(self) -> tuple[LinearisedCalibration, FloatArray]:
        """The graph's derivatives by bones and mounts, and (R,1 + 7 G) those by log scale and maps."""
        mounts = self._calibration.linearised()
        shifts = -measurement_jacobian(self._calibration, mounts.linear, self._directions())
        shifts[:, 0] -= scale_jacobian(self._calibration, mounts)
        return mounts, shifts

    def _cost(self) -> float:
        return self._calibration.solve(self._scale) + 0.5 * float((self._from_sources() ** 2).sum())

    def from_reach(self) -> float:
        """How far the scale has left the one that the limbs' reach gave, in sigmas."""
        return float(self._from_sources()[0])

    def _from_sources(self) -> FloatArray:
        """How far the scale is from what each source says, in sigmas."""
        return np.array([np.log(self._scale / each.scale) / each.sigma_log for each in self._sources])

    def _directions(self) -> FloatArray:
        """(C,K,P,6) movement of each camera's pose in metres, turn and shift in the main map's axes."""
        samples = self._calibration.samples
        centres = self._scale * samples.map_from_cam[..., :3, 3]
        out = np.zeros((*centres.shape[:2], 1 + 7 * len(self._members), 6))
        seen = samples.valid
        out[:, :, 0, 3:] = centres - centres[seen].mean(axis=0)
        for index, members in enumerate(self._members):
            first = 1 + 7 * index
            off = centres[members] - self._centres(index)[1]
            for axis, unit in enumerate(np.eye(3)):
                out[members, :, first + axis, :3] = unit
                out[members, :, first + axis, 3:] = np.cross(unit, off)
                out[members, :, first + 4 + axis, 3 + axis] = 1.0
            out[members, :, first + 3, 3:] = off
        return out

    def _apply(self, change: FloatArray) -> None:
        """Move the samples and remember where the maps went."""
        samples = self._calibration.samples
        poses = samples.map_from_cam.copy()
        for index, members in enumerate(self._members):
            turn, stretch, shift = np.split(change[1 + 7 * index : 8 + 7 * index], [3, 4])
            middle = self._centres(index)[1] / self._scale
            rotation, factor = so3_exp(turn), float(np.exp(stretch[0]))
            update = Similarity(factor, rotation, middle + shift / self._scale - factor * rotation @ middle)
            poses[members] = update.apply_to_poses(poses[members])
            self.moved[index] = update.after(self.moved[index])
        self._calibration.set_samples(replace(samples, map_from_cam=poses))
        self._scale *= float(np.exp(change[0]))


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of the maps' places.

    Raises:
        EstimationError: They are singular.
    """
    try:
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            "the body's movement does not determine where the map lies",
            hint="bending, turns in the walk, an upper arm's camera or a common view settle it",
        ) from error
