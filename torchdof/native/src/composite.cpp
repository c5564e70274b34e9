// Composites the layers from far to near, as described in render/layers/composite.py. With m a layer's share of each
// pixel and M the share at or behind the layer (its normalizer), K its kernel and I its light:
//
//   colour = K * (m I) / K * M,   coverage = K * m / K * M,   picture = colour + (1 - coverage) picture
//
// Runs of layers of a coarser resolution are composited first, each on a canvas of its own resolution. Then each tile
// composites its full-resolution layers and these canvases while it is in the cache.
#include "composite.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "blocks.h"
#include "border.h"
#include "constants/composite.h"
#include "convolution.h"
#include "disocclusion.h"
#include "downsampling.h"
#include "field_mask.h"
#include "highlights.h"
#include "job.h"
#include "layers.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"

namespace torchdof {
namespace {

using constants::composite::LEAST;
constexpr float COVERED = 1e-6f;  // an uncovered part up to this is a rounding error
constexpr int TILE_PIXELS = TILE * TILE;
constexpr int PART = 16;                // side in pixels of the parts of a coarse canvas that are skipped if empty
constexpr float EVEN_SQUARED = 1e-12f;  // square of the difference from 1 up to which a normalizer counts as 1

// Consecutive layers of one resolution, composited together. Under occlusion a coarse run lies on one side of the
// focus; without occlusion the order does not matter, and all layers of one resolution form one run.
struct Run {
  int scale, first, last, half;
  int tile_rows = 0, tile_columns = 0, rows = 0, columns = 0;  // of its canvas, which has a margin of one pixel
  Buffer<float> canvas;                                        // light and coverage
  int part_columns = 0;                                        // number of parts in a row of parts
  std::vector<uint8_t> used;                                   // parts that are not empty
};

// Pieces (sparse block means, see Downsampled) in a window. Those between node i and the next are sorted[start[i]] to
// sorted[start[i + 1]].
struct WindowPiece {
  const float *values;
  uint16_t row, column, node;
  bool normalizer_only;
};
struct WindowPieces {
  std::vector<WindowPiece> unsorted, sorted;
  std::vector<int> start;
};

// The part of a window inside one block of pixels: pointers to its surfaces, and which of its terms are still valid.
struct WindowBlock {
  struct Surface {
    const float *light, *weight;  // from the block's first row in the window; weight null: 1
    int light_pitch, weight_pitch;
    size_t channel;  // distance between channels
  };
  int top, rows, column;  // in the window
  Surface surfaces[2];
  int count;
  const uint64_t *layers;  // that occur in it
  bool clear;              // light and share of its terms are 0
  // State of its normalizer term: out of date, constant, or KEPT, valid behind the same number of the block's layers.
  enum Normalizer { STALE, ZERO, ONE, KEPT } normalizer;
  int before;  // with KEPT: layers of the block before that for which the term was computed
  uint32_t partial[BLOCK], varying[BLOCK];  // column marks of each row, stored with a KEPT normalizer
};

// A layer's kernels after masking by the lens's field, for one block of the layer's pixels.
struct MaskedKernels {
  const Layer *layer = nullptr;
  int row = 0, column = 0;
  std::vector<Kernel> kernels;  // one for each colour
};

// Buffers of a thread. Planes of a window have `pitch` values a row.
struct Scratch {
  std::vector<float> memory;
  std::vector<float *> light, coc, weight;  // of each surface (light: [surfaces, channels])
  std::vector<float *> term;                // of one layer: light, share, normalizer
  std::vector<float *> canvas;              // light and coverage of a tile
  float *traced;                            // light of highlights in a tile
  float *farther;                           // weight of surfaces that lie wholly behind a coarse layer
  // column marks (see `mark`) of each row: where the layer has a share, where its normalizer exceeds the share (so that
  // coverage is below 1), and where the normalizer differs from 1
  std::vector<uint32_t> occupied, partial, varying, every;
  std::vector<MaskedKernels> masked_kernels = std::vector<MaskedKernels>(TILE / FieldMask::COLUMNS);
  std::vector<const float *> pointers;
  std::vector<vec> missing, cover;  // of each surface, for the stand-ins
  std::vector<uint64_t> layers, block_layers;
  std::vector<WindowBlock> blocks;
  WindowPieces pieces;
};

}  // namespace

class Composite {
 public:
  Composite(const Job &job, const RayKernels &ray_kernels, float *out)
      : job_(job), s_(job.surfaces), layers_(job.layers), ray_kernels_(ray_kernels), out_(out) {}

  // 1. Group consecutive layers of one scale into runs.
  // 2. Find the layers of each cell, the light beyond the border, and the surfaces at the scales of coarse runs.
  // 3. Composite the tiles of coarse runs, then those of the picture.
  void run() {
    H_ = job_.height, W_ = job_.width, C_ = job_.channels, E_ = job_.colours, N_ = (int)layers_.size();
    over_ = job_.scene.occlusion;
    index_.low = (float)layers_.front().node;
    index_.high = (float)layers_.back().node;
    int half = 0;
    for (int k = 0; k < N_; k++) {
      const Layer &l = layers_[k];
      half = std::max(half, l.half);
      auto run = std::find_if(runs_.begin(), runs_.end(), [&](const Run &r) {
        const bool follows = &r == &runs_.back() && (l.scale == 1 || (layers_[r.first].node < 0) == (l.node < 0));
        return r.scale == l.scale && (follows || !over_);
      });
      if (run == runs_.end()) {
        run = runs_.emplace(run);
        run->scale = l.scale;
        run->first = k;
        run->half = 0;
      }
      run->last = k;
      run->half = std::max(run->half, l.half);
    }
    window_ = TILE + 2 * half;
    pitch_ = (window_ + 15) / 16 * 16 + 3 * BLOCK;  // rows are read in whole blocks
    scratches_.resize(std::max(1, job_.scene.threads));
    index();
    fine_.assign(index_.words, 0);
    for (int k = 0; k < N_; k++)
      if (layers_[k].scale == 1) fine_[k / 64] |= 1ull << k % 64;
    int farthest = 0;  // pixels beyond the frame that any layer reads
    for (const Layer &l : layers_) farthest = std::max(farthest, l.scale * (l.half + 2) + 2 * BLOCK);
    border_ = border_of(job_, farthest);
    std::vector<std::pair<int, int>> coarse;  // run and tile
    for (int r = 0; r < (int)runs_.size(); r++) {
      Run &run = runs_[r];
      if (run.scale == 1) continue;
      run.rows = ceil_div(H_, run.scale) + 2;
      run.columns = ceil_div(W_, run.scale) + 2;
      run.tile_rows = ceil_div(run.rows, TILE);
      run.tile_columns = ceil_div(run.columns, TILE);
      run.part_columns = run.tile_columns * (TILE / PART);
      run.used.assign((size_t)run.tile_rows * (TILE / PART) * run.part_columns, 0);
      run.canvas = Buffer<float>((size_t)(C_ + E_) * run.rows * run.columns + PART);  // rows are read in whole vectors
      for (int t = 0; t < run.tile_rows * run.tile_columns; t++) coarse.push_back({r, t});
      if (s_.independent || downsampled(run.scale)) continue;
      int margin = 0;
      for (const Run &same : runs_)
        if (same.scale == run.scale) margin = std::max(margin, same.half + 1);
      downsampled_.emplace_back(new Downsampled(job_, run.scale, margin));
      downsampled_.back()->take(job_, index_, border_);
    }
    job_.parallel((int)coarse.size(),
                  [&](int i, int worker) { coarse_tile(runs_[coarse[i].first], coarse[i].second, scratch(worker)); });
    if (!job_.rays.empty()) sort_rays();
    const int columns = ceil_div(W_, TILE);
    job_.parallel(ceil_div(H_, TILE) * columns,
                  [&](int i, int worker) { tile(i / columns, i % columns, scratch(worker)); });
  }

 private:
  // Index of a pixel in the planes of a window.
  size_t in_window(int y, int x) const { return (size_t)y * pitch_ + x; }

