"""The task that writes the page a person reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.stage import RESULTS, SEEING, VISION, Json, Stage

if TYPE_CHECKING:
    from bodycap_batch.capture import Capture
    from bodycap_batch.model.merge_data import MergeResult
    from bodycap_batch.report import ReportInputs


def _report(_: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.report import REPORT_FILE, write_report

    write_report(load_inputs(arguments, context.threads), files / RESULTS / REPORT_FILE, context)


def load_inputs(arguments: Json, threads: int = 0) -> ReportInputs:
    """Read what the stages before left; what a broken-off job lacks is None in the arguments."""
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.merge_data import CameraClock
    from bodycap_batch.report import ReportInputs

    registrations = [load_registration(path) for path in arguments["registrations"]]
    exported = arguments["export"]
    return ReportInputs(
        name=arguments["name"],
        cameras=tuple(camera["name"] for camera in arguments["capture"]["cameras"]),
        maps=() if arguments["map"] is None else load_map(arguments["map"]).maps,
        registrations=tuple(registrations),
        clocks={
            found.trajectory.camera: read_dataclass(CameraClock, Path(path), "clock")
            for path, found in zip(arguments["registrations"], registrations, strict=True)
        },
        selections=tuple(load_keyframes(path) for path in arguments["keyframes"]),
        merge=_merge(arguments["merge"]),
        mounts=() if arguments["body"] is None else load_body(arguments["body"])[1],
        metrics=None
        if exported is None
        else json.loads((Path(exported) / RESULTS / "metrics.json").read_text(encoding="utf-8")),
        capture=_capture(arguments, threads),
        failure=arguments["failure"],
        max_gap_s=arguments["max_gap_s"],
    )


def _merge(path: str | None) -> MergeResult | None:
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.merge_data import MergeResult

    return None if path is None else read_dataclass(MergeResult, Path(path), "merge")


def _capture(arguments: Json, threads: int) -> Capture | None:
    """The videos; None where it is they that stopped the job."""
    from bodycap_batch.core.errors import CaptureError

    try:
        return load_capture(arguments, threads)
    except CaptureError:
        if arguments["failure"] is None:
            raise
        return None


REPORT = Stage(
    function=_report,
    libraries=(*VISION, "jinja2", "k3d", "pycolmap", "scipy"),
    modules=(*SEEING, "bodycap_batch.report", "jinja2", "pycolmap", "scipy.spatial.transform"),
)
