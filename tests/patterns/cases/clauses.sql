--- case without PARTITION BY all rows are one partition
SELECT * FROM (VALUES (1, 1), (2, 2), (1, 3)) AS t(k, id) MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(k) AS ks PATTERN (A+))
--- wanted
ks
[1, 2, 1]

--- case partitions by two columns
SELECT * FROM (VALUES (1, 'x', 1), (1, 'y', 2), (1, 'x', 3), (2, 'x', 4)) AS t(a, b, id) MATCH_RECOGNIZE (
  PARTITION BY a, b ORDER BY id MEASURES array_agg(id) AS ids PATTERN (A+)) ORDER BY a, b
--- wanted
a | b | ids
1 | x | [1, 3]
1 | y | [2]
2 | x | [4]

--- case NULL is a partition of its own
SELECT * FROM (VALUES (NULL, 1), (1, 2), (NULL, 3)) AS t(k, id) MATCH_RECOGNIZE (
  PARTITION BY k ORDER BY id MEASURES array_agg(id) AS ids PATTERN (A+)) ORDER BY k NULLS FIRST
--- wanted
k | ids
NULL | [1, 3]
1 | [2]

--- case the order is that of ORDER BY, not that of the input
SELECT * FROM (VALUES (3), (1), (2)) AS t(id) MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(id) AS ids PATTERN (A+))
--- wanted
ids
[1, 2, 3]

--- case a descending order
SELECT * FROM (VALUES (3), (1), (2)) AS t(id) MATCH_RECOGNIZE (ORDER BY id DESC MEASURES array_agg(id) AS ids PATTERN (A+))
--- wanted
ids
[3, 2, 1]

--- case an order of several columns
SELECT * FROM (VALUES (1, 'b', 1), (2, 'a', 1), (1, 'a', 2), (2, 'b', 2)) AS t(a, b, id) MATCH_RECOGNIZE (
  ORDER BY a DESC, b ASC MEASURES array_agg(a || b) AS seen PATTERN (X+))
--- wanted
seen
[2a, 2b, 1a, 1b]

--- case where NULL stands in the order is said
SELECT * FROM (VALUES (2, 'x'), (NULL, 'y'), (1, 'z')) AS t(id, x) MATCH_RECOGNIZE (
  ORDER BY id ASC NULLS FIRST MEASURES string_agg(x, '') AS xs PATTERN (A+))
--- wanted
xs
yzx

--- case NULL last in a descending order
SELECT * FROM (VALUES (2, 'x'), (NULL, 'y'), (3, 'z')) AS t(id, x) MATCH_RECOGNIZE (
  ORDER BY id DESC NULLS LAST MEASURES string_agg(x, '') AS xs PATTERN (A+))
--- wanted
xs
zxy

--- case rows that tie keep the order of the input
SELECT * FROM (VALUES (1, 'c'), (1, 'a'), (0, 'x'), (1, 'b')) AS t(id, x) MATCH_RECOGNIZE (
  ORDER BY id MEASURES string_agg(x, '') AS xs PATTERN (A+))
--- wanted
xs
xcab

--- case without ORDER BY the order is that of the input
SELECT * FROM (VALUES (3, 'x'), (1, 'y'), (2, 'z')) AS t(id, x) MATCH_RECOGNIZE (MEASURES string_agg(x, '') AS xs PATTERN (A+))
--- wanted
xs
xyz

--- case an order by text
SELECT * FROM (VALUES ('b'), ('a'), ('c')) AS t(x) MATCH_RECOGNIZE (ORDER BY x MEASURES string_agg(x, '') AS xs PATTERN (A+))
--- wanted
xs
abc

--- case an order by a date, and arithmetic on it
SELECT * FROM (VALUES (DATE '2026-01-03'), (DATE '2026-01-01'), (DATE '2026-01-02'), (DATE '2026-01-05')) AS t(d) MATCH_RECOGNIZE (
  ORDER BY d MEASURES FIRST(d) AS since, LAST(d) AS until, COUNT(*) AS days
  PATTERN (A B*) DEFINE B AS d = PREV(d) + 1)
--- wanted
since date | until date | days bigint
2026-01-01 | 2026-01-03 | 3
2026-01-05 | 2026-01-05 | 1

--- case DEFINE may be left out
SELECT * FROM (VALUES (1), (2)) AS t(id) MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B))
--- wanted
n
2

--- case a definition that is always true, and one that never is
SELECT * FROM (VALUES (1), (2)) AS t(id) MATCH_RECOGNIZE (ORDER BY id MEASURES CLASSIFIER() AS c PATTERN (A | B)
  DEFINE A AS FALSE, B AS TRUE)
--- wanted
c
B
B

--- case INITIAL is what is meant if nothing is said
SELECT * FROM (VALUES (1), (2)) AS t(id) MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n
  AFTER MATCH SKIP PAST LAST ROW INITIAL PATTERN (A B))
--- wanted
n
2

