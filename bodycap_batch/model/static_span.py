"""The minimum time span for which a single camera must see a point of the static scene."""

MIN_STATIC_SPAN_NS = 1_000_000_000
"""Minimum time span, nanoseconds, between the first and the last observation of a static point.

The minimum is used for a point that only one camera sees. If the camera sees the point for a longer time,
the point is treated as a part of the static scene. A point with a shorter time may move with the wearer.
Origin: the wearer's sleeve can be in view for longer than the minimum. But a point on the sleeve seldom stays
in one place for such a long time. Evidence: none.
"""
