"""Settled starts: stored init states after ten idle control ticks, for any fixture poses.

Init states are stored before things have settled, and LIBERO's evaluations let them settle with the arm idle. With
fixtures at the centres of their regions the result ships with the package (``vecenv.libero.tasks.settled``); for any
other fixture poses it is computed by native physics with published contacts, upstream's geometry and the stored start,
once, and kept in the user's cache folder under a name that is a hash of everything it depends on.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from pathlib import Path

import mujoco
import numpy as np

from vecenv.errors import SimulationError
from vecenv.libero.physics.base import SETTLE_ACTION, SETTLE_TICKS, Start
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.settled import TIME
from vecenv.util import caching

# Part of the key: increased when the computation changes.
VERSION = 1


class SettlingError(SimulationError):
    """A start that cannot be settled; the message names the row and the fault."""


def at_rest(scene: Scene, starts: Start) -> Start:
    """The starts after settling.

    Args:
        scene: the scene, with upstream's geometry and published contacts.
        starts: n stored starts with their fixture poses.

    Raises:
        SettlingError: the physics of one failed.
    """
    keys = _keys(scene.model, starts)
    states = [_read(key, scene.model.nq + scene.model.nv) for key in keys]
    missing = [row for row, state in enumerate(states) if state is None]
    if missing:
        for row, state in zip(missing, _settle(scene, starts.select(np.array(missing))), strict=True):
            states[row] = state
            _write(keys[row], state)
    settled = np.stack([state for state in states if state is not None])
    return Start(
        qpos=settled[:, : scene.model.nq],
        qvel=settled[:, scene.model.nq :],
        bodies=starts.bodies,
        body_pos=starts.body_pos,
        body_quat=starts.body_quat,
        time=TIME,
        settled=True,
    )


def _settle(scene: Scene, starts: Start) -> np.ndarray:
    """States after settling, [n, nq + nv]."""
    from vecenv.libero.physics.native import NativePhysics

    count = len(starts.qpos)
    physics = NativePhysics([scene], np.zeros(count, int))
    try:
        (group,) = physics.groups
        physics.place(group, np.arange(count), starts)
        for _ in range(SETTLE_TICKS):
            physics.control_step(np.tile(SETTLE_ACTION, (count, 1)), np.ones(count, bool))
        if physics.faults:
            row, fault = min(physics.faults.items())
            raise SettlingError(f"start {row} of {count} in {scene.problem_name} does not settle: {fault}")
        return np.concatenate([group.qpos, group.qvel], axis=1)
    finally:
        physics.close()


def _keys(model: mujoco.MjModel, starts: Start) -> list[str]:
    """For each start, a hash of everything its settled state depends on."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    common = hashlib.sha256(repr((VERSION, SETTLE_TICKS, SETTLE_ACTION.tolist(), mujoco.__version__)).encode())
    common.update(buffer.tobytes())
    common.update(np.ascontiguousarray(starts.bodies).tobytes())
    keys = []
    for row in zip(starts.qpos, starts.qvel, starts.body_pos, starts.body_quat, strict=True):
        digest = common.copy()
        for array in row:
            digest.update(np.ascontiguousarray(array).tobytes())
        keys.append(digest.hexdigest())
    return keys


def _path(key: str) -> Path | None:
    folder = caching.folder("settled")
    return None if folder is None else folder / f"{key}.state"


def _read(key: str, width: int) -> np.ndarray | None:
    """A state [nq + nv] from the cache; None if it is missing or damaged."""
    path = _path(key)
    data = None if path is None else caching.unsealed(path)
    if data is None:
        return None
    with contextlib.suppress(OSError, ValueError, EOFError):
        state = np.load(io.BytesIO(data), allow_pickle=False)
        if state.shape == (width,) and state.dtype == float and np.isfinite(state).all():
            return state
    caching.damaged(Path(str(path)), "not a state of the scene")
    return None


def _write(key: str, state: np.ndarray) -> None:
    path, buffer = _path(key), io.BytesIO()
    if path is None:
        return
    np.save(buffer, state)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        caching.write_file(path, caching.sealed(buffer.getvalue()))
