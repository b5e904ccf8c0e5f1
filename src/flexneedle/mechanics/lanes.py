"""Lanes: the numbers of several needles side by side, one in each lane of a processor's vector register.

Every operation acts on each lane as on a number, so that no needle knows its companions. A comparison of lanes gives a
mask, and `select` takes the place of `if`. In space, a lateral quantity is a `Pair` of lanes, real and imag. Kernels
are written once; the types of their arrays decide whether they are compiled for lanes or, for one needle, for numbers:

    array of          numbers             lanes
    reals             (k, c) float        (k, c, WIDTH) float
    laterals, plane   (k, c) float        (k, c, WIDTH) float
    laterals, space   (k, c) complex      (k, c, 2, WIDTH) float
"""

import operator
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel.models import PrimitiveModel, StructModel
from numba.core.datamodel.registry import register_default
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, builtin_registry, infer_global, signature
from numba.extending import make_attribute_wrapper

_Function = TypeVar("_Function", bound=Callable[..., Any])
_Value = TypeVar("_Value")

WIDTH = 8
"""Needles side by side: a register of AVX-512, two of AVX2, whose latencies overlap; decision 0027."""

_DOUBLE, _INT, _BYTE = ir.DoubleType(), ir.IntType(64), ir.IntType(8)
_VECTOR, _BITS = ir.VectorType(_DOUBLE, WIDTH), ir.VectorType(ir.IntType(1), WIDTH)
_SIZE = 8  # bytes of a number
ROW = 8
"""Numbers in a row that `row_of` reads."""


