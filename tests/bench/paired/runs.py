"""Run one job of one side on one input, measure it, and keep the record."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import av

from bodycap_batch import Result
from bodycap_batch.core.errors import BodycapError
from tests.bench import poses
from tests.bench.paired import measures
from tests.bench.paired.captures import VIDEOS, BenchCapture
from tests.bench.paired.measures import Paths, TruthFigures
from tests.bench.paired.perturb import make_input
from tests.bench.paired.sides import Side, digest_of
from tests.bench.rows import BODYCAP, REPOSITORY

FORMAT = 1
"""Number of the format of the records. Records of another format are made again."""
RECORD, PATHS = "record.json", "paths.npz"
_KEPT = (
    "trajectories",
    "colmap",
    "metrics.json",
    "run.json",
    "frames.csv",
    "job.yaml",
    "map.ply",
    "motion.bvh",
)
"""Files of a result that stay: what the measures read."""
_NEEDED = ("run.json", "metrics.json", "frames.csv")
stopping = threading.Event()
"""Set if all jobs of this process are to stop. They leave no record then."""
_POLL_S, _LEAST_CPU_S = 0.1, 1e-3
_STOP_S = 30.0
"""Time for a job to stop by itself, seconds."""
_PICTURE_LIMIT = 3600.0
"""Time limit of the comparison with the pictures, seconds."""
_MEASURE = REPOSITORY / "bodycap_batch" / "evaluate"
"""Code of the comparison with the pictures."""
_GRADE = (
    "import json, sys; from bodycap_batch.report.verdict import judge; "
    "print(judge(json.load(open(sys.argv[1], encoding='utf-8')), None).cameras.word)"
)
"""Program that prints the grade of the cameras, by the code of the side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings:
    """How jobs run.

    Attributes:
        work: Folder of the comparison.
        limit_s: Time limit of a job, seconds.
        threads: Number of cores of a job.
        has_pictures: True to compare the results with the pictures.
        pictures_again: True to repeat this where another version of the measure made it.
    """

    work: Path
    limit_s: float = 1200.0
    threads: int = 1
    has_pictures: bool = True
    pictures_again: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureFigures:
    """Frames by what the pictures say: see ``bodycap evaluate --video``."""

    right: int
    wrong: int
    unmeasurable: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord:
    """What one job gave.

    Attributes:
        capture: Name of the capture.
        seed: Number of the perturbation.
        side: Name of the side.
        exit: Exit code; None if the job reached its time limit.
        error: Last lines of the errors; empty if the job finished.
        seconds: Wall seconds.
        cpu_s: Processor seconds of the job and of its child processes.
        memory_mb: Largest memory of a task; None if it is unknown.
        frames: Number of frames of all cameras.
        posed: Number of frames with a pose in the main map.
        rotations: Number of frames with a rotation and no position.
        rotations_deg: Median error of these rotations; None without a truth.
        models: Number of maps.
        digest: Digest of the poses, the map and the motion; empty without results.
        grade: Word of the grade of the cameras, by the code of the side.
        acted: How often each mechanism acted; None if the version does not count it.
        has_truth: True if the capture has a truth.
        truth: Errors against the truth; None without a truth, or without posed frames.
        inside: Fraction of the poses inside their 95 % region.
        palm_m: Mean error of the positions relative to the reference camera, m.
        lens: Errors of the lens, degrees, by distance from the centre; and ``spread`` of a camera's models.
        pictures: Frames by what the pictures say; None if it was not measured.
        measure: Version of the measure that compared the result with the pictures.
        source: Digest of the names and sizes of the videos. A record of other videos is made again.
    """

    capture: str
    seed: int
    side: str
    exit: int | None
    error: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    memory_mb: float | None = None
    frames: int = 0
    posed: int = 0
    rotations: int = 0
    rotations_deg: float | None = None
    models: int = 0
    digest: str = ""
    grade: str = ""
    acted: dict[str, int] | None = None
    has_truth: bool = False
    truth: TruthFigures | None = None
    inside: float | None = None
    palm_m: float | None = None
    lens: dict[str, float] = field(default_factory=dict)
    pictures: PictureFigures | None = None
    measure: str = ""
    source: str = ""

    @property
    def right(self) -> int | None:
        """Number of right frames, by the truth or else by the pictures; None if nothing measured them."""
        return self._count("right")

    @property
    def wrong(self) -> int | None:
        """Number of wrong frames, by the truth or else by the pictures; None if nothing measured them."""
        return self._count("wrong")

    @property
    def wrong_verdict(self) -> str:
        """How the verdict contradicts the frames; empty if it does not."""
        if not self.grade or self.right is None or self.wrong is None:
            return ""
        return measures.wrong_verdict(self.grade, self.frames, self.right, self.wrong)

    def _count(self, name: str) -> int | None:
        if not self.posed:
            return 0
        found = self.truth if self.has_truth else self.pictures
        return None if found is None else int(getattr(found, name))

    def save(self, folder: Path) -> None:
        """Write the record; a stopped process leaves the old one or the new one."""
        part = folder / f".{os.getpid()}-{RECORD}"
        part.write_text(json.dumps({"format": FORMAT, **asdict(self)}, indent=1), encoding="utf-8")
        part.replace(folder / RECORD)

    @staticmethod
    def load(folder: Path) -> RunRecord | None:
        """Read a record; None if there is none of this format."""
        if not (folder / RECORD).exists():
            return None
        values = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        if values.pop("format", None) != FORMAT:
            return None
        values["truth"] = values["truth"] and TruthFigures(**values["truth"])
        values["pictures"] = values["pictures"] and PictureFigures(**values["pictures"])
        return RunRecord(**values)


