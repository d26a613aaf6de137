--- letters t aab

--- case a clause without a pattern
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i▸)
--- error PATTERN

--- case PARTITION misspelt
SELECT * FROM t MATCH_RECOGNIZE (▸PARTITON BY x PATTERN (A))
--- error PARTITON

--- case PARTITION without BY
SELECT * FROM t MATCH_RECOGNIZE (PARTITION ▸x PATTERN (A))
--- error wanted BY

--- case ORDER misspelt
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY x ▸ODER BY id PATTERN (A))
--- error ODER

--- case MEASURES misspelt
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ▸MEASURE id AS i PATTERN (A))
--- error MEASURE

--- case ROW for ROWS
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ALL ▸ROW PER MATCH PATTERN (A))
--- error wanted ROWS

--- case ROWS for ROW
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ONE ▸ROWS PER MATCH PATTERN (A))
--- error wanted ROW

--- case MATCHES for MATCH
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ONE ROW PER ▸MATCHES PATTERN (A))
--- error wanted MATCH

--- case which empty matches
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ALL ROWS PER MATCH SHOW ▸EMPTIES PATTERN (A))
--- error wanted EMPTY

--- case empty matches with ONE ROW PER MATCH
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ONE ROW PER MATCH ▸OMIT EMPTY MATCHES PATTERN (A))
--- error OMIT

--- case AFTER without MATCH
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id AFTER ▸SKIP TO NEXT ROW PATTERN (A))
--- error wanted MATCH

--- case SKIP to nowhere
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id AFTER MATCH SKIP ▸PAST_LAST ROW PATTERN (A))
--- error PAST LAST ROW

--- case SKIP TO without a variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id AFTER MATCH SKIP TO ▸FIRST PATTERN (A))
--- error FIRST

--- case SKIP TO an unknown variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id AFTER MATCH SKIP TO LAST ▸B PATTERN (A))
--- error B

--- case PATTERN misspelt
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ▸PATERN (A))
--- error PATERN

--- case DEFINE misspelt
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) ▸DEFIN A AS x = 'a')
--- error DEFIN

--- case SUBSET misspelt
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) ▸SUBSETS U = (A) DEFINE A AS x = 'a')
--- error SUBSETS

--- case clauses in the wrong order
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS x = 'a' ▸MEASURES id AS i)
--- error MEASURES

--- case a clause twice
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ▸ORDER BY x PATTERN (A))
--- error ORDER

--- case SEEK
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id AFTER MATCH SKIP TO NEXT ROW ▸SEEK PATTERN (A))
--- error SEEK

--- case an unknown column to partition by
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY ▸k ORDER BY id PATTERN (A))
--- error k

--- case an unknown column to order by
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id, ▸at PATTERN (A))
--- error at

--- case an unknown column in a measure
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(▸y) AS y PATTERN (A))
--- error y

--- case an unknown column of a variable in a measure
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES 1 + ▸A.y AS y PATTERN (A))
--- error y

--- case an unknown column in a definition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A)
  DEFINE A AS x = 'a' AND ▸y > 1)
--- error y

--- case an unknown variable in a measure
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸B.x AS x PATTERN (A))
--- error B

--- case an unknown variable in a definition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS ▸B.x = 'a')
--- error B

--- case the name of another table in front of a column
SELECT * FROM t AS seen MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A) DEFINE A AS ▸t.x = 'a')
--- error t

--- case a result without a column
SELECT count(*) FROM t ▸MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error no column

--- case a quantifier that allows no time
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A B▸{0}))
--- error at least 1

--- case a quantifier up to no time
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A B▸{,0}?))
--- error at least 1

--- case one row of DISTINCT values
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸LAST(DISTINCT x) AS i PATTERN (A))
--- error DISTINCT

--- case an order that looks at the match
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY abs(▸PREV(id)) MEASURES id AS i PATTERN (A))
--- error there is no match to look at yet

--- case a partition by an aggregate
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY ▸sum(id) + 1 MEASURES id AS i PATTERN (A))
--- error there is no match to look at yet

--- case an order by a computed column that is not there
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY -▸nothing MEASURES id AS i PATTERN (A))
--- error nothing

--- case a definition of a variable that the pattern does not have
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS x = 'a', ▸B AS x = 'b')
--- error B

--- case a variable defined twice
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS x = 'a', ▸A AS x = 'b')
--- error A

--- case a measure without a name
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(id) ▸PATTERN (A))
--- error AS

--- case two measures of one name
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i, x AS ▸I PATTERN (A))
--- error I

