const int size = sh.shape[1];
const float* row = reinterpret_cast<const float*>(sh.data) + 3ll * size * n;
float sum[3] = {0.0f, 0.0f, 0.0f}, largest = 0.0f;
auto take = [&](int i, float c) {
    if (i < 3 * count) {
        sum[i % 3] += weights[i / 3] * c;
        largest = fmaxf(largest, fabsf(c));
    }
};
#include "native_sh_row.cu"
return wp::vec4(sum[0], sum[1], sum[2], largest);
