"""A 3-D view of one slot in the browser, drawn by viser: its bodies, and what VoxPoser planned in it.

In: looks at a slot (``looks3d``), offered by the environment's thread whenever something moved, and planned motions.
Out: a web server of its own, on this machine only, whose page follows them. Nothing is made while nobody looks, and the
environment's thread never waits for it.
"""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import InvalidInput, MissingDependency, ServiceError, VecenvError
from vecenv_eval.web.looks3d import Look, look

if TYPE_CHECKING:
    import viser

    from voxposer.planned import PlannedMotion

log = logging.getLogger(__name__)
HOST = "127.0.0.1"
# Looks a second at most, and how far a body moves before the browser is told: metres, and parts of a unit quaternion.
_RATE, _STILL = 15.0, 1e-5
_AXES, _POINT, _VOXEL = 0.08, 0.006, 0.004
# Of a value map the best voxels are shown: one in so many of those that differ from the worst, and at most so many.
_ONE_IN, _MOST_VOXELS = 50, 3000
# As in the pages of `vecenv voxposer show`: targets, what is kept away from, the planner's path, the hand's way.
_TARGET, _AVOID, _PATH, _HAND = (10, 154, 75), (217, 48, 37), (26, 115, 232), (242, 153, 0)
_GREY = (150, 156, 165)
# Of objects, readable on white and on black (after Okabe and Ito).
_COLORS = ((42, 143, 216), (230, 159, 0), (204, 121, 167), (0, 158, 115), (86, 180, 233), (213, 94, 0))


