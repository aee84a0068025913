#include "blend_common.cu"
#include "blend_settings.cu"
// Depth of the Gaussian that leaves a pixel half of its light or less; a thread block per tile, a thread per pixel.
constexpr int BATCH = 32;
__shared__ float4 s_a[BATCH], s_b[BATCH];
__shared__ float s_z[BATCH];
const int t = threadIdx.x, block = t / 32;
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int x = (in_camera % columns) * SIDE + (block % WIDE) * 8 + lane % 8;
const int y = (in_camera / columns) * SIDE + (block / WIDE) * 4 + lane / 8;
const bool inside = x < width && y < height;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
float T = 1.0f, found = 0.0f;
bool done = !inside;
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
for (int first = begin; first < end; first += BATCH) {
    const int count = min(BATCH, end - first);
    if (__syncthreads_and(done))
        break;
    if (t < count) {
        Splat s;
        s.load(projected.data, gaussian_ids.data[first + t]);
        s.rescale();
        s_a[t] = s.a;
        s_b[t] = s.b;
        s_z[t] = s.depth();
    }
    __syncthreads();
    for (int j = 0; j < count && !done; ++j) {
        const float4 a = s_a[j];
        const float dx = __fsub_rn(px, a.x), dy = __fsub_rn(py, a.y);
        const float e1 = __fmaf_rn(a.w, dy, __fmul_rn(a.z, dx)), e2 = __fmul_rn(s_b[j].x, dy);
        const float alpha = fminf(alpha_max, __fmul_rn(s_b[j].y, falloff(e1, e2)));
        if (alpha >= alpha_cut) {
            const float after = __fmul_rn(T, __fsub_rn(1.0f, alpha));
            if ((inclusive || after >= stop) && after <= 0.5f)
                found = s_z[j];
            done = after <= 0.5f || after < stop;
            T = after;
        }
    }
}
if (inside)
    reals.data[((long long)camera * height + y) * width + x] = found;
