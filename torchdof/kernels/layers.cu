// The layers of torchdof.render.layers.composite on a GPU, forward and backward. NVRTC compiles this file at first use, with the
// numbers CHANNELS, SURFACES, STACKED and LAYERS defined. There is no shared memory, no barrier and no atomic operation: one
// thread writes each result and adds its terms in a fixed order. So the bits are the same each time, and in the tests a CPU
// runs the threads one after the other.
//
// With m the weight of a layer, v the weight behind it and K its kernel, a layer is laid over the picture `out` by
//
//   terms      T = (m I, m, v)                                  of each pixel of the frame, averaged over blocks of pixels
//   convolve   S = K * T
//   composite  u = v + raise(lacking(m, v)),  n = m + u         with m and v from S
//              out = S_light / n + (u / n) out
//
// One launch treats a few layers of one resolution, far to near. Their grid is the canvas (the picture, or, in a coarse
// resolution, a picture with one more pixel on each side) with `inset` pixels around it, which the kernels reach. The tiles
// that no light of a layer reaches are left out.
#include "frame.h"
#include "rules.h"
#include "weights.h"

// Marks the tile of a pixel of the grid in the layers that its pixels of the frame lie in. A pixel at the end of a layer's ramps
// has a gradient there, except in focus. The table is zero before.
extern "C" __global__ void mark(const __grid_constant__ Run r) {
  const int first = first_in_frame(r, pixel_row(), pixel_column()), item = blockIdx.z * r.colours;
  if (first < 0) return;
  float low[SURFACES], high[SURFACES];
  for (int j = 0; j < SURFACES; j++)
    for (int i = 0; i < r.scale * r.scale; i++) {
      const float place = r.place[j][blockIdx.z * area_of_frame(r) + first + i / r.scale * r.frame_columns + i % r.scale];
      low[j] = i ? torchdof::min(low[j], place) : place;
      high[j] = i ? torchdof::max(high[j], place) : place;
    }
  for (int i = 0; i < r.layers; i++) {
    const Ramps l = ramps_of(r, item, i);
    bool any = false;
    for (int j = 0; j < SURFACES; j++) {
      const float a = l.at_or_behind(high[j]), b = l.behind(low[j]);
      any |= low[j] == 0 && high[j] == 0 ? a > 0 && b < 1 : a >= 0 && b <= 1;
    }
    if (any && l.start != l.next_start) r.occupied[tile_at(r, item, i, blockIdx.y, blockIdx.x)] = 1;  // else the item has no such layer
  }
}

// Whether a table of tiles has one within `half` pixels of a tile. One thread a tile; blockIdx.z counts items, and layers in them.
__device__ inline bool any_near(const Run &r, const signed char *table, int row, int column) {
  const int layer = blockIdx.z % r.layers, half = r.half[layer], item = blockIdx.z / r.layers * r.colours;
  const int last_row = min((row * TILE_ROWS + TILE_ROWS - 1 + half) / TILE_ROWS, r.tile_rows - 1);
  const int last_column = min((column * TILE_COLUMNS + TILE_COLUMNS - 1 + half) / TILE_COLUMNS, r.tile_columns - 1);
  for (int y = max(row * TILE_ROWS - half, 0) / TILE_ROWS; y <= last_row; y++)
    for (int x = max(column * TILE_COLUMNS - half, 0) / TILE_COLUMNS; x <= last_column; x++)
      if (table[tile_at(r, item, layer, y, x)]) return true;
  return false;
}
extern "C" __global__ void find_lit(const __grid_constant__ Run r) {
  const int row = pixel_row(), column = pixel_column(), y = row * TILE_ROWS - r.inset, x = column * TILE_COLUMNS - r.inset;
  if (row >= r.tile_rows || column >= r.tile_columns) return;
  const bool in_canvas = y >= 0 && x >= 0 && y < r.height && x < r.width;
  r.lit[tile_at(r, blockIdx.z / r.layers * r.colours, blockIdx.z % r.layers, row, column)] = in_canvas && any_near(r, r.occupied, row, column);
}
extern "C" __global__ void find_read(const __grid_constant__ Run r) {
  const int row = pixel_row(), column = pixel_column();
  if (row >= r.tile_rows || column >= r.tile_columns) return;
  r.read[tile_at(r, blockIdx.z / r.layers * r.colours, blockIdx.z % r.layers, row, column)] = any_near(r, r.lit, row, column);
}