--- case WITHIN leaves out what lies an interval after the first row
SELECT * FROM (VALUES (TIMESTAMP '2026-01-01 10:00:00'), ('2026-01-01 10:00:04.999'), ('2026-01-01 10:00:05')) AS t(ts) MATCH_RECOGNIZE (
  ORDER BY ts MEASURES FIRST(ts)::time AS f, COUNT(*) AS n PATTERN (A+) WITHIN INTERVAL '5' SECOND)
--- wanted
f | n
10:00:00 | 2
10:00:05 | 1

--- case WITHIN makes a match fail that would take longer
SELECT * FROM (VALUES (TIMESTAMP '2026-01-01 10:00:00', 'a'), ('2026-01-01 10:00:10', 'a'), ('2026-01-01 10:00:12', 'b')) AS t(ts, x)
MATCH_RECOGNIZE (ORDER BY ts MEASURES A.ts::time AS a, B.ts::time AS b PATTERN (A X* B) WITHIN INTERVAL '10' SECOND
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
a | b
10:00:10 | 10:00:12

--- case names of columns are compared without regard to case
SELECT ID, n FROM (VALUES (1, 2)) AS t("Id", "Value") MATCH_RECOGNIZE (ORDER BY ID MEASURES a.VALUE AS n, LAST(iD) AS id PATTERN (A))
--- wanted
id | n
1 | 2

--- case names in quotes, with spaces, quotes and words of the clause in them
SELECT * FROM (VALUES (1, 2, 3)) AS t("order", "a ""b""", "MEASURES") MATCH_RECOGNIZE (
  ORDER BY "order" MEASURES LAST("a ""b""") AS "x-y", "pattern"."MEASURES" AS "define" PATTERN ("pattern"))
--- wanted
x-y | define
2 | 3

--- case words of the clause as names of columns and variables
SELECT * FROM (VALUES (1, 10, 20)) AS t(id, match, final) MATCH_RECOGNIZE (
  ORDER BY id MEASURES first.match AS match, LAST(first.final) AS rows PATTERN (first))
--- wanted
match | rows
10 | 20

--- case columns of nested types
SELECT * FROM (VALUES (1, [1, 2], {'a': 'x'}), (2, [3], {'a': 'y'})) AS t(id, l, s) MATCH_RECOGNIZE (
  ORDER BY id MEASURES LAST(l) AS l, FIRST(l[1]) AS l1, LAST(len(l)) AS n, s AS s PATTERN (A B))
--- wanted
l integer[] | l1 integer | n bigint | s struct(a varchar)
[3] | 1 | 1 | {'a': y}

--- case columns of many types come through as they are
SELECT * FROM (VALUES (1::tinyint, 2::smallint, 3::bigint, 1.5::float, 2.5::double, 1.25::decimal(5,2), TRUE,
  DATE '2026-01-01', TIME '10:00:00', TIMESTAMP '2026-01-01 10:00:00', TIMESTAMPTZ '2026-01-01 10:00:00+00', 'x'::blob)) AS t(a, b, c, d, e, f, g, h, i, j, k, l)
MATCH_RECOGNIZE (MEASURES a AS a, b AS b, c AS c, d AS d, e AS e, f AS f, g AS g, h AS h, i AS i, j AS j, k AS k, l AS l PATTERN (X))
--- wanted
a tinyint | b smallint | c bigint | d float | e double | f decimal(5,2) | g boolean | h date | i time | j timestamp | k timestamp with time zone | l blob
1 | 2 | 3 | 1.5 | 2.5 | 1.25 | true | 2026-01-01 | 10:00:00 | 2026-01-01 10:00:00 | 2026-01-01 10:00:00+00 | x

--- case intervals between times
SELECT * FROM (VALUES (TIMESTAMP '2026-01-01 10:00:00'), ('2026-01-01 10:00:30'), ('2026-01-01 10:05:00')) AS t(ts) MATCH_RECOGNIZE (
  ORDER BY ts MEASURES LAST(ts) - FIRST(ts) AS lasted PATTERN (A B+) DEFINE B AS ts < PREV(ts) + INTERVAL '1' MINUTE)
--- wanted
lasted interval
00:00:30

--- case a column that is NULL in every row
SELECT * FROM (VALUES (1, NULL::integer), (2, NULL)) AS t(id, v) MATCH_RECOGNIZE (
  ORDER BY id MEASURES SUM(v) AS s, LAST(v) AS l, COUNT(v) AS n PATTERN (A+ B?) DEFINE A AS v IS NULL, B AS v > 0)
--- wanted
s | l integer | n
NULL | NULL | 0

--- case division of integers is that of the standard
SELECT * FROM (VALUES (7)) AS t(v) MATCH_RECOGNIZE (MEASURES v / 2 AS half, v / 2.0 AS exact PATTERN (A))
--- wanted
half | exact
3 | 3.5

--- case a semicolon after the query
SELECT * FROM (VALUES (1)) AS t(id) MATCH_RECOGNIZE (MEASURES id AS id PATTERN (A));
--- wanted
id
1

--- case words of the clause in any case
select * from (values (1)) as t(id) match_recognize (order by id measures id as id one row per match
  after match skip past last row pattern (a) define a as true)
--- wanted
id
1
