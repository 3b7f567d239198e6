"""Choose the lens profile from which the map's estimate of a lens starts."""

from __future__ import annotations

from collections.abc import Mapping

from bodycap_batch.capture.video import VideoFile, open_container
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.lens_profiles import LensChoice, choose_for_file, choose_named
from bodycap_batch.config.models import CameraConfig
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.gpmf import gopro_lens_mode, gopro_model, gopro_settings, gopro_stabilisation

_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")
"""Keys of the metadata that name the model of a phone or a camera."""


def chosen_lens(config: CameraConfig, video: VideoFile) -> LensChoice | None:
    """Return the lens profile of a camera: the one that the job names, else one for the model in the file.

    The file must state the model, its lens mode if the model has several at this size, and no stabilisation.
    A calibration or a field of view in the job has priority.

    Args:
        config: The resolved camera.
        video: Its first video.

    Returns:
        The choice; None if there is none, or if the job gives a calibration or a field of view.

    Raises:
        CaptureError: The job names a lens that does not fit the video.
    """
    if isinstance(config.calibration, str) and config.calibration != "auto":
        found = choose_named(config.calibration, video.shown_size, video.fps)
        if isinstance(found, str):
            raise CaptureError(
                found,
                path=video.path,
                field="calibration",
                hint="name a profile of this size (`bodycap lenses`), or use `calibration: auto`",
            )
        return found
    if isinstance(config.calibration, Calibration) or config.fov_deg is not None:
        return None
    with open_container(video.path) as container:
        metadata = {key.lower(): str(value) for key, value in container.metadata.items()}
    settings = gopro_settings(video.path)
    if gopro_stabilisation(settings) not in ("", "off"):
        return None
    model = _model(settings, metadata)
    if not model:
        return None
    choice = choose_for_file(model, gopro_lens_mode(settings), video.shown_size, video.fps)
    return None if isinstance(choice, str) else choice


def _model(settings: Mapping[str, str], metadata: Mapping[str, str]) -> str:
    gopro = gopro_model(settings, metadata.get("firmware", ""), "")
    return gopro or next((metadata[key] for key in _MODEL_KEYS if metadata.get(key)), "")
