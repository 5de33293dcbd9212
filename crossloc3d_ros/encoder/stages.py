"""The stages of the compiled network: each a kernel over the rows [begin, end), so that threads can share it."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from crossloc3d_ros.encoder.kernels import (
    COLUMNS,
    dense_product,
    gather_product,
    strided_product,
)
from crossloc3d_ros.encoder.sites import find_key

_fused = njit(cache=True, nogil=True, boundscheck=False, fastmath={"contract"})
_loose = njit(cache=True, nogil=True, boundscheck=False, fastmath={"contract", "reassoc", "nsz"})

_LOG2_E = np.float32(1.44269504)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
# Far below what changes a sum, and far enough above denormal numbers, which are slow.
_LOWEST, _HIGHEST = np.float32(-60.0), np.float32(88.0)
_HALF, _ONE = np.float32(0.5), np.float32(1.0)
_P0, _P1, _P2 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
_P3, _P4, _P5 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)

BLOCK = 32
"""Rows that a stage of several products works on at a time, so that what lies between them stays in the cache."""


@intrinsic
def _as_float(typingctx: Any, bits: Any) -> Any:
    """Reinterpret an int32 as a float32."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@njit(nogil=True, inline="always")
def _exp(x: Any) -> Any:
    """Return e^x in float32 to 2e-7 relative (Cephes' polynomial), in a form that LLVM can vectorise."""
    x = min(max(x, _LOWEST), _HIGHEST)
    n = np.floor(x * _LOG2_E + _HALF)
    r = x - n * _LN2_HIGH - n * _LN2_LOW
    p = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
    return (p * r * r + r + _ONE) * _as_float(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))


@_loose
def stem(table: Any, places: Any, steps: Any, weights: Any, out: Any, begin: int, end: int) -> None:
    """Convolve the constant feature 1: add the weights (K^3, C) of the neighbours that exist, then ReLU."""
    channels = out.shape[1]
    for i in range(begin, end):
        for k in range(len(steps)):
            wanted = places[i] + steps[k]
            there = table[wanted] if len(table) else find_key(places, wanted) >= 0  # places are sorted keys
            if there:
                for c in range(channels):
                    out[i, c] += weights[k, c]
        for c in range(channels):
            out[i, c] = max(out[i, c], np.float32(0.0))


@_fused
def _relu(x: Any, begin: int, end: int) -> None:
    for i in range(begin, end):
        for c in range(x.shape[1]):
            x[i, c] = max(x[i, c], np.float32(0.0))


@_fused
def dense_relu(x: Any, weights: Any, out: Any, begin: int, end: int) -> None:
    """Compute `out = relu(out + x @ weights)`."""
    dense_product(x, weights, out, begin, end)
    _relu(out, begin, end)


@_fused
def convolve(
    x: Any, weights: Any, in_rows: Any, out_rows: Any, relu: bool, out: Any, first: Any, last: Any, begin: int, end: int
) -> None:
    """Compute `out = out + convolution`, with a ReLU where configured, for one thread's pairs and output rows."""
    gather_product(x, weights, in_rows, out_rows, first, last, out)
    if relu:
        _relu(out, begin, end)


@_loose
def channel_attention(branches: Any, kernels: Any) -> Any:
    """Return the scales (5, C) of branches (5, N, C): mean over the sites, 1-D convolution, sigmoid."""
    n_branches, n, channels = branches.shape
    scales = np.empty((n_branches, channels), np.float32)
    mean = np.empty(channels + 2, np.float32)
    for b in range(n_branches):
        mean[:] = 0.0
        for i in range(n):
            for c in range(channels):
                mean[c + 1] += branches[b, i, c]
        for c in range(channels):
            mean[c + 1] /= n
        for c in range(channels):
            value = kernels[b, 0] * mean[c] + kernels[b, 1] * mean[c + 1] + kernels[b, 2] * mean[c + 2]
            scales[b, c] = 1.0 / (1.0 + np.exp(-value))
    return scales