  Scratch &scratch(int worker) {
    if (!scratches_[worker]) {
      scratches_[worker].reset(new Scratch());
      Scratch &b = *scratches_[worker];
      const size_t plane = (size_t)window_ * pitch_;
      const int count = s_.count, planes = count * (C_ + 2) + (C_ + 2) + 1;
      b.memory.assign(planes * plane + (size_t)(2 * C_ + E_) * TILE_PIXELS + 16, 0.0f);
      float *p = b.memory.data();
      auto take = [&](size_t size) { return (p += size) - size; };
      for (int i = 0; i < count * C_; i++) b.light.push_back(take(plane));
      for (int i = 0; i < count; i++) b.coc.push_back(take(plane)), b.weight.push_back(take(plane));
      for (int i = 0; i < C_ + 2; i++) b.term.push_back(take(plane));
      b.farther = take(plane);
      b.traced = take((size_t)C_ * TILE_PIXELS);
      for (int i = 0; i < C_ + E_; i++) b.canvas.push_back(take(TILE_PIXELS));
      for (auto *rows : {&b.occupied, &b.partial, &b.varying}) rows->resize(window_);
      b.every.assign(window_, ~0u);
      b.pointers.resize(C_);
      b.missing.resize(s_.count);
      b.cover.resize(s_.count);
      b.layers.resize(index_.words);
    }
    return *scratches_[worker];
  }

  // Finds the node before each pixel of each surface, and the layers that occur in each cell of CELL x CELL pixels.
  void index() {
    index_.words = (N_ + 63) / 64;
    index_.rows = ceil_div(H_, CELL);
    index_.columns = ceil_div(W_, CELL);
    index_.bits.assign((size_t)index_.rows * index_.columns * index_.words, 0);
    index_.single.assign((size_t)index_.rows * index_.columns, 0);
    index_.mixed.assign(index_.single.size(), 0);
    for (int i = 0; i < s_.count; i++) index_.intervals.emplace_back(s_.area());
    constexpr int CELLS = BLOCK / CELL;
    job_.parallel(s_.block_rows, [&](int by, int) {
      std::vector<const float *> light(C_);
      for (int bx = 0; bx < s_.block_columns; bx++) {
        if (index_at_once(by, bx)) continue;
        for (int row = by * CELLS; row < std::min((by + 1) * CELLS, index_.rows); row++)
          for (int column = bx * CELLS; column < std::min((bx + 1) * CELLS, index_.columns); column++)
            index_cell(row, column, light.data());
      }
    });
  }

  int node_before(float place) const {
    const auto is_before = [](float at, const Layer &l) { return at < l.at; };
    const auto after = std::upper_bound(layers_.begin() + 1, layers_.end(), place, is_before);
    return (int)(after - layers_.begin()) - 1;
  }

  // Marks the layers of a place after node k.
  void mark_layers(uint64_t *bits, float place, int k) const {
    bits[k / 64] |= 1ull << k % 64;
    if (place > layers_[k].at) bits[(k + 1) / 64] |= 1ull << (k + 1) % 64;
  }

  // Indexes a block at once if it shows one surface that lies between two neighbouring nodes, as it usually does; else
  // returns false.
  bool index_at_once(int by, int bx) {
    constexpr int CELLS = BLOCK / CELL;
    const int block = by * s_.block_columns + bx;
    if (s_.full_planes() || s_.has_block(block)) return false;
    const float low = index_.place(job_.block_low[block]), high = index_.place(job_.block_high[block]);
    const int k = node_before(low), columns = std::min(BLOCK, W_ - bx * BLOCK);
    if (k != node_before(high)) return false;
    for (int y = by * BLOCK; y < std::min(H_, (by + 1) * BLOCK); y++)
      std::fill_n(&index_.intervals[0][s_.pixel(y, bx * BLOCK)], columns, (uint16_t)k);
    for (int row = by * CELLS; row < std::min((by + 1) * CELLS, index_.rows); row++)
      for (int column = bx * CELLS; column < std::min((bx + 1) * CELLS, index_.columns); column++) {
        const size_t cell = (size_t)row * index_.columns + column;
        mark_layers(&index_.bits[cell * index_.words], low, k);
        mark_layers(&index_.bits[cell * index_.words], high, k);
        index_.single[cell] = !s_.independent;
      }
    return true;
  }

  // The places of a cell's pixels. A row cut off by the frame repeats its last pixel.
  struct CellPlaces {
    float all[CELL * CELL], shown[CELL * CELL];                // shown: of pixels with weight, else NEVER_PX
    float own_cocs[CELL * CELL], own_weights[CELL * CELL];     // of the first surface
    vec low, high, least_weight, most_weight, farther_weight;  // farther_weight: largest of the farther of two surfaces
  };

  void index_cell(int row, int column, const float **light) {
    const size_t cell = (size_t)row * index_.columns + column;
    CellPlaces p;
    bool single = true;
    for (int i = 0; i < s_.count; i++) {
      if (!read_places(row, column, i, light, p)) continue;
      single &= i ? !any_positive(p.most_weight) : reduce_min(p.least_weight) >= 1;
      if (i) index_.mixed[cell] = reduce_max(p.farther_weight) > HIDDEN_WEIGHT;
      index_surface(row, column, i, p);
    }
    index_.single[cell] = single && !s_.independent;
  }

  // Returns false if a cell has no surface i.
  bool read_places(int row, int column, int i, const float **light, CellPlaces &p) const {
    const int x0 = column * CELL, n = std::min(CELL, W_ - x0), rows = std::min(CELL, H_ - row * CELL);
    p.low = broadcast(NEVER_PX), p.high = broadcast(-NEVER_PX);
    p.least_weight = broadcast(1.0f), p.most_weight = p.farther_weight = vec{};
    for (int y = 0; y < rows; y++) {
      const float *coc, *weight;
      float cut_coc[CELL], cut_weight[CELL];
      if (!s_.row(i, row * CELL + y, x0, light, coc, weight)) return false;
      for (int x = 0; n < CELL && x < CELL; x++) {
        cut_coc[x] = coc[std::min(x, n - 1)];
        if (weight) cut_weight[x] = weight[std::min(x, n - 1)];
      }
      if (n < CELL) coc = cut_coc, weight = weight ? cut_weight : nullptr;
      for (int x = 0; x < CELL; x += LANES) {
        const vec its_coc = load<vec>(coc + x), place = index_.place(its_coc);
        const vec w = weight ? load<vec>(weight + x) : broadcast(1.0f);
        const auto weighs = w != vec{};
        store(p.all + y * CELL + x, place);
        store(p.shown + y * CELL + x, weighs ? place : broadcast(NEVER_PX));
        p.low = min(p.low, weighs ? place : broadcast(NEVER_PX));
        p.high = max(p.high, weighs ? place : broadcast(-NEVER_PX));
        p.least_weight = min(p.least_weight, w);
        p.most_weight = max(p.most_weight, w);
        float *const own_coc = p.own_cocs + y * CELL + x, *const own_weight = p.own_weights + y * CELL + x;
        if (i) p.farther_weight = max(p.farther_weight, its_coc < load<vec>(own_coc) ? load<vec>(own_weight) : w);
        if (!i) store(own_coc, its_coc), store(own_weight, w);
      }
    }
    return true;
  }

  // Writes the node before each pixel of surface i in a cell, and marks the layers in which it occurs: compares the
  // places with the nodes between the smallest and the largest one.
  void index_surface(int row, int column, int i, const CellPlaces &p) {
    const int x0 = column * CELL, n = std::min(CELL, W_ - x0), rows = std::min(CELL, H_ - row * CELL);
    uint64_t *const bits = &index_.bits[((size_t)row * index_.columns + column) * index_.words];
    uint16_t *const intervals = &index_.intervals[i][(size_t)row * CELL * W_ + x0];
    const bool any = any_positive(p.most_weight);
    const int first = any ? node_before(reduce_min(p.low)) : 0, last = any ? node_before(reduce_max(p.high)) : 0;
    if (first == last) {
      for (int y = 0; y < rows; y++) std::fill_n(intervals + s_.pixel(y, 0), n, (uint16_t)first);
      if (any) mark_layers(bits, reduce_min(p.low), first), mark_layers(bits, reduce_max(p.high), first);
      return;
    }
    for (int y = 0; y < rows; y++) {
      int32_t nodes[CELL];
      for (int x = 0; x < CELL; x += LANES) {
        const vec place = load<vec>(p.all + y * CELL + x);
        ivec node = ivec{} + first;
        for (int k = first + 1; k <= last; k++) node -= place >= broadcast(layers_[k].at);
        store(nodes + x, node);
      }
      for (int x = 0; x < n; x++) intervals[s_.pixel(y, x)] = (uint16_t)nodes[x];
    }
    for (int k = first; k <= std::min(last + 1, N_ - 1); k++) {  // layer k occurs between nodes k - 1 and k + 1
      const vec before = broadcast(k == first ? -NEVER_PX : layers_[k - 1].at);
      const vec after = broadcast(k > last || k == N_ - 1 ? NEVER_PX : layers_[k + 1].at);
      ivec found = {};
      for (int j = 0; j < rows * CELL; j += LANES) {
        const vec place = load<vec>(p.shown + j);
        found |= (place > before) & (place < after);
      }
      if (any_of(found)) bits[k / 64] |= 1ull << k % 64;
    }
  }

