"""Numbers of the measures of a grasp, each declared here alone; plain Python, for kernels and NumPy alike."""

import math

CONE_EDGES = 8
"""Edges of the friction pyramids of gswo, epsilon and the exact wrench space."""
INSCRIBED = math.cos(math.pi / CONE_EDGES)
"""Friction coefficient of the round cone inside such a pyramid, however it is turned, over the pyramid's own."""
BALANCED = 1.0e-4
"""Residual of gswo below which the search for less stops."""
LOAD_ARM = 0.05
"""Torques of the unresisted load are divided by this length [m]."""
LOAD_FORCE = 5.0
"""Normal forces of all contacts together that may resist a unit load."""
LOAD_DIRECTIONS = 6
"""Directions of the unit load, along and against the axes of the hand's base."""
DRIVE_STIFFNESS = 5.0
"""Position control that squeezes are meant for and simulations begin with [N m/rad]."""
SLIDING_ARM = 0.1
"""A sliding joint is as stiff as a revolute one at this arm [m]."""
LIMIT_EXCESS = 1.0e-4
"""Of joints beyond their limits, which files round [rad or m]."""
LEAST_MASS = 1.0e-3
"""Of a link that is simulated, where its URDF gives less [kg]."""
LEAST_INERTIA = 1.0e-7
"""Of a link that is simulated, about any axis, where its URDF gives less [kg m^2]."""
