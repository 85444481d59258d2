"""Pages and images of ``vecenv voxposer show``: the maps, paths and programs of one task.

A suite, a task and an episode come in; the task is planned and followed once, and an HTML page (plotly, one file, no
network) and a PNG (matplotlib) go out. Each planned motion has a picture: the scene's surface, targets, what is kept
away from, the planner's path, and the hand's way. Under it stands every program that the language model wrote, whether
it came from the cache, and what it cost.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.errors import InvalidInput
from voxposer.agent import Agent, AgentConfig, PlannedMotion
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp_config import Call
from voxposer.paths import obstacle_map

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D

# Voxels of an obstacle map above this are drawn, and no more than that many.
_DRAWN_ABOVE = 0.3
_DRAWN_AT_MOST = 3000
# Of the picture around the hand's way, metres.
_MARGIN = 0.15
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:70rem;padding:0 1rem;color:#222}
pre{background:#f5f5f5;padding:.7rem;overflow-x:auto;border-radius:4px}summary{cursor:pointer;padding:.2rem 0}
.note{color:#666}.bad{color:#b00020}h2{margin-top:2.5rem}"""


@dataclass(frozen=True)
class EpisodeRecord:
    """One episode, recorded for display.

    Attributes:
        title: suite, task and episode.
        instruction: the task in words.
        model: the model that wrote the programs.
        subtasks: of the latest pass.
        motions: every motion planned.
        calls: every question to the model.
        success: the task was solved.
        ticks: control ticks it took.
        cause: why the slot stopped, "" if it did not.
    """

    title: str
    instruction: str
    model: str
    subtasks: tuple[str, ...]
    motions: tuple[PlannedMotion, ...]
    calls: tuple[Call, ...]
    success: bool
    ticks: int
    cause: str


def parse_task(text: str) -> tuple[str, int, int]:
    """Suite, task and episode of ``"libero_goal/0"`` or ``"libero_goal/0/3"``.

    Raises:
        InvalidInput: the text has another form, or there is no such task; the message lists what there is.
    """
    import vecenv

    suite, *numbers = text.split("/")
    if not 1 <= len(numbers) <= 2 or not all(number.isdigit() for number in numbers):
        raise InvalidInput(f"{text!r}: write SUITE/TASK or SUITE/TASK/EPISODE, such as libero_goal/0")
    if suite not in vecenv.list_suites():
        raise InvalidInput(f"there is no suite {suite!r}; there are {', '.join(vecenv.list_suites())}")
    task, episode = int(numbers[0]), int(numbers[1]) if len(numbers) == 2 else 0
    count, episodes = len(vecenv.list_tasks(suite)), vecenv.eval_metadata(suite)["episodes_per_task"]
    if task >= count or episode >= episodes:
        raise InvalidInput(f"{text!r}: {suite} has tasks 0 to {count - 1} and episodes 0 to {episodes - 1}")
    return suite, task, episode


def record_episode(
    suite: str, task: int, episode: int = 0, *, model: str = "offline/libero", prompts_dir: Path | None = None
) -> EpisodeRecord:
    """Plan and follow one episode of a task to its end, and keep what was planned."""
    import vecenv

    env = vecenv.make(suite, task=task, episodes=[episode])
    motions: list[PlannedMotion] = []
    try:
        info = env.reset()
        prompts = str(prompts_dir) if prompts_dir else None
        llm = Llm(LlmConfig(model=model))
        agent = Agent(env, info.instruction, llm, AgentConfig(passes=1), prompts, motions.append)
        control = agent.step()
        while not control.done.all() and not agent.slots[0].cause:
            control = agent.step()
        slot = agent.slots[0]
        return EpisodeRecord(
            title=info.episode_id[0],
            instruction=slot.instruction,
            model=model,
            subtasks=slot.progress.subtasks,
            motions=tuple(motions),
            calls=tuple(slot.lmps.trace),
            success=bool(control.success[0]),
            ticks=int(control.step_index[0]),
            cause=slot.cause,
        )
    finally:
        env.close()


# -- the page ----------------------------------------------------------------------------------------------------------


