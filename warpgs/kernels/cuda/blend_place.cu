// One warp composites PER blocks of 8 x 4 pixels, one below the other, a pixel of each in a lane:
// item = position of the tile in the order (long lists first) * (BLOCKS / PER) + part.
const int warp = threadIdx.x / 32;
const int place = item / (BLOCKS / PER), part = item % (BLOCKS / PER);
// The tiles of each rank stand in a row of the order, those of the first ranks come first; there are 33 ranks.
int upto = counts.data[lane];
for (int distance = 1; distance < 32; distance *= 2) {
    const int other = __shfl_up_sync(ALL, upto, distance);
    upto += lane >= distance ? other : 0;
}
const int rank = __popc(__ballot_sync(ALL, upto <= place));
const int before = rank > 0 ? __shfl_sync(ALL, upto, rank - 1) : 0;
const int tile = order.data[(long long)rank * (ranges.shape[0] / 2) + place - before];
const int camera = tile / tiles, in_camera = tile - camera * tiles;
const int block = part / WIDE * PER * WIDE + part % WIDE;  // the first one; the next lies WIDE further
const int left = (in_camera % columns) * SIDE + (block % WIDE) * 8, top = (in_camera / columns) * SIDE + (block / WIDE) * 4;
const int x = left + lane % 8, y = top + lane / 8;
const float px = origin_x + x + 0.5f, py = origin_y + y + 0.5f;
