// Blurs and composites the layers of a padded frame as composite.cpp does, forward and backward, for training. All
// planes are dense, because every pixel has a gradient.
//
// With m a layer's share of each pixel, r the share behind it, I light and K the layer's kernel, from far to near:
//
//   l = K * (m I),  w = K * m,  v = K * r,   n = w + v' (v' is v, raised where w + v < KNOWN)
//   picture = l / n + (1 - w / n) picture
//
// Between the focus and the layers before it, surfaces stand in for the background (stand_ins in
// render/surfaces/frame.py).
//
// Backward, the blurred l, w and v are computed again and kept, block by block; their gradients replace them. Each
// block then composites its layers again, walks back through them from near to far, and the gradients of l, w and v are
// scattered by the turned kernels to the gradients of m I, m and r, and from these to the surfaces.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "api.h"
#include "blocks.h"
#include "blur_axis.h"
#include "constants/native.h"
#include "convolution.h"
#include "entry.h"
#include "layers.h"
#include "memory.h"
#include "mixture.h"
#include "rules.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

using constants::native::MOST_PLANES;
static_assert(BLOCK % STRIP_COLUMNS == 0 && BLOCK % STRIP_ROWS == 0, "strips fill a block");

inline vec load_some(const float *p, int n) {
  if (n >= LANES) return load<vec>(p);
  vec v = {};
  memcpy(&v, p, n * sizeof(float));
  return v;
}
inline void add_some(float *p, vec v, int n) {
  if (n >= LANES) return store(p, load<vec>(p) + v);
  for (int i = 0; i < n; i++) p[i] += v[i];
}
// Consecutive layers of one resolution on one side of the focus, on a grid of their pixels, the padded frame's.
struct Run {
  int scale, margin;         // margin: pixels of the grid before the picture
  int rows, columns, pitch;  // of the grid
  int half;                  // largest half width of its kernels
  int block_rows, block_columns;
  int top, left, bottom, right;  // its canvas in the grid; a coarse one has one more pixel on each side
  std::vector<int> layers;       // far to near
  size_t plane;                  // values of a plane of the grid
  Buffer<float> canvas, slopes;  // light and coverage [planes, plane], and their gradient
  size_t at(int y, int x) const { return (size_t)y * pitch + x; }
  int blocks() const { return block_rows * block_columns; }
};

// A tile of a run's grid, whose layers are blurred one after the other while its pixels are in the cache: blocks
// [row0, row1) x [column0, column1). Its planes also hold the pixels around it that the kernels reach.
struct Tile {
  int row0, row1, column0, column1;
  int top, left, rows, columns;  // pixels of the planes
  size_t plane;
  std::vector<float> &memory;
  float *at(int v, int y, int x) const { return memory.data() + v * plane + (size_t)(y - top) * columns + x - left; }
};

// A layer: which blocks of its run's grid its light reaches, and the blurred terms there.
struct Blurred {
  std::vector<int> index;                 // of each block in `values`, or -1
  std::vector<int> reached;               // blocks with blurred terms
  std::vector<uint8_t> needed;            // blocks that are read for these
  std::vector<uint8_t> occupied, behind;  // blocks in which the layer occurs; in which a surface lies behind it
  Buffer<float> values;                   // [blocks, terms, BLOCK_PIXELS]
  std::vector<Kernel> kernels, turned;    // for each colour
};

class Blend {
 public:
  explicit Blend(const torchdof_layers &scene)
      : scene_(scene), C_(scene.channels), E_(scene.kernel_colours), S_(scene.surfaces), over_(scene.occlusion),
        terms_(C_ + (over_ ? 2 : 1)), values_(C_ + (over_ ? 2 : 1) * E_), planes_(C_ + E_),
        empty_(scene.backed ? 1.0f : 0.0f) {
    const float *values = scene.kernels;
    layers_.resize(scene.layers);
    blurred_.resize(scene.layers);
    for (int k = 0; k < scene.layers; k++) {
      layers_[k] = make_layer(scene.nodes, scene.layers, k);
      layers_[k].scale = scene.scales[k];
      layers_[k].half = scene.halves[k];
      const int side = 2 * scene.halves[k] + 1;
      for (int e = 0; e < E_; e++, values += side * side) {
        std::vector<float> turned(values, values + side * side);
        std::reverse(turned.begin(), turned.end());
        blurred_[k].kernels.push_back(make_kernel(values, layers_[k].half, true));
        blurred_[k].turned.push_back(make_kernel(turned.data(), layers_[k].half, true));
      }
    }
  }

  void picture(float *out) {
    blur_all();
    const std::vector<Step> steps = steps_of_picture();
    each_block(fine(), [&](int block, Events &) {
      float canvas[MOST * BLOCK_PIXELS];
      composite(steps, block, canvas);
      write(block, canvas, out);
    });
  }

  void gradient(const float *out_gradient, float *const *light, float *const *place, float *const *weight) {
    light_ = light, place_ = place, weight_ = weight;
    blur_all();
    const size_t area = (size_t)scene_.height * scene_.width;
    for (Run &run : runs_)
      if (run.scale > 1) {
        run.slopes = Buffer<float>(planes_ * area);
        memset(run.slopes.data(), 0, planes_ * area * sizeof(float));
      }
    const std::vector<Step> of_picture = steps_of_picture();
    each_block(fine(), [&](int block, Events &events) {
      float slopes[MOST * BLOCK_PIXELS];
      read(block, out_gradient, slopes);
      walk(of_picture, block, events, slopes);
    });
    for (Run &run : runs_) {
      if (run.scale == 1) continue;
      const std::vector<Step> steps = steps_of(run);
      each_block(run, [&](int block, Events &events) {
        float slopes[MOST * BLOCK_PIXELS];
        gather(run, block, slopes);
        walk(steps, block, events, slopes);
      });
    }
    for (const Run &run : runs_) each_tile(run, values_, [&](int k, const Tile &tile) { scatter_back(run, k, tile); });
  }

 private:
  static constexpr int MOST = MOST_PLANES;
  using Events = std::vector<float>;
  // A step of a composite, far to near: a layer, the canvas of a coarse run (then `run` is not null), or the stand-ins.
  struct Step {
    const Run *run;
    int layer;
  };
  static constexpr Step STAND_INS = {nullptr, -1};

