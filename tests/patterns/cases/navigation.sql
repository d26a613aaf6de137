--- table p
id integer | v integer
1 | 10
2 | 8
3 | 6
4 | 9
5 | 12
6 | 7

--- case a column of a variable is that of its last row
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES A.v AS a, B.v AS b, C.v AS c, v AS any_v
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
a integer | b integer | c integer | any_v integer
10 | 6 | 12 | 12

--- case FIRST and LAST without an offset
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(A.v) AS fa, FIRST(B.v) AS fb, LAST(B.v) AS lb, FIRST(C.v) AS fc, LAST(C.v) AS lc, FIRST(v) AS f, LAST(v) AS l
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
fa | fb | lb | fc | lc | f | l
10 | 8 | 6 | 9 | 12 | 10 | 12

--- case FIRST and LAST with an offset count rows of the variable
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(B.v, 1) AS b1, FIRST(B.v, 2) AS b2, LAST(B.v, 0) AS l0, LAST(B.v, 1) AS l1, LAST(B.v, 2) AS l2
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
b1 | b2 | l0 | l1 | l2
6 | NULL | 6 | 8 | NULL

--- case FIRST and LAST with an offset over all rows of the match
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(v, 1) AS f1, FIRST(v, 4) AS f4, LAST(v, 1) AS l1, LAST(v, 5) AS l5
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
f1 | f4 | l1 | l5
8 | 12 | 9 | NULL

--- case PREV and NEXT count rows of the partition, beyond the match too
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES PREV(A.v) AS before, NEXT(A.v) AS a1, NEXT(C.v) AS c1, NEXT(C.v, 2) AS c2, PREV(B.v) AS b1, PREV(B.v, 2) AS b2
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
before | a1 | c1 | c2 | b1 | b2
NULL | 8 | 7 | NULL | 8 | 10

--- case PREV and NEXT by no row
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES PREV(B.v, 0) AS p0, NEXT(B.v, 0) AS n0
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
p0 | n0
6 | 6

--- case PREV and NEXT around FIRST and LAST begin where those stand
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES PREV(FIRST(B.v)) AS a, PREV(FIRST(B.v, 1)) AS b, NEXT(FIRST(A.v), 2) AS c, NEXT(LAST(C.v, 1)) AS d, PREV(LAST(v, 1), 2) AS e
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
a | b | c | d | e
10 | 8 | 6 | 12 | 8

--- case nested navigation is NULL where the inner one finds no row
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES PREV(FIRST(A.v, 1)) AS a, NEXT(LAST(D.v), 1) AS b
  PATTERN (A B+ C+ D*) DEFINE B AS v < PREV(v), C AS v > PREV(v), D AS FALSE)
--- wanted
a | b
NULL | NULL

--- case nested navigation is NULL beyond the partition
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES PREV(FIRST(v), 1) AS a, NEXT(LAST(v), 2) AS b, NEXT(LAST(v), 1) AS c
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
a | b | c
NULL | NULL | 7

--- case an expression is taken in the row that navigation finds
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES LAST(B.v * 10 + B.id) AS a, PREV(B.v + B.id) AS b, FIRST(v || '!') AS c, NEXT(FIRST(v - id, 1), 1) AS d
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
a | b | c varchar | d
63 | 10 | 10! | 3

--- case CLASSIFIER inside navigation
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(CLASSIFIER()) AS f, LAST(CLASSIFIER()) AS l, LAST(CLASSIFIER(), 2) AS l2, PREV(CLASSIFIER(), 2) AS p2,
           LAST('variable ' || CLASSIFIER()) AS t, LAST(CLASSIFIER() = 'A' OR v > 10) AS b
  PATTERN (A B+ C+) DEFINE B AS v < PREV(v), C AS v > PREV(v))
--- wanted
f varchar | l | l2 | p2 | t | b boolean
A | C | B | B | variable C | true

--- case navigation to a variable that the match lacks is NULL
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES D.v AS a, FIRST(D.v) AS b, PREV(D.v) AS c, CLASSIFIER(D) AS d, COALESCE(D.v, -1) AS e
  PATTERN (A D?) DEFINE A AS id = 1, D AS FALSE)
--- wanted
a integer | b integer | c integer | d varchar | e integer
NULL | NULL | NULL | NULL | -1

