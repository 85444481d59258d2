"""A LIBERO scene as an MJX model on the device, with what all its worlds share.

In: a compiled scene, a memory budget and solver limits. Out: a ``Build``: the MJX model, the constants of the arm for
the controller, and blank data for a batch of worlds.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vecenv.controllers import kinematics, osc
from vecenv.libero.physics import budgets
from vecenv.libero.physics.mjx import contacts as mjx_contacts
from vecenv.libero.physics.mjx import kernels
from vecenv.libero.physics.mjx.options import Impl, MjxError, remember_compilations, resolve_impl
from vecenv.libero.robot import HOME_QPOS, panda_chain
from vecenv.libero.scene import contacts
from vecenv.libero.scene.scene import Scene

# Joints of the arm and its fingers, the first of a scene.
ROBOT_JOINTS = 9
_TOLERANCES = ("tolerance", "ls_tolerance")


class System(NamedTuple):
    """What every world of a scene shares.

    Attributes:
        model: the MJX model.
        chain: constants of the arm.
        home: the arm as the controller first sees it in upstream's reset: at home, at rest, fingers at 0.
        touching: geoms of the two things whose contacts each sensor counts, bool [nsensordata, 2, ngeom]; only for
            ``impl="jax"``, which does not support contact sensors of subtrees.
    """

    model: mjx.Model
    chain: kinematics.Chain
    home: osc.ArmState
    touching: jax.Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Build:
    """A scene made ready for MJX.

    Attributes:
        scene: the scene.
        model: its model, with the budgets that ``impl="jax"`` reads.
        impl: which implementation.
        budget: sizes of the contact and constraint memory.
        system: what worlds share, on the device.
    """

    scene: Scene
    model: mujoco.MjModel
    impl: Impl
    budget: budgets.Budget
    system: System

    def blank(self, num_worlds: int) -> mjx.Data:
        """Data of one world, with room for the contacts of ``num_worlds``."""
        sizes = self.budget.warp_sizes(num_worlds) if self.impl == "warp" else {}
        return mjx.make_data(self.model, impl=self.impl, **sizes)


def usual_iterations(impl: str | None, geometry: str) -> tuple[int, int]:
    """Newton iterations and line-search steps of a substep at most; upstream's are 100 and 50.

    On warp a batch waits for its slowest world, and 99 in 100 worlds are done after two or three iterations. On jax
    both loops run until the slowest world is done; with 4 and 8, cans at rest roll by centimetres (libero_object,
    lean).
    """
    if resolve_impl(impl) == "jax":
        return (20, 20)
    return (4, 8) if geometry == "lean" else (10, 20)


def build(
    scene: Scene,
    *,
    impl: str | None = None,
    budget: budgets.Budget,
    iterations: tuple[int, int] | None = None,
    deterministic: bool = False,
) -> Build:
    """Put a scene's model on the device.

    Args:
        scene: a compiled scene.
        impl: ``"jax"``, ``"warp"`` or None, see ``resolve_impl``.
        budget: sizes of the contact and constraint memory.
        iterations: solver iterations and line-search steps at most; None for ``usual_iterations`` of exact geometry.
        deterministic: with warp, steps whose results do not depend on the order in which threads run, see
            ``vecenv.libero.physics.mjx.deterministic``.

    Raises:
        MjxError: see ``resolve_impl``; or the integrator is not Euler; or the arm's joints are not the first; or
            ``deterministic`` with jax, or for a scene with something it does not support.
        MjxContactsError: the scene has published contacts, and the installed MJX does not support them.
        MjxDeterminismError: ``deterministic``, and the installed MJX does not support it.
    """
    chosen = resolve_impl(impl)
    if deterministic and chosen != "warp":
        raise MjxError("deterministic=True is for MuJoCo Warp and native MuJoCo; here MJX runs in pure JAX")
    remember_compilations()
    if chosen == "warp":
        kernels.install()
    if [*scene.arm_qpos, *scene.finger_qpos] != list(range(ROBOT_JOINTS)):
        raise MjxError("the arm and its fingers must be the scene's first joints")
    if scene.model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        raise MjxError("the scene's integrator must be Euler")
    model = budget.limited(scene.model)
    model.opt.iterations, model.opt.ls_iterations = iterations or usual_iterations(chosen, "exact")
    # Single precision never reaches the tolerance that published contacts set for native physics.
    model.opt.tolerance, model.opt.ls_tolerance = (contacts.OPTIONS["current"][name] for name in _TOLERANCES)
    touching = _without_contact_sensors(model) if chosen == "jax" else None
    if deterministic:
        model = _deterministic().prepared(model)
    put = mjx_contacts.put_model(model, impl=chosen)
    if deterministic:
        put = _deterministic().marked(put)
    if chosen == "warp":
        put = put.replace(opt=put.opt.tree_replace({"_impl.warn_overflow": 0}))
    chain = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), panda_chain(scene.model))
    home_qpos = jnp.array([*HOME_QPOS, 0.0, 0.0], jnp.result_type(float))
    home = jax.jit(kinematics.arm_state)(chain, home_qpos, jnp.zeros_like(home_qpos))
    return Build(scene=scene, model=model, impl=chosen, budget=budget, system=System(put, chain, home, touching))


def _deterministic() -> ModuleType:
    """The module, which needs Warp.

    Raises:
        MjxError: the installed MuJoCo Warp lacks a name that the module needs.
    """
    try:
        from vecenv.libero.physics.mjx import deterministic
    except ImportError as error:
        raise MjxError(f"deterministic=True: {error}") from error
    return deterministic


def _without_contact_sensors(model: mujoco.MjModel) -> jax.Array:
    """Replace a model's contact sensors by clock sensors; returns what they detected, see ``System.touching``."""
    ancestors = [_ancestors(model, int(body)) for body in model.geom_bodyid]
    watched = np.zeros((model.nsensordata, 2, model.ngeom), bool)
    for sensor in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT):
        row = watched[model.sensor_adr[sensor]]
        roots = model.sensor_objid[sensor], model.sensor_refid[sensor]
        for side, root in enumerate(roots):
            row[side] = [root in above for above in ancestors]
        model.sensor_type[sensor] = mujoco.mjtSensor.mjSENS_CLOCK
        model.sensor_needstage[sensor] = mujoco.mjtStage.mjSTAGE_POS
        model.sensor_objtype[sensor] = model.sensor_reftype[sensor] = mujoco.mjtObj.mjOBJ_UNKNOWN
        model.sensor_objid[sensor] = model.sensor_refid[sensor] = -1
    return jnp.asarray(watched)


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    """A body and its ancestors, without the world."""
    found = set()
    while body > 0:
        found.add(body)
        body = int(model.body_parentid[body])
    return found