  const Run &fine() const {
    return *std::find_if(runs_.begin(), runs_.end(), [](const Run &run) { return run.scale == 1; });
  }

  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(scene_.threads, count, scene_.cancelled, body);
  }
  // Calls body(block, events) for the blocks of a run's canvas; events: memory of the thread.
  template <typename Body>
  void each_block(const Run &run, const Body &body) {
    std::vector<Events> events(std::max(1, scene_.threads));
    const int r0 = std::max(run.top, 0) / BLOCK, r1 = (run.bottom - 1) / BLOCK, c0 = std::max(run.left, 0) / BLOCK,
              c1 = (run.right - 1) / BLOCK;
    const int across = c1 - c0 + 1;
    parallel((r1 - r0 + 1) * across,
             [&](int i, int worker) { body((r0 + i / across) * run.block_columns + c0 + i % across, events[worker]); });
  }

  Buffer<float> grid_planes(const Run &run, int count) const {
    Buffer<float> planes(count * run.plane);
    memset(planes.data(), 0, count * run.plane * sizeof(float));
    return planes;
  }

  // The layers, blurred, and the canvases of coarse runs.
  void blur_all() {
    find_runs();
    mark_cells();
    for (Run &run : runs_) {
      for (int k : run.layers) find_blocks(run, k);
      each_tile(run, terms_, [&](int k, const Tile &tile) { blur(run, k, tile); });
      if (run.scale == 1) continue;
      run.canvas = grid_planes(run, planes_);
      const std::vector<Step> steps = steps_of(run);
      each_block(run, [&](int block, Events &) {
        float canvas[MOST * BLOCK_PIXELS];
        composite(steps, block, canvas);
        const int y0 = block / run.block_columns * BLOCK, x0 = block % run.block_columns * BLOCK;
        for (int c = 0; c < planes_; c++)
          for (int y = 0; y < BLOCK; y++)
            memcpy(run.canvas.data() + c * run.plane + run.at(y0 + y, x0), canvas + c * BLOCK_PIXELS + y * BLOCK,
                   BLOCK * sizeof(float));
      });
    }
  }

  // Far to near. Without full-resolution layers an empty run stands for the picture.
  void find_runs() {
    auto add = [&](int scale) {
      runs_.emplace_back();
      Run &run = runs_.back();
      run.scale = scale;
      run.margin = scene_.margin / scale;
      run.rows = scene_.rows / scale;
      run.columns = scene_.columns / scale;
      const int more = scale > 1;
      run.top = run.left = run.margin - more;
      run.bottom = run.margin + scene_.height / scale + more;
      run.right = run.margin + scene_.width / scale + more;
      run.half = 0;
    };
    for (int k = scene_.layers - 1; k >= 0; k--) {
      const bool follows =
          !runs_.empty() && runs_.back().scale == layers_[k].scale &&
          (layers_[k].scale == 1 || (layers_[runs_.back().layers.back()].node < 0) == (layers_[k].node < 0));
      if (!follows) add(layers_[k].scale);
      runs_.back().layers.push_back(k);
      runs_.back().half = std::max(runs_.back().half, layers_[k].half);
    }
    if (!has_fine()) add(1);
    for (Run &run : runs_) {
      run.block_rows = ceil_div(run.rows, BLOCK);
      run.block_columns = ceil_div(run.columns, BLOCK);
      run.pitch = run.block_columns * BLOCK;
      run.plane = (size_t)run.block_rows * BLOCK * run.pitch;
    }
  }
  bool has_fine() const {
    return std::any_of(runs_.begin(), runs_.end(), [](const Run &run) { return run.scale == 1; });
  }

  // Finds the layers that occur in each cell of CELL x CELL pixels of the padded frame, and its range of places.
  void mark_cells() {
    words_ = (scene_.layers + 63) / 64;
    cell_rows_ = ceil_div(scene_.rows, CELL);
    cell_columns_ = ceil_div(scene_.columns, CELL);
    cells_.assign((size_t)cell_rows_ * cell_columns_ * words_, 0);
    lows_.assign((size_t)cell_rows_ * cell_columns_, NEVER_PX);
    highs_.assign(lows_.size(), -NEVER_PX);
    std::vector<float> nodes;
    for (const Layer &l : layers_) nodes.push_back(l.at);
    const int last = (int)nodes.size() - 1;
    parallel(cell_rows_, [&](int row, int) {
      for (int i = 0; i < S_; i++)
        for (int y = row * CELL; y < std::min((row + 1) * CELL, scene_.rows); y++) {
          const float *of_row = scene_.place[i] + (size_t)y * scene_.columns;
          for (int x = 0, next, k = 0; x < scene_.columns; x = next) {
            while (k < last && of_row[x] >= nodes[k + 1]) k++;
            while (k > 0 && of_row[x] < nodes[k]) k--;
            const size_t cell = (size_t)row * cell_columns_ + x / CELL;
            uint64_t *bits = &cells_[cell * words_];
            const bool beyond = of_row[x] > nodes[k], at = of_row[x] == nodes[k] && nodes[k] != 0;
            for (next = x; next < scene_.columns && next / CELL == x / CELL; next++) {  // pixels between the same nodes
              if (next > x && !(beyond && of_row[next] > nodes[k] && (k == last || of_row[next] < nodes[k + 1]))) break;
              lows_[cell] = std::min(lows_[cell], of_row[next]);
              highs_[cell] = std::max(highs_[cell], of_row[next]);
            }
            bits[k / 64] |= 1ull << k % 64;
            // a pixel at a node has a gradient in the layers beside it, except in focus
            if (k < last && (beyond || at)) bits[(k + 1) / 64] |= 1ull << (k + 1) % 64;
            if (k > 0 && at) bits[(k - 1) / 64] |= 1ull << (k - 1) % 64;
          }
        }
    });
  }
  // Calls body(cell) for the cells of a range of pixels of a run's grid until it returns true; returns whether it did.
  template <typename Body>
  bool any_cell(const Run &run, int y0, int y1, int x0, int x1, const Body &body) const {
    const int s = run.scale, r0 = std::max(y0 * s, 0) / CELL, r1 = std::min(y1 * s - 1, scene_.rows - 1) / CELL;
    const int c0 = std::max(x0 * s, 0) / CELL, c1 = std::min(x1 * s - 1, scene_.columns - 1) / CELL;
    for (int r = r0; r <= r1; r++)
      for (int c = c0; c <= c1; c++)
        if (body((size_t)r * cell_columns_ + c)) return true;
    return false;
  }
  // Whether a layer occurs in a cell.
  bool is_in(int k, size_t cell) const { return cells_[cell * words_ + k / 64] >> k % 64 & 1; }
  // Where all surfaces of a cell's pixels lie, relative to a layer.
  enum Side { ACROSS, IN_FRONT, BEHIND };
  Side side_of(int k, size_t cell) const {
    if (is_in(k, cell)) return ACROSS;
    if (k == scene_.layers - 1 || highs_[cell] <= layers_[k].at) return IN_FRONT;
    return lows_[cell] >= layers_[k + 1].at ? BEHIND : ACROSS;
  }
  // Whether a layer occurs in a range of pixels of a run's grid; whether a surface lies in it or behind it.
  bool occurs(const Run &run, int k, int y0, int y1, int x0, int x1) const {
    return any_cell(run, y0, y1, x0, x1, [&](size_t cell) { return is_in(k, cell); });
  }
  bool reaches_behind(const Run &run, int k, int y0, int y1, int x0, int x1) const {
    return any_cell(run, y0, y1, x0, x1, [&](size_t cell) { return side_of(k, cell) != IN_FRONT; });
  }

  // Finds the blocks that a layer's light reaches, and the blocks that are read for them.
  void find_blocks(const Run &run, int k) {
    Blurred &b = blurred_[k];
    const int half = layers_[k].half, count = run.blocks();
    b.index.assign(count, -1);
    b.occupied.assign(count, 0);
    b.behind.assign(count, 0);
    b.needed.assign(count, 0);
    int reached = 0;
    for (int i = 0; i < count; i++) {
      const int y0 = i / run.block_columns * BLOCK, x0 = i % run.block_columns * BLOCK;
      b.occupied[i] = occurs(run, k, y0, y0 + BLOCK, x0, x0 + BLOCK);
      b.behind[i] = reaches_behind(run, k, y0, y0 + BLOCK, x0, x0 + BLOCK);
      const bool outside = y0 >= run.bottom || y0 + BLOCK <= run.top || x0 >= run.right || x0 + BLOCK <= run.left;
      if (outside || !occurs(run, k, y0 - half, y0 + BLOCK + half, x0 - half, x0 + BLOCK + half)) continue;
      b.index[i] = reached++;
      for (int r = std::max(y0 - half, 0) / BLOCK; r <= std::min((y0 + BLOCK - 1 + half) / BLOCK, run.block_rows - 1);
           r++)
        for (int c = std::max(x0 - half, 0) / BLOCK;
             c <= std::min((x0 + BLOCK - 1 + half) / BLOCK, run.block_columns - 1); c++)
          b.needed[r * run.block_columns + c] = 1;
    }
    b.values = Buffer<float>((size_t)reached * values_ * BLOCK_PIXELS + 1);
  }

  // Calls body(k, tile) for the layers of a run and the tiles of its grid; planes: number of planes of a tile.
  template <typename Body>
  void each_tile(const Run &run, int planes, const Body &body) const {
    const int side = std::max(TILE, run.half / BLOCK * BLOCK * 2) / BLOCK, guard = ceil_div(run.half, CELL) * CELL;
    const int down = ceil_div(run.block_rows, side), across = ceil_div(run.block_columns, side);
    std::vector<std::vector<float>> memory(std::max(1, scene_.threads));
    parallel(down * across, [&](int i, int worker) {
      const int row0 = i / across * side, column0 = i % across * side, width = side * BLOCK + 2 * guard;
      const Tile tile = {row0,
                         std::min(row0 + side, run.block_rows),
                         column0,
                         std::min(column0 + side, run.block_columns),
                         row0 * BLOCK - guard,
                         column0 * BLOCK - guard,
                         width,
                         width,
                         (size_t)width * width,
                         memory[worker]};
      tile.memory.resize(planes * tile.plane + LANES);
      for (int k : run.layers) body(k, tile);
    });
  }
  // Calls body(block) for the blocks of a tile.
  template <typename Body>
  void each_block_of(const Run &run, const Tile &tile, const Body &body) const {
    for (int r = tile.row0; r < tile.row1; r++)
      for (int c = tile.column0; c < tile.column1; c++) body(r * run.block_columns + c);
  }

  float *values_of(int k, int block) const {
    const int index = blurred_[k].index[block];
    return index < 0 ? nullptr : blurred_[k].values.data() + (size_t)index * values_ * BLOCK_PIXELS;
  }

  vec weight_at(int j, size_t at, int n) const {
    return scene_.weight[j] ? load_some(scene_.weight[j] + at, n) : broadcast(1.0f);
  }

  // The surfaces of some pixels, near to far, in a layer.
  template <int S>
  struct Pixels : Mixture<vec, S> {
    decltype(vec{} < vec{}) swapped;  // the frame's second surface is the nearer one

    // Surface j of the frame from the nearer and the farther one, or the other way round.
    vec swap(const vec *surfaces, int j) const {
      return S > 1 ? (swapped ? surfaces[S - 1 - j] : surfaces[j]) : surfaces[j];
    }
    // The weight of surface j of the frame in the layer.
    vec of_frame(int j) const { return S > 1 ? (swapped ? this->own(S - 1 - j) : this->own(j)) : this->own(j); }
  };
  template <int S>
  Pixels<S> weigh(const Layer &l, size_t at, int n) const {
    Pixels<S> p;
    vec place[S], weight[S];
    for (int j = 0; j < S; j++) {
      place[j] = load_some(scene_.place[j] + at, n);
      weight[j] = weight_at(j, at, n);
    }
    p.swapped = place[S - 1] < place[0];
    p.eased = over_;
    for (int j = 0; j < S; j++) {
      const vec its_place = p.swap(place, j);
      p.weight[j] = p.swap(weight, j);
      p.ahead[j] = unlimited_at_or_behind(l, its_place);
      p.here[j] = unlimited_behind(l, its_place);
    }
    p.weigh();
    return p;
  }

  // Calls body(y, x, n, side, occupied) for up to LANES pixels of the padded frame at a time, for those cells of a
  // range of pixels of a run's grid that are not wholly in front of a layer.
  template <typename Body>
  void each_cell(const Run &run, int k, int y0, int y1, int x0, int x1, const Body &body) const {
    const int s = run.scale, bottom = std::min(y1 * s, scene_.rows), right = std::min(x1 * s, scene_.columns);
    for (int top = std::max(y0 * s, 0); top < bottom; top += CELL)
      for (int left = std::max(x0 * s, 0); left < right; left += CELL) {
        const size_t cell = (size_t)(top / CELL) * cell_columns_ + left / CELL;
        const Side side = side_of(k, cell);
        if (side == IN_FRONT || (side == BEHIND && !over_)) continue;
        const bool occupied = is_in(k, cell);
        for (int y = top; y < std::min(top + CELL, bottom); y++)
          for (int x = left; x < std::min(left + CELL, right); x += LANES)
            body(y, x, std::min(LANES, scene_.columns - x), side, occupied);
      }
  }

  // The terms of a layer in and around a tile: light, share and the share behind it.
  template <int S>
  void terms(const Run &run, int k, const Tile &tile) const {
    const int C = C_, s = run.scale, guard = ceil_div(layers_[k].half, CELL) * CELL;
    const Layer &l = layers_[k];
    const float part = 1.0f / (s * s);
    std::fill(tile.memory.begin(), tile.memory.end(), 0.0f);
    const int top = tile.row0 * BLOCK - guard, bottom = tile.row1 * BLOCK + guard, left = tile.column0 * BLOCK - guard,
              right = tile.column1 * BLOCK + guard;
    each_cell(run, k, top, bottom, left, right, [&](int y, int x, int n, Side side, bool occupied) {
      const size_t at = (size_t)y * scene_.columns + x;
      float *its = tile.at(0, y / s, x / s);
      auto put = [&](int v, vec term) {
        float *to = its + v * tile.plane;
        if (s == 1)
          n == LANES ? store(to, term) : add_some(to, term, n);
        else if (s >= LANES)
          to[0] += part * reduce_add(term);
        else
          for (int i = 0; i < n; i++) to[i / s] += part * term[i];
      };
      vec behind = {};
      if (side == BEHIND) {
        for (int j = 0; j < S; j++) behind += weight_at(j, at, n);
        return put(C + 1, behind);
      }
      const Pixels<S> p = weigh<S>(l, at, n);
      if (over_) put(C + 1, p.beyond());
      if (!occupied) return;
      vec given[S];
      for (int j = 0; j < S; j++) given[j] = p.of_frame(j);
      for (int c = 0; c < C; c++) {
        const vec own = load_some(scene_.light[0] + c * map_ + at, n) * given[0];
        put(c, S > 1 ? own + load_some(scene_.light[S - 1] + c * map_ + at, n) * given[S - 1] : own);
      }
      put(C, S > 1 ? given[0] + given[S - 1] : given[0]);
    });
  }

  // Rows of a block's window that contain a layer, or surfaces behind it, as column marks for convolve_strip.
  void rows_of(const Run &run, int k, int block, bool behind, std::vector<uint32_t> &rows) const {
    const int half = layers_[k].half, y0 = block / run.block_columns * BLOCK - half,
              x0 = block % run.block_columns * BLOCK - half;
    rows.assign(BLOCK + 2 * half, 0);
    const int step = std::max(CELL / run.scale, 1);  // rows of a cell
    for (int i = 0, next; i < (int)rows.size(); i = next) {
      next = std::min((floor_div(y0 + i, step) + 1) * step - y0, (int)rows.size());
      const int x1 = x0 + BLOCK + 2 * half;
      const bool any =
          behind ? reaches_behind(run, k, y0 + i, y0 + next, x0, x1) : occurs(run, k, y0 + i, y0 + next, x0, x1);
      std::fill(rows.begin() + i, rows.begin() + next, any ? ~0u : 0u);
    }
  }

  // Convolves a block of a plane: out [BLOCK, BLOCK]. Strips of rows y for which `wanted(y)` is false stay unwritten.
  template <typename Wanted>
  void convolve(const Run &run, const Tile &tile, int plane, int block, const Kernel &kernel, const uint32_t *rows,
                float *out, const Wanted &wanted) const {
    const int y0 = block / run.block_columns * BLOCK, x0 = block % run.block_columns * BLOCK;
    float strip[STRIP];
    for (int y = 0; y < BLOCK; y += STRIP_ROWS)
      for (int x = 0; wanted(y) && x < BLOCK; x += STRIP_COLUMNS) {
        convolve_strip(tile.at(plane, y0 + y - kernel.half, x0 + x - kernel.half), tile.columns, rows + y, ~0u, kernel,
                       strip);
        for (int i = 0; i < STRIP_ROWS; i++)
          memcpy(out + (y + i) * BLOCK + x, strip + i * STRIP_COLUMNS, STRIP_COLUMNS * sizeof(float));
      }
  }

  void blur(const Run &run, int k, const Tile &tile) const {
    const Blurred &b = blurred_[k];
    bool any = false;
    each_block_of(run, tile, [&](int block) { any |= b.index[block] >= 0; });
    if (!any) return;
    S_ == 1 ? terms<1>(run, k, tile) : terms<2>(run, k, tile);
    std::vector<uint32_t> rows, rows_behind;
    each_block_of(run, tile, [&](int block) {
      float *to = values_of(k, block);
      if (!to) return;
      rows_of(run, k, block, false, rows);
      rows_of(run, k, block, true, rows_behind);
      for (int v = 0; v < values_; v++, to += BLOCK_PIXELS) {
        const int term = v < C_ + E_ ? std::min(v, C_) : C_ + 1;
        convolve(run, tile, term, block,
                 b.kernels[E_ == 1  ? 0
                           : v < C_ ? v
                                    : (v - C_) % E_],
                 term <= C_ ? rows.data() : rows_behind.data(), to, [](int) { return true; });
      }
    });
  }

  void clear(float *canvas) const {
    std::fill(canvas, canvas + C_ * BLOCK_PIXELS, 0.0f);
    std::fill(canvas + C_ * BLOCK_PIXELS, canvas + planes_ * BLOCK_PIXELS, over_ ? empty_ : 0.0f);
  }

  struct Front {
    vec share, transmittance;  // of a layer in a pixel; for the light behind it
  };
  Front front(vec share) const { return {share, scene_.backed ? share : max(1.0f - share, vec{})}; }
  struct Normalizer {
    vec lacking, behind, sum;  // what the sum lacks to KNOWN; the share behind the layer, raised; their sum
  };
  static Normalizer normalizer_of(vec own, vec behind) {
    const vec lacks = lacking(own, behind), raised = behind + raise(lacks);
    return {lacks, raised, own + raised};
  }
  int first_channel(int e) const { return E_ == 1 ? 0 : e; }
  int last_channel(int e) const { return E_ == 1 ? C_ - 1 : e; }

  // Puts light, multiplied by `gain`, in front of a canvas at pixel i, in the channels of kernel e.
  void over(int e, int i, Front f, const float *light, vec gain, float *canvas) const {
    for (int c = first_channel(e); c <= last_channel(e); c++) {
      float *to = canvas + c * BLOCK_PIXELS + i;
      store(to, load<vec>(light + c * BLOCK_PIXELS + i) * gain + f.transmittance * load<vec>(to));
    }
    float *to = canvas + (C_ + e) * BLOCK_PIXELS + i;
    store(to, (scene_.backed ? vec{} : f.share) + f.transmittance * load<vec>(to));
  }
  void add(const float *values, float *canvas) const {
    for (int i = 0; i < planes_ * BLOCK_PIXELS; i += LANES)
      store(canvas + i, load<vec>(canvas + i) + load<vec>(values + i));
  }
  // Calls body(e, i) for each vector of pixels of a block and each of the kernel's colours.
  template <typename Body>
  void each_pixel(const Body &body) const {
    for (int e = 0; e < E_; e++)
      for (int i = 0; i < BLOCK_PIXELS; i += LANES) body(e, i);
  }

  std::vector<Step> steps_of(const Run &run) const {
    std::vector<Step> steps;
    for (int k : run.layers) steps.push_back({nullptr, k});
    return steps;
  }
  std::vector<Step> steps_of_picture() const {
    std::vector<Step> steps;
    bool has_stand_ins = over_;
    auto add = [&](Step step, int layer) {
      if (has_stand_ins && layers_[layer].node < 0) has_stand_ins = false, steps.push_back(STAND_INS);
      steps.push_back(step);
    };
    for (const Run &run : runs_) {
      if (run.scale > 1)
        add({&run, -1}, run.layers[0]);
      else
        for (int k : run.layers) add({nullptr, k}, k);
    }
    return steps;
  }
  // Puts a step in front of a canvas; returns false if it is empty there. `kept`: takes a coarse canvas, interpolated.
  bool put(const Step &step, int block, float *canvas, float *kept) const {
    return step.run         ? join(*step.run, block, canvas, kept)
           : step.layer < 0 ? put_stand_ins(block, canvas)
                            : put_layer(step.layer, block, canvas);
  }
  void composite(const std::vector<Step> &steps, int block, float *canvas) const {
    float kept[MOST * BLOCK_PIXELS];
    clear(canvas);
    for (const Step &step : steps) put(step, block, canvas, kept);
  }

  bool put_layer(int k, int block, float *canvas) const {
    const float *values = values_of(k, block);
    if (!values) return false;
    if (!over_) {
      add(values, canvas);
      return true;
    }
    each_pixel([&](int e, int i) {
      const vec own = load<vec>(values + (C_ + e) * BLOCK_PIXELS + i);
      const Normalizer n = normalizer_of(own, load<vec>(values + (C_ + E_ + e) * BLOCK_PIXELS + i));
      const vec per = 1.0f / n.sum;
      over(e, i, front((scene_.backed ? n.behind : own) * per), values, per, canvas);
    });
    return true;
  }

  // The surfaces of some pixels as stand-ins; a second one that is not there has no weight.
  using StandIns = torchdof::StandIns<vec, 2, false>;
  StandIns stand_ins(size_t at, int n) const {
    StandIns s = {};
    for (int j = 0; j < S_; j++) s.place[j] = load_some(scene_.place[j] + at, n), s.weight[j] = weight_at(j, at, n);
    s.find();
    return s;
  }
  // Calls body(i, at, n, stand_ins) for up to LANES pixels at a time, i in a block of the picture and `at` in the
  // padded frame, where any surface stands in.
  template <typename Body>
  void each_stand_in(int block, const Body &body) const {
    const int y0 = block / fine().block_columns * BLOCK, x0 = block % fine().block_columns * BLOCK;
    for (int y = 0; y < std::min(BLOCK, scene_.rows - y0); y++)
      for (int x = 0; x < std::min(BLOCK, scene_.columns - x0); x += LANES) {
        const size_t at = (size_t)(y0 + y) * scene_.columns + x0 + x;
        const int n = std::min(LANES, scene_.columns - x0 - x);
        const StandIns s = stand_ins(at, n);
        if (any_positive(s.sum)) body(y * BLOCK + x, at, n, s);
      }
  }
  Front front_of(const StandIns &s) const { return front(scene_.backed ? 1.0f - s.sum : s.sum); }
  bool put_stand_ins(int block, float *canvas) const {
    bool any = false;
    float light[MOST * BLOCK_PIXELS];
    each_stand_in(block, [&](int i, size_t at, int n, const StandIns &s) {
      any = true;
      for (int c = 0; c < C_; c++) {
        vec sum = {};
        for (int j = 0; j < S_; j++) sum += s.cover[j] * load_some(scene_.light[j] + c * map_ + at, n);
        store(light + c * BLOCK_PIXELS + i, sum);
      }
      for (int e = 0; e < E_; e++) over(e, i, front_of(s), light, broadcast(1.0f), canvas);
    });
    return any;
  }
  // Walks back through the stand-ins, to the gradients of the surfaces.
  void walk_stand_ins(int block, const float *behind, float *slopes) const {
    each_stand_in(block, [&](int i, size_t at, int n, const StandIns &s) {
      vec d_sum = {}, d_cover[2] = {}, d_weight[2] = {}, d_place[2] = {};
      for (int e = 0; e < E_; e++)
        d_sum += through(e, i, front_of(s), behind, slopes, [&](int c, vec slope) {
          for (int j = 0; j < S_; j++) {
            d_cover[j] += slope * load_some(scene_.light[j] + c * map_ + at, n);
            add_some(light_[j] + c * map_ + at, slope * s.cover[j], n);
          }
        });
      for (vec &d : d_cover) d += scene_.backed ? -d_sum : d_sum;
      s.back(d_cover, d_place, d_weight);
      for (int j = 0; j < S_; j++) {
        add_some(place_[j] + at, d_place[j], n);
        if (scene_.weight[j]) add_some(weight_[j] + at, d_weight[j], n);
      }
    });
  }

  // Row and column of a coarse canvas before a pixel of the picture, and the fraction of the way to the next.
  static void coarse(int at, int scale, int limit, int &before, float &part) {
    const float place = (at + 0.5f) / scale + 0.5f;
    before = std::clamp((int)place, 0, limit - 2);
    part = place - before;
  }

  // A coarse canvas at a block of the picture, interpolated: [planes, BLOCK, BLOCK]; false if it is empty there.
  bool widen(const Run &run, int block, float *out) const {
    const Run &to = fine();
    const int y0 = block / to.block_columns * BLOCK - to.margin, x0 = block % to.block_columns * BLOCK - to.margin;
    const int s = run.scale, rows = run.bottom - run.top, columns = run.right - run.left;
    int column[BLOCK], first;
    float part[BLOCK];
    for (int x = 0; x < BLOCK; x++) coarse(x0 + x, s, columns, column[x], part[x]);
    first = column[0];
    const int count = column[BLOCK - 1] + 2 - first;
    {
      int low, high;
      float unused;
      coarse(y0, s, rows, low, unused);
      coarse(y0 + BLOCK - 1, s, rows, high, unused);
      bool any = false;
      for (int r = (run.top + low) / BLOCK; r <= (run.top + high + 1) / BLOCK; r++)
        for (int c = (run.left + first) / BLOCK; c <= (run.left + first + count - 1) / BLOCK; c++)
          for (int k : run.layers) any |= blurred_[k].index[r * run.block_columns + c] >= 0;
      if (!any) return false;
    }
    for (int c = 0; c < planes_; c++) {
      const float *plane = run.canvas.data() + c * run.plane;
      for (int y = 0; y < BLOCK; y++) {
        int row;
        float down, line[BLOCK + 2];
        coarse(y0 + y, s, rows, row, down);
        const float *upper = plane + run.at(run.top + row, run.left + first), *lower = upper + run.pitch;
        for (int i = 0; i < count; i++) line[i] = upper[i] + down * (lower[i] - upper[i]);
        float *its = out + c * BLOCK_PIXELS + y * BLOCK;
        for (int x = 0; x < BLOCK; x++) {
          const float *v = line + column[x] - first;
          its[x] = v[0] + part[x] * (v[1] - v[0]);
        }
      }
    }
    return true;
  }
  // The gradient of a coarse canvas at a block of its grid, from that of its interpolation: [planes, BLOCK, BLOCK].
  void gather(const Run &run, int block, float *slopes) const {
    const int s = run.scale, y0 = block / run.block_columns * BLOCK - run.top,
              x0 = block % run.block_columns * BLOCK - run.left;
    const int H = scene_.height, W = scene_.width, rows = run.bottom - run.top, columns = run.right - run.left;
    auto weight = [&](int at, int i, int limit) {
      int before;
      float part;
      coarse(at, s, limit, before, part);
      return before == i ? 1.0f - part : before + 1 == i ? part : 0.0f;
    };
    // pixels of the picture into which a coarse pixel i is interpolated: (i - 1.5) s to (i + 0.5) s
    auto low = [&](int i) { return std::max((2 * i - 3) * s / 2 - 1, 0); };
    auto high = [&](int i, int limit) { return std::min((2 * i + 1) * s / 2 + 1, limit); };
    std::vector<float> line(W);
    memset(slopes, 0, planes_ * BLOCK_PIXELS * sizeof(float));
    const int left = low(std::max(x0, 0)), right = high(std::min(x0 + BLOCK, columns) - 1, W);
    for (int c = 0; c < planes_; c++)
      for (int y = std::max(0, -y0); y < BLOCK && y0 + y < rows; y++) {
        std::fill(line.begin(), line.end(), 0.0f);
        for (int from = low(y0 + y); from < high(y0 + y, H); from++) {
          const float part = weight(from, y0 + y, rows), *row = run.slopes.data() + ((size_t)c * H + from) * W;
          if (part != 0)
            for (int x = left; x < right; x++) line[x] += part * row[x];
        }
        for (int x = std::max(0, -x0); x < BLOCK && x0 + x < columns; x++) {
          float total = 0;
          for (int from = low(x0 + x); from < high(x0 + x, W); from++)
            total += weight(from, x0 + x, columns) * line[from];
          slopes[c * BLOCK_PIXELS + y * BLOCK + x] = total;
        }
      }
  }

  bool join(const Run &run, int block, float *canvas, float *values) const {
    if (!widen(run, block, values)) return false;
    if (over_)
      each_pixel([&](int e, int i) {
        over(e, i, front(load<vec>(values + (C_ + e) * BLOCK_PIXELS + i)), values, broadcast(1.0f), canvas);
      });
    else
      add(values, canvas);
    return true;
  }

  // Calls body(position in the block, position in a picture, count) for each plane and row of a block of the picture.
  template <typename Body>
  void each_row(int block, const Body &body) const {
    const Run &run = fine();
    const int y0 = block / run.block_columns * BLOCK, x0 = block % run.block_columns * BLOCK;
    const int left = std::max(run.left - x0, 0), count = std::min(run.right - x0, BLOCK) - left;
    for (int c = 0; c < planes_; c++)
      for (int y = std::max(run.top - y0, 0); y < std::min(run.bottom - y0, BLOCK); y++)
        body(c * BLOCK_PIXELS + y * BLOCK + left,
             ((size_t)c * scene_.height + y0 + y - run.top) * scene_.width + x0 + left - run.left, count);
  }
  void write(int block, const float *canvas, float *out) const {
    each_row(block, [&](size_t from, size_t to, int count) { memcpy(out + to, canvas + from, count * sizeof(float)); });
  }
  void read(int block, const float *picture, float *canvas) const {
    memset(canvas, 0, planes_ * BLOCK_PIXELS * sizeof(float));
    each_row(block,
             [&](size_t to, size_t from, int count) { memcpy(canvas + to, picture + from, count * sizeof(float)); });
  }

  // One step back through the composite at pixel i, for kernel e. Multiplies the gradients by the transmittance, so
  // that they become those of the picture behind. Calls light(c, slope) with the gradient of the front's light in each
  // channel; returns the gradient of the front's share.
  template <typename Light>
  vec through(int e, int i, Front f, const float *behind, float *slopes, const Light &light) const {
    float *coverage = slopes + (C_ + e) * BLOCK_PIXELS + i;
    const vec d_coverage = load<vec>(coverage);
    vec d_transmittance = d_coverage * load<vec>(behind + (C_ + e) * BLOCK_PIXELS + i);
    for (int c = first_channel(e); c <= last_channel(e); c++) {
      float *its = slopes + c * BLOCK_PIXELS + i;
      const vec slope = load<vec>(its);
      d_transmittance += slope * load<vec>(behind + c * BLOCK_PIXELS + i);
      light(c, slope);
      store(its, f.transmittance * slope);
    }
    store(coverage, f.transmittance * d_coverage);
    return scene_.backed ? d_transmittance : d_coverage - (f.share <= 1.0f ? d_transmittance : vec{});
  }

  // Walks back through a layer: its blurred terms become their gradients.
  void walk_layer(int k, int block, const float *behind, float *slopes) const {
    float *values = values_of(k, block);
    if (!over_) {
      memcpy(values, slopes, values_ * BLOCK_PIXELS * sizeof(float));
      return;
    }
    each_pixel([&](int e, int i) {
      float *own = values + (C_ + e) * BLOCK_PIXELS + i, *behind_it = values + (C_ + E_ + e) * BLOCK_PIXELS + i;
      const Normalizer n = normalizer_of(load<vec>(own), load<vec>(behind_it));
      const vec per = 1.0f / n.sum, share = (scene_.backed ? n.behind : load<vec>(own)) * per;
      vec d_sum = {};
      const vec d_share = through(e, i, front(share), behind, slopes, [&](int c, vec slope) {
        float *its = values + c * BLOCK_PIXELS + i;
        const vec d_light = slope * per;
        d_sum -= d_light * load<vec>(its) * per;
        store(its, d_light);
      });
      d_sum -= d_share * share * per;
      const vec d_part = d_share * per, d_raised = d_sum + (scene_.backed ? d_part : vec{}),
                slope = slope_of_raise(n.lacking);
      store(own, d_sum + (scene_.backed ? vec{} : d_part) + d_raised * slope);
      store(behind_it, d_raised * (1.0f + slope));
    });
  }

  // Composites a block again, and walks back through the steps: `slopes` is its gradient.
  void walk(const std::vector<Step> &steps, int block, Events &events, float *slopes) const {
    const size_t size = planes_ * BLOCK_PIXELS;
    events.resize(size * (2 * steps.size() + 1));
    std::vector<const float *> behind;  // the canvas behind each step, and after it the step's own; null if it is empty
    float *canvas = events.data();
    clear(canvas);
    for (const Step &step : steps) {
      float *kept = canvas + size, *next = step.run ? kept + size : kept;
      memcpy(next, canvas, size * sizeof(float));
      behind.push_back(put(step, block, next, kept) ? canvas : nullptr);
      canvas = next;
    }
    for (int i = (int)steps.size() - 1; i >= 0; i--) {
      if (!behind[i]) continue;
      if (steps[i].run)
        walk_join(*steps[i].run, block, behind[i], behind[i] + size, slopes);
      else if (steps[i].layer < 0)
        walk_stand_ins(block, behind[i], slopes);
      else
        walk_layer(steps[i].layer, block, behind[i], slopes);
    }
  }
  void walk_join(const Run &run, int block, const float *behind, const float *values, float *slopes) const {
    float d_run[MOST * BLOCK_PIXELS];
    if (over_)
      each_pixel([&](int e, int i) {
        const Front f = front(load<vec>(values + (C_ + e) * BLOCK_PIXELS + i));
        store(d_run + (C_ + e) * BLOCK_PIXELS + i,
              through(e, i, f, behind, slopes, [&](int c, vec slope) { store(d_run + c * BLOCK_PIXELS + i, slope); }));
      });
    else
      memcpy(d_run, slopes, planes_ * BLOCK_PIXELS * sizeof(float));
    write(block, d_run, run.slopes.data());
  }

  // Scatters the gradients of a layer's blurred terms to its terms, and on to the surfaces.
  void scatter_back(const Run &run, int k, const Tile &tile) const {
    const Blurred &b = blurred_[k];
    const int half = layers_[k].half;
    auto has_gradient = [&](int block) {  // otherwise its terms are constant, or nothing reads them
      return b.needed[block] && (b.occupied[block] || (over_ && weighed() && b.behind[block]));
    };
    bool any = false;
    each_block_of(run, tile, [&](int block) { any |= has_gradient(block); });
    if (!any) return;
    const int top = tile.row0 * BLOCK - half, bottom = tile.row1 * BLOCK + half, left = tile.column0 * BLOCK - half,
              right = tile.column1 * BLOCK + half;
    for (int r = floor_div(top, BLOCK); r * BLOCK < bottom; r++)
      for (int c = floor_div(left, BLOCK); c * BLOCK < right; c++) {
        const bool within = r >= 0 && r < run.block_rows && c >= 0 && c < run.block_columns;
        const float *values = within ? values_of(k, r * run.block_columns + c) : nullptr;
        const int x0 = std::max(left, c * BLOCK), count = std::min(right, (c + 1) * BLOCK) - x0;
        for (int v = 0; v < values_; v++)
          for (int y = std::max(top, r * BLOCK); y < std::min(bottom, (r + 1) * BLOCK); y++)
            if (values)
              memcpy(tile.at(v, y, x0), values + v * BLOCK_PIXELS + (y - r * BLOCK) * BLOCK + x0 - c * BLOCK,
                     count * sizeof(float));
            else
              memset(tile.at(v, y, x0), 0, count * sizeof(float));
      }
    const std::vector<uint32_t> every(BLOCK + 2 * half, ~0u);
    each_block_of(run, tile, [&](int block) {
      if (!has_gradient(block)) return;
      float slopes[(MOST + 2) * BLOCK_PIXELS], more[BLOCK_PIXELS];
      const int y0 = block / run.block_columns * BLOCK, x0 = block % run.block_columns * BLOCK;
      bool wanted[2][BLOCK / STRIP_ROWS];  // strips with pixels in the layer; in it or behind it
      for (int y = 0; y < BLOCK; y += STRIP_ROWS) {
        wanted[0][y / STRIP_ROWS] = occurs(run, k, y0 + y, y0 + y + STRIP_ROWS, x0, x0 + BLOCK);
        wanted[1][y / STRIP_ROWS] = reaches_behind(run, k, y0 + y, y0 + y + STRIP_ROWS, x0, x0 + BLOCK);
      }
      for (int term = b.occupied[block] ? 0 : C_ + 1; term < terms_; term++) {
        float *to = slopes + term * BLOCK_PIXELS;
        const int first = term < C_ ? term : term == C_ ? C_ : C_ + E_, count = term < C_ ? 1 : E_;
        for (int e = 0; e < count; e++) {
          const Kernel &kernel = b.turned[E_ == 1 ? 0 : term < C_ ? term : e];
          convolve(run, tile, first + e, block, kernel, every.data(), e ? more : to,
                   [&](int y) { return wanted[term > C_][y / STRIP_ROWS]; });
          for (int j = 0; e && j < BLOCK_PIXELS; j++) to[j] += more[j];
        }
      }
      S_ == 1 ? to_surfaces<1>(run, k, block, slopes) : to_surfaces<2>(run, k, block, slopes);
    });
  }
  bool weighed() const {
    for (int j = 0; j < S_; j++)
      if (scene_.weight[j]) return true;
    return false;
  }

  // Adds the gradients of a layer's terms in a block to those of the surfaces: the derivatives of `terms` and `weigh`,
  // last operation first.
  template <int S>
  void to_surfaces(const Run &run, int k, int block, const float *slopes) const {
    const int C = C_;
    const Layer &l = layers_[k];
    const int s = run.scale, y0 = block / run.block_columns * BLOCK, x0 = block % run.block_columns * BLOCK;
    const float part = 1.0f / (s * s);
    each_cell(run, k, y0, y0 + BLOCK, x0, x0 + BLOCK, [&](int y, int x, int n, Side side, bool occupied) {
      const size_t at = (size_t)y * scene_.columns + x;
      const float *row = slopes + (y / s - y0) * BLOCK - x0;
      auto slope = [&](int v) {
        const float *from = row + v * BLOCK_PIXELS;
        if (s == 1) return load<vec>(from + x);
        vec wide;
        for (int i = 0; i < LANES; i++) wide[i] = from[(x + i) / s];
        return wide * part;
      };
      const vec d_behind = over_ ? slope(C + 1) : vec{};
      if (side == BEHIND) {
        for (int j = 0; j < S; j++)
          if (scene_.weight[j]) add_some(weight_[j] + at, d_behind, n);
        return;
      }
      const Pixels<S> p = weigh<S>(l, at, n);
      vec d_share[S] = {}, d_ahead[S], d_here[S], d_place[S], d_weight[S];
      if (occupied) {
        vec given[S], more[S] = {};
        for (int j = 0; j < S; j++) given[j] = p.of_frame(j);
        for (int c = 0; c < C; c++) {
          const vec d_light = slope(c);
          for (int j = 0; j < S; j++) {
            more[j] += d_light * load_some(scene_.light[j] + c * map_ + at, n);
            add_some(light_[j] + c * map_ + at, d_light * given[j], n);
          }
        }
        for (int j = 0; j < S; j++) d_share[j] = slope(C) + p.swap(more, j);
      }
      p.back(d_share, d_behind, d_ahead, d_here, d_weight);
      for (int j = 0; j < S; j++) d_place[j] = d_ahead[j] * l.per_before + d_here[j] * l.per_after;
      for (int j = 0; j < S; j++) {
        add_some(place_[j] + at, p.swap(d_place, j), n);
        if (scene_.weight[j]) add_some(weight_[j] + at, p.swap(d_weight, j), n);
      }
    });
  }

  const torchdof_layers &scene_;
  const int C_, E_, S_;
  const bool over_;
  const int terms_, values_, planes_;  // of a layer: terms, blurred terms; planes of a canvas
  const float empty_;
  const size_t map_ = (size_t)scene_.rows * scene_.columns;
  std::vector<Layer> layers_;
  std::vector<Blurred> blurred_;
  std::vector<Run> runs_;
  int words_ = 0, cell_rows_ = 0, cell_columns_ = 0;
  std::vector<uint64_t> cells_;
  std::vector<float> lows_, highs_;
  float *const *light_ = nullptr, *const *place_ = nullptr, *const *weight_ = nullptr;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_blend(const torchdof_layers *layers, float *out, const float *gradient, float *const *d_light,
                       float *const *d_place, float *const *d_weight) {
  return torchdof::guarded([&] {
    torchdof::Blend blend(*layers);
    gradient ? blend.gradient(gradient, d_light, d_place, d_weight) : blend.picture(out);
  });
}
