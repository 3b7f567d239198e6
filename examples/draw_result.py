"""Draw a job's results into a PNG: the room's points, the cameras' paths and the solved body.

    python examples/draw_result.py out/cpl_lab picture.png

Needs matplotlib (``pip install matplotlib``; it comes with the development dependencies).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")

import matplotlib.pyplot as plt
import open3d as o3d

from bodycap_batch import Result
from bodycap_batch.formats.bvh import read_bvh

BODY_TIMES = 6
TONES = ("#d1495b", "#00798c", "#edae49", "#66a182", "#8d6a9f", "#2e4057")


def body_at(motion, tick: int) -> list[np.ndarray]:
    """Bones (2,3) of one tick, metres, Z up."""
    world_from_joint = motion.world_from_joint()[tick]
    parents = motion.skeleton.parents
    bones = [
        np.stack([world_from_joint[parents[joint], :3, 3], world_from_joint[joint, :3, 3]])
        for joint in range(1, len(parents))
    ]
    ends = motion.skeleton.end_offsets_m
    for joint in np.flatnonzero(np.isfinite(ends).all(axis=1)):
        pose = world_from_joint[joint]
        bones.append(np.stack([pose[:3, 3], pose[:3, :3] @ ends[joint] + pose[:3, 3]]))
    return bones


def draw(results: Path, picture: Path) -> None:
    """Write the picture."""
    cloud = o3d.io.read_point_cloud(str(results / "map.ply"))
    points, colours = np.asarray(cloud.points), np.asarray(cloud.colors)
    trajectories = Result(results).placed_trajectories()
    paths = {name: path.centres[path.localised] for name, path in trajectories.items()}
    centres = np.concatenate(list(paths.values()))
    low, high = np.percentile(points, [3, 97], axis=0)
    low, high = np.minimum(low, centres.min(axis=0)), np.maximum(high, centres.max(axis=0))
    inside = ((points > low) & (points < high)).all(axis=1)

    figure = plt.figure(figsize=(12, 7), dpi=110)
    axes = figure.add_subplot(projection="3d", computed_zorder=False)
    axes.scatter(*points[inside].T, c=colours[inside], s=7, linewidths=0, alpha=0.85)
    for tone, (name, path) in zip(TONES, paths.items(), strict=False):
        axes.plot(*path.T, color=tone, linewidth=1.6, label=name.replace("_", " "))
    _, motion = read_bvh(results / "motion.bvh")
    if motion is not None:
        ticks = np.linspace(0, len(motion.root_in_world_m) - 1, BODY_TIMES).round().astype(int)
        for shade, tick in zip(np.linspace(0.35, 1.0, BODY_TIMES), ticks, strict=True):
            for bone in body_at(motion, tick):
                axes.plot(*bone.T, color="black", linewidth=2.4, alpha=shade, solid_capstyle="round")
    axes.set_box_aspect(np.maximum(high - low, 0.1), zoom=1.35)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(min(low[2], 0.0), high[2]))
    axes.view_init(elev=24, azim=-62)
    axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    axes.legend(loc="upper left", frameon=False)
    figure.tight_layout()
    figure.savefig(picture)


def main() -> None:
    """Read the command line and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", type=Path, help="folder of a finished job")
    parser.add_argument("picture", type=Path, help="PNG to write")
    options = parser.parse_args()
    draw(options.results, options.picture)


if __name__ == "__main__":
    main()
