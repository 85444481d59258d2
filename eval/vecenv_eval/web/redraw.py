"""Images of recorded states: the scene is built here, put into a state, and drawn.

Recordings with states come in, images go out. One thread makes, draws and closes environments (GL contexts belong to a
thread); two are kept, for two runs side by side.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as Overdue
from dataclasses import replace
from typing import Any

import numpy as np

from vecenv.assets import AssetsMissing
from vecenv.contract import BatchEnv
from vecenv.errors import NotFound, ServiceError, VecenvError
from vecenv_eval.web.recorded import DemoFacts, Unreadable

# Seconds that a request waits; the scene goes on being built.
WAIT_S = 60.0
_KEPT = 2
# Requests that may wait for an image, so that there are threads for other requests.
_MOST_WAITING = 8


class Busy(ServiceError):
    """The image cannot be drawn yet."""


class Redrawer:
    """Draws recorded states."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="redraw")
        self._envs: OrderedDict[Any, BatchEnv] = OrderedDict()
        self._places = threading.Semaphore(_MOST_WAITING)

    def frame(self, recorded: DemoFacts, tick: int, camera: str) -> np.ndarray:
        """The image before a tick, uint8 [H, W, 3]; after the last action, the end.

        Args:
            recorded: a recording with states.
            tick: control ticks.
            camera: its name; ``"all"`` for the first one of the scene.

        Raises:
            NotFound: the scene has no such camera.
            Unreadable: the scene cannot be made here, or does not have such states.
            Busy: the scene is still being built, or too many wait.
        """
        if not self._places.acquire(blocking=False):
            raise Busy(f"{_MOST_WAITING} images wait to be drawn already: ask again")
        try:
            job = self._thread.submit(self._draw, recorded, tick, camera)
            try:
                return job.result(WAIT_S)
            except Overdue:
                job.cancel()
                raise Busy("the scene of this episode is still being built: ask again") from None
        finally:
            self._places.release()

    def close(self) -> None:
        """Close the environments."""
        self._thread.submit(self._close_all).result()
        self._thread.shutdown()

    def _draw(self, recorded: DemoFacts, tick: int, camera: str) -> np.ndarray:
        demo = recorded.demo
        try:
            row = demo.recorded_state(min(tick, len(demo)))
            if row is None:
                raise Unreadable(f"{demo.path.name}: {demo.name} has no recorded states")
            env = self._placed(demo)
            state = env.state()
            nq, nv = int(state.nq[0]), int(state.nv[0])
            if len(row) != 1 + nq + nv:
                raise Unreadable(
                    f"{demo.path.name}: a state of {demo.name} has {len(row)} numbers, the scene {1 + nq + nv}"
                )
            qpos, qvel = state.qpos.copy(), state.qvel.copy()
            qpos[0, :nq], qvel[0, :nv] = row[1 : 1 + nq], row[1 + nq :]
            env.set_state(replace(state, qpos=qpos, qvel=qvel, time=np.array(row[:1])))
            images = env.observe_egocentric().images
            names = list(images)
            if (camera != "all" and camera not in images) or not names:
                raise NotFound(f"the scene has no camera {camera!r:.50}; it has {', '.join(names) or 'none'}")
            return np.asarray(images[camera if camera in images else names[0]][0])
        except (Unreadable, NotFound):
            raise
        except (VecenvError, AssetsMissing, ValueError, RuntimeError, OSError, LookupError, TypeError) as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
            raise Unreadable(f"the scene of this episode cannot be drawn here: {reason}") from None

    def _placed(self, demo: Any) -> BatchEnv:
        from vecenv_eval.demos.replay import place

        key = (demo.path, demo.name, demo.path.stat().st_mtime_ns)
        if key not in self._envs:
            while len(self._envs) >= _KEPT:
                self._envs.popitem(last=False)[1].close()
            self._envs[key] = place(demo)
        self._envs.move_to_end(key)
        return self._envs[key]

    def _close_all(self) -> None:
        while self._envs:
            self._envs.popitem()[1].close()
