"""Compiler tests list the program; the tables follow from it."""

import pytest

from patterns import LimitError, Limits, RuleError, SkipError, bind, match
from patterns.binding.program import Instruction, ProgramTooLarge, compile_pattern, listing, tabulate
from patterns.language.pattern_parser import parse_pattern
from patterns.language.text import Passage
from tests.patterns.samples import SCHEMAS, define_letters, letter_rule, letters, spans

LISTINGS = {
    "A B": "row A; row B; accept",
    "A | B | C": "split 1 3; row A; jump 7; split 4 6; row B; jump 7; row C; accept",
    "A?": "split 1 2; row A; accept",
    "A??": "split 2 1; row A; accept",
    "A*": "split 1 3; row A; jump 0; accept",
    "A*?": "split 3 1; row A; jump 0; accept",
    "A+": "row A; split 2 4; row A; jump 1; accept",
    "A{2}": "row A; row A; accept",
    "A{2,}": "row A; row A; split 3 5; row A; jump 2; accept",
    "A{,2}": "split 1 4; row A; split 3 4; row A; accept",
    "A{1,3}?": "row A; split 5 2; row A; split 5 4; row A; accept",
    "(A B)+ C": "row A; row B; split 3 6; row A; row B; jump 2; row C; accept",
    "^ A $": "at the partition's start; row A; at the partition's end; accept",
    "()": "accept",
    "A {- B {- C -} -}": "row A; row B excluded; row C excluded; accept",
    "PERMUTE(A, B)": "split 1 3; row A; jump 5; row B; jump 7; row B; jump 9; row A; jump 9; accept",
    "A{,}": "split 1 3; row A; jump 0; accept",
    "(A?)*": "split 1 6; mark 0; split 3 4; row A; check 0 else 6; jump 0; accept",
}


def _program(pattern: str) -> tuple[list[str], tuple[Instruction, ...]]:
    tree, end = parse_pattern(Passage.alone(f"({pattern})"), 0)
    assert end == len(pattern) + 2
    names = ["A", "B", "C"]
    program = compile_pattern(tree, names, 1000)
    return names, program


@pytest.mark.parametrize("pattern", LISTINGS)
def test_listing(pattern: str) -> None:
    names, program = _program(pattern)
    lines = [line.split(maxsplit=1)[1] for line in listing(program, names).splitlines()]
    assert "; ".join(lines) == LISTINGS[pattern]


@pytest.mark.parametrize(
    "pattern,follow,accepts",
    [
        ("A B", [(1,), (), (0,)], [False, True, False]),
        ("A* B", [(0, 1), (), (0, 1)], [False, True, False]),
        ("A*? B", [(1, 0), (), (1, 0)], [False, True, False]),
        ("A*", [(0,), (0,)], [True, True]),
        ("A*?", [(), ()], [True, True]),
        ("A+?", [(), (), (0,)], [True, True, False]),
        ("(A | B) C??", [(), (), (), (0, 1)], [True, True, True, False]),
        # The reluctant body prefers to be empty, which ends the loop: so B is preferred to A.
        ("(A??)* B", [(1, 0), (), (1, 0)], [False, True, False]),
        ("(A?)* B", [(0, 1), (), (0, 1)], [False, True, False]),
    ],
)
def test_tables(pattern: str, follow: list[tuple[int, ...]], accepts: list[bool]) -> None:
    _, program = _program(pattern)
    tables = tabulate(program)
    # Without anchors a match begins at a partition's first row as it does at any other.
    assert tables.follow == (*follow, follow[-1])
    assert tables.accepts == tables.accepts_end == (*accepts, accepts[-1])


