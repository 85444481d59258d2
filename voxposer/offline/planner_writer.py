"""Programs of the planner: an instruction becomes sentences for the composer.

An instruction and entity names come in; the planner's program goes out, one ``composer("...")`` call per subtask. It
looks at the scene first where the instruction has a condition, or presupposes something.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from voxposer.offline.grammar import understand
from voxposer.offline.grounding import ground, handle_of, is_table
from voxposer.offline.looks import RESTS, looked_at, presupposed
from voxposer.offline.meaning import Action, Avoidance, Condition, Instruction
from voxposer.offline.names import Name, NotUnderstood, read_names
from voxposer.offline.opened import with_open_drawer
from voxposer.offline.programs import AVOID, Block, in_one_line, program
from voxposer.offline.subtasks import SubtaskWriter


def write_planner(instruction: str, objects: Sequence[str]) -> str:
    """The planner's program for an instruction.

    Raises:
        NotUnderstood: the message says what is not understood.
    """
    names = read_names(objects)
    try:
        meant, drawer = with_open_drawer(understand(instruction, objects), names)
        lines = _Cases(names, meant).lines()
        lines = drawer.lines(lines) if drawer is not None else lines
    except RecursionError:
        raise NotUnderstood(f"{instruction.strip()[:80]!r} describes objects by one another without an end") from None
    slips = [f"# {written!r} is taken for {word!r}" for written, word in meant.slips]
    return "\n".join([*slips, *lines, "# done"])


class _Cases:
    """The program with what it looks at first, and its two cases where there is a condition."""

    def __init__(self, names: Sequence[Name], meant: Instruction) -> None:
        self._names, self._meant = names, meant
        self._extras = _extras(meant, names)

    def lines(self) -> list[str]:
        """The lines of the program."""
        found = [action.condition for action in self._meant.actions if action.condition is not None]
        if not found:
            return self._with_rests(self._case(self._meant.actions))
        condition = replace(found[0], negated=False)
        if any(replace(other, negated=False) != condition for other in found):
            raise NotUnderstood("more than one condition at a time is not understood")
        self._check_first(condition)
        looked, test = self._test(condition)
        cases = [
            self._case([action for action in self._meant.actions if _applies(action, negated)])
            for negated in (False, True)
        ]
        then, otherwise = ([f"    {line}" for line in in_one_line(case)] for case in cases)
        branches = [f"if {test}:", *then, "else:", *otherwise] if otherwise else [f"if {test}:", *then]
        branches = branches if then else [f"if not ({test}):", *otherwise]
        return self._with_rests([*looked, *branches])

    def _with_rests(self, lines: list[str]) -> list[str]:
        return [*(RESTS if any("rests(" in line for line in lines) else []), *lines]

    def _case(self, actions: Sequence[Action]) -> list[str]:
        """The lines of one case: what it presupposes, then its subtasks."""
        blocks = SubtaskWriter(self._names).plan(replace(self._meant, actions=tuple(actions)))
        said = [
            Block(tuple(_with(sentence, self._extras) for sentence in block.sentences), block.thing) for block in blocks
        ]
        return [*presupposed(actions, self._names), *self._open_already(actions), *program(said)]

    def _open_already(self, actions: Sequence[Action]) -> list[str]:
        """Lines that check that what must not be opened, and something is to be put in, is open.

        Raises:
            NotUnderstood: something is to be put in what was closed before.
        """
        shut: set[str] = set()
        kept = {handle for action in self._meant.forbidden if action.verb == "open" for handle in self._handles(action)}
        lines: list[str] = []
        for action in actions:
            if action.verb in {"open", "close"}:
                shut = shut - self._handles(action) if action.verb == "open" else shut | self._handles(action)
            if action.place is None or action.place.relation not in {"in", "to"} or is_table(action.place.thing):
                continue
            found = ground(action.place.thing, self._names)
            handle = handle_of(found.names[0], self._names) if found.is_settled else None
            if handle in shut:
                raise NotUnderstood(f"{action.thing} is to be put in {action.place.thing}, which is closed before")
            if handle in kept:
                told = f"{found.names[0].text} is closed, and must not be opened"
                lines.append(f"if not detect({handle!r}).is_open: raise ValueError({told!r})")
        return lines

    def _handles(self, action: Action) -> set[str]:
        return {handle.removeprefix("the ") for handle in SubtaskWriter(self._names).operated(action.thing, "handle")}

    def _test(self, condition: Condition) -> tuple[list[str], str]:
        """Lines that look, and an expression that is true where the condition holds."""
        if condition.relation is None:
            part = "knob" if condition.state in {"on", "off"} else "handle"
            (name,) = self._single(SubtaskWriter(self._names).operated(condition.thing, part), condition)
            test = f"detect({name!r}).is_open"
            return [], test if condition.state in {"on", "open"} else f"not {test}"
        (ref,) = condition.relation.refs
        looked = looked_at(ref, condition.relation, self._names)
        thing = ground(condition.thing, self._names)
        if looked is None or not thing.is_settled:
            raise NotUnderstood(f"whether {condition.thing} is there, {str(condition.relation)!r}, cannot be told")
        return [*looked[0], f"name = {thing.names[0].text!r}"], looked[1]

    def _single(self, phrases: Sequence[str], condition: Condition) -> list[str]:
        known = [name.text for name in self._names for phrase in phrases if phrase == f"the {name.text}"]
        if len(phrases) != 1 or not known:
            raise NotUnderstood(f"which is to be {condition.state} in the condition, {str(condition.thing)!r}?")
        return known

    def _check_first(self, condition: Condition) -> None:
        """Refuse a condition about what was changed before: the program looks before anything moves."""
        for action in self._meant.actions:
            if action.condition is not None:
                return
            operated = action.verb in {"open", "close", "turn_on", "turn_off"}
            if operated == (condition.relation is None):
                raise NotUnderstood(f"whether {condition.thing} is so once {action.thing} was changed is not known yet")


def _applies(action: Action, negated: bool) -> bool:
    return action.condition is None or action.condition.negated == negated


def _extras(meant: Instruction, names: Sequence[Name]) -> str:
    """What holds for every motion, in the composer's words: what to keep away from, and the speed."""
    kept = [
        f"{round(max(avoidance.cm or AVOID, 1))}cm{'' if index else ' away'} from {thing}"
        for index, (avoidance, thing) in enumerate(
            (avoidance, thing) for avoidance in meant.avoid for thing in _avoided(avoidance, names)
        )
    ]
    text = f" while keeping at least {' and '.join(kept)}" if kept else ""
    return text + (f", at {meant.speed:g}x speed" if meant.speed is not None else "")


def _avoided(avoidance: Avoidance, names: Sequence[Name]) -> list[str]:
    found = ground(avoidance.thing, names)
    if found.is_settled or not found.noun.plural:
        return [found.text]
    if found.noun.ranking or found.noun.relation or found.noun.excluded:
        raise NotUnderstood(f"how many are {str(avoidance.thing)!r}?")
    return [f"the {name.text}" for name in found.names]


def _with(sentence: str, extras: str) -> str:
    return sentence if sentence.endswith(("default pose", "gripper")) else sentence + extras
