"""Load Open3D on import, so that a child process can load it while it waits for its task."""

from bodycap_batch.formats.open3d_loader import load_open3d

load_open3d()
