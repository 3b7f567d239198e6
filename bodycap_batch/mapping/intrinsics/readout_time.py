"""Estimate rolling-shutter readout times from the map, and correct the map for them."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.bundle_adjustment import bundle_adjust, sub_model
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion, camera_motions
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.mapping.reconstruction.motion_adjustment import (
    MAX_GLOBAL_S,
    MIN_SIGMAS,
    AdjustedReadout,
    MotionAdjustment,
)
from bodycap_batch.mapping.reconstruction.reprojection import image_residuals_px
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.optical_flow import pixel_scale
from bodycap_batch.model.rotation_path import PosePath, RotationPath, near_in_time
from bodycap_batch.model.scene import Map, Trajectory

if TYPE_CHECKING:
    import pycolmap

_TRIAL_STEP_S = 0.01
"""First step and maximum step (seconds) in the search for the readout time. Evidence: none."""
_NEXT_STEP_S = 0.003
"""First step (seconds) if the search starts from an estimate. Evidence: none."""
_TRIAL_ITERATIONS = 40
"""Maximum number of iterations of a trial adjustment. Evidence: none."""
_TRIAL_KEYFRAMES = 24
"""Maximum number of keyframes of each camera in a trial adjustment. The successive keyframes with the largest
motion are used. Evidence: none."""
_MAX_TRIALS = 4
"""Maximum number of trial values of the readout time, in addition to the first trial value 0.
Evidence: none."""
_CONVERGED_S = 0.001
"""Maximum step of the readout time (seconds) at convergence. The search ends if the next step of every camera
is smaller. Evidence: none."""
_MAX_READOUT_FRAMES = 1.1
"""Maximum estimated readout time, in frame intervals. The physical limit is one frame interval. The value is
a little larger, because the estimate is uncertain."""
_MIN_READOUT_S = 0.001
"""Minimum estimated readout time (seconds) of a rolling shutter. A shorter one moves no pixel by much.
Evidence: none."""
_MAX_SIGMA_S = 0.004
"""Maximum standard deviation of a determined readout time, seconds. Evidence: none."""
_MAX_DIFFERENCE_S = 0.003
"""Maximum difference of the readout times from residuals and from matches, seconds. With a larger difference,
the residuals are not used. Evidence: none."""
_MODEL_SIGMA_RATIO = 0.025
"""Standard deviation that is added to each estimate, as a ratio of the readout time. A hand shakes faster
than the spline through the poses of the frames follows. Evidence: docs/decisions/mapping.md."""
_MAX_POOLED_SIGMAS = 3.0
"""Maximum deviation of the readout time of a camera from the mean of equal cameras, in its standard
deviations. With a larger deviation, the cameras do not share the mean. Evidence: none."""
STATED = "stated"
"""`Readout.source` of a readout time that is given in the job."""
_NONE_FOUND = "none found"
"""`Readout.source` of a camera without a rolling shutter, as far as an estimate can show it."""
_UNDETERMINED = "not determined: "
"""First words of `Readout.source` of a camera whose readout time is unknown; the reason follows."""
_BLOCKS = 8
"""Number of blocks of successive keyframes from which a standard deviation is estimated. Evidence: none."""
_FLOOR_SIGMA_S = 0.0002
"""Standard deviation that is added to each estimate and to each mean of equal cameras, seconds, because the
path between frames is a spline. Evidence: docs/decisions/mapping.md."""
DISPLACED_PERCENT = 95.0
"""Percentile of the displacements of keypoints that is compared with a limit. Evidence: none."""
_LOSS_PX = 1.0
"""Width (px) of the robust weight function of a residual. Evidence: none."""
_MAX_RESIDUAL_PX = 8.0
"""Maximum residual (px) of an observation that is used. Evidence: none."""


@dataclass(frozen=True, slots=True)
class Readout:
    """A camera's readout time, and how it was determined.

    Attributes:
        seconds: Time (seconds) from the exposure of the sensor's first row to the exposure of the last row;
            0 for a global shutter.
        sigma_s: Standard deviation of the readout time, seconds; 0 if the time is given in the job.
        source: "stated" (given in the job), "estimated", "none found", "of the map" (the time for which an
            earlier map was corrected), or the reason why the time could not be determined.
        best_s: Readout time (seconds) with the smallest residuals, even if it is not significant.
        sideways: True if the sensor's rows are columns of the image.
    """

    seconds: float
    sigma_s: float
    source: str
    best_s: float
    sideways: bool = False

    def pooled(self, others: Sequence[Readout]) -> Readout:
        """Return the readout time with the common best value of equal cameras, if all of them agree with it.

        Args:
            others: The readout times of the equal cameras whose residuals agree with their matches.

        Source: Birge, "The calculation of errors by the method of least squares", 1932, for the standard
            deviation of a mean of values that scatter more than their standard deviations.
        """
        mean = _consistent_mean(others, _MAX_POOLED_SIGMAS)
        if mean is None or list(others) == [self]:
            return self
        best_s = mean[0]
        sigma_s = float(np.linalg.norm([mean[1], _FLOOR_SIGMA_S, _MODEL_SIGMA_RATIO * best_s]))
        return judged_readout(best_s, sigma_s, sideways=self.sideways)

    def with_other_estimate(self, other: Readout) -> Readout:
        """Return the mean of the readout time from the residuals of a map and that from matches.

        The residuals of a map hold only the points that agree with the map. If they contradict the matches
        between adjacent frames, the matches are right.

        Args:
            other: The readout time from matches between adjacent frames.
        """
        mean = _consistent_mean([self, other], np.inf)
        difference_s = abs(self.best_s - other.best_s)
        if difference_s > _MAX_DIFFERENCE_S or mean is None:
            sigma_s = max(difference_s, other.sigma_s)
            return replace(
                self, seconds=other.best_s, sigma_s=sigma_s, source="estimated", best_s=other.best_s
            )
        best_s = mean[0]
        # The angular velocities of both estimates are those of splines, with the same systematic error.
        sigma_s = float(np.hypot(mean[1], _MODEL_SIGMA_RATIO * best_s))
        return replace(self, seconds=best_s, best_s=best_s, sigma_s=sigma_s, source="estimated")

    def adjusted(self, found: AdjustedReadout) -> Readout:
        """Return the readout time after an adjustment in which it may have been an unknown."""
        if found.sigma_s is None:
            return self
        source = "estimated" if found.seconds else _NONE_FOUND
        return replace(self, seconds=found.seconds, sigma_s=found.sigma_s, source=source, best_s=found.best_s)

    @property
    def determined(self) -> bool:
        """True if the readout time is known, or known to be short; False if the data do not determine it."""
        return not self.source.startswith(_UNDETERMINED)

    @property
    def excludes_rolling(self) -> bool:
        """True if an estimate found no rolling shutter: the readout time is short, or 0."""
        return self.source == _NONE_FOUND

    @property
    def scatter_s(self) -> float:
        """Standard deviation (seconds) without the part that all estimates have in common.

        The common part is the error of the splines, a ratio of the readout time. A mean does not reduce it,
        so it is added to the mean, once.
        """
        variance = self.sigma_s**2 - (_MODEL_SIGMA_RATIO * self.best_s) ** 2
        return float(np.sqrt(max(variance, _FLOOR_SIGMA_S**2)))

    @property
    def significance(self) -> float:
        """Ratio of the readout time to its standard deviation; 0 if no readout time was found."""
        return abs(self.seconds) / self.sigma_s if self.sigma_s else 0.0


def judged_readout(best_s: float, sigma_s: float, *, sideways: bool = False) -> Readout:
    """Return the readout time, or 0 with the reason why it is not used.

    Args:
        best_s: The most likely readout time, seconds.
        sigma_s: Its standard deviation, seconds; infinity if it is unknown.
        sideways: True if the sensor's rows are columns of the image.
    """
    if sigma_s <= _MAX_SIGMA_S and abs(best_s) >= max(_MIN_READOUT_S, MIN_SIGMAS * sigma_s):
        return Readout(best_s, sigma_s, "estimated", best_s, sideways)
    if abs(best_s) + 2.0 * sigma_s < MAX_GLOBAL_S:
        return Readout(0.0, sigma_s, _NONE_FOUND, best_s, sideways)
    return Readout(
        0.0, sigma_s, f"{_UNDETERMINED}the camera turns too evenly, or too little", best_s, sideways
    )


def _consistent_mean(readouts: Sequence[Readout], max_sigmas: float) -> tuple[float, float] | None:
    """Return the weighted mean of readout times and its standard deviation without the common part, seconds.

    Args:
        readouts: The readout times.
        max_sigmas: Maximum deviation of a readout time from the mean, in its standard deviations.

    Returns:
        Mean and standard deviation; None if a standard deviation is unknown, or if a value deviates more.
    """
    value = np.array([item.best_s for item in readouts])
    sigma = np.array([item.scatter_s for item in readouts])
    if len(readouts) == 0 or not np.isfinite(sigma).all() or not all(item.sigma_s for item in readouts):
        return None
    mean, mean_sigma = weighted_mean(value, sigma)
    deviation = (value - mean) / sigma
    if np.abs(deviation).max() > max_sigmas:
        return None
    scatter = max(1.0, float((deviation**2).sum()) / max(1, len(readouts) - 1))
    return mean, mean_sigma * float(np.sqrt(scatter))


def weighted_mean(values: FloatArray, sigmas: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values (N,), weighted by their information, and its standard deviation.

    Args:
        values: The values.
        sigmas: Their standard deviations, in the same unit.
    """
    weight = 1.0 / sigmas**2
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)


