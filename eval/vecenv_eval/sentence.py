"""One sentence of the user's own, followed by VoxPoser in the scene of a task.

A suite, a task and an episode say which scene; a sentence and the options of ``vecenv_eval.policies.voxposer`` say what
is done in it. Out: a :class:`Followed`, and an mp4 if one is asked for. The scene's own task judges only its own
sentence; it may end the episode before another sentence is done.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import vecenv
from vecenv.contract import BatchEnv, Control
from vecenv.errors import InvalidInput
from vecenv.util.names import unknown
from vecenv_eval.policies import make_policy
from vecenv_eval.policies.voxposer import VoxPoserPolicy, cause
from vecenv_eval.video.writer import Recordable, recording
from voxposer.slots import FOLLOWED, Slot


@dataclass(frozen=True, kw_only=True)
class Round:
    """One round of planning and moving.

    Attributes:
        subtask: its words.
        number: of the subtask, from 1, counted over all passes.
        waypoints: that were planned.
        missed: of these, those that were not reached.
        ticks: control ticks that it took.
    """

    subtask: str
    number: int
    waypoints: int
    missed: int
    ticks: int


@dataclass(frozen=True, kw_only=True)
class Followed:
    """How a sentence was followed.

    Attributes:
        episode: name of the scene's episode.
        sentence: what was followed.
        own: the sentence is the task's own.
        writer: what wrote the programs.
        subtasks: of the latest pass.
        rounds: what was done.
        success: the goal of the scene's task was reached.
        cause: why it ended before that, "" if it did not.
        error: why the language model could not be asked, "" if it could.
        ticks: control ticks it took.
        frames: of the video, 0 without one.
    """

    episode: str
    sentence: str
    own: bool
    writer: str
    subtasks: tuple[str, ...]
    rounds: tuple[Round, ...]
    success: bool
    cause: str
    error: str
    ticks: int
    frames: int = 0

    @property
    def ok(self) -> bool:
        """The task's own sentence was solved, or another was followed to its end."""
        return self.success or (not self.own and self.cause == FOLLOWED)


def parse_scene(text: str, episode: int) -> tuple[str, int]:
    """Suite and task of ``"libero_goal/0"`` or ``"simpler/bridge/0"``.

    Raises:
        InvalidInput: the text has another form, or there is no such task or episode; the message says what there is.
    """
    suite, slash, number = text.rpartition("/")
    if not (slash and number.isdigit() and number.isascii()):
        raise InvalidInput(f"{text!r}: write SUITE/TASK, such as libero_goal/0")
    if suite not in vecenv.list_suites():
        hint = ": write SUITE/TASK, and the episode as --episode N" if suite.rpartition("/")[2].isdigit() else ""
        raise InvalidInput(f"{text!r}{hint}" if hint else f"{text!r}: {unknown('suite', suite, vecenv.list_suites())}")
    tasks, episodes = len(vecenv.list_tasks(suite)), vecenv.eval_metadata(suite)["episodes_per_task"]
    if int(number) >= tasks or not 0 <= episode < episodes:
        raise InvalidInput(
            f"{text!r}, episode {episode}: {suite} has tasks 0 to {tasks - 1} and episodes 0 to {episodes - 1}"
        )
    return suite, int(number)


def follow(
    suite: str,
    task: int,
    episode: int,
    sentence: str,
    options: Mapping[str, Any],
    *,
    video: Path | None = None,
    on_round: Callable[[tuple[str, ...], Round], None] = lambda subtasks, done: None,
) -> Followed:
    """Plan a sentence in a scene and follow it to its end.

    Args:
        suite, task, episode: the scene.
        sentence: what to do.
        options: of the policy. A sentence that is not the task's own is planned once, unless ``passes`` is among them.
        video: an mp4 of it, None for none.
        on_round: called after each round with the subtasks of the pass and what was done.

    Raises:
        PolicyError: there is no such option, or its value cannot be used.
        PolicyUnavailable: the model cannot be asked at all.
        RenderError: images cannot be rendered or written.
        VecenvError: the scene cannot be built.
    """
    sentence = " ".join(sentence.split())
    own = _same(sentence, vecenv.list_tasks(suite)[task].instruction)
    policy = cast(VoxPoserPolicy, make_policy("voxposer", **(dict(options) if own else {"passes": 1, **options})))
    try:
        with vecenv.make(suite, task=task, episodes=[episode]) as env:
            return _follow(env, policy, sentence, own, video, on_round)
    finally:
        policy.close()


def _follow(
    env: Any,
    policy: VoxPoserPolicy,
    sentence: str,
    own: bool,
    video: Path | None,
    on_round: Callable[[tuple[str, ...], Round], None],
) -> Followed:
    """Follow the sentence in an environment of one slot."""
    info = env.reset()
    title = f"{info.episode_id[0]}: {sentence}"
    frames: AbstractContextManager[Any] = nullcontext()
    if video is not None:
        frames = recording(cast(Recordable, env), video, fps=env.control_hz, titles=[title], judged=own)
    policy.reset(env, replace(info, instruction=(sentence,)))
    assert policy.agent is not None
    slot, rounds = policy.agent.slots[0], []
    with frames as recorded:
        while True:
            control = _act(policy, env, slot, rounds)
            on_round(slot.progress.subtasks, rounds[-1])
            if control.done.all() or slot.cause:
                break
    success = bool(control.success[0])
    return Followed(
        episode=info.episode_id[0],
        sentence=sentence,
        own=own,
        writer=policy.settings.writer,
        subtasks=slot.progress.subtasks,
        rounds=tuple(rounds),
        success=success,
        cause="" if success else slot.cause or cause(slot),
        error=slot.error,
        ticks=int(control.step_index[0]),
        frames=0 if recorded is None else recorded.frames,
    )


def _act(policy: VoxPoserPolicy, env: BatchEnv, slot: Slot, rounds: list[Round]) -> Control:
    """One round, noted."""
    before, ticks = slot.counts, sum(done.ticks for done in rounds)
    control = policy.act(env)
    rounds.append(
        Round(
            subtask=slot.progress.text,
            number=slot.progress.begun,
            waypoints=slot.counts.waypoints - before.waypoints,
            missed=slot.counts.missed - before.missed,
            ticks=int(control.step_index[0]) - ticks,
        )
    )
    return control


def _same(sentence: str, instruction: str) -> bool:
    """Whether two sentences are the same but for capitals, spaces and the full stop."""
    one, two = (" ".join(text.lower().split()).rstrip(". ") for text in (sentence, instruction))
    return one == two
