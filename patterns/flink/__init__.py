"""The hand-off: a rule as Flink SQL that finds the same situations, or the reason why there is none.

    script = translate(rule, schemas, frame_sizes)
    print(script.text)

Decides, does nothing: text out, no Flink in here. What Flink cannot say, and
what it says but means otherwise than the standard, is refused with its place.
Flink looks at patterns as they complete, without going back; `elements`
tells which patterns that makes no difference for.
"""

from patterns.flink.options import Options
from patterns.flink.script import Script, check, translate

__all__ = ["Options", "Script", "check", "translate"]
