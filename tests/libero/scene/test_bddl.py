"""What the BDDL parser reads equals what upstream reads, and what it refuses is refused with the exact place."""

from __future__ import annotations

import contextlib
import io
import math
import pickle
import re
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vecenv.assets import libero_root
from vecenv.libero.scene import bddl_syntax
from vecenv.libero.scene.bddl import Instance, Predicate, Problem, Region, load_problem, parse_problem
from vecenv.libero.scene.bddl_syntax import BDDLError
from vecenv.libero.tasks.suites import list_suites

TASK_FILES = sorted((libero_root() / "bddl_files").rglob("*.bddl"))
SUITE_FILES = [path for path in TASK_FILES if path.parent.name in list_suites()]
OTHER_FILES = [path for path in TASK_FILES if path.parent.name not in list_suites()]
# The one shipped file that is refused: its y range runs from 0.225 to 0.205. It belongs to no registered suite.
REVERSED_RANGE = "libero_object_temp_y0.5/pick_up_the_cream_cheese_and_place_it_in_the_basket.bddl"

TEXT = """\
(define (problem Some_Problem) ; a comment ( with a parenthesis
  (:domain robosuite)
  (:language Put  the Bowl
     on the plate)
  (:regions
    (bowl_region
      (:target table_1)
      (:ranges ((-0.1 -.2 1e-1 0.2) (0 0 1 1)))
      (:yaw_rotation ((-pi/2 0)))
      (:rgba (1 0 0 0.5))
    )
    (top_side (:target cabinet_1))
    (left_region (:target nobody_1))
  )
  (:fixtures table_1 - table cabinet_1 - cabinet)
  (:objects bowl_2 bowl_1 - bowl plate_1 - plate)
  (:obj_of_interest bowl_1 cabinet_1_top_side)
  (:init (On bowl_1 table_1_bowl_region) (Open cabinet_1_top_side))
  (:goal (And (On bowl_1 plate_1) (TurnOff cabinet_1)))
)
"""

fuzz = settings(max_examples=150, deadline=timedelta(seconds=10), derandomize=True, database=None)


@pytest.fixture(scope="module")
def upstream() -> Callable[[Path], Problem]:
    """Upstream's own reading of a file, put into our dataclasses."""
    with contextlib.redirect_stdout(io.StringIO()):
        from libero.libero.envs.bddl_utils import get_problem_info, robosuite_parse_problem

    def read(path: Path) -> Problem:
        raw = robosuite_parse_problem(str(path))
        return Problem(
            name=raw["problem_name"],
            domain="robosuite",
            language=get_problem_info(str(path))["language_instruction"],
            regions=tuple(
                Region(
                    name=name,
                    target=region["target"],
                    ranges=tuple(tuple(rectangle) for rectangle in region["ranges"]),
                    yaw=tuple(region["yaw_rotation"]),
                    rgba=tuple(region["rgba"]),
                )
                for name, region in raw["regions"].items()
            ),
            fixtures=tuple(Instance(name, kind) for kind, names in raw["fixtures"].items() for name in names),
            objects=tuple(Instance(name, kind) for kind, names in raw["objects"].items() for name in names),
            obj_of_interest=tuple(raw["obj_of_interest"]),
            init=tuple(Predicate(name, tuple(args)) for name, *args in raw["initial_state"]),
            goal=tuple(Predicate(name, tuple(args)) for name, *args in raw["goal_state"]),
        )

    return read


# ---------------------------------------------------------------------------------------------------- real files


@pytest.mark.parametrize("suite", list_suites())
def test_every_task_file_of_the_suites_reads_as_upstream_reads_it(suite: str, upstream) -> None:
    paths = [path for path in SUITE_FILES if path.parent.name == suite]
    assert len(paths) == (90 if suite == "libero_90" else 10)
    for path in paths:
        problem = load_problem(path)
        assert problem == upstream(path)
        assert problem.source == str(path)


