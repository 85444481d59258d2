"""Published contacts on MJX: the colliders for Warp and JAX against the one that equals MuJoCo 3.3.0, and who gets
them."""

# Warp arrays in the signature of a kernel.
# pyright: reportInvalidTypeForm=false

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from support.paths import DATA

import vecenv
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.physics import private
from vecenv.libero.physics.colliders import boxbox_jax, planemesh_jax
from vecenv.libero.physics.colliders.boxbox import box_box
from vecenv.libero.physics.colliders.boxbox_numba import MOST
from vecenv.libero.physics.mjx import contacts as mjx_contacts
from vecenv.libero.physics.mjx.contacts import MjxContactsError
from vecenv.libero.physics.mjx.options import jit
from vecenv.libero.scene import contacts

wp = pytest.importorskip("warp", reason="MuJoCo Warp is an extra: pip install 'vecenv[warp]'")

from vecenv.libero.physics.colliders import boxbox_warp  # noqa: E402

PAIRS = 400


class Rows(NamedTuple):
    """Contacts of pairs: numbers [n], distances [n, 8], positions [n, 8, 3], normals [n, 3]."""

    count: np.ndarray
    dist: np.ndarray
    pos: np.ndarray
    normal: np.ndarray


@wp.kernel(enable_backward=False)
def _collide(
    poses: wp.array2d[float],
    count: wp.array[int],
    dist: wp.array2d[float],
    pos: wp.array2d[wp.vec3],
    normal: wp.array[wp.vec3],
):
    n = wp.tid()
    p = poses[n]
    pos1, pos2 = wp.vec3(p[0], p[1], p[2]), wp.vec3(p[15], p[16], p[17])
    rot1 = wp.mat33(p[3], p[4], p[5], p[6], p[7], p[8], p[9], p[10], p[11])
    rot2 = wp.mat33(p[18], p[19], p[20], p[21], p[22], p[23], p[24], p[25], p[26])
    size1, size2 = wp.vec3(p[12], p[13], p[14]), wp.vec3(p[27], p[28], p[29])
    found, depth, place, towards = boxbox_warp.box_box(pos1, rot1, size1, pos2, rot2, size2, p[30])
    count[n] = found
    normal[n] = towards
    for i in range(8):
        dist[n, i] = depth[i]
        pos[n, i] = place[i]


def on_warp(poses: np.ndarray) -> Rows:
    n = len(poses)
    given = wp.array(poses.astype(np.float32), dtype=float, device="cpu")
    shapes = ((n, int), ((n, MOST), float), ((n, MOST), wp.vec3), (n, wp.vec3))
    outputs = [wp.zeros(shape, dtype=kind, device="cpu") for shape, kind in shapes]
    wp.launch(_collide, dim=n, inputs=[given], outputs=outputs, device="cpu")
    return Rows(*(output.numpy() for output in outputs))


@functools.cache
def compiled() -> Callable[..., Any]:
    return jit(jax.vmap(boxbox_jax.box_box))


def on_jax(poses: np.ndarray) -> Rows:
    boxes = [
        boxbox_jax.Box(jnp.asarray(p[:, :3]), jnp.asarray(p[:, 3:12].reshape(-1, 3, 3)), jnp.asarray(p[:, 12:]))
        for p in np.split(poses[:, :30].astype(np.float32), 2, axis=1)
    ]
    dist, pos, normal = (np.asarray(x) for x in compiled()(*boxes, poses[:, 30].astype(np.float32)))
    return Rows((dist < boxbox_jax.NOTHING).sum(1), dist, pos, normal)


def wanted(pose: np.ndarray) -> np.ndarray:
    """What MuJoCo 3.3.0 gives, [n, 7]."""
    first, second = pose[:15], pose[15:30]
    return box_box(first[:3], first[3:12], first[12:], second[:3], second[3:12], second[12:], pose[30])


