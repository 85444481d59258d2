"""Camera images as servers expect them: resized with Pillow's bilinear filter, as the projects' own clients do it."""

from __future__ import annotations

import numpy as np

from vecenv.errors import MissingDependency

try:
    from PIL import Image
except ImportError as error:
    raise MissingDependency("Pillow is not installed: pip install 'vecenv[clients]'") from error


def resize_with_pad(images: np.ndarray, size: int) -> np.ndarray:
    """Scale images to fit a square and pad the shorter side with black, keeping the image in the centre.

    The result equals ``openpi_client.image_tools.resize_with_pad``.

    Args:
        images: uint8 [B, H, W, 3].
        size: side of the square, pixels; 0 leaves the images as they are.

    Returns:
        uint8 [B, size, size, 3].
    """
    height, width = images.shape[1:3]
    if size == 0 or (height, width) == (size, size):
        return images
    ratio = max(width, height) / size
    inner = (int(height / ratio), int(width / ratio))
    top, left = (size - inner[0]) // 2, (size - inner[1]) // 2
    padded = np.zeros((len(images), size, size, 3), np.uint8)
    padded[:, top : top + inner[0], left : left + inner[1]] = _scale(images, inner)
    return padded


def resize(images: np.ndarray, size: int) -> np.ndarray:
    """Scale images [B, H, W, 3] to a square without padding; 0 leaves them as they are."""
    if size == 0 or images.shape[1:3] == (size, size):
        return images
    return _scale(images, (size, size))


def _scale(images: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    scaled = [Image.fromarray(image).resize((shape[1], shape[0]), Image.Resampling.BILINEAR) for image in images]
    return np.stack([np.asarray(image) for image in scaled])
