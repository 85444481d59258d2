"""Rendering when GL is missing, fails or runs out of contexts, and when renderers are closed."""

from __future__ import annotations

import ctypes
import os
import threading
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from support.box_scene import SIZE, rgb, shot
from support.images import needs_gl

from vecenv.libero.render import contexts, painter
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.gl import GlError, GlRenderer, available, choose

pytestmark = needs_gl


def test_without_gl_libraries_the_error_names_the_packages(monkeypatch: pytest.MonkeyPatch, stage: Stage) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(contexts, "_loads", lambda library: False)
    with pytest.raises(GlError, match=r"libegl1.*libosmesa6.*Physics does not need it"):
        GlRenderer([stage])
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(GlError, match=r"libOSMesa is not installed; apt-get install libosmesa6"):
        GlRenderer([stage])


def test_an_unknown_gl_is_refused(stage: Stage) -> None:
    with pytest.raises(GlError, match="gl='vulkan': expected one of egl, osmesa"):
        GlRenderer([stage], gl="vulkan")


def test_a_driver_that_refuses_is_named(monkeypatch: pytest.MonkeyPatch, stage: Stage) -> None:
    def refuse(*_: Any) -> Any:
        raise RuntimeError("no device")

    monkeypatch.setattr("importlib.import_module", refuse)
    with pytest.raises(GlError, match=r"gives no GL context \(RuntimeError: no device\).*vecenv doctor"):
        GlRenderer([stage], num_threads=1)


def test_fewer_contexts_than_threads_are_enough(monkeypatch: pytest.MonkeyPatch, stage: Stage) -> None:
    opened, real = [], painter.open_context

    def scarce(*arguments: Any) -> Any:
        if len(opened) == 2:
            raise GlError("no more contexts")
        opened.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(painter, "open_context", scarce)
    renderer = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=5)
    try:
        assert renderer.num_threads == 2
        assert rgb(renderer, *[shot(stage)] * 7).any(axis=(1, 2, 3)).all()
    finally:
        renderer.close()


def test_a_lost_context_is_made_anew(monkeypatch: pytest.MonkeyPatch, renderer: GlRenderer, stage: Stage) -> None:
    before, failures = rgb(renderer, shot(stage)), [0x507]
    real = mujoco.mjr_getError
    monkeypatch.setattr(mujoco, "mjr_getError", lambda: failures.pop() if failures else real())
    np.testing.assert_array_equal(rgb(renderer, shot(stage)), before)
    assert not failures


def test_gl_that_keeps_failing_is_an_error(monkeypatch: pytest.MonkeyPatch, renderer: GlRenderer, stage: Stage) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(mujoco, "mjr_getError", lambda: 0x507)
        with pytest.raises(GlError, match="failed 2 times"):
            rgb(renderer, shot(stage), shot(stage))
    assert rgb(renderer, shot(stage)).any()


def test_a_closed_renderer_says_so(stage: Stage) -> None:
    renderer = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=1)
    renderer.close()
    renderer.close()
    with pytest.raises(GlError, match="closed"):
        rgb(renderer, shot(stage))


def test_several_threads_may_ask_at_once(renderer: GlRenderer, stage: Stage) -> None:
    expected = rgb(renderer, shot(stage))
    seen: list[np.ndarray] = []
    askers = [threading.Thread(target=lambda: seen.append(rgb(renderer, shot(stage)))) for _ in range(4)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join()
    assert len(seen) == 4
    assert all(np.array_equal(image, expected) for image in seen)


def test_closing_ends_the_threads(stage: Stage) -> None:
    before = threading.active_count()
    for _ in range(20):
        renderer = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=2)
        rgb(renderer, shot(stage))
        renderer.close()
    assert threading.active_count() == before


@pytest.mark.heavy
def test_hundreds_of_renderers_leak_nothing(stage: Stage) -> None:
    def cycles(count: int) -> float:
        for _ in range(count):
            renderer = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=2)
            rgb(renderer, shot(stage), shot(stage))
            renderer.close()
        ctypes.CDLL("libc.so.6").malloc_trim(0)  # what is free goes back, or its pieces look like a leak
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmRSS:")[1].split()[0]) / 1024

    warm = cycles(50)
    after = cycles(300)
    print(f"{warm:.1f} MB after 50 cycles, {after:.1f} MB after 350")
    # 27 kB a renderer; an image of it that stayed would be more, its context megabytes.
    assert after - warm < 8


def test_every_other_context_in_software_gl_is_on_a_second_display() -> None:
    if not available() or choose() != "egl":
        pytest.skip("GL is not EGL here")
    from mujoco import egl

    from vecenv.libero.render import displays

    before = dict(os.environ)
    contexts = [displays.egl_context(8, 8) for _ in range(2)]
    assert dict(os.environ) == before
    kinds = {isinstance(context, egl.GLContext) for context in contexts}
    assert kinds == ({True, False} if displays._is_software(egl.EGL_DISPLAY) else {True})
    for context in contexts:
        context.make_current()
        context.free()
        context.free()