  // Collects the layers of a range of cells; returns whether these show the first surface alone.
  bool around(int r0, int r1, int c0, int c1, uint64_t *bits) const {
    r0 = std::clamp(r0, 0, index_.rows - 1), r1 = std::clamp(r1, 0, index_.rows - 1);
    c0 = std::clamp(c0, 0, index_.columns - 1), c1 = std::clamp(c1, 0, index_.columns - 1);
    for (int w = 0; w < index_.words; w++) bits[w] = 0;
    bool single = true;
    for (int r = r0; r <= r1; r++)
      for (int c = c0; c <= c1; c++) {
        const size_t cell = (size_t)r * index_.columns + c;
        for (int w = 0; w < index_.words; w++) bits[w] |= index_.bits[cell * index_.words + w];
        single &= (bool)index_.single[cell];
      }
    return single;
  }
  static bool has(const uint64_t *bits, int k) { return bits[k / 64] >> k % 64 & 1; }

  // Composites one tile of a coarse run.
  void coarse_tile(Run &run, int which, Scratch &b) {
    const int s = run.scale, tile_y = which / run.tile_columns * TILE, tile_x = which % run.tile_columns * TILE;
    const int rows = std::min(TILE, run.rows - tile_y), columns = std::min(TILE, run.columns - tile_x);
    const int half = run.half, height = rows + 2 * half, width = columns + 2 * half;
    const int top = tile_y - 1 - half, left = tile_x - 1 - half;  // first block of the window
    around(floor_div(top * s, CELL), floor_div((top + height) * s - 1, CELL), floor_div(left * s, CELL),
           floor_div((left + width) * s - 1, CELL), b.layers.data());
    bool any = false;
    auto reaches = [&](int k) { return layers_[k].scale == s && has(b.layers.data(), k); };
    for (int k = run.first; k <= run.last; k++) any |= reaches(k);
    if (!any) {
      for (int c = 0; c < C_ + E_; c++)
        for (int y = 0; y < rows; y++)
          memset(&run.canvas[((size_t)c * run.rows + tile_y + y) * run.columns + tile_x], 0, columns * sizeof(float));
      return;
    }
    for (float *canvas : b.canvas) memset(canvas, 0, TILE_PIXELS * sizeof(float));
    const Downsampled *d = downsampled(s);
    if (d) find_pieces(run, *d, top, left, height, width, b);
    for (int k = run.last; k >= run.first; k--) {
      if (!reaches(k)) continue;
      const Layer &l = layers_[k];
      const int spare = half - l.half;
      if (d)
        downsampled_terms(run, *d, k, top, left, height, width, spare, b);
      else
        block_means(k, s, top + spare, left + spare, rows + 2 * l.half, columns + 2 * l.half, spare, spare, b);
      composite_layer(b, l, rows, columns, spare, spare, tile_y - 1, tile_x - 1);
    }
    for (int c = 0; c < C_ + E_; c++)
      for (int y = 0; y < rows; y++)
        memcpy(&run.canvas[((size_t)c * run.rows + tile_y + y) * run.columns + tile_x], b.canvas[c] + y * TILE,
               columns * sizeof(float));
    for (int y = 0; y < rows; y += PART)
      for (int x = 0; x < columns; x += PART) {
        vec most_cover = {};
        for (int e = 0; e < E_; e++)
          for (int i = 0; i < PART; i++)
            for (int j = 0; j < PART; j += LANES)
              most_cover = max(most_cover, load<vec>(b.canvas[C_ + e] + (y + i) * TILE + x + j));
        run.used[(size_t)(tile_y + y) / PART * run.part_columns + (tile_x + x) / PART] = any_positive(most_cover);
      }
  }

  const Downsampled *downsampled(int scale) const {
    for (const auto &d : downsampled_)
      if (d->scale == scale) return d.get();
    return nullptr;
  }

  // Sorts the pieces of a window by node, and sums the weight of those behind the run.
  void find_pieces(const Run &run, const Downsampled &d, int top, int left, int height, int width, Scratch &b) {
    const int per_band = BLOCK / d.scale, L = run.last - run.first + 2, stride = d.stride();
    WindowPieces &p = b.pieces;
    p.unsorted.clear();
    p.start.assign(L + 1, 0);
    if (over_)
      for (int y = 0; y < height; y++) memset(b.farther + in_window(y, 0), 0, width * sizeof(float));
    for (int y = 0; y < height; y++) {
      const int row = top + y, band = floor_div(row, per_band);
      const Pieces &pieces = d.pieces[band - d.first_band];
      const int *start = &pieces.start[row - band * per_band], *column = pieces.column.data();
      const int end = (int)(std::lower_bound(column + start[0], column + start[1], left + width) - column);
      for (int i = (int)(std::lower_bound(column + start[0], column + start[1], left) - column); i < end; i++) {
        const int node = (pieces.node[i] & ~Pieces::NORMALIZER_ONLY) - run.first + 1, x = column[i] - left;
        const float *values = &pieces.values[(size_t)i * stride];
        if (node >= L) b.farther[in_window(y, x)] += values[0];
        if (node < 0 || node >= L) continue;
        p.unsorted.push_back(
            {values, (uint16_t)y, (uint16_t)x, (uint16_t)node, (pieces.node[i] & Pieces::NORMALIZER_ONLY) != 0});
        p.start[node + 1]++;
      }
    }
    for (int i = 0; i < L; i++) p.start[i + 1] += p.start[i];
    p.sorted.resize(p.unsorted.size());
    std::vector<int> next(p.start.begin(), p.start.end() - 1);
    for (const WindowPiece &piece : p.unsorted) p.sorted[next[piece.node]++] = piece;
  }

  // The terms of layer k in a window. Adds the weight between node k and the next to `farther`.
  void downsampled_terms(const Run &run, const Downsampled &d, int k, int top, int left, int height, int width,
                         int spare, Scratch &b) {
    const int C = C_;
    const vec at = broadcast((float)k), before = broadcast((float)(k - 1));
    for (int y = spare; y < height - spare; y++) {
      const size_t to = in_window(y, 0);
      const float *node = d.row(0, top + y) + left, *one = d.row(1, top + y) + left,
                  *two = d.row(C + 2, top + y) + left;
      float *share = b.term[C] + to, *normalizer = b.term[C + 1] + to;
      uint32_t occupied = 0, partial = 0, varying = 0;
      for (int x0 = 0; x0 < width; x0 += MARKED) {
        vec some = {}, more = {}, other = {};
        for (int x = x0; x < x0 + MARKED; x += LANES) {
          const vec n = load<vec>(node + x);
          const auto ahead = n == before, behind = n == at;
          const vec w = load<vec>(one + x), part = load<vec>(two + x);
          const vec ramp = ahead ? part : vec{}, its_share = behind ? w - part : ramp;
          store(share + x, its_share);
          some = max(some, its_share);
          if (!over_) continue;
          const vec its_normalizer = (n >= at ? w : ramp) + load<vec>(b.farther + to + x),
                    from_one = its_normalizer - 1.0f;
          store(normalizer + x, its_normalizer);
          more = max(more, its_normalizer - its_share);
          other = max(other, from_one * from_one - EVEN_SQUARED);
        }
        const uint32_t bit = mark(x0);
        occupied |= any_positive(some) ? bit : 0;
        partial |= any_positive(more) ? bit : 0;
        varying |= any_positive(other) ? bit : 0;
      }
      b.occupied[y] = occupied;
      b.partial[y] = partial;
      b.varying[y] = varying;
      for (int c = 0; c < C; c++) {
        const float *light = d.row(2 + c, top + y) + left, *far = d.row(3 + C + c, top + y) + left;
        float *term = b.term[c] + to;
        for (int x0 = 0; x0 < width; x0 += MARKED) {
          if (!(occupied & mark(x0))) {
            std::fill(term + x0, term + x0 + MARKED, 0.0f);
            continue;
          }
          for (int x = x0; x < x0 + MARKED; x += LANES) {
            const vec n = load<vec>(node + x), v = load<vec>(far + x);
            store(term + x, n == at ? load<vec>(light + x) - v : n == before ? v : vec{});
          }
        }
      }
    }
    const int node = k - run.first + 1;
    if (C == 3) {
      add_pieces<3, true>(node, b);
      add_pieces<3, false>(node - 1, b);
    } else {
      add_pieces<0, true>(node, b);
      add_pieces<0, false>(node - 1, b);
    }
  }

