"""Work that is shared out to processes."""

from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

from tqdm import tqdm


def each(work: Callable[..., Any], jobs: Iterable[tuple], what: str) -> list[Any]:
    """The results of jobs in their order, two at a time."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        waiting = [pool.submit(work, *job) for job in jobs]
        return [job.result() for job in tqdm(waiting, what, unit="job", disable=None)]
