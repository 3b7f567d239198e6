"""Estimate rolling-shutter readout times from the map, and correct the map for them."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bodycap_batch.capture import CaptureCamera
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.mechanisms import Mechanism, is_on
from bodycap_batch.mapping.matching.database import ImageRef
from bodycap_batch.mapping.reconstruction.bundle_adjustment import sub_model
from bodycap_batch.mapping.reconstruction.camera_motion import CameraMotion, camera_motions
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.mapping.reconstruction.motion_adjustment import (
    MAX_GLOBAL_S,
    MIN_SIGMAS,
    AdjustedReadout,
    MotionAdjustment,
)
from bodycap_batch.model.geometry import make_transform
from bodycap_batch.model.rotation_path import PosePath, RotationPath
from bodycap_batch.model.scene import Map, Trajectory

if TYPE_CHECKING:
    import pycolmap

_LIKELY_S = 0.01
"""Readout time (seconds) that is used to find the keyframes whose pixels a shutter displaces most. Origin:
the sensors of phones and action cameras need 8 to 33 ms."""
_PART_KEYFRAMES = 24
"""Number of keyframes of each camera from which an unknown readout time is estimated. The successive
keyframes with the largest motion are used. Evidence: none."""
_FIRST_S = 0.0001
"""Readout time (seconds) with which the search for an unknown one starts. It only makes the displacements
proportional to something."""
_UNKNOWN_SIGMA_S = 0.02
"""Standard deviation of a readout time that nothing determines, seconds. Origin: sensors need up to 33 ms."""
_MAX_READOUT_FRAMES = 1.1
"""Maximum estimated readout time, in frame intervals. The physical limit is one frame interval. The value is
a little larger, because the estimate is uncertain."""
_MIN_READOUT_S = 0.001
"""Minimum estimated readout time (seconds) of a rolling shutter. A shorter one moves no pixel by much.
Evidence: none."""
_MAX_SIGMA_S = 0.004
"""Maximum standard deviation of a determined readout time, seconds. Evidence: none."""
STATED = "stated"
"""`Readout.source` of a readout time that is given in the job."""
_NONE_FOUND = "none found"
"""`Readout.source` of a camera without a rolling shutter, as far as an estimate can show it."""
_UNDETERMINED = "not determined: "
"""First words of `Readout.source` of a camera whose readout time is unknown; the reason follows."""
_UNKNOWN = "unknown"
"""`Readout.source` of a readout time from which the search for an unknown one starts."""


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

    def adjusted(self, found: AdjustedReadout) -> Readout:
        """Return the readout time after an adjustment in which it may have been an unknown."""
        if self.source == _UNKNOWN:
            sigma_s = np.inf if found.sigma_s is None else found.sigma_s
            return judged_readout(found.best_s, sigma_s, sideways=self.sideways)
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


def weighted_mean(values: FloatArray, sigmas: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values (N,), weighted by their information, and its standard deviation.

    Args:
        values: The values.
        sigmas: Their standard deviations, in the same unit.
    """
    weight = 1.0 / sigmas**2
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)


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
            frames. They are used for the exact velocities of frames beside a frame without a pose.
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

    def _px_at_mid_row(self, item: _Keypoints, readout_s: float) -> FloatArray:
        """Return the positions (N,2) of keypoints at the instant of the middle row, for a readout time."""
        path = self._paths.get(item.camera)
        if path is None or not readout_s:
            return item.px
        return path.px_at_mid_row(self._intrinsics[item.camera], item.frame, item.points, item.px, readout_s)

    def find_unknown_readouts(
        self, known: Mapping[str, Readout], equal_cameras: Sequence[Sequence[str]] = ()
    ) -> dict[str, Readout]:
        """Estimate the readout times that are not known, in an adjustment of a part of the model.

        The part has the successive keyframes of each camera with the largest motion. Poses, points,
        velocities and readout times are adjusted together. A readout time stays unknown if no value up to
        20 ms displaces the keypoints of the camera by more than their noise: then it is not needed. It also
        stays unknown if the adjustment makes it longer than a frame interval. The other cameras are then
        estimated without this camera's shutter.

        Args:
            known: The readout times that are known, by camera name.
            equal_cameras: Groups of names of cameras that may be of one model.

        Returns:
            The readout times of the other cameras with a trajectory, by camera name.
        """
        unknown = {
            name: Readout(_FIRST_S, _UNKNOWN_SIGMA_S, _UNKNOWN, _FIRST_S, camera.sideways)
            for name, camera in self._intrinsics.items()
            if name in self._trajectories and name not in known
        }
        if not unknown:
            return {}
        part = self._most_dynamic_part()
        start = {name: item for name, item in known.items() if name in part._intrinsics} | unknown
        model = part.corrected({name: item.seconds for name, item in start.items()})
        adjusted = part.adjust_with_velocities(model, start, {}, equal_cameras)
        nothing = {
            name: judged_readout(0.0, math.inf, sideways=item.sideways) for name, item in unknown.items()
        }
        if adjusted is not None:
            return {name: adjusted.readouts[name] for name in unknown}
        if len(unknown) == 1:
            return nothing
        alone = {name: {**known, **nothing} for name in unknown}
        for name, others in alone.items():
            del others[name]
            nothing |= self.find_unknown_readouts(others, equal_cameras)
        return nothing

    def _most_dynamic_part(self) -> RollingShutterModel:
        """Return a smaller model: for each camera, only the successive keyframes with the largest motion."""
        kept: set[int] = set()
        for name in self._intrinsics:
            keyframes = [item for item in self._keypoints if item.camera == name and len(item.px)]
            keyframes.sort(key=lambda item: int(item.frame[0]))
            speed = [
                float(np.median(np.abs(self._px_at_mid_row(item, _LIKELY_S) - item.px))) for item in keyframes
            ]
            total = np.concatenate([[0.0], np.cumsum(speed)])
            size = min(_PART_KEYFRAMES, len(keyframes))
            start = int(np.argmax(total[size:] - total[: len(total) - size]))
            kept |= {item.image_id for item in keyframes[start : start + size]}
        part = sub_model(self._model, kept)
        smaller = RollingShutterModel(
            part, self._trajectories, self._cameras, self._detected_px, self._rotations
        )
        return smaller.with_sideways([name for name, lens in self._intrinsics.items() if lens.sideways])

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

    def _points(self, image: Any, feature: IntArray) -> FloatArray:
        """Return the positions (N,3), in map units, of the points that some features of an image observe."""
        points = image.points2D
        return np.array(
            [self._model.point3D(points[index].point3D_id).xyz for index in feature.tolist()]
        ).reshape(-1, 3)


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
    if start.source == _UNKNOWN:
        return start.seconds, start.sigma_s
    if other is None or not other.determined or not other.sigma_s or other.sideways != start.sideways:
        return start.seconds, _MAX_SIGMA_S
    return other.best_s, other.sigma_s


def stated_readout(readout_s: float) -> Readout:
    """Return the readout time of a camera whose readout time is given in the job."""
    return Readout(readout_s, 0.0, STATED, readout_s)