def test_every_other_shipped_task_file_reads_as_upstream_reads_it_but_for_one_reversed_range(upstream) -> None:
    refused = {}
    for path in OTHER_FILES:
        try:
            assert load_problem(path) == upstream(path)
        except BDDLError as error:
            refused[f"{path.parent.name}/{path.name}"] = (error.line, error.column, error.message)
    assert len(OTHER_FILES) == 434
    assert refused == {REVERSED_RANGE: (15, 48, "y runs from 0.225 to 0.205")}


def test_problems_are_values() -> None:
    assert parse_problem(TEXT, "a") == parse_problem(TEXT, "b")
    assert hash(parse_problem(TEXT)) == hash(parse_problem(TEXT))
    assert parse_problem(TEXT) != parse_problem(TEXT.replace("plate_1)", "bowl_2)"))


# ------------------------------------------------------------------------------------------------------ the dialect


def test_every_part_of_a_problem_is_read() -> None:
    assert parse_problem(TEXT, "some.bddl") == Problem(
        name="some_problem",
        domain="robosuite",
        language="put the bowl on the plate",
        regions=(
            Region(
                name="table_1_bowl_region",
                target="table_1",
                ranges=((-0.1, -0.2, 0.1, 0.2), (0.0, 0.0, 1.0, 1.0)),
                yaw=(-math.pi / 2, 0.0),
                rgba=(1.0, 0.0, 0.0, 0.5),
            ),
            Region("cabinet_1_top_side", "cabinet_1", (), (0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            Region("nobody_1_left_region", "nobody_1"),
        ),
        fixtures=(Instance("table_1", "table"), Instance("cabinet_1", "cabinet")),
        objects=(Instance("bowl_2", "bowl"), Instance("bowl_1", "bowl"), Instance("plate_1", "plate")),
        obj_of_interest=("bowl_1", "cabinet_1_top_side"),
        init=(Predicate("on", ("bowl_1", "table_1_bowl_region")), Predicate("open", ("cabinet_1_top_side",))),
        goal=(Predicate("on", ("bowl_1", "plate_1")), Predicate("turnoff", ("cabinet_1",))),
    )


def test_a_goal_may_be_a_single_predicate() -> None:
    text = TEXT.replace("(And (On bowl_1 plate_1) (TurnOff cabinet_1))", "(On bowl_1 plate_1)")
    assert parse_problem(text).goal == (Predicate("on", ("bowl_1", "plate_1")),)


def test_regions_and_objects_of_interest_may_be_absent() -> None:
    text = re.sub(r"\(:regions.*?\n  \)\n", "", TEXT, flags=re.DOTALL)
    text = text.replace("  (:obj_of_interest bowl_1 cabinet_1_top_side)\n", "")
    text = re.sub(r"\(:init.*\)", "(:init)", text)
    problem = parse_problem(text)
    assert (problem.regions, problem.obj_of_interest, problem.init) == ((), (), ())


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("pi", math.pi),
        ("np.pi", math.pi),
        ("-pi/2", -math.pi / 2),
        ("3*pi/4", 3 * math.pi / 4),
        ("+pi-1", math.pi - 1),
        ("1-2-3", -4.0),
        ("8/4/2", 1.0),
        ("1+2*3-4/2", 5.0),
        ("2*-3", -6.0),
        ("--1.5e0", 1.5),
        ("1e-3", 1e-3),
        ("PI", math.pi),
    ],
)
def test_yaw_bounds_may_be_arithmetic_with_pi(word: str, value: float) -> None:
    text = TEXT.replace("((-pi/2 0))", f"(({word} {word}))")
    assert parse_problem(text).regions[0].yaw == (value, value)


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_any_line_end_gives_the_same_problem_and_the_same_places(newline: str, tmp_path: Path) -> None:
    path = tmp_path / "task.bddl"
    path.write_bytes(TEXT.replace("\n", newline).encode())
    assert load_problem(path) == parse_problem(TEXT)
    path.write_bytes(TEXT.replace("(:init", "(:inti").replace("\n", newline).encode())
    with pytest.raises(BDDLError) as caught:
        load_problem(path)
    assert (caught.value.line, caught.value.column) == (18, 4)


def test_a_byte_order_mark_is_not_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "task.bddl"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.encode())
    assert load_problem(path) == parse_problem(TEXT)


