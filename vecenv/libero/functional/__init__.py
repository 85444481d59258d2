"""One LIBERO environment as pure functions of one world, for JAX training loops."""

from vecenv.libero.functional.config import (
    ACTIONS,
    PLACEMENTS,
    FunctionalConfig,
    FunctionalError,
    Randomization,
    default_config,
)
from vecenv.libero.functional.env import FunctionalLibero
from vecenv.libero.functional.randomize import Variation, randomize
from vecenv.libero.functional.state import Data, FunctionalState
from vecenv.libero.physics.mjx.options import jit

__all__ = [
    "ACTIONS",
    "PLACEMENTS",
    "Data",
    "FunctionalConfig",
    "FunctionalError",
    "FunctionalLibero",
    "FunctionalState",
    "Randomization",
    "Variation",
    "default_config",
    "jit",
    "randomize",
]
