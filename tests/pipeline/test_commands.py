"""Every command of the README and of the tutorials on a real stored result, judged by what it wrote."""

from __future__ import annotations

import datetime as dt
import json
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from fractions import Fraction
from http.client import HTTPConnection
from pathlib import Path

import av
import bvhio
import numpy as np
import pytest
import yaml

from bodycap_batch.config.export_targets import TARGETS, export_target
from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.fbx import find_blender, require_blender
from tests.boards import PINHOLE_LENS
from tests.pipeline.commands import OFFSETS_S, PAGES, ROOT, Done, Site, commands_in, make_site
from tests.pipeline.tiny_job import Place

pytestmark = pytest.mark.slow
MEASURED = {"Spine1", "LeftArm", "LeftForeArm", "LeftHand"}
"""Bones between the two cameras of the job, which move."""
LOOK = Path(__file__).parents[1] / "blender" / "look_at_curves.py"


@pytest.fixture(scope="module")
def site(reference: Place, tmp_path_factory: pytest.TempPathFactory) -> Site:
    """A site in which the job has been run as the pages say, under each name that they use."""
    site = make_site(tmp_path_factory.mktemp("site") / "work", reference)
    for command in ("bodycap run my_walk/ --height 1.75", "bodycap run cpl_lab.yaml"):
        assert site.run(command).code == 0
    for day, name in (("monday", "my_walk"), ("tuesday", "cpl_lab")):
        shutil.copytree(site.folder / "out" / name, site.folder / "out" / day)
    return site


def moving_bones(path: Path) -> set[str]:
    """Return the names of the bones of a BVH file whose rotation changes, read with another library."""
    joints = [joint for joint, _, _ in bvhio.readAsBvh(str(path)).Root.layout()]
    turns = {joint.Name: np.array([list(key.Rotation) for key in joint.Keyframes]) for joint in joints}
    return {name for name, values in turns.items() if np.ptp(values, axis=0).max() > 1e-3}


def curves_in_blender(path: Path) -> dict[str, list[str]]:
    """Return what Blender finds in a file: the bones with changing rotation curves, and the videos."""
    done = subprocess.run(
        [str(require_blender()), "-P", str(LOOK), str(path)], capture_output=True, text=True, check=True
    )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def has_blender() -> bool:
    try:
        find_blender()
    except JobError:
        return False
    return True


def page_with(*words: str) -> Callable[[Site, Done], None]:
    """Return a check of a page that is written, and that contains these words."""

    def check(site: Site, done: Done) -> None:
        pages = [name for name in done.written if name.endswith(".html")]
        assert len(pages) == 1, done.written
        text = (site.folder / pages[0]).read_text(encoding="utf-8")
        assert [word for word in words if word not in text] == []

    return check


def says(*words: str) -> Callable[[Site, Done], None]:
    """Return a check of a command that prints these words and writes nothing."""

    def check(_: Site, done: Done) -> None:
        assert [word for word in words if word not in done.out] == [], done.out
        assert done.written == set()

    return check


def is_run(site: Site, done: Done) -> None:
    out = site.folder / "out" / "my_walk"
    assert moving_bones(out / "motion.bvh") >= MEASURED
    assert yaml.safe_load((out / "job.yaml").read_text())["height_m"] == 1.75
    assert done.out.splitlines()[-1] == f"results: {out}"
    for name in ("map.ply", "report.html", "preview.mp4", "trajectories/torso.tum", "frames.csv"):
        assert (out / name).stat().st_size > 1000, name


def is_open(site: Site, _: Done) -> None:
    address = site.opened.read_text().strip()
    assert address.startswith("file://")
    assert address.endswith("/report.html")
    assert Path(address.removeprefix("file://")).is_file()
    site.opened.unlink()


def is_recording(site: Site, done: Done) -> None:
    assert done.written == {"walk.rrd"}
    assert (site.folder / "walk.rrd").stat().st_size > 10_000


