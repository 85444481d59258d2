"""The constraint solver of ``impl="jax"``: Newton's method on MuJoCo's primal problem, each island with its own steps.

In: data of one world after ``mjx.fwd_acceleration``. Out: the acceleration that constraints allow, and their force.
It replaces ``mjx.solve``, which fails on LIBERO's scenes in float32: where a contact with an elliptic cone sticks, its
line search takes the root of a small number that rounding made negative, and stops at the NaN; and with one step length
for all objects, a single object that begins to slide slows down the convergence of all others.

The problem (MuJoCo's documentation, "Computation"): minimise over accelerations a

    (a - a0)' M (a - a0) / 2 + sum of s(J a - aref),    a0 the acceleration without constraints.

s of an elliptic contact is, in coordinates scaled by friction, half the squared distance to a circular cone.
Derivatives are those of the minimum (implicit function theorem), in both directions and with any number of iterations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from mujoco import mjx

# A line search ends where the slope is this fraction of the initial slope.
_SLOPE = 0.02


@dataclass(frozen=True)
class _Layout:
    """Which constraint rows are of which kind; a function of the model alone.

    Attributes:
        equal: number of rows of equality constraints, which come first.
        frictional: number of rows of dry friction in joints, which come next.
        cones: contacts with elliptic cones: number of rows of each, first row, first contact, number of contacts.
        trees: of each degree of freedom the kinematic tree, one-hot, [nv, ntree].
    """

    equal: int
    frictional: int
    cones: Sequence[tuple[int, int, int, int]]
    trees: np.ndarray

    @classmethod
    def of(cls, model: mjx.Model, data: mjx.Data) -> _Layout:
        impl, cones = data._impl, []
        dims = np.asarray(impl.contact.dim) if model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else np.zeros(0, int)
        # Contacts come last, those of one dimension together.
        row = impl.nefc - int(dims.sum())
        for dim in np.unique(dims).tolist():
            first, count = int(np.argmax(dims == dim)), int((dims == dim).sum())
            if dim > 1:
                cones.append((dim, row, first, count))
            row += dim * count
        trees = np.asarray(model.dof_treeid)
        return cls(impl.ne, impl.nf, tuple(cones), np.eye(trees.max() + 1)[trees])


class _Cones(NamedTuple):
    """Elliptic contacts of one dimension: ``scale`` [n, dim] makes the cone circular, of slope ``mu`` [n]."""

    scale: jax.Array
    mu: jax.Array
    stiff: jax.Array


class _Problem(NamedTuple):
    """What is minimised: mass matrix [nv, nv], force without constraints [nv], and rows: Jacobian [R, nv], reference
    acceleration, stiffness and dry friction [R]; cones as in the layout."""

    mass: jax.Array
    force: jax.Array
    jacobian: jax.Array
    reference: jax.Array
    stiff: jax.Array
    rub: jax.Array
    cones: tuple[_Cones, ...]


def solve(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """``mjx.solve`` for one world of ``impl="jax"``: sets ``qacc`` and ``qfrc_constraint``.

    Runs at most ``model.opt.iterations`` iterations with ``model.opt.ls_iterations`` steps of the line search each,
    from ``data.qacc_warmstart``.
    """
    if data._impl.efc_J.shape[0] == 0:
        return data.replace(qacc=data.qacc_smooth)
    layout, problem = _Layout.of(model, data), _problem(model, data)
    limits = model.opt.iterations, model.opt.ls_iterations

    def slope(qacc: jax.Array) -> jax.Array:
        return _gradient(layout, problem, qacc)

    def minimum(_: object, guess: jax.Array) -> jax.Array:
        # In float64 this iterates to full precision, because derivatives are those of the exact minimum.
        tolerance = jnp.minimum(model.opt.tolerance, jnp.finfo(guess.dtype).eps) * jnp.trace(problem.mass)
        return _newton(layout, problem, guess, limits, tolerance)

    def tangent(linear: object, wanted: jax.Array) -> jax.Array:
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(len(wanted), dtype=wanted.dtype))  # type: ignore[arg-type]
        return jnp.linalg.solve(matrix, wanted)

    qacc = lax.custom_root(slope, data.qacc_warmstart, minimum, tangent)
    pushed = _pull(layout, problem, problem.jacobian @ qacc - problem.reference)[0]
    return data.replace(qacc=qacc, qfrc_constraint=-problem.jacobian.T @ pushed)


def _problem(model: mjx.Model, data: mjx.Data) -> _Problem:
    impl, layout = data._impl, _Layout.of(model, data)
    cones = []
    for dim, row, contact, count in layout.cones:
        friction = impl.contact.friction[contact : contact + count, : dim - 1]
        mu = friction[:, 0] / jnp.sqrt(model.opt.impratio)
        normal = impl.efc_D[row : row + dim * count : dim]
        cones.append(_Cones(jnp.concatenate([mu[:, None], friction], axis=1), mu, normal / mu**2))
    return _Problem(
        mass=mjx.full_m(model, data),
        force=data.qfrc_smooth,
        jacobian=impl.efc_J,
        reference=impl.efc_aref,
        stiff=impl.efc_D,
        rub=impl.efc_frictionloss,
        cones=tuple(cones),
    )


# ---------------------------------------------------------------------------------------------------------------------
# The cost of constraint rows: slope and curvature.


class _Curvature(NamedTuple):
    """Second derivatives: of the rows before the first cone, and of the cones [n, dim, dim]."""

    alone: jax.Array
    cones: tuple[jax.Array, ...]


def _pull(layout: _Layout, problem: _Problem, x: jax.Array) -> tuple[jax.Array, _Curvature]:
    """First derivative [R] and second derivatives of the cost of the rows at x = J a - aref, [R]."""
    alone = layout.cones[0][1] if layout.cones else len(x)
    first, second = _pull_alone(layout, problem, x[:alone])
    slopes, blocks = [first], []
    for (dim, row, _, count), cones in zip(layout.cones, problem.cones, strict=True):
        slope, block = jax.vmap(_pull_cone)(x[row : row + dim * count].reshape(count, dim), cones)
        slopes.append(slope.reshape(-1))
        blocks.append(block)
    return jnp.concatenate(slopes), _Curvature(second, tuple(blocks))


def _pull_alone(layout: _Layout, problem: _Problem, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Likewise for single rows: equalities act both ways, limits and pyramid edges one way, dry friction slips."""
    index, stiff, rub = np.arange(len(x)), problem.stiff[: len(x)], problem.rub[: len(x)]
    equal, frictional = index < layout.equal, (index >= layout.equal) & (index < layout.equal + layout.frictional)
    slope = stiff * x
    slips = frictional & (jnp.abs(slope) > rub)
    lets_go = ~equal & ~frictional & (x >= 0)
    free = slips | lets_go
    slope = jnp.where(free, jnp.where(slips, jnp.sign(x) * rub, 0.0), slope)
    return slope, jnp.where(free, 0.0, stiff)


