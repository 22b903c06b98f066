"""Sums over the lanes of several vectors at once, which numba has no words for."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from querysplat_cli.splat.compiled_memory import row_of
from querysplat_cli.splat.compiled_tiles import WIDE

LANES = 16
"""Numbers of one vector."""
QUARTERS = range(0, LANES, LANES // 4)
MERGED = (
    ([q + k for q in QUARTERS for k in (0, 16, 1, 17)], [q + k for q in QUARTERS for k in (2, 18, 3, 19)]),
    ([q + k for q in QUARTERS for k in (0, 1, 16, 17)], [q + k for q in QUARTERS for k in (2, 3, 18, 19)]),
    ([q + k for q in (0, 4, 16, 20) for k in range(4)], [q + k for q in (8, 12, 24, 28) for k in range(4)]),
    ([q + k for q in (0, 8, 16, 24) for k in range(4)], [q + k for q in (4, 12, 20, 28) for k in range(4)]),
)
"""Of two vectors of 16 numbers, 0 to 15 and 16 to 31: the two summands of the vector that they become, step by step.

After the four steps, number i is the sum of all lanes of the vector i.
"""
SUMS = 7
"""Vectors that are summed over their lanes."""


@intrinsic
def add_sums(typing, place, left, array, row):
    """Add to array[row], of LANES columns, the sums over the lanes of ten vectors, and 0 in the columns after them.

    The ten are the first of SUMS vectors that `place` points to, times x and times x², the second one times x, and
    then all of them. x is `left` in the first column of a tile. Two vectors become one that holds partial sums of
    both, until one is left, which takes a third of the instructions of ten sums apart.
    """

    def generate(context, builder, signature, arguments):
        kind = ir.VectorType(ir.FloatType(), LANES)

        def vector(pointer, number):
            start = builder.gep(pointer, [ir.Constant(ir.IntType(64), LANES * number)])
            return builder.load(builder.bitcast(start, kind.as_pointer()), align=64)

        place, left, array, row = arguments
        given = [vector(place, number) for number in range(SUMS)]
        columns = ir.Constant(kind, [ir.FloatType()(lane % WIDE) for lane in range(LANES)])
        alone = builder.insert_element(ir.Constant(kind, ir.Undefined), left, ir.IntType(32)(0))
        same = ir.Constant(ir.VectorType(ir.IntType(32), LANES), None)
        x = builder.fadd(builder.shuffle_vector(alone, alone, same), columns)
        first = builder.fmul(given[0], x)
        vectors = [first, builder.fmul(first, x), builder.fmul(given[1], x), *given]
        for summands in MERGED:
            vectors += [ir.Constant(kind, None)] * (len(vectors) % 2)
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [_merged(builder, first, second, summands) for first, second in pairs]
        target = builder.bitcast(row_of(context, builder, signature.args[2], array, row), kind.as_pointer())
        builder.store(builder.fadd(builder.load(target, align=4), vectors[0]), target, align=4)
        return context.get_dummy_value()

    return types.void(place, types.float32, array, types.intp), generate


def _merged(builder, first, second, summands):
    number = ir.IntType(32)
    masks = (ir.Constant(ir.VectorType(number, LANES), [number(k) for k in lanes]) for lanes in summands)
    one, other = (builder.shuffle_vector(first, second, mask) for mask in masks)
    return builder.fadd(one, other)