def pairs(kind: str) -> np.ndarray:
    """Pairs of boxes [PAIRS, 31]: any pose; one flat on the other, leaning by 0.02 or 0.001; or two crossed edges."""
    if kind == "recorded":
        with np.load(DATA / "box_contacts_mujoco_3_3_0.npz", allow_pickle=False) as file:
            poses = file["poses"]
        return poses[np.random.default_rng(0).permutation(len(poses))[:PAIRS]]
    rng, poses = np.random.default_rng(1), np.zeros((PAIRS, 31))
    for pose in poses:
        size1, size2, place = rng.uniform(0.01, 0.08, 3), rng.uniform(0.01, 0.08, 3), rng.uniform(-0.5, 0.5, 3)
        base, own = rotation(rng.normal(size=4)), rotation(rng.normal(size=4))
        away = rng.normal(size=3)
        away *= rng.uniform(0.02, 0.1) / np.linalg.norm(away)
        if kind.startswith("leaning"):
            own = rotation(np.array([1, *(rng.normal(size=3) * float(kind.split()[1]))]))
            away = np.array([*rng.uniform(-0.03, 0.03, 2), size1[2] + size2[2] - rng.uniform(0.0005, 0.005)])
        if kind == "edges":
            size1, size2 = np.full(3, size1[0]), np.full(3, size2[0])
            own = rotation(np.array([1, 0, 0, 0.41])) @ rotation(np.array([1, 0.41, *rng.normal(size=2) * 0.03]))
            base_turn = rotation(np.array([1, 0.41, *rng.normal(size=2) * 0.03]))
            away = np.array([0, 0, (size1[0] + size2[0]) * np.sqrt(2) - rng.uniform(0, 0.004)])
            away, own = base_turn.T @ away, base_turn.T @ own
        pose[:30] = [*place, *base.ravel(), *size1, *(place + base @ away), *(base @ own).ravel(), *size2]
    return poses


def rotation(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat / np.linalg.norm(quat))
    return matrix.reshape(3, 3)


@pytest.mark.parametrize("collide", [on_warp, on_jax])
@pytest.mark.parametrize(
    ("kind", "decided_by_rounding"),
    [("any", 0.005), ("edges", 0.005), ("leaning 0.02", 0.005), ("leaning 0.001", 0.03), ("recorded", 0.08)],
)
def test_boxes_touch_as_in_mujoco_3_3_0_to_single_precision(
    kind: str, decided_by_rounding: float, collide: Callable[[np.ndarray], Rows]
) -> None:
    poses = pairs(kind)
    found, same, touching = collide(poses), 0, 0
    for number, pose in enumerate(poses):
        rows, count = wanted(pose), found.count[number]
        ours = np.c_[found.dist[number], found.pos[number], np.tile(found.normal[number], (MOST, 1))][:count]
        touching += len(rows) > 0
        same += len(rows) == count and (count == 0 or np.abs(ours - rows).max() < 1e-5)
    assert touching > PAIRS / 2
    assert same >= PAIRS * (1 - decided_by_rounding)


def barely_touching(count: int) -> np.ndarray:
    """Pairs of thin boxes [count, 31] whose edges cross, at a distance below what single precision resolves."""
    rng, poses = np.random.default_rng(3), np.zeros((count, 31))
    for pose in poses:
        sizes = np.exp(rng.uniform(np.log(0.001), np.log(0.05), (2, 3)))
        first, second = rotation(rng.normal(size=4)), rotation(rng.normal(size=4))
        axis = np.cross(first[:, rng.integers(3)], second[:, rng.integers(3)])
        axis /= np.linalg.norm(axis)
        corners = [np.sign(axis @ first) * sizes[0], -np.sign(axis @ second) * sizes[1]]
        # Along the edges, their middles meet.
        ends = [
            np.where(np.abs(axis @ box) < 1e-9, 0, corner) for box, corner in zip((first, second), corners, strict=True)
        ]
        place = rng.uniform(-0.5, 0.5, 3)
        away = first @ ends[0] - second @ ends[1] - axis * rng.uniform(-1e-7, 1e-7)
        pose[:30] = [*place, *first.ravel(), *sizes[0], *(place + away), *second.ravel(), *sizes[1]]
    return poses


