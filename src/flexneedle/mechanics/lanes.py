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
from functools import partial
from itertools import product
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
_lane = partial(ir.Constant, ir.IntType(32))
_order = partial(ir.Constant, ir.VectorType(ir.IntType(32), WIDTH))
_index = partial(ir.Constant, _INT)
_SIZE = 8  # bytes of a number
ROW = 8
"""Numbers in a row that `row_of` reads."""


class _InLanes(types.Type):
    """Something in each lane; a plain one becomes one that is the same in all of them."""

    plain: tuple[Any, ...] = ()

    def __init__(self) -> None:
        super().__init__(type(self).__name__)

    def can_convert_from(self, _context: Any, other: Any) -> Any:
        """Return how a plain type converts."""
        return Conversion.safe if isinstance(other, self.plain) else None


class Lanes(_InLanes):
    """A number in each lane."""

    plain = types.Float, types.Integer


class Mask(_InLanes):
    """A truth value in each lane."""

    plain = (types.Boolean,)


class Pair(_InLanes):
    """A vector y + iz in each lane."""


_LANES, _MASK, _PAIR = Lanes(), Mask(), Pair()
_COMPLEX = types.complex128


register_default(Lanes)(lambda manager, kind: PrimitiveModel(manager, kind, _VECTOR))
register_default(Mask)(lambda manager, kind: PrimitiveModel(manager, kind, _BITS))
register_default(Pair)(lambda manager, kind: StructModel(manager, kind, [("real", _LANES), ("imag", _LANES)]))
make_attribute_wrapper(Pair, "real", "real")
make_attribute_wrapper(Pair, "imag", "imag")


def is_space(kind: Any) -> bool:
    """Return whether a compiled type is of lateral quantities in space."""
    return isinstance(kind, types.Complex | Pair)


# ---- parts of values: a pair, of numbers or lanes, has two; anything else is its own part


def _split(builder: Any, value: Any) -> list[Any]:
    """Return the parts of a value."""
    if not isinstance(value.type, ir.Aggregate):
        return [value]
    return [builder.extract_value(value, k) for k in range(len(value.type.elements))]


def _join(builder: Any, parts: list[Any]) -> Any:
    """Return the value with these parts."""
    if len(parts) == 1:
        return parts[0]
    value = ir.Constant(ir.LiteralStructType([part.type for part in parts]), ir.Undefined)
    for k, part in enumerate(parts):
        value = builder.insert_value(value, part, k)
    return value


def _numbers(builder: Any, part: Any) -> list[Any]:
    """Return the numbers in the lanes of a part."""
    if part.type != _VECTOR:
        return [part]
    return [builder.extract_element(part, _lane(k)) for k in range(WIDTH)]


def _side_by_side(builder: Any, numbers: list[Any]) -> Any:
    """Return the part with these numbers in its lanes."""
    if len(numbers) == 1:
        return numbers[0]
    part = ir.Constant(_VECTOR, ir.Undefined)
    for k, number in enumerate(numbers):
        part = builder.insert_element(part, number, _lane(k))
    return part


def _in_all(builder: Any, value: Any, vector: Any) -> Any:
    undefined = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(undefined, value, _lane(0))
    return builder.shuffle_vector(one, undefined, _order([0] * WIDTH))


@lower_cast(types.Float, Lanes)
@lower_cast(types.Integer, Lanes)
def _number_to_lanes(context: Any, builder: Any, given: Any, _wanted: Any, value: Any) -> Any:
    return _in_all(builder, context.cast(builder, value, given, types.float64), _VECTOR)


@lower_cast(types.Boolean, Mask)
def _truth_to_mask(_context: Any, builder: Any, _given: Any, _wanted: Any, value: Any) -> Any:
    return _in_all(builder, value, _BITS)


# ---- operators


