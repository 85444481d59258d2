"""The arguments of the Ray engine, and what they ask of a cluster."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vecenv_eval.config import ConfigError, EvalConfig

# Backends that step on CPU threads; any other one is given a GPU.
_CPU_BACKENDS = ("native", "physx_cpu")
# `jax` and `mjx` run on whatever there is: a GPU has to be asked for.
_NO_GPU = (*_CPU_BACKENDS, "jax", "mjx")


@dataclass(frozen=True, kw_only=True)
class RayOptions:
    """Arguments of the engine.

    Attributes:
        address: of a Ray cluster, ``"auto"`` for the one this machine belongs to; None starts an instance here.
        actors: how many actors; None for as many as the cluster has room for.
        cpus: CPUs of an actor; None for ``num_threads`` of the evaluation, or 1.
        gpus: GPUs of an actor, parts of one allowed; None for 1 where the backend needs one, else 0.
        unit: episodes that an actor takes at once; None for units that shrink as episodes run out.
        attempts: how often an episode whose actor was lost is begun, before it ends in an error.
        runtime_env: Ray's runtime environment for the actors: ``{"working_dir": "."}``, for example.
        object_store_mb: size of the object store of an instance that is started here, 1e6 bytes.
        start_timeout_s: seconds without any running actor, after which the run ends.

    Raises:
        ConfigError: a number is too small, or an argument belongs to an instance that is not started here.
    """

    address: str | None = None
    actors: int | None = None
    cpus: int | None = None
    gpus: float | None = None
    unit: int | None = None
    attempts: int = 3
    runtime_env: Mapping[str, Any] | None = None
    object_store_mb: int = 100
    start_timeout_s: float = 600.0

    def __post_init__(self) -> None:
        least = {"actors": 1, "cpus": 1, "gpus": 0, "unit": 1, "attempts": 1, "object_store_mb": 80}
        for name, minimum in least.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise ConfigError(f"engine argument {name} must be at least {minimum}, not {value}")
        if self.start_timeout_s <= 0:
            raise ConfigError(f"engine argument start_timeout_s must be above 0, not {self.start_timeout_s}")
        if (self.address or "").startswith("ray://"):
            raise ConfigError(
                f"engine argument address={self.address}: the Ray client cannot stream records; run on a node of "
                "the cluster, with address=auto or address=HOST:PORT"
            )
        if self.gpus is not None and self.gpus > 1 and self.gpus != int(self.gpus):
            raise ConfigError(f"engine argument gpus must be a whole number or below 1, not {self.gpus}")


def on_cpu(config: EvalConfig) -> bool:
    """Whether the physics runs on CPU threads."""
    return config.backend in _CPU_BACKENDS


def needs_gpu(config: EvalConfig) -> bool:
    """Whether the physics cannot run without a GPU."""
    return config.backend not in _NO_GPU


def resources(options: RayOptions, config: EvalConfig) -> dict[str, float]:
    """What an actor takes of its node, by Ray's names."""
    cpus = options.cpus or config.num_threads or 1
    gpus = options.gpus if options.gpus is not None else int(needs_gpu(config))
    return {"CPU": cpus, "GPU": gpus}


def room(wanted: Mapping[str, float], nodes: Sequence[Mapping[str, float]]) -> int:
    """How many actors the nodes hold together.

    Args:
        wanted: what an actor takes.
        nodes: what each node has, by the same names.
    """
    limits = {name: amount for name, amount in wanted.items() if amount}
    return sum(min(int(node.get(name, 0) / amount + 1e-9) for name, amount in limits.items()) for node in nodes)
