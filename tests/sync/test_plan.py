import contextlib
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from events import StreamName, station_name
from sync import LANES, Entry, Plan, PlanError
from sync.plans.entries import base_of, derived_name

TEXT = """\
entries:
  - stream: "*/*/situation_detected"
    priority: situations
  - stream: "brno-?/cam-[0-9]*/track_point"
    from: beginning
    priority: 25
  - {stream: "*/gate/[!a]*"}
"""


def stream(text: str) -> StreamName:
    return StreamName.parse(text)


def test_a_file_is_read_in_order(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(TEXT)

    plan = Plan.load(path)

    assert plan.entries == (
        Entry(stream="*/*/situation_detected", priority=LANES["situations"]),
        Entry(stream="brno-?/cam-[0-9]*/track_point", priority=25),
        Entry(stream="*/gate/[!a]*", priority=LANES["points"]),
    )


@pytest.mark.parametrize(
    "name, priority",
    [
        ("brno-2/gate/situation_detected", 10),
        ("brno-2/cam-07/track_point", 25),
        ("brno-12/cam-07/track_point", None),
        ("brno-2/cam-x/track_point", None),
        ("brno-2/gate/track_ended", 30),
        ("brno-2/gate/activity_interval", None),
        ("BRNO-2/cam-07/track_point", None),
    ],
)
def test_the_first_entry_that_fits_decides(name: str, priority: int | None) -> None:
    assert priority_in(Plan.parse(TEXT), name) == priority


def priority_in(plan: Plan, name: str) -> int | None:
    entry = plan.entry_for(stream(name))
    return None if entry is None else entry.priority


def test_an_earlier_entry_hides_a_later_one() -> None:
    plan = Plan.of({"entries": [{"stream": "*/*/*", "priority": "media"}, {"stream": "*/*/*", "priority": "alerts"}]})

    assert priority_in(plan, "a/b/c") == LANES["media"]


def test_a_pattern_matches_part_by_part() -> None:
    assert not Entry(stream="*/track_point/*").fits(stream("a/b/track_point"))
    assert Entry(stream="a*/*/*").fits_station(station_name("a.b"))
    assert not Entry(stream="a*/*/*").fits_station(station_name("b"))


def test_the_lanes_are_in_the_order_of_their_urgency() -> None:
    assert list(LANES) == ["alerts", "situations", "tracks", "points", "media"]
    assert list(LANES.values()) == sorted(LANES.values())


def test_two_spellings_of_one_plan_have_one_hash() -> None:
    flow = Plan.parse("{entries: [{priority: 30, from: beginning, stream: '*/a/*'}]} # the same")
    block = Plan.parse("entries:\n- stream: '*/a/*'\n  priority: points\n")

    assert flow.plan_hash == block.plan_hash
    assert flow.canonical() == '{"entries":[{"from":"beginning","priority":30,"stream":"*/a/*"}]}'
    assert Plan.of({"entries": [{"stream": "*/b/*"}]}).plan_hash != flow.plan_hash


@given(
    st.lists(
        st.fixed_dictionaries(
            {
                "stream": st.from_regex(r"([a-z*?.]{1,9}/){2}[a-z*_]{1,9}", fullmatch=True),
                "priority": st.sampled_from([*LANES, 0, 99]),
            }
        ),
        min_size=1,
        max_size=5,
    )
)
def test_the_canonical_form_says_the_same_plan(entries: list[dict[str, object]]) -> None:
    plan = Plan.of({"entries": entries})

    assert Plan.parse(plan.canonical()) == plan


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "plan.yaml: the file is empty"),
        ("entries: []", "plan.yaml, line 1: entries: the plan names no stream"),
        ("entries:\n", "plan.yaml, line 1: entries: must be a list"),
        ("- a", "plan.yaml: a plan is a mapping with entries, got a list"),
        ("streams: []", "line 1: streams: unknown key; known: entries"),
        ("entries:\n- stream: a/b\n", "plan.yaml, line 2: entries[0].stream: must be a pattern station/source/type"),
        ("entries:\n- stream: a/b/c\n- stream: 'a/{b}/c'\n", "plan.yaml, line 3: entries[1].stream: the part '{b}'"),
        ("entries:\n- stream: 'a/[b/c'\n", "the part '[b'"),
        ("entries:\n- stream: a//c\n", "the part ''"),
        (f"entries:\n- stream: a/{'b' * 65}/c\n", "must be 1 to 64"),
        ("entries:\n- stream: 7\n", "must be a pattern station/source/type, such as */*/situation_detected; got '7'"),
        ("entries:\n- stream: [a/b/c]\n", "entries[0].stream: Input should be a valid string"),
        (
            "entries:\n- stream: a/b/c\n  speed: 3\n",
            "plan.yaml, line 3: entries[0].speed: unknown key; known: stream, from",
        ),
        (
            "entries:\n- stream: a/b/c\n  rate: 3\n",
            "plan.yaml, line 3: entries[0].rate: must be a rate such as 800 kbit/s",
        ),
        ("entries:\n- stream: a/b/c\n  rate: 0 kbit/s\n", "from 1 kbit/s to 1000 Gbit/s; got '0 kbit/s'"),
        ("entries:\n- stream: a/b/c\nrate: -1 kbit/s\n", "plan.yaml, line 3: rate: must be a rate"),
        ("entries:\n- stream: a/b/c\nbacklog_share: half\n", "line 3: backlog_share: must be a number from 0 to 0.9"),
        ("entries:\n- stream: a/b/c\nbacklog_share: 1\n", "line 3: backlog_share: Input should be less than or equal"),
        ("entries:\n- stream: a/b/c\npaused: perhaps\n", "line 3: paused: Input should be a valid boolean"),
        (
            "entries:\n- stream: a/b/c\n  order: newest\n",
            "line 3: entries[0].order: Input should be 'live' or 'oldest'",
        ),
        ("entries:\n- stream: a/b/c\n  leave_out: vx\n", "entries[0].leave_out: must be a list of fields, such as"),
        ("entries:\n- {stream: a/b/c, send: false, where: x}\n", "send: false has a stream and nothing else"),
        ("entries:\n- {stream: a/b/c, now: 2026-01-01T00:00:00Z}\n", "now says which time `from: now` stands for"),
        ("entries: [{stream: a/b/c}]\ngive_up: all\n", "line 2: give_up: must be a list of {stream, older_than}"),
        (
            "entries: [{stream: a/b/c}]\ngive_up: [{stream: a/b/c, age: 1}]\n",
            "age: unknown key; known: stream, older_than",
        ),
        (
            "entries: [{stream: a/b/c}]\ngive_up: [{stream: a/b/c, older_than: 7}]\n",
            "give_up[0].older_than: must be a duration such as 7 d, 36 h",
        ),
        ("entries:\n- stream: a/b/c\n  since: beginning\n  from: beginning\n", "line 3"),
        ("entries:\n- priority: alerts\n", "plan.yaml, line 2: entries[0].stream: must be there: station/source/type"),
        (
            "entries:\n- stream: a/b/c\n  from: 2026-01-01\n",
            "line 3: entries[0].from: must be beginning, now, or a time with its zone such as 2026-11-01T00:00:00Z",
        ),
        ("entries:\n- stream: a/b/c\n  from: 9999-12-31T23:00:00-08:00\n", "must be beginning, now, or a time"),
        ("entries:\n- stream: a/b/c\n  priority: urgent\n", "priority: must be one of alerts, situations, tracks"),
        ("entries:\n- stream: a/b/c\n  priority: 100\n", "line 3: entries[0].priority"),
        ("entries:\n- stream: a/b/c\n  priority: true\n", "line 3: entries[0].priority"),
        ("entries:\n- just text\n", "plan.yaml, line 2: entries[0]"),
        ("entries:\n- stream: a/b/c\n  stream: d/e/f\n", "plan.yaml, line 3: 'stream' is given twice"),
        ("entries:\n- stream: 'a/b/c\n", "plan.yaml, line 3: not YAML"),
        ("a: b: c", "plan.yaml, line 1: not YAML"),
        ("entries: *nowhere", "line 1: not YAML: found undefined alias"),
        ("entries: !!python/object/apply:os.system [ls]", "line 1: entries[0]: Input should be"),
        ("--- {entries: []}\n--- {}\n", "line 2: not YAML: but found another document"),
        ("entries: [[[[[[[[]]]]]]]]", "line 1: nested too deep for a plan"),
        ("[" * 1000, "plan.yaml: not YAML"),
        ("entries: \x00", "plan.yaml: not YAML"),
        ("? [a, b]\n: c\n", "plan.yaml, line 1: a key must be a text"),
        ("x: &x []\nentries: *x\n", "plan.yaml, line 1: an alias repeats this"),
        ("x" * 300_000, "at most 262144 characters, got 300000"),
    ],
)
def test_what_is_no_plan_is_refused_with_the_place(text: str, words: str) -> None:
    with pytest.raises(PlanError) as raised:
        Plan.parse(text, "plan.yaml")

    assert words in str(raised.value)
    assert len(str(raised.value)) < 1000


