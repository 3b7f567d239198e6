"""Find a rolling shutter's readout time in the data, and take its bending out of the map."""

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
_TRIAL_ITERATIONS = 40
_TRIAL_KEYFRAMES = 24
"""The readout time is looked for in so many successive keyframes, those that move most."""
_MAX_TRIALS = 4
_CONVERGED_S = 0.001
_MAX_READOUT_FRAMES = 1.1
"""A readout takes at most the time between two frames."""
_MIN_READOUT_S = 0.002
_MIN_SIGMAS = 5.0
_LOSS_PX = 1.0
_MAX_RESIDUAL_PX = 8.0


@dataclass(frozen=True, slots=True)
class Readout:
    """A camera's readout time.

    Attributes:
        seconds: From the first row's exposure to the last's; 0 for a global shutter.
        sigma_s: Standard deviation; 0 where it was stated.
        source: "stated", "estimated", "none found", or why it could not be determined.
        best_s: Where the residuals are smallest, found or not.
        sideways: The sensor's rows run along the picture's columns.
    """

    seconds: float
    sigma_s: float
    source: str
    best_s: float
    sideways: bool = False

    @property
    def clearness(self) -> float:
        """How many standard deviations the readout time is off none; 0 where none was found."""
        return abs(self.seconds) / self.sigma_s if self.sigma_s else 0.0


@dataclass(frozen=True, slots=True)
class _Keypoints:
    """The observations of one keyframe.

    Attributes:
        image_id: Its image in the model.
        camera: Its camera's name.
        feature: (N,) point indices in the image.
        px: (N,2) as detected.
        velocity: (N,2) px/s.
    """

    image_id: int
    camera: str
    feature: IntArray
    px: FloatArray
    velocity: FloatArray


