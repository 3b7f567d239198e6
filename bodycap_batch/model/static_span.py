"""The time span that separates static map points from points that move with the wearer."""

MIN_STATIC_SPAN_NS = 1_000_000_000
"""Nanoseconds. A point that one camera alone sees counts as static if it sees the point over a longer time.

Origin: the wearer's sleeve is in view for longer, but it seldom stays in one place. Evidence: none.
"""
