"""Blending kernels for CUDA in float32: one block per tile, one thread per pixel, Gaussians staged in shared memory.

Warp has no shuffles and no block-wide reductions that fit an inner loop, so the bodies are native CUDA. They follow the
generic kernels of blend_cpu.py line by line in what they compute (docs/blend.md); tests hold them against each other.
"""

import functools
from types import SimpleNamespace

import warp as wp

# Products and sums are spelled with their rounding, because the compiler's choice of fused operations may differ between
# two kernels, and the backward pass must see the very alpha that the forward pass blended.
_ALPHA = """
    const int t = threadIdx.x;
    const int camera = tile / tiles;
    const int in_camera = tile - camera * tiles;
    const int x = (in_camera % columns) * SIDE + t % SIDE;
    const int y = (in_camera / columns) * SIDE + t / SIDE;
    const bool inside = x < width && y < height;
    const long long o = ((long long)camera * height + y) * width + x;
    const float px = x + 0.5f;
    const float py = y + 0.5f;
    struct Falloff {
        float dx, dy, e1, e2, g, raw, alpha;
        __device__ Falloff(float px, float py, float4 a, float4 b, float alpha_max) {
            // a = mean x, mean y, u11, u12; b = u22, opacity, ...
            dx = __fsub_rn(px, a.x);
            dy = __fsub_rn(py, a.y);
            e1 = __fmaf_rn(a.z, dx, __fmul_rn(a.w, dy));
            e2 = __fmul_rn(b.x, dy);
            g = expf(__fmul_rn(-0.5f, __fmaf_rn(e1, e1, __fmul_rn(e2, e2))));
            raw = __fmul_rn(b.y, g);
            alpha = fminf(alpha_max, raw);
        }
    };
"""

_STAGE = """
            const float4* record = reinterpret_cast<const float4*>(splats.data) + 3ll * splat_ids.data[BATCH_INDEX];
            s_a[t] = record[0];
            s_b[t] = record[1];
            s_c[t] = record[2];
"""

_FORWARD = (
    _ALPHA
    + """
    __shared__ float4 s_a[PIXELS], s_b[PIXELS], s_c[PIXELS];
    float T = 1.0f, red = 0.0f, green = 0.0f, blue = 0.0f, z = 0.0f, total = 0.0f;
    int last = 0;
    bool done = !inside;
    const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
    for (int batch = begin; batch < end; batch += PIXELS) {
        if (__syncthreads_count(done) == PIXELS)
            break;
        if (batch + t < end) {
"""
    + _STAGE.replace("BATCH_INDEX", "batch + t")
    + """
        }
        __syncthreads();
        const int count = min(PIXELS, end - batch);
        for (int j = 0; j < count && !done; ++j) {
            const float4 b = s_b[j], c = s_c[j];
            const Falloff f(px, py, s_a[j], b, alpha_max);
            if (!(f.alpha >= alpha_cut))
                continue;
            const float after = __fmul_rn(T, __fsub_rn(1.0f, f.alpha));
            done = !(after >= stop);
            if (done && !inclusive)
                break;
            const float w = f.alpha * T;
            T = after;
            red += w * b.z;
            green += w * b.w;
            blue += w * c.x;
            z += w * c.y;
            total += w;
            last = batch + j + 1;
        }
    }
    if (inside) {
        const float* background = backgrounds.data + 3 * camera;
        rgb.data[3 * o] = red + T * background[0];
        rgb.data[3 * o + 1] = green + T * background[1];
        rgb.data[3 * o + 2] = blue + T * background[2];
        alpha_out.data[o] = 1.0f - T;
        depth.data[o] = total > 0.0f ? z / total : 0.0f;
        transmittances.data[o] = T;
        weights.data[o] = total;
        ends.data[o] = last;
    }
"""
)

