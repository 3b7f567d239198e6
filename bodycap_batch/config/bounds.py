"""Bounds of the numbers in a job file that several options share."""

MIN_FPS = 1.0
"""Minimum rate (ticks per second) of a motion. A slower motion does not show the movement of a body.
Evidence: none."""
MAX_FPS = 1000.0
"""Maximum rate (frames or ticks per second) of a video or a motion. Cameras that can be worn record at most
960 frames per second."""
MAX_MOTION_FPS = 240.0
"""Maximum rate (ticks per second) at which the motion is solved, unless a camera is faster: the rate of fast
worn cameras. The memory grows with the rate. Evidence: docs/decisions/check.md."""
MAX_TICKS = 432_000
"""Maximum number of ticks of a motion whose rate the job gives: four hours at 30 ticks per second. Files with
more ticks than that need gigabytes of memory. Evidence: docs/decisions/check.md."""
MAX_CAPTURE_S = 86_400.0
"""Maximum duration (seconds) of a part of a capture: one day. No worn camera records for a day without a
change of its battery. Evidence: none."""
MAX_TIME_S = 4e9
"""Maximum absolute value (seconds) of a time in a job. Unix times are smaller than this maximum. The sum of
two times of this size, in nanoseconds, fits into int64."""
MAX_SEED = 2**31 - 1
"""Maximum seed of random choices (no unit): the largest value of the type int of COLMAP and OpenCV."""
MAX_REACH_M = 10.0
"""Maximum distance (metres) of a camera from the joint of its bone, along each axis, and maximum sigma of
this distance. A body with a pole in its hand is smaller. Evidence: none."""
MIN_SIGMA_DEG = 1e-3
"""Minimum sigma (degrees) of a rotation. No mount is measured more exactly, and the square of the inverse
must be finite. Evidence: none."""
MIN_SIGMA_M = 1e-5
"""Minimum sigma (metres) of a position. No mount is measured more exactly, and the square of the inverse must
be finite. Evidence: none."""
MAX_ANGLE_DEG = 180.0
"""Maximum sigma (degrees) of a rotation: half a turn. A larger sigma says no more."""
MAX_LENS_PARAMETER = 1e6
"""Maximum absolute value of a lens parameter (pixels, or no unit for distortion). An image of 65,536 pixels
with a field of view of 4 degrees has a focal length of 940,000 pixels."""
MAX_ROLLING_SHUTTER_S = 1.0
"""Maximum time (seconds) from the exposure of the first row to the exposure of the last row. Sensors take
less than a tenth of this time. Evidence: none."""
MAX_DRIFT_PPM = 1e5
"""Maximum absolute drift (parts per million) of a clock. Crystals drift by less than 100 ppm, and software
clocks of webcams by less than a tenth. Evidence: none."""
ASPECT_TOLERANCE = 0.004
"""Maximum relative difference between two aspect ratios that are treated as equal (no unit). Origin: one
pixel in an image of 640×480, because encoders round image sizes to even numbers."""
