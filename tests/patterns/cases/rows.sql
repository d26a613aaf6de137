--- table r
n integer | k integer | id integer | x varchar
7 | 1 | 1 | a
8 | 1 | 2 | b
9 | 1 | 3 | c

--- case ONE ROW PER MATCH has the columns of the partition, then the measures
SELECT * FROM r MATCH_RECOGNIZE (PARTITION BY k ORDER BY id MEASURES x AS last_x, FIRST(n) AS first_n ONE ROW PER MATCH PATTERN (A+))
--- wanted
k integer | last_x varchar | first_n integer
1 | c | 7

--- case ONE ROW PER MATCH is what is meant if nothing is said
SELECT * FROM r MATCH_RECOGNIZE (PARTITION BY k ORDER BY id MEASURES x AS last_x PATTERN (A+))
--- wanted
k | last_x
1 | c

--- case without measures ONE ROW PER MATCH has the columns of the partition
SELECT * FROM r MATCH_RECOGNIZE (PARTITION BY k ORDER BY id PATTERN (A))
--- wanted
k
1
1
1

--- case ALL ROWS PER MATCH has columns of the partition, of the order, measures, and the rest as the input has them
SELECT * FROM r MATCH_RECOGNIZE (PARTITION BY k ORDER BY id MEASURES CLASSIFIER() AS c ALL ROWS PER MATCH PATTERN (A B C))
--- wanted
k integer | id integer | c varchar | n integer | x varchar
1 | 1 | A | 7 | a
1 | 2 | B | 8 | b
1 | 3 | C | 9 | c

--- case ALL ROWS PER MATCH without measures, partition or order has the input's columns
SELECT * FROM r MATCH_RECOGNIZE (ALL ROWS PER MATCH PATTERN (A B) DEFINE B AS x = 'b')
--- wanted
n | k | id | x
7 | 1 | 1 | a
8 | 1 | 2 | b

--- case with ALL ROWS PER MATCH a measure sees the match up to its row
SELECT id, last_x, a, b, m FROM r MATCH_RECOGNIZE (ORDER BY id
  MEASURES LAST(x) AS last_x, A.id AS a, B.id AS b, MATCH_NUMBER() AS m ALL ROWS PER MATCH PATTERN (A B+))
--- wanted
id | last_x | a | b | m
1 | a | 1 | NULL | 1
2 | b | 1 | 2 | 1
3 | c | 1 | 3 | 1

--- case with ALL ROWS PER MATCH navigation to rows outside begins at the row at hand
SELECT id, p, n1, nf FROM r MATCH_RECOGNIZE (ORDER BY id
  MEASURES PREV(x) AS p, NEXT(x) AS n1, NEXT(FIRST(x), 1) AS nf ALL ROWS PER MATCH PATTERN (A B) DEFINE A AS x = 'b')
--- wanted
id | p | n1 | nf
2 | a | c | c
3 | b | NULL | c

--- case CLASSIFIER of a variable with ALL ROWS PER MATCH
SELECT id, c, ca, cb FROM r MATCH_RECOGNIZE (ORDER BY id
  MEASURES CLASSIFIER() AS c, CLASSIFIER(A) AS ca, CLASSIFIER(B) AS cb ALL ROWS PER MATCH PATTERN (A B A))
--- wanted
id | c | ca | cb
1 | A | A | NULL
2 | B | A | B
3 | A | A | B

--- case empty matches are shown if nothing is said
--- letters t bab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c, COUNT(*) AS n, LAST(x) AS l
  ALL ROWS PER MATCH PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
id | m | c | n | l | x
1 | 1 | NULL | 0 | NULL | b
2 | 2 | A | 1 | a | a
3 | 3 | NULL | 0 | NULL | b

--- case SHOW EMPTY MATCHES
--- letters t ba
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, x AS y
  ALL ROWS PER MATCH SHOW EMPTY MATCHES PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
id | m | y | x
1 | 1 | NULL | b
2 | 2 | a | a

--- case OMIT EMPTY MATCHES leaves gaps in the numbers
--- letters t bab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c
  ALL ROWS PER MATCH OMIT EMPTY MATCHES PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
id | m | c | x
2 | 2 | A | a

--- case WITH UNMATCHED ROWS shows rows of no match, with measures that are NULL
--- letters t bab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c, COUNT(*) AS n, x AS y
  ALL ROWS PER MATCH WITH UNMATCHED ROWS PATTERN (A+) DEFINE A AS x = 'a')
--- wanted
id | m | c | n | y | x
1 | NULL | NULL | NULL | NULL | b
2 | 1 | A | 1 | a | a
3 | NULL | NULL | NULL | NULL | b

