"""Render the drawn captures, on which nobody tunes: ``python -m tests.bench drawn --out DIR [NAME…]``.

The parameters of the 24 captures were fixed before a program ran on them. Each kind has two captures; one of
them counts only in the final check (``final``). Half of the captures have rolling shutters. Each folder holds
videos, ``calib.json`` and the ground truth ``gt/``, so ``bodycap evaluate RESULT DIR/NAME/gt`` compares a
result with it. Folders that exist are kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bodycap_batch.core.context import StageContext
from bodycap_batch.synthetic import SynthOptions, synthesise
from tests.bench.rows import DATA

_LENSES: dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    "phone": ("OPENCV", (0.74,), (0.08, -0.12, 0.0005, -0.0004)),
    "wide": ("OPENCV", (0.56,), (-0.22, 0.045, 0.0006, -0.0008)),
    "action": ("OPENCV_FISHEYE", (0.47,), (0.035, -0.012, 0.003, -0.0008)),
    "narrow": ("PINHOLE", (0.92,), ()),
}
"""For each lens: COLMAP's model, the focal length as a fraction of the width, and the distortion."""
_THREE = ("torso", "left_palm", "right_palm")
_FPS = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """The parameters of one drawn capture.

    Attributes:
        name: Name of its folder.
        kind: What is special, in words.
        final: True if it counts only in the final check.
        seed: Seed of body, mounts, path, room and noise.
        seconds: Duration.
        motion: ``walk``, ``gait``, ``spot`` (turns on the spot), ``still`` (at a table), or the name of a BVH
            file in the folder of motions.
        start_s: Time in the BVH file at which the capture starts.
        cameras: Names of the cameras.
        size: Width and height, px.
        lens: Name of a lens in `_LENSES`.
        readout_ms: Time between the first and the last row; 0: global shutter.
        exposure_ms: Exposure time.
        texture: Contrast and density of textures: 1: posters, 0: plain paint.
        noise: Standard deviation of the noise, grey levels.
        auto_exposure: How far the brightness follows the pictures, 0 to 1.
        bit_rate_mbps: Bit rate of each video.
        room: Kind of identical parts, as in `SynthOptions.room`.
        carried_s: Times in which a hand carries a box, by hand.
        hand_in_view: Share of the pictures of wrist cameras that shows the own hand.
        more: Other options of `SynthOptions`.
    """

    name: str
    kind: str
    final: bool
    seed: int
    seconds: float
    motion: str = "walk"
    start_s: float = 0.0
    cameras: tuple[str, ...] = _THREE
    size: tuple[int, int] = (640, 480)
    lens: str = "phone"
    readout_ms: float = 0.0
    exposure_ms: float = 8.0
    texture: float = 1.0
    noise: float = 2.0
    auto_exposure: float = 0.0
    bit_rate_mbps: float = 2.5
    room: str = "single"
    carried_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    hand_in_view: float = 0.0
    more: Mapping[str, Any] = field(default_factory=dict)

    def options(self, motions: Path = DATA / "motions", scale: float = 1.0) -> SynthOptions:
        """Return the options of the generator.

        Args:
            motions: Folder of BVH files.
            scale: Factor of the size of the pictures, for trials.
        """
        width, height = (2 * round(side * scale / 2) for side in self.size)
        model, (focal,), distortion = _LENSES[self.lens]
        # The principal point of a real lens is not in the middle.
        centre = (0.503 * width, 0.494 * height)
        values: dict[str, Any] = {
            "seed": self.seed,
            "seconds": self.seconds,
            "fps": _FPS,
            "width": width,
            "height": height,
            "cameras": self.cameras,
            "lens": model,
            "lens_params": (focal * width, focal * width, *centre, *distortion),
            "rolling_shutter_s": 1e-3 * self.readout_ms,
            "exposure_s": 1e-3 * self.exposure_ms,
            "texture": self.texture,
            "noise": self.noise,
            "auto_exposure": self.auto_exposure,
            "bit_rate_mbps": max(0.1, self.bit_rate_mbps * scale**2),
            "room": self.room,
            "carried_s": dict(self.carried_s),
            "hand_in_view": self.hand_in_view,
            "body_in_view": True,
            "mount_sigma_m": 0.02,
            "on_the_spot": self.motion == "spot",
            "still": self.motion == "still",
            "walk": "gait" if self.motion == "gait" else "simple",
            **self.more,
        }
        if self.motion not in ("walk", "gait", "spot", "still"):
            values |= {"motion": motions / f"{self.motion}.bvh", "motion_start_s": self.start_s}
        return SynthOptions.model_validate(values)