// The terms of a pixel of the grid in all layers: one thread has them all, so that the surfaces stay in the cache.
extern "C" __global__ void terms(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z, first = first_in_frame(r, y, x);
  if (y >= r.rows || x >= r.columns) return;
  for (int layer = 0; layer < r.layers; layer++) {
    if (!r.read[tile_at(r, item, layer, blockIdx.y, blockIdx.x)]) continue;
    const Ramps l = ramps_of(r, item, layer);
    float sum[VALUES] = {};  // outside of the frame 0, because convolve multiplies it by 0
    for (int i = 0; first >= 0 && i < r.scale * r.scale; i++) {
      const int at = first + i / r.scale * r.frame_columns + i % r.scale;
      const Pixel p = pixel_of(r, item, at);
      const Weights w = weigh(l, p);
      for (int j = 0; j < SURFACES; j++) {
        for (int c = 0; c < CHANNELS; c++) sum[c] += light_of(r, p, j, light_at(r, item, c, at)) * w.own[j];
        sum[OWN] += w.own[j];
      }
      sum[BEYOND] += w.beyond;
    }
    float *const to = r.terms + ((long long)item * r.layers + layer) * VALUES * area_of_grid(r) + y * r.columns + x;
    for (int n = 0; n < VALUES; n++) to[n * area_of_grid(r)] = sum[n] / (r.scale * r.scale);
  }
}

// Convolves the first VALUES planes of a grid at the ROWS pixels from (y, x) on. turned: with the kernel turned, which scatters.
// Each column is summed by itself first, because long sums round badly.
__device__ inline void convolve(const Run &r, const float *planes, int item, int layer, int y, int x, bool turned, float (&sum)[ROWS][VALUES]) {
  const int half = r.half[layer], side = 2 * half + 1, step = turned ? -1 : 1;
  const float *const kernel = r.kernel[layer] + (long long)(item % r.sets) * side * side + (turned ? side * side - 1 : 0);
  const int first = max(half - y, 0), last = min(side + ROWS - 1, r.rows + half - y);  // rows of the grid that are read
  for (int dx = max(half - x, 0); dx < min(side, r.columns + half - x); dx++) {
    auto tap_at = [&](int dy) { return dy >= 0 && dy < side ? kernel[step * (dy * side + dx)] : 0.0f; };
    float tap[ROWS], part[ROWS][VALUES] = {};
    for (int j = 0; j < ROWS; j++) tap[j] = tap_at(first - 1 - j);
    const float *value = planes + (y - half + first) * r.columns + x - half + dx;
    for (int dy = first; dy < last; dy++, value += r.columns) {
#pragma unroll
      for (int j = ROWS - 1; j > 0; j--) tap[j] = tap[j - 1];
      tap[0] = tap_at(dy);
      float v[VALUES];
#pragma unroll
      for (int n = 0; n < VALUES; n++) v[n] = value[n * area_of_grid(r)];
#pragma unroll
      for (int j = 0; j < ROWS; j++)
#pragma unroll
        for (int n = 0; n < VALUES; n++) part[j][n] += tap[j] * v[n];
    }
#pragma unroll
    for (int j = 0; j < ROWS; j++)
#pragma unroll
      for (int n = 0; n < VALUES; n++) sum[j][n] += part[j][n];
  }
}

// First pixel of the ROWS pixels of this thread.
__device__ inline int first_row() { return blockIdx.y * TILE_ROWS + threadIdx.y * ROWS; }

