"""Telemetry of GoPro cameras: the GPMF track of an MP4 file.

Source: the GPMF key-length-value format and its list of streams, published by GoPro.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from bodycap_batch.capture.video import open_container
from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.formats.gpmf import (
    Damage,
    GpmfItem,
    gopro_lens_mode,
    gopro_model,
    gopro_settings,
    gopro_stabilisation,
    read_items,
)
from bodycap_batch.model.gravity import STANDARD_GRAVITY_M_S2
from bodycap_batch.telemetry.stream_clock import MAX_SAMPLES, Payload, StreamClock, fit_stream_clock
from bodycap_batch.telemetry.streams import (
    ACCELEROMETER,
    CAMERA_ORIENTATION,
    EXPOSURE,
    GRAVITY,
    GYROSCOPE,
    IMAGE_ORIENTATION,
    MAGNETOMETER,
    READOUT,
    CameraTelemetry,
    GpsTrack,
    Stream,
    gaps_of,
)

_STREAMS = {
    ACCELEROMETER: (3, "m/s²"),
    GYROSCOPE: (3, "rad/s"),
    MAGNETOMETER: (3, "µT"),
    GRAVITY: (3, "1"),
    CAMERA_ORIENTATION: (4, "1"),
    IMAGE_ORIENTATION: (4, "1"),
    EXPOSURE: (1, "s"),
    READOUT: (1, "s"),
    "ISOE": (1, "ISO"),
    "ISOG": (1, "1"),
    "WBAL": (1, "K"),
    "YAVG": (1, "1"),
}
"""Number of values of a sample, and unit, of each stream that is read. A magnetometer may have a fourth
value, which is not used. Source: GoPro's list of streams."""
_GPS = {"GPS5": 5, "GPS9": 9}
"""Number of values of a sample of each GPS stream."""
_PROPERTIES = frozenset(
    (
        *("STMP", "TSMP", "TICK", "TOCK", "STNM", "SIUN", "UNIT", "SCAL", "TYPE", "MTRX", "ORIN", "ORIO"),
        *("TMPC", "EMPT", "GPSU", "GPSF", "GPSP", "GPSA", "VPTS", "TIMO", "STPS", "FWVS", "RMRK", "VERS"),
        *("LRVO", "LRVS"),
    )
)
"""Keys of items that describe the samples of their stream."""
_VECTORS = (ACCELEROMETER, GYROSCOPE, MAGNETOMETER)
_INERTIAL = (*_VECTORS, GRAVITY)
_UNIT_FACTORS = {
    (ACCELEROMETER, "g"): STANDARD_GRAVITY_M_S2,
    (GYROSCOPE, "deg/s"): math.pi / 180.0,
    (READOUT, ""): 1e-3,
    (READOUT, "ms"): 1e-3,
}
"""Factor to the unit of `_STREAMS` for values in another unit. A readout time is in milliseconds."""
_CAM_FROM_GOPRO = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""Rotation from GoPro's axes (x left, y back, z up) to OpenCV's axes (x right, y down, z forward). Evidence:
docs/decisions/telemetry.md."""
_CAM_FROM_GRAVITY = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation and sign from the gravity stream to the direction upwards in OpenCV's axes. Evidence:
docs/decisions/telemetry.md."""
_OLD_AXES = (("FUSION", "yXZ"), ("HERO5", "ZXY"), ("HERO6", "YxZ"), ("HERO7", "YxZ"))
"""Axes of the stored values of cameras whose files do not state them, by start of the model. A small letter
is the negative axis. Source: GoPro's list of streams."""
_ZXY_NAMES = ("(z,x,y)", "(up/down, right/left, forward/back)")
"""Ends of the names of streams that name the axes z, x, y, of files that name neither model nor axes."""
_MIN_IMU_PER_FRAME = 1.5
"""Minimum number of gyroscope samples per frame. With fewer samples, they are means over a timelapse
interval.
Origin: inertial sensors of cameras give 100 to 800 samples per second."""
_MAX_DAYS = 36_525
"""Maximum number of days since the year 2000 of a plausible GPS time: a hundred years."""
_MIN_FIX = 2
"""Minimum kind of a GPS fix whose time is right: 2 is a fix without altitude. Without a fix, the receiver
gives the time of its own clock, which may be years wrong."""
_MAX_OTHER = 500
"""Maximum number of streams that are listed although they are not read. Real files have some twenty."""
_HANDLER = "GoPro MET"
_GYROFLOW_COMMENT, _GYROFLOW_SUFFIX = "Original filename: ", "_stabilized"
"""Start of the comment in a file that Gyroflow wrote, and end of the name that it proposes."""


