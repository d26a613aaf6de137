--- table a
acc varchar | id int | kind varchar | amount decimal(10,2) | at timestamp
p | 1 | in | 900.00 | 2026-01-01 09:00:00
p | 2 | out | 300.00 | 2026-01-01 09:10:00
p | 3 | out | 580.00 | 2026-01-01 09:20:00
p | 4 | in | 50.00 | 2026-01-02 09:00:00
q | 5 | in | 1000.00 | 2026-01-01 09:00:00
q | 6 | out | 100.00 | 2026-01-03 09:00:00
q | 7 | out | 890.00 | 2026-01-03 09:01:00

--- case money that comes in and goes out again within a day
SELECT * FROM a MATCH_RECOGNIZE (PARTITION BY acc ORDER BY at
  MEASURES I.amount AS got, SUM(O.amount) AS gone, LAST(O.at) - I.at AS took, FINAL COUNT(O.*) AS n
  AFTER MATCH SKIP PAST LAST ROW
  PATTERN (I O+)
  DEFINE I AS kind = 'in' AND amount >= 500, O AS kind = 'out' AND O.at - I.at < INTERVAL '1' DAY AND SUM(O.amount) <= I.amount)
--- wanted
acc | got | gone | took | n
p | 900.00 | 880.00 | 00:20:00 | 2

--- case what has gone out when nine tenths are gone
SELECT acc, gone FROM a MATCH_RECOGNIZE (PARTITION BY acc ORDER BY at MEASURES SUM(O.amount) AS gone
  PATTERN (I O* L) SUBSET X = (O, L)
  DEFINE I AS kind = 'in' AND amount >= 500, O AS kind = 'out', L AS kind = 'out' AND SUM(X.amount) >= 0.9 * I.amount) ORDER BY acc
--- wanted
acc | gone
p | 300.00
q | 100.00

--- case sessionisation
SELECT acc, s, n, began FROM a MATCH_RECOGNIZE (PARTITION BY acc ORDER BY at
  MEASURES MATCH_NUMBER() AS s, COUNT(*) AS n, FIRST(at) AS began
  PATTERN (F N*)
  DEFINE N AS N.at - PREV(N.at) <= INTERVAL '30' MINUTE) ORDER BY acc, s
--- wanted
acc | s | n | began
p | 1 | 3 | 2026-01-01 09:00:00
p | 2 | 1 | 2026-01-02 09:00:00
q | 1 | 1 | 2026-01-01 09:00:00
q | 2 | 2 | 2026-01-03 09:00:00

--- case sessionisation by the session's length
SELECT acc, s, n FROM a MATCH_RECOGNIZE (PARTITION BY acc ORDER BY at
  MEASURES MATCH_NUMBER() AS s, COUNT(*) AS n
  PATTERN (N+)
  DEFINE N AS N.at - FIRST(N.at) <= INTERVAL '15' MINUTE) ORDER BY acc, s
--- wanted
acc | s | n
p | 1 | 2
p | 2 | 1
p | 3 | 1
q | 1 | 1
q | 2 | 2

--- case running totals with a reset
SELECT id, total FROM a MATCH_RECOGNIZE (PARTITION BY acc ORDER BY at
  MEASURES SUM(amount) AS total
  ALL ROWS PER MATCH PATTERN (X+)
  DEFINE X AS SUM(amount) <= 1000 ) ORDER BY id
--- wanted
id | total
1 | 900.00
2 | 300.00
3 | 880.00
4 | 930.00
5 | 1000.00
6 | 100.00
7 | 990.00

--- case gaps between ids
SELECT * FROM (VALUES (1), (2), (3), (7), (8), (11)) t(i) MATCH_RECOGNIZE (ORDER BY i
  MEASURES FIRST(i) AS f, LAST(i) AS l, COUNT(*) AS n
  PATTERN (A B*)
  DEFINE B AS B.i = PREV(B.i) + 1)
--- wanted
f | l | n
1 | 3 | 3
7 | 8 | 2
11 | 11 | 1

--- case runs of equal values, first different row excluded
SELECT i, r FROM (VALUES (1,'x'), (2,'x'), (3,'y'), (4,'x')) t(i, k) MATCH_RECOGNIZE (ORDER BY i
  MEASURES MATCH_NUMBER() AS r
  ALL ROWS PER MATCH PATTERN (S+)
  DEFINE S AS S.k = FIRST(S.k))
