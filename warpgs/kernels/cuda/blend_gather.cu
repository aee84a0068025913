#include "blend_common.cu"
// Gradient of one projected Gaussian from the sums of its instances. Their slots are neighbours: a thread sums a short list, the warp
// shares a long one. The factors common to all pixels are applied here, once.
constexpr int SHORT = 32;
constexpr bool with_depth = WITH_DEPTH, atomic = ATOMIC, absgrad = ABSGRAD;
constexpr int values = 6 + CHANNELS + (absgrad ? 3 : with_depth);
const bool valid = i < counts.shape[0];
const bool seen = valid && counts.data[i] > 0;
const int count = atomic ? (int)seen : seen ? counts.data[i] : 0;
const long long start = count == 0 ? 0 : atomic ? i : starts.data[i];  // atomic: the row of the Gaussian is its one slot
float v[STRIDE] = {};
if (count <= SHORT)
    for (int s = 0; s < count; ++s) {
        const float4* row = reinterpret_cast<const float4*>(v_slots.data + STRIDE * (start + s));
        #pragma unroll
        for (int q = 0; q < QUADS - 1; ++q) {
            const float4 p = row[q];
            v[4 * q] += p.x; v[4 * q + 1] += p.y; v[4 * q + 2] += p.z; v[4 * q + 3] += p.w;
        }
        const float* last = reinterpret_cast<const float*>(row + QUADS - 1);
        v[5 + CHANNELS] += last[0];
        if (with_depth)
            v[6 + CHANNELS] += last[1];
        if (absgrad) {
            v[7 + CHANNELS] += last[2];
            v[8 + CHANNELS] += last[3];
        }
    }
unsigned heavy = __ballot_sync(ALL, count > SHORT);
while (heavy) {
    const int owner = __ffs(heavy) - 1;
    heavy &= heavy - 1u;
    const int many = __shfl_sync(ALL, count, owner);
    const long long from = __shfl_sync(ALL, start, owner);
    float u[STRIDE] = {};
    for (int s = lane; s < many; s += 32)
        #pragma unroll
        for (int k = 0; k < values; ++k)
            u[k] += v_slots.data[STRIDE * (from + s) + k];
    #pragma unroll
    for (int k = 0; k < values; ++k) {
        for (int distance = 16; distance > 0; distance /= 2)
            u[k] += __shfl_xor_sync(ALL, u[k], distance);
        if (lane == owner)
            v[k] = u[k];
    }
}
if (valid) {
    float4* row = reinterpret_cast<float4*>(v_projected.data) + (long long)QUADS * i;
    if (count > 0) {
        const float4* values_of = reinterpret_cast<const float4*>(projected.data) + (long long)QUADS * i;
        const float4 a = values_of[0], b = values_of[1];
        constexpr float back = 1.0f / SCALE;
        const float s1 = back * v[0], s2 = back * v[1];
        if (absgrad) {  // sums of |e1 ...| and of |U^T e ...|, both in the units of the scaled factor
            v[7 + CHANNELS] *= back * fabsf(a.z);
            v[8 + CHANNELS] *= back * back;
        }
        row[0] = make_float4(-a.z * s1, -(a.w * s1 + b.x * s2), back * v[2], back * v[3]);
        row[1] = make_float4(back * v[4], v[5], v[6], v[7]);
        #pragma unroll
        for (int q = 2; q < QUADS; ++q)
            row[q] = make_float4(v[4 * q], v[4 * q + 1], v[4 * q + 2], v[4 * q + 3]);
    } else
        #pragma unroll
        for (int q = 0; q < QUADS; ++q)
            row[q] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
}
