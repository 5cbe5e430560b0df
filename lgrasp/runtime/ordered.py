"""Work on several threads whose results come in order."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def in_order(
    work: Callable[[T], R], items: Iterable[T | None], at_once: int, *, ahead: int = 0
) -> Generator[tuple[T, R]]:
    """Each item with what came of it, in the order of the items; one at a time is worked on by this thread itself.

    Closing the generator (or an error in an item) drops the items not started and waits for the others.

    Args:
        items: taken as there is room for them; None: there is none until the next result is out.
        ahead: items that wait for a free thread.
    """
    rest = iter(items)
    if at_once == 1 and not ahead:
        yield from ((item, work(item)) for item in rest if item is not None)
        return
    with ThreadPoolExecutor(at_once) as pool:
        waiting: deque[tuple[T, Future[R]]] = deque()
        try:
            while True:
                while len(waiting) < at_once + ahead and (item := next(rest, None)) is not None:
                    waiting.append((item, pool.submit(work, item)))
                if not waiting:
                    return
                item, future = waiting.popleft()
                yield item, future.result()
        finally:
            for _, future in waiting:
                future.cancel()
