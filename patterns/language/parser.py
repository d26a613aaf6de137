"""MATCH_RECOGNIZE, from text to `Clause`; and a rule's SQL, the SELECT around one clause, to `Query`.

The clauses are read here, word by word; sqlglot parses each scalar expression.
What is not understood is refused by name, never misread. Names are not
resolved: `patterns.binding.binder` does that for rules, `patterns.querying.recognition` for
queries.
"""

from collections.abc import Callable
from difflib import get_close_matches
from typing import NoReturn, TypeVar

from sqlglot import exp
from sqlglot.errors import ParseError
from sqlglot.tokenizer_core import Token, TokenType

from patterns.errors import NotInRules, RuleError
from patterns.language.dialect import ClauseDialect
from patterns.language.pattern_parser import parse_pattern
from patterns.language.syntax import (
    Arm,
    Clause,
    Identifier,
    Item,
    Named,
    Ordering,
    Pattern,
    Query,
    RowsPerMatch,
    Scalar,
    Skip,
    SkipMode,
    Subset,
)
from patterns.language.text import Passage
from patterns.language.tokens import Word, canonical_name, tokenise

SITUATION_TYPE = "situation_detected"
NESTING_MOST = 30
"""Parentheses of an expression in each other."""
OPERATORS_MOST = 150
"""Operators and functions of an expression in each other; a chain of AND counts each."""

_NAMED_INPUT = (
    "its FROM is the whole input. Next: write what WITH names as an arm of FROM, or as a rule of its own, and read it "
    "by situation('rule')"
)
_MEASURES_SAY = "what a situation says is named in MEASURES. Next: write SELECT *"
_ONE_STREAM = (
    "a rule reads events in one order as they come, and a join or a group is complete only when nothing more comes. "
    "Next: unite types with FROM (SELECT ... UNION ALL BY NAME SELECT ...), filter in WHERE there, join in PATTERN"
)
_ONE_EVENT = (
    "an arm reads one event at a time. Next: write SELECT list FROM type WHERE condition, united by UNION ALL BY NAME"
)
_EACH_MATCH = (
    "each match is a situation when it is final, whatever others come. Next: say in DEFINE which matches count, in "
    "`emit` how often; a rule can read them by situation('rule'), a query from the log"
)
_T = TypeVar("_T")
_CLAUSES = ("PARTITION", "ORDER", "MEASURES", "ONE", "ALL", "AFTER", "INITIAL", "SEEK", "PATTERN", "SUBSET", "DEFINE")
_BEFORE_PATTERN = ("PARTITION BY", "ORDER BY", "MEASURES", "ONE ROW PER MATCH", "ALL ROWS PER MATCH",
                   "AFTER MATCH SKIP", "INITIAL", "PATTERN")  # fmt: skip
_BEHIND_PATTERN = ("WITHIN", "SUBSET", "DEFINE")
_PAIRS = {"PARTITION": "BY", "ORDER": "BY", "ONE": "ROW", "ALL": "ROWS", "AFTER": "MATCH", "PATTERN": "("}
_OPENING, _CLOSING = ("(", "[", "{"), (")", "]", "}")
_OF_QUERIES = ("UNION", "EXCEPT", "INTERSECT", "JOIN", "WHERE", "GROUP", "ORDER", "HAVING", "LIMIT", "WITH",
                  "MATCH_RECOGNIZE", "CROSS", "LEFT", "RIGHT", "FULL", "INNER")  # fmt: skip


def parse_clause(passage: Passage, offset: int) -> tuple[Clause, int]:
    """The clause whose MATCH_RECOGNIZE stands at this offset, and the offset after its closing parenthesis.

    Its expressions are DuckDB's SQL. Words after the clause are not looked at.

    Raises:
        RuleError: Not a MATCH_RECOGNIZE clause.
    """
    parser = _Parser(passage)
    while parser.has_word() and parser.offset() < offset:
        parser.index += 1
    clause = parser.clause()
    return clause, parser.words[parser.index - 1].end


def parse(passage: Passage) -> Query:
    """The query that the SQL says.

    Raises:
        RuleError: Not one SELECT * FROM type MATCH_RECOGNIZE (...).
        NotInRules: SQL that a rule does not have.
    """
    return _Parser(passage).query()