  // Adds the pieces between a node and the next to the terms of the layer at that node (BEHIND), or of the layer at the
  // next node.
  template <int CHANNELS, bool BEHIND>
  void add_pieces(int node, Scratch &b) const {
    const int C = CHANNELS ? CHANNELS : C_;
    const WindowPiece *const pieces = b.pieces.sorted.data();
    for (int i = b.pieces.start[node]; i < b.pieces.start[node + 1]; i++) {
      const WindowPiece &piece = pieces[i];
      const size_t at = (size_t)piece.row * pitch_ + piece.column;
      const float *one = piece.values, *two = one + C + 1;
      auto part = [&](int v) { return BEHIND ? one[v] - two[v] : two[v]; };
      const uint32_t bit = mark(piece.column);
      b.occupied[piece.row] |= bit;
      b.partial[piece.row] |= bit;
      b.varying[piece.row] |= bit;
      if (!piece.normalizer_only) {
        b.term[C][at] += part(0);
        for (int c = 0; c < C; c++) b.term[c][at] += part(1 + c);
      }
      if (!over_) continue;
      b.term[C + 1][at] += BEHIND ? one[0] : two[0];
      if (BEHIND) b.farther[at] += one[0];
    }
  }

  // The terms of layer k for surfaces that cover each other, in rows from `first` and columns from `from` of a window:
  // computes each row of pixels and averages over s x s.
  void block_means(int k, int s, int top, int left, int height, int width, int first, int from, Scratch &b) {
    const float each = 1.0f / (s * s);
    const int n = width * s;
    std::vector<float> memory((size_t)(s_.count + 1) * (C_ + 2) * (n + LANES));
    float *m = memory.data();
    auto take = [&] { return (m += n + LANES) - (n + LANES); };  // vectors may read beyond the end
    std::vector<float *> light(s_.count * C_), coc(s_.count), weight(s_.count), term(C_ + 2);
    for (auto *v : {&light, &coc, &weight, &term})
      for (float *&row : *v) row = take();
    for (int by = 0; by < height; by++) {
      const size_t to = in_window(first + by, from);
      for (int c = 0; c < C_ + 2; c++) memset(b.term[c] + to, 0, width * sizeof(float));
      for (int y = 0; y < s; y++) {
        read_row((top + by) * s + y, left * s, n, false, light.data(), coc.data(), weight.data(), b);
        row_terms(layers_[k], n, light.data(), coc.data(), weight.data(), term.data());
        for (int x = 0; x < n; x++)
          for (int c = 0; c < C_ + 2; c++) b.term[c][to + x / s] += term[c][x] * each;
      }
    }
    find_occupied(b, first, height, from, width);
  }

  // Reads a row of all surfaces, extended beyond the frame: light [surfaces, channels], place on the blur axis, weight.
  void read_row(int y, int x0, int n, bool single, float *const *light, float *const *coc, float *const *weight,
                Scratch &b) {
    const int at_y = std::clamp(y, 0, H_ - 1), first = std::clamp(x0, 0, W_ - 1),
              last = std::clamp(x0 + n - 1, 0, W_ - 1);
    const int before = std::max(0, std::min(n, -x0)), after = std::max(0, std::min(n, x0 + n - W_));
    for (int i = 0; i < (single ? 1 : s_.count); i++) {
      const float *from_coc, *from_weight;
      for (int x = first; x <= last;) {
        int end = last + 1;
        if (!s_.full_planes()) {  // a run of blocks stored in the image alone, or a single block
          const int blocks = at_y / BLOCK * s_.block_columns;
          const bool own = s_.has_block(blocks + x / BLOCK);
          end = (x / BLOCK + 1) * BLOCK;
          while (end <= last && !own && !s_.has_block(blocks + end / BLOCK)) end += BLOCK;
          end = std::min(end, last + 1);
        }
        const int count = end - x;
        // a window wholly beside the frame reads the nearest pixel
        const int to = x0 > W_ - 1 ? 0 : x0 + n <= 0 ? n - 1 : std::max(x - x0, 0);
        const bool there = s_.row(i, at_y, x, b.pointers.data(), from_coc, from_weight);
        auto copy = [&](float *row, const float *from) {
          if (there && count == BLOCK)
            memcpy(row + to, from, BLOCK * sizeof(float));
          else if (there)
            memcpy(row + to, from, count * sizeof(float));
          else
            memset(row + to, 0, count * sizeof(float));
        };
        for (int c = 0; c < C_; c++) copy(light[i * C_ + c], b.pointers[c]);
        copy(coc[i], from_coc);
        if (there && !from_weight)
          std::fill(weight[i] + to, weight[i] + to + count, 1.0f);
        else
          copy(weight[i], from_weight);
        x = end;
      }
      auto extend = [&](float *row) {
        std::fill(row, row + before, row[std::min(before, n - 1)]);
        std::fill(row + n - after, row + n, row[std::max(n - after, 1) - 1]);
      };
      for (int c = 0; c < C_; c++) {
        float *row = light[i * C_ + c];
        extend(row);
        for (int x = 0; x < before; x++) row[x] = border_.light(i, c, y, x0 + x, row[x]);
        for (int x = n - after; x < n; x++) row[x] = border_.light(i, c, y, x0 + x, row[x]);
        if (y != at_y && before + after < n)
          border_.continue_row(i, c, y, x0 + before, n - before - after, row + before);
      }
      extend(coc[i]);
      extend(weight[i]);
      for (int x = 0; x < n; x += LANES) store(coc[i] + x, index_.place(load<vec>(coc[i] + x)));
    }
  }

  // Terms of a layer in a row of n pixels of surfaces that cover each other, near to far. h: a surface's share at or
  // behind the layer; g: its share at the layer. Each surface in turn takes its part of what nearer surfaces at the
  // layer left. The normalizer is the share that surfaces in front of the layer leave visible, where any surface behind
  // them is known.
  void row_terms(const Layer &l, int n, const float *const *light, const float *const *place,
                 const float *const *weight, float *const *term) const {
    std::vector<vec> m(s_.count);  // share of each surface
    for (int i = 0; i < n; i += LANES) {
      vec left = broadcast(1.0f), unknown = left, normalizer = left, share = {};
      for (int j = 0; j < s_.count; j++) {
        const vec p = load<vec>(place[j] + i), cover = load<vec>(weight[j] + i), h = at_or_behind(l, p, over_);
        const vec own = ramp(h / HIDING_SHARE, true), near = unlimited_at_or_behind(l, end_of_surface(p));
        vec slope = ramp(near / HIDING_SHARE, true) - own;
        for (int k = j + 1; k < s_.count && any_of(slope > vec{}); k++) {
          const vec farther = load<vec>(place[k] + i);
          slope *= is_clear(p, farther, load<vec>(weight[k] + i), behind(l, farther, over_));
        }
        const vec here = cover * (own + slope), there = 1.0f - here + here * h;
        const vec stops = cover * (h - behind(l, p, over_)) / max(there, broadcast(LEAST_PASSING));
        m[j] = left * stops;
        left *= 1.0f - stops;
        normalizer *= there;
        unknown *= 1.0f - here;
      }
      for (vec &its_share : m) share += its_share *= normalizer;
      store(term[C_] + i, share);
      store(term[C_ + 1] + i, normalizer * (1.0f - unknown));
      for (int c = 0; c < C_; c++) {
        vec sum = {};
        for (int j = 0; j < s_.count; j++) sum += load<vec>(light[j * C_ + c] + i) * m[j];
        store(term[c] + i, sum);
      }
    }
  }

