"""Which operands an operator takes, and the type of what it gives.

Where integers meet numbers, the integers are converted by an explicit call of
`float`, so that the two evaluators cannot promote differently.
"""

from collections.abc import Callable

from patterns.binding.expressions import COMPARISONS, Call, Const, Expr, Kind

_NUMBERS = (Kind.INT, Kind.FLOAT)
_B, _I, _F, _T, _D = Kind.BOOL, Kind.INT, Kind.FLOAT, Kind.TIME, Kind.DURATION
_ARITHMETIC: dict[tuple[str, Kind, Kind], Kind] = {
    ("+", _I, _I): _I, ("-", _I, _I): _I, ("*", _I, _I): _I, ("/", _I, _I): _I, ("%", _I, _I): _I,
    ("+", _F, _F): _F, ("-", _F, _F): _F, ("*", _F, _F): _F, ("/", _F, _F): _F,
    ("+", _T, _D): _T, ("+", _D, _T): _T, ("-", _T, _D): _T, ("-", _T, _T): _D,
    ("+", _D, _D): _D, ("-", _D, _D): _D, ("/", _D, _D): _F,
    ("*", _D, _I): _D, ("*", _I, _D): _D, ("/", _D, _I): _D,
}  # fmt: skip
_SCALINGS = {("*", _D, _F), ("*", _F, _D), ("/", _D, _F)}


class TypeMismatch(Exception):
    """Operands that the operator does not take; who knows the place makes an error of it."""


def typed_call(op: str, operands: tuple[Expr, ...]) -> Expr:
    """The call of an operator or function on these operands, with its type.

    Raises:
        TypeMismatch: It does not take operands of these types, or not so many.
    """
    return _RULES[op](op, operands)


def as_float(expr: Expr) -> Expr:
    """The expression as a number that need not be whole."""
    if expr.kind is Kind.FLOAT:
        return expr
    if isinstance(expr, Const):
        value = expr.value
        return Const(None if value is None else float(value), Kind.FLOAT)
    return Call("float", (expr,), Kind.FLOAT)


def _arithmetic(op: str, operands: tuple[Expr, ...]) -> Expr:
    left, right = operands
    if left.kind is Kind.NULL or right.kind is Kind.NULL:
        other = right.kind if left.kind is Kind.NULL else left.kind
        return Const(None, other)
    if {left.kind, right.kind} == set(_NUMBERS):
        left, right = as_float(left), as_float(right)
    if (op, left.kind, right.kind) in _SCALINGS:
        number, duration = (left, right) if left.kind is Kind.FLOAT else (right, left)
        return Call("scale" if op == "*" else "shrink", (duration, number), Kind.DURATION)
    kind = _ARITHMETIC.get((op, left.kind, right.kind))
    if kind is None:
        raise TypeMismatch(f"{op} does not take {left.kind.value} and {right.kind.value}")
    is_ratio = op == "/" and right.kind is Kind.DURATION
    return Call("ratio" if is_ratio else op, (left, right), kind)


def _comparison(op: str, operands: tuple[Expr, ...]) -> Expr:
    return Call(op, _alike(op, operands), Kind.BOOL)


def _logical(op: str, operands: tuple[Expr, ...]) -> Expr:
    for operand in operands:
        if operand.kind not in (Kind.BOOL, Kind.NULL):
            raise TypeMismatch(f"{op.upper()} takes conditions, got {operand.kind.value}")
    return Call(op, tuple(_with_kind(operand, Kind.BOOL) for operand in operands), Kind.BOOL)


def _is_null(op: str, operands: tuple[Expr, ...]) -> Expr:
    return Call(op, operands, Kind.BOOL)


def _signed(op: str, operands: tuple[Expr, ...]) -> Expr:
    (operand,) = _counted(op, operands, 1)
    if operand.kind not in (*_NUMBERS, Kind.DURATION, Kind.NULL):
        raise TypeMismatch(f"{op.upper()} takes a number or a duration, got {operand.kind.value}")
    return operand if operand.kind is Kind.NULL else Call(op, (operand,), operand.kind)


def _root(op: str, operands: tuple[Expr, ...]) -> Expr:
    (operand,) = _counted(op, operands, 1)
    if operand.kind not in (*_NUMBERS, Kind.NULL):
        raise TypeMismatch(f"SQRT takes a number, got {operand.kind.value}")
    return Call(op, (as_float(operand),), Kind.FLOAT)


def _choice(op: str, operands: tuple[Expr, ...]) -> Expr:
    if not operands:
        raise TypeMismatch(f"{op.upper()} takes at least one operand")
    same = _alike(op, operands)
    return Call(op, same, same[0].kind)


def _case(op: str, operands: tuple[Expr, ...]) -> Expr:
    """Operands: condition, value, condition, value, ..., the value of ELSE."""
    conditions = operands[:-1:2]
    values = _alike("case", (*operands[1:-1:2], operands[-1]))
    checked = _logical("case when", conditions)
    assert isinstance(checked, Call)
    mixed = [part for pair in zip(checked.operands, values[:-1], strict=True) for part in pair]
    return Call(op, (*mixed, values[-1]), values[-1].kind)


def _alike(op: str, operands: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """The operands, brought to one type."""
    kinds = [operand.kind for operand in operands if operand.kind is not Kind.NULL]
    if not kinds:
        return operands
    if set(kinds) == set(_NUMBERS):
        kinds = [Kind.FLOAT]
    for kind in kinds:
        if kind is not kinds[0]:
            what = f"{op} compares" if op in COMPARISONS else f"{op.upper()} takes"
            raise TypeMismatch(f"{what} values of one type, got {kinds[0].value} and {kind.value}")
    return tuple(_with_kind(operand, kinds[0]) for operand in operands)


def _with_kind(operand: Expr, kind: Kind) -> Expr:
    if operand.kind is Kind.NULL:
        return Const(None, kind)
    return as_float(operand) if kind is Kind.FLOAT else operand


def _counted(op: str, operands: tuple[Expr, ...], wanted: int) -> tuple[Expr, ...]:
    if len(operands) != wanted:
        raise TypeMismatch(f"{op.upper()} takes {wanted} operand{'s' * (wanted > 1)}, got {len(operands)}")
    return operands


_RULES: dict[str, Callable[[str, tuple[Expr, ...]], Expr]] = {
    **dict.fromkeys(("+", "-", "*", "/", "%"), _arithmetic),
    **dict.fromkeys(sorted(COMPARISONS), _comparison),
    **dict.fromkeys(("and", "or", "not"), _logical),
    **dict.fromkeys(("neg", "abs"), _signed),
    **dict.fromkeys(("least", "greatest", "coalesce"), _choice),
    "is_null": _is_null,
    "sqrt": _root,
    "case": _case,
}
