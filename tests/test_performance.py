"""The page of figures is what the last runs measured, and nothing else."""

from benchmarks.report import PAGE, RESULTS, page


def test_the_page_is_written_from_the_results() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "Next: python -m benchmarks.report"


def test_each_result_on_the_page_is_one_of_a_whole_run() -> None:
    for results in RESULTS.glob("*.json"):
        assert '"is_quick": false' in results.read_text(encoding="utf-8"), f"{results.name} is of a quick run"
