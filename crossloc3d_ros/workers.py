"""Executors: this process, several processes of this machine, or a Dask cluster."""

from __future__ import annotations

import functools
import itertools
import multiprocessing
import os
import pickle
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol, TypeVar

from crossloc3d_ros.errors import ConfigError, CrossLocError
from crossloc3d_ros.types import DescriptorEncoder

EncoderLoader = Callable[[], DescriptorEncoder]
"""Loads the encoder where it is needed; a picklable function, such as `functools.partial(load_encoder, path)`."""

Advance = Callable[[int], None]
Task = TypeVar("Task")
Result = TypeVar("Result")

_ANSWER_WITHIN_S = 10
_NO_ENCODER = "these workers were opened without an encoder"
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "RAYON_NUM_THREADS")


class Workers(Protocol):
    """Does tasks somewhere, in any order."""

    shared_threads: bool
    """Whether a task may use every core of its machine."""

    def run(
        self, function: Callable[[Task, Advance | None], Result], tasks: Iterable[tuple[Task, int]], advance: Advance
    ) -> Iterator[Result]:
        """Yield the results as they come; tasks come with their sizes, which `advance` counts.

        The tasks are taken from the iterable as they are needed: a state has a million tiles.
        """

    def run_encoding(
        self,
        function: Callable[[Task, DescriptorEncoder, Advance | None], Result],
        tasks: Iterable[tuple[Task, int]],
        advance: Advance,
    ) -> Iterator[Result]:
        """Do the same with a function that needs the encoder."""


class LocalWorker:
    """Works in this process, one task after the other."""

    shared_threads = True

    def __init__(self, encoder: DescriptorEncoder | None) -> None:
        self._encoder = encoder

    def run(
        self, function: Callable[[Task, Advance | None], Result], tasks: Iterable[tuple[Task, int]], advance: Advance
    ) -> Iterator[Result]:
        """Yield the results in the order of the tasks."""
        for task, _ in tasks:
            yield function(task, advance)

    def run_encoding(
        self,
        function: Callable[[Task, DescriptorEncoder, Advance | None], Result],
        tasks: Iterable[tuple[Task, int]],
        advance: Advance,
    ) -> Iterator[Result]:
        """Yield the results in the order of the tasks."""
        if self._encoder is None:
            raise ConfigError(_NO_ENCODER)
        for task, _ in tasks:
            yield function(task, self._encoder, advance)