def is_template(site: Site, done: Done) -> None:
    (written,) = done.written
    assert written == "my_walk/job.yaml"
    text = (site.folder / written).read_text()
    assert "torso" in text
    (site.folder / written).unlink()  # the other commands use the folder without it


def is_board(site: Site, done: Done) -> None:
    assert done.written == {"board.pdf"}
    assert (site.folder / "board.pdf").read_bytes().startswith(b"%PDF")


def is_calibration(site: Site, done: Done) -> None:
    lens = json.loads((site.folder / "calib.json").read_text())
    assert "calib.json" in done.written
    numbers = [float(text) for text in re.findall(r"\d+\.\d+", json.dumps(lens))]
    # The clip's lens; 0.5 % as in the tests of the calibration.
    assert any(abs(value / float(PINHOLE_LENS.params[0]) - 1.0) < 0.005 for value in numbers), lens


def are_clocks(_: Site, done: Done) -> None:
    (found,) = yaml.safe_load(done.out.partition("job.yaml:\n")[2])
    assert found["name"] == "left_palm"
    # The way of sound in the air takes some milliseconds.
    assert abs(found["offset_s"] - OFFSETS_S["left_palm"]) < 0.01


def is_capture(site: Site, done: Done) -> None:
    names = {name.removeprefix("my_test/") for name in done.written}
    assert names >= {"torso.mp4", "left_palm.mp4", "right_palm.mp4", "calib.json", "gt/motion.bvh"}


def is_export(target: str, folder: str) -> Callable[[Site, Done], None]:
    """Return a check of the files for one program: its main file holds the motion."""

    def check(site: Site, done: Done) -> None:
        program, out = export_target(target), site.folder / folder
        if program.file.endswith(".fbx") and not has_blender():
            assert done.code == 2
            assert "make blender" in done.err
            assert done.written <= {name for name in done.written if "/logs/" in name}
            return
        assert done.code == 0, done.err
        printed = [site.folder / line for line in done.out.splitlines()]
        assert out / program.file in printed
        assert printed[-1] == out / "HOW_TO_IMPORT.txt"
        assert all(path.is_file() for path in printed)
        if target == "blender":
            assert moving_bones(out / "motion.bvh") == moving_bones(site.folder / "out/my_walk/motion.bvh")
            videos = json.loads((out / "blender_scene.json").read_text())["videos"]
            assert set(videos) == {"torso", "left_palm"}
            assert all(Path(path).is_file() for files in videos.values() for path in files)
        if (out / "motion.bvh").is_file():
            assert len(moving_bones(out / "motion.bvh")) >= len(MEASURED)
        if has_blender():
            seen = curves_in_blender(out / ("scene.blend" if target == "blender" else program.file))
            assert len(seen["bones"]) >= len(MEASURED), seen
            if target == "blender":
                assert len(seen["videos"]) == 2
                assert all(Path(path).is_file() for path in seen["videos"])

    return check


def are_clips(site: Site, done: Done) -> None:
    """Check that each camera has a clip with one picture for each of its frames, and a .chan file."""
    out = site.folder / "out/my_walk/undistorted"
    assert done.code == 0, done.err
    facts = json.loads((out / "cameras.json").read_text())
    assert sorted(facts["cameras"]) == ["left_palm", "torso"]
    main = json.loads((site.folder / "out/my_walk/cameras.json").read_text())
    assert facts["frames"] == main["frames"] > 10
    for name, camera in facts["cameras"].items():
        assert camera == main["cameras"][name]
        with av.open(str(out / f"{name}.mp4")) as container:
            stream = container.streams.video[0]
            assert stream.average_rate == Fraction(facts["rate"])
            assert (stream.width, stream.height) == (camera["width_px"], camera["height_px"])
            assert sum(1 for _ in container.decode(video=0)) == facts["frames"]
        lines = (out / "cameras" / f"{name}.chan").read_text().splitlines()
        assert len(lines) == sum(last - first + 1 for first, last in camera["valid_frames"])


