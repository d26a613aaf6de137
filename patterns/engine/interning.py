"""Numbers for what is not a number: partition keys, and texts that a match remembers."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from patterns.binding.expressions import Kind
from patterns.engine.kernel import Integers, intern

_WORD_BYTES = 8
_TEXT_WORDS_MOST = 5
"""Longer texts are told apart as texts: a UUID still fits."""
_FIRST_OCTETS = np.array([(1 << 8 * count) - 1 for count in range(_WORD_BYTES + 1)], dtype=np.uint64).view(np.int64)
"""Masks of so many octets of a word, little-endian."""
_NOT_A_NUMBER = np.array([np.nan]).view(np.int64)[0]


class Interned:
    """A number for each row of words, in the order in which they were met."""

    def __init__(self, width: int) -> None:
        """None are known; a row has so many words."""
        self.count = 0
        self.table = np.empty((1024, width), dtype=np.int64)
        self._slots = np.full(4096, -1, dtype=np.int64)

    def numbers(self, rows: Integers) -> Integers:
        """For each row its number; those that were not known are now."""
        most = self.count + len(rows)
        if most > len(self.table):
            grown = np.empty((max(most, 2 * len(self.table)), self.table.shape[1]), dtype=np.int64)
            grown[: self.count] = self.table[: self.count]
            self.table = grown
        if 2 * most > len(self._slots):
            self._slots = np.full(1 << (4 * most - 1).bit_length(), -1, dtype=np.int64)
            known = self.table[: self.count].copy()
            intern(known, self.table, self._slots, 0, np.empty(self.count, dtype=np.int64))
        numbers = np.empty(len(rows), dtype=np.int64)
        self.count = intern(rows, self.table, self._slots, self.count, numbers)
        return numbers


class Texts:
    """A number for each text, in the order in which they were met."""

    def __init__(self, known: Sequence[str] = ()) -> None:
        self.known = list(known)
        self._numbers = {text: number for number, text in enumerate(self.known)}
        self._packed: dict[int, tuple[Interned, Integers]] = {}
        """By width in words: the texts that were met as words, and their numbers."""

    def clear(self) -> None:
        """Forgets them all."""
        self.known = []
        self._numbers = {}
        self._packed = {}

    def numbers(self, column: Any) -> Integers:
        """For each row its text's number; any number where the text is NULL."""
        words = _packed(column)
        return self._numbers_coded(column) if words is None else self._numbers_packed(column, words)

    def _numbers_packed(self, column: Any, words: Integers) -> Integers:
        """Short texts are told apart as words of 64 bits, which is several times cheaper than as texts."""
        width = words.shape[1]
        interned, numbers_of = self._packed.get(width) or (Interned(width), np.empty(0, dtype=np.int64))
        known = interned.count
        places = interned.numbers(words)
        if interned.count > known:
            rows = np.flatnonzero(places >= known)
            _, firsts = np.unique(places[rows], return_index=True)
            texts = column.take(pa.array(rows[firsts])).to_pylist()
            if interned.count > len(numbers_of):
                numbers_of = np.concatenate((numbers_of[:known], np.empty(len(interned.table) - known, dtype=np.int64)))
            numbers_of[known : interned.count] = [self.number(text) for text in texts]
        self._packed[width] = interned, numbers_of
        numbers: Integers = numbers_of[places]
        return numbers

    def _numbers_coded(self, column: Any) -> Integers:
        encoded = column.dictionary_encode()
        if len(encoded.dictionary) == 0:
            return np.zeros(len(column), dtype=np.int64)
        texts = encoded.dictionary.to_pylist()
        known = list(map(self._numbers.get, texts))
        if None in known:
            known = [self.number(text) if number is None else number for text, number in zip(texts, known, strict=True)]
        table = np.array(known, dtype=np.int64)
        indices = pc.fill_null(encoded.indices, 0) if encoded.indices.null_count else encoded.indices
        numbers: Integers = table[indices.to_numpy()]
        return numbers

    def number(self, text: str) -> int:
        """The text's number."""
        number = self._numbers.get(text)
        if number is None:
            number = self._numbers[text] = len(self.known)
            self.known.append(text)
        return number


