"""The pattern core against Python's `re`, one letter a row, where no loop body can be empty."""

import re

from hypothesis import assume, given
from hypothesis import strategies as st

from patterns import match
from tests.patterns.examples import examples
from tests.patterns.reference import Tree, has_empty_body, rendered
from tests.patterns.samples import bound_unless_empty, define_letters, letter_rule, letters, spans, trees


def _regex(tree: Tree) -> str:
    kind = tree[0]
    if kind == "var":
        return str(tree[1]).lower()
    if kind == "cat":
        return "".join(_regex(part) for part in tree[1])
    if kind == "alt":
        return f"(?:{'|'.join(_regex(choice) for choice in tree[1])})"
    _, body, least, most, greedy = tree
    return f"(?:{_regex(body)}){{{least},{'' if most is None else most}}}{'' if greedy else '?'}"


@examples(0.2)
@given(tree=trees("ABC", leaves=7), text=st.text("abcd", max_size=14))
def test_spans_are_those_of_re(tree: Tree, text: str) -> None:
    assume(not has_empty_body(tree))
    pattern = re.compile(_regex(tree))
    wanted = []
    at = 0
    while at < len(text):
        found = pattern.match(text, at)
        if found and found.end() > at:
            wanted.append((at, found.end() - 1))
            at = found.end()
        else:
            at += 1
    used = "".join(name for name in "ABC" if name in rendered(tree))
    rule = letter_rule(rendered(tree), define_letters(used))
    bound = bound_unless_empty(rule)
    assert spans(match(bound, letters(text)) if bound else []) == wanted
