"""The typed options of each stage. The key of an artefact holds only the options of the artefact's stage."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from bodycap_batch.config.bounds import MAX_CAPTURE_S, MAX_FPS, MAX_MOTION_FPS, MAX_SEED, MIN_FPS
from bodycap_batch.config.export_targets import Target, export_target

FrameName = Annotated[str, StringConstraints(pattern=r"^.+:\d{1,9}$")]
"""Name of one frame: ``camera:frame``. Frame 0 is the first frame of the camera's first chapter; the count
continues through all chapters. ``start_s`` does not change the count."""

FileFormat = Literal[
    "ply", "bvh", "glb", "fbx", "usd", "abc", "chan", "c3d", "trc", "tum", "csv", "npz", "colmap", "blender"
]
NamePreset = Literal["hik", "mixamo", "biped", "unreal", "unity"]
RootMode = Literal["hips", "ground", "in_place"]


_MAX_PARALLAX_PX = 640.0
"""Maximum parallax (pixels) that causes a keyframe: the long side of the image in which it is measured."""
_MAX_WINDOW = 60
"""Maximum number of frames from which the sharpest one is selected: two seconds of usual video. All these
frames are in memory. Evidence: none."""
_MAX_FEATURES = 32_768
"""Maximum number of features of a keyframe. It is four times the default of COLMAP. The matching of two
keyframes needs a matrix with a row and a column for each feature: 4 GB for this number."""
_MAX_ROUNDS = 100
"""Maximum number of rounds that extend the map. A map that still gains frames after ten rounds was not
observed. Evidence: none."""
_MAX_INLIERS = 10_000
"""Maximum of the smallest number of inliers of a frame. A frame has fewer tracks. Evidence: none."""
_MAX_SQUARES = 100
"""Maximum number of squares along a side of a marker board. A board that fills an image of 960 px then has
squares of 10 px, and smaller markers cannot be read. Evidence: none."""
_DISTANCE_M = (1e-3, 1e4)
"""Minimum and maximum distance (metres) between two frames that sets the scale. A distance below 1 mm cannot
be measured; a walk of 10 km takes two hours. Evidence: none."""
_CUTOFF_HZ = (0.1, MAX_FPS / 2.0)
"""Minimum and maximum cutoff frequency (Hz) of the low-pass filter. A body moves faster than the minimum; the
maximum is the Nyquist frequency of the maximum rate."""


class Options(BaseModel):
    """Base class of all blocks of a job: immutable; unknown keys, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class KeyframeOptions(Options):
    """Options of stage 1, the selection of keyframes."""

    parallax_px: float = Field(
        15.0,
        gt=0,
        le=_MAX_PARALLAX_PX,
        description=(
            "a frame becomes a keyframe if its parallax is larger than this; in pixels of a picture"
            " with a long side of 640 px; the effect of camera rotation is subtracted"
        ),
    )
    min_survival: float = Field(
        0.5,
        gt=0,
        lt=1,
        description="a frame becomes a keyframe if less than this share of the last keyframe's tracks is "
        "still visible",
    )
    max_gap_s: float = Field(
        0.5, gt=0, le=MAX_CAPTURE_S, description="maximum time between two keyframes, in seconds"
    )
    min_gap_s: float = Field(
        0.05, ge=0, le=MAX_CAPTURE_S, description="minimum time between two keyframes, in seconds"
    )
    max_per_min: float | None = Field(
        None,
        gt=0,
        le=60.0 * MAX_FPS,
        description=(
            "maximum number of keyframes per minute; the keyframes with the least new content are left out"
        ),
    )
    window: int = Field(
        4,
        ge=1,
        le=_MAX_WINDOW,
        description=(
            "number of latest frames to choose from: the sharpest of these frames becomes the keyframe"
        ),
    )


class MapOptions(Options):
    """Options of stage 2, mapping."""

    features: int = Field(
        512,
        ge=128,
        le=_MAX_FEATURES,
        description="maximum number of SIFT features of a keyframe with enough matches; the strongest ones "
        "are used; a keyframe with few matches gets up to four times as many",
    )
    pairs: Literal["retrieval", "exhaustive"] = Field(
        "retrieval",
        description="pairs of keyframes to match; retrieval: neighbouring and similar keyframes, "
        "exhaustive: all pairs",
    )
    init_frames: tuple[FrameName, FrameName] | None = Field(
        None,
        description="two frames from which the map is started, each written as camera:frame; default: "
        "selected automatically",
    )
    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of all random numbers")
    min_coverage: float = Field(
        0.1,
        ge=0,
        le=1,
        description="the job stops if the map contains a smaller share of the keyframes with texture",
    )


class RegistrationOptions(Options):
    """Options of stage 3, the registration of every frame."""

    rounds: int = Field(
        3,
        ge=0,
        le=_MAX_ROUNDS,
        description="maximum number of times that the map is extended to localise lost frames",
    )
    min_inliers: int = Field(
        15,
        ge=4,
        le=_MAX_INLIERS,
        description="minimum number of map points that must agree with the pose of a frame (PnP inliers)",
    )
    max_sigma_depth: float = Field(
        0.015,
        gt=0,
        le=1,
        description=(
            "maximum standard deviation of a camera position, divided by the median depth of the "
            "visible points"
        ),
    )


