"""Writes docs/performance.md from the results of the benchmarks' last runs.

    python -m benchmarks.report

A test holds the page to the results: whoever measures anew writes it anew.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "performance.md"
_HEAD = """# Performance

Written by `python -m benchmarks.report` from the last runs; do not edit. Figures come from a shared machine with two
cores: read them as ratios, each taken beside its reference in one run, commits durable (`fsync` and
`synchronous_commit` on).
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


def page() -> str:
    """The page's text."""
    sections = [*_log(_loaded("log")), *_sustained(_loaded("sustained")), *_growth(_loaded("growth"))]
    if (RESULTS / "patterns.json").exists():
        if (RESULTS / "flink.json").exists():
            sections += beside_flink(_loaded("patterns"), _loaded("flink"))
        sections += of_rules(_loaded("patterns"))
    if all((RESULTS / f"{name}.json").exists() for name in ("patterns_log", "flink")):
        sections += over_the_log(_loaded("patterns_log"), _loaded("flink"))
    if (RESULTS / "sync.json").exists():
        sections += of_sync(_loaded("sync"))
    if (RESULTS / "accuracy.json").exists():
        sections += of_accuracy(_loaded("accuracy"))
    if (RESULTS / "extractors.json").exists():
        sections += of_extractors(_loaded("extractors"))
    if (RESULTS / "long_input.json").exists():
        sections += of_long_input(_loaded("long_input"))
    return "\n".join([_HEAD, *sections])