_BACKWARD = (
    _ALPHA
    + """
    constexpr int BATCH = 32, WARPS = PIXELS / 32, VALUES = 10;
    __shared__ float4 s_a[BATCH], s_b[BATCH], s_c[BATCH];
    __shared__ float s_sum[WARPS][BATCH][VALUES];
    __shared__ int s_last[WARPS];
    const int lane = t % 32, warp = t / 32;
    float T = 1.0f, behind = 0.0f, g0 = 0.0f, g1 = 0.0f, g2 = 0.0f, v_z = 0.0f, v_w = 0.0f;
    int last = 0;
    if (inside) {
        const float* background = backgrounds.data + 3 * camera;
        T = transmittances.data[o];
        g0 = v_rgb.data[3 * o];
        g1 = v_rgb.data[3 * o + 1];
        g2 = v_rgb.data[3 * o + 2];
        if (weights.data[o] > 0.0f) {
            v_z = v_depth.data[o] / weights.data[o];
            v_w = -v_z * depth.data[o];
        }
        v_w += v_alpha.data[o];
        behind = T * (background[0] * g0 + background[1] * g1 + background[2] * g2);
        last = ends.data[o];
    }
    const int warp_last = __reduce_max_sync(0xffffffffu, last);
    if (lane == 0)
        s_last[warp] = warp_last;
    __syncthreads();
    int tile_last = 0;
    for (int i = 0; i < WARPS; ++i)
        tile_last = max(tile_last, s_last[i]);
    const int begin = ranges.data[2 * tile];
    for (int stop = tile_last; stop > begin; stop -= BATCH) {
        const int first = max(begin, stop - BATCH);
        const int count = stop - first;
        __syncthreads();
        if (t < count) {
"""
    + _STAGE.replace("BATCH_INDEX", "first + t")
    + """
        }
        for (int i = t; i < WARPS * BATCH * VALUES; i += PIXELS)
            (&s_sum[0][0][0])[i] = 0.0f;
        __syncthreads();
        for (int j = min(count, warp_last - first) - 1; j >= 0; --j) {
            const float4 a = s_a[j], b = s_b[j], c = s_c[j];
            const Falloff f(px, py, a, b, alpha_max);
            const bool drawn = f.alpha >= alpha_cut && first + j < last;
            if (!__any_sync(0xffffffffu, drawn))
                continue;
            float v[VALUES] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
            if (drawn) {
                const float inverse = 1.0f / (1.0f - f.alpha);
                T *= inverse;
                const float w = f.alpha * T;
                const float d = b.z * g0 + b.w * g1 + c.x * g2 + c.y * v_z + v_w;
                const float v_a = f.raw <= alpha_max ? T * d - behind * inverse : 0.0f;
                behind += w * d;
                const float v_q = -f.raw * v_a;
                const float v_e1 = v_q * f.e1, v_e2 = v_q * f.e2;
                v[0] = -a.z * v_e1;
                v[1] = -(a.w * v_e1 + b.x * v_e2);
                v[2] = v_e1 * f.dx;
                v[3] = v_e1 * f.dy;
                v[4] = v_e2 * f.dy;
                v[5] = v_a * f.g;
                v[6] = w * g0;
                v[7] = w * g1;
                v[8] = w * g2;
                v[9] = w * v_z;
            }
            for (int k = 0; k < VALUES; ++k)
                for (int distance = 16; distance > 0; distance /= 2)
                    v[k] += __shfl_xor_sync(0xffffffffu, v[k], distance);
            if (lane == 0)
                for (int k = 0; k < VALUES; ++k)
                    s_sum[warp][j][k] = v[k];
        }
        __syncthreads();
        for (int i = t; i < count * VALUES; i += PIXELS) {
            float sum = 0.0f;
            for (int k = 0; k < WARPS; ++k)
                sum += s_sum[k][i / VALUES][i % VALUES];
            v_slots.data[(long long)VALUES * slots.data[first + i / VALUES] + i % VALUES] = sum;
        }
    }
"""
)

_CONTRIBUTIONS = (
    _ALPHA
    + """
    constexpr int BATCH = 32, WARPS = PIXELS / 32;
    __shared__ float4 s_a[BATCH], s_b[BATCH], s_c[BATCH];
    __shared__ float s_sum[WARPS][BATCH], s_max[WARPS][BATCH];
    const int lane = t % 32, warp = t / 32;
    const int last = inside ? ends.data[o] : 0;
    float T = 1.0f;
    const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
    for (int first = begin; first < end; first += BATCH) {
        const int count = min(BATCH, end - first);
        __syncthreads();
        if (t < count) {
"""
    + _STAGE.replace("BATCH_INDEX", "first + t")
    + """
        }
        __syncthreads();
        for (int j = 0; j < count; ++j) {
            const Falloff f(px, py, s_a[j], s_b[j], alpha_max);
            float w = 0.0f;
            if (f.alpha >= alpha_cut && first + j < last) {
                w = f.alpha * T;
                T = __fmul_rn(T, __fsub_rn(1.0f, f.alpha));
            }
            float largest = w;
            for (int distance = 16; distance > 0; distance /= 2) {
                w += __shfl_xor_sync(0xffffffffu, w, distance);
                largest = fmaxf(largest, __shfl_xor_sync(0xffffffffu, largest, distance));
            }
            if (lane == 0) {
                s_sum[warp][j] = w;
                s_max[warp][j] = largest;
            }
        }
        __syncthreads();
        if (t < count) {
            float sum = 0.0f, largest = 0.0f;
            for (int k = 0; k < WARPS; ++k) {
                sum += s_sum[k][t];
                largest = fmaxf(largest, s_max[k][t]);
            }
            const long long slot = slots.data[first + t];
            instance_weights.data[2 * slot] = sum;
            instance_weights.data[2 * slot + 1] = largest;
        }
    }
"""
)