@pytest.mark.parametrize(
    "pattern,text,wanted",
    [
        ("A B", "abcab", [(0, 1), (3, 4)]),
        ("A+", "aabaa", [(0, 1), (3, 4)]),
        ("A+?", "aab", [(0, 0), (1, 1)]),
        ("A (B | C)+ A", "abca", [(0, 3)]),
        ("A | A B", "ab", [(0, 0)]),
        ("A B | A", "ab", [(0, 1)]),
        ("A{2,3}", "aaaaa", [(0, 2), (3, 4)]),
        ("A{2,3}?", "aaaaa", [(0, 1), (2, 3)]),
        ("A (B* C)?", "abbabbc", [(0, 0), (3, 6)]),
        ("(A | B)*? C", "ababd" * 3, []),
    ],
)
def test_letters(pattern: str, text: str, wanted: list[tuple[int, int]]) -> None:
    names = "".join(name for name in "ABC" if name in pattern)
    assert spans(match(bind(letter_rule(pattern, define_letters(names)), SCHEMAS), letters(text))) == wanted


@pytest.mark.parametrize(
    "skip,wanted",
    [
        ("PAST LAST ROW", [(0, 3), (4, 5)]),
        ("TO NEXT ROW", [(0, 3), (1, 3), (4, 5)]),
        ("TO FIRST B", [(0, 3), (4, 5)]),
        ("TO b", [(0, 3), (4, 5)]),
    ],
)
def test_skip_modes(skip: str, wanted: list[tuple[int, int]]) -> None:
    bound = bind(letter_rule("A+ B+", define_letters("AB"), skip=skip), SCHEMAS)
    assert spans(match(bound, letters("aabbab"))) == wanted


def test_skipping_to_the_first_row_of_the_match_is_an_error() -> None:
    bound = bind(letter_rule("A+ B+", define_letters("AB"), skip="TO LAST A"), SCHEMAS)
    assert spans(match(bound, letters("cc"))) == []
    wanted = (
        r"AFTER MATCH SKIP TO LAST A: A is the first row of the match from 2026-01-01T10:00:01Z \(sequence 1\) to "
        r"2026-01-01T10:00:03Z \(sequence 3\), so the search would find it for ever. Next: skip to a variable further"
    )
    with pytest.raises(SkipError, match=wanted):
        match(bound, letters("cabb"))


def test_skipping_to_a_variable_goes_on_at_its_row() -> None:
    rule = letter_rule("A B C", define_letters("ABC"), skip="TO LAST C")
    assert spans(match(bind(rule, SCHEMAS), letters("abcabc"))) == [(0, 2), (3, 5)]
    rule = letter_rule("X Y", "Y AS letter <> PREV(letter)", skip="TO LAST Y")
    assert spans(match(bind(rule, SCHEMAS), letters("abba"))) == [(0, 1), (2, 3)]


def test_skipping_to_a_variable_that_took_no_row_is_an_error() -> None:
    rule = letter_rule("A B?", define_letters("AB"), skip="TO LAST B")
    with pytest.raises(SkipError, match=r"TO LAST B: B is not in the match from .* \(sequence 0\) to .*"):
        match(bind(rule, SCHEMAS), letters("ac"))


def test_a_pattern_that_unfolds_too_far_is_refused_at_its_place() -> None:
    with pytest.raises(RuleError, match=r"unfolds to 12000 positions; the limit `positions` is 10000") as caught:
        bind(letter_rule("(A{300} B{100}){30}"), SCHEMAS)
    assert caught.value.excerpt.splitlines()[-1].index("^") == caught.value.excerpt.index("PATTERN")
    assert bind(letter_rule("(A{30} B{10}){30}"), SCHEMAS, limits=Limits(positions=1200)).tables.start == 1200


def test_deeply_nested_loops_over_nothing_end() -> None:
    pattern = "A?"
    for _ in range(24):
        pattern = f"({pattern} (B? | C)*)*"
    bound = bind(letter_rule(pattern, define_letters("ABC")), SCHEMAS)
    assert spans(match(bound, letters("abcdcba"))) == [(0, 1), (5, 6)]


