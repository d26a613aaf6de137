"""The page of figures is what the last runs measured, and nothing else."""

from benchmarks.report import PAGE, RESULTS, beside_flink, page


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
