#include "blend_common.cu"
#include "blend_settings.cu"
// Sum and maximum of each instance's weight over the pixels of its tile; a thread block per tile.
constexpr int BATCH = 32;
__shared__ float s_sum[BLOCKS][BATCH], s_max[BLOCKS][BATCH];
__shared__ float4 s_a[BATCH], s_b[BATCH];
const int t = threadIdx.x, block = t / 32;
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int x = (in_camera % columns) * SIDE + (block % WIDE) * 8 + lane % 8;
const int y = (in_camera / columns) * SIDE + (block / WIDE) * 4 + lane / 8;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
const int last = x < width && y < height ? ends.data[((long long)camera * height + y) * width + x] : 0;
float T = 1.0f;
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
for (int first = begin; first < end; first += BATCH) {
    const int count = min(BATCH, end - first);
    __syncthreads();
    if (t < count) {
        Splat s;
        s.load(projected.data, gaussian_ids.data[first + t]);
        s.rescale();
        s_a[t] = s.a;
        s_b[t] = s.b;
    }
    __syncthreads();
    for (int j = 0; j < count; ++j) {
        const float4 a = s_a[j];
        const float dx = __fsub_rn(px, a.x), dy = __fsub_rn(py, a.y);
        const float e1 = __fmaf_rn(a.w, dy, __fmul_rn(a.z, dx)), e2 = __fmul_rn(s_b[j].x, dy);
        const float alpha = fminf(alpha_max, __fmul_rn(s_b[j].y, falloff(e1, e2)));
        float w = 0.0f;
        if (alpha >= alpha_cut && first + j < last) {
            w = alpha * T;
            T = __fmul_rn(T, __fsub_rn(1.0f, alpha));
        }
        float largest = w;
        for (int distance = 16; distance > 0; distance /= 2) {
            w += __shfl_xor_sync(ALL, w, distance);
            largest = fmaxf(largest, __shfl_xor_sync(ALL, largest, distance));
        }
        if (lane == 0) {
            s_sum[block][j] = w;
            s_max[block][j] = largest;
        }
    }
    __syncthreads();
    if (t < count) {
        float sum = 0.0f, largest = 0.0f;
        for (int k = 0; k < BLOCKS; ++k) {
            sum += s_sum[k][t];
            largest = fmaxf(largest, s_max[k][t]);
        }
        const long long slot = slots.data[first + t];
        instance_weights.data[2 * slot] = sum;
        instance_weights.data[2 * slot + 1] = largest;
    }
}
