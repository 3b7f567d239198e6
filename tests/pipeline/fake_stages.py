"""Stand-ins for all stages: small text files of what each was computed from, and failures on order."""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import CaptureError, EstimationError
from bodycap_batch.runner import child_main

Json = Mapping[str, Any]
ORDERS = "BODYCAP_FAKE_ORDERS"
"""Path of a JSON file: {"fail" | "crash" | "hang" | "fill": stage, "on": text in its videos,
"wanted" | "localised" | "contradicted": [a value per round], "lost": {camera: frames},
 "unused": {camera: reason}, "rolling": true, "unknown_clocks": [cameras],
 "corrected": [a list of cameras for the first map and for each refined map],
 "wrong": {"given" | "auto": frames that the video contradicts}, "tracks_show_lenses": true,
 "no_map": {"message", "hint"}, "unposed": true, "moves": true,
 "telemetry": [cameras], "stabilised": [cameras],
 "real": [stages that are no stand-ins]}.
 "fail" may be a list of stages."""


def give_orders(folder: Path, **values: Any) -> None:
    """Replace the orders of a folder at once: stages that run meanwhile read the old or the new ones."""
    orders = {"started": str(folder / "started"), **values}
    new = folder / "orders.json.new"
    new.write_text(json.dumps(orders))
    new.replace(folder / "orders.json")


def orders() -> dict[str, Any]:
    path = os.environ.get(ORDERS)
    return dict(json.loads(Path(path).read_text())) if path else {}


def made_of(value: Any) -> Any:
    """Replace every reference to an artefact in a value by the content of the artefact."""
    if isinstance(value, Mapping):
        if value.keys() == {"path", "digest"}:
            return made_of(value["path"])
        return {key: made_of(part) for key, part in value.items() if key not in ("video", "out", "job")}
    if isinstance(value, list):
        return [made_of(part) for part in value]
    if isinstance(value, str) and (Path(value) / "made_of.txt").is_file():
        return (Path(value) / "made_of.txt").read_text()
    return value


def stage(name: str) -> Any:
    def run(arguments: Json, context: StageContext, files: Path) -> None:
        if name in orders().get("real", []):
            from bodycap_batch.tasks.stages import STAGES  # its libraries take seconds to load

            return STAGES[name].run(arguments, context, files)
        context.progress(1, 1, "steps")
        meant = orders().get("on", "") in " ".join(videos(arguments))
        if orders().get("crash") == name and meant:
            ctypes.string_at(0)
        if orders().get("hang") == name and meant:
            Path(orders()["started"]).write_text(str(os.getpid()))
            while True:
                time.sleep(0.05)
        if name in as_list(orders().get("fail")) and meant:
            raise EstimationError(f"{name} does not work out", hint="film more")
        if name == "check" and any("unreadable" in text for text in videos(arguments["job"])):
            raise CaptureError("the file cannot be read as a video", hint="copy the video again")
        if orders().get("fill") == name:
            with (files / "big.bin").open("wb") as stream:
                for _ in range(1000):
                    stream.write(bytes(1 << 20))
        options = dict(arguments.get("options", {}))
        inputs = {key: value for key, value in arguments.items() if key != "options"}
        content = [name, options, made_of(inputs), videos(arguments)]
        (files / "made_of.txt").write_text(json.dumps(content, sort_keys=True))
        EXTRA.get(name, summary)(options, arguments, files)
        return None

    return run


def as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def videos(arguments: Json) -> list[str]:
    capture = arguments.get("capture", {})
    cameras = capture.get("config", capture).get("cameras", [])
    files = [Path(video) for camera in cameras for video in camera["video"]]
    return [file.read_bytes().decode("utf-8", "replace") for file in files if file.exists()]


def summary(options: Json, arguments: Json, files: Path) -> None:
    unknown = orders().get("unknown_clocks", [])
    values = {"notes": ["a note"], "frames": 20, "unknown": unknown, "failure": orders().get("no_map")}
    (files / "summary.json").write_text(json.dumps(values))


