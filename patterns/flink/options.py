"""How a script is to be."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Options:
    """How a script is to be.

    Attributes:
        source_tables: For event types whose table is there already, its name; the others' are made.
        connector: The options of a table that is made, `{type}` standing for the event type; empty: a
            Kafka topic to be filled in.
        whole_milliseconds: Whether all times are whole milliseconds, the precision of Flink's event time;
            then the script needs no more than Flink's own WITHIN.
        one_station: Whether all events are of one station, and each source has one stream of a type.
    """

    source_tables: Mapping[str, str] = field(default_factory=dict)
    connector: Mapping[str, str] = field(default_factory=dict)
    whole_milliseconds: bool = False
    one_station: bool = False
