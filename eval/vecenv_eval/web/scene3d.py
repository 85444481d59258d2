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
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import InvalidInput, MissingDependency, SimulationError, VecenvError
from vecenv_eval.web.looks3d import Look, look

if TYPE_CHECKING:
    import viser

    from voxposer.planned import PlannedMotion

log = logging.getLogger(__name__)
HOST = "127.0.0.1"
# Looks a second at most, and how far a body moves before the browser is told: metres, and parts of a unit quaternion.
_RATE, _STILL = 15.0, 1e-5
_AXES, _POINT, _VOXEL = 0.08, 0.006, 0.008
# Of a value map the best voxels are shown: this part of those that differ from the worst, and no more than that many.
_BEST, _MOST_VOXELS = 0.04, 6000
_GREY = (150, 156, 165)


class Scene3D:
    """The 3-D view.

    Args:
        port: of the view's server; 0 takes any that is free.
        on_follow: called with a slot that is chosen in the view, so that it is shown also while nothing moves.

    Attributes:
        url: its address.
        slot: the slot that is shown.

    Raises:
        MissingDependency: viser is not installed.
        InvalidInput: the port cannot be used.
    """

    def __init__(self, port: int = 0, on_follow: Callable[[int], None] = lambda slot: None) -> None:
        self.slot = 0
        self._on_follow = on_follow
        self._server = _serve(port)
        self.url = f"http://{HOST}:{self._server.get_port()}/"
        self._wake, self._closed = threading.Condition(), False
        self._offered: Look | None = None
        self._motion: PlannedMotion | None = None
        self._motions: dict[int, PlannedMotion] = {}
        self._taken_at = 0.0
        self._key: object = None
        self._frames: dict[str, Any] = {}
        self._poses: dict[str, np.ndarray] = {}
        self._plan: list[Any] = []
        self._drawn_motion: PlannedMotion | None = None
        self._gui = _Gui(self._server, self._chosen)
        self._thread = threading.Thread(target=self._run, name="view-3d", daemon=True)
        self._thread.start()

    # -- from other threads --------------------------------------------------------------------------------------------

    @property
    def watched(self) -> bool:
        """Whether somebody looks."""
        return bool(self._server.get_clients())

    def follow(self, slot: int) -> None:
        """Show another slot from the next look on."""
        if slot != self.slot:
            self.slot, self._taken_at = slot, 0.0
            self._gui.slot.value = slot

    def changed(self, env: BatchEnv, *, now: bool = False) -> None:
        """Take a look at the slot, if it is time for one; on the environment's thread.

        Args:
            env: the environment.
            now: also if the last look was a moment ago; for the end of a run, and for another slot.
        """
        if not self.watched or not (now or time.monotonic() - self._taken_at >= 1 / _RATE):
            return
        self._taken_at = time.monotonic()
        self._gui.slots(env.num_envs)
        taken = look(env, min(self.slot, env.num_envs - 1))
        if taken is not None:
            with self._wake:
                self._offered = taken
                self._motion = self._motions.get(self.slot)
                self._wake.notify()

    def planned(self, motion: PlannedMotion) -> None:
        """Show a motion that was planned, while its slot is followed; on the environment's thread."""
        self._motions[motion.slot] = motion

    def begin(self) -> None:
        """Forget what was planned: another run begins."""
        self._motions.clear()

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

    # -- the view's own thread -----------------------------------------------------------------------------------------

    def _chosen(self, slot: int) -> None:
        if slot != self.slot:
            self.slot, self._taken_at = slot, 0.0
            self._on_follow(slot)

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._closed or self._offered is not None)
                if self._closed:
                    return
                taken, self._offered = self._offered, None
                motion = self._motion
            assert taken is not None
            try:
                self._draw(taken, motion)
            except VecenvError as error:
                self._gui.say(str(error))
            except Exception:  # a view that fails must not end the session
                log.exception("the 3-D view failed")
                self._gui.say("The 3-D view failed; the log of the server says why.")

    def _draw(self, taken: Look, motion: PlannedMotion | None) -> None:
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
        if motion is not self._drawn_motion:
            self._drawn_motion = motion
            self._draw_plan(motion)

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
                scene.add_point_cloud(f"/{body.name}/points", body.points, color, point_size=_POINT, point_shape="circle")
        if "hand" in poses:
            self._frames["hand"] = scene.add_frame("/hand", axes_length=_AXES, axes_radius=_AXES / 25)
            if first:
                self._server.initial_camera.look_at = poses["hand"][:3] - (0, 0, 0.15)
                self._server.initial_camera.position = poses["hand"][:3] + (0.95, 0.4, 0.6)
        self._key = taken.key
        self._gui.say(model.note)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def _draw_plan(self, motion: PlannedMotion | None) -> None:
        for handle in self._plan:
            handle.remove()
        self._plan = []
        self._gui.subtask.value = "" if motion is None else motion.text
        if motion is None:
            return
        from voxposer import figures

        scene, found = self._server.scene, figures.layers(motion)
        self._line("/plan/path", found["planner's path"], figures.PATH)
        self._line("/plan/way", found["hand's way"], figures.HAND)
        if motion.stops:
            quats, points = (np.array([getattr(stop, name) for stop in motion.stops]) for name in ("quat", "pos"))
            self._plan.append(scene.add_batched_axes("/plan/stops", quats, points, axes_length=0.03, axes_radius=0.0012))
        self._cloud("/plan/targets", found["targets"], figures.TARGET)
        self._cloud("/plan/avoid", _thinned(found["keep away"]), figures.AVOID, self._gui.avoidance.value)
        points, colors = value_cloud(motion)
        self._cloud("/plan/value", points, colors, self._gui.value.value)

    def _line(self, name: str, points: np.ndarray, color: str) -> None:
        if len(points) > 1:
            ends = np.stack([points[:-1], points[1:]], axis=1)
            made = self._server.scene.add_line_segments(name, ends, _rgb(color), thickness=0.004)
            self._plan.append(made)

    def _cloud(self, name: str, points: np.ndarray, colors: str | np.ndarray, visible: bool = True) -> None:
        if len(points):
            shown = _rgb(colors) if isinstance(colors, str) else colors
            made = self._server.scene.add_point_cloud(name, points, shown, point_size=_VOXEL, visible=visible)
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
    count = min(_MOST_VOXELS, int(np.ceil(_BEST * len(useful))))
    best = useful[np.argsort(flat[useful], kind="stable")[:count]]
    points = motion.perception.grid.world(np.stack(np.unravel_index(best, values.shape), axis=1))
    return points, _viridis(_ranks(flat[best]))


