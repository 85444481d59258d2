"""The arm computed from its joints alone against MuJoCo's own kinematics and dynamics, and what JAX is promised."""

from __future__ import annotations

import copy
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from vecenv.controllers import osc
from vecenv.controllers.chain import chain_from_model
from vecenv.controllers.kinematics import Chain, arm_state, hand_pose
from vecenv.libero.physics.mjx.options import compiler_options
from vecenv.libero.robot import ARM_JOINTS, FINGER_JOINTS, GRIP_SITE, HAND_BODY, HOME_QPOS, panda_chain
from vecenv.libero.tasks.sources import installed_tasks

# The options the library uses, and the same without LLVM's optimisation, which compile 5 times faster.
OPTIONS = compiler_options()
UNOPTIMISED: dict[str, Any] = {**OPTIONS, "xla_backend_optimization_level": 0}
optimised, compiled = (partial(jax.jit, compiler_options=options) for options in (OPTIONS, UNOPTIMISED))
# States of most tests: functions of as many compile once.
COUNT = 500
# One scene on the floor, one on a table with a mount under the robot.
SUITES = ("libero_object", "libero_spatial")


@cache
def scene_model(suite: str) -> mujoco.MjModel:
    return installed_tasks(suite)[0].scene(()).model


@pytest.fixture(scope="module")
def chain() -> Chain:
    return panda_chain(scene_model("libero_spatial"))


class States(NamedTuple):
    """Joint states: positions and velocities [n, 9]."""

    qpos: np.ndarray
    qvel: np.ndarray


def states_of(model: mujoco.MjModel, count: int = COUNT, seed: int = 0) -> States:
    """Joints anywhere in their ranges, the arm at some rad/s, the fingers at some dm/s."""
    rng = np.random.default_rng(seed)
    low, high = model.jnt_range[:9].T
    return States(rng.uniform(low, high, (count, 9)), rng.normal(size=(count, 9)) * [*[1.5] * 7, 0.3, 0.3])


class Truth(NamedTuple):
    """What MuJoCo makes of joint states."""

    eef_pos: np.ndarray
    eef_mat: np.ndarray
    jacobian: np.ndarray
    mass_matrix: np.ndarray
    bias: np.ndarray
    hand_quat: np.ndarray


def truth_of(model: mujoco.MjModel, states: States) -> Truth:
    model = copy.copy(model)
    # Contacts change none of this and cost most of the time.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    site, hand = model.site(GRIP_SITE).id, model.body(HAND_BODY).id
    jacobian, full = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
    rows = []
    for qpos, qvel in zip(*states, strict=True):
        data.qpos[:9], data.qvel[:9] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        mujoco.mj_fullM(model, data, full)
        row = (data.site_xpos[site], data.site_xmat[site].reshape(3, 3), jacobian[:, :7], full[:7, :7])
        rows.append([np.copy(x) for x in (*row, data.qfrc_bias[:7], data.xquat[hand])])
    return Truth(*map(np.array, zip(*rows, strict=True)))


def found_of(chain: Chain, states: States) -> Truth:
    """What we make of joint states, in float64."""
    with jax.enable_x64(True):
        arm, (pos, quat) = compiled(arm_state)(chain, *states), compiled(hand_pose)(chain, states.qpos)
    np.testing.assert_array_equal(pos, arm.eef_pos)
    fields = (arm.eef_pos, arm.eef_mat, arm.jacobian, arm.mass_matrix, arm.bias, quat)
    return Truth(*map(np.asarray, fields))


def assert_equal(found: Truth, truth: Truth) -> None:
    for name, ours, theirs in zip(Truth._fields, found, truth, strict=True):
        assert ours.dtype == np.float64
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12 * np.abs(theirs).max(), err_msg=name)


# Parity -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suite", SUITES)
def test_500_random_states_of_a_scene_equal_mujocos(suite: str) -> None:
    model = scene_model(suite)
    states = states_of(model)
    assert_equal(found_of(panda_chain(model), states), truth_of(model, states))


def test_the_base_is_where_the_scene_puts_it() -> None:
    floor, table = (panda_chain(scene_model(suite)) for suite in SUITES)
    bases = [scene_model(suite).body("robot0_base").pos for suite in SUITES]
    assert np.abs(bases[0] - bases[1]).max() > 0.5
    np.testing.assert_allclose(np.subtract(table.base, floor.base), bases[1] - bases[0], atol=1e-15)


def numbers(values: np.ndarray) -> str:
    return " ".join(map(str, values))


