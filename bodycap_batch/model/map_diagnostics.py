"""The diagnostics of a map: what mapping passes to its later steps, to other stages and to the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_KEYS = {
    "undecided_groups": "mirror_images",
    "flipped_cameras": "mirrored_cameras",
    "contradicting_cameras": "contradicting_cameras",
    "recalibrated": "freed_lenses",
    "uncorrected_shutters": "uncorrected_shutters",
    "excluded_from_pair": "named_initial_pair",
    "misfit_factors": "misfitting_lenses",
    "refined_intrinsics": "found_lenses",
    "extensions": "growth",
    "reach": "reach",
    "misplaced": "misplaced_keyframes",
}
"""Key in the log of each field, in the order in which they are written."""
_LEFT_OUT = "left_out"
"""Key of the names in the entry of `excluded_from_pair`."""
_CHECKED = ("misfit_factors", "reach")
"""Fields that are None without a check, and empty if the check found nothing."""
_REFINED = ("misplaced",)
"""Fields whose entry an earlier refinement may have written. It is replaced by an empty one."""

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
        uncorrected_shutters: Names of the cameras that may have a rolling shutter for which no keypoint was
            corrected before the map was built.
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
    uncorrected_shutters: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_log(log: Mapping[str, Any]) -> MapDiagnostics:
        """Read the diagnostics from a log.

        Args:
            log: The log that is stored with the map, or the value of ``mapping`` in ``metrics.json``.
        """
        found = {name: _as_tuples(log[key]) for name, key in _KEYS.items() if key in log}
        if "excluded_from_pair" in found:
            found["excluded_from_pair"] = _as_tuples(found["excluded_from_pair"].get(_LEFT_OUT, ()))
        if "misplaced" in found:
            found["misplaced"] = {name: tuple(frames) for name, frames in found["misplaced"].items()}
        if "refined_intrinsics" in found:
            found["refined_intrinsics"] = {
                name: RefinedIntrinsics(entry["model"], tuple(entry["params"]))
                for name, entry in found["refined_intrinsics"].items()
            }
        return MapDiagnostics(**found, details=log)

    def to_log(self) -> dict[str, Any]:
        """Return the log.

        The log contains all entries of `details`. For each other field that has a value, the entry is added
        or replaced.
        """
        log = dict(self.details)
        for name, key in _KEYS.items():
            value = getattr(self, name)
            is_known = value is not None if name in _CHECKED else bool(value)
            if is_known or (name in _REFINED and key in log):
                log[key] = _as_lists(value)
        if self.excluded_from_pair:
            log[_KEYS["excluded_from_pair"]] = {
                "failed": "a mirrored camera was left out",
                _LEFT_OUT: list(self.excluded_from_pair),
            }
        return log


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _as_lists(value: Any) -> Any:
    if isinstance(value, RefinedIntrinsics):
        return {"model": value.model, "params": list(value.params)}
    if isinstance(value, Mapping):
        return {name: _as_lists(part) for name, part in value.items()}
    return [_as_lists(part) for part in value] if isinstance(value, tuple) else value
