#include "blend_common.cu"
#include "blend_settings.cu"
// One warp takes CHUNK instances back to front, for all pixels of their tiles: item = number of the chunk. The sums of an
// instance go to its slot; if ATOMIC, they are added to those of its Gaussian atomically, in no fixed order.
__shared__ float4 s_a[WARPS][32], s_b[WARPS][32], s_rest[WARPS][REST][32];
const int warp = threadIdx.x / 32;
constexpr bool with_depth = WITH_DEPTH, atomic = ATOMIC, absgrad = ABSGRAD;
const int total = (int)min(totals.data[0], (long long)capacity);  // instances in the list, which may be cut short
const int floor = item * CHUNK;
constexpr int values = 6 + CHANNELS + (absgrad ? 3 : with_depth);  // magnitudes stand behind the place of the depth
// an image may have more channels than this pass, or, in the last of several passes, fewer
const long long pitch = rgb.strides[0] / (int)sizeof(float), v_pitch = v_rgb.strides[0] / (int)sizeof(float);
// number of the sum that this lane holds after the reduction below
int held = 0;
{
    int n = values, size = values;
    #pragma unroll
    for (int distance = 16; distance > 0; distance /= 2) {
        const int half = (n + 1) / 2;
        if (n > 1 && (lane & distance)) {
            held += half;
            size -= half;
        } else
            size = min(size, half);
        n = half;
    }
    // up to 16 sums end in pairs of lanes that hold the same one
    held = size > 0 && (values > 16 || !(lane & 1)) ? held : -1;
}
int top_instance = min(floor + CHUNK, total);
while (top_instance > floor) {
    // the part of this chunk that belongs to one tile
    const int tile = keys.data[top_instance - 1];
    int first = top_instance - 1, tile_begin = first;
    if (tile != no_tile) {
        tile_begin = ranges.data[2 * tile];
        first = max(floor, tile_begin);
    }
    const int stop_at = top_instance;
    top_instance = first;
    // the Gaussian of this lane is known a batch before it is loaded
    int batch = (stop_at - 1) & ~31;
    int next_id = gaussian_ids.data[min(batch + lane, stop_at - 1)];
    const int camera = tile / tiles, in_camera = tile - camera * tiles;
    const int left = (in_camera % columns) * SIDE, top = (in_camera / columns) * SIDE;
    const float px = origin_x + left + lane % 8 + 0.5f, py = origin_y + top + lane / 8 + 0.5f;  // of the pixel in the first block
    const float* background = backgrounds.data + CHANNELS * camera;
    float T[BLOCKS], behind[BLOCKS], G[BLOCKS][CHANNELS], vz[BLOCKS], vw[BLOCKS];
    int last[BLOCKS];
    int part_last = 0;
    #pragma unroll
    for (int k = 0; k < BLOCKS; ++k) {
        const int x = left + (k % WIDE) * 8 + lane % 8, y = top + (k / WIDE) * 4 + lane / 8;
        T[k] = 1.0f;
        behind[k] = vz[k] = vw[k] = 0.0f;
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c)
            G[k][c] = 0.0f;
        last[k] = 0;
        if (tile != no_tile && x < width && y < height) {
            const long long o = ((long long)camera * height + y) * width + x;
            last[k] = ends.data[o];
        }
        part_last = max(part_last, last[k]);
    }
    #pragma unroll
    for (int distance = 16; distance > 0; distance /= 2)  // __reduce_max_sync needs sm_80
        part_last = max(part_last, __shfl_xor_sync(ALL, part_last, distance));
    if (part_last > first) {
        #pragma unroll
        for (int k = 0; k < BLOCKS; ++k) {
            const int x = left + (k % WIDE) * 8 + lane % 8, y = top + (k / WIDE) * 4 + lane / 8;
            if (last[k] > first) {
                const long long o = ((long long)camera * height + y) * width + x;
                const float T_end = transmittances.data[o];
                T[k] = T_end;
                #pragma unroll
                for (int c = 0; c < CHANNELS; ++c)
                    G[k][c] = c < v_rgb.shape[1] ? v_rgb.data[v_pitch * o + c] : 0.0f;
                float z_end = 0.0f;
                if (with_depth) {
                    const float W = weights.data[o];
                    if (W >= SMALLEST_WEIGHT) {
                        vz[k] = v_depth.data[o] / W;
                        vw[k] = -vz[k] * depth.data[o];
                        z_end = depth.data[o] * W;
                    }
                    vw[k] += v_alpha.data[o];
                }
                float empty = background[0] * G[k][0];
                #pragma unroll
                for (int c = 1; c < CHANNELS; ++c)
                    empty += background[c] * G[k][c];
                behind[k] = T_end * empty;
                if (last[k] > stop_at) {
                    // something was blended behind this chunk: the whole image less what lies up to here
                    const float* state = states.data + (long long)(stop_at / CHUNK) * (STATE * PIXELS) + k * 32 + lane;
                    T[k] = state[0];
                    behind[k] = (rgb.data[pitch * o] - state[PIXELS]) * G[k][0];
                    #pragma unroll
                    for (int c = 1; c < CHANNELS; ++c)
                        if (c < rgb.shape[1])
                            behind[k] += (rgb.data[pitch * o + c] - state[(1 + c) * PIXELS]) * G[k][c];
                    if (with_depth)
                        behind[k] += (z_end - state[(1 + CHANNELS) * PIXELS]) * vz[k] + (state[0] - T_end) * vw[k];
                }
            }
        }
    }
    for (; batch + 32 > first; batch -= 32) {
        const int i = batch + lane, id = next_id;
        const bool mine = i >= first && i < stop_at;
        next_id = gaussian_ids.data[max(i - 32, 0)];
        unsigned mask = 0;
        int target = 0;
        __syncwarp();
        if (mine) {
            target = atomic ? id : slots.data[i];
            if (i < part_last) {
                Splat s;
                s.load(projected.data, id);
                s.rescale();
                const float limit = limit_of(s.b.y, log_cut);
                #pragma unroll
                for (int k = 0; k < BLOCKS; ++k)
                    if (whole_tiles || s.touches(
                            (float)(origin_x + left + (k % WIDE) * 8), (float)(origin_y + top + (k / WIDE) * 4), limit))
                        mask |= 1u << k;
                s_a[warp][lane] = s.a;
                s_b[warp][lane] = s.b;
                #pragma unroll
                for (int q = 0; q < REST; ++q)
                    s_rest[warp][q][lane] = s.rest[q];
            }
        }
        __syncwarp();
        unsigned todo = __ballot_sync(ALL, mask != 0);
        unsigned written = 0;
        while (todo) {
            const int j = 31 - __clz(todo);
            todo &= ~(1u << j);
            const unsigned blocks = __shfl_sync(ALL, mask, j);
            Splat s;
            s.a = s_a[warp][j];
            s.b = s_b[warp][j];
            #pragma unroll
            for (int q = 0; q < REST; ++q)
                s.rest[q] = s_rest[warp][q][j];
            const float4 a = s.a, b = s.b;
            float v[STRIDE] = {};
            bool any = false;
            float dx[WIDE], p[WIDE];
            #pragma unroll
            for (int k = 0; k < WIDE; ++k) {
                dx[k] = __fsub_rn(px + 8 * k, a.x);
                p[k] = __fmul_rn(a.z, dx[k]);
            }
            #pragma unroll
            for (int row = 0; row < BLOCKS / WIDE; ++row) {
                if (!(blocks >> (row * WIDE) & ((1u << WIDE) - 1u)))
                    continue;
                const float dy = __fsub_rn(py + 4 * row, a.y);
                const float e2 = __fmul_rn(b.x, dy);
                #pragma unroll
                for (int column = 0; column < WIDE; ++column) {
                    const int k = row * WIDE + column;
                    if (!(blocks >> k & 1u))
                        continue;
                    const float e1 = __fmaf_rn(a.w, dy, p[column]);
                    const float g = falloff(e1, e2);
                    const float raw = __fmul_rn(b.y, g), alpha = fminf(alpha_max, raw);
                    const bool blended = alpha >= alpha_cut && batch + j < last[k];
                    if (!__any_sync(ALL, blended))
                        continue;
                    any = true;
                    if (blended) {
                        const float inverse = __fdividef(1.0f, 1.0f - alpha);
                        T[k] *= inverse;
                        const float w = alpha * T[k];
                        float d = s.channel(0) * G[k][0];
                        #pragma unroll
                        for (int c = 1; c < CHANNELS; ++c)
                            d += s.channel(c) * G[k][c];
                        if (with_depth)
                            d += s.depth() * vz[k] + vw[k];
                        const float v_a = raw <= alpha_max ? T[k] * d - behind[k] * inverse : 0.0f;
                        behind[k] += w * d;
                        const float v_q = -raw * v_a;
                        const float v_e1 = v_q * e1, v_e2 = v_q * e2;
                        v[0] += v_e1;
                        v[1] += v_e2;
                        v[2] += v_e1 * dx[column];
                        v[3] += v_e1 * dy;
                        v[4] += v_e2 * dy;
                        v[5] += v_a * g;
                        #pragma unroll
                        for (int c = 0; c < CHANNELS; ++c)
                            v[6 + c] += w * G[k][c];
                        if (with_depth)
                            v[6 + CHANNELS] += w * vz[k];
                        if (absgrad) {
                            v[7 + CHANNELS] += fabsf(v_e1);
                            v[8 + CHANNELS] += fabsf(a.w * v_e1 + b.x * v_e2);
                        }
                    }
                }
            }
            if (!any)
                continue;
            written |= 1u << j;
            // Each step halves the sums a lane holds instead of adding all of them: 12 shuffles for 9 sums, not 45.
            int n = values;
            #pragma unroll
            for (int distance = 16; distance > 0; distance /= 2) {
                const int half = (n + 1) / 2;
                const bool upper = lane & distance;
                if (n == 1)
                    v[0] += __shfl_xor_sync(ALL, v[0], distance);
                else {
                    #pragma unroll
                    for (int h = 0; h < STRIDE / 2; ++h) {  // a number, or v would not stay in registers
                        if (h >= half)
                            break;
                        const float low = v[h], high = h + half < n ? v[h + half] : 0.0f;
                        v[h] = (upper ? high : low) + __shfl_xor_sync(ALL, upper ? low : high, distance);
                    }
                }
                n = half;
            }
            float* to = v_slots.data + (long long)STRIDE * __shfl_sync(ALL, target, j) + held;
            if (held >= 0) {
                if (atomic)
                    atomicAdd(to, v[0]);
                else
                    *to = v[0];
            }
        }
        if (!atomic && mine && !(written >> lane & 1u)) {
            float4* row = reinterpret_cast<float4*>(v_slots.data + (long long)STRIDE * target);
            #pragma unroll
            for (int q = 0; q < QUADS; ++q)
                row[q] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        }
    }
}