@pytest.mark.parametrize("collide", [on_warp, on_jax])
def test_boxes_whose_edges_barely_touch_are_thrown_apart_only_where_mujoco_3_3_0_does(
    collide: Callable[[np.ndarray], Rows],
) -> None:
    poses = barely_touching(20_000).astype(np.float32).astype(float)
    found = collide(poses)
    deepest = np.where(np.arange(MOST) < found.count[:, None], found.dist, 0).min(1)
    assert (found.count > 0).mean() > 0.2
    for number in np.flatnonzero(deepest < -1e-5):
        assert wanted(poses[number])[:, 0].min(initial=0) == pytest.approx(deepest[number], abs=1e-5)


@pytest.mark.parametrize("collide", [on_warp, on_jax])
def test_boxes_that_lie_square_on_each_other_touch_with_half_the_overlap(collide: Callable[[np.ndarray], Rows]) -> None:
    poses, rng = np.zeros((PAIRS, 31)), np.random.default_rng(2)
    for pose in poses:
        base, turned = rotation(rng.normal(size=4)), rotation(np.array([1, 0, 0, rng.normal()]))
        pose[:30] = [
            0,
            0,
            0,
            *base.ravel(),
            0.1,
            0.1,
            0.1,
            *base @ [0, 0, 0.148],
            *(base @ turned).ravel(),
            *[0.05] * 3,
        ]
    found = collide(poses)
    assert (found.count == 4).all()
    np.testing.assert_allclose(found.dist[:, :4], -0.001, atol=1e-6)


