"""The language programs of VoxPoser: queries in words go in, a model's programs run, maps and motions come out.

In: a language model (``voxposer.language.llm``), the functions programs may call (perception, map helpers,
``execute``), the names of the objects in the scene. Out: ``Lmps``, which has one method for each program, and a trace
of every program written.

Each language program (LMP) asks the model to answer a query in code, shown examples from its prompt file, and runs the
answer in ``voxposer.sandbox``:

- the *planner* splits an instruction into calls of ``composer``, one for each subtask;
- the *composer* answers a subtask by calling the others and then ``execute``, once or several times;
- *parse_query_obj* finds what words refer to. The program is kept, not its result: reading the observation runs it
  again, so that it is always up to date;
- *get_affordance_map*, *get_avoidance_map*, *get_rotation_map*, *get_velocity_map*, *get_gripper_map* write maps over
  the voxel grid, kept as programs too and run when ``execute`` asks for them.

The semantics are upstream's (huangwl18/VoxPoser, ``src/LMP.py``, ``src/interfaces.py``, ``rlbench_config.yaml``), its
prompt files included: stop tokens, the context line, query prefix and suffix, ``ret_val``. Beyond
upstream, programs are checked and bounded, a query is one line, and each LMP gets only the functions it needs.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from voxposer.language.llm import Llm
from voxposer.language.lmp_config import ACTIONS, CONFIGS, MAPS, RESTRICTED, Call, LmpConfig, LmpError
from voxposer.language.observations import DynamicObservation, DynamicObservations, LazyMap, Observation
from voxposer.language.prompts import chat_messages, code_in, lines, load_prompts, query_line, repair_messages
from voxposer.language.replies import LlmError, Message, NoRuleError, Reply
from voxposer.sandbox import interpreter as sandbox
from voxposer.sandbox.guard import Budget, HostFault, Limits, RecordList
from voxposer.sandbox.interpreter import Program
from voxposer.sandbox.syntax import SandboxError

T = TypeVar("T")
# Subtasks of one instruction, and characters of one query.
_SUBTASKS, _QUERY_CHARS = 100, 1000
# Characters of programs that are kept parsed: a syntax tree takes up to 350 bytes for each.
_CACHED = 2000


@dataclass(kw_only=True)
class _Written:
    """A program that the model wrote for a query; a repaired one takes its place."""

    config: LmpConfig
    query: str
    program: Program
    call: Call


class Lmps:
    """The language programs of one robot: its functions, its scene's objects, its trace.

    Attributes:
        trace: every question to the model so far, in order.
    """

    def __init__(
        self,
        functions: Mapping[str, Callable[..., Any]],
        llm: Llm,
        prompts: Mapping[str, str],
        *,
        limits: Limits | None = None,
        configs: Mapping[str, LmpConfig] = CONFIGS,
        repairs: int = 0,
        undo: Callable[[], None] | None = None,
        aside: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Language programs over functions; ``build_lmps`` loads the prompts.

        Args:
            functions: what programs may call, by name; ``execute`` and ``reset_to_default_pose`` are for the composer.
            llm: the model; several may share one.
            prompts: text of each LMP's examples.
            limits: what a program may use.
            configs: the LMPs.
            repairs: how often the model is shown what its program did wrong and asked for another. A rule base would
                write the same again; it is not asked.
            undo: forgets what the composer's functions did since its program began. Without it, a composer's program
                that failed while it ran is not repaired.
            aside: what to be inside while the model is waited for.
        """
        self.trace: list[Call] = []
        self._llm, self._prompts, self._configs = llm, dict(prompts), dict(configs)
        self._limits = limits or Limits()
        self._repairs = 0 if llm.config.is_rule_base else repairs
        self._undo, self._aside = undo, aside
        self._functions = dict(functions) | self._own_functions()
        self._objects: tuple[str, ...] | None = None
        self._budget: Budget | None = None
        self._sessions: dict[str, str] = {}
        self._session_variables: dict[str, dict[str, Any]] = {}

    def _own_functions(self) -> dict[str, Callable[..., Any]]:
        makers = {name: getattr(self, name) for name in ("parse_query_obj", *MAPS)}
        return {"composer": self.composer} | makers

    def set_context(self, objects: Sequence[str]) -> None:
        """Set the names of the scene's objects, which the planner and ``parse_query_obj`` receive.

        Raises:
            TypeError: they are not a list of names.
        """
        names = tuple(objects)
        if isinstance(objects, str) or not all(isinstance(name, str) for name in names):
            raise TypeError(f"objects are a list of names, not {objects!r}")
        self._objects = names

    def clear_trace(self) -> None:
        """Forget the trace, and the sessions of LMPs that keep one."""
        self.trace.clear()
        self._sessions.clear()
        self._session_variables.clear()

    # The eight LMPs

    def planner(self, query: str) -> None:
        """Carry out an instruction: plan it, and run the composer on each subtask.

        Raises:
            LmpError: a program, this one's or one it called, cannot be run.
            LlmError: the model does not answer.
        """
        self._execute(self._write("planner", query), self._functions)  # subtasks that are done cannot be undone

    def composer(self, query: str) -> None:
        """Carry out one subtask: run the program that calls ``execute``. Raises as ``planner``."""
        self._run(self._write("composer", query), self._functions, self._undo)

    def parse_query_obj(self, query: str) -> DynamicObservation | DynamicObservations:
        """The object that a query refers to, or several where the program returns a list.

        Raises:
            LmpError: the program cannot be run, or found nothing.
        """
        written = self._write("parse_query_obj", query)
        if isinstance(self._things(written), list):
            return DynamicObservations(lambda: self._several(written))
        return DynamicObservation(lambda: self._one(written))

    def get_affordance_map(self, query: str) -> LazyMap:
        """Targets of a motion: 1 at targets, 0 elsewhere."""
        return self._map("get_affordance_map", query)

    def get_avoidance_map(self, query: str) -> LazyMap:
        """Cost of passing through each voxel, 0 to 1."""
        return self._map("get_avoidance_map", query)

    def get_rotation_map(self, query: str) -> LazyMap:
        """Orientation of the hand at each voxel: quaternions wxyz, world frame."""
        return self._map("get_rotation_map", query)

    def get_velocity_map(self, query: str) -> LazyMap:
        """Speed of the hand at each voxel: 1 is normal."""
        return self._map("get_velocity_map", query)

    def get_gripper_map(self, query: str) -> LazyMap:
        """Whether the gripper is open at each voxel: 1 open, 0 closed."""
        return self._map("get_gripper_map", query)

    def plan(self, query: str) -> tuple[str, ...]:
        """The subtasks of an instruction, in order; nothing is executed. Raises as ``planner``."""
        subtasks: list[str] = []
        written = self._write("planner", query)
        self._run(written, self._functions | {"composer": _recorder(subtasks)}, subtasks.clear)
        return tuple(subtasks)

    # Results

    def _map(self, name: str, query: str) -> LazyMap:
        written = self._write(name, query)
        return LazyMap(name, written.query, lambda: self._voxels(written))

    def _voxels(self, written: _Written) -> np.ndarray:
        """The map that a program returns, checked."""
        return self._run(written, self._functions, _nothing, self._as_voxels)

    def _as_voxels(self, written: _Written, value: Any) -> np.ndarray:
        tail = (4,) if written.config.name == "get_rotation_map" else ()
        shape: tuple[int, ...] = value.shape if isinstance(value, np.ndarray) else ()
        if shape != (shape[:1] or (0,)) * 3 + tail:
            wanted = "[N, N, N, 4]" if tail else "[N, N, N]"
            raise self._wrong(written, f"the program returned {_shown(value)}, not a map {wanted}")
        if not np.isfinite(value).all():
            raise self._wrong(written, "the map has values that are not finite")
        return np.asarray(value, np.float64)

    def _things(self, written: _Written) -> Observation | list[Observation]:
        return self._run(written, self._functions, _nothing, self._as_things)

    def _as_things(self, written: _Written, value: object) -> Observation | list[Observation]:
        single = not isinstance(value, (list, tuple, RecordList))
        things = [_static(item) for item in ([value] if single else value)]
        if not things or any(thing is None for thing in things):
            raise self._wrong(written, f"the program found {_shown(value)}, not an observation")
        found = [thing for thing in things if thing is not None]
        return found[0] if single else found

    def _one(self, written: _Written) -> Observation:
        things = self._things(written)
        return things[0] if isinstance(things, list) else things

    def _several(self, written: _Written) -> list[Observation]:
        things = self._things(written)
        return things if isinstance(things, list) else [things]

    def _wrong(self, written: _Written, reason: str) -> LmpError:
        written.call.error = reason
        return LmpError(written.config.name, written.query, "result", reason)

    # Writing programs

    def _write(self, name: str, query: object) -> _Written:
        """Request the program for a query from the model, and another if it cannot be run."""
        config, words = self._configs[name], self._words(name, query)
        context = self._context(config, words)
        call = self._new_call(config, words, context, self._messages(config, context, words))
        while True:
            try:
                return self._ask(config, call)
            except LmpError as error:
                call = self._repair_of(config, call, error)

    def _new_call(
        self, config: LmpConfig, query: str, context: str, messages: Sequence[Message], repair: int = 0
    ) -> Call:
        """A question that is about to be asked."""
        if self._budget is not None:
            self._budget.program()
        call = Call(
            lmp=config.name,
            query=query,
            context=context,
            model=self._llm.config.model,
            repair=repair,
            messages=messages,
            stop=config.stop,
            settings=self._llm.config.settings(config.max_tokens, config.temperature),
        )
        self.trace.append(call)
        return call

    def _ask(self, config: LmpConfig, call: Call) -> _Written:
        """Ask the model, and parse what it answers."""
        with self._inside(call), self._clock_stopped():
            reply = self._reply(config, call)
            call.note(reply)
            return _Written(config=config, query=call.query, program=self._parsed(call, reply.text), call=call)

    def _repair_of(self, config: LmpConfig, call: Call, error: LmpError) -> Call:
        """The question that shows the model what its program did wrong; raises the error if none is to be asked."""
        if call.repair >= self._repairs or call.reply is None or error.rule in ("query", "reply"):
            raise error
        messages = repair_messages(config, call.messages, call.reply, str(error), call.context, call.query)
        return self._new_call(config, call.query, call.context, messages, call.repair + 1)

    def _words(self, name: str, query: object) -> str:
        """A query as one line, without the full stop at its end."""
        if not isinstance(query, str):
            raise LmpError(name, "", "query", f"a query is text, not {_shown(query)}")
        words = " ".join(query.split()).rstrip(". ")
        if not words or len(words) > _QUERY_CHARS:
            raise LmpError(name, words[:80], "query", f"a query has 1 to {_QUERY_CHARS} characters, not {len(words)}")
        return words

    def _context(self, config: LmpConfig, query: str) -> str:
        if not config.include_context:
            return ""
        if self._objects is None:
            raise LmpError(config.name, query, "query", "no objects are known; call set_context first")
        return f"objects = {list(self._objects)}"

    def _reply(self, config: LmpConfig, call: Call) -> Reply:
        """The model's answer; that a rule base has no rule for the query is an error of the LMP."""
        try:
            with self._aside():
                return self._llm.complete(
                    call.messages,
                    stop=config.stop,
                    max_tokens=config.max_tokens,
                    temperature=config.temperature,
                    note=call.note,
                    check=lambda text: self._parsed(call, text),
                )
        except NoRuleError as error:
            raise LmpError(call.lmp, call.query, "reply", str(error)) from error
        except LlmError as error:
            if error.reply is not None:
                call.note(error.reply)
            error.add_note(f"requested by {call.lmp}({call.query!r})")
            raise

    def _messages(self, config: LmpConfig, context: str, query: str) -> list[Message]:
        """The request: examples and earlier exchanges first, then the query with its context."""
        session = self._sessions.get(config.name, "")
        prompt = self._prompt(config) + (f"\n\n{session}" if session else "")
        return chat_messages(config, prompt, context, query)

    def _prompt(self, config: LmpConfig) -> str:
        """The examples, with upstream's placeholder for the line that imports the functions."""
        names = sorted(self._allowed(config.name, self._functions))
        return self._prompts[config.name].replace("{variable_vars_imports}", f"from utils import {', '.join(names)}")

    def _parsed(self, call: Call, text: str) -> Program:
        call.code = code_in(text)
        try:
            with self._budget.clock(running=True) if self._budget else contextlib.nullcontext():
                parse = _parse if len(call.code) <= _CACHED else _parse.__wrapped__
                return parse(call.code, self._limits)
        except SandboxError as error:
            reason = f"{call.model} wrote a program that cannot be run: {error.reason}, in {_start(call.code)}"
            raise LmpError(call.lmp, call.query, error.rule, reason, error.line) from error

    # Running programs

    def _run(
        self,
        written: _Written,
        functions: Mapping[str, Callable[..., Any]],
        undo: Callable[[], None] | None,
        take: Callable[[_Written, Any], T] = lambda written, value: value,
    ) -> T:
        """What ``take`` makes of the value of a program; a program that fails is repaired where that may be undone."""
        while True:
            try:
                return take(written, self._execute(written, functions))
            except LmpError as error:
                own = (error.lmp, error.query) == (written.config.name, written.query)
                if undo is None or not own:
                    raise
                self._repair(written, error)
            undo()

    def _repair(self, written: _Written, error: LmpError) -> None:
        """Put another program of the model in the place of one that failed; raises the error if there is none."""
        call = self._repair_of(written.config, written.call, error)
        while True:
            try:
                repaired = self._ask(written.config, call)
                break
            except LmpError as other:
                call = self._repair_of(written.config, call, other)
        written.program, written.call = repaired.program, repaired.call

    def _execute(self, written: _Written, functions: Mapping[str, Callable[..., Any]]) -> Any:
        """Run a program; its errors are reported as errors of this LMP.

        Some of upstream's examples for maps end without an assignment to ``ret_val``, and models copy that: the map is
        then the variable that all of them call by its kind, such as ``affordance_map``.
        """
        config = written.config
        variables = dict(self._session_variables.get(config.name, {}))
        if config.include_context:
            variables["objects"] = list(self._objects or ())
        with self._inside(written.call), self._running(written) as budget:
            outcome = written.program.run(
                self._allowed(config.name, functions),
                variables,
                returns=config.return_val_name if config.has_return else None,
                budget=budget,
            )
        if config.maintain_session:
            self._remember(written, outcome.variables)
        if outcome.value is None and config.name in MAPS:
            return outcome.variables.get(config.name.removeprefix("get_"))
        return outcome.value

    def _allowed(self, name: str, functions: Mapping[str, Callable[..., Any]]) -> dict[str, Callable[..., Any]]:
        """The functions that an LMP's programs may call."""
        return {key: value for key, value in functions.items() if key not in RESTRICTED or key in ACTIONS[name]}

    @contextlib.contextmanager
    def _running(self, written: _Written) -> Iterator[Budget]:
        """The budget of a program: its caller's, except that each composer program gets a new one."""
        outer = self._budget
        if outer is None or written.config.name == "composer":
            self._budget = Budget(self._limits)
        try:
            assert self._budget is not None
            yield self._budget
        except SandboxError as error:
            raise LmpError(
                written.config.name, written.query, error.rule, error.reason, error.line
            ) from error.__cause__
        except HostFault as error:
            error.add_note(f"in {written.config.name}({written.query!r})")
            raise
        finally:
            self._budget = outer

    @contextlib.contextmanager
    def _clock_stopped(self) -> Iterator[None]:
        """Stop the program's clock while the model answers."""
        with self._budget.clock(running=False) if self._budget else contextlib.nullcontext():
            yield

    @contextlib.contextmanager
    def _inside(self, call: Call) -> Iterator[None]:
        """Record an error in the trace."""
        try:
            yield
        except Exception as error:
            call.error = str(error)
            raise

    def _remember(self, written: _Written, variables: Mapping[str, Any]) -> None:
        config = written.config
        said = lines(written.call.context, query_line(config, written.query), written.call.code)
        self._sessions[config.name] = lines(self._sessions.get(config.name, ""), said)
        self._session_variables[config.name] = dict(variables)


