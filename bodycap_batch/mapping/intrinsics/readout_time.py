"""Estimate rolling-shutter readout times from the map, and correct the map for them."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.bundle_adjustment import bundle_adjust, sub_model
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.mapping.reconstruction.reprojection import image_residuals_px
from bodycap_batch.model.rolling_shutter import image_velocity, px_at_mid_row
from bodycap_batch.model.scene import Map, Trajectory

if TYPE_CHECKING:
    import pycolmap

_TRIAL_STEP_S = 0.01
"""First step of the readout time, and the largest step, seconds. Evidence: none."""
_TRIAL_ITERATIONS = 40
"""Iterations of a trial adjustment at most. Evidence: none."""
_TRIAL_KEYFRAMES = 24
"""Successive keyframes of each camera that trial adjustments use: those that move most. Evidence: none."""
_MAX_TRIALS = 4
"""Trial values at most. Evidence: none."""
_CONVERGED_S = 0.001
"""Step of the readout time below which the search ends, seconds. Evidence: none."""
_MAX_READOUT_FRAMES = 1.1
"""Largest readout time in frame intervals. The true limit is 1; the rest is for its uncertainty."""
_MIN_READOUT_S = 0.002
"""Readout time below which a shutter counts as global, seconds. Evidence: none."""
_MIN_SIGMAS = 5.0
"""Standard deviations by which an estimate must differ from zero. Evidence: none."""
_LOSS_PX = 1.0
"""Width of the robust weight of a residual, px. Evidence: none."""
_MAX_RESIDUAL_PX = 8.0
"""Residual above which an observation is ignored, px. Evidence: none."""


@dataclass(frozen=True, slots=True)
class Readout:
    """A camera's readout time.

    Attributes:
        seconds: Time from the first row's exposure to the last row's; 0 for a global shutter.
        sigma_s: Standard deviation; 0 if the time was stated.
        source: "stated", "estimated", "none found", or why it could not be determined.
        best_s: Readout time with the smallest residuals, even if it is not significant.
        sideways: True if the sensor's rows are the picture's columns.
    """

    seconds: float
    sigma_s: float
    source: str
    best_s: float
    sideways: bool = False

    @property
    def significance(self) -> float:
        """Readout time in standard deviations; 0 if none was found."""
        return abs(self.seconds) / self.sigma_s if self.sigma_s else 0.0


@dataclass(frozen=True, slots=True)
class _Keypoints:
    """The observations of one keyframe.

    Attributes:
        image_id: Id of its image in the model.
        camera: Name of its camera.
        feature: (N,) indices of features in the image.
        px: (N,2) as detected, px.
        velocity: (N,2) px/s.
    """

    image_id: int
    camera: str
    feature: IntArray
    px: FloatArray
    velocity: FloatArray


class RollingShutterModel:
    """A model whose keypoints can be moved to where they are at the instant of the middle row.

    Args:
        model: COLMAP's reconstruction; not changed.
        trajectories: Poses of every frame in the model's gauge, by camera. Keypoints of a camera without a
            trajectory stay; its frames were registered against another map.
        cameras: The capture's cameras by name.
    """

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        trajectories: Mapping[str, Trajectory],
        cameras: Mapping[str, CaptureCamera],
    ) -> None:
        self._model = model
        self._trajectories = trajectories
        self._cameras = cameras
        self._intrinsics = {
            ImageRef.parse(model.image(image_id).name).camera: camera_from_pycolmap(
                model.image(image_id).camera
            )
            for image_id in model.reg_image_ids()
        }
        self._keypoints = [
            self._keypoints_of(image_id, trajectories) for image_id in sorted(model.reg_image_ids())
        ]

    def corrected(self, readout_s: Mapping[str, float]) -> pycolmap.Reconstruction:
        """Return a copy of the model with all keypoints at the instant of the middle row."""
        out = copy.deepcopy(self._model)
        self.move_keypoints(out, readout_s)
        return out

    def move_keypoints(self, model: pycolmap.Reconstruction, readout_s: Mapping[str, float]) -> None:
        """Move the keypoints of a copy of the model, in place.

        Args:
            model: The copy.
            readout_s: Readout time by camera, seconds. With 0 the keypoints are where they were detected.
        """
        for item in self._keypoints:
            px = px_at_mid_row(
                self._intrinsics[item.camera], item.px, item.velocity, readout_s.get(item.camera, 0.0)
            )
            points = model.image(item.image_id).points2D
            for feature, xy in zip(item.feature.tolist(), px, strict=True):
                points[feature].xy = xy

    def most_dynamic_subset(self) -> RollingShutterModel:
        """Return a model of the successive keyframes of each camera that move most, without all others."""
        kept: set[int] = set()
        for name in self._intrinsics:
            keyframes = [item for item in self._keypoints if item.camera == name]
            keyframes.sort(key=lambda item: ImageRef.parse(self._model.image(item.image_id).name).frame)
            speed = [
                float(np.median(np.abs(item.velocity))) if len(item.velocity) else 0.0 for item in keyframes
            ]
            total = np.concatenate([[0.0], np.cumsum(speed)])
            size = min(_TRIAL_KEYFRAMES, len(keyframes))
            start = int(np.argmax(total[size:] - total[: len(total) - size]))
            kept |= {item.image_id for item in keyframes[start : start + size]}
        part = sub_model(self._model, kept)
        sideways = [name for name, camera in self._intrinsics.items() if camera.sideways]
        return RollingShutterModel(part, self._trajectories, self._cameras).with_sideways(sideways)

    def with_sideways(self, sideways: Collection[str]) -> RollingShutterModel:
        """Return the same model; only in these cameras are the sensor's rows the picture's columns."""
        out = copy.copy(self)
        out._intrinsics = {
            name: replace(camera, sideways=name in sideways) for name, camera in self._intrinsics.items()
        }
        return out

    def estimate(
        self, settings: pycolmap.IncrementalPipelineOptions, calibrated_ids: Sequence[int]
    ) -> dict[str, Readout]:
        """Estimate readout times by camera, from adjustments of the map with a few trial values.

        After poses and points are adjusted, the residuals are almost linear in the readout time. Their change
        from one trial to the next gives the next step.

        Args:
            settings: The mapper's options.
            calibrated_ids: Ids of the calibrated cameras.

        Raises:
            EstimationError: An adjustment failed.

        Source: secant steps on the reduced functional of Golub, Pereyra, "The differentiation of
            pseudo-inverses and nonlinear least squares problems whose variables separate", 1973.
        """
        names = [name for name in self._intrinsics if name in self._trajectories]
        unknown = [name for name in names if not self._cameras[name].rolling_shutter_known]
        out = {
            name: _stated_readout(self._cameras[name].rolling_shutter_s)
            for name in names
            if name not in unknown
        }
        if not unknown:
            return out
        frame_s = {name: float(np.median(np.diff(self._cameras[name].times_ns))) * 1e-9 for name in unknown}
        readout_s = {name: readout.seconds for name, readout in out.items()} | dict.fromkeys(unknown, 0.0)
        model = self.corrected(readout_s)
        bundle_adjust(model, settings, calibrated_ids, _TRIAL_ITERATIONS)
        before = self._residuals(model)
        step_s = dict.fromkeys(unknown, _TRIAL_STEP_S)
        for _ in range(_MAX_TRIALS):
            readout_s = readout_s | {name: readout_s[name] + step_s[name] for name in unknown}
            self.move_keypoints(model, readout_s)
            bundle_adjust(model, settings, calibrated_ids, _TRIAL_ITERATIONS)
            after = self._residuals(model)
            for name in unknown:
                slope = _ResidualSlope.of(before[name], after[name], step_s[name])
                out[name] = slope.readout(readout_s[name], frame_s[name])
                step_s[name] = float(
                    np.clip(out[name].best_s - readout_s[name], -_TRIAL_STEP_S, _TRIAL_STEP_S)
                )
            if max(map(abs, step_s.values())) < _CONVERGED_S:
                break
            before = after
        return out

    def undetermined(self, reason: str) -> dict[str, Readout]:
        """Return the stated readout times; those of other cameras are 0 and carry the reason."""
        out = {}
        for name in self._intrinsics:
            camera = self._cameras[name]
            if camera.rolling_shutter_known:
                out[name] = _stated_readout(camera.rolling_shutter_s)
            else:
                out[name] = Readout(0.0, 0.0, f"not determined: {reason}", 0.0)
        return out

    def _keypoints_of(self, image_id: int, trajectories: Mapping[str, Trajectory]) -> _Keypoints:
        """Return the observations of one image, with their velocities."""
        image = self._model.image(image_id)
        ref = ImageRef.parse(image.name)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        px = np.array([image.points2D[index].xy for index in feature.tolist()]).reshape(-1, 2)
        x_in_map = self._points(image, feature)
        path = trajectories.get(ref.camera)
        if path is None:  # Registered against another map: its motion in this gauge is unknown.
            return _Keypoints(image_id, ref.camera, feature, px, np.zeros_like(px))
        velocity = image_velocity(
            self._intrinsics[ref.camera],
            path.gauge_from_cam,
            path.times_ns,
            np.full(len(feature), ref.frame, dtype=np.int64),
            x_in_map,
        )
        return _Keypoints(image_id, ref.camera, feature, px, velocity)

    def _points(self, image: Any, feature: IntArray) -> FloatArray:
        """Return the points (N,3) that features of an image observe, in the map."""
        points = image.points2D
        return np.array(
            [self._model.point3D(points[index].point3D_id).xyz for index in feature.tolist()]
        ).reshape(-1, 3)

    def _residuals(self, model: pycolmap.Reconstruction) -> dict[str, FloatArray]:
        """Return observed minus projected pixels by camera, in the same order for every copy of the model."""
        out: dict[str, list[FloatArray]] = {name: [] for name in self._intrinsics}
        for item in self._keypoints:
            residuals = image_residuals_px(model, model.image(item.image_id), item.feature)
            out[item.camera].append(residuals.ravel())
        return {name: np.concatenate([np.zeros(0), *parts]) for name, parts in out.items()}


@dataclass(frozen=True, slots=True)
class _ResidualSlope:
    """How the residuals of an adjusted map change with the readout time.

    Attributes:
        correlation: Weighted product of the residuals with their derivative by the readout time, px²/s.
        information: Weighted square of the derivative, px²/s².
        variance: Variance of the residuals about the line, px².
    """

    correlation: float
    information: float
    variance: float

    @staticmethod
    def of(before: FloatArray, after: FloatArray, step_s: float) -> _ResidualSlope:
        """Return the slope at the second of two adjustments.

        Args:
            before: (N,) residuals of the first adjustment, px.
            after: (N,) residuals of the second adjustment, px.
            step_s: Difference of their readout times, seconds.
        """
        change = (after - before) / (step_s if step_s else np.inf)
        # Points that an adjustment moves far away carry no information on the shutter.
        small = np.maximum(np.abs(after), np.abs(before)) < _MAX_RESIDUAL_PX
        weight = np.where(small, 1.0 / (1.0 + (after / _LOSS_PX) ** 2), 0.0)
        information = float((weight * change * change).sum())
        correlation = float((weight * change * after).sum())
        best = after - change * (correlation / information if information else 0.0)
        variance = float((weight * best**2).sum() / max(weight.sum(), 1.0))
        return _ResidualSlope(correlation, information, variance)

    def readout(self, at_s: float, frame_s: float) -> Readout:
        """Return the readout time with the smallest residuals, or 0 if it is not significant.

        Args:
            at_s: Readout time at which the slope was taken, seconds.
            frame_s: Frame interval, seconds.
        """
        if self.information <= 0.0:
            return Readout(0.0, float("inf"), "none found", at_s)
        best_s = at_s - self.correlation / self.information
        sigma_s = float(np.sqrt(self.variance / self.information))
        found = max(_MIN_READOUT_S, _MIN_SIGMAS * sigma_s) < abs(best_s) < _MAX_READOUT_FRAMES * frame_s
        return Readout(best_s if found else 0.0, sigma_s, "estimated" if found else "none found", best_s)


def estimate_readouts(
    rolling: RollingShutterModel,
    cameras: Mapping[str, CaptureCamera],
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Sequence[int],
) -> tuple[RollingShutterModel, dict[str, Readout]]:
    """Estimate readout times by camera, and whether the sensors' rows are the pictures' columns.

    If a trial adjustment fails, only stated readout times are used, and the result gives the reason.

    Args:
        rolling: The model.
        cameras: The capture's cameras by name.
        settings: The mapper's options.
        calibrated_ids: Ids of the calibrated cameras.

    Returns:
        The model with the row directions that fit best, and the readout times.
    """
    stated = {name for name, camera in cameras.items() if camera.camera.sideways}
    rolling = rolling.with_sideways(stated)
    try:
        part = rolling.most_dynamic_subset()
        readouts = part.estimate(settings, calibrated_ids)
        turned = {
            name
            for name in readouts
            if cameras[name].may_be_sideways and not cameras[name].rolling_shutter_known
        }
        sideways = part.with_sideways(stated | turned).estimate(settings, calibrated_ids) if turned else {}
    except EstimationError as error:
        readouts, turned, sideways = rolling.undetermined(error.message), set(), {}
    better = {name for name in turned if sideways[name].significance > readouts[name].significance}
    readouts |= {name: sideways[name] for name in better}
    readouts = {
        name: replace(readout, sideways=name in stated | better) for name, readout in readouts.items()
    }
    return rolling.with_sideways(stated | better), readouts


def map_with_readouts(scene: Map, readouts: Mapping[str, Readout]) -> Map:
    """Return a corrected map with the readout times and row directions it was corrected for."""
    nonzero = {name: readout for name, readout in readouts.items() if readout.seconds}
    cameras = {
        name: replace(camera, sideways=name in nonzero and nonzero[name].sideways)
        for name, camera in scene.cameras.items()
    }
    return replace(
        scene, cameras=cameras, readout_s={name: readout.seconds for name, readout in nonzero.items()}
    )


def _stated_readout(readout_s: float) -> Readout:
    """Return the readout time that the job states."""
    return Readout(readout_s, 0.0, "stated", readout_s)
