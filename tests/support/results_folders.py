"""Results folders as ``vecenv eval`` leaves them, for what reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from vecenv_eval.report import markdown, summarise
from vecenv_eval.store import Record, ResultStore

CONDITIONS = {
    "protocol": "seed",
    "instead": {},
    "horizon": 300,
    "idle_steps": 0,
    "start": "settled",
    "contacts": "published",
    "colors": "published",
    "fixtures": "center",
    "reset_loop": "-",
    "seed": 7,
    "success": "first",
}
RUN = {
    "started": "2026-01-02T03:04:05+00:00",
    "arguments": ["eval", "--suite", "libero_goal"],
    "commit": "0123abc",
    "versions": {"python": "3.11.7", "mujoco": "3.17.0"},
    "machine": {"system": "Linux", "gpu": "H100"},
}
INSTRUCTIONS = ("open the drawer", "turn on the stove")


def some_records(
    solved: Callable[[int, int], bool], *, suite: str = "libero_goal", tasks: int = 2, episodes: int = 5, **more: Any
) -> list[Record]:
    """One record an episode; ``solved(task, episode)`` says how it went."""
    return [
        Record(
            suite=suite,
            task=task,
            episode=episode,
            instruction=INSTRUCTIONS[task % 2],
            success=solved(task, episode),
            success_first=solved(task, episode),
            success_final=solved(task, episode),
            num_steps=100 + 20 * episode if solved(task, episode) else 300,
            reward=float(solved(task, episode)),
            setup_s=1.5,
            wall_s=12.0,
            **more,
        )
        for task in range(tasks)
        for episode in range(episodes)
    ]


def write_results(
    folder: Path, records: Sequence[Record], *, suite: str = "libero_goal", ended: bool = True, **settings: Any
) -> Path:
    """A results folder; ``settings`` replace what ``config.json`` says."""
    config = {"suite": suite, "policy": "my:Policy", "backend": "native", "seed": None, "policy_args": {"path": "x"}}
    store = ResultStore.create(folder, {"config": config, "runs": [RUN], "conditions": CONDITIONS} | settings)
    store.append(records)
    if ended:
        texts = [INSTRUCTIONS[task % 2] for task in range(1 + max((r.task for r in records), default=0))]
        planned = [record.key for record in records]
        summary = summarise(records, planned, suite=suite, policy="my:Policy", instructions=texts)
        store.write_summary(summary.to_dict(), markdown(summary))
    return folder
