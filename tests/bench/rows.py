"""The captures on which the benchmark runs."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("BODYCAP_TEST_DATA") or REPOSITORY.parent / "shared" / "data")
LAB = REPOSITORY / "examples" / "cpl_lab"
BODYCAP = (sys.executable, "-c", "from bodycap_batch.cli import main; main()")


@dataclass(frozen=True)
class Row:
    """One benchmark job.

    Attributes:
        name: Name in the table.
        capture: Folder or job file.
        truth: Folder or file of the truth.
        arguments: Further arguments of the command line.
        reference: Camera with which the others are compared in metres.
    """

    name: str
    capture: Path
    truth: Path
    arguments: tuple[str, ...] = ()
    reference: str | None = None


SHARED = ("tum_fr1_xyz", "walk12", "room12", "walk131", "room131")
"""Shared captures with truth in the table of `make bench`."""


def rows_in(data: Path, lab: Path, work: Path) -> list[Row]:
    """Return the captures that exist."""
    rows = [row_of(data / name) for name in SHARED]
    rows.append(Row("cpl_lab", REPOSITORY / "jobs" / "cpl_lab.yaml", lab / "gt", (), "torso"))
    true_mounts = work / "cpl_lab_true_mounts.yaml"
    if (lab / "gt" / "mounts.json").exists():
        _write_true_mounts(lab, true_mounts)
        body = ("--skeleton", str(lab / "skeleton.bvh"))
        rows.append(Row("cpl_lab_true_mounts", true_mounts, lab / "gt", (), "torso"))
        rows.append(Row("cpl_lab_true_mounts_and_bones", true_mounts, lab / "gt", body, "torso"))
    return [row for row in rows if row.capture.exists()]


def row_of(capture: Path) -> Row:
    """Return the row of a folder of videos with its truth inside: ``gt/`` or ``groundtruth.txt``."""
    skeleton = capture / "skeleton.bvh"
    truth = capture / "groundtruth.txt"
    if not skeleton.exists():
        return Row(capture.name, capture, truth if truth.exists() else capture / "gt")
    reference = "torso" if (capture / "torso.mp4").exists() else None
    return Row(capture.name, capture, capture / "gt", ("--skeleton", str(skeleton)), reference)


def _write_true_mounts(lab: Path, target: Path) -> None:
    """Write a job like that of the repository, with the true mounts of the cameras."""
    import yaml

    mounts = json.loads((lab / "gt" / "mounts.json").read_text(encoding="utf-8"))
    cameras = []
    for name, mount in sorted(mounts.items()):
        cameras.append(
            {
                "name": name,
                "video": str(lab / f"{name}.mp4"),
                "mount": name,
                "joint_from_cam": mount["joint_from_cam"],
                "sigma_deg": 1.0,
                "sigma_m": 0.005,
            }
        )
    job = {
        "capture": {"cameras": cameras, "calibration": str(lab / "calib.json")},
        "name": "cpl_lab_true_mounts",
    }
    target.write_text(yaml.safe_dump(job, sort_keys=False), encoding="utf-8")
