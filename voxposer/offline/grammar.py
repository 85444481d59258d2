"""From an instruction to actions: clauses in the order of doing, pronouns resolved, omitted words filled in.

English comes in ("take the black bowl from the top drawer, put it on the plate, and then close the drawer"); an
:class:`~voxposer.offline.meaning.Instruction` goes out. Positions are not known here. The names of the scene's objects
may be given; they only decide what "one" stands for in "the red one", and which of several earlier objects is meant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from voxposer.offline import mentions
from voxposer.offline.clause import Clause, Group
from voxposer.offline.clauses import read_clauses
from voxposer.offline.grounding import ground, is_table
from voxposer.offline.meaning import BESIDE, Action, Avoidance, Condition, Instruction, Noun, Place, Ranking, Relation
from voxposer.offline.mentions import BEARERS, VERBS_SAID, carrying, described_words, inner_nouns
from voxposer.offline.names import Name, NotUnderstood, matching, read_names
from voxposer.offline.nouns import PLACES, Phrase, qualified, read_noun_phrase, read_phrase, read_phrases
from voxposer.offline.spelling import corrected
from voxposer.offline.tokens import Cursor, tokenize

_MOST_WORDS = 200  # longer texts are no instructions, and cost time


def read_instruction(text: str, objects: Sequence[str] = ()) -> tuple[Action, ...]:
    """The actions of an instruction, in the order in which they are to be done.

    Raises:
        NotUnderstood: a clause without a known verb, or with words left over.
    """
    return understand(text, objects).actions


def understand(text: str, objects: Sequence[str] = ()) -> Instruction:
    """All that an instruction says: actions, and what is to be avoided, left alone or kept.

    Args:
        text: the instruction.
        objects: names of the scene's objects.

    Raises:
        NotUnderstood: the message quotes what is not understood.
    """
    tokens = tokenize(text)
    if len(tokens) > _MOST_WORDS:
        raise NotUnderstood(f"{' '.join(tokens[:8])!r} ...: an instruction has at most {_MOST_WORDS} words")
    names = read_names(objects)
    tokens, slips = corrected(tokens, names)
    clauses, speed = read_clauses(tokens)
    if not clauses:
        raise NotUnderstood(f"no known verb at the beginning of {text.strip()[:80]!r}")
    return replace(_Reader(names).read(clauses, speed), slips=slips)


def read_noun(text: str) -> Noun:
    """A noun phrase with its qualifiers: "the black bowl between the plate and the ramekin".

    Raises:
        NotUnderstood: words that are no part of it.
    """
    cursor = Cursor(tokenize(text))
    noun = read_noun_phrase(cursor)
    if noun is not None:
        phrases = read_phrases(cursor, inner=True)
        noun = qualified(noun, phrases)
        behind = Cursor(["the", "thing", *cursor.tokens[cursor.at :]])
        more = read_noun_phrase(behind)
        if more is not None and behind.at_end and not more.ranking and not more.relation:
            noun = replace(noun, moved=(*noun.moved, *more.moved), excluded=(*noun.excluded, *more.excluded))
            cursor.at = len(cursor.tokens)
    if noun is None or not cursor.at_end:
        raise NotUnderstood(f"{text!r} cannot be parsed as a description of an object")
    return noun


def read_between(text: str) -> tuple[Noun, Noun]:
    """The two objects of "X and Y"."""
    phrase = read_phrase(Cursor(["between", *tokenize(text)]))
    if phrase is None or phrase.thing is None or phrase.second is None:
        raise NotUnderstood(f"{text!r} cannot be parsed as two objects")
    return phrase.thing, phrase.second


class _Reader:
    """Turns clauses into actions; keeps the objects that pronouns and omitted objects can refer to."""

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._picked: list[Noun] = []
        self._moved: list[Noun] = []
        self._fixture: Noun | None = None
        self._last: tuple[str, Place | None] = ("", None)
        self._mentions: list[Noun] = []
        self._places: list[Noun] = []
        self._phrase: Phrase | None = None
        self._put_on: Action | None = None
        self._actions: list[tuple[float, Action]] = []
        self._avoid: list[Avoidance] = []
        self._untouched: list[Noun] = []
        self._kept: list[tuple[str, Noun]] = []
        self._forbidden: list[Action] = []
        self._condition: Condition | None = None
        self._picked_if: Condition | None = None

    def read(self, clauses: Sequence[Clause], speed: float | None) -> Instruction:
        for clause in clauses:
            self._clause(clause)
        self._leave_picked(clauses[-1].when)
        if not self._actions:
            raise NotUnderstood(f"{clauses[0].said!r} says only what not to do")
        ordered = sorted(self._actions, key=lambda pair: pair[0])
        return Instruction(
            actions=tuple(action for _, action in ordered),
            avoid=tuple(self._avoid),
            speed=speed,
            untouched=tuple(self._untouched),
            kept=tuple(self._kept),
            forbidden=tuple(self._forbidden),
        )

    # -- clauses -------------------------------------------------------------------------------------------------------

    def _clause(self, clause: Clause) -> None:
        self._condition = self._conditioned(clause)
        if clause.forbidden:
            self._forbid(clause)
            return
        verb = self._last[0] if clause.verb in {"again", "same"} else clause.verb
        if not verb:
            raise NotUnderstood(f"no known verb at the beginning of {clause.said!r}")
        if verb == "avoid":
            self._avoid += [Avoidance(thing=noun, cm=clause.cm) for noun in self._moved_described(clause.groups)]
        elif verb == "untouched":
            self._untouched += self._moved_described(clause.groups)
        elif verb.startswith("keep_"):
            self._kept += [(verb.removeprefix("keep_"), noun) for noun in self._described(clause.groups)]
        elif verb in {"put", "stack", "push"}:
            self._put(verb, clause)
        elif verb == "pick" and self._picked and [noun and noun.is_pronoun for noun, _ in clause.groups] == [True]:
            return  # "hold on to it" adds nothing to what was picked up
        elif verb == "pick":
            self._leave_picked(clause.when)
            self._fixture = self._moved[-1] if self._moved else self._fixture
            self._picked, self._picked_if = self._described(clause.groups), self._condition
            self._rule_out(clause, self._picked)
        else:
            self._operate(verb, clause)
        if verb in VERBS_SAID:
            self._last = (verb, self._last[1])

    def _conditioned(self, clause: Clause) -> Condition | None:
        """The condition of a clause; what it is about is what "it" stands for in the clause."""
        spoken = clause.condition
        if spoken is None:
            return None
        if clause.forbidden or clause.verb in {"avoid", "untouched"} or clause.verb.startswith("keep_"):
            raise NotUnderstood(f"a condition of what not to do is not understood: {clause.said!r}")
        own = clause.groups[0][0] if clause.trails and clause.groups else None
        thing = self._thing(own if own is not None and spoken.thing.is_pronoun else spoken.thing)
        if not clause.trails and (self._condition is None or self._condition.thing != thing):
            self._mention(thing)
            self._fixture = thing
            self._moved = [thing] if spoken.place is not None else self._moved
        relation = qualified(Noun(words=("thing",)), [spoken.place]).relation if spoken.place is not None else None
        if relation is not None:
            relation = replace(relation, refs=tuple(map(self._thing, relation.refs)), negated=False)
        return Condition(thing=thing, state=spoken.state, relation=relation, negated=spoken.negated)

    def _described(self, groups: Sequence[Group]) -> list[Noun]:
        """Objects with all their phrases as their description."""
        found = []
        for noun, phrases in groups:
            if noun is None:
                raise NotUnderstood("the object is missing")
            noun = self._resolved(qualified(noun, list(phrases))) if not noun.is_pronoun else self._thing(noun)
            self._mention(noun)
            found.append(noun)
        return found

    def _moved_described(self, groups: Sequence[Group]) -> list[Noun]:
        """The same, where "it" is the object moved last rather than its place."""
        fixture = self._fixture
        self._fixture = (
            [*([fixture] if fixture else []), *self._moved, *self._picked][-1:][0]
            if fixture or self._moved or self._picked
            else None
        )
        found = self._described(groups)
        self._fixture = fixture
        return found

    def _forbid(self, clause: Clause) -> None:
        """What must not be done; it is read by a reader of its own, which knows what this one knows."""
        other = _Reader(self._names)
        other._picked, other._moved, other._fixture = list(self._picked), list(self._moved), self._fixture
        other._mentions, other._last = list(self._mentions), self._last
        clause.forbidden = False
        if clause.verb == "put" and not any(phrases for _, phrases in clause.groups):
            self._untouched += self._moved_described(clause.groups)
            return
        other._clause(clause)
        other._leave_picked(0.0)
        self._mentions = other._mentions
        self._forbidden += [action for _, action in other._actions]

    def _leave_picked(self, when: float) -> None:
        """Objects picked up and not put anywhere stay in the hand."""
        self._actions += [(when, Action(verb="pick", thing=noun, condition=self._picked_if)) for noun in self._picked]
        self._picked = []

    def _rule_out(self, clause: Clause, things: list[Noun]) -> None:
        """ "the yellow book, not the black one": what is ruled out is not meant."""
        for index, noun in enumerate(things):
            out = [other for other in clause.ruled_out if isinstance(other, Noun)]
            if out:
                things[index] = replace(
                    noun, excluded=(*noun.excluded, *(self._headed(other, [noun]) for other in out))
                )

    # -- what is meant -------------------------------------------------------------------------------------------------

    def _mention(self, noun: Noun) -> None:
        for part in inner_nouns(noun):
            if part not in self._mentions[-1:]:
                self._mentions.append(part)

    def _thing(self, noun: Noun | None) -> Noun:
        """What a pronoun or an omitted object stands for."""
        if noun is not None and not noun.is_pronoun:
            return self._resolved(noun)
        word = noun.words[0] if noun else ""
        if word in {"itself", "themselves"}:
            raise NotUnderstood(f"{word!r}: nothing can be put on or in {word}")
        if self._fixture is None:
            raise NotUnderstood(
                f"{word!r} refers to nothing said before" if noun else "the omitted object refers to nothing"
            )
        return self._fixture

    def _said(self, as_place: bool) -> list[Noun]:
        """The objects named so far, the latest first; places last where an object to act on is meant."""
        things = [noun for noun in self._mentions[::-1] if as_place or noun not in self._places]
        return [*things, *self._places[::-1]]

    def _resolved(self, noun: Noun, it: Noun | None = None, *, as_place: bool = False) -> Noun:
        """A description with "one", "other", "that ..." and the pronouns inside it resolved.

        Args:
            noun: the description.
            it: what "it" inside the description stands for; by default the last object that was moved or operated.
            as_place: whether it says where to put something.
        """
        if noun.words[-1] in {"one", "ones"} and not noun.is_pronoun:
            noun = self._headed(noun, [*(self._places[::-1] if as_place else ()), *self._said(as_place)])
        if noun.said and noun.is_bare:
            same = [mention for mention in self._mentions if mention.words[-1] == noun.words[-1]]
            return same[-1] if same else replace(noun, said=False)
        if noun.other:
            before = [mention for mention in self._mentions if mention.words[-1] == noun.words[-1]]
            if not before:
                raise NotUnderstood(f"{str(noun)!r}: other than which?")
            own = tuple(dict.fromkeys(replace(mention, plural=False) for mention in before))
            noun = replace(noun, other=False, excluded=(*noun.excluded, *own))
        if noun.is_bare and not noun.plural and not noun.indefinite:
            noun = self._recent(noun)
        return self._inside(noun, it)

    def _recent(self, noun: Noun) -> Noun:
        """ "The drawer" where one of several was named before: that one. Only of what is not put somewhere."""
        if not self._names or not matching(noun.words, self._names):
            return noun
        try:
            ground(noun, self._names)
        except NotUnderstood:
            fits = {name.text for name in matching(noun.words, self._names)}
            candidates = [*self._picked, *self._mentions]
            for mention in reversed(candidates):
                known = {name.text for name in matching(mention.words, self._names)}
                if known < fits and (all(name.is_part for name in matching(mention.words, self._names))):
                    return mention
        return noun

    def _inside(self, noun: Noun, it: Noun | None) -> Noun:
        """The objects that a description refers to, resolved."""

        def one(ref: Noun) -> Noun:
            if ref.words[-1] in {"one", "ones"} and not ref.is_pronoun:
                ref = self._headed(ref, [noun, *self._mentions[::-1]])
            if not ref.is_pronoun:
                return self._resolved(ref, it)
            return it if it is not None else self._antecedent(ref)

        if noun.ranking is not None and noun.ranking.ref is not None:
            noun = replace(noun, ranking=replace(noun.ranking, ref=one(noun.ranking.ref)))
        if noun.relation is not None:
            noun = replace(noun, relation=replace(noun.relation, refs=tuple(map(one, noun.relation.refs))))
        return noun

    def _antecedent(self, pronoun: Noun) -> Noun:
        known = [*self._moved[-1:], *([self._fixture] if self._fixture else []), *self._picked[-1:]]
        if not known:
            raise NotUnderstood(f"{pronoun.words[0]!r} refers to nothing said before")
        return known[-1]

    def _headed(self, noun: Noun, mentions: Sequence[Noun]) -> Noun:
        """ "The red one": with the noun of an earlier object in place of "one", the latest that makes sense."""
        if noun.words[-1] not in {"one", "ones"}:
            return noun
        own = set(noun.words[:-1])
        heads = [described_words(mention, own) for mention in mentions if not is_table(mention)]
        heads += [mention.words[-1:] for mention in mentions if not is_table(mention)]
        for head in dict.fromkeys(heads):
            option = replace(noun, words=(*noun.words[:-1], *head))
            if not self._names or self._fits(option):
                return option
        if not heads:
            raise NotUnderstood(f"{str(noun)!r}: one of what?")
        return replace(noun, words=(*noun.words[:-1], *heads[-1]))

    def _fits(self, noun: Noun) -> bool:
        try:
            ground(replace(noun, other=False, plural=True, number=None) if noun.other else noun, self._names)
        except NotUnderstood:
            return False
        return True

    # -- opening, closing, turning -------------------------------------------------------------------------------------

    def _operate(self, verb: str, clause: Clause) -> None:
        for noun, phrases in clause.groups:
            thing = self._thing(noun) if noun is None or noun.is_pronoun else self._resolved(qualified(noun, phrases))
            self._mention(thing)
            things = [thing]
            self._rule_out(clause, things)
            self._fixture = thing
            self._actions.append((clause.when, Action(verb=verb, thing=things[0], condition=self._condition)))

    # -- putting -------------------------------------------------------------------------------------------------------

    def _put(self, verb: str, clause: Clause) -> None:
        groups = [group for group in clause.groups if group != (None, [])] or clause.groups
        if any(noun is None and phrases for noun, phrases in groups[1:]):
            raise NotUnderstood(f"{clause.groups[0][0]} cannot be at two places: {clause.said!r}")
        placed: list[Action] = []
        for index, (noun, phrases) in enumerate(groups):
            place, describing = self._split(noun, phrases, groups[index + 1 :], clause)
            for thing in self._moving(noun, describing):
                self._mention(thing)
                placed.append(self._action(verb, thing, place, clause, placed))
        placed = mentions.stacked(placed) if verb == "stack" else mentions.together(placed)
        self._check_ruled_out(clause, placed)
        self._add(placed, clause.when)

    def _split(
        self, noun: Noun | None, phrases: Sequence[Phrase], later: Sequence[Group], clause: Clause
    ) -> tuple[Phrase | None, list[Phrase]]:
        """The phrase that says where to, and those that describe the object.

        The last phrase says where to; of an object without one, that of the next object ("put A and B in the basket").
        A last phrase such as "to its left" describes the object of the phrase before it.
        """
        if clause.way or (not phrases and not later):
            return None, list(phrases)
        if not phrases:
            return next((group[1][-1] for group in later if group[1]), None), []
        *before, last = phrases
        if before and last.kind in BESIDE and last.thing is not None and last.thing.is_pronoun and before[-1].thing:
            *before, last = [*before[:-1], replace(before[-1], thing=qualified(before[-1].thing, [last]))]
        sources = [phrase for phrase in before if phrase.kind in PLACES and phrase.kind in {"to", "towards"}]
        if sources:
            raise NotUnderstood(f"{str(noun)!r} cannot be at two places: {clause.said!r}")
        if last.kind == "from" and before:
            *before, last = [*before[:-1], last, before[-1]]
        return last, before

    def _moving(self, noun: Noun | None, describing: list[Phrase]) -> list[Noun]:
        """The objects to put: the noun's, else those picked up, else those put somewhere before."""
        if noun is not None and not noun.is_pronoun:
            thing = self._resolved(qualified(noun, describing))
            self._picked = [picked for picked in self._picked if picked != thing]
            return [thing]
        word = noun.words[0] if noun else ""
        if word in {"itself", "themselves", "there", "one", "each other"}:
            raise NotUnderstood(f"{word!r} refers to nothing said before")
        both = word in {"them", "they", "these", "those"}
        if both and not self._picked and len(self._moved) == 1 and self._put_on and self._put_on.place:
            # "Put A in B and put them in C": B goes to C first, then A to B again; a stack is not carried.
            return [self._put_on.place.thing, self._moved[0]]
        moving = self._picked or self._moved
        if not moving:
            missing = f"{word!r} refers to nothing: " if noun else ""
            raise NotUnderstood(f"{missing}the object to put there is missing")
        if self._picked and self._picked_if != self._condition:
            raise NotUnderstood(f"{self._picked[0]} is picked up under a condition, and put somewhere without it")
        self._picked = []
        return list(moving)

    def _action(self, verb: str, thing: Noun, phrase: Phrase | None, clause: Clause, placed: list[Action]) -> Action:
        if clause.way:
            if not clause.cm:
                raise NotUnderstood(f"how far to the {clause.way} is {thing} to go?")
            return Action(verb="shift", thing=thing, way=clause.way, cm=clause.cm)
        place = self._place(phrase, thing, placed, clause)
        if verb == "stack" and thing.plural:
            return Action(verb="stack", thing=thing, place=place)
        if place is None:
            raise NotUnderstood(f"the destination of {thing} is missing")
        return Action(verb="push" if verb == "push" else "put", thing=thing, place=place)

    def _place(self, phrase: Phrase | None, thing: Noun, placed: list[Action], clause: Clause) -> Place | None:
        if phrase is None:
            before = placed[-1].place if placed else None
            if before is not None and before.thing.words[-1:] == thing.words[-1:]:
                raise NotUnderstood(f"is {thing} to be moved too, or another place? {clause.said!r}")
            return self._last[1] if clause.verb in {"again", "same"} else before
        if phrase.thing is None and phrase.kind in BESIDE and not (placed and placed[-1].place):
            raise NotUnderstood(f"how far {phrase.said!r} is {thing} to go?")
        if phrase.kind == "there":
            if self._last[1] is None:
                raise NotUnderstood("'there' refers to nothing said before")
            return self._last[1]
        if phrase.kind not in PLACES or phrase.negated:
            raise NotUnderstood(f"'{phrase.said or phrase.kind}' is not a destination")
        second = self._resolved(phrase.second, thing) if phrase.second else None
        target = self._place_thing(phrase, thing, placed, clause)
        self._phrase = phrase
        self._mention(target)
        self._places.append(target)
        return Place(relation=phrase.kind, thing=target, second=second, cm=phrase.cm)

    def _place_thing(self, phrase: Phrase, thing: Noun, placed: list[Action], clause: Clause) -> Noun:
        """The object of a destination; "it" is what describes the object, or the last place or fixture."""
        noun = phrase.thing
        if noun is not None and not noun.is_pronoun:
            return self._resolved(noun, thing, as_place=True)
        if noun is not None and noun.words[0] == "each other":
            return noun
        if noun is None or noun.words[0] in {"it", "that", "this"}:
            if noun is not None and len(inner := inner_nouns(thing)) > 1:
                return inner[-2]
            before = placed[-1].place if placed else self._last[1] if clause.verb == "again" else None
            if before is not None and phrase is self._phrase:
                return before.thing
            last = self._moved_last(placed)
            bearing = {"on", "top_of", "in"} if last is not None and last.words[-1] in BEARERS else set()
            where = before.relation if before else self._last[1].relation if self._last[1] else ""
            if (
                noun is not None
                and where in bearing
                and phrase.kind in bearing - ({"top_of"} if where == "in" else set())
            ):
                if phrase.kind == "in" and last is not None and mentions.is_hollow(last) and where != "in":
                    return last
                raise NotUnderstood(f"'{phrase.said} {noun.words[0]}' could be {last} or what it is put on or in")
            if before is not None:
                return before.thing
            if self._fixture is None and self._mentions[:-1] and noun is not None:
                return self._mentions[-2]
        if noun is None and self._fixture is None:
            raise NotUnderstood(f"{phrase.said!r} what? The place for {thing} refers to nothing said before")
        return self._thing(noun)

    def _moved_last(self, placed: Sequence[Action]) -> Noun | None:
        return placed[-1].thing if placed else self._moved[-1] if self._moved else None

    def _check_ruled_out(self, clause: Clause, placed: list[Action]) -> None:
        """ ", not on the right plate": it must be another place than the one that is said."""
        for out in clause.ruled_out:
            if isinstance(out, Phrase) and out.thing is not None and out.kind in PLACES:
                places = [action.place for action in placed if action.place]
                noun = self._headed(out.thing, [place.thing for place in places])
                unclear = {out.kind, "near"} if out.kind in BESIDE else {out.kind}  # on which side is "next to"?
                if any(place.relation in unclear and (noun.is_pronoun or place.thing == noun) for place in places):
                    raise NotUnderstood(f"{clause.said!r} is ruled out by 'not {out.said} {noun}', or may be")
            elif isinstance(out, Noun):
                things = [action.thing for action in placed]
                self._rule_out(clause, things)
                placed[:] = [replace(action, thing=thing) for action, thing in zip(placed, things, strict=True)]

    def _add(self, actions: list[Action], when: float) -> None:
        actions = [replace(action, condition=self._condition) for action in actions]
        stack, self._put_on = self._put_on, None
        if stack is not None and stack.place is not None and [action.thing for action in actions] in carrying(stack):
            carry = replace(actions[0], thing=stack.place.thing)
            self._actions = [(at, action) for at, action in self._actions if action is not stack]
            actions = [carry, stack]
        elif len(actions) == 1 and actions[0].verb == "put":
            self._put_on = actions[0]
        self._moved = [action.thing for action in actions]
        places = [action.place for action in actions if action.place]
        if places:
            self._last = (self._last[0], places[-1])
            self._fixture = places[-1].thing
        self._actions += [(when, action) for action in actions]


__all__ = ["Noun", "Ranking", "Relation", "read_between", "read_instruction", "read_noun", "understand"]