def render_page(shown: EpisodeRecord) -> str:
    """The HTML page, complete in itself."""
    from plotly.offline import get_plotlyjs

    verdict = "solved" if shown.success else "not solved"
    subtasks = "".join(f"<li>{html.escape(text)}</li>" for text in shown.subtasks)
    motions = "".join(_motion_section(number, motion) for number, motion in enumerate(shown.motions, start=1))
    calls = "".join(_call_section(call) for call in shown.calls)
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(shown.title)}</title>
<style>{_STYLE}</style><script>{get_plotlyjs()}</script></head><body>
<h1>{html.escape(shown.instruction)}</h1>
<p>{html.escape(shown.title)}, programs by <b>{html.escape(_author(shown.model))}</b>: {verdict} in {shown.ticks} ticks.
<span class="bad">{html.escape(shown.cause)}</span></p>
<h2>Subtasks</h2><ol>{subtasks}</ol>
<h2>Motions</h2><p class="note">Drag to turn, scroll to zoom, click names to hide them. Metres.</p>{motions}
<h2>Programs</h2><p class="note">{_totals(shown.calls, shown.model)}</p>{calls}
</body></html>
"""


def _author(model: str) -> str:
    return f"{model} (rule-based, no language model)" if model.startswith("offline/") else model


def _totals(calls: Sequence[Call], model: str) -> str:
    """Questions and, of a language model, what they cost as far as that is known."""
    asked = f"{len(calls)} questions, {sum(call.cached for call in calls)} answered from the cache"
    if LlmConfig(model=model).is_rule_base:
        return asked
    prices = [call.cost_usd for call in calls if not call.cached]
    known = [price for price in prices if price is not None]
    unknown = f", the price of {len(prices) - len(known)} unknown" if len(known) < len(prices) else ""
    return f"{asked}, {sum(known):.4f} US dollars{unknown}" if known else f"{asked}{unknown}"


def _call_section(call: Call) -> str:
    state = "from the cache" if call.cached else "asked"
    state = f"repair, {state}" if call.repair else state
    counted = call.prompt_tokens is not None and call.completion_tokens is not None
    tokens = f", {call.prompt_tokens} + {call.completion_tokens} tokens" if counted else ""
    error = f'<p class="bad">{html.escape(call.error)}</p>' if call.error else ""
    context = f"{call.context}\n" if call.context else ""
    return (
        f"<details><summary><b>{html.escape(call.lmp)}</b>: {html.escape(call.query)} "
        f'<span class="note">{state}{tokens}</span></summary>{error}'
        f"<pre>{html.escape(context)}{html.escape(call.code)}</pre></details>"
    )


def _motion_section(number: int, motion: PlannedMotion) -> str:
    kinds = {"home": "back to where it began", "stay": "where it is", "path": "over maps"}
    words = f"{number}. {motion.text} ({kinds[motion.request.kind]})"
    picture = figure(motion).to_html(full_html=False, include_plotlyjs=False, default_height="520px")
    return f"<h3>{html.escape(words)}</h3>{picture}"


def figure(motion: PlannedMotion) -> Any:
    """One motion as a plotly figure."""
    import plotly.graph_objects as go

    marks = {"surface": (2, "#9aa0a6", 0.5), "keep away": (3, "#d93025", 0.15), "targets": (7, "#188038", 0.9)}
    traces = [
        _cloud(go, name, points, *marks[name])
        for name, points in layers(motion).items()
        if name in marks and len(points)
    ]
    lines = {"planner's path": ("#1a73e8", "lines"), "hand's way": ("#f29900", "lines+markers")}
    found = layers(motion)
    for name, (colour, mode) in lines.items():
        points = found[name]
        if len(points):
            x, y, z = points.T
            line = {"color": colour, "width": 5}
            traces.append(go.Scatter3d(x=x, y=y, z=z, mode=mode, name=name, line=line, marker={"size": 3}))
    result = go.Figure(traces)
    result.update_layout(scene={"aspectmode": "data"}, margin={"l": 0, "r": 0, "t": 0, "b": 0})
    return result


def _cloud(go: ModuleType, name: str, points: np.ndarray, size: int, colour: str, opacity: float) -> Any:
    x, y, z = points.T
    marker = {"size": size, "color": colour, "opacity": opacity}
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker)


def layers(motion: PlannedMotion) -> dict[str, np.ndarray]:
    """What there is to see of a motion: name -> points [n, 3], metres, world frame; none where there is nothing."""
    perception, request = motion.perception, motion.request
    grid = perception.grid
    parts = [part.cloud.points for part in perception.snapshot.parts.values()]
    points = np.concatenate([perception.snapshot.scene.points, *parts])
    inside = ((points >= grid.lo) & (points <= grid.hi)).all(axis=1)
    none = np.zeros((0, 3))
    targets = none if request.targets is None else grid.world(np.argwhere(request.targets))
    return {
        "surface": points[inside],
        "keep away": none if request.targets is None else _kept_away(motion),
        "targets": targets,
        "planner's path": grid.world(motion.path) if len(motion.path) else none,
        "hand's way": np.array([stop.pos for stop in motion.stops]).reshape(-1, 3),
    }


def _kept_away(motion: PlannedMotion) -> np.ndarray:
    """Middles of the voxels that the planner kept away from."""
    cost = obstacle_map(motion.perception, motion.request, AgentConfig().route)
    voxels = np.argwhere(cost > _DRAWN_ABOVE)
    return motion.perception.grid.world(voxels[:: max(1, len(voxels) // _DRAWN_AT_MOST)])


# -- the picture -------------------------------------------------------------------------------------------------------


def save_image(shown: EpisodeRecord, path: Path) -> None:
    """All motions side by side as a PNG."""
    from matplotlib.figure import Figure

    motions = [motion for motion in shown.motions if motion.request.kind == "path"] or list(shown.motions)
    columns = min(4, max(1, len(motions)))
    rows = -(-max(1, len(motions)) // columns)
    sheet = Figure(figsize=(4.2 * columns, 4.0 * rows), layout="constrained")
    sheet.suptitle(f"{shown.instruction} ({_author(shown.model)})")
    for number, motion in enumerate(motions, start=1):
        axes = sheet.add_subplot(rows, columns, number, projection="3d")
        _draw(axes, motion)
    sheet.savefig(path, dpi=110)


def _draw(axes: Axes3D, motion: PlannedMotion) -> None:
    found = layers(motion)
    axes.set_title(motion.text, fontsize=8)
    way = np.concatenate([found["targets"], found["hand's way"]])
    low, high = way.min(axis=0) - _MARGIN, way.max(axis=0) + _MARGIN
    surface = found["surface"]
    surface = surface[((surface >= low) & (surface <= high)).all(axis=1)]
    axes.scatter(*surface.T, s=3, c=surface[:, 2], cmap="Greys_r", alpha=0.7)
    axes.scatter(*found["targets"].T, s=30, c="#188038")
    axes.plot(*found["planner's path"].T, c="#1a73e8", lw=2)
    axes.plot(*found["hand's way"].T, c="#f29900", lw=2, marker="o", ms=3)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.tick_params(labelsize=6)