@dataclass(slots=True)
class _RawStream:
    """A stream while its payloads are collected."""

    key: str
    name: str = ""
    unit: str = ""
    axes: str = ""
    payloads: list[Payload] = field(default_factory=list)
    parts: list[FloatArray] = field(default_factory=list)
    fixes: list[tuple[int, float, str]] = field(default_factory=list)
    count: int = 0


@dataclass(slots=True)
class GpmfTrack:
    """The GPMF track of one file, with times in this file.

    Attributes:
        device: Name of the camera in the track; "" if it is missing.
        streams: The streams of the camera.
        other: Number of samples of each stream that is not read, by key and name.
        damage: The damage that was found.
    """

    device: str = ""
    streams: dict[str, _RawStream] = field(default_factory=dict)
    other: dict[str, int] = field(default_factory=dict)
    damage: Damage = field(default_factory=Damage)
    _device_id: float | None = None
    _last_s: float = -math.inf

    def add(self, data: bytes, time_s: float, duration_s: float) -> None:
        """Add one payload.

        Args:
            data: The payload.
            time_s: Its time in the file, seconds.
            duration_s: Its duration, seconds.
        """
        if not (math.isfinite(time_s) and math.isfinite(duration_s) and time_s > self._last_s):
            self.damage.add("the times of the telemetry run backwards; a payload is not used")
            return
        self._last_s = time_s
        for device in read_items(data, self.damage):
            if device.key != "DEVC":
                self.damage.add("a part of the telemetry belongs to no device and is not used")
                continue
            self._add_device(device, time_s, duration_s)

    def _add_device(self, device: GpmfItem, time_s: float, duration_s: float) -> None:
        name = device.child("DVNM")
        number = _number(device.child("DVID"))
        if self._device_id is None:
            self._device_id, self.device = number, name.text() if name else ""
        is_camera = number == self._device_id
        for stream in device.children:
            if stream.key != "STRM":
                continue
            if is_camera:
                self._add_stream(stream, time_s, duration_s)
            else:
                self._count_other(stream, name.text() if name else "")

    def _count_other(self, stream: GpmfItem, device: str = "") -> None:
        label = stream.child("STNM")
        for item in stream.children:
            if item.key not in _PROPERTIES:
                name = " ".join(part for part in (item.key, label.text() if label else "") if part)
                name = f"{name} ({device})" if device else name
                if name in self.other or len(self.other) < _MAX_OTHER:
                    self.other[name] = self.other.get(name, 0) + item.count

    def _add_stream(self, stream: GpmfItem, time_s: float, duration_s: float) -> None:
        data = next((item for item in stream.children if item.key in _STREAMS or item.key in _GPS), None)
        if data is None:
            self._count_other(stream)
            return
        values = self._scaled_values(stream, data)
        if values is None or not len(values):
            return
        raw = self.streams.setdefault(data.key, _RawStream(data.key))
        if raw.count + len(values) > MAX_SAMPLES:
            self.damage.add(f"the stream {data.key} is too long; its end is not used")
            return
        name, unit, axes = (stream.child(key) for key in ("STNM", "SIUN", "ORIN"))
        raw.name, raw.unit = name.text() if name else "", unit.text() if unit else ""
        raw.axes = axes.text() if axes else ""
        raw.parts.append(values)
        raw.count += len(values)
        raw.fixes.append(_gps_fix(stream))
        raw.payloads.append(
            Payload(
                time_s=time_s,
                duration_s=duration_s,
                count=len(values),
                stamp_s=_stamp_s(stream),
                total=_whole(_number(stream.child("TSMP"))),
            )
        )

    def _scaled_values(self, stream: GpmfItem, data: GpmfItem) -> FloatArray | None:
        """Return the samples (N,C) divided by their scale; None if they cannot be used."""
        columns = _GPS.get(data.key) or _STREAMS[data.key][0]
        types = stream.child("TYPE")
        values = data.values(types.text() if types else "")
        if values is None or values.shape[1] < columns:
            if data.count:
                self.damage.add(f"samples of the stream {data.key} have a wrong type or size")
            return None
        values = values[:, :columns]
        scale_item = stream.child("SCAL")
        scale = None if scale_item is None else scale_item.values()
        if scale is not None and scale.size:
            scale = scale.ravel()
            divisor = scale[:columns] if len(scale) >= columns else np.full(columns, scale[0])
            if not np.isfinite(divisor).all() or (divisor == 0).any():
                self.damage.add(f"the scale of the stream {data.key} is not a number")
                return None
            with np.errstate(over="ignore"):
                values = values / divisor
        finite: BoolArray = np.asarray(np.isfinite(values).all(axis=1))
        if not finite.all():
            self.damage.add(f"samples of the stream {data.key} are not numbers")
            if not finite.any():
                return None
            values = np.where(finite[:, None], values, values[np.argmax(finite)])
        return values