def made_up_robot(seed: int = 0) -> str:
    """MJCF of an arm of the same plan with nothing aligned: any axes, offsets, inertias, reference angles, gravity."""
    rng = np.random.default_rng(seed)

    def pose(scale: float = 0.3) -> str:
        return f'pos="{numbers(rng.normal(size=3) * scale)}" quat="{numbers(rng.normal(size=4))}"'

    def inertial() -> str:
        return (
            f'<inertial {pose(0.1)} mass="{rng.uniform(0.5, 3)}" diaginertia="{numbers(rng.uniform(0.1, 0.15, 3))}"/>'
        )

    def joint(name: str, kind: str) -> str:
        where = f'pos="{numbers(rng.normal(size=3) * 0.1)}" axis="{numbers(rng.normal(size=3))}"'
        return f'<joint name="{name}" type="{kind}" {where} ref="{rng.normal()}" armature="{rng.uniform(0, 1)}"/>'

    inner = "".join(
        f"<body {pose()}>{joint(name, 'slide')}{inertial()}<body {pose()}>{inertial()}</body></body>"
        for name in ("gripper0_finger_joint1", "gripper0_finger_joint2")
    )
    inner = (
        f'<body name="robot0_right_hand" {pose()}>{inertial()}<site name="gripper0_grip_site" {pose()}/>{inner}</body>'
    )
    for index in range(7, 0, -1):
        inner = f'<body name="link{index}" {pose()}>{joint(f"robot0_joint{index}", "hinge")}{inertial()}{inner}</body>'
    return f"""<mujoco><compiler angle="radian"/><option gravity="{numbers(rng.normal(size=3) * 9)}"/><worldbody>
    <body {pose()}>{inertial()}{inner}</body><body name="free">{inertial()}<freejoint/></body>
    </worldbody></mujoco>"""


def test_a_robot_with_nothing_aligned_equals_mujocos() -> None:
    model = mujoco.MjModel.from_xml_string(made_up_robot())
    rng = np.random.default_rng(1)
    states = States(rng.uniform(-3, 3, (COUNT, 9)), rng.normal(size=(COUNT, 9)))
    assert_equal(found_of(panda_chain(model), states), truth_of(model, states))


def test_without_gravity_there_is_none() -> None:
    model = mujoco.MjModel.from_xml_string(made_up_robot())
    assert np.any(panda_chain(model).gravity)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
    assert not np.any(panda_chain(model).gravity)


# float32 ------------------------------------------------------------------------------------------------------------


def torques_in(now: osc.ArmState, before: osc.ArmState, action: Any) -> jax.Array:
    """Torques of arms for goals set where they were before."""
    goal = osc.set_goal(before, osc.hold_goal(before), action)
    return osc.torques(now, goal, jnp.asarray(HOME_QPOS, action.dtype))


def torques_from_joints(chain: Chain, now: States, before: States, action: Any) -> jax.Array:
    """The same, in one program as a simulator has it."""
    both = arm_state(chain, *jax.tree.map(lambda *x: jnp.stack(x), now, before))
    seen, remembered = (jax.tree.map(lambda x, i=i: x[i], both) for i in range(2))
    return torques_in(seen, remembered, action)


def test_float32_torques_are_good_to_a_millinewton_metre(chain: Chain) -> None:
    """Of 20,000 such states none was off by more; 0.25 % were before those near a singularity were left out."""
    rng, model = np.random.default_rng(3), scene_model("libero_spatial")
    single, exact, regular = partial(optimised(torques_from_joints), chain), compiled(torques_in), []
    for seed in range(6):
        before = states_of(model, seed=seed)
        now = before._replace(qpos=before.qpos + rng.normal(size=(COUNT, 9)) * [*[0.02] * 7, 0, 0])
        inputs = jax.tree.map(np.float32, (now, before, rng.uniform(-1, 1, (COUNT, 6))))
        found = single(*inputs)
        assert found.dtype == np.float32
        with jax.enable_x64(True):
            now, before, action = jax.tree.map(np.float64, inputs)
            arms = [compiled(arm_state)(chain, *states) for states in (now, before)]
            error = np.abs(found - np.asarray(exact(*arms, action))).max(axis=1)
        regular.append(np.linalg.svd(arms[0].jacobian, compute_uv=False)[:, -1] > 0.05)
        assert error[regular[-1]].max() < 1e-3
    assert np.mean(regular) > 0.6


# What JAX is promised -----------------------------------------------------------------------------------------------


def assert_same(found: osc.ArmState, expected: osc.ArmState) -> None:
    for name, ours, other in zip(osc.ArmState._fields, found, expected, strict=True):
        np.testing.assert_allclose(ours, other, rtol=1e-12, atol=1e-13, err_msg=name)


