#include "blend_common.cu"
#include "blend_settings.cu"
constexpr int AHEAD = 4;  // alphas computed before they are blended: they do not wait for each other
__shared__ float4 s_a[WARPS][32 + AHEAD], s_b[WARPS][32 + AHEAD], s_rest[WARPS][REST][32 + AHEAD];
__shared__ int s_i[WARPS][32 + AHEAD];
#include "blend_place.cu"
float T[PER], color[PER][CHANNELS] = {}, z[PER], total[PER];
int last[PER];
bool done[PER], finished = true;
#pragma unroll
for (int k = 0; k < PER; ++k) {
    T[k] = 1.0f;
    z[k] = total[k] = 0.0f;
    last[k] = 0;
    done[k] = !(x < width && y + 4 * k < height);
    finished = finished && done[k];
}
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
// batches start at multiples of 32, so that one starts at every multiple of CHUNK
int i = (begin & ~31) + lane;
Splat s;
if (i >= begin && i < end)
    s.load(projected.data, gaussian_ids.data[i]);
int next_id = i + 32 < end ? gaussian_ids.data[i + 32] : 0;  // known a batch before it is loaded
for (int batch = begin & ~31; batch < end; batch += 32) {
    if (__all_sync(ALL, finished))
        break;
    if (SAVE && batch % chunk == 0 && batch > begin) {
        #pragma unroll
        for (int k = 0; k < PER; ++k) {
            float* state = states.data + (long long)(batch / chunk) * (STATE * PIXELS) + (block + k * WIDE) * 32 + lane;
            state[0] = T[k];
            #pragma unroll
            for (int c = 0; c < CHANNELS; ++c)
                state[(1 + c) * PIXELS] = color[k][c];
            state[(1 + CHANNELS) * PIXELS] = z[k];
        }
    }
    bool touched = false;
    if (i >= begin && i < end) {
        s.rescale();
        touched = whole_tiles
            || s.touches((float)(origin_x + left), (float)(origin_y + top), limit_of(s.b.y, alpha_cut), 4 * PER - 0.5f);
    }
    const unsigned mask = __ballot_sync(ALL, touched);
    const int slot = __popc(mask & ((1u << lane) - 1u));
    const int count = __popc(mask);
    __syncwarp();
    if (touched) {
        s_a[warp][slot] = s.a;
        s_b[warp][slot] = s.b;
        #pragma unroll
        for (int q = 0; q < REST; ++q)
            s_rest[warp][q][slot] = s.rest[q];
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
            const int next = s_i[warp][j + ahead];
            #pragma unroll
            for (int k = 0; k < PER; ++k) {
                if (!done[k] && alpha[ahead][k] >= alpha_cut && next > 0) {
                    const float after = __fmul_rn(T[k], __fsub_rn(1.0f, alpha[ahead][k]));
                    done[k] = !(after >= stop);
                    if (inclusive || !done[k]) {
                        Splat g;
                        g.b = s_b[warp][j + ahead];
                        #pragma unroll
                        for (int q = 0; q < REST; ++q)
                            g.rest[q] = s_rest[warp][q][j + ahead];
                        const float w = alpha[ahead][k] * T[k];
                        T[k] = after;
                        #pragma unroll
                        for (int c = 0; c < CHANNELS; ++c)
                            color[k][c] += w * g.channel(c);
                        z[k] += w * g.depth();
                        total[k] += w;
                        last[k] = next;
                    }
                }
            }
        }
    }
    finished = true;
    #pragma unroll
    for (int k = 0; k < PER; ++k)
        finished = finished && done[k];
}
const float* background = backgrounds.data + CHANNELS * camera;
const long long pitch = rgb.strides[0] / (int)sizeof(float);
#pragma unroll
for (int k = 0; k < PER; ++k) {
    const bool inside = x < width && y + 4 * k < height;
    const long long o = ((long long)camera * height + y + 4 * k) * width + x;
    if (CHANNELS == 3) {
        if (inside)
            #pragma unroll
            for (int c = 0; c < CHANNELS; ++c)
                if (c < rgb.shape[1])
                    rgb.data[pitch * o + c] = color[k][c] + T[k] * background[c];
    } else {
        // through shared memory, so that a store of the warp goes to few pixels, whose channels are neighbours
        float* staged = reinterpret_cast<float*>(s_rest[warp]);
        __syncwarp();
        #pragma unroll
        for (int c = 0; c < CHANNELS; ++c)
            staged[lane * CHANNELS + c] = color[k][c] + T[k] * background[c];
        __syncwarp();
        #pragma unroll
        for (int n = 0; n < CHANNELS; ++n) {
            const int p = (32 * n + lane) / CHANNELS, c = (32 * n + lane) % CHANNELS;
            const int to_x = left + p % 8, to_y = top + p / 8 + 4 * k;
            if (to_x < width && to_y < height && c < rgb.shape[1])
                rgb.data[pitch * (((long long)camera * height + to_y) * width + to_x) + c] = staged[32 * n + lane];
        }
    }
    if (inside) {
        alpha_out.data[o] = 1.0f - T[k];
        depth.data[o] = total[k] >= SMALLEST_WEIGHT ? z[k] / total[k] : 0.0f;
        if (SAVE) {
            transmittances.data[o] = T[k];
            weights.data[o] = total[k];
        }
        ends.data[o] = last[k];
    }
}