# ----------------------------------------------------------------------------------------------------- malformed text

# (replace this once, by this with ^ where the error is reported, what was expected, what the message says)
MALFORMED = [
    ("(define", "^define", "'('", "found 'define'"),
    ("(define", "(^defin", "'define'", "found 'defin'"),
    ("(define", "(^() define", "'define'", "found a group"),
    ("1)))\n)\n", "1)))\n^", "')'", "the file ends inside the group opened at 1:1"),
    ("1)))\n)\n", "1)))\n)\n^)", "end of file", "found ')' after the end of (define ...)"),
    ("1)))\n)\n", "1)))\n)\n\t^more", "end of file", "found 'more' after the end of (define ...)"),
    ("(problem Some_Problem)", "^Some_Problem", "a section '(...)'", "found 'some_problem'"),
    ("(problem Some_Problem)", "(^)", "a section name", "found ')'"),
    ("(problem Some_Problem)", "(problem^)", "a problem name", "found ')'"),
    ("(problem Some_Problem)", "(problem ^(a))", "a problem name", "found a group (a ...)"),
    ("(problem Some_Problem)", "(problem a ^b)", "')'", "found 'b' after 'a'"),
    ("robosuite", "^igibson", "'robosuite'", "found 'igibson'"),
    ("(:domain", "(^:scene_properties", "one of problem,", "unknown section ':scene_properties'"),
    ("(:domain robosuite)", "(^(a))", "a section name", "found a group (a ...)"),
    ("(:objects", "(^:domain robosuite) (:objects", "each section once", "':domain' was already given at 2:3"),
    ("(:language Put  the Bowl\n     on the plate)", "(:language^)", "an instruction", "found ')'"),
    ("Bowl\n", "^(bowl)\n", "a word of the instruction", "found a group (bowl ...)"),
    ("(bowl_region", "^bowl_region (bowl_region", "a region '(name ...)'", "found 'bowl_region'"),
    ("(top_side (:target cabinet_1))", "(^)", "a region name", "found ')'"),
    ("(top_side (:target cabinet_1))", "(top_side^)", "'(:target ...)'", "region 'top_side' has no target"),
    ("(top_side (:target cabinet_1))", "(top_side (:target^))", "the name of an instance", "found ')'"),
    ("(top_side (:target cabinet_1))", "(top_side (:target a ^b))", "')'", "found 'b' after 'a'"),
    ("(top_side (:target cabinet_1))", "(top_side ^cabinet_1)", "a region attribute '(:name ...)'", "'cabinet_1'"),
    ("(top_side (:target", "(^bowl_region (:target table_1)) (top_side (:target", "an unused name", "declared at 6:6"),
    ("(:rgba", "(^:colour", "one of :target, :ranges, :yaw_rotation, :rgba", "unknown attribute ':colour'"),
    ("(:rgba", "(^:target table_1) (:rgba", "each attribute once", "':target' is given twice"),
    ("((-0.1 -.2 1e-1 0.2) (0 0 1 1))", "(^)", "a rectangle '(x0 y0 x1 y1)'", "found ')'"),
    ("((-0.1 -.2 1e-1 0.2) (0 0 1 1))", "^0.1", "a list of rectangles", "found '0.1'"),
    ("((-0.1 -.2 1e-1 0.2) (0 0 1 1))", "(^0 0 1 1)", "a rectangle '(x0 y0 x1 y1)'", "found '0'"),
    ("(0 0 1 1)", "(0 0 1^)", "4 numbers", "found 3"),
    ("(0 0 1 1)", "(0 0 1 1 ^1)", "4 numbers", "found 5"),
    ("(0 0 1 1)", "(0 0 ^-1 1)", "an upper bound not below the lower one", "x runs from 0 to -1"),
    ("(0 0 1 1)", "(0 0 1 ^-1)", "an upper bound not below the lower one", "y runs from 0 to -1"),
    ("(0 0 1 1)", "(0 ^zero 1 1)", "a finite number", "found 'zero'"),
    ("(0 0 1 1)", "(0 ^nan 1 1)", "a finite number", "found 'nan'"),
    ("(0 0 1 1)", "(0 0 1 ^1e999)", "a finite number", "found '1e999'"),
    ("(0 0 1 1)", "(0 0 1 ^(1))", "a number", "found a group (1 ...)"),
    ("((-pi/2 0))", "(^-pi/2 0)", "a list of one pair '((low high))'", "found '-pi/2'"),
    ("((-pi/2 0))", "(^)", "a list of one pair '((low high))'", "found ')'"),
    ("((-pi/2 0))", "((-pi/2 0) ^(0 0))", "')'", "found a group (0 ...) after a group (-pi/2 ...)"),
    ("((-pi/2 0))", "((-pi/2^))", "2 numbers", "found 1"),
    ("((-pi/2 0))", "((0 ^-pi/2))", "an upper bound not below the lower one", "yaw runs from 0 to -1.5708"),
    ("-pi/2", "^-pi/0", "arithmetic with pi", "found '-pi/0'"),
    ("-pi/2", "^-pi/", "arithmetic with pi", "found '-pi/'"),
    ("-pi/2", "^-2**2", "arithmetic with pi", "found '-2**2'"),
    ("-pi/2", "^pipi", "arithmetic with pi", "found 'pipi'"),
    ("-pi/2", "^-pi.real", "arithmetic with pi", "found '-pi.real'"),
    ("-pi/2", "^-1e999", "arithmetic with pi", "found '-1e999'"),
    ("-pi/2", "^__import__", "arithmetic with pi", "found '__import__'"),
    ("(1 0 0 0.5)", "(1 0 0^)", "4 numbers", "found 3"),
    ("(1 0 0 0.5)", "(1 0 0 ^1.5)", "a value from 0 to 1", "found '1.5'"),
    ("table_1 - table", "^- table", "an instance name", "found '-'"),
    ("table_1 - table", "table_1 - ^-", "a category", "found '-'"),
    ("table_1 - table", "table_1 - ^(table)", "an instance name", "found a group (table ...)"),
    ("cabinet_1 - cabinet)", "cabinet_1 -^)", "a category", "found ')'"),
    ("cabinet_1 - cabinet)", "cabinet_1^)", "'- category'", "'cabinet_1' has no category"),
    ("bowl_2 bowl_1 - bowl", "bowl_1 ^bowl_1 - bowl", "an unused name", "'bowl_1' was already declared at 16:13"),
    ("bowl_2 bowl_1 - bowl", "bowl_1 ^cabinet_1 - bowl", "an unused name", "'cabinet_1' was already declared at 15:30"),
    (
        "plate_1 - plate",
        "plate_1 - ^bowl",
        "all instances of a category in one run",
        "'bowl' was already used at 16:29",
    ),
    ("(left_region (:target nobody_1))", "(^1 (:target bowl))", "an unused name", "'bowl_1' was already declared"),
    ("interest bowl_1", "interest ^cup_1", "the name of an object, fixture or region", "'cup_1' is not declared"),
    ("interest bowl_1", "interest ^(bowl_1)", "the name of an object, fixture or region", "found a group"),
    ("(On bowl_1 table", "(On ^bowl_3 table", "the name of an object, fixture or region", "'bowl_3' is not declared"),
    ("table_1_bowl_region)", "^table_1_plate_region)", "the name of an object, fixture or region", "is not declared"),
    ("table_1_bowl_region)", "^nobody_1_left_region)", "the name of an object, fixture or region", "is not declared"),
    ("(On bowl_1 table", "^on (On bowl_1 table", "a predicate '(name argument ...)'", "found 'on'"),
    ("(Open cabinet_1_top_side)", "(^)", "a predicate '(name argument ...)'", "found ')'"),
    ("(Open cabinet_1_top_side)", "(^Opened cabinet_1_top_side)", "one of in, on,", "unknown predicate 'opened'"),
    ("(Open cabinet_1_top_side)", "(^Open bowl_1 bowl_2)", "1 argument", "'open' has 2"),
    ("(On bowl_1 plate_1)", "(^On bowl_1)", "2 arguments", "'on' has 1"),
    ("(On bowl_1 plate_1)", "(^True)", "1 or 2 arguments", "'true' has 0"),
    ("(On bowl_1 plate_1)", "(On bowl_1 ^plate_2)", "the name of an object, fixture or region", "'plate_2'"),
    ("(On bowl_1 plate_1)", "(^Not (On bowl_1 plate_1))", "a predicate over names", "nested 'not' is not supported"),
    ("(On bowl_1 plate_1)", "(^Forall (?x - bowl) (On ?x plate_1))", "a predicate over names", "nested 'forall'"),
    ("(:goal (And", "(:goal (^Or", "a predicate over names", "nested 'or' is not supported"),
    ("(And (On bowl_1 plate_1) (TurnOff cabinet_1))", "(And^)", "a predicate '(name argument ...)'", "found ')'"),
    ("(And (On bowl_1 plate_1) (TurnOff cabinet_1))", "^and", "one goal '(And ...)'", "found 'and'"),
    ("(And (On bowl_1 plate_1) (TurnOff cabinet_1))", "(^)", "one goal '(And ...)'", "found ')'"),
    ("(And (On bowl_1 plate_1) (TurnOff cabinet_1))", "^", "one goal '(And ...)'", "found ')'"),
    ("(:goal (And", "(:goal (On bowl_1 plate_1) ^(And", "')'", "found a group (and ...) after a group (on ...)"),
]


