"""Nearest descriptors: the map's search index, and the only module that knows faiss.

The search is exact. A descriptor of 256 numbers takes a kilobyte and a square kilometre has 2,770 of them: a city fits
in memory, and larger indices are mapped from the disk.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from pathlib import Path

import faiss
import numpy as np

from crossloc3d_ros.errors import MapError
from crossloc3d_ros.types import Float32Array, Int64Array

_MAPPED_FROM_BYTES = 1 << 30  # a larger map is read from disk as needed instead of filling a robot's memory


class DescriptorMap:
    """Finds the descriptors that lie nearest to a query."""

    def __init__(self, descriptors: Float32Array) -> None:
        """Index descriptors (M, D); row i gets id i."""
        index = faiss.IndexFlatL2(descriptors.shape[1])
        index.add(np.ascontiguousarray(descriptors, dtype=np.float32))
        self._index: faiss.Index = index

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @property
    def descriptor_size(self) -> int:
        """Numbers in a descriptor."""
        return int(self._index.d)

    def search(self, descriptor: Float32Array, k: int) -> tuple[Int64Array, Float32Array]:
        """Return ids and Euclidean distances (k,) of the nearest descriptors to one (D,), best first.

        Fewer than `k` where the map holds fewer; neighbours at the same distance come in the order of their ids.
        """
        ids, distances = self.search_many(descriptor[None], k)
        return ids[0], distances[0]

    def search_many(self, descriptors: Float32Array, k: int) -> tuple[Int64Array, Float32Array]:
        """Return ids and Euclidean distances (B, k) of the nearest to each of the descriptors (B, D)."""
        if descriptors.ndim != 2 or descriptors.shape[1] != self.descriptor_size:
            raise MapError(
                f"the map holds descriptors of {self.descriptor_size} numbers, the query has the shape "
                f"{descriptors.shape[1:]}: map and weights do not belong together"
            )
        squared, ids = self._index.search(
            np.ascontiguousarray(descriptors, dtype=np.float32), max(1, min(k, len(self)))
        )
        # The squares come from a difference of large numbers and may fall below zero by a rounding error.
        return ids.astype(np.int64), np.sqrt(np.maximum(squared, 0.0)).astype(np.float32)

    def descriptors(self, ids: Int64Array) -> Float32Array:
        """Return the stored descriptors (len(ids), D)."""
        return np.asarray(self._index.reconstruct_batch(np.ascontiguousarray(ids, dtype=np.int64)), dtype=np.float32)

    def save(self, path: Path) -> None:
        """Write the index to a file."""
        blocks = (self.descriptors(np.arange(i, min(i + 4096, len(self)))) for i in range(0, len(self), 4096))
        write_descriptors(path, blocks, len(self), self.descriptor_size)

    @classmethod
    def load(cls, path: Path) -> DescriptorMap:
        """Read an index, or map it into memory where it is large; MapError where it is damaged."""
        self = cls.__new__(cls)
        try:
            mapped = path.stat().st_size >= _MAPPED_FROM_BYTES
            self._index = faiss.read_index(str(path), faiss.IO_FLAG_MMAP_IFC if mapped else 0)
        except (RuntimeError, OSError) as error:
            raise MapError(f"the index {path} is damaged or missing; copy the map again or build it anew") from error
        return self


def write_descriptors(path: Path, blocks: Iterable[Float32Array], count: int, size: int) -> None:
    """Write a faiss index of `count` descriptors of `size` numbers that arrive in blocks (B, size).

    faiss itself writes only what it holds in memory, which a state's worth of descriptors is too much for. Its file of
    a flat index is a header, the number of floats and the floats: the header comes from faiss with the numbers of an
    empty index, which are replaced, and the result is opened with faiss.
    """
    header = bytearray(faiss.serialize_index(faiss.IndexFlatL2(size)).tobytes())
    struct.pack_into("<q", header, 8, count)
    struct.pack_into("<Q", header, len(header) - 8, count * size)
    written = 0
    with path.open("wb") as file:
        file.write(header)
        for block in blocks:
            file.write(np.ascontiguousarray(block, dtype="<f4").tobytes())
            written += len(block)
        file.flush()
        os.fsync(file.fileno())
    if written != count or DescriptorMap.load(path)._index.ntotal != count:
        raise MapError(f"{path}: {written} descriptors were written where {count} were promised")
