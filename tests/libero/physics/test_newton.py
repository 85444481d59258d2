"""The constraint solver of ``impl="jax"`` finds what MuJoCo finds, keeps islands apart, and can be differentiated."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from vecenv.libero.physics import newton
from vecenv.libero.physics.mjx.options import compiler_options
from vecenv.libero.physics.mjx.step import substep

OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
compiled: Callable[..., Callable[..., Any]] = partial(jax.jit, compiler_options=OPTIONS)
# A box at rest, one that slides, a ball that spins in place, a ball in the air; a drawer that rubs and ends at a stop.
WORLD = """
<mujoco>
  <option timestep="0.002" cone="{cone}" impratio="20" iterations="100" ls_iterations="50" tolerance="1e-12"/>
  <worldbody>
    <geom type="plane" size="1 1 .1" condim="4" friction="1 .02 .001"/>
    <body name="rests" pos="0 0 .0499"><freejoint/><geom type="box" size=".05 .05 .05" condim="4"/></body>
    <body name="slides" pos=".3 0 .0498"><freejoint/><geom type="box" size=".04 .03 .05" condim="3"/></body>
    <body name="spins" pos="-.3 0 .0298"><freejoint/><geom type="sphere" size=".03" condim="4"/></body>
    <body name="falls" pos="-.3 .3 .5"><freejoint/><geom type="sphere" size=".03"/></body>
    <body name="drawer" pos="0 .5 .5">
      <joint name="rail" type="slide" axis="1 0 0" range="0 .2" limited="true" frictionloss=".5"/>
      <geom type="box" size=".05 .05 .02" mass=".4" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
CONES = ("elliptic", "pyramidal")


class Scene:
    """The world above on both sides, in motion."""

    def __init__(self, cone: str, rail: float = 0.1) -> None:
        self.cone = cone
        self.model = mujoco.MjModel.from_xml_string(WORLD.format(cone=cone))
        self.native = mujoco.MjData(self.model)
        self.native.qpos[self.model.joint("rail").qposadr[0]] = rail
        self.native.qvel[6:9] = 0.4, 0.1, 0
        self.native.qvel[12:18] = 0, 0, 0, 0, 0, 6
        self.native.qvel[-1] = -0.2
        self.put = mjx.put_model(self.model)

    def data(self, dtype: Any = jnp.float32) -> mjx.Data:
        """What MJX sees."""
        native, blank = self.native, mjx.make_data(self.model)
        qpos, qvel, warm = (jnp.asarray(x, dtype) for x in (native.qpos, native.qvel, native.qacc_warmstart))
        return blank.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warm)


def prepared(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = stage(model, data)
    return data


@cache
def compiled_for(cone: str) -> tuple[Callable[..., mjx.Data], Callable[..., mjx.Data]]:
    """What comes before the solver, and the solver."""
    model = Scene(cone).put
    return compiled(partial(prepared, model)), compiled(partial(newton.solve, model))


def solved(scene: Scene) -> mjx.Data:
    prepare, solve = compiled_for(scene.cone)
    return solve(prepare(scene.data()))


@pytest.mark.parametrize("cone", CONES)
def test_accelerations_and_forces_are_mujocos(cone: str) -> None:
    scene = Scene(cone)
    for _ in range(5):
        mujoco.mj_forward(scene.model, scene.native)
        found = solved(scene)
        np.testing.assert_allclose(found.qacc, scene.native.qacc, atol=0.02)
        np.testing.assert_allclose(found.qfrc_constraint, scene.native.qfrc_constraint, atol=2e-3)
        assert scene.native.nisland >= 3
        mujoco.mj_step(scene.model, scene.native, nstep=10)


def test_a_stop_holds() -> None:
    scene = Scene("elliptic", rail=-0.001)
    rail = int(scene.model.joint("rail").dofadr[0])
    mujoco.mj_forward(scene.model, scene.native)
    found = solved(scene)
    assert found.qfrc_constraint[rail] > 1
    np.testing.assert_allclose(found.qfrc_constraint[rail], scene.native.qfrc_constraint[rail], rtol=1e-4)


def test_dry_friction_holds_what_is_pushed_less() -> None:
    scene = Scene("elliptic")
    rail = int(scene.model.joint("rail").dofadr[0])
    scene.native.qvel[rail] = 0
    prepare, solve = compiled_for("elliptic")
    data = prepare(scene.data())
    pushed = [solve(data.replace(qfrc_smooth=data.qfrc_smooth.at[rail].add(force))) for force in (0.4, 0.9)]
    # Alone, 0.4 N would give 1 m/s2; MuJoCo's friction lets a tenth through. Then 0.9 N against 0.5 N on 0.4 kg.
    assert 0 < float(pushed[0].qacc[rail]) < 0.15
    assert float(pushed[1].qacc[rail]) == pytest.approx(1.0, abs=0.01)


def test_worlds_of_a_batch_are_solved_as_alone() -> None:
    prepare, solve = compiled_for("elliptic")
    data = prepare(Scene("elliptic").data())
    other = data.tree_replace({"_impl.efc_aref": data._impl.efc_aref * 0.3, "qacc_warmstart": data.qacc_warmstart + 1})
    batch = jax.tree.map(lambda *x: jnp.stack(x), data, other)
    both = compiled(jax.vmap(partial(newton.solve, Scene("elliptic").put)))(batch)
    for row, alone in zip(both.qacc, (data, other), strict=True):
        np.testing.assert_allclose(row, solve(alone).qacc, atol=0.02)


@pytest.mark.parametrize("cone", CONES)
def test_derivatives_are_those_of_the_minimum(cone: str) -> None:
    scene = Scene(cone)
    data = compiled_for(cone)[0](scene.data())
    with jax.enable_x64(True):
        model, data = mjx.put_model(scene.model), jax.tree.map(wide, data)

        def pushed(reference: jax.Array) -> jax.Array:
            return newton.solve(model, data.tree_replace({"_impl.efc_aref": reference})).qacc

        at, rng, size = data._impl.efc_aref, np.random.default_rng(0), 1e-4
        along, weight = jnp.asarray(rng.normal(size=at.shape)), jnp.asarray(rng.normal(size=scene.model.nv))
        value = compiled(pushed)
        forwards = compiled(lambda x: jax.jvp(pushed, (x,), (along,))[1])(at)
        backwards = compiled(jax.grad(lambda x: weight @ pushed(x)))(at)
        difference = (value(at + size * along) - value(at - size * along)) / (2 * size)
        np.testing.assert_allclose(forwards, difference, atol=1e-5, rtol=1e-5)
        assert np.abs(forwards).max() > 0.1
        assert float(backwards @ along) == pytest.approx(float(weight @ forwards), rel=1e-6)


def wide(x: Any) -> Any:
    """Floats in float64."""
    return jnp.asarray(x, jnp.float64) if isinstance(x, jax.Array) and x.dtype == jnp.float32 else x


@pytest.mark.heavy
@pytest.mark.parametrize("cone", CONES)
def test_a_second_of_steps_ends_where_mujocos_does(cone: str) -> None:
    scene, ticks = Scene(cone), 500
    data = scene.data()
    run = compiled(lambda data: jax.lax.scan(lambda d, _: (substep(scene.put, d), None), data, None, ticks)[0])
    mujoco.mj_step(scene.model, scene.native, nstep=ticks)
    np.testing.assert_allclose(run(data).qpos, scene.native.qpos, atol=1e-4)
