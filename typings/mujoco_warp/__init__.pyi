# Kernel code is Python in syntax only: Warp compiles it by its own type rules. To pyright everything from warp is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
