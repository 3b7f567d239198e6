"""When a camera's lost frames are looked for once more: what runs it and what computes have to agree."""

from __future__ import annotations

LEAST_LOST, LEAST_POSED = 3, 20
"""They are where there are so many, among so many with poses: fewer are not worth decoding the keyframes of
all cameras again; from fewer poses nobody knows how it moves."""