class Lanes(types.Type):
    """A number in each lane; a plain number becomes one that is the same in all of them."""

    def __init__(self) -> None:
        super().__init__("Lanes")

    def can_convert_from(self, _context: Any, other: Any) -> Any:
        """Return how numbers convert."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None


class Mask(types.Type):
    """A truth value in each lane."""

    def __init__(self) -> None:
        super().__init__("Mask")

    def can_convert_from(self, _context: Any, other: Any) -> Any:
        """Return how a truth value converts."""
        return Conversion.safe if isinstance(other, types.Boolean) else None


class Pair(types.Type):
    """A vector y + iz in each lane."""

    def __init__(self) -> None:
        super().__init__("Pair")


_LANES, _MASK, _PAIR = Lanes(), Mask(), Pair()
_COMPLEX = types.complex128


@register_default(Lanes)
class _LanesModel(PrimitiveModel):
    def __init__(self, manager: Any, lanes: Any) -> None:
        super().__init__(manager, lanes, _VECTOR)


@register_default(Mask)
class _MaskModel(PrimitiveModel):
    def __init__(self, manager: Any, mask: Any) -> None:
        super().__init__(manager, mask, _BITS)


@register_default(Pair)
class _PairModel(StructModel):
    def __init__(self, manager: Any, pair: Any) -> None:
        super().__init__(manager, pair, [("real", _LANES), ("imag", _LANES)])


make_attribute_wrapper(Pair, "real", "real")
make_attribute_wrapper(Pair, "imag", "imag")


def is_space(kind: Any) -> bool:
    """Return whether a compiled type is of lateral quantities in space."""
    return isinstance(kind, types.Complex | Pair)


# ---- conversions


def _in_all(builder: Any, value: Any, vector: Any) -> Any:
    undefined = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(
        one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    )


@lower_cast(types.Float, Lanes)
@lower_cast(types.Integer, Lanes)
def _number_to_lanes(context: Any, builder: Any, given: Any, _wanted: Any, value: Any) -> Any:
    return _in_all(builder, context.cast(builder, value, given, types.float64), _VECTOR)


@lower_cast(types.Boolean, Mask)
def _truth_to_mask(_context: Any, builder: Any, _given: Any, _wanted: Any, value: Any) -> Any:
    return _in_all(builder, value, _BITS)


# ---- operators


def _operator(
    function: Any, accepts: Callable[..., bool], given: Any, result: Any, build: Callable[..., Any]
) -> None:
    """Define an operator on lanes: arguments that it `accepts` are converted to the type `given`."""

    @infer_global(function)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, _kws: Any) -> Any:
            return signature(result, *(given for _ in args)) if accepts(*args) else None

    def lower(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return build(builder, *args)

    lower_builtin(function, *[given] * (1 if function in (operator.neg, operator.invert) else 2))(lower)


def _some(kind: Any, also: Any) -> Callable[..., bool]:
    return lambda *args: (
        any(isinstance(a, kind) for a in args) and all(isinstance(a, (kind, *also)) for a in args)
    )


_real, _truth = _some(Lanes, (types.Float, types.Integer)), _some(Mask, (types.Boolean,))
for _functions, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _function in _functions:
        _operator(_function, _real, _LANES, _LANES, lambda b, x, y, n=_name: getattr(b, n)(x, y))
for _function, _name in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
):  # fmt: skip
    _operator(_function, _real, _LANES, _MASK, lambda b, x, y, n=_name: b.fcmp_ordered(n, x, y))
_operator(operator.ne, _real, _LANES, _MASK, lambda b, x, y: b.fcmp_unordered("!=", x, y))
_operator(operator.neg, _real, _LANES, _LANES, lambda b, x: b.fneg(x))
_operator(operator.and_, _truth, _MASK, _MASK, lambda b, x, y: b.and_(x, y))
_operator(operator.or_, _truth, _MASK, _MASK, lambda b, x, y: b.or_(x, y))


def _both_parts(name: str) -> Callable[..., Any]:
    def build(builder: Any, x: Any, y: Any) -> Any:
        for part in range(2):
            parts = builder.extract_value(x, part), builder.extract_value(y, part)
            x = builder.insert_value(x, getattr(builder, name)(*parts), part)
        return x

    return build


for _functions, _name in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
):
    for _function in _functions:
        _operator(_function, _some(Pair, ()), _PAIR, _PAIR, _both_parts(_name))


# ---- functions


def _primitive(typed: Callable[..., Any]) -> Callable[..., Any]:
    """Return a decorator of a function's lowering: `typed` maps the types of its arguments to the type of its result.

    The decorated function has the name, and the meaning for numbers in the interpreter.
    """

    def define(build: Callable[..., Any]) -> Callable[[_Function], _Function]:
        def enter(function: _Function) -> _Function:
            class _Typing(AbstractTemplate):
                key = function
                prefer_literal = True

                def generic(self, args: Any, _kws: Any) -> Any:
                    return signature(typed(*args), *args)

            builtin_registry.register_global(function, types.Function(_Typing))
            lower_builtin(function, types.VarArg(types.Any))(build)
            return function

        return enter

    return define


def _common(*kinds: Any) -> Any:
    """Return lanes if any type is lanes, else a number."""
    return _LANES if any(isinstance(kind, Lanes) for kind in kinds) else types.float64


def _cast_all(context: Any, builder: Any, sig: Any, args: Any, first: int = 0) -> list[Any]:
    return [
        context.cast(builder, value, kind, sig.return_type)
        for value, kind in zip(args[first:], sig.args[first:], strict=True)
    ]


def _math(name: str) -> Callable[..., Any]:
    """Return the lowering of an intrinsic function of LLVM with any number of arguments."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = _cast_all(context, builder, sig, args)
        kind = values[0].type
        suffix = "f64" if kind == _DOUBLE else f"v{WIDTH}f64"
        declared = ir.FunctionType(kind, [kind] * len(values))
        function = cgutils.get_or_insert_function(builder.module, declared, f"llvm.{name}.{suffix}")
        return builder.call(function, values)

    return build