def test_more_partial_matches_than_the_limit_is_an_error_that_names_it() -> None:
    rule = letter_rule("A X* B", "X AS n >= A.n, B AS letter = 'b'", within="INTERVAL '1' HOUR")
    bound = bind(rule, SCHEMAS, limits=Limits(threads=50))
    with pytest.raises(LimitError, match="the limit `threads` is 50"):
        match(bound, letters("a" * 60))
    assert spans(match(bound, letters("a" * 20 + "b"))) == [(0, 20)]


def test_more_row_local_conditions_than_a_word_has_bits_is_an_error() -> None:
    rule = letter_rule("A", "A AS " + " AND ".join(f"n <> {number}" for number in range(64)))
    with pytest.raises(RuleError, match="more than 63 different row-local conditions"):
        bind(rule, SCHEMAS)
    same = letter_rule("A", "A AS " + " AND ".join(["n <> 1"] * 64))
    assert len(bind(same, SCHEMAS).predicates) == 1


def test_more_partitions_than_the_limit_is_an_error_that_names_it() -> None:
    bound = bind(letter_rule("A B", define_letters("AB"), partition="n"), SCHEMAS, limits=Limits(partitions=5))
    with pytest.raises(LimitError, match="the limit `partitions` is 5"):
        match(bound, letters("a" * 6))


def test_many_starts_of_one_hopeless_pattern_share_their_threads() -> None:
    # A million rows of it are linear: at no time are there more threads than positions.
    bound = bind(letter_rule("(A | B)*? C", define_letters("ABC")), SCHEMAS, limits=Limits(threads=4))
    assert match(bound, letters("ab" * 300)) == []


def test_the_shared_thread_does_not_outlive_the_start_that_it_stands_for() -> None:
    # Start 0 waits in vain; start 1 settles for rows 1 to 2 and so covers start 2, while start 3,
    # whose thread is equal to that of start 2, must still be found.
    rule = letter_rule("F X* G | A B (X* D)? | (B | C) C* E", define_letters("ABCDEFG"))
    assert spans(match(bind(rule, SCHEMAS), letters("fabccce"))) == [(1, 2), (3, 6)]


def test_starts_do_not_share_threads_that_end_at_different_times() -> None:
    rule = letter_rule("A X* B", define_letters("AB"), within="INTERVAL '4' SECOND")
    assert spans(match(bind(rule, SCHEMAS), letters("aaxxb"))) == [(1, 4)]


def test_threads_that_remember_different_things_are_not_one() -> None:
    # What C asks of A is not asked at the row after A, but must be remembered until then.
    rule = letter_rule("A+ X C", "A AS letter = 'a', X AS letter = 'x', C AS n = FIRST(A.n)")
    rows = letters("aaaxc", numbers=[1, 2, 3, 0, 2])
    assert spans(match(bind(rule, SCHEMAS), rows)) == [(1, 4)]


@pytest.mark.parametrize(
    "pattern,ends,firsts",
    [
        ("A $", [True, False, False], (0,)),
        ("A B? $", [True, True, False, False], (0,)),
        ("^ A | B", [True, True, False, False], (1, 0)),
        ("A ($ | B)", [True, True, False, False], (0,)),
        ("A ^ B", [False, True, False, False], (0,)),
    ],
)
def test_anchors_are_a_second_end_and_a_second_start(pattern: str, ends: list[bool], firsts: tuple[int, ...]) -> None:
    tables = tabulate(_program(pattern)[1])
    assert tables.accepts_end == tuple(ends)
    assert tables.firsts() == firsts
    assert tables.has_start_anchor == pattern.startswith("^")


def test_eight_parts_in_any_order_are_a_thousand_positions_and_not_forty_thousand() -> None:
    names = [f"V{number}" for number in range(8)]
    tree, _ = parse_pattern(Passage.alone(f"(PERMUTE({', '.join(names)}))"), 0)
    assert tabulate(compile_pattern(tree, names, 1_024)).start == 1_024
    with pytest.raises(ProgramTooLarge, match="unfolds to 1024 positions"):
        compile_pattern(tree, names, 1_023)