class RemoteWorkers(ABC):
    """Works in other processes, each on one core."""

    shared_threads = False

    def __init__(self, loader: EncoderLoader | None) -> None:
        try:
            self._pickled_loader = pickle.dumps(loader)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise ConfigError(
                "other processes cannot be given this encoder; hand over a function that loads it, such as "
                "functools.partial(load_encoder, path)"
            ) from error

    def run(
        self, function: Callable[[Task, Advance | None], Result], tasks: Iterable[tuple[Task, int]], advance: Advance
    ) -> Iterator[Result]:
        """Yield the results as they come."""
        return self._run(functools.partial(_call, function), tasks, advance)

    def run_encoding(
        self,
        function: Callable[[Task, DescriptorEncoder, Advance | None], Result],
        tasks: Iterable[tuple[Task, int]],
        advance: Advance,
    ) -> Iterator[Result]:
        """Yield the results as they come."""
        return self._run(functools.partial(_call_encoding, function, self._pickled_loader), tasks, advance)

    def _run(self, function: Callable[[Any], Any], tasks: Iterable[tuple[Any, int]], advance: Advance) -> Iterator[Any]:
        sizes: dict[int, int] = {}

        def numbered() -> Iterator[tuple[int, Any]]:
            for index, (task, size) in enumerate(tasks):
                sizes[index] = size
                yield index, task

        for index, result in self._map(function, numbered()):
            yield result
            advance(sizes.pop(index))

    @abstractmethod
    def _map(self, function: Callable[[Any], Any], tasks: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        """Yield (number of the task, result) as the results come."""


class ProcessWorkers(RemoteWorkers):
    """Works in several processes of this machine."""

    def __init__(self, executor: ProcessPoolExecutor, workers: int, loader: EncoderLoader | None) -> None:
        super().__init__(loader)
        self._executor = executor
        self._in_flight = 2 * workers

    def _map(self, function: Callable[[Any], Any], tasks: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        numbers: dict[Future[Any], int] = {}
        try:
            while True:
                for number, task in itertools.islice(tasks, self._in_flight - len(numbers)):
                    numbers[self._executor.submit(function, task)] = number
                if not numbers:
                    return
                finished, _ = wait(numbers, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield numbers.pop(future), future.result()
        except BrokenProcessPool as error:
            raise CrossLocError(
                "a worker process died, probably for lack of memory; what is done is kept: give the same command "
                "again, with fewer --workers or smaller tiles"
            ) from error


class DaskWorkers(RemoteWorkers):
    """Works on the machines of a Dask cluster that see the same folders as this one."""

    def __init__(self, client: Any, loader: EncoderLoader | None) -> None:
        super().__init__(loader)
        self._client = client

    def _map(self, function: Callable[[Any], Any], tasks: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        from distributed import as_completed

        in_flight = 2 * max(1, sum(self._client.nthreads().values()))
        numbers: dict[str, int] = {}

        def submit(count: int) -> list[Any]:
            futures = []
            for number, task in itertools.islice(tasks, count):
                future = self._client.submit(function, task, pure=False)
                numbers[future.key] = number
                futures.append(future)
            return futures

        running = as_completed(submit(in_flight), loop=self._client.loop)
        for future in running:
            yield numbers.pop(future.key), future.result()
            for following in submit(1):
                running.add(following)


@contextmanager
def open_workers(
    loader: EncoderLoader | None,
    encoder: DescriptorEncoder | None,
    workers: int,
    scheduler: str | None,
    folder: Path,
) -> Iterator[Workers]:
    """Give the requested workers; `folder` is where the work lies, and all of them must see it.

    Without loader and encoder they do tasks that need none. Raises ConfigError where the cluster does not respond or
    does not see the folder.
    """
    if scheduler is not None:
        with _dask_client(scheduler, folder) as client:
            yield DaskWorkers(client, loader)
    elif workers > 1:
        with _process_pool(workers) as executor:
            yield ProcessWorkers(executor, workers, loader)
    else:
        yield LocalWorker(encoder)


@contextmanager
def _process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    context = multiprocessing.get_context("spawn")  # a forked torch or numba may hang on a lock that a thread held
    receiver, sender = context.Pipe(duplex=False)
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))  # read by the libraries when a worker imports them
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(receiver,))
    others = set(multiprocessing.active_children())
    try:
        _start_all(executor, workers)
        yield executor
        executor.shutdown()
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()  # whatever still runs was not wanted any more; pieces of work are whole or not there
        executor.shutdown(cancel_futures=True)
        sender.close()
        receiver.close()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_all(executor: ProcessPoolExecutor, workers: int) -> None:
    """Start the processes with Ctrl-C blocked, which they inherit: it is the parent's business from the beginning."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        for _ in range(workers):
            executor.submit(_nothing)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _nothing() -> None:
    """Make the executor start a process."""


def _start_worker(parent: Connection) -> None:
    """End when the parent dies in whatever way, which closes its end of the pipe."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def watch() -> None:
        try:
            parent.recv()
        except (EOFError, OSError):
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask_client(scheduler: str, folder: Path) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigError("--scheduler needs Dask: pip install distributed") from error
    try:
        client = Client(scheduler, timeout=_ANSWER_WITHIN_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(f"no Dask scheduler responds at {scheduler}: {error}") from error
    try:
        seen = client.run(folder.is_dir)
        if not seen:
            raise ConfigError(f"the Dask scheduler at {scheduler} has no workers")
        blind = [address for address, sees in seen.items() if not sees]
        if blind:
            raise ConfigError(
                f"the Dask workers {', '.join(sorted(blind))} do not see {folder}: inputs and output must lie on a "
                "disk that every machine shares, under the same path"
            )
        yield client
    finally:
        client.close()


def _call(function: Callable[[Any, None], Any], task: Any) -> Any:
    return function(task, None)


def _call_encoding(function: Callable[[Any, DescriptorEncoder, None], Any], pickled_loader: bytes, task: Any) -> Any:
    return function(task, _load_once(pickled_loader), None)


_loading = threading.Lock()


def _load_once(pickled_loader: bytes) -> DescriptorEncoder:
    with _loading:  # a Dask worker has threads
        return _load(pickled_loader)


@functools.lru_cache(maxsize=1)
def _load(pickled_loader: bytes) -> DescriptorEncoder:
    loader: EncoderLoader | None = pickle.loads(pickled_loader)
    if loader is None:
        raise ConfigError(_NO_ENCODER)
    return loader()
