"""Which objects of the scene a description can mean, by their names.

A :class:`~voxposer.offline.meaning.Noun` and the names of the scene come in; a :class:`Found` goes out: the names that
fit, and what is left of the description to choose between them by position or size, which only the program can do.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from voxposer.offline.lexicon import GENERIC, SIDE_WORDS, SIZES, words
from voxposer.offline.meaning import Noun, Ranking
from voxposer.offline.names import COLOURS, Name, NotUnderstood, matching

TABLE = ("table",)
_TABLES = frozenset(["table", "tabletop", "desk", "counter", "countertop", "workspace", "floor"])
# A thing with such a part is a fixture.
_FIXED_PARTS = frozenset(words("handle knob burner level slot door drawer top"))
# Objects that "to" puts things into, and those it puts them on; it puts things next to all others.
CONTAINERS = frozenset(words("basket tray drawer microwave caddy compartment bowl bin box mug"))
SUPPORTS = frozenset(words("plate stove cabinet shelf rack towel cloth table burner level top ramekin"))
_HOLLOW = frozenset(words("cup pot pan frypan sink glass jar inside slot"))
_FIXTURES = frozenset(words("cabinet stove shelf microwave rack sink"))
_LEVELS = {"top": 0, "upper": 0, "middle": 1, "bottom": 2, "lower": 2}


@dataclass(frozen=True)
class Found:
    """The names a noun can mean, and what picks one of several: its ranking, relation or exclusions."""

    noun: Noun
    names: tuple[Name, ...]

    @property
    def is_settled(self) -> bool:
        """Whether it is one object, independent of positions."""
        chosen = self.noun.ranking or self.noun.relation or self.noun.excluded or self.noun.moved
        return len(self.names) == 1 or (self.noun.indefinite and not chosen)

    @property
    def text(self) -> str:
        """Words for it in a subtask: its name if it is settled."""
        return f"the {self.names[0].text}" if self.is_settled else str(self.noun)


def is_table(noun: Noun) -> bool:
    """Whether it is the table that everything stands on."""
    return len(noun.words) == 1 and noun.words[0] in _TABLES


def is_fixture(name: Name, names: Sequence[Name]) -> bool:
    """Whether a thing cannot be carried: parts, and what has drawers, doors, knobs or levels."""
    parts = {word for other in names if other.whole == name.text and other.is_part for word in other.part_words}
    return name.is_part or bool(parts & _FIXED_PARTS) or bool(_FIXTURES & set(name.words))


def holds_things(name: Name, names: Sequence[Name]) -> bool:
    """Whether "in" it can be a place; "in the plate" is said of what is on it."""
    parts = {word for other in names if other.whole == name.text for word in other.words}
    return bool((parts | {*name.words}) & (CONTAINERS | SUPPORTS | _HOLLOW))


def ground(noun: Noun, names: Sequence[Name]) -> Found:
    """The names a noun can mean; words like "left" and "big" become its ranking where no name has them.

    Raises:
        NotUnderstood: no name fits; several do and the noun does not say which; or there are not as many as it says.
    """
    for option in _options(noun):
        found = _generic(option, names) if option.words[-1] in GENERIC else matching(option.words, names)
        if found and not _is_size_unused(option, found):
            return _checked(_levelled(_without_refs(_without_excluded(Found(option, found), names), names)))
    listed = ", ".join(name.text for name in names) or "no objects"
    raise NotUnderstood(f"{str(noun)!r} fits none of {listed}")


def _is_size_unused(noun: Noun, found: Sequence[Name]) -> bool:
    """Whether a word for a size, which no name has, would tell the names apart: "the small cube"."""
    sizes = [word for word in noun.words[:-1] if word in SIZES]
    ranked = noun.ranking is not None and bool(noun.ranking.key)
    return len(found) > 1 and not ranked and any(word not in name.words for word in sizes for name in found)


def _options(noun: Noun) -> list[Noun]:
    """The noun as it is, and with a word for a side or a size as its ranking."""
    options = [noun]
    ranked = noun.ranking is not None and bool(noun.ranking.key)
    for table in (SIDE_WORDS, SIZES):
        for word in noun.words[:-1]:
            if word in table and not ranked:
                words = tuple(other for other in noun.words if other != word)
                rank = noun.ranking.rank if noun.ranking else 1
                options.append(replace(noun, words=words, ranking=Ranking(key=table[word], rank=rank)))
    return options


def _generic(noun: Noun, names: Sequence[Name]) -> tuple[Name, ...]:
    """All objects that can be carried, of the colour or kind that is said."""
    said = set(noun.words[:-1])
    return tuple(name for name in names if not is_fixture(name, names) and said <= name.senses)


def _without_excluded(found: Found, names: Sequence[Name]) -> Found:
    """The names without those that are excluded by their words; other exclusions are left to the program."""
    left, dynamic = found.names, []
    for excluded in found.noun.excluded:
        bare = excluded.words[-1] in {"one", "ones"} or (len(excluded.words) == 1 and excluded.words[0] in COLOURS)
        head = [word for word in excluded.words if word not in {"one", "ones"}] + (
            [found.noun.words[-1]] if bare else []
        )
        noun = replace(excluded, words=tuple(head), plural=not excluded.indefinite, number=None)
        try:
            out = ground(noun, names)
        except NotUnderstood:
            if not bare and excluded.is_bare:
                raise
            continue
        if out.is_settled or not (out.noun.ranking or out.noun.relation):
            gone = out.names[:1] if excluded.indefinite else out.names
            left = tuple(name for name in left if name not in gone)
        else:
            dynamic.append(replace(out.noun, plural=False))
    if not left:
        raise NotUnderstood(f"{str(found.noun)!r} leaves nothing")
    return Found(replace(found.noun, excluded=tuple(dynamic)), left)


def _without_refs(found: Found, names: Sequence[Name]) -> Found:
    """The names without the objects that describe them: "the thing nearest to the milk" is not the milk."""
    left = found.names
    for ref in refs_of(found.noun):
        with contextlib.suppress(NotUnderstood):
            out = ground(ref, names) if not is_table(ref) else None
            if out is not None and out.is_settled:
                left = tuple(name for name in left if name != out.names[0])
    return Found(found.noun, left or found.names)


def refs_of(noun: Noun) -> list[Noun]:
    """The objects that describe another one."""
    nearest = [noun.ranking.ref] if noun.ranking is not None and noun.ranking.ref is not None else []
    return [*(noun.relation.refs if noun.relation is not None else ()), *nearest]


def _levelled(found: Found) -> Found:
    """Drawers and levels are told apart by their names: "the second drawer from the top"."""
    ranking, names = found.noun.ranking, found.names
    levels = [[_LEVELS[word] for word in name.part_words if word in _LEVELS] for name in names]
    if len(names) == 1 or not all(levels) or len({name.whole for name in names}) > 1:
        return found
    if ranking is None:
        return _below(found, [level[0] for level in levels])
    if ranking.key in {"left", "right", "front", "back"}:
        listed = ", ".join(name.text for name in names)
        raise NotUnderstood(f"{str(found.noun)!r}: {listed} are above one another")
    if ranking.key not in {"top", "bottom"}:
        return found
    ordered = [
        name for _, name in sorted(zip([level[0] for level in levels], names, strict=True), key=lambda pair: pair[0])
    ]
    ordered = ordered if ranking.key == "top" else ordered[::-1]
    if abs(ranking.rank) > len(ordered):
        return found
    chosen = ordered[ranking.rank - 1 if ranking.rank > 0 else ranking.rank]
    return Found(replace(found.noun, ranking=None), (chosen,))


def _below(found: Found, levels: Sequence[int]) -> Found:
    """ "The drawer below the top one"; positions would not tell it from that one."""
    noun, relation = found.noun, found.noun.relation
    if (
        relation is None
        or relation.negated
        or not set(found.names) & set(matching(relation.refs[0].words, found.names))
    ):
        return found
    others = [levels[found.names.index(name)] for name in matching(relation.refs[0].words, found.names)]
    below = [name for name, level in zip(found.names, levels, strict=True) if level == others[0] + 1]
    if relation.kind != "under" or len(others) != 1 or not below:
        raise NotUnderstood(f"{str(noun)!r} is none of {', '.join(name.text for name in found.names)}")
    return Found(replace(noun, relation=None), tuple(below))


def _checked(found: Found) -> Found:
    """The same, if there are as many as it says and it tells which is meant."""
    noun, count = found.noun, len(found.names)
    listed = ", ".join(name.text for name in found.names)
    if noun.ranking and abs(noun.ranking.rank) > count:
        raise NotUnderstood(f"{str(noun)!r}: there is no such one, only {listed}")
    if noun.number is not None and noun.number > count:
        raise NotUnderstood(f"{str(noun)!r}: there are fewer, only {listed}")
    chosen = noun.ranking or noun.relation or noun.excluded or noun.moved
    if noun.number is not None and noun.exact and noun.number != count and (not noun.plural or not chosen):
        raise NotUnderstood(f"{str(noun)!r}: there are more: {listed}")
    if noun.ranking and not noun.ranking.key and count > 1:
        raise NotUnderstood(f"{str(noun)!r} is counted from where? It could be any of {listed}")
    if noun.ranking and noun.ranking.key in {"near", "far"} and noun.ranking.ref is None and count > 1:
        raise NotUnderstood(f"{str(noun)!r} is {noun.ranking.key} what? It could be any of {listed}")
    if not (found.is_settled or chosen or noun.plural):
        raise NotUnderstood(f"{str(noun)!r} could be any of {listed}")
    if noun.plural and not noun.exact and noun.number is not None and not chosen:
        return Found(noun, found.names[: noun.number])
    return found


def holder(relation: str, name: Name, names: Sequence[Name]) -> Name | None:
    """The part of a thing that holds what is on, in, on top of or under it; None for the thing itself.

    Raises:
        NotUnderstood: it goes into one of several drawers and none is named, or there is nothing below it.
    """
    if name.is_part and {"handle", "knob", "door"} & set(name.part_words):
        raise NotUnderstood(f"nothing can be put on or in {name.text}")
    if name.is_part:
        return _part_of(name.whole, names, ({"top"},)) if relation == "top_of" and "drawer" in name.words else None
    inside = ({"inside"},) if _part_of(name.text, names, ({"handle"}, {"door"})) else ()
    upper, lower, top = {"upper", "level"}, {"lower", "level"}, {"top"}
    wanted: dict[str, tuple[set[str], ...]] = {
        "in": (*inside, upper, {"slot"}),
        "on": ({"burner"}, {"slot"}, upper, top),
        "top_of": ({"burner"}, {"slot"}, top),
        "under": (lower,),
    }
    found = _part_of(name.text, names, wanted.get(relation, ()))
    drawers = [part.text for part in names if part.whole == name.text and "drawer" in part.part_words]
    if found is None and relation in {"in", "under"} and drawers:
        raise NotUnderstood(f"in which drawer? There are {', '.join(drawers)}")
    return found


def handle_of(name: Name, names: Sequence[Name]) -> str | None:
    """The handle of a drawer, or of a thing with one door; None for what has none."""
    stem = name.text.removesuffix("_drawer").removesuffix("_inside")
    return next((other.text for other in names if other.text == f"{stem}_handle"), None)


def _part_of(whole: str, names: Sequence[Name], wanted: Sequence[set[str]]) -> Name | None:
    """The first part of a thing with exactly the wanted words, in order of preference."""
    parts = [name for name in names if name.whole == whole and name.is_part]
    return next((part for words in wanted for part in parts if set(part.part_words) == words), None)


def with_words(noun: Noun, words: tuple[str, ...], names: Sequence[Name]) -> Noun:
    """The noun with other words; a name itself stays, so that its own part is found."""
    whole = [name for name in names if name.text in noun.words]
    words = tuple(
        part for word in words for part in ((word.split("_")) if whole and word == whole[0].text else (word,))
    )
    return Noun(
        words=tuple(word for word in words if not word.isdigit()),
        ranking=noun.ranking,
        relation=noun.relation,
        plural=noun.plural,
        number=noun.number,
        exact=noun.exact,
        excluded=tuple(_handle_of(excluded) for excluded in noun.excluded),
        indefinite=noun.indefinite,
    )


def _handle_of(noun: Noun) -> Noun:
    words = (*(word for word in noun.words if word not in {"drawer", "door"}), "handle")
    return Noun(words=words, ranking=noun.ranking, relation=noun.relation)
