--- case a subset is the rows of its members, in the order of the match
--- letters t abac
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(U.id) AS f, LAST(U.id) AS l, LAST(U.id, 1) AS l1, COUNT(U.*) AS n, array_agg(U.id) AS ids, CLASSIFIER(U) AS c
  PATTERN (A B A C) SUBSET U = (B, A) DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
f | l | l1 | n | ids | c
1 | 3 | 2 | 3 | [1, 2, 3] | A

--- case several subsets, and a variable in both
--- letters t abc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id
  MEASURES string_agg(U.x, '') AS u, string_agg(W.x, '') AS w, CLASSIFIER(U) AS cu, CLASSIFIER(W) AS cw
  PATTERN (A B C) SUBSET U = (A, B), W = (B, C))
--- wanted
u | w | cu | cw
ab | bc | B | C

--- case a subset of one variable
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(U.x) AS u PATTERN (A B) SUBSET U = (A))
--- wanted
u
a

--- case a subset in a definition holds the row at hand if its variable is a member
--- letters t aaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c, COUNT(U.*) AS n PATTERN (A+ B+)
  SUBSET U = (A, B) DEFINE A AS COUNT(U.*) <= 2, B AS COUNT(U.*) <= 3)
--- wanted
c | n
[A, A, B] | 3

--- case a subset in a definition of a variable that is no member
--- letters t abc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES C.id AS c PATTERN (A B C) SUBSET U = (A, B) DEFINE C AS LAST(U.x) = 'b')
--- wanted
c
3

--- case a column of a subset is that of its last row
--- letters t abab
SELECT id, u FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES U.x AS u ALL ROWS PER MATCH PATTERN (A B C C) SUBSET U = (A, B))
--- wanted
id | u
1 | a
2 | b
3 | b
4 | b

--- case PREV and NEXT from a subset
--- letters t abcd
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES PREV(U.x) AS p, NEXT(U.x) AS n, PREV(FIRST(U.x, 1), 1) AS pf
  PATTERN (A B C D) SUBSET U = (B, C))
--- wanted
p | n | pf
b | d | b

--- case a subset with a name in quotes
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT("my set".*) AS n PATTERN (A B) SUBSET "my set" = (A, B))
--- wanted
n
2

--- case RUNNING and FINAL over a subset
--- letters t abc
SELECT id, r, f FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES RUNNING COUNT(U.*) AS r, FINAL COUNT(U.*) AS f
  ALL ROWS PER MATCH PATTERN (A B C) SUBSET U = (A, C))
--- wanted
id | r | f
1 | 1 | 2
2 | 1 | 2
3 | 2 | 2

--- case the search goes on after the last row if nothing is said
--- letters t aaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A A) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 2
3 | 4

--- case SKIP PAST LAST ROW
--- letters t aaaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l AFTER MATCH SKIP PAST LAST ROW PATTERN (A{3}))
--- wanted
f | l
1 | 3

--- case SKIP TO NEXT ROW finds matches that overlap
--- letters t aaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO NEXT ROW PATTERN (A A) DEFINE A AS x = 'a')
--- wanted
m | f | l
1 | 1 | 2
2 | 2 | 3
3 | 3 | 4

--- case SKIP TO FIRST of a variable
--- letters t abbab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, array_agg(CLASSIFIER()) AS c
  AFTER MATCH SKIP TO FIRST B PATTERN (A? B+) DEFINE A AS x = 'a', B AS x = 'b')
--- fails SKIP

--- case SKIP TO FIRST of a variable inside the match
--- letters t abbab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO FIRST B PATTERN (A B+) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
m | f | l
1 | 1 | 3
2 | 4 | 5

--- case SKIP TO LAST of a variable
--- letters t abbcbc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l, array_agg(CLASSIFIER()) AS c
  AFTER MATCH SKIP TO LAST B PATTERN (X B+ C) DEFINE B AS x = 'b', C AS x = 'c')
--- wanted
f | l | c
1 | 4 | [X, B, B, C]
4 | 6 | [X, B, C]

--- case SKIP TO a variable is to its last row
--- letters t abbcbc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO B PATTERN (X B+ C) DEFINE B AS x = 'b', C AS x = 'c')
--- wanted
f | l
1 | 4
4 | 6

--- case SKIP TO FIRST and LAST of a subset
--- letters t abcabc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO FIRST U PATTERN (X Y Z) SUBSET U = (Y, Z))
--- wanted
f | l
1 | 3
2 | 4
3 | 5
4 | 6

--- case SKIP TO LAST of a subset of which not every member is in the match
--- letters t abac
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, CLASSIFIER() AS c
  AFTER MATCH SKIP TO LAST U PATTERN (A (B | C)) SUBSET U = (B, C) DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
f | c
1 | B
3 | C

--- case a match may begin with the row that the one before ended with
--- letters t abab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO LAST Z PATTERN (Y Z))
--- wanted
f | l
1 | 2
2 | 3
3 | 4

--- case SKIP to the match's first row fails
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id AFTER MATCH SKIP TO FIRST A PATTERN (A B))
--- fails first row

--- case SKIP to a variable that the match lacks fails
--- letters t ac
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id AFTER MATCH SKIP TO LAST B PATTERN (A B? C)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- fails not in the match

--- case SKIP to a subset that the match lacks fails
--- letters t a
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id AFTER MATCH SKIP TO FIRST U PATTERN (A B? C?)
  SUBSET U = (B, C) DEFINE B AS FALSE, C AS FALSE)
--- fails not in the match

--- case a SKIP that would fail does not if nothing matches
--- letters t xy
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS id AFTER MATCH SKIP TO FIRST A PATTERN (A B) DEFINE A AS x = 'a')
--- wanted
id

--- case after an empty match the search goes on at the next row, whatever SKIP says
--- letters t bab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n
  AFTER MATCH SKIP PAST LAST ROW PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
m | n
1 | 0
2 | 1
3 | 0

--- case an empty match after SKIP TO NEXT ROW
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, LAST(id) AS l
  AFTER MATCH SKIP TO NEXT ROW PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
m | f | l
1 | 1 | 2
2 | 2 | 2
3 | NULL | NULL

--- case SKIP TO of a variable with a name that is a word of the clause
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(next.id) AS n AFTER MATCH SKIP TO next PATTERN (a next) DEFINE a AS x = 'a')
--- wanted
n
2

--- case ALL ROWS PER MATCH with overlapping matches shows a row in each
--- letters t aaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, CLASSIFIER() AS c ALL ROWS PER MATCH
  AFTER MATCH SKIP TO NEXT ROW PATTERN (A B))
--- wanted
id | m | c | x
1 | 1 | A | a
2 | 1 | B | a
2 | 2 | A | a
3 | 2 | B | a