  // Marks the columns in which a layer's terms are used, in rows from `top` and columns from `left` of a window.
  void find_occupied(Scratch &b, int top, int rows, int left, int columns) const {
    for (int y = top; y < top + rows; y++) {
      const float *share = b.term[C_] + in_window(y, 0), *normalizer = b.term[C_ + 1] + in_window(y, 0);
      b.occupied[y] = b.partial[y] = b.varying[y] = 0;
      for (int x = left; x < left + columns; x++) {
        const float from_one = normalizer[x] - 1.0f;
        b.occupied[y] |= share[x] > 0 ? mark(x) : 0;
        if (!over_) continue;
        b.partial[y] |=
            normalizer[x] != share[x] ? mark(x) : 0;  // may also be smaller, where a share is below HIDING_SHARE
        b.varying[y] |= from_one * from_one > EVEN_SQUARED ? mark(x) : 0;
      }
    }
  }

  // Splits a window into blocks. Blocks that touch the frame's border are copied and extended beyond it.
  void find_blocks(int top, int rows, int left, int columns, Scratch &b) {
    b.blocks.clear();
    const size_t plane = (size_t)window_ * pitch_, area = s_.area();
    const int block_rows = ceil_div(top + rows - floor_div(top, BLOCK) * BLOCK, BLOCK), block_columns = columns / BLOCK;
    b.block_layers.assign((size_t)block_rows * block_columns * index_.words, 0);
    std::vector<float *> light(b.light.size()), coc(s_.count), weight(s_.count);
    for (int i = 0; i < block_rows * block_columns; i++) {
      const int y0 = floor_div(top, BLOCK) * BLOCK + i / block_columns * BLOCK, x0 = left + i % block_columns * BLOCK;
      const bool inside = y0 >= 0 && x0 >= 0 && y0 + BLOCK <= H_ && x0 + BLOCK <= W_;
      const int y_in = std::clamp(y0, 0, (s_.block_rows - 1) * BLOCK),
                x_in = std::clamp(x0, 0, (s_.block_columns - 1) * BLOCK);
      WindowBlock w;
      uint64_t *layers = &b.block_layers[(size_t)i * index_.words];
      const bool single =
          around(y_in / CELL, y_in / CELL + BLOCK / CELL - 1, x_in / CELL, x_in / CELL + BLOCK / CELL - 1, layers);
      w.layers = layers;
      w.count = single ? 1 : s_.count;
      w.top = std::max(y0 - top, 0);
      w.rows = std::min(y0 + BLOCK - top, rows) - w.top;
      w.column = x0 - left;
      w.clear = false;
      w.normalizer = WindowBlock::STALE;
      const int first_row = top + w.top;
      for (int j = 0; j < w.count && inside; j++) {
        WindowBlock::Surface &of = w.surfaces[j];
        const float *from = nullptr;
        s_.row(j, first_row, x0, b.pointers.data(), from, of.weight);
        const bool in_block = s_.has_block(first_row / BLOCK * s_.block_columns + x0 / BLOCK);
        of.light = b.pointers[0];
        of.channel = in_block ? BLOCK_PIXELS : area;
        of.light_pitch = in_block ? BLOCK : W_;
        of.weight_pitch = BLOCK;
        if (single) of.weight = nullptr;
        if (!over_ && !has_fine(layers)) continue;  // no layer needs the places
        for (int y = w.top; y < w.top + w.rows; y++, from += j ? BLOCK : W_)
          for (int x = 0; x < BLOCK; x += LANES)
            store(b.coc[j] + in_window(y, w.column + x), index_.place(load<vec>(from + x)));
      }
      if (!inside) {
        for (int y = w.top; y < w.top + w.rows; y++) {
          const size_t at = in_window(y, w.column);
          for (size_t v = 0; v < light.size(); v++) light[v] = b.light[v] + at;
          for (int j = 0; j < s_.count; j++) coc[j] = b.coc[j] + at, weight[j] = b.weight[j] + at;
          read_row(top + y, x0, BLOCK, single, light.data(), coc.data(), weight.data(), b);
        }
        for (int j = 0; j < w.count; j++) {
          const size_t at = (size_t)w.top * pitch_ + w.column;
          w.surfaces[j] = {b.light[j * C_] + at, single ? nullptr : b.weight[j] + at, pitch_, pitch_, plane};
        }
      }
      b.blocks.push_back(w);
    }
  }

  // Whether any layer of a set has full resolution.
  bool has_fine(const uint64_t *layers) const {
    for (int i = 0; i < index_.words; i++)
      if (layers[i] & fine_[i]) return true;
    return false;
  }

  // The terms of layer k in rows from `first` and columns from `from` of a window. Terms still valid from the previous
  // layer are not written again.
  void window_terms(int k, int first, int rows, int from, int columns, Scratch &b) {
    std::fill(&b.occupied[first], &b.occupied[first] + rows, 0u);
    std::fill(&b.partial[first], &b.partial[first] + rows, 0u);
    std::fill(&b.varying[first], &b.varying[first] + rows, 0u);
    for (WindowBlock &w : b.blocks) {
      int before = 0;  // the block's layers before layer k
      bool behind = false;
      for (int i = 0; i < index_.words; i++) {
        before += __builtin_popcountll(w.layers[i] & below(k, i));
        behind |= (w.layers[i] & ~below(k + 1, i)) != 0;
      }
      const int y0 = std::max(w.top, first), y1 = std::min(w.top + w.rows, first + rows);
      const int x0 = std::max(0, from - w.column) / LANES * LANES, x1 = std::min(BLOCK, from + columns - w.column);
      if (y0 >= y1 || x0 >= x1) continue;
      if (has(w.layers, k)) {
        w.clear = false;
        w.normalizer = WindowBlock::STALE;
        const auto terms =
            C_ == 3 ? (w.count == 1 ? &Composite::block_terms<3, 1, true> : &Composite::block_terms<3, 2, true>)
                    : (w.count == 1 ? &Composite::block_terms<0, 1, true> : &Composite::block_terms<0, 2, true>);
        (this->*terms)(layers_[k], w, y0, y1, x0, x1, &b.partial[w.top], &b.varying[w.top], b);
        continue;
      }
      if (!w.clear) {
        w.clear = true;
        for (int c = 0; c < C_ + 1; c++) fill(b.term[c], w, 0.0f);
      }
      if (!over_) continue;
      const uint32_t bits = marks(w.column, w.column + BLOCK - 1);
      if ((before && behind) || (behind && (w.count > 1 || w.surfaces[0].weight))) {
        // layers in between may have been left out here, as their kernels do not reach the block
        if (w.normalizer != WindowBlock::KEPT || w.before != before) {
          std::fill(w.partial, w.partial + BLOCK, 0u);
          std::fill(w.varying, w.varying + BLOCK, 0u);
          const auto terms = w.count == 1 ? &Composite::block_terms<0, 1, false> : &Composite::block_terms<0, 2, false>;
          (this->*terms)(layers_[k], w, w.top, w.top + w.rows, 0, BLOCK, w.partial, w.varying, b);
        }
        w.normalizer = WindowBlock::KEPT;
        w.before = before;
        for (int y = y0; y < y1; y++) {
          b.partial[y] |= w.partial[y - w.top];
          b.varying[y] |= w.varying[y - w.top];
        }
      } else {
        const WindowBlock::Normalizer constant = behind ? WindowBlock::ONE : WindowBlock::ZERO;
        if (w.normalizer != constant) fill(b.term[C_ + 1], w, behind ? 1.0f : 0.0f);
        w.normalizer = constant;
        for (int y = y0; y < y1; y++) (behind ? b.partial : b.varying)[y] |= bits;
      }
    }
  }

  void fill(float *term, const WindowBlock &w, float value) const {
    for (int y = w.top; y < w.top + w.rows; y++) {
      float *row = term + in_window(y, w.column);
      std::fill(row, row + BLOCK, value);
    }
  }

