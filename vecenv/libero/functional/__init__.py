"""One LIBERO environment as pure functions of one world, for JAX training loops."""

from vecenv.libero.functional.env import (
    Data,
    FunctionalConfig,
    FunctionalError,
    LiberoEnv,
    State,
    default_config,
    jit,
    randomize,
)

__all__ = ["Data", "FunctionalConfig", "FunctionalError", "LiberoEnv", "State", "default_config", "jit", "randomize"]
