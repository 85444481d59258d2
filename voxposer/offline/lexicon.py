"""The vocabulary of the offline writer: function words, verbs, numbers and units, by what they mean.

Tables only. Names of objects are not here: a word that no table has is taken for a part of a name, and is refused, and
quoted, where no object of the scene is called so.
"""

from __future__ import annotations

from collections.abc import Mapping


def words(text: str) -> tuple[str, ...]:
    """The words of a text."""
    return tuple(text.split())


def phrases(text: str) -> frozenset[tuple[str, ...]]:
    """Phrases that are separated by bars or new lines, each as its words."""
    return frozenset(tuple(phrase.split()) for phrase in text.replace("\n", "|").split("|"))


# -- verbs -------------------------------------------------------------------------------------------------------------

# Action -> verbs that mean it, in the base form.
_VERBS: Mapping[str, str] = {
    "put": """put place set drop deposit move bring transfer lay toss throw stick carry relocate shift insert position
    return stow store dump load deliver chuck pop plop""",
    "pick": "pick grab grasp lift take get fetch raise seize collect hold",
    "push": "push slide shove nudge",
    "stack": "stack pile",
    "open": "open",
    "close": "close shut",
    "turn": "turn switch",
    "turn_on": "light ignite activate",
    "turn_off": "extinguish deactivate",
    "pull": "pull",
    "leave": "leave",
    "keep": "keep",
    "touch": "touch bump hit disturb knock brush contact",
    "avoid": "avoid",
}
# Forms that the rules for -ing and -ed do not give.
_IRREGULAR: Mapping[str, str] = {
    "putting": "put",
    "setting": "set",
    "laid": "lay",
    "threw": "throw",
    "thrown": "throw",
    "stuck": "stick",
    "brought": "bring",
    "taken": "take",
    "took": "take",
    "got": "get",
    "gotten": "get",
    "getting": "get",
    "held": "hold",
    "slid": "slide",
    "shutting": "shut",
    "left": "leave",
    "kept": "keep",
    "hitting": "hit",
    "dropping": "drop",
    "dropped": "drop",
    "grabbing": "grab",
    "grabbed": "grab",
    "stowed": "stow",
    "transferring": "transfer",
    "transferred": "transfer",
}
VERBS: Mapping[str, str] = {verb: action for action, verbs in _VERBS.items() for verb in verbs.split()}


def _forms(verb: str) -> tuple[str, str]:
    stem = verb[:-1] if verb.endswith("e") else verb
    past = f"{verb[:-1]}ied" if verb.endswith("ry") else f"{stem}ed"
    return f"{stem}ing", past


# Every form of a verb -> its base.
GERUNDS: Mapping[str, str] = {_forms(verb)[0]: verb for verb in VERBS} | {
    form: verb for form, verb in _IRREGULAR.items() if form.endswith("ing")
}
PARTICIPLES: Mapping[str, str] = (
    {_forms(verb)[1]: verb for verb in VERBS if verb not in _IRREGULAR.values() or verb in {"stow"}}
    | {verb: verb for verb in ("put", "set", "shut", "hit")}
    | {form: verb for form, verb in _IRREGULAR.items() if not form.endswith("ing")}
)
# Particles of verbs; "on", "off" and "open" say what becomes of the object.
PARTICLES = frozenset(["up", "down", "over", "back", "away", "out"])
STATES: Mapping[str, str] = {
    "on": "on",
    "off": "off",
    "open": "open",
    "opened": "open",
    "closed": "close",
    "shut": "close",
}
# Which of several drawers or doors, by its state.
OPENED: Mapping[str, str] = {"open": "open", "opened": "open", "closed": "closed", "shut": "closed"}

# -- around a sentence -------------------------------------------------------------------------------------------------

