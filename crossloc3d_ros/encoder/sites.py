"""The sites of a voxel grid: their numbering, the distinct ones, and which of them are neighbours (kernel maps).

A site is a cell (x, y, z) of a grid that is occupied. Within a box that holds all cells it has a number, its key, that
ascends by z, then y, then x; `cell_key` and `key_cell` alone know how. What is compiled here works on plain NumPy
arrays, releases the GIL and starts no threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from crossloc3d_ros.types import Float32Array, Int32Array

_exact = njit(cache=True, nogil=True, boundscheck=False)

MAX_DENSE_CELLS = 1 << 24
"""Largest box (in cells) that is looked up in a dense table; beyond it sorted keys are searched."""


def cell_key(x: Any, y: Any, z: Any, shape: Any) -> Any:
    """Return the key of the cell x, y, z of a box of `shape` (3,): numbers, arrays or tensors."""
    return (z * shape[1] + y) * shape[0] + x


def key_cell(key: Any, shape: Any) -> Any:
    """Return x, y, z of the cell with this key: the inverse of `cell_key`."""
    rest = key // shape[0]
    return key % shape[0], rest % shape[1], rest // shape[1]


_cell_key, _key_cell = _exact(cell_key), _exact(key_cell)


@_exact
def _is_dense(shape: Any) -> bool:
    return float(shape[0]) * float(shape[1]) * float(shape[2]) <= MAX_DENSE_CELLS  # in float: no overflow


@_exact
def _keys(coords: Any, begin: int, end: int, low: Any, shape: Any) -> Any:
    """Return the keys (end - begin,) int64 of coords[begin:end] in the box that starts at `low`."""
    keys = np.empty(end - begin, np.int64)
    for n in range(begin, end):
        keys[n - begin] = _cell_key(coords[n, 0] - low[0], coords[n, 1] - low[1], coords[n, 2] - low[2], shape)
    return keys


@_exact
def _neighbour_steps(kernel_size: int, step: int, shape: Any) -> Any:
    """Return (K^3,) int64, what to add to a key for the neighbour of each kernel index k = ix + K iy + K^2 iz."""
    radius = (kernel_size // 2) * step
    steps = np.empty(kernel_size**3, np.int64)
    k = 0
    for iz in range(-radius, radius + 1, step):
        for iy in range(-radius, radius + 1, step):
            for ix in range(-radius, radius + 1, step):
                steps[k] = _cell_key(ix, iy, iz, shape)
                k += 1
    return steps


def unique_sites(coords: Int32Array) -> Int32Array:
    """Return the distinct rows of coords (n, 3), sorted by z, then y, then x."""
    low = coords.min(axis=0).astype(np.int64)
    shape = coords.max(axis=0) - low + 1
    sites: Int32Array = _unique_sites(coords, low, shape)
    return sites


@_exact
def _unique_sites(coords: Any, low: Any, shape: Any) -> Any:
    keys = _keys(coords, 0, len(coords), low, shape)
    if _is_dense(shape):
        seen = np.zeros(shape[0] * shape[1] * shape[2], np.bool_)
        for key in keys:
            seen[key] = True
        keys = np.flatnonzero(seen)
    else:
        keys = np.unique(keys)
    sites = np.empty((len(keys), 3), np.int32)
    for i in range(len(keys)):
        x, y, z = _key_cell(keys[i], shape)
        sites[i, 0] = x + low[0]
        sites[i, 1] = y + low[1]
        sites[i, 2] = z + low[2]
    return sites


def voxels(points: Float32Array, size: np.float32) -> Int32Array:
    """Return the sites `floor(x / size)` of points (n, 3) float32, divided in float32; see `sparse.voxelize`."""
    return unique_sites(np.floor(points / size).astype(np.int32))


def coarser(sites: Int32Array) -> Int32Array:
    """Return the sites of stride 2: the distinct `floor(c / 2) * 2`."""
    return unique_sites(sites & ~1)


@_exact
def _widen(coords: Any, begin: int, end: int, low: Any, high: Any) -> None:
    """Widen the box from low to high (3,) so that it holds coords[begin:end]."""
    for n in range(begin, end):
        for axis in range(3):
            low[axis] = min(low[axis], coords[n, axis])
            high[axis] = max(high[axis], coords[n, axis])


@_exact
def lower_bound(keys: Any, wanted: int) -> int:
    """Return the first position in sorted keys that is not below `wanted` (NumPy's own compiles for seconds)."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low


@_exact
def find_key(keys: Any, wanted: int) -> int:
    """Return the position of `wanted` in sorted keys, or -1."""
    at = lower_bound(keys, wanted)
    return at if at < len(keys) and keys[at] == wanted else -1


@_exact
def kernel_map(coords: Any, starts: Any, queries: Any, query_starts: Any, kernel_size: int, step: int) -> Any:
    """Find for every output site its input neighbours.

    coords (N, 3) and queries (M, 3) int32 hold x, y, z of the input and output sites, cloud by cloud as `starts` and
    `query_starts` (B + 1,) begin, each cloud's sorted by z, then y, then x. Kernel index k = ix + K iy + K^2 iz, offset
    (ix - K // 2, ...) times `step`.
    Returns in_rows (P,), out_rows (P,) int32, sorted by kernel and then by output row, and first (K^3 + 1,) int64,
    where each kernel's pairs begin.
    """
    found = np.full((kernel_size**3, len(queries)), -1, np.int32)
    first = np.zeros(len(found) + 1, np.int64)
    radius = (kernel_size // 2) * step
    low = np.empty(3, np.int64)
    high = np.empty(3, np.int64)
    table = np.empty(0, np.int32)
    for cloud in range(len(starts) - 1):
        begin, end = starts[cloud], starts[cloud + 1]
        query_begin, query_end = query_starts[cloud], query_starts[cloud + 1]
        if begin == end or query_begin == query_end:
            continue
        low[:] = coords[begin]
        high[:] = coords[begin]
        _widen(coords, begin, end, low, high)
        _widen(queries, query_begin, query_end, low, high)
        low -= radius
        shape = high + radius - low + 1
        steps = _neighbour_steps(kernel_size, step, shape)
        keys = _keys(coords, begin, end, low, shape)
        wanted = _keys(queries, query_begin, query_end, low, shape)
        rows = found[:, query_begin:query_end]
        if _is_dense(shape):
            cells = shape[0] * shape[1] * shape[2]
            if cells > len(table):
                table = np.full(cells, -1, np.int32)
            _find_in_table(keys, begin, wanted, steps, table, rows, first)
        else:
            _find_among_keys(keys, begin, wanted, steps, rows, first)
    return _pairs(found, np.cumsum(first))


@_exact
def _find_in_table(keys: Any, begin: int, wanted: Any, steps: Any, table: Any, found: Any, first: Any) -> None:
    """Find neighbours by a table of rows that holds -1 where no site is, before and after."""
    for n in range(len(keys)):
        table[keys[n]] = begin + n
    for k in range(len(steps)):
        count = 0
        for m in range(len(wanted)):
            n = table[wanted[m] + steps[k]]
            found[k, m] = n
            count += n >= 0
        first[k + 1] += count
    for key in keys:
        table[key] = -1


@_exact
def _find_among_keys(keys: Any, begin: int, wanted: Any, steps: Any, found: Any, first: Any) -> None:
    """Find neighbours by binary search among the sorted keys."""
    for k in range(len(steps)):
        for m in range(len(wanted)):
            at = find_key(keys, wanted[m] + steps[k])
            if at >= 0:
                found[k, m] = begin + at
                first[k + 1] += 1


@_exact
def _pairs(found: Any, first: Any) -> Any:
    """Return in_rows, out_rows and first of the rows `found` (K^3, M), where -1 is no neighbour."""
    in_rows = np.empty(first[-1], np.int32)
    out_rows = np.empty(first[-1], np.int32)
    p = 0
    for k in range(found.shape[0]):
        for m in range(found.shape[1]):
            n = found[k, m]
            if n >= 0:
                in_rows[p] = n
                out_rows[p] = m
                p += 1
    return in_rows, out_rows, first


@_exact
def split_pairs(out_rows: Any, first: Any, n_rows: int, parts: int) -> Any:
    """Share the pairs of a kernel map out by output row, so that every part has about as many pairs.

    Returns rows (parts + 1,), where each part's output rows begin, and begin, end (parts, K), its pairs of kernel k.
    """
    load = np.zeros(n_rows + 1, np.int64)
    for row in out_rows:
        load[row + 1] += 1
    for row in range(n_rows):
        load[row + 1] += load[row]
    rows = np.zeros(parts + 1, np.int64)
    for part in range(1, parts):
        rows[part] = lower_bound(load, len(out_rows) * part // parts)
    rows[parts] = n_rows
    kernels = len(first) - 1
    begin = np.empty((parts, kernels), np.int64)
    end = np.empty((parts, kernels), np.int64)
    for k in range(kernels):
        at = first[k]
        for part in range(parts):
            begin[part, k] = at
            at = first[k] + lower_bound(out_rows[first[k] : first[k + 1]], rows[part + 1])
            end[part, k] = at
    return rows, begin, end


@_exact
def occupancy(sites: Any, kernel_size: int) -> Any:
    """Return a padded table of occupied cells, each site's place in it, and the steps to its neighbours.

    The table is (cells,) bool, the places (N,) int64, the steps (K^3,) int64 in kernel order; where the box is too
    large for a table, the table is empty.
    """
    radius = kernel_size // 2
    low = sites[0].astype(np.int64)
    high = low.copy()
    _widen(sites, 0, len(sites), low, high)
    low -= radius
    shape = high + radius - low + 1
    steps = _neighbour_steps(kernel_size, 1, shape)
    places = _keys(sites, 0, len(sites), low, shape)
    if not _is_dense(shape):
        return np.zeros(0, np.bool_), places, steps
    table = np.zeros(shape[0] * shape[1] * shape[2], np.bool_)
    for place in places:
        table[place] = True
    return table, places, steps
