#include "blend_common.cu"
#include "blend_settings.cu"
// The k heaviest Gaussians of a pixel, in order, in its place of the results; a thread block per tile, a thread per pixel.
constexpr int BATCH = 32;
__shared__ float4 s_a[BATCH], s_b[BATCH];
__shared__ int s_id[BATCH];
const int t = threadIdx.x, block = t / 32;
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int x = (in_camera % columns) * SIDE + (block % WIDE) * 8 + lane % 8;
const int y = (in_camera / columns) * SIDE + (block / WIDE) * 4 + lane / 8;
const bool inside = x < width && y < height;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
const long long pixel = ((long long)camera * height + y) * width + x;
float* own_weights = reals.data + pixel * k;
int* own_ids = ids.data + pixel * k;
float T = 1.0f, last = 0.0f;
int blended = 0;
bool done = !inside;
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
for (int first = begin; first < end; first += BATCH) {
    const int count = min(BATCH, end - first);
    if (__syncthreads_and(done))
        break;
    if (t < count) {
        const int id = gaussian_ids.data[first + t];
        Splat s;
        s.load(projected.data, id);
        s.rescale();
        s_a[t] = s.a;
        s_b[t] = s.b;
        s_id[t] = id - camera * per_camera;
    }
    __syncthreads();
    for (int j = 0; j < count && !done; ++j) {
        const float4 a = s_a[j];
        const float dx = __fsub_rn(px, a.x), dy = __fsub_rn(py, a.y);
        const float e1 = __fmaf_rn(a.w, dy, __fmul_rn(a.z, dx)), e2 = __fmul_rn(s_b[j].x, dy);
        const float alpha = fminf(alpha_max, __fmul_rn(s_b[j].y, falloff(e1, e2)));
        if (alpha >= alpha_cut) {
            const float weight = __fmul_rn(alpha, T), after = __fmul_rn(T, __fsub_rn(1.0f, alpha));
            done = after < stop;
            T = after;
            if (inclusive || !done) {
                ++blended;
                if (weight > last) {
                    int at = k - 1;
                    for (; at > 0 && own_weights[at - 1] < weight; --at) {
                        own_weights[at] = own_weights[at - 1];
                        own_ids[at] = own_ids[at - 1];
                    }
                    own_weights[at] = weight;
                    own_ids[at] = s_id[j];
                    last = own_weights[k - 1];
                }
            }
        }
    }
}
if (inside)
    counts.data[pixel] = blended;
