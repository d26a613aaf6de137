"""One rule and its rows in both engines: what is asked of each, and what each said, in one form."""

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from patterns import Rule, bind, match
from patterns.flink import Options, translate
from patterns.scene.site import Site

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".flink" / "bin" / "python"
_CLUSTER = Path(__file__).with_name("cluster.py")


@dataclass(frozen=True)
class Case:
    """A rule, its rows, and what is needed to bind it."""

    name: str
    rule: Rule
    rows: pa.Table
    schemas: dict[str, pa.Schema]
    site: Site
    options: Options = field(default_factory=Options)


def ours(case: Case) -> list[dict[str, Any]]:
    """What this engine finds, in the form that `theirs` has."""
    bound = bind(case.rule, case.schemas, site=case.site)
    found = []
    rows = pa.concat_tables([case.rows, _later(case.rows)]) if bound.timers else case.rows
    for each in match(bound, rows):
        row = {**each.partition, **each.measures}
        for which, event in (("first", each.first), ("last", each.last)):
            row |= {f"{which}_stream": event.stream, f"{which}_sequence": event.sequence, f"{which}_time": event.time}
        found.append({name: _said(value) for name, value in row.items()})
    return _sorted(found)


def _later(rows: pa.Table) -> pa.Table:
    """A row of no interest, a day after the last: with it time comes to every timer, as in Flink at the input's end."""
    last = pc.max(rows.column("time")).as_py() + timedelta(days=1)
    row = {**rows.slice(0, 1).to_pylist()[0], "type": "later", "time": last, "sequence": 1}
    return pa.Table.from_pylist([row], schema=rows.schema)


def theirs(cases: Sequence[Case], folder: Path) -> dict[str, list[dict[str, Any]]]:
    """What Flink finds, by the case's name; all cases in one process."""
    found = run_in_flink([_job(case, folder) for case in cases], folder)
    return {name: _sorted(rows) for name, rows in found.items()}


def run_in_flink(jobs: Sequence[dict[str, Any]], folder: Path) -> dict[str, list[dict[str, Any]]]:
    """The rows of each job's result, by the job's name; all jobs in one process."""
    (folder / "jobs.json").write_text(json.dumps(jobs), encoding="utf-8")
    results = folder / "results"
    # Flink's process must not see ViAn's folders: it imports modules by their top-level names.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    ran = subprocess.run(
        [PYTHON, "-W", "ignore", _CLUSTER, folder / "jobs.json", results],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-8000:]
    found: dict[str, list[dict[str, Any]]] = {job["name"]: [] for job in jobs}
    for file in results.glob("**/part-*"):
        for line in file.read_text(encoding="utf-8").splitlines():
            said = json.loads(line)
            row = json.loads(said["row"])
            row.pop("fired_at_ms", None)
            found[said["name"]].append(row)
    return found


def comparable(case: Case, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with numbers as numbers: Java and Python write the same double differently."""
    floats = {output.name for output in bind(case.rule, case.schemas, site=case.site).measures
              if output.value.kind.name == "FLOAT"}  # fmt: skip
    return [
        {name: float(value) if name in floats and value is not None else value for name, value in row.items()}
        for row in rows
    ]


def _job(case: Case, folder: Path) -> dict[str, Any]:
    # In order of time: what comes too late is left out by both engines, but not by one that is given all rows at once.
    arriving = case.rows.sort_by("time")
    path = folder / "rows" / case.name
    for event_type in bind(case.rule, case.schemas, site=case.site).types:
        rows = arriving.filter(pc.equal(arriving.column("type"), event_type))
        (path / event_type).mkdir(parents=True)
        lines = [f"{line}\n" for line in json_rows(rows)]
        (path / event_type / "rows.json").write_text("".join(lines), encoding="utf-8")
    connector = {"connector": "filesystem", "path": f"{path}/{{type}}", "format": "json",
                 "json.timestamp-format.standard": "ISO-8601"}  # fmt: skip
    script = translate(case.rule, case.schemas, None, replace(case.options, connector=connector), case.site)
    return {
        "name": case.name,
        "statements": [statement for _, statement in script.statements],
        "result": script.result,
    }


def json_rows(rows: pa.Table) -> list[str]:
    """The rows as the script's table expects them: one JSON object a row, times in ISO 8601."""
    return [json.dumps({name: _plain(value) for name, value in row.items()}) for row in rows.to_pylist()]


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    if isinstance(value, timedelta):
        return value // timedelta(microseconds=1)
    return None if isinstance(value, bytes) else value


def _said(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, datetime):
        return value.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S.%f")
    if isinstance(value, timedelta):
        return str(value // timedelta(microseconds=1))
    return str(value)


def _sorted(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(rows, key=lambda row: (*_place(row, "first"), *_place(row, "last"), json.dumps(row, sort_keys=True)))


def _place(row: dict[str, Any], which: str) -> tuple[str, str, int]:
    return row[f"{which}_time"], row.get(f"{which}_stream", ""), int(row[f"{which}_sequence"])
