"""CUDA functions that plain Warp cannot express: exchange between the threads of a warp or block, and 16-byte loads."""

import functools
import importlib.resources
import re
from types import SimpleNamespace

import warp as wp

BLOCK = 128
"""Threads of a block in kernels that call `compact` or `clear_rows`."""


def source(*names: str, **numbers) -> str:
    """Return the CUDA text of some files of the folder ``cuda``, joined, with names in capitals replaced by numbers."""
    folder = importlib.resources.files("warpgs.kernels") / "cuda"
    text = "".join((folder / name).read_text("utf-8") for name in names)
    for name, number in numbers.items():
        text = re.sub(rf"\b{name}\b", str(number), text)
    return text


_COMPACT = """
    constexpr int warps = BLOCK / 32;
    __shared__ int s_counts[warps], s_items[BLOCK];
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned mask = __ballot_sync(0xffffffffu, wanted != 0);
    if (lane == 0)
        s_counts[warp] = __popc(mask);
    __syncthreads();
    int before = 0, all = 0;
    for (int w = 0; w < warps; ++w) {
        before += w < warp ? s_counts[w] : 0;
        all += s_counts[w];
    }
    if (wanted)
        s_items[before + __popc(mask & ((1u << lane) - 1u))] = item;
    __syncthreads();
    return (int)threadIdx.x < all ? s_items[threadIdx.x] : -1;
"""

# The rows of a block are neighbours, so its threads clear them together, in whole 16-byte pieces where they can.
_CLEAR = """
    __shared__ int s_kept[BLOCK];
    __syncthreads();
    s_kept[threadIdx.x] = kept;
    __syncthreads();
    const int first = item - (int)threadIdx.x, rows = min(BLOCK, sh.shape[0] - first), size = 3 * sh.shape[1];
    float* from = reinterpret_cast<float*>(sh.data) + (long long)first * size;
    auto clear = [&](int pieces) {
        for (int i = threadIdx.x; i < rows * pieces; i += BLOCK)
            if (!s_kept[i / pieces])
                reinterpret_cast<float4*>(from)[i] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    };
    if (size == 48)
        clear(12);  // degree 3, the usual: to divide by what the compiler knows is much faster
    else if (size % 4 == 0)
        clear(size / 4);
    else
        for (int i = threadIdx.x; i < rows * size; i += BLOCK)
            if (!s_kept[i / size])
                from[i] = 0.0f;
"""

# Rows of K x 3 floats are a multiple of 16 bytes for K = 4 and 16. What lies past the count is loaded along, and not used:
# it may be anything, a NaN too.
_EACH = """
    if (size % 4 == 0) {
        #pragma unroll
        for (int q = 0; q < 12; ++q)
            if (4 * q < 3 * count) {
                const float4 v = reinterpret_cast<const float4*>(row)[q];
                take(4 * q, v.x);
                take(4 * q + 1, v.y);
                take(4 * q + 2, v.z);
                take(4 * q + 3, v.w);
            }
    } else {
        #pragma unroll
        for (int i = 0; i < 48; ++i)
            if (i < 3 * count)
                take(i, row[i]);
    }
"""

_COLOR = (
    """
    const int size = sh.shape[1];
    const float* row = reinterpret_cast<const float*>(sh.data) + 3ll * size * n;
    float sum[3] = {0.0f, 0.0f, 0.0f}, largest = 0.0f;
    auto take = [&](int i, float c) {
        if (i < 3 * count) {
            sum[i % 3] += weights[i / 3] * c;
            largest = fmaxf(largest, fabsf(c));
        }
    };
"""
    + _EACH
    + """    return wp::vec4(sum[0], sum[1], sum[2], largest);
"""
)

_COLOR_WEIGHTS = (
    """
    const int size = sh.shape[1] / 3;
    const float* row = sh.data + 3ll * size * n;
    wp::vec_t<16, float> w;
    auto take = [&](int i, float c) {
        if (i < 3 * count)
            w[i / 3] += c * upstream[i % 3];
    };
"""
    + _EACH
    + """    return w;
"""
)

