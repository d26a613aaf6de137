--- table q
id integer | v integer
1 | 4
2 | NULL
3 | 6
4 | 2

--- case counts of rows and of values
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES COUNT(*) AS n, COUNT(A.*) AS a, COUNT(B.*) AS b, COUNT(v) AS v, COUNT(A.v) AS av, COUNT(1) AS one, COUNT() AS none
  PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
n bigint | a bigint | b | v | av | one | none
4 | 2 | 2 | 3 | 1 | 4 | 4

--- case sums, least and greatest pass over NULL
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES SUM(v) AS s, SUM(A.v) AS sa, MIN(v) AS least, MAX(B.v) AS most, AVG(v) AS mean, AVG(B.v) AS mb
  PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
s | sa | least integer | most integer | mean double | mb double
12 | 4 | 2 | 6 | 4.0 | 4.0

--- case aggregates over a variable that the match lacks
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES COUNT(C.*) AS n, COUNT(C.v) AS nv, SUM(C.v) AS s, MIN(C.v) AS least, AVG(C.v) AS mean, array_agg(C.v) AS list
  PATTERN (A+ C*) DEFINE C AS FALSE)
--- wanted
n | nv | s | least | mean | list
0 | 0 | NULL | NULL | NULL | NULL

--- case aggregates of expressions
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES SUM(v * 2) AS s, SUM(A.v + A.id) AS sa, MAX(v - id) AS d, MAX(v) - MIN(v) AS spread, SUM(CASE WHEN v > 3 THEN 1 END) AS many
  PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
s | sa | d | spread | many
24 | 5 | 3 | 4 | 2

--- case lists keep the order of the rows, and NULL
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id DESC MEASURES array_agg(v) AS v, array_agg(A.id) AS a, array_agg(CLASSIFIER()) AS c
  PATTERN (A+ B+) DEFINE A AS id > 2, B AS id <= 2)
--- wanted
v integer[] | a integer[] | c varchar[]
[2, 6, NULL, 4] | [4, 3] | [A, A, B, B]

--- case aggregates of DuckDB beyond the standard's five
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES string_agg(CLASSIFIER(), '-') AS c, bool_and(v > 1) AS b, median(v) AS m, COUNT(DISTINCT CLASSIFIER()) AS d, stddev_pop(B.v) AS dev
  PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
c varchar | b boolean | m double | d bigint | dev double
A-A-B-B | true | 4.0 | 2 | 2.0

--- case aggregates of two arguments
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES max_by(id, v) AS a, min_by(id, v) AS b, max_by(A.id, A.v) AS c, max_by(CLASSIFIER(), v) AS d, min_by(1, v) AS e
  PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
a integer | b integer | c integer | d varchar | e
3 | 4 | 1 | B | 1

--- case aggregates of DISTINCT values
SELECT * FROM (VALUES (1, 3), (2, 3), (3, 5)) AS t(id, v) MATCH_RECOGNIZE (ORDER BY id
  MEASURES SUM(DISTINCT v) AS s, COUNT(DISTINCT v) AS n, SUM(v) AS total PATTERN (A+))
--- wanted
s | n | total
8 | 2 | 11

--- case MATCH_NUMBER and CLASSIFIER inside aggregates
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES array_agg(MATCH_NUMBER()) AS m, SUM(MATCH_NUMBER()) AS s, array_agg(CLASSIFIER() || id) AS c
  PATTERN (A{2}))
--- wanted
m bigint[] | s | c
[1, 1] | 2 | [A1, A2]
[2, 2] | 4 | [A3, A4]

--- case aggregates grow from row to row with ALL ROWS PER MATCH
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES SUM(v) AS s, COUNT(A.*) AS a, COUNT(B.*) AS b, MAX(v) AS most, AVG(v) AS mean, array_agg(v) AS list
  ALL ROWS PER MATCH PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
id | s | a | b | most | mean | list | v
1 | 4 | 1 | 0 | 4 | 4.0 | [4] | 4
2 | 4 | 2 | 0 | 4 | 4.0 | [4, NULL] | NULL
3 | 10 | 2 | 1 | 6 | 5.0 | [4, NULL, 6] | 6
4 | 12 | 2 | 2 | 6 | 4.0 | [4, NULL, 6, 2] | 2

