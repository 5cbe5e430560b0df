"""Functions and kernels with loops over ``wp.static``, which Warp unrolls.

What Warp reads in such a loop while it compiles becomes a part of the function's hash, by which it knows compiled
modules: the hash would depend on what the process had compiled before, and modules would be compiled again in process
after process.
"""

from typing import Any


def unrolled(made: Any) -> Any:
    """Known by its source and constants alone, like any other: for a function or kernel whose ``wp.static`` reads
    nothing but these and the variables of loops."""
    kind = type(made.adj)
    made.adj.__class__ = type(kind.__name__, (kind,), {"deferred_static_expressions": _NOTHING})
    made.module.has_unresolved_static_expressions = False
    return made


_NOTHING = property(lambda adj: [], lambda adj, found: None)
