const int size = sh.shape[1];
const float* row = reinterpret_cast<const float*>(sh.data) + 3ll * size * n;
float* v_row = reinterpret_cast<float*>(v_sh.data) + 3ll * size * n;
wp::vec_t<BASES, float> w;
auto give = [&](int i, float c, float& sum) {
    if (i < 3 * count) {
        w[i / 3] += c * v[i % 3];
        sum += weights[i / 3] * v[i % 3];
    }
};
if (size % 4 == 0) {
    // AHEAD loads before the stores that use them: the compiler cannot know that rows do not overlap, and would wait for each
    constexpr int AHEAD = 6;
    #pragma unroll
    for (int first = 0; first < (3 * BASES + 3) / 4; first += AHEAD) {
        float4 held[AHEAD];
        #pragma unroll
        for (int k = 0; k < AHEAD; ++k)
            if (4 * (first + k) < 3 * count)
                held[k] = reinterpret_cast<const float4*>(row)[first + k];
        #pragma unroll
        for (int k = 0; k < AHEAD; ++k) {
            const int q = first + k;
            float4* to = reinterpret_cast<float4*>(v_row) + q;
            if (4 * q < 3 * count) {
                const float4 c = held[k];
                float4 sum = add ? *to : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
                give(4 * q, c.x, sum.x);
                give(4 * q + 1, c.y, sum.y);
                give(4 * q + 2, c.z, sum.z);
                give(4 * q + 3, c.w, sum.w);
                *to = sum;
            } else if (!add && 4 * q < 3 * size)
                *to = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        }
    }
} else {
    #pragma unroll
    for (int k = 0; k < BASES; ++k)
        for (int channel = 0; channel < 3; ++channel)
            if (k < count) {
                w[k] += row[3 * k + channel] * v[channel];
                v_row[3 * k + channel] = (add ? v_row[3 * k + channel] : 0.0f) + weights[k] * v[channel];
            } else if (!add && k < size)
                v_row[3 * k + channel] = 0.0f;
}
if (!add)
    for (int i = 3 * BASES; i < 3 * size; ++i)
        v_row[i] = 0.0f;
return w;
