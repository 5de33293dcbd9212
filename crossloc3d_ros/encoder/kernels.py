"""The CPU kernel of the sparse network, compiled by Numba: the gathered matrix product.

Everything here works on plain NumPy arrays, releases the GIL and starts no threads of its own: whoever calls may run
one kernel on several row ranges at once from several threads.

The gathered matrix product `out[o] += x[i] @ w` is where the encoder spends its time. LLVM does not find the register
tile by itself, so `_tile` spells it out: R rows of the input against 16 columns of the weights, accumulated in vector
registers over all input channels, then added to R output rows. Nothing is gathered into a buffer, and absent
neighbours cost nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

COLUMNS = 16
"""Columns of a weight panel: two AVX2 registers, one AVX-512, four NEON."""

UNROLL = 4
"""Input channels that the register tile takes at a time."""

OUTER_BLOCK = 64
"""Pairs that the gradient of the weights takes at a time, so that both sides stay in the cache."""


def _make_tile(n_rows: int, *, gathered: bool) -> Any:
    """Emit the register tile for `n_rows` rows of x against one panel of 16 columns of w.

    `tile(x, w, out, geometry, begin)` works on flat float32 arrays and the rows from `begin` on; a gathered one has
    `in_rows` and `out_rows` besides, and takes the rows of x and out that stand there from `begin` on. `geometry` is
    (w_at, depth, x_at, x_row, x_step, w_step, out_at, out_row): row r, depth d of x lies at
    `x_at + r x_row + d x_step`, depth d of the panel at `w_at + d w_step`, row r of out at `out_at + r out_row`.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        single, lane, word = ir.FloatType(), ir.IntType(32), ir.IntType(64)
        vector = ir.VectorType(single, COLUMNS)
        fused = ir.FunctionType(vector, [vector] * 3)
        fma = cgutils.get_or_insert_function(builder.module, fused, f"llvm.fma.v{COLUMNS}f32")
        w_at, depth, x_at, x_row, x_step, w_step, out_at, out_row = cgutils.unpack_tuple(builder, args[3], 8)

        def data(position: int) -> Any:
            return context.make_array(signature.args[position])(context, builder, args[position]).data

        def row(r: int, rows_position: int) -> Any:
            number = builder.add(args[4], word(r))
            if gathered:
                stored = builder.load(builder.gep(data(rows_position), [number]))
                number = builder.sext(stored, word) if stored.type.width < word.width else stored
            return number

        def address(base: Any, offset: Any, number: Any, step: Any) -> Any:
            return builder.gep(base, [builder.add(offset, builder.mul(number, step))])

        rows = [address(data(0), x_at, row(r, 5), x_row) for r in range(n_rows)]
        panel = builder.gep(data(1), [w_at])
        sums = [cgutils.alloca_once(builder, vector) for _ in range(n_rows)]
        for total in sums:
            builder.store(ir.Constant(vector, [0.0] * COLUMNS), total)
        undefined = ir.Constant(vector, ir.Undefined)
        everywhere = ir.Constant(ir.VectorType(lane, COLUMNS), [0] * COLUMNS)

        def accumulate(index: Any) -> None:
            place = builder.gep(panel, [builder.mul(index, w_step)])
            weights = builder.load(builder.bitcast(place, vector.as_pointer()), align=4)
            x_index = builder.mul(index, x_step)
            for start, total in zip(rows, sums, strict=True):
                value = builder.insert_element(undefined, builder.load(builder.gep(start, [x_index])), lane(0))
                broadcast = builder.shuffle_vector(value, undefined, everywhere)
                builder.store(builder.call(fma, [broadcast, weights, builder.load(total)]), total)

        rounds = builder.udiv(depth, word(UNROLL))
        with cgutils.for_range(builder, rounds, intp=word) as loop:
            for step in range(UNROLL):
                accumulate(builder.add(builder.mul(loop.index, word(UNROLL)), word(step)))
        done = builder.mul(rounds, word(UNROLL))
        with cgutils.for_range(builder, builder.sub(depth, done), intp=word) as loop:
            accumulate(builder.add(done, loop.index))
        for r, total in enumerate(sums):
            place = address(data(2), out_at, row(r, 6), out_row)
            target = builder.bitcast(place, vector.as_pointer())
            builder.store(builder.fadd(builder.load(target, align=4), builder.load(total)), target, align=4)
        return context.get_dummy_value()

    geometry_type = types.UniTuple(types.intp, 8)

    @intrinsic
    def gathered_tile(
        typingctx: Any, x: Any, w: Any, out: Any, geometry: Any, begin: Any, in_rows: Any, out_rows: Any
    ) -> Any:
        return types.void(x, w, out, geometry_type, types.intp, in_rows, out_rows), codegen

    @intrinsic
    def tile(typingctx: Any, x: Any, w: Any, out: Any, geometry: Any, begin: Any) -> Any:
        return types.void(x, w, out, geometry_type, types.intp), codegen

    return gathered_tile if gathered else tile


_tile6, _tile2, _tile1 = (_make_tile(n, gathered=False) for n in (6, 2, 1))
_gathered6, _gathered2, _gathered1 = (_make_tile(n, gathered=True) for n in (6, 2, 1))


