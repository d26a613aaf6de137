"""`vian rules backtest`: what it shows, how versions differ, and what is said of each wrong use."""

import csv
import io
import json
from pathlib import Path

import pytest

from patterns.processor import Processor, deploy, retire
from store import Log
from tests.patterns.walkers import STATION, T0, add_video, end, point, rule, say, walkers
from tests.vian.conftest import Run
from tests.vian.test_rules import HIGH, write_rule
from vian.querying import query
from vian.rules import file_text


@pytest.fixture
def walked(log: Log) -> Log:
    """A log in which a rule has run, in two versions."""
    walkers(log)
    for version, pattern in ((1, "(outside inside)"), (2, "(outside inside inside)")):
        tried = rule(version=version, pattern=pattern)
        deploy(log, STATION, [tried], {tried.rule: file_text(tried)}, T0)
    Processor(log, STATION, [rule()]).catch_up()
    return log


def test_the_situations_are_those_that_were_found_online(walked: Log, run: Run) -> None:
    head = walked.head()
    ran = run("rules", "backtest", "enters@1", "--dsn", walked.dsn, "--station", STATION, "--json")
    assert ran.code == 0
    shown = [json.loads(line) for line in ran.out.splitlines()]
    stored = query(walked, "select situation, title, source from situation_detected order by sequence").to_pylist()
    assert [{name: each[name] for name in ("situation", "title", "source")} for each in shown] == stored
    assert walked.head() == head, "nothing was appended"


def test_a_span_shows_the_situations_of_that_time_and_loses_none(walked: Log, run: Run) -> None:
    def times(*span: str) -> list[str]:
        ran = run("rules", "backtest", "enters@1", *span, "--dsn", walked.dsn, "--station", STATION, "--json")
        return [json.loads(line)["time"] for line in ran.out.splitlines()]

    middle = "2026-01-01T10:00:06Z"
    before, after = times("--until", middle), times("--since", middle)
    assert before, "some are earlier"
    assert after, "some are later"
    assert max(before) < middle <= min(after)
    assert before + after == times()
    assert times("--from", "2026-01-01T10:00:11Z") == []


def test_two_versions_are_shown_side_by_side(walked: Log, run: Run) -> None:
    ran = run("rules", "backtest", "enters@1", "--against", "2", "--dsn", walked.dsn, "--station", STATION)
    assert ran.code == 0
    assert ran.out.startswith("A is enters v1, B is enters v2\n")
    assert ran.out.splitlines()[-1] == "7 both, 1 only A, 0 only B"
    assert "ended_at" in ran.out


def test_it_is_said_which_situations_the_log_has_and_which_in_shadow(walked: Log, run: Run) -> None:
    def recorded(version: str) -> list[str]:
        out = run("rules", "backtest", f"enters@{version}", "--dsn", walked.dsn, "--station", STATION).out
        return [line.rstrip(" │").rpartition("│")[2].strip() for line in out.splitlines() if "came in" in line]

    assert recorded("1") == ["yes"] * 8
    assert recorded("2") == ["no"] * 7
    shadowed = rule(version=2, pattern="(outside inside inside)")
    retire(walked, STATION, "enters", T0)
    deploy(walked, STATION, [shadowed], {}, T0, after=0, is_shadow=True)
    Processor(walked, STATION).catch_up()
    assert recorded("2") == ["in shadow"] * 7


def test_csv_has_a_header_and_a_line_for_each_situation(walked: Log, run: Run) -> None:
    ran = run("rules", "backtest", "enters@1", "--dsn", walked.dsn, "--csv")
    rows = list(csv.DictReader(io.StringIO(ran.out)))
    assert len(rows) == 8
    assert rows[0]["title"] == "track 3 came in"


def test_what_the_log_cannot_answer_is_said(log: Log, run: Run, tmp_path: Path) -> None:
    path = write_rule(tmp_path / "high.yaml")
    ran = run("rules", "backtest", path, "--dsn", log.dsn)
    assert ran.code == 0
    assert "the log has no track_point that the rule could see" in ran.words
    add_video(log, "gate")
    say(log, "gate", point(7, 1, 80))
    say(log, "gate", point(7, 0, 80))
    end(log, "gate")
    ran = run("rules", "backtest", path, "--dsn", log.dsn)
    assert "high v1: 1 events came too late to take part, as online" in ran.words
    say(log, "yard", point(7, 1, 80))
    ran = run("rules", "backtest", path, "--dsn", log.dsn)
    assert "high v1: 1 events are not final yet: their source may still send earlier ones" in ran.words


WRONG: list[tuple[list[str], str]] = [
    (["gone.yaml"], "the rule file gone.yaml cannot be read"),
    (["nothing"], "'nothing' is neither a rule file nor a rule deployed in this log; deployed: enters@1, enters@2"),
    (["enters@9"], "version 9 of rule enters is not deployed in this log; deployed versions: 1, 2"),
    (["enters", "--against", "9"], "version 9 of rule enters is not deployed"),
    (["enters", "--since", "yesterday"], "--since must be a time such as"),
    (["enters", "--since", "2026-01-02", "--until", "2026-01-01"], "--since must be before --until"),
    (["enters", "--from", "2036-01-02"], "--from: the log has no event at or after 2036-01-02"),
    (["enters", "--source", "roof"], "no source 'roof' in this log; known: gate, rules"),
    (["enters", "--csv", "--json"], "give either --csv or --json"),
]


def test_wrong_use_is_told_with_what_was_wanted(walked: Log, run: Run) -> None:
    for arguments, said in WRONG:
        ran = run("rules", "backtest", *arguments, "--dsn", walked.dsn)
        assert ran.code == 2, arguments
        assert said in ran.words


def test_a_rule_that_cannot_go_on_is_named(log: Log, run: Run, tmp_path: Path) -> None:
    say(log, "gate", point(7, 1, 80))
    end(log, "gate")
    path = tmp_path / "zone.yaml"
    text = HIGH.format(name="high", version=1, x=5).replace("a.x > 5", "in_zone(a.x, a.y, 'yard')")
    path.write_text(text.replace("match:", "zones: {yard: {source: gate, polygon: [[0, 0], [1, 0], [1, 1]]}}\nmatch:"))
    ran = run("rules", "backtest", path, "--dsn", log.dsn)
    assert ran.code == 2
    assert "'yard' is in normalised coordinates of source 'gate', whose frame size is not known" in ran.words


def test_without_a_log_it_says_where_it_looked(run: Run, tmp_path: Path) -> None:
    ran = run("rules", "backtest", "enters", "--data-dir", tmp_path / "empty")
    assert ran.code == 1
    assert "there is no log in" in ran.words


def test_situations_outside_the_time_asked_for_are_told_of(walked: Log, run: Run) -> None:
    place = ("--dsn", walked.dsn, "--station", STATION)
    ran = run("rules", "backtest", "enters@1", "--since", "2026-01-01T11:00:00", *place)
    assert ran.code == 0
    assert "8 situations outside --since and --until, from 2026-01-01T10:00:02.000Z to" in ran.words
    assert "outside" not in run("rules", "backtest", "enters@1", *place).words


def test_a_backtest_from_where_nothing_follows_says_so(walked: Log, run: Run) -> None:
    ran = run("rules", "backtest", "enters@1", "--from", "head", "--dsn", walked.dsn, "--station", STATION)
    assert "the log has no track_point behind --from that the rule could see" in ran.words
