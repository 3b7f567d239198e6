"""RootSIFT descriptors: types, length, and the limits within which two of them match."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

ByteDescriptors = npt.NDArray[np.uint8]
"""(N,128) root-normalised SIFT descriptors, as the database stores them."""

FloatDescriptors = npt.NDArray[np.float32]
"""(N,128) the same descriptors as float32, ready for a matrix product."""

DESCRIPTOR_NORM = 512.0
"""Euclidean length of a descriptor in the unit of its bytes. Scalar products of two descriptors are whole
numbers below 2^24. A float32 adds these exactly in any order, so threads and libraries cannot change a
match."""

MAX_MATCH_ANGLE_RAD = 0.7
"""Largest angle between two matching descriptors, radians. COLMAP's default."""

MAX_RATIO = 0.8
"""Largest ratio of the angles to the nearest and to the second nearest descriptor. COLMAP's default."""