  // The terms of layer l in columns x0 to x1 of a block and rows y0 to y1 of the window; only the normalizer, if the
  // layer does not occur in the block. partial, varying: marks of the block's rows.
  template <int CHANNELS, int COUNT, bool OCCURS>
  void block_terms(const Layer &l, const WindowBlock &w, int y0, int y1, int x0, int x1, uint32_t *partial,
                   uint32_t *varying, Scratch &b) {
    const int C = CHANNELS ? CHANNELS : C_;
    for (int y = y0; y < y1; y++) {
      const size_t row = y - w.top, at = in_window(y, w.column);
      for (int x = x0; x < x1; x += LANES) {
        vec surface_share[COUNT], share = {}, normalizer = {}, p[COUNT], h[COUNT], weight[COUNT];
        for (int j = 0; j < COUNT; j++) {
          const WindowBlock::Surface &of = w.surfaces[j];
          p[j] = load<vec>(b.coc[j] + at + x);
          h[j] = at_or_behind(l, p[j], over_);
          weight[j] = of.weight ? load<vec>(of.weight + row * of.weight_pitch + x) : broadcast(1.0f);
        }
        if (COUNT == 2) add_continuation(p, h, weight);
        for (int j = 0; j < COUNT; j++) normalizer += h[j] * weight[j];
        const uint32_t bit = mark(w.column + x);
        if (OCCURS) {
          bool has_light[COUNT];
          for (int j = 0; j < COUNT; j++) {
            surface_share[j] = (h[j] - behind(l, p[j], over_)) * weight[j];
            share += surface_share[j];
            has_light[j] = any_positive(surface_share[j]);
          }
          store(b.term[C] + at + x, share);
          for (int c = 0; c < C; c++) {
            vec sum = {};
            for (int j = 0; j < COUNT; j++)
              if (has_light[j])
                sum +=
                    load<vec>(w.surfaces[j].light + c * w.surfaces[j].channel + row * w.surfaces[j].light_pitch + x) *
                    surface_share[j];
            store(b.term[c] + at + x, sum);
          }
          b.occupied[y] |= any_positive(share) ? bit : 0;
        }
        if (!over_) continue;
        const vec from_one = normalizer - 1.0f;
        store(b.term[C + 1] + at + x, normalizer);
        partial[row] |= any_positive(normalizer - share) ? bit : 0;
        varying[row] |= any_positive(from_one * from_one - EVEN_SQUARED) ? bit : 0;
      }
    }
  }

  // Adds the continuation of the farther surface behind the nearer one to the weights of two surfaces.
  static void add_continuation(const vec *place, const vec *h, vec *weight) {
    const auto other_is_nearer = place[1] < place[0];
    const vec extra = continuation(other_is_nearer ? weight[0] : weight[1]);
    if (!any_positive(extra)) return;
    const vec more = extra * visible_part(other_is_nearer ? h[1] : h[0]);
    weight[0] += other_is_nearer ? more : vec{};
    weight[1] += other_is_nearer ? vec{} : more;
  }

  static uint64_t below(int k, int word) {  // bits of layers before layer k
    const int bit = k - 64 * word;
    return bit <= 0 ? 0 : bit >= 64 ? ~0ull : (1ull << bit) - 1;
  }

  // A layer's kernels at a position in pixels of the layer. All strips of one block share them, so they are cached.
  const Kernel *kernels_at(Scratch &b, const Layer &l, int row, int column) const {
    if (!l.field_mask) return l.kernels.data();
    const torchdof_scene &scene = job_.scene;
    const int before = l.scale > 1;  // the canvas of a coarser resolution begins one pixel outside the frame
    const int block_row = (row + before) / FieldMask::ROWS, block_column = (column + before) / FieldMask::COLUMNS;
    MaskedKernels &masked = b.masked_kernels[block_column % (int)b.masked_kernels.size()];
    if (masked.layer == &l && masked.row == block_row && masked.column == block_column) return masked.kernels.data();
    masked.layer = &l;
    masked.row = block_row;
    masked.column = block_column;
    masked.kernels.resize(E_);
    const float per = per_half_diagonal(scene);
    const float y = (((block_row + 0.5f) * FieldMask::ROWS - before) * l.scale - 0.5f * H_) * per;
    const float x = (((block_column + 0.5f) * FieldMask::COLUMNS - before) * l.scale - 0.5f * W_) * per;
    for (int e = 0; e < E_; e++)
      mask_kernel(l, e, FieldMask(scene, *l.field_mask, nullptr, 0.0f, e, y, x), masked.kernels[e]);
    return masked.kernels.data();
  }

  // Blurs the terms of a layer and composites them onto the tile's canvas. first, from: where the terms begin in the
  // window. top, left: position of the canvas in pixels of the layer.
  void composite_layer(Scratch &b, const Layer &l, int rows, int columns, int first, int from, int top, int left) {
    for (int y = rows; y < ceil_div(rows, STRIP_ROWS) * STRIP_ROWS; y++) {
      const int row = first + y + 2 * l.half;
      b.occupied[row] = b.partial[row] = b.varying[row] = 0;
    }
    for (int y = 0; y < rows; y += STRIP_ROWS) {
      uint32_t occupied = 0, partial = 0, varying = 0;  // marks of all rows within the kernel's reach
      for (int i = first + y; i < first + y + STRIP_ROWS + 2 * l.half; i++) {
        occupied |= b.occupied[i];
        partial |= b.partial[i];
        varying |= b.varying[i];
      }
      if (!occupied) continue;
      for (int x = 0; x < columns; x += STRIP_COLUMNS) {
        const uint32_t within = strip_inputs(from + x, l.half);
        if (!(occupied & within)) continue;
        const size_t at = in_window(first + y, from + x);
        const Kernel *kernels = kernels_at(b, l, top + y, left + x);
        if (over_)
          composite_strip(b, kernels, at, first + y, within, partial & within, varying & within, y * TILE + x);
        else
          add_strip(b, kernels, at, first + y, within, y * TILE + x);
      }
    }
  }

  void add_strip(Scratch &b, const Kernel *kernels, size_t from, int y, uint32_t within, int at) {
    float spread_of[STRIP];
    for (int v = 0; v < C_ + E_; v++) {
      const Kernel &kernel = kernels[E_ == 1 ? 0 : v < C_ ? v : v - C_];
      convolve_strip(b.term[std::min(v, C_)] + from, pitch_, &b.occupied[y], within, kernel, spread_of);
      for (int i = 0; i < STRIP; i += LANES) {
        float *to = b.canvas[v] + at + i / STRIP_COLUMNS * TILE + i % STRIP_COLUMNS;
        store(to, load<vec>(to) + load<vec>(spread_of + i));
      }
    }
  }

  void composite_strip(Scratch &b, const Kernel *kernels, size_t from, int y, uint32_t within, bool partial,
                       bool varying, int at) {
    float share[STRIP], normalizer[STRIP], gain[STRIP], left[STRIP], light[STRIP];
    for (int e = 0; e < E_; e++) {
      const Kernel &kernel = kernels[e];
      if (varying)
        convolve_strip(b.term[C_ + 1] + from, pitch_, b.every.data(), ~0u, kernel, normalizer);
      else
        std::fill(normalizer, normalizer + STRIP, kernel.sum);
      if (partial)
        convolve_strip(b.term[C_] + from, pitch_, &b.occupied[y], within, kernel, share);
      else
        memcpy(share, normalizer, sizeof(normalizer));
      // colour = light / normalizer, coverage = share / normalizer
      float *const canvas = b.canvas[C_ + e] + at;
      for (int i = 0; i < STRIP; i += LANES) {
        const vec all_normalizer = load<vec>(normalizer + i), its_share = load<vec>(share + i),
                  missing = lacking(all_normalizer);
        const vec known = all_normalizer + raise(missing), per_normalizer = 1.0f / known,
                  cover = its_share * per_normalizer;
        // a layer that covers a pixel fully removes all light behind it, however bright
        const vec its_left = its_share < known ? max(1.0f - cover, vec{}) : vec{};
        store(gain + i, per_normalizer);
        store(left + i, its_left);
        float *to = canvas + i / STRIP_COLUMNS * TILE + i % STRIP_COLUMNS;
        store(to, cover + its_left * load<vec>(to));
      }
      for (int c = E_ == 1 ? 0 : e; c < (E_ == 1 ? C_ : e + 1); c++) {
        convolve_strip(b.term[c] + from, pitch_, &b.occupied[y], within, kernel, light);
        for (int i = 0; i < STRIP; i += LANES) {
          float *to = b.canvas[c] + at + i / STRIP_COLUMNS * TILE + i % STRIP_COLUMNS;
          store(to, load<vec>(light + i) * load<vec>(gain + i) + load<vec>(left + i) * load<vec>(to));
        }
      }
    }
  }

