"""`bodycap telemetry`."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.shared_options import JsonOption
from bodycap_batch.cli.terminal import print_json, print_lines

if TYPE_CHECKING:
    from bodycap_batch.telemetry import CameraTelemetry, GpsTrack, PictureGyroComparison, Stream

_MAX_LISTED_GAPS = 5
"""Maximum number of gaps that the text lists for each stream."""
_WIDTH = 110
"""Maximum number of characters of a line of text that is wrapped."""
_FACTS = (
    "source", "model", "firmware", "lens_mode", "stabilisation", "is_timelapse", "axes_known",
)  # fmt: skip
"""Attributes of the telemetry that the JSON output holds as they are."""


@app.command()
def telemetry(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A video, or a folder with the chapters of one camera."),
    ],
    as_json: JsonOption = False,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE.svg", help="Draw the streams along time.")
    ] = None,
    with_comparison: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Compare the gyroscope with the pictures: delay, rotation, bias, stabilisation. Takes some "
            "seconds.",
        ),
    ] = False,
) -> None:
    """Show what a camera recorded beside pictures and sound.

    Lists the streams of inertial sensors, exposure, gravity and GPS with their rates, ranges and gaps, and
    the model, the lens mode and the stabilisation that the file states. A file <camera>.imu.csv or
    <camera>.gcsv beside the video is read, too.

    \b
    Examples:
      bodycap telemetry GX010123.MP4 --picture streams.svg
      bodycap telemetry GX010123.MP4 --compare
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.capture.frame_index import index_videos
    from bodycap_batch.capture.timeline import join_chapters
    from bodycap_batch.cli.pictures import draw_telemetry
    from bodycap_batch.config.folder import chapters_in
    from bodycap_batch.config.sample_files import samples_beside
    from bodycap_batch.formats.atomic_files import write_text
    from bodycap_batch.telemetry import read_telemetry

    paths = chapters_in(file) if file.is_dir() else (file,)
    videos = index_videos(paths)
    times_ns = join_chapters(videos, ()).times_ns
    found = read_telemetry(videos, times_ns, samples_beside(paths, file.stem, (file,)))
    if picture is not None:
        write_text(picture, draw_telemetry(found))
    compared = _compared(paths, file.stem, found) if with_comparison else None
    if as_json:
        print_json(telemetry_as_json(found, compared), indent=1)
    else:
        print_lines(lines_of(found, file.name))
        print_lines([] if compared is None else comparison_lines(compared))


def _compared(paths: tuple[Path, ...], name: str, found: CameraTelemetry) -> PictureGyroComparison:
    """Compare the gyroscope with the pictures of the videos."""
    from bodycap_batch.capture import open_camera
    from bodycap_batch.config.models import CameraConfig, CaptureConfig
    from bodycap_batch.telemetry import compare_picture_and_gyro
    from bodycap_batch.telemetry.picture_rotation import WORK_PX

    config = CameraConfig(name=name[:64], video=paths, calibration="auto")
    spec = CaptureConfig(cameras=(config,), work_px=WORK_PX)
    return compare_picture_and_gyro(open_camera(spec, config), found)


def comparison_lines(compared: PictureGyroComparison) -> Iterator[str]:
    """Yield the comparison of the gyroscope with the pictures as text for the user."""
    yield from textwrap.wrap(f"pictures: {compared.reason}", _WIDTH, subsequent_indent="  ")
    fit = compared.best
    if fit is None:
        return
    chord = float(np.linalg.norm(fit.cam_from_sensor - np.eye(3)))
    turned = 2.0 * math.degrees(math.asin(min(1.0, chord / math.sqrt(8.0))))
    bias = " ".join(f"{value:+.4f}" for value in fit.bias_rad_s)
    yield f"  delay {1e3 * fit.delay_s:+.1f} ms ± {1e3 * fit.delay_sigma_s:.1f} (sample = frame + delay)"
    yield (
        f"  sensor turned by {turned:.1f}° against the stated axes (± "
        f"{np.degrees(np.linalg.norm(fit.rotation_sigma_rad)):.1f}°); bias {bias} rad/s"
    )
    yield f"  focal length {fit.focal_ratio:.2f} of the assumed one, from {fit.pairs} pairs of frames"


def _comparison_as_json(compared: PictureGyroComparison) -> dict[str, Any]:
    fits = {
        name: fit and {key: np.asarray(value).tolist() for key, value in asdict(fit).items()}
        for name, fit in (("fit", compared.fit), ("undone", compared.undone))
    }
    return {"verdict": compared.verdict, "reason": compared.reason, **fits}


