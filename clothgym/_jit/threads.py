"""Plain Python threads that run kernels, which do not hold the GIL.

Unlike numba's threading layers they may be used from several threads at once, survive a fork, and cost no parallel compilation.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait

_pool: ThreadPoolExecutor | None = None
_pool_size = 0
_pool_guard = threading.Lock()


def _forget_pool() -> None:
    """After a fork the child has no worker threads, and would share its parent's hold on the lock: it makes its own."""
    global _pool, _pool_size, _pool_guard
    _pool, _pool_size, _pool_guard = None, 0, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def default_threads() -> int:
    """Threads to use when the caller does not say: the processors this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _spans(count: int, parts: int) -> Iterator[tuple[int, int]]:
    for part in range(parts):
        yield count * part // parts, count * (part + 1) // parts


def run_spans(work: Callable[[int, int], None], count: int, threads: int) -> None:
    """Call ``work(first, last)`` over ``range(count)`` cut into at most ``threads`` spans, one of them on this thread.

    The spans share nothing, so the outcome does not depend on how many there are.
    """
    global _pool, _pool_size
    parts = min(threads, count)
    if parts <= 1:
        work(0, count)
        return
    with _pool_guard:
        if _pool is None or _pool_size < parts - 1:
            # an outgrown pool ends by itself when its last caller is done with it
            _pool, _pool_size = ThreadPoolExecutor(parts - 1, "clothgym"), parts - 1
        pool = _pool
    first, *rest = _spans(count, parts)
    futures = [pool.submit(work, *span) for span in rest]
    try:
        work(*first)
    finally:
        wait(futures)
    for future in futures:
        future.result()