def _pull_cone(x: jax.Array, cone: _Cones) -> tuple[jax.Array, jax.Array]:
    """Slope [dim] and curvature [dim, dim] of one elliptic contact: normal first, then tangents.

    In scaled coordinates u, half the squared distance to the cone ``normal >= mu |tangent|``: nothing inside, the
    distance to the tip in the polar cone, and the distance to the surface elsewhere.
    """
    u, mu = cone.scale * x, cone.mu
    normal, tangent = u[0], u[1:]
    square = tangent @ tangent
    length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    tip = mu * normal + length <= 0
    side = ~tip & (normal < mu * length)
    along = tangent / jnp.where(side, length, 1.0)
    depth = (normal - mu * length) / (1 + mu**2)
    outward = jnp.concatenate([jnp.ones(1, u.dtype), -mu * along])
    slope = jnp.where(tip, u, jnp.where(side, depth * outward, 0.0))
    bend = jnp.where(side, -mu * depth / jnp.where(side, length, 1.0), 0.0)
    round_ = jnp.diag(jnp.ones_like(u).at[0].set(0.0)) - jnp.pad(jnp.outer(along, along), (1, 0))
    surface = jnp.outer(outward, outward) / (1 + mu**2) + bend * round_
    curvature = jnp.where(tip, jnp.eye(len(x), dtype=u.dtype), jnp.where(side, surface, 0.0))
    return cone.stiff * cone.scale * slope, cone.stiff * cone.scale[:, None] * curvature * cone.scale


def _bent(layout: _Layout, curvature: _Curvature, rows: jax.Array) -> jax.Array:
    """Curvature times rows, [R] or [R, nv]."""
    alone = layout.cones[0][1] if layout.cones else len(rows)
    parts = [(curvature.alone * rows[:alone].T).T]
    for (dim, row, _, count), blocks in zip(layout.cones, curvature.cones, strict=True):
        own = rows[row : row + dim * count].reshape(count, dim, -1)
        # An explicit loop, because a library call is slower for matrices as small as these.
        turned = sum(blocks[:, :, j, None] * own[:, None, j] for j in range(dim))
        parts.append(jnp.asarray(turned).reshape(dim * count, *rows.shape[1:]))
    return jnp.concatenate(parts)


def _gradient(layout: _Layout, problem: _Problem, qacc: jax.Array) -> jax.Array:
    """Gradient of the whole cost, [nv]."""
    slope, _ = _pull(layout, problem, problem.jacobian @ qacc - problem.reference)
    return problem.mass @ qacc - problem.force + problem.jacobian.T @ slope


# ---------------------------------------------------------------------------------------------------------------------
# The iterations.


class _Islands(NamedTuple):
    """Trees connected by rows: ``first`` [R, ntree], one-hot, a tree per row; ``mates`` [ntree, ntree], by island."""

    first: jax.Array
    mates: jax.Array


