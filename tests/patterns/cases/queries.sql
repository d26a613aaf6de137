--- table ticks
symbol varchar | ts integer | price integer
ACME | 1 | 10
ACME | 2 | 8
ACME | 3 | 9
BETA | 1 | 5
BETA | 2 | 4
BETA | 3 | 7
--- table names
symbol varchar | name varchar
ACME | Acme Ltd
BETA | Beta Inc

--- case an input of VALUES with names for its columns
SELECT m.a, m.b FROM (VALUES (1, 10), (2, 20)) AS t(id, value) MATCH_RECOGNIZE (
  ORDER BY id MEASURES A.value AS a, B.value AS b PATTERN (A B)) AS m
--- wanted
a | b
10 | 20

--- case an input of VALUES without parentheses of its own
SELECT * FROM VALUES (1, 10), (2, 20) AS t(id, value) MATCH_RECOGNIZE (ORDER BY id MEASURES SUM(value) AS s PATTERN (A+))
--- wanted
s
30

--- case an input that is a table
SELECT * FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES LAST(B.price) AS low PATTERN (A B C)
  DEFINE B AS B.price < A.price, C AS C.price > B.price) ORDER BY symbol
--- wanted
symbol | low
ACME | 8
BETA | 4

--- case an input that is a table with another name
SELECT * FROM ticks AS t MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES COUNT(*) AS n PATTERN (A+)) ORDER BY 1
--- wanted
symbol | n
ACME | 3
BETA | 3

--- case an input that is a table with other names for its columns
SELECT * FROM ticks t (s, a, p) MATCH_RECOGNIZE (PARTITION BY s ORDER BY a MEASURES LAST(p) AS p PATTERN (A+)) ORDER BY s
--- wanted
s | p
ACME | 9
BETA | 7

--- case an input that is a table in its schema
SELECT count(*) AS n FROM main.ticks MATCH_RECOGNIZE (ORDER BY symbol, ts MEASURES ts AS at PATTERN (A))
--- wanted
n
6

--- case an input whose name is quoted
SELECT * FROM "Odd Name" MATCH_RECOGNIZE (ORDER BY id MEASURES id AS id PATTERN (A))
--- table Odd Name
id integer
1
--- wanted
id
1

--- case an input that is a sub-query
SELECT * FROM (SELECT symbol, ts, price * 2 AS twice FROM ticks WHERE price > 4) MATCH_RECOGNIZE (
  PARTITION BY symbol ORDER BY ts MEASURES array_agg(twice) AS ts PATTERN (A+)) ORDER BY symbol
--- wanted
symbol | ts
ACME | [20, 16, 18]
BETA | [10, 14]

--- case an input that is a join in parentheses
SELECT * FROM (ticks JOIN names USING (symbol)) MATCH_RECOGNIZE (
  PARTITION BY name ORDER BY ts MEASURES COUNT(*) AS n PATTERN (A+)) ORDER BY name
--- wanted
name | n
Acme Ltd | 3
Beta Inc | 3

--- case an input that is a table function
SELECT * FROM range(5) AS r(i) MATCH_RECOGNIZE (ORDER BY i MEASURES FIRST(i) AS f, LAST(i) AS l PATTERN (A B))
--- wanted
f | l
0 | 1
2 | 3

--- case an input that is the answer of another clause
SELECT * FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES LAST(price) AS p PATTERN (A A))
  MATCH_RECOGNIZE (ORDER BY symbol MEASURES array_agg(p) AS ps PATTERN (X+))
--- wanted
ps
[8, 4]

--- case an input that is the answer of another clause, with a name
SELECT * FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES LAST(price) AS p PATTERN (A A)) AS m(s, last_price)
  MATCH_RECOGNIZE (ORDER BY s MEASURES array_agg(last_price) AS ps PATTERN (X+)) AS n
--- wanted
ps
[8, 4]

--- case a clause in a sub-query of another clause
SELECT * FROM (SELECT p + 1 AS q FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES LAST(price) AS p PATTERN (A A)))
  MATCH_RECOGNIZE (ORDER BY q MEASURES array_agg(q) AS qs PATTERN (X+))