MARKER_COUNTS = {
    **{f"{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "ARUCO_ORIGINAL": 1024,
    "ARUCO_MIP_36H12": 250,
    "APRILTAG_16H5": 30,
    "APRILTAG_25H9": 35,
    "APRILTAG_36H10": 2320,
    "APRILTAG_36H11": 587,
}
"""Number of markers in each of OpenCV's families of markers, by name of the family."""


class MarkerBoard(Options):
    """A flat board in the room, with squares of known size."""

    square_m: float = Field(
        ge=1e-3, le=2, description="side of one square in metres, as measured on the printed board"
    )
    columns: int = Field(
        ge=3, le=_MAX_SQUARES, description="chessboard: inner corners in a row; ChArUco: squares in a row"
    )
    rows: int = Field(
        ge=3,
        le=_MAX_SQUARES,
        description="chessboard: inner corners in a column; ChArUco: squares in a column",
    )
    kind: Literal["charuco", "chessboard"] = Field("charuco", description="kind of board")
    dictionary: str = Field("4X4_50", description="ChArUco: name of the family of markers, as in OpenCV")
    marker: float = Field(
        0.75, gt=0.1, lt=1, description="ChArUco: side of a marker divided by the side of a square"
    )
    legacy: bool = Field(
        False, description="ChArUco: true if the board was made with OpenCV before version 4.6"
    )
    placed: Literal["lying", "hanging"] | None = Field(
        None,
        description="lying: the board lies on a level floor or table; hanging: the board is attached to a "
        "wall, with two edges horizontal; if this is given, the board also determines the vertical",
    )


_Distance = Annotated[float, Field(ge=_DISTANCE_M[0], le=_DISTANCE_M[1])]


class MergeOptions(Options):
    """Options of stage 4, the motion of the skeleton."""

    fps: float | None = Field(
        None,
        ge=MIN_FPS,
        le=MAX_MOTION_FPS,
        description="rate of the motion in frames per second; default: the rate of the torso camera",
    )
    max_gap_s: float = Field(
        1.0,
        gt=0,
        le=MAX_CAPTURE_S,
        description=(
            "a gap between two poses of a camera is marked as filled if it is longer than this time"
            " in seconds"
        ),
    )
    t_pose_s: float | None = Field(
        None,
        ge=0,
        le=MAX_CAPTURE_S,
        description=(
            "duration of the T-pose at the start, in seconds; default: detected automatically; 0: "
            "there is no T-pose"
        ),
    )
    camera_paths: Literal["joint", "measured"] = Field(
        "joint",
        description="camera positions in the results; joint: solved together with the body, measured: "
        "as registered in the map",
    )
    foot_contact: bool = Field(
        True,
        description="prevent feet that stand on the floor from sliding; this needs cameras on the shins "
        "or the feet",
    )
    known_distance: tuple[FrameName, FrameName, _Distance] | None = Field(
        None,
        description=(
            "two frames, each written as camera:frame, and the distance in metres between the "
            "camera positions in these frames; sets the scale"
        ),
    )
    marker_board: MarkerBoard | None = Field(
        None,
        description="a board in the room with squares of known size, which the cameras see; sets the scale",
    )


class TelemetryOptions(Options):
    """Uses of the inertial sensors of the cameras. Without telemetry, these options have no effect."""

    gravity: bool = Field(True, description="the accelerometers determine the vertical of the world")
    tracking: bool = Field(
        True,
        description="the gyroscopes measure how the cameras turn from frame to frame and from row to row",
    )
    gps: bool = Field(
        True, description="GPS positions give the place of the world on the Earth; the scale is not changed"
    )
    smoothing: bool = Field(
        True,
        description="the poses of the pictures are solved again together with the inertial samples, and "
        "poses that contradict them are replaced",
    )
    gaps: bool = Field(
        True,
        description="frames that are lost for up to a second get poses from the inertial sensor, with the "
        "status INERTIAL",
    )


class ExportOptions(Options):
    """Options of stage 5, the export of the result files.

    A target sets the other options to what one program expects. An option that the job states is kept.
    """

    target: Target | None = Field(
        None,
        description="program that the files are made for; sets formats, names, root, units and tpose, "
        "except those that the job states",
    )
    formats: tuple[FileFormat, ...] = Field(
        ("ply", "bvh", "glb", "tum", "csv", "colmap", "blender"),
        description="files to write, as a list: [ply, bvh]",
    )
    units: Literal["cm", "m"] = Field("cm", description="unit of length in the BVH file")
    names: NamePreset = Field(
        "hik", description="set of joint names, and number of spine joints, in the files for animation"
    )
    root: RootMode = Field(
        "hips",
        description="joint that contains the travel of the person; hips: the hips, ground: an additional "
        "root on the ground, in_place: no joint, so that the person stays in place",
    )
    fps: float | None = Field(
        None,
        ge=MIN_FPS,
        le=MAX_FPS,
        description="rate of the files for animation, in frames per second; default: the rate of the motion",
    )
    tpose: bool = Field(False, description="insert a T-pose as frame 0 of the files for animation")
    smoothing_hz: float | None = Field(
        None,
        ge=_CUTOFF_HZ[0],
        le=_CUTOFF_HZ[1],
        description=(
            "cutoff frequency in Hz of a low-pass filter for the files for animation, usually 6; "
            "default: no filter"
        ),
    )
    euler_order: Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = Field(
        "ZXY", description="rotation channels"
    )
    hierarchy: Literal["full", "solved"] = Field(
        "full", description="joints in the files: the whole body, or only the solved joints"
    )
    filled_markers: bool = Field(
        False, description="write joints that no camera measured to the TRC file; default: they are left out"
    )
    preview: bool = Field(
        True, description="write preview.mp4, which shows the body in the room next to the videos"
    )

    @model_validator(mode="after")
    def _apply_target(self) -> ExportOptions:
        """Set the options that the target gives and that are not stated."""
        if self.target is not None:
            for name, value in export_target(self.target).options.items():
                if name not in self.model_fields_set:
                    object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)
        return self
