"""Which entity names a noun phrase can mean.

A list of entity names, as the ``objects = [...]`` line of a prompt gives them (``akita_black_bowl_1``,
``wooden_cabinet_1_top_handle``), and the words of a phrase ("the black bowl") come in; the names that fit go out. No
task and no position is known here: a phrase that fits several names stays ambiguous and is resolved by generated code.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from vecenv.errors import InvalidInput


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


COLOURS = _words("black white red green blue yellow orange brown purple pink grey silver golden cyan")
# Words that tell several equal objects apart by position; they also occur in part names (top_drawer, back_compartment).
SIDES = _words("left right front back middle top bottom upper lower")
# Words for parts of an object. Only a phrase with such a word can mean a part.
PART_WORDS = _words("handle drawer knob button burner compartment section slot level inside door")
# Words of descriptions that say no object: what a typing error can be one of, besides the words of the scene.
KINDS = COLOURS | SIDES | PART_WORDS
# Words for packaging and make; they may be missing from the name.
_PACKAGES = _words("box can bottle carton pack package packet container jar tin bar")
_MAKES = _words("wine wooden wood flat desk coffee akita porcelain glazed rim kitchen small big bigger new")
# Word in a name -> other words that an instruction may use for it.
_SENSES = {
    "porcelain": ("white",),
    "cookie": ("box", "biscuit", "food"),
    "frypan": ("pan", "skillet"),
    "mug": ("cup",),
    "cup": ("mug",),
    "shelf": ("cabinet", "bookshelf"),
    "caddy": ("organizer", "organiser"),
    "cabinet": ("cupboard",),
    "stove": ("stovetop", "hob"),
    "block": ("cube",),
    "cube": ("block",),
    "cloth": ("towel",),
    "towel": ("cloth",),
    "basket": ("bin",),
    "knob": ("button",),
    "compartment": ("section",),
    "handle": ("door", "drawer"),
    "level": ("shelf",),
    "upper": ("top",),
    "lower": ("bottom",),
    # What they are packed in, or are.
    "soup": ("can", "tin", "food"),
    "tomato": ("can", "tin", "food"),
    "ketchup": ("bottle", "sauce", "food"),
    "bbq": ("barbecue", "bottle", "food"),
    "dressing": ("bottle", "food"),
    "milk": ("carton", "drink", "food"),
    "juice": ("carton", "drink", "food", "oj"),
    "cheese": ("box", "food"),
    "butter": ("box", "food"),
    "pudding": ("box", "dessert", "food"),
    "apple": ("fruit", "food"),
    "orange": ("fruit", "food"),
    "banana": ("fruit", "food"),
    "carrot": ("vegetable", "veggie", "food"),
    "eggplant": ("vegetable", "veggie", "aubergine", "food"),
    "coke": ("cola", "drink"),
    "pepsi": ("cola", "drink"),
    "7up": ("drink",),
    "sprite": ("drink",),
    "fanta": ("drink",),
    "redbull": ("drink",),
}
_IRREGULAR = {"shelves": "shelf", "knives": "knife", "boxes": "box", "dishes": "dish", "glasses": "glass"}
_NOT_PLURAL = _words("gas glass less plus lens alias themselves")


class NotUnderstood(InvalidInput):
    """The offline writer has no program for a query; the message quotes the words that it does not understand."""


@dataclass(frozen=True, kw_only=True)
class Name:
    """An entity name split into words.

    Attributes:
        text: the name itself, ``"wooden_cabinet_1_top_handle"``.
        whole: name of the object it is a part of; the name itself for a whole object.
        words: its words without instance numbers, singular.
        part_words: the words that name the part, empty for a whole object.
    """

    text: str
    whole: str
    words: tuple[str, ...]
    part_words: tuple[str, ...] = ()

    @property
    def is_part(self) -> bool:
        """Whether this names a part of another entity of the list."""
        return bool(self.part_words)

    @property
    def kind(self) -> tuple[str, ...]:
        """Words that instances of one category share."""
        return self.words

    @property
    def senses(self) -> frozenset[str]:
        """All words that an instruction may use for it."""
        return frozenset(self.words).union(*(_SENSES.get(word, ()) for word in self.words))

    @property
    def colours(self) -> frozenset[str]:
        """Colours in its name."""
        return self.senses & COLOURS


def singular(word: str) -> str:
    """A word without its plural ending: bowls -> bowl, cookies -> cookie."""
    if word in _IRREGULAR:
        return _IRREGULAR[word]
    if len(word) < 4 or word.endswith("ss") or word in _NOT_PLURAL or not word.endswith("s"):
        return word
    return word[:-1]


def name_words(text: str) -> tuple[str, ...]:
    """The words of an entity name, instance numbers dropped."""
    return tuple(singular(word) for word in re.split(r"[\s_]+", text.lower()) if word and not word.isdigit())


def read_names(texts: Sequence[str]) -> tuple[Name, ...]:
    """Entity names with their parts recognised: a part's name continues the name of its whole."""
    return tuple(_read_name(text, texts) for text in texts)


def _read_name(text: str, texts: Sequence[str]) -> Name:
    wholes = [other for other in texts if other != text and re.match(re.escape(other) + r"[_ ]", text)]
    whole = min(wholes, key=len, default=text)
    part = name_words(text[len(whole) :]) if whole != text else ()
    return Name(text=text, whole=whole, words=name_words(text), part_words=part)


def matching(words: Iterable[str], names: Sequence[Name]) -> tuple[Name, ...]:
    """The names that a phrase with these content words can mean.

    A name itself means that name. A phrase with a part word ("drawer", "knob") means a part if one fits, any other
    phrase means whole objects. All words must fit. Where no name fits, words for packaging and make are ignored ("the
    cream cheese box", "the wine bottle" for a ``white_bottle_1``), never colours nor the noun itself. Of the names that
    fit, those with the fewest colours that were not said are kept: "the white mug" is not ``white_yellow_mug_1`` beside
    ``porcelain_mug_1``.
    """
    said = tuple(singular(word) for word in words)
    exact = tuple(name for name in names if name.text.lower() in {"_".join(said), " ".join(said)})
    if exact:
        return exact
    of_part = bool(PART_WORDS.intersection(said))
    preferred = [name for name in names if name.is_part == of_part]
    others = [name for name in names if not name.is_part] if of_part else []
    for attempt in _looser_and_looser(said):
        for group in (preferred, others):
            found = [name for name in group if attempt and set(attempt) <= name.senses]
            if found:
                return _closest(said, found)
    return ()


def _looser_and_looser(said: tuple[str, ...]) -> Iterable[tuple[str, ...]]:
    yield said
    if len(said) > 1:
        yield (*(word for word in said[:-1] if word not in _MAKES), said[-1])
        unpacked = tuple(word for word in said if word not in _PACKAGES)
        yield unpacked if set(unpacked) - _MAKES else ()


def _closest(said: Sequence[str], found: Sequence[Name]) -> tuple[Name, ...]:
    def surplus(name: Name) -> tuple[int, int]:
        unsaid = len(name.colours - set(said)) if COLOURS & set(said) else 0
        return unsaid, sum(word not in name.words for word in said)

    best = min(map(surplus, found))
    return tuple(name for name in found if surplus(name) == best)
