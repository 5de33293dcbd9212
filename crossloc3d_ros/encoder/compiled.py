"""The network of `model.py` once more, as the CPU runs it fastest: folded, compiled, one cloud at a time.

Batch norms are folded into the weights before them, what depends on the weights alone is computed once, and each stage
is one compiled kernel over a range of rows, so that a few threads share it. `model.py` defines what is computed; the
tests hold the two together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, cast

import numpy as np
from torch import Tensor, nn

from crossloc3d_ros.encoder import sites, stages
from crossloc3d_ros.encoder.kernels import COLUMNS, dense_product, pack_weights
from crossloc3d_ros.encoder.model import (
    ConvolutionNorm,
    CrossLoc3D,
    Grain,
    PositionEmbedding,
    RefinementLayer,
    SelectionBlock,
)
from crossloc3d_ros.types import Float32Array, Int32Array, Int64Array

MIN_ROWS_TO_SHARE = 256
"""Below this many rows a stage is quicker on one thread than handed out."""


class _Layer(NamedTuple):
    """A linear layer with its batch norm folded in."""

    weights: Float32Array
    """Packed for the kernels: (K^3, Cout / 16, Cin, 16), or without the first axis for K = 1."""
    shift: Float32Array
    """(Cout,)."""
    kernel_size: int = 1


class CompiledModel:
    """A trained model, folded and packed; safe to use from several threads at once.

    Needs widths that fill whole vectors: see `can_compile`.
    """

    def __init__(self, model: CrossLoc3D, threads: int = 1) -> None:
        config = model.config
        self._sub_steps = config.sub_steps
        self._team = Team(threads)
        self._grains = [_FoldedGrain(cast(Grain, grain)) for grain in model.grains]
        if config.refinement != "fine_to_coarse":
            self._grains.reverse()
        self._steps: list[_FoldedStep] = []
        if model.refinement is not None:
            for number, layer in enumerate(model.refinement.layers):
                time = model.refinement.time
                embedding = np.zeros(config.channels, np.float32) if time is None else _array(time(number))
                self._steps.append(_FoldedStep(cast(RefinementLayer, layer), embedding))
        scale, self._fusion_shift = _folded_norm(model.fusion_norm)
        fusion = (_array(model.fusion.weight) * scale[:, None]).reshape(len(scale), -1, config.channels)
        blocks = np.ascontiguousarray(fusion.transpose(1, 2, 0))  # (stages, C, F)
        # A grain that is not refined yet stands as it came in every stage up to its own: those weights add up here.
        self._raw_fusion = [
            _packed(blocks[: grain + 1 if self._steps else 1].sum(axis=0)) for grain in range(len(self._grains))
        ]
        self._refined_fusion = [_packed(block) for block in blocks[1:]]
        pool = model.pooling
        scale, shift = _folded_norm(pool.assignment_norm)
        self._assignment = _Layer(_packed(_array(pool.assignment) * scale), shift)
        self._centers = _array(pool.centers)
        scale, shift = _folded_norm(pool.output_norm)
        self._projection = _Layer(_array(pool.projection) * scale, shift)
        scale, shift = _folded_norm(pool.gating_norm)
        self._gating = _Layer(_array(pool.gating) * scale, shift)

    @staticmethod
    def can_compile(model: CrossLoc3D) -> bool:
        """Return whether every width of the model is a multiple of the vector width."""
        config = model.config
        widths = [config.channels, config.fused_channels, config.clusters]
        if model.refinement is not None:
            widths += list(config.memory_sizes)
        return all(width % COLUMNS == 0 for width in widths)

    def encode_many(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the descriptors (B, D) of clouds (n, 3); with several clouds each thread takes whole ones."""
        if len(clouds) < self._team.threads:
            return np.stack([self.encode(cloud) for cloud in clouds])
        alone = Team(1)
        descriptors = np.empty((len(clouds), len(self._gating.shift)), np.float32)

        def encode_some(begin: int, end: int) -> None:
            for i in range(begin, end):
                descriptors[i] = self.encode(clouds[i], alone)

        self._team.run(self._team.ranges(len(clouds)), encode_some)
        return descriptors

    def encode(self, points: Float32Array, team: Team | None = None) -> Float32Array:
        """Return the descriptor (D,) of the points (n, 3) float32 in [-1, 1]."""
        team = team or self._team
        grains = [grain.encode(points, team) for grain in self._grains]
        ends = np.cumsum([len(x) for x in grains]).tolist()
        x = np.concatenate(grains)
        fused = _rows(self._fusion_shift, len(x))
        for begin, end, weights in zip([0, *ends[:-1]], ends, self._raw_fusion, strict=True):
            team.share(end - begin, dense_product, x[begin:end], weights, fused[begin:end])
        for number, step in enumerate(self._steps):
            grain, sub_step = divmod(number, self._sub_steps)
            step.refine(x[: ends[grain]], team)
            if sub_step == self._sub_steps - 1:
                team.share(ends[grain], dense_product, x, self._refined_fusion[grain], fused)
        return self._pool(fused, team)

    def _pool(self, fused: Float32Array, team: Team) -> Float32Array:
        n, channels = fused.shape
        soft = _rows(self._assignment.shift, n)
        team.share(n, stages.assign, fused, self._assignment.weights, soft)
        sums = np.zeros((channels, soft.shape[1]), np.float32)
        team.share(channels, stages.aggregate, fused, soft, sums)
        y = self._project(stages.residuals(sums, soft, self._centers), self._projection, team)
        gate = self._project(y, self._gating, team)
        return (y / (1.0 + np.exp(-gate))).astype(np.float32)

    def _project(self, x: Float32Array, layer: _Layer, team: Team) -> Float32Array:
        parts = np.zeros((team.threads, len(layer.shift)), np.float32)
        team.share(len(x), stages.project, x, layer.weights, parts, numbered=True)
        total: Float32Array = parts.sum(axis=0) + layer.shift
        return total