def telemetry_as_json(
    found: CameraTelemetry, compared: PictureGyroComparison | None = None
) -> dict[str, Any]:
    """Return the telemetry as plain JSON values, with statistics instead of samples."""
    return {
        **{key: getattr(found, key) for key in _FACTS},
        "streams": {key: _statistics(stream) for key, stream in found.streams.items()},
        "gps": None if found.gps is None else _gps_statistics(found.gps),
        "other_streams": dict(found.other_streams),
        "settings": dict(found.settings),
        "notes": list(found.notes),
        "comparison": None if compared is None else _comparison_as_json(compared),
    }


def _statistics(stream: Stream) -> dict[str, Any]:
    return {
        "name": stream.name,
        "unit": stream.unit,
        "samples": len(stream.times_s),
        "rate_hz": round(stream.rate_hz, 4),
        "start_s": round(float(stream.times_s[0]), 6),
        "end_s": round(float(stream.times_s[-1]), 6),
        "least": _rounded(stream.values.min(axis=0)),
        "mean": _rounded(stream.values.mean(axis=0)),
        "largest": _rounded(stream.values.max(axis=0)),
        "gaps_s": [[round(start, 4), round(end, 4)] for start, end in stream.gaps_s],
    }


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.6g}") for value in np.asarray(values).tolist()]


def _gps_statistics(gps: GpsTrack) -> dict[str, Any]:
    has_fix = gps.fix != 0
    used = has_fix if has_fix.any() else ~has_fix
    return {
        "samples": len(gps.times_s),
        "share_with_fix": round(float(has_fix.mean()), 4),
        "start_utc": gps.start_utc,
        "start_s": round(float(gps.times_s[0]), 4),
        "end_s": round(float(gps.times_s[-1]), 4),
        "latitude_longitude_deg": [round(value, 7) for value in gps.latitude_longitude_deg[used][0].tolist()],
        "altitude_m": _rounded([gps.altitude_m[used].min(), gps.altitude_m[used].max()]),
        "largest_speed_m_s": float(f"{gps.speed_m_s[used].max():.4g}"),
    }


def lines_of(found: CameraTelemetry, name: str) -> Iterator[str]:
    """Yield the telemetry as text for the user.

    Args:
        found: The telemetry.
        name: Name of the video or folder.
    """
    facts = {"firmware": found.firmware, "lens mode": found.lens_mode, "stabilisation": found.stabilisation}
    stated = (f"{fact} {value}" for fact, value in facts.items() if value)
    yield f"{name}: {', '.join((found.model or 'camera model unknown', *stated))}"
    if found.source == "none":
        yield "no telemetry: neither in the video nor in a file <camera>.imu.csv or <camera>.gcsv beside it"
        return
    yield f"telemetry: {found.source}"
    yield from _table(found)
    if found.gps is not None:
        figures = _gps_statistics(found.gps)
        when = f", from {figures['start_utc']}" if figures["start_utc"] else ""
        yield (
            f"GPS: {figures['samples']} positions, {100 * figures['share_with_fix']:.0f} % with a fix{when}, "
            f"up to {figures['largest_speed_m_s']:g} m/s"
        )
    if found.other_streams:
        others = ", ".join(dict.fromkeys(label.split(" ")[0] for label in found.other_streams))
        yield from textwrap.wrap(f"further streams, not read: {others}", _WIDTH, subsequent_indent="  ")
    if not found.axes_known and found.gyro is not None:
        yield "note: the axes of the sensors are unknown"
    for note in found.notes:
        yield from textwrap.wrap(f"note: {note}", _WIDTH, subsequent_indent="  ")


def _table(found: CameraTelemetry) -> Iterator[str]:
    """Yield a line for each stream, and a line for its gaps."""
    if not found.streams:
        return
    yield f"{'stream':6}  {'samples':>8}  {'per second':>10}  {'from':>8}  {'to':>8}  range"
    for key, stream in found.streams.items():
        low, high = float(stream.values.min()), float(stream.values.max())
        unit = "" if stream.unit == "1" else f" {stream.unit}"
        yield (
            f"{key:6}  {len(stream.times_s):8}  {stream.rate_hz:10.3f}  {stream.times_s[0]:8.3f}  "
            f"{stream.times_s[-1]:8.3f}  {low:.4g} to {high:.4g}{unit}  {stream.name}".rstrip()
        )
        if stream.gaps_s:
            shown = ", ".join(f"{start:.3f} to {end:.3f}" for start, end in stream.gaps_s[:_MAX_LISTED_GAPS])
            more = len(stream.gaps_s) - _MAX_LISTED_GAPS
            yield f"        gaps (s): {shown}{f' and {more} more' if more > 0 else ''}"
