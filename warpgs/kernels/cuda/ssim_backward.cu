// The transpose of the window is the window: three fields, weighted by the upstream gradient, go down and then across.
constexpr int HALO = 5, ROWS = 16, COLUMNS = 48, SPAN = COLUMNS + 6 * HALO, TALL = ROWS + 2 * HALO;
const float window[11] = {WINDOW};
__shared__ float s_f[3][TALL][SPAN];
__shared__ float s_m[3][ROWS][SPAN];
const int t = threadIdx.x;
const int across = (columns + COLUMNS - 1) / COLUMNS, down = (height + ROWS - 1) / ROWS;
const int image = block / (across * down), inner = block - image * across * down;
const int top = (inner / across) * ROWS, left = (inner % across) * COLUMNS;
const long long base = (long long)image * height * columns;
// summed: the upstream gradients of the sums of 1 - similarity and of |a - b|; else that of each similarity
const float v_unlike = summed ? v_result.data[0] : 0.0f, v_error = summed ? v_result.data[1] : 0.0f;
for (int i = t; i < TALL * SPAN; i += 256) {
    const int r = i / SPAN, c = i % SPAN, y = top + r - HALO, x = left + c - 3 * HALO;
    const bool inside = y >= 0 && y < height && x >= 0 && x < columns;
    const long long o = inside ? base + (long long)y * columns + x : 0;
    const float v = !inside ? 0.0f : summed ? -v_unlike : v_result.data[o];
    s_f[0][r][c] = inside ? v * by_mean.data[o] : 0.0f;
    s_f[1][r][c] = inside ? v * by_variance.data[o] : 0.0f;
    s_f[2][r][c] = inside ? v * by_gap.data[o] : 0.0f;
}
__syncthreads();
for (int i = t; i < ROWS * SPAN; i += 256) {
    const int r = i / SPAN, c = i % SPAN;
    #pragma unroll
    for (int f = 0; f < 3; ++f) {
        float m = 0.0f;
        #pragma unroll
        for (int k = 0; k < 11; ++k)
            m += window[k] * s_f[f][r + k][c];
        s_m[f][r][c] = m;
    }
}
__syncthreads();
#pragma unroll
for (int part = 0; part < 3; ++part) {
    const int i = t + 256 * part, r = i / COLUMNS, c = i % COLUMNS, y = top + r, x = left + c;
    if (y < height && x < columns) {
        float m[3] = {0.0f, 0.0f, 0.0f};
        #pragma unroll
        for (int k = 0; k < 11; ++k)
            #pragma unroll
            for (int f = 0; f < 3; ++f)
                m[f] += window[k] * s_m[f][r][c + 3 * k];
        const long long o = base + (long long)y * columns + x;
        const float p = a.data[o], d = p - b.data[o];
        float v = m[0] + 2.0f * (p * m[1] + d * m[2]);
        if (summed)
            v += d > 0.0f ? v_error : d < 0.0f ? -v_error : 0.0f;
        v_a.data[o] = v;
    }
}