class Scene3D:
    """The 3-D view: an observer of a session (``vecenv_eval.panel.session.Observer``).

    Args:
        port: of the view's server; 0 takes any that is free.

    Attributes:
        url: its address.
        slot: the slot that is shown.
        on_due: called, on any thread, when the environment should be looked at although it does not move: somebody
            has come, another slot was chosen, or the last move was too soon after the one before.

    Raises:
        MissingDependency: viser is not installed.
        InvalidInput: the port is no port.
        ServiceError: the port is in use.
    """

    def __init__(self, port: int = 0) -> None:
        self.slot = 0
        self.on_due: Callable[[], None] = lambda: None
        self._server = _serve(port)
        self.url = f"http://{HOST}:{self._server.get_port()}/"
        self._wake, self._closed, self._due = threading.Condition(), False, False
        self._offered: Look | None = None
        self._latest: Look | None = None
        self._taken_at, self._count = 0.0, 1
        self._plans: dict[int, PlanLook] = {}
        self._unseen: PlannedMotion | None = None
        self._key: object = None
        self._frames: dict[str, Any] = {}
        self._poses: dict[str, np.ndarray] = {}
        self._plan: list[Any] = []
        self._drawn_plan: PlanLook | None = None
        self._gui = _Gui(self._server, self._choose)
        self._server.on_client_connect(lambda _: self._welcome())
        self._thread = threading.Thread(target=self._run, name="vecenv-view-3d", daemon=True)
        self._thread.start()

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return bool(self._server.get_clients())

    def follow(self, slot: int) -> None:
        """Show another slot."""
        if slot != self.slot:
            self.slot = slot
            self._gui.slot.value = slot
            self.on_due()

    def _welcome(self) -> None:
        """Somebody has come: show what was seen last, and ask for what is to be seen now."""
        self._offer()
        self.on_due()

    def _choose(self, slot: int) -> None:
        if slot != self.slot:
            self.slot = slot
            self.on_due()

    def close(self) -> None:
        """Stop the server. Closing twice is harmless."""
        with self._wake:
            if self._closed:
                return
            self._closed = True
            self._wake.notify()
        self._thread.join(timeout=10)
        with _silent():
            self._server.stop()

    # -- on the environment's thread -----------------------------------------------------------------------------------

    def placed(self, env: BatchEnv) -> None:
        """Episodes stand at their start; what was planned is forgotten."""
        self._plans.clear()
        self._unseen = None
        self._take(env)

    def tick(self, env: BatchEnv) -> None:
        """Take a look at the slot, if it is time for one."""
        if time.monotonic() - self._taken_at >= 1 / _RATE:
            self.look(env)
        elif not self._due:
            with self._wake:
                self._due = True
                self._wake.notify()

    def look(self, env: BatchEnv) -> None:
        """Take a look at the slot, if somebody watches."""
        self._due = False
        if self.watched:
            self._take(env)

    def _take(self, env: BatchEnv) -> None:
        self._taken_at = time.monotonic()
        self._count, self._latest = env.num_envs, look(env, min(self.slot, env.num_envs - 1))
        if self.watched:
            self._offer()

    def _offer(self) -> None:
        with self._wake:
            self._offered = self._latest
            self._wake.notify()

    def planned(self, motion: PlannedMotion) -> None:
        """Keep what there is to see of a motion: its maps too if its slot is shown, for the view's thread to read."""
        if motion.slot == self.slot:
            self._unseen = motion
        elif self.watched:
            self._plans[motion.slot] = plan_look(motion, maps=False)

    def lost(self) -> None:
        """The environment is closed; what the view shows stays."""
        self._plans.clear()
        self._unseen = None
        self._latest = None

    # -- the view's own thread -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            try:
                self._gui.slots(self._count)
                self._draw(taken)
            except VecenvError as error:
                self._gui.say(str(error))
            except Exception:  # a view that fails must not end the session
                log.exception("the 3-D view failed")
                self._gui.say("The 3-D view failed; the log of the server says why.")

    def _next(self) -> Look | None:
        """The newest look; None once the view is closed. A move that came too soon is asked for again."""
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._offered is not None or self._due)
                if self._closed:
                    return None
                taken, self._offered = self._offered, None
                if taken is not None:
                    return taken
                wait = 1 / _RATE - (time.monotonic() - self._taken_at)
                if wait > 0 and self._wake.wait_for(lambda: self._closed or self._offered is not None, wait):
                    continue
                due, self._due = self._due, False
            if due:
                self.on_due()

    def _draw(self, taken: Look) -> None:
        poses = taken.poses()
        if taken.key != self._key:
            self._build(taken, poses)
        with self._server.atomic():
            for name, pose in poses.items():
                frame, before = self._frames.get(name), self._poses.get(name)
                if frame is None or (before is not None and np.abs(pose - before).max() < _STILL):
                    continue
                frame.position, frame.wxyz = pose[:3], pose[3:7]
                self._poses[name] = pose
        unseen, self._unseen = self._unseen, None
        if unseen is not None:
            self._plans[unseen.slot] = plan_look(unseen)
        plan = self._plans.get(self.slot)
        if plan is not self._drawn_plan:
            self._drawn_plan = plan
            self._draw_plan(plan)

    def _build(self, taken: Look, poses: Mapping[str, np.ndarray]) -> None:
        """Replace the bodies by those of another scene."""
        self._gui.say("The scene is being prepared.")
        model, scene = taken.model(), self._server.scene
        first = self._key is None
        for handle in self._frames.values():
            handle.remove()
        self._frames, self._poses = {}, {}
        for body in model.bodies:
            self._frames[body.name] = scene.add_frame(f"/{body.name}", show_axes=False)
            if body.glb is not None:
                scene.add_glb(f"/{body.name}/shape", body.glb)
            elif body.points is not None and len(body.points):
                color = _GREY if body.name == "surroundings" else _color(body.name)
                scene.add_point_cloud(
                    f"/{body.name}/points", body.points, color, point_size=_POINT, point_shape="circle"
                )
        if "hand" in poses:
            self._frames["hand"] = scene.add_frame("/hand", axes_length=_AXES, axes_radius=_AXES / 25)
            if first:
                self._server.initial_camera.look_at = poses["hand"][:3] - (0, 0, 0.12)
                self._server.initial_camera.position = poses["hand"][:3] + (0.6, 0.25, 0.4)
        self._key = taken.key
        self._gui.say(model.note)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def _draw_plan(self, plan: PlanLook | None) -> None:
        for handle in self._plan:
            handle.remove()
        self._plan = []
        self._gui.subtask.value = "" if plan is None else plan.text
        if plan is None:
            return
        self._line("/plan/path", plan.path, _PATH)
        self._line("/plan/way", plan.stops[:, :3], _HAND)
        if len(plan.stops):
            scene, points, quats = self._server.scene, plan.stops[:, :3], plan.stops[:, 3:]
            self._plan.append(
                scene.add_batched_axes("/plan/stops", quats, points, axes_length=0.03, axes_radius=0.0012)
            )
        self._cloud("/plan/targets", plan.targets, _TARGET)
        self._cloud("/plan/avoid", plan.avoid, _AVOID, self._gui.avoidance.value)
        self._cloud("/plan/value", plan.value, plan.value_colors, self._gui.value.value)

    def _line(self, name: str, points: np.ndarray, color: tuple[int, int, int]) -> None:
        if len(points) > 1:
            ends = np.stack([points[:-1], points[1:]], axis=1)
            self._plan.append(self._server.scene.add_line_segments(name, ends, color, thickness=0.004))

    def _cloud(
        self, name: str, points: np.ndarray, colors: tuple[int, int, int] | np.ndarray, visible: bool = True
    ) -> None:
        if len(points):
            made = self._server.scene.add_point_cloud(name, points, colors, point_size=_VOXEL, visible=visible)
            self._plan.append(made)