def test_aliases_that_multiply_are_refused_at_once() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]

    with pytest.raises(PlanError):
        Plan.parse("\n".join([*lines, "entries: *a11"]))


def test_every_mistake_is_told_at_once() -> None:
    with pytest.raises(PlanError) as raised:
        Plan.parse("entries:\n- stream: a/b\n- stream: c/d\n")

    assert str(raised.value).count("\n") == 1


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"missing.yaml: cannot be read: No such file"):
        Plan.load(tmp_path / "missing.yaml")
    (tmp_path / "latin.yaml").write_bytes(b"entries: \xe9")
    with pytest.raises(PlanError, match=r"latin.yaml: is not UTF-8: .* at byte 9"):
        Plan.load(tmp_path / "latin.yaml")


@given(st.text(max_size=200))
def test_any_text_is_a_plan_or_is_refused(text: str) -> None:
    with contextlib.suppress(PlanError):
        assert Plan.parse(text).entries


WHOLE = """\
paused: true
rate: 800 kbit/s
backlog_share: 0.5
entries:
  - {stream: "*/*/situation_detected", priority: alerts, order: oldest}
  - {stream: "*/gate/track_point", from: 2026-11-01T00:00:00Z, rate: 1.5 Mbit/s, where: "x > 0.5 or y < 1"}
  - {stream: "*/gate/plate_read", leave_out: [region, candidates], from: now, now: 2026-11-01T01:00:00+01:00}
  - {stream: "*/gate/*", send: false}
give_up:
  - {stream: "*/*/track_point", older_than: 7 d}
  - {stream: "*/*/track_*"}
"""
WHOLE_TOML = """\
paused = true
rate = "800 kbit/s"
backlog_share = 0.5
entries = [
  {stream = "*/*/situation_detected", priority = 0, order = "oldest"},
  {stream = "*/gate/track_point", from = 2026-11-01T00:00:00Z, rate = "1500 kbit/s", where = "x > 0.5 or y < 1"},
  {stream = "*/gate/plate_read", leave_out = ["candidates", "region"], from = "now", now = 2026-11-01T00:00:00Z},
  {stream = "*/gate/*", send = false},
]
[[give_up]]
stream = "*/*/track_point"
older_than = "168 h"
[[give_up]]
stream = "*/*/track_*"
"""


