// Tiles with long lists first, so that none of them starts when the others are done: a counting sort by the number of binary
// digits of the length, in one thread block. The order among equals differs from run to run; no result depends on it.
__shared__ int s_starts[33];
for (int i = threadIdx.x; i < 33; i += blockDim.x)
    s_starts[i] = 0;
__syncthreads();
auto rank = [&](int tile) { return __clz(ranges.data[2 * tile + 1] - ranges.data[2 * tile]); };  // 0 for the longest
for (int tile = threadIdx.x; tile < count; tile += blockDim.x)
    atomicAdd(&s_starts[rank(tile)], 1);
__syncthreads();
if (threadIdx.x == 0)
    for (int i = 0, sum = 0; i < 33; ++i) {
        const int here = s_starts[i];
        s_starts[i] = sum;
        sum += here;
    }
__syncthreads();
for (int tile = threadIdx.x; tile < count; tile += blockDim.x)
    order.data[atomicAdd(&s_starts[rank(tile)], 1)] = tile;
