"""Spread a compiled loop over the cores with plain Python threads.

The loops release the interpreter lock, so threads are enough: they work inside any process or thread that
calls us, where an OpenMP pool would not survive a fork and numba's own pool refuses two callers at once.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

#: Environment variable that limits the threads of one process (a campaign's workers set it to 1).
THREADS_VARIABLE = "UMOV_THREADS"


def thread_count() -> int:
    """Threads to use: `UMOV_THREADS` where set, else the cores that this process may use."""
    text = os.environ.get(THREADS_VARIABLE, "")
    if text:
        if not text.isdecimal() or int(text) < 1:
            raise ValueError(
                f"{THREADS_VARIABLE}={text!r} is not a number of threads; set it to 1 or more, or unset it"
            )
        return int(text)
    # Linux alone tells what this process may use.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def for_ranges(items: int, loop: Callable[[int, int], object], align: int = 256, smallest: int = 4096) -> None:
    """Call `loop(start, stop)` over ranges that cover `items`, one range a thread.

    Range borders are multiples of `align`; below `smallest` items everything runs in the calling thread.
    The first error of any thread is raised.
    """
    threads = min(thread_count(), -(-items // smallest)) if items > smallest else 1
    if threads <= 1:
        loop(0, items)
        return
    step = -(-items // threads // align) * align
    ranges = [(start, min(start + step, items)) for start in range(0, items, step)]
    with ThreadPoolExecutor(len(ranges) - 1) as pool:
        others = [pool.submit(loop, start, stop) for start, stop in ranges[1:]]
        loop(*ranges[0])
        for future in others:
            future.result()
