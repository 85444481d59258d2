"""The 3-D view: bodies and poses are those of the physics, and its thread draws what it is offered."""

from __future__ import annotations

import io
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from support.simpler_batches import CARROT, OPEN_TOP, batch

import vecenv
from vecenv.errors import InvalidInput, ServiceError

pytest.importorskip("trimesh")
pytest.importorskip("viser", reason="needs viser: pip install 'vecenv[viser]'")
import trimesh
from vecenv_eval.web import scene3d
from vecenv_eval.web.looks3d import POINTS_NOTE, look
from vecenv_eval.web.scene3d import PlanLook, Scene3D
from vecenv_eval.web.shapes3d import glb_of_bodies

UP = np.array([[0, 0, 1.0, 0, 0, 0, -1.0]])
SHAPES = """<mujoco><asset>
  <texture name="red" type="2d" builtin="flat" rgb1="1 0 0" width="4" height="4"/><material name="red" texture="red"/>
</asset><worldbody>
  <geom name="floor" type="plane" size="0 0 1"/><geom name="wall_left" type="box" size="1 1 1"/>
  <body pos="1 2 3"><freejoint/>
    <geom type="box" size=".1 .2 .3" pos="0 0 1" quat="0.7071068 0.7071068 0 0" material="red" group="1"/>
    <geom type="sphere" size=".1" group="1"/><geom type="capsule" size=".1 .2" group="1"/>
    <geom type="cylinder" size=".1 .2" group="1"/><geom type="ellipsoid" size=".1 .2 .3" group="1"/>
    <geom name="unseen" type="sphere" size="9" rgba="0 0 0 0" group="1"/><geom name="hits" type="sphere" size="9"/>
  </body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def libero() -> Iterator[Any]:
    env = vecenv.make("libero_goal", tasks=[8], episodes=[0, 1])
    env.reset()
    yield env
    env.close()


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene3D]:
    monkeypatch.setattr(Scene3D, "watched", True)
    made = Scene3D()
    yield made
    made.close()


def until(condition: Any, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.02)


def vertices(glb: bytes) -> np.ndarray:
    return loaded(glb).to_geometry().vertices


def loaded(glb: bytes) -> Any:
    return trimesh.load(io.BytesIO(glb), file_type="glb")


def test_geoms_are_in_the_frame_of_their_body() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    found = glb_of_bodies(model, groups=(1,))
    assert list(found) == [1]
    corners = vertices(found[1])
    # The box's z half extent lies along y after a turn about x; nothing of radius 9 is there.
    np.testing.assert_allclose(corners.max(axis=0), (0.1, 0.3, 1.2), atol=1e-6)
    np.testing.assert_allclose(corners.min(axis=0), (-0.1, -0.3, -0.3), atol=1e-6)


def test_hidden_geoms_and_groups_are_left_out() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    found = glb_of_bodies(model, groups=(0,), hidden=("wall",))
    assert np.abs(vertices(found[0])[:, 2]).max() < 1e-6  # only the floor is left of the world
    assert np.linalg.norm(vertices(found[1]), axis=1).max() == pytest.approx(9, rel=1e-3)


def test_a_texture_tints_what_has_no_texture_coordinates() -> None:
    model = mujoco.MjModel.from_xml_string(SHAPES)
    scene = loaded(glb_of_bodies(model, groups=(1,))[1])
    colors = [tuple(mesh.visual.material.baseColorFactor[:3]) for mesh in scene.geometry.values()]
    assert (255, 0, 0) in colors


def test_a_slot_of_libero_is_posed_as_the_physics_poses_it(libero: Any) -> None:
    taken = look(libero, 1)
    assert taken is not None
    before = taken.poses()
    state = libero.state()
    model = libero.mj_models[0]
    hand = np.concatenate([each[1] for each in libero.physics.eef()])
    np.testing.assert_allclose(before["hand"], hand)
    assert set(before) == {f"bodies/{body}" for body in range(model.nbody)} | {"hand"}
    # A free object's pose is its part of qpos.
    bowl = model.joint("akita_black_bowl_1_joint0")
    body, start = int(bowl.bodyid[0]), int(bowl.qposadr[0])
    np.testing.assert_allclose(before[f"bodies/{body}"], state.qpos[1, start : start + 7], atol=1e-9)
    libero.step_continuous(np.repeat(UP, 2, axis=0))
    np.testing.assert_array_equal(taken.poses()["hand"], before["hand"])  # a look is a copy
    after = look(libero, 1)
    assert after is not None
    assert after.poses()["hand"][2] > before["hand"][2]
    assert after.key == taken.key


def test_bodies_are_drawn_where_they_are_and_moved(libero: Any, view: Scene3D) -> None:
    view.placed(libero)
    until(lambda: len(view._poses) > 20)
    poses = look(libero, 0)
    assert poses is not None
    for name, pose in poses.poses().items():
        if name in view._frames:
            np.testing.assert_allclose(view._frames[name].position, pose[:3], atol=1e-6)
    frames = dict(view._frames)
    height = view._frames["hand"].position[2]
    for _ in range(5):
        libero.step_continuous(np.repeat(UP, 2, axis=0))
    view.look(libero)
    until(lambda: view._frames["hand"].position[2] > height + 0.005)
    assert view._frames == frames  # the same scene is not built again
    view.follow(1)
    view.look(libero)
    other = look(libero, 1)
    assert other is not None
    hand = other.poses()["hand"]
    until(lambda: np.allclose(view._frames["hand"].position, hand[:3], atol=1e-4))


def test_a_tick_too_soon_is_asked_for_again(libero: Any, view: Scene3D) -> None:
    asked = []
    view.on_due = lambda: asked.append(1)
    view.look(libero)
    taken = view._latest
    view.tick(libero)
    assert view._latest is taken
    until(lambda: bool(asked))  # once the bodies are made


def test_nothing_is_made_while_nobody_looks(libero: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    view = Scene3D()
    try:
        assert not view.watched
        view.placed(libero)
        view.tick(libero)
        time.sleep(0.2)
        assert view._frames == {}
    finally:
        view.close()
        view.close()


def test_a_plan_is_drawn_and_taken_away(libero: Any, view: Scene3D) -> None:
    points = np.array([[0.0, 0, 1], [0, 0.1, 1], [0.1, 0.1, 1]])
    plan = PlanLook(
        text="<b>move</b>",
        path=points,
        stops=np.concatenate([points, np.tile([1.0, 0, 0, 0], (3, 1))], axis=1),
        targets=points[:1],
        avoid=points[1:],
        value=points,
        value_colors=np.zeros((3, 3), np.uint8),
    )
    view.slot = 0
    view._plans[0] = plan
    view.look(libero)
    until(lambda: len(view._plan) == 6)
    assert view._gui.subtask.value == "<b>move</b>"
    avoid = view._server.scene.get_handle_by_name("/plan/avoid")
    assert avoid is not None
    assert not avoid.visible
    view.placed(libero)
    until(lambda: not view._plan)
    assert view._gui.subtask.value == ""


def test_a_view_that_fails_says_so_and_goes_on(libero: Any, view: Scene3D, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene3d, "look", lambda env, slot: SimpleNamespace(key=1, poses=lambda: 1 / 0))
    view.look(libero)
    until(lambda: "failed" in view._gui._note.value)
    monkeypatch.undo()
    monkeypatch.setattr(Scene3D, "watched", True)
    view.look(libero)
    until(lambda: len(view._frames) > 5)


def test_the_objects_of_simpler_are_points_on_their_surfaces(small: Path) -> None:
    env = batch(small, CARROT, [0])
    try:
        taken, snapshot = look(env, 0), env.observe_objects().snapshot[0]
        assert taken is not None
        assert snapshot is not None
        model, poses = taken.model(), taken.poses()
        assert model.note == POINTS_NOTE
        np.testing.assert_allclose(poses["hand"], snapshot.ee_pose)
        for body in model.bodies:
            if not body.name.startswith("objects/"):
                continue
            assert body.points is not None
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, poses[body.name][3:7])
            points = body.points @ rotation.reshape(3, 3).T + poses[body.name][:3]
            np.testing.assert_allclose(points, snapshot.objects[body.name.removeprefix("objects/")].points, atol=1e-9)
    finally:
        env.close()


def test_drawers_of_simpler_move_on_their_own(small: Path) -> None:
    env = batch(small, OPEN_TOP, [0])
    try:
        before = look(env, 0)
        state = env.state()
        dof = env.robot.dof
        state.qpos[0, dof : dof + 3] += 0.05
        env.set_state(state)
        after = look(env, 0)
        assert before is not None
        assert after is not None
        assert before.key == after.key
        names = [name for name in before.poses() if name.startswith("parts/")]
        assert len(names) == 3
        for name in names:
            assert after.poses()[name][0] - before.poses()[name][0] == pytest.approx(0.05)
        moved, still = (
            {body.name: body.points for body in each.model().bodies if body.points is not None}
            for each in (after, before)
        )
        for name in names:
            np.testing.assert_allclose(moved[name], still[name], atol=1e-9)
    finally:
        env.close()


def test_the_view_follows_a_session_and_the_page_chooses_its_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fastapi")
    from fastapi.testclient import TestClient
    from support.live_world import session
    from vecenv_eval.web.app import create_app
    from vecenv_eval.web.routes_view3d import attach_view3d

    seen: list[tuple[int, int]] = []
    monkeypatch.setattr(Scene3D, "watched", True)
    monkeypatch.setattr(scene3d, "look", lambda env, slot: seen.append((slot, int(env.ticks[slot]))))
    with session() as live:
        scene = Scene3D()
        app = create_app(live)
        attach_view3d(app, live, scene)
        live.wait_until("ready", timeout=30)
        with TestClient(app, base_url="http://127.0.0.1:8000") as client:
            assert client.get("/api/session").json()["url_3d"] == scene.url
            until(lambda: (0, 0) in seen)
            assert client.post("/api/view3d", json={"slot": 4}).json() == {"ok": True}
            until(lambda: (4, 0) in seen)
            assert scene._gui.slot.value == 4
            live.act("step", 3)
            until(lambda: (4, 3) in seen)  # the last tick too, however soon it came after the one before
            assert client.post("/api/view3d", json={"slot": -1}).status_code == 422
        assert scene._closed


@pytest.mark.parametrize(
    ("options", "status", "text"),
    [(["--port-3d", "8000"], 2, "--port-3d needs --view-3d"), (["--view-3d"], 1, "pip install 'vecenv[viser]'")],
)
def test_options_that_cannot_be_had_are_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], options: list[str], status: int, text: str
) -> None:
    import typer
    from vecenv_eval.cli import listening, serve

    installed = listening.is_installed
    monkeypatch.setattr(listening, "is_installed", lambda module: module != "viser" and installed(module))
    app = typer.Typer()
    app.command()(serve.serve_command)
    with pytest.raises(SystemExit) as ended:
        app(["--no-open", "--port", "0", *options])
    assert ended.value.code == status
    assert text in " ".join(capfd.readouterr().err.split())


def test_a_port_in_use_is_a_sentence() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ServiceError, match=f"the port of the 3-D view, {port}, is in use"):
            Scene3D(port)
    with pytest.raises(InvalidInput, match="70000"):
        Scene3D(70000)
