"""The page of figures is what the last runs measured, and nothing else."""

from benchmarks import accuracy
from benchmarks.measuring import Figure, Row
from benchmarks.report import (
    PAGE,
    RESULTS,
    beside_flink,
    of_accuracy,
    of_extractors,
    of_long_input,
    of_rules,
    of_sync,
    over_the_log,
    page,
)


def test_the_page_is_written_from_the_results() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "Next: python -m benchmarks.report"


def test_each_result_on_the_page_is_one_of_a_whole_run() -> None:
    for results in RESULTS.glob("*.json"):
        assert '"is_quick": false' in results.read_text(encoding="utf-8"), f"{results.name} is of a quick run"


def test_rules_stand_beside_flink_on_the_same_rows() -> None:
    run = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False}
    ours = [{"what": "line crossing", "keys": keys, "events_per_cpu_s": 4e6} for keys in (100, 1_000_000)]
    theirs = [
        {"what": f"line crossing{what}", "keys": 100, "events_per_cpu_s": rate}
        for what, rate in (("", 80_000), (": pass-through", 600_000))
    ]
    section = list(beside_flink({**run, "in_process": ours}, {**run, "flink": theirs}))
    assert section[2:-1] == ["| line crossing | 100 | 4,000,000 | 80,000 | 600,000 | 50 | at least 50: reached |"]


def test_what_rules_cost_stands_beside_what_was_wanted() -> None:
    rates = {"zone intrusion": 4e6, "A then B": 3e6, "line crossing": 4e6, "one zone rule": 8e6, "100 zone rules": 2e6}
    costs = {
        "checkpoint_partitions": 130_000, "checkpoint_ms": 80.0, "checkpoint_mb": 3.5, "restore_ms": 120.0,
        "start_cpu_s": 2.5, "first_start_cpu_s": 1.8, "compiling_cpu_s": 30.0, "reload_ms": 20.0, "step_ms": 1.0,
    }  # fmt: skip
    said = {
        "measured_at": "2026-01-01T10:00:00+00:00",
        "is_quick": False,
        "in_process": [
            {"what": what, "keys": keys, "events_per_cpu_s": rate, "events_per_wall_s": rate, "matches": 9}
            for what, rate in rates.items()
            for keys in (10_000, 1_000_000)
        ],
        "duckdb": {"reference_name": "DuckDB", "ratio": 1.5},
        "costs": costs,
        "worst_cases": [
            {"what": "(A|B)*?", "way": "rule", "rows": 8, "seconds": 1.0, "growth": 1.0, "matches": 0, "error": None}
        ],
    }
    section = "\n".join(of_rules(said))
    assert "| 100 zone rules, of 100 times what one costs | 0.040 | at most 0.0666667: reached |" in section
    assert "| start to first match | 2.50 s | at most 2: missed |" in section
    assert "| (A\\|B)*? | rule | 8 | 1.0 s | 1.00 | 0 |" in section


def test_rules_over_the_log_stand_beside_flink_and_what_was_wanted() -> None:
    run = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False}
    caught_up = {"rule": "A then B", "keys": 100, "situations": 7, "events_per_cpu_s": 2e6, "events_per_wall_s": 1e6}
    online = {"events_per_s": 25_000, "rules": 20, "situations": 500, "seconds": 60.0, "cores": 0.2}
    latency = {"latency_p50_ms": 40.0, "latency_p99_ms": 160.0}
    said = {**run, "catch_up": [caught_up], "online": online | latency, "reload_ms": 30.0}
    hour = {"seconds": 3600.0, "quarters_mb": [200.0, 205.0, 206.0, 206.0]}
    theirs = [{"what": "A then B", "keys": 100, "events_per_cpu_s": 80_000}]
    section = "\n".join(over_the_log(said | {"memory": hour}, {**run, "flink": theirs}))
    assert "| A then B | 100 | 7 | 2,000,000 | 1,000,000 | 80,000 | 25 | at least 25: reached |" in section
    assert "committed situation, p99 | 160 ms | at most 150: missed |" in section
    assert "| memory after 60 minutes of event time, of that after a quarter of them | 1.03 times |" in section


def test_sync_stands_beside_its_references_and_what_was_wanted() -> None:
    raced = Row("durable end to end", "events/s", 900_000.0, 300_000.0, "logical replication", 3.0, 4.0)
    latency = Figure("an alert at central, max of 90", "s", 0.81, 1.0, at_least=False)
    plain = Figure("payload", "%", 93.5)
    said = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False}
    section = list(of_sync(said | {"rows": [each.plain() for each in (raced, latency, plain)]}))
    assert (
        "| durable end to end | 900,000 events/s | 300,000 (logical replication) | 3.00 | at least 4: missed |"
        in section
    )
    assert "| an alert at central, max of 90 | 0.810 s | at most 1: reached |" in section
    assert "| payload | 93.5 % |  |" in section


def test_accuracy_stands_beside_its_references_and_what_was_wanted() -> None:
    peers = {"SORT": 0.40, "ByteTrack": 0.45}
    rows = [
        accuracy.Row("tracking", "IDF1", 0.8, peers, 0.75, is_ahead_wanted=True),
        accuracy.Row("tracking", "HOTA", 0.42, peers, is_ahead_wanted=True),
        accuracy.Row("horizon", "coverage", 1.0, {"A": None}, 0.9, target_max=0.99),
        accuracy.Row("horizon", "error", None, {"A": 0.1}, 0.03, at_least=False),
        accuracy.Row("tracker", "MOTA", 0.5, peers),
    ]
    said = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False, "rows": [row.plain() for row in rows]}
    assert list(of_accuracy(said))[2:-1] == [
        "| tracking | IDF1 | 0.800 | SORT 0.400, ByteTrack 0.450 | at least 0.75 and not behind any: reached |",
        "| tracking | HOTA | 0.420 | SORT 0.400, ByteTrack 0.450 | not behind any: missed |",
        "| horizon | coverage | 1.000 |  | 0.9 to 0.99: missed |",
        "| horizon | error |  | A 0.100 | at most 0.03: missed |",
        "| tracker | MOTA | 0.500 | SORT 0.400, ByteTrack 0.450 |  |",
    ]


def test_memory_over_a_long_input_stands_by_thirds() -> None:
    samples = [
        {"minutes": float(minute + 1), "extractor_mb": 360.0 + 10 * (minute % 3), "decoder_mb": 70.0 + 5 * minute}
        for minute in range(6)
    ]
    said = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False, "pictures": 3600, "events": 900}
    section = list(of_long_input(said | {"samples": samples}))
    assert section[-3:-1] == [
        "| extractor, with the horizon | 370 MB | 380 MB | 380 MB | 1.03 | at most 1.1: reached |",
        "| decoding process | 75 MB | 85 MB | 95 MB | 1.27 | at most 1.1: missed |",
    ]


def test_extraction_stands_beside_its_reference_and_what_was_wanted() -> None:
    rows = [
        Row("file to segments", "frames/s", 54.0, 98.0, "MOG2", 0.56, 0.5),
        Figure("update of the horizon", "s", 0.61, 0.5, at_least=False),
    ]
    said = {"measured_at": "2026-01-01T10:00:00+00:00", "is_quick": False, "rows": [row.plain() for row in rows]}
    assert list(of_extractors(said))[2:-1] == [
        "| file to segments | 54.0 frames/s | 98.0 (MOG2) | 0.56 | at least 0.5: reached |",
        "| update of the horizon | 0.610 s | | | at most 0.5: missed |",
    ]