// Lays the layers over the canvas, far to near, at ROWS pixels. For the gradients it keeps the blurred terms, and the gradient's
// product with the canvas behind each layer.
extern "C" __global__ void composite(const __grid_constant__ Run r) {
  const int y = first_row(), x = pixel_column(), item = blockIdx.z;
  if (y >= r.height || x >= r.width) return;
  float out[ROWS][PLANES];
  for (int j = 0; j < ROWS; j++)
    for (int n = 0; n < PLANES; n++) out[j][n] = y + j < r.height ? before_at(r, item, n, (y + j) * r.width + x) : 0.0f;
  for (int i = 0; i < r.layers; i++) {
    if (!r.lit[canvas_tile(r, item, i)]) continue;
    const long long layer = (long long)item * r.layers + i;
    float sum[ROWS][VALUES] = {};
    convolve(r, r.terms + layer * VALUES * area_of_grid(r), item, i, y + r.inset, x + r.inset, true, sum);
    for (int j = 0; j < ROWS; j++) {
      if (y + j >= r.height) break;
      const float *s = sum[j];
      if (r.kept) {
        float *const to = r.kept + layer * KEPT * area_of_grid(r) + (y + j + r.inset) * r.columns + x + r.inset;
        float product = 0;
        for (int n = 0; n < PLANES; n++) product += r.of_after[((long long)item * PLANES + n) * area_of_canvas(r) + (y + j) * r.width + x] * out[j][n];
        for (int n = 0; n < VALUES; n++) to[n * area_of_grid(r)] = s[n];
        to[VALUES * area_of_grid(r)] = product;
      }
      const float beyond = s[BEYOND] + raise(lacking(s[OWN], s[BEYOND])), known = s[OWN] + beyond, left = beyond / known;
      for (int c = 0; c < CHANNELS; c++) out[j][c] = s[c] / known + left * out[j][c];
      out[j][OWN] = (r.backed ? 0.0f : s[OWN] / known) + left * out[j][OWN];
    }
  }
  if (!r.after) return;
  for (int j = 0; j < ROWS; j++)
    for (int n = 0; n < PLANES; n++)
      if (y + j < r.height) r.after[((long long)item * PLANES + n) * area_of_canvas(r) + (y + j) * r.width + x] = out[j][n];
}

// Walks back through the layers, near to far, at a pixel of the canvas: from the gradient g of the canvas to those of the blurred terms.
// With F the transmittance of nearer layers, P the kept product of g with what lies behind, O = (g S + P u) / n that with the layer,
//   of S_light = g F / n,  of u = F (P - O) / n,  of m = F (g_coverage - O) / n + of u du/dm,  of v = of u (1 + du/dm).
extern "C" __global__ void walk_back(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z;
  if (y >= r.height || x >= r.width) return;
  float *const of_after = r.of_after + (long long)item * PLANES * area_of_canvas(r) + y * r.width + x;
  float g[PLANES], front = 1;
  for (int n = 0; n < PLANES; n++) g[n] = of_after[n * area_of_canvas(r)];
  const float of_coverage = r.backed ? 0.0f : g[OWN];
  for (int i = r.layers - 1; i >= 0; i--) {
    if (!r.lit[canvas_tile(r, item, i)]) continue;
    float *const kept = r.kept + ((long long)item * r.layers + i) * KEPT * area_of_grid(r) + (y + r.inset) * r.columns + x + r.inset;
    float s[KEPT];
    for (int n = 0; n < KEPT; n++) s[n] = kept[n * area_of_grid(r)];
    const float lacks = lacking(s[OWN], s[BEYOND]), beyond = s[BEYOND] + raise(lacks), per = 1 / (s[OWN] + beyond);
    const float behind = s[VALUES];
    float with_layer = of_coverage * s[OWN] + beyond * behind;
    for (int c = 0; c < CHANNELS; c++) with_layer += g[c] * s[c];
    with_layer *= per;
    const float of_beyond = front * per * (behind - with_layer), slope = slope_of_raise(lacks);
    for (int c = 0; c < CHANNELS; c++) kept[c * area_of_grid(r)] = g[c] * front * per;
    kept[OWN * area_of_grid(r)] = front * per * (of_coverage - with_layer) + of_beyond * slope;
    kept[BEYOND * area_of_grid(r)] = of_beyond * (1 + slope);
    front *= beyond * per;
  }
  for (int n = 0; n < PLANES; n++) of_after[n * area_of_canvas(r)] = g[n] * front;
}

