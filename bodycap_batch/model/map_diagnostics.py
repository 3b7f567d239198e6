"""The diagnostics of a map: what mapping passes to its later steps, to other stages and to the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_UNDECIDED_GROUPS = "mirror_images"
_FLIPPED_CAMERAS = "mirrored_cameras"
_INITIAL_PAIR = "named_initial_pair"
_EXCLUDED_FROM_PAIR = "left_out"
_CONTRADICTING_CAMERAS = "contradicting_cameras"
_MISFIT_FACTORS = "misfitting_lenses"
_RECALIBRATED = "freed_lenses"
_REFINED_INTRINSICS = "found_lenses"
_EXTENSIONS = "growth"
_REACH = "reach"
_MISPLACED = "misplaced_keyframes"
_UNKNOWN_SHUTTERS = "unknown_shutters"
_DISTORTED_CAMERAS = "distorted_cameras"

CameraGroups = tuple[tuple[str, ...], tuple[str, ...]]
"""Two groups of cameras, by name."""


@dataclass(frozen=True, slots=True)
class RefinedIntrinsics:
    """The refined intrinsics of a camera, estimated together with a map.

    Attributes:
        model: COLMAP's name of the camera model.
        params: Parameters of the camera model in COLMAP's order.
    """

    model: str
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapDiagnostics:
    """The diagnostics of a map, with a typed field for every entry of the log that other code reads.

    Attributes:
        undecided_groups: Pairs of camera groups whose images are mirrored relative to each other. All cameras
            of both groups are kept, because it is unknown which group is mirrored.
        flipped_cameras: Names of the cameras that were excluded because their images are mirrored.
        contradicting_cameras: Names of the cameras that were excluded because their matches contradict the
            matches of the other cameras.
        excluded_from_pair: Names of the excluded cameras that belong to the user's initial image pair. If
            there is such a camera, mapping did not use the user's pair.
        misfit_factors: By camera name, the focal length that fits the map, divided by the given focal length.
            A camera has an entry only if the map contradicts its given intrinsics. None if the intrinsics
            were not checked.
        recalibrated: Names of the cameras whose given intrinsics were replaced by refined intrinsics.
        refined_intrinsics: By camera name, the refined intrinsics of the recalibrated cameras.
        extensions: For each extension of the map, the entry that describes the extension in the log.
        reach: Result of comparing the distances between the cameras with the distances that the body permits,
            as entries of the log. None if the distances were not checked.
        misplaced: By camera name, the frame indices of the keyframes that contradicted the map. They are not
            in the map.
        unknown_shutters: Names of the cameras whose readout time neither the job nor the matches of adjacent
            frames determine.
        distorted_cameras: Names of the cameras whose rolling shutter displaces keypoints so far that the map
            should be built again from corrected keypoints.
        details: All entries of the log in the order of the log, including the entries of the other fields.
    """

    undecided_groups: tuple[CameraGroups, ...] = ()
    flipped_cameras: tuple[str, ...] = ()
    contradicting_cameras: tuple[str, ...] = ()
    excluded_from_pair: tuple[str, ...] = ()
    misfit_factors: Mapping[str, float] | None = None
    recalibrated: tuple[str, ...] = ()
    refined_intrinsics: Mapping[str, RefinedIntrinsics] = field(default_factory=dict)
    extensions: tuple[Mapping[str, Any], ...] = ()
    reach: Mapping[str, Any] | None = None
    misplaced: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    unknown_shutters: tuple[str, ...] = ()
    distorted_cameras: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_log(log: Mapping[str, Any]) -> MapDiagnostics:
        """Read the diagnostics from a log.

        Args:
            log: The log that is stored with the map, or the value of ``mapping`` in ``metrics.json``.
        """
        return MapDiagnostics(
            undecided_groups=tuple(_groups(groups) for groups in log.get(_UNDECIDED_GROUPS, ())),
            flipped_cameras=tuple(log.get(_FLIPPED_CAMERAS, ())),
            contradicting_cameras=tuple(log.get(_CONTRADICTING_CAMERAS, ())),
            excluded_from_pair=tuple(log.get(_INITIAL_PAIR, {}).get(_EXCLUDED_FROM_PAIR, ())),
            misfit_factors=log.get(_MISFIT_FACTORS),
            recalibrated=tuple(log.get(_RECALIBRATED, ())),
            refined_intrinsics={
                name: RefinedIntrinsics(entry["model"], tuple(entry["params"]))
                for name, entry in log.get(_REFINED_INTRINSICS, {}).items()
            },
            extensions=tuple(log.get(_EXTENSIONS, ())),
            reach=log.get(_REACH),
            misplaced={name: tuple(frames) for name, frames in log.get(_MISPLACED, {}).items()},
            unknown_shutters=tuple(log.get(_UNKNOWN_SHUTTERS, ())),
            distorted_cameras=tuple(log.get(_DISTORTED_CAMERAS, ())),
            details=log,
        )

    def to_log(self) -> dict[str, Any]:
        """Return the log.

        The log contains all entries of `details`. For each other field that has a value, the entry is added
        or replaced.
        """
        log = dict(self.details)
        if self.undecided_groups:
            log[_UNDECIDED_GROUPS] = [[list(one), list(other)] for one, other in self.undecided_groups]
        for key, names in (
            (_FLIPPED_CAMERAS, self.flipped_cameras),
            (_CONTRADICTING_CAMERAS, self.contradicting_cameras),
            (_RECALIBRATED, self.recalibrated),
            (_UNKNOWN_SHUTTERS, self.unknown_shutters),
        ):
            if names:
                log[key] = list(names)
        if self.excluded_from_pair:
            log[_INITIAL_PAIR] = {
                "failed": "a mirrored camera was left out",
                _EXCLUDED_FROM_PAIR: list(self.excluded_from_pair),
            }
        if self.misfit_factors is not None:
            log[_MISFIT_FACTORS] = dict(self.misfit_factors)
        if self.refined_intrinsics:
            log[_REFINED_INTRINSICS] = {
                name: {"model": item.model, "params": list(item.params)}
                for name, item in self.refined_intrinsics.items()
            }
        if self.extensions:
            log[_EXTENSIONS] = list(self.extensions)
        if self.reach is not None:
            log[_REACH] = dict(self.reach)
        if self.misplaced or _MISPLACED in log:
            log[_MISPLACED] = {name: list(frames) for name, frames in self.misplaced.items()}
        if self.distorted_cameras or _DISTORTED_CAMERAS in log:
            log[_DISTORTED_CAMERAS] = list(self.distorted_cameras)
        return log


def _groups(groups: Sequence[Sequence[str]]) -> CameraGroups:
    """Convert a pair of lists of camera names to a pair of tuples."""
    one, other = groups
    return tuple(one), tuple(other)
