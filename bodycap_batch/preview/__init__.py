"""``preview.mp4``: the body in its room beside the source videos, everything solved drawn into them."""

from bodycap_batch.preview.stage import PreviewInputs, render_preview

__all__ = ["PreviewInputs", "render_preview"]
