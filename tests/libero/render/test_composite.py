"""Images of which only that is drawn which has moved are those that MuJoCo draws whole, to the bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from support import upstream
from support.box_scene import SIZE, shot, tiny_scene
from support.images import needs_gl

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render import lod, painter
from vecenv.libero.render.colors import visual_scene
from vecenv.libero.render.composite import Compositor
from vecenv.libero.render.culling import View
from vecenv.libero.render.drawing import Pose, Sight, Stage
from vecenv.libero.render.gl import GlRenderer, Shot, Wanted
from vecenv.libero.render.options import POLICY_CAMERAS, CameraShift, UserCamera, VisualOptions
from vecenv.libero.render.stillness import SETTLED, Stillness
from vecenv.libero.tasks.suites import list_tasks

EYES = ("agentview", "side")

SHAPES = """
<mujoco>
  <asset>
    <texture name="flat" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"/>
    <texture name="cube" type="cube" builtin="gradient" rgb1="1 1 0" rgb2="0 0 1" width="32" height="32"/>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.4 0.6 0.8" rgb2="0 0 0.2" width="32" height="32"/>
    <material name="flat" texture="flat" texrepeat="3 2" specular="0.9" shininess="0.7"/>
    <material name="even" texture="flat" texrepeat="4 5" texuniform="true" emission="0.2"/>
    <material name="cubic" texture="cube"/>
    <material name="even_cubic" texture="cube" texuniform="true"/>
    <material name="plain" rgba="0.1 0.8 0.3 1"/>
    <material name="mirror" texture="flat" rgba="0.3 0.3 0.3 1" reflectance="{reflectance}"/>
    <mesh name="bare" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 1 1 -1 -1 -1 1 1 -1 1 -1 1 1 1 1 1" scale="0.1 0.1 0.1"/>
    <mesh name="mapped" vertex="0 0 0 1 0 0 0 1 0 0 0 1" texcoord="0 0 1 0 0 1 1 1" scale="0.3 0.3 0.3"/>
  </asset>
  <worldbody>
    <light pos="0 0 5" castshadow="false"/>
    <light pos="1 -1 3" dir="-0.3 0.3 -1" type="spot" diffuse="0.2 0.4 0.2" castshadow="false"/>
    <camera name="agentview" pos="0 -2 2" xyaxes="1 0 0 0 0.7 0.7" fovy="50"/>
    <camera name="side" pos="-2.5 0 0.4" xyaxes="0 -1 0 0 0 1" fovy="60"/>
    <geom name="floor" type="plane" size="2 2 0.1" rgba="0.5 0.5 0.5 1" group="1"/>
    <geom name="plate" type="box" size="0.7 0.5 0.05" pos="0 0.2 0.05" material="mirror" group="1"/>
    <body name="box_1_main" pos="0 0 0.5">
      <freejoint/>
      <geom type="mesh" mesh="bare" material="flat" group="1"/>
      <geom type="mesh" mesh="bare" material="even" pos="0.4 0 0" group="1"/>
      <geom type="mesh" mesh="bare" material="cubic" pos="0.8 0 0" group="1"/>
      <geom type="mesh" mesh="mapped" material="flat" pos="-0.6 0 0" group="1"/>
      <geom type="mesh" mesh="mapped" material="even" pos="-1 0 0" group="1"/>
    </body>
    <body name="ball_1_main" pos="0 0.4 0.9">
      <freejoint/>
      <geom type="sphere" size="0.1" material="even" pos="-0.9 0 0" group="1"/>
      <geom type="capsule" size="0.07 0.12" material="flat" pos="-0.6 0 0" group="1"/>
      <geom type="ellipsoid" size="0.1 0.2 0.05" material="cubic" pos="-0.3 0 0" group="1"/>
      <geom type="cylinder" size="0.1 0.1" material="plain" group="1"/>
      <geom type="box" size="0.1 0.05 0.12" material="even_cubic" pos="0.3 0 0" group="1"/>
      <geom type="box" size="0.05 0.1 0.12" material="even" pos="0.6 0 0" group="1"/>
      <geom type="capsule" size="0.05 0.1" rgba="0.8 0.2 0.9 {alpha}" pos="0.9 0 0" group="1"/>
      <site name="glow" type="sphere" size="0.06" rgba="1 1 0 1" pos="0 0 0.3"/>
    </body>
  </worldbody>
