"""What descriptions still mean after some objects were moved.

A program looks at the scene when it runs, so "the left bowl" means another bowl once the left one has been carried to
the right. Here a description of what is meant now is found: what was moved is named by where it is, and the rest by its
order among what is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from voxposer.offline.grounding import Found, ground, is_table, refs_of
from voxposer.offline.lexicon import GENERIC
from voxposer.offline.meaning import BESIDE, Noun, Place, Ranking, Relation
from voxposer.offline.names import Name, NotUnderstood

_OPPOSITE = {
    "left": "right", "right": "left", "front": "back", "back": "front", "top": "bottom", "bottom": "top",
    "large": "small", "small": "large", "tall": "short", "short": "tall", "near": "far", "far": "near",
}  # fmt: skip


_IN_HAND = Relation(kind="in", refs=(Noun(words=("hand",)),))


class Moves:
    """The objects that were put somewhere so far.

    Args:
        names: names of the scene.
    """

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._moved: list[tuple[Found, Place, int]] = []

    def add(self, found: Found, place: Place) -> None:
        """Note that an object was put somewhere."""
        several = found.noun.plural and not found.is_settled
        named = several and not (found.noun.ranking or found.noun.relation or found.noun.excluded)
        if not named:
            self._moved.append((found, place, (found.noun.number or 1) if several else 1))

    def count(self, noun: Noun, place: Place) -> int:
        """How many objects a description means."""
        return len(self.phrases(noun, place))

    def phrases(self, noun: Noun, place: Place | None) -> list[str]:
        """Phrases for the objects that a description means, to be moved one after the other.

        Args:
            noun: the description.
            place: where they go, by which those that were moved already are told from the others.
        """
        counted = noun.words[-1] in GENERIC and noun.number is not None and not (noun.ranking or noun.relation)
        if counted and place is not None and not is_table(place.thing):
            # "Two things" are two besides the one that they are put on.
            there = [Noun(words=(name.text,)) for name in ground(place.thing, self._names).names]
            noun = replace(noun, excluded=(*noun.excluded, *there))
        found = ground(noun, self._names)
        self._check_refs(found.noun)
        if found.noun.words[-1] in GENERIC and place is not None:
            found = self._without(found, place)
        if not found.noun.plural or found.is_settled:
            return [self.since_moved(found).text]
        chosen, number = found.noun, found.noun.number
        dynamic = tuple(out for out in chosen.excluded if not out.is_named)
        if not (chosen.ranking or chosen.relation or dynamic):
            return [f"the {name.text}" for name in found.names]
        if dynamic and not chosen.ranking and not chosen.relation:
            chosen, number = self._opposite(found, dynamic), len(found.names) - len(dynamic)
        if number is None:
            raise NotUnderstood(f"how many are {str(noun)!r}? Say a number")
        chosen = replace(chosen, plural=False, number=None, exact=False, indefinite=False)
        if place is None:
            return [str(chosen)] * min(number, 2)
        there = self._relation(place)
        return [self._nth(replace(found, noun=chosen), index, there) for index in range(number)]

    def _nth(self, found: Found, index: int, there: Relation) -> str:
        """What is described, among those that were not moved yet."""
        if index == 0:
            return self.since_moved(found).text
        return str(replace(found.noun, moved=((index, there),)))

    def _opposite(self, found: Found, excluded: tuple[Noun, ...]) -> Noun:
        """ "All but the leftmost" as the rightmost, again and again."""
        key = excluded[0].ranking.key if len(excluded) == 1 and excluded[0].ranking else ""
        if key not in _OPPOSITE or excluded[0].ranking is None or excluded[0].ranking.rank != 1:
            if len(found.names) - len(excluded) == 1:
                return found.noun
            out = ", ".join(map(str, excluded))
            raise NotUnderstood(
                f"once one of several is moved, {out!r} cannot be told any more; name those that are meant"
            )
        named = tuple(out for out in found.noun.excluded if out.is_named)
        return replace(found.noun, excluded=named, ranking=replace(excluded[0].ranking, key=_OPPOSITE[key]))

    def _without(self, found: Found, place: Place) -> Found:
        """Without the destination: "put everything in the basket"."""
        there = {name.text for name in ground(place.thing, self._names).names} if not is_table(place.thing) else set()
        if place.second is not None:
            there |= {name.text for name in ground(place.second, self._names).names}
        left = tuple(name for name in found.names if name.text not in there)
        out = tuple(Noun(words=(name.text,)) for name in found.names if name.text in there)
        if not left:
            raise NotUnderstood(f"{str(found.noun)!r} leaves nothing to put there")
        return replace(found, names=left, noun=replace(found.noun, excluded=(*found.noun.excluded, *out)))

    def _check_refs(self, noun: Noun) -> None:
        for ref in refs_of(noun):
            if not is_table(ref):
                self._check_refs(ground(ref, self._names).noun)

    def since_moved(self, found: Found) -> Found:
        """The object described so that the description holds now, after what was moved."""
        for moved, place, count in self._moved:
            if (
                found.is_settled
                or found.noun.plural
                or not set(moved.names[:1] if moved.is_settled else moved.names) & set(found.names)
            ):
                continue
            if moved.is_settled:
                found = self._without_name(found, moved.names[0])
                continue
            if _bare(moved.noun) == _bare(found.noun):
                if not is_table(place.thing) and ground(place.thing, self._names).names == found.names:
                    return self._stacked(found, place, "top")
                relation = self._relation(place)
                return replace(found, noun=replace(_plain(found.noun), relation=relation))
            found = self._among_others(found, moved, place, count)
        return found

    def while_held(self, found: Found, thing: Noun) -> Found:
        """A place described so that the description holds while an object that would fit it too is carried there."""
        held = ground(thing, self._names)
        if found.is_settled or not set(held.names) & set(found.names):
            return found
        if held.is_settled:
            return self._without_name(found, held.names[0])
        if held.noun.plural:
            raise NotUnderstood(f"{str(thing)!r} are carried one by one, and {str(found.noun)!r} changes its meaning")
        if self._since(found):
            return found
        noun, ranking = found.noun, found.noun.ranking
        if held.names == found.names:
            ranking = _among_rest(ranking, held.noun.ranking, len(found.names))
        elif ranking and (ranking.key == "middle" or abs(ranking.rank) != 1):
            raise NotUnderstood(f"once {thing} is carried, {str(noun)!r} cannot be told any more")
        excluded = tuple(out for out in noun.excluded if _bare(out) != _bare(held.noun))
        moved = (*noun.moved, (1, _IN_HAND))
        if len(found.names) - sum(count for count, _ in moved) == 1:
            return replace(found, noun=replace(_plain(noun), moved=moved))
        return replace(found, noun=replace(noun, ranking=ranking, excluded=excluded, moved=moved))

    def _since(self, found: Found) -> bool:
        """Whether it is described by where it was put."""
        places = [self._relation(place) for _, place, _ in self._moved]
        return found.noun.relation in [*places, *(Relation(kind="outside", refs=place.refs) for place in places)]

    def _without_name(self, found: Found, gone: Name) -> Found:
        """Another object than one that was moved and has a name of its own."""
        noun = found.noun
        if noun.ranking and (noun.ranking.key == "middle" or abs(noun.ranking.rank) != 1):
            raise NotUnderstood(f"once {gone.text} is moved, {str(noun)!r} cannot be told any more")
        left = tuple(name for name in found.names if name != gone)
        if not left:
            return found
        excluded = (*noun.excluded, Noun(words=(gone.text,)))
        return Found(replace(noun, excluded=excluded), left)

    def _among_others(self, found: Found, moved: Found, place: Place, count: int) -> Found:
        """Another object than those that were moved."""
        noun, there = found.noun, self._relation(place)
        if self._is(place.thing, found):
            return self._stacked(found, place, "bottom")
        excluded = tuple(out for out in noun.excluded if _bare(out) != _bare(moved.noun))
        gone = (*noun.moved, (count, there))
        if len(found.names) - sum(number for number, _ in gone) == 1:
            noun = replace(_plain(noun), moved=gone)
            if gone == ((1, there),) and place.relation not in BESIDE | {"between", "center"}:
                noun = replace(noun, moved=(), relation=Relation(kind="outside", refs=(place.thing,)))
            return replace(found, noun=noun)
        ranking = noun.ranking
        if moved.names != found.names and ranking and (ranking.key == "middle" or abs(ranking.rank) != 1):
            raise NotUnderstood(f"once {moved.noun} is moved, {str(noun)!r} cannot be told any more")
        for _ in range(count if moved.names == found.names else 0):
            ranking = _among_rest(ranking, moved.noun.ranking, len(found.names))
        return replace(found, noun=replace(noun, excluded=excluded, ranking=ranking, moved=gone))

    def _is(self, noun: Noun, found: Found) -> bool:
        """Whether two descriptions are the same."""
        return not is_table(noun) and _bare(ground(noun, self._names).noun) == _bare(found.noun)

    def _stacked(self, found: Found, place: Place, key: str) -> Found:
        """The upper or lower one of two equal objects that were stacked."""
        if len(found.names) != 2 or place.relation not in {"on", "in", "top_of"}:
            raise NotUnderstood(f"once two of them are together, {str(found.noun)!r} cannot be told any more")
        return replace(found, noun=replace(_plain(found.noun), ranking=Ranking(key=key)))

    def _relation(self, place: Place) -> Relation:
        """Where an object is that was put at a place."""
        refs = (place.thing,) if place.second is None else (place.thing, place.second)
        return Relation(kind=place.relation, refs=refs)


def _plain(noun: Noun) -> Noun:
    return replace(noun, ranking=None, relation=None, excluded=(), plural=False, number=None, exact=False)


def _bare(noun: Noun) -> Noun:
    """What identifies an object, number and determiner aside."""
    return replace(noun, plural=False, number=None, exact=False, said=False, words=noun.words[-1:])


def _among_rest(ranking: Ranking | None, gone: Ranking | None, count: int) -> Ranking | None:
    """The rank among what is left, where another one is gone."""
    if ranking is None or gone is None:
        return ranking
    if ranking.key == gone.key and ranking.rank > gone.rank > 0:
        return replace(ranking, rank=ranking.rank - 1)
    if ranking.key == "middle" and count == 3 and gone.key in {"left", "right", "front", "back"}:
        # Of three in a row with one end gone, the middle one is at that end.
        return replace(gone, rank=1)
    if gone.key == "middle" and abs(ranking.rank) == 1 and ranking.key != "middle":
        return ranking
    if ranking.key == "middle" or gone.key == "middle":
        raise NotUnderstood(f"once one of {count} is moved, which is in the middle cannot be told any more")
    if (
        _OPPOSITE.get(ranking.key) == gone.key
        and ranking.rank > 0
        and gone.rank > 0
        and ranking.rank > count - gone.rank + 1
    ):
        return replace(ranking, rank=ranking.rank - 1)
    return ranking
