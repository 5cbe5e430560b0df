"""What is made once and kept in memory."""

import threading
from collections.abc import Callable, Hashable
from concurrent.futures import Executor
from typing import Any


class Keeper:
    """The latest of each kind, made once by whichever thread comes first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._made: dict[str, tuple[Hashable, Any]] = {}

    def get(self, kind: str, key: Hashable, make: Callable[[], Any]) -> Any:
        """The object of a kind that was made for a key."""
        with self._lock:
            if self._made.get(kind, (None,))[0] != key:
                self._made.pop(kind, None)  # not both at a time
                self._made[kind] = key, make()
            return self._made[kind][1]

    def forget(self, *kinds: str) -> None:
        """Forget some kinds; pools end."""
        with self._lock:
            for kind in kinds:
                _, made = self._made.pop(kind, (None, None))
                if isinstance(made, Executor):
                    made.shutdown(cancel_futures=True)

    def close(self) -> None:
        """Forget everything; pools end."""
        self.forget(*self._made)
