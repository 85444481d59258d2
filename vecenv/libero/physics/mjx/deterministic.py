"""The same run twice: MuJoCo Warp's step with results that do not depend on the order in which threads run.

On a GPU, two runs of one batch differ in MuJoCo Warp: threads take places in arrays, and add to floating-point numbers,
in the order they arrive. A model with this module's mark (a bit of the disable flags that MuJoCo does not use) is
stepped by variants of a few of its functions, with the kernels of ``deterministic_warp``; other models run the
originals. In a step of LIBERO's scenes the order of threads matters in these places:

* **Contacts** lie in one buffer for all worlds, in the order they were found. That order stays; what is computed from
  it does not use it: constraint rows are numbered by the geoms of their contact.
* **Constraint rows** of friction, limits and contacts are numbered by counters. The line search adds over the rows, a
  row to a thread by its number, so the numbers matter. Here a row's number is its rank.
* **Composite inertias, subtree centres and body forces**: siblings add to their parent, such as the two fingers to the
  hand. Here one thread adds them.
* **Constraint forces, the squared length of the gradient, and the Hessian** of the solver: rows add to coordinates. How
  many threads share the rows also depends on the number of worlds. Here terms are added in fixed point.

Everything else in MuJoCo Warp is computed by one thread, or by one block of threads of a fixed size, from one world
alone. Two places need nothing: the number of contacts that a contact sensor finds is an integer, and GJK's working
memory is as large as the memory of contacts. The Hessian is kept in the sparse form for scenes of any size, as the
dense one has sums of its own.

What XLA computes between the steps, such as the controller, is in ``blocks``. Contacts, rows and the solver's problem
are the same with and without the mark up to the rounding of sums.

What vecenv's scenes do not have is refused: equality constraints, tendons, flexible bodies, ball joints with limits,
gravity compensation, adhesion, sleeping, pyramidal cones, solvers other than Newton's.

MuJoCo Warp 4 has an option for deterministic steps; there is no MJX of that version, and MJX 3.17 contains its own
MuJoCo Warp, without it.
"""

from __future__ import annotations

import copy
import functools
import threading
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import mujoco
import numpy as np
import warp as wp
from mujoco import mjx

from vecenv.errors import SimulationError
from vecenv.libero.physics import private
from vecenv.libero.physics.mjx import deterministic_warp as kernels
from vecenv.libero.physics.mjx.options import DETERMINISTIC, MjxError, is_deterministic
from vecenv.libero.physics.mjx.patching import copy_with, dispatch, expect

# A launch has about this many groups of threads for the rows of all worlds, at least and at most so many a world.
_GROUPS, _FEWEST_SLOTS, _MOST_SLOTS = 65536, 8, 128
_LOCK = threading.Lock()


class MjxDeterminismError(SimulationError):
    """The installed MJX does not support deterministic steps; the message says what was found and what to do."""


def _unsupported(found: str) -> MjxDeterminismError:
    return MjxDeterminismError(
        f"mujoco-mjx {private.installed_version()} does not support deterministic=True: {found}; use "
        f"deterministic=False, or the mujoco-mjx that this version of vecenv was tested with ({private.TESTED})"
    )


