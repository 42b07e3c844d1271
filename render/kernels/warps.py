"""What the 32 threads of a warp do together on CUDA, which Warp's own language has no words for: native snippets, a few lines each.

On the CPU a warp is one thread, alone in its block, so that the kernels that use these run there as well, with tiles of one pixel.
"""

from functools import cache

import warp as wp

from render.kernels.types import RECORD

LANES = 32
"""Threads of a warp."""
WARPS = 8
"""Warps of a block of 16 x 16 pixels."""
SUMS = 16
"""Numbers that a warp sums up at once."""

vec_record = wp.types.vector(length=RECORD, dtype=wp.float32)
vec_sums = wp.types.vector(length=SUMS, dtype=wp.float32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (int)__ballot_sync(0xffffffffu, yes);
#else
return yes ? 1 : 0;
#endif
""")
def ballot(yes: bool) -> int:
    """Of each of the warp's threads whether it said yes, as bits. All of them must call it, as all that follow."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __shfl_sync(0xffffffffu, value, lane);
#else
return value;
#endif
""")
def of_lane(value: int, lane: int) -> int:
    """What the warp's thread number `lane` passes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __reduce_max_sync(0xffffffffu, value);
#else
return value;
#endif
""")
def largest_of_warp(value: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ffs(bits) - 1;
#else
return __builtin_ffs(bits) - 1;
#endif
""")
def lowest_bit(bits: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return 31 - __clz(bits);
#else
return 31 - __builtin_clz(bits);
#endif
""")
def highest_bit(bits: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def wait_for_block():
    """Until all threads of the block are here, and what they wrote can be read."""
    ...


@wp.func_native("""
wp::vec_t<16, wp::float32> r;
#if defined(__CUDA_ARCH__)
const float4* row = reinterpret_cast<const float4*>(records.data) + 4 * (long long)i;
#pragma unroll
for (int k = 0; k < 4; ++k) {
    const float4 four = __ldg(row + k);
    r[4 * k] = four.x;
    r[4 * k + 1] = four.y;
    r[4 * k + 2] = four.z;
    r[4 * k + 3] = four.w;
}
#else
for (int k = 0; k < 16; ++k) r[k] = records.data[16 * (long long)i + k];
#endif
return r;
""")
def record_of(records: wp.array2d[float], i: int) -> vec_record:
    """Row i, contiguous, by four loads instead of sixteen."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const int lane = threadIdx.x & 31;
float v[16];
#pragma unroll
for (int k = 0; k < 16; ++k) v[k] = values[k];
// written out four times: a loop over `half` would keep v in memory, where it can be indexed
#define HALVE(half) {                                                                 \\
    const bool upper = lane & half;                                                   \\
    _Pragma("unroll")                                                                 \\
    for (int k = 0; k < half; ++k) {                                                  \\
        const float sent = upper ? v[k] : v[k + half];                                \\
        const float kept = upper ? v[k + half] : v[k];                                \\
        v[k] = kept + __shfl_xor_sync(0xffffffffu, sent, half);                       \\
    }                                                                                 \\
}
HALVE(8)
HALVE(4)
HALVE(2)
HALVE(1)
#undef HALVE
return v[0] + __shfl_xor_sync(0xffffffffu, v[0], 16);
#else
return values[0];
#endif
""")
def sum_of_warp(values: vec_sums) -> float:
    """The number of the thread's lane modulo SUMS, summed over the warp; of one thread, the first. The numbers halve while the threads that
    sum each double: 16 exchanges for 16 numbers, where one number alone takes 5."""
    ...


CELL = """
#if defined(__CUDA_ARCH__)
__shared__ TYPE cells[COUNT];
#else
static TYPE cells[COUNT];
#endif
if (write) cells[at] = value;
return cells[at];
"""


@cache
def shared_floats(count: int):
    """`cell(at, value, write)`: a float of the `count` that a block's threads share; returns what stands there then."""
    snippet = CELL.replace("TYPE", "float").replace("COUNT", str(count))

    @wp.func_native(snippet)
    def float_cell(at: int, value: float, write: bool) -> float: ...

    return float_cell


@cache
def shared_ints(count: int):
    """The same for ints."""
    snippet = CELL.replace("TYPE", "int").replace("COUNT", str(count))

    @wp.func_native(snippet)
    def int_cell(at: int, value: int, write: bool) -> int: ...

    return int_cell
