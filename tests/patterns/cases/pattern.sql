--- case parts stand one after the other
--- letters t abcab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id
  MEASURES FIRST(id) AS f, LAST(id) AS l, array_agg(CLASSIFIER()) AS c
  PATTERN (A B) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f integer | l integer | c varchar[]
1 | 2 | [A, B]
4 | 5 | [A, B]

--- case a match begins as far left as it can
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | l
2 | 3

--- case of an alternation the left side is preferred
--- letters t b
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A | B)
  DEFINE A AS x < 'z', B AS x = 'b')
--- wanted
c
[A]

--- case the left side of an alternation is preferred though the right one is longer
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, array_agg(CLASSIFIER()) AS c PATTERN (A | A B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | c
1 | [A]

--- case the right side of an alternation is taken where the left one leads nowhere
--- letters t ac
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A B | A) C)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
c
[A, C]

--- case an alternation of four
--- letters t dbca
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A | B | C | D)+)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c', D AS x = 'd')
--- wanted
c
[D, B, C, A]

--- case star is greedy
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, array_agg(CLASSIFIER()) AS c PATTERN (A* B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | c
1 | [A, A, B]

--- case star takes no row where there is none to take
--- letters t baa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, array_agg(CLASSIFIER()) AS c
  PATTERN (A*) DEFINE A AS x = 'a')
--- wanted
m bigint | f | c
1 | NULL | NULL
2 | 2 | [A, A]

--- case reluctant plus takes one row
--- letters t aaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f, LAST(id) AS l
  PATTERN (A+?) DEFINE A AS x = 'a')
--- wanted
m | f | l
1 | 1 | 1
2 | 2 | 2
3 | 3 | 3

--- case reluctant star alone takes nothing
--- letters t aa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n PATTERN (A*?) DEFINE A AS x = 'a')
--- wanted
m | n
1 | 0
2 | 0

--- case reluctant star takes what the rest needs
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, array_agg(CLASSIFIER()) AS c PATTERN (A*? B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | c
1 | [A, A, B]

--- case question mark takes a row if it can
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, FIRST(id) AS f PATTERN (A?) DEFINE A AS x = 'a')
--- wanted
m | f
1 | 1
2 | NULL

--- case reluctant question mark takes no row if it can
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A?? B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, B]

--- case reluctant question mark before a variable that takes anything
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A?? X) DEFINE A AS x = 'a')
--- wanted
c
[X]
[X]

--- case a fixed number of rows
--- letters t aaaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{2}) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 2
3 | 4

--- case at least so many rows
--- letters t aaaabab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{2,}) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 4

--- case at most so many rows
--- letters t aaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{,2}) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 2
3 | 3

--- case between two and three rows, greedy
--- letters t aaaaaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{2,3}) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 3
4 | 6

--- case between two and three rows, reluctant
--- letters t aaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{2,3}?) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 2
3 | 4

--- case at least so many rows, reluctant
--- letters t aaaaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A{2,}?) DEFINE A AS x = 'a')
--- wanted
f | l
1 | 2
3 | 4

--- case at most so many rows, reluctant
--- letters t aa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n PATTERN (A{,2}?) DEFINE A AS x = 'a')
--- wanted
m | n
1 | 0
2 | 0

--- case bounds of which both are left out are a star
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n PATTERN (A{,}) DEFINE A AS x = 'a')
--- wanted
m | n
1 | 2
2 | 0

--- case spaces inside bounds
--- letters t aaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A{ 2 , 3 }) DEFINE A AS x = 'a')
--- wanted
n
3

--- case a group is repeated as a whole
--- letters t ababa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A B)+)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, B, A, B]

--- case a group is repeated reluctantly
--- letters t ababc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A B)+? C)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
c
[A, B, A, B, C]

--- case a group with an optional part, twice
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A B?){2})
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, A, B]

--- case a greedy part gives back what the rest needs
--- letters t aaab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A+ C B)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'a')
--- wanted
c
[A, A, C, B]

--- case a reluctant part before a greedy one leaves it all
--- letters t aaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A*? B*) DEFINE A AS x = 'a', B AS x = 'a')
--- wanted
c
[B, B, B]

--- case spaces, comments and line ends in a pattern say nothing
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (
    A  /* the first ) */
    ( B ) ?   -- the second )
  ) DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, B]

--- case PERMUTE takes its parts in any order
--- letters t cabx
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A, B, C))
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
c
[C, A, B]

--- case PERMUTE prefers the order of its list
--- letters t xyz
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A, B, C)))
--- wanted
c
[A, B, C]

--- case PERMUTE prefers orders as a dictionary has them
--- letters t cab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A, B, C))
  DEFINE A AS x IN ('a', 'b'), B AS x IN ('a', 'b', 'c'))
--- wanted
c
[B, A, C]

--- case PERMUTE of patterns
--- letters t baac
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A+, B) C)
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
c
[B, A, A, C]

--- case PERMUTE repeated
--- letters t abbaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A, B)+)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, B, B, A]

--- case PERMUTE of an optional part
--- letters t bc
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (PERMUTE(A?, B, C))
  DEFINE A AS x = 'a', B AS x = 'b', C AS x = 'c')