  static constexpr int WIDENED =
      TILE + 32;  // values of a widened row, which begins half a coarse pixel before the tile

  // Widens a row of a coarser canvas, from column `first` on, to the tile's resolution: to [channels + colours,
  // WIDENED]. Returns false if it covers nothing.
  bool widen(const Run &run, int row, int first, float *to) const {
    const int s = run.scale, inside = std::max(std::min(TILE / s + 1, run.columns - 1 - first), 0);
    float ramp[16];
    for (int i = 0; i < 16; i++) ramp[i] = (i % s + 0.5f) / s;
    vec most_cover = {};
    for (int c = C_ + E_ - 1; c >= 0; c--) {
      const float *from = &run.canvas[((size_t)c * run.rows + row) * run.columns + first];
      if (c >= C_) {
        for (int i = 0; i <= inside; i += LANES) most_cover = max(most_cover, load<vec>(from + i));
      } else if (!any_positive(most_cover)) {
        memset(to, 0, (size_t)(C_ + E_) * WIDENED * sizeof(float));
        return false;
      }
      float *v = to + (size_t)c * WIDENED;
      if (s == 2)
        for (int i = 0; i < inside; i++) {
          const float step = from[i + 1] - from[i];
          v[2 * i] = from[i] + 0.25f * step;
          v[2 * i + 1] = from[i] + 0.75f * step;
        }
      else
        for (int i = 0; i < inside; i++)
          for (int part = 0; part < s; part += 4, v += 4) {
            typedef float f4 __attribute__((vector_size(16)));
            const f4 value = f4{} + from[i], step = f4{} + (from[i + 1] - from[i]);
            store(v, value + step * load<f4>(ramp + part));
          }
    }
    return true;
  }

  // Composites a coarser canvas, interpolated, onto the tile's canvas.
  //
  // 1. Return if no layer of the run reaches the tile.
  // 2. Widen two rows of the canvas to the tile's resolution; each serves several rows of the tile.
  // 3. Interpolate between them, and put the result in front of the tile's row.
  void join_finer(const Run &run, int y0, int x0, Scratch &b) {
    const int s = run.scale;
    const int r1 = std::min((y0 + TILE) / s + 1, run.rows - 1) / PART,
              c1 = std::min((x0 + TILE) / s + 1, run.columns - 1) / PART;
    bool any = false;
    for (int r = y0 / s / PART; r <= r1; r++)
      for (int c = x0 / s / PART; c <= c1; c++) any |= run.used[(size_t)r * run.part_columns + c];
    if (!any) return;
    const int channels = C_ + E_;
    std::vector<float> memory((size_t)2 * channels * WIDENED);
    float *upper = memory.data(), *lower = upper + channels * WIDENED;  // two rows, widened to the tile's resolution
    bool upper_covers = false, lower_covers = false;
    for (int y = 0, known = -2; y < TILE; y++) {
      const float at_y = (y0 + y + 0.5f) / s + 0.5f;
      const int row = std::min((int)at_y, run.rows - 2);
      const float down = at_y - row;
      if (row != known) {
        std::swap(upper, lower);
        upper_covers = row == known + 1 ? lower_covers : widen(run, row, x0 / s, upper);
        lower_covers = widen(run, row + 1, x0 / s, lower);
        known = row;
      }
      if (!upper_covers && !lower_covers) continue;
      auto value_at = [&](int c, int x) {
        const size_t at = (size_t)c * WIDENED + s / 2 + x;
        return load<vec>(upper + at) + down * (load<vec>(lower + at) - load<vec>(upper + at));
      };
      for (int c = 0; c < channels; c++) {
        // light, then coverage; each keeps 1 - (coverage of this run) of the tile's value
        const int e = c < C_ ? E_ == 1 ? 0 : c : c - C_;
        float *canvas = b.canvas[c] + y * TILE;
        for (int x = 0; x < TILE; x += LANES) {
          const vec value = value_at(c, x);
          const vec left = over_ ? max(1.0f - (c < C_ ? value_at(C_ + e, x) : value), vec{}) : broadcast(1.0f);
          store(canvas + x, value + left * load<vec>(canvas + x));
        }
      }
    }
  }

  // Puts the surfaces that stand in for the background in front of the tile's canvas.
  void add_stand_ins(int y0, int x0, int rows, int columns, Scratch &b) {
    around(y0 / CELL, (y0 + rows - 1) / CELL, x0 / CELL, (x0 + columns - 1) / CELL, b.layers.data());
    bool any = false;  // a pixel between a layer and the next one belongs to both
    for (int k = 0; k < N_ && layers_[k].node < 0; k++)
      any |= layers_[std::min(k + 1, N_ - 1)].node > -2 * BARELY_BLURRED && has(b.layers.data(), k);
    if (!any) return;
    std::vector<float> memory((size_t)s_.count * (C_ + 2) * (TILE + LANES));
    float *m = memory.data();
    std::vector<float *> light(s_.count * C_), place(s_.count), weight(s_.count);
    for (auto *v : {&light, &place, &weight})
      for (float *&row : *v) row = m, m += TILE + LANES;
    for (int y = 0; y < rows; y++) {
      read_row(y0 + y, x0, columns, false, light.data(), place.data(), weight.data(), b);
      for (int x = 0; x < columns; x += LANES) {
        vec left = broadcast(1.0f), share = {};
        for (int j = 0; j < s_.count; j++) {
          const vec at = load<vec>(place[j] + x), given = load<vec>(weight[j] + x);
          b.missing[j] = 1.0f - counts(given) * at_focus(at);
          b.cover[j] = seen(given) * stands_in(at) * left;
          if (s_.independent) left *= 1.0f - given;
        }
        for (int j = 0; j < s_.count; j++) {
          for (int i = 0; i < s_.count; i++) b.cover[j] *= i == j ? broadcast(1.0f) : b.missing[i];
          share += b.cover[j];
        }
        if (!any_positive(share)) continue;
        const vec through = max(1.0f - share, vec{});
        for (int c = 0; c < C_ + E_; c++) {
          vec sum = c < C_ ? vec{} : share;
          for (int j = 0; c < C_ && j < s_.count; j++) sum += load<vec>(light[j * C_ + c] + x) * b.cover[j];
          float *to = b.canvas[c] + y * TILE + x;
          store(to, sum + through * load<vec>(to));
        }
      }
    }
  }

  // Renders one tile of the picture.
  //
  // 1. List the full-resolution layers whose blur reaches the tile, and read the window that they need.
  // 2. From far to near, composite these layers and the coarser canvases onto the tile's canvas; between the focus and
  // the
  //    layers before it, the surfaces that stand in for the background.
  // 3. Finish: light behind all layers, highlights.
  void tile(int tile_row, int tile_column, Scratch &b) {
    const int y0 = tile_row * TILE, x0 = tile_column * TILE, rows = std::min(TILE, H_ - y0),
              columns = std::min(TILE, W_ - x0);
    for (float *canvas : b.canvas) memset(canvas, 0, TILE_PIXELS * sizeof(float));
    // layers of full resolution whose light reaches the tile
    std::vector<int> reaching;
    int halo = 0, known_reach = -1;
    for (int k = N_ - 1; k >= 0; k--) {
      const Layer &l = layers_[k];
      if (l.scale > 1) continue;
      const int reach = ceil_div(l.half, CELL);
      if (reach != known_reach)
        around(y0 / CELL - reach, (y0 + TILE) / CELL - 1 + reach, x0 / CELL - reach, (x0 + TILE) / CELL - 1 + reach,
               b.layers.data());
      known_reach = reach;
      if (!has(b.layers.data(), k)) continue;
      reaching.push_back(k);
      halo = std::max(halo, l.half);
    }
    const int top = y0 - halo, left = floor_div(x0 - halo, BLOCK) * BLOCK;  // of the window
    const int height = rows + 2 * halo, across = ceil_div(x0 + columns + halo - left, BLOCK) * BLOCK;
    if (!reaching.empty() && !s_.independent) find_blocks(top, height, left, across, b);
    size_t next = 0;
    bool has_stand_ins = over_;
    auto pass = [&](const Layer &l) {
      if (has_stand_ins && l.node < 0) has_stand_ins = false, add_stand_ins(y0, x0, rows, columns, b);
    };
    for (int r = (int)runs_.size() - 1; r >= 0; r--) {
      const Run &run = runs_[r];
      if (run.scale > 1) {
        pass(layers_[run.first]);
        join_finer(run, y0, x0, b);
        continue;
      }
      for (; next < reaching.size() && reaching[next] >= run.first; next++) {
        const Layer &l = layers_[reaching[next]];
        pass(l);
        const int first = halo - l.half, from = x0 - l.half - left, reach_rows = rows + 2 * l.half,
                  reach_columns = columns + 2 * l.half;
        if (s_.independent)
          block_means(reaching[next], 1, top + first, left + from, reach_rows, reach_columns, first, from, b);
        else
          window_terms(reaching[next], first, reach_rows, from, reach_columns, b);
        composite_layer(b, l, rows, columns, first, from, y0, x0);
      }
    }
    finish(tile_row * ceil_div(W_, TILE) + tile_column, y0, x0, rows, columns, b);
  }

