"""The offline writer on ordinary sentences: two sets with their expected outcomes, and any text at all."""

from __future__ import annotations

import ast
import collections
import contextlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.sentences import FILES, HALVES, Sentence, judge, load, snapshots

from voxposer.offline.grammar import read_noun, understand
from voxposer.offline.names import NotUnderstood
from voxposer.offline.planner_writer import write_planner

SENTENCES = {name: load(name) for name in FILES}
NAMES = [
    *("akita_black_bowl_1", "akita_black_bowl_2", "plate_1", "wine_bottle_1", "wooden_cabinet_1"),
    *(f"wooden_cabinet_1_{level}_{part}" for level in ("top", "middle", "bottom") for part in ("drawer", "handle")),
    *("wooden_cabinet_1_top", "flat_stove_1", "flat_stove_1_knob", "flat_stove_1_burner"),
]
# Words to make sentences of that are nearly understood.
WORDS = sorted(
    {word for listed in SENTENCES.values() for one in listed for word in one.say.lower().replace(",", " ,").split()}
)
# How many sentences of each half are understood at least: the tuned one, the one that was only scored.
LEAST = {"first": (0.95, 0.85), "second": (0.9, 0.85)}


@pytest.mark.parametrize(("name", "least", "each"), [("first", 200, 90), ("second", 150, 70)])
def test_sets_have_both_halves_and_no_sentence_twice(name: str, least: int, each: int) -> None:
    listed = SENTENCES[name]
    halves = collections.Counter(sentence.half for sentence in listed)
    assert len(listed) >= least
    assert all(halves[half] >= each for half in HALVES)
    assert len({(sentence.scene, sentence.say) for sentence in listed}) == len(listed)


def test_sentences_are_said_of_every_scene() -> None:
    assert {sentence.scene for listed in SENTENCES.values() for sentence in listed} == set(snapshots())


@pytest.mark.parametrize("name", FILES)
def test_sentences_come_to_what_they_mean_and_none_is_misunderstood(name: str) -> None:
    verdicts = [(sentence, judge(sentence)) for sentence in SENTENCES[name]]
    misunderstood = [
        (sentence.scene, sentence.say, verdict.detail)
        for sentence, verdict in verdicts
        if verdict.kind in {"wrong", "crash"}
    ]
    assert not misunderstood
    if name == "second":
        changed = [(one.say, one.so_far, verdict.kind) for one, verdict in verdicts if verdict.kind != one.so_far]
        assert not changed
    for half, least in zip(HALVES, LEAST[name], strict=True):
        kinds = [verdict.kind for sentence, verdict in verdicts if sentence.half == half]
        assert kinds.count("right") >= least * len(kinds)


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        (
            Sentence(scene="groceries", say="Put the milk in the basket.", then=(("in", "butter_1", "basket_1"),)),
            "wrong",
        ),
        (
            Sentence(scene="groceries", say="Put the milk in the basket.", then=(("near", "milk_1", "basket_1"),)),
            "wrong",
        ),
        (Sentence(scene="groceries", say="Put the milk in the basket.", refused=("milk",)), "wrong"),
        (Sentence(scene="groceries", say="Put the kiwi in the basket.", then=(("held", "milk_1"),)), "refused"),
        (Sentence(scene="groceries", say="Put the kiwi in the basket.", refused=("pear",)), "other reason"),
    ],
)
def test_the_judge_tells_what_is_not_as_expected(wrong: Sentence, kind: str) -> None:
    assert judge(wrong).kind == kind


def program(text: str) -> str | None:
    """The planner's program, or None for a refusal that gives a reason."""
    try:
        written = write_planner(text, NAMES)
    except NotUnderstood as error:
        reason = str(error).strip()
        if not reason:
            pytest.fail(f"no reason for refusing {text!r}")
        return None
    ast.parse(written)
    return written


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=400))
def test_any_text_is_planned_or_refused(text: str) -> None:
    program(text)


@settings(max_examples=400, deadline=None)
@given(st.lists(st.sampled_from(WORDS), max_size=25))
def test_any_words_are_planned_or_refused(words: list[str]) -> None:
    program(" ".join(words))


