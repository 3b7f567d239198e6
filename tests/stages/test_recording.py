"""The recording for the Rerun viewer: the solved motion, in the world and in common time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.palette import Colour, camera_colours
from bodycap_batch.overlay import bones_from_motion
from bodycap_batch.report import ReportInputs
from bodycap_batch.report.recording import write_recording
from bodycap_batch.runner import NotStored
from tests.reports import report_inputs


@pytest.fixture(scope="module")
def inputs() -> ReportInputs:
    return report_inputs(40)


class LogSpy:
    """Records what is logged, by entity."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.strips: dict[str, list[list[np.ndarray]]] = {}
        self.times: list[float] = []
        self.columns: list[np.ndarray] = []
        self._last: list[np.ndarray] = []
        self._colours: tuple[Colour, ...] = ()
        self.colours: dict[str, tuple[Colour, ...]] = {}
        strips, column, set_time, log = (
            rr.LineStrips3D,
            rr.TimeColumn,
            rr.RecordingStream.set_time,
            rr.RecordingStream.log,
        )

        def spy_strips(lines: list[np.ndarray], colors: Sequence[Colour] = ()) -> object:
            self._last = lines
            self._colours = tuple(colors)
            return strips(lines, colors=colors or None)

        def spy_column(name: str, *, duration: np.ndarray) -> object:
            self.columns.append(duration)
            return column(name, duration=duration)

        def spy_time(stream: object, name: str, *, duration: float) -> None:
            self.times.append(duration)
            set_time(stream, name, duration=duration)

        def spy_log(stream: object, name: str, thing: object, **options: bool) -> None:
            if isinstance(thing, strips):
                self.strips.setdefault(name, []).append(self._last)
                self.colours[name] = self._colours
            log(stream, name, thing, **options)

        monkeypatch.setattr(rr, "LineStrips3D", spy_strips)
        monkeypatch.setattr(rr, "TimeColumn", spy_column)
        monkeypatch.setattr(rr.RecordingStream, "set_time", spy_time)
        monkeypatch.setattr(rr.RecordingStream, "log", spy_log)


def test_a_recording_is_written(inputs: ReportInputs, tmp_path: Path) -> None:
    write_recording(inputs, tmp_path / "out" / "walk.rrd")
    assert (tmp_path / "out" / "walk.rrd").read_bytes()[:3] == b"RRF"


def test_the_body_is_the_solved_one(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LogSpy(monkeypatch)
    write_recording(inputs, tmp_path / "walk.rrd")
    assert inputs.merge is not None
    np.testing.assert_allclose(log.times, inputs.merge.times_ns() * 1e-9)
    np.testing.assert_array_equal(
        log.strips["world/body"], bones_from_motion(inputs.merge.motion, inputs.merge.solved).ends_in_world
    )
    # The body walks at 1.1 m/s for 39 ticks of 1/30 s; an in-place animation would not move.
    bones = np.array(log.strips["world/body"])
    assert np.linalg.norm(bones[-1] - bones[0], axis=-1).min() > 1.0


def test_camera_paths_use_common_time_and_are_interrupted_at_gaps(
    inputs: ReportInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = LogSpy(monkeypatch)
    clocks = {name: replace(clock, offset_s=2.5) for name, clock in inputs.clocks.items()}
    write_recording(replace(inputs, clocks=clocks, merge=None), tmp_path / "walk.rrd")
    for registration, times in zip(inputs.registrations, log.columns, strict=True):
        path = registration.trajectory
        np.testing.assert_allclose(times, path.times_ns[path.localised] * 1e-9 + 2.5)
    # frames 20 to 24 are lost
    (lines,) = log.strips["world/cameras/torso/path"]
    assert [len(line) for line in lines] == [20, 15]
    assert log.colours["world/cameras/torso/path"] == (camera_colours(inputs.cameras)["torso"],)
    assert "world/body" not in log.strips


def test_a_job_without_stored_results_has_no_recording(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="neither the map nor the camera paths"):
        write_recording(ReportInputs(name="x"), tmp_path / "x.rrd")
    # If stored results come from another version, the error states it, as the report does.
    failure = NotStored([], tmp_path).to_dict()
    with pytest.raises(JobError, match="have not been computed yet") as caught:
        write_recording(ReportInputs(name="x", failure=failure), tmp_path / "x.rrd")
    assert "bodycap why" in str(caught.value.hint)


def test_a_target_that_cannot_be_written_is_an_error(inputs: ReportInputs, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        write_recording(inputs, tmp_path / "file" / "x.rrd")
