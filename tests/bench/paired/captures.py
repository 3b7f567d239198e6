"""The captures of the comparison: shared ones, the same without their lens, real ones and drawn ones."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import yaml

from tests.bench.rows import DATA, SHARED, row_of

VIDEOS = (".mp4", ".mov", ".mkv")
CALIBRATION = "calib.json"
TIMESTAMPS = ".timestamps.txt"
_MORE_SHARED = ("walk131_02", "roll131", "clocks05")
"""Shared captures with truth that are not in the table of `make bench`."""
_WITHOUT_LENS = "_no_lens"
_MAX_DELAY_FRAMES = 3
"""Maximum start of a video, frames, that is the delay of its encoder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchCapture:
    """One capture of the comparison.

    Attributes:
        name: Name in the tables.
        source: Folder of videos, or job file.
        truth: Folder of the true paths, or the file of the path of the only camera; None without a truth.
        lens: File with the true lens; None if it is unknown.
        arguments: Further arguments of ``bodycap run``.
        reference: Camera with which the others are compared in metres.
        has_lens: False if the job does not get the calibration.
        only: The only video of the folder that belongs to the capture; empty for all.
    """

    name: str
    source: Path
    truth: Path | None = None
    lens: Path | None = None
    arguments: tuple[str, ...] = ()
    reference: str | None = None
    has_lens: bool = True
    only: str = ""

    @property
    def folder(self) -> Path:
        """The folder of the videos."""
        return self.source if self.source.is_dir() else self.source.parent


def shared_captures(data: Path = DATA) -> list[BenchCapture]:
    """Return the shared captures that exist, with truth or without."""
    rows = [row_of(data / name) for name in (*SHARED, *_MORE_SHARED) if (data / name).is_dir()]
    out = [
        BenchCapture(
            name=row.name,
            source=row.capture,
            truth=row.truth,
            lens=row.capture / CALIBRATION,
            arguments=row.arguments or ("--skeleton", "none"),
            reference=row.reference,
        )
        for row in rows
    ]
    if (data / "gopro" / "karma.mp4").exists():
        karma = BenchCapture(name="karma", source=data / "gopro", only="karma.mp4")
        out.append(replace(karma, arguments=("--skeleton", "none")))
    return out


def without_lens(captures: Sequence[BenchCapture]) -> list[BenchCapture]:
    """Return the captures that have a calibration, with the calibration withheld."""
    return [
        replace(capture, name=capture.name + _WITHOUT_LENS, has_lens=False)
        for capture in captures
        if (capture.folder / CALIBRATION).exists() and capture.source.is_dir()
    ]


def folder_captures(root: Path, *, has_body: bool) -> list[BenchCapture]:
    """Return the captures in the folders of a folder: rebuilt real ones, or drawn ones.

    A job file other than job.yaml is another capture of the same videos.

    Args:
        root: Folder of the folders.
        has_body: True to solve the body's motion where several cameras are on one body (drawn captures).
    """
    out = []
    for folder in sorted(path for path in root.iterdir() if path.is_dir()):
        if not any(path.suffix.lower() in VIDEOS for path in folder.iterdir()):
            continue
        row = row_of(folder)
        calibration = folder / CALIBRATION
        capture = BenchCapture(
            name=folder.name,
            source=folder,
            truth=row.truth if _has_paths(row.truth) else None,
            lens=calibration if calibration.exists() else None,
            arguments=_body_arguments(folder, row.arguments) if has_body else ("--skeleton", "none"),
            reference=row.reference if has_body else None,
        )
        out.append(capture)
        for job in sorted(path for path in folder.glob("*.yaml") if path.name != "job.yaml"):
            out.append(replace(capture, name=f"{folder.name}:{job.stem}", source=job))
    return out


def all_captures(
    real: Path | None,
    drawn: Path | None,
    say: Callable[[str], None],
    data: Path = DATA,
) -> list[BenchCapture]:
    """Return all captures that exist; absent folders are said.

    Args:
        real: Folder of the real captures.
        drawn: Folder of the drawn captures.
        say: Receives a sentence about each folder that is absent.
        data: Folder of the shared captures.
    """
    out: list[BenchCapture] = []
    if data.is_dir():
        shared = shared_captures(data)
        out += [*shared, *without_lens(shared)]
    else:
        say(f"shared captures: {data} is absent, skipped")
    for what, folder, has_body in (("real", real, False), ("drawn", drawn, True)):
        if folder is None or not folder.is_dir():
            say(
                f"{what} captures: {folder or f'no --{what} DIR given'}{' is absent' * bool(folder)}, skipped"
            )
        else:
            out += folder_captures(folder.resolve(), has_body=has_body)
    return out