--- wanted
qs
[5, 9]

--- case an input that is a common table expression
WITH high AS (SELECT * FROM ticks WHERE price >= 8)
SELECT * FROM high MATCH_RECOGNIZE (ORDER BY ts MEASURES COUNT(*) AS n PATTERN (A+))
--- wanted
n
3

--- case a common table expression that holds a clause
WITH lows AS (SELECT * FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MIN(price) AS low PATTERN (A+)))
SELECT name, low FROM lows JOIN names USING (symbol) ORDER BY name
--- wanted
name | low
Acme Ltd | 8
Beta Inc | 4

--- case a clause over a common table expression that rests on one before it
WITH a AS (SELECT * FROM ticks), b (s, p) AS (SELECT symbol, price FROM a),
     c AS MATERIALIZED (SELECT * FROM b MATCH_RECOGNIZE (PARTITION BY s ORDER BY p MEASURES COUNT(*) AS n PATTERN (X+)))
SELECT * FROM c MATCH_RECOGNIZE (ORDER BY s MEASURES SUM(n) AS total PATTERN (Y+))
--- wanted
total
6

--- case the nearest of two common table expressions of one name is meant
WITH a AS (SELECT 1 AS id) SELECT * FROM (WITH a AS (SELECT 2 AS id) SELECT * FROM a MATCH_RECOGNIZE (MEASURES id AS id PATTERN (X)))
--- wanted
id
2

--- case a recursive common table expression as input
WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r WHERE i < 4)
SELECT * FROM r MATCH_RECOGNIZE (ORDER BY i MEASURES SUM(i) AS s PATTERN (A+))
--- wanted
s
10

--- case the answer of a clause joined with a table
SELECT m.low, names.name FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MIN(price) AS low PATTERN (A+)) AS m
  JOIN names ON names.symbol = m.symbol ORDER BY low
--- wanted
low | name
4 | Beta Inc
8 | Acme Ltd

--- case a table joined with the answer of a clause
SELECT name, low FROM names LEFT JOIN ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MIN(price) AS low PATTERN (A+)
  DEFINE A AS symbol = 'ACME') AS m USING (symbol) ORDER BY name
--- wanted
name | low
Acme Ltd | 8
Beta Inc | NULL

--- case the answers of two clauses joined
SELECT a.symbol, a.low, b.high
FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MIN(price) AS low PATTERN (A+)) AS a
JOIN ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MAX(price) AS high PATTERN (A+)) AS b ON a.symbol = b.symbol
ORDER BY 1
--- wanted
symbol | low | high
ACME | 8 | 10
BETA | 4 | 7

--- case the answers of two clauses with a comma between them
SELECT a.n + b.n AS n FROM ticks MATCH_RECOGNIZE (ORDER BY ts MEASURES COUNT(*) AS n PATTERN (A+)) AS a,
  names MATCH_RECOGNIZE (MEASURES COUNT(*) AS n PATTERN (A+)) AS b
--- wanted
n
8

--- case clauses in the arms of a UNION
SELECT 'low' AS what, v FROM ticks MATCH_RECOGNIZE (ORDER BY price MEASURES FIRST(price) AS v PATTERN (A+))
UNION ALL SELECT 'high', v FROM ticks MATCH_RECOGNIZE (ORDER BY price MEASURES LAST(price) AS v PATTERN (A+)) ORDER BY v
--- wanted
what | v
low | 4
high | 10

--- case a clause in a scalar sub-query
SELECT name, (SELECT max(n) FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES COUNT(*) AS n PATTERN (A+)) AS m
  WHERE m.symbol = names.symbol) AS n FROM names ORDER BY name
--- wanted
name | n
Acme Ltd | 3
Beta Inc | 3

--- case a clause in EXISTS and in IN
SELECT name FROM names WHERE EXISTS (SELECT 1 FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts PATTERN (A) DEFINE A AS price > 9) m
    WHERE m.symbol = names.symbol)
  AND symbol IN (SELECT symbol FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts PATTERN (A A A)))