def with_sensor(options: Json, arguments: Json, files: Path) -> None:
    before = Path(arguments["registrations"][arguments["cameras"][0]]["path"])
    (files / "summary.json").write_bytes((before / "summary.json").read_bytes())


def checked(options: Json, arguments: Json, files: Path) -> None:
    telemetry = orders().get("telemetry", [])
    (files / "summary.json").write_text(
        json.dumps(
            {
                "notes": ["a note"],
                "frames": 20,
                "telemetry": telemetry,
                "stabilised": orders().get("stabilised", []),
            }
        )
    )


def registered(options: Json, arguments: Json, files: Path) -> None:
    before = arguments["previous"]
    again = json.loads((Path(before["path"]) / "summary.json").read_text())["round"] + 1 if before else 0
    wanted = [*orders().get("wanted", []), *[[]] * 9][again]
    localised = [*orders().get("localised", []), *[10] * 9][again]
    camera = arguments["capture"]["config"]["cameras"][0]["name"]
    frames = localised + orders().get("lost", {}).get(camera, 0)
    values = {
        "round": again,
        "wanted": wanted,
        "localised": localised,
        "contradicted": [*orders().get("contradicted", []), *[0] * 9][again],
        "frames": frames,
    }
    (files / "summary.json").write_text(json.dumps(values))


def heard(options: Json, arguments: Json, files: Path) -> None:
    """No camera has sound, so the sound gives no clock."""
    summary(options, arguments, files)
    start = {"first_frame_s": 0.0, "created_s": None, "timecode_s": None, "frame_s": 0.0, "gps_s": None}
    recordings = [
        {
            "camera": camera["name"], "sound_start_s": None, "problem": "the video has no sound", "notes": [],
            "recorder": None, "start": start, "end_s": 1.0, "frames": 20,
        }
        for camera in arguments["capture"]["config"]["cameras"]
    ]  # fmt: skip
    document = {"type": "SoundEvidence", "value": {"recordings": recordings, "pairs": []}}
    (files / "sound.json").write_text(json.dumps(document))


def placed(options: Json, arguments: Json, files: Path) -> None:
    found = orders().get("places", {})
    values = {"notes": [], "places": found, "reason": "" if found else "the arms do not move"}
    (files / "summary.json").write_text(json.dumps(values))


def mapped(options: Json, arguments: Json, files: Path) -> None:
    """The first map, an extended one, or a refined one."""
    before = Path(arguments["map"]["path"]) / "summary.json" if "map" in arguments else None
    passes = (
        0 if before is None else json.loads(before.read_text())["passes"] + ("registrations" in arguments)
    )
    corrected = [*orders().get("corrected", [["torso"], ["torso"]]), *[[]] * 3][passes]
    values = {
        "notes": ["a note"],
        "passes": passes,
        "rolling": bool(orders().get("rolling")),
        "corrected": corrected,
        "failure": orders().get("no_map"),
    }
    (files / "summary.json").write_text(json.dumps(values))


def recovered(options: Json, arguments: Json, files: Path) -> None:
    before = Path(next(iter(arguments["registrations"].values()))["path"])
    (files / "summary.json").write_bytes((before / "summary.json").read_bytes())


def further_mapped(options: Json, arguments: Json, files: Path) -> None:
    (files / "summary.json").write_text(json.dumps({"further": orders().get("further", 0)}))


def selected(options: Json, arguments: Json, files: Path) -> None:
    """A camera with an unknown lens has the lens that its tracks determine, if they do."""
    given = arguments["capture"]["config"]["cameras"][0]["calibration"] != "auto"
    lens = not given and orders().get("tracks_show_lenses", True)
    (files / "summary.json").write_text(json.dumps({"notes": ["a note"], "frames": 20, "lens": lens}))
    (files / "calibration.json").write_text(json.dumps("given" if given else "auto"))


