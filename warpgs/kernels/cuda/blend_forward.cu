#include "blend_common.cu"
#include "blend_settings.cu"
// One warp composites PER blocks of 8 x 4 pixels, one below the other, a pixel of each in a lane:
// item = position of the tile in the order (long lists first) * (BLOCKS / PER) + part. PACKED Gaussians (blend_pack.cu) make an
// image within the largest error. Its alphas have the same bits; a pixel is finished at a transmittance that follows from the
// error (docs/numerics.md), which a warp tests once in AHEAD Gaussians.
constexpr int AHEAD = 4;  // alphas computed before they are blended: they do not wait for each other
__shared__ struct {
    float4 a[32 + AHEAD], b[32 + AHEAD], rest[REST][32 + AHEAD];
    int next[32 + AHEAD];
} batches[WARPS];
auto& own = batches[threadIdx.x / 32];
const int place = item / (BLOCKS / PER), part = item % (BLOCKS / PER);
// The tiles of each rank stand in a row of the order, those of the first ranks come first; there are 33 ranks.
int upto = counts.data[lane];
for (int distance = 1; distance < 32; distance *= 2) {
    const int other = __shfl_up_sync(ALL, upto, distance);
    upto += lane >= distance ? other : 0;
}
const int rank = __popc(__ballot_sync(ALL, upto <= place));
const int before = rank > 0 ? __shfl_sync(ALL, upto, rank - 1) : 0;
const int tile = order.data[(long long)rank * (ranges.shape[0] / 2) + place - before];
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int block = part / WIDE * PER * WIDE + part % WIDE;  // the first one; the next lies WIDE further
const int left = (in_camera % columns) * SIDE + (block % WIDE) * 8, top = (in_camera / columns) * SIDE + (block / WIDE) * 4;
const int x = left + lane % 8, y = top + lane / 8;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
float T[PER], color[PER][CHANNELS] = {}, z[PER], total[PER];
int last[PER];
bool done[PER];
const auto finished = [&] {
    bool all = true;
    #pragma unroll
    for (int k = 0; k < PER; ++k)
        all = all && done[k];
    return (bool)__all_sync(ALL, all);
};
const float* background = backgrounds.data + CHANNELS * camera;
float behind[CHANNELS], enough = stop;  // in PACKED images the middle of all colours that may be behind a finished pixel
if (PACKED) {
    const float most = projected.data[projected.shape[0] - STRIDE];
    float spread = 0.0f, reach = most;  // largest distances of these colours from the middle, and from 0
    #pragma unroll
    for (int c = 0; c < CHANNELS; ++c) {
        const float low = fminf(0.0f, background[c]), high = fmaxf(most, background[c]);
        behind[c] = 0.5f * (low + high);
        spread = fmaxf(spread, 0.5f * (high - low));
        reach = fmaxf(reach, fabsf(background[c]));
    }
    const float rounded = (most <= LARGEST_HALF ? rounding : 1.0f) * reach + 3e-8f;
    enough = fmaxf(4.0f * stop, fminf((0.999f * max_error - rounded) / spread, LARGEST_STOP));
    if (in_camera == 0 && part == 0 && lane == 0)
        bounds.data[camera] = (rounded + enough * spread) * 1.001f;
}
#pragma unroll
for (int k = 0; k < PER; ++k) {
    done[k] = !(x < width && y + 4 * k < height);
    T[k] = PACKED && done[k] ? 0.0f : 1.0f;
    z[k] = total[k] = 0.0f;
    last[k] = 0;
}
const int begin = ranges.data[2 * tile], end = ranges.data[2 * tile + 1];
// batches of SAVE start at multiples of 32, so that one starts at every multiple of CHUNK
const int first = PACKED ? begin : begin & ~31;
int i = first + lane;
Splat s;
if (i >= begin && i < end)
    s.load(projected.data, gaussian_ids.data[i]);
int next_id = i + 32 < end ? gaussian_ids.data[i + 32] : 0;  // known a batch before it is loaded
bool open = true;
for (int batch = first; batch < end && open; batch += 32) {
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
    if ((PACKED || i >= begin) && i < end) {
        if (!PACKED)
            s.rescale();
        touched = (!PACKED && whole_tiles)
            || s.touches((float)(origin_x + left), (float)(origin_y + top), limit_of(s.b.y, log_cut), 4 * PER - 0.5f);
    }
    const unsigned mask = __ballot_sync(ALL, touched);
    const int slot = __popc(mask & ((1u << lane) - 1u));
    const int count = __popc(mask);
    __syncwarp();
    if (touched) {
        if (PACKED)
            s.unpack();
        own.a[slot] = s.a;
        own.b[slot] = s.b;
        #pragma unroll
        for (int q = 0; q < REST; ++q)
            own.rest[q][slot] = s.rest[q];
        if (!PACKED)
            own.next[slot] = i + 1;
    }
    if (lane < AHEAD) {  // the entries that fill up the last group blend nothing
        if (PACKED)
            own.a[count + lane] = own.b[count + lane] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        else
            own.next[count + lane] = 0;
    }
    __syncwarp();
    i += 32;
    if (i < end)
        s.load(projected.data, next_id);  // under way while this batch is blended
    if (i + 32 < end)
        next_id = gaussian_ids.data[i + 32];
    for (int j = 0; j < count && open; j += AHEAD) {
        float alpha[AHEAD][PER];
        #pragma unroll
        for (int ahead = 0; ahead < AHEAD; ++ahead) {
            const float4 a = own.a[j + ahead];
            const float2 b = *reinterpret_cast<const float2*>(&own.b[j + ahead]);
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
            const int next = own.next[j + ahead];
            Splat g;
            const auto fetch = [&] {
                g.b = own.b[j + ahead];
                #pragma unroll
                for (int q = 0; q < REST; ++q)
                    g.rest[q] = own.rest[q][j + ahead];
            };
            if (PACKED)
                fetch();
            #pragma unroll
            for (int k = 0; k < PER; ++k) {
                if ((PACKED || (!done[k] && next > 0)) && alpha[ahead][k] >= alpha_cut) {
                    const float w = alpha[ahead][k] * T[k];
                    const float after = PACKED ? __fmaf_rn(-alpha[ahead][k], T[k], T[k])
                                               : __fmul_rn(T[k], __fsub_rn(1.0f, alpha[ahead][k]));
                    done[k] = !(after >= stop);
                    if (PACKED || inclusive || !done[k]) {
                        if (!PACKED)
                            fetch();
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
        if (PACKED) {
            #pragma unroll
            for (int k = 0; k < PER; ++k)
                done[k] = T[k] < enough;
            open = !finished();
        }
    }
    if (!PACKED)
        open = !finished();
}
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
                    rgb.data[pitch * o + c] = color[k][c] + T[k] * (PACKED && T[k] < enough ? behind[c] : background[c]);
    } else {
        // through shared memory, so that a store of the warp goes to few pixels, whose channels are neighbours
        float* staged = reinterpret_cast<float*>(own.rest);
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
        const float weight = PACKED ? 1.0f - T[k] : total[k];
        depth.data[o] = weight >= SMALLEST_WEIGHT ? z[k] / weight : 0.0f;
        if (SAVE) {
            transmittances.data[o] = T[k];
            weights.data[o] = total[k];
        }
        if (!PACKED)
            ends.data[o] = last[k];
    }
}