class _Gui:
    """The panel beside the view: the slot, what is shown of a plan, and sentences. Text is never read as markup."""

    def __init__(self, server: viser.ViserServer, on_slot: Callable[[int], None]) -> None:
        gui = server.gui
        self._server = server
        self.slot = gui.add_slider("Slot", min=0, max=1, step=1, initial_value=0, disabled=True)
        self.subtask = gui.add_text("Subtask", "", disabled=True, multiline=True)
        self.value = gui.add_checkbox("Value map", True, hint="The best voxels of the map that the hand descends")
        self.avoidance = gui.add_checkbox("Keep away", False, hint="Voxels that the path stays away from")
        self._note = gui.add_text("Note", "", disabled=True, multiline=True, visible=False)
        self.slot.on_update(lambda event: on_slot(int(self.slot.value)) if event.client is not None else None)
        self.value.on_update(lambda _: self._show("/plan/value", self.value.value))
        self.avoidance.on_update(lambda _: self._show("/plan/avoid", self.avoidance.value))

    def slots(self, count: int) -> None:
        """There are so many."""
        if self.slot.max != max(1, count - 1):
            self.slot.max = max(1, count - 1)
        if self.slot.disabled != (count < 2):
            self.slot.disabled = count < 2

    def say(self, sentence: str) -> None:
        """One sentence; "" for none."""
        self._note.value, self._note.visible = sentence, bool(sentence)

    def _show(self, name: str, visible: bool) -> None:
        handle = self._server.scene.get_handle_by_name(name)
        if handle is not None:
            handle.visible = visible


@dataclass(frozen=True)
class PlanLook:
    """What there is to see of a planned motion; its maps, 8 MB each, are not kept.

    Attributes:
        text: the subtask in words.
        path: the planner's way, metres, world frame, [P, 3].
        stops: poses of the hand along it, xyz + wxyz, [S, 7].
        targets, avoid: centres of voxels that it goes to, and that it stays away from, [n, 3].
        value: centres of the best voxels of the map that was descended, [n, 3].
        value_colors: theirs, uint8 [n, 3]; the best are yellow.
    """

    text: str
    path: np.ndarray
    stops: np.ndarray
    targets: np.ndarray
    avoid: np.ndarray
    value: np.ndarray
    value_colors: np.ndarray


