"""Sizes that the kernels are compiled for; plain Python, for kernels and NumPy alike."""

MAX_JOINTS = 16
"""Most movable joints (mimic joints included) in one dependency group."""
MAX_BODIES = 40
"""Most movable joints in a hand."""
MAX_DOFS = 8
"""Most actuated joints in one dependency group."""
MAX_GROUPS = 6
"""Most dependency groups of a hand."""
DOF_SIZES = (4, MAX_DOFS)
"""Most actuated joints of a group that a kernel may be compiled for."""
MAX_CONTACTS = MAX_GROUPS + 1
"""Most contacts of a grasp: one of each finger, and the palm's."""
MAX_KINDS = 16
"""Most numbers of finger contacts that the search draws from."""
