"""What mapping reports on a map to later steps, other stages and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

_UNDECIDED_GROUPS = "mirror_images"
_FLIPPED_CAMERAS = "mirrored_cameras"
_INITIAL_PAIR = "named_initial_pair"
_EXCLUDED_FROM_PAIR = "left_out"
_MISFIT_FACTORS = "misfitting_lenses"
_RECALIBRATED = "freed_lenses"
_REFINED_INTRINSICS = "found_lenses"
_EXTENSIONS = "growth"
_REACH = "reach"

CameraGroups = tuple[tuple[str, ...], tuple[str, ...]]
"""Two groups of cameras, by name."""


@dataclass(frozen=True, slots=True)
class RefinedIntrinsics:
    """Intrinsics that a map refined.

    Attributes:
        model: COLMAP's name of the camera model.
        params: Its parameters in COLMAP's order.
    """

    model: str
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapDiagnostics:
    """What mapping reports on a map, with a typed field for everything that other code reads.

    Attributes:
        undecided_groups: Groups of cameras that see mirror images of each other, all kept.
        flipped_cameras: Cameras that were left out because their picture is flipped.
        excluded_from_pair: Cameras of the user's initial pair that were left out; the pair was not used.
        misfit_factors: By camera name, the focal length that fits relative to the given one, if the map
            contradicts the given intrinsics. None before the check.
        recalibrated: Cameras whose given intrinsics were replaced by refined ones.
        refined_intrinsics: The refined intrinsics of these cameras.
        extensions: One entry for the log for each extension of the map.
        reach: Entries for the log on the distances between cameras; None if they were not checked.
        details: All entries of the log in their order, those of the other fields included.
    """

    undecided_groups: tuple[CameraGroups, ...] = ()
    flipped_cameras: tuple[str, ...] = ()
    excluded_from_pair: tuple[str, ...] = ()
    misfit_factors: Mapping[str, float] | None = None
    recalibrated: tuple[str, ...] = ()
    refined_intrinsics: Mapping[str, RefinedIntrinsics] = field(default_factory=dict)
    extensions: tuple[Mapping[str, Any], ...] = ()
    reach: Mapping[str, Any] | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_log(log: Mapping[str, Any]) -> MapDiagnostics:
        """Read the diagnostics from a log, as stored with the map or under ``mapping`` in metrics.json."""
        return MapDiagnostics(
            undecided_groups=tuple(_groups(groups) for groups in log.get(_UNDECIDED_GROUPS, ())),
            flipped_cameras=tuple(log.get(_FLIPPED_CAMERAS, ())),
            excluded_from_pair=tuple(log.get(_INITIAL_PAIR, {}).get(_EXCLUDED_FROM_PAIR, ())),
            misfit_factors=log.get(_MISFIT_FACTORS),
            recalibrated=tuple(log.get(_RECALIBRATED, ())),
            refined_intrinsics={
                name: RefinedIntrinsics(entry["model"], tuple(entry["params"]))
                for name, entry in log.get(_REFINED_INTRINSICS, {}).items()
            },
            extensions=tuple(log.get(_EXTENSIONS, ())),
            reach=log.get(_REACH),
            details=log,
        )

    def to_log(self) -> dict[str, Any]:
        """Return the log: the details, with new entries for the fields that are set."""
        log = dict(self.details)
        if self.undecided_groups:
            log[_UNDECIDED_GROUPS] = [[list(one), list(other)] for one, other in self.undecided_groups]
        if self.flipped_cameras:
            log[_FLIPPED_CAMERAS] = list(self.flipped_cameras)
        if self.excluded_from_pair:
            log[_INITIAL_PAIR] = {
                "failed": "a mirrored camera was left out",
                _EXCLUDED_FROM_PAIR: list(self.excluded_from_pair),
            }
        if self.misfit_factors is not None:
            log[_MISFIT_FACTORS] = dict(self.misfit_factors)
        if self.recalibrated:
            log[_RECALIBRATED] = list(self.recalibrated)
        if self.refined_intrinsics:
            log[_REFINED_INTRINSICS] = {
                name: {"model": item.model, "params": list(item.params)}
                for name, item in self.refined_intrinsics.items()
            }
        if self.extensions:
            log[_EXTENSIONS] = list(self.extensions)
        if self.reach is not None:
            log[_REACH] = dict(self.reach)
        return log


def _groups(groups: Sequence[Sequence[str]]) -> CameraGroups:
    """Return two groups of cameras as tuples."""
    one, other = groups
    return tuple(one), tuple(other)
