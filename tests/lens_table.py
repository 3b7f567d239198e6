"""The table of lens profiles of the package: ``python -m tests.lens_table PROFILES.jsonl``.

The input has one profile on each line, drawn from the collection of lens profiles of Gyroflow (CC0). Profiles
with an RMS error above 2 px, and profiles that no camera has, are left out.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import sys
from pathlib import Path
from typing import Any

TABLE = Path(__file__).resolve().parent.parent / "bodycap_batch" / "presets" / "lenses" / "profiles.json.gz"
SOURCE = "Gyroflow lens profiles, https://github.com/gyroflow/lens_profiles, CC0"
COLUMNS = (
    *("brand", "model", "lens", "setting", "width", "height", "fps"),
    *("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    *("rms_px", "official", "stabilised", "anamorphic", "readout_ms", "sizes"),
)
MAX_RMS_PX = 2.0
MAX_READOUT_MS = 40.0
MAX_SHAPE_DIFFERENCE = 0.004
MAX_ASPECT_DIFFERENCE = 0.05
"""Largest difference of the two focal lengths of a lens that is not anamorphic."""


def row(profile: dict[str, Any]) -> list[Any] | None:
    """Return the row of one profile; None if it is left out."""
    width, height = profile["calib"]["w"], profile["calib"]["h"]
    (fx, _, cx), (_, fy, cy) = profile["K"][:2]
    numbers = [fx, fy, cx, cy, *profile["D"], profile["rms"]]
    if not all(map(math.isfinite, numbers)) or not 0 < profile["rms"] <= MAX_RMS_PX:
        return None
    if not all(0.1 * width < focal < 10 * width for focal in (fx, fy)):
        return None
    if not (0.25 * width < cx < 0.75 * width and 0.25 * height < cy < 0.75 * height):
        return None
    words = " ".join(str(profile.get(key) or "") for key in ("model", "lens", "setting", "file"))
    stretch = profile.get("stretch") or 1.0
    anamorphic = (
        re.search("an[ao]mor", words, re.IGNORECASE) is not None
        or abs(stretch - 1.0) > 0.01
        or abs(fx / fy - 1.0) > MAX_ASPECT_DIFFERENCE
    )
    stabilised = re.search(r"(?<!NO-)\bEIS\b|HLevel|HS Boost|RockSteady|(?<!no )Steady", profile["file"])
    readout = profile.get("readout_ms") or 0.0
    sizes = {
        (int(each["width"]), int(each["height"]))
        for each in profile.get("compatible", [])
        if "width" in each
        and "height" in each
        # A size of another shape is a crop, and the collection does not state which.
        and abs(int(each["width"]) * height / (int(each["height"]) * width) - 1.0) <= MAX_SHAPE_DIFFERENCE
    }
    lens = profile.get("lens") or ""
    return [
        profile["brand"],
        profile["model"],
        "" if lens.endswith(".json") else lens,
        profile.get("setting") or "",
        *(width, height, round(profile["fps"], 2) if profile.get("fps") else 0),
        *(float(f"{value:.6g}") for value in (fx, fy, cx, cy)),
        *(float(f"{value:.4g}") for value in profile["D"]),
        *(round(profile["rms"], 2), int(bool(profile.get("official"))), int(stabilised is not None)),
        *(int(anamorphic), round(readout, 2) if 0 < abs(readout) <= MAX_READOUT_MS else 0),
        sorted(sizes - {(width, height)}),
    ]


def write_table(source: Path) -> int:
    """Write the table and return the number of its rows."""
    lines = source.read_text(encoding="utf-8").splitlines()
    rows = sorted(filter(None, (row(json.loads(line)) for line in lines)), key=str)
    content = json.dumps({"source": SOURCE, "columns": COLUMNS, "rows": rows}, separators=(",", ":"))
    TABLE.write_bytes(gzip.compress(content.encode(), 9, mtime=0))
    return len(rows)


if __name__ == "__main__":
    print(write_table(Path(sys.argv[1])), "profiles,", TABLE.stat().st_size, "bytes")
