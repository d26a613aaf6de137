"""What rules may write short of metres: `speed_kmh` and `distance_m(a, b)`, as the longer SQL that they stand for.

They are spelt out before anything else is made of them, so that engine, explanations and Flink need not know them.
"""

from sqlglot import exp

SPEED = "speed_kmh"
"""The column that every input with a point and a velocity has: the point's speed on the ground, km/h."""
KMH = 3.6
"""Kilometres an hour of one metre a second."""


def is_quoted(column: exp.Expr) -> bool:
    """Whether the name is one of the input's own, to the letter."""
    return bool(column.this.args.get("quoted"))


def speed_kmh(column: exp.Expr) -> exp.Expr:
    """`ground_speed(x, y, vx, vy) * 3.6` of the same row."""
    speed = _call("ground_speed", [_of(column, name) for name in ("x", "y", "vx", "vy")])
    return exp.Mul(this=speed, expression=exp.Literal.number(KMH))


def distance_m(one: exp.Expr, other: exp.Expr) -> exp.Expr:
    """Straight distance on the ground between the points of two variables' last rows."""
    squares = []
    for name in ("ground_x", "ground_y"):
        apart = exp.Paren(this=exp.Sub(this=_ground(name, one), expression=_ground(name, other)))
        squares.append(exp.Mul(this=apart, expression=apart.copy()))
    return _call("SQRT", [exp.Add(this=squares[0], expression=squares[1])])


def _ground(name: str, variable: exp.Expr) -> exp.Expr:
    points: list[exp.Expr] = []
    for axis in ("x", "y"):
        point = exp.Column(this=_identifier(axis, variable), table=variable.this.copy())
        points.append(point)
    return _call(name, points)


def _of(column: exp.Expr, name: str) -> exp.Expr:
    """Another column of the same row."""
    other = column.copy()
    other.set("this", _identifier(name, column))
    return other


def _identifier(name: str, at: exp.Expr) -> exp.Expr:
    """The name, standing where the other stands, so that errors point there."""
    identifier = exp.to_identifier(name)
    identifier.meta.update(at.this.meta)
    return identifier


def _call(name: str, arguments: list[exp.Expr]) -> exp.Expr:
    return exp.Anonymous(this=name, expressions=arguments)