def test_any_leading_axes_give_the_same(chain: Chain) -> None:
    states = states_of(scene_model("libero_spatial"))
    with jax.enable_x64(True):
        flat = compiled(arm_state)(chain, *states)
        folded = compiled(arm_state)(chain, *(x.reshape(2, -1, 9) for x in states))
    assert_same(jax.tree.map(lambda x: x.reshape(COUNT, *x.shape[2:]), folded), flat)


def test_under_vmap_and_scan_masses_may_differ_between_slots() -> None:
    model = mujoco.MjModel.from_xml_string(made_up_robot())
    states, light = States(*np.random.default_rng(2).normal(size=(2, COUNT, 9))), panda_chain(model)
    model.body_mass[model.body("link7").id] += 2.0
    heavy = panda_chain(model)

    def scanned(chain: Chain) -> osc.ArmState:
        return jax.lax.scan(lambda _, state: (None, arm_state(chain, *state)), None, states)[1]

    with jax.enable_x64(True):
        both = compiled(jax.vmap(scanned))(jax.tree.map(lambda *x: np.stack(x), light, heavy))
        alone = [compiled(arm_state)(chain, *states) for chain in (light, heavy)]
    for slot, expected in enumerate(alone):
        assert_same(jax.tree.map(lambda x, slot=slot: x[slot], both), expected)
    np.testing.assert_allclose(alone[1].bias, truth_of(model, states).bias, rtol=1e-10, atol=1e-10)
    assert np.abs(alone[1].bias - alone[0].bias).max() > 1.0


def test_leading_axes_broadcast_and_the_dtype_follows_the_inputs(chain: Chain) -> None:
    def found(qpos: np.ndarray, qvel: np.ndarray) -> list[Any]:
        return [*jax.eval_shape(arm_state, chain, qpos, qvel), *jax.eval_shape(hand_pose, chain, qpos)]

    single, double, whole = np.zeros((4, 1, 9), np.float32), np.zeros((3, 9)), np.zeros(9, int)
    tails = [(7,), (7,), (3,), (3, 3), (6, 7), (7, 7), (7,)]
    with jax.enable_x64(True):
        mixed = found(single, double)
        assert [x.shape for x in mixed] == [(4, 3, *tail) for tail in tails] + [(4, 1, 3), (4, 1, 4)]
        assert [x.dtype for x in mixed] == [np.float64] * 7 + [np.float32] * 2
        assert {x.dtype for x in found(single, single)} == {jnp.dtype(np.float32)}
    assert {x.dtype for x in found(whole, whole)} == {jnp.dtype(np.float32)}


def test_the_jacobian_is_the_slope_of_the_sites_position(chain: Chain) -> None:
    states, step = states_of(scene_model("libero_spatial")), 1e-6
    directions = np.random.default_rng(5).normal(size=(COUNT, 9))

    @compiled
    def slope(qpos: jax.Array, direction: jax.Array) -> jax.Array:
        return jax.jvp(lambda x: hand_pose(chain, x)[0], (qpos,), (direction,))[1]

    def ahead(step: float) -> np.ndarray:
        return np.asarray(compiled(hand_pose)(chain, states.qpos + step * directions)[0])

    with jax.enable_x64(True):
        found = np.asarray(slope(states.qpos, directions))
        jacobian = np.asarray(compiled(arm_state)(chain, *states).jacobian)
        differences = (ahead(step) - ahead(-step)) / (2 * step)
    np.testing.assert_allclose(found, np.einsum("nij,nj->ni", jacobian[:, :3], directions[:, :7]), atol=1e-12)
    np.testing.assert_allclose(found, differences, atol=1e-8)