</mujoco>
"""


def shapes(reflectance: float = 0.6, alpha: float = 1.0) -> Stage:
    model = mujoco.MjModel.from_xml_string(SHAPES.format(reflectance=reflectance, alpha=alpha))
    return Stage(dataclasses.replace(tiny_scene(), model=model))


def posed(stage: Stage, box: Sequence[float], ball: Sequence[float], options: VisualOptions | None = None) -> Shot:
    """The two bodies at these heights above where they are, turned by as many radians."""
    model = stage.model
    qpos = model.qpos0.copy()
    for first, (rise, turn) in ((0, box), (7, ball)):
        qpos[first + 2] += rise
        qpos[first + 3 : first + 7] = [np.cos(turn / 2), np.sin(turn / 2), 0, 0]
    return Shot(0, Pose(qpos, model.body_pos.copy(), model.body_quat.copy()), options or VisualOptions())


def motion(stage: Stage) -> Iterator[Shot]:
    """Both at rest, one moves, it rests, the other moves, and there is another scene."""
    for _ in range(3):
        yield posed(stage, (0, 0), (0, 0))
    for tick in range(1, 4):
        yield posed(stage, (0.05 * tick, 0.3 * tick), (0, 0))
    for _ in range(SETTLED + 2):
        yield posed(stage, (0.15, 0.9), (0, 0))
    for tick in range(3):
        yield posed(stage, (0.15, 0.9), (0.05 * tick, 0.2 * tick))
    yield posed(stage, (0.4, -1), (-0.3, 1))
    yield posed(stage, (0.4, -1), (-0.3, 1))


class Drawn:
    """Two renderers of the same scenes, one of which stores layers, and how often it used one."""

    def __init__(self, stages: Sequence[Stage], size: int = SIZE) -> None:
        self.layered = GlRenderer(stages, height=size, width=size, num_threads=1)
        self.whole = GlRenderer(stages, height=size, width=size, num_threads=1, layer_memory=0)
        self.copies = 0

    def compare(self, *shots: Shot, cameras: Sequence[str | UserCamera] = EYES) -> None:
        """Both draw the same."""
        ours, theirs = (renderer.render(shots, cameras).rgb for renderer in (self.layered, self.whole))
        for camera, images in theirs.items():
            np.testing.assert_array_equal(ours[camera], images)
            assert images.any()


@contextmanager
def drawn(monkeypatch: pytest.MonkeyPatch, *stages: Stage, size: int = SIZE) -> Iterator[Drawn]:
    monkeypatch.setattr(painter, "is_worthwhile", lambda: True)
    found, copy = Drawn(stages, size), Compositor.copy

    def counted(self: Compositor, layer: int, area: mujoco.MjrRect) -> None:
        found.copies += 1
        copy(self, layer, area)

    monkeypatch.setattr(Compositor, "copy", counted)
    yield found
    found.layered.close()
    found.whole.close()


@needs_gl
@pytest.mark.parametrize("reflectance", [0.0, 0.6])
def test_images_of_layers_are_the_whole_ones(monkeypatch: pytest.MonkeyPatch, reflectance: float) -> None:
    """Every shape and texture that moves, with and without a mirror below, and with a sky behind."""
    stage = shapes(reflectance)
    with drawn(monkeypatch, stage, size=96) as both:
        for one in motion(stage):
            both.compare(one)
        assert both.copies > 20


@needs_gl
def test_a_mirror_without_layers_is_mujocos(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that moves, as one at the hand does."""
    stage, rng = shapes(), np.random.default_rng(0)
    with drawn(monkeypatch, stage, size=96) as both:
        for _ in range(12):
            shift = CameraShift(pos=tuple(rng.uniform(-0.6, 0.6, 3)), turn=tuple(rng.uniform(-0.3, 0.3, 3)))
            options = VisualOptions(cameras={"agentview": shift})
            box, ball = (rng.normal(size=(2, 2)) * 0.1).tolist()
            both.compare(posed(stage, box, ball, options))
        assert both.copies == 0


@needs_gl
def test_what_is_transparent_is_left_to_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = shapes(alpha=0.5)
    with drawn(monkeypatch, stage) as both:
        for one in motion(stage):
            both.compare(one)
        assert both.copies == 0


