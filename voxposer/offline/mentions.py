"""What was said of objects before, what "one" and "it" can repeat of it, and objects that go to one another."""

from __future__ import annotations

from dataclasses import replace

from voxposer.offline.lexicon import SIDE_WORDS, SIZES, words
from voxposer.offline.meaning import BESIDE, Action, Noun, Place
from voxposer.offline.names import COLOURS

# Actions that a clause without a verb can repeat.
VERBS_SAID = frozenset(words("put stack push pick open close turn_on turn_off"))
# Things that others can stand in or on.
BEARERS = frozenset(
    words("plate bowl tray basket towel cloth book block cube box ramekin mug cup pan frypan caddy cookie")
)
_HOLLOW = frozenset(words("bowl basket tray box ramekin mug cup pan frypan caddy"))


def is_hollow(noun: Noun) -> bool:
    """Whether things go into it, rather than on it."""
    return noun.words[-1] in _HOLLOW


def described_words(noun: Noun, own: set[str]) -> tuple[str, ...]:
    """What "one" repeats of an earlier description: all but its side and size, and its colour where another is said."""
    dropped = {*SIDE_WORDS, *SIZES, *(COLOURS if own & COLOURS else ())}
    return tuple(word for word in noun.words if word not in dropped) or noun.words[-1:]


def carrying(stack: Action) -> list[list[Noun]]:
    """The objects of an action that carries a stack: both of them."""
    assert stack.place is not None
    return [[stack.place.thing, stack.thing]]


def inner_nouns(noun: Noun) -> list[Noun]:
    """The objects that a description names, the described one last."""
    refs: list[Noun] = []
    if noun.relation is not None:
        refs += noun.relation.refs
    if noun.ranking is not None and noun.ranking.ref is not None:
        refs.append(noun.ranking.ref)
    return [*(part for ref in refs for part in inner_nouns(ref)), noun]


def stacked(placed: list[Action]) -> list[Action]:
    """ "Stack the bowl and the cup on the plate": each on the one before."""
    if len(placed) < 2 or any(action.thing.plural or action.place != placed[0].place for action in placed):
        return placed
    supports = [placed[0].place, *(Place(relation="on", thing=action.thing) for action in placed)]
    return [replace(action, place=support) for action, support in zip(placed, supports, strict=False)]


def together(placed: list[Action]) -> list[Action]:
    """ "The ramekin and the cookies next to each other": the first goes to the second."""
    places = [action.place for action in placed if action.place and action.place.thing.words == ("each other",)]
    if len(placed) != 2 or len(places) != 2 or places[0].relation not in BESIDE:
        return placed
    return [replace(placed[0], place=replace(places[0], thing=placed[1].thing))]