_COLOR_BACKWARD = """
    const int size = sh.shape[1];
    const float* row = reinterpret_cast<const float*>(sh.data) + 3ll * size * n;
    float* v_row = reinterpret_cast<float*>(v_sh.data) + 3ll * size * n;
    wp::vec_t<16, float> w;
    auto give = [&](int i, float c, float& sum) {
        if (i < 3 * count) {
            w[i / 3] += c * v[i % 3];
            sum += weights[i / 3] * v[i % 3];
        }
    };
    if (size % 4 == 0) {
        // AHEAD loads before the stores that use them: the compiler cannot know that rows are apart, and would wait for each
        constexpr int AHEAD = 6;
        #pragma unroll
        for (int first = 0; first < 12; first += AHEAD) {
            float4 held[AHEAD];
            #pragma unroll
            for (int k = 0; k < AHEAD; ++k)
                if (4 * (first + k) < 3 * count)
                    held[k] = reinterpret_cast<const float4*>(row)[first + k];
            #pragma unroll
            for (int k = 0; k < AHEAD; ++k) {
                const int q = first + k;
                float4* to = reinterpret_cast<float4*>(v_row) + q;
                if (4 * q < 3 * count) {
                    const float4 c = held[k];
                    float4 sum = add ? *to : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
                    give(4 * q, c.x, sum.x);
                    give(4 * q + 1, c.y, sum.y);
                    give(4 * q + 2, c.z, sum.z);
                    give(4 * q + 3, c.w, sum.w);
                    *to = sum;
                } else if (!add && 4 * q < 3 * size)
                    *to = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
            }
        }
    } else {
        #pragma unroll
        for (int k = 0; k < 16; ++k)
            for (int channel = 0; channel < 3; ++channel)
                if (k < count) {
                    w[k] += row[3 * k + channel] * v[channel];
                    v_row[3 * k + channel] = (add ? v_row[3 * k + channel] : 0.0f) + weights[k] * v[channel];
                } else if (!add && k < size)
                    v_row[3 * k + channel] = 0.0f;
    }
    return w;
"""


@functools.cache
def make_functions():
    """Make the functions, for CUDA; those on colours are for float32."""
    vec12, vec16 = wp.types.vector(12, wp.float32), wp.types.vector(16, wp.float32)

    @wp.func_native(_COMPACT.replace("BLOCK", str(BLOCK)))
    def compact(item: int, wanted: int) -> int:
        """Return the wanted items of the block's threads, dealt to its first threads in order; -1 for the others.

        All BLOCK threads of the block must call it.
        """
        ...

    @wp.func_native("""
        float4* row = reinterpret_cast<float4*>(records.data) + 3ll * i;
        row[0] = make_float4(v[0], v[1], v[2], v[3]);
        row[1] = make_float4(v[4], v[5], v[6], v[7]);
        row[2] = make_float4(v[8], v[9], v[10], v[11]);
    """)
    def store_row(records: wp.array2d(dtype=float), i: int, v: vec12):
        """Write row i of an array of rows of 12 floats, 16-byte aligned."""
        ...

    @wp.func_native(_CLEAR.replace("BLOCK", str(BLOCK)))
    def clear_rows(item: int, kept: int, sh: wp.array2d(dtype=wp.vec3)):
        """Set the rows of the block's items to zero, except those that are kept. All BLOCK threads must call it."""
        ...

    @wp.func_native("return (int)__ballot_sync(0xffffffffu, wanted != 0);")
    def ballot(wanted: int) -> int:
        """Return a mask with bit l set where lane l wants. All 32 lanes of the warp must call this and the next three."""
        ...

    @wp.func_native("return __shfl_sync(0xffffffffu, value, lane);")
    def broadcast(value: int, lane: int) -> int:
        """Return the value that a lane of the warp holds."""
        ...

    @wp.func_native(
        """
        int sum = value;
        for (int distance = 1; distance < 32; distance *= 2) {
            const int other = __shfl_up_sync(0xffffffffu, sum, distance);
            sum += (threadIdx.x % 32 >= distance) ? other : 0;
        }
        return sum;
        """
    )
    def running_sum(value: int) -> int:
        """Return the sum over this lane of the warp and those before it."""
        ...

    @wp.func_native(
        """
        long long sum = value;
        for (int distance = 16; distance > 0; distance /= 2)
            sum += __shfl_xor_sync(0xffffffffu, sum, distance);
        return sum;
        """
    )
    def whole_sum(value: wp.int64) -> wp.int64:
        """Return the sum over all lanes of the warp."""
        ...

    @wp.func_native("return __ffs(mask) - 1;")
    def lowest(mask: int) -> int:
        """Return the position of the lowest bit set, -1 for none."""
        ...

    @wp.func_native(_COLOR)
    def color(sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: vec16) -> wp.vec4:
        """Return the weighted sum of the first ``count`` coefficients of row n, and their largest magnitude (ignoring NaN)."""
        ...

    @wp.func_native(_COLOR_BACKWARD)
    def color_backward(
        sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: vec16, v: wp.vec3, add: int,
        v_sh: wp.array2d(dtype=wp.vec3),
    ) -> vec16:  # fmt: skip
        """Return the weights' gradient of `color` for upstream ``v``; store (0 past ``count``) or add that of the row."""
        ...

    @wp.func_native(_COLOR_WEIGHTS)
    def color_weights(sh: wp.array2d(dtype=float), n: int, count: int, upstream: wp.vec3) -> vec16:
        """Return the weights' gradient alone, of flat rows: sh [N, 3 K]."""
        ...

    return SimpleNamespace(
        compact=compact, store_row=store_row, clear_rows=clear_rows, ballot=ballot, broadcast=broadcast,
        running_sum=running_sum, whole_sum=whole_sum, lowest=lowest, color=color, color_backward=color_backward,
        color_weights=color_weights,
    )  # fmt: skip
