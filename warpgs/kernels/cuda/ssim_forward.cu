// A thread block takes 16 x 16 pixels: both images with a border of 5 pixels into shared memory, then down, then across.
// Names in capitals are replaced by numbers before compilation (ssim_cuda.py).
constexpr int HALO = 5, ROWS = 16, COLUMNS = 48, SPAN = COLUMNS + 6 * HALO, TALL = ROWS + 2 * HALO;
const float window[11] = {WINDOW};
__shared__ float s_a[TALL][SPAN], s_b[TALL][SPAN];
__shared__ float s_m[5][ROWS][SPAN];
__shared__ float s_sums[2][8];
const int t = threadIdx.x;
const int across = (columns + COLUMNS - 1) / COLUMNS, down = (height + ROWS - 1) / ROWS;
const int image = block / (across * down), inner = block - image * across * down;
const int top = (inner / across) * ROWS, left = (inner % across) * COLUMNS;
const long long base = (long long)image * height * columns;
for (int i = t; i < TALL * SPAN; i += 256) {
    const int r = i / SPAN, c = i % SPAN, y = top + r - HALO, x = left + c - 3 * HALO;
    const bool inside = y >= 0 && y < height && x >= 0 && x < columns;
    s_a[r][c] = inside ? a.data[base + (long long)y * columns + x] : 0.0f;
    s_b[r][c] = inside ? b.data[base + (long long)y * columns + x] : 0.0f;
}
__syncthreads();
for (int i = t; i < ROWS * SPAN; i += 256) {
    const int r = i / SPAN, c = i % SPAN;
    float m[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    #pragma unroll
    for (int k = 0; k < 11; ++k) {
        const float w = window[k], p = s_a[r + k][c], q = s_b[r + k][c], d = p - q;
        m[0] += w * p;
        m[1] += w * q;
        m[2] += w * p * p;
        m[3] += w * q * q;
        m[4] += w * d * d;
    }
    #pragma unroll
    for (int f = 0; f < 5; ++f)
        s_m[f][r][c] = m[f];
}
__syncthreads();
float unlike = 0.0f, error = 0.0f;
#pragma unroll
for (int part = 0; part < 3; ++part) {
    const int i = t + 256 * part, r = i / COLUMNS, c = i % COLUMNS, y = top + r, x = left + c;
    if (y < height && x < columns) {
        float m[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        #pragma unroll
        for (int k = 0; k < 11; ++k)
            #pragma unroll
            for (int f = 0; f < 5; ++f)
                m[f] += window[k] * s_m[f][r][c + 3 * k];
        // docs/ssim.md, sections 2 and 3
        const float ma = m[0], mb = m[1];
        const float raw_va = m[2] - ma * ma, raw_gap = m[4] - (ma - mb) * (ma - mb);
        const float va = fmaxf(raw_va, 0.0f), vb = fmaxf(m[3] - mb * mb, 0.0f), gap = fmaxf(raw_gap, 0.0f);
        const float n1 = 2.0f * ma * mb + C1, d1 = n1 + (ma - mb) * (ma - mb), d2 = va + vb + C2;
        const float luminance = n1 / d1, structure = 1.0f - gap / d2;
        const float v = raw_va > 0.0f ? luminance * gap / (d2 * d2) : 0.0f;
        const float g = raw_gap > 0.0f ? -luminance / d2 : 0.0f;
        const long long o = base + (long long)y * columns + x;
        by_mean.data[o] = 2.0f * (structure * (mb - luminance * ma) / d1 - ma * v - (ma - mb) * g);
        by_variance.data[o] = v;
        by_gap.data[o] = g;
        if (summed) {
            unlike += 1.0f - luminance * structure;
            error += fabsf(s_a[r + HALO][c + 3 * HALO] - s_b[r + HALO][c + 3 * HALO]);
        } else
            result.data[o] = luminance * structure;
    }
}
if (summed) {
    for (int distance = 16; distance > 0; distance /= 2) {
        unlike += __shfl_xor_sync(0xffffffffu, unlike, distance);
        error += __shfl_xor_sync(0xffffffffu, error, distance);
    }
    if (t % 32 == 0) {
        s_sums[0][t / 32] = unlike;
        s_sums[1][t / 32] = error;
    }
    __syncthreads();
    if (t < 2) {
        float sum = 0.0f;
        for (int w = 0; w < 8; ++w)
            sum += s_sums[t][w];
        result.data[2 * block + t] = sum;
    }
}