def _ranks(values: np.ndarray) -> np.ndarray:
    """1 for the smallest of some values, 0 for the largest."""
    spread = float(np.ptp(values)) if len(values) else 0.0
    return np.ones(len(values)) if spread == 0 else 1 - (values - values.min()) / spread


def _viridis(parts: np.ndarray) -> np.ndarray:
    import matplotlib

    return (255 * matplotlib.colormaps["viridis"](parts)[:, :3]).astype(np.uint8)


def _thinned(points: np.ndarray) -> np.ndarray:
    return points[:: max(1, -(-len(points) // _MOST_VOXELS))]


def _rgb(color: str) -> tuple[int, int, int]:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


def _color(name: str) -> tuple[int, int, int]:
    """A colour that a name always has."""
    from voxposer.figures import COLORS

    return _rgb(COLORS[sum(name.encode()) % len(COLORS)])


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
        raise InvalidInput(f"the port of the 3-D view, {port}, is in use: give another one, or 0 for any")
    server.scene.set_up_direction("+z")
    server.scene.add_grid("/grid", width=4, height=4, cell_size=0.25, section_size=1.0, position=(0, 0, -0.001))
    server.gui.configure_theme(control_layout="collapsible", control_width="small", show_logo=False, show_share_button=False)
    return server


def _silent() -> contextlib.AbstractContextManager[Any]:
    """viser greets on standard output, which belongs to the command."""
    return contextlib.redirect_stdout(io.StringIO())


@contextlib.contextmanager
def _port_errors(port: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise SimulationError(f"the 3-D view cannot listen on port {port}: {error}") from error