CAPTURES = (
    Drawn(
        name="draw01", kind="posters", final=False, seed=7101, seconds=8.0, lens="wide", bit_rate_mbps=3.0
    ),
    Drawn(
        name="draw02", kind="posters", final=True, seed=7202, seconds=7.0, motion="gait", size=(960, 540),
        readout_ms=16.0, exposure_ms=6.0, bit_rate_mbps=4.0, auto_exposure=0.5,
    ),
    Drawn(
        name="draw03", kind="plain paint", final=False, seed=7303, seconds=8.0, lens="wide", texture=0.0,
        noise=4.0, auto_exposure=0.8, readout_ms=12.0, exposure_ms=12.0, bit_rate_mbps=1.8,
    ),
    Drawn(
        name="draw04", kind="plain paint", final=True, seed=7404, seconds=8.0, texture=0.05, noise=5.0,
        auto_exposure=1.0, exposure_ms=14.0, bit_rate_mbps=1.5, cameras=("head", "torso", "right_palm"),
    ),
    Drawn(
        name="draw05", kind="little texture, arms thrown about", final=False, seed=7505, seconds=6.0,
        motion="131_03", start_s=0.5, texture=0.35, noise=3.0, auto_exposure=0.6, exposure_ms=10.0,
        bit_rate_mbps=2.2,
    ),
    Drawn(
        name="draw06", kind="little texture, arms thrown about", final=True, seed=7606, seconds=6.0,
        motion="131_01", start_s=0.3, texture=0.25, noise=3.5, auto_exposure=0.7, readout_ms=22.0,
        exposure_ms=8.0, size=(960, 540), bit_rate_mbps=3.0,
    ),
    Drawn(
        name="draw07", kind="four equal bays at 90 degrees", final=False, seed=7707, seconds=10.0,
        room="bays_90", cameras=("head", "left_palm", "right_palm"), readout_ms=18.0, bit_rate_mbps=2.4,
    ),
    Drawn(
        name="draw08", kind="four equal bays at 90 degrees", final=True, seed=7808, seconds=9.0,
        room="bays_90", texture=0.5, lens="wide", exposure_ms=10.0, motion="spot", auto_exposure=0.5,
        cameras=("torso", "left_palm"), bit_rate_mbps=2.0,
    ),
    Drawn(
        name="draw09", kind="equal halves at 180 degrees", final=False, seed=7909, seconds=10.0,
        room="bays_180", noise=3.0, bit_rate_mbps=2.2, cameras=("head", "torso"), lens="narrow",
    ),
    Drawn(
        name="draw10", kind="equal halves at 180 degrees", final=True, seed=8010, seconds=10.0,
        room="bays_180", motion="gait", readout_ms=14.0, auto_exposure=0.6, size=(800, 450),
        bit_rate_mbps=2.6,
    ),
    Drawn(
        name="draw11", kind="equal bays along a wall", final=False, seed=8111, seconds=8.0,
        room="bays_along", readout_ms=25.0, exposure_ms=5.0, bit_rate_mbps=2.5, lens="wide",
    ),
    Drawn(
        name="draw12", kind="equal bays along a wall", final=True, seed=8212, seconds=8.0, room="bays_along",
        texture=0.7, noise=4.0, auto_exposure=0.8, exposure_ms=12.0, bit_rate_mbps=1.8,
        cameras=("head", "torso", "left_palm"),
    ),
    Drawn(
        name="draw13", kind="two equal rooms", final=False, seed=8313, seconds=10.0, room="two_rooms",
        cameras=("head", "torso", "left_palm"), bit_rate_mbps=2.6, exposure_ms=6.0,
    ),
    Drawn(
        name="draw14", kind="two equal rooms", final=True, seed=8414, seconds=10.0, room="two_rooms",
        texture=0.6, readout_ms=20.0, lens="action", size=(960, 540), auto_exposure=0.7, bit_rate_mbps=3.5,
    ),
    Drawn(
        name="draw15", kind="a box carried through the picture", final=False, seed=8515, seconds=8.0,
        cameras=("head", "torso", "left_palm"), carried_s={"right": (2.0, 6.0)}, readout_ms=10.0,
        bit_rate_mbps=2.4,
    ),
    Drawn(
        name="draw16", kind="a box carried through the picture", final=True, seed=8616, seconds=9.0,
        cameras=("head", "torso"), carried_s={"left": (1.5, 5.0), "right": (4.0, 8.0)}, texture=0.5,
        lens="wide", auto_exposure=0.6, exposure_ms=12.0, bit_rate_mbps=2.0,
    ),
    Drawn(
        name="draw17", kind="a head that hardly moves", final=False, seed=8717, seconds=8.0, motion="still",
        cameras=("head", "left_palm", "right_palm"), bit_rate_mbps=2.0, exposure_ms=10.0,
    ),
    Drawn(
        name="draw18", kind="a head that hardly moves", final=True, seed=8818, seconds=9.0, motion="still",
        cameras=("head", "torso", "right_palm"), carried_s={"left": (3.0, 6.5)}, readout_ms=17.0, texture=0.6,
        auto_exposure=0.7, noise=3.5, bit_rate_mbps=1.8,
    ),
    Drawn(
        name="draw19", kind="wrist cameras with the own hand", final=False, seed=8919, seconds=8.0,
        cameras=("torso", "left_wrist", "right_wrist"), hand_in_view=0.4, readout_ms=13.0, bit_rate_mbps=2.4,
    ),
    Drawn(
        name="draw20", kind="wrist cameras with the own hand", final=True, seed=9020, seconds=8.0,
        cameras=("head", "left_wrist"), hand_in_view=0.42, lens="wide", auto_exposure=0.8, noise=3.0,
        exposure_ms=10.0, size=(800, 600), bit_rate_mbps=3.0, more={"clothes": "patterned"},
    ),
    Drawn(
        name="draw21", kind="quick turns, action cameras", final=False, seed=9121, seconds=7.0,
        motion="05_06", start_s=0.2, lens="action", readout_ms=15.0, exposure_ms=7.0, size=(960, 540),
        cameras=("head", "left_palm", "right_palm"), bit_rate_mbps=4.0,
    ),
    Drawn(
        name="draw22", kind="quick turns, action cameras", final=True, seed=9222, seconds=6.0,
        motion="131_02", start_s=0.4, lens="action", readout_ms=8.0, exposure_ms=12.0, size=(800, 600),
        texture=0.6, auto_exposure=0.6, bit_rate_mbps=3.0,
    ),
    Drawn(
        name="draw23", kind="long exposures, low bit rates", final=False, seed=9323, seconds=8.0,
        motion="gait", exposure_ms=20.0, noise=5.0, auto_exposure=1.0, bit_rate_mbps=0.9, texture=0.8,
    ),
    Drawn(
        name="draw24", kind="long exposures, low bit rates", final=True, seed=9424, seconds=8.0,
        exposure_ms=25.0, noise=6.0, auto_exposure=0.9,
        bit_rate_mbps=0.8, texture=0.9, cameras=("torso", "right_palm"),
    ),
)  # fmt: skip
"""The drawn captures. Do not change them: results of all versions are compared on them."""