--- case with an empty match no row is unmatched
--- letters t ba
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n
  ALL ROWS PER MATCH WITH UNMATCHED ROWS PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
id | m | n | x
1 | 1 | 0 | b
2 | 2 | 1 | a

--- case with ONE ROW PER MATCH an empty match is a row, a row of no match is none
--- letters t bab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n, x AS x ONE ROW PER MATCH
  PATTERN (A?) DEFINE A AS x = 'a')
--- wanted
m | n | x
1 | 0 | NULL
2 | 1 | a
3 | 0 | NULL

--- case a row that an earlier match has is not unmatched, though no match begins there
--- letters t aabx
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c
  ALL ROWS PER MATCH WITH UNMATCHED ROWS AFTER MATCH SKIP TO NEXT ROW PATTERN (A+ B) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
id | m | c | x
1 | 1 | A | a
2 | 1 | A | a
3 | 1 | B | b
2 | 2 | A | a
3 | 2 | B | b
4 | NULL | NULL | x

--- case everything is unmatched
--- letters t xy
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m
  ALL ROWS PER MATCH WITH UNMATCHED ROWS PATTERN (A) DEFINE A AS x = 'a')
--- wanted
id | m bigint | x
1 | NULL | x
2 | NULL | y

--- case excluded rows are not shown, but count
--- letters t aabb
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n, FIRST(id) AS f, CLASSIFIER() AS c
  ALL ROWS PER MATCH PATTERN (A {- A+ B -} B) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
id | n | f | c | x
1 | 1 | 1 | A | a
4 | 4 | 1 | B | b

--- case a variable is excluded where the braces have it, and shown elsewhere
--- letters t aba
SELECT id, c FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES CLASSIFIER() AS c
  ALL ROWS PER MATCH PATTERN ({- A -} B A) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
id | c
2 | B
3 | A

--- case an exclusion inside a repetition
--- letters t abab
SELECT id, c FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES CLASSIFIER() AS c
  ALL ROWS PER MATCH PATTERN ((A {- B -})+) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
id | c
1 | A
3 | A

--- case an excluded match shows no rows but has its number
--- letters t ab
SELECT id, m FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m
  ALL ROWS PER MATCH PATTERN ({- A -} | B) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
id | m
2 | 2

--- case an exclusion with OMIT EMPTY MATCHES
--- letters t bab
SELECT id, m, c FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c
  ALL ROWS PER MATCH OMIT EMPTY MATCHES PATTERN (A* {- C -} | ()) DEFINE A AS x = 'a', C AS id = 3)
--- wanted
id | m | c
2 | 2 | A

--- case numbers of matches begin anew in each partition
SELECT * FROM (VALUES (1, 1), (1, 2), (2, 3), (2, 4)) AS t(k, id) MATCH_RECOGNIZE (PARTITION BY k ORDER BY id
  MEASURES MATCH_NUMBER() AS m ALL ROWS PER MATCH PATTERN (A))
--- wanted
k | id | m
1 | 1 | 1
1 | 2 | 2
2 | 3 | 1
2 | 4 | 2

--- case a measure may bear the name of a column that the answer does not have
SELECT * FROM r MATCH_RECOGNIZE (PARTITION BY k ORDER BY id MEASURES LAST(x) AS x, LAST(n) AS n ONE ROW PER MATCH PATTERN (A+))
--- wanted
k | x | n
1 | c | 9

--- case measures that are constants
SELECT * FROM r MATCH_RECOGNIZE (ORDER BY id MEASURES 'found' AS what, 1 + 1 AS two, NULL AS nothing PATTERN (A+))
--- wanted
what varchar | two integer | nothing
found | 2 | NULL

--- case constants are NULL for an unmatched row
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES 'found' AS what ALL ROWS PER MATCH WITH UNMATCHED ROWS
  PATTERN (A) DEFINE A AS x = 'a')
--- wanted
id | what | x
1 | found | a
2 | NULL | b

--- case rows of a match come in its order, matches from left to right, partitions one after the other
SELECT k, id, m FROM (VALUES (2, 3), (1, 1), (2, 1), (1, 2), (2, 2)) AS t(k, id) MATCH_RECOGNIZE (PARTITION BY k ORDER BY id DESC
  MEASURES MATCH_NUMBER() AS m ALL ROWS PER MATCH PATTERN (A A?)) ORDER BY k, m, id DESC
--- wanted
k | id | m
1 | 2 | 1
1 | 1 | 1
2 | 3 | 1
2 | 2 | 1
2 | 1 | 2

--- case constants are shown for an empty match
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES 'found' AS what ALL ROWS PER MATCH PATTERN (A?) DEFINE A AS x = 'a')
--- wanted
id | what | x
1 | found | a
2 | found | b
