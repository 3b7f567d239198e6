"""Use the inertial sensor of one camera after its frames are registered."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.options import TelemetryOptions
from bodycap_batch.inertial.alignment import SensorAlignment, align_sensor
from bodycap_batch.inertial.clip_solver import ClipSolver
from bodycap_batch.inertial.force_windows import force_windows
from bodycap_batch.inertial.gap_filling import constants_of_clip, fill_gaps
from bodycap_batch.inertial.path_solving import solve_path
from bodycap_batch.model.earth import GpsFixes
from bodycap_batch.model.gravity import fit_gravity
from bodycap_batch.model.inertial_camera import ForceWindows, InertialCamera
from bodycap_batch.model.picture_turns import PictureTurns
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.telemetry.comparison import PictureGyroComparison
from bodycap_batch.telemetry.picture_orientation import turns_of_pictures, unrecorded_turns
from bodycap_batch.telemetry.streams import CameraTelemetry, GpsTrack

_MAX_DILUTION = 10.0
"""Maximum dilution of precision of a used position. Origin: receivers call a larger one poor."""
_SIGMA_PER_DILUTION_M, _UNKNOWN_SIGMA_M = 2.5, 5.0
"""Standard deviation of a horizontal coordinate (metres) per dilution of precision, and if the dilution is
unknown. Origin: usual range errors of consumer's receivers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UsedSensor:
    """What the sensor of a camera gives.

    Attributes:
        camera: Its relation to the camera, and what it measures.
        trajectory: The poses of the pictures, with the frames that the sensor added.
    """

    camera: InertialCamera
    trajectory: Trajectory


@dataclass(frozen=True, slots=True)
class _Prepared:
    """The path of a camera, the relation of its sensor to it, and the means of the specific force.

    The path has the axes of the camera. They differ from those of stabilised pictures by `turns`.
    """

    trajectory: Trajectory
    turns: PictureTurns | None
    aligned: SensorAlignment
    windows: ForceWindows | None

    @staticmethod
    def of(pictures: Trajectory, telemetry: CameraTelemetry) -> _Prepared:
        trajectory, turns, aligned = _aligned(pictures, telemetry)
        if aligned.fit is None or aligned.samples is None:
            return _Prepared(trajectory, turns, aligned, None)
        windows = force_windows(trajectory, aligned.samples, aligned.fit.rotation_sigma_rad)
        return _Prepared(trajectory, turns, aligned, windows)

    def solver(self, others: Sequence[_Prepared]) -> ClipSolver | None:
        """Return the solver of the clip; None if vertical and scale are too uncertain.

        Vertical and scale come from the windows of all cameras: a camera with many lost frames may have none.
        """
        fit, samples, windows = self.aligned.fit, self.aligned.samples, self.windows
        if fit is None or samples is None or windows is None:
            return None
        gravity = fit_gravity([windows, *(each.windows for each in others if each.windows is not None)])
        if gravity is None:
            return None
        constants = constants_of_clip(fit, gravity, has_windows=bool(len(windows.times_s)))
        return None if constants is None else ClipSolver(self.trajectory, samples, constants)


def _aligned(
    pictures: Trajectory, telemetry: CameraTelemetry
) -> tuple[Trajectory, PictureTurns | None, SensorAlignment]:
    """Return the path of a camera, the turns of its pictures, and the comparison of its sensor with the path.

    The sensor turns with the camera, not with stabilised pictures. If it agrees less with poses that the
    record turned back, the pictures were turned in another way, for example by another program: the record is
    not used.
    """
    plain = align_sensor(pictures, telemetry)
    turns = turns_of_pictures(telemetry, pictures.seconds)
    if turns is None and plain.comparison.verdict != "stabilised":
        return pictures, None, plain
    if turns is not None and turns.recorded.any():
        path = turns.exact().camera_path(pictures)
        aligned = align_sensor(path, telemetry)
        if _explained(aligned) >= _explained(plain):
            return path, turns, aligned
    unused = plain.comparison
    if unused.verdict == "agrees":  # fast movements hide the turns of the pictures relative to the lens
        reason = "the camera stabilised the video without a usable record of how it turned the pictures"
        unused = PictureGyroComparison(verdict="stabilised", reason=reason)
    return pictures, unrecorded_turns(telemetry, len(pictures.status)), SensorAlignment(comparison=unused)


