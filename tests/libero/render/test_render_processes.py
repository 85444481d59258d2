"""Rendering in processes, and images that are read back late: the same pixels, and nothing stays behind."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.box_scene import SIZE, rgb, shot, tiny_scene
from support.images import needs_gl

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render import gl, painter, processes
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.gl import Frames, GlError, GlRenderer, Shot, Wanted
from vecenv.libero.render.options import CameraShift, RenderConfig, RenderError, UserCamera, VisualOptions

psutil = pytest.importorskip("psutil")
pytestmark = [needs_gl, pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="processes need Linux")]

ALL = Wanted(rgb=True, depth=True, segmentation=True)
ABOVE = UserCamera(name="above", pos=[[0.1 * i, 0.0, 1.5] for i in range(5)], quat=[1, 0, 0, 0])
CAMERAS = ["agentview", "side", ABOVE]
LOOKS = [
    VisualOptions(),
    VisualOptions(light=0.5, light_shift=(1.0, 0.0, 0.0)),
    VisualOptions(colors={"box_1": (1.0, 0.2, 0.2)}),
    VisualOptions(textures={"cloth": "checks"}),
    VisualOptions(cameras={"agentview": CameraShift(turn=(0.0, 0.1, 0.0))}),
]


def several(stage: Stage, count: int = 5) -> list[Shot]:
    return [shot(stage, box=(0.1 * i, 0.0), options=LOOKS[i % len(LOOKS)]) for i in range(count)]


def assert_equal(found: Frames, expected: Frames) -> None:
    for kind in ("rgb", "depth", "segmentation"):
        ours, theirs = getattr(found, kind), getattr(expected, kind)
        assert ours.keys() == theirs.keys()
        for name, images in ours.items():
            np.testing.assert_array_equal(images, theirs[name])
            assert (images.dtype, images.shape) == (theirs[name].dtype, theirs[name].shape)
    assert found.views.keys() == expected.views.keys()
    for name, view in found.views.items():
        for part in ("intrinsics", "pos", "mat"):
            np.testing.assert_array_equal(getattr(view, part), getattr(expected.views[name], part))


def children() -> list[int]:
    return [child.pid for child in psutil.Process().children(recursive=True)]


@pytest.fixture(scope="module")
def apart(stage: Stage) -> Iterator[GlRenderer]:
    made = GlRenderer([stage], height=SIZE, width=SIZE, num_processes=2)
    yield made
    made.close()
    assert not set(made.pids) & set(children())


@pytest.mark.parametrize("wanted", [ALL, Wanted(), Wanted(rgb=False, depth=True), Wanted(rgb=False, segmentation=True)])
def test_processes_draw_what_threads_draw(
    apart: GlRenderer, renderer: GlRenderer, stage: Stage, wanted: Wanted
) -> None:
    assert (apart.num_processes, apart.num_threads) == (2, 0)
    for _ in range(3):  # the third image of a still camera is composed of a layer
        assert_equal(apart.render(several(stage), CAMERAS, wanted), renderer.render(several(stage), CAMERAS, wanted))


@pytest.mark.parametrize("slots", [1, 2, 12])
def test_images_that_are_read_late_are_the_same(stage: Stage, slots: int) -> None:
    late, direct = (
        GlRenderer([stage], height=SIZE, width=SIZE, num_threads=2, layer_memory=0, late_reads=is_late)
        for is_late in (True, False)
    )
    try:
        assert late._threads is not None
        assert late._threads._threads[0].painter._readback is not None
        shots = several(stage, slots)
        cameras = CAMERAS[:2]
        for wanted in (Wanted(), ALL):
            assert_equal(late.render(shots, cameras, wanted), direct.render(shots, cameras, wanted))
    finally:
        late.close()
        direct.close()


def test_images_begun_in_a_context_that_is_lost_are_drawn_again(
    monkeypatch: pytest.MonkeyPatch, stage: Stage, renderer: GlRenderer
) -> None:
    shots, real, checks = several(stage), painter._check, [0]
    expected = renderer.render(shots, ["agentview", "side"]).rgb
    late = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=1, layer_memory=0, late_reads=True)

    def check() -> None:
        checks[0] += 1
        if checks[0] == 7:
            raise painter.ContextLost("GL error 0x507")
        real()

    try:
        monkeypatch.setattr(painter, "_check", check)
        found = late.render(shots, ["agentview", "side"]).rgb
        assert checks[0] > len(shots) * 2
        for name, images in found.items():
            np.testing.assert_array_equal(images, expected[name])
    finally:
        late.close()


def test_images_stay_as_they_are_while_later_ones_are_drawn(apart: GlRenderer, stage: Stage) -> None:
    first = rgb(apart, shot(stage, box=(0.0, 0.0)))
    row, before = first[0, SIZE // 2], first.copy()
    later = [rgb(apart, shot(stage, box=(0.05 * i, 0.2))) for i in range(1, 9)]
    np.testing.assert_array_equal(first, before)
    assert len({image.tobytes() for image in later}) == len(later)
    del first, later
    rgb(apart, shot(stage, box=(0.4, 0.2)))
    np.testing.assert_array_equal(row, before[0, SIZE // 2])


def test_memory_is_used_again_when_images_are_gone(apart: GlRenderer, stage: Stage) -> None:
    def draw() -> int:
        for i in range(20):
            rgb(apart, shot(stage, box=(0.01 * i, 0.0)))
        gc.collect()
        return psutil.Process().num_fds()

    assert draw() == draw()


def test_given_arrays_are_filled(apart: GlRenderer, stage: Stage) -> None:
    out = np.zeros((1, SIZE, SIZE, 3), np.uint8)
    assert apart.render([shot(stage)], ["agentview"], out={"agentview": out}).rgb["agentview"] is out
    np.testing.assert_array_equal(out, rgb(apart, shot(stage)))


def test_scenes_and_slots_of_any_number(apart: GlRenderer, stage: Stage) -> None:
    other, old = Stage(tiny_scene()), apart.stages
    both = GlRenderer([stage, other], height=SIZE, width=SIZE, num_threads=2)
    assert apart.use([stage, other])
    try:
        for count in (1, 4, 2):
            shots = [Shot(i % 2, one.pose, one.options) for i, one in enumerate(several(stage, count))]
            assert_equal(apart.render(shots, CAMERAS, ALL), both.render(shots, CAMERAS, ALL))
    finally:
        apart.use(old)
        both.close()


def test_processes_stay_when_the_scenes_change(apart: GlRenderer, renderer: GlRenderer, stage: Stage) -> None:
    pids, old, expected = apart.pids, apart.stages, rgb(renderer, *several(stage))
    other = Stage(tiny_scene())
    for stages in ([other], [other, stage], [stage]):
        assert apart.use(stages)
        shots = [Shot(i % len(stages), one.pose, one.options) for i, one in enumerate(several(stage))]
        np.testing.assert_array_equal(rgb(apart, *shots), expected)
    assert apart.use(old)
    assert apart.pids == pids
    assert not renderer.use([other])


def test_what_is_not_there_is_refused_as_with_threads(apart: GlRenderer, stage: Stage) -> None:
    with pytest.raises(RenderError, match="no camera 'none'; this scene has agentview, side"):
        rgb(apart, shot(stage), camera="none")
    with pytest.raises(RenderError, match="num_threads=1, num_processes=1: threads or processes render"):
        RenderConfig(num_threads=1, num_processes=1)
    with pytest.raises(RenderError, match="num_processes=0: need at least 1"):
        RenderConfig(num_processes=0)


def test_a_killed_process_is_replaced_and_its_images_are_drawn(
    apart: GlRenderer, stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    expected, before = rgb(apart, *several(stage)), apart.pids
    os.kill(before[0], signal.SIGKILL)
    np.testing.assert_array_equal(rgb(apart, *several(stage)), expected)
    assert apart.pids[1:] == before[1:]
    assert apart.pids[0] != before[0]
    assert f"rendering process {before[0]} was ended by SIGKILL" in caplog.text
    assert before[0] not in children()


def test_processes_that_keep_ending_are_an_error_and_later_calls_start_others(
    monkeypatch: pytest.MonkeyPatch, apart: GlRenderer, stage: Stage
) -> None:
    before, real = apart.pids, processes._Worker.send

    def send(worker: processes._Worker, *arguments: object) -> None:
        os.kill(worker.pid, signal.SIGKILL)
        worker._process.wait()
        real(worker, *arguments)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(processes._Worker, "send", send)
        with pytest.raises(GlError, match=r"was ended by SIGKILL; the machine may be out of memory, and so did"):
            rgb(apart, shot(stage))
    assert not set(before) & set(children())
    assert apart.pids == ()
    assert rgb(apart, shot(stage)).any()
    assert len(apart.pids) == 2


def test_an_interrupted_call_leaves_no_answers_behind(
    monkeypatch: pytest.MonkeyPatch, apart: GlRenderer, stage: Stage
) -> None:
    expected, before = rgb(apart, shot(stage, box=(0.3, 0.0))), apart.pids

    def interrupt(worker: processes._Worker) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(processes._Worker, "receive", interrupt)
        with pytest.raises(KeyboardInterrupt):
            rgb(apart, shot(stage, box=(0.1, 0.3)))
    assert not set(before) & set(children())
    np.testing.assert_array_equal(rgb(apart, shot(stage, box=(0.3, 0.0))), expected)


def test_gl_that_fails_in_a_process_is_the_callers_error(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    before = children()
    monkeypatch.setattr(processes, "_MODULE", "vecenv.libero.render.no_such_module")
    with pytest.raises(GlError, match=r"rendering process \d+ ended with exit status 1 before it had a GL context"):
        GlRenderer([stage], height=SIZE, width=SIZE, num_processes=2)
    assert children() == before


def test_where_the_driver_draws_in_hardware_several_slots_are_drawn_by_processes(
    monkeypatch: pytest.MonkeyPatch, stage: Stage, renderer: GlRenderer
) -> None:
    monkeypatch.setattr(painter, "draws_in_software", lambda: False)
    monkeypatch.setattr(gl, "usable_cores", lambda: 2)
    chosen = GlRenderer([stage], height=SIZE, width=SIZE)
    try:
        one = rgb(chosen, shot(stage))
        assert (chosen.num_threads, chosen.num_processes) == (1, 0)
        chosen.render([shot(stage)], ["agentview", "side"])
        assert (chosen.num_threads, chosen.num_processes) == (2, 0)
        expected = renderer.render(several(stage), CAMERAS)
        assert_equal(chosen.render(several(stage), CAMERAS), expected)
        assert (chosen.num_threads, chosen.num_processes) == (0, 2)
        np.testing.assert_array_equal(rgb(chosen, shot(stage)), one)
    finally:
        chosen.close()


def test_in_software_threads_draw(stage: Stage) -> None:
    usual = GlRenderer([stage], height=SIZE, width=SIZE)
    try:
        rgb(usual, *several(stage))
        assert usual.num_processes == 0
    finally:
        usual.close()


def test_closing_ends_processes_and_images_stay(stage: Stage) -> None:
    before, handles = children(), psutil.Process().num_fds()
    first, second = (GlRenderer([stage], height=SIZE, width=SIZE, num_processes=1) for _ in range(2))
    images = rgb(first, shot(stage))
    first.close()
    first.close()
    np.testing.assert_array_equal(rgb(second, shot(stage)), images)
    with pytest.raises(GlError, match="closed"):
        rgb(first, shot(stage))
    second.close()
    assert children() == before
    del images
    gc.collect()
    assert psutil.Process().num_fds() == handles


def test_a_renderer_that_is_dropped_ends_its_processes(stage: Stage) -> None:
    before = children()
    dropped = GlRenderer([stage], height=SIZE, width=SIZE, num_processes=1)
    assert rgb(dropped, shot(stage)).any()
    del dropped
    gc.collect()
    assert children() == before


PROGRAM = """
import os, signal, sys
from support.box_scene import SIZE, rgb, shot, tiny_scene
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.gl import GlError, GlRenderer

