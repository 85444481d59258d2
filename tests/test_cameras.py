"""Which cameras observations show: all of the scene, or those asked for by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.images import needs_gl

import vecenv
from vecenv.errors import InvalidInput
from vecenv.libero.render.options import UserCamera
from vecenv.libero.scene.arenas import ARENAS, camera_names
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks.suites import list_tasks
from vecenv.observations import ImagesUnavailable, UnknownCamera
from vecenv.registry import OptionError

LIBERO: dict[str, Any] = {"suite": "libero_object", "task": 0, "episodes": [0], "num_threads": 1}


def observed(**options: Any) -> Any:
    with vecenv.make(**LIBERO, **options) as env:
        env.reset()
        return env.observe_egocentric()


def test_the_cameras_of_a_workspace_are_those_of_its_compiled_scenes() -> None:
    seen = {}
    for suite in ("libero_90", "libero_object", "libero_goal"):
        for task in list_tasks(suite):
            seen.setdefault(task.problem().name, task)
    assert len(seen) == 5  # no task is at the sixth, the coffee table
    for name, task in seen.items():
        model = compile_scene(task.problem()).model
        assert {model.camera(i).name for i in range(model.ncam)} == set(camera_names(ARENAS[name]))


def test_cameras_are_all_of_the_scene_or_those_asked_for_in_their_order() -> None:
    assert list(observed().images) == [*camera_names(ARENAS[list_tasks("libero_object")[0].problem().name]), "wrist"]
    seen = observed(cameras=["wrist", "frontview"])
    assert (
        list(seen.images) == list(seen.depths) == list(seen.segmentations) == list(seen.views) == ["wrist", "frontview"]
    )
    with pytest.raises(ImagesUnavailable, match="no image of camera 'agentview': available: wrist, frontview"):
        _ = seen.rgb


def test_a_camera_goes_by_each_of_its_names() -> None:
    seen = observed(cameras=["robot0_eye_in_hand"])
    assert list(seen.images) == ["wrist"]
    assert "robot0_eye_in_hand_image" in seen.images


def test_a_camera_of_the_users_own_can_be_asked_for() -> None:
    above = UserCamera(name="above", pos=[0, 0, 1.5], quat=[1, 0, 0, 0])
    assert list(observed(render=vecenv.RenderConfig(cameras=[above]), cameras=["above"]).images) == ["above"]


@needs_gl
def test_what_is_left_out_does_not_change_what_is_drawn() -> None:
    images = []
    choices: list[dict[str, Any]] = [{"cameras": ["frontview"]}, {}]
    for options in choices:
        with vecenv.make(**LIBERO, render={"height": 32, "width": 32, "lod": "fast"}, **options) as env:
            env.reset()
            images.append(env.observe_egocentric().images["frontview"])
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize(
    ("cameras", "kind", "says"),
    [
        (["nowhere"], UnknownCamera, "there is no camera 'nowhere'; cameras: frontview, birdview, agentview"),
        (["paperview"], UnknownCamera, "there is no camera 'paperview'"),
        ([], InvalidInput, r"cameras=\[\]: give some of frontview"),
        (["wrist", "robot0_eye_in_hand"], InvalidInput, "'wrist' is named twice"),
        ("agentview", OptionError, "cameras"),
        ([3], OptionError, "cameras"),
    ],
)
def test_cameras_that_there_are_not_are_refused_when_the_environment_is_made(
    cameras: Any, kind: type[Exception], says: str
) -> None:
    with pytest.raises(kind, match=says):
        vecenv.make(**LIBERO, cameras=cameras)


def test_simpler_has_one_camera() -> None:
    assert vecenv.make_config("simpler/bridge", {"cameras": ["agentview"]}).cameras == ("agentview",)
    with pytest.raises(UnknownCamera, match="there is no camera 'wrist'; cameras: agentview"):
        vecenv.make_config("simpler/bridge", {"cameras": ["wrist"]})


def test_gymnasium_observes_the_cameras_that_there_are() -> None:
    from vecenv.interop.observing import GymnasiumError, Observer
    from vecenv.libero.env import LiberoEnv

    with vecenv.make(**LIBERO, cameras=["frontview", "birdview"]) as env:
        assert isinstance(env, LiberoEnv)
        assert Observer(env, "pixels").cameras == ("frontview", "birdview")
        with pytest.raises(GymnasiumError, match="expected some of frontview, birdview"):
            Observer(env, "pixels", ["wrist"])


def test_lerobots_environments_keep_their_two_cameras() -> None:
    from vecenv.interop.lerobot import LeRobotError, LeRobotOptions

    with pytest.raises(LeRobotError, match="cameras: LeRobot's policies expect"):
        LeRobotOptions(fields={"cameras": ["frontview"]})
