int sum = value;
for (int distance = 1; distance < 32; distance *= 2) {
    const int other = __shfl_up_sync(0xffffffffu, sum, distance);
    sum += (threadIdx.x % 32 >= distance) ? other : 0;
}
return sum;
