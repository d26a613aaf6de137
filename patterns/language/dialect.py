"""The SQL of expressions inside MATCH_RECOGNIZE as queries write it: DuckDB's, with every function left by its name.

sqlglot knows many functions and writes some of them in another way than it read
them. A query's expressions go back to DuckDB as they came, so here a function
is a name and its arguments. Navigation and `RUNNING`, `FINAL` are told apart by
`patterns.language.navigation`.
"""

from typing import ClassVar

from sqlglot import exp
from sqlglot.dialects.duckdb import DuckDB
from sqlglot.parser import Parser
from sqlglot.parsers.duckdb import DuckDBParser

_OF_A_GRAMMAR = ("CAST", "TRY_CAST", "EXTRACT", "TRIM", "POSITION", "SUBSTRING", "OVERLAY")


class ClauseDialect(DuckDB):
    """DuckDB's SQL with functions by name."""

    class Parser(DuckDBParser):
        """Reads every function as `Anonymous`, but for those of a grammar of their own.

        `list(x)[1]` is a place in a list; sqlglot takes `list [1]` for a list that is written out.
        """

        ARRAY_CONSTRUCTORS: ClassVar = {"ARRAY": exp.Array}
        FUNCTIONS: ClassVar = {}
        PLACEHOLDER_PARSERS: ClassVar = {**Parser.PLACEHOLDER_PARSERS, **DuckDBParser.PLACEHOLDER_PARSERS}
        NO_PAREN_FUNCTIONS: ClassVar = {}
        FUNCTION_PARSERS: ClassVar = {
            name: parser for name, parser in DuckDBParser.FUNCTION_PARSERS.items() if name in _OF_A_GRAMMAR
        }
