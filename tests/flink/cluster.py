"""Runs scripts in Flink and writes what they found; run by the interpreter of `.flink`, which has no ViAn.

    .flink/bin/python tests/flink/cluster.py JOBS.json RESULTS_FOLDER

JOBS.json is a list of `{"name", "statements", "result"}`; all run in one process on one local cluster, as one
streaming job over bounded input. RESULTS_FOLDER gets JSON lines `{"name", "row"}`, each value of a row as text.
"""

import json
import sys
from pathlib import Path
from typing import Any

from pyflink.common import Configuration
from pyflink.table import EnvironmentSettings, TableEnvironment

_SETTINGS = {
    "parallelism.default": "1",
    "table.local-time-zone": "UTC",
    "taskmanager.numberOfTaskSlots": "1",
    "rest.port": "0",
    "table.exec.resource.default-parallelism": "1",
}


def environment() -> TableEnvironment:
    """A table environment with a local cluster of one slot."""
    configuration = Configuration()
    for key, value in _SETTINGS.items():
        configuration.set_string(key, value)
    settings = EnvironmentSettings.new_instance().in_streaming_mode().with_configuration(configuration).build()
    return TableEnvironment.create(settings)


def main(jobs_file: str, results: str) -> None:
    """Run all jobs."""
    jobs = json.loads(Path(jobs_file).read_text(encoding="utf-8"))
    tables = environment()
    tables.execute_sql(
        "CREATE TABLE default_database.results (`name` STRING, `row` STRING) WITH "
        f"('connector' = 'filesystem', 'path' = '{results}', 'format' = 'json')"
    )
    inserts = tables.create_statement_set()
    added: dict[int, str] = {}
    for number, job in enumerate(jobs):
        tables.execute_sql(f"CREATE DATABASE job_{number}")
        tables.execute_sql(f"USE job_{number}")
        for statement in job["statements"]:
            tables.execute_sql(statement)
        names = tables.sql_query(f"SELECT * FROM `{job['result']}`").get_schema().get_field_names()
        pairs = ", ".join(f"KEY '{name}' VALUE CAST(`{name}` AS STRING)" for name in names)
        insert = (
            f"INSERT INTO default_database.results SELECT '{job['name']}', "
            f"JSON_OBJECT({pairs} NULL ON NULL) FROM `{job['result']}`"
        )
        added[number] = insert
        inserts.add_insert_sql(insert)
    try:
        inserts.execute().wait()
    except Exception as error:
        raise SystemExit(f"{_reason(error)}\n{_refused(tables, jobs, added)}") from None


def _refused(tables: TableEnvironment, jobs: list[dict[str, Any]], inserts: dict[int, str]) -> str:
    """The first job that has no plan, if it was that."""
    for number, insert in inserts.items():
        tables.execute_sql(f"USE job_{number}")
        try:
            tables.explain_sql(insert)
        except Exception as error:
            return f"{jobs[number]['name']}: {_reason(error)}\n" + ";\n".join(jobs[number]["statements"])
    return "all jobs have a plan"


def _reason(error: Exception) -> str:
    """The causes of a Java error, without where each was thrown."""
    return "\n".join(line for line in str(error).splitlines() if not line.lstrip().startswith(("at ", "...")))


if __name__ == "__main__":
    main(*sys.argv[1:])