--- case a measure with the name of a column that is in the answer too
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY x ORDER BY id MEASURES id AS ▸x PATTERN (A))
--- error x

--- case a subset of an unknown variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET U = (A, ▸C))
--- error C

--- case a subset with the name of a variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET ▸A = (A, B))
--- error A

--- case a subset twice
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET U = (A), ▸U = (B))
--- error U

--- case a subset of a subset
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET U = (A), W = (▸U, B))
--- error U

--- case a subset without members
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET U = (▸))
--- error pattern variable

--- case a definition of a subset
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A B) SUBSET U = (A, B) DEFINE ▸U AS x = 'a')
--- error U

--- case a definition that is no condition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS ▸id + 1)
--- error condition

--- case a definition without AS
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A ▸x = 'a')
--- error wanted AS

--- case an aggregate in an aggregate
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES SUM(▸MAX(id)) AS s PATTERN (A+))
--- error MAX

--- case navigation in an aggregate
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES SUM(▸PREV(id)) AS s PATTERN (A+))
--- error PREV

--- case an aggregate in navigation
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(▸SUM(id)) AS s PATTERN (A+))
--- error SUM

--- case two variables in one navigation
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(A.id + ▸B.id) AS s PATTERN (A B))
--- error one variable

--- case a variable and all rows in one navigation
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(A.id + ▸id) AS s PATTERN (A B))
--- error one variable

--- case two variables in one aggregate
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES max_by(A.id, ▸B.id) AS s PATTERN (A B))
--- error one variable

--- case navigation without a column
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸LAST(1) AS s PATTERN (A B))
--- error LAST

--- case a negative offset
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸PREV(id, -1) AS s PATTERN (A B))
--- error PREV

--- case an offset that is not a number
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸FIRST(id, id) AS s PATTERN (A B))
--- error FIRST

--- case FIRST around PREV
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(▸PREV(id)) AS s PATTERN (A B))
--- error PREV

--- case PREV around PREV
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES PREV(▸PREV(id)) AS s PATTERN (A B))
--- error PREV

--- case FIRST around LAST
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(▸LAST(id)) AS s PATTERN (A B))
--- error LAST

--- case FINAL in a definition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS id = ▸FINAL LAST(A.id))
--- error FINAL

--- case FINAL before PREV
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸FINAL PREV(id) AS p PATTERN (A))
--- error FINAL

--- case RUNNING before a column
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸RUNNING A.id AS p PATTERN (A))
--- error RUNNING

--- case a sub-query in a definition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS id = (SELECT ▸max(id) FROM t))
--- error sub-quer

--- case a window function in a measure
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸row_number() OVER (ORDER BY id) AS r PATTERN (A))
--- error window

--- case a volatile function in a definition
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS ▸random() < 0.5)
--- error RANDOM has another value at each call

--- case the time of now in a measure
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸now() AS at PATTERN (A))
--- error NOW has another value at each call

--- case an unknown function
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸no_such(x) AS n PATTERN (A))
--- error no_such

--- case a star outside of COUNT
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES (▸*) AS n PATTERN (A))
--- error stands in COUNT only

--- case a star in another aggregate
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES max(▸A.*) AS n PATTERN (A))
--- error stands in COUNT only

--- case CLASSIFIER of an unknown variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES CLASSIFIER(▸B) AS c PATTERN (A))
--- error B

--- case CLASSIFIER of a column
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸CLASSIFIER(A.x) AS c PATTERN (A))
--- error CLASSIFIER

--- case MATCH_NUMBER of something
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸MATCH_NUMBER(1) AS m PATTERN (A))
--- error MATCH_NUMBER

--- case a group that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN ▸(A (B) DEFINE A AS x = 'a')
--- error not closed

--- case a quantifier without anything before it
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (▸* A))
--- error *

--- case two quantifiers
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A*▸*))
--- error a quantifier follows a quantifier

--- case bounds in the wrong order
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A▸{3,2}))
--- error 3

--- case bounds that are no numbers
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A▸{n}))
--- error {

--- case bounds beyond the limit
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A▸{2,1000000}))
--- error at most

--- case an exclusion that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN ({- A B▸))
--- error -}

--- case an exclusion with WITH UNMATCHED ROWS
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ▸ALL ROWS PER MATCH WITH UNMATCHED ROWS PATTERN (A {- B -}))
--- error UNMATCHED

--- case PERMUTE of nothing
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (PERMUTE(▸)))
--- error wanted a variable

--- case a sign that a pattern does not know
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A ▸& B))
--- error &

--- case WITHIN of a number
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) WITHIN ▸5)
--- error WITHIN