def folder_of(side: str, capture: str, seed: int, work: Path) -> Path:
    """Return the folder of the record of a job."""
    return work / "runs" / side / capture.replace(":", "_") / str(seed)


def run(side: Side, capture: BenchCapture, seed: int, settings: RunSettings) -> RunRecord:
    """Return the stored record of a job, or run the job and store its record."""
    folder = folder_of(side.name, capture.name, seed, settings.work)
    stored, source = RunRecord.load(folder), _source_of(capture)
    measure = digest_of(_MEASURE)[:8] if settings.has_pictures else ""
    if stored is not None and stored.source != source:
        stored = None
    if stored is not None and not (
        settings.has_pictures
        and stored.posed
        and (stored.pictures is None or (settings.pictures_again and stored.measure != measure))
    ):
        return stored
    job, videos = make_input(capture, seed, settings.work)
    if stored is None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        values = _run_job(side, capture, job, folder, settings)
        if all((folder / "out" / name).exists() for name in _NEEDED):
            values |= _measure(side, capture, folder)
        else:
            values["frames"] = sum(count_frames(file) for file in _videos_of(capture, videos))
        shutil.rmtree(folder / "store", ignore_errors=True)
    else:
        values = {name: getattr(stored, name) for name in RunRecord.__slots__}
    values |= {"capture": capture.name, "seed": seed, "side": side.name, "source": source}
    values["has_truth"] = capture.truth is not None
    if settings.has_pictures and values.get("posed"):
        equal = _equal_run(values, measure, settings.work)
        values["pictures"] = equal.pictures if equal else _pictures(folder / "out", job)
        values["measure"] = measure
    record = RunRecord(**values)
    record.save(folder)
    return record


def _equal_run(values: Mapping[str, Any], measure: str, work: Path) -> RunRecord | None:
    """Return a stored run of another side with the same input and the same outputs, measured alike."""
    for file in (work / "runs").glob(f"*/{values['capture'].replace(':', '_')}/{values['seed']}/{RECORD}"):
        other = RunRecord.load(file.parent)
        if other and other.pictures and (other.digest, other.measure) == (values["digest"], measure):
            return other
    return None


def count_frames(file: Path) -> int:
    """Return the number of pictures of a video."""
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        return stream.frames or sum(packet.pts is not None for packet in container.demux(stream))


def _videos_of(capture: BenchCapture, folder: Path) -> list[Path]:
    files = [file for file in sorted(folder.iterdir()) if file.suffix.lower() in VIDEOS]
    return [file for file in files if capture.only in ("", file.name)]


def _source_of(capture: BenchCapture) -> str:
    text = " ".join(f"{file.name} {file.stat().st_size}" for file in _videos_of(capture, capture.folder))
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _run_job(
    side: Side, capture: BenchCapture, job: Path, folder: Path, settings: RunSettings
) -> dict[str, Any]:
    """Run ``bodycap run`` of a side; returns the exit code, the error, the times."""
    command = [*BODYCAP, "run", str(job), "--out", str(folder / "out"), "--store", str(folder / "store")]
    command += [*capture.arguments, "--threads", str(settings.threads)]
    started = time.monotonic()
    with (folder / "stdout.txt").open("w") as out, (folder / "stderr.txt").open("w") as errors:
        process = subprocess.Popen(
            command,
            cwd=side.folder,
            env=side.environment(settings.threads),
            stdout=out,
            stderr=errors,
            start_new_session=True,
        )
        code, cpu_s = _wait(process, settings.limit_s)
    text = (folder / "stderr.txt").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-3:]
    if code is None:
        text = [f"stopped after {settings.limit_s / 60:g} minutes"]
    return {
        "exit": code,
        "error": "" if code == 0 else " ".join(line.strip() for line in text),
        "seconds": round(time.monotonic() - started, 2),
        "cpu_s": round(cpu_s, 2),
    }


