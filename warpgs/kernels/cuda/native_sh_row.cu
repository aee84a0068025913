// Hand each number of a row of K x 3 floats to `take`. Rows are a multiple of 16 bytes for K = 4 and 16, not for 25. Numbers past
// the count are loaded but not used: they may be anything, also NaN.
if (size % 4 == 0) {
    #pragma unroll
    for (int q = 0; q < (3 * BASES + 3) / 4; ++q)
        if (4 * q < 3 * count) {
            const float4 v = reinterpret_cast<const float4*>(row)[q];
            take(4 * q, v.x);
            take(4 * q + 1, v.y);
            take(4 * q + 2, v.z);
            take(4 * q + 3, v.w);
        }
} else {
    #pragma unroll
    for (int i = 0; i < 3 * BASES; ++i)
        if (i < 3 * count)
            take(i, row[i]);
}
