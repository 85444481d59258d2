"""One thread that runs the policy: the requests that have arrived while it was busy are answered in one batch."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from types import TracebackType

import numpy as np

from vecenv_eval.serving.policy import Observation, Served


@dataclass(frozen=True)
class _Job:
    """What the policy is to do: answer an observation, or, where that is None, begin an episode."""

    observation: Observation | None
    future: Future[np.ndarray] = field(default_factory=Future)


class Batcher:
    """Runs a policy in a thread of its own, while it is entered as a context.

    Args:
        served: the policy.
        most: most observations in a batch.
    """

    def __init__(self, served: Served, most: int = 64) -> None:
        self._served, self._most = served, most
        self._jobs: deque[_Job] = deque()
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="policy", daemon=True)

    def __enter__(self) -> Batcher:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()

    def act(self, observation: Observation) -> Future[np.ndarray]:
        """The chunk [K, 7] for an observation, when it is there."""
        return self._put(_Job(observation))

    def reset(self) -> Future[np.ndarray]:
        """Tell the policy that an episode begins; done when the requests before it are answered."""
        return self._put(_Job(None))

    def _put(self, job: _Job) -> Future[np.ndarray]:
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()
        return job.future

    def _run(self) -> None:
        while jobs := self._take():
            try:
                answers = self._answer(jobs)
            except Exception as error:  # the policy is the user's: its error is an answer
                for job in jobs:
                    job.future.set_exception(error)
            else:
                for job, answer in zip(jobs, answers, strict=True):
                    job.future.set_result(answer)

    def _take(self) -> list[_Job]:
        """Wait for jobs: one episode that begins, or the observations up to the next one; none when it is over."""
        with self._changed:
            self._changed.wait_for(lambda: self._jobs or self._stopped)
            if self._stopped:
                return []
            jobs = [self._jobs.popleft()]
            while jobs[0].observation is not None and len(jobs) < self._most:
                if not self._jobs or self._jobs[0].observation is None:
                    break
                jobs.append(self._jobs.popleft())
            return jobs

    def _answer(self, jobs: Sequence[_Job]) -> Sequence[np.ndarray]:
        observations = [job.observation for job in jobs if job.observation is not None]
        if observations:
            return self._served.act(observations)
        self._served.reset()
        return [np.zeros((0, 7))]
