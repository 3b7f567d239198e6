"""``preview.mp4``: the body in its room next to the source videos, with the results drawn into them."""

from bodycap_batch.preview.preview_film import PreviewInputs, render_preview

__all__ = ["PreviewInputs", "render_preview"]