def is_made(*words: str) -> Callable[[Site, Done], None]:
    """Return a check of a target of the Makefile: its recipe runs this program."""

    def check(_: Site, done: Done) -> None:
        assert [word for word in words if word not in done.out] == [], done.out

    return check


def nothing(_: Site, done: Done) -> None:
    assert done.out == ""


CHECKS: dict[str, Callable[[Site, Done], None]] = {
    "make job": is_made("bin/bodycap run jobs/cpl_lab.yaml"),
    "make docs": is_made("sphinx -b html", "build/docs"),
    "source .venv/bin/activate": nothing,
    "bodycap check my_walk/": says("ready to run", "torso.mp4", "left_palm.mp4"),
    "bodycap check my_walk/ --height 1.75": says("ready to run", "torso.mp4", "left_palm.mp4"),
    "bodycap run my_walk/ --height 1.75": is_run,
    "bodycap open my_walk/": is_open,
    "bodycap open out/cpl_lab": is_open,
    "bodycap export out/my_walk --for blender": is_export("blender", "out/my_walk/blender"),
    "bodycap export out/cpl_lab --for blender": is_export("blender", "out/cpl_lab/blender"),
    "bodycap export out/cpl_lab --for unreal": is_export("unreal", "out/cpl_lab/unreal"),
    "bodycap export out/my_walk --undistorted": are_clips,
    "bodycap compare out/monday out/tuesday": page_with("monday", "tuesday", "<svg"),
    "bodycap compare out/my_walk mocap.bvh --shift 0.4 --out walk.html": page_with("mocap", "<svg"),
    "bodycap compare out/my_walk capture/gt/joints.npz": page_with("my_walk", "<svg"),
    "bodycap compare out/cpl_lab walk.bvh": page_with("cpl_lab", "walk", "<svg"),
    "bodycap report out/cpl_lab": page_with("cpl_lab", "map.ply"),
    "bodycap view out/cpl_lab --rerun walk.rrd": is_recording,
    "bodycap evaluate out/cpl_lab examples/cpl_lab/gt": says("torso", "left_palm", "cm"),
    "bodycap doctor": says("this machine can run jobs", "FBX"),
    "bodycap init my_walk/": is_template,
    "bodycap sync my_walk/": are_clocks,
    "bodycap calibrate --print board.pdf": is_board,
    "bodycap calibrate board.mp4": is_calibration,
    "bodycap lenses hero11 wide": says("HERO11", "Wide"),
    "bodycap telemetry GX010123.MP4": says("HERO11 Black"),
    "bodycap synth my_test/ --seconds 10": is_capture,
}
"""What each command must do, by the command as a page shows it."""
SERVERS = ("bodycap view out/cpl_lab",)
"""Commands that run until Ctrl-C."""
QUICKER = {"bodycap synth my_test/ --seconds 10": ("--seconds", "1", "--size", "160x120")}
"""Words that only make a command quicker; a repeated option replaces the first."""
PLACES = {"bodycap sync my_walk/": "with_sound"}
"""Folder in which a command is run, if not in that of the stored results."""
SHOWN_TARGETS = {command.rpartition(" --for ")[2] for command in CHECKS if " --for " in command}
SHOWN = {command: page.name for page in PAGES for command in commands_in(page)}


def test_every_command_of_the_pages_has_a_test() -> None:
    assert len(SHOWN) > 20
    assert set(SHOWN) == {*CHECKS, *SERVERS}


@pytest.mark.parametrize("command", [name for name in CHECKS if name.startswith("bodycap")])
def test_a_command_of_the_pages_does_what_they_say(site: Site, command: str) -> None:
    done = site.run(command, *QUICKER.get(command, ()), place=PLACES.get(command, "."))
    if " export " not in command:
        assert done.code == 0, done.err
    CHECKS[command](site, done)


