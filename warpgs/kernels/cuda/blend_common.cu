// Declarations that the blending bodies share. Upper-case names are replaced by numbers before compilation (blend_cuda.py).
// A tile is cut into blocks of 8 x 4 pixels, one pixel a lane. Products and sums that decide alpha have explicit
// rounding: the compiler's choice of fused operations may differ between kernels, and both passes must see one alpha.
constexpr unsigned ALL = 0xffffffffu;
constexpr int WIDE = SIDE / 8, BLOCKS = WIDE * (SIDE / 4), PIXELS = SIDE * SIDE;
constexpr int QUADS = STRIDE / 4, REST = QUADS > 2 ? QUADS - 2 : 1;  // of a projected Gaussian; of its quads after the first two
const int lane = threadIdx.x % 32;
struct Splat {
    // A projected Gaussian; u11 = a.z, u12 = a.w, u22 = b.x in units where the falloff is 2^-|U d|^2. Channels are b.z, b.w and
    // the rest but for the last three, which are depth and half sides.
    float4 a, b, rest[REST];
    __device__ void load(const float* projected, int i) {
        const float4* record = reinterpret_cast<const float4*>(projected) + (long long)QUADS * i;
        a = record[0];
        b = record[1];
        #pragma unroll
        for (int q = 2; q < QUADS; ++q)
            rest[q - 2] = record[q];
    }
    __device__ void unpack() {  // of blend_pack.cu
        const wp::half* halves = reinterpret_cast<const wp::half*>(&b.z);
        rest[0].x = half_to_float(halves[2]);
        rest[0].y = __uint_as_float(__float_as_uint(b.w) & 0xffff0000u);
        b = make_float4(b.x, b.y, half_to_float(halves[0]), half_to_float(halves[1]));
    }
    __device__ float channel(int k) const {
        const float4 v = k < 2 ? b : rest[(k - 2) / 4];
        const int part = (k + 2) % 4;
        return part == 0 ? v.x : part == 1 ? v.y : part == 2 ? v.z : v.w;
    }
    __device__ float depth() const {
        return rest[REST - 1].y;
    }
    __device__ void rescale() {
        a.z *= SCALE;
        a.w *= SCALE;
        b.x *= SCALE;
    }
    // Whether a pixel centre of the block at (left, top), 8 px wide and bottom + 0.5 px high, may have alpha at or above the
    // cut, that is |U d|^2 <= limit. The least |U d|^2 over the block lies on one of the two edges that face the mean. Distances
    // are widened by their largest rounding errors. A NaN is kept; it changes nothing.
    __device__ bool touches(float left, float top, float limit, float bottom = 3.5f) const {
        const float slack_x = 0.01f + 2e-6f * fabsf(a.x), slack_y = 0.01f + 2e-6f * fabsf(a.y);
        const float x0 = left + 0.5f - a.x - slack_x, x1 = left + 7.5f - a.x + slack_x;
        const float y0 = top + 0.5f - a.y - slack_y, y1 = top + bottom - a.y + slack_y;
        const float near_x = fminf(fmaxf(0.0f, x0), x1), near_y = fminf(fmaxf(0.0f, y0), y1);
        const float y = fminf(fmaxf(-__fdividef(a.w * a.z * near_x, a.w * a.w + b.x * b.x), y0), y1);
        const float x = fminf(fmaxf(-__fdividef(a.w * near_y, a.z), x0), x1);
        return !(below(near_x, y) > limit && below(x, near_y) > limit);
    }
    __device__ float below(float dx, float dy) const {
        const float p = a.z * dx, r = a.w * dy, e2 = b.x * dy;
        const float e1 = fmaxf(fabsf(p + r) - 1e-6f * (fabsf(p) + fabsf(r)), 0.0f);
        return (e1 * e1 + e2 * e2) * 0.99999f;
    }
};
// 2^-limit of the opacity is the cut; a cut of 0 has no limit
auto limit_of = [](float opacity, float log_cut) { return (__log2f(opacity) - log_cut) * 1.00001f + 1e-4f; };
auto falloff = [](float e1, float e2) {
    float g;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(g) : "f"(__fmaf_rn(-e1, e1, __fmul_rn(-e2, e2))));
    return g;
};
