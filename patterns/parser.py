"""A rule's SQL, from text to `Query`: the clauses of MATCH_RECOGNIZE and the SELECT around them.

The clauses are read here, word by word; sqlglot parses each scalar expression.
What SQL:2016 allows and this version does not understand is refused by name,
never misread. Names are not resolved: `patterns.binder` does that.
"""

from typing import NoReturn

from sqlglot import exp
from sqlglot.dialects.dialect import Dialect
from sqlglot.errors import ParseError
from sqlglot.tokenizer_core import Token, TokenType

from patterns.errors import NotSupportedYet
from patterns.pattern_parser import parse_pattern
from patterns.syntax import Identifier, Named, Pattern, Query, Scalar, Skip, SkipMode
from patterns.text import Passage
from patterns.tokens import Word, canonical_name, tokenise

_CLAUSES = ("PARTITION", "ORDER", "MEASURES", "ONE", "ALL", "AFTER", "INITIAL", "SEEK", "PATTERN", "SUBSET", "DEFINE")
_QUERY_NOT_YET = ("UNION", "EXCEPT", "INTERSECT", "JOIN", "WHERE", "GROUP", "ORDER", "HAVING", "LIMIT", "WITH",
                  "MATCH_RECOGNIZE", "CROSS", "LEFT", "RIGHT", "FULL", "INNER")  # fmt: skip


def parse(passage: Passage) -> Query:
    """The query that the SQL says.

    Raises:
        RuleError: Not one SELECT * FROM type MATCH_RECOGNIZE (...).
        NotSupportedYet: SQL that this version does not understand.
    """
    return _Parser(passage).query()


