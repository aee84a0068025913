// The costs of the paths along a line, both ways. A warp takes a line, and each lane every 32nd plane. The costs of the last
// pixel and of this one are in turn in two rows of the line, which have an entry that no path prefers at each end.
const int lane = threadIdx.x % 32, pitch = planes + 2;
int* rows = path.data + (long long)line * 2 * pitch;
for (int i = lane; i < 2 * pitch; i += 32)
    rows[i] = FAR_AWAY;
for (int way = 0; way < 2; ++way) {
    int lowest = 0;
    for (int k = 0; k < length; ++k) {
        __syncwarp();
        const int j = way == 0 ? k : length - 1 - k, edge = way == 0 ? k - 1 : j;
        const long long pixel = (long long)(line * line_step + j * pixel_step) * planes;
        // the most that any change of depth may add to the best of the pixel before
        const int most = k > 0 ? lowest + bounds.data[line * line_edge + edge * pixel_edge] : 0;
        const int* before = rows + (k % 2) * pitch + 1;
        int* here = rows + (1 - k % 2) * pitch + 1;
        int least = FAR_AWAY;
        for (int d = lane; d < planes; d += 32) {
            int cost = costs.data[pixel + d];
            if (k > 0)
                cost += min(min(before[d], most), min(before[d - 1], before[d + 1]) + small) - lowest;
            here[d] = cost;
            total.data[pixel + d] = (short)(total.data[pixel + d] + cost);
            least = min(least, cost);
        }
        for (int distance = 16; distance > 0; distance /= 2)
            least = min(least, __shfl_xor_sync(0xffffffffu, least, distance));
        lowest = least;
    }
}
