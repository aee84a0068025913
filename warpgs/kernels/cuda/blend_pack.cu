// Pack the visible Gaussian j in order of depth for blend_image.cu: mean, factor in units of blend_common.cu, opacity; the colour as
// three halves and the upper half of the depth, in 32 bytes. All threads of the block must call it.
const auto half_of = [](float v) {
    unsigned short h;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(h) : "f"(fminf(v, LARGEST_HALF)));
    return (unsigned)h;
};
float most = 0.0f;
if (j < count) {
    const int i = order.data[j];
    const float4* row = reinterpret_cast<const float4*>(projected.data) + 3ll * i;
    const float4 a = row[0], b = row[1];
    const float2 c = *reinterpret_cast<const float2*>(row + 2);
    counts.data[j] = tile_counts.data[i];
    float4* record = reinterpret_cast<float4*>(records.data) + 2ll * j;
    record[0] = make_float4(a.x, a.y, a.z * SCALE, a.w * SCALE);
    const unsigned green = half_of(b.w) << 16, depth = __float_as_uint(c.y) + 0x8000u & 0xffff0000u;
    record[1] = make_float4(b.x * SCALE, b.y, __uint_as_float(half_of(b.z) | green), __uint_as_float(half_of(c.x) | depth));
    most = fmaxf(fmaxf(b.z, b.w), c.x);
}
for (int distance = 16; distance > 0; distance /= 2)
    most = fmaxf(most, __shfl_xor_sync(0xffffffffu, most, distance));
const int bits = __float_as_int(most);  // ordered as the numbers, which are not negative
if (threadIdx.x % 32 == 0 && bits > largest.data[0])
    atomicMax(&largest.data[0], bits);
