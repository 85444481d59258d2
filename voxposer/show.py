"""Pages and images of ``vecenv voxposer show``: the maps, paths and programs of one task.

A suite, a task and an episode come in; the task is planned and followed once, and an HTML page (plotly, one file, no
network) and a PNG (matplotlib) go out. Each planned motion is drawn on the maps that it was planned on, beside what the
camera saw, and is linked to the programs that the language model wrote for it, the settings and the commit.
"""

from __future__ import annotations

import base64
import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import InvalidInput, MissingDependency, VecenvError
from vecenv.util.revision import git_commit
from voxposer.agent import Agent, AgentConfig, PlannedMotion
from voxposer.figures import (
    Figure,
    color_of,
    grip_figure,
    layers,
    map_views,
    objects,
    scene_figure,
    slices_figure,
)
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.lmp_config import Call

if TYPE_CHECKING:
    from mpl_toolkits.mplot3d.axes3d import Axes3D

TEMPLATE = "show.html.j2"
_CAMERA = "agentview"
# Packages whose versions the page names.
_PACKAGES = ("vecenv", "mujoco", "jax", "numpy", "litellm")
_KINDS = {"home": "back to where it began", "stay": "where it is", "path": "over maps"}
# Of the picture around the hand's way, metres.
_MARGIN = 0.15


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
        config: the agent's options.
        images: what the camera saw when each motion was planned, uint8 [H, W, 3]; empty without images.
        last_image: what it saw at the end.
        no_images: why there are no images, "" if there are.
        commit: of the code, "" outside a clone.
        versions: of packages, by name.
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
    config: AgentConfig = field(default_factory=AgentConfig)
    images: tuple[np.ndarray, ...] = ()
    last_image: np.ndarray | None = None
    no_images: str = ""
    commit: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)


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


class _Recorder:
    """Keeps motions as they are planned, and what the camera sees at that time."""

    def __init__(self, env: BatchEnv) -> None:
        self._env = env
        self.motions: list[PlannedMotion] = []
        self.images: list[np.ndarray] = []
        self.no_images = ""

    def __call__(self, motion: PlannedMotion) -> None:
        self.motions.append(motion)
        if (image := self.look()) is not None:
            self.images.append(image)

    def look(self) -> np.ndarray | None:
        """What the camera sees now; None where images cannot be drawn."""
        if self.no_images:
            return None
        try:
            images = self._env.observe_egocentric().images
            return np.array(images[_CAMERA if _CAMERA in images else next(iter(images))][0])
        except (VecenvError, ImportError, StopIteration) as error:
            self.no_images = str(error) or "the environment has no cameras"
            return None


def record_episode(
    suite: str, task: int, episode: int = 0, *, model: str = "offline/libero", prompts_dir: Path | None = None
) -> EpisodeRecord:
    """Plan and follow one episode of a task to its end, and keep what was planned."""
    import vecenv
    from vecenv.doctor import installed_version

    env = vecenv.make(suite, task=task, episodes=[episode])
    recorder, config = _Recorder(env), AgentConfig(passes=1)
    try:
        info = env.reset()
        prompts = str(prompts_dir) if prompts_dir else None
        agent = Agent(env, info.instruction, Llm(LlmConfig(model=model)), config, prompts, recorder)
        control = agent.step()
        while not control.done.all() and not agent.slots[0].cause:
            control = agent.step()
        slot = agent.slots[0]
        return EpisodeRecord(
            title=info.episode_id[0],
            instruction=slot.instruction,
            model=model,
            subtasks=slot.progress.subtasks,
            motions=tuple(recorder.motions),
            calls=tuple(slot.lmps.trace),
            success=bool(control.success[0]),
            ticks=int(control.step_index[0]),
            cause=slot.cause,
            config=config,
            last_image=recorder.look(),
            images=tuple(recorder.images),
            no_images=recorder.no_images,
            commit=git_commit(),
            versions={name: version for name in _PACKAGES if (version := installed_version(name))},
        )
    finally:
        env.close()


# -- the page ----------------------------------------------------------------------------------------------------------


