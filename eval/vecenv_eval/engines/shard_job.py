"""What a job of the submitit engine does: one shard of an evaluation, into a results folder of its own.

A job that was preempted, timed out or killed is repeated as it is, and continues its folder.
"""

from __future__ import annotations

import pickle  # nosec B403 # see its use
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cloudpickle
from submitit.helpers import DelayedSubmission

from vecenv.errors import VecenvError
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import open_or_begin
from vecenv_eval.runner import Evaluation
from vecenv_eval.simulator import Simulator


@dataclass(frozen=True, kw_only=True)
class ShardOutcome:
    """How a job ended that was not killed.

    Attributes:
        interrupted: it was stopped by a signal.
        causes: what failed in it, one line each.
        refused: why it could not run at all.
        failed: what was raised, one line; another attempt may fare better.
        traceback: of that.
    """

    interrupted: bool = False
    causes: tuple[str, ...] = ()
    refused: str = ""
    failed: str = ""
    traceback: str = ""


class ShardJob:
    """Runs a shard; called without arguments, on whatever machine.

    Args:
        config: what is evaluated, with the shard.
        folder: the shard's results folder.
        simulator: where environments come from.
        path: folders in which the submitting process finds modules.
    """

    def __init__(self, config: EvalConfig, folder: Path, simulator: Simulator, path: Sequence[str]) -> None:
        self._path = tuple(path)
        # What the simulator names can be imported only after the path was set.
        self._pickled = cloudpickle.dumps((config, folder, simulator))

    def __call__(self) -> ShardOutcome:
        """Run what the shard's folder does not have yet."""
        sys.path += [folder for folder in self._path if folder not in sys.path]
        config, folder, simulator = pickle.loads(self._pickled)  # nosec B301 # __init__ pickled it
        try:
            evaluation = Evaluation(config, simulator)
            folder.parent.mkdir(parents=True, exist_ok=True)
            result = evaluation.run(open_or_begin(config, folder))
        except VecenvError as error:
            return ShardOutcome(refused=" ".join(str(error).split()))
        except Exception as error:  # what a policy's constructor raises, for example
            line = f"{type(error).__name__}: {error}".splitlines()[0]
            return ShardOutcome(failed=line, traceback=traceback.format_exc())
        return ShardOutcome(interrupted=result.interrupted, causes=result.causes)

    def checkpoint(self) -> DelayedSubmission:
        """What submitit queues again when the job is preempted or out of time: the same job."""
        return DelayedSubmission(self)
