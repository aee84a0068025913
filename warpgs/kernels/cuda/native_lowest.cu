return __ffs(mask) - 1;
