"""The files of a run: its settings, checkpoints as ``.npz``, what acts, and the curve as CSV and as a picture."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from ppo_parts.config import Environment, PPOConfig, RunError
from ppo_parts.networks import Networks, Normalizer, init_networks, observed

SETTINGS, POLICY = "config.json", "policy.npz"

Row: TypeAlias = dict[str, float]


def settings(out: Path) -> dict[str, Any]:
    """Options of the run that is resumed."""
    try:
        found = json.loads((out / SETTINGS).read_text())
    except OSError as error:
        raise RunError(f"{out} holds no run to resume: {error}") from error
    return {name: value for name, value in found.items() if name not in ("out", "resume", "steps")}


def save(path: Path, tree: Any, **numbers: float) -> None:
    """Write the arrays of a tree, and some numbers, to one ``.npz`` file; an older one stays until the new is whole."""
    arrays: dict[str, Any] = {
        f"tree{jax.tree_util.keystr(where)}": np.asarray(x) for where, x in jax.tree.leaves_with_path(tree)
    }
    arrays |= {name: np.asarray(value) for name, value in numbers.items()}
    beside = path.with_name(f".{path.name}")
    with beside.open("wb") as file:
        np.savez(file, **arrays)
    beside.replace(path)


def load(path: Path, like: Any, *numbers: str) -> tuple[Any, dict[str, float]]:
    """Read what ``save`` wrote: a tree of the structure of ``like``, and the named numbers.

    Raises:
        RunError: there is none, or it is of another environment or other settings.
    """
    if not path.is_file():
        raise RunError(f"{path} does not exist; start without --resume")
    leaves, treedef = jax.tree.flatten_with_path(like)
    names = [f"tree{jax.tree_util.keystr(where)}" for where, _ in leaves]
    with np.load(path, allow_pickle=False) as file:
        found = {name: file[name] for name in [*names, *numbers] if name in file}
    made = [_fitting(path, name, found.get(name), x) for name, (_, x) in zip(names, leaves, strict=True)]
    return jax.tree.unflatten(treedef, made), {name: float(found[name]) for name in numbers}


def _fitting(path: Path, name: str, array: np.ndarray | None, like: jax.Array) -> jax.Array:
    if array is None or (array.shape, array.dtype) != (like.shape, like.dtype):
        have = "nothing" if array is None else f"{array.dtype}{list(array.shape)}"
        raise RunError(
            f"{path}: {name} is {have}, this run needs {like.dtype}{list(like.shape)}; "
            "resume with the task and settings that it was made with"
        )
    return jnp.asarray(array)


class Learnt(NamedTuple):
    """The part of a learner that acts."""

    networks: Networks
    normalizer: Normalizer


def load_policy(folder: Path, env: Environment) -> Learnt:
    """What a run has learnt.

    Raises:
        RunError: there is no such run, or it does not fit the environment.
    """
    config = PPOConfig.of(settings(folder))
    none = jnp.zeros(observed(env)[0])
    like = Learnt(init_networks(jax.random.key(0), env, config), Normalizer(jnp.zeros(()), none, none))
    return load(folder / POLICY, like)[0]


def read_rows(path: Path, until: int) -> list[Row]:
    """The rows of a curve up to so many environment steps; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    return [row for row in rows if row["env_steps"] <= until]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a curve."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows({name: f"{value:.10g}" for name, value in row.items()} for row in rows)


def plot(path: Path, rows: Sequence[Row], title: str) -> bool:
    """Draw success and return over environment steps; False where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    steps = [row["env_steps"] for row in rows]
    for axes, name in zip(figure.subplots(1, 2), ("success", "return"), strict=True):
        axes.plot(steps, [row[name] for row in rows])
        axes.set(xlabel="environment steps", ylabel=name)
        axes.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    return True
