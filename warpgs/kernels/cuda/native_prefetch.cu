#ifndef __CUDA_ARCH__
const char* row = reinterpret_cast<const char*>(rows.data) + static_cast<long long>(i) * rows.strides[0];
__builtin_prefetch(row);
__builtin_prefetch(row + rows.strides[0] - 1);  // a row may lie in two cache lines
#endif