--- case NEXT in a definition looks at rows that are not matched yet
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS v > NEXT(v))
--- wanted
f | l
1 | 2
5 | 5

--- case NEXT at the end of the partition is NULL
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id PATTERN (A) DEFINE A AS NEXT(A.v) IS NULL)
--- wanted
id
6

--- case PREV at the beginning of the partition is NULL
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id PATTERN (A) DEFINE A AS PREV(v, 2) IS NULL)
--- wanted
id
1
2

--- case PREV in a definition looks before the match
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS v > PREV(v))
--- wanted
f | l
4 | 5

--- case PREV does not look into another partition
SELECT * FROM (VALUES (1, 1, 5), (1, 2, 6), (2, 1, 7), (2, 2, 8)) AS t(k, id, v) MATCH_RECOGNIZE (
  PARTITION BY k ORDER BY id MEASURES A.v AS v PATTERN (A) DEFINE A AS v > PREV(v))
--- wanted
k | v
1 | 6
2 | 8

--- case in its own definition a variable's last row is the row at hand
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+)
  DEFINE A AS LAST(A.v) > LAST(A.v, 1) OR LAST(A.v, 1) IS NULL)
--- wanted
f | l
1 | 1
2 | 2
3 | 5
6 | 6

--- case FIRST in a definition is the first row mapped so far
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+) DEFINE A AS v <= FIRST(A.v))
--- wanted
f | l
1 | 4
5 | 6

--- case FIRST with an offset in a definition is NULL until there are rows enough
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+)
  DEFINE A AS FIRST(A.v, 1) IS NULL OR v <= FIRST(A.v, 1))
--- wanted
f | l
1 | 3
4 | 6

--- case in a definition another variable has the rows mapped to it so far
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a, C.id AS c PATTERN (A B* C)
  DEFINE C AS C.v > A.v)
--- wanted
a | c
1 | 5

--- case nested navigation in a definition
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES B.id AS id PATTERN (A B) DEFINE A AS id > 1, B AS B.v > PREV(FIRST(A.v), 1))
--- wanted
id
4

--- case CLASSIFIER in a definition is the variable that is tried
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A | B)+)
  DEFINE A AS COALESCE(LAST(CLASSIFIER(), 1), 'B') = 'B')
--- wanted
c
[A, B, A, B, A, B]

--- case MATCH_NUMBER in a definition is the number of the match that is tried
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, A.id AS id PATTERN (A) DEFINE A AS id >= MATCH_NUMBER() * 2)
--- wanted
m | id
1 | 2
2 | 4
3 | 6

--- case a condition on two variables
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a, B.id AS b, C.id AS c PATTERN (A B C) DEFINE C AS C.v > A.v + B.v - 10)
--- wanted
a | b | c
2 | 3 | 4

--- case a variable that is not mapped yet is NULL in a definition
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B) DEFINE A AS B.v IS NULL)
--- wanted
n
2
2
2

--- case a condition that is NULL does not hold, nor does its negation
SELECT * FROM (VALUES (1, 5), (2, NULL), (3, 0)) AS t(id, v) MATCH_RECOGNIZE (
  ORDER BY id MEASURES array_agg(id) AS ids PATTERN (A+) DEFINE A AS NOT (v > 3) OR v > 3)
--- wanted
ids integer[]
[1]
[3]

--- case a comparison with PREV is NULL next to a NULL
SELECT * FROM (VALUES (1, 5), (2, NULL), (3, 6), (4, 7)) AS t(id, v) MATCH_RECOGNIZE (
  ORDER BY id MEASURES A.id AS id PATTERN (A) DEFINE A AS v > PREV(v))
--- wanted
id
4

--- case functions, casts, CASE and BETWEEN in measures and definitions
SELECT * FROM p MATCH_RECOGNIZE (ORDER BY id
  MEASURES upper('x' || A.v::varchar) AS a, CASE WHEN B.v BETWEEN 5 AND 7 THEN 'low' ELSE 'high' END AS b,
           greatest(A.v, B.v) AS c, CAST(A.v AS DOUBLE) / 4 AS d, A.v % 3 AS e, abs(B.v - A.v) AS f
  PATTERN (A B) DEFINE A AS v IN (8, 100), B AS v NOT BETWEEN 7 AND 9 AND length(v::varchar) = 1)
--- wanted
a varchar | b varchar | c integer | d double | e integer | f integer
X8 | low | 8 | 2.0 | 2 | 2