@njit(cache=True, nogil=True, boundscheck=False)
def pack_weights(weights: Any) -> Any:
    """Rearrange weights (K, Cin, Cout) into panels (K, Cout / 16, Cin, 16), zero-padded to whole panels."""
    kernels, depth, width = weights.shape
    panels = (width + COLUMNS - 1) // COLUMNS
    packed = np.zeros((kernels, panels, depth, COLUMNS), np.float32)
    for k in range(kernels):
        for c in range(depth):
            for o in range(width):
                packed[k, o // COLUMNS, c, o % COLUMNS] = weights[k, c, o]
    return packed


@njit(cache=True, nogil=True, boundscheck=False)
def gather_product(x: Any, packed: Any, in_rows: Any, out_rows: Any, first: Any, last: Any, out: Any) -> None:
    """Add `x[i] @ weights[k]` to `out[o]` for the pairs (i, o) of each kernel k.

    Kernel k's pairs are (in_rows, out_rows)[first[k]:last[k]]; x (N, Cin) and out (M, Cout) float32, C-contiguous;
    packed from `pack_weights`; Cout a multiple of 16. Within one kernel an output row must not occur twice.
    """
    kernels, panels, depth, _ = packed.shape
    x_flat, w_flat, out_flat = x.ravel(), packed.ravel(), out.ravel()
    for k in range(kernels):
        for panel in range(panels):
            w_at = (k * panels + panel) * depth * COLUMNS
            geometry = (w_at, depth, 0, x.shape[1], 1, COLUMNS, panel * COLUMNS, out.shape[1])
            p, end = first[k], last[k]
            while p + 6 <= end:
                _gathered6(x_flat, w_flat, out_flat, geometry, p, in_rows, out_rows)
                p += 6
            while p + 2 <= end:
                _gathered2(x_flat, w_flat, out_flat, geometry, p, in_rows, out_rows)
                p += 2
            if p < end:
                _gathered1(x_flat, w_flat, out_flat, geometry, p, in_rows, out_rows)


@njit(cache=True, nogil=True, boundscheck=False)
def strided_product(
    x: Any,
    x_at: int,
    x_row: int,
    x_step: int,
    w: Any,
    w_at: int,
    w_panel: int,
    w_step: int,
    out: Any,
    out_at: int,
    out_row: int,
    depth: int,
    width: int,
    begin: int,
    end: int,
) -> None:
    """Add `x @ w` to `out` for the rows [begin, end), on flat float32 arrays with steps of the caller's choice.

    Row r, depth d of x lies at `x_at + r x_row + d x_step`; depth d of the 16 columns of panel p of w at
    `w_at + p w_panel + d w_step`; row r of out at `out_at + r out_row`. `width` is a multiple of 16.
    """
    for panel in range(width // COLUMNS):
        geometry = (w_at + panel * w_panel, depth, x_at, x_row, x_step, w_step, out_at + panel * COLUMNS, out_row)
        row = begin
        while row + 6 <= end:
            _tile6(x, w, out, geometry, row)
            row += 6
        while row + 2 <= end:
            _tile2(x, w, out, geometry, row)
            row += 2
        if row < end:
            _tile1(x, w, out, geometry, row)


@njit(cache=True, nogil=True, boundscheck=False)
def dense_product(x: Any, packed: Any, out: Any, begin: int, end: int) -> None:
    """Add `x @ weights` to `out` for the rows [begin, end); packed (Cout / 16, Cin, 16)."""
    panels, depth, _ = packed.shape
    strided_product(
        x.ravel(),
        0,
        x.shape[1],
        1,
        packed.ravel(),
        0,
        depth * COLUMNS,
        COLUMNS,
        out.ravel(),
        0,
        out.shape[1],
        depth,
        panels * COLUMNS,
        begin,
        end,
    )


@njit(cache=True, nogil=True, boundscheck=False)
def gather_outer(x: Any, grad: Any, in_rows: Any, out_rows: Any, first: Any, out: Any) -> None:
    """Add `x[i].T @ grad[o]` over the pairs (i, o) of each kernel k to out[k]: the gradient of the weights.

    x (N, Cin) and grad (M, Cout) float32, C-contiguous; out (K, Cin, Cout); Cout a multiple of 16.
    """
    depth, width = x.shape[1], grad.shape[1]
    transposed = np.empty((depth, OUTER_BLOCK), np.float32)
    gathered = np.empty((OUTER_BLOCK, width), np.float32)
    for k in range(len(first) - 1):
        target = out[k].ravel()
        for start in range(first[k], first[k + 1], OUTER_BLOCK):
            count = min(OUTER_BLOCK, first[k + 1] - start)
            for p in range(count):
                row = in_rows[start + p]
                for c in range(depth):
                    transposed[c, p] = x[row, c]
                row = out_rows[start + p]
                for c in range(width):
                    gathered[p, c] = grad[row, c]
            strided_product(
                transposed.ravel(),
                0,
                OUTER_BLOCK,
                1,
                gathered.ravel(),
                0,
                COLUMNS,
                width,
                target,
                0,
                width,
                count,
                width,
                0,
                depth,
            )
