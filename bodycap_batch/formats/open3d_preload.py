"""Load Open3D on import. A child process imports this module while it waits for its task."""

from bodycap_batch.formats.open3d_loader import load_open3d

load_open3d()