def main(arguments: Sequence[str]) -> int:
    """Render captures; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench drawn", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="captures to render (all)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the captures")
    parser.add_argument("--list", action="store_true", help="print the captures and render none")
    parser.add_argument("--not-final", action="store_true", help="leave out those of the final check")
    parser.add_argument("--scale", type=float, default=1.0, help="factor of the size, for trials (1)")
    options = parser.parse_args(arguments)
    unknown = sorted(set(options.names) - {capture.name for capture in CAPTURES})
    if unknown:
        raise SystemExit(f"no such capture: {', '.join(unknown)}")
    for capture in CAPTURES:
        if (options.names and capture.name not in options.names) or (options.not_final and capture.final):
            continue
        group = "final" if capture.final else "open"
        line = (
            f"{capture.name} ({group}): {capture.kind}, {', '.join(capture.cameras)}, {capture.seconds:g} s"
        )
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
        if not options.list:
            render(capture.name, options.out, options.scale)
    return 0


def render(name: str, out: Path, scale: float = 1.0) -> Path:
    """Render a capture to ``out/name`` if this folder does not exist, and return the folder.

    Args:
        name: Name of the capture.
        out: Folder of the captures.
        scale: Factor of the size of the pictures, for trials.
    """
    folder = out / name
    if not folder.exists():
        out.mkdir(parents=True, exist_ok=True)
        capture = next(capture for capture in CAPTURES if capture.name == name)
        context = StageContext(work_dir=out, threads=len(os.sched_getaffinity(0)))
        synthesise(capture.options(scale=scale), folder, context)
    return folder
