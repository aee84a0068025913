if (skip.data[0] != 0)
    return;
const float head_lr = lrs.data[0], lr = lrs.data[1], root_correction2 = lrs.data[2];
const int size = parameter.shape[0];
// Products and sums that the compiler might fuse have explicit rounding: fusing may differ between kernels, and all kernels
// that update must give the same bits.
auto one = [&](float g, float rate, float& p, float& m, float& s) {
    m = __fmaf_rn(beta1, m, __fmul_rn(rest1, g));
    s = __fmaf_rn(beta2, s, __fmul_rn(__fmul_rn(rest2, g), g));
    p -= rate * m / (sqrtf(s) / root_correction2 + eps);
};
auto lr_of = [&](int i) { return i % row < head ? head_lr : lr; };
if (4 * four + 4 <= size) {
    float4 p = reinterpret_cast<float4*>(parameter.data)[four], m = reinterpret_cast<float4*>(mean.data)[four];
    float4 s = reinterpret_cast<float4*>(square.data)[four];
    const float4 g = reinterpret_cast<const float4*>(gradient.data)[four];
    one(g.x, lr_of(4 * four), p.x, m.x, s.x);
    one(g.y, lr_of(4 * four + 1), p.y, m.y, s.y);
    one(g.z, lr_of(4 * four + 2), p.z, m.z, s.z);
    one(g.w, lr_of(4 * four + 3), p.w, m.w, s.w);
    reinterpret_cast<float4*>(parameter.data)[four] = p;
    reinterpret_cast<float4*>(mean.data)[four] = m;
    reinterpret_cast<float4*>(square.data)[four] = s;
} else
    for (int i = 4 * four; i < size; ++i)
        one(gradient.data[i], lr_of(i), parameter.data[i], mean.data[i], square.data[i]);