def linked(options: Json, arguments: Json, files: Path) -> None:
    """Of twenty frames, as many are wrong as the orders say for the lens of the camera."""
    posed = not orders().get("unposed", False)
    lens = Path(arguments["keyframes"]["path"]) / "calibration.json"
    wrong = orders().get("wrong", {}).get(json.loads(lens.read_text()), 0)
    link = {"frame": "map", "compared": 20, "contradicted": wrong}
    values = {"links": [link], "frame": "map", "posed": posed, "sigma": None, "extent": None}
    (files / "summary.json").write_text(json.dumps(values))


def turned(options: Json, arguments: Json, files: Path) -> None:
    """The rotations of a camera; none if it moves."""
    before = json.loads((Path(arguments["registration"]["path"]) / "summary.json").read_text())
    rotations = 0 if orders().get("moves", False) else before["frames"]
    (files / "summary.json").write_text(json.dumps({**before, "rotations": rotations}))


def merged(options: Json, arguments: Json, files: Path) -> None:
    (files / "summary.json").write_text(
        json.dumps({"notes": ["a note"], "unused_cameras": orders().get("unused", {})})
    )


def exported(options: Json, arguments: Json, files: Path) -> None:
    results = files / "results"
    (results / "trajectories").mkdir(parents=True)
    for kind in options["formats"]:
        (results / f"result.{kind}").write_text(json.dumps(made_of(arguments), sort_keys=True))
    (results / "trajectories" / "torso.tum").write_text("0 0 0 0 0 0 0 1\n")
    metrics = {**orders().get("metrics", {}), "partial": arguments["failure"] is not None}
    (results / "metrics.json").write_text(json.dumps(metrics))
    (files / "summary.json").write_text(json.dumps({"notes": []}))


def previewed(options: Json, arguments: Json, files: Path) -> None:
    (files / "results").mkdir()
    (files / "results" / "preview.mp4").write_text(json.dumps(made_of(arguments), sort_keys=True))


def reported(options: Json, arguments: Json, files: Path) -> None:
    (files / "results").mkdir()
    failure = arguments["failure"] or {"stage": "", "message": "all is well"}
    made = [name for name in ("keyframes", "map", "registrations", "merge", "export") if arguments[name]]
    text = f"{failure['stage']}: {failure['message']}; {' '.join(made)}"
    (files / "results" / "report.html").write_text(text)


def rendered(options: Json, arguments: Json, files: Path) -> None:
    capture = files / "capture"
    (capture / "gt").mkdir(parents=True)
    for name in options["cameras"]:
        (capture / f"{name}.mp4").write_text(f"{name} for {options['seconds']} s")
    (capture / "gt" / "torso.tum").write_text("0 0 0 0 0 0 0 1\n")


EXTRA = {
    "check": checked,
    "inertial": with_sensor,
    "registration": registered,
    "map": mapped,
    "extend": mapped,
    "refine": mapped,
    "recover": recovered,
    "sound": heard,
    "further_maps": further_mapped,
    "keyframes": selected,
    "links": linked,
    "rotations": turned,
    "merge": merged,
    "export": exported,
    "places": placed,
    "report": reported,
    "preview": previewed,
    "synth": rendered,
}
NAMES = (
    "synth",
    "check",
    "keyframes",
    "map",
    "extend",
    "refine",
    "registration",
    "recover",
    "sound",
    "clocks",
    "places",
    "inertial",
    "further_maps",
    "further_poses",
    "links",
    "rotations",
    "merge",
    "fill",
    "export",
    "preview",
    "report",
)

if __name__ == "__main__":
    # Stand-ins need no libraries; those of the stages they stand for take seconds to load.
    child_main.import_ahead = lambda _: None
    sys.exit(child_main.main(sys.argv[1:], {name: stage(name) for name in NAMES}))