# Said before an order; removed, the longest first.
POLITE = phrases(
    """would you mind|would you be so kind as to|would you be able to|could you be so kind as to
    can you|could you|would you|will you|i want you to|i need you to|i would like you to|i'd like you to|we need you to
    you should|you must|you need to|you have to|you can|you may|you are to|your task is to|your job is to|please
    please to|kindly|only|if you can|if possible|if you like|if you please
    make sure to|make sure that you|be sure to|try to|go ahead and|go and|proceed to|start by|begin by|let us|let's
    remember to|hey robot|robot|hey|ok|okay|hi|hello|now|just|simply|so|well|also|help me|help me to|i want to
    i would like to|i'd like to|let me see you|it is time to|it's time to|your goal is to
    it would be great if you could|it would be nice if you could|i would appreciate it if you could
    i would be grateful if you could|make sure that|make sure|ensure that|see to it that|if you could
    i would appreciate it if you would"""
)
# Said after or amid an order, and without a meaning of its own here.
FILLERS = phrases(
    """please|kindly|thank you|thanks|for me|again|instead|too|as well|right now|now|right away
    immediately|at once|one after the other|one after another|one by one|one at a time|together|neatly|properly|directly
    if you can|if possible|if you please|will you|would you|could you|can you|this time|completely|fully|all the way
    afterwards|just|simply|straight|right there|safely|of course|thank you very much|thanks a lot|many thanks
    thank you so much|mate|buddy|my friend|robot|if you do not mind|if that is ok|if it is possible
    on your own|at the end|while doing so|while doing this|while doing that|in the process|meanwhile|if you would
    if you could"""
)
# Between clauses; all mean that what follows is done next.
THEN = phrases(
    """and then|then|after that|after this|afterwards|afterward|and after that|and afterwards|next
    and next|finally|and finally|lastly|and lastly|last|first|firstly|first of all|second|secondly|thirdly|third
    subsequently|later|and later|to begin with|to start with|once that is done|once done|when that is done
    when you are done|when done|once you are done|in the end|at last|followed by|and also|but|but first|and
    while you are at it|at the same time|while you|before anything else|before all else|above all|last of all
    and last of all"""
)
BEFORE = ("before", "prior to")
AFTER = ("after", "once", "as soon as", "when", "having", "after having", "only after", "only once", "only when")
# Modal verbs and what else stands between a subject and what is to become of it.
MODALS = phrases(
    """should now|should|must|shall|ought to|needs to|need to|has to|have to|is to|are to|is supposed to
    are supposed to|is meant to|are meant to|had better|is required to|has got to|will|would|may|might|can|could"""
)
GOES = frozenset(
    ["goes", "go", "belongs", "belong", "sits", "sit", "stands", "stand", "ends", "end", "rest", "rests", "lie"]
)
QUESTIONS = frozenset(
    words("is are was were do does did what where which who why how when whose has have am isn't aren't")
)
# Said behind alternatives: any of them will do.
INDIFFERENT = phrases(
    """i do not care|i do not mind|it does not matter|does not matter|whichever you like|whichever you prefer
    whichever you want|whichever one you like|as you like|either is fine|either one is fine|any is fine|both are fine
    up to you|your choice|you choose"""
)
# Said where a speaker corrects what was said just before.
CORRECTIONS = phrases(
    """sorry|no sorry|oh sorry|no wait|wait no|wait|i mean|no i mean|i meant|no i meant|or rather|make that|no make that
    correction|no|oh no|actually|no actually|actually no|or actually|scratch that|forget that"""
)
NEGATIONS = (
    "do not",
    "don't",
    "dont",
    "never",
    "avoid",
    "must not",
    "mustn't",
    "should not",
    "shouldn't",
    "you must not",
)

SPEEDS: Mapping[str, float] = {
    **dict.fromkeys(words("slowly carefully gently cautiously softly slow careful gentle delicately"), 0.5),
    **dict.fromkeys(words("quickly fast rapidly swiftly quick hurriedly"), 1.5),
}

# -- prepositions ------------------------------------------------------------------------------------------------------

# Relation -> phrases; the longest phrase that fits is taken.
_PREPOSITIONS: Mapping[str, str] = {
    "center": """at the center of|at the centre of|in the center of|in the centre of|in the middle of|at the middle of
    from the center of|from the middle of|from the centre of""",
    "top_of": "on top of|on the top of|to the top of|to top of|onto the top of|onto top of|atop|on to the top of",
    "left_of": """to the left of|on the left of|at the left of|left of|to left of|to the left side of
    on the left side of|at the left side of|left to|left from|to the left from|on the left from""",
    "right_of": """to the right of|on the right of|at the right of|right of|to right of|to the right side of
    on the right side of|at the right side of|right from|to the right from|on the right from""",
    "front_of": "in front of|to the front of|at the front of|to front of|on the front of",
    "back_of": "behind|to the back of|at the back of|in back of|at the rear of|to the rear of",
    "near": """next to|adjacent to|close to|near to|beside|alongside|near|nearby|by the side of|by|right next to
    to the side of|at the side of""",
    "outside": "outside of|outside|not in",
    "in": "inside of|inside|into|within|in to|in",
    "on": "onto|upon|on to|on",
    "under": "underneath|under|below|beneath",
    "between": "in between|between",
    "from": "out of|off of|off|from inside|from within|from on|from",
    "towards": "towards|toward",
    "to": "over to|up to|to",
}
PREPOSITIONS: Mapping[tuple[str, ...], str] = {
    tuple(phrase.split()): relation
    for relation, phrases in _PREPOSITIONS.items()
    for phrase in phrases.replace("\n", "|").split("|")
}

