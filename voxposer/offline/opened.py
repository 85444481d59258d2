"""Drawers that are told apart by being open: "the drawer that is open", and "the drawer" where only one is.

Which one that is, only the scene shows. The subtasks are written for one of the drawers, and the planner's program puts
the name of the one that is open (or closed) in its place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from voxposer.offline.lexicon import OPENED
from voxposer.offline.meaning import Action, Instruction, Noun, Place
from voxposer.offline.names import Name, NotUnderstood, matching


@dataclass(frozen=True)
class OpenDrawer:
    """A drawer of which only the state is known.

    Attributes:
        stems: what the names of each one's parts begin with, "cabinet_1_top".
        state: open or closed.
    """

    stems: tuple[str, ...]
    state: str

    def lines(self, lines: Sequence[str]) -> list[str]:
        """A program that was written for the first of the drawers, for the one that is open."""
        listed = ", ".join(map(repr, self.stems))
        negated = "" if self.state == "open" else "not "
        look = [
            f"drawers = [name for name in [{listed}] if {negated}detect(name + '_handle').is_open]",
            f"if len(drawers) != 1: raise ValueError('which drawer? Not just one of them is {self.state}')",
            "drawer = drawers[0]",
        ]
        return [*look, *(self._line(line) for line in lines)]

    def _line(self, line: str) -> str:
        part = rf"{re.escape(self.stems[0])}_(drawer|handle)"
        line = re.sub(rf"detect\('{part}'\)", r"detect(drawer + '_\1')", line)
        changed = re.sub(part, r"{drawer}_\1", line)
        return re.sub(r"""(?<!\w)("[^"]*\{drawer\}[^"]*"|'[^']*\{drawer\}[^']*')""", r"f\1", changed)


def with_open_drawer(meant: Instruction, names: Sequence[Name]) -> tuple[Instruction, OpenDrawer | None]:
    """An instruction with one of the drawers in place of "the open drawer", and what it stands for; None for none.

    Raises:
        NotUnderstood: it is said of one of the drawers by its name, too.
    """
    found: list[OpenDrawer] = []

    def exchanged(noun: Noun, *, implied: bool = True) -> Noun:
        relation, ranking = noun.relation, noun.ranking
        if relation is not None:
            noun = replace(noun, relation=replace(relation, refs=tuple(map(exchanged, relation.refs))))
        if ranking is not None and ranking.ref is not None:
            noun = replace(noun, ranking=replace(ranking, ref=exchanged(ranking.ref)))
        drawer = _drawer(noun, names, implied=implied or bool(found))
        if drawer is None:
            return noun
        found.append(drawer)
        return Noun(words=(f"{drawer.stems[0]}_drawer",))

    actions = tuple(_exchanged(action, exchanged) for action in meant.actions)
    if not found:
        return meant, None
    if len(set(found)) > 1 or _named(actions, found[0], names):
        raise NotUnderstood("'the drawer' could be any: more than one of them is spoken of; say which")
    kept = tuple((state, exchanged(noun)) for state, noun in meant.kept)
    forbidden = tuple(_exchanged(action, exchanged) for action in meant.forbidden)
    return replace(meant, actions=actions, kept=kept, forbidden=forbidden), found[0]


def _exchanged(action: Action, exchange: Callable[..., Noun]) -> Action:
    place: Place | None = action.place
    if place is not None:
        second = None if place.second is None else exchange(place.second)
        place = replace(place, thing=exchange(place.thing, implied=place.relation in {"in", "to"}), second=second)
    # What is to be opened is not open yet: which one must be said.
    return replace(action, thing=exchange(action.thing, implied=action.verb == "close"), place=place)


def _drawer(noun: Noun, names: Sequence[Name], *, implied: bool) -> OpenDrawer | None:
    """The drawers that "the drawer" or "the open drawer" could be."""
    states = [OPENED[word] for word in noun.words if word in OPENED]
    words = [word for word in noun.words if word not in OPENED]
    if words[-1:] != ["drawer"] or not (states or implied) or not noun.is_bare or noun.plural or noun.indefinite:
        return None
    drawers = [name for name in matching(words, names) if name.text.endswith("_drawer")]
    if len(drawers) < 2:
        return None
    return OpenDrawer(tuple(name.text.removesuffix("_drawer") for name in drawers), states[0] if states else "open")


def _named(actions: Sequence[Action], drawer: OpenDrawer, names: Sequence[Name]) -> bool:
    """Whether an action is about one of the drawers by its name."""
    first = f"{drawer.stems[0]}_drawer"
    nouns = [noun for action in actions for noun in (action.thing, action.place and action.place.thing) if noun]
    known = {name.text for noun in nouns if noun.words != (first,) for name in matching(noun.words, names)}
    return any(f"{stem}_{part}" in known for stem in drawer.stems for part in ("drawer", "handle"))