def _number(item: GpmfItem | None) -> float | None:
    """Return the first number of an item; None without one."""
    values = None if item is None else item.values()
    return None if values is None or not values.size else float(values.flat[0])


def _whole(value: float | None) -> int | None:
    return int(value) if value is not None and 0 <= value < 2**53 else None


def _stamp_s(stream: GpmfItem) -> float | None:
    """Return the stamp of a payload: STMP in microseconds, else TICK in milliseconds, as seconds."""
    stamp, tick = _number(stream.child("STMP")), _number(stream.child("TICK"))
    if stamp is not None:
        return stamp * 1e-6
    return None if not tick else tick * 1e-3


def _gps_fix(stream: GpmfItem) -> tuple[int, float, str]:
    """Return kind of the fix, dilution of precision and UTC time of a payload of GPS5."""
    fix, dilution, time = _number(stream.child("GPSF")), _number(stream.child("GPSP")), stream.child("GPSU")
    return (
        -1 if fix is None or not 0 <= fix <= 3 else int(fix),
        math.nan if dilution is None else dilution / 100.0,
        "" if time is None else time.text(),
    )


def read_gpmf_payloads(payloads: Iterable[tuple[bytes, float, float]]) -> GpmfTrack:
    """Read a GPMF track.

    Args:
        payloads: The payloads in the order of the file: bytes, time in the file and duration, seconds.
    """
    track = GpmfTrack()
    for data, time_s, duration_s in payloads:
        track.add(data, time_s, duration_s)
    return track


def gpmf_payloads(path: Path) -> Iterator[tuple[bytes, float, float]]:
    """Yield the payloads of the GPMF track of an MP4 file: bytes, time in the file and duration, seconds.

    Raises:
        CaptureError: The file cannot be opened.
    """
    import av

    with open_container(path) as container:
        named = [each for each in container.streams.data if _HANDLER in each.metadata.get("handler_name", "")]
        candidates = named or list(container.streams.data)
        chosen = named[0].index if len(named) == 1 else -1
        if not candidates:
            return
        try:
            for packet in container.demux(candidates):
                if not packet.size or packet.pts is None or packet.time_base is None:
                    continue
                data = bytes(packet)
                if chosen < 0 and data.startswith(b"DEVC"):  # of several tracks, the first with telemetry
                    chosen = packet.stream.index
                if packet.stream.index == chosen:
                    base = packet.time_base
                    yield data, float(packet.pts * base), float((packet.duration or 0) * base)
        except av.error.FFmpegError:
            return


def has_telemetry_track(path: Path) -> bool:
    """Return True if a video has a track that GoPro cameras write their telemetry to.

    Raises:
        CaptureError: The file cannot be opened.
    """
    with open_container(path) as container:
        return any(_HANDLER in each.metadata.get("handler_name", "") for each in container.streams.data)


def has_picture_orientations(path: Path) -> bool:
    """Return True if a video records how the camera turned its pictures.

    Raises:
        CaptureError: The file cannot be opened.
    """
    first = next(gpmf_payloads(path), None)
    return first is not None and IMAGE_ORIENTATION in read_gpmf_payloads([first]).streams


