// The rows of a block are neighbours, so its threads clear them together, in whole 16-byte pieces where they can.
__shared__ int s_kept[BLOCK];
__syncthreads();
s_kept[threadIdx.x] = kept;
__syncthreads();
const int first = item - (int)threadIdx.x, rows = min(BLOCK, sh.shape[0] - first), size = 3 * sh.shape[1];
float* from = reinterpret_cast<float*>(sh.data) + (long long)first * size;
auto clear = [&](int pieces) {
    for (int i = threadIdx.x; i < rows * pieces; i += BLOCK)
        if (!s_kept[i / pieces])
            reinterpret_cast<float4*>(from)[i] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
};
if (size == 48)
    clear(12);  // degree 3, the usual case: division by a constant is much faster
else if (size % 4 == 0)
    clear(size / 4);
else
    for (int i = threadIdx.x; i < rows * size; i += BLOCK)
        if (!s_kept[i / size])
            from[i] = 0.0f;