--- case WITHIN of an order that is no time
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) WITHIN ▸INTERVAL '5' SECOND)
--- error WITHIN

--- case an unknown table before the clause
SELECT * FROM ▸nothing MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error nothing does not exist

--- case an unknown column of the answer
SELECT m.id,
       ▸m.nothing FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS id PATTERN (A)) AS m
--- error nothing

--- case a mistake in the SQL after the clause
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS id
  PATTERN (A)) AS m WHERE ▸AND id > 1
--- error syntax error

--- case a mistake in the SQL before the clause
SELECT 'é', ▸nothing FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A))
--- error nothing

--- case a mistake in the input
SELECT * FROM (SELECT id, ▸y FROM t) MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error y

--- case an input that looks at the query around it
SELECT (SELECT count(*) FROM (SELECT * FROM t WHERE t.id = ▸o.id) MATCH_RECOGNIZE (ORDER BY id PATTERN (A))) FROM t AS o
--- error query of its own

--- case LATERAL
SELECT * FROM t AS o, LATERAL (SELECT ▸o.id AS id) MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error query of its own

--- case a clause without an input
SELECT * FROM ▸MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error wants its input before it

--- case a clause inside the recursive table that it reads
WITH RECURSIVE r AS (SELECT 1 AS id UNION ALL SELECT id FROM ▸r MATCH_RECOGNIZE (ORDER BY id MEASURES id AS id PATTERN (A))) SELECT * FROM r
--- error recursive table r

--- case the parenthesis of the clause is not closed
SELECT * FROM t MATCH_RECOGNIZE ▸(ORDER BY id PATTERN (A)
--- error not closed

--- case a text that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A) DEFINE A AS x = ▸'a)
--- error not closed