@pytest.mark.parametrize("command", [name for name in CHECKS if not name.startswith("bodycap")])
def test_a_command_for_the_shell_exists(site: Site, command: str) -> None:
    if command.startswith("source"):
        assert "VENV := .venv" in (ROOT / "Makefile").read_text()
        return
    done = subprocess.run(
        [*command.split(), "-n", "-W", "requirements.lock"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    CHECKS[command](site, Done(0, done.stdout, done.stderr, set()))


@pytest.mark.parametrize("command", SERVERS)
def test_a_server_shows_the_page_and_the_videos_until_it_is_stopped(site: Site, command: str) -> None:
    process = site.start(command.split())
    try:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0]
        assert address.startswith("http://127.0.0.1:")
        host, _, page = address.removeprefix("http://").partition("/")
        connection = HTTPConnection(host, timeout=60)
        connection.request("GET", f"/{page}")
        assert "cpl_lab" in connection.getresponse().read().decode()
        connection.close()
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)


@pytest.mark.parametrize("target", [name for name in TARGETS if name not in SHOWN_TARGETS])
def test_the_main_file_for_each_other_program_has_motion(site: Site, target: str) -> None:
    done = site.run(f"bodycap export out/my_walk --for {target} --to made/{target}")
    is_export(target, f"made/{target}")(site, done)


def test_a_batch_keeps_the_height_of_the_last_run(site: Site) -> None:
    out = site.folder / "out" / "my_walk"
    before = (out / "motion.bvh").read_bytes()
    done = site.run("bodycap batch my_walk/")
    assert done.code == 0, done.err
    assert "--height 1.75" in done.err
    assert "nothing to do" in done.out
    assert (out / "motion.bvh").read_bytes() == before
    assert site.run("bodycap batch my_walk/ --height 1.9 --out tall").code == 0
    assert yaml.safe_load((site.folder / "tall" / "my_walk" / "job.yaml").read_text())["height_m"] == 1.9
    assert (site.folder / "tall" / "my_walk" / "motion.bvh").read_bytes() != before


def test_the_store_of_a_job_is_found_by_its_videos(site: Site) -> None:
    done = site.run("bodycap gc my_walk/")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1].startswith("would remove")


def test_progress_for_programs_has_a_schema_and_times_and_reaches_its_totals(site: Site) -> None:
    done = site.run("bodycap run my_walk/ --height 1.75 --json-progress --from registration --out again")
    assert done.code == 0, done.err
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert {line["schema"] for line in lines} == {1}
    times = [dt.datetime.fromisoformat(line["time"]) for line in lines]
    assert all(time.utcoffset() == dt.timedelta() for time in times)
    assert times == sorted(times)
    steps: dict[tuple[str, str, str], tuple[int, int]] = {}
    for line in lines:
        if line["kind"] == "progress" and line["total"]:
            steps[line["stage"], line["camera"], line["what"]] = (line["done"], line["total"])
    last = {(stage, camera): values for (stage, camera, _), values in steps.items()}
    assert {stage for stage, _ in last} >= {"registration", "merge", "export", "report", "preview"}
    assert [key for key, (done_units, total) in last.items() if done_units != total] == []
    assert steps["registration", "torso", "frames tracked"] == (60, 60)


def test_a_watched_folder_gives_motion_whose_videos_are_found_after_the_job_has_moved(site: Site) -> None:
    dropped = site.folder / "jobs" / "inbox" / "my_walk"
    shutil.copytree(site.folder / "my_walk", dropped)
    (dropped / "job.yaml").write_text("height_m: 1.75\n")
    (dropped / "READY").touch()
    done = site.run("bodycap watch jobs/inbox --once")
    assert done.code == 0, done.err
    result = site.folder / "jobs" / "done" / "my_walk" / "result"
    assert moving_bones(result / "motion.bvh") == moving_bones(site.folder / "out/my_walk/motion.bvh")
    videos = json.loads((result / "run.json").read_text())["videos"]
    assert set(videos) == {"torso", "left_palm"}
    assert all((result / path).is_file() for files in videos.values() for path in files)
    assert site.run("bodycap export jobs/done/my_walk --for blender").code == 0
    assert moving_bones(result / "blender" / "motion.bvh") >= MEASURED
