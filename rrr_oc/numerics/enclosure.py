"""Interval arithmetic with first derivatives: where a function of parameters lies, for all parameters in a box at once.

A function that is written with numpy's arithmetic takes an `Enclosure` in the place of an array; `evaluated` takes one to a CasADi
function.
"""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

Pair = Any  # least and greatest value, or None for the slopes of a constant


class NotEnclosed(Exception):
    """A function has an operation that has no rule here."""


class Enclosure(NDArrayOperatorsMixin):
    """Bounds of a quantity and of its derivatives over boxes of parameters, up to rounding.

    Attributes:
        value: Least and greatest value, of any shape that broadcasts.
        slopes: Least and greatest derivative by each parameter, which is the first axis; None for a constant.
    """

    def __init__(self, value: Pair, slopes: Pair = None) -> None:
        self.value, self.slopes = value, slopes

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> "Enclosure":
        rule = _RULES.get(ufunc)
        if rule is None or method != "__call__" or options:
            raise NotEnclosed(f"{ufunc.__name__} has no rule for intervals")
        return rule(*inputs)

    def total(self, weights: np.ndarray) -> "Enclosure":
        """The sum over the last axis with weights (K,); what has one entry there is the same for all."""
        up, down = np.maximum(weights, 0), np.minimum(weights, 0)

        def summed(pair: Pair) -> Pair:
            low, high = (np.broadcast_to(end, (*np.shape(end)[:-1], weights.size)) for end in pair)
            return low @ up + high @ down, high @ up + low @ down

        return Enclosure(summed(self.value), None if self.slopes is None else summed(self.slopes))


def enclosures(lower: np.ndarray, upper: np.ndarray) -> list[Enclosure]:
    """The parameters themselves, over P boxes with these bounds, (parameters, P) each; values have the shape (P, 1)."""
    own = np.eye(len(lower))[:, :, None, None]  # derivatives by the parameters
    return [Enclosure((low[:, None], high[:, None]), (one, one)) for low, high, one in zip(lower, upper, own, strict=True)]


def enclosed(x: Any) -> Enclosure:
    """An enclosure, or the enclosure of a constant."""
    return x if isinstance(x, Enclosure) else Enclosure((x, x))


def evaluated(function: ca.Function, arguments: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """The entries of the outputs of an SX function without structural zeros, from those of its arguments: enclosures or numbers.

    Raises `NotEnclosed` where the function has an operation without a rule.
    """
    work: dict[int, Any] = {}
    results: list[list[Any]] = [[0.0] * function.nnz_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        operation, to, of = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_CONST:
            work[to[0]] = function.instruction_constant(k)
        elif operation == ca.OP_INPUT:
            work[to[0]] = arguments[of[0]][of[1]]
        elif operation == ca.OP_OUTPUT:
            results[to[0]][to[1]] = work[of[0]]
        elif operation in _OPERATIONS:
            work[to[0]] = _OPERATIONS[operation](*(work[i] for i in of))
        else:
            raise NotEnclosed(f"CasADi's operation {operation} has no rule for intervals")
    return results


def _sum(a: Pair, b: Pair) -> Pair:
    return b if a is None else a if b is None else (a[0] + b[0], a[1] + b[1])


def _times(a: Pair, c: Any) -> Pair:
    """The product with a constant."""
    if a is None:
        return None
    one, other = a[0] * c, a[1] * c
    return np.minimum(one, other), np.maximum(one, other)


def _product(a: Pair, b: Pair) -> Pair:
    if a is None or b is None:
        return None
    (low, high), (least, greatest) = _times(a, b[0]), _times(a, b[1])
    return np.minimum(low, least), np.maximum(high, greatest)


def _add(a: Any, b: Any) -> Enclosure:
    a, b = enclosed(a), enclosed(b)
    return Enclosure((a.value[0] + b.value[0], a.value[1] + b.value[1]), _sum(a.slopes, b.slopes))


def _negative(a: Enclosure) -> Enclosure:
    return Enclosure((-a.value[1], -a.value[0]), None if a.slopes is None else (-a.slopes[1], -a.slopes[0]))


def _multiply(a: Any, b: Any) -> Enclosure:
    if not isinstance(a, Enclosure):
        a, b = b, a
    if not isinstance(b, Enclosure):
        return Enclosure(_times(a.value, b), _times(a.slopes, b))
    return Enclosure(_product(a.value, b.value), _sum(_product(a.slopes, b.value), _product(b.slopes, a.value)))


def _divide(a: Any, b: Any) -> Enclosure:
    if isinstance(b, Enclosure):
        raise NotEnclosed("a quotient by a parameter has no rule for intervals")
    return _multiply(a, 1 / b)


def _power(a: Any, b: Any) -> Enclosure:
    if isinstance(b, Enclosure) or np.ndim(b) or b < 1 or b != int(b):
        raise NotEnclosed("a power that is no positive integer has no rule for intervals")
    result = a
    for _ in range(int(b) - 1):
        result = _multiply(result, a)
    return result


def _maximum(a: Any, b: Any) -> Enclosure:
    """Where it is not certain which of the two is larger, the derivative is that of either."""
    a, b = enclosed(a), enclosed(b)
    value = np.maximum(a.value[0], b.value[0]), np.maximum(a.value[1], b.value[1])
    first, second = a.value[0] > b.value[1], b.value[0] > a.value[1]
    of_a, of_b = ((0.0, 0.0) if x.slopes is None else x.slopes for x in (a, b))
    ends = zip(of_a, of_b, (np.minimum, np.maximum), strict=True)
    low, high = (np.where(first, x, np.where(second, y, either(x, y))) for x, y, either in ends)
    return Enclosure(value, (low, high))


def _minimum(a: Any, b: Any) -> Enclosure:
    return _negative(_maximum(_negative(enclosed(a)), _negative(enclosed(b))))


def _sin(a: Enclosure) -> Enclosure:
    slope = _sine((a.value[0] + np.pi / 2, a.value[1] + np.pi / 2))
    return Enclosure(_sine(a.value), _product(a.slopes, slope))


def _sine(angles: Pair) -> Pair:
    """The sine reaches 1 and -1 where a quarter turn after whole or half turns lies between the angles."""
    (low, high), ends = angles, np.sin(angles)

    def between(angle: float) -> np.ndarray:
        return np.floor((high - angle) / (2 * np.pi)) >= np.ceil((low - angle) / (2 * np.pi))

    return np.where(between(-np.pi / 2), -1.0, ends.min(axis=0)), np.where(between(np.pi / 2), 1.0, ends.max(axis=0))


_RULES: dict[np.ufunc, Any] = {
    np.add: _add,
    np.negative: _negative,
    np.subtract: lambda a, b: _add(a, _negative(enclosed(b))),
    np.multiply: _multiply,
    np.divide: _divide,
    np.power: _power,
    np.fmax: _maximum,
    np.maximum: _maximum,
    np.fmin: _minimum,
    np.minimum: _minimum,
    np.square: lambda a: _multiply(a, a),
    np.absolute: lambda a: _maximum(a, _negative(a)),
    np.sin: _sin,
    np.cos: lambda a: _sin(_add(a, np.pi / 2)),
}
_OPERATIONS = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda a: np.multiply(a, 2.0),
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_FABS: np.absolute,
}