stage = Stage(tiny_scene())
renderer = GlRenderer([stage], height=SIZE, width=SIZE, num_processes=1)
image = rgb(renderer, shot(stage))
print(*renderer.pids, flush=True)
how = sys.argv[1]
if how == "fork":
    child = os.fork()
    if child == 0:
        try:
            rgb(renderer, shot(stage))
        except GlError as error:
            print(error, flush=True)
        renderer.close()
        sys.exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert (rgb(renderer, shot(stage)) == image).all()
elif how == "exception":
    raise SystemExit(3)
elif how == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(
    ("how", "status"),
    [
        pytest.param("end", 0, marks=pytest.mark.heavy),
        pytest.param("exception", 3, marks=pytest.mark.heavy),
        ("killed", -signal.SIGKILL),
        ("fork", 0),
    ],
)
def test_no_process_outlives_its_caller(how: str, status: int) -> None:
    here = Path(__file__).resolve().parents[3]
    paths = os.pathsep.join([str(here), str(here / "tests")])
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", PROGRAM, how],
        capture_output=True, text=True, check=False, timeout=120, env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    assert done.returncode == status, done.stderr
    assert done.stderr == ""
    pid, *said = done.stdout.splitlines()
    assert ["it does not survive a fork" in line for line in said] == [True] * (how == "fork")
    psutil.wait_procs([psutil.Process(int(pid))] if psutil.pid_exists(int(pid)) else [], timeout=20)
    assert not psutil.pid_exists(int(pid))