class RollingShutterModel:
    """A model whose keypoints can be moved to the instant of the middle row.

    Args:
        model: COLMAP's reconstruction, left as it is.
        trajectories: Every frame's pose in the model's gauge, by camera; a camera whose frames were solved in
            another map has none here, and its keypoints stay.
        cameras: The capture's cameras, by name.
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
        self._lenses = {
            ImageRef.parse(model.image(image_id).name).camera: camera_from_pycolmap(
                model.image(image_id).camera
            )
            for image_id in model.reg_image_ids()
        }
        self._keypoints = [
            self._keypoints_of(image_id, trajectories) for image_id in sorted(model.reg_image_ids())
        ]

    def moved(self, readout_s: Mapping[str, float]) -> pycolmap.Reconstruction:
        """A copy of the model, its keypoints where they are at the instant of the middle row."""
        out = copy.deepcopy(self._model)
        self.move(out, readout_s)
        return out

    def move(self, model: pycolmap.Reconstruction, readout_s: Mapping[str, float]) -> None:
        """Move the keypoints of a copy of the model; a readout of 0 puts them back where they were found."""
        for item in self._keypoints:
            px = px_at_mid_row(
                self._lenses[item.camera], item.px, item.velocity, readout_s.get(item.camera, 0.0)
            )
            points = model.image(item.image_id).points2D
            for feature, xy in zip(item.feature.tolist(), px, strict=True):
                points[feature].xy = xy

    def fastest(self) -> RollingShutterModel:
        """A model of each camera's successive keyframes that move most, without all others."""
        kept: set[int] = set()
        for name in self._lenses:
            mine = [item for item in self._keypoints if item.camera == name]
            mine.sort(key=lambda item: ImageRef.parse(self._model.image(item.image_id).name).frame)
            speed = [float(np.median(np.abs(item.velocity))) if len(item.velocity) else 0.0 for item in mine]
            total = np.concatenate([[0.0], np.cumsum(speed)])
            size = min(_TRIAL_KEYFRAMES, len(mine))
            start = int(np.argmax(total[size:] - total[: len(total) - size]))
            kept |= {item.image_id for item in mine[start : start + size]}
        part = sub_model(self._model, kept)
        sideways = [name for name, lens in self._lenses.items() if lens.sideways]
        return RollingShutterModel(part, self._trajectories, self._cameras).read_along(sideways)

    def read_along(self, sideways: Collection[str]) -> RollingShutterModel:
        """The same model, these cameras' sensors read along the picture's columns, all others' along rows."""
        out = copy.copy(self)
        out._lenses = {name: replace(lens, sideways=name in sideways) for name, lens in self._lenses.items()}
        return out

    def find(
        self, settings: pycolmap.IncrementalPipelineOptions, constant: Sequence[int]
    ) -> dict[str, Readout]:
        """Readout times from a few adjustments of the map with trial values.

        After poses and points are adjusted, the residuals are close to linear in the readout time: their
        change from one trial to the next says how far to go.

        Raises:
            EstimationError: An adjustment failed.

        Source: secant steps on the reduced functional of Golub, Pereyra, "The differentiation of
            pseudo-inverses and nonlinear least squares problems whose variables separate", 1973.
        """
        moving = [name for name in self._lenses if name in self._trajectories]
        wanted = [name for name in moving if not self._cameras[name].rolling_shutter_known]
        out = {
            name: _stated_readout(self._cameras[name].rolling_shutter_s)
            for name in moving
            if name not in wanted
        }
        if not wanted:
            return out
        frame_s = {name: float(np.median(np.diff(self._cameras[name].times_ns))) * 1e-9 for name in wanted}
        times = {name: readout.seconds for name, readout in out.items()} | dict.fromkeys(wanted, 0.0)
        model = self.moved(times)
        bundle_adjust(model, settings, constant, _TRIAL_ITERATIONS)
        before = self._residuals(model)
        step = dict.fromkeys(wanted, _TRIAL_STEP_S)
        for _ in range(_MAX_TRIALS):
            times = times | {name: times[name] + step[name] for name in wanted}
            self.move(model, times)
            bundle_adjust(model, settings, constant, _TRIAL_ITERATIONS)
            after = self._residuals(model)
            for name in wanted:
                slope = _ResidualSlope.of(before[name], after[name], step[name])
                out[name] = slope.readout(times[name], frame_s[name])
                step[name] = float(np.clip(out[name].best_s - times[name], -_TRIAL_STEP_S, _TRIAL_STEP_S))
            if max(map(abs, step.values())) < _CONVERGED_S:
                break
            before = after
        return out

    def undetermined(self, reason: str) -> dict[str, Readout]:
        """The stated readout times alone; the others are not known for a reason."""
        out = {}
        for name in self._lenses:
            camera = self._cameras[name]
            if camera.rolling_shutter_known:
                out[name] = _stated_readout(camera.rolling_shutter_s)
            else:
                out[name] = Readout(0.0, 0.0, f"not determined: {reason}", 0.0)
        return out

    def _keypoints_of(self, image_id: int, trajectories: Mapping[str, Trajectory]) -> _Keypoints:
        image = self._model.image(image_id)
        ref = ImageRef.parse(image.name)
        feature = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        px = np.array([image.points2D[index].xy for index in feature.tolist()]).reshape(-1, 2)
        x_in_map = self._points(image, feature)
        path = trajectories.get(ref.camera)
        if path is None:  # registered against another map: how it moves is not known in this gauge
            return _Keypoints(image_id, ref.camera, feature, px, np.zeros_like(px))
        velocity = image_velocity(
            self._lenses[ref.camera],
            path.gauge_from_cam,
            path.times_ns,
            np.full(len(feature), ref.frame, dtype=np.int64),
            x_in_map,
        )
        return _Keypoints(image_id, ref.camera, feature, px, velocity)

    def _points(self, image: Any, feature: IntArray) -> FloatArray:
        points = image.points2D
        return np.array(
            [self._model.point3D(points[index].point3D_id).xyz for index in feature.tolist()]
        ).reshape(-1, 3)

    def _residuals(self, model: pycolmap.Reconstruction) -> dict[str, FloatArray]:
        """Observed minus projected, in the same order for every copy, by camera."""
        out: dict[str, list[FloatArray]] = {name: [] for name in self._lenses}
        for item in self._keypoints:
            found = image_residuals_px(model, model.image(item.image_id), item.feature)
            out[item.camera].append(found.ravel())
        return {name: np.concatenate([np.zeros(0), *parts]) for name, parts in out.items()}


