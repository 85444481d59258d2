"""What tests of pictures share: how alike two are, and whether this machine can draw any."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from vecenv.render import gl


def can_draw() -> bool:
    """Whether a GL context can be had here."""
    return bool(gl.available())


needs_gl = pytest.mark.skipif(not can_draw(), reason="no GL library (EGL or OSMesa) is installed")


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two uint8 images, dB; infinite when they are equal."""
    error = np.mean((a.astype(float) - b.astype(float)) ** 2)
    return float("inf") if error == 0 else float(10 * np.log10(255.0**2 / error))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity of two uint8 images' luma (Wang et al. 2004, Gaussian window of 1.5 pixels)."""
    x, y = (image @ np.array([0.299, 0.587, 0.114]) for image in (a, b))

    def mean(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, 1.5, truncate=3.5)

    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    return float(np.mean((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))))
