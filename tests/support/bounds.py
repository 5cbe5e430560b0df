"""pytest plugin: kernels check the bounds of their arrays, and abort where one is left.

    taskset -c 0 pytest -p support.bounds tests/grasp

Slow, and on one core: threads of Warp's kernels share state in this mode.
"""

import warp as wp

wp.config.mode = "debug"
