"""Render ``preview.mp4``: the body in its room, next to the source videos with overlays of the results."""

from bodycap_batch.preview.preview_film import PreviewInputs, render_preview

__all__ = ["PreviewInputs", "render_preview"]
