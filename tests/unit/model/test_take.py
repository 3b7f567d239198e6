"""Exact frame rates and timecodes."""

from __future__ import annotations

from fractions import Fraction

import pytest

from bodycap_batch.model.take import Take, Timecode, exact_rate

NTSC = Fraction(30000, 1001)


@pytest.mark.parametrize(
    ("fps", "text"),
    [
        (30.0, "30"),
        (29.97, "30000/1001"),
        (30000 / 1001, "30000/1001"),
        (23.976, "24000/1001"),
        (59.94, "60000/1001"),
        (119.88, "120000/1001"),
        (25.0, "25"),
        (12.5, "25/2"),
        (29.98, "1499/50"),  # measured by a phone: neither 30 nor 29.97
        (240.0, "240"),
    ],
)
def test_rates_of_television_are_exact(fps: float, text: str) -> None:
    assert str(exact_rate(fps)) == text


def parsed(text: str, rate: Fraction) -> Timecode:
    code = Timecode.parse(text, rate)
    assert code is not None
    return code


@pytest.mark.parametrize("text", ["00:00:00:00", "10:00:00:29", "23:59:59:24", "01:10:00;00", "00:01:00;02"])
@pytest.mark.parametrize("rate", [Fraction(30), NTSC])
def test_a_timecode_is_written_as_it_was_read(text: str, rate: Fraction) -> None:
    expected = text.replace(";", ":") if rate == 30 else text
    assert str(parsed(text, rate)) == expected


@pytest.mark.parametrize("text", ["", "10:00", "24:00:00:00", "10:61:00:00", "later", "10:00:00:1"])
def test_other_texts_are_no_timecode(text: str) -> None:
    assert Timecode.parse(text, NTSC) is None


def test_drop_frame_numbers_leave_out_two_at_each_minute_but_the_tenth() -> None:
    """SMPTE ST 12-1: 00:00:59;29 is followed by 00:01:00;02, and 00:09:59;29 by 00:10:00;00."""
    frame_s = float(1 / NTSC)
    assert str(parsed("00:00:59;29", NTSC).later(frame_s)) == "00:01:00;02"
    assert str(parsed("00:09:59;29", NTSC).later(frame_s)) == "00:10:00;00"
    assert str(parsed("00:00:59:29", NTSC).later(frame_s)) == "00:01:00:00"
    # After an hour of real time, a drop-frame timecode has counted an hour, and another one 3.6 s less.
    assert str(parsed("00:00:00;00", NTSC).later(3600.0)) == "01:00:00;00"
    assert str(parsed("00:00:00:00", NTSC).later(3600.0)) == "00:59:56:12"


@pytest.mark.parametrize("text", ["23:59:59:29", "23:59:59;29"])
def test_midnight_begins_at_zero(text: str) -> None:
    code = parsed(text, NTSC)
    assert str(code.later(float(1 / NTSC))).replace(";", ":") == "00:00:00:00"
    assert str(code.later(float(1 / NTSC)).later(-float(1 / NTSC))) == text


def test_another_rate_keeps_the_second() -> None:
    assert str(parsed("10:20:30:15", Fraction(30)).at_rate(Fraction(60))) == "10:20:30:30"
    assert str(parsed("10:20:30:59", Fraction(60)).at_rate(Fraction(24))) == "10:20:30:23"


def test_a_take_states_only_what_is_known() -> None:
    take = Take(name="", rate=NTSC, start_ns=1_500_000_000)
    assert take.figures() == {"rate": "30000/1001", "fps": 30000 / 1001, "start_s": 1.5}
