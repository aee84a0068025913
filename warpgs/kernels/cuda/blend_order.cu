// Tiles by rank, so that tiles with long lists start first, not when the others are done. The rank is 0 for the
// longest lists, 32 for empty ones: leading zeros of the length. A thread takes one tile. The order among equals differs from run
// to run; no result depends on it.
__shared__ int s_places[RANKS];  // tiles of the block by rank, then the place of the first of them among all of that rank
const int lane = threadIdx.x % 32;
if (threadIdx.x < RANKS)
    s_places[threadIdx.x] = 0;
__syncthreads();
int rank = RANKS;  // past the last tile
if (tile < count)
    rank = __clz(ranges.data[2 * tile + 1] - ranges.data[2 * tile]);
// one addition for all lanes of a rank: most tiles have one of a few ranks, and atomic additions to one number are serial
const unsigned alike = __match_any_sync(0xffffffffu, rank);
const int leader = __ffs(alike) - 1;
int at = 0;
if (lane == leader && rank < RANKS)
    at = atomicAdd(&s_places[rank], __popc(alike));
at = __shfl_sync(0xffffffffu, at, leader) + __popc(alike & ((1u << lane) - 1u));
__syncthreads();
if (threadIdx.x < RANKS) {
    const int here = s_places[threadIdx.x];
    s_places[threadIdx.x] = here > 0 ? atomicAdd(&counts.data[threadIdx.x], here) : 0;
}
__syncthreads();
if (rank < RANKS)
    order.data[(long long)rank * count + s_places[rank] + at] = tile;