def test_gradients_are_finite_and_equal_finite_differences_moving_and_at_rest(chain: Chain) -> None:
    model, step = scene_model("libero_spatial"), 1e-6
    moving, still = states_of(model, 2), np.zeros((1, 9))
    states = np.concatenate([np.hstack(moving), np.hstack([still, still])])
    directions = np.random.default_rng(4).normal(size=(18, 18))

    @compiled
    @partial(jax.grad, has_aux=True)
    def slopes_and_values(states: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of a number for each slot that depends on every number of its arm's state and its hand's pose."""
        qpos, qvel = states[..., :9], states[..., 9:]
        parts = (*arm_state(chain, qpos, qvel), *hand_pose(chain, qpos))
        flat = jnp.concatenate([part.reshape(len(states), -1) for part in parts], axis=1)
        values = jnp.sum(flat * np.arange(1, flat.shape[1] + 1)[None], axis=1)
        return jnp.sum(values), values

    shifted = states[:, None, None] + step * np.stack([directions, -directions])
    with jax.enable_x64(True):
        slopes, values = slopes_and_values(np.concatenate([states, shifted.reshape(-1, 18)]))
    ends = np.asarray(values)[3:].reshape(3, 2, 18)
    expected = (ends[:, 0] - ends[:, 1]) / (2 * step)
    np.testing.assert_allclose(np.asarray(slopes)[:3] @ directions.T, expected, rtol=1e-6, atol=1e-4)


def test_a_broken_slot_does_not_touch_the_others(chain: Chain) -> None:
    states = states_of(scene_model("libero_spatial"))
    broken = jax.tree.map(np.copy, states)
    broken.qpos[1, 2], broken.qvel[2, 8] = np.nan, np.inf
    with jax.enable_x64(True):
        before, after = (compiled(arm_state)(chain, *x) for x in (states, broken))
    assert not np.isfinite(after.mass_matrix[1]).all()
    assert not np.isfinite(after.bias[2]).all()
    for ours, expected in zip(after, before, strict=True):
        np.testing.assert_array_equal(*(np.delete(x, [1, 2], axis=0) for x in (ours, expected)))


def test_no_matrix_product_is_left_to_the_accelerator(chain: Chain) -> None:
    """An accelerator would round float32 matrix products to TF32."""
    states = states_of(scene_model("libero_spatial"))
    with jax.enable_x64(True):
        traces = jax.jit(arm_state).trace(chain, *states), jax.jit(hand_pose).trace(chain, states.qpos)
    for text in (str(trace.jaxpr) for trace in traces):
        assert "dot_general" not in text
        assert "cos" in text


def test_compiled_for_a_cpu_nothing_is_computed_many_times(chain: Chain) -> None:
    """XLA's CPU fusion would copy early steps into every later one; without stages it does 2.4 times the work."""
    with jax.enable_x64(True):
        lowered: Any = jax.jit(arm_state).lower(chain, *states_of(scene_model("libero_spatial")))
        written = lowered.cost_analysis()["flops"]
        for options in ({}, OPTIONS):  # as anybody compiles it, and as the library does
            done = lowered.compile(compiler_options={**options, "xla_backend_optimization_level": 0})
            assert written <= 1.2 * done.cost_analysis()["flops"] <= 1.5 * written


# Errors -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"robot0_joint3" type="hinge"', '"elbow" type="hinge"', "no joint 'robot0_joint3'"),
        ('"robot0_joint3" type="hinge"', '"robot0_joint3" type="slide"', "'robot0_joint3' must be a hinge"),
        ('"gripper0_grip_site"', '"tip"', "no site 'gripper0_grip_site'"),
        ('"robot0_right_hand"', '"palm"', "no body 'robot0_right_hand'"),
        (
            "<worldbody>",
            '<worldbody><body><joint name="door"/><geom size="1"/></body>',
            "'robot0_joint1' must be number 0",
        ),
        (
            '<body name="link4"',
            '<body><joint type="ball"/><geom size="1"/></body><body name="link4"',
            "must be number 3",
        ),
    ],
)
def test_a_robot_built_otherwise_is_refused(old: str, new: str, message: str) -> None:
    xml = made_up_robot()
    assert old in xml
    with pytest.raises(ValueError, match=message):
        panda_chain(mujoco.MjModel.from_xml_string(xml.replace(old, new)))


def test_names_of_the_wrong_number_or_place_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(made_up_robot())
    names: dict[str, Any] = {
        "arm_joints": ARM_JOINTS,
        "finger_joints": FINGER_JOINTS,
        "site": GRIP_SITE,
        "hand": HAND_BODY,
    }
    with pytest.raises(ValueError, match="need 7 arm joints and 2 finger joints"):
        chain_from_model(model, **{**names, "arm_joints": ["robot0_joint1"]})
    with pytest.raises(ValueError, match="body 'link6' must be fixed to the link of joint 'robot0_joint7'"):
        chain_from_model(model, **{**names, "hand": "link6"})


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_named(chain: Chain) -> None:
    with pytest.raises(ValueError, match=r"qvel must have shape \[..., 9\], got \[2, 7\]"):
        arm_state(chain, np.zeros((2, 9)), np.zeros((2, 7)))
    with pytest.raises(ValueError, match=r"qpos must have shape \[..., 9\], got \[58\]"):
        hand_pose(chain, np.zeros(58))
