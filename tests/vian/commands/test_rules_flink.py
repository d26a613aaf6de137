"""`vian rules flink`: what it prints, and what is said of each wrong use."""

import json
from pathlib import Path

import pytest

import patterns
from patterns.processor import deploy
from store import Log
from tests.patterns.walkers import STATION, T0, add_video, rule
from tests.vian.conftest import Run
from vian.rules import file_text

RULES = Path(patterns.__file__).parent / "rules"
ZONE = str(RULES / "zone-intrusion.yaml")
SIZE = ("--frame-size", "cam-01=1000x1000")


def test_a_rule_file_needs_no_log(run: Run) -> None:
    ran = run("rules", "flink", ZONE, *SIZE)
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("-- Where the events of type track_point come from.")
    assert ran.out.endswith("SELECT * FROM `zone-intrusion_situations`;\n")
    assert "'connector' = 'kafka'" in ran.out


def test_options_of_the_table_stand_in_it(run: Run) -> None:
    given = ("--with", "connector=filesystem", "--with", "path=/data/a=b", "--with", "format=parquet")
    ran = run("rules", "flink", ZONE, *SIZE, *given)
    assert "'connector' = 'filesystem',\n    'path' = '/data/a=b',\n    'format' = 'parquet'\n" in ran.out


def test_a_table_that_is_there_is_not_made(run: Run) -> None:
    ran = run("rules", "flink", ZONE, *SIZE, "--source-table", "track_point=points")
    assert "CREATE TABLE" not in ran.out
    assert "FROM `points`" in ran.out


def test_statements_for_machines(run: Run) -> None:
    said = json.loads(run("rules", "flink", ZONE, *SIZE, "--json").out)
    assert (said["rule"], said["version"], said["result"]) == ("zone-intrusion", 1, "zone-intrusion_situations")
    assert [each["sql"].split()[0:2] for each in said["statements"]] == [["CREATE", "TABLE"]] + [
        ["CREATE", "TEMPORARY"]
    ] * 3


def test_a_deployed_rule_and_frame_sizes_are_the_log_s(log: Log, run: Run) -> None:
    add_video(log, "gate")
    deployed = rule()
    deploy(log, STATION, [deployed], {deployed.rule: file_text(deployed)}, T0)
    ran = run("rules", "flink", deployed.rule, "--dsn", log.dsn)
    assert ran.code == 0, ran.err
    assert "`x` BETWEEN 50.0E0 AND 100.0E0" in ran.out


@pytest.mark.parametrize(
    "arguments,wanted",
    [
        ((ZONE,), "'restricted' is in normalised coordinates, and the frame size of 'cam-01' is not known"),
        ((ZONE, "--frame-size", "cam-01"), "--frame-size is SOURCE=WIDTHxHEIGHT, as in cam-01=1920x1080; got 'cam-01'"),
        (
            (ZONE, *SIZE, "--with", "kafka"),
            "--with wants a name, = and a value, as in connector=filesystem; got 'kafka'",
        ),
        ((ZONE, *SIZE, "--source-table", "t"), "--source-table wants a name, = and a value, as in track_point=points"),
        (("missing.yaml",), "the rule file missing.yaml cannot be read: No such file or directory"),
    ],
)
def test_wrong_use(arguments: tuple[str, ...], wanted: str, run: Run) -> None:
    ran = run("rules", "flink", *arguments)
    assert ran.code == 2
    assert wanted in ran.words


def test_what_flink_cannot_say_is_refused_with_place_and_reason(run: Run, tmp_path: Path) -> None:
    text = Path(ZONE).read_text().replace("(outside inside{3})", "(outside | inside{3})").split("tests:")[0]
    file = tmp_path / "either.yaml"
    file.write_text(text)
    ran = run("rules", "flink", str(file), *SIZE)
    assert ran.code == 2
    assert "either.yaml:20:14: portable: alternation: Flink has no | in a pattern" in ran.words
