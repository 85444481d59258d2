"""Array types of signatures that take NumPy's arrays as well as JAX's.

Shapes are written with jaxtyping: ``Float[AnyArray, "*#B 7"]`` is a float array whose last axis is 7 and whose leading
batch axes broadcast against those of the other arguments. The tests check them at run time; users pay nothing.
"""

from __future__ import annotations

from typing import TypeAlias

import jax
import numpy as np

AnyArray: TypeAlias = jax.Array | np.ndarray
