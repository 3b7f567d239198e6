"""Choose the lens profile from which the map's estimate of a lens starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.capture.video import VideoFile, open_container
from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.lens_profiles import LensChoice, choose_for_file, choose_named
from bodycap_batch.config.models import CameraConfig
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.formats.gpmf import gopro_lens_mode, gopro_model, gopro_settings, gopro_stabilisation

_MODEL_KEYS = ("com.apple.quicktime.model", "com.android.model", "model")
"""Keys of the metadata that name the model of a phone or a camera."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoMode:
    """What a video states about the camera and its mode; "" for what it does not state.

    Attributes:
        model: Model of the camera.
        lens_mode: Lens mode, such as Wide.
        stabilisation: Mode of the stabilisation, or "off".
    """

    model: str
    lens_mode: str
    stabilisation: str


def video_mode(path: Path) -> VideoMode:
    """Return what a video states about the camera and its mode. Raises `CaptureError` if it is unreadable."""
    with open_container(path) as container:
        metadata = {key.lower(): str(value) for key, value in container.metadata.items()}
    settings = gopro_settings(path)
    return VideoMode(
        model=_model(settings, metadata),
        lens_mode=gopro_lens_mode(settings),
        stabilisation=gopro_stabilisation(settings),
    )


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
    sizes = (video.shown_size, video.turned_size)  # in square pixels, and in stored ones
    if isinstance(config.calibration, str) and config.calibration != "auto":
        name = config.calibration
        found = _first_choice([choose_named(name, size, video.fps) for size in sizes])
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
    mode = video_mode(video.path)
    if mode.stabilisation not in ("", "off") or not mode.model:
        return None
    choice = _first_choice([choose_for_file(mode.model, mode.lens_mode, size, video.fps) for size in sizes])
    return None if isinstance(choice, str) else choice


def _first_choice(choices: Sequence[LensChoice | str]) -> LensChoice | str:
    return next((each for each in choices if isinstance(each, LensChoice)), choices[0])


def _model(settings: Mapping[str, str], metadata: Mapping[str, str]) -> str:
    gopro = gopro_model(settings, metadata.get("firmware", ""), "")
    return gopro or next((metadata[key] for key in _MODEL_KEYS if metadata.get(key)), "")