@needs_gl
def test_a_camera_that_mujoco_draws_for_goes_before_one_with_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one below the floor sees through it, which is left to MuJoCo."""
    stage = shapes()
    below = UserCamera.looking_at("below", eye=[0.5, 0, -2], target=[0, 0, 0], up=[1, 0, 0])
    with drawn(monkeypatch, stage) as both:
        for tick in range(4):
            # One thread chooses both cameras of a slot before it draws either, once it has two slots or more.
            both.compare(*[posed(stage, (0.1 * tick, 0), (0, 0))] * 2, cameras=(below, "agentview"))
        assert both.copies > 3


@needs_gl
def test_a_slot_may_change_its_looks_and_its_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = shapes(), Stage(tiny_scene())
    dim = VisualOptions(light=0.5, colors={"ball_1": (1.0, 0.2, 0.2)}, light_shift=(0.5, 0.0, 0.0))
    with drawn(monkeypatch, first, second) as both:
        for tick in range(3):
            both.compare(posed(first, (0.1 * tick, 0), (0, 0)), posed(first, (0, 0), (0, 0), dim))
        for tick in range(3):
            both.compare(posed(first, (0.1 * tick, 0), (0, 0), dim), posed(first, (0, 0), (0, 0)))
        for tick in range(3):
            other = dataclasses.replace(shot(second, box=(0.1 * tick, 0.1)), stage=1)
            both.compare(other, posed(first, (0.1 * tick, 0), (0, 0)))
        assert both.copies > 8


@needs_gl
def test_depths_and_segmentations_between_images_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = shapes()
    with drawn(monkeypatch, stage) as both:
        for tick in range(4):
            one = posed(stage, (0.1 * tick, 0), (0, 0))
            both.compare(one)
            both.layered.render([one], EYES, Wanted(rgb=True, depth=True, segmentation=True))
        assert both.copies


@needs_gl
def test_without_memory_for_its_layer_a_slot_is_drawn_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = shapes()
    with drawn(monkeypatch, stage) as both:
        both.layered.close()
        both.layered = GlRenderer(
            [stage], height=SIZE, width=SIZE, num_threads=1, layer_memory=SIZE * SIZE * 4 * 12 * 3 // 2
        )
        for tick in range(4):
            both.compare(*[posed(stage, (0.1 * tick, slot), (0, 0)) for slot in range(3)], cameras=EYES[:1])
        assert both.copies == 3


def sight(poses: np.ndarray, shown: np.ndarray | None = None, x: float = 0.0) -> Sight:
    everything = np.ones(len(poses), bool) if shown is None else shown
    return Sight(
        view=View(np.array([x, 0.0, 0.0]), np.eye(3), 45.0),
        drawable=everything,
        shown=everything,
        in_image=everything,
        reflected=np.zeros(len(poses), bool),
        mirror=-1,
        reflectance=0.0,
        poses=poses,
        is_opaque=True,
    )


def test_what_has_not_moved_is_held_from_the_second_image_on() -> None:
    history, poses = Stillness(), np.zeros((3, 12))
    assert history.plan(sight(poses), VisualOptions()).held is None
    poses = poses.copy()
    poses[2] = 1
    plan = history.plan(sight(poses), VisualOptions())
    assert plan.is_new
    assert plan.held is not None
    assert plan.held.tolist() == [True, True, False]
    plan = history.plan(sight(poses), VisualOptions())
    assert not plan.is_new
    assert plan.held is not None
    assert plan.held.tolist() == [True, True, False]


def test_what_moves_leaves_the_layer_and_comes_back_when_it_has_settled() -> None:
    history, poses = Stillness(), np.zeros((2, 12))
    for _ in range(2):
        history.plan(sight(poses), VisualOptions())
    poses = poses.copy()
    poses[0] = 1
    held = []
    for _ in range(SETTLED + 2):
        plan = history.plan(sight(poses), VisualOptions())
        assert plan.held is not None
        held.append((plan.is_new, plan.held[0]))
    assert held == [(True, False)] + [(False, False)] * (SETTLED - 1) + [(True, True), (False, True)]


@pytest.mark.parametrize(
    ("x", "options"), [(1.0, VisualOptions()), (0.0, VisualOptions(light=0.5))], ids=["camera", "light"]
)
def test_another_view_or_light_begins_anew(x: float, options: VisualOptions) -> None:
    history, poses = Stillness(), np.zeros((2, 12))
    for _ in range(3):
        history.plan(sight(poses), VisualOptions())
    assert history.plan(sight(poses, x=x), options).held is None


def test_what_is_no_longer_shown_leaves_the_layer() -> None:
    history, poses = Stillness(), np.zeros((2, 12))
    for _ in range(3):
        history.plan(sight(poses), VisualOptions())
    plan = history.plan(sight(poses, np.array([True, False])), VisualOptions())
    assert plan.is_new
    assert plan.held is not None
    assert plan.held.tolist() == [True, False]


@needs_gl
@pytest.mark.heavy
@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_images_of_rollouts_are_the_whole_ones(monkeypatch: pytest.MonkeyPatch, scene_id: str) -> None:
    """Every scene: slots in motion and refilled, one with every joint somewhere else, all cameras that policies see."""
    suite, task = scene_id.rsplit("-", 1)
    rng = np.random.default_rng(int(task))
    env = vecenv.make(suite, task=int(task), episodes=range(2))
    assert isinstance(env, LiberoEnv)
    problem = list_tasks(suite)[int(task)].problem()
    stage = Stage(visual_scene(problem, "published", "fast"), lod.GRID["fast"])
    with drawn(monkeypatch, stage, size=128) as both:
        for episodes in (range(2), range(2, 4)):
            env.set_episodes(episodes=list(episodes))
            env.reset()
            for tick in range(8):
                env.step_continuous(rng.uniform(-1, 1, (2, 7)))
                if tick == 5:
                    qpos = np.stack([upstream.shuffled(env.mj_model, row, rng) for row in env.state().qpos])
                    env.set_state(qpos=qpos, qvel=np.zeros((2, env.mj_model.nv)))
                both.compare(*_shots(env), cameras=POLICY_CAMERAS)
        print(scene_id, both.copies)
    env.close()


def _shots(env: LiberoEnv) -> list[Shot]:
    (group,) = env.physics.groups
    pos, quat = group.expand("body_pos"), group.expand("body_quat")
    return [Shot(0, Pose(group.seen_qpos[row].copy(), pos[row], quat[row])) for row in range(len(group.slots))]