def build_lmps(
    functions: Mapping[str, Callable[..., Any]],
    llm: Llm,
    prompts_dir: str | Path | None = None,
    limits: Limits | None = None,
    configs: Mapping[str, LmpConfig] = CONFIGS,
    **options: Any,
) -> Lmps:
    """The language programs with their prompts loaded.

    Args:
        functions: as for ``Lmps``.
        llm: the model.
        prompts_dir: a folder with ``{lmp}.txt`` or, as upstream names them, ``{lmp}_prompt.txt``; the package's own
            prompts by default.
        limits: what a program may use.
        configs: the LMPs.
        **options: ``repairs``, ``undo`` and ``aside`` as for ``Lmps``.

    Raises:
        FileNotFoundError: a prompt is missing.
    """
    return Lmps(functions, llm, load_prompts(prompts_dir), limits=limits, configs=configs, **options)


@functools.lru_cache(maxsize=256)
def _parse(code: str, limits: Limits) -> Program:
    """A parsed program, cached: the episodes of a batch share the same few."""
    return sandbox.parse(code, limits=limits)


def _nothing() -> None:
    """Undoes a program that did nothing but compute."""


def _recorder(subtasks: list[str]) -> Callable[[Any], None]:
    """A composer that only records its queries."""

    def composer(query: object) -> None:
        if not isinstance(query, str):
            raise TypeError(f"a subtask is text, not {type(query).__name__}")
        if len(subtasks) == _SUBTASKS:
            raise ValueError(f"more than {_SUBTASKS} subtasks")
        subtasks.append(query)

    return composer


def _static(value: object) -> Observation | None:
    """The present value of an observation; None if the value is not one."""
    if isinstance(value, DynamicObservation):
        return value()
    return value if isinstance(value, Observation) else None


def _shown(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"an array {list(value.shape)}"
    if isinstance(value, (str, bool, int, float)):
        return f"{type(value).__name__} {str(value)[:80]!r}"
    if isinstance(value, (list, tuple, dict, set)):  # whose items may be many more than it holds
        return f"a {type(value).__name__} of {len(value)}"
    return "nothing" if value is None else f"a value of type {type(value).__name__}"


def _start(code: str) -> str:
    line = code.strip().splitlines()[0] if code.strip() else ""
    return repr(line if len(line) <= 80 else f"{line[:77]}...")