--- wanted
name
Acme Ltd

--- case names for the columns of an answer
SELECT m.s, m.low FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES MIN(price) AS x PATTERN (A+)) AS m(s, low) ORDER BY s
--- wanted
s | low
ACME | 8
BETA | 4

--- case a name for an answer without AS
SELECT m.* FROM ticks MATCH_RECOGNIZE (ORDER BY price MEASURES FIRST(price) AS least PATTERN (A+)) m
--- wanted
least
4

--- case an answer without a name
SELECT least FROM ticks MATCH_RECOGNIZE (ORDER BY price MEASURES FIRST(price) AS least PATTERN (A+)) WHERE least < 5
--- wanted
least
4

--- case an answer grouped, filtered and ordered
SELECT symbol, count(*) AS n, sum(p) AS total FROM ticks MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES A.price AS p PATTERN (A)) AS m
WHERE p > 4 GROUP BY symbol HAVING count(*) > 1 ORDER BY total DESC LIMIT 1
--- wanted
symbol | n | total
ACME | 3 | 27

--- case a window function over an answer
SELECT p, row_number() OVER (ORDER BY p) AS r FROM names MATCH_RECOGNIZE (ORDER BY name MEASURES name AS p PATTERN (A)) ORDER BY r
--- wanted
p | r
Acme Ltd | 1
Beta Inc | 2

--- case a query that begins with FROM
FROM ticks MATCH_RECOGNIZE (ORDER BY price MEASURES FIRST(price) AS least PATTERN (A+))
--- wanted
least
4

--- case a table and a clause in parentheses
SELECT least FROM (ticks MATCH_RECOGNIZE (ORDER BY price MEASURES FIRST(price) AS least PATTERN (A+)))
--- wanted
least
4

--- case the words in texts, names and comments are no clause
SELECT 'FROM t MATCH_RECOGNIZE (PATTERN (A))' AS a, "MATCH_RECOGNIZE" AS b -- MATCH_RECOGNIZE (
FROM (SELECT $$x MATCH_RECOGNIZE ($$ AS "MATCH_RECOGNIZE") /* MATCH_RECOGNIZE ( /* nested */ */
--- wanted
a | b
FROM t MATCH_RECOGNIZE (PATTERN (A)) | x MATCH_RECOGNIZE (

--- case parentheses and commas inside texts of a clause do not end it
SELECT * FROM (VALUES (1, ')'), (2, '(,')) AS t(id, x) MATCH_RECOGNIZE (ORDER BY id /* ) */
  MEASURES string_agg(x, ')') AS xs, ')' AS "c)" PATTERN (A B) DEFINE A AS x = ')', B AS x = '(,' -- )
) AS m
--- wanted
xs | c)
))(, | )

--- case a query without any clause
SELECT count(*) AS n FROM ticks
--- wanted
n
6

--- case a clause over no rows
SELECT * FROM (SELECT * FROM ticks WHERE FALSE) MATCH_RECOGNIZE (PARTITION BY symbol ORDER BY ts MEASURES SUM(price) AS s, CLASSIFIER() AS c PATTERN (A*))
--- wanted
symbol | s | c varchar

--- case an answer whose rows are made into a table
CREATE TABLE kept AS SELECT * FROM ticks MATCH_RECOGNIZE (ORDER BY ts MEASURES ts AS at PATTERN (A))
--- wanted
Count bigint
6

--- case the name of the input in front of its columns
--- letters t aab
SELECT * FROM t AS seen MATCH_RECOGNIZE (PARTITION BY seen.x ORDER BY seen.id
  MEASURES SUM(seen.id) AS s, LAST(SEEN.id) AS l, A.id AS a PATTERN (A B?) DEFINE B AS seen.id > PREV(seen.id))
--- wanted
x | s | l | a
a | 3 | 2 | 1
b | 3 | 3 | 3

--- case a variable that is called like the input
--- letters t abb
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(t.id) AS l, COUNT(t.*) AS n PATTERN (t A+) DEFINE t AS x = 'a')
--- wanted
l | n
1 | 1