def few_blocks_factor(blocks: int) -> float:
    """Return the factor of a standard deviation that was estimated from a few independent blocks.

    Few blocks often have similar estimates by chance. The factor is that of a 95 % interval.
    """
    from scipy.special import ndtri, stdtrit  # scipy.stats takes a second to import.

    return float(stdtrit(blocks - 1, 0.975) / ndtri(0.975))


def groups_of_equal_cameras(cameras: Iterable[CaptureCamera]) -> list[list[str]]:
    """Return groups of names of cameras with equal given intrinsics, image size and frame rate.

    These cameras may be of one model.
    """
    if not is_on(Mechanism.EQUAL_CAMERAS):
        return [[camera.name] for camera in cameras]
    groups: dict[object, list[str]] = {}
    for camera in cameras:
        lens = camera.given or camera.camera
        key = (lens.model, lens.width_px, lens.height_px, round(camera.nominal_fps, 2), lens.params.tobytes())
        groups.setdefault(key, []).append(camera.name)
    return list(groups.values())


@dataclass(frozen=True, slots=True)
class _Keypoints:
    """The observations of one keyframe.

    Attributes:
        image_id: Id of the keyframe's image in the model.
        camera: Name of the keyframe's camera.
        feature: (N,) indices of the features that observe a point of the model.
        px: (N,2) detected positions of these features, px.
        frame: (N,) frame index of the keyframe, repeated.
        points: (N,3) points that these features observe, in map units.
    """

    image_id: int
    camera: str
    feature: IntArray
    px: FloatArray
    frame: IntArray
    points: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustedMotion:
    """The motion of cameras after an adjustment.

    Attributes:
        readouts: Readout times by camera name.
        error_scales: (N,3) factors of the expected errors of the velocities of each frame, by camera name.
    """

    readouts: dict[str, Readout]
    error_scales: Mapping[str, FloatArray]


