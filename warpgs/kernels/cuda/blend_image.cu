#include "blend_common.cu"
#include "blend_settings.cu"
// An image without gradients, from the records of blend_pack.cu. Alphas have the bits of blend_forward.cu; a pixel is finished at
// a transmittance that follows from the largest error (docs/numerics.md).
constexpr int AHEAD = 4;  // as in blend_forward.cu
__shared__ float4 s_a[WARPS][32 + AHEAD], s_b[WARPS][32 + AHEAD];
__shared__ float2 s_c[WARPS][32 + AHEAD];
#include "blend_place.cu"
const float* background = backgrounds.data + 3 * camera;
const float most = __int_as_float(largest.data[0]);
float behind[3], spread = 0.0f;  // middle of all colours that a pixel may have behind, and the largest distance from it
#pragma unroll
for (int c = 0; c < 3; ++c) {
    const float low = fminf(0.0f, background[c]), high = fmaxf(most, background[c]);
    behind[c] = 0.5f * (low + high);
    spread = fmaxf(spread, 0.5f * (high - low));
}
const float rounded = (most <= LARGEST_HALF ? rounding : 1.0f) * most + 1e-6f * spread + 3e-8f;
const float enough = fmaxf(stop, fminf((max_error * 0.999f - rounded) / spread, LARGEST_STOP));
if (in_camera == 0 && part == 0 && lane == 0)
    bounds.data[camera] = (rounded + enough * spread) * 1.001f;
const float log_cut = __log2f(alpha_cut);
float T[PER], color[PER][3] = {}, z[PER] = {};
#pragma unroll
for (int k = 0; k < PER; ++k)
    T[k] = x < width && y + 4 * k < height ? 1.0f : 0.0f;
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
const float4* rows = reinterpret_cast<const float4*>(records.data);
int i = begin + lane;
Splat s;
auto load = [&](int id) {
    s.a = rows[2ll * id];
    s.b = rows[2ll * id + 1];
};
auto decoded = [](unsigned bits) {
    float v;
    asm("cvt.f32.f16 %0, %1;" : "=f"(v) : "h"((unsigned short)bits));
    return v;
};
if (i < end)
    load(ids.data[i]);
int next_id = i + 32 < end ? ids.data[i + 32] : 0;  // known a batch before it is loaded
bool open = true;
for (int batch = begin; batch < end && open; batch += 32) {
    const float limit = (__log2f(s.b.y) - log_cut) * 1.00001f + 1e-4f;
    const bool touched = i < end && s.touches((float)(origin_x + left), (float)(origin_y + top), limit, 4 * PER - 0.5f);
    const unsigned mask = __ballot_sync(ALL, touched);
    const int slot = __popc(mask & ((1u << lane) - 1u)), count = __popc(mask);
    __syncwarp();
    if (touched) {
        const unsigned low = __float_as_uint(s.b.z), high = __float_as_uint(s.b.w);
        s_a[warp][slot] = s.a;
        s_b[warp][slot] = make_float4(s.b.x, s.b.y, decoded(low), decoded(low >> 16));
        s_c[warp][slot] = make_float2(decoded(high), __uint_as_float(high & 0xffff0000u));
    }
    if (lane < AHEAD)  // the entries that fill up the last group have opacity 0
        s_a[warp][count + lane] = s_b[warp][count + lane] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    __syncwarp();
    i += 32;
    if (i < end)
        load(next_id);  // under way while this batch is blended
    if (i + 32 < end)
        next_id = ids.data[i + 32];
    for (int j = 0; j < count && open; j += AHEAD) {
        float alpha[AHEAD][PER];
        #pragma unroll
        for (int ahead = 0; ahead < AHEAD; ++ahead) {
            const float4 a = s_a[warp][j + ahead];
            const float2 b = *reinterpret_cast<const float2*>(&s_b[warp][j + ahead]);
            const float dx = __fsub_rn(px, a.x), p = __fmul_rn(a.z, dx);
            #pragma unroll
            for (int k = 0; k < PER; ++k) {
                const float dy = __fsub_rn(py + 4 * k, a.y);
                const float e1 = __fmaf_rn(a.w, dy, p), e2 = __fmul_rn(b.x, dy);
                alpha[ahead][k] = fminf(alpha_max, __fmul_rn(b.y, falloff(e1, e2)));
            }
        }
        #pragma unroll
        for (int ahead = 0; ahead < AHEAD; ++ahead) {
            const float4 b = s_b[warp][j + ahead];
            const float2 c = s_c[warp][j + ahead];
            #pragma unroll
            for (int k = 0; k < PER; ++k) {
                if (alpha[ahead][k] >= alpha_cut) {
                    const float w = alpha[ahead][k] * T[k];
                    T[k] = __fmaf_rn(-alpha[ahead][k], T[k], T[k]);
                    color[k][0] += w * b.z;
                    color[k][1] += w * b.w;
                    color[k][2] += w * c.x;
                    z[k] += w * c.y;
                }
            }
        }
        bool finished = true;
        #pragma unroll
        for (int k = 0; k < PER; ++k)
            finished = finished && T[k] < enough;
        open = !__all_sync(ALL, finished);
    }
}
#pragma unroll
for (int k = 0; k < PER; ++k) {
    if (x < width && y + 4 * k < height) {
        const long long o = ((long long)camera * height + y + 4 * k) * width + x;
        const float total = 1.0f - T[k];
        #pragma unroll
        for (int c = 0; c < 3; ++c)
            rgb.data[3 * o + c] = color[k][c] + T[k] * (T[k] < enough ? behind[c] : background[c]);
        alpha_out.data[o] = total;
        depth.data[o] = total >= SMALLEST_WEIGHT ? z[k] / total : 0.0f;
    }
}