class _Parser:
    """A cursor over the words, one method for each clause."""

    def __init__(self, passage: Passage) -> None:
        self.passage = passage
        self.words = tokenise(passage)
        self.index = 0

    # The SELECT around the clause.

    def query(self) -> Query:
        if self.key() == "WITH":
            self.refuse("WITH")
        self.expect("SELECT")
        self.select_star()
        self.expect("FROM")
        source_type, where = self.source()
        self.expect("MATCH_RECOGNIZE")
        self.expect("(")
        query = self.clauses(source_type, where)
        self.expect(")")
        self.end()
        return query

    def select_star(self) -> None:
        if self.key() != "*":
            self.refuse("a SELECT list other than *")
        self.index += 1
        if self.key() == ",":
            self.refuse("a SELECT list other than *")

    def source(self) -> tuple[Identifier, Scalar | None]:
        if self.key() != "(":
            name = self.identifier("an event type")
            if self.key() in (",", *_QUERY_NOT_YET) and self.key() != "MATCH_RECOGNIZE":
                self.refuse(f"{self.word_shown()} after FROM")
            return name, None
        self.index += 1
        self.expect("SELECT")
        self.select_star()
        self.expect("FROM")
        name = self.identifier("an event type")
        where = None
        if self.accept("WHERE"):
            where = self.scalar("WHERE", stops=(*_QUERY_NOT_YET, "WINDOW", "QUALIFY"))
        if self.key() in _QUERY_NOT_YET or self.key() == ",":
            self.refuse(f"{self.word_shown()} in a sub-query of FROM")
        self.expect(")")
        return name, where

    def end(self) -> None:
        if self.accept("AS") or (self.has_word() and self.key() not in (";", *_QUERY_NOT_YET)):
            self.identifier("a name for the result")
        while self.accept(";"):
            pass
        if self.key() in _QUERY_NOT_YET:
            self.refuse(f"{self.word_shown()} after MATCH_RECOGNIZE")
        if self.has_word():
            self.fail(f"wanted the end of the query, got {self.word_shown()}")

    # The clauses, in the order that the standard gives them.

    def clauses(self, source_type: Identifier, where: Scalar | None) -> Query:
        partition_by = self.partition_by()
        self.order_by("ORDER BY time" if partition_by else "PARTITION BY or ORDER BY")
        measures = self.measures()
        self.rows_per_match()
        skip = self.after_match()
        self.no_search_mode()
        pattern, pattern_at = self.pattern()
        within = self.within() if self.accept("WITHIN") else None
        if self.key() == "SUBSET":
            self.refuse("SUBSET")
        defines = self.defines()
        self.no_further_clause()
        return Query(
            self.passage, source_type, where, partition_by, measures, skip, pattern, pattern_at, within, defines
        )

    def partition_by(self) -> tuple[Identifier, ...]:
        if not self.accept("PARTITION"):
            return ()
        self.expect("BY")
        columns = [self.identifier("a column to partition by")]
        while self.accept(","):
            columns.append(self.identifier("a column to partition by"))
        return tuple(columns)

    def order_by(self, wanted_here: str) -> None:
        self.expect("ORDER", wanted_here)
        self.expect("BY")
        for position, wanted in enumerate(("TIME", "SEQUENCE")):
            if position > 0 and not self.accept(","):
                return
            column = self.identifier(f"the column {wanted.lower()}")
            if column.key != wanted:
                self.refuse_at(f"ORDER BY {column.name} (only time and sequence order events)", column.at)
            if self.key() in ("DESC", "NULLS"):
                self.refuse(f"ORDER BY ... {self.key()}")
            self.accept("ASC")
        if self.key() == ",":
            self.refuse("ORDER BY more than time and sequence")

    def measures(self) -> tuple[Named, ...]:
        if not self.accept("MEASURES"):
            return ()
        measures = [self.measure()]
        while self.accept(","):
            measures.append(self.measure())
        return tuple(measures)

    def measure(self) -> Named:
        if self.key() in ("RUNNING", "FINAL"):
            self.refuse(f"MEASURES: {self.key()}")
        value = self.scalar("MEASURES", stops=("AS",))
        self.expect("AS", "AS and the measure's name")
        return Named(self.identifier("the measure's name"), value)

    def rows_per_match(self) -> None:
        if self.key() == "ALL":
            self.refuse("ALL ROWS PER MATCH")
        if self.accept("ONE"):
            for word in ("ROW", "PER", "MATCH"):
                self.expect(word)

    def after_match(self) -> Skip:
        if not self.accept("AFTER"):
            return Skip(SkipMode.PAST_LAST_ROW)
        self.expect("MATCH")
        self.expect("SKIP")
        if self.accept("PAST"):
            self.expect("LAST")
            self.expect("ROW")
            return Skip(SkipMode.PAST_LAST_ROW)
        self.expect("TO", "PAST LAST ROW, TO NEXT ROW, TO FIRST v, TO LAST v or TO v")
        if self.key() == "NEXT" and self.key(1) == "ROW":
            self.index += 2
            return Skip(SkipMode.TO_NEXT_ROW)
        mode = SkipMode.TO_LAST
        if self.key() in ("FIRST", "LAST") and self.names_something(1):
            mode = SkipMode.TO_FIRST if self.key() == "FIRST" else SkipMode.TO_LAST
            self.index += 1
        return Skip(mode, self.identifier("a pattern variable"))

    def no_search_mode(self) -> None:
        if self.key() in ("INITIAL", "SEEK"):
            self.refuse(self.key())

    def pattern(self) -> tuple[Pattern, int]:
        at = self.offset()
        wanted = "one of the clauses PARTITION BY, ORDER BY, MEASURES, ONE ROW PER MATCH, AFTER MATCH SKIP, PATTERN"
        self.expect("PATTERN", wanted)
        opening = self.offset()
        self.expect("(")
        tree, end = parse_pattern(self.passage, opening)
        while self.has_word() and self.words[self.index].start < end:
            self.index += 1
        return tree, at

    def within(self) -> Scalar:
        if self.key()[:1] in "'0123456789" and self.names_something(1) and self.key(1) not in _CLAUSES:
            shown = " ".join(word.text for word in self.words[self.index : self.index + 2])
            self.fail(f"WITHIN: wanted INTERVAL '10' SECOND or :parameter, got {shown}")
        return self.scalar("WITHIN")

    def defines(self) -> tuple[Named, ...]:
        if self.key() == ")":
            return ()
        self.expect("DEFINE", "WITHIN, DEFINE or ')'")
        defines = [self.define()]
        while self.accept(","):
            defines.append(self.define())
        return tuple(defines)

    def define(self) -> Named:
        name = self.identifier("a pattern variable")
        self.expect("AS")
        return Named(name, self.scalar("DEFINE"))

    def no_further_clause(self) -> None:
        if self.key() in _CLAUSES:
            self.fail(f"{self.key()} stands too late or twice; clauses come in the order "
                      "PARTITION BY, ORDER BY, MEASURES, ONE ROW, AFTER MATCH, PATTERN, WITHIN, DEFINE")  # fmt: skip

    # Scalar expressions.

    def scalar(self, clause: str, stops: tuple[str, ...] = ()) -> Scalar:
        """The expression up to a comma, a closing parenthesis, a clause or one of the stops."""
        first = self.index
        depth = 0
        while self.has_word():
            key = self.key()
            if depth == 0 and (key in (",", ")") or key in stops or (key in _CLAUSES and self.begins_clause())):
                break
            depth += (key == "(") - (key == ")")
            self.index += 1
        words = self.words[first : self.index]
        if not words:
            self.fail(f"{clause}: wanted an expression, got {self.word_shown()}")
        return Scalar(self.parse_words(words, clause), words[0].start, words[-1].end)

    def parse_words(self, words: list[Word], clause: str) -> exp.Expression:
        opening, closing = Token(TokenType.L_PAREN, "("), Token(TokenType.R_PAREN, ")")
        try:
            trees = (
                Dialect.get_or_raise(None)
                .parser()
                .parse([opening, *(word.token for word in words if word.token is not None), closing], self.passage.text)
            )
        except ParseError as error:
            raise self.passage.error(f"{clause}: {_complaint(error)}", _error_offset(error, words)) from error
        tree = trees[0]
        if len(trees) != 1 or not isinstance(tree, exp.Paren | exp.Subquery):
            raise self.passage.error(f"{clause}: not one scalar expression", words[0].start)
        if isinstance(tree.this, exp.Alias):
            alias = tree.this.args["alias"]
            raise self.passage.error(f"{clause}: not one expression", alias.meta.get("start", words[-1].start))
        return tree.this if isinstance(tree, exp.Paren) else tree

    def begins_clause(self) -> bool:
        """Whether the keyword here opens a clause, rather than naming a variable or a function."""
        return self.key(1) not in (".", "(", ",", ")") or self.key() == "PATTERN"

    # The cursor.

    def has_word(self) -> bool:
        return self.index < len(self.words)

    def key(self, ahead: int = 0) -> str:
        index = self.index + ahead
        return self.words[index].key if index < len(self.words) else ""

    def names_something(self, ahead: int) -> bool:
        index = self.index + ahead
        begins_pattern = self.key(ahead) == "PATTERN" and self.key(ahead + 1) == "("
        return index < len(self.words) and self.words[index].is_identifier and not begins_pattern

    def accept(self, key: str) -> bool:
        if self.key() != key:
            return False
        self.index += 1
        return True

    def expect(self, key: str, wanted: str = "") -> None:
        if not self.accept(key):
            self.fail(f"wanted {wanted or key}, got {self.word_shown()}")

    def identifier(self, what: str) -> Identifier:
        if not self.has_word() or not self.words[self.index].is_identifier:
            self.fail(f"wanted {what}, got {self.word_shown()}")
        word = self.words[self.index]
        self.index += 1
        return Identifier(word.name, canonical_name(word.name, word.is_quoted), word.start)

    def word_shown(self) -> str:
        return self.words[self.index].text if self.has_word() else "the end"

    def offset(self) -> int:
        if self.has_word():
            return self.words[self.index].start
        return self.words[-1].end - 1 if self.words else 0

    def fail(self, message: str) -> NoReturn:
        raise self.passage.error(message, self.offset())

    def refuse(self, what: str) -> NoReturn:
        self.refuse_at(what, self.offset())

    def refuse_at(self, what: str, at: int) -> NoReturn:
        raise self.passage.error(f"{what} is not supported yet", at, NotSupportedYet)


def _complaint(error: ParseError) -> str:
    details = error.errors[0] if error.errors else {}
    description = str(details.get("description") or error).split(" missing for ")[0]
    return f"{description} near {details.get('highlight')!r}" if details.get("highlight") else description


def _error_offset(error: ParseError, words: list[Word]) -> int:
    """Where sqlglot stumbled: it names the line and last column of a token."""
    details = error.errors[0] if error.errors else {}
    for word in words:
        token = word.token
        if token is not None and (token.line, token.col) == (details.get("line"), details.get("col")):
            return word.start
    return words[-1].start