def gyroflow_original(path: Path) -> str | None:
    """Return the name of the file from which the program Gyroflow made a stabilised video; None otherwise.

    Gyroflow names the original file in the comment, and adds a suffix to the name of its file. The result is
    "" if only the suffix is there.

    Source: the program's public code (``render_queue.rs``).

    Raises:
        CaptureError: The file cannot be opened.
    """
    with open_container(path) as container:
        comment = str(container.metadata.get("comment", ""))
    if comment.startswith(_GYROFLOW_COMMENT):
        return comment.removeprefix(_GYROFLOW_COMMENT).splitlines()[0].strip()
    return "" if path.stem.endswith(_GYROFLOW_SUFFIX) else None


def states_stabilisation(path: Path) -> bool:
    """Return whether a video states that it is stabilised, by the camera or by Gyroflow.

    Raises:
        CaptureError: The file cannot be opened.
    """
    return gopro_stabilisation(gopro_settings(path)) not in {"", "off"} or gyroflow_original(path) is not None


def gopro_telemetry(
    track: GpmfTrack, settings: Mapping[str, str], firmware: str, frame_rate_hz: float
) -> CameraTelemetry:
    """Return the telemetry of a track, with times in the file.

    Args:
        track: The track.
        settings: The settings of the file, from `gopro_settings`.
        firmware: Name of the firmware in the container; "" if it is not given.
        frame_rate_hz: Nominal frame rate of the video; 0 if it is unknown.
    """
    firmware = settings.get("FMWR", firmware)
    model = gopro_model(settings, firmware, track.device)
    notes: list[str] = []
    streams: dict[str, Stream] = {}
    gps: list[tuple[str, GpsTrack]] = []
    axes_known, is_timelapse = True, False
    for key, raw in track.streams.items():
        clock = fit_stream_clock(raw.payloads)
        if clock is None:
            track.damage.add(f"the times of the stream {key} cannot be determined")
            continue
        notes += [note for note in clock.notes if note not in notes]
        if clock.is_timelapse or (
            key == GYROSCOPE and 0 < clock.rate_hz < _MIN_IMU_PER_FRAME * frame_rate_hz
        ):
            is_timelapse = True
        times_s = clock.times_s([payload.count for payload in raw.payloads])
        usable = _increasing(times_s)
        if key in _GPS:
            gps.append((key, _gps_track(raw, times_s, usable)))
            continue
        rotation = cam_from_stored(raw, model)
        axes_known &= rotation is not None or key not in (ACCELEROMETER, GYROSCOPE)
        streams[key] = _stream(raw, clock, times_s[usable], _in_camera_frame(raw, rotation)[usable])
    if is_timelapse:
        notes.append(
            "the recording is a timelapse or slow motion: the inertial samples are not used, because "
            "they are means over other times"
        )
        streams = {key: stream for key, stream in streams.items() if key not in _INERTIAL}
    return CameraTelemetry(
        source="GPMF" if track.streams or track.other else "none",
        model=model,
        firmware=firmware,
        lens_mode=gopro_lens_mode(settings),
        stabilisation=gopro_stabilisation(settings),
        settings=dict(settings),
        streams=streams,
        gps=max(gps, key=lambda item: item[0])[1] if gps else None,
        other_streams=dict(track.other),
        axes_known=axes_known,
        is_timelapse=is_timelapse,
        notes=(*notes, *track.damage.notes()),
    )


def read_gopro_file(path: Path, frame_rate_hz: float) -> CameraTelemetry:
    """Return the telemetry of one GoPro file, with times in the file.

    Args:
        path: Path of the file.
        frame_rate_hz: Nominal frame rate of the video; 0 if it is unknown.

    Raises:
        CaptureError: The file cannot be opened.
    """
    with open_container(path) as container:
        firmware = str(container.metadata.get("firmware", ""))
    track = read_gpmf_payloads(gpmf_payloads(path))
    telemetry = gopro_telemetry(track, gopro_settings(path), firmware, frame_rate_hz)
    if gyroflow_original(path) is None:
        return telemetry
    # The record, if there is one, is that of the camera, and Gyroflow turned the pictures once more.
    streams = {key: stream for key, stream in telemetry.streams.items() if key != IMAGE_ORIENTATION}
    return replace(telemetry, stabilisation="Gyroflow", streams=streams)


def gps_time_s(telemetry: CameraTelemetry, at_s: float) -> float | None:
    """Return the Unix time of an instant according to the GPS receiver; None without a fix.

    Args:
        telemetry: The telemetry of one file.
        at_s: Time of the instant in the file, seconds.
    """
    gps = telemetry.gps
    if gps is None or not len(gps.fix) or gps.fix[0] < _MIN_FIX or not gps.start_utc:
        return None
    return datetime.fromisoformat(gps.start_utc).timestamp() + at_s - float(gps.times_s[0])