--- case partitions and order by expressions
SELECT * FROM t MATCH_RECOGNIZE (PARTITION BY lower(name) ORDER BY -id, length(name) DESC
  MEASURES array_agg(id) AS ids PATTERN (A+))
--- table t
id int | name varchar
1      | ann
2      | bob
3      | Ann
4      | BOB
5      | cid
--- wanted
lower(name) | ids
ann         | [3, 1]
bob         | [4, 2]
cid         | [5]

--- case what the order is by is no column of all rows
--- letters t abc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id % 2, id MEASURES COUNT(*) AS n ALL ROWS PER MATCH PATTERN (A+))
--- wanted
id | n | x
2  | 1 | b
1  | 2 | a
3  | 3 | c

--- case an order by a field
SELECT * FROM (SELECT {'h': 9, 'm': 5} AS seen UNION ALL SELECT {'h': 8, 'm': 59}) AS o MATCH_RECOGNIZE (
  ORDER BY o.seen.h, seen.m MEASURES FIRST(seen.h) AS f, LAST(A.seen.m) AS l PATTERN (A+))
--- wanted
f | l
8 | 5

--- case columns that are called like clauses
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY pattern, define MEASURES A.pattern AS p, A.define + t.final AS d, define AS e,
  FINAL LAST(final) AS f, running AS r PATTERN (A) DEFINE A AS A.pattern = 1)
--- table t
pattern int | define int | final int | running int
1           | 2          | 3         | 4
--- wanted
p | d | e | f | r
1 | 5 | 2 | 3 | 4

--- case a place in a list that an aggregate makes
--- letters t abc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id
  MEASURES list(x)[2] AS b, array_agg(x)[1] AS a, list(B.id)[-1] AS c, ARRAY[LAST(x)] AS d PATTERN (A B+))
--- wanted
b | a | c | d
b | a | 3 | [c]

--- case sums divide as whole numbers do
--- letters t abb
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES SUM(id) / 4 AS s, SUM(id) / COUNT(*) AS m PATTERN (A+)
  DEFINE A AS SUM(id) / 4 <= 1)
--- wanted
s | m
1 | 2

--- case a condition that is NULL
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A | B) DEFINE A AS NULL)
--- wanted
n
1
1

--- case sub-queries in measures
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(A.id + (SELECT max(id) * 10 FROM t)) AS l, (SELECT NULL) AS n,
  EXISTS (SELECT 1 FROM t WHERE x = 'b') AND COUNT(*) = 2 AS e, array_agg(x || (SELECT 'z')) AS z,
  (SELECT [DATE '2026-01-02']) AS d PATTERN (A A+?))
--- wanted
l  | n    | e    | z        | d date[]
32 | NULL | true | [az, az] | [2026-01-02]

--- case IN over a sub-query, with SQL's NULL
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.x IN (SELECT v FROM w) AS i, A.x NOT IN (SELECT v FROM w) AS o,
  A.x IN (SELECT v FROM n) AS n, A.x NOT IN (SELECT v FROM w WHERE false) AS e PATTERN (A))
--- letters t ab-c
--- table w
v varchar
a
c
--- table n
v varchar
a
NULL
--- wanted
i | o | n | e
true   | false  | true   | true
false  | true   | NULL   | true
NULL   | NULL   | NULL   | true
true   | false  | NULL   | true

--- case a column that a join has twice, which the clause does not name
SELECT m.* FROM (t JOIN u USING (id)) MATCH_RECOGNIZE (ORDER BY id MEASURES A.id + n AS s PATTERN (A)) AS m
--- letters t ab
--- table u
id int | x int | n int
1      | 5     | 2
2      | 6     | 3
--- wanted
s
3
5

--- case a column that a sub-query has twice, of which the later gets a number, as in DuckDB
SELECT * FROM (SELECT 1 AS x, 2 AS x) AS t MATCH_RECOGNIZE (MEASURES A.x AS a, t.x_1 AS b PATTERN (A))
--- wanted
a | b
1 | 2
