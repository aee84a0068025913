#include "blend_common.cu"
#include "blend_settings.cu"
// One warp composites one block of 8 x 4 pixels: item = place of the tile in the order * BLOCKS + block.
constexpr int AHEAD = 4;  // alphas computed before they are blended: they do not wait for each other
__shared__ float4 s_a[WARPS][32 + AHEAD], s_b[WARPS][32 + AHEAD], s_c[WARPS][32 + AHEAD];
__shared__ int s_i[WARPS][32 + AHEAD];
const int warp = threadIdx.x / 32;
const int tile = order.data[item / BLOCKS], block = item % BLOCKS;
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int left = (in_camera % columns) * SIDE + (block % WIDE) * 8, top = (in_camera / columns) * SIDE + (block / WIDE) * 4;
const int x = left + lane % 8, y = top + lane / 8;
const bool inside = x < width && y < height;
const long long o = ((long long)camera * height + y) * width + x;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
float T = 1.0f, red = 0.0f, green = 0.0f, blue = 0.0f, z = 0.0f, total = 0.0f;
int last = 0;
bool done = !inside;
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
// batches start at multiples of 32, so that one starts at every multiple of CHUNK
int i = (begin & ~31) + lane;
Splat s;
if (i >= begin && i < end)
    s.load(projected.data, gaussian_ids.data[i]);
int next_id = i + 32 < end ? gaussian_ids.data[i + 32] : 0;  // known a batch before it is loaded
for (int batch = begin & ~31; batch < end; batch += 32) {
    if (__all_sync(ALL, done))
        break;
    if (batch % chunk == 0 && batch > begin) {
        float* state = states.data + (long long)(batch / chunk) * (STATE * PIXELS) + block * 32 + lane;
        state[0] = T;
        state[PIXELS] = red;
        state[2 * PIXELS] = green;
        state[3 * PIXELS] = blue;
        state[4 * PIXELS] = z;
    }
    bool touched = false;
    if (i >= begin && i < end) {
        s.rescale();
        touched = whole_tiles || s.touches((float)(origin_x + left), (float)(origin_y + top), limit_of(s.b.y, alpha_cut));
    }
    const unsigned mask = __ballot_sync(ALL, touched);
    const int slot = __popc(mask & ((1u << lane) - 1u));
    const int count = __popc(mask);
    __syncwarp();
    if (touched) {
        s_a[warp][slot] = s.a;
        s_b[warp][slot] = s.b;
        s_c[warp][slot] = s.c;
        s_i[warp][slot] = i + 1;
    }
    if (lane < AHEAD)
        s_i[warp][count + lane] = 0;  // the entries that fill up the last group blend nothing
    __syncwarp();
    i += 32;
    if (i < end)
        s.load(projected.data, next_id);  // under way while this batch is blended
    if (i + 32 < end)
        next_id = gaussian_ids.data[i + 32];
    for (int j = 0; j < count; j += AHEAD) {
        float alpha[AHEAD];
        #pragma unroll
        for (int k = 0; k < AHEAD; ++k) {
            const float4 a = s_a[warp][j + k];
            const float2 b = *reinterpret_cast<const float2*>(&s_b[warp][j + k]);
            const float dx = __fsub_rn(px, a.x), dy = __fsub_rn(py, a.y);
            const float e1 = __fmaf_rn(a.w, dy, __fmul_rn(a.z, dx)), e2 = __fmul_rn(b.x, dy);
            alpha[k] = fminf(alpha_max, __fmul_rn(b.y, falloff(e1, e2)));
        }
        #pragma unroll
        for (int k = 0; k < AHEAD; ++k) {
            const int next = s_i[warp][j + k];
            if (!done && alpha[k] >= alpha_cut && next > 0) {
                const float after = __fmul_rn(T, __fsub_rn(1.0f, alpha[k]));
                done = !(after >= stop);
                if (inclusive || !done) {
                    const float4 b = s_b[warp][j + k], c = s_c[warp][j + k];
                    const float w = alpha[k] * T;
                    T = after;
                    red += w * b.z;
                    green += w * b.w;
                    blue += w * c.x;
                    z += w * c.y;
                    total += w;
                    last = next;
                }
            }
        }
    }
}
if (inside) {
    const float* background = backgrounds.data + 3 * camera;
    rgb.data[3 * o] = red + T * background[0];
    rgb.data[3 * o + 1] = green + T * background[1];
    rgb.data[3 * o + 2] = blue + T * background[2];
    alpha_out.data[o] = 1.0f - T;
    depth.data[o] = total >= SMALLEST_WEIGHT ? z / total : 0.0f;
    transmittances.data[o] = T;
    weights.data[o] = total;
    ends.data[o] = last;
}
