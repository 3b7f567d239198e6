"""Write a synthetic capture. The folder of the capture gets its final name when the capture is complete."""

from __future__ import annotations

import secrets
import shutil
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.atomic_files import store_error_from_os_error, write_text
from bodycap_batch.formats.gpmf_writer import append_settings
from bodycap_batch.formats.mp4_writer import DataTrack, VideoWriter
from bodycap_batch.formats.tum import TimedPoses, seconds_text, write_tum
from bodycap_batch.model.skeleton import Mount
from bodycap_batch.synthetic.atlas import Atlas, Bytes
from bodycap_batch.synthetic.camera_sounds import CameraSounds
from bodycap_batch.synthetic.clip import load_clip
from bodycap_batch.synthetic.clocks import first_and_last_s, true_clocks
from bodycap_batch.synthetic.gait import Walk, WalkStyle
from bodycap_batch.synthetic.hand_view import with_hand_in_view
from bodycap_batch.synthetic.imu import write_imu
from bodycap_batch.synthetic.measured import disturb_poses
from bodycap_batch.synthetic.moving_body import MovingBody, camera_poses_at, picture_poses_at
from bodycap_batch.synthetic.moving_camera import MovingCamera
from bodycap_batch.synthetic.moving_scene import ROOM, MovingPart
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.person import draw_body, draw_mounts, draw_posture
from bodycap_batch.synthetic.pressing import carrying, find_press
from bodycap_batch.synthetic.room import build_room
from bodycap_batch.synthetic.sensor import AutoExposure, Sensor
from bodycap_batch.synthetic.stabilisation import GOPRO_SETTINGS, orientation_track, turn_of_pictures
from bodycap_batch.synthetic.stance_walk import StanceWalk
from bodycap_batch.synthetic.triangles import triangles_from_surfaces
from bodycap_batch.synthetic.truth import (
    common_ticks_ns,
    mean_poses,
    seconds_from_ns,
    write_calibration,
    write_truth,
)
from bodycap_batch.synthetic.wearer import Wearer

_TEXELS_PER_PIXEL_M = 0.85
"""Ratio of the texture detail (texels per metre) to the focal length (pixels). With this ratio, a texel at a
distance of 1 m covers slightly more than one pixel."""
_MAX_TEXELS_PER_M = 500.0
"""Maximum texture detail (texels per metre). The limit saves memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """The person who wears the cameras.

    Attributes:
        motion: The moving body, centred in the room.
        mounts: True mounts of the cameras on the body.
        seeds: Independent random seeds by purpose, for example ``room``, ``clothes`` or ``images``.
    """

    motion: MovingBody
    mounts: tuple[Mount, ...]
    seeds: dict[str, np.random.SeedSequence]


def draw_subject(options: SynthOptions) -> Subject:
    """Draw body, motion and mounts at random from the seed of the options.

    Raises:
        JobError: The BVH file cannot be used.
    """
    names = ("body", "walk", "mounts", "room", "clothes", "images", "poses", "drops", "posture", "imu")
    children = np.random.SeedSequence(options.seed).spawn(len(names))
    seeds = dict(zip(names, children, strict=True))
    clocks = true_clocks(options)
    first_s, last_s = first_and_last_s(options, clocks)
    length_s = max(options.seconds, last_s)
    sigmas = options.mount_sigma_deg, options.mount_sigma_m
    mount_rng = np.random.default_rng(seeds["mounts"])
    inward_deg = options.hands_inward_deg
    motion: MovingBody
    if options.motion is not None:
        # With free clocks, the earliest camera starts at the start of the used part of the file.
        lead_s = max(0.0, -first_s) if options.clocks == "free" else 0.0
        start_s = options.motion_start_s + lead_s
        motion = load_clip(options.motion, start_s, length_s - 1.0 / options.fps, options.subject_height_m)
        mounts = draw_mounts(options.cameras, motion.skeleton, sigmas, mount_rng, inward_deg)
    else:
        body = draw_body(
            options.subject_height_m, options.proportion_range, np.random.default_rng(seeds["body"])
        )
        mounts = draw_mounts(options.cameras, body, sigmas, mount_rng, inward_deg)
        style = WalkStyle(
            t_pose_s=options.t_pose_s,
            arms_ahead=options.arms_ahead,
            on_the_spot=options.on_the_spot,
            still=options.still,
            presses=(
                *(
                    find_press(mount, body, *options.pressed_s[mount.camera])
                    for mount in mounts
                    if mount.camera in options.pressed_s
                ),
                *(carrying(side.capitalize(), *span) for side, span in options.carried_s.items()),
            ),
            posture=draw_posture(options.posture_spread, np.random.default_rng(seeds["posture"])),
        )
        kind = StanceWalk if options.walk == "gait" else Walk
        motion = kind(body, length_s, style, np.random.default_rng(seeds["walk"]))
    if options.hand_in_view:
        mounts = tuple(
            with_hand_in_view(mount, motion.skeleton, options.camera(), options.hand_in_view)
            for mount in mounts
        )
    return Subject(motion=motion, mounts=mounts, seeds=seeds)


def write_synthetic_capture(options: SynthOptions, out_dir: Path, context: StageContext) -> None:
    """Write a synthetic capture to `out_dir`, as `bodycap_batch.synthetic.synthesise` describes."""
    if out_dir.exists() and not (out_dir.is_dir() and not any(out_dir.iterdir())):
        raise JobError(
            "this folder exists already", path=out_dir, hint="choose another folder, or delete this folder"
        )
    subject = draw_subject(options)
    with _atomic_folder(out_dir) as folder:
        write_calibration(folder, options)
        kept = _draw_kept_frames(options, subject)
        for mount in subject.mounts:
            _write_camera_truth(folder, options, subject, mount, kept[mount.camera])
        if not options.poses_only:
            _write_videos(folder, options, subject, kept, context)
        write_truth(folder, options, subject.motion, subject.mounts)


def _draw_kept_frames(options: SynthOptions, subject: Subject) -> dict[str, BoolArray]:
    """Draw at random which frames each camera delivers, as one mask for each camera.

    The first and the last frame are always delivered.
    """
    rng = np.random.default_rng(subject.seeds["drops"])
    out = {}
    for camera in options.cameras:
        kept = rng.uniform(size=len(frame_times_ns(options, camera))) >= options.drop_frames
        kept[[0, -1]] = True
        out[camera] = kept
    return out


def frame_times_ns(options: SynthOptions, camera: str) -> IntArray:
    """Return the time of each frame on the camera's own clock, nanoseconds."""
    rate = options.rate_fps(camera)
    count = max(1, round(options.seconds * rate))
    return np.asarray(np.round(np.arange(count) * (1e9 / rate)), dtype=np.int64)


