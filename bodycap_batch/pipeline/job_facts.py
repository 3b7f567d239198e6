"""A job, and what is known about its videos: what the tasks of all stages are made from."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace

from bodycap_batch.config.models import CameraConfig, CaptureConfig, Job
from bodycap_batch.pipeline.inputs import capture_ref
from bodycap_batch.tasks.inputs import CaptureRef, FileRef


@dataclass(frozen=True, slots=True, kw_only=True)
class JobFacts:
    """A job, and what is known about its videos.

    Attributes:
        job: The resolved job, with the places that were found from the motion.
        capture: The capture block of the job. If start_s or end_s selects frames, it states the clocks that
            are known before the map.
        digests: The `camera_digest` of each camera, by camera name; empty until the videos are identified.
        samples: The file with inertial samples beside the video of each camera that has one, by camera name.
        telemetry: Names of the cameras with telemetry.
        stabilised: Names of the cameras whose videos say that they are stabilised.
        freed: By name of each camera whose given lens is not used, its given focal length over the width.
    """

    job: Job
    capture: CaptureConfig
    digests: Mapping[str, str] = field(default_factory=dict)
    samples: Mapping[str, FileRef] = field(default_factory=dict)
    telemetry: frozenset[str] = frozenset()
    stabilised: frozenset[str] = frozenset()
    freed: Mapping[str, float] = field(default_factory=dict)

    @staticmethod
    def of(job: Job) -> JobFacts:
        """Return the facts of a job whose videos are not identified yet."""
        return JobFacts(job=job, capture=job.capture)

    def footage(self, cameras: Sequence[CameraConfig] | None = None) -> CaptureRef:
        """Return the videos of all or some cameras, as input of a task."""
        return capture_ref(self.capture, self.digests, cameras)

    def with_places(self, places: Mapping[str, str]) -> JobFacts:
        """Return the facts with the places that were found from the motion, by camera name."""
        located = self.job.model_copy(update={"capture": self.capture}).with_places(places)
        return replace(self, job=self.job.with_places(places), capture=located.capture)

    def with_unknown_lenses(self, given: Mapping[str, float]) -> JobFacts:
        """Return the facts of the job in which the lenses of some cameras are unknown.

        Args:
            given: By camera name, the given focal length over the width.
        """
        capture = _with_unknown_lenses(self.job.capture, given)
        return replace(
            self,
            job=self.job.model_copy(update={"capture": capture}),
            capture=_with_unknown_lenses(self.capture, given),
            freed=given,
        )


def _with_unknown_lenses(capture: CaptureConfig, cameras: Container[str]) -> CaptureConfig:
    changed = tuple(
        camera.model_copy(update={"calibration": "auto"}) if camera.name in cameras else camera
        for camera in capture.cameras
    )
    return capture.model_copy(update={"cameras": changed})
