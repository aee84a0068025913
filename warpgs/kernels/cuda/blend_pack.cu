// Pack Gaussian i, the j-th in order of depth, for blend_image.cu: mean, factor in units of blend_common.cu, opacity; the colour as
// three halves and the upper half of the depth, in 32 bytes. Behind all records stands the largest colour, zero on entry.
// All lanes of the warp must call it.
const auto half_of = [](float v) { return (unsigned)wp::float_to_half(fminf(v, LARGEST_HALF)).u; };
float most = 0.0f;
if (j < count) {
    const float4* row = reinterpret_cast<const float4*>(projected.data) + 3ll * i;
    const float4 a = row[0], b = row[1];
    const float2 c = *reinterpret_cast<const float2*>(row + 2);
    const unsigned green = half_of(b.w) << 16, depth = __float_as_uint(c.y) + 0x8000u & 0xffff0000u;
    float4* record = reinterpret_cast<float4*>(records.data) + 2ll * j;
    record[0] = make_float4(a.x, a.y, a.z * SCALE, a.w * SCALE);
    record[1] = make_float4(b.x * SCALE, b.y, __uint_as_float(half_of(b.z) | green), __uint_as_float(half_of(c.x) | depth));
    most = fmaxf(fmaxf(b.z, b.w), c.x);
}
// not negative, so their bits have the order of the numbers
const int bits = (int)__reduce_max_sync(0xffffffffu, __float_as_uint(most));
int* largest = records.data + 8ll * count;
if (threadIdx.x % 32 == 0 && bits > *largest)
    atomicMax(largest, bits);
