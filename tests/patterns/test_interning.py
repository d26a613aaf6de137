"""Numbers for texts: the same text has the same number, however long those beside it are."""

import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from patterns.engine.interning import Texts

_TEXTS = st.lists(st.lists(st.text(max_size=50) | st.sampled_from(["", "a", "a\0", "ä" * 20, "7A01234"]) | st.none()))


@settings(deadline=None)
@given(_TEXTS)
def test_equal_texts_and_no_others_share_a_number(batches: list[list[str | None]]) -> None:
    texts = Texts(["a"])
    for batch in batches:
        # A slice, as batches are: what lies beside it in memory must not matter.
        column = pa.array(["beside", *batch, "it"], pa.string()).slice(1, len(batch))
        numbers = texts.numbers(column)
        told = [text for text in zip(numbers.tolist(), batch, strict=True) if text[1] is not None]
        assert [texts.known[number] for number, _ in told] == [text for _, text in told]
    assert len(set(texts.known)) == len(texts.known)
    assert texts.known[0] == "a"


def test_texts_that_were_cleared_are_numbered_anew() -> None:
    texts = Texts()
    assert texts.numbers(pa.array(["b", "a", "b"])).tolist() == [0, 1, 0]
    texts.clear()
    assert texts.numbers(pa.array(["a", "c"])).tolist() == [0, 1]
