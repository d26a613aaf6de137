"""Numbers for texts: the same text has the same number, however long those beside it are."""

from random import Random
from typing import Any

import numpy as np
import pyarrow as pa
from hypothesis import given, settings
from hypothesis import strategies as st

from patterns.binding.expressions import Kind
from patterns.engine.interning import Keys, Texts

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


_PARTS = st.sampled_from([None, "", "cam-00", "cam-01", "7A01234"])


@settings(deadline=None)
@given(st.lists(st.tuples(_PARTS, _PARTS, st.none() | st.integers(0, 2))), st.randoms())
def test_keys_are_the_same_whichever_are_kept_or_taken_over(rows: list[tuple[Any, ...]], choose: Random) -> None:
    kinds = [Kind.STRING, Kind.STRING, Kind.INT]
    types = [pa.string(), pa.string(), pa.int64()]

    def numbers(keys: Keys) -> list[int]:
        columns = [pa.array([row[at] for row in rows], kind) for at, kind in enumerate(types)]
        return keys.numbers(columns, len(rows)).tolist()

    keys = Keys(kinds)
    assert [keys.key(number) for number in numbers(keys)] == rows
    some = np.array(sorted(choose.sample(range(keys.count), choose.randint(0, keys.count))), dtype=np.int64)
    kept = keys.kept(some)
    assert [kept.key(number) for number in range(kept.count)] == [keys.key(number) for number in some]
    other = Keys(kinds)
    other.texts.number("before")
    assert [other.key(number) for number in other.numbers_of(kept.table[: kept.count], kept.texts)] == [
        keys.key(number) for number in some
    ]
    known = kept.count
    assert [kept.key(number) for number in numbers(kept)] == rows
    assert kept.count == known + len(set(rows) - {keys.key(number) for number in some})
