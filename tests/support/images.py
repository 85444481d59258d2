"""What tests of images share: how alike two are, whether this machine can draw any, and upstream's own in files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render import gl
from vecenv.libero.render.options import POLICY_CAMERAS, RenderConfig
from vecenv.observations import Egocentric


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


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Upstream's images of a scene, in a file that ``benchmarks/images_peer.py`` wrote.

    Attributes:
        suite, task: the first task of the scene.
        images: of M moments and the two cameras of policies, as delivered, uint8 [M, 2, H, W, 3].
        qpos, qvel: states that they show, [M, nq], [M, nv].
        fixtures: where fixtures stand, by name: position [3], metres, and orientation wxyz [4].
    """

    suite: str
    task: int
    images: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    fixtures: Mapping[str, tuple[np.ndarray, np.ndarray]]

    @classmethod
    def load(cls, folder: Path, scene: str) -> Reference:
        """Read the file of a scene, ``"suite-task"``."""
        with np.load(folder / f"{scene}.npz", allow_pickle=False) as file:
            arrays = dict(file)
        suite, task = scene.rsplit("-", 1)
        poses = zip(arrays["fixture_pos"], arrays["fixture_quat"], strict=True)
        return cls(
            suite=suite,
            task=int(task),
            fixtures=dict(zip(arrays["fixtures"].tolist(), poses, strict=True)),
            **{name: arrays[name] for name in ("images", "qpos", "qvel")},
        )

    def drawn(self, render: RenderConfig, moments: Sequence[int] | None = None, **more: Any) -> np.ndarray:
        """The same images by vecenv, of some moments or all; ``more`` are options of ``vecenv.make``."""
        options: Any = {"fixtures": self.fixtures, "start": "raw", "settle_steps": 0, **more}
        env = vecenv.make(self.suite, task=self.task, episodes=[0], render=render, **options)
        assert isinstance(env, LiberoEnv)
        found = []
        try:
            env.reset()
            for moment in range(len(self.qpos)) if moments is None else moments:
                env.set_state(qpos=self.qpos[moment][None], qvel=self.qvel[moment][None])
                seen = env.observe_egocentric()
                assert isinstance(seen, Egocentric)
                found.append([seen.images[camera][0] for camera in POLICY_CAMERAS])
        finally:
            env.close()
        return np.array(found)


def agreement(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """PSNR of images [..., H, W, 3], dB, [...]; equal ones count as 100."""
    pairs = zip(ours.reshape(-1, *ours.shape[-3:]), theirs.reshape(-1, *theirs.shape[-3:]), strict=True)
    return np.array([min(psnr(a, b), 100.0) for a, b in pairs]).reshape(ours.shape[:-3])