def marked(old: str, new: str) -> tuple[str, int, int]:
    """The text with one place rewritten, and the line and column of the ^ in what is put there."""
    assert old in TEXT
    with_mark = TEXT.replace(old, new, 1)
    before, after = with_mark.split("^")
    return before + after, before.count("\n") + 1, len(before.split("\n")[-1]) + 1


@pytest.mark.parametrize(("old", "new", "expected", "message"), MALFORMED)
def test_malformed_text_is_refused_where_it_is_malformed(old: str, new: str, expected: str, message: str) -> None:
    text, line, column = marked(old, new)
    with pytest.raises(BDDLError) as caught:
        parse_problem(text, "task.bddl")
    error = caught.value
    assert (error.source, error.line, error.column) == ("task.bddl", line, column)
    assert expected in error.expected
    assert message in error.message


@pytest.mark.parametrize("section", ["problem", ":domain", ":language", ":fixtures", ":objects", ":init", ":goal"])
def test_a_missing_section_is_named_at_the_end_of_the_problem(section: str) -> None:
    text = re.sub(rf"\({section} (?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)", "", TEXT)
    with pytest.raises(BDDLError) as caught:
        parse_problem(text)
    assert caught.value.message == f"the problem has no {section!r} section"
    assert caught.value.expected == f"'({section} ...)'"
    assert (caught.value.line, caught.value.column) == (text.rstrip().count("\n") + 1, 1)