def _extreme(sign: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = _cast_all(context, builder, sig, args)
        return builder.select(builder.fcmp_ordered(sign, b, a), b, a)

    return build


@_primitive(_common)(_math("sqrt"))
def root(x: float) -> float:
    """Return the square root."""
    return float(np.sqrt(x))


@_primitive(_common)(_math("fabs"))
def magnitude(x: float) -> float:
    """Return |x|."""
    return abs(x)


@_primitive(_common)(_math("floor"))
def whole(x: float) -> float:
    """Return the largest whole number that is not above x."""
    return float(np.floor(x))


@_primitive(_common)(_extreme("<"))
def least(a: float, b: float) -> float:
    """Return the smaller number; `a` where either is NaN."""
    return b if b < a else a


@_primitive(_common)(_extreme(">"))
def most(a: float, b: float) -> float:
    """Return the larger number; `a` where either is NaN."""
    return b if b > a else a


def _select(builder: Any, mask: Any, a: Any, b: Any) -> Any:
    if isinstance(a.type, ir.Aggregate):
        for k in range(len(a.type.elements)):
            part = _select(builder, mask, builder.extract_value(a, k), builder.extract_value(b, k))
            a = builder.insert_value(a, part, k)
        return a
    return builder.select(mask, a, b)


def _build_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    mask = (
        context.cast(builder, args[0], sig.args[0], _MASK) if sig.return_type in (_LANES, _MASK) else args[0]
    )
    return _select(builder, mask, *_cast_all(context, builder, sig, args, 1))


def _type_of_select(mask: Any, a: Any, b: Any) -> Any:
    if isinstance(a, types.Number | Lanes) and not isinstance(a, types.Complex):
        return _common(a, b) if isinstance(mask, types.Boolean) else _LANES
    return _MASK if isinstance(a, Mask) or isinstance(b, Mask) else types.unliteral(a)


@_primitive(_type_of_select)(_build_select)
def select(mask: bool, a: _Value, b: _Value) -> _Value:
    """Return `a` where the mask is true, else `b`: numbers, masks, laterals, or records of them."""
    return a if mask else b


def _build_any(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    if not isinstance(args[0].type, ir.VectorType):
        return args[0]
    bits = builder.bitcast(args[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@_primitive(lambda _mask: types.boolean)(_build_any)
def some(mask: bool) -> bool:
    """Return whether the mask is true in any lane."""
    return mask


def _build_not(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    return builder.not_(args[0])


@_primitive(lambda mask: mask)(_build_not)
def opposite(mask: bool) -> bool:
    """Return the mask that is true where the given one is false."""
    return not mask


def _build_pair(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    lanes = sig.return_type == _PAIR
    part = _LANES if lanes else types.float64
    out = ir.Constant(ir.LiteralStructType([_VECTOR if lanes else _DOUBLE] * 2), ir.Undefined)
    for k, (value, kind) in enumerate(zip(args, sig.args, strict=True)):
        out = builder.insert_value(out, context.cast(builder, value, kind, part), k)
    return out


@_primitive(lambda *parts: _PAIR if isinstance(_common(*parts), Lanes) else _COMPLEX)(_build_pair)
def pair(y: float, z: float) -> complex:
    """Return y + iz."""
    return complex(y, z)


def in_each(function: Any) -> Any:
    """Return a compiled function of one number as a function of lanes, lane by lane."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        one = context.get_function(function, signature(types.float64, types.float64))
        if sig.args[0] != _LANES:
            return one(builder, [context.cast(builder, args[0], sig.args[0], types.float64)])
        out = ir.Constant(_VECTOR, ir.Undefined)
        for k in range(WIDTH):
            at = ir.Constant(ir.IntType(32), k)
            out = builder.insert_element(out, one(builder, [builder.extract_element(args[0], at)]), at)
        return out

    def lanes(x: float) -> float:
        return function(x)

    return _primitive(_common)(build)(lanes)


# ---- arrays


def _layout(array: Any) -> tuple[Any, Any, int]:
    """Return type, LLVM type of a part, and number of parts of the elements of an array of numbers or lanes."""
    if array.ndim == 2:
        return array.dtype, _DOUBLE, 2 if is_space(array.dtype) else 1
    return (_PAIR, _VECTOR, 2) if array.ndim == 4 else (_LANES, _VECTOR, 1)


def _element(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Return a pointer, in bytes, to the element at row and column of an array whose rows are contiguous."""
    kind, _, parts = _layout(sig.args[0])
    array = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0])
    row, column = (context.cast(builder, args[k], sig.args[k], types.int64) for k in (1, 2))
    size = parts * _SIZE * (1 if isinstance(kind, types.Number) else WIDTH)
    stride = cgutils.unpack_tuple(builder, array.strides, sig.args[0].ndim)[0]
    at = builder.add(builder.mul(row, stride), builder.mul(column, ir.Constant(_INT, size)))
    return builder.gep(builder.bitcast(array.data, _BYTE.as_pointer()), [at])


def _part(builder: Any, element: Any, part: Any, k: int) -> Any:
    size = _SIZE * (WIDTH if part == _VECTOR else 1)
    place = builder.gep(element, [ir.Constant(_INT, k * size)])
    return builder.bitcast(place, part.as_pointer())


def _build_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    _, part, parts = _layout(sig.args[0])
    element = _element(context, builder, sig, args)
    values = [builder.load(_part(builder, element, part, k), align=_SIZE) for k in range(parts)]
    if parts == 1:
        return values[0]
    out = ir.Constant(ir.LiteralStructType([part] * parts), ir.Undefined)
    for k, value in enumerate(values):
        out = builder.insert_value(out, value, k)
    return out


@_primitive(lambda array, _row, _column: _layout(array)[0])(_build_load)
def load(array: Any, row: int, column: int) -> Any:
    """Return an element."""
    return array[row, column]


def _type_of_all(array: Any, _row: Any, count: Any) -> Any:
    return types.UniTuple(_layout(array)[0], count.literal_value)


def _build_load_all(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, places = sig.return_type.dtype, (types.int64, types.int64)
    one = signature(kind, sig.args[0], *places)
    row = context.cast(builder, args[1], sig.args[1], types.int64)
    columns = [ir.Constant(_INT, k) for k in range(sig.return_type.count)]
    values = [_build_load(context, builder, one, (args[0], row, column)) for column in columns]
    return context.make_tuple(builder, sig.return_type, values)


@_primitive(_type_of_all)(_build_load_all)
def load_all(array: Any, row: int, count: int) -> Any:
    """Return the first elements of a row; `count` is a constant."""
    return tuple(array[row, :count].tolist())


def _build_lanes_of(_context: Any, _builder: Any, sig: Any, _args: Any) -> Any:
    return ir.Constant(_INT, 1 if _layout(sig.args[0])[1] == _DOUBLE else WIDTH)


@_primitive(lambda _array: types.int64)(_build_lanes_of)
def lanes_of(_array: Any) -> int:
    """Return the number of needles in an array."""
    return 1


def _build_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    kind, part, parts = _layout(sig.args[0])
    element = _element(context, builder, sig, args)
    value = context.cast(builder, args[3], sig.args[3], kind)
    for k in range(parts):
        one = value if parts == 1 else builder.extract_value(value, k)
        builder.store(one, _part(builder, element, part, k), align=_SIZE)
    return context.get_dummy_value()


@_primitive(lambda *_: types.none)(_build_store)
def store(array: Any, row: int, column: int, value: Any) -> None:
    """Set an element."""
    array[row, column] = value


def _number(context: Any, builder: Any, kind: Any, array: Any, index: list[Any]) -> Any:
    """Return a pointer to a number of an array (…) of numbers, with any strides."""
    proxy = cgutils.create_struct_proxy(kind)(context, builder, value=array)
    at = ir.Constant(_INT, 0)
    for place, stride in zip(index, cgutils.unpack_tuple(builder, proxy.strides, kind.ndim), strict=True):
        at = builder.add(at, builder.mul(place, stride))
    place = builder.gep(builder.bitcast(proxy.data, _BYTE.as_pointer()), [at])
    return builder.bitcast(place, _DOUBLE.as_pointer())


def _places(context: Any, builder: Any, sig: Any, args: Any, first: int) -> list[Any]:
    return [context.cast(builder, args[k], sig.args[k], types.int64) for k in range(first, len(args))]


def _after(builder: Any, place: Any, k: int) -> Any:
    return builder.add(place, ir.Constant(_INT, k))


def _build_fill(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    _, part, parts = _layout(sig.args[0])
    element = _element(context, builder, sig, args)
    who = cgutils.create_struct_proxy(sig.args[4])(context, builder, value=args[4])
    first, *inner = _places(context, builder, sig, args, 5)
    lanes = WIDTH if part == _VECTOR else 1
    needles = [builder.load(builder.gep(who.data, [_after(builder, first, lane)])) for lane in range(lanes)]
    for k in range(parts):
        value = ir.Constant(part, ir.Undefined)
        for lane, needle in enumerate(needles):
            index = [needle, *inner[:-1], _after(builder, inner[-1], k)]
            one = builder.load(_number(context, builder, sig.args[3], args[3], index))
            value = (
                builder.insert_element(value, one, ir.Constant(ir.IntType(32), lane)) if lanes > 1 else one
            )
        builder.store(value, _part(builder, element, part, k), align=_SIZE)
    return context.get_dummy_value()


@_primitive(lambda *_: types.none)(_build_fill)
def fill(array: Any, row: int, column: int, numbers: Any, who: Any, first: int, *index: int) -> None:
    """Set an element from an array of numbers (needles, …): of the needles who[first], who[first + 1], …, at `index`.

    The parts of a lateral in space follow one another along the last axis.
    """
    raise NotImplementedError


def _build_spill(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value, kind = args[0], sig.args[0]
    if isinstance(kind, types.Float | types.Integer):
        value, kind = context.cast(builder, value, kind, types.float64), types.float64
    first, *inner = _places(context, builder, sig, args, 2)
    parts = [builder.extract_value(value, k) for k in range(2)] if is_space(kind) else [value]
    for k, part in enumerate(parts):
        for lane in range(WIDTH if part.type == _VECTOR else 1):
            index = [_after(builder, first, lane), *inner[:-1], _after(builder, inner[-1], k)]
            one = (
                builder.extract_element(part, ir.Constant(ir.IntType(32), lane))
                if part.type == _VECTOR
                else part
            )
            builder.store(one, _number(context, builder, sig.args[1], args[1], index))
    return context.get_dummy_value()


@_primitive(lambda *_: types.none)(_build_spill)
def spill(value: Any, numbers: Any, first: int, *index: int) -> None:
    """Write a value to an array of numbers (needles, …), as `fill` reads it."""
    raise NotImplementedError


# ---- rows of a table


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of a square of numbers, as vectors: in three rounds of exchanges."""

    def exchanged(rows: list[Any], step: int) -> list[Any]:
        low = [(k & ~step) + (WIDTH if k & step else 0) for k in range(WIDTH)]
        high = [(k | step) + (WIDTH if k & step else 0) for k in range(WIDTH)]
        out = list(rows)
        kinds = ir.VectorType(ir.IntType(32), WIDTH)
        for k in range(WIDTH):
            if not k & step:
                a, b = rows[k], rows[k | step]
                out[k] = builder.shuffle_vector(a, b, ir.Constant(kinds, low))
                out[k | step] = builder.shuffle_vector(a, b, ir.Constant(kinds, high))
        return out

    for step in (1, 2, 4):
        rows = exchanged(rows, step)
    return rows


def _build_row(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    table = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0])
    start = builder.bitcast(table.data, _BYTE.as_pointer())

    def place(number: Any) -> Any:
        row = builder.fptosi(number, _INT)
        return builder.gep(start, [builder.mul(row, ir.Constant(_INT, ROW * _SIZE))])

    if sig.args[1] != _LANES:
        first = builder.bitcast(
            place(context.cast(builder, args[1], sig.args[1], types.float64)), _DOUBLE.as_pointer()
        )
        columns = [builder.load(builder.gep(first, [ir.Constant(_INT, k)])) for k in range(ROW)]
    else:
        numbers = [builder.extract_element(args[1], ir.Constant(ir.IntType(32), k)) for k in range(WIDTH)]
        rows = [
            builder.load(builder.bitcast(place(one), _VECTOR.as_pointer()), align=_SIZE) for one in numbers
        ]
        columns = _transposed(builder, rows)
    return context.make_tuple(builder, sig.return_type, columns)


@_primitive(lambda _table, row: types.UniTuple(_common(row), ROW))(_build_row)
def row_of(table: Any, row: float) -> Any:
    """Return the 8 numbers of a row of a table (rows, 8); `row` is a whole number."""
    return tuple(table[int(row)].tolist())