--- wanted
i | r
1 | 1
2 | 1
3 | 2
4 | 3

--- case U shape with flat bottom
SELECT * FROM (VALUES (1,9), (2,5), (3,5), (4,5), (5,8), (6,7)) t(i, p) MATCH_RECOGNIZE (ORDER BY i
  MEASURES S.i AS s, FIRST(F.i) AS f0, LAST(F.i) AS f1, LAST(U.i) AS e
  AFTER MATCH SKIP TO LAST U
  PATTERN (S D+ F* U+)
  DEFINE D AS D.p < PREV(D.p), F AS F.p = PREV(F.p), U AS U.p > PREV(U.p))
--- wanted
s | f0 | f1 | e
1 | 3 | 4 | 5

--- case elliott-like triple peaks
SELECT * FROM (VALUES (1,1), (2,3), (3,2), (4,4), (5,3), (6,5), (7,1)) t(i, p) MATCH_RECOGNIZE (ORDER BY i
  MEASURES COUNT(*) AS n, COUNT(U.*) AS u, COUNT(D.*) AS d
  PATTERN (S (U+ D+){2,3})
  DEFINE U AS U.p > PREV(U.p), D AS D.p < PREV(D.p))
--- wanted
n | u | d
7 | 3 | 3

--- case login failures then success from another place
SELECT * FROM (VALUES (1,'u','bad','A'), (2,'u','bad','A'), (3,'u','ok','B'), (4,'v','bad','A'), (5,'v','ok','A')) t(i, u, r, place) MATCH_RECOGNIZE (PARTITION BY u ORDER BY i
  MEASURES COUNT(F.*) AS f, OK.place AS place
  PATTERN (F{2,} OK)
  DEFINE F AS r = 'bad', OK AS r = 'ok' AND OK.place <> LAST(F.place))
--- wanted
u | f | place
u | 2 | B

--- case funnel with permute
SELECT * FROM (VALUES (1,'b'), (2,'a'), (3,'c'), (4,'d')) t(i, e) MATCH_RECOGNIZE (ORDER BY i
  MEASURES string_agg(CLASSIFIER(), '>') AS w
  PATTERN (PERMUTE(A, B{1,2}) C+? (D | E))
  DEFINE A AS e = 'a', B AS e = 'b', D AS e = 'd')
--- wanted
w
B>A>C>D

--- case measure over union with running and final of classifier
SELECT i, lu, fu FROM (VALUES (1), (2), (3), (4)) t(i) MATCH_RECOGNIZE (ORDER BY i
  MEASURES LAST(U.i) AS lu, FINAL LAST(U.i) AS fu
  ALL ROWS PER MATCH PATTERN (A B A B) SUBSET U = (B))
--- wanted
i | lu | fu
1 | NULL | 4
2 | 2 | 4
3 | 2 | 4
4 | 4 | 4

--- case final last with offset beyond
SELECT i, x FROM (VALUES (1), (2)) t(i) MATCH_RECOGNIZE (ORDER BY i
  MEASURES FINAL LAST(i, 5) AS x
  ALL ROWS PER MATCH PATTERN (A+))
--- wanted
i | x
1 | NULL
2 | NULL

--- case next of final last leaves the match but not the partition
SELECT p, i, x FROM (VALUES (1,1), (1,2), (1,3), (2,9)) t(p, i) MATCH_RECOGNIZE (PARTITION BY p ORDER BY i
  MEASURES NEXT(FINAL LAST(i)) AS x
  ALL ROWS PER MATCH PATTERN (A A?)
  DEFINE A AS i < 3 OR p = 2) ORDER BY p, i
--- wanted
p | i | x
1 | 1 | 3
1 | 2 | 3
2 | 9 | NULL

--- case prev over unmatched partition start
SELECT p, i, x FROM (VALUES (1,1), (1,2), (2,9)) t(p, i) MATCH_RECOGNIZE (PARTITION BY p ORDER BY i
  MEASURES PREV(i) AS x
  ALL ROWS PER MATCH PATTERN (A)) ORDER BY p, i
--- wanted
p | i | x
1 | 1 | NULL
1 | 2 | 1
2 | 9 | NULL