def _loaded(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return found


def _log(said: dict[str, Any]) -> Iterator[str]:
    yield f"## Beside references\n\n`python -m benchmarks.log`, {_when(said)}.\n"
    yield "| what | ours | reference | ratio | target |\n|---|---:|---:|---:|---|"
    for row in said["rows"]:
        yield (
            f"| {row['what']} | {row['ours']:,.0f} {row['unit']} | {row['reference']:,.0f} ({row['reference_name']}) "
            f"| {row['ratio']:.2f} | {_target(row)} |"
        )
    yield ""


def _target(row: dict[str, Any]) -> str:
    if row["target"] is None:
        return ""
    is_reached = row["ratio"] >= row["target"] if row["at_least"] else row["ratio"] <= row["target"]
    return f"{'at least' if row['at_least'] else 'at most'} {row['target']:g}: {'reached' if is_reached else 'missed'}"


def _sustained(said: dict[str, Any]) -> Iterator[str]:
    yield f"## For long, and in bursts\n\n`python -m benchmarks.sustained`, {_when(said)}.\n"
    yield (
        "| load | events/s | for | commit to subscriber, p50 / p99 | cores, PostgreSQL included | memory, middle / end "
        "| most segments without rows | caught up after |\n|---|---:|---:|---:|---:|---:|---:|---:|"
    )
    for each in said["outcomes"]:
        yield (
            f"| {each['load']} | {each['events_per_s_reached']:,.0f} | {each['seconds']:g} s "
            f"| {each['latency_p50_ms']:.1f} / {each['latency_p99_ms']:.1f} ms | {each['cores']:.2f} "
            f"| {each['memory_mb_middle']:.0f} / {each['memory_mb_end']:.0f} MB "
            f"| {each['projector_lag_segments_max']:,} | {each['seconds_to_catch_up']:.1f} s |"
        )
    yield ""


def _growth(said: dict[str, Any]) -> Iterator[str]:
    yield f"## As the log grows\n\n`python -m benchmarks.growth --plot docs/performance-growth.svg`, {_when(said)}.\n"
    yield "![cost of an append and a read an event, and memory, over the log's length](performance-growth.svg)\n"
    yield "| events in the log | append, µs an event | catch-up, µs an event | memory |\n|---:|---:|---:|---:|"
    for point in said["points"]:
        yield (
            f"| {point['events']:,} | {point['append_us']:.2f} | {point['read_us']:.3f} | {point['memory_mb']:.0f} MB |"
        )
    yield ""


def beside_flink(patterns: dict[str, Any], flink: dict[str, Any]) -> Iterator[str]:
    """The section on rules in process, each beside Flink on the same rows."""
    yield (
        f"## Rules beside Flink\n\n`python -m benchmarks.patterns`, {_when(patterns)}; `python -m benchmarks.flink`, "
        f"{_when(flink)}. Events per CPU-second of the process; Flink warmed up and without the start of its jobs.\n"
    )
    yield "| rule | keys | ours | Flink | Flink, reading alone | ratio | target |\n|---|---:|---:|---:|---:|---:|---|"
    theirs = {(row["what"], row["keys"]): row for row in flink["flink"]}
    for row in patterns["in_process"]:
        reference = theirs.get((row["what"], row["keys"]))
        if reference is None:
            continue
        alone = theirs[f"{row['what']}: pass-through", row["keys"]]
        rates = [each["events_per_cpu_s"] for each in (row, reference, alone)]
        ratio = rates[0] / rates[1]
        shown = " | ".join(f"{rate:,.0f}" for rate in rates)
        target = _target({"ratio": ratio, **_FLINK_TARGET})
        yield f"| {row['what']} | {row['keys']:,} | {shown} | {ratio:.0f} | {target} |"
    yield ""


def of_rules(said: dict[str, Any]) -> Iterator[str]:
    """The section on what rules cost: many keys, many rules, hard patterns, state and starting."""
    yield f"## Rules in process\n\n`python -m benchmarks.patterns`, {_when(said)}; CPU of the process.\n"
    yield "| rules | keys | events per CPU-second | events a second | situations |\n|---|---:|---:|---:|---:|"
    for row in said["in_process"]:
        rates = f"{row['events_per_cpu_s']:,.0f} | {row['events_per_wall_s']:,.0f}"
        yield f"| {row['what']} | {row['keys']:,} | {rates} | {row['matches']:,} |"
    yield "\n| what | reached | target |\n|---|---:|---|"
    for what, reached, unit, row in _single(said):
        yield f"| {what} | {reached:,.{_digits(reached)}f}{unit} | {_target({'ratio': reached, **row})} |"
    yield "\n| pattern | as | rows | CPU | growth: 1 is linear | matches |\n|---|---|---:|---:|---:|---:|"
    for row in said["worst_cases"]:
        growth = row["error"] or f"{row['growth']:.2f}"
        what = row["what"].replace("|", "\\|")
        yield f"| {what} | {row['way']} | {row['rows']:,} | {row['seconds']:.1f} s | {growth} | {row['matches']:,} |"
    yield ""


def _single(said: dict[str, Any]) -> Iterator[tuple[str, float, str, dict[str, Any]]]:
    """What was reached, in which unit, and what was wanted."""
    rates = {(row["what"], row["keys"]): row["events_per_cpu_s"] for row in said["in_process"]}
    for what in ("zone intrusion", "A then B", "line crossing"):
        share = rates[what, 1_000_000] / rates[what, 10_000]
        yield f"{what} at 1,000,000 keys, of its rate at 10,000", share, "", _wanted(0.2)
    many, one = rates["100 zone rules", 10_000], rates["one zone rule", 10_000]
    yield "100 zone rules, events per CPU-second", many, "", _wanted(2e6)
    yield "100 zone rules, of 100 times what one costs", one / many / 100, "", _wanted(1 / 15, at_least=False)
    yield f"line crossing beside {said['duckdb']['reference_name']}", said["duckdb"]["ratio"], " times", _wanted(1.0)
    costs = said["costs"]
    what = f"checkpoint of {costs['checkpoint_partitions']:,} open partitions"
    yield what, costs["checkpoint_ms"], " ms", _wanted(100, at_least=False)
    yield f"{what}, size", costs["checkpoint_mb"], " MB", _wanted(20, at_least=False)
    yield f"{what}, read again", costs["restore_ms"], " ms", _wanted(None)
    yield "start to first match", costs["start_cpu_s"], " s", _wanted(2, at_least=False)
    yield "start to first match, kernel never compiled", costs["first_start_cpu_s"], " s", _wanted(2, at_least=False)
    yield "compiling the kernel, once", costs["compiling_cpu_s"], " s", _wanted(None)
    yield "reload of one rule among 100", costs["reload_ms"], " ms", _wanted(50, at_least=False)
    yield "a step of 2,500 rows, 20 rules", costs["step_ms"], " ms", _wanted(None)


def over_the_log(said: dict[str, Any], flink: dict[str, Any]) -> Iterator[str]:
    """The section on rules from the log to the situations in it."""
    yield (
        f"## Rules over the log\n\n`python -m benchmarks.patterns_log`, {_when(said)}; events per CPU-second of the "
        "process, from stored segments to committed situations. Flink as above, in process.\n"
    )
    yield "| rule | keys | situations | ours | events a second | Flink | ratio | target |"
    yield "|---|---:|---:|---:|---:|---:|---:|---|"
    theirs = {(row["what"], row["keys"]): row["events_per_cpu_s"] for row in flink["flink"]}
    for row in said["catch_up"]:
        reference = theirs.get((row["rule"], row["keys"]))
        if reference is not None:
            ratio = row["events_per_cpu_s"] / reference
            shown = f"{row['events_per_cpu_s']:,.0f} | {row['events_per_wall_s']:,.0f} | {reference:,.0f} | {ratio:.0f}"
            target = _target({"ratio": ratio, **_wanted(25.0)})
            yield f"| {row['rule']} | {row['keys']:,} | {row['situations']:,} | {shown} | {target} |"
    yield "\n| what | reached | target |\n|---|---:|---|"
    for what, reached, unit, row in _live(said):
        yield f"| {what} | {reached:,.{_digits(reached)}f}{unit} | {_target({'ratio': reached, **row})} |"
    online = said["online"]
    yield (
        f"\nOnline: {online['events_per_s']:,} events a second, {online['rules']} rules, {online['situations']:,} "
        f"situations in {online['seconds']:.0f} s.\n"
    )


def _live(said: dict[str, Any]) -> Iterator[tuple[str, float, str, dict[str, Any]]]:
    """What was reached while events came, in which unit, and what was wanted."""
    online, hour = said["online"], said["memory"]
    what = "from the commit that lifts the watermark to the committed situation"
    yield f"{what}, p50", online["latency_p50_ms"], " ms", _wanted(None)
    yield f"{what}, p99", online["latency_p99_ms"], " ms", _wanted(150, at_least=False)
    yield "of a core, meanwhile", online["cores"], "", _wanted(1, at_least=False)
    what = f"memory after {hour['seconds'] / 60:.0f} minutes of event time, of that after a quarter of them"
    yield what, hour["quarters_mb"][-1] / hour["quarters_mb"][0], " times", _wanted(1.1, at_least=False)
    yield "one rule among 100 replaced, through the log", said["reload_ms"], " ms", _wanted(50, at_least=False)


def of_sync(said: dict[str, Any]) -> Iterator[str]:
    """The section on a station's log that comes to be central's."""
    yield (
        f"## From a station to central\n\n`python -m benchmarks.sync`, {_when(said)}; both programs and both logs on "
        "this machine, TLS on, each program in a network namespace of its own. Logical replication is PostgreSQL's, "
        "binary, of the same events as typed rows; its subscriber waits for the disk at each commit, as central does, "
        "unless it says otherwise. The slow link is a TUN device on each side, whose packets wait as on a line of "
        "that rate and delay.\n"
    )
    yield "| what | ours | reference | ratio | target |\n|---|---:|---:|---:|---|"
    for row in said["rows"]:
        if "reference" in row:
            ours, theirs = (f"{row[side]:,.{_digits(row[side])}f}" for side in ("ours", "reference"))
            yield (
                f"| {row['what']} | {ours} {row['unit']} | {theirs} ({row['reference_name']}) "
                f"| {row['ratio']:.2f} | {_target(row)} |"
            )
    yield "\n| what | reached | target |\n|---|---:|---|"
    for row in said["rows"]:
        if "reached" in row:
            reached = f"{row['reached']:,.{_digits(row['reached'])}f} {row['unit']}".rstrip()
            yield f"| {row['what']} | {reached} | {_target({'ratio': row['reached'], **row})} |"
    yield ""


def of_accuracy(said: dict[str, Any]) -> Iterator[str]:
    """The section on how right tracks, horizons and positions are."""
    yield (
        f"## Accuracy\n\n`python -m benchmarks.accuracy`, {_when(said)}, on public data beside references in one run. "
        "Errors of horizons are in image heights. SORT and ByteTrack are those of the package `trackers` on the public "
        "detections, A and B the plain methods of `vian.evaluation.references`. The method and the scenes as pictures: "
        "[evaluation](guides/evaluation.md), [gallery](gallery/README.md).\n"
    )
    yield "| what | measure | ours | beside | wanted |\n|---|---|---:|---|---|"
    for row in said["rows"]:
        beside = ", ".join(f"{name} {_figure(value)}" for name, value in row["references"].items() if value is not None)
        wanted = row["wanted"] and f"{row['wanted']}: {'reached' if row['is_reached'] else 'missed'}"
        yield f"| {row['what']} | {row['measure']} | {_figure(row['ours'])} | {beside} | {wanted} |"
    yield ""


def of_extractors(said: dict[str, Any]) -> Iterator[str]:
    """The section on how fast extraction is."""
    yield (
        f"## Extraction\n\n`python -m benchmarks.extractors --lines 576 VIDEO`, {_when(said)}, on the PETS clip, one "
        "thread. Motion is from decoded frames to batches of events; from file to stored segments is all that "
        "`vian extract motion` does: the decoding process, horizon, calibration and PostgreSQL share one processor.\n"
    )
    yield "| what | ours | reference | ratio | target |\n|---|---:|---:|---:|---|"
    for row in said["rows"]:
        if "reference" in row:
            ours, theirs = (f"{row[side]:,.{_digits(row[side])}f}" for side in ("ours", "reference"))
            yield (
                f"| {row['what']} | {ours} {row['unit']} | {theirs} ({row['reference_name']}) | {row['ratio']:.2f} "
                f"| {_target(row)} |"
            )
        else:
            reached = f"{row['reached']:,.{_digits(row['reached'])}f} {row['unit']}"
            yield f"| {row['what']} | {reached} | | | {_target({'ratio': row['reached'], **row})} |"
    yield ""


def of_long_input(said: dict[str, Any]) -> Iterator[str]:
    """The section on memory while a long video is extracted."""
    samples = said["samples"]
    yield (
        "## Memory over a long input\n\n"
        "`python -m benchmarks.long_input --plot docs/performance-long-input.svg VIDEO`, "
        f"{_when(said)}: the PETS clip in a loop, {samples[-1]['minutes']:.0f} minutes, {said['pictures']:,} pictures, "
        f"{said['events']:,} events, from the video to stored segments.\n"
    )
    yield "![resident memory over the minutes of the input](performance-long-input.svg)\n"
    yield "| process | largest in the first third | in the second | in the last | last over first | target |"
    yield "|---|---:|---:|---:|---:|---|"
    third = len(samples) // 3
    for name, key in (("extractor, with the horizon", "extractor_mb"), ("decoding process", "decoder_mb")):
        largest = [max(each[key] for each in samples[i * third : (i + 1) * third]) for i in range(3)]
        shown = " | ".join(f"{each:.0f} MB" for each in largest)
        ratio = largest[2] / largest[0]
        target = _target({"ratio": ratio, **_wanted(1.1, at_least=False)})
        yield f"| {name} | {shown} | {ratio:.2f} | {target} |"
    yield ""


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _wanted(target: float | None, *, at_least: bool = True) -> dict[str, Any]:
    return {"target": target, "at_least": at_least}


def _digits(value: float) -> int:
    """So many that three count."""
    return 0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3


_FLINK_TARGET = {"target": 50.0, "at_least": True}


def _when(said: dict[str, Any]) -> str:
    return f"{said['measured_at'][:10]}{', a quick run' if said['is_quick'] else ''}"


if __name__ == "__main__":
    main()