def _operator(function: Any, given: _InLanes, result: _InLanes, build: Callable[..., Any]) -> None:
    """Define an operator on lanes: arguments are of the type `given`, at least one of them before conversion."""
    kind = type(given)

    @infer_global(function)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, _kws: Any) -> Any:
            fits = all(isinstance(a, (kind, *kind.plain)) for a in args)
            return signature(result, *[given] * len(args)) if fits and given in args else None

    def lower(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return build(builder, *args)

    lower_builtin(function, *[given] * (1 if function is operator.neg else 2))(lower)


def _by_parts(name: str) -> Callable[..., Any]:
    def build(builder: Any, x: Any, y: Any) -> Any:
        pairs = zip(_split(builder, x), _split(builder, y), strict=True)
        return _join(builder, [getattr(builder, name)(*both) for both in pairs])

    return build


for _name, _kinds, _functions in (
    ("fadd", (_LANES, _PAIR), (operator.add, operator.iadd)),
    ("fsub", (_LANES, _PAIR), (operator.sub, operator.isub)),
    ("fmul", (_LANES,), (operator.mul, operator.imul)),
    ("fdiv", (_LANES,), (operator.truediv, operator.itruediv)),
):
    for _function, _kind in product(_functions, _kinds):
        _operator(_function, _kind, _kind, _by_parts(_name))
for _function, _name in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
):  # fmt: skip
    _operator(_function, _LANES, _MASK, lambda b, x, y, n=_name: b.fcmp_ordered(n, x, y))
_operator(operator.ne, _LANES, _MASK, lambda b, x, y: b.fcmp_unordered("!=", x, y))
_operator(operator.neg, _LANES, _LANES, lambda b, x: b.fneg(x))
_operator(operator.and_, _MASK, _MASK, lambda b, x, y: b.and_(x, y))
_operator(operator.or_, _MASK, _MASK, lambda b, x, y: b.or_(x, y))


# ---- functions


def _primitive(typed: Callable[..., Any], build: Callable[..., Any]) -> Callable[[_Function], _Function]:
    """Return a decorator: `typed` maps the types of the arguments to the type of the result, `build` is the lowering.

    The decorated function has the name, and the meaning for numbers in the interpreter.
    """

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


@_primitive(_common, _math("sqrt"))
def root(x: float) -> float:
    """Return the square root."""
    return float(np.sqrt(x))


@_primitive(_common, _math("fabs"))
def magnitude(x: float) -> float:
    """Return |x|."""
    return abs(x)


@_primitive(_common, _math("floor"))
def whole(x: float) -> float:
    """Return the largest whole number that is not above x."""
    return float(np.floor(x))


@_primitive(_common, _extreme("<"))
def least(a: float, b: float) -> float:
    """Return the smaller number; `a` where either is NaN."""
    return b if b < a else a


@_primitive(_common, _extreme(">"))
def most(a: float, b: float) -> float:
    """Return the larger number; `a` where either is NaN."""
    return b if b > a else a


def _select(builder: Any, mask: Any, a: Any, b: Any) -> Any:
    if not isinstance(a.type, ir.Aggregate):
        return builder.select(mask, a, b)
    for k, parts in enumerate(zip(_split(builder, a), _split(builder, b), strict=True)):
        a = builder.insert_value(a, _select(builder, mask, *parts), k)
    return a


def _build_select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    mask = (
        context.cast(builder, args[0], sig.args[0], _MASK) if sig.return_type in (_LANES, _MASK) else args[0]
    )
    return _select(builder, mask, *_cast_all(context, builder, sig, args, 1))


def _type_of_select(mask: Any, a: Any, b: Any) -> Any:
    if isinstance(a, types.Number | Lanes) and not isinstance(a, types.Complex):
        return _common(a, b) if isinstance(mask, types.Boolean) else _LANES
    return _MASK if isinstance(a, Mask) or isinstance(b, Mask) else types.unliteral(a)


@_primitive(_type_of_select, _build_select)
def select(mask: bool, a: _Value, b: _Value) -> _Value:
    """Return `a` where the mask is true, else `b`: numbers, masks, laterals, or records of them."""
    return a if mask else b


