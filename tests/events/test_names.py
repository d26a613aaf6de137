import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import InvalidName, StreamName, source_name, station_name, type_name
from tests.events.strategies import names, streams, type_names

OUTSIDE = [
    "",
    " ",
    "a/b",
    "a\n",
    "\na",
    "a\0",
    "'a'",
    'a"b',
    "-a",
    "a.",
    "..",
    "a b",
    "Ärger",
    "\N{ARABIC-INDIC DIGIT ONE}",
    "a" * 65,
    "a" * 10_000,
]


@given(names)
def test_a_name_inside_the_grammar_comes_back_as_it_is(name: str) -> None:
    assert station_name(name) == source_name(name) == name


@given(type_names)
def test_a_type_name_inside_the_grammar_comes_back_as_it_is(name: str) -> None:
    assert type_name(name) == name


@pytest.mark.parametrize("text", OUTSIDE)
@pytest.mark.parametrize("check, what", [(station_name, "station"), (source_name, "source")])
def test_a_name_outside_the_grammar_is_refused_with_what_was_got_and_wanted(check, what, text) -> None:
    with pytest.raises(InvalidName) as caught:
        check(text)
    message = str(caught.value)
    assert message.startswith(f"{what} must be 1 to 64 of A-Z a-z 0-9 . _ -")
    assert f"got {text[:100]!r}" in message
    assert "\n" not in message
    assert len(message) < 250


@pytest.mark.parametrize("text", [*OUTSIDE, "Track", "1track", "_track", "track-point", "track.point", "t" * 49])
def test_a_type_name_outside_the_grammar_is_refused(text: str) -> None:
    with pytest.raises(InvalidName, match=r"type must be 1 to 48 of a-z 0-9 _, beginning with a letter; got"):
        type_name(text)


@given(streams)
def test_parsing_a_stream_name_is_the_inverse_of_writing_it(stream: StreamName) -> None:
    assert StreamName.parse(str(stream)) == stream


@pytest.mark.parametrize("text", ["", "a", "a/b", "a/b/c/d", "a/b/c/", "x" * 10_000])
def test_a_stream_name_without_three_parts_is_refused(text: str) -> None:
    with pytest.raises(InvalidName, match=r"written station/source/type, got") as caught:
        StreamName.parse(text)
    assert len(str(caught.value)) < 200


@given(st.text())
def test_any_text_is_a_stream_name_or_is_refused(text: str) -> None:
    try:
        stream = StreamName.parse(text)
    except InvalidName:
        return
    assert str(stream) == text


def test_streams_are_ordered_by_station_then_source_then_type() -> None:
    written = ["a/a/b", "a/b/a", "b/a/a"]
    assert [str(s) for s in sorted(map(StreamName.parse, reversed(written)))] == written
