"""The name and the time of a take, as editors need them: exact frame rate and start timecode."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

_RATE_TOLERANCE = 2e-6
"""Relative difference of a frame rate from a rate of television that counts as this rate. Derivation: rates
are written with three decimals at least, and 23.976 differs from 24000/1001 by 1.0e-6."""
_NTSC = Fraction(1000, 1001)
"""Ratio of the rates of television in North America and Japan to whole numbers. Source: SMPTE ST 12-1."""
_MAX_DENOMINATOR = 100_000
"""Largest denominator of other rates. Origin: rates have at most five decimals."""
_DROPPED_EACH_30 = 2
"""Number of frame numbers for each 30 frames per second that a drop-frame timecode omits at the start of each
minute, except each tenth. Source: SMPTE ST 12-1."""
_TIMECODE = re.compile(r"(\d\d):(\d\d):(\d\d)([:;.,])(\d\d\d?)")


def exact_rate(fps: float) -> Fraction:
    """Return a frame rate as a fraction: 29.97 and 29.97003 become 30000/1001."""
    for exact in (Fraction(round(fps)), round(fps / _NTSC) * _NTSC):
        if abs(float(exact) - fps) <= _RATE_TOLERANCE * fps:
            return exact
    return Fraction(fps).limit_denominator(_MAX_DENOMINATOR)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timecode:
    """A timecode: the number of a frame on a clock that counts frames from midnight.

    Attributes:
        frames: Number of frames since 00:00:00:00. It is less than the number of a day.
        rate: Frames per second. The timecode counts with the next whole number.
        drop_frame: True if frame numbers are omitted so that the timecode follows the time of day.
    """

    frames: int
    rate: Fraction
    drop_frame: bool = False

    @staticmethod
    def parse(text: str, rate: Fraction) -> Timecode | None:
        """Return the timecode of a text ``HH:MM:SS:FF``; None if it is not one. ``;`` means drop-frame.

        Args:
            text: The text.
            rate: Frames per second of the video that has the timecode.
        """
        match = _TIMECODE.fullmatch(text.strip())
        if match is None:
            return None
        hours, minutes, seconds, frames = (int(match.group(part)) for part in (1, 2, 3, 5))
        if hours > 23 or minutes > 59 or seconds > 59:
            return None
        code = Timecode(frames=0, rate=rate, drop_frame=match.group(4) != ":" and rate.denominator != 1)
        label = (hours * 60 + minutes) * 60 + seconds
        dropped = (hours * 60 + minutes - (hours * 60 + minutes) // 10) * code._dropped
        return replace(code, frames=label * code._counted_fps + frames - dropped)

    @property
    def _counted_fps(self) -> int:
        return max(1, round(self.rate))

    @property
    def _dropped(self) -> int:
        return _DROPPED_EACH_30 * (self._counted_fps // 30) if self.drop_frame else 0

    def later(self, seconds: float) -> Timecode:
        """Return the timecode of the frame that is nearest to a time after this frame, seconds."""
        minutes, tens = self._counted_fps * 60 - self._dropped, 9 * self._dropped
        day = 24 * 6 * (10 * self._counted_fps * 60 - tens) if self._dropped else 24 * 60 * minutes
        return replace(self, frames=(self.frames + round(seconds * self.rate)) % day)

    def at_rate(self, rate: Fraction) -> Timecode:
        """Return the timecode with the same hour, minute and second at another frame rate."""
        if rate == self.rate:
            return self
        hours, minutes, seconds, frames = self._parts()
        number = min(frames * max(1, round(rate)) // self._counted_fps, max(1, round(rate)) - 1)
        separator = ";" if self.drop_frame else ":"
        text = f"{hours:02d}:{minutes:02d}:{seconds:02d}{separator}{number:02d}"
        code = Timecode.parse(text, rate)
        assert code is not None
        return code

    def _parts(self) -> tuple[int, int, int, int]:
        """Return hours, minutes, seconds and the number of the frame in the second."""
        fps, number = self._counted_fps, self.frames
        if self._dropped:
            minute, ten = fps * 60 - self._dropped, fps * 600 - 9 * self._dropped
            tens, rest = divmod(number, ten)
            full = 0 if rest < fps * 60 else 1 + (rest - fps * 60) // minute
            number += self._dropped * (9 * tens + full)
        seconds, frames = divmod(number, fps)
        return seconds // 3600 % 24, seconds // 60 % 60, seconds % 60, frames

    def __str__(self) -> str:
        hours, minutes, seconds, frames = self._parts()
        separator = ";" if self.drop_frame else ":"
        return f"{hours:02d}:{minutes:02d}:{seconds:02d}{separator}{frames:02d}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """The name and the time of the frames of a take.

    Attributes:
        name: Name of the take; "" if it is unknown.
        rate: Frames per second.
        start_ns: Common time of frame 0, nanoseconds.
        timecode: Timecode of frame 0; None if no camera has one.
    """

    name: str
    rate: Fraction
    start_ns: int
    timecode: Timecode | None = None

    @property
    def fps(self) -> float:
        """Frames per second."""
        return float(self.rate)

    def figures(self) -> dict[str, Any]:
        """Return the name and the time as plain JSON values. Unknown values are left out."""
        out: dict[str, Any] = {"take": self.name} if self.name else {}
        out |= {"rate": str(self.rate), "fps": self.fps, "start_s": self.start_ns / 1e9}
        return out if self.timecode is None else {**out, "start_timecode": str(self.timecode)}
