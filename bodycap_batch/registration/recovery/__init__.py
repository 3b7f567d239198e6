"""Poses of frames that tracking lost, by guided search from their neighbours."""
