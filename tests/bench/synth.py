"""Seconds that a rendered frame takes: ``python -m tests.bench synth``.

Prints the time of the renderer with and without exposure and readout, for a torso camera with the wearer's
arms in view.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.atlas import Bytes
from bodycap_batch.synthetic.making import build_renderers, draw_subject

_KINDS = ((0.0, 0.0), (0.010, 0.0), (0.0, 0.020), (0.010, 0.020))
"""Exposures and readout times, seconds."""


def main(arguments: Sequence[str]) -> int:
    """Render frames and print the seconds; the exit code is 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench synth", description=__doc__)
    parser.add_argument("--size", default="1280x720", help="image size (1280x720)")
    parser.add_argument("--frames", type=int, default=4, help="number of frames of each kind (4)")
    options = parser.parse_args(arguments)
    width, height = map(int, options.size.split("x"))
    cv2.setNumThreads(1)
    times_s = np.linspace(1.0, 3.0, options.frames).tolist()
    for exposure_s, readout_s in _KINDS:
        capture = SynthOptions(
            width=width, height=height, seconds=4.0, cameras=("torso",), seed=3, body_in_view=True,
            arms_ahead=0.7, exposure_s=exposure_s, rolling_shutter_s=readout_s,
        )  # fmt: skip
        renderer = build_renderers(capture, draw_subject(capture))[0]
        seconds = _seconds(renderer.render, times_s)
        sys.stdout.write(f"exposure {1e3 * exposure_s:g} ms, readout {1e3 * readout_s:g} ms: {seconds}\n")
        sys.stdout.flush()
    return 0


def _seconds(render: Callable[[float], Bytes], times_s: Sequence[float]) -> str:
    """Return the seconds a frame takes, as text. The first frame is rendered twice."""
    render(times_s[0])
    wall, used = time.perf_counter(), time.process_time()
    for t_s in times_s:
        render(t_s)
    wall, used = time.perf_counter() - wall, time.process_time() - used
    return f"{used / len(times_s):.2f} s of a processor ({wall / len(times_s):.2f} s) a frame"
