"""The online processor: rules into service, over the log, and what they find into it.

    deploy(log, "brno", rules, texts, utc_now())     # the log says what runs
    processor = Processor(log, "brno", now=utc_now)
    while True:
        processor.step(timeout_s=1.0)

This package alone, of `patterns`, knows the log.
"""

from patterns.processor.deploying import (
    OpenMatches,
    Retirement,
    Service,
    deploy,
    readable_by,
    retire,
    rule_of,
    rules_in_service,
    schemas,
    standing,
)
from patterns.processor.limits import ProcessorLimits
from patterns.processor.processor import Processor, Step
from patterns.processor.reporting import Report, reports
from patterns.processor.saving import stored_mark, stored_state
from patterns.processor.writing import SOURCE, drafts_of, shadow_of, situation_of

__all__ = [
    "SOURCE",
    "OpenMatches",
    "Processor",
    "ProcessorLimits",
    "Report",
    "Retirement",
    "Service",
    "Step",
    "deploy",
    "drafts_of",
    "readable_by",
    "reports",
    "retire",
    "rule_of",
    "rules_in_service",
    "schemas",
    "shadow_of",
    "situation_of",
    "standing",
    "stored_mark",
    "stored_state",
]