def _wait(process: subprocess.Popen[bytes], limit_s: float) -> tuple[int | None, float]:
    """Wait for a process; returns its exit code, None at the time limit, and its processor seconds."""
    end = time.monotonic() + limit_s
    try:
        while not (ended := _ended(process)):
            if stopping.is_set():
                raise InterruptedError("the comparison was stopped")
            if time.monotonic() > end:
                return None, _stop(process)
            time.sleep(_POLL_S)
    except BaseException:
        _stop(process)
        raise
    return process.returncode, ended


def _stop(process: subprocess.Popen[bytes]) -> float:
    """Stop a job and return its processor seconds. It stops its own tasks, which have groups of their own."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        end = time.monotonic() + _STOP_S
        if process.returncode is None:
            os.killpg(process.pid, number)
        while time.monotonic() < end:
            if ended := _ended(process):
                return ended
            time.sleep(_POLL_S)
    return 0.0


def _ended(process: subprocess.Popen[bytes]) -> float:
    """Return the processor seconds of a process that ended, with its children; 0 while it runs."""
    if process.returncode is not None:
        return _LEAST_CPU_S
    found, status, used = os.wait4(process.pid, os.WNOHANG)
    if not found:
        return 0.0
    process.returncode = os.waitstatus_to_exitcode(status)
    return max(used.ru_utime + used.ru_stime, _LEAST_CPU_S)


def _measure(side: Side, capture: BenchCapture, folder: Path) -> dict[str, Any]:
    """Measure the results of a job, and delete what the measures do not need again."""
    out = folder / "out"
    record = Result(out).record()
    frames, posed = measures.frame_counts(out)
    rotations, rotations_deg = measures.rotations_alone(out, capture.truth)
    values: dict[str, Any] = {
        "memory_mb": record.get("peak_memory_mb"),
        "frames": frames,
        "posed": posed,
        "rotations": rotations,
        "rotations_deg": rotations_deg,
        "models": len(list((out / "colmap").glob("*/"))),
        "digest": measures.digest_of_results(out),
        "grade": _grade(side, out / "metrics.json"),
        "acted": acted(record),
        "lens": measures.lens_figures(out, capture),
    }
    if capture.truth is not None:
        paths = measures.read_paths(out, capture.truth)
        if paths is not None:
            paths.save(folder / PATHS)
            values["truth"] = measures.truth_figures(paths)
        values["inside"] = _share_inside(out, folder / "store", capture.truth)
        if capture.reference is not None:
            values["palm_m"] = measures.palm_error_m(out, capture.truth, capture.reference)
    for file in out.iterdir():
        if file.name not in _KEPT:
            shutil.rmtree(file) if file.is_dir() else file.unlink()
    return values


def acted(record: Mapping[str, Any]) -> dict[str, int] | None:
    """Return how often each mechanism acted in a job, from its run.json; None if no stage states it."""
    stated = [stage["acted"] for stage in record.get("stages", ()) if stage.get("acted") is not None]
    if not stated:
        return None
    total: Counter[str] = Counter()
    for each in stated:
        total.update({name: int(count) for name, count in each.items()})
    return dict(sorted(total.items()))


def stored_paths(record: RunRecord, folder: Path) -> Paths | None:
    """Return the posed frames of a stored run that have a truth."""
    return Paths.load(folder / PATHS) if record.truth is not None and (folder / PATHS).exists() else None


def _grade(side: Side, metrics: Path) -> str:
    done = subprocess.run(
        [*BODYCAP[:2], _GRADE, str(metrics)],
        cwd=side.folder,
        env=side.environment(1),
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() if done.returncode == 0 else ""


def _share_inside(out: Path, store: Path, truth: Path) -> float | None:
    """Return the fraction of the poses inside their 95 % region; None if the artefacts cannot be read."""
    try:
        found = poses.consistency(out, store, truth)
    except (BodycapError, ValueError, KeyError, IndexError, OSError, TypeError):  # of another version
        return None
    return found["all"]["pose_inside"] if found else None


def _pictures(out: Path, job: Path) -> PictureFigures | None:
    """Return what the pictures say of a result, by the measure of this working tree."""
    try:
        done = subprocess.run(
            [*BODYCAP, "evaluate", str(out), "--video", str(job), "--json"],
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
            timeout=_PICTURE_LIMIT,
        )
    except subprocess.TimeoutExpired:
        return None
    if done.returncode != 0:
        return None
    cameras = json.loads(done.stdout).values()
    counts = {name: sum(each[name] for each in cameras) for name in ("right", "wrong", "not_measurable")}
    return PictureFigures(right=counts["right"], wrong=counts["wrong"], unmeasurable=counts["not_measurable"])
