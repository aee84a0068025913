#include "blend_common.cu"
#include "blend_settings.cu"
// One warp takes a bucket of 32 * PER instances. A lane keeps PER of them with their sums, and the pixels pass through the
// lanes: lane l works on the pixel that lane l - 1 had a step before, and takes over what changes on its way. The order is
// back to front, the last instance in lane 0, so that arithmetic and inputs are those of the kernel that this is held against
// (blend_backward.cu). Nothing has to be reduced: a lane writes the sums of its instances when all pixels have passed.
constexpr bool with_depth = WITH_DEPTH, skip = SKIP;
constexpr int values = with_depth ? 10 : 9, SIZE = 32 * PER;
__shared__ float4 s_upstream[WARPS][PIXELS];  // of each pixel on its way: gradient of the colour, and its end
__shared__ float2 s_centre[WARPS][PIXELS];
__shared__ float2 s_entry[WARPS][PIXELS];  // transmittance and what lies behind, as lane 0 takes them
__shared__ float2 s_depth[WARPS][with_depth ? PIXELS : 1];  // vz and vw of docs/blend.md
const int warp = threadIdx.x / 32;
const int total = (int)min(totals.data[0], (long long)capacity);
const int floor = item * SIZE;
int top_instance = min(floor + SIZE, total);
while (top_instance > floor) {
    // the part of this bucket that belongs to one tile
    const int tile = keys.data[top_instance - 1];
    const bool listed = tile != no_tile;
    const int stop_at = top_instance, first = listed ? max(floor, ranges.data[2 * tile]) : top_instance - 1;
    top_instance = first;
    const int camera = tile / tiles, in_camera = tile - camera * tiles;
    const int left = (in_camera % columns) * SIDE, top = (in_camera / columns) * SIDE;
    int last[BLOCKS];
    int part_last = 0;
    #pragma unroll
    for (int k = 0; k < BLOCKS; ++k) {
        const int x = left + (k % WIDE) * 8 + lane % 8, y = top + (k / WIDE) * 4 + lane / 8;
        last[k] = listed && x < width && y < height ? ends.data[((long long)camera * height + y) * width + x] : 0;
        part_last = max(part_last, last[k]);
    }
    part_last = __reduce_max_sync(ALL, part_last);
    const int drawn_end = max(first, min(stop_at, part_last));  // nothing from here on was drawn
    for (int i = drawn_end + lane; i < stop_at; i += 32) {
        float4* row = reinterpret_cast<float4*>(v_slots.data + (long long)STRIDE * slots.data[i]);
        row[0] = row[1] = row[2] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
    if (drawn_end == first)
        continue;
    // the instances of this lane, the last first
    Splat s[PER];
    int number[PER];
    unsigned blocks = 0;
    #pragma unroll
    for (int j = 0; j < PER; ++j) {
        const int i = drawn_end - 1 - (lane * PER + j);
        number[j] = 0x7fffffff;  // at or beyond every end: draws nothing
        s[j].a = s[j].b = s[j].c = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (i >= first) {
            number[j] = i;
            s[j].load(projected.data, gaussian_ids.data[i]);
            s[j].rescale();
            const float limit = limit_of(s[j].b.y, alpha_cut);
            #pragma unroll
            for (int k = 0; k < BLOCKS; ++k)
                if (!skip || whole_tiles || s[j].touches(
                        (float)(origin_x + left + (k % WIDE) * 8), (float)(origin_y + top + (k / WIDE) * 4), limit))
                    blocks |= 1u << k;
        }
    }
    blocks = __reduce_or_sync(ALL, blocks);
    // the pixels that have to pass: those of touched blocks that drew something of this part
    __syncwarp();  // the pixels of the part before are no longer read
    const float* background = backgrounds.data + 3 * camera;
    int count = 0;
    #pragma unroll
    for (int k = 0; k < BLOCKS; ++k) {
        const bool open = (blocks >> k & 1u) && last[k] > first;
        const unsigned mask = __ballot_sync(ALL, open);
        if (open) {
            const int x = left + (k % WIDE) * 8 + lane % 8, y = top + (k / WIDE) * 4 + lane / 8;
            const long long o = ((long long)camera * height + y) * width + x;
            const float g0 = v_rgb.data[3 * o], g1 = v_rgb.data[3 * o + 1], g2 = v_rgb.data[3 * o + 2];
            const float T_end = transmittances.data[o];
            float vz = 0.0f, vw = 0.0f, z_end = 0.0f;
            if (with_depth) {
                const float W = weights.data[o];
                if (W > 0.0f) {
                    vz = v_depth.data[o] / W;
                    vw = -vz * depth.data[o];
                    z_end = depth.data[o] * W;
                }
                vw += v_alpha.data[o];
            }
            float2 entry = make_float2(T_end, T_end * (background[0] * g0 + background[1] * g1 + background[2] * g2));
            if (last[k] > stop_at) {
                // something was blended behind this bucket: all of the picture less what lies up to here
                const float* state = states.data + (long long)(stop_at / SIZE) * (STATE * PIXELS) + k * 32 + lane;
                entry.x = state[0];
                entry.y = (rgb.data[3 * o] - state[PIXELS]) * g0 + (rgb.data[3 * o + 1] - state[2 * PIXELS]) * g1
                    + (rgb.data[3 * o + 2] - state[3 * PIXELS]) * g2;
                if (with_depth)
                    entry.y += (z_end - state[4 * PIXELS]) * vz + (state[0] - T_end) * vw;
            }
            const int place = count + __popc(mask & ((1u << lane) - 1u));
            s_upstream[warp][place] = make_float4(g0, g1, g2, __int_as_float(last[k]));
            s_centre[warp][place] = make_float2(origin_x + x + 0.5f, origin_y + y + 0.5f);
            s_entry[warp][place] = entry;
            if (with_depth)
                s_depth[warp][place] = make_float2(vz, vw);
        }
        count += __popc(mask);
    }
    __syncwarp();
    float v[PER][VALUES];
    #pragma unroll
    for (int j = 0; j < PER; ++j)
        #pragma unroll
        for (int n = 0; n < VALUES; ++n)
            v[j][n] = 0.0f;
    float T = 1.0f, behind = 0.0f;
    const int lanes = (drawn_end - first + PER - 1) / PER;
    for (int step = 0; step < count + lanes - 1; ++step) {
        T = __shfl_up_sync(ALL, T, 1);
        behind = __shfl_up_sync(ALL, behind, 1);
        const int pixel = step - lane;
        const bool here = pixel >= 0 && pixel < count;
        const int place = here ? pixel : 0;
        if (lane == 0) {
            const float2 entry = s_entry[warp][place];
            T = entry.x;
            behind = entry.y;
        }
        const float4 g = s_upstream[warp][place];
        const float2 centre = s_centre[warp][place];
        const int end = here ? __float_as_int(g.w) : 0;
        float2 v_d = make_float2(0.0f, 0.0f);
        if (with_depth)
            v_d = s_depth[warp][place];
        #pragma unroll
        for (int j = 0; j < PER; ++j) {
            const float4 a = s[j].a, b = s[j].b, c = s[j].c;
            const float dx = __fsub_rn(centre.x, a.x), dy = __fsub_rn(centre.y, a.y);
            const float e1 = __fmaf_rn(a.w, dy, __fmul_rn(a.z, dx)), e2 = __fmul_rn(b.x, dy);
            const float weight = falloff(e1, e2);
            const float raw = __fmul_rn(b.y, weight), alpha = fminf(alpha_max, raw);
            if (alpha >= alpha_cut && number[j] < end) {
                const float inverse = __fdividef(1.0f, 1.0f - alpha);
                T *= inverse;
                const float w = alpha * T;
                float d = b.z * g.x + b.w * g.y + c.x * g.z;
                if (with_depth)
                    d += c.y * v_d.x + v_d.y;
                const float v_a = raw <= alpha_max ? T * d - behind * inverse : 0.0f;
                behind += w * d;
                const float v_q = -raw * v_a;
                const float v_e1 = v_q * e1, v_e2 = v_q * e2;
                v[j][0] += v_e1;
                v[j][1] += v_e2;
                v[j][2] += v_e1 * dx;
                v[j][3] += v_e1 * dy;
                v[j][4] += v_e2 * dy;
                v[j][5] += v_a * weight;
                v[j][6] += w * g.x;
                v[j][7] += w * g.y;
                v[j][8] += w * g.z;
                if (with_depth)
                    v[j][9] += w * v_d.x;
            }
        }
    }
    #pragma unroll
    for (int j = 0; j < PER; ++j) {
        const int i = drawn_end - 1 - (lane * PER + j);
        if (i >= first) {
            float4* row = reinterpret_cast<float4*>(v_slots.data + (long long)STRIDE * slots.data[i]);
            row[0] = make_float4(v[j][0], v[j][1], v[j][2], v[j][3]);
            row[1] = make_float4(v[j][4], v[j][5], v[j][6], v[j][7]);
            row[2] = make_float4(v[j][8], v[j][9], 0.0f, 0.0f);
        }
    }
}