  // Composites the tile onto the light behind all layers, adds the light of highlights and writes the picture.
  void finish(int which, int y0, int x0, int rows, int columns, Scratch &b) {
    const int C = C_, E = E_;
    float *const traced = b.traced;  // [channels, TILE, TILE]
    const bool has_rays = !job_.rays.empty() && ray_start_[which] < ray_start_[which + 1];
    if (has_rays) {
      memset(traced, 0, sizeof(float) * C * TILE_PIXELS);
      splat(job_, visibility_, y0, x0, &ray_list_[ray_start_[which]], ray_start_[which + 1] - ray_start_[which],
            ray_kernels_, gains_, traced);
    }
    const bool normalize = over_ ? job_.behind.empty() : (bool)job_.scene.normalize;
    if (has_rays && !over_)
      for (int i = 0; i < C * TILE_PIXELS; i++) b.canvas[0][i] += traced[i];
    if (over_ && !normalize) composite_over_behind(y0, x0, rows, columns, b);
    for (int c = 0; c < C; c++) {
      const float *cover = b.canvas[C + (E > 1 ? c : 0)], *canvas = b.canvas[c];
      const float *added = has_rays && over_ ? traced + (size_t)c * TILE_PIXELS : nullptr;
      for (int y = 0; y < rows; y++, canvas += TILE, cover += TILE) {
        const size_t at = c * s_.area() + s_.pixel(y0 + y, x0);
        float *const to = out_ + at;
        for (int x = 0; x < columns; x += LANES) {
          vec v = load<vec>(canvas + x);
          if (normalize) v = load<vec>(cover + x) > LEAST ? v / load<vec>(cover + x) : vec{};
          if (added) v += load<vec>(added + y * TILE + x);
          if (x + LANES <= columns)
            store(to + x, v);
          else
            memcpy(to + x, &v, (columns - x) * sizeof(float));
        }
        if (!s_.valid) continue;
        const float *valid = s_.valid + s_.pixel(y0 + y, x0);
        for (int x = 0; x < columns; x++)
          if (!(valid[x] > 0)) to[x] = job_.scene.light[0][at + x];
      }
    }
  }

  void composite_over_behind(int y0, int x0, int rows, int columns, Scratch &b) {
    vec least_cover = broadcast(1.0f);
    for (int e = 0; e < E_; e++)
      for (int i = 0; i < TILE_PIXELS; i += LANES) least_cover = min(least_cover, load<vec>(b.canvas[C_ + e] + i));
    if (!any_of(least_cover < broadcast(1.0f - COVERED))) return;
    const int h = job_.behind_height, w = job_.behind_width;
    int before[TILE];
    float across[TILE];  // fraction of the way to the next sample
    for (int x = 0; x < TILE; x++) {
      const float at_x = (x0 + x - 0.5f * (W_ - 1)) / BEHIND_STEP + 0.5f * (w - 1);
      before[x] = std::min((int)at_x, w - 1);
      across[x] = at_x - before[x];
    }
    for (int y = 0; y < rows; y++) {
      // image and samples have the same centre
      const float at_y = (y0 + y - 0.5f * (H_ - 1)) / BEHIND_STEP + 0.5f * (h - 1);
      const int top = std::min((int)at_y, h - 1), bottom = std::min(top + 1, h - 1);
      const float down = at_y - top;
      for (int c = 0; c < C_; c++) {
        const float *cover = b.canvas[C_ + (E_ > 1 ? c : 0)] + y * TILE;
        float *canvas = b.canvas[c] + y * TILE;
        const float *upper = &job_.behind[((size_t)c * h + top) * w],
                    *lower = &job_.behind[((size_t)c * h + bottom) * w];
        for (int x = 0; x < columns; x += LANES) {
          const vec uncovered = 1.0f - load<vec>(cover + x), old = load<vec>(canvas + x);
          const auto is_uncovered = uncovered > COVERED;
          if (!any_of(is_uncovered)) continue;
          vec above_left, above_right, below_left, below_right;
          for (int i = 0; i < LANES; i++) {
            const int left = before[x + i], right = std::min(left + 1, w - 1);
            above_left[i] = upper[left], above_right[i] = upper[right], below_left[i] = lower[left],
            below_right[i] = lower[right];
          }
          const vec part = load<vec>(across + x);
          const vec above = above_left + part * (above_right - above_left),
                    below = below_left + part * (below_right - below_left);
          store(canvas + x, is_uncovered ? old + uncovered * (above + down * (below - above)) : old);
        }
      }
    }
  }

  // Lists the rays that reach each tile, in order.
  void sort_rays() {
    if (over_) visibility_ = find_visibility(job_, ray_kernels_);
    gains_ = gains_of(job_, ray_kernels_);
    const int tile_rows = ceil_div(H_, TILE), tile_columns = ceil_div(W_, TILE);
    ray_start_.assign(tile_rows * tile_columns + 1, 0);
    auto each_tile = [&](auto body) {
      for (int i = 0; i < (int)job_.rays.size(); i++) {
        const Ray &ray = job_.rays[i];
        const int half = std::max(ray_kernels_.halves[ray.radius], ray_kernels_.halves[ray.radius + 1]);
        const int r0 = std::max(ray.row - half, 0) / TILE, r1 = std::min(ray.row + half, H_ - 1) / TILE;
        const int c0 = std::max(ray.column - half, 0) / TILE, c1 = std::min(ray.column + half, W_ - 1) / TILE;
        for (int r = r0; r <= r1; r++)
          for (int c = c0; c <= c1; c++) body(i, r * tile_columns + c);
      }
    };
    each_tile([&](int, int tile) { ray_start_[tile + 1]++; });
    for (size_t t = 0; t + 1 < ray_start_.size(); t++) ray_start_[t + 1] += ray_start_[t];
    ray_list_.resize(ray_start_.back());
    std::vector<int> next(ray_start_.begin(), ray_start_.end() - 1);
    each_tile([&](int i, int tile) { ray_list_[next[tile]++] = i; });
  }

  const Job &job_;
  const Surfaces &s_;
  const std::vector<Layer> &layers_;
  const RayKernels &ray_kernels_;
  float *out_;
  int H_, W_, C_, E_, N_;
  bool over_;
  std::vector<Run> runs_;
  std::vector<uint64_t> fine_;  // full-resolution layers, a bit each
  int window_, pitch_;
  std::vector<std::unique_ptr<Scratch>> scratches_;
  LayerIndex index_;
  std::vector<std::unique_ptr<Downsampled>> downsampled_;  // one for each coarse scale
  Border border_;
  Visibility visibility_;
  std::vector<float> gains_;
  std::vector<int> ray_start_, ray_list_;
};

int LayerIndex::only_interval(size_t i) const {
  int first = -1, last = -1;
  for (int w = 0; w < words; w++) {
    const uint64_t found = cell(i)[w];
    if (!found) continue;
    if (first < 0) first = 64 * w + __builtin_ctzll(found);
    last = 64 * w + 63 - __builtin_clzll(found);
  }
  return last <= first + 1 ? first : -1;
}

void composite(const Job &job, const RayKernels &ray_kernels, float *out) { Composite(job, ray_kernels, out).run(); }

}  // namespace torchdof