@dataclass(frozen=True, slots=True)
class _ResidualSlope:
    """How the residuals of an adjusted map change with the readout time.

    Attributes:
        correlation: Of the residuals with their change by a second more.
        information: Of that change with itself.
        spread: Variance of the residuals about the line.
    """

    correlation: float
    information: float
    spread: float

    @staticmethod
    def of(before: FloatArray, after: FloatArray, step_s: float) -> _ResidualSlope:
        """From the residuals of two adjustments, `step_s` apart; taken at the second."""
        change = (after - before) / (step_s if step_s else np.inf)
        # A point that an adjustment throws far away says nothing of the shutter.
        sane = np.maximum(np.abs(after), np.abs(before)) < _MAX_RESIDUAL_PX
        weight = np.where(sane, 1.0 / (1.0 + (after / _LOSS_PX) ** 2), 0.0)
        information = float((weight * change * change).sum())
        correlation = float((weight * change * after).sum())
        best = after - change * (correlation / information if information else 0.0)
        return _ResidualSlope(
            correlation, information, float((weight * best**2).sum() / max(weight.sum(), 1.0))
        )

    def readout(self, at_s: float, frame_s: float) -> Readout:
        """The readout time at which the residuals are smallest, if it stands out."""
        if self.information <= 0.0:
            return Readout(0.0, float("inf"), "none found", at_s)
        best_s = at_s - self.correlation / self.information
        sigma_s = float(np.sqrt(self.spread / self.information))
        found = max(_MIN_READOUT_S, _MIN_SIGMAS * sigma_s) < abs(best_s) < _MAX_READOUT_FRAMES * frame_s
        return Readout(best_s if found else 0.0, sigma_s, "estimated" if found else "none found", best_s)


def estimate_readouts(
    rolling: RollingShutterModel,
    cameras: Mapping[str, CaptureCamera],
    settings: pycolmap.IncrementalPipelineOptions,
    constant: Sequence[int],
) -> tuple[RollingShutterModel, dict[str, Readout]]:
    """Readout times by camera, and the model read the way its cameras' sensors turn out to lie.

    Where trial adjustments fail none is used, and the log says so.
    """
    stated = {name for name, camera in cameras.items() if camera.camera.sideways}
    rolling = rolling.read_along(stated)
    try:
        part = rolling.fastest()
        found = part.find(settings, constant)
        turned = {
            name
            for name in found
            if cameras[name].may_be_sideways and not cameras[name].rolling_shutter_known
        }
        across = part.read_along(stated | turned).find(settings, constant) if turned else {}
    except EstimationError as error:
        found, turned, across = rolling.undetermined(error.message), set(), {}
    better = {name for name in turned if across[name].clearness > found[name].clearness}
    found |= {name: across[name] for name in better}
    found = {name: replace(each, sideways=name in stated | better) for name, each in found.items()}
    return rolling.read_along(stated | better), found


def map_with_readouts(scene: Map, found: Mapping[str, Readout]) -> Map:
    """A map of the cameras' middle rows that says how long their sensors took, and which way they lie."""
    read = {name: each for name, each in found.items() if each.seconds}
    cameras = {
        name: replace(lens, sideways=name in read and read[name].sideways)
        for name, lens in scene.cameras.items()
    }
    return replace(scene, cameras=cameras, readout_s={name: each.seconds for name, each in read.items()})


def _stated_readout(readout_s: float) -> Readout:
    return Readout(readout_s, 0.0, "stated", readout_s)
