"""A batch over several devices, on host devices that XLA is told to make up; in a process of its own."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh
from vecenv.util.devices import Spread, over_rows, replicated

mesh = Mesh(np.array(jax.devices()), ("rows",))
assert mesh.size == 4

def count_down(scale, rows, limit):
    # A loop that ends when the rows of one device have stopped.
    def body(carry):
        left, turns = carry
        return jnp.maximum(left - 1, 0), turns + 1
    left, turns = jax.lax.while_loop(lambda c: (c[0] > 0).any(), body, (limit, jnp.zeros_like(limit)))
    return {"scaled": rows * scale["by"], "turns": turns}

rows, limit = np.arange(24.0).reshape(8, 3), np.array([1, 2, 3, 4, 5, 6, 7, 8])
spread = Spread(jax.jit(count_down), mesh, shared=1)
out = spread({"by": jnp.float32(2)}, rows, limit)
assert np.array_equal(out["scaled"], 2 * rows)
assert out["scaled"].sharding == over_rows(mesh)
# Two rows a device: each stops with the slower of its own two.
assert np.asarray(out["turns"]).tolist() == [2, 2, 4, 4, 6, 6, 8, 8]
again = spread(jax.device_put({"by": jnp.float32(3)}, replicated(mesh)), out["scaled"], limit)
assert np.array_equal(again["scaled"], 6 * rows)

donating = Spread(jax.jit(lambda by, rows: rows + by, donate_argnums=1), mesh, shared=1)
first = donating(1.0, rows)
second = donating(1.0, first)
assert np.array_equal(second, rows + 2)

try:
    spread({"by": jnp.float32(2)}, rows[:7], limit[:7])
except ValueError as error:
    assert "evenly divide" in str(error), error
else:
    raise AssertionError("seven rows over four devices")
print("fine")
"""


@pytest.fixture(scope="module")
def ran() -> subprocess.CompletedProcess[str]:
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "JAX_PLATFORMS": "cpu"}
    return subprocess.run([sys.executable, "-c", SCRIPT], env={**os.environ, **flags}, capture_output=True, text=True)


def test_every_device_works_on_its_own_rows(ran: subprocess.CompletedProcess[str]) -> None:
    assert ran.returncode == 0, ran.stderr[-3000:]
    assert ran.stdout.strip().endswith("fine")