@functools.cache
def make_kernels(tile_size: int):
    """Forward, backward and contribution kernels for one tile size; blocks of tile_size^2 threads."""
    if tile_size * tile_size % 32:
        raise ValueError(f"the CUDA kernels need tiles of whole warps (a multiple of 32 pixels), not {tile_size} px")

    def native(snippet: str) -> str:
        return snippet.replace("SIDE", str(tile_size)).replace("PIXELS", str(tile_size * tile_size))

    @wp.func_native(native(_FORWARD))
    def forward_body(
        tile: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float, stop: float, inclusive: int,
        rgb: wp.array2d(dtype=float), alpha_out: wp.array(dtype=float), depth: wp.array(dtype=float),
        transmittances: wp.array(dtype=float), weights: wp.array(dtype=float), ends: wp.array(dtype=int),
    ): ...  # fmt: skip

    @wp.func_native(native(_BACKWARD))
    def backward_body(
        tile: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float,
        transmittances: wp.array(dtype=float), weights: wp.array(dtype=float), depth: wp.array(dtype=float),
        ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=float), v_alpha: wp.array(dtype=float), v_depth: wp.array(dtype=float),
        v_slots: wp.array2d(dtype=float),
    ): ...  # fmt: skip

    @wp.func_native(native(_CONTRIBUTIONS))
    def contributions_body(
        tile: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float, ends: wp.array(dtype=int), instance_weights: wp.array2d(dtype=float),
    ): ...  # fmt: skip

    threads = wp.constant(tile_size * tile_size)
    options = {"enable_backward": False, "grid_stride": False, "module": f"warpgs.kernels.blend_cuda.{tile_size}"}

    # Signatures equal those of blend_cpu.py, so that one caller serves both; a block works on one tile.
    @wp.kernel(**options)
    def forward(
        begin: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float, whole_tiles: int, stop: float, inclusive: int,
        # outputs
        rgb: wp.array2d(dtype=float), alpha_out: wp.array(dtype=float), depth: wp.array(dtype=float),
        transmittances: wp.array(dtype=float), weights: wp.array(dtype=float), ends: wp.array(dtype=int),
    ):  # fmt: skip
        forward_body(
            wp.tid() // threads, splats, ranges, splat_ids, backgrounds, width, height, columns, tiles,
            alpha_cut, alpha_max, stop, inclusive, rgb, alpha_out, depth, transmittances, weights, ends,
        )  # fmt: skip

    @wp.kernel(**options)
    def backward(
        begin: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), backgrounds: wp.array2d(dtype=float), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float, whole_tiles: int,
        transmittances: wp.array(dtype=float), weights: wp.array(dtype=float), depth: wp.array(dtype=float),
        ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=float), v_alpha: wp.array(dtype=float), v_depth: wp.array(dtype=float),
        # outputs, zero on entry
        v_slots: wp.array2d(dtype=float),
    ):  # fmt: skip
        backward_body(
            wp.tid() // threads, splats, ranges, splat_ids, slots, backgrounds, width, height, columns, tiles,
            alpha_cut, alpha_max, transmittances, weights, depth, ends, v_rgb, v_alpha, v_depth, v_slots,
        )  # fmt: skip

    @wp.kernel(**options)
    def contributions(
        begin: int, splats: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), width: int, height: int, columns: int, tiles: int,
        alpha_cut: float, alpha_max: float, whole_tiles: int, ends: wp.array(dtype=int),
        # outputs, zero on entry
        weights: wp.array2d(dtype=float),
    ):  # fmt: skip
        contributions_body(
            wp.tid() // threads, splats, ranges, splat_ids, slots, width, height, columns, tiles,
            alpha_cut, alpha_max, ends, weights,
        )  # fmt: skip

    return SimpleNamespace(forward=forward, backward=backward, contributions=contributions)