def _write_camera_truth(
    folder: Path, options: SynthOptions, subject: Subject, mount: Mount, kept: BoolArray
) -> None:
    """Write what is known of a camera besides its video: paths, timestamps of frames, sensor, noisy poses."""
    camera, number = mount.camera, options.cameras.index(mount.camera)
    times_ns = frame_times_ns(options, camera)[kept]
    clock = true_clocks(options)[camera]

    def lens_at(camera_s: FloatArray) -> FloatArray:
        return camera_poses_at(subject.motion, mount, clock.common_s(camera_s))

    def rng(purpose: str) -> np.random.Generator:
        return np.random.default_rng([number, *subject.seeds[purpose].generate_state(4).tolist()])

    def write(folder_name: str, at_ns: IntArray, poses: FloatArray, note: str) -> None:
        timed = TimedPoses(times_ns=at_ns, world_from_cam=poses)
        write_tum(folder / folder_name / f"{camera}.tum", timed, (note,))

    common_s = clock.common_s(seconds_from_ns(times_ns))
    poses = picture_poses_at(subject.motion, mount, common_s, stabilised=options.stabilised != "none")
    write("gt", times_ns, poses, "world_from_camera, the camera's own clock")
    if options.exposure_s:
        mean = mean_poses(lens_at, seconds_from_ns(times_ns), options.exposure_s)
        note = "world_from_camera, mean over the exposure, the camera's own clock"
        write("gt/exposure", times_ns, mean, note)
    if options.stabilised != "none":
        note = "world_from_lens of the camera that stabilises its pictures, the camera's own clock"
        write("gt/lens", times_ns, lens_at(seconds_from_ns(times_ns)), note)
    if not kept.all():
        seconds = (f"{seconds_text(int(time))}\n" for time in times_ns)
        write_text(folder / f"{camera}.timestamps.txt", "".join(seconds))
    if options.poses_only:
        measured, present = disturb_poses(poses, options, rng("poses"))
        note = "world_from_camera with noise, gross errors and gaps; the camera's own clock"
        write("poses", times_ns[present], measured[present], note)
    if options.imu is not None:
        write_imu(folder, camera, options.imu, options.seconds, lens_at, rng("imu"))


def _write_videos(
    folder: Path, options: SynthOptions, subject: Subject, kept: dict[str, BoolArray], context: StageContext
) -> None:
    """Render and encode the video of every camera."""
    total, done = sum(int(frames.sum()) for frames in kept.values()), 0
    context.progress(0, total, "room")
    renderers = build_renderers(options, subject)
    clocks = true_clocks(options)
    sounds = CameraSounds(options, subject.motion) if options.sound else None
    with _single_opencv_thread(), ThreadPoolExecutor(max_workers=max(1, context.threads)) as pool:
        for renderer, seed in zip(renderers, subject.seeds["images"].spawn(len(renderers)), strict=True):
            camera = renderer.mount.camera
            frames = np.flatnonzero(kept[camera])
            times_s = clocks[camera].common_s(seconds_from_ns(frame_times_ns(options, camera)[frames]))
            sensor = Sensor(options.noise, 3 * options.width * options.height, seed)
            exposure = AutoExposure(options.auto_exposure, 1.0 / options.fps)
            with VideoWriter(
                folder / f"{camera}.mp4",
                options.fps,
                (options.width, options.height),
                options.quality,
                sound=None if sounds is None else sounds.of_camera(camera),
                bit_rate_mbps=options.bit_rate_mbps,
                data=_orientations(options, renderer, times_s),
            ) as video:
                images = _render_in_order(pool, renderer.render, times_s.tolist(), context)
                for frame, image in zip(frames.tolist(), images, strict=True):
                    video.add(sensor.record(image, frame, exposure.gain(image)))
                    done += 1
                    context.progress(done, total, camera)
            if options.stabilised != "none":
                append_settings(folder / f"{camera}.mp4", GOPRO_SETTINGS)