def _explained(aligned: SensorAlignment) -> float:
    """Return the share of the variance that the sensor explains; 0 without a fit."""
    fit = aligned.comparison.fit
    return 0.0 if fit is None else fit.r_squared


def use_sensor(
    pictures: Trajectory,
    telemetry: CameraTelemetry,
    options: TelemetryOptions,
    others: Iterable[tuple[Trajectory, CameraTelemetry]] = (),
) -> UsedSensor:
    """Estimate how the sensor of a camera relates to its solved poses, and use what it measures.

    Args:
        pictures: The poses of the camera's frames, in the axes of the pictures.
        telemetry: The telemetry of the camera.
        options: Which uses of the telemetry are on.
        others: Poses and telemetry of other cameras. They help to find the vertical and the scale of the map.
    """
    own = _Prepared.of(pictures, telemetry)
    trajectory, aligned, windows = own.trajectory, own.aligned, own.windows
    used, frames = trajectory, dict[str, int]()
    if windows is not None and (options.gaps or options.smoothing):
        prepared = [_Prepared.of(*other) for other in others if other[0].gauge == trajectory.gauge]
        solver = own.solver(prepared)
        if solver is not None:
            around = [
                found
                for index, other in enumerate(prepared)
                if (found := other.solver([own, *prepared[:index], *prepared[index + 1 :]])) is not None
            ]
            used, frames = _used_path(solver, around, options)
    camera = InertialCamera(
        camera=trajectory.camera,
        gauge=trajectory.gauge,
        source=telemetry.source,
        verdict=aligned.comparison.verdict,
        reason=aligned.comparison.reason,
        relation=aligned.fit,
        windows=windows if options.gravity and windows is not None and len(windows.times_s) else None,
        gps=_gps_fixes(telemetry.gps) if options.gps and telemetry.gps is not None else None,
        turns=own.turns,
        **frames,
    )
    if used is trajectory:
        return UsedSensor(camera=camera, trajectory=pictures)
    exact = None if own.turns is None else own.turns.exact()
    solved = used if exact is None else exact.picture_path(used)
    return UsedSensor(camera=camera, trajectory=solved)


def _used_path(
    solver: ClipSolver, others: Sequence[ClipSolver], options: TelemetryOptions
) -> tuple[Trajectory, dict[str, int]]:
    """Return the trajectory with the poses that the sensor improved and added, and the numbers of frames.

    The names of the numbers are those of `InertialCamera`.

    A pose that contradicts the sensor is replaced like that of a lost frame. If that is not possible, it
    stays.
    """
    path = solver.trajectory
    wrong = np.zeros(len(path.status), dtype=bool)
    moved, result = wrong, path
    if options.smoothing:
        solved = solve_path(solver)
        moved, wrong, result = solved.moved, solved.wrong, solved.trajectory
    if not options.gaps:
        return result, {"solved": int(moved.sum())}
    found = fill_gaps(solver.without(wrong), others)
    refused = found.refused - int((wrong & ~found.filled).sum())
    return found.added_to(result), {
        "filled": int((found.filled & ~wrong).sum()),
        "refused": max(refused, 0),
        "solved": int(moved.sum()),
        "replaced": int((found.filled & wrong).sum()),
    }


def _gps_fixes(track: GpsTrack) -> GpsFixes | None:
    """Return the usable positions of a GPS receiver; None if there are none."""
    unknown = ~np.isfinite(track.dilution)
    usable = (track.fix != 0) & (unknown | (track.dilution < _MAX_DILUTION))
    if not usable.any():
        return None
    sigma_m = np.where(unknown, _UNKNOWN_SIGMA_M, _SIGMA_PER_DILUTION_M * np.nan_to_num(track.dilution))
    return GpsFixes(
        times_s=track.times_s[usable],
        latitude_longitude_deg=track.latitude_longitude_deg[usable],
        altitude_m=track.altitude_m[usable],
        sigma_m=np.maximum(sigma_m[usable], _SIGMA_PER_DILUTION_M),
    )
