"""Compare the gyroscope of a camera with its pictures: clock, mounting, and stabilisation of the pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from bodycap_batch.capture import CaptureCamera, open_camera
from bodycap_batch.capture.timeline import join_chapters
from bodycap_batch.config.models import CameraConfig, CaptureConfig
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.geometry import so3_exp, so3_log
from bodycap_batch.model.picture_turns import stabilisation_note
from bodycap_batch.telemetry.gyro_fit import GyroFit, fit_gyro
from bodycap_batch.telemetry.picture_orientation import recorded_turns
from bodycap_batch.telemetry.picture_rotation import WORK_PX, PictureRotation, measure_picture_rotation
from bodycap_batch.telemetry.reading import read_telemetry
from bodycap_batch.telemetry.streams import IMAGE_ORIENTATION, CameraTelemetry, Stream

Verdict = Literal["agrees", "stabilised", "unknown"]
"""Whether pictures and gyroscope turn together, the camera stabilised the pictures, or neither can be
said."""

_MIN_R_SQUARED = 0.9
"""Minimum share of the variance that the gyroscope explains if pictures and gyroscope agree. Evidence:
docs/decisions/telemetry.md."""
_MAX_PEAK_RATIO = 0.5
"""Maximum unexplained share of the variance at the best delay, as a ratio to that at a typical delay. With a
larger ratio there is no peak, and the delay is not determined. Evidence: none."""
_MIN_SHAKE_RAD_S = 0.02
"""Minimum fast changes (rad/s) of the gyroscope that a comparison needs. Origin: a tenth of a pixel per
frame, at 30 frames per second and 500 pixels of focal length, is 0.006 rad/s."""
_MAX_SHAKE_RATIO = 0.6
"""Maximum ratio of the fast changes of the pictures to those of the gyroscope, of a stabilised video.
Evidence: docs/decisions/telemetry.md."""
_UNDO_ROUNDS = 3
"""Number of times that a stabilisation is undone, each time with a better focal ratio."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureGyroComparison:
    """The result of a comparison.

    Attributes:
        verdict: Whether pictures and gyroscope agree.
        reason: Sentence that explains the verdict.
        fit: The fit of the pictures as they are; None if there are too few pictures or samples.
        undone: The fit after the recorded orientations undid the stabilisation; None if it was not undone.
    """

    verdict: Verdict
    reason: str
    fit: GyroFit | None = None
    undone: GyroFit | None = None

    @property
    def best(self) -> GyroFit | None:
        """The fit that gives delay, rotation and bias; None if they are not determined."""
        if self.verdict == "agrees":
            return self.fit
        return self.undone if self.undone is not None and _is_good(self.undone) else None


def compare_picture_and_gyro(camera: CaptureCamera, telemetry: CameraTelemetry) -> PictureGyroComparison:
    """Compare the rotations of the pictures with the gyroscope of the same camera.

    Args:
        camera: The camera. A work size of `WORK_PX` is enough.
        telemetry: Its telemetry.

    Raises:
        CaptureError: The video cannot be read.
    """
    gyro = telemetry.gyro
    if gyro is None or len(gyro.times_s) < 2:
        return PictureGyroComparison(verdict="unknown", reason="there is no gyroscope to compare with")
    picture = measure_picture_rotation(camera, gyro)
    return judge_rotations(picture, gyro, telemetry)


def judge_rotations(
    picture: PictureRotation, gyro: Stream, telemetry: CameraTelemetry, *, focal_known: bool = False
) -> PictureGyroComparison:
    """Compare measured rotations of pictures with a gyroscope.

    Args:
        picture: The rotations of the pictures.
        gyro: The gyroscope.
        telemetry: The telemetry with the orientations of the image, if the camera recorded them.
        focal_known: Whether the focal length behind the rotations is exact.
    """
    fit = fit_gyro(picture, gyro, axes_known=telemetry.axes_known, focal_known=focal_known)
    verdict: Verdict = "unknown"
    undone = None
    if fit is None:
        reason = "too few pictures with texture have samples of the gyroscope"
    elif _is_good(fit):
        verdict = "agrees"
        reason = f"pictures and gyroscope turn together (R² {fit.r_squared:.2f})"
    elif fit.gyro_shake_rad_s < _MIN_SHAKE_RAD_S:
        reason = f"the camera turns too little for a comparison ({fit.gyro_shake_rad_s:.3f} rad/s)"
    elif (share := fit.picture_shake_rad_s / fit.gyro_shake_rad_s) > _MAX_SHAKE_RATIO:
        reason = (
            f"pictures and gyroscope do not agree (R² {fit.r_squared:.2f}), although both turn: the "
            "samples may belong to another video, or the pictures show too little of the room"
        )
    else:
        verdict = "stabilised"
        undone = _undone_fit(picture, gyro, telemetry, focal_known=focal_known)
        reason = (
            f"the camera stabilised the video: the pictures show {100 * share:.0f} % of the shaking that "
            f"its gyroscope measured (R² {max(fit.r_squared, 0.0):.2f}); {_undo_text(undone)}"
        )
    return PictureGyroComparison(verdict=verdict, reason=reason, fit=fit, undone=undone)


