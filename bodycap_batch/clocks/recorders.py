"""Compare the devices and encoders that recorded two files."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from av.audio.stream import AudioStream
    from av.container import InputContainer

_MODEL_KEYS = (
    "com.apple.quicktime.model",
    "com.android.model",
    "model",
    "com.apple.quicktime.make",
    "com.android.manufacturer",
    "make",
)
"""Keys of container metadata that name the model of a camera or its maker."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorder:
    """What a file says about the device and the encoder of its sound.

    Attributes:
        model: Name of the camera model; empty if it is unknown.
        encoder: Container, codec and handlers. Equal cameras write equal values.
        rate_hz: Samples per second of the sound.
    """

    model: str
    encoder: tuple[str, ...]
    rate_hz: int

    def is_like(self, other: Recorder) -> bool:
        """Return True if both files seem to come from cameras of the same model.

        Cameras of different models relate sound and picture differently. If a model is unknown, cameras with
        a difference of encoder or format are treated as different models.
        """
        if self.model and other.model:
            return self.model == other.model
        return (self.model, self.encoder, self.rate_hz) == (other.model, other.encoder, other.rate_hz)


def recorder_of(container: InputContainer, stream: AudioStream) -> Recorder:
    """Read what an opened file says about the device and the encoder of its sound."""
    metadata = {key.lower(): value for key, value in container.metadata.items()}
    model = " ".join(metadata[key] for key in _MODEL_KEYS if metadata.get(key))
    # The first part of a GoPro's firmware version names the camera: HD5.02, H19.03.
    firmware = re.match(r"^(H[A-Z]?\d+)\.", metadata.get("firmware", ""))
    if not model and firmware:
        model = firmware.group(1)
    encoder = (
        container.format.name,
        metadata.get("major_brand", ""),
        metadata.get("encoder", ""),
        stream.codec_context.name,
        str(stream.metadata.get("handler_name", "")).strip(),
        str(stream.codec_context.layout.name),
    )
    return Recorder(model=model, encoder=encoder, rate_hz=int(stream.codec_context.sample_rate or 0))