def cam_from_stored(raw: _RawStream, model: str) -> FloatArray | None:
    """Return the signed permutation (3,3) from the stored values of a stream to the nominal camera frame.

    The file states the axes (ORIN), or they are known for the model. Otherwise the result is None.
    """
    axes = raw.axes
    if sorted(axes.upper()) != ["X", "Y", "Z"]:
        name = re.sub(r"[^A-Z0-9]", "", model.upper()).removeprefix("GOPRO")
        named = "ZXY" if raw.name.endswith(_ZXY_NAMES) else ""
        axes = next((known for start, known in _OLD_AXES if name.startswith(start)), named)
        if not axes:
            return None
    gopro_from_stored = np.zeros((3, 3))
    for column, letter in enumerate(axes):
        gopro_from_stored["XYZ".index(letter.upper()), column] = 1.0 if letter.isupper() else -1.0
    return np.asarray(_CAM_FROM_GOPRO @ gopro_from_stored)


def _in_camera_frame(raw: _RawStream, rotation: FloatArray | None) -> FloatArray:
    """Return the values of a stream in its unit and, for vectors, in the nominal camera frame."""
    values = np.concatenate(raw.parts) * _UNIT_FACTORS.get((raw.key, raw.unit), 1.0)
    if raw.key in _VECTORS and rotation is not None:
        return np.asarray(values @ rotation.T)
    if raw.key == GRAVITY:
        return np.asarray(values @ _CAM_FROM_GRAVITY.T)
    return values


def _stream(raw: _RawStream, clock: StreamClock, times_s: FloatArray, values: FloatArray) -> Stream:
    return Stream(
        key=raw.key,
        name=raw.name,
        unit=_STREAMS[raw.key][1],
        times_s=times_s,
        values=values,
        rate_hz=clock.rate_hz,
        gaps_s=gaps_of(raw.key, times_s, values, clock.rate_hz),
    )


def _increasing(times_s: FloatArray) -> BoolArray:
    """Return a mask (N,) of the samples that are later than all samples before them."""
    latest = np.maximum.accumulate(times_s)
    return np.concatenate([[True], times_s[1:] > latest[:-1]])[: len(times_s)]


def _gps_track(raw: _RawStream, times_s: FloatArray, usable: BoolArray) -> GpsTrack:
    """Return the positions of a stream GPS5 or GPS9."""
    values = np.concatenate(raw.parts)
    counts = [payload.count for payload in raw.payloads]
    if values.shape[1] == 9:
        fix, dilution = np.clip(values[:, 8], -1, 3), values[:, 7]
        start_utc = _utc_of_days(float(values[0, 5]), float(values[0, 6]))
    else:
        fix = np.repeat([float(each[0]) for each in raw.fixes], counts)
        dilution = np.repeat([each[1] for each in raw.fixes], counts)
        start_utc = _iso_time(raw.fixes[0][2])
    return GpsTrack(
        times_s=times_s[usable],
        latitude_longitude_deg=values[usable, :2],
        altitude_m=values[usable, 2],
        speed_m_s=values[usable, 3:5],
        fix=fix[usable].astype(np.int64),
        dilution=dilution[usable],
        start_utc=start_utc,
    )


def _iso_time(text: str) -> str:
    """Return a time such as ``191118234514.000`` as ISO 8601; "" for any other text."""
    match = re.fullmatch(r"(\d\d)(\d\d)(\d\d)(\d\d)(\d\d)(\d\d(?:\.\d+)?)", text)
    if match is None:
        return ""
    year, month, day, hour, minute, second = match.groups()
    return f"20{year}-{month}-{day}T{hour}:{minute}:{second}Z"


def _utc_of_days(days: float, seconds: float) -> str:
    """Return a time of GPS9, days since the year 2000 and seconds of the day, as ISO 8601.

    An implausible time gives "".
    """
    if not (0 <= days < _MAX_DAYS and 0 <= seconds < 86_401):
        return ""
    moment = datetime(2000, 1, 1, tzinfo=UTC) + timedelta(days=int(days), seconds=seconds)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