--- case RUNNING is the same as nothing, FINAL sees the whole match
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES RUNNING SUM(v) AS r, FINAL SUM(v) AS f, FINAL COUNT(B.*) AS b, RUNNING COUNT(*) AS n, FINAL array_agg(CLASSIFIER()) AS c
  ALL ROWS PER MATCH PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
id | r | f | b | n | c | v
1 | 4 | 12 | 2 | 1 | [A, A, B, B] | 4
2 | 4 | 12 | 2 | 2 | [A, A, B, B] | NULL
3 | 10 | 12 | 2 | 3 | [A, A, B, B] | 6
4 | 12 | 12 | 2 | 4 | [A, A, B, B] | 2

--- case RUNNING and FINAL are the same with ONE ROW PER MATCH
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES RUNNING SUM(v) AS r, FINAL SUM(v) AS f, RUNNING LAST(v) AS rl, FINAL LAST(v) AS fl, RUNNING COUNT(A.*) AS ra
  ONE ROW PER MATCH PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
r | f | rl | fl | ra
12 | 12 | 2 | 2 | 2

--- case RUNNING and FINAL with FIRST and LAST
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id
  MEASURES RUNNING LAST(A.id) AS ra, FINAL LAST(A.id) AS fa, RUNNING FIRST(B.id) AS rb, FINAL FIRST(B.id) AS fb, FINAL LAST(id) - id AS left_over
  ALL ROWS PER MATCH PATTERN (A+ B+) DEFINE A AS id <= 2, B AS id > 2)
--- wanted
id | ra | fa | rb | fb | left_over | v
1 | 1 | 2 | NULL | 3 | 3 | 4
2 | 2 | 2 | NULL | 3 | 2 | NULL
3 | 2 | 2 | 3 | 3 | 1 | 6
4 | 2 | 2 | 3 | 3 | 0 | 2

--- case RUNNING and FINAL in one expression
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id MEASURES FINAL COUNT(*) - RUNNING COUNT(*) AS to_come ALL ROWS PER MATCH PATTERN (A+))
--- wanted
id | to_come bigint | v
1 | 3 | 4
2 | 2 | NULL
3 | 1 | 6
4 | 0 | 2

--- case a running sum in a definition counts the row at hand
SELECT * FROM (VALUES (1, 10), (2, 8), (3, 6), (4, 9), (5, 12), (6, 7)) AS t(id, v) MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS SUM(A.v) <= 20)
--- wanted
f | l
1 | 2
3 | 4
5 | 6

--- case a running average in a definition
SELECT * FROM (VALUES (1, 10), (2, 8), (3, 6), (4, 3), (5, 12)) AS t(id, v) MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS AVG(A.v) >= 8)
--- wanted
f | l
1 | 3
5 | 5

--- case counts in a definition bound a repetition
SELECT * FROM q MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS COUNT(*) <= 3)
--- wanted
f | l
1 | 3
4 | 4

--- case an aggregate of another variable in a definition
SELECT * FROM (VALUES (1, 3), (2, 5), (3, 4), (4, 6)) AS t(id, v) MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(id) AS f, B.id AS b PATTERN (A{2} B) DEFINE B AS B.v > MAX(A.v))
--- wanted
f | b
2 | 4

--- case a list aggregate in a definition
SELECT * FROM (VALUES (1, 'x'), (2, 'y'), (3, 'x'), (4, 'z')) AS t(id, v) MATCH_RECOGNIZE (ORDER BY id
  MEASURES string_agg(v, '') AS vs PATTERN (A+) DEFINE A AS COUNT(DISTINCT A.v) = COUNT(A.v))
--- wanted
vs
xy
xz

--- case aggregates of decimals, times and booleans keep DuckDB's types
SELECT * FROM (VALUES (1, 1.50::decimal(6,2), DATE '2026-01-01', TRUE), (2, 2.25, DATE '2026-01-03', FALSE)) AS t(id, v, d, b)
MATCH_RECOGNIZE (ORDER BY id MEASURES SUM(v) AS s, MAX(v) AS most, MAX(d) AS latest, bool_or(b) AS b, AVG(v) AS mean PATTERN (A+))
--- wanted
s decimal(38,2) | most decimal(6,2) | latest date | b boolean | mean double
3.75 | 2.25 | 2026-01-03 | true | 1.875
