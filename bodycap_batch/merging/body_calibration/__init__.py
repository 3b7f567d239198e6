"""Calibration of the body: mounts, metric scale and vertical, with their uncertainties."""
