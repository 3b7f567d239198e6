"""bodycap_batch: body motion and a map of the room from body-worn cameras."""

# zlib must be loaded before pycolmap: the other order aborts on the first compression.
import zlib  # noqa: F401
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bodycap_batch.api import (
        BodyMotion,
        CameraPath,
        ClockEstimate,
        Event,
        FrameTable,
        Job,
        Result,
        load_job,
        run_job,
    )

__version__ = "0.2.0"
__all__ = [
    "BodyMotion",
    "CameraPath",
    "ClockEstimate",
    "Event",
    "FrameTable",
    "Job",
    "Result",
    "load_job",
    "run_job",
]


def __getattr__(name: str) -> Any:
    """Return a name of the Python API. It is imported on first use, because commands start without it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.api"), name)
