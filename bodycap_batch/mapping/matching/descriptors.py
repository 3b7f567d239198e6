"""RootSIFT descriptors: their types, their length, and the limits for a match of two descriptors."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

ByteDescriptors = npt.NDArray[np.uint8]
"""(N,128) root-normalised SIFT descriptors as bytes, as the database stores them."""

FloatDescriptors = npt.NDArray[np.float32]
"""(N,128) root-normalised SIFT descriptors as float32, for matrix products."""

DESCRIPTOR_NORM = 512.0
"""Euclidean length of a descriptor, in the unit of its bytes. With this length, the scalar products of
descriptors are whole numbers below 2^24. A float32 sum of such numbers is exact, in any order of its terms.
So the matches do not depend on the number of threads or on the library."""

MAX_MATCH_ANGLE_RAD = 0.7
"""Maximum angle (radians) between two matching descriptors. COLMAP's default."""

MAX_RATIO = 0.8
"""Maximum ratio of two angles: the angle to the nearest descriptor over the angle to the second nearest
descriptor. COLMAP's default."""
