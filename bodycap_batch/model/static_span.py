"""The minimum time span for which a single camera must see a point of the static scene."""

MIN_STATIC_SPAN_NS = 1_000_000_000
"""Minimum time span, nanoseconds, between the first and the last observation of a static point.

The minimum is used for a point that only one camera sees. If this camera sees the point for a longer time, the
point is treated as a part of the static scene. Otherwise the point may move with the wearer. Origin: the
wearer's sleeve is in view for longer than this, but a point on the sleeve seldom stays in one place for so
long. Evidence: none.
"""
