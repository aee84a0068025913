// Fields of the settings under their own names (Pass of falloff.py).
const int origin_x = settings.origin_x, origin_y = settings.origin_y, width = settings.width, height = settings.height;
const int columns = settings.columns, tiles = settings.tiles, inclusive = settings.inclusive, whole_tiles = settings.whole_tiles;
const float alpha_cut = settings.alpha_cut, log_cut = __log2f(alpha_cut), alpha_max = settings.alpha_max, stop = settings.stop;