// The gradients of the terms, in their place, at ROWS pixels of the grid: the kernel applied to those of the blurred terms.
// blockIdx.z counts items, and layers in them.
extern "C" __global__ void convolve_back(const __grid_constant__ Run r) {
  const int y = first_row(), x = pixel_column(), item = blockIdx.z / r.layers, layer = blockIdx.z % r.layers;
  if (!r.read[tile_at(r, item, layer, blockIdx.y, blockIdx.x)] || y >= r.rows || x >= r.columns) return;
  float sum[ROWS][VALUES] = {};
  convolve(r, r.kept + (long long)blockIdx.z * KEPT * area_of_grid(r), item, layer, y, x, false, sum);
  float *const to = r.terms + (long long)blockIdx.z * VALUES * area_of_grid(r) + y * r.columns + x;
  for (int j = 0; j < ROWS; j++)
    for (int n = 0; n < VALUES; n++)
      if (y + j < r.rows) to[n * area_of_grid(r) + j * r.columns] = sum[j][n];
}

// Adds the gradients by the surfaces of a pixel of the frame.
extern "C" __global__ void __launch_bounds__(TILE_ROWS * TILE_COLUMNS) terms_back(const __grid_constant__ Run r) {
  const int y = pixel_row() / r.scale, x = pixel_column() / r.scale, item = blockIdx.z, first = first_in_frame(r, y, x);
  if (first < 0) return;
  const int at = first + pixel_row() % r.scale * r.frame_columns + pixel_column() % r.scale;
  const Pixel p = pixel_of(r, item, at);
  const float each = 1.0f / (r.scale * r.scale);
  const auto each_layer = [&](const auto &use) {
    for (int i = 0; i < r.layers; i++)
      if (r.read[tile_at(r, item, i, y / TILE_ROWS, x / TILE_COLUMNS)])
        use(ramps_of(r, item, i), r.terms + ((long long)item * r.layers + i) * VALUES * area_of_grid(r) + y * r.columns + x);
  };
  {  // the light first, because all gradients together need more registers than there are
    float of_light[SURFACES][CHANNELS] = {};
    each_layer([&](const Ramps &l, const float *of_terms) {
      const Weights w = weigh(l, p);
      for (int c = 0; c < CHANNELS; c++)
        for (int j = 0; j < SURFACES; j++) of_light[j][c] += of_terms[c * area_of_grid(r)] * w.own[j];
    });
    for (int j = 0; j < SURFACES; j++)
      for (int c = 0; c < CHANNELS; c++) (p.swapped ? r.of_light[SURFACES - 1 - j] : r.of_light[j])[light_at(r, item, c, at)] += of_light[j][c] * each;
  }
  float of_place[SURFACES] = {}, of_weight[SURFACES] = {};
  each_layer([&](const Ramps &l, const float *of_terms) {
    Weights of = {{}, of_terms[BEYOND * area_of_grid(r)]};
    for (int j = 0; j < SURFACES; j++) {
      of.own[j] = of_terms[OWN * area_of_grid(r)];
      for (int c = 0; c < CHANNELS; c++) of.own[j] += of_terms[c * area_of_grid(r)] * light_of(r, p, j, light_at(r, item, c, at));
    }
    weigh_back(l, p, of, of_place, of_weight);
  });
  for (int j = 0; j < SURFACES; j++) of_place[j] *= each, of_weight[j] *= each;
  add_to(r, item, at, p, of_place, of_weight);
}

// Lays the stand-ins over the picture.
extern "C" __global__ void stand_ins(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z, here = y * r.width + x;
  if (y >= r.height || x >= r.width) return;
  const int at = (y + r.margin) * r.frame_columns + x + r.margin;
  const Pixel p = pixel_of(r, item, at);
  const auto t = stand_ins_of(p);
  for (int n = 0; n < PLANES; n++) {
    float light = n < CHANNELS || r.backed ? 0.0f : t.sum;
    for (int j = 0; j < SURFACES && n < CHANNELS; j++) light += light_of(r, p, j, light_at(r, item, n, at)) * t.cover[j];
    r.after[((long long)item * PLANES + n) * area_of_canvas(r) + here] = light + (1 - t.sum) * before_at(r, item, n, here);
  }
}
extern "C" __global__ void stand_ins_back(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z, here = y * r.width + x;
  if (y >= r.height || x >= r.width) return;
  const int at = (y + r.margin) * r.frame_columns + x + r.margin;
  const Pixel p = pixel_of(r, item, at);
  const auto t = stand_ins_of(p);
  float of_cover[SURFACES] = {}, of_place[SURFACES] = {}, of_weight[SURFACES] = {};
  for (int n = 0; n < PLANES; n++) {
    float &g = r.of_after[((long long)item * PLANES + n) * area_of_canvas(r) + here];
    const float behind = before_at(r, item, n, here);
    for (int j = 0; j < SURFACES; j++) {
      const long long light = light_at(r, item, n, at);
      of_cover[j] += g * ((n < CHANNELS ? light_of(r, p, j, light) : r.backed ? 0.0f : 1.0f) - behind);
      if (n < CHANNELS) (p.swapped ? r.of_light[SURFACES - 1 - j] : r.of_light[j])[light] += g * t.cover[j];
    }
    g *= 1 - t.sum;
  }
  t.back(of_cover, of_place, of_weight);
  add_to(r, item, at, p, of_place, of_weight);
}

