// The frame that the kernels of layers.cu composite, and where its values and those of a launch lie in memory.
#pragma once

constexpr int TILE_ROWS = 16, TILE_COLUMNS = 32;  // of the tiles of a grid, in its pixels: a block of threads
constexpr int ROWS = 4;                            // pixels of a column that one thread convolves
constexpr int OWN = CHANNELS, BEYOND = CHANNELS + 1, VALUES = CHANNELS + 2;  // terms: light, m and v
constexpr int PLANES = CHANNELS + 1;  // of a picture: light, and the transmittance of all layers or, without light behind, their coverage
constexpr int KEPT = VALUES + 1;      // for the gradients: blurred terms, and the gradient's product with the canvas behind the layer

// What a kernel works on, filled in by layers.py: one member a line. Gradients of x are named of_x.
struct Run {
  const float *light[SURFACES];  // of the frame's surfaces, [items, CHANNELS, frame_rows, frame_columns]
  const float *place[SURFACES];  // on the blur axis, [items / colours, frame_rows, frame_columns]
  const float *weight[SURFACES];  // the same; null: 1
  float *of_light[SURFACES];  // each [items, ..., frame_rows, frame_columns]
  float *of_place[SURFACES];
  float *of_weight[SURFACES];  // null where weight is
  const float *kernel[LAYERS];  // of each layer, far to near, [sets, 2 half + 1, 2 half + 1]
  int half[LAYERS];
  const float *ramps;  // start and width, [plans, 2, all_layers + 1]
  signed char *occupied;  // tiles with pixels in a layer, [items / colours, layers, tile_rows, tile_columns]
  signed char *lit;  // tiles of the canvas that a layer's light reaches
  signed char *read;  // tiles whose terms these need
  float *terms;  // [items, layers, VALUES, rows, columns]; their gradients
  float *kept;  // [items, layers, KEPT, rows, columns]; gradients of the first VALUES; null: nothing is kept
  const float *before;  // canvas before these layers, [items, PLANES, height, width]; null: no layer yet
  float *after;  // canvas with these layers
  const float *coarse;  // coarse canvas to lay over the picture, [items, PLANES, coarse_height, coarse_width]
  float *of_coarse;
  float *of_after;  // gradient of the canvas after, becomes that of the canvas before
  int colours;  // items that share their places and weights: colours with kernels of their own
  int plans;  // rows of the ramps: 1, or items / colours
  int sets;  // kernels of a layer: item i has kernel i % sets
  int all_layers;
  int layers;
  int farthest;  // index of the first of these layers, counted from near to far
  int scale;  // pixels of the frame for each of the grid, in both directions
  int start;  // pixels of the frame before the grid; negative: the grid begins outside of the frame
  int rows;
  int columns;
  int tile_rows;
  int tile_columns;
  int inset;  // a multiple of both sides of a tile
  int height;
  int width;
  int coarse_height;
  int coarse_width;
  int frame_rows;
  int frame_columns;
  int margin;  // pixels of the frame around the picture
  int backed;  // whether there is light behind all layers
};

__device__ inline int pixel_row() { return blockIdx.y * TILE_ROWS + threadIdx.y; }
__device__ inline int pixel_column() { return blockIdx.x * TILE_COLUMNS + threadIdx.x; }
__device__ inline long long area_of_frame(const Run &r) { return (long long)r.frame_rows * r.frame_columns; }
__device__ inline long long area_of_grid(const Run &r) { return (long long)r.rows * r.columns; }
__device__ inline long long area_of_canvas(const Run &r) { return (long long)r.height * r.width; }

// Index of a tile in the tables, for a layer of an item.
__device__ inline long long tile_at(const Run &r, int item, int layer, int row, int column) {
  return (((long long)(item / r.colours) * r.layers + layer) * r.tile_rows + row) * r.tile_columns + column;
}
// The same for the tile of the canvas in which this block lies.
__device__ inline long long canvas_tile(const Run &r, int item, int layer) {
  return tile_at(r, item, layer, blockIdx.y + r.inset / TILE_ROWS, blockIdx.x + r.inset / TILE_COLUMNS);
}
// First pixel of the frame in a pixel of the grid, or -1 if it lies outside.
__device__ inline int first_in_frame(const Run &r, int y, int x) {
  const int row = y * r.scale + r.start, column = x * r.scale + r.start;
  const bool inside = y < r.rows && x < r.columns && row >= 0 && column >= 0 && row < r.frame_rows && column < r.frame_columns;
  return inside ? row * r.frame_columns + column : -1;
}
// A plane of the canvas before these layers.
__device__ inline float before_at(const Run &r, int item, int plane, int at) {
  if (r.before) return r.before[((long long)item * PLANES + plane) * area_of_canvas(r) + at];
  return plane < CHANNELS || !r.backed ? 0.0f : 1.0f;
}

// The ramps of a layer: the shares of a surface at or behind it, and behind it, before their limits.
struct Ramps {
  float start, width, next_start, next_width;
  __device__ float at_or_behind(float place) const { return (place - start) / width; }  // a division: exact at both ends
  __device__ float behind(float place) const { return (place - next_start) / next_width; }
};
__device__ inline Ramps ramps_of(const Run &r, int item, int layer) {
  const float *starts = r.ramps + (item / r.colours) % r.plans * 2 * (r.all_layers + 1) + r.farthest - layer;
  const float *widths = starts + r.all_layers + 1;
  return {starts[0], widths[0], starts[1], widths[1]};
}

// The surfaces of a pixel, near to far.
struct Pixel {
  bool swapped;  // whether the frame's second surface is the nearer one
  float place[SURFACES], weight[SURFACES];
};
__device__ inline Pixel pixel_of(const Run &r, int item, int at) {
  const long long place = item / r.colours * area_of_frame(r) + at;
  Pixel p;
  p.swapped = !STACKED && r.place[SURFACES - 1][place] < r.place[0][place];
  for (int j = 0; j < SURFACES; j++) {
    const float *weight = p.swapped ? r.weight[SURFACES - 1 - j] : r.weight[j];
    p.place[j] = (p.swapped ? r.place[SURFACES - 1 - j] : r.place[j])[place];
    p.weight[j] = weight ? weight[place] : 1.0f;
  }
  return p;
}
// Offset of a channel of light, and the light of surface j of the pixel there.
__device__ inline long long light_at(const Run &r, int item, int channel, int at) {
  return ((long long)item * CHANNELS + channel) * area_of_frame(r) + at;
}
__device__ inline float light_of(const Run &r, const Pixel &p, int j, long long light) {
  return (p.swapped ? r.light[SURFACES - 1 - j] : r.light[j])[light];
}
// Adds the gradients by places and weights.
__device__ inline void add_to(const Run &r, int item, int at, const Pixel &p, const float *of_place, const float *of_weight) {
  const long long place = item * area_of_frame(r) + at;
  for (int j = 0; j < SURFACES; j++) {
    (p.swapped ? r.of_place[SURFACES - 1 - j] : r.of_place[j])[place] += of_place[j];
    float *sum = p.swapped ? r.of_weight[SURFACES - 1 - j] : r.of_weight[j];
    if (sum) sum[place] += of_weight[j];
  }
}