def _is_good(fit: GyroFit) -> bool:
    has_peak = 1.0 - fit.r_squared < _MAX_PEAK_RATIO * (1.0 - fit.typical_r_squared)
    return fit.r_squared >= _MIN_R_SQUARED and has_peak


def _undo_text(undone: GyroFit | None) -> str:
    if undone is None:
        return "it cannot be undone, because the camera recorded no orientations of the image"
    if _is_good(undone):
        return f"the recorded orientations of the image undo it (R² {undone.r_squared:.2f})"
    return (
        "it cannot be undone: with the recorded orientations of the image, pictures and gyroscope still "
        f"disagree (R² {max(undone.r_squared, 0.0):.2f})"
    )


def _undone_fit(
    picture: PictureRotation, gyro: Stream, telemetry: CameraTelemetry, *, focal_known: bool
) -> GyroFit | None:
    """Return the fit after the orientations of the image undid the stabilisation; None without them."""
    if IMAGE_ORIENTATION not in telemetry.streams:
        return None
    ratio, best = 1.0, None
    for _ in range(_UNDO_ROUNDS):
        undone = undo_stabilisation(picture, telemetry, ratio)
        fit = fit_gyro(undone, gyro, axes_known=telemetry.axes_known, focal_known=focal_known)
        if fit is None:
            break
        best = fit
        ratio *= fit.focal_ratio
    return best


def undo_stabilisation(
    picture: PictureRotation, telemetry: CameraTelemetry, focal_ratio: float = 1.0
) -> PictureRotation:
    """Return the rotations of the camera instead of those of the stabilised image.

    A pair of frames without a recorded orientation is left out.

    Args:
        picture: Rotations that the stabilised pictures show.
        telemetry: The telemetry with the recorded orientations.
        focal_ratio: True focal length divided by the assumed one.
    """
    first, has_first = recorded_turns(telemetry, picture.start_s)
    second, has_second = recorded_turns(telemetry, picture.end_s)
    keep = np.flatnonzero(has_first & has_second)
    picture = picture.chosen(keep)
    first_from_second = so3_exp(picture.turn_rad / focal_ratio)
    turned = first[keep] @ first_from_second @ np.swapaxes(second[keep], 1, 2)
    return replace(picture, turn_rad=so3_log(turned).reshape(-1, 3))


def all_times_ns(camera: CaptureCamera, config: CameraConfig) -> IntArray:
    """Return the time of every frame of a camera, used or not, on its clock, nanoseconds.

    Raises:
        CaptureError: A file of timestamps cannot be used.
    """
    return join_chapters(camera.videos, config.timestamps).times_ns


def telemetry_notes(spec: CaptureConfig) -> list[str]:
    """Return notes on damaged telemetry, timelapses, and videos that the gyroscope shows to be stabilised.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
    """
    notes = []
    small = spec.model_copy(update={"work_px": min(spec.work_px, WORK_PX)})
    for config in spec.cameras:
        try:
            camera = open_camera(small, config.model_copy(update={"mask": None}), threads=1)
            telemetry = read_telemetry(camera.videos, all_times_ns(camera, config), config.samples)
            notes += [f"{config.name}: {note}" for note in telemetry.notes]
            compared = compare_picture_and_gyro(camera, telemetry)
        except CaptureError as error:  # a video that cannot be read is reported by the other checks
            if error.path is not None and error.path.endswith((".csv", ".gcsv")):
                notes.append(f"{config.name}: {error.one_line}; its samples are not used")
            continue
        note = stabilisation_note(telemetry.stabilisation, recorded=compared.best is not None)
        # The check of the settings reports what the file states.
        if compared.verdict == "stabilised" and note != telemetry.stabilisation_note():
            notes.append(f"{config.name}: {note}")
    return notes