@pytest.mark.heavy
def test_environments_at_once_draw_what_threads_draw() -> None:
    """Two with processes beside one with threads, in motion, and after their scenes have changed."""
    render: dict[str, object] = {"height": 128, "width": 128, "cameras": [ABOVE]}
    options = ({"num_threads": 2}, {"num_processes": 2}, {"num_processes": 1})
    with contextlib.ExitStack() as opened:
        envs = [
            opened.enter_context(
                vecenv.make("libero_object", tasks=[0, 1], episodes=[0], num_threads=1, render={**render, **own})
            )
            for own in options
        ]
        rng = np.random.default_rng(0)
        for tasks in ([0, 1], [1, 2]):
            for env in envs:
                assert isinstance(env, LiberoEnv)
                env.set_episodes(tasks=tasks, episodes=[3])
                env.set_visuals(LOOKS[:2])
                env.reset()
            for _ in range(3):
                actions = rng.uniform(-1, 1, (2, 7))
                seen = []
                for env in envs:
                    env.step_continuous(actions)
                    now = env.observe_egocentric()
                    images = [now.images[name] for name in ("agentview", "wrist", "above")]
                    seen.append([*images, now.depths["wrist"], now.segmentations["agentview"]])
                for expected, *others in zip(*seen, strict=True):
                    assert expected.any()
                    for found in others:
                        np.testing.assert_array_equal(found, expected)