class RollingShutterModel:
    """A model with the motion of its keypoints, to estimate readout times and to correct rolling shutters.

    For the correction, each keypoint is moved to its position at the instant of the image's middle row.

    Args:
        model: COLMAP's reconstruction; not changed.
        trajectories: Trajectories in the model's gauge, by camera name. A camera without a trajectory was
            registered against another model. Its keypoints are moved with the poses of its keyframes and its
            rotation. They are not moved if its rotation is unknown.
        cameras: The capture's cameras by name.
        detected_px: Detected positions (N,2) of all keypoints of each image whose keypoints are at other
            positions in the model, by image id.
        rotations: Rotations of the cameras by camera name, from gyroscopes or from matches between adjacent
            frames. They are used for the exact velocities of frames beside a frame without a pose. For an
            estimate of the readout time, only those from gyroscopes are used: the others are too smooth.
    """

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        trajectories: Mapping[str, Trajectory],
        cameras: Mapping[str, CaptureCamera],
        detected_px: Mapping[int, FloatArray] | None = None,
        rotations: Mapping[str, RotationPath] | None = None,
    ) -> None:
        self._model = model
        self._detected_px = detected_px or {}
        self._rotations = rotations or {}
        measured = {name: path for name, path in self._rotations.items() if path.gyro is not None}
        self._trajectories = trajectories
        self._cameras = cameras
        self._intrinsics = {
            ImageRef.parse(model.image(image_id).name).camera: camera_from_pycolmap(
                model.image(image_id).camera
            )
            for image_id in model.reg_image_ids()
        }
        self._keypoints = [self._keypoints_of(image_id) for image_id in sorted(model.reg_image_ids())]
        poses = {name: (path.gauge_from_cam, path.times_ns) for name, path in trajectories.items()}
        elsewhere = (self._intrinsics.keys() & self._rotations.keys()) - poses.keys()
        self._poses = poses | {
            name: (self._keyframe_poses(name), cameras[name].times_ns) for name in elsewhere
        }
        self._paths = {
            name: PosePath.create(*path, measured.get(name), shrunk=False) for name, path in poses.items()
        } | {name: PosePath.create(*self._poses[name], self._rotations[name]) for name in elsewhere}
        self._inner = {name: inner_poses(path) for name, path in trajectories.items()}

    def corrected(self, readout_s: Mapping[str, float]) -> pycolmap.Reconstruction:
        """Return a copy of the model in which all keypoints are at their corrected positions.

        The corrected position of a keypoint is its position at the instant of the image's middle row.

        Args:
            readout_s: Readout time (seconds) of each camera, by camera name.
        """
        out = copy.deepcopy(self._model)
        self.move_keypoints(out, readout_s)
        return out

    def with_exact_rates(
        self, readout_s: Mapping[str, float], corrected: Collection[str]
    ) -> RollingShutterModel:
        """Return a copy with the most exact angular velocities, for a correction with known readout times.

        If the model was built from corrected keypoints, the angular velocities of the keyframes are fitted to
        their observations. In a model of uncorrected keypoints, poses and points have absorbed a part of the
        displacements. Velocities that fit them would leave this part as it is.

        Args:
            readout_s: Readout time (seconds) of each camera, by camera name.
            corrected: Names of the cameras whose keypoints were corrected before the model was built.
        """
        out = copy.copy(self)
        out._paths = dict(self._paths)
        for name, poses in self._poses.items():
            path = PosePath.create(*poses, self._rotations.get(name))
            own = [item for item in self._keypoints if item.camera == name]
            out._paths[name] = path
            if own and readout_s.get(name) and name in corrected:
                frame, points, px = (
                    np.concatenate([getattr(item, part) for item in own])
                    for part in ("frame", "points", "px")
                )
                out._paths[name] = path.with_fitted_rates(
                    self._intrinsics[name], frame, points, px, readout_s[name]
                )
        return out

    def move_keypoints(self, model: pycolmap.Reconstruction, readout_s: Mapping[str, float]) -> None:
        """Move the keypoints in a copy of the model to their positions at the instant of the middle row.

        Args:
            model: The copy of the model, changed in place.
            readout_s: Readout time (seconds) of each camera, by camera name. The keypoints of a camera that
                is missing here, or that has a readout time of 0, are moved to their detected positions.
        """
        for item in self._keypoints:
            px = self._px_at_mid_row(item, readout_s.get(item.camera, 0.0))
            points = model.image(item.image_id).points2D
            for feature, xy in zip(item.feature.tolist(), px, strict=True):
                points[feature].xy = xy

    def adjust_with_velocities(
        self,
        model: pycolmap.Reconstruction,
        readouts: Mapping[str, Readout],
        expected: Mapping[str, Readout] | None = None,
        equal_cameras: Sequence[Sequence[str]] = (),
    ) -> AdjustedMotion | None:
        """Adjust poses, points, velocities of keyframes and readout times of a copy of the model together.

        The keypoints are then moved to their positions at the instant of the middle row, with the adjusted
        velocities. The caller adjusts the model for these positions afterwards: intrinsics and gauge are not
        fixed here.

        Args:
            model: The copy of the model, changed in place.
            readouts: Readout time of each camera at the start, by camera name. The keypoints of cameras
                without one are moved to their detected positions. A time with a standard deviation of 0 is
                constant.
            expected: Readout times that do not come from this model, by camera name. They count as
                observations.
            equal_cameras: Groups of names of cameras that may be of one model.

        Returns:
            The adjusted readout times of the cameras in `readouts`, and the expected errors of their
            velocities. None if the velocities of the paths are exact enough, or if a readout time becomes
            longer than a frame interval: then the model is unchanged.
        """
        import pycolmap

        items = [self._remaining(item, model) for item in self._keypoints]
        ids = [self._point_ids(item) for item in items]
        sizes = [len(item.px) for item in items]
        point_ids, point = np.unique(np.concatenate([np.zeros(0, np.int64), *ids]), return_inverse=True)
        poses = [model.image(item.image_id).cam_from_world().matrix() for item in items]
        adjustment = MotionAdjustment(
            lenses=self._intrinsics,
            poses=self._poses,
            rotations=self._rotations,
            camera=tuple(item.camera for item in items),
            frame=np.array([ImageRef.parse(model.image(item.image_id).name).frame for item in items]),
            keyframe=np.repeat(np.arange(len(sizes)), sizes),
            point=np.ravel(point),
            px=np.concatenate([np.zeros((0, 2)), *(item.px for item in items)]),
            equal_cameras=equal_cameras,
            uninformative=self._uninformative_cameras(),
        )
        seconds = {name: readout.seconds for name, readout in readouts.items() if readout.seconds}
        adjusted = adjustment.run(
            np.array([make_transform(pose[:, :3], pose[:, 3]) for pose in poses]),
            np.array([model.point3D(number).xyz for number in point_ids.tolist()]).reshape(-1, 3),
            seconds,
            {name: _expected_readout(readouts[name], (expected or {}).get(name)) for name in seconds},
        )
        if adjusted is None or self._are_too_long(adjusted.readouts):
            return None
        for number, xyz in zip(point_ids.tolist(), adjusted.points, strict=True):
            model.point3D(number).xyz = xyz
        parts = np.split(adjusted.px_at_mid_row, np.cumsum(sizes)[:-1])
        for item, pose, px in zip(items, adjusted.cam_from_map, parts, strict=True):
            image = model.image(item.image_id)
            model.frame(image.frame_id).set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose[:3]))
            for feature, xy in zip(item.feature.tolist(), px, strict=True):
                image.points2D[feature].xy = xy
        found = {
            name: readout.adjusted(adjusted.readouts[name]) if name in seconds else readout
            for name, readout in readouts.items()
        }
        return AdjustedMotion(readouts=found, error_scales=adjusted.error_scales)

    def motions(
        self,
        readouts: Mapping[str, Readout],
        error_scales: Mapping[str, FloatArray] | None = None,
    ) -> dict[str, CameraMotion]:
        """Return the motion of each camera with a path and a readout time, by camera name.

        Args:
            readouts: Readout times by camera name.
            error_scales: (N,3) factors of the expected errors of the velocities of each frame, by camera
                name.
        """
        seconds = {name: readout.seconds for name, readout in readouts.items() if readout.seconds}
        sigma_s = {name: readout.sigma_s for name, readout in readouts.items()}
        return camera_motions(self._intrinsics, self._poses, self._rotations, seconds, sigma_s, error_scales)

    def _uninformative_cameras(self) -> set[str]:
        """Return the names of the cameras whose motion does not determine their readout times.

        The motion of a camera without a trajectory is that of matches, which is too smooth.
        """
        measured = {name for name, path in self._rotations.items() if path.gyro is not None}
        return self._intrinsics.keys() - self._trajectories.keys() - measured

    def _are_too_long(self, readouts: Mapping[str, AdjustedReadout]) -> bool:
        """Return True if a readout time that was adjusted is longer than a frame interval, or unknown."""
        for name, found in readouts.items():
            limit_s = _MAX_READOUT_FRAMES * 1e-9 * float(np.median(np.diff(self._cameras[name].times_ns)))
            if found.sigma_s is not None and not (
                abs(found.best_s) <= limit_s and np.isfinite(found.sigma_s)
            ):
                return True
        return False

    def _remaining(self, item: _Keypoints, model: pycolmap.Reconstruction) -> _Keypoints:
        """Return the observations whose points are left in a copy of the model."""
        points = model.image(item.image_id).points2D
        left = np.array([points[index].has_point3D() for index in item.feature.tolist()], dtype=bool)
        parts = {name: getattr(item, name)[left] for name in ("feature", "px", "frame", "points")}
        return replace(item, **parts)

    def _point_ids(self, item: _Keypoints) -> IntArray:
        """Return the ids (N,) of the points that the observations of a keyframe see."""
        points = self._model.image(item.image_id).points2D
        return np.array([points[index].point3D_id for index in item.feature.tolist()], dtype=np.int64)

    def displacement_px(self, name: str, readout_s: float) -> float:
        """Return how far the rolling shutter displaces the keypoints of a camera.

        Args:
            name: Name of the camera.
            readout_s: Readout time of the camera, seconds.

        Returns:
            The 95th percentile, px of an image with a long side of 640 px; 0 if there are no keypoints.
        """
        lens = self._intrinsics.get(name)
        own = [item for item in self._keypoints if item.camera == name and len(item.px)]
        if lens is None or not own:
            return 0.0
        moved = [np.linalg.norm(self._px_at_mid_row(item, readout_s) - item.px, axis=1) for item in own]
        scale = pixel_scale(lens.width_px, lens.height_px)
        return float(np.percentile(np.concatenate(moved), DISPLACED_PERCENT)) / scale

    def _px_at_mid_row(self, item: _Keypoints, readout_s: float) -> FloatArray:
        """Return the positions (N,2) of keypoints at the instant of the middle row, for a readout time."""
        path = self._paths.get(item.camera)
        if path is None or not readout_s:
            return item.px
        return path.px_at_mid_row(self._intrinsics[item.camera], item.frame, item.points, item.px, readout_s)

    def most_dynamic_subset(self) -> RollingShutterModel:
        """Return a smaller model: for each camera, only the successive keyframes with the largest motion."""
        kept: set[int] = set()
        for name in self._intrinsics:
            keyframes = [item for item in self._keypoints if item.camera == name]
            keyframes.sort(key=lambda item: ImageRef.parse(self._model.image(item.image_id).name).frame)
            speed = [
                float(np.median(np.abs(self._px_at_mid_row(item, _TRIAL_STEP_S) - item.px)))
                if self._tells_readout(item)
                else 0.0
                for item in keyframes
            ]
            total = np.concatenate([[0.0], np.cumsum(speed)])
            size = min(_TRIAL_KEYFRAMES, len(keyframes))
            start = int(np.argmax(total[size:] - total[: len(total) - size]))
            kept |= {item.image_id for item in keyframes[start : start + size]}
        part = sub_model(self._model, kept)
        sideways = [name for name, camera in self._intrinsics.items() if camera.sideways]
        smaller = RollingShutterModel(
            part, self._trajectories, self._cameras, self._detected_px, self._rotations
        )
        return smaller.with_sideways(sideways)

    def with_sideways(self, sideways: Collection[str]) -> RollingShutterModel:
        """Return a copy with changed row directions.

        Args:
            sideways: Names of the cameras in which the sensor's rows are columns of the image. In all other
                cameras, the sensor's rows are rows of the image.
        """
        out = copy.copy(self)
        out._intrinsics = {
            name: replace(camera, sideways=name in sideways) for name, camera in self._intrinsics.items()
        }
        return out

    def estimate(
        self,
        settings: pycolmap.IncrementalPipelineOptions,
        calibrated_ids: Sequence[int],
        start_s: Mapping[str, float] | None = None,
        from_matches: Mapping[str, Readout] | None = None,
    ) -> dict[str, Readout]:
        """Estimate the readout time of each camera, from adjustments of the map with a few trial values.

        After an adjustment of poses and points, the residuals are almost a linear function of the readout
        time. The change of the residuals from one trial value to the next gives the next step.

        Args:
            settings: The mapper's options.
            calibrated_ids: Database ids of the calibrated cameras.
            start_s: Readout times (seconds) for which the poses were estimated, by camera name. The search
                starts from them; from 0 for any other camera.
            from_matches: Readout times from matches between adjacent frames, by camera name.

        Returns:
            Readout time of each camera with a trajectory, by camera name. Readout times that are given in the
            job are returned unchanged.

        Raises:
            EstimationError: An adjustment failed.

        Source: secant steps on the reduced functional of Golub, Pereyra, "The differentiation of
            pseudo-inverses and nonlinear least squares problems whose variables separate", 1973.
        """
        names = [name for name in self._intrinsics if name in self._trajectories]
        unknown = [name for name in names if not self._cameras[name].rolling_shutter_known]
        out = {
            name: stated_readout(self._cameras[name].rolling_shutter_s)
            for name in names
            if name not in unknown
        }
        if not unknown:
            return out
        frame_s = {name: float(np.median(np.diff(self._cameras[name].times_ns))) * 1e-9 for name in unknown}
        readout_s = dict(start_s or {}) | {name: readout.seconds for name, readout in out.items()}
        readout_s |= {name: readout_s.get(name, 0.0) for name in unknown}
        model = self.corrected(readout_s)
        bundle_adjust(model, settings, calibrated_ids, _TRIAL_ITERATIONS)
        before = self._residuals(model)
        step_s = {name: _NEXT_STEP_S if readout_s[name] else _TRIAL_STEP_S for name in unknown}
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
        others = from_matches or {}

        def contradicted(name: str) -> bool:
            return name in others and abs(out[name].best_s - others[name].best_s) > _MAX_DIFFERENCE_S

        pooled = dict(out)
        for names in groups_of_equal_cameras(self._cameras[name] for name in unknown):
            equal = [name for name in names if np.isfinite(out[name].sigma_s) and not contradicted(name)]
            for name in names:
                pooled[name] = out[name].pooled([out[other] for other in equal])
        return pooled | {
            name: pooled[name].with_other_estimate(other) for name, other in others.items() if name in unknown
        }

    def undetermined(self, reason: str) -> dict[str, Readout]:
        """Return readout times without an estimation, by camera name.

        A readout time that is given in the job is used. All other cameras get a readout time of 0.

        Args:
            reason: The reason why no readout time could be estimated. The reason is stored in
                `Readout.source` of each camera without a given readout time.
        """
        out = {}
        for name in self._intrinsics:
            camera = self._cameras[name]
            if camera.rolling_shutter_known:
                out[name] = stated_readout(camera.rolling_shutter_s)
            else:
                out[name] = Readout(0.0, 0.0, f"{_UNDETERMINED}{reason}", 0.0)
        return out

    def _keypoints_of(self, image_id: int) -> _Keypoints:
        """Return the observations of one image, with their points."""
        image = self._model.image(image_id)
        ref = ImageRef.parse(image.name)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        detected = self._detected_px.get(image_id)
        used = np.array([image.points2D[index].xy for index in feature.tolist()]).reshape(-1, 2)
        return _Keypoints(
            image_id,
            ref.camera,
            feature,
            used if detected is None else detected[feature],
            np.full(len(feature), ref.frame, dtype=np.int64),
            self._points(image, feature),
        )

    def _keyframe_poses(self, name: str) -> FloatArray:
        """Return the poses (N,4,4) of a camera's keyframes, map_from_cam; NaN for all other frames."""
        out = np.full((len(self._cameras[name].times_ns), 4, 4), np.nan)
        for image_id in self._model.reg_image_ids():
            image = self._model.image(image_id)
            ref = ImageRef.parse(image.name)
            if ref.camera == name:
                pose = image.cam_from_world().inverse().matrix()
                out[ref.frame] = make_transform(pose[:, :3], pose[:, 3])
        return out

    def _tells_readout(self, item: _Keypoints) -> bool:
        """Return True if the velocity of a keyframe is known from poses on both sides."""
        inner = self._inner.get(item.camera)
        return len(item.px) > 0 and inner is not None and bool(inner[item.frame[0]])

    def _points(self, image: Any, feature: IntArray) -> FloatArray:
        """Return the positions (N,3), in map units, of the points that some features of an image observe."""
        points = image.points2D
        return np.array(
            [self._model.point3D(points[index].point3D_id).xyz for index in feature.tolist()]
        ).reshape(-1, 3)

    def _residuals(self, model: pycolmap.Reconstruction) -> dict[str, FloatArray]:
        """Return the residuals (observed minus projected position, px) of each camera, by camera name.

        The order of the residuals is the same for every copy of the model. Keyframes without poses on both
        sides are left out: their velocities are extrapolated.
        """
        out: dict[str, list[FloatArray]] = {name: [] for name in self._intrinsics}
        for item in filter(self._tells_readout, self._keypoints):
            residuals = image_residuals_px(model, model.image(item.image_id), item.feature)
            out[item.camera].append(residuals.ravel())
        return {name: np.concatenate([np.zeros(0), *parts]) for name, parts in out.items()}


