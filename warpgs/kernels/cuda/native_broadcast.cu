return __shfl_sync(0xffffffffu, value, lane);
