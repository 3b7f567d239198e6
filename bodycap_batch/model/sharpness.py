"""Measure the sharpness of an image."""

from __future__ import annotations

from bodycap_batch.model.optical_flow import GreyImage


def sharpness(grey: GreyImage) -> float:
    """Return the sharpness of an image: the standard deviation of its second derivative.

    Blur decreases the sharpness. The values of neighbouring frames can be compared.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    import cv2

    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(cv2.meanStdDev(cv2.Laplacian(small, cv2.CV_16S, ksize=1))[1][0, 0])
