"""Colours of pixels: hue, saturation and brightness, and words for hues."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from PIL import Image

# Words for colours and their hues, of a turn; where the first is larger the range goes through 0.
HUES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "red": (0.95, 0.04),
        "orange": (0.04, 0.11),
        "yellow": (0.11, 0.20),
        "green": (0.20, 0.45),
        "blue": (0.50, 0.70),
        "purple": (0.70, 0.82),
        "pink": (0.82, 0.95),
    }
)
# Less saturated or darker than this a pixel has no colour.
_LEAST_SATURATION, _LEAST_VALUE = 0.4, 0.3


def hsv(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Hue, saturation and value, 0 to 1, [H, W] each, of colours uint8 [H, W, 3]."""
    bands = Image.fromarray(np.ascontiguousarray(colors)).convert("HSV").split()
    hue, saturation, value = (np.asarray(band, float) / 255 for band in bands)
    return hue, saturation, value


def has_color(colors: np.ndarray, word: str) -> np.ndarray:
    """Which pixels have the colour that a word of :data:`HUES` means, bool [H, W]."""
    hue, saturation, value = hsv(colors)
    low, high = HUES[word]
    return ((hue - low) % 1.0 < (high - low) % 1.0) & (saturation > _LEAST_SATURATION) & (value > _LEAST_VALUE)
