"""Record ideal images as a sensor does: white balance, noise and automatic exposure."""

from __future__ import annotations

import cv2
import numpy as np

from bodycap_batch.synthetic.atlas import Bytes

_NOISE_SURPLUS = 1 << 21
"""Number of additional random values in the noise array that all frames share. The noise of each frame is a
section of the array that starts at a random index below this number."""
_EXPOSURE_DELAY_S = 0.5
"""Time constant (seconds) of the automatic exposure. Evidence: none."""
_MID_GREY = 118.0
"""Grey level that the automatic exposure makes of the mean. Origin: 18 % of the light, in sRGB."""


class Sensor:
    """Sensor that converts ideal images into recorded images with white balance and noise, in 8 bits.

    Args:
        noise: Standard deviation (grey levels) of the noise at mid grey. Half of the variance at mid grey is
            read noise, which does not depend on the light; the other half is shot noise.
        size: Number of values of one image: height · width · 3.
        seed: Seed of white balance and noise.
    """

    def __init__(self, noise: float, size: int, seed: np.random.SeedSequence) -> None:
        self._seed, self._count = seed.generate_state(4).tolist(), size
        rng = np.random.default_rng(seed)
        gain = rng.uniform(0.94, 1.06, 3)
        self._mean = (np.arange(256)[:, None] * gain)[None].astype(np.float32)
        self._sigma = (noise * np.sqrt(0.5 + self._mean * (0.5 / 128.0))).astype(np.float32)
        # Drawing a million numbers for each frame would double the rendering time. So frames share one array.
        self._normal = rng.standard_normal(size + _NOISE_SURPLUS if noise > 0 else 0, dtype=np.float32)

    def record(self, image: Bytes, frame: int, gain: float = 1.0) -> Bytes:
        """Return an ideal image (H,W,3) as the sensor records it.

        The frame number determines the noise. The gain multiplies light and noise.
        """
        mean = cv2.LUT(image, self._mean)
        if gain != 1.0:
            mean = mean * np.float32(gain)
        if len(self._normal):
            start = int(np.random.default_rng([frame, *self._seed]).integers(0, _NOISE_SURPLUS))
            normal = self._normal[start : start + self._count].reshape(image.shape)
            noise = cv2.multiply(cv2.LUT(image, self._sigma), normal, scale=gain)
            return np.asarray(cv2.add(mean, noise, dtype=cv2.CV_8U))
        return np.asarray(cv2.convertScaleAbs(mean))


class AutoExposure:
    """Gain that follows the mean brightness of the images with a delay.

    Args:
        strength: 1: the mean brightness becomes mid grey; 0: the gain is always 1.
        interval_s: Time between two images, seconds.
    """

    def __init__(self, strength: float, interval_s: float) -> None:
        self._strength, self._share = strength, 1.0 - np.exp(-interval_s / _EXPOSURE_DELAY_S)
        self._log_gain: float | None = None

    def gain(self, image: Bytes) -> float:
        """Return the gain for the next ideal image (H,W,3)."""
        # The middle of the picture counts twice.
        height, width = image.shape[:2]
        middle = image[height // 4 : height - height // 4, width // 4 : width - width // 4]
        mean = (cv2.mean(image)[1] + cv2.mean(middle)[1]) / 2
        wanted = self._strength * float(np.log(_MID_GREY / max(mean, 8.0)))
        if self._log_gain is None:
            self._log_gain = wanted
        self._log_gain += self._share * (wanted - self._log_gain)
        return float(np.exp(self._log_gain))