# -- descriptions ------------------------------------------------------------------------------------------------------

ARTICLES = frozenset(["the", "that", "this", "these", "those", "its", "their", "my", "your", "our"])
INDEFINITE = frozenset(["a", "an", "any", "some", "either", "whichever", "another"])
ALL = frozenset(["all", "every", "each"])
NUMBERS: Mapping[str, int] = {
    word: number
    for number, word in enumerate(
        words("zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen")
    )
} | {"twenty": 20, "thirty": 30, "twenty-five": 25, "couple": 2}
_ORDINALS = words("first second third fourth fifth sixth seventh eighth ninth tenth")
ORDINALS: Mapping[str, int] = {
    **{word: number for number, word in enumerate(_ORDINALS, 1)},
    **{"1st": 1, "2nd": 2, "3rd": 3, "4th": 4, "5th": 5, "last": -1},
}
# Centimetres of a unit.
UNITS: Mapping[str, float] = {
    **dict.fromkeys(words("cm cms centimetre centimetres centimeter centimeters"), 1.0),
    **dict.fromkeys(words("mm millimetre millimetres millimeter millimeters"), 0.1),
    **dict.fromkeys(words("m metre metres meter meters"), 100.0),
    **dict.fromkeys(words("inch inches"), 2.54),
    **dict.fromkeys(words("foot feet"), 30.48),
}
# Words that say which of several by their order along a direction; "upper" and the like are parts' names too.
SIDE_WORDS: Mapping[str, str] = {
    **{side: side for side in ("left", "right", "front", "back", "middle", "top", "bottom")},
    **{"rear": "back", "center": "middle", "centre": "middle", "central": "middle", "upper": "top", "lower": "bottom"},
}
# Superlatives and comparatives: word -> what they order by.
ORDERS: Mapping[str, str] = {
    **{
        f"{side}most": SIDE_WORDS[side]
        for side in ("left", "right", "front", "back", "rear", "top", "bottom", "upper", "lower")
    },
    **{f"{side}-most": SIDE_WORDS[side] for side in ("left", "right", "front", "back")},
    **{
        "uppermost": "top",
        "topmost": "top",
        "highest": "top",
        "lowest": "bottom",
        "higher": "top",
        "middlemost": "middle",
    },
    **{"hindmost": "back", "foremost": "front"},
    **dict.fromkeys(words("largest biggest larger bigger greatest"), "large"),
    **dict.fromkeys(words("smallest smaller littlest tiniest littler"), "small"),
    **dict.fromkeys(words("tallest taller"), "tall"),
    **dict.fromkeys(words("shortest shorter flattest flatter"), "short"),
    **dict.fromkeys(words("longest longer"), "long"),
}
SIZES: Mapping[str, str] = {
    "large": "large",
    "big": "large",
    "small": "small",
    "little": "small",
    "tall": "tall",
    "short": "short",
}
NEAREST = frozenset(["nearest", "closest", "nearer", "closer"])
FARTHEST = frozenset(["farthest", "furthest", "farther", "further"])
# Where an order starts, "the second from the left", and where a superlative leads, "the furthest to the right".
EXCEPTIONS = ("except for", "except", "apart from", "other than", "excluding", "besides", "but not", "but")
GENERIC = frozenset(words("object item thing everything anything stuff"))

# Every word that a table has: what a typing error can be one of.
KNOWN: frozenset[str] = frozenset(
    [
        *VERBS, *GERUNDS, *PARTICIPLES, *PARTICLES, *STATES, *GOES, *QUESTIONS, *SPEEDS, *ARTICLES, *INDEFINITE, *ALL,
        *NUMBERS, *ORDINALS, *UNITS, *SIDE_WORDS, *ORDERS, *SIZES, *NEAREST, *FARTHEST, *GENERIC, *BEFORE, *AFTER,
        *(f"{word}s" for word in GENERIC),
        *(word for table in (POLITE, FILLERS, THEN, MODALS, PREPOSITIONS) for phrase in table for word in phrase),
        *(word for phrase in EXCEPTIONS for word in phrase.split()),
        *words("both it them they which that who whose and or not without while between other others one ones is are"),
    ]
)  # fmt: skip
