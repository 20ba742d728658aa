"""Matrix products in tiles whose sums stay in registers, with bias and ReLU: what the layers of a network are made of.

The right matrix is packed (`panels`). A tile has ROWS rows and PANEL columns, which leaves registers for a row of the
panel and a number of the left matrix.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from pnu.kernels.panels import LANES
from pnu.kernels.vectors import VECTOR, call, constant, greater, load_at, pointer, spread, store_at

ROWS = 6
FEW_ROWS = 4
WORD = ir.IntType(64)


def tile(rows: int, vectors: int, *, relu: bool) -> Any:
    """A function of numba that computes one tile of out = relu(start + x w), see its docstring."""

    @intrinsic
    def product(
        typing: Any,
        x: Any, x_at: Any, x_row: Any, x_column: Any, w: Any, w_at: Any, depth: Any,
        start: Any, start_at: Any, out: Any, out_at: Any, out_row: Any,
    ) -> Any:  # fmt: skip
        """out[r, :] = start + sum over d < depth of x[r, d] w[d, :], then ReLU if there is one.

        Flat buffers and places in them: x[r, d] lies at x_at + r x_row + d x_column, row r of out at out_at + r
        out_row, a panel of the packed w from w_at on, and the row that all rows begin with at start_at.
        """
        place = types.intp
        signature = types.void(x, place, place, place, w, place, place, start, place, out, place, place)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            x, x_at, x_row, x_column, w, w_at, depth, start, start_at, out, out_at, out_row = values
            x, w, start, out = (
                pointer(context, builder, signature.args[i], values[i]) for i in (0, 4, 7, 9)
            )  # fmt: skip

            def plus(a: Any, b: Any, times: int = 1) -> Any:
                return builder.add(a, builder.mul(b, ir.Constant(WORD, times)))

            lanes = [ir.Constant(WORD, c * LANES) for c in range(vectors)]
            sums = [[cgutils.alloca_once(builder, VECTOR) for _ in lanes] for _ in range(rows)]
            for c, shift in enumerate(lanes):
                first = load_at(builder, start, plus(start_at, shift))
                for row in sums:
                    builder.store(first, row[c])
            left = [builder.gep(x, [plus(x_at, x_row, r)]) for r in range(rows)]
            right = builder.gep(w, [w_at])
            with cgutils.for_range(builder, depth, intp=WORD) as loop:
                at = builder.mul(loop.index, ir.Constant(WORD, vectors * LANES))
                panel = [load_at(builder, right, plus(at, shift)) for shift in lanes]
                column = builder.mul(loop.index, x_column)
                for numbers, row in zip(left, sums, strict=True):
                    number = spread(builder, builder.load(builder.gep(numbers, [column])))
                    for values_, sum_ in zip(panel, row, strict=True):
                        builder.store(call(builder, "fmuladd", number, values_, builder.load(sum_)), sum_)
            for r, row in enumerate(sums):
                for shift, sum_ in zip(lanes, row, strict=True):
                    value = builder.load(sum_)
                    value = greater(builder, value, constant(0)) if relu else value
                    store_at(builder, out, plus(plus(out_at, out_row, r), shift), value)
            return context.get_dummy_value()

        return signature, generate

    return product