@_fused
def select(
    branches: Any,
    scales: Any,
    first: Any,
    first_shift: Any,
    second: Any,
    second_shift: Any,
    gate: Any,
    gate_shift: Any,
    kept: int,
    out: Any,
    begin: int,
    end: int,
) -> None:
    """Gate the branches (5, N, C): softmax over the branches, the `kept` largest stay, weighted sum into out (N, C)."""
    n_branches, _, channels = branches.shape
    scaled = np.empty((n_branches, BLOCK, channels), np.float32)
    hidden = np.empty((BLOCK, channels), np.float32)
    summed = np.empty((BLOCK, channels), np.float32)
    logits = np.empty((BLOCK, n_branches * channels), np.float32)
    top = np.empty(channels, np.float32)
    total = np.empty(channels, np.float32)
    above = np.empty(channels, np.float32)
    most = np.float32(kept)
    weights = np.empty((n_branches, channels), np.float32)
    for start in range(begin, end, BLOCK):
        rows = min(BLOCK, end - start)
        for i in range(rows):
            summed[i] = second_shift
            logits[i] = gate_shift
        for b in range(n_branches):
            for i in range(rows):
                for c in range(channels):
                    scaled[b, i, c] = branches[b, start + i, c] * scales[b, c]
                    hidden[i, c] = first_shift[b, c]
            dense_product(scaled[b], first[b], hidden, 0, rows)
            _relu(hidden, 0, rows)
            dense_product(hidden, second[b], summed, 0, rows)
        dense_product(summed, gate, logits, 0, rows)
        for i in range(rows):
            row = logits[i].reshape(n_branches, channels)
            for c in range(channels):
                top[c] = row[0, c]
            for b in range(1, n_branches):
                for c in range(channels):
                    top[c] = max(top[c], row[b, c])
            for c in range(channels):
                total[c] = 0.0
            for b in range(n_branches):
                for c in range(channels):
                    weights[b, c] = _exp(row[b, c] - top[c])
                    total[c] += weights[b, c]
            for c in range(channels):
                out[start + i, c] = 0.0
            for c in range(channels):
                total[c] = _ONE / total[c]
            for b in range(n_branches):
                for c in range(channels):
                    above[c] = 0.0
                for other in range(n_branches):
                    for c in range(channels):
                        above[c] += np.float32(row[other, c] > row[b, c])
                for c in range(channels):
                    weight = weights[b, c] * total[c] if above[c] < most else np.float32(0.0)
                    out[start + i, c] += weight * scaled[b, i, c]


@_loose
def attend(
    x: Any, step: Any, keys: Any, heads: int, attention: Any, sums: Any, begin: int, end: int, part: int
) -> None:
    """Add e(t) to x and attend: softmax over the centres into attention (N, heads * M), its sums into sums[part].

    keys: packed (C, heads * M), the query projection folded into the centres.
    """
    width = attention.shape[1]
    memory = width // heads
    for i in range(begin, end):
        for c in range(x.shape[1]):
            x[i, c] += step[c]
        for m in range(width):
            attention[i, m] = 0.0
    dense_product(x, keys, attention, begin, end)
    for i in range(begin, end):
        for h in range(heads):
            row = attention[i, h * memory : (h + 1) * memory]
            _softmax(row)
            for m in range(memory):
                sums[part, h * memory + m] += row[m]


@_loose
def _softmax(row: Any) -> None:
    top = row[0]
    for m in range(len(row)):
        top = max(top, row[m])
    total = np.float32(0.0)
    for m in range(len(row)):
        row[m] = _exp(row[m] - top)
        total += row[m]
    scale = _ONE / total
    for m in range(len(row)):
        row[m] *= scale


@_fused
def scale_values(values: Any, sums: Any) -> Any:
    """Divide the values (heads, panels, M, 16) by (1e-9 + the attention's sum (parts, heads * M) over the points)."""
    heads, panels, memory, columns = values.shape
    scaled = np.empty_like(values)
    for h in range(heads):
        for m in range(memory):
            total = np.float32(1e-9)
            for part in range(len(sums)):
                total += sums[part, h * memory + m]
            for p in range(panels):
                for c in range(columns):
                    scaled[h, p, m, c] = values[h, p, m, c] / total
    return scaled