def test_an_error_prints_like_a_compiler_message_and_survives_pickling() -> None:
    text, line, column = marked("(0 0 1 1)", "(0 0 1^)")
    with pytest.raises(BDDLError) as caught:
        parse_problem(text, "task.bddl")
    assert str(caught.value) == f"task.bddl:{line}:{column}: expected 4 numbers: found 3"
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_a_long_word_is_cut_in_messages() -> None:
    with pytest.raises(BDDLError) as caught:
        parse_problem(TEXT.replace("robosuite", "x" * 10_000))
    assert len(str(caught.value)) < 200


def test_bytes_that_are_not_utf8_are_refused_where_they_are(tmp_path: Path) -> None:
    path = tmp_path / "task.bddl"
    for mark in (b"", b"\xef\xbb\xbf"):
        path.write_bytes(mark + "(define\r\n  (:language é".encode() + b"\xff\xfe))")
        with pytest.raises(BDDLError) as caught:
            load_problem(path)
        assert str(caught.value) == f"{path}:2:15: expected UTF-8 text: found byte 0xff"


def test_text_beyond_the_size_limit_is_refused(tmp_path: Path) -> None:
    for padding, refused in ((bddl_syntax.MAX_CHARS - len(TEXT), False), (bddl_syntax.MAX_CHARS - len(TEXT) + 1, True)):
        path = tmp_path / f"{refused}.bddl"
        path.write_text(TEXT + " " * padding)
        with pytest.raises(BDDLError, match="at most") if refused else contextlib.nullcontext():
            load_problem(path)
    path.write_bytes(b"\xff" * (4 * bddl_syntax.MAX_CHARS + 1))
    with pytest.raises(BDDLError, match="at most"):
        load_problem(path)


