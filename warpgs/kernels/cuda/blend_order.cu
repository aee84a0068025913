// Tiles with long lists first, so that none of them starts when the others are done: a counting sort by the number of binary
// digits of the length, in one thread block. The order among equals differs from run to run; no result depends on it.
constexpr int HELD = 8;  // tiles that a thread loads before it uses the first: one block alone cannot hide the waits
__shared__ int s_starts[THREADS];  // by rank: 0 for the longest lists, 32 for empty ones, 33 past the last tile
const int lane = threadIdx.x % 32;
const int2* spans = reinterpret_cast<const int2*>(ranges.data);
s_starts[threadIdx.x] = 0;
__syncthreads();
auto rank_of = [&](int tile) { return tile < count ? __clz(spans[tile].y - spans[tile].x) : 33; };
for (int begin = threadIdx.x; begin - (int)threadIdx.x < count; begin += HELD * THREADS) {
    int rank[HELD];
    #pragma unroll
    for (int k = 0; k < HELD; ++k)
        rank[k] = rank_of(begin + k * THREADS);
    #pragma unroll
    for (int k = 0; k < HELD; ++k) {
        // one addition for all lanes of a rank: most tiles have one of a few ranks, and additions to one number are serial
        const unsigned alike = __match_any_sync(0xffffffffu, rank[k]);
        const int leader = __ffs(alike) - 1;
        int at = 0;
        if (lane == leader)
            at = atomicAdd(&s_starts[rank[k]], __popc(alike));
        at = __shfl_sync(0xffffffffu, at, leader) + __popc(alike & ((1u << lane) - 1u));
        if (rank[k] < 33)
            places.data[begin + k * THREADS] = at;
    }
}
__syncthreads();
if (threadIdx.x == 0)
    for (int i = 0, sum = 0; i < 34; ++i) {
        const int here = s_starts[i];
        s_starts[i] = sum;
        sum += here;
    }
__syncthreads();
for (int begin = threadIdx.x; begin < count; begin += HELD * THREADS) {
    int rank[HELD], at[HELD];
    #pragma unroll
    for (int k = 0; k < HELD; ++k) {
        const int tile = begin + k * THREADS;
        rank[k] = rank_of(tile);
        at[k] = tile < count ? places.data[tile] : 0;  // written by this thread
    }
    #pragma unroll
    for (int k = 0; k < HELD; ++k)
        if (rank[k] < 33)
            order.data[s_starts[rank[k]] + at[k]] = begin + k * THREADS;
}
