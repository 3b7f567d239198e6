"""Importing this loads Open3D: for a child that has nothing else to do yet."""

from bodycap_batch.formats.open3d_loader import load_open3d

load_open3d()