def _packed(column: Any) -> Integers | None:
    """Each text's length and bytes as words of 64 bits; None: some are too long, or NULL, or no plain texts."""
    if not len(column) or column.null_count or not pa.types.is_string(column.type):
        return None
    _, offsets, data = column.buffers()
    bounds = np.frombuffer(offsets, dtype=np.int32)[column.offset : column.offset + len(column) + 1]
    lengths = np.diff(bounds)
    width = -(-int(lengths.max()) // _WORD_BYTES)
    if not 0 < width <= _TEXT_WORDS_MOST:
        return None
    begin, end = int(bounds[0]), int(bounds[-1])
    octets = np.zeros(end - begin + width * _WORD_BYTES, dtype=np.uint8)
    octets[: end - begin] = np.frombuffer(data, dtype=np.uint8)[begin:end]
    words = np.empty((len(column), width + 1), dtype=np.int64)
    words[:, 0] = lengths
    at_any_octet = np.ndarray(len(octets) - _WORD_BYTES + 1, dtype="<i8", buffer=octets, strides=(1,))
    for word in range(width):
        here = _WORD_BYTES * word
        words[:, 1 + word] = at_any_octet[bounds[:-1] - begin + here]
        words[:, 1 + word] &= _FIRST_OCTETS[np.clip(lengths - here, 0, _WORD_BYTES)]
    return words


def as_words(column: Any, kind: Kind, texts: Texts) -> Integers:
    """The column's values as words of 64 bits: numbers, the bits of floats, numbers of texts; 0 or so where NULL."""
    if kind is Kind.STRING:
        return texts.numbers(column)
    if kind is Kind.NULL:
        return np.zeros(len(column), dtype=np.int64)
    if kind is Kind.BOOL:
        column = column.cast(pa.int64())
    if column.null_count:
        column = pc.fill_null(column, pa.scalar(0, column.type))
    values = column.to_numpy()
    words: Integers = values.view(np.int64)
    return words


def as_values(words: Integers, is_null: NDArray[np.bool_], kind: Kind, texts: Texts) -> list[Any]:
    """The values that stand in words; None where NULL."""
    if kind is Kind.STRING:
        known = texts.known
        return [None if null else known[word] for word, null in zip(words.tolist(), is_null.tolist(), strict=True)]
    words = np.ascontiguousarray(words)
    values: list[Any] = (
        words.view(np.float64) if kind is Kind.FLOAT else words != 0 if kind is Kind.BOOL else words
    ).tolist()
    if is_null.any():
        values = [None if null else value for value, null in zip(values, is_null.tolist(), strict=True)]
    return values


class Keys:
    """A number for each partition: a row of partition columns. NULL equals NULL."""

    def __init__(self, kinds: Sequence[Kind]) -> None:
        self.kinds = tuple(kinds)
        self.texts = Texts()
        self._interned = Interned(len(self.kinds) + 1)

    @property
    def count(self) -> int:
        """How many partitions have a number."""
        return self._interned.count

    @property
    def table(self) -> Integers:
        """By partition its columns as words, and then which of them are NULL."""
        return self._interned.table

    def numbers(self, columns: Sequence[Any | Integers], rows: int) -> Integers:
        """For each row its partition's number; a column is Arrow's, or numbers of `texts`."""
        keys = np.empty((rows, len(self.kinds) + 1), dtype=np.int64)
        keys[:, -1] = 0
        for at, (column, kind) in enumerate(zip(columns, self.kinds, strict=True)):
            keys[:, at] = column if isinstance(column, np.ndarray) else self._words(column, kind)
            if not isinstance(column, np.ndarray) and column.null_count:
                is_null = np.asarray(column.is_null())
                keys[is_null, at] = 0
                keys[:, -1] |= is_null.astype(np.int64) << at
        return self._interned.numbers(keys)

    def numbers_of(self, table: Integers, texts: Texts) -> Integers:
        """The numbers of another's keys, whose texts are these."""
        return self._interned.numbers(self._renumbered(table, texts))

    def key(self, number: int) -> tuple[Any, ...]:
        """The partition columns of a partition."""
        return tuple(value for (value,) in self.columns(np.array([number])))

    def columns(self, numbers: Integers) -> list[list[Any]]:
        """By partition column its values of these partitions."""
        words = self.table[numbers]
        return [
            as_values(words[:, at], words[:, -1] >> at & 1 != 0, kind, self.texts) for at, kind in enumerate(self.kinds)
        ]

    def kept(self, numbers: Integers) -> "Keys":
        """Keys that know only these partitions, numbered in this order."""
        kept = Keys(self.kinds)
        kept._interned.numbers(kept._renumbered(self.table[numbers], self.texts))
        return kept

    def _renumbered(self, table: Integers, texts: Texts) -> Integers:
        """Keys whose texts have numbers of `texts` with their numbers here; NULL has none, and stays 0."""
        keys = table.copy()
        for at, kind in enumerate(self.kinds):
            if kind is Kind.STRING:
                is_text = keys[:, -1] >> at & 1 == 0
                used, inverse = np.unique(keys[is_text, at], return_inverse=True)
                numbers = [self.texts.number(texts.known[number]) for number in used.tolist()]
                keys[is_text, at] = np.array(numbers, dtype=np.int64)[inverse]
        return keys

    def _words(self, column: Any, kind: Kind) -> Integers:
        words = as_words(column, kind, self.texts)
        if kind is Kind.FLOAT:
            floats = words.view(np.float64) + 0.0
            words = floats.view(np.int64)
            words[np.isnan(floats)] = _NOT_A_NUMBER
        return words