def inner_poses(trajectory: Trajectory) -> BoolArray:
    """Return a mask (N,): True if a frame and both neighbouring frames have poses and are near in time."""
    both = trajectory.localised[1:] & trajectory.localised[:-1] & near_in_time(trajectory.times_ns)
    none = np.zeros(1, dtype=bool)
    return np.asarray(np.concatenate([none, both]) & np.concatenate([both, none]))


@dataclass(frozen=True, slots=True)
class _ResidualSlope:
    """A linear model of the residuals of an adjusted map, as a function of the readout time.

    The readout time with the smallest residuals is computed from this model.

    Attributes:
        correlation: Weighted sum of the products of each residual and its derivative, px²/s. The derivative
            is taken with respect to the readout time.
        information: Weighted sum of the squared derivatives, px²/s².
        sigma_s: Standard deviation of the readout time, seconds. It is estimated by leaving out blocks of
            successive keyframes one after another (jackknife), because the residuals of a keyframe have
            common errors.
    """

    correlation: float
    information: float
    sigma_s: float

    @staticmethod
    def of(before: FloatArray, after: FloatArray, step_s: float) -> _ResidualSlope:
        """Return the slope of the residuals at the second of two adjustments.

        Args:
            before: (N,) residuals after the first adjustment, px.
            after: (N,) residuals after the second adjustment, px.
            step_s: Difference (seconds) of the readout times: second adjustment minus first adjustment.
        """
        change = (after - before) / (step_s if step_s else np.inf)
        # If an adjustment moves a point far away, the residuals of the point are large. Such residuals do
        # not depend on the readout time and are not used.
        small = np.maximum(np.abs(after), np.abs(before)) < _MAX_RESIDUAL_PX
        weight = np.where(small, 1.0 / (1.0 + (after / _LOSS_PX) ** 2), 0.0)
        information = float((weight * change * change).sum())
        correlation = float((weight * change * after).sum())
        if information <= 0.0:
            return _ResidualSlope(correlation, information, float("inf"))
        products = (
            np.array_split(weight * change * after, _BLOCKS),
            np.array_split(weight * change**2, _BLOCKS),
        )
        other_correlation, other_information = (
            total - np.array([block.sum() for block in blocks])
            for total, blocks in zip((correlation, information), products, strict=True)
        )
        without = other_correlation / np.maximum(other_information, 1e-12 * information)
        variance = (_BLOCKS - 1) / _BLOCKS * ((without - without.mean()) ** 2).sum()
        sigma_s = few_blocks_factor(_BLOCKS) * float(np.sqrt(variance))
        return _ResidualSlope(correlation, information, float(np.hypot(sigma_s, _FLOOR_SIGMA_S)))

    def readout(self, at_s: float, frame_s: float) -> Readout:
        """Return the readout time with the smallest residuals, or 0 with the reason why it is not used.

        Args:
            at_s: Readout time of the adjustment at which the slope was computed, seconds.
            frame_s: Frame interval, seconds.
        """
        if self.information <= 0.0:
            return judged_readout(at_s, float("inf"))
        best_s = at_s - self.correlation / self.information
        if abs(best_s) > _MAX_READOUT_FRAMES * frame_s:
            return judged_readout(best_s, float("inf"))
        return judged_readout(best_s, float(np.hypot(self.sigma_s, _MODEL_SIGMA_RATIO * best_s)))


