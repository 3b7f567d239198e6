"""bodycap_batch: body motion and a map of the room from body-worn cameras."""

# zlib must be loaded before pycolmap: the other order aborts on the first compression.
import zlib  # noqa: F401

__version__ = "0.2.0"
