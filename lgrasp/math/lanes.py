"""Lanes: threads that work on one thing together, one warp of a GPU, or the one thread of a CPU.

Each lane of ``lanes`` takes the items ``lane``, ``lane + lanes``, ... of a loop. All run through the same branches and
loops about the functions here; a block has whole warps only.
"""

import warp as wp

LANES = 32
"""On a GPU."""


def lanes_of(device: str) -> int:
    """How many a device gives to one thing."""
    return LANES if wp.get_device(device).is_cuda else 1


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
""")
def meet():
    """Wait until every lane is here; each then sees what the others wrote."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = 16; k > 0; k >>= 1) x += __shfl_xor_sync(0xffffffffu, x, k);
#endif
return x;
""")
def lanes_sum(x: wp.float32) -> wp.float32:
    """Sum over the lanes, the same in all."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = n >> 1; k > 0; k >>= 1) x += __shfl_xor_sync(0xffffffffu, x, k);
#endif
return x;
""")
def neighbours_sum(x: wp.float32, n: wp.int32) -> wp.float32:
    """Sum over n lanes side by side (a power of 2; the first of them begin at multiples of n), the same in these."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = 16; k > 0; k >>= 1) x = max(x, __shfl_xor_sync(0xffffffffu, x, k));
#endif
return x;
""")
def lanes_max(x: wp.float32) -> wp.float32:
    """Greatest of the lanes' numbers, in all."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
for (int k = 16; k > 0; k >>= 1) x = min(x, __shfl_xor_sync(0xffffffffu, x, k));
#endif
return x;
""")
def lanes_least(x: wp.int32) -> wp.int32:
    """Least of the lanes' numbers, in all."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __popc(__ballot_sync(0xffffffffu, x != 0));
#else
return x != 0;
#endif
""")
def lanes_count(x: wp.int32) -> wp.int32:
    """Lanes whose number is not 0."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __popc(__ballot_sync(0xffffffffu, x != 0) & ((1u << (threadIdx.x & 31u)) - 1u));
#else
return 0;
#endif
""")
def lanes_before(x: wp.int32) -> wp.int32:
    """Lanes before this one whose number is not 0."""