--- case a comment that is not closed
SELECT * FROM t ▸/* what MATCH_RECOGNIZE (ORDER BY id PATTERN (A))
--- error not closed

--- case two statements
▸SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id PATTERN (A)); SELECT 1
--- error one statement, got 2

--- case nothing
▸
--- error one statement, got nothing

--- case a value that cannot be cast as the query runs
SELECT ▸CAST(x AS integer) FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES x AS x PATTERN (A))
--- error Could not convert

--- case a sub-query in measures that looks at the match
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES (SELECT ▸A.id) AS i PATTERN (A))
--- error A

--- case a sub-query in measures with several values
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES (SELECT ▸id FROM t) AS i PATTERN (A))
--- error More than one row

--- case a comparison in measures with all that a sub-query gives
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id = ANY (SELECT ▸1) AS i PATTERN (A))
--- error sub-query

--- case a parenthesis of PATTERN that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN ▸(A (B C) DEFINE A AS x = 'a')
--- error PATTERN: this parenthesis is not closed

--- case a parenthesis of DEFINE that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A B) DEFINE A AS ▸(A.x = 'a', B AS x = 'b')
--- error DEFINE: this parenthesis is not closed

--- case a parenthesis of MEASURES that is not closed
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES count▸(A.x AS i PATTERN (A B))
--- error MEASURES: this parenthesis is not closed

--- case no comma between measures
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i ▸B.x AS j PATTERN (A B))
--- error MEASURES: wanted ',' or the next clause, got B

--- case no comma between definitions
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A B) DEFINE A AS x = 'a' ▸B AS x = 'b')
--- error DEFINE: wanted ',' before B AS

--- case a measure without its name
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS ▸ONE ROW PER MATCH PATTERN (A B))
--- error MEASURES: wanted the measure's name, got ONE

--- case a definition with = for AS
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A ▸= x > 1)
--- error DEFINE A: wanted AS, got =

--- case PATTERN without parentheses
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN ▸A B)
--- error wanted ( around the pattern, got A

--- case nothing behind a comma of MEASURES
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i▸, PATTERN (A))
--- error MEASURES: nothing follows this comma

--- case nothing behind a comma of PARTITION BY
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY x▸, ORDER BY id PATTERN (A))
--- error PARTITION BY: nothing follows this comma

--- case nothing behind a comma of DEFINE
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A AS x = 'a'▸,)
--- error DEFINE: nothing follows this comma

--- case a semicolon inside
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A AS x = 'a'▸;)
--- error DEFINE: a semicolon must not stand inside MATCH_RECOGNIZE

--- case an operator without its right side
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A AS x = 'a' ▸AND)
--- error DEFINE: something is missing near AND

--- case the clause that was meant
SELECT * FROM t MATCH_RECOGNIZE (▸PARTITIONED BY x ORDER BY id PATTERN (A))
--- error did you mean PARTITION BY?

--- case the clause that was meant, after others
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i ▸AFTR MATCH SKIP PAST LAST ROW PATTERN (A))
--- error did you mean AFTER MATCH SKIP?

--- case the clause that was meant, behind PATTERN
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) ▸DEFINES A AS x = 'a')
--- error did you mean DEFINE?

--- case a clause too early
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i ▸DEFINE A AS x = 'a' PATTERN (A))
--- error DEFINE comes behind PATTERN

--- case a clause too late
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id ▸PARTITION BY x MEASURES A.x AS i PATTERN (A))
--- error PARTITION stands too late or twice

--- case NEXT ROWS
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i AFTER MATCH SKIP TO NEXT ▸ROWS PATTERN (A))
--- error wanted ROW, got ROWS

--- case NEXT without ROW
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i AFTER MATCH SKIP TO ▸NEXT PATTERN (A))
--- error did you mean TO NEXT ROW?

--- case FIRST without a variable
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i AFTER MATCH SKIP TO ▸FIRST PATTERN (A))
--- error TO FIRST wants a variable behind it

--- case the column that was meant
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A AS ▸A.xx = 'a')
--- error did you mean 'x'?

--- case the function that was meant
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x AS i PATTERN (A) DEFINE A AS ▸PRV(A.x) = 'a')
--- error did you mean 'PREV'?

--- case MATCH_RECOGNIZE misspelt
SELECT * FROM t MATCH_RECOGNISE (▸ORDER BY id MEASURES A.x AS i PATTERN (A))
--- error MATCH_RECOGNISE: did you mean MATCH_RECOGNIZE?

--- case MATCH_RECOGNIZE without a parenthesis
SELECT * FROM t MATCH_RECOGNIZE ORDER BY id ▸PATTERN (A)
--- error MATCH_RECOGNIZE wants a parenthesis behind it, got ORDER

--- case IN over a sub-query of two columns
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x IN (SELECT ▸id, x FROM t) AS i PATTERN (A))
--- error MEASURES: the sub-query of IN gives one column, got 2

--- case IN over a sub-query that sees the match
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x IN (SELECT ▸x FROM t WHERE id = A.id) AS i PATTERN (A))
--- error Referenced table "A" not found

--- case a sub-query in DEFINE
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A) DEFINE A AS ▸A.x IN (SELECT x FROM t))
--- error but in MEASURES as a value, in EXISTS or behind IN

--- case a column that both tables of a join have
SELECT * FROM (t JOIN u ON t.id = u.id) MATCH_RECOGNIZE (ORDER BY ▸id MEASURES A.n AS i PATTERN (A))
--- table u
id int | n int
1      | 2
--- error ORDER BY: 'id' is ambiguous, as the input has it twice: t.id and u.id. Next: give one of them another name

--- case a column that both tables of a join have, behind a common table expression
WITH c AS (SELECT id AS k, x FROM t) SELECT * FROM (c JOIN t ON k = t.id) AS j MATCH_RECOGNIZE (ORDER BY k
  MEASURES last(▸A.x) AS i PATTERN (A))
--- error MEASURES: 'x' is ambiguous, as the input has it twice: c.x and t.x

--- case a value that a measure cannot cast
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i, CAST(x AS integer) AS n PATTERN (A))
--- fails <query>:1:64: MEASURES: DuckDB: Conversion Error: Could not convert string 'a' to INT32

--- case a value that an aggregate in a measure cannot cast
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i, SUM(CAST(x AS integer)) AS n PATTERN (A))
--- fails <query>:1:64: MEASURES: DuckDB: Conversion Error

--- case a value that a condition cannot cast
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A B) DEFINE A AS id > 0,
  B AS CAST(x AS integer) > 0)
--- fails <query>:2:8: DEFINE: DuckDB: Conversion Error

--- case a value of two rows that a condition cannot cast
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES id AS i PATTERN (A B) DEFINE A AS id > 0,
  B AS CAST(A.x || B.x AS integer) > 0)
--- fails <query>:2:8: DEFINE: DuckDB: Conversion Error

--- case a measure that makes several rows of one
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES ▸unnest([id, 2]) AS n PATTERN (A))
--- error UNNEST makes several rows of one

--- case a list comprehension
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES [▸e + 1 FOR e IN list(id)] AS n PATTERN (A))
--- error a list comprehension must not stand here; write list_transform

--- case an order by the number of a column
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY ▸1 MEASURES id AS i PATTERN (A))
--- error ORDER BY: 1 is the same for every row; name a column