def render_page(shown: EpisodeRecord) -> str:
    """The HTML page, complete in itself.

    Raises:
        MissingDependency: jinja2 or plotly is not installed.
    """
    try:
        from jinja2 import Environment, StrictUndefined
        from markupsafe import Markup
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise MissingDependency("the page needs jinja2 and plotly: pip install 'vecenv[voxposer]'") from error

    figures: dict[str, Figure] = {}
    names = sorted({name for motion in shown.motions for name in motion.perception.snapshot.objects})
    motions = [_motion(number, motion, shown, names, figures) for number, motion in enumerate(shown.motions, start=1)]
    motions_of: dict[int, list[int]] = defaultdict(list)
    for number, motion in enumerate(shown.motions, start=1):
        motions_of[motion.subtask].append(number)
    made = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    # Scripts of the page's own; a language model writes none of them.
    return made.from_string(files("voxposer").joinpath(TEMPLATE).read_text(encoding="utf-8")).render(
        shown=shown,
        author=_author(shown.model),
        motions=motions,
        motions_of=motions_of,
        pictures={"ends": _ends(shown)},
        totals=_totals(shown.calls, shown.model),
        settings="\n".join(_settings(shown.config)),
        figures=figures,
        plotly_js=Markup(get_plotlyjs()),  # nosec B704 # a file of the plotly package
    )


def _motion(
    number: int, motion: PlannedMotion, shown: EpisodeRecord, names: Sequence[str], figures: dict[str, Figure]
) -> dict[str, Any]:
    """What the page says about a motion; its figures go into ``figures``."""
    views = map_views(motion, shown.config.planner)
    drawn = {"scene": scene_figure(motion, names), "maps": slices_figure(motion, views), "grip": grip_figure(motion)}
    figures |= {f"{kind}-{number}": figure for kind, figure in drawn.items() if figure is not None}
    pushed = "; the object is pushed along it, one push a snapshot" if motion.request.object_centric else ""
    picture = shown.images[number - 1] if len(shown.images) == len(shown.motions) else None
    return {
        "number": number,
        "text": motion.text,
        "kind": _KINDS[motion.request.kind],
        "movable": motion.request.movable,
        "path": f"{len(motion.path)} waypoints of the planner, {len(motion.stops)} stops of the hand{pushed}",
        "constants": [(view.name, view.constant) for view in views if view.values is None and view.constant],
        "calls": _calls(motion, shown.calls),
        "picture": "" if picture is None else _data_url(picture),
        "has_slices": drawn["maps"] is not None,
        "has_grip": drawn["grip"] is not None,
    }


def _calls(motion: PlannedMotion, calls: Sequence[Call]) -> dict[str, list[int]]:
    """Numbers of the questions that a motion's subtask took, by language program, as the page counts them."""
    found: dict[str, list[int]] = defaultdict(list)
    for i in motion.calls:
        if i < len(calls):
            found[calls[i].lmp].append(i + 1)
    return dict(found)


def _ends(shown: EpisodeRecord) -> list[tuple[str, str]]:
    """The first and the last image, with their words."""
    first = [("at the start", _data_url(shown.images[0]))] if shown.images else []
    return first + ([("at the end", _data_url(shown.last_image))] if shown.last_image is not None else [])


def _data_url(image: np.ndarray) -> str:
    """An image, uint8 [H, W, 3], as the address of a PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _settings(options: Any, prefix: str = "") -> list[str]:
    """The fields of a config, and of those in it, as lines ``group.name: value``."""
    lines: list[str] = []
    named = (
        options
        if isinstance(options, Mapping)
        else {each.name: getattr(options, each.name) for each in fields(options)}
    )
    for name, value in named.items():
        if isinstance(value, Mapping) or is_dataclass(value):
            lines += _settings(value, f"{prefix}{name}.")
        else:
            lines.append(f"{prefix}{name}: {value}")
    return lines


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
    found, things = layers(motion), objects(motion)
    axes.set_title(motion.text, fontsize=8)
    way = np.concatenate([found["targets"], found["hand's way"], found["planner's path"]])
    low, high = way.min(axis=0) - _MARGIN, way.max(axis=0) + _MARGIN
    for name, points in {"": found["surroundings"], **things}.items():
        near = points[((points >= low) & (points <= high)).all(axis=1)]
        axes.scatter(*near.T, s=3, c=color_of(name, [*things]) if name else "#9aa0a6", alpha=0.6)
    axes.scatter(*found["targets"].T, s=30, c="#188038")
    axes.plot(*found["planner's path"].T, c="#1a73e8", lw=2)
    axes.plot(*found["hand's way"].T, c="#f29900", lw=2, marker="o", ms=3)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low)
    axes.tick_params(labelsize=6)