def _islands(layout: _Layout, jacobian: jax.Array) -> _Islands:
    count, dtype = layout.trees.shape[1], jacobian.dtype
    alone = layout.cones[0][1] if layout.cones else len(jacobian)
    # A contact's rows move the same trees, so they count as one.
    parts, rows_of = [jnp.abs(jacobian[:alone])], [np.arange(alone)]
    for dim, row, _, number in layout.cones:
        parts.append(jnp.abs(jacobian[row : row + dim * number]).reshape(number, dim, -1).sum(1))
        rows_of.append(np.repeat(rows_of[-1].max(initial=-1) + 1 + np.arange(number), dim))
    moved = (jnp.concatenate(parts) @ layout.trees.astype(dtype)) > 0
    mates = ((moved.T.astype(dtype) @ moved) > 0) | jnp.eye(count, dtype=bool)
    for _ in range(int(np.ceil(np.log2(max(count, 2))))):
        reach = mates.astype(dtype)
        mates = (reach @ reach) > 0
    first = (jnp.arange(count) == jnp.argmax(moved, axis=1)[:, None]) & moved
    return _Islands(first.astype(dtype)[np.concatenate(rows_of)], mates.astype(dtype))


class _Carry(NamedTuple):
    """Acceleration [nv], gradient of the cost there [nv], expected decrease of the next step, number of steps."""

    qacc: jax.Array
    gradient: jax.Array
    promise: jax.Array
    steps: jax.Array


def _newton(
    layout: _Layout, problem: _Problem, guess: jax.Array, limits: tuple[int, int], tolerance: jax.Array
) -> jax.Array:
    """The minimum, or the point that the last iteration reached."""
    islands = _islands(layout, problem.jacobian)

    def going(carry: _Carry) -> jax.Array:
        return (carry.steps < limits[0]) & (carry.promise > tolerance)

    def step(carry: _Carry) -> _Carry:
        x = problem.jacobian @ carry.qacc - problem.reference
        _, curvature = _pull(layout, problem, x)
        hessian = problem.mass + problem.jacobian.T @ _bent(layout, curvature, problem.jacobian)
        factor = jax.scipy.linalg.cho_factor(hessian)
        search = -jax.scipy.linalg.cho_solve(factor, carry.gradient)
        size = _line_search(layout, problem, islands, carry.qacc, x, search, limits[1])
        qacc = carry.qacc + layout.trees.astype(size.dtype) @ size * search
        gradient = _gradient(layout, problem, qacc)
        # Decrease of the next step if the curvature does not change.
        promise = gradient @ jax.scipy.linalg.cho_solve(factor, gradient) / 2
        return _Carry(qacc, gradient, promise, carry.steps + 1)

    start = _Carry(
        guess, _gradient(layout, problem, guess), jnp.asarray(jnp.inf, guess.dtype), jnp.zeros((), jnp.int32)
    )
    return lax.while_loop(going, step, start).qacc


class _Bracket(NamedTuple):
    """Step sizes, each [ntree]: the current one with its slope, and bounds whose slopes are below and above 0."""

    size: jax.Array
    slope: jax.Array
    low: jax.Array
    high: jax.Array
    tries: jax.Array


def _line_search(
    layout: _Layout,
    problem: _Problem,
    islands: _Islands,
    qacc: jax.Array,
    x: jax.Array,
    search: jax.Array,
    tries: int,
) -> jax.Array:
    """Step size of every tree, [ntree]: where the slope along the direction vanishes, equal within an island."""
    trees = layout.trees.astype(x.dtype)
    row_step = problem.jacobian @ search
    weight = problem.mass @ search
    base = (search * (problem.mass @ qacc - problem.force)) @ trees
    growth = (search * weight) @ trees

    def slopes(size: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """First and second derivatives, and the sum of the absolute terms of the first."""
        first, curvature = _pull(layout, problem, x + (islands.first @ size) * row_step)
        first, second = first * row_step, row_step * _bent(layout, curvature, row_step)
        rows = jnp.stack([first, second, jnp.abs(first)]) @ islands.first
        own = jnp.stack([base + size * growth, growth, jnp.abs(base)])
        return tuple((rows + own) @ islands.mates)  # type: ignore[return-value]

    begin, _, terms = slopes(jnp.zeros_like(base))
    flat = _SLOPE * jnp.abs(begin) + 10 * jnp.finfo(base.dtype).eps * terms

    def searching(bracket: _Bracket) -> jax.Array:
        return (bracket.tries < tries) & (jnp.abs(bracket.slope) > flat).any()

    def shrink(bracket: _Bracket) -> _Bracket:
        slope, bend, _ = slopes(bracket.size)
        low = jnp.where(slope < 0, bracket.size, bracket.low)
        high = jnp.where(slope > 0, bracket.size, bracket.high)
        guess = bracket.size - slope / jnp.where(bend > 0, bend, 1.0)
        middle = jnp.where(jnp.isfinite(high), (low + high) / 2, 2 * bracket.size)
        inside = (guess > low) & (guess < high)
        good = jnp.abs(slope) <= flat
        size = jnp.where(good, bracket.size, jnp.where(inside, guess, middle))
        return _Bracket(size, jnp.where(good, 0.0, slope), low, high, bracket.tries + 1)

    ones = jnp.ones_like(base)
    first = _Bracket(ones, jnp.full_like(base, jnp.inf), 0 * ones, jnp.inf * ones, jnp.zeros((), jnp.int32))
    return lax.while_loop(searching, shrink, first).size