def _orientations(options: SynthOptions, renderer: MovingCamera, common_s: FloatArray) -> DataTrack | None:
    """Return the record of the orientations of stabilised pictures; None without one.

    Args:
        options: The options of the capture.
        renderer: The camera.
        common_s: (T,) common times of the pictures, seconds.
    """
    if options.stabilised != "recorded":
        return None
    cameras = camera_poses_at(renderer.motion, renderer.mount, common_s)
    turns = turn_of_pictures(lambda t_s: camera_poses_at(renderer.motion, renderer.mount, t_s), common_s)
    in_file_ns = np.round(np.arange(len(common_s)) * (1e9 / options.fps)).astype(np.int64)
    return orientation_track(in_file_ns, cameras, turns)


def build_renderers(options: SynthOptions, subject: Subject) -> list[MovingCamera]:
    """Build the room around the motion, and return a renderer for each camera."""
    camera = options.camera()
    texels_per_m = min(_TEXELS_PER_PIXEL_M * camera.focal_px, _MAX_TEXELS_PER_M)
    extent_m = walked_extent_m(options, subject)
    surfaces = build_room(extent_m, texels_per_m, subject.seeds["room"], options)
    images = [surface.image for surface in surfaces]
    patterned = options.clothes == "patterned"
    wearer = (
        Wearer(
            subject.motion.skeleton,
            subject.seeds["clothes"],
            patterned=patterned,
            carrying=tuple(side.capitalize() for side in options.carried_s),
        )
        if options.body_in_view
        else None
    )
    atlas = Atlas(images + (wearer.images if wearer else []))
    clothes = atlas.origins[len(images) :]
    room = MovingPart(ROOM, triangles_from_surfaces(surfaces, atlas.origins[: len(images)]))
    return [
        MovingCamera(
            motion=subject.motion,
            mount=mount,
            camera=camera,
            parts=[room, *(MovingPart(*limb) for limb in (wearer.parts(clothes, mount) if wearer else []))],
            atlas=atlas,
            exposure_s=options.exposure_s,
            rolling_shutter_s=options.rolling_shutter_s,
            stabilised=options.stabilised != "none",
        )
        for mount in subject.mounts
    ]


def walked_extent_m(options: SynthOptions, subject: Subject) -> tuple[float, float]:
    """Return the maximum distances (metres) of the walk from the room's middle along x and y."""
    root_path = subject.motion.pose(seconds_from_ns(common_ticks_ns(options)))[0][:, :2]
    extent_x, extent_y = np.abs(root_path).max(axis=0).tolist()
    return extent_x, extent_y


def _render_in_order(
    pool: ThreadPoolExecutor, render: Callable[[float], Bytes], times_s: list[float], context: StageContext
) -> Iterator[Bytes]:
    """Render the frames of several times in several threads, and yield them in order.

    Only a few frames are in memory at a time.
    """
    waiting: deque[Future[Bytes]] = deque()
    try:
        for time_s in times_s:
            waiting.append(pool.submit(render, time_s))
            if len(waiting) > 2 * max(1, context.threads):
                context.check_cancelled()
                yield waiting.popleft().result()
        while waiting:
            context.check_cancelled()
            yield waiting.popleft().result()
    finally:
        for future in waiting:
            future.cancel()


@contextmanager
def _single_opencv_thread() -> Iterator[None]:
    """Limit OpenCV to one thread while several threads render frames."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def _atomic_folder(out_dir: Path) -> Iterator[Path]:
    """Yield a temporary folder. Rename it to `out_dir` if the block succeeds; otherwise delete it.

    Raises:
        StoreError: A file or folder cannot be written to the disk.
    """
    folder = out_dir.with_name(f".{out_dir.name}.{secrets.token_hex(4)}")
    try:
        (folder / "gt").mkdir(parents=True)
        yield folder
        folder.rename(out_dir)
    except OSError as error:
        raise store_error_from_os_error(error, out_dir) from error
    except StoreError as error:
        # Replace the temporary folder in the error by the requested folder: the temporary folder is deleted.
        path = Path(error.path or out_dir)
        named = out_dir / path.relative_to(folder) if path.is_relative_to(folder) else path
        raise StoreError(error.message, path=named, hint=error.hint) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