// A coarse canvas, interpolated at a pixel of the picture: rows and columns of the four pixels around it, and their weights.
struct Taps {
  int row, column;
  float down, right;
};
__device__ inline Taps taps_at(const Run &r, int y, int x) {
  const float row = (y + 0.5f) / r.scale + 0.5f, column = (x + 0.5f) / r.scale + 0.5f;
  return {(int)row, (int)column, row - (int)row, column - (int)column};
}
__device__ inline float coarse_at(const Run &r, int item, int plane, const Taps &t) {
  const float *c = r.coarse + (((long long)item * PLANES + plane) * r.coarse_height + t.row) * r.coarse_width + t.column;
  const float above = c[0] + t.right * (c[1] - c[0]), below = c[r.coarse_width] + t.right * (c[r.coarse_width + 1] - c[r.coarse_width]);
  return above + t.down * (below - above);
}
// The part of the picture that passes through a coarse canvas, by its last plane.
__device__ inline float passing(const Run &r, float last_plane) { return r.backed ? last_plane : torchdof::max(1 - last_plane, 0.0f); }

// Lays a coarse canvas over the picture.
extern "C" __global__ void upsample(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z, at = y * r.width + x;
  if (y >= r.height || x >= r.width) return;
  const Taps t = taps_at(r, y, x);
  const float last = coarse_at(r, item, OWN, t), left = passing(r, last);
  for (int n = 0; n < PLANES; n++) {
    const float front = n < CHANNELS ? coarse_at(r, item, n, t) : r.backed ? 0.0f : last;
    r.after[((long long)item * PLANES + n) * area_of_canvas(r) + at] = front + left * before_at(r, item, n, at);
  }
}
// The gradient of a pixel of the coarse canvas: a sum over the pixels of the picture that it is interpolated for.
extern "C" __global__ void upsample_back(const __grid_constant__ Run r) {
  const int row = pixel_row(), column = pixel_column(), item = blockIdx.z, s = r.scale;
  if (row >= r.coarse_height || column >= r.coarse_width) return;
  float sum[PLANES] = {};
  for (int y = max(s * row - 3 * s / 2, 0); y < min(s * row + s / 2, r.height); y++)
    for (int x = max(s * column - 3 * s / 2, 0); x < min(s * column + s / 2, r.width); x++) {
      const Taps t = taps_at(r, y, x);
      const float weight = (t.row == row ? 1 - t.down : t.down) * (t.column == column ? 1 - t.right : t.right);
      float of_left = 0;
      for (int n = 0; n < PLANES; n++) {
        const int at = y * r.width + x;
        const float g = r.of_after[((long long)item * PLANES + n) * area_of_canvas(r) + at];
        of_left += g * before_at(r, item, n, at);
        sum[n] += n < CHANNELS || !r.backed ? weight * g : 0.0f;
      }
      sum[OWN] += weight * (r.backed ? of_left : -of_left);
    }
  for (int n = 0; n < PLANES; n++) r.of_coarse[(((long long)item * PLANES + n) * r.coarse_height + row) * r.coarse_width + column] = sum[n];
}
// Then the gradient of the picture behind it.
extern "C" __global__ void pass_back(const __grid_constant__ Run r) {
  const int y = pixel_row(), x = pixel_column(), item = blockIdx.z;
  if (y >= r.height || x >= r.width) return;
  const float left = passing(r, coarse_at(r, item, OWN, taps_at(r, y, x)));
  for (int n = 0; n < PLANES; n++) r.of_after[((long long)item * PLANES + n) * area_of_canvas(r) + y * r.width + x] *= left;
}