class Team:
    """A few threads that share the rows of a stage; the caller is one of them."""

    def __init__(self, threads: int) -> None:
        self.threads = max(1, threads)
        self._pool = ThreadPoolExecutor(self.threads - 1, "encoder") if self.threads > 1 else None

    def parts(self, rows: int) -> int:
        """Return on how many threads a stage of so many rows should run."""
        return self.threads if rows >= MIN_ROWS_TO_SHARE else 1

    def ranges(self, rows: int, count: int | None = None) -> list[tuple[int, int]]:
        """Return `count` equal ranges of the rows, by default one a thread."""
        count = count or self.threads
        bounds = [rows * part // count for part in range(count + 1)]
        return list(itertools.pairwise(bounds))

    def share(self, rows: int, kernel: Callable[..., None], *args: Any, numbered: bool = False) -> None:
        """Run `kernel(*args, begin, end)` over equal ranges of the rows; `numbered` adds the range's number."""
        ranges = self.ranges(rows, self.parts(rows))
        self.run([(*part, i) for i, part in enumerate(ranges)] if numbered else ranges, kernel, *args)

    def run(self, parts: list[Any], kernel: Callable[..., None], *args: Any) -> None:
        """Run `kernel(*args, *part)` for every part, the first in the calling thread; wait for all."""
        waiting = [self._pool.submit(kernel, *args, *part) for part in parts[1:]] if self._pool is not None else []
        kernel(*args, *parts[0])
        for future in waiting:
            future.result()


class _Pairs:
    """A kernel map, with each thread's share of every kernel's pairs."""

    def __init__(self, inputs: Int32Array, outputs: Int32Array, kernel_size: int, stride: int, team: Team) -> None:
        starts, output_starts = np.array([0, len(inputs)]), np.array([0, len(outputs)])
        self.in_rows, self.out_rows, first = sites.kernel_map(
            inputs, starts, outputs, output_starts, kernel_size, stride
        )
        self.n_rows = len(outputs)
        rows, begin, end = sites.split_pairs(self.out_rows, first, self.n_rows, team.parts(self.n_rows))
        self.shares: list[tuple[Int64Array, Int64Array, int, int]] = [
            (begin[part], end[part], int(rows[part]), int(rows[part + 1])) for part in range(len(begin))
        ]

    def convolve(
        self,
        x: Float32Array,
        layer: _Layer,
        team: Team,
        *,
        relu: bool,
        out: Float32Array | None = None,
        added: Float32Array | None = None,
    ) -> Float32Array:
        out = np.empty((self.n_rows, len(layer.shift)), np.float32) if out is None else out
        out[:] = layer.shift
        if added is not None:
            out += added
        team.run(self.shares, stages.convolve, x, layer.weights, self.in_rows, self.out_rows, relu, out)
        return out


_WIDE_KERNELS = {size for sizes in SelectionBlock.KERNELS for size in sizes if size > 1}
"""Kernel sizes that need a kernel map: every branch ends in one."""


class _FoldedGrain:
    def __init__(self, grain: Grain) -> None:
        block = grain.selection
        self._voxel_size = np.float32(grain.voxel_size)
        weights, self._stem_shift = _folded(grain.stem)
        self._stem = np.ascontiguousarray(weights[:, 0])  # (K^3, C)
        self._stem_size = grain.stem.kernel_size
        self._down = _layer(grain.down)
        self._position = None if grain.position is None else _FoldedPosition(grain.position, grain.voxel_size)
        self._branches = [[_layer(cast(ConvolutionNorm, m)) for m in cast(nn.ModuleList, b)] for b in block.branches]
        self._attention = np.stack([_array(cast(Any, a).conv.weight).reshape(3) for a in block.attentions])
        self._kept = block.kept
        if block.kept:
            pairs = [[_layer(cast(ConvolutionNorm, m)) for m in cast(nn.ModuleList, t)] for t in block.transforms]
            gate = _layer(block.gate)
            self._gate = (
                np.stack([first.weights for first, _ in pairs]),
                np.stack([first.shift for first, _ in pairs]),
                np.stack([second.weights for _, second in pairs]),
                np.sum([second.shift for _, second in pairs], axis=0, dtype=np.float32),
                gate.weights,
                gate.shift,
            )

    def encode(self, points: Float32Array, team: Team) -> Float32Array:
        """Return the grain's features (N, C) on the sites of stride 2."""
        fine = sites.voxels(points, self._voxel_size)
        coarse = sites.coarser(fine)
        y = _rows(self._stem_shift, len(fine))
        team.share(len(fine), stages.stem, *sites.occupancy(fine, self._stem_size), self._stem, y)
        places = None if self._position is None else self._position.embed(coarse)
        x = _Pairs(fine, coarse, self._down.kernel_size, 1, team).convolve(y, self._down, team, relu=True, added=places)
        pairs = {size: _Pairs(coarse, coarse, size, 2, team) for size in _WIDE_KERNELS}
        branches = np.empty((len(self._branches), *x.shape), np.float32)
        for layers, out in zip(self._branches, branches, strict=True):
            y = x
            for layer in layers[:-1]:
                y = (
                    _dense_relu(y, layer, team)
                    if layer.kernel_size == 1
                    else pairs[layer.kernel_size].convolve(y, layer, team, relu=True)
                )
            if layers:  # no ReLU at a branch's end
                pairs[layers[-1].kernel_size].convolve(y, layers[-1], team, relu=False, out=out)
            else:
                out[:] = x
        scales = stages.channel_attention(branches, self._attention)
        if not self._kept:
            mean: Float32Array = (branches * scales[:, None]).mean(axis=0)
            return mean
        selected = np.empty_like(x)
        team.share(len(x), stages.select, branches, scales, *self._gate, self._kept, selected)
        return selected


class _FoldedPosition:
    """The embedding is a sum over the axes, and sites lie on a grid: a few sines an axis serve every site."""

    def __init__(self, position: PositionEmbedding, voxel_size: float) -> None:
        self._kind = position.kind
        self._voxel_size = voxel_size
        self._weights = _array(position.linear.weight).T.reshape(-1, position.axes, position.linear.out_features)

    def embed(self, coarse: Int32Array) -> Float32Array:
        """Return (N, C) for sites `coarse` (N, 3) of stride 2."""
        if self._kind == "radial":
            x, y = ((coarse[:, axis] + 1.0) * self._voxel_size for axis in range(2))
            distances, rows = np.unique(np.hypot(x, y).astype(np.float32), return_inverse=True)
            return self._axis(distances, 0)[rows] + self._on_grid(coarse[:, 2], 1)
        return self._on_grid(coarse[:, 0], 0) + self._on_grid(coarse[:, 1], 1) + self._on_grid(coarse[:, 2], 2)

    def _on_grid(self, coordinates: Int32Array, axis: int) -> Float32Array:
        low = int(coordinates.min())
        centres = (np.arange(low, int(coordinates.max()) + 1) + 1.0) * self._voxel_size
        table: Float32Array = self._axis(centres.astype(np.float32), axis)[coordinates - low]
        return table

    def _axis(self, values: Float32Array, axis: int) -> Float32Array:
        angles = [np.float32(math.pi * wave) * values for wave in PositionEmbedding.WAVES]
        waves = np.stack([values, *(np.sin(a) for a in angles), *(np.cos(a) for a in angles)], axis=1)
        product: Float32Array = waves @ self._weights[:, axis]
        return product


class _FoldedStep:
    def __init__(self, layer: RefinementLayer, embedding: Float32Array) -> None:
        self._embedding = embedding
        self._heads = layer.heads
        channels, memory = layer.centers.shape
        query = _array(layer.query.weight).reshape(layer.heads, -1, channels)  # (H, d, C)
        centers = _array(layer.centers).reshape(layer.heads, -1, memory)  # (H, d, M)
        keys = np.einsum("hdc,hdm->chm", query, centers).reshape(channels, -1)
        self._keys = _packed(keys)
        values = _array(layer.value(layer.centers.t())).reshape(memory, layer.heads, -1)
        self._values = np.stack([_packed(values[:, head]) for head in range(layer.heads)])  # (H, panels, M, 16)
        scale, shift = _folded_norm(layer.norm)
        self._transform = _packed(_array(layer.transform.weight).T * scale)
        self._shift = _array(layer.transform.bias) * scale + shift

    def refine(self, x: Float32Array, team: Team) -> None:
        """Apply the layer to the rows of x (N, C), in place."""
        attention = np.empty((len(x), self._keys.shape[0] * COLUMNS), np.float32)
        sums = np.zeros((team.threads, attention.shape[1]), np.float32)
        args = (x, self._embedding, self._keys, self._heads, attention, sums)
        team.share(len(x), stages.attend, *args, numbered=True)
        values = stages.scale_values(self._values, sums)
        team.share(len(x), stages.read_memory, x, attention, values, self._transform, self._shift, x)


def _dense_relu(x: Float32Array, layer: _Layer, team: Team) -> Float32Array:
    out = _rows(layer.shift, len(x))
    team.share(len(x), stages.dense_relu, x, layer.weights, out)
    return out


def _rows(row: Float32Array, count: int) -> Float32Array:
    """Return `count` copies of a row."""
    out = np.empty((count, len(row)), np.float32)
    out[:] = row
    return out


def _array(tensor: Tensor) -> Float32Array:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)


def _folded_norm(norm: nn.BatchNorm1d) -> tuple[Float32Array, Float32Array]:
    """Return scale and shift of `y = scale x + shift`."""
    mean, variance = cast(Tensor, norm.running_mean).double(), cast(Tensor, norm.running_var).double()
    scale = norm.weight.detach().double() / (variance + norm.eps).sqrt()
    return _array(scale), _array(norm.bias.detach().double() - mean * scale)


def _folded(layer: ConvolutionNorm) -> tuple[Float32Array, Float32Array]:
    scale, shift = _folded_norm(layer.norm)
    return _array(layer.weight) * scale, shift


def _layer(layer: ConvolutionNorm) -> _Layer:
    weights, shift = _folded(layer)
    packed = pack_weights(weights)
    return _Layer(packed[0] if layer.kernel_size == 1 else packed, shift, layer.kernel_size)


def _packed(weights: Float32Array) -> Float32Array:
    """Pack one matrix (Cin, Cout) as (Cout / 16, Cin, 16)."""
    packed: Float32Array = pack_weights(np.ascontiguousarray(weights, np.float32)[None])[0]
    return packed
