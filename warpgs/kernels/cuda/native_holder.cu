int lane = 0;
for (int step = 16; step > 0; step /= 2)
    lane += (__shfl_sync(0xffffffffu, running_sum, lane + step - 1) <= item) ? step : 0;
return lane;
