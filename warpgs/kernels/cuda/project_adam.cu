    // The gradients of a block's rows go through shared memory, so that all its threads update them in whole 16-byte pieces,
    // neighbours in memory by neighbouring threads. A row that nothing sees has a zero gradient, and moves on by its moments.
    // Of a row: 0:3 mean, 3:7 quaternion, 7:10 log scale, 10 opacity, 11:14 colour, 14:30 basis. Its odd length spares banks.
    constexpr int LENGTH = 31;
    constexpr int AHEAD = 2;
    __shared__ float s_rows[BLOCK * LENGTH];
    __shared__ int s_seen[BLOCK];
    const int first = item - (int)threadIdx.x, rows = min(BLOCK, means.shape[0] - first);
    s_seen[threadIdx.x] = seen;
    if (n >= 0) {
        float* to = s_rows + (n - first) * LENGTH;
        for (int k = 0; k < 3; ++k) {
            to[k] = v_mean[k];
            to[7 + k] = v_log_scale[k];
            to[11 + k] = v_color[k];
        }
        for (int k = 0; k < 4; ++k)
            to[3 + k] = v_quat[k];
        to[10] = v_logit;
        for (int k = 0; k < 16; ++k)
            to[14 + k] = basis[k];
    }
    __syncthreads();
    auto update = [&](const wp::array_t<float>& parameter, const wp::array_t<float>& mean, const wp::array_t<float>& square,
                      const float* rates_of, int head, auto gradient, auto held) {
        const float head_rate = rates_of[0], rate = rates_of[1], root_correction2 = rates_of[2];
        ELEMENT
        const int size = parameter.shape[1], end = rows * size;
        const long long begin = (long long)first * size;
        float *ps = parameter.data + begin, *ms = mean.data + begin, *ss = square.data + begin;
        for (int start = 4 * (int)threadIdx.x; start < end; start += 4 * BLOCK * AHEAD) {
            float4 p[AHEAD], m[AHEAD], s[AHEAD];
            #pragma unroll
            for (int a = 0; a < AHEAD; ++a) {
                const int i = start + 4 * BLOCK * a;
                if (i + 4 <= end) {
                    p[a] = *reinterpret_cast<const float4*>(ps + i);
                    m[a] = *reinterpret_cast<const float4*>(ms + i);
                    s[a] = *reinterpret_cast<const float4*>(ss + i);
                }
            }
            #pragma unroll
            for (int a = 0; a < AHEAD; ++a) {
                const int i = start + 4 * BLOCK * a;
                int row = i / size, column = i - row * size;
                auto next = [&](float& p_i, float& m_i, float& s_i) {
                    const float before = p_i, g = s_seen[row] ? gradient(s_rows + row * LENGTH, column) : 0.0f;
                    one(g, column < head ? head_rate : rate, p_i, m_i, s_i);
                    p_i = held(first + row, before, p_i);
                    if (++column == size) {
                        column = 0;
                        ++row;
                    }
                };
                if (i + 4 <= end) {
                    next(p[a].x, m[a].x, s[a].x);
                    next(p[a].y, m[a].y, s[a].y);
                    next(p[a].z, m[a].z, s[a].z);
                    next(p[a].w, m[a].w, s[a].w);
                    *reinterpret_cast<float4*>(ps + i) = p[a];
                    *reinterpret_cast<float4*>(ms + i) = m[a];
                    *reinterpret_cast<float4*>(ss + i) = s[a];
                } else
                    for (int j = i; j < end; ++j)
                        next(ps[j], ms[j], ss[j]);
            }
        }
    };
    auto free = [](int, float, float now) { return now; };
    auto part = [&](int i, float before, float now) {
        if (share.shape[0] == 0 || share.data[i] == 1.0f)
            return now;
        return __fadd_rn(before, __fmul_rn(share.data[i], now - before));
    };
    update(means, mean_means, mean_squares, rates.data, 0, [](const float* v, int k) { return v[k]; }, part);
    update(quats, quat_means, quat_squares, rates.data + 3, 0, [](const float* v, int k) { return v[3 + k]; }, free);
    update(log_scales, scale_means, scale_squares, rates.data + 6, 0, [](const float* v, int k) { return v[7 + k]; }, free);
    update(logits, logit_means, logit_squares, rates.data + 9, 0, [](const float* v, int) { return v[10]; }, free);
    auto coefficient = [&](const float* v, int k) { return k < 3 * count ? __fmul_rn(v[14 + k / 3], v[11 + k % 3]) : 0.0f; };
    update(sh, sh_means, sh_squares, rates.data + 12, head, coefficient, free);
