"""Draw the batches to come while the one at hand is learned from."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from crossloc3d_ros.training.sampling import Batch, HardPlaces, Sampler
from crossloc3d_ros.types import Float32Array, Float64Array, Int64Array

_Key = tuple[int, int, HardPlaces | None]


class BatchesAhead:
    """A sampler whose next batches are drawn in threads; the batches are those of the sampler that it wraps.

    Where the network learns on a GPU, the processor's cores are free to cut and thin the clouds beside it.
    """

    def __init__(self, sampler: Sampler, workers: int) -> None:
        """Draw up to `workers` batches ahead, one a thread."""
        self._sampler = sampler
        self._workers = workers
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="batches")
        self._drawn: dict[_Key, Future[Batch]] = {}

    def close(self) -> None:
        """Stop the threads."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    @property
    def places(self) -> tuple[Int64Array, Int64Array, Float64Array]:
        """See `Sampler.places`."""
        return self._sampler.places

    def submap(self, town: int, scan: int) -> Float32Array | None:
        """See `Sampler.submap`."""
        return self._sampler.submap(town, scan)

    def batch(self, step: int, *, pairs: int = 0, hard: HardPlaces | None = None) -> Batch:
        """See `Sampler.batch`; submits the steps after this one to the threads."""
        wanted = [(step + i, pairs, hard) for i in range(self._workers + 1)]
        for key in self._drawn.keys() - set(wanted):
            self._drawn.pop(key).cancel()
        for key in wanted:
            if key not in self._drawn:
                self._drawn[key] = self._pool.submit(self._sampler.batch, key[0], pairs=pairs, hard=hard)
        return self._drawn.pop(wanted[0]).result()