--- wanted
c
[B, C]

--- case the anchor of the beginning holds at the partition's first row only
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f PATTERN (^ A) DEFINE A AS x = 'a')
--- wanted
f
1

--- case the anchor of the beginning where the first row does not fit
--- letters t baa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f PATTERN (^ A) DEFINE A AS x = 'a')
--- wanted
f

--- case the anchor of the end holds after the partition's last row only
--- letters t aba
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f PATTERN (A $) DEFINE A AS x = 'a')
--- wanted
f
3

--- case the anchor of the end makes a greedy part give back nothing
--- letters t abaa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A+ $) DEFINE A AS x = 'a')
--- wanted
f | l
3 | 4

--- case both anchors want the whole of a partition
SELECT * FROM (VALUES (1, 1, 'a'), (1, 2, 'a'), (2, 1, 'a'), (2, 2, 'b')) AS t(k, id, x) MATCH_RECOGNIZE (
  PARTITION BY k ORDER BY id MEASURES COUNT(*) AS n PATTERN (^ A+ $) DEFINE A AS x = 'a')
--- wanted
k | n
1 | 2

--- case an anchor in one arm of an alternation
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, CLASSIFIER() AS c PATTERN (^ A | B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | c
1 | A
3 | B

--- case the anchor of the beginning after a row never holds
--- letters t aa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f PATTERN (A ^))
--- wanted
f

--- case the anchor of the end before a row never holds
--- letters t aa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f PATTERN ($ A))
--- wanted
f

--- case the anchor of the beginning alone is an empty match at the first row
--- letters t aa
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n, FIRST(A.id) AS f PATTERN (^ A*?))
--- wanted
m | n | f
1 | 0 | NULL

--- case the empty pattern matches at every row
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n, CLASSIFIER() AS c PATTERN (()))
--- wanted
m | n bigint | c varchar
1 | 0 | NULL
2 | 0 | NULL

--- case the empty pattern on the left of an alternation is preferred
--- letters t a
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (() | A) DEFINE A AS x = 'a')
--- wanted
n
0

--- case the empty pattern on the right of an alternation stands in
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, COUNT(*) AS n PATTERN (A | ()) DEFINE A AS x = 'a')
--- wanted
m | n
1 | 1
2 | 0

--- case the empty pattern between two rows says nothing
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A () B))
--- wanted
c
[A, B]

--- case an exclusion changes neither the match nor its measures
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c, COUNT(*) AS n PATTERN ({- A+ -} B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c | n
[A, A, B] | 3

--- case a repetition of what may be empty ends
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A?)* B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, A, B]

--- case a repetition of a repetition ends
--- letters t aabb
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (((A*)*)* B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, A, B]
[B]

--- case at least one of what may be empty
--- letters t b
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A*)+ B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[B]

--- case a repetition whose body prefers to be empty
--- letters t aab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((() | A)* B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, A, B]

--- case at least two of what may be empty
--- letters t a
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN ((A | ()){2,3}) DEFINE A AS x = 'a')
--- wanted
c
[A]

--- case a variable without a definition takes any row
--- letters t a-b
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES array_agg(CLASSIFIER()) AS c PATTERN (A any_row B)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
c
[A, ANY_ROW, B]

--- case a pattern without any definition
--- letters t abcde
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, LAST(id) AS l PATTERN (A B))
--- wanted
f | l
1 | 2
3 | 4

--- case names of variables are compared without regard to case
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(first_one.id) AS f, CLASSIFIER() AS c PATTERN (First_One two)
  DEFINE FIRST_ONE AS X = 'a', Two AS x = 'b')
--- wanted
f | c
1 | TWO

--- case quoted variables keep their case and differ from those that are not quoted
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES LAST("a".id) AS small, LAST(A.id) AS large, array_agg(CLASSIFIER()) AS c
  PATTERN ("a" a) DEFINE "a" AS "a".x = 'a', A AS a.x = 'b')
--- wanted
small | large | c
1 | 2 | [a, A]

--- case a variable used twice in a pattern
--- letters t aba
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(A.id) AS f, LAST(A.id) AS l, COUNT(A.*) AS n PATTERN (A B A)
  DEFINE A AS x = 'a', B AS x = 'b')
--- wanted
f | l | n
1 | 3 | 2

--- case no rows, no matches, not even empty ones
--- letters t
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES MATCH_NUMBER() AS m, LAST(x) AS x PATTERN (A*))
--- wanted
m bigint | x varchar

--- case the order of PERMUTE is preferred before the ways of its parts
--- letters t bxab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES string_agg(CLASSIFIER(), '') AS c PATTERN (PERMUTE(A, B C??, B))
  DEFINE A AS x IN ('x', 'a'), B AS x IN ('b', 'x'))
--- wanted
c
BCAB

--- case variables with letters of every alphabet
--- letters t ab
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES CLASSIFIER() AS c, COUNT(é.*) AS n, ž1.id AS z PATTERN (é ž1) DEFINE ž1 AS ž1.id > é.id)
--- wanted
c | n | z
Ž1 | 1 | 2