def plan_look(motion: PlannedMotion, *, maps: bool = True) -> PlanLook:
    """What there is to see of a motion; with ``maps`` it takes 0.2 s, without almost nothing."""
    none = np.zeros((0, 3))
    grid = motion.perception.grid
    seen = PlanLook(
        text=motion.text,
        path=grid.world(np.asarray(motion.path)) if len(motion.path) else none,
        stops=np.array([np.append(stop.pos, stop.quat) for stop in motion.stops]).reshape(-1, 7),
        targets=none,
        avoid=none,
        value=none,
        value_colors=np.zeros((0, 3), np.uint8),
    )
    if not maps:
        return seen
    from voxposer.figures import layers

    found = layers(motion)
    value, colors = value_cloud(motion)
    targets, avoid = (_thinned(found[name]) for name in ("targets", "keep away"))
    return replace(seen, targets=targets, avoid=avoid, value=value, value_colors=colors)


def value_cloud(motion: PlannedMotion) -> tuple[np.ndarray, np.ndarray]:
    """The best voxels of the value map that a motion was planned on.

    Returns:
        their centres, metres, world frame, [n, 3], and their colours, uint8 [n, 3]; the best are yellow. Both are empty
        where the motion was planned on no map.
    """
    from voxposer.figures import map_views
    from voxposer.planning.config import PlannerConfig

    values = map_views(motion, PlannerConfig())[0].values
    if values is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    flat = np.where(np.isfinite(values), values, np.inf).ravel()
    useful = np.flatnonzero(flat < np.max(flat[np.isfinite(flat)], initial=0.0))
    count = min(_MOST_VOXELS, -(-len(useful) // _ONE_IN))
    if not count:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    best = useful[np.argpartition(flat[useful], count - 1)[:count]]
    points = motion.perception.grid.world(np.stack(np.unravel_index(best, values.shape), axis=1))
    return points, _viridis(_ranks(flat[best]))


def _ranks(values: np.ndarray) -> np.ndarray:
    """1 for the smallest of some values, 0 for the largest."""
    spread = float(np.ptp(values))
    return np.ones(len(values)) if spread == 0 else 1 - (values - values.min()) / spread


def _viridis(parts: np.ndarray) -> np.ndarray:
    import matplotlib

    return (255 * matplotlib.colormaps["viridis"](parts)[:, :3]).astype(np.uint8)


def _thinned(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, -(-len(points) // _MOST_VOXELS))]


def _color(name: str) -> tuple[int, int, int]:
    """A colour that a name always has."""
    return _COLORS[sum(name.encode()) % len(_COLORS)]


def _serve(port: int) -> viser.ViserServer:
    try:
        import viser
    except ImportError as error:
        raise MissingDependency("the 3-D view needs viser: pip install 'vecenv[viser]'", name="viser") from error
    if not 0 <= port <= 65535:
        raise InvalidInput(f"the port of the 3-D view is {port}: expected 0 to 65535")
    with _port_errors(port), _silent():
        server = viser.ViserServer(host=HOST, port=port, label="vecenv", verbose=False)
    if port and server.get_port() != port:  # viser takes the next one that is free
        with _silent():
            server.stop()
        raise ServiceError(f"the port of the 3-D view, {port}, is in use: give another one, or 0 for any")
    server.scene.set_up_direction("+z")
    server.scene.add_grid("/grid", width=4, height=4, cell_size=0.25, section_size=1.0, position=(0, 0, -0.001))
    server.gui.configure_theme(control_width="small", show_logo=False, show_share_button=False)
    return server


def _silent() -> contextlib.AbstractContextManager[Any]:
    """viser greets on standard output, which belongs to the command."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _port_errors(port: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ServiceError(f"the 3-D view cannot listen on port {port}: {error}") from error