class _Parser:
    """A cursor over the words, one method for each clause."""

    def __init__(self, passage: Passage) -> None:
        self.passage = passage
        self.dialect = ClauseDialect()
        self.words = tokenise(passage, self.dialect, skips_patterns=True)
        self.index = 0
        self.keys: dict[int, Scalar] = {}

    # The SELECT around the clause.

    def query(self) -> Query:
        if self.key() == "WITH":
            self.refuse("WITH", _NAMED_INPUT)
        self.expect("SELECT")
        self.select_star()
        self.expect("FROM")
        arms = self.arms()
        clause = self.clause()
        self.end()
        return Query(self.passage, arms, clause)

    def select_star(self) -> None:
        if self.key() != "*":
            self.refuse("SELECT list other than *", _MEASURES_SAY)
        self.index += 1
        if self.key() == ",":
            self.refuse("SELECT list other than *", _MEASURES_SAY)

    def arms(self) -> tuple[Arm, ...]:
        if not self.accept("("):
            name, rule = self.event_type()
            if self.key() in (",", *_OF_QUERIES) and self.key() != "MATCH_RECOGNIZE":
                self.refuse(
                    "second table after FROM" if self.key() == "," else f"{self.word_shown()} after FROM", _ONE_STREAM
                )
            return (Arm(name, rule, has_star=True, items=(), where=None),)
        arms = [self.arm()]
        while self.unites():
            arms.append(self.arm())
        if self.key() in _OF_QUERIES or self.key() == ",":
            self.refuse("second table in an arm" if self.key() == "," else f"{self.word_shown()} in an arm", _ONE_EVENT)
        self.expect(")")
        return tuple(arms)

    def unites(self) -> bool:
        """Whether another arm follows; it is united BY NAME."""
        at = self.offset()
        if not self.accept("UNION"):
            return False
        if not self.accept("ALL"):
            raise self.passage.error("UNION takes out rows that are alike, and no two events are. "
                                     "Next: write UNION ALL BY NAME", at)  # fmt: skip
        if not self.accept("BY"):
            raise self.passage.error("UNION ALL by position would mix columns up when a type's next version has more. "
                                     "Next: write UNION ALL BY NAME", at)  # fmt: skip
        self.expect("NAME")
        return True

    def arm(self) -> Arm:
        self.expect("SELECT")
        has_star, items = self.select_list()
        self.expect("FROM")
        name, rule = self.event_type()
        where = None
        if self.accept("WHERE"):
            where = self.scalar("WHERE", stops=(*_OF_QUERIES, "WINDOW", "QUALIFY"))
        return Arm(name, rule, has_star, items, where)

    def event_type(self) -> tuple[Identifier, str | None]:
        """An event type, or the situations of a rule."""
        name = self.identifier("an event type")
        if name.key != "SITUATION" or self.key() != "(":
            return name, None
        self.index += 1
        word = self.words[self.index] if self.has_word() else None
        if word is None or word.kind is not TokenType.STRING:
            self.fail(f"wanted situation('rule'), got {self.word_shown()}")
        self.index += 1
        self.expect(")")
        return Identifier(SITUATION_TYPE, SITUATION_TYPE.upper(), name.at), word.name

    def select_list(self) -> tuple[bool, tuple[Item, ...]]:
        has_star = self.accept("*")
        items = [] if has_star else [self.item()]
        while self.accept(","):
            items.append(self.item())
        return has_star, tuple(items)

    def item(self) -> Item:
        """`column`, or `expression AS column`."""
        first = self.index
        value = self.scalar("SELECT", stops=("AS", "FROM"))
        is_column = self.index == first + 1 and self.words[first].is_identifier
        if self.accept("AS"):
            first = self.index
            self.identifier("the column's name")
        elif not is_column:
            raise self.passage.error("SELECT: an expression needs a name. Next: write ... AS name", value.at)
        word = self.words[first]
        return Item(word.name if word.is_quoted else word.name.lower(), word.start, value)

    def end(self) -> None:
        if self.key() == ",":
            self.fail("wanted the end of the query, got ','; the parenthesis of MATCH_RECOGNIZE is closed before it")
        if self.accept("AS") or (self.has_word() and self.key() not in (";", *_OF_QUERIES)):
            self.identifier("a name for the result")
        while self.accept(";"):
            pass
        if self.key() in _OF_QUERIES:
            self.refuse(f"{self.word_shown()} after MATCH_RECOGNIZE", _EACH_MATCH)
        if self.has_word():
            self.fail(f"wanted the end of the query, got {self.word_shown()}")

    # The clauses, in the order that the standard gives them.

    def clause(self) -> Clause:
        at = self.offset()
        self.expect("MATCH_RECOGNIZE")
        self.expect("(")
        partition_by = self.partition_by()
        order_by = self.order_by()
        measures = self.measures()
        rows_at = self.offset()
        rows = self.rows_per_match()
        skip = self.after_match()
        self.search_mode()
        pattern, pattern_at = self.pattern()
        within = self.within() if self.accept("WITHIN") else None
        subsets = self.subsets()
        defines = self.defines()
        self.no_further_clause()
        self.expect(")")
        return Clause(
            self.passage, at, partition_by, order_by, measures, rows, rows_at, skip, pattern, pattern_at, within,
            subsets, defines, dict(self.keys),
        )  # fmt: skip

    def partition_by(self) -> tuple[Identifier, ...]:
        if not self.accept("PARTITION"):
            return ()
        self.expect("BY")
        return self.listed("PARTITION BY", lambda: self.column("a column to partition by"))

    def order_by(self) -> tuple[Ordering, ...]:
        if not self.accept("ORDER"):
            return ()
        self.expect("BY")
        return self.listed("ORDER BY", self.ordering)

    def ordering(self) -> Ordering:
        column = self.column("a column to order by")
        is_descending = self.accept("DESC")
        if not is_descending:
            self.accept("ASC")
        nulls_first = None
        if self.accept("NULLS"):
            nulls_first = self.accept("FIRST")
            if not nulls_first:
                self.expect("LAST", "FIRST or LAST")
        return Ordering(column, is_descending, nulls_first)

    def column(self, what: str) -> Identifier:
        """A column's name, a table's before it left out; or, in a query, what an expression is called."""
        first = self.index
        if self.stands_clause():
            self.fail(f"wanted {what}, got {self.word_shown()}")
        if self.key() in (",", ")", ""):
            return self.identifier(what)
        names = 1
        while self.names_something(names - 1) and self.key(names) == "." and self.names_something(names + 1):
            names += 2
        ends = self.key(names) in (",", ")", "PATTERN") or self.index + names >= len(self.words)
        is_name = self.names_something(0) and (ends or self.names_something(names))
        if is_name and names == 1:
            return self.identifier(what)
        key = self.scalar(what, stops=("ASC", "DESC", "NULLS", *_CLAUSES))
        last = self.words[self.index - 1]
        name = last.name if is_name else self.passage.text[key.at : key.end]
        self.keys[self.words[first].start] = key
        return Identifier(name, canonical_name(name, not is_name or last.is_quoted), key.at)

    def measures(self) -> tuple[Named, ...]:
        return self.listed("MEASURES", self.measure) if self.accept("MEASURES") else ()

    def measure(self) -> Named:
        value = self.scalar("MEASURES", stops=("AS",))
        self.expect("AS", "AS and the measure's name")
        if self.stands_clause():
            self.fail(f"MEASURES: wanted the measure's name, got {self.word_shown()}")
        return Named(self.identifier("the measure's name"), value)

    def rows_per_match(self) -> RowsPerMatch:
        if self.accept("ONE"):
            self.expect_all("ROW", "PER", "MATCH")
            return RowsPerMatch.ONE
        if not self.accept("ALL"):
            return RowsPerMatch.ONE
        self.expect_all("ROWS", "PER", "MATCH")
        if self.accept("OMIT"):
            self.expect_all("EMPTY", "MATCHES")
            return RowsPerMatch.ALL_OMIT_EMPTY
        if self.accept("WITH"):
            self.expect_all("UNMATCHED", "ROWS")
            return RowsPerMatch.ALL_WITH_UNMATCHED
        if self.accept("SHOW"):
            self.expect_all("EMPTY", "MATCHES")
        return RowsPerMatch.ALL_SHOW_EMPTY

    def after_match(self) -> Skip:
        if not self.accept("AFTER"):
            return Skip(SkipMode.PAST_LAST_ROW)
        self.expect_all("MATCH", "SKIP")
        if self.accept("PAST"):
            self.expect_all("LAST", "ROW")
            return Skip(SkipMode.PAST_LAST_ROW)
        self.expect("TO", "PAST LAST ROW, TO NEXT ROW, TO FIRST v, TO LAST v or TO v")
        if self.key() == "NEXT" and self.names_something(1) and self.key(1) != "INITIAL":
            self.expect_all("NEXT", "ROW")
            return Skip(SkipMode.TO_NEXT_ROW)
        mode = SkipMode.TO_LAST
        if self.key() in ("FIRST", "LAST") and self.names_something(1):
            mode = SkipMode.TO_FIRST if self.key() == "FIRST" else SkipMode.TO_LAST
            self.index += 1
        return Skip(mode, self.identifier("a pattern variable"))

    def search_mode(self) -> None:
        if self.key() == "SEEK":
            message = "SEEK finds one match anywhere in a window; MATCH_RECOGNIZE in FROM finds all, so leave it out"
            self.fail(message)
        self.accept("INITIAL")

    def pattern(self) -> tuple[Pattern, int]:
        at = self.offset()
        wanted = "one of the clauses PARTITION BY, ORDER BY, MEASURES, ONE ROW PER MATCH, AFTER MATCH SKIP, PATTERN"
        self.expect("PATTERN", wanted, _BEFORE_PATTERN)
        opening = self.offset()
        self.expect("(", "( around the pattern")
        tree, end = parse_pattern(self.passage, opening)
        while self.has_word() and self.words[self.index].start < end:
            self.index += 1
        return tree, at

    def within(self) -> Scalar:
        if self.key()[:1] in "'0123456789" and self.names_something(1) and self.key(1) not in _CLAUSES:
            shown = " ".join(word.text for word in self.words[self.index : self.index + 2])
            self.fail(f"WITHIN: wanted INTERVAL '10' SECOND or :parameter, got {shown}")
        return self.scalar("WITHIN")

    def subsets(self) -> tuple[Subset, ...]:
        return self.listed("SUBSET", self.subset) if self.accept("SUBSET") else ()

    def subset(self) -> Subset:
        name = self.identifier("a name for the union of variables")
        self.expect("=")
        self.expect("(")
        members = self.separated("SUBSET", lambda: self.identifier("a pattern variable"))
        self.expect(")")
        return Subset(name, members)

    def defines(self) -> tuple[Named, ...]:
        if self.key() == ")":
            return ()
        self.expect("DEFINE", "WITHIN, SUBSET, DEFINE or ')'", _BEHIND_PATTERN)
        return self.separated("DEFINE", self.define)

    def define(self) -> Named:
        name = self.identifier("a pattern variable")
        if self.key() != "AS":
            self.fail(f"DEFINE {name.name}: wanted AS, got {self.word_shown()}")
        self.index += 1
        return Named(name, self.scalar("DEFINE"))

    def no_further_clause(self) -> None:
        if self.key() in _CLAUSES:
            self.fail(f"{self.key()} stands too late or twice; clauses come in the order PARTITION BY, ORDER BY, "
                      "MEASURES, ONE ROW or ALL ROWS, AFTER MATCH, PATTERN, WITHIN, SUBSET, DEFINE")  # fmt: skip

    # Scalar expressions.

    def scalar(self, clause: str, stops: tuple[str, ...] = ()) -> Scalar:
        """The expression up to a comma, a closing parenthesis, a clause or one of the stops."""
        first = self.index
        open_at: list[int] = []
        while self.has_word():
            key = self.key()
            self.check_expression_goes_on(clause, first, open_at)
            if not open_at and (key in (",", *_CLOSING) or key in stops or (key in _CLAUSES and self.begins_clause())):
                break
            if key in _OPENING:
                open_at.append(self.index)
            elif key in _CLOSING:
                open_at.pop()
            if len(open_at) > NESTING_MOST:
                self.fail(f"{clause}: an expression nests at most {NESTING_MOST} parentheses in each other")
            self.index += 1
        if open_at:
            self.fail_open(clause, open_at)
        words = self.words[first : self.index]
        if not words:
            self.fail(f"{clause}: wanted an expression, got {self.word_shown()}")
        return Scalar(self.parse_words(words, clause), words[0].start, words[-1].end)

    def check_expression_goes_on(self, clause: str, first: int, open_at: list[int]) -> None:
        """Checks that no word stands here that an expression cannot have: what should end it is missing before."""
        if self.key() == ";":
            self.fail(f"{clause}: a semicolon must not stand inside MATCH_RECOGNIZE")
        is_definition = clause == "DEFINE" and self.names_something(0) and self.key(1) == "AS"
        if not open_at:
            if is_definition and self.index > first:
                self.fail(f"DEFINE: wanted ',' before {self.word_shown()} AS")
            return
        is_query = any(self.words[at + 1].key in ("SELECT", "WITH", "FROM") for at in open_at)
        is_next = self.stands_clause() and self.key() not in ("PARTITION", "ORDER")
        if not is_query and (is_next or (is_definition and self.key(-1) == ",")):
            self.fail_open(clause, open_at)

    def fail_open(self, clause: str, open_at: list[int]) -> NoReturn:
        """Fails at the parenthesis that was opened last."""
        raise self.passage.error(f"{clause}: this parenthesis is not closed", self.words[open_at[-1]].start)

    def parse_words(self, words: list[Word], clause: str) -> exp.Expression:
        opening, closing = Token(TokenType.L_PAREN, "("), Token(TokenType.R_PAREN, ")")
        try:
            trees = self.dialect.parser().parse([opening, *_tokens(words), closing], self.passage.text)
        except ParseError as error:
            at = _error_offset(error, words)
            for word, _, stumbled in zip(words, words[1:], words[2:], strict=False):
                if stumbled.start == at and word.key in ("RUNNING", "FINAL"):
                    message = f"{clause}: {word.key} stands before FIRST, LAST or an aggregate function only"
                    raise self.passage.error(message, word.start) from error
            raise self.passage.error(f"{clause}: {_complaint(error, words, at)}", at) from error
        except RecursionError as error:
            raise self.too_deep(clause, words[0].start) from error
        tree = trees[0]
        if tree is not None and _height(tree) > OPERATORS_MOST:
            raise self.too_deep(clause, words[0].start)
        if tree is not None:
            tree = tree.transform(_without_nameless)
        if len(trees) != 1 or not isinstance(tree, exp.Paren | exp.Subquery):
            raise self.passage.error(f"{clause}: not one scalar expression", words[0].start)
        if isinstance(tree.this, exp.Alias):
            alias = tree.this.args["alias"]
            raise self.passage.error(f"{clause}: not one expression", alias.meta.get("start", words[-1].start))
        return tree.this if isinstance(tree, exp.Paren) else tree

    def too_deep(self, clause: str, at: int) -> RuleError:
        message = f"{clause}: the expression nests too deeply; {OPERATORS_MOST} operators are the most in one chain"
        return self.passage.error(f"{message}. Next: IN (...) in place of many OR", at)

    def begins_clause(self) -> bool:
        """Whether the keyword here opens a clause, rather than naming a variable, a column or a function."""
        if self.key(-1) == "." or self.key(1) == "AS":
            return False
        return self.key(1) not in (".", "(", ",", ")") or (self.key() == "PATTERN" and self.key(1) == "(")

    def stands_clause(self) -> bool:
        """Whether the words here can be nothing but the beginning of a clause."""
        key = self.key()
        if key in _PAIRS:
            return self.key(1) == _PAIRS[key]
        return {"SUBSET": "=", "DEFINE": "AS"}.get(key) == self.key(2) != ""

    # The cursor.

    def has_word(self) -> bool:
        return self.index < len(self.words)

    def key(self, ahead: int = 0) -> str:
        index = self.index + ahead
        return self.words[index].key if 0 <= index < len(self.words) else ""

    def names_something(self, ahead: int) -> bool:
        index = self.index + ahead
        begins_pattern = self.key(ahead) == "PATTERN" and self.key(ahead + 1) == "("
        return index < len(self.words) and self.words[index].is_identifier and not begins_pattern

    def accept(self, key: str) -> bool:
        if self.key() != key:
            return False
        self.index += 1
        return True

    def listed(self, clause: str, one: Callable[[], _T]) -> tuple[_T, ...]:
        """One or more, with commas between them; then the next clause."""
        found = self.separated(clause, one)
        is_clause = self.key() in (*_CLAUSES, *_BEHIND_PATTERN) or self.meant((*_BEFORE_PATTERN, *_BEHIND_PATTERN))
        if self.names_something(0) and not is_clause:
            self.fail(f"{clause}: wanted ',' or the next clause, got {self.word_shown()}")
        return found

    def separated(self, clause: str, one: Callable[[], _T]) -> tuple[_T, ...]:
        """One or more, with commas between them."""
        found = [one()]
        while self.key() == ",":
            comma = self.offset()
            self.index += 1
            if not self.has_word() or self.key() == ")" or self.stands_clause():
                raise self.passage.error(f"{clause}: nothing follows this comma", comma)
            found.append(one())
        return tuple(found)

    def expect_all(self, *keys: str) -> None:
        for key in keys:
            self.expect(key)

    def expect(self, key: str, wanted: str = "", known: tuple[str, ...] = ()) -> None:
        if not self.accept(key):
            self.fail(f"wanted {wanted or key}, got {self.word_shown()}{self.meant(known)}")

    def meant(self, known: tuple[str, ...]) -> str:
        """What the word here was meant to be, or why it must not stand here, as far as that can be said."""
        if self.key() in _BEHIND_PATTERN and "PATTERN" in known:
            return f"; {self.key()} comes behind PATTERN"
        if self.key() in _CLAUSES and known:
            return f"; {self.key()} stands too late or twice"
        by_first = {each.split()[0]: each for each in known}
        like = get_close_matches(self.key(), by_first, n=1)
        return f"; did you mean {by_first[like[0]]}?" if like else ""

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

    def refuse(self, what: str, why: str) -> NoReturn:
        raise self.passage.error(f"rules have no {what}: {why}", self.offset(), NotInRules)


