"""Published contacts inside MuJoCo: marked models get them, whatever else runs in the process does not notice."""

from __future__ import annotations

import threading

import mujoco
import numpy as np
import pytest
from support.paths import DATA

import vecenv
from vecenv.libero.physics.colliders import install as collider
from vecenv.libero.physics.colliders.install import ColliderError
from vecenv.libero.scene import contacts
from vecenv.libero.scene.contacts import ContactsError

# Boxes on boxes and a wedge on a plane, all of which lean a little.
STACK = """
<mujoco>
  {custom}
  <asset><mesh name="slab" vertex="{vertices}"/></asset>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <geom type="box" size=".2 .2 .1" pos="0 0 .1"/>
    <body pos=".03 .01 .26" quat="1 .02 .01 .3"><freejoint/><geom type="box" size=".08 .06 .07"/></body>
    <body pos="-.02 .02 .37" quat="1 .01 -.02 .1"><freejoint/><geom type="box" size=".05 .05 .05"/></body>
    <body pos="{pos}" quat="{quat}"><freejoint/><geom name="slab" type="mesh" mesh="slab"/></body>
  </worldbody>
</mujoco>
"""
NUMERIC = '<custom><numeric name="published_contacts" data="0"/></custom>'


def text(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def stack(custom: str = NUMERIC, pos: str = "1 0 .01", quat: str = "1 .01 0 0") -> mujoco.MjModel:
    with np.load(DATA / "plane_mesh_contacts_mujoco_3_3_0.npz", allow_pickle=False) as file:
        vertices = text(file["vertices"])
    return mujoco.MjModel.from_xml_string(STACK.format(custom=custom, vertices=vertices, pos=pos, quat=quat))


def run(model: mujoco.MjModel, steps: int) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=steps)
    return np.concatenate([data.qpos, data.qvel])


def touching(model: mujoco.MjModel, *kinds: mujoco.mjtGeom) -> np.ndarray:
    """Distance, position and normal of all contacts, or of those between two kinds of geom, [n, 7]."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    contact = data.contact
    rows = np.concatenate([contact.dist[:, None], contact.pos, contact.frame[:, :3]], axis=1)
    return rows[(model.geom_type[contact.geom] == kinds).all(axis=1)] if kinds else rows


@pytest.fixture(autouse=True, scope="module")
def installed() -> None:
    collider.install()


def test_marked_models_get_published_contacts() -> None:
    model, boxes = stack(), (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_BOX)
    current, depth = touching(model), touching(model, *boxes)[:, 0].min()
    contacts.mark(model, "published")
    assert contacts.of(model) == "published"
    assert touching(model, *boxes)[:, 0].min() == pytest.approx(depth / 2)
    contacts.mark(model, "current")
    np.testing.assert_array_equal(touching(model), current)


@pytest.mark.parametrize("custom", ["", NUMERIC, '<custom><numeric name="other" data="1 2 3"/></custom>'])
def test_models_without_the_mark_get_what_they_would_get_without_us(custom: str) -> None:
    model = stack(custom)
    table = collider._table()
    ours = table[6][6], table[0][7]
    with_us = touching(model)
    table[6][6], table[0][7] = (int(collider._LAYOUT[i]) for i in (0, 1))
    try:
        without_us = touching(model)
    finally:
        table[6][6], table[0][7] = ours
    np.testing.assert_array_equal(with_us, without_us)


def test_a_foreign_model_in_another_thread_beside_a_batch_does_not_notice() -> None:
    model = stack(custom="")
    alone = run(model, 400)
    env = vecenv.make("libero_object", task=0, episodes=range(8))
    env.reset()
    found: list[np.ndarray] = []
    thread = threading.Thread(target=lambda: found.extend(run(model, 400) for _ in range(20)))
    thread.start()
    actions = np.zeros((8, 7))
    while thread.is_alive():
        env.step_continuous(actions)
    thread.join()
    env.close()
    assert len(found) == 20
    for state in found:
        np.testing.assert_array_equal(state, alone)


def test_meshes_on_planes_touch_as_mujoco_3_3_0_recorded() -> None:
    with np.load(DATA / "plane_mesh_contacts_mujoco_3_3_0.npz", allow_pickle=False) as file:
        poses, rows = file["poses"], file["contacts"]
    counts = set()
    for number, (height, *quat) in enumerate(poses):
        model = stack(pos=f"1 0 {float(height)!r}", quat=text(np.array(quat)))
        contacts.mark(model, "published")
        found = touching(model, mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_MESH)
        wanted = rows[rows[:, 0] == number, 1:] + [0, 1, 0, 0, 0, 0, 0]  # recorded at the origin
        assert len(found) == len(wanted), f"pose {number}"
        # MuJoCo stores vertices in single precision, and compiles them a little differently.
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-7, err_msg=f"pose {number}")
        counts.add(len(found))
    assert counts >= {1, 2, 3}


def test_a_mujoco_with_other_fields_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collider, "_DATA_FIELDS", {"geom_xpos": np.float32})
    with pytest.raises(ColliderError, match=r"MuJoCo 3\.\d+.*geom_xpos is of type float64.*contacts='current'"):
        collider._offsets()


def test_a_mujoco_that_calls_its_colliders_in_another_way_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    collider._verify()
    monkeypatch.setattr(collider.boxbox, "box_box", lambda *_: np.ones((4, 7)))
    with pytest.raises(ColliderError, match="does not return our contacts"):
        collider._verify()


def test_bad_values_are_refused_with_the_allowed_ones() -> None:
    for bad in ("", "Published", "3.3", None):
        with pytest.raises(ContactsError, match="published, current"):
            contacts.checked(bad)  # type: ignore[arg-type]
    with pytest.raises(ContactsError, match="no custom number"):
        contacts.mark(stack(custom=""), "published")
    with pytest.raises(ValueError, match="published, current"):
        vecenv.make("libero_object", task=0, episodes=[0], contacts="old")
    with pytest.raises(vecenv.OptionError, match="contacts"):
        vecenv.make("simpler/bridge", task="widowx_stack_cube", episodes=[0], contacts="current")