@_fused
def read_memory(
    x: Any, attention: Any, values: Any, transform: Any, shift: Any, out: Any, begin: int, end: int
) -> None:
    """Compute `out = x + relu((attention @ values - x) @ transform + shift)`."""
    heads, panels, memory, _ = values.shape
    channels = x.shape[1]
    # The panels of a narrow head are padded with zeros, which the last head adds beyond its row.
    read = np.empty((BLOCK, channels + COLUMNS), np.float32)
    moved = np.empty((BLOCK, channels), np.float32)
    for start in range(begin, end, BLOCK):
        rows = min(BLOCK, end - start)
        for i in range(rows):
            for c in range(channels):
                read[i, c] = -x[start + i, c]
                moved[i, c] = shift[c]
        for h in range(heads):
            strided_product(
                attention.ravel(),
                start * attention.shape[1] + h * memory,
                attention.shape[1],
                1,
                values.ravel(),
                h * panels * memory * COLUMNS,
                memory * COLUMNS,
                COLUMNS,
                read.ravel(),
                h * (channels // heads),
                read.shape[1],
                memory,
                panels * COLUMNS,
                0,
                rows,
            )
        dense_product(read, transform, moved, 0, rows)
        for i in range(rows):
            for c in range(channels):
                out[start + i, c] = x[start + i, c] + max(moved[i, c], np.float32(0.0))


@_loose
def assign(x: Any, weights: Any, soft: Any, begin: int, end: int) -> None:
    """ReLU x in place and assign it softly: `soft = softmax(soft + x @ weights)`."""
    _relu(x, begin, end)
    dense_product(x, weights, soft, begin, end)
    for i in range(begin, end):
        _softmax(soft[i])


@_fused
def aggregate(x: Any, soft: Any, sums: Any, begin: int, end: int) -> None:
    """Add `x.T @ soft` to sums (C, K) for the channels [begin, end)."""
    n, clusters = soft.shape
    transposed = np.empty((end - begin, BLOCK), np.float32)
    for start in range(0, n, BLOCK):
        rows = min(BLOCK, n - start)
        for i in range(rows):
            for c in range(begin, end):
                transposed[c - begin, i] = x[start + i, c]
        strided_product(
            transposed.ravel(),
            0,
            BLOCK,
            1,
            soft.ravel(),
            start * clusters,
            COLUMNS,
            clusters,
            sums.ravel(),
            begin * clusters,
            clusters,
            rows,
            clusters,
            0,
            end - begin,
        )


@_loose
def residuals(sums: Any, soft: Any, centers: Any) -> Any:
    """Return the VLAD vector (C * K,): residuals to the centres, each cluster normalised, then the whole."""
    channels, clusters = sums.shape
    mass = np.zeros(clusters, np.float32)
    for i in range(len(soft)):
        for k in range(clusters):
            mass[k] += soft[i, k]
    squares = np.zeros(clusters, np.float32)
    for c in range(channels):
        for k in range(clusters):
            sums[c, k] -= mass[k] * centers[c, k]
            squares[k] += sums[c, k] * sums[c, k]
    for k in range(clusters):
        squares[k] = _ONE / max(np.sqrt(squares[k]), np.float32(1e-12))
    total = np.float32(0.0)
    for c in range(channels):
        for k in range(clusters):
            sums[c, k] *= squares[k]
            total += sums[c, k] * sums[c, k]
    return sums.ravel() * (_ONE / max(np.sqrt(total), np.float32(1e-12)))


@_loose
def project(x: Any, weights: Any, parts: Any, begin: int, end: int, part: int) -> None:
    """Add `x[begin:end] @ weights[begin:end]` to parts[part]; bound by the memory that the weights come from."""
    width = weights.shape[1]
    out = parts[part]
    i = begin
    while i + 4 <= end:
        a, b, c, d = x[i], x[i + 1], x[i + 2], x[i + 3]
        for j in range(width):
            out[j] += a * weights[i, j] + b * weights[i + 1, j] + c * weights[i + 2, j] + d * weights[i + 3, j]
        i += 4
    while i < end:
        for j in range(width):
            out[j] += x[i] * weights[i, j]
        i += 1