def test_nesting_beyond_the_limit_is_refused_at_the_first_level_too_many() -> None:
    def nested(depth: int) -> str:
        return TEXT.replace("on the plate", "(" * (depth - 2) + "x" + ")" * (depth - 2))

    with pytest.raises(BDDLError, match="expected a word"):
        parse_problem(nested(bddl_syntax.MAX_DEPTH))
    with pytest.raises(BDDLError, match="expected at most 64 levels") as caught:
        parse_problem(nested(bddl_syntax.MAX_DEPTH + 1))
    assert (caught.value.line, caught.value.column) == (4, 6 + bddl_syntax.MAX_DEPTH - 2)


def test_a_file_that_does_not_exist_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_problem(tmp_path / "none.bddl")


# ------------------------------------------------------------------------------------------------------------- fuzz


def parses_or_refuses(text: str) -> Problem | None:
    """Parse; anything but a `Problem` or a `BDDLError` with a place inside the text escapes and fails the test."""
    try:
        return parse_problem(text)
    except BDDLError as error:
        refusal = error
    lines = re.split("\r\n|\r|\n", text)
    assert 1 <= refusal.line <= len(lines)
    assert 1 <= refusal.column <= len(lines[refusal.line - 1]) + 1
    assert refusal.expected
    assert refusal.message
    return None


@st.composite
def mutated_files(draw: st.DrawFn) -> str:
    """A real file with tokens deleted, duplicated, swapped in from elsewhere, or cut off."""
    text = draw(st.sampled_from(SUITE_FILES)).read_text()
    tokens = re.findall(r"[()]|[^\s()]+|\s+", text)
    noise = st.sampled_from([*sorted(set(tokens)), "-", ";", "pi/2", "(", ")", "()", "é", "\x00", "1e400", "0"])
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(tokens) - 1, 0)))
        match draw(st.sampled_from(["delete", "insert", "replace", "duplicate", "truncate"])):
            case "delete":
                del tokens[at : at + 1]
            case "insert":
                tokens.insert(at, draw(noise))
            case "replace":
                tokens[at : at + 1] = [draw(noise)]
            case "duplicate":
                end = at + draw(st.integers(1, 30))
                tokens[at:at] = tokens[at:end]
            case "truncate":
                del tokens[at:]
    return "".join(tokens)


@fuzz
@given(st.text())
@example("")
@example("(")
@example("(define (problem")
@example("\x00")
@example(";")
@example("(define" + "(" * 100_000)
@example("(" * 100_000 + ")" * 100_000)
@example("(define " + "() " * 50_000 + ")")
@example(TEXT.replace("-pi/2", "-" * 100_000 + "1"))
@example(TEXT.replace("-pi/2", "1" + "+1" * 50_000 + "/0"))
@example(TEXT.replace("0.2)", "9" * 100_000 + ")"))
def test_any_text_gives_a_problem_or_an_error_with_a_place(text: str) -> None:
    parses_or_refuses(text)


@fuzz
@given(
    st.lists(st.sampled_from(["(", ")", "define", ":goal", "and", "on", "-", "a", "1", ";", "\n", " "]), max_size=80)
)
def test_any_tokens_give_a_problem_or_an_error_with_a_place(tokens: list[str]) -> None:
    parses_or_refuses(" ".join(tokens))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "mutated.bddl"


@fuzz
@given(text=mutated_files())
def test_a_mutated_real_file_is_refused_or_reads_as_upstream_reads_it(text: str, scratch: Path, upstream) -> None:
    problem = parses_or_refuses(text)
    if problem is not None:
        scratch.write_text(text, newline="")
        assert problem == upstream(scratch)
