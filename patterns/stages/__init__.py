"""Stages: relations between objects and counts over time, derived from final rows as ordinary events.

A rule's pattern sees one partition at a time; what lies between partitions (how near two tracks are, how
many are in a zone) is derived before it, once for all rules. A stage is one YAML file, as a rule is:

    stage = load_stage(Path("stages/near.yaml"))
    derive(stage, rows)                      # all rows at once: the definition

    run = StageRun(stage)                    # the same online
    run.push(batch).derived

What a stage derives depends on its rows alone, not on how they came, as long as none is late. What it
remembers is bounded, and saved with `StageRun.state`.
"""

from patterns.stages.cases import run_stage_tests
from patterns.stages.files import load_stage, load_stages, parse_stage
from patterns.stages.running import Derived, StageOutcome, StageRun, derive
from patterns.stages.settings import Stage

__all__ = [
    "Derived",
    "Stage",
    "StageOutcome",
    "StageRun",
    "derive",
    "load_stage",
    "load_stages",
    "parse_stage",
    "run_stage_tests",
]