def _build_any(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    if not isinstance(args[0].type, ir.VectorType):
        return args[0]
    bits = builder.bitcast(args[0], ir.IntType(WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@_primitive(lambda _mask: types.boolean, _build_any)
def some(mask: bool) -> bool:
    """Return whether the mask is true in any lane."""
    return mask


def _build_not(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    return builder.not_(args[0])


@_primitive(lambda mask: mask, _build_not)
def opposite(mask: bool) -> bool:
    """Return the mask that is true where the given one is false."""
    return not mask


def _build_pair(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    part = _LANES if sig.return_type == _PAIR else types.float64
    return _join(builder, [context.cast(builder, *one, part) for one in zip(args, sig.args, strict=True)])


@_primitive(lambda *parts: _PAIR if isinstance(_common(*parts), Lanes) else _COMPLEX, _build_pair)
def pair(y: float, z: float) -> complex:
    """Return y + iz."""
    return complex(y, z)


def in_each(function: Any) -> Any:
    """Return a compiled function of one number as a function of lanes, lane by lane."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        one = context.get_function(function, signature(types.float64, types.float64))
        (value,) = _cast_all(context, builder, sig, args)
        return _side_by_side(builder, [one(builder, [number]) for number in _numbers(builder, value)])

    def lanes(x: float) -> float:
        return function(x)

    return _primitive(_common, build)(lanes)


# ---- arrays


def _layout(array: Any) -> tuple[Any, Any, int]:
    """Return type, LLVM type of a part, and number of parts of the elements of an array of numbers or lanes."""
    if array.ndim == 2:
        return array.dtype, _DOUBLE, 2 if is_space(array.dtype) else 1
    return (_PAIR, _VECTOR, 2) if array.ndim == 4 else (_LANES, _VECTOR, 1)


def _place(builder: Any, data: Any, offset: Any, kind: Any) -> Any:
    """Return a pointer to a value of this LLVM type, `offset` bytes after the start of the data."""
    at = builder.gep(builder.bitcast(data, _BYTE.as_pointer()), [offset])
    return builder.bitcast(at, kind.as_pointer())


def _parts(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    """Return pointers to the parts of the element at row and column of an array whose rows are contiguous."""
    _, part, count = _layout(sig.args[0])
    array = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0])
    row, column = _whole(context, builder, sig, args, 1, 3)
    size = _SIZE * (WIDTH if part == _VECTOR else 1)
    stride = cgutils.unpack_tuple(builder, array.strides, sig.args[0].ndim)[0]
    at = builder.add(builder.mul(row, stride), builder.mul(column, _index(count * size)))
    return [_place(builder, array.data, builder.add(at, _index(k * size)), part) for k in range(count)]


def _whole(context: Any, builder: Any, sig: Any, args: Any, first: int, last: int | None = None) -> list[Any]:
    """Return arguments from `first` to `last` − 1 as whole numbers."""
    given = zip(args[first:last], sig.args[first:last], strict=True)
    return [context.cast(builder, *one, types.int64) for one in given]


def _build_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _join(builder, [builder.load(place, align=_SIZE) for place in _parts(context, builder, sig, args)])


@_primitive(lambda array, _row, _column: _layout(array)[0], _build_load)
def load(array: Any, row: int, column: int) -> Any:
    """Return an element."""
    return array[row, column]


def _type_of_all(array: Any, _row: Any, count: Any) -> Any:
    return types.UniTuple(_layout(array)[0], count.literal_value)


def _build_load_all(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    one = signature(sig.return_type.dtype, sig.args[0], sig.args[1], types.int64)
    columns = [_index(k) for k in range(sig.return_type.count)]
    values = [_build_load(context, builder, one, (*args[:2], column)) for column in columns]
    return context.make_tuple(builder, sig.return_type, values)


@_primitive(_type_of_all, _build_load_all)
def load_all(array: Any, row: int, count: int) -> Any:
    """Return the first elements of a row; `count` is a constant."""
    return tuple(array[row, :count].tolist())


def _build_lanes_of(_context: Any, _builder: Any, sig: Any, _args: Any) -> Any:
    return _index(1 if _layout(sig.args[0])[1] == _DOUBLE else WIDTH)


@_primitive(lambda _array: types.int64, _build_lanes_of)
def lanes_of(_array: Any) -> int:
    """Return the number of needles in an array."""
    return 1


def _build_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value = context.cast(builder, args[3], sig.args[3], _layout(sig.args[0])[0])
    places = _parts(context, builder, sig, args)
    for place, part in zip(places, _split(builder, value), strict=True):
        builder.store(part, place, align=_SIZE)
    return context.get_dummy_value()


@_primitive(lambda *_: types.none, _build_store)
def store(array: Any, row: int, column: int, value: Any) -> None:
    """Set an element."""
    array[row, column] = value


def _number(context: Any, builder: Any, kind: Any, array: Any, index: list[Any]) -> Any:
    """Return a pointer to a number of an array (…) of numbers, with any strides."""
    proxy = cgutils.create_struct_proxy(kind)(context, builder, value=array)
    at = _index(0)
    for place, stride in zip(index, cgutils.unpack_tuple(builder, proxy.strides, kind.ndim), strict=True):
        at = builder.add(at, builder.mul(place, stride))
    return _place(builder, proxy.data, at, _DOUBLE)


def _after(builder: Any, place: Any, k: int) -> Any:
    return builder.add(place, _index(k))


def _build_fill(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    places = _parts(context, builder, sig, args)
    lanes = WIDTH if places[0].type.pointee == _VECTOR else 1
    who = cgutils.create_struct_proxy(sig.args[4])(context, builder, value=args[4])
    first, *inner, last = _whole(context, builder, sig, args, 5)
    needles = [builder.load(builder.gep(who.data, [_after(builder, first, lane)])) for lane in range(lanes)]
    for k, place in enumerate(places):
        rest = *inner, _after(builder, last, k)
        numbers = [_number(context, builder, sig.args[3], args[3], [needle, *rest]) for needle in needles]
        part = _side_by_side(builder, [builder.load(number) for number in numbers])
        builder.store(part, place, align=_SIZE)
    return context.get_dummy_value()


@_primitive(lambda *_: types.none, _build_fill)
def fill(array: Any, row: int, column: int, numbers: Any, who: Any, first: int, *index: int) -> None:
    """Set an element from an array of numbers (needles, …): of the needles who[first], who[first + 1], …, at `index`.

    The parts of a lateral in space follow one another along the last axis.
    """
    raise NotImplementedError


def _build_spill(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value, kind = args[0], sig.args[0]
    if isinstance(kind, types.Float | types.Integer):
        value = context.cast(builder, value, kind, types.float64)
    first, *inner = _whole(context, builder, sig, args, 2)
    for k, part in enumerate(_split(builder, value)):
        for lane, number in enumerate(_numbers(builder, part)):
            index = [_after(builder, first, lane), *inner[:-1], _after(builder, inner[-1], k)]
            builder.store(number, _number(context, builder, sig.args[1], args[1], index))
    return context.get_dummy_value()


@_primitive(lambda *_: types.none, _build_spill)
def spill(value: Any, numbers: Any, first: int, *index: int) -> None:
    """Write a value to an array of numbers (needles, …), as `fill` reads it."""
    raise NotImplementedError


# ---- rows of a table


def _transpose(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of a square of numbers, as vectors: in three rounds of exchanges."""
    for step in (1, 2, 4):
        low = [(k & ~step) + (WIDTH if k & step else 0) for k in range(WIDTH)]
        high = [(k | step) + (WIDTH if k & step else 0) for k in range(WIDTH)]
        rows = [
            builder.shuffle_vector(rows[k & ~step], rows[k | step], _order(high if k & step else low))
            for k in range(WIDTH)
        ]
    return rows


def _build_row(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    table = cgutils.create_struct_proxy(sig.args[0])(context, builder, value=args[0])
    row = context.cast(builder, args[1], sig.args[1], _common(sig.args[1]))
    starts = [builder.mul(builder.fptosi(one, _INT), _index(ROW * _SIZE)) for one in _numbers(builder, row)]
    if len(starts) == 1:
        places = [_after(builder, starts[0], k * _SIZE) for k in range(ROW)]
        columns = [builder.load(_place(builder, table.data, place, _DOUBLE)) for place in places]
    else:
        rows = [builder.load(_place(builder, table.data, at, _VECTOR), align=_SIZE) for at in starts]
        columns = _transpose(builder, rows)
    return context.make_tuple(builder, sig.return_type, columns)


@_primitive(lambda _table, row: types.UniTuple(_common(row), ROW), _build_row)
def row_of(table: Any, row: float) -> Any:
    """Return the 8 numbers of a row of a table (rows, 8); `row` is a whole number."""
    return tuple(table[int(row)].tolist())
