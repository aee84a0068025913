constexpr int warps = BLOCK / 32;
__shared__ int s_counts[warps], s_items[BLOCK];
const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
const unsigned mask = __ballot_sync(0xffffffffu, wanted != 0);
if (lane == 0)
    s_counts[warp] = __popc(mask);
__syncthreads();
int before = 0, all = 0;
for (int w = 0; w < warps; ++w) {
    before += w < warp ? s_counts[w] : 0;
    all += s_counts[w];
}
if (wanted)
    s_items[before + __popc(mask & ((1u << lane) - 1u))] = item;
__syncthreads();
return (int)threadIdx.x < all ? s_items[threadIdx.x] : -1;
