"""Whether the kernel is compiled on this machine, and compiling it.

    python -m patterns.compiling

Compiling takes half a minute of a processor's time, once for a machine and version; then the functions load
from numba's cache in a fraction of a second. Until it is done, rules run on the general matcher, which
finds the same. The cache lies beside the source, or where that cannot be written in the user's cache folder.
"""

import hashlib
import platform
import subprocess
import sys
from pathlib import Path

import numba

from patterns import kernel, raster

_SAMPLE = """rule: sample
version: 1
title: sample
severity: info
zones: {yard: {source: a, units: pixels, polygon: [[0, 0], [9, 0], [9, 9], [0, 9]]}}
match: |
  SELECT * FROM sample MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time, sequence
    MEASURES A.time AS began, LAST(B.x) AS x
    PATTERN (A B*? C) WITHIN INTERVAL '1' HOUR
    DEFINE A AS NOT in_zone(A.x, A.y, 'yard'), B AS B.x > PREV(B.x),
           C AS in_zone(C.x, C.y, 'yard') AND C.time >= A.time + INTERVAL '1' SECOND)
"""


def is_compiled() -> bool:
    """Whether the kernel, as it is now, was compiled on this machine before."""
    return _marker().exists()


def compile_kernel() -> None:
    """Compiles the kernel if it was not; when this returns, it is."""
    if not is_compiled():
        _run_sample()
        _marker().touch()


def start_compiling() -> "subprocess.Popen[bytes] | None":
    """A process that compiles the kernel, when it is not; the caller waits for it or lets it be."""
    if is_compiled():
        return None
    return subprocess.Popen([sys.executable, "-m", "patterns.compiling"])


def _marker() -> Path:
    """The file that says it: named by what numba's cache depends on."""
    sources = b"".join(Path(str(module.__file__)).read_bytes() for module in (kernel, raster))
    machine = f"{numba.__version__} {platform.python_version()} {platform.machine()} {platform.node()}"
    name = hashlib.sha256(sources + machine.encode()).hexdigest()[:16]
    return Path(kernel.run.stats.cache_path) / f"kernel-{name}.compiled"


def _run_sample() -> None:
    """Runs every compiled function once, with the types that it always has."""
    import pyarrow as pa

    from patterns.binder import bind
    from patterns.loading import parse_rule
    from patterns.ruleset import RuleSetRun

    columns = {
        "station": ["s"] * 6, "source": ["a"] * 6, "type": ["sample"] * 6, "sequence": [1, 2, 3, 4, 6, 5],
        "time": pa.array([second * 1_000_000 for second in (0, 1, 2, 3, 9, 4)], pa.timestamp("us", "UTC")),
        "key": ["k", "k", "k", "l", "k", "l"], "x": [20.0, 21.0, 5.0, 20.0, 5.0, 21.0], "y": [5.0] * 6,
    }  # fmt: skip
    rows = pa.table(columns)
    bound = bind(parse_rule(_SAMPLE), {"sample": rows.schema})
    group = RuleSetRun([bound], uses_kernel=True)
    group.push(rows)
    state = group.state("sample")
    group.status("sample")
    group.finish()
    restored = RuleSetRun(uses_kernel=True)
    restored.add(bound, state)
    restored.compile_rest("sample")
    restored.finish()


if __name__ == "__main__":
    compile_kernel()