def chosen(captures: Sequence[BenchCapture], names: Sequence[str]) -> list[BenchCapture]:
    """Return the captures with these names, or all without names.

    Raises:
        SystemExit: A name is unknown.
    """
    known = {capture.name: capture for capture in captures}
    if unknown := sorted(set(names) - set(known)):
        raise SystemExit(f"no such capture: {', '.join(unknown)}; there are: {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names)] if names else list(captures)


def is_as_it_is(capture: BenchCapture) -> bool:
    """Return True if a job can read the folder of a capture itself: nothing of it is withheld."""
    return capture.has_lens and not capture.only


def lay_out(
    capture: BenchCapture, target: Path, video: Callable[[Path], Path], first: int
) -> tuple[Path, Path]:
    """Write the input of a job: links to the videos and to the files beside them.

    Args:
        capture: The capture.
        target: Folder of the input; it is created.
        video: Returns the file that replaces a video.
        first: Number of frames that the videos leave out at their start. The times of the others stay.

    Returns:
        The folder or job file for the command line, and the folder of the videos.
    """
    target.mkdir(parents=True, exist_ok=True)
    for file in sorted(capture.folder.iterdir()):
        new = target / file.name
        if new.is_symlink() or new.is_file():
            new.unlink()
        if file.suffix.lower() in VIDEOS:
            if not capture.only or file.name == capture.only:
                new.symlink_to(video(file).resolve())
                sidecar = target / (file.stem + TIMESTAMPS)
                if first and not (capture.folder / sidecar.name).exists():
                    _write_times(sidecar, video_times_s(file)[first:])
        elif file.name.endswith(TIMESTAMPS) and first:
            _write_times(new, _times(file)[first:])
        elif file.suffix == ".yaml":
            new.write_text(_with_absolute_paths(file, target), encoding="utf-8")
        elif file.name != CALIBRATION or capture.has_lens:
            new.symlink_to(file.resolve())
    if not capture.has_lens:
        _state_clocks(capture.folder / CALIBRATION, target)
    return target if capture.source.is_dir() else target / capture.source.name, target


def video_times_s(file: Path) -> list[str]:
    """Return the times of the pictures of a video in the order of time, seconds.

    A small start is the delay of an encoder, which the program does not count either.
    """
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        pts = sorted(packet.pts for packet in container.demux(stream) if packet.pts is not None)
        base, rate = stream.time_base or Fraction(1), stream.average_rate or Fraction(30)
    start = pts[0] if abs(pts[0] * base * rate) <= _MAX_DELAY_FRAMES else 0
    return [f"{float((value - start) * base):.9f}" for value in pts]


def _body_arguments(folder: Path, own: tuple[str, ...]) -> tuple[str, ...]:
    """Return the arguments for a capture whose job file may state the body."""
    return own if own or (folder / "job.yaml").exists() else ("--skeleton", "none")


def _has_paths(truth: Path) -> bool:
    return truth.is_file() or any(truth.glob("*.tum"))


def _write_times(file: Path, times_s: Sequence[str]) -> None:
    file.write_text("\n".join(times_s) + "\n", encoding="utf-8")


def _times(file: Path) -> list[str]:
    """Return the lines of a file of timestamps that have a time."""
    lines = [line.split("#", 1)[0].strip() for line in file.read_text(encoding="utf-8").splitlines()]
    return [line for line in lines if line]


def _with_absolute_paths(job: Path, target: Path) -> str:
    """Return the text of a job file in which videos of other folders have absolute paths."""
    content = yaml.safe_load(job.read_text(encoding="utf-8"))
    for camera in content.get("capture", {}).get("cameras", ()):
        if os.sep in str(camera.get("video", "")):
            camera["video"] = str((job.parent / camera["video"]).resolve())
    return str(yaml.safe_dump(content, sort_keys=False))


def _state_clocks(calibration: Path, target: Path) -> None:
    """Write a job file with what a withheld calibration states beside the lens: clocks and readout time."""
    stated = json.loads(calibration.read_text(encoding="utf-8"))
    offsets, readout = stated.get("offsets_s", {}), stated.get("rolling_shutter_s")
    if not offsets or (target / "job.yaml").exists():
        return
    cameras = []
    for name, offset in offsets.items():
        camera = {"name": name, "video": f"{name}.mp4", "offset_s": offset}
        cameras.append(camera if readout is None else {**camera, "rolling_shutter_s": readout})
    job = {"name": target.name, "capture": {"cameras_only": True, "cameras": cameras}}
    (target / "job.yaml").write_text(yaml.safe_dump(job, sort_keys=False), encoding="utf-8")
