"""Compare the clock offsets that a job uses with the sound of its cameras."""

from __future__ import annotations

from bodycap_batch.clocks.estimate import estimate_clocks
from bodycap_batch.config.models import CaptureConfig
from bodycap_batch.core.errors import CaptureError

_MAX_SIGMAS = 3.0
"""Maximum difference of an offset from the offset of the sound, in standard deviations of the latter."""
_MAX_DIFFERENCE_S = 1.0 / 30.0
"""Maximum difference (seconds) of an offset from the offset of the sound. Origin: the interval between two
frames at 30 fps. An offset that was read from the frames of a clap is not more accurate."""


def offset_notes(spec: CaptureConfig, threads: int | None = None) -> list[str]:
    """Return a note for the user if the sound contradicts the clock offsets that a job uses.

    Cameras without sound, and cameras whose sound matches no other sound, are not judged.

    Args:
        spec: The capture block of a job, as returned by `load_job`.
        threads: Number of cameras or pairs that are worked on at the same time; None for all processors.

    Returns:
        At most one note, which names all cameras with a contradicted offset.
    """
    if len(spec.cameras) < 2:
        return []
    try:
        estimates = estimate_clocks(spec, threads)
    except CaptureError:  # the other checks report a video that cannot be read
        return []
    used_s = {camera.name: camera.offset_s or 0.0 for camera in spec.cameras}
    wrong = []
    for clock in estimates.cameras:
        if clock.source != "sound" or clock.offset_s is None or clock.sigma_s is None:
            continue
        job_s = used_s[clock.camera] - used_s[estimates.reference]
        if abs(job_s - clock.offset_s) > max(_MAX_SIGMAS * clock.sigma_s, _MAX_DIFFERENCE_S):
            wrong.append(f"{clock.camera} {clock.offset_s:+.3f} s (the job uses {job_s:+.3f} s)")
    if not wrong:
        return []
    return [
        f"the sound contradicts the clock offsets of the job, so the motion and its scale will be wrong: "
        f"relative to {estimates.reference}, the sound gives {', '.join(wrong)}; run `bodycap sync`, and put "
        "the lines that it prints into job.yaml"
    ]
