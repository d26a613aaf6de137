"""Runs scripts in Flink over and over and says what each run cost; run by the interpreter of `.flink`.

    .flink/bin/python benchmarks/flink_runs.py JOBS.json

JOBS.json: `{"warm_up": n, "runs": n, "jobs": [{"name", "statements", "inserts", "folder"}]}`. Prints a JSON line
for each run that counts: CPU seconds of the Java process, seconds of the clock on the wall, and rows found.
"""

import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from pyflink.common import Configuration
from pyflink.table import EnvironmentSettings, TableEnvironment

_SETTINGS = {
    "parallelism.default": "1",
    "table.local-time-zone": "UTC",
    "taskmanager.numberOfTaskSlots": "1",
    "pipeline.object-reuse": "true",
    "rest.port": "0",
}


def main(jobs_file: str) -> None:
    """Run all jobs, one after the other."""
    asked = json.loads(Path(jobs_file).read_text(encoding="utf-8"))
    configuration = Configuration()
    for key, value in _SETTINGS.items():
        configuration.set_string(key, value)
    settings = EnvironmentSettings.new_instance().in_streaming_mode().with_configuration(configuration).build()
    tables = TableEnvironment.create(settings)
    for number, job in enumerate(asked["jobs"]):
        tables.execute_sql(f"CREATE DATABASE job_{number}")
        tables.execute_sql(f"USE job_{number}")
        for statement in job["statements"]:
            tables.execute_sql(statement)
        for run in range(asked["warm_up"] + asked["runs"]):
            cost = _run(tables, job)
            if run >= asked["warm_up"]:
                print(json.dumps({"name": job["name"], **cost}), flush=True)


def _run(tables: TableEnvironment, job: dict[str, Any]) -> dict[str, float]:
    shutil.rmtree(job["folder"], ignore_errors=True)
    cpu, wall = _java_cpu_s(), time.perf_counter()
    tables.execute_sql(job["insert"]).wait()
    cost = {"cpu_s": _java_cpu_s() - cpu, "wall_s": time.perf_counter() - wall}
    found = sum(len(part.read_bytes().splitlines()) for part in Path(job["folder"]).glob("**/part-*"))
    return {**cost, "rows": found}


def _java_cpu_s() -> float:
    """CPU seconds of the Java process, in which planner, cluster and tasks all run: a child of this one."""
    ours = Path("/proc/self/task").glob("*/children")
    children = [child for each in ours for child in each.read_text().split()]
    (java,) = (child for child in children if Path(f"/proc/{child}/comm").read_text().strip() == "java")
    fields = Path(f"/proc/{java}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main(sys.argv[1])
