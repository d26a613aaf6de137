--- table s
id integer | at timestamp | seen timestamptz | day date | x double | f float | n integer | price decimal(8,2) | word varchar
1 | 2026-01-01 00:00:00 | 2026-01-01 00:00:00+00 | 2026-01-01 | 1.0 | 0.5 | 7 | 10.00 | ab
2 | 2026-01-02 00:00:00 | 2026-01-02 00:00:00+00 | 2026-01-02 | 3.5 | 0.1 | 2 | 12.50 | b
3 | 2026-01-02 12:00:00 | 2026-01-02 12:00:00+00 | 2026-01-02 | -4.0 | 0.75 | -3 | NULL | NULL
4 | 2026-01-04 00:00:01 | 2026-01-04 00:00:01+00 | 2026-01-04 | 2.0 | 0.25 | 5 | 9.99 | abc

--- case a day lasts 24 hours where intervals are compared
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*) DEFINE B AS B.at - A.at <= INTERVAL '24' HOUR)
--- wanted
n
2
1
1

--- case the time between two rows, with a zone
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*) DEFINE B AS B.seen - A.seen < INTERVAL '2 days')
--- wanted
n
3
1

--- case columns of intervals are compared by their length
SELECT * FROM (SELECT id, CAST(iv AS interval) AS iv FROM t) MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n
  PATTERN (A B*) DEFINE B AS B.iv >= A.iv)
--- table t
id integer | iv varchar
1 | 1 day
2 | 24 hours
3 | 25 hours
4 | 30 days
5 | 1 month
6 | 29 days 23:59:59
7 | 1 second
--- wanted
n
6
1

--- case a variable is compared with a time that another and an interval give
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*)
  DEFINE B AS B.at < LAST(A.at) + INTERVAL '1' DAY + INTERVAL '1' HOUR)
--- wanted
n
2
1
1

--- case differences of days, and differences counted in a unit
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*)
  DEFINE B AS B.day - A.day <= 1 AND date_diff('hour', A.at, B.at) <= 36 AND extract(epoch FROM B.at - A.at) < 129601)
--- wanted
n
3
1

--- case the distance of two rows of a match
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES FIRST(id) AS f, COUNT(*) AS n PATTERN (A B+)
  DEFINE B AS abs(B.x - A.x) < 3 AND sqrt(pow(B.x - A.x, 2) + (B.n - A.n) ** 2) > 1)
--- wanted
f | n
1 | 2

--- case a share of another row's value, of whole numbers, decimals and binary fractions
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a, B.id AS b AFTER MATCH SKIP TO NEXT ROW PATTERN (A B)
  DEFINE B AS B.price / A.price > 1.2 OR B.n / A.n = -1 OR B.x / A.x = -0.5)
--- wanted
a | b
1 | 2
2 | 3
3 | 4

--- case a division by nothing is NULL
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a PATTERN (A B)
  DEFINE B AS B.x / (A.x - A.x) IS NULL AND B.n // (A.n - A.n) IS NULL)
--- wanted
a
1
3

--- case numbers of 32 bits stay such
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a AFTER MATCH SKIP TO NEXT ROW PATTERN (A B)
  DEFINE B AS A.f + B.f * 0 = 0.1 OR A.f - B.f = CAST(0.5 AS float))
--- wanted
a
2
3

--- case a remainder has the sign of what is divided
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES A.id AS a AFTER MATCH SKIP TO NEXT ROW PATTERN (A B) DEFINE B AS (B.n - A.n) % 3 = -2)
--- wanted
a
1
2

--- case the greater of two, passing over NULL, and the first that is there
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*)
  DEFINE B AS GREATEST(B.price, A.price) >= 12 AND COALESCE(B.price, A.price) >= 10)
--- wanted
n
2
1
1

--- case texts put together, and one of two conditions
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B)
  DEFINE B AS CASE WHEN A.id = 1 THEN A.word || B.word = 'abb' ELSE B.word = 'abc' END)
--- wanted
n
2
2

--- case an average compared with a share of a row
SELECT * FROM s MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN (A B*) DEFINE B AS AVG(n) < 0.7 * A.n AND B.x < 1.5 * MAX(x))
--- wanted
n
4

--- case a number that is none is greater than all, in a match as in the whole query
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n, MIN(v) AS least, MAX(v) AS most PATTERN (A+ | B+)
  DEFINE A AS MIN(A.v) <= 3, B AS MAX(B.v) > 3)
--- table t
id integer | v double
1 | 3
2 | nan
3 | 2
4 | nan
--- wanted
n | least | most
4 | 2.0 | nan

--- case times in nanoseconds
SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n, LAST(at) AS l PATTERN (A B*) DEFINE B AS B.at > A.at)
--- table t
id integer | at timestamp_ns
1 | 2026-01-01 00:00:00.000000001
2 | 2026-01-01 00:00:00.000000002
3 | 2026-01-01 00:00:00.000000001
--- wanted
n | l timestamp_ns
2 | 2026-01-01 00:00:00.000000002
1 | 2026-01-01 00:00:00.000000001

--- case what another row's map holds
SELECT * FROM (SELECT id, CAST(m AS MAP(varchar, integer)) AS m FROM t) MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n
  PATTERN (A B*) DEFINE B AS B.m['a'] > A.m['a'])
--- table t
id integer | m varchar
1 | {a=1}
2 | {a=2}
3 | {b=2}
--- wanted
n
2
1
