"""Whether the kernel is compiled on this machine, and compiling it.

    python -m patterns.engine.compiling

Compiling takes half a minute of a processor's time, once for a machine and version; then the functions load
from numba's cache in a fraction of a second. Until it is done, rules run on the general matcher, which
finds the same. The cache lies beside the source, or where that cannot be written in the user's cache folder.
"""

import hashlib
import logging
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Thread

logger = logging.getLogger(__name__)

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
    marker = _marker()
    return marker is not None and marker.exists()


def compile_kernel() -> None:
    """Compiles the kernel if it was not; when this returns, it is."""
    marker = _marker()
    if marker is None or not marker.exists():
        _run_sample()
    if marker is not None:
        marker.touch()


@contextmanager
def compiling_beside() -> Iterator[None]:
    """Compiles the kernel in a process of low priority beside what is done meanwhile, if it was not compiled.

    That it fails is logged and harms nothing. What is left when the block ends is compiled another time.
    """
    if _marker() is None or is_compiled():
        yield
        return
    process = subprocess.Popen(
        [sys.executable, "-m", "patterns.engine.compiling"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )  # fmt: skip
    is_told_to_end = False

    def reap() -> None:
        _, said = process.communicate()
        if process.returncode and not is_told_to_end:
            logger.warning(
                "the kernel is not compiled (exit %d), so rules run on the general matcher, slower. "
                "Next: python -m patterns.engine.compiling. It said: %s",
                process.returncode, said.decode(errors="replace").strip()[-500:],
            )  # fmt: skip

    reaper = Thread(target=reap, name="compiling", daemon=True)
    reaper.start()
    try:
        yield
    finally:
        is_told_to_end = True
        process.terminate()
        reaper.join()


@cache
def _marker() -> Path | None:
    """The file that says it: named by what numba's cache depends on. None: nothing can be kept."""
    # Numba takes a third of a second to import: only who asks pays that.
    import numba

    from patterns.engine import jit, kernel, raster

    folder = kernel.run.stats.cache_path
    if folder is None:
        return None
    sources = b"".join(Path(str(module.__file__)).read_bytes() for module in (jit, kernel, raster))
    machine = f"{numba.__version__} {platform.python_version()} {platform.machine()} {platform.node()}"
    name = hashlib.sha256(sources + machine.encode()).hexdigest()[:16]
    return Path(folder) / f"kernel-{name}.compiled"


def _run_sample() -> None:
    """Runs every compiled function once, with the types that it always has."""
    import pyarrow as pa

    from patterns.binding.binder import bind
    from patterns.engine.ruleset import RuleSetRun
    from patterns.files.loading import parse_rule

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
    os.nice(10)  # what waits for it goes on meanwhile, and comes first
    compile_kernel()
