"""What code loads in an interpreter of its own."""

import ast
import subprocess
import sys
from collections.abc import Iterable

SLOW = (
    "PIL",
    "coacd",
    "matplotlib",
    "mujoco",
    "networkx",
    "pytorch_kinematics",
    "scipy",
    "torch",
    "trimesh",
    "yourdfpy",
)
"""What only some commands need."""
HEAVY = (*SLOW, "h5py", "numpy", "warp")
"""What no command needs to list, to help and to refuse wrong words."""


def loaded(code: str, names: Iterable[str] = HEAVY) -> list[str]:
    """Those of the names that a module's name begins with, of all that are loaded when the code has run."""
    found = f"[name for name in {tuple(names)} if any(module.startswith(name) for module in sys.modules)]"
    script = f"import sys\ntry:\n    exec({code!r})\nfinally:\n    print({found})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done
    return ast.literal_eval(done.stdout.splitlines()[-1])