def _height(tree: exp.Expr) -> int:
    """How many nodes stand in each other, on the deepest way; parentheses do not count."""
    highest, waiting = 0, [(tree, 1)]
    while waiting:
        node, height = waiting.pop()
        highest = max(highest, height)
        waiting += [(child, height + (not isinstance(child, exp.Paren))) for child in node.iter_expressions()]
    return highest


def _without_nameless(node: exp.Expr) -> exp.Expr:
    """The node; for `(:p)`, which sqlglot takes for DuckDB's `name: value` without a name, what it holds."""
    is_nameless = isinstance(node, exp.Alias) and node.args.get("alias") is None
    return node.this.transform(_without_nameless) if is_nameless else node


def _tokens(words: list[Word]) -> list[Token]:
    """The words' tokens; `FINAL LAST(x)` reads as `FINAL(LAST(x))`, which expressions have a form for."""
    tokens: list[Token] = []
    closing: list[int] = []
    for index, word in enumerate(words):
        if word.key in ("RUNNING", "FINAL") and _begins_call(words[index + 1 : index + 3]):
            place = word.token or Token(TokenType.VAR, word.text)
            tokens.append(Token(TokenType.VAR, word.key, place.line, place.col, place.start, place.end))
            tokens.append(Token(TokenType.L_PAREN, "("))
            closing.append(_end_of_call(words, index + 2))
        elif word.token is not None:
            tokens.append(word.token)
        tokens += [Token(TokenType.R_PAREN, ")")] * closing.count(index)
    return tokens


def _begins_call(words: list[Word]) -> bool:
    return len(words) == 2 and words[0].is_identifier and words[1].key == "("


def _end_of_call(words: list[Word], opening: int) -> int:
    depth = 0
    for index in range(opening, len(words)):
        depth += (words[index].key == "(") - (words[index].key == ")")
        if depth == 0:
            return index
    return len(words) - 1


def _complaint(error: ParseError, words: list[Word], at: int) -> str:
    details = error.errors[0] if error.errors else {}
    description, _, missing = str(details.get("description") or error).partition(" missing for ")
    if missing:
        description = "something is missing"
    word = next((word for word in words if word.start == at), words[-1])
    return f"{description.replace('Expecting', 'wanted')} near {word.text}"


def _error_offset(error: ParseError, words: list[Word]) -> int:
    """Where sqlglot stumbled: it names the line and last column of a token."""
    details = error.errors[0] if error.errors else {}
    for word in words:
        token = word.token
        if token is not None and (token.line, token.col) == (details.get("line"), details.get("col")):
            return word.start
    return words[-1].start