@settings(max_examples=300, deadline=None)
@given(st.text(max_size=60))
def test_any_phrase_is_parsed_or_refused(text: str) -> None:
    with contextlib.suppress(NotUnderstood):
        assert read_noun(text).words


@pytest.mark.parametrize(
    "text", ["", " ", ".", "\u200b", "put " * 5000, "x" * 100_000, "put the bowl on " + "the " * 150]
)
def test_empty_and_long_texts_are_refused(text: str) -> None:
    assert program(text) is None


@pytest.mark.parametrize(
    ("text", "quoted"),
    [
        ("put the teapot on the plate", "teapot"),
        ("juggle the bottle", "juggle"),
        ("put the bottle on the plate if it is full", "if it is full"),
        ("put the third bowl on the plate", "third"),
        ("put the bottle on the plate or on the stove", "or"),
        ("setze die Flasche auf den Teller", "setze"),
        ("put the bottle onto the Käsebrett", "käsebrett"),
        ("put both plates on the stove", "both plate"),
        ("put the left bowl and the bottle on the plate and the plate", "moved too"),
        ("put the bottle and the plate into themselves", "themselves"),
    ],
)
def test_a_refusal_quotes_the_words_that_are_not_understood(text: str, quoted: str) -> None:
    with pytest.raises(NotUnderstood, match=quoted):
        write_planner(text, NAMES)


@pytest.mark.parametrize(
    "phrase",
    [
        "the second bowl from the left",
        "the last bowl from the front",
        "the largest bowl",
        "the second tallest bowl",
        "the bowl nearest to the plate",
        "the second bowl farthest from the plate",
        "the bowl except the bowl on the left",
        "the bowl on the right besides the 1 on the plate_1",
        "the bowl nearest to the plate besides the 2 in the tray_1 besides the 1 on top of the stove",
        "the two smallest bowl",
    ],
)
def test_descriptions_written_out_are_parsed_to_the_same(phrase: str) -> None:
    noun = read_noun(phrase)
    assert str(noun) == phrase
    assert read_noun(str(noun)) == noun


@pytest.mark.parametrize(
    ("text", "meant", "slip"),
    [
        ("put the bottel on the plate", "put the bottle on the plate", "'bottel' is taken for 'bottle'"),
        ("put the bottle on the platte", "put the bottle on the plate", ""),
        ("put the wine botle on the plaate", "put the wine bottle on the plate", "'plaate' is taken for 'plate'"),
        ("open the botom drawer", "open the bottom drawer", "'botom' is taken for 'bottom'"),
        ("put the flat stoove on the plate", "", ""),
    ],
)
def test_words_with_one_wrong_letter_are_taken_for_what_they_are_near(text: str, meant: str, slip: str) -> None:
    written = program(text)
    if not slip:  # "platte" is in the dictionary, and a stove cannot be carried
        assert written is None
        return
    assert written is not None
    comments = [line for line in written.splitlines() if "is taken for" in line]
    assert f"# {slip}" in comments
    assert [line for line in written.splitlines() if line not in comments] == (program(meant) or "").splitlines()


@pytest.mark.parametrize("word", ["tower", "saucer", "clock", "plane", "stave", "pl", "bowlplate", "flasche"])
def test_other_words_than_typing_errors_are_refused_and_quoted(word: str) -> None:
    with pytest.raises(NotUnderstood, match=word):
        write_planner(f"put the {word} on the plate", [*NAMES, "towel", "tomato_sauce_1", "block"])


