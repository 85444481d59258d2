"""Arguments that every environment checks alike: the states of ``set_state``, the points of ``observe_objects``.

In: what a caller gives and the kind of error of the environment. Out: arrays that can be written into the physics.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vecenv.contract import State
from vecenv.util import inputs

# What points ``observe_objects`` samples.
POINTS = ("surface", "aabb")


def check_points(points: object, error: type[Exception]) -> None:
    """Check the option ``points`` of ``observe_objects``; raises ``error`` where it is none of ``POINTS``."""
    if not isinstance(points, str) or points not in POINTS:
        raise error(f"points={inputs.shown(points)}: expected {' or '.join(map(repr, POINTS))}")


def checked_state(
    state: object, arrays: Mapping[str, object], current: State, error: type[Exception], *, exactly: bool = False
) -> State:
    """What ``set_state`` writes: arrays of a state, or some of them with the present ones for the rest.

    Args:
        state: what a caller gave as a state; None for ``arrays``.
        arrays: ``qpos``, ``qvel`` and ``time`` by name, of which None leaves the present one.
        current: the present state.
        error: raised for a wrong type or shape, a number that is not finite, and the state of another placement.
        exactly: refuse rows that are longer than the present ones.

    Returns:
        float64 arrays; rows may be longer than the scenes need.
    """
    if state is not None and not isinstance(state, State):
        raise error(f"set_state: got a {type(state).__name__}; expected what state() returned, a vecenv.contract.State")
    given = dict(arrays) if state is None else {name: getattr(state, name) for name in ("qpos", "qvel", "time")}
    chosen: dict[str, np.ndarray] = {}
    for name, value in given.items():
        need: tuple[int, ...] = getattr(current, name).shape

        def fits(shape: tuple[int, ...], need: tuple[int, ...] = need) -> bool:
            long_enough = shape[1:] == need[1:] if exactly else shape[1:] >= need[1:]
            return len(shape) == len(need) and shape[:1] == need[:1] and long_enough

        what, right = f"set_state: {name}", f"numbers of shape {need}"
        chosen[name] = getattr(current, name) if value is None else inputs.floats(value, what, right, error, fits=fits)
        bad = ~np.isfinite(chosen[name]).reshape(len(chosen[name]), -1).all(axis=1)
        if bad.any():
            raise error(f"set_state: {name} of slot {int(bad.argmax())} is not finite; expected finite {right}")
    for name in ("nq", "nv") if state is not None else ():
        need = getattr(current, name).shape
        sizes = inputs.array(getattr(state, name), f"set_state: {name}", f"integers of shape {need}", error, kinds="iu")
        if sizes.shape != need or (sizes != getattr(current, name)).any():
            raise error(
                f"set_state: the state of other scenes: {name} is {inputs.shown(sizes.tolist())}, and this batch has "
                f"{inputs.shown(getattr(current, name).tolist())}"
            )
    return State(**chosen, nq=current.nq, nv=current.nv)