def estimate_readouts(
    rolling: RollingShutterModel,
    cameras: Mapping[str, CaptureCamera],
    settings: pycolmap.IncrementalPipelineOptions,
    calibrated_ids: Sequence[int],
    corrected: Map | None = None,
    from_matches: Mapping[str, Readout] | None = None,
) -> tuple[RollingShutterModel, dict[str, Readout]]:
    """Estimate the readout time of each camera, and whether the sensor's rows are columns of the image.

    If a trial adjustment fails, only the readout times that are given in the job are used. The returned
    readout times then hold the reason of the failure.

    Args:
        rolling: The model.
        cameras: The capture's cameras by name.
        settings: The mapper's options.
        calibrated_ids: Database ids of the calibrated cameras.
        corrected: The map whose readout times and row directions were estimated before; None if there is
            none. The search starts from them.
        from_matches: Readout times from matches between adjacent frames, by camera name.

    Returns:
        The model with the row directions that fit best; the readout times by camera name.
    """
    stated = sideways_cameras(cameras, corrected)
    start_s = {} if corrected is None else dict(corrected.readout_s)
    rolling = rolling.with_sideways(stated)
    try:
        part = rolling.most_dynamic_subset()
        readouts = part.estimate(settings, calibrated_ids, start_s, from_matches)
        turned = {
            name
            for name in readouts
            if cameras[name].may_be_sideways
            and not cameras[name].rolling_shutter_known
            and name not in start_s
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


def sideways_cameras(cameras: Mapping[str, CaptureCamera], corrected: Map | None) -> set[str]:
    """Return the names of the cameras whose sensor's rows are known to be columns of the image.

    Args:
        cameras: The capture's cameras by name.
        corrected: The map whose row directions were estimated before; None if there is none.
    """
    out = {name for name, camera in cameras.items() if camera.camera.sideways}
    if corrected is not None:
        out |= {name for name, camera in corrected.cameras.items() if camera.sideways}
    return out


def map_with_readouts(scene: Map, readouts: Mapping[str, Readout]) -> Map:
    """Return a copy of a corrected map that holds the readout times and row directions of the correction."""
    nonzero = {name: readout for name, readout in readouts.items() if readout.seconds}
    cameras = {
        name: replace(camera, sideways=name in nonzero and nonzero[name].sideways)
        for name, camera in scene.cameras.items()
    }
    return replace(
        scene,
        cameras=cameras,
        readout_s={name: readout.seconds for name, readout in nonzero.items()},
        readout_sigma_s={name: readout.sigma_s for name, readout in nonzero.items() if readout.sigma_s},
    )


def _expected_readout(start: Readout, other: Readout | None) -> tuple[float, float]:
    """Return the expected readout time and its standard deviation, seconds, before an adjustment.

    Args:
        start: The readout time at the start.
        other: A readout time that does not come from the adjusted model; None if there is none.
    """
    if not start.sigma_s:
        return start.seconds, 0.0
    if other is None or not other.determined or not other.sigma_s or other.sideways != start.sideways:
        return start.seconds, _MAX_SIGMA_S
    return other.best_s, other.sigma_s


def stated_readout(readout_s: float) -> Readout:
    """Return the readout time of a camera whose readout time is given in the job."""
    return Readout(readout_s, 0.0, STATED, readout_s)
