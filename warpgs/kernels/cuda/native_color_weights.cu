const int size = sh.shape[1] / 3;
const float* row = sh.data + 3ll * size * n;
wp::vec_t<16, float> w;
auto take = [&](int i, float c) {
    if (i < 3 * count)
        w[i / 3] += c * upstream[i % 3];
};
#include "native_sh_row.cu"
return w;