def test_toml_and_yaml_say_the_same_plan() -> None:
    plan, same = Plan.parse(WHOLE, "plan.yaml"), Plan.parse(WHOLE_TOML, "plan.toml")
    assert plan.canonical() == same.canonical()
    assert plan.plan_hash == same.plan_hash
    assert Plan.parse(plan.canonical()).canonical() == plan.canonical()
    assert Plan.of(plan.said()).plan_hash == plan.plan_hash


def test_what_a_plan_says_is_read_from_it() -> None:
    plan = Plan.parse(WHOLE)
    alerts, points, plates, rest = plan.entries
    assert (plan.paused, plan.rate_bps, plan.backlog_share) == (True, 800_000, 0.5)
    assert [(each.stream, each.older_than.days) for each in plan.give_up] == [
        ("*/*/track_point", 7),
        ("*/*/track_*", 0),
    ]
    assert (alerts.since, alerts.order, alerts.rate_bps, alerts.is_derived) == (None, "oldest", None, False)
    assert (points.since, points.rate_bps, points.is_derived) == (datetime(2026, 11, 1, tzinfo=UTC), 1_500_000, True)
    assert (plates.since, plates.is_derived, plates.sends) == (points.since, True, True)
    assert (rest.sends, rest.is_derived) == (False, False)
    assert Plan.parse("entries: [{stream: a/b/c}]").give_up == ()


def test_a_derived_stream_is_sent_in_place_of_its_base_as_long_as_its_filter_is_the_plans() -> None:
    plan = Plan.parse(WHOLE)
    base = stream("brno/gate/track_point")
    name = derived_name(base, plan.entries[1])
    assert str(name) == f"brno/gate~{plan.entries[1].filter_hash}/track_point"
    assert base_of(name) == base
    assert base_of(base) is None
    assert plan.entry_for(base) is None
    assert plan.entry_for(name) == plan.entries[1]
    assert plan.entry_for(stream("brno/gate~01234567/track_point")) is None
    assert plan.entry_for(stream("brno/yard~01234567/track_point")) is None
    assert plan.entry_for(stream("brno/gate/track_ended")) is None
    assert priority_in(plan, "brno/yard/situation_detected") == 0
    assert plan.chosen(stream("brno/gate/track_ended")) == plan.entries[3]


@pytest.mark.parametrize(
    "text, words",
    [
        ("entries = [", "plan.toml: not TOML: Invalid value (at end of document)"),
        ("entries = 1\nentries = 2\n", "plan.toml: not TOML: Cannot overwrite a value (at line 2, column 12)"),
        ("", "plan.toml: the file is empty; wanted: [[entries]] with stream"),
        ("[[entries]]\nstream = 7\n", "plan.toml: entries[0].stream: Input should be a valid string; got '7'"),
        ("[[entries]]\nstream = 'a/b/c'\nfrom = 2026-11-01\n", "entries[0].from: must be beginning, now, or a time"),
        ("[[entries]]\nstream = 'a/b/c'\nfrom = 2026-11-01T00:00:00\n", "a time with its zone such as 2026-11-01"),
        ("[[entries]]\nstream = 'a/b/c'\nrate = 800\n", "rate: must be a rate such as 800 kbit/s"),
        ("[[entries]]\nstream = 'a/b/c'\npriority = true\n", "entries[0].priority"),
    ],
)
def test_what_is_no_plan_in_toml_is_refused(text: str, words: str) -> None:
    with pytest.raises(PlanError) as raised:
        Plan.parse(text, "plan.toml")
    assert words in str(raised.value)