def test_without_a_dictionary_unknown_words_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("voxposer.offline.spelling._dictionary", lambda: None)
    assert program("put the botle on the plate") is None


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("put the bottle, sorry, the plate on the stove", "put the plate on the stove"),
        ("put the bottle on the plate, no wait, on the stove", "put the bottle on the stove"),
        ("open the top drawer. No, close the top drawer", "close the top drawer"),
        ("put the bottle on the plate or on the stove, I don't care which", "put the bottle on the plate"),
        ("put the bottle or the plate on the stove, either is fine", "put the bottle on the stove"),
        ("put neither the plate nor the bottle on the stove, but the left bowl", "put the left bowl on the stove"),
        ("the bottle, put it on the plate", "put the bottle on the plate"),
        ("put the bottle, not the plate, on the stove", "put the bottle on the stove"),
        ("put the bottle in front of the plate, 5 cm away from it", "put the bottle 5 cm in front of the plate"),
        ("move the bottle so that it is behind the plate", "put the bottle behind the plate"),
        ("pick up and place the bottle on the plate", "put the bottle on the plate"),
        ("open the drawer below the top one", "open the middle drawer"),
        ("put only the bottle on the plate and leave everything else alone", "put the bottle on the plate"),
        (
            "stack the bottle and the left bowl on the plate",
            "put the bottle on the plate and the left bowl on the bottle",
        ),
        ("put the small bowl on the plate", "put the smallest bowl on the plate"),
    ],
)
def test_two_ways_to_say_the_same(said: str, meant: str) -> None:
    assert write_planner(said, NAMES) == write_planner(meant, NAMES)


@pytest.mark.parametrize(
    ("text", "quoted"),
    [
        ("put the bottle on the plate, wait, turn on the stove first", "taken back"),
        ("put the bottle on the plate, sorry, the left bowl", "taken back"),
        ("if the top drawer is open, close it, then put the bottle on the plate", "does the condition hold"),
        ("put the bottle on the plate and turn on the stove if it is off", "which part"),
        ("if the bottle is green, put it on the plate", "the condition in"),
        ("otherwise put the bottle on the plate", "'otherwise' has no condition"),
        ("open the top drawer. If the top drawer is open, close it", "changed"),
        ("if the stove is on, turn it off. If the top drawer is open, close it", "more than one condition"),
        ("don't touch the bottle if the stove is on", "what not to do"),
        ("open the drawer", "could be any"),
        ("put the bottle in the drawer and close the top drawer", "more than one of them is spoken of"),
        ("put the plate in the bottle", "nothing can be put in the bottle"),
        ("put the bottle back", "'back' to where"),
        ("put neither the bottle nor the plate on the stove", "only what not to do"),
    ],
)
def test_what_is_not_clear_is_refused(text: str, quoted: str) -> None:
    with pytest.raises(NotUnderstood, match=quoted):
        write_planner(text, NAMES)


def test_conditions_and_what_is_presupposed_are_looked_at_before_anything_moves() -> None:
    told = {
        "if the top drawer is closed, open it": "if not detect('wooden_cabinet_1_top_handle').is_open:",
        "unless the stove is on, turn it on": "if not (detect('flat_stove_1_knob').is_open):",
        "put the bottle that is on the stove on the plate": "other = detect('flat_stove_1')",
        "close the open drawer": "drawer = drawers[0]",
    }
    for text, looked in told.items():
        lines = write_planner(text, NAMES).splitlines()
        motions = [index for index, line in enumerate(lines) if "composer(" in line]
        assert lines.index(looked) < motions[0], text


def test_order_words_change_the_order_of_doing() -> None:
    told = {
        "put the bottle on the plate after turning on the stove": ["turn_on", "put"],
        "before you turn on the stove, put the bottle on the plate": ["put", "turn_on"],
        "turn on the stove, but first put the bottle on the plate": ["put", "turn_on"],
        "turn on the stove. Before that, put the bottle on the plate": ["put", "turn_on"],
    }
    for text, verbs in told.items():
        assert [action.verb for action in understand(text, NAMES).actions] == verbs


def test_lengths_have_units() -> None:
    told = {
        "5 cm": 5,
        "5cm": 5,
        "an inch": 2.54,
        "two and a half inches": 6.35,
        "0.1 m": 10,
        "30 mm": 3,
        "half a foot": 15.24,
    }
    for length, cm in told.items():
        (action,) = understand(f"put the bottle {length} to the left of the plate", NAMES).actions
        assert action.place is not None
        assert action.place.cm == pytest.approx(cm)


def test_many_objects_make_a_short_program() -> None:
    names = [*(f"thing_{index}" for index in range(8)), "basket_1"]
    written = write_planner(
        "put everything in the basket", [f"red_{name}" if name != "basket_1" else name for name in names]
    )
    assert written.count("composer(") == 7
    assert "for thing in [" in written
