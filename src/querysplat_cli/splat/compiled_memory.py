"""What compiled functions ask of memory that numba has no words for."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array


def _on_stack(size, kind, of_llvm):
    def generate(context, builder, signature, arguments):
        place = cgutils.alloca_once(builder, of_llvm, size=ir.Constant(ir.IntType(64), size.literal_value))
        place.align = 64
        return place

    return types.CPointer(kind)(size), generate


@intrinsic(prefer_literal=True)
def scratch(typing, size):
    """`size` float32 on the stack, which LLVM can keep in registers; it cannot do that to a numpy array."""
    return _on_stack(size, types.float32, ir.FloatType())


@intrinsic(prefer_literal=True)
def scratch64(typing, size):
    """`size` float64 on the stack."""
    return _on_stack(size, types.float64, ir.DoubleType())


def row_of(context, builder, kind, array, number):
    """In LLVM's words, where a row of a 2D array of a numba type begins."""
    place = make_array(kind)(context, builder, array)
    return builder.gep(place.data, [builder.mul(number, builder.extract_value(place.shape, 1))])


@intrinsic
def prefetch(typing, array, row):
    """Ask for the line of the cache where a row of a 2D float32 array begins, ahead of its use."""

    def generate(context, builder, signature, arguments):
        first = row_of(context, builder, signature.args[0], *arguments)
        number, byte = ir.IntType(32), ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        fetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(fetch, [builder.bitcast(first, byte), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@intrinsic
def pointer(typing, array):
    """Where the numbers of a float32 array begin."""

    def generate(context, builder, signature, arguments):
        return make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(types.float32)(array), generate


@intrinsic
def copy(typing, target, first, source, start, count):
    """target[first : first + count] = source[start : start + count], of pointers to float32.

    A loop over as few numbers as a tile is wide would copy one at a time.
    """

    def generate(context, builder, signature, arguments):
        target, first, source, start, count = arguments
        cgutils.raw_memcpy(builder, builder.gep(target, [first]), builder.gep(source, [start]), count, 4)
        return context.get_dummy_value()

    places = (types.CPointer(types.float32), types.intp)
    return types.void(*places, *places, types.intp), generate
