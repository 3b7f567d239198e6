"""Inputs of the stages, from what the stages before them saved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.tasks.stage import Json

if TYPE_CHECKING:
    from bodycap_batch.capture import Capture, KeptFrames
    from bodycap_batch.model.scene import KeyframeSelection, MapResult, Registration


def load_capture(arguments: Json, threads: int = 0) -> Capture:
    """Open the capture block of a task's arguments, with the frames that its keyframes' artefacts keep."""
    from bodycap_batch.capture import open_capture
    from bodycap_batch.config.models import CaptureConfig

    capture = open_capture(CaptureConfig.model_validate(arguments["capture"]), threads)
    folders = arguments.get("kept", {})
    cameras = (replace(each, kept=_kept(folders.get(each.name))) for each in capture.cameras)
    return replace(capture, cameras=tuple(cameras))


def _kept(folder: str | None) -> KeptFrames | None:
    from bodycap_batch.capture.kept import KEPT_NAME, KeptFrames
    from bodycap_batch.formats.dataclass_files import read_dataclass

    if folder is None or not (Path(folder) / f"{KEPT_NAME}.json").exists():
        return None
    return read_dataclass(KeptFrames, Path(folder), KEPT_NAME)


def load_keyframes(path: str) -> KeyframeSelection:
    """Read a camera's keyframes."""
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.scene import KeyframeSelection

    return read_dataclass(KeyframeSelection, Path(path), "keyframes")


def load_map(path: str) -> MapResult:
    """Read a map with its workspace."""
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.scene import MapResult

    return read_dataclass(MapResult, Path(path), "map")


def load_registration(path: str) -> Registration:
    """Read a camera's poses."""
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.scene import Registration

    return read_dataclass(Registration, Path(path), "registration")