def test_derivatives_of_contacts_are_finite_where_boxes_lie_square() -> None:
    turn, size = jnp.eye(3), jnp.full(3, 0.05)
    below = boxbox_jax.Box(jnp.zeros(3), turn, size)

    def contacts_of(pos: jax.Array) -> tuple[jax.Array, jax.Array]:
        dist, place, normal = boxbox_jax.box_box(below, boxbox_jax.Box(pos, turn, size))
        return dist.min(), dist.sum() + place.sum() + normal.sum()

    deepest, everything = jit(jax.jacfwd(contacts_of))(jnp.array([0.0, 0.0, 0.098]))
    np.testing.assert_allclose(deepest, [0, 0, 0.5], atol=1e-6)
    assert jnp.isfinite(everything).all()
    backwards = jit(jax.grad(lambda pos: contacts_of(pos)[1]))(jnp.array([0.0, 0.0, 0.098]))
    np.testing.assert_allclose(backwards, everything, atol=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Models.

STACK = """
<mujoco>
  <custom>
    <numeric name="published_contacts" data="0"/>
    <numeric name="max_contact_points" data="40"/><numeric name="max_geom_pairs" data="10"/>
  </custom>
  <asset><mesh name="slab" vertex="{vertices}"/></asset>
  <worldbody>
    <geom type="plane" size="2 2 .1" contype="3" conaffinity="3"/>
    <geom type="box" size=".2 .2 .1" pos="0 0 .1"/>
    <body pos=".03 .01 .265" quat="1 .02 .01 .3"><freejoint/><geom type="box" size=".08 .06 .07"/></body>
    <body pos="1 0 .01" quat="1 .01 0 0"><freejoint/><geom type="mesh" mesh="slab" contype="2" conaffinity="2"/></body>
  </worldbody>
</mujoco>
"""


def stack(chosen: contacts.Contacts) -> mujoco.MjModel:
    """A box that leans on another, and a mesh that leans on a plane."""
    with np.load(DATA / "plane_mesh_contacts_mujoco_3_3_0.npz", allow_pickle=False) as file:
        vertices = " ".join(repr(float(value)) for value in file["vertices"].ravel())
    model = mujoco.MjModel.from_xml_string(STACK.format(vertices=vertices))
    contacts.mark(model, chosen)
    return model


@functools.cache
def compiled_stack(impl: str, chosen: contacts.Contacts) -> tuple[mujoco.MjModel, Callable[..., np.ndarray]]:
    """The model, and a function of positions that gives its contacts, see ``sorted_rows``."""
    model = stack(chosen)
    put = mjx_contacts.put_model(model, impl=impl)
    blank = mjx.make_data(model, impl=impl, **({"naconmax": 64, "njmax": 128} if impl == "warp" else {}))
    forward = mjx.forward if impl == "warp" else lambda m, d: mjx.collision(m, mjx.kinematics(m, d))
    run = jit(lambda qpos: forward(put, blank.replace(qpos=qpos)))

    def touching(qpos: np.ndarray) -> np.ndarray:
        found = run(jnp.asarray(qpos, jnp.float32))._impl
        if impl == "warp":
            count = int(found.nacon[0])
            arrays = found.contact__geom, found.contact__dist, found.contact__pos, found.contact__frame
        else:
            contact = found.contact
            count, arrays = None, (contact.geom, contact.dist, contact.pos, contact.frame)
        return sorted_rows(*(np.asarray(array)[:count] for array in arrays))

    return model, touching


def sorted_rows(geom: np.ndarray, dist: np.ndarray, pos: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Geoms, position, distance and normal of the contacts below 0, [n, 9], in an order of its own."""
    rows = np.c_[geom, pos, dist, frame.reshape(-1, 9)[:, :3]][dist < 0]
    return rows[np.lexsort(np.round(rows[:, 4::-1], 4).T)]


def of_mujoco(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """The same from native MuJoCo."""
    from vecenv.libero.physics.colliders import install as collider

    collider.install()
    data = mujoco.MjData(model)
    data.qpos = qpos
    mujoco.mj_forward(model, data)
    contact = data.contact
    return sorted_rows(contact.geom, contact.dist, contact.pos, contact.frame)


def between(model: mujoco.MjModel, rows: np.ndarray, kind: str) -> np.ndarray:
    """Rows of the contacts whose second geom is of a kind."""
    return rows[model.geom_type[rows[:, 1].astype(int)] == getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")]


@pytest.mark.parametrize("impl", ["warp", "jax"])
def test_marked_models_get_native_contacts_and_others_in_the_process_their_own(impl: str) -> None:
    model, published = compiled_stack(impl, "published")
    depths = {}
    for chosen in ("published", "current", "published"):
        found = compiled_stack(impl, chosen)[1](model.qpos0)
        depths[chosen] = between(model, found, "BOX")[:, 5].min()
    assert depths["current"] == pytest.approx(2 * depths["published"], rel=1e-3)
    wanted_rows = between(model, of_mujoco(model, model.qpos0), "BOX")
    np.testing.assert_allclose(between(model, published(model.qpos0), "BOX"), wanted_rows, atol=2e-6)
    current = mjx.put_model(stack("current"), impl=impl)
    assert not int(current.opt.disableflags) & mjx_contacts.PUBLISHED


@pytest.mark.parametrize("impl", ["warp", "jax"])
def test_meshes_lie_on_planes_with_native_points(impl: str) -> None:
    model, touching = compiled_stack(impl, "published")
    with np.load(DATA / "plane_mesh_contacts_mujoco_3_3_0.npz", allow_pickle=False) as file:
        poses = file["poses"][:60]
    counts = set()
    for height, *quat in poses:
        qpos = np.array([*model.qpos0[:7], 1, 0, height, *np.array(quat) / np.linalg.norm(quat)])
        rows, ours = (between(model, found, "MESH") for found in (of_mujoco(model, qpos), touching(qpos)))
        assert len(ours) == len(rows)
        np.testing.assert_allclose(ours, rows, atol=2e-6)
        counts.add(len(rows))
    assert counts >= {1, 2, 3}


def slab() -> tuple[planemesh_jax.Hull, float]:
    """The mesh of the stack, and its bounding radius."""
    model = stack("published")
    hull = planemesh_jax.hull_of(model, 0)
    assert hull is not None
    return hull, float(model.geom_rbound[-1])


def test_a_mesh_that_lies_flat_has_the_points_of_mujoco() -> None:
    """Several vertices are equally low: which is the first depends on the way along the edges."""
    model, touching = compiled_stack("jax", "published")
    for turn in range(8):
        quat = [np.cos(turn * np.pi / 8), 0, 0, np.sin(turn * np.pi / 8)] if turn < 4 else np.eye(4)[turn - 4]
        qpos = np.array([*model.qpos0[:7], 1, 0, 0.005, *quat])
        rows = between(model, of_mujoco(model, qpos), "MESH")
        assert len(rows)
        np.testing.assert_allclose(between(model, touching(qpos), "MESH"), rows, atol=2e-6)


def test_derivatives_of_a_mesh_on_a_plane_are_those_of_its_points() -> None:
    hull, radius = slab()
    turn = jnp.asarray(rotation(np.array([1, 0.01, 0.02, 0.3])), jnp.float32)

    def contacts_of(height: jax.Array) -> tuple[jax.Array, jax.Array]:
        above = jnp.array([0.0, 0, 1])
        return planemesh_jax.plane_mesh(hull, above, jnp.zeros(3), above * height, turn, radius)

    dist, _ = contacts_of(jnp.array(0.0))
    for derivative in (jax.jacfwd, jax.jacrev):
        of_dist, of_pos = jit(derivative(contacts_of))(jnp.array(0.0))
        np.testing.assert_allclose(of_dist, dist < planemesh_jax.NOTHING, atol=1e-6)
        np.testing.assert_allclose(of_pos[:, 2][dist < 0], 0.5, atol=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# Another version of MJX.


def test_an_mjx_whose_functions_have_changed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    collision_driver, collision_primitive = private.warp_collision_driver, private.warp_collision_primitive
    changes: list[tuple[Any, str, Any, str]] = [
        (collision_driver, "primitive_narrowphase", lambda model, data: None, "takes model, data"),
        (collision_driver, "_narrowphase", lambda m, d, ctx: None, "does not refer to"),
        (collision_primitive, "box_box", lambda a, b: None, "takes a, b"),
        (collision_primitive, "_PRIMITIVE_COLLISIONS", {}, "is not a function"),
        (private.jax_collision_driver, "make_condim", lambda m, impl: None, "does not refer to _COLLISION_FUNC"),
        (private.jax_collision_driver, "_COLLISION_FUNC", {}, "is not a function"),
    ]
    for owner, name, value, message in changes:
        jax_side = owner is private.jax_collision_driver
        find = mjx_contacts._jax_functions if jax_side else mjx_contacts._warp_narrowphase
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            with pytest.raises(MjxContactsError, match=rf"{message}.*contacts='current'"):
                find()


def test_a_private_name_that_is_missing_is_reported_with_both_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(private, "mat43")
    with pytest.raises(ImportError, match=rf"has no mat43 .*tested with mujoco-mjx {private.TESTED}"):
        _ = private.mat43
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        getattr(private, "nonsense")  # noqa: B009


def test_the_installed_mjx_is_the_one_that_is_understood() -> None:
    """When this fails, MJX has changed what ``private`` imports or ``mjx_contacts`` copies: read its changes first."""
    for name in private.__all__:
        assert getattr(private, name) is not None, name
    assert callable(mjx_contacts._warp_narrowphase())
    assert set(mjx_contacts._jax_functions()) == {"collision", "make_condim"}


@pytest.mark.heavy
def test_a_bowl_that_starts_in_a_ramekin_stays_there_on_warp() -> None:
    ends = {}
    for backend in ("native", "warp"):
        env = vecenv.make("libero_spatial", task=5, episodes=range(2), backend=backend, start="raw")
        assert isinstance(env, LiberoEnv)
        env.reset()
        env.step_continuous(np.tile(SETTLE_ACTION, (2, 30, 1)))
        (group,) = env.physics.groups
        assert not env.physics.faults
        first = [group.scene.model.joint(entity.joints[0]).qposadr[0] for entity in group.scene.objects]
        ends[backend] = np.array(group.qpos)[:, np.array(first)[:, None] + np.arange(3)]
        env.close()
    # Half a millimetre: a bowl that slips off ends centimetres lower.
    np.testing.assert_allclose(ends["warp"], ends["native"], atol=5e-4)