def prepared(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model with the Jacobian in sparse form, which ``marked`` needs.

    Raises:
        MjxError: the model has something that deterministic steps do not support.
    """
    if found := [what for what, has in _not_supported(model).items() if has]:
        raise MjxError(f"deterministic=True does not support {', '.join(found)}")
    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    return model


def _not_supported(model: mujoco.MjModel) -> dict[str, bool]:
    """Which parts of a model deterministic steps do not support, and whether it has them."""
    ball = model.jnt_type == mujoco.mjtJoint.mjJNT_BALL
    sensor = model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT
    only_found = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
    return {
        "pyramidal friction cones (cone='pyramidal')": model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC,
        "solvers other than Newton's": model.opt.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        "integrators other than Euler's": model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER,
        "noslip iterations": model.opt.noslip_iterations > 0,
        "sleeping bodies": bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP),
        "equality constraints": model.neq > 0,
        "tendons": model.ntendon > 0,
        "flexible bodies": model.nflex > 0,
        "ball joints with limits": bool(np.any(model.jnt_limited[ball])),
        "adhesion": bool(np.any(model.geom_adhesion)) or bool(np.any(model.pair_adhesion)),
        "gravity compensation": bool(np.any(model.body_gravcomp)),
        "actuators of anything but joints": bool(np.any(model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT)),
        "two actuators of one joint": len(np.unique(model.actuator_trnid[:, 0])) < model.nu,
        "contact sensors of more than the number of contacts": bool(
            np.any(model.sensor_intprm[sensor, 0] != only_found)
        ),
    }


def marked(model: mjx.Model) -> mjx.Model:
    """A copy of a model for MuJoCo Warp that is stepped deterministically.

    Raises:
        MjxDeterminismError: the installed MJX is not a supported one.
    """
    install()
    return model.replace(opt=model.opt.replace(disableflags=model.opt.disableflags | DETERMINISTIC))


@functools.cache
def install() -> None:
    """Make MuJoCo Warp step marked models deterministically; done once a process.

    Raises:
        MjxDeterminismError: its functions are not those that vecenv was written for.
    """
    with _LOCK:
        try:
            variants = [_smooth_variants(), _constraint_variants(), _solver_variants()]
        except (ImportError, AttributeError) as error:
            raise _unsupported(f"a module, type or function of MuJoCo Warp is missing ({error})") from error
        for module, functions in variants:
            for name, function in functions.items():
                setattr(module, name, dispatch(function, getattr(module, name), is_deterministic))


_Variants: TypeAlias = tuple[Any, Mapping[str, Callable[..., Any]]]
_expect = functools.partial(expect, unsupported=_unsupported)


class _Launches:
    """The module ``warp`` as a copied function sees it: to launch a name of ``instead`` is to call that function."""

    def __init__(self, **instead: Callable[[], None]) -> None:
        self._instead = instead

    def launch(self, kernel: Any, *args: Any, **kwargs: Any) -> None:
        if isinstance(kernel, str):
            self._instead[kernel]()
        else:
            wp.launch(kernel, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        return getattr(wp, name)


def _named(name: str) -> Callable[..., str]:
    """In place of a function that makes a kernel: the name of what ``_Launches`` calls instead."""
    return lambda *args: name


# ---------------------------------------------------------------------------------------------------------------------
# Bodies.


def _smooth_variants() -> _Variants:
    module, found = private.warp_smooth, {}
    for name, kernel, replacement in (
        ("com_pos", "_subtree_com_acc", kernels.add_subtree_com),
        ("crb", "_crb_accumulate", kernels.add_composite_inertia),
        ("_rne_cfrc_backward", "_cfrc_backward", kernels.add_body_force),
    ):
        plain = _expect(getattr(module, name, None), "m d", kernel)
        if len(getattr(module, kernel).adj.args) != len(replacement.adj.args):
            raise _unsupported(f"{kernel} takes {len(getattr(module, kernel).adj.args)} arguments")
        found[name] = copy_with(plain, f"deterministic_{name}", **{kernel: replacement})
    return module, found


# ---------------------------------------------------------------------------------------------------------------------
# Constraint rows.


def _constraint_variants() -> _Variants:
    module = private.warp_constraint
    plain = _expect(getattr(module, "make_constraint", None), "m d", "_efc_contact_init", "wp")

    def make_constraint(m: Any, d: Any) -> None:
        launches = _Launches(rows=lambda: _order_rows(m, d))
        copy_with(plain, "deterministic_make_constraint", wp=launches, _efc_contact_init=_named("rows"))(m, d)

    return module, {"make_constraint": private.event_scope(make_constraint)}


def _order_rows(m: Any, d: Any) -> None:
    """Put the rows of friction and limits in order, and give rows to contacts."""
    efc = d.efc
    rows = min(d.njmax, m.nv + m.jnt_limited_slide_hinge_adr.size)
    names = wp.empty((d.nworld, rows), dtype=wp.vec3i)  # pyright: ignore[reportArgumentType]
    values = wp.empty((d.nworld, rows, kernels.ROW_VALUES), dtype=float)
    entries = [efc.J_rowadr, efc.J_colind, efc.J]
    fields = [efc.pos, efc.margin, efc.D, efc.vel, efc.aref, efc.frictionloss]
    groups = [efc.jtdaj_adr, efc.jtdaj_nrow]
    wp.launch(
        kernels.read_rows,
        dim=(d.nworld, rows),
        inputs=[d.nefc, d.njmax, efc.type, efc.id, *entries, *fields],
        outputs=[names, values],
    )
    wp.launch(
        kernels.write_rows,
        dim=(d.nworld, rows),
        inputs=[d.nefc, d.njmax, names, values],
        outputs=[efc.type, efc.id, efc.J_rownnz, *entries, *fields, *groups],
    )
    contact = d.contact
    counts = wp.zeros(d.nworld, dtype=int)
    contacts, sizes = (wp.empty((d.nworld, d.njmax), dtype=int) for _ in range(2))
    keys = wp.empty((d.nworld, d.njmax), dtype=wp.int64)  # pyright: ignore[reportArgumentType]
    bodies = [m.body_weldid, m.body_dofnum, m.body_dofadr, m.dof_parentid, m.geom_bodyid]
    found = [contact.dist, contact.dim, contact.includemargin, contact.worldid, contact.geom]
    wp.launch(
        kernels.list_contacts,
        dim=d.naconmax,
        inputs=[*bodies, d.nacon, *found, contact.geomcollisionid, contact.type],
        outputs=[d.nefc, counts, contacts, keys, sizes],
    )
    wp.launch(
        kernels.place_contacts,
        dim=(d.nworld, d.njmax),
        inputs=[d.njmax, d.njmax_nnz, d.nf, d.nl, counts, contacts, keys, sizes],
        outputs=[contact.efc_address, efc.id, efc.J_rownnz, efc.J_rowadr, *groups, efc.jtdaj_nblock],
    )


# ---------------------------------------------------------------------------------------------------------------------
# The solver. Its context gets the memory of the sums, because a step may be captured as a CUDA graph with a loop, in
# which nothing can be allocated.


def _solver_variants() -> _Variants:
    module = private.warp_solver
    create = _expect(getattr(module, "_create_solver_context", None), "m d")
    constraint = _expect(
        getattr(module, "_update_constraint", None), "m d ctx", "_update_constraint_init_qfrc_constraint_sparse", "wp"
    )
    makers = ("_update_gradient_grad", "_update_gradient_init_h_sparse", "_JTDACJ_sparse", "_jtdaj_groups_per_world")
    gradient = _expect(getattr(module, "_update_gradient", None), "m d ctx", *makers, "wp")

    def create_solver_context(m: Any, d: Any) -> Any:
        context = create(m, d)
        context.force_sums = wp.zeros((d.nworld, m.nv), dtype=wp.int64)
        context.hessian_sums = wp.zeros((d.nworld, _triangle(m.nv)), dtype=wp.int64)
        return context

    def update_constraint(m: Any, d: Any, ctx: Any, *args: Any, **kwargs: Any) -> None:
        launches = _Launches(forces=lambda: _add_forces(m, d, ctx))
        replaced = {"_update_constraint_init_qfrc_constraint_sparse": _named("forces")}
        copy_with(constraint, "deterministic_update_constraint", wp=launches, **replaced)(m, d, ctx, *args, **kwargs)

    def update_gradient(m: Any, d: Any, ctx: Any, *args: Any, **kwargs: Any) -> None:
        launches = _Launches(inertia=lambda: None, hessian=lambda: _add_hessian(m, d, ctx))
        copied = copy_with(
            gradient,
            "deterministic_update_gradient",
            wp=launches,
            _update_gradient_grad=lambda stable_fast: kernels.gradient,
            _update_gradient_init_h_sparse=_named("inertia"),
            _JTDACJ_sparse=_named("hessian"),
            _jtdaj_groups_per_world=lambda *args: 1,
        )
        copied(m, d, ctx, *args, **kwargs)

    return module, {
        "_create_solver_context": create_solver_context,
        "_update_constraint": update_constraint,
        "_update_gradient": update_gradient,
    }


def _triangle(size: int) -> int:
    return size * (size + 1) // 2


def _slots(nworld: int) -> int:
    """Groups of threads that share the rows of a world; the sums do not depend on it."""
    if wp.get_device().is_cpu:  # where threads run one after the other
        return 1
    return min(max(_GROUPS // nworld, _FEWEST_SLOTS), _MOST_SLOTS)


def _groups(d: Any) -> list[Any]:
    """The groups of rows and their entries in the Jacobian."""
    efc = d.efc
    return [efc.jtdaj_nblock, efc.jtdaj_adr, efc.jtdaj_nrow, efc.J_rownnz, efc.J_rowadr, efc.J_colind, efc.J]


def _add_forces(m: Any, d: Any, ctx: Any) -> None:
    """``qfrc_constraint``, which is zero before."""
    slots = _slots(d.nworld)
    wp.launch(
        kernels.add_forces,
        dim=(d.nworld, slots, kernels.LANES),
        inputs=[*_groups(d), d.efc.force, ctx.done, slots],
        outputs=[ctx.force_sums, d.qfrc_constraint],
    )
    wp.launch(kernels.read_forces, dim=(d.nworld, m.nv), inputs=[ctx.done], outputs=[ctx.force_sums, d.qfrc_constraint])


def _add_hessian(m: Any, d: Any, ctx: Any) -> None:
    """The Hessian, inertia included."""
    slots = _slots(d.nworld)
    rows = [d.efc.D, d.efc.state, ctx.Jaref]
    wp.launch(
        kernels.add_hessian,
        dim=(d.nworld, slots, kernels.LANES),
        inputs=[m.opt.impratio_invsqrt, d.contact.friction, d.efc.id, *_groups(d), *rows, ctx.done, slots],
        outputs=[ctx.hessian_sums],
    )
    wp.launch(
        kernels.read_hessian,
        dim=(d.nworld, _triangle(m.nv_pad)),
        inputs=[m.nv, m.M_elemid, d.M, ctx.done],
        outputs=[ctx.hessian_sums, ctx.h],
    )
