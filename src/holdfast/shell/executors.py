"""Who computes the blocks of a campaign: threads here, or the workers of a Dask cluster."""

import contextlib
import functools
import json
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

from holdfast.campaign.blocks import Block, block
from holdfast.shell import runtime
from holdfast.shell.errors import InputError
from holdfast.shell.points import Prepared, prepare
from holdfast.shell.study import study_of

RETRIES = 3
"""How often a block is given to another worker after one died with it."""
TIMEOUT_S = 20.0
"""Seconds to wait for a scheduler."""


class Task(NamedTuple):
    """Blocks ``first`` to ``first + blocks - 1`` of point number ``point``."""

    point: int
    first: int
    blocks: int


def computed(prepared: Prepared, task: Task) -> list[Block]:
    """The blocks of a task."""
    case, key = prepared.cases[task.point], prepared.keys[task.point]
    runs = prepared.study.settings.runs
    return [block(case, key, task.first + i, runs) for i in range(task.blocks)]


class Local:
    """Threads of this process: compiled code runs without Python's lock."""

    def __init__(self, prepared: Prepared, workers: int):
        self.prepared, self.workers = prepared, workers

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, list[Block]]]:
        """Each task with its blocks as it is finished; stopping leaves what has not begun."""
        pool = ThreadPoolExecutor(self.workers)
        try:
            pending: dict[Future, Task] = {}
            waiting = iter(tasks)
            while True:
                # no more at a time than there are threads, so that little is lost on a stop
                for task in _taken(waiting, self.workers - len(pending)):
                    pending[pool.submit(computed, self.prepared, task)] = task
                if not pending:
                    return
                for future in wait(pending, return_when=FIRST_COMPLETED).done:
                    yield pending.pop(future), future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _taken(tasks: Iterator[Task], count: int) -> Iterator[Task]:
    for _ in range(count):
        task = next(tasks, None)
        if task is None:
            return
        yield task


class Cluster:
    """The workers of a Dask cluster. Each builds the study for itself from its text, with the
    calibrations made here; what is sent back is arrays.
    """

    def __init__(self, prepared: Prepared, address: str, allow_python: bool):
        try:
            import distributed
        except ImportError:
            raise InputError("--scheduler", "", "no Dask", 'pip install "holdfast[dask]"') from None
        self._distributed: Any = distributed
        try:
            self.client: Any = distributed.Client(address, timeout=TIMEOUT_S)
            threads = self.client.nthreads()
        except (OSError, ValueError, TypeError) as error:
            text = str(error) or type(error).__name__
            raise InputError(
                "--scheduler", "", f"{address}: {text}", "the address of a running scheduler"
            ) from None
        if not threads:
            self.client.close()
            raise InputError("--scheduler", "", f"{address} without workers", "some workers")
        self.workers = sum(threads.values())
        self._payload = _packed(prepared, allow_python)

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, list[Block]]]:
        """Each task with its blocks as it is finished; what a dead worker had goes to another."""
        client, dask = self.client, self._distributed
        # the text goes with every task: what is scattered dies with the workers that hold it
        futures = {
            client.submit(on_worker, self._payload, tuple(task), pure=False, retries=RETRIES): task
            for task in tasks
        }
        try:
            for future, found in dask.as_completed(futures, with_results=True):
                if isinstance(found, BaseException):  # what was cancelled comes as a result
                    raise found
                yield futures[future], found
        except (dask.CancelledError, dask.client.FutureCancelledError, OSError):
            raise InputError("--scheduler", "", "a scheduler that went away",
                             "one that stays; finished blocks are kept") from None  # fmt: skip
        except dask.KilledWorker:
            raise InputError(
                "--scheduler", "", f"a block that {RETRIES + 1} workers died with",
                "workers with more memory; finished blocks are kept",
            ) from None  # fmt: skip
        finally:
            with contextlib.suppress(Exception):
                client.cancel(list(futures))
                client.close(timeout=TIMEOUT_S)


def _packed(prepared: Prepared, allow_python: bool) -> str:
    study = prepared.study
    return json.dumps({
        "study": {
            "path": os.path.abspath(study.path),
            "source": study.source,
            "scenario_path": os.path.abspath(study.scenario_path),
            "scenario_source": study.scenario_source,
        },
        "values": prepared.values,
        "allow_python": allow_python,
    })  # fmt: skip


def on_worker(payload: str, task: tuple[int, int, int]) -> list[Block]:
    """The blocks of a task, in a worker process."""
    return computed(_unpacked(payload), Task(*task))


@functools.lru_cache(maxsize=4)
def _unpacked(payload: str) -> Prepared:
    runtime.configure()
    found: Any = json.loads(payload)
    return prepare(study_of(**found["study"]), found["allow_python"], found["values"])
