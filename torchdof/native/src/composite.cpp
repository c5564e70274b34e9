// Composite: soft layers, far to near, each spread with its kernel and laid over what is behind it. The formulas are
// told in render/composite.py. Layers of full resolution are laid tile by tile, all of them while the tile is in the
// cache; coarser ones before that, each run of them on a canvas of its resolution.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

constexpr float LEAST = 1e-6f;    // share of spread weight below which nothing is known
constexpr float KNOWN = 2e-3f;    // and from which on a layer is known in full
constexpr float FOOT = 0.15f;     // share up to which a ramp between layers rises by its square,
constexpr float SLOPE = 1 / (1 - FOOT / 2);  // and how it goes on
constexpr float HAIR = 0.06f;     // share of a surface up to which it does not yet hide what is known behind it
constexpr float COVERED = 1e-6f;  // so little is left uncovered by rounding alone
constexpr int BEHIND_STEP = 4;    // pixels between samples of the light behind all surfaces
constexpr int TILE_PIXELS = TILE * TILE;

// A ramp from 0 to 1, exactly, whose foot is a parabola.
inline float eased(float v) {
  const float foot = std::min(v, FOOT);
  return std::max(1.0f - SLOPE * (1.0f - v), SLOPE / (2 * FOOT) * foot * foot);
}
template <typename V>
inline V eased(V v) {
  const V most = V{} + FOOT, foot = v < most ? v : most;
  const V line = 1.0f - SLOPE * (1.0f - v), parabola = SLOPE / (2 * FOOT) * foot * foot;
  return line > parabola ? line : parabola;
}
inline bool any_positive(vec v) {
  typedef long long wide __attribute__((vector_size(LANES * 4)));
  const wide bits = (wide)(v > vec{});
  long long any = 0;
  for (int i = 0; i < LANES / 2; i++) any |= bits[i];
  return any != 0;
}

// Neighbouring layers of one resolution and, if it is a coarser one, one side of the focus.
struct Run {
  int scale, first, last, half;
  int tile_rows = 0, tile_columns = 0, rows = 0, columns = 0;  // of its canvas, one pixel more on each side
  Buffer<float> canvas;                                        // light and coverage
  std::vector<uint8_t> used;                                   // tiles with anything in them
};

// Parts of blocks of pixels that lie between two nodes: for each its place in the window, the node before, and
// 2 (channels + 1) sums: share and light; and these times how far between the nodes each pixel lies.
struct Pieces {
  std::vector<int> at, node, order;
  std::vector<float> values;  // of more pieces than there are
  int count = 0;
  float *add(int place, int after, int stride) {
    if ((size_t)(count + 1) * stride > values.size()) values.resize(std::max<size_t>(values.size() * 2, 4096 * stride));
    at.push_back(place);
    node.push_back(after);
    return values.data() + (size_t)count++ * stride;
  }
};

// Planes of a window, `pitch` values a row.
struct Scratch {
  std::vector<float> memory;
  std::vector<float *> light, coc, weight;  // of each surface (light: [surfaces, channels])
  std::vector<float *> term;    // what a layer spreads: light, share, room
  std::vector<float *> spread;  // the same spread: light, then share and room of each colour
  std::vector<float *> canvas;  // light and coverage of a tile
  std::vector<float *> mine;    // a row of each surface's share
  float *rest;                  // what lies wholly behind a coarse layer
  std::vector<uint32_t> rows, every;
  std::vector<const float *> pointers;
  std::vector<uint64_t> layers;
  Pieces pieces;
};

}  // namespace

class Composite {
 public:
  Composite(const Job &job, const float *const *ray_kernels, const int32_t *ray_halves, float *out)
      : job_(job), s_(job.surfaces), layers_(job.layers), ray_kernels_(ray_kernels), ray_halves_(ray_halves), out_(out) {}

  void run() {
    H_ = job_.height, W_ = job_.width, C_ = job_.channels, E_ = job_.colours, N_ = (int)layers_.size();
    over_ = job_.scene.occlusion;
    low_ = (float)layers_.front().node;
    high_ = (float)layers_.back().node;
    int half = 0;
    for (int k = 0; k < N_; k++) {
      const Layer &l = layers_[k];
      half = std::max(half, l.half);
      const bool near = l.node < 0;
      if (!runs_.empty() && runs_.back().scale == l.scale && (l.scale == 1 || (layers_[runs_.back().first].node < 0) == near)) {
        runs_.back().last = k;
        runs_.back().half = std::max(runs_.back().half, l.half);
      } else {
        Run run;
        run.scale = l.scale;
        run.first = run.last = k;
        run.half = l.half;
        runs_.push_back(std::move(run));
      }
    }
    window_ = TILE + 2 * half;
    pitch_ = (window_ + 15) / 16 * 16 + 3 * BLOCK;  // rows are read in whole blocks
    scratches_.resize(std::max(1, job_.scene.threads));
    index();
    int farthest = 0;  // beyond the frame
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
      run.used.assign(run.tile_rows * run.tile_columns, 0);
      run.canvas = Buffer<float>((size_t)(C_ + E_) * run.rows * run.columns);
      for (int t = 0; t < run.tile_rows * run.tile_columns; t++) coarse.push_back({r, t});
    }
    job_.parallel((int)coarse.size(), [&](int i, int worker) { coarse_tile(runs_[coarse[i].first], coarse[i].second, scratch(worker)); });
    if (!job_.rays.empty()) sort_rays();
    const int columns = ceil_div(W_, TILE);
    job_.parallel(ceil_div(H_, TILE) * columns, [&](int i, int worker) { tile(i / columns, i % columns, scratch(worker)); });
  }

 private:
  Scratch &scratch(int worker) {
    if (!scratches_[worker]) {
      scratches_[worker].reset(new Scratch());
      Scratch &b = *scratches_[worker];
      const size_t plane = (size_t)window_ * pitch_;
      const int count = s_.count, planes = count * (C_ + 2) + (C_ + 2) + 1;
      b.memory.assign(planes * plane + (size_t)(2 * C_ + 3 * E_) * TILE_PIXELS + (size_t)count * pitch_ * 2 + 16, 0.0f);
      float *p = b.memory.data();
      auto take = [&](size_t size) { return (p += size) - size; };
      for (int i = 0; i < count * C_; i++) b.light.push_back(take(plane));
      for (int i = 0; i < count; i++) b.coc.push_back(take(plane)), b.weight.push_back(take(plane));
      for (int i = 0; i < C_ + 2; i++) b.term.push_back(take(plane));
      b.rest = take(plane);
      for (int i = 0; i < C_ + 2 * E_; i++) b.spread.push_back(take(TILE_PIXELS));
      for (int i = 0; i < C_ + E_; i++) b.canvas.push_back(take(TILE_PIXELS));
      for (int i = 0; i < 2 * count; i++) b.mine.push_back(take(pitch_));
      b.rows.resize(window_);
      b.every.assign(window_, ~0u);
      b.pointers.resize(C_);
      b.layers.resize(words_);
    }
    return *scratches_[worker];
  }

  // For each pixel of each surface the node before it, and for each cell the layers in it.
  void index() {
    words_ = (N_ + 63) / 64;
    cell_rows_ = ceil_div(H_, CELL);
    cell_columns_ = ceil_div(W_, CELL);
    cells_.assign((size_t)cell_rows_ * cell_columns_ * words_, 0);
    single_.assign((size_t)cell_rows_ * cell_columns_, 0);
    for (int i = 0; i < s_.count; i++) intervals_.emplace_back(s_.area());
    constexpr int STEPS = 4096;
    std::vector<int> start(STEPS + 2);
    const double reach = (double)high_ - low_;
    for (int i = 0, k = 0; i <= STEPS + 1; i++) {
      while (k + 1 < N_ && (float)layers_[k + 1].node <= low_ + (i - 1) * reach / STEPS) k++;
      start[i] = k;
    }
    const float scale = reach > 0 ? (float)(STEPS / reach) : 0.0f;
    auto node_before = [&](float place) {
      int k = start[std::clamp((int)((place - low_) * scale), 0, STEPS)];
      while (k + 1 < N_ && place >= layers_[k + 1].at) k++;
      return k;
    };
    auto mark = [&](uint64_t *bits, float place, int k) {
      bits[k / 64] |= 1ull << k % 64;
      if (place > layers_[k].at) bits[(k + 1) / 64] |= 1ull << (k + 1) % 64;
    };
    constexpr int CELLS = BLOCK / CELL;
    job_.parallel(s_.block_rows, [&](int by, int) {
      std::vector<const float *> light(C_);
      const float *coc, *weight;
      for (int bx = 0; bx < s_.block_columns; bx++) {
        const int block = by * s_.block_columns + bx, y_end = std::min(H_, (by + 1) * BLOCK), x_end = std::min(W_, (bx + 1) * BLOCK);
        if (!s_.whole() && !s_.has_block(block)) {  // one surface; mostly between the same two nodes
          const float low = axis(job_.block_low[block], low_, high_), high = axis(job_.block_high[block], low_, high_);
          const int k = node_before(low);
          if (k == node_before(high)) {
            for (int y = by * BLOCK; y < y_end; y++) std::fill(&intervals_[0][(size_t)y * W_ + bx * BLOCK], &intervals_[0][(size_t)y * W_ + x_end - 1] + 1, (uint16_t)k);
            for (int row = by * CELLS; row * CELL < y_end && row < (by + 1) * CELLS; row++)
              for (int column = bx * CELLS; column * CELL < x_end && column < (bx + 1) * CELLS; column++) {
                const size_t cell = (size_t)row * cell_columns_ + column;
                mark(&cells_[cell * words_], low, k);
                mark(&cells_[cell * words_], high, k);
                single_[cell] = !s_.independent;
              }
            continue;
          }
        }
        for (int row = by * CELLS; row * CELL < y_end && row < (by + 1) * CELLS; row++)
          for (int column = bx * CELLS; column * CELL < x_end && column < (bx + 1) * CELLS; column++) {
            const size_t cell = (size_t)row * cell_columns_ + column;
            uint64_t *bits = &cells_[cell * words_];
            const int x0 = column * CELL, n = std::min(CELL, W_ - x0);
            bool single = true;
            for (int i = 0; i < s_.count; i++) {
              float places[CELL * CELL], low = NEVER, high = -NEVER;
              bool there[CELL * CELL], any = false;
              int count = 0;
              for (int y = row * CELL; y < std::min(H_, (row + 1) * CELL); y++) {
                if (!s_.row(i, y, x0, light.data(), coc, weight)) break;
                if (i && !weight) single = false;
                if (n == CELL) {
                  vec lows = all(NEVER), highs = all(-NEVER), least_weight = all(1.0f), most_weight = all(weight ? 0.0f : 1.0f);
                  for (int x = 0; x < CELL; x += LANES, count += LANES) {
                    const vec place = axis(load<vec>(coc + x), low_, high_);
                    store(places + count, place);
                    lows = least(lows, place);
                    highs = most(highs, place);
                    if (weight) {
                      least_weight = least(least_weight, load<vec>(weight + x));
                      most_weight = most(most_weight, load<vec>(weight + x));
                    }
                    for (int lane = 0; lane < LANES; lane++) there[count + lane] = !weight || weight[x + lane] != 0;
                  }
                  low = std::min(low, smallest(lows));
                  high = std::max(high, largest(highs));
                  if (i ? largest(most_weight) != 0 : smallest(least_weight) < 1) single = false;
                  any |= largest(most_weight) != 0;
                  continue;
                }
                for (int x = 0; x < n; x++, count++) {
                  const float w = weight ? weight[x] : 1.0f;
                  if (weight && (i ? w != 0 : w < 1)) single = false;
                  any |= there[count] = w != 0;
                  places[count] = axis(coc[x], low_, high_);
                  low = std::min(low, places[count]);
                  high = std::max(high, places[count]);
                }
              }
              if (!any) continue;
              const int first = node_before(low), last = node_before(high);
              for (int j = 0; j < count; j++) {
                const int k = first == last ? first : node_before(places[j]);
                intervals_[i][(size_t)(row * CELL + j / n) * W_ + x0 + j % n] = (uint16_t)k;
                if (first != last && there[j]) mark(bits, places[j], k);
              }
              if (first == last) {
                mark(bits, low, first);
                mark(bits, high, first);
              }
            }
            single_[cell] = single && !s_.independent;
          }
      }
    });
  }

  // Layers in cells, and whether these show the first surface alone.
  bool around(int r0, int r1, int c0, int c1, uint64_t *bits) const {
    r0 = std::clamp(r0, 0, cell_rows_ - 1), r1 = std::clamp(r1, 0, cell_rows_ - 1);
    c0 = std::clamp(c0, 0, cell_columns_ - 1), c1 = std::clamp(c1, 0, cell_columns_ - 1);
    for (int w = 0; w < words_; w++) bits[w] = 0;
    bool single = true;
    for (int r = r0; r <= r1; r++)
      for (int c = c0; c <= c1; c++) {
        const size_t cell = (size_t)r * cell_columns_ + c;
        for (int w = 0; w < words_; w++) bits[w] |= cells_[cell * words_ + w];
        single &= (bool)single_[cell];
      }
    return single;
  }
  static bool has(const uint64_t *bits, int k) { return bits[k / 64] >> k % 64 & 1; }

  static int floor_div(int a, int b) { return a >= 0 ? a / b : -((-a + b - 1) / b); }

  // A coarse run in one of its tiles.
  void coarse_tile(Run &run, int which, Scratch &b) {
    const int s = run.scale, tile_y = which / run.tile_columns * TILE, tile_x = which % run.tile_columns * TILE;
    const int rows = std::min(TILE, run.rows - tile_y), columns = std::min(TILE, run.columns - tile_x);
    const int half = run.half, height = rows + 2 * half, width = columns + 2 * half;
    const int top = tile_y - 1 - half, left = tile_x - 1 - half;  // the first block of the window
    around(floor_div(top * s, CELL), floor_div((top + height) * s - 1, CELL), floor_div(left * s, CELL),
           floor_div((left + width) * s - 1, CELL), b.layers.data());
    bool any = false;
    for (int k = run.first; k <= run.last; k++) any |= has(b.layers.data(), k);
    if (!any) {
      for (int c = 0; c < C_ + E_; c++)
        for (int y = 0; y < rows; y++)
          memset(&run.canvas[((size_t)c * run.rows + tile_y + y) * run.columns + tile_x], 0, columns * sizeof(float));
      return;
    }
    run.used[which] = 1;
    for (float *canvas : b.canvas) memset(canvas, 0, TILE_PIXELS * sizeof(float));
    if (!s_.independent) {
      if (C_ == 3) gather<3>(run, top, left, height, width, b); else gather<0>(run, top, left, height, width, b);
    }
    for (int k = run.last; k >= run.first; k--) {
      const Layer &l = layers_[k];
      const bool there = s_.independent ? has(b.layers.data(), k) : !(piece_start(b, k - run.first + 2) == piece_start(b, k - run.first));
      if (!there) continue;
      const int spare = half - l.half;
      const size_t shift = (size_t)spare * pitch_ + spare;
      if (s_.independent)
        block_means(k, s, top + spare, left + spare, rows + 2 * l.half, columns + 2 * l.half, shift, b);
      else
        add_pieces(run, k, height, b);
      lay(b, l, rows, columns, shift);
    }
    for (int c = 0; c < C_ + E_; c++)
      for (int y = 0; y < rows; y++)
        memcpy(&run.canvas[((size_t)c * run.rows + tile_y + y) * run.columns + tile_x], b.canvas[c] + y * TILE, columns * sizeof(float));
  }

  static int piece_start(const Scratch &b, int i) { return b.pieces.order[i]; }

  // What the blocks of a window hold for a run, sorted by node. Pieces between node first - 1 + i and the next one are
  // order[i] to order[i + 1].
  template <int CHANNELS>
  void gather(const Run &run, int top, int left, int height, int width, Scratch &b) {
    const int C = CHANNELS ? CHANNELS : C_, s = run.scale, stride = 2 * (C + 1), L = run.last - run.first + 2;
    const float each = 1.0f / (s * s);
    Pieces &p = b.pieces;
    p.at.clear();
    p.node.clear();
    p.count = 0;
    std::vector<float> sums(stride);
    for (int by = 0; by < height; by++) memset(b.rest + (size_t)by * pitch_, 0, width * sizeof(float));
    for (int by = 0; by < height; by++)
      for (int bx = 0; bx < width; bx++) {
        const int y0 = (top + by) * s, x0 = (left + bx) * s, place = by * pitch_ + bx;
        const bool inside = y0 >= 0 && x0 >= 0 && y0 + s <= H_ && x0 + s <= W_;
        int count = s_.count;
        if (inside) {
          bool before = false, behind = false, here = false, single = true;  // layers of its cells relative to the run
          for (int row = y0 / CELL; row <= (y0 + s - 1) / CELL; row++)
            for (int column = x0 / CELL; column <= (x0 + s - 1) / CELL; column++) {
              const size_t cell = (size_t)row * cell_columns_ + column;
              const uint64_t *bits = &cells_[cell * words_];
              for (int w = 0; w < words_; w++) {
                before |= (bits[w] & below(run.first, w)) != 0;
                behind |= (bits[w] & ~below(run.last + 1, w)) != 0;
                here |= (bits[w] & ~below(run.first, w) & below(run.last + 1, w)) != 0;
              }
              single &= (bool)single_[cell];
            }
          if (!here && !behind) continue;
          if (single && !here && !before) {
            b.rest[place] = 1.0f;
            continue;
          }
          if (single) count = 1;
        }
        for (int i = 0; i < count; i++) {
          const float *light_of[CHANNELS ? CHANNELS : 1], *coc, *weight;
          const float **light = CHANNELS ? light_of : b.pointers.data();
          if (inside) {
            if (!s_.row(i, y0, x0, light, coc, weight)) break;
            const uint16_t *interval = &intervals_[i][(size_t)y0 * W_ + x0];
            const size_t light_step = s_.whole() || !weight ? W_ : BLOCK, coc_step = i && !s_.whole() ? BLOCK : W_;
            if (CHANNELS && one_interval(interval, s)) {
              const int k = *interval;
              if (k + 1 < run.first) continue;
              if (k > run.last) {
                float sum = weight ? 0.0f : s * s;
                if (weight)
                  for (int y = 0; y < s; y++)
                    for (int x = 0; x < s; x++) sum += weight[y * light_step + x];
                b.rest[place] += sum * each;
                continue;
              }
              float *to = p.add(place, k - run.first + 1, stride);
              if (weight)
                sum_block<CHANNELS, true>(light, light_step, coc, coc_step, weight, s, k, to);
              else
                sum_block<CHANNELS, false>(light, light_step, coc, coc_step, weight, s, k, to);
              continue;
            }
          }
          int node = -1;
          auto flush = [&] {
            if (node < 0) return;
            memcpy(p.add(place, node - run.first + 1, stride), sums.data(), stride * sizeof(float));
          };
          for (int y = 0; y < s; y++) {
            const int at_y = std::clamp(y0 + y, 0, H_ - 1);
            if (inside) s_.row(i, at_y, x0, light, coc, weight);
            for (int x = 0; x < s; x++) {
              int at = x, at_x = x0 + x;
              bool beyond = false;
              if (!inside) {
                at_x = std::clamp(at_x, 0, W_ - 1);
                beyond = y0 + y != at_y || x0 + x != at_x;
                at = 0;
                if (!s_.row(i, at_y, at_x, light, coc, weight)) continue;
              }
              const float w = weight ? weight[at] : 1.0f;
              if (w == 0) continue;
              const int k = intervals_[i][(size_t)at_y * W_ + at_x];
              if (k + 1 < run.first) continue;
              if (k > run.last) {
                b.rest[place] += w * each;
                continue;
              }
              if (k != node) {
                flush();
                node = k;
                std::fill(sums.begin(), sums.end(), 0.0f);
              }
              const float ramp = clamp01((axis(coc[at], low_, high_) - layers_[k].at) * layers_[k].per_after);
              const float part = over_ ? eased(ramp) : ramp;
              float *one = sums.data(), *two = one + C + 1;
              one[0] += w;
              two[0] += w * part;
              for (int c = 0; c < C; c++) {
                const float v = w * (beyond ? border_.light(i, c, y0 + y, x0 + x, light[c][at]) : light[c][at]);
                one[1 + c] += v;
                two[1 + c] += v * part;
              }
            }
          }
          flush();
        }
      }
    // sorted by node
    const int pieces = p.count;
    p.order.assign(L + 2 + pieces, 0);
    for (int node : p.node) p.order[node + 1]++;
    for (int i = 0; i <= L; i++) p.order[i + 1] += p.order[i];
    std::vector<int> next(p.order.begin(), p.order.begin() + L + 1);
    for (int i = 0; i < pieces; i++) p.order[L + 2 + next[p.node[i]]++] = i;
  }

  bool one_interval(const uint16_t *at, int s) const {
    const uint16_t first = at[0];
    unsigned differs = 0;
    for (int y = 0; y < s; y++, at += W_)
      for (int x = 0; x < s; x++) differs |= at[x] ^ first;
    return !differs;
  }

  // The sums of a block of one surface that lies between two nodes.
  template <int CHANNELS, bool WEIGHTED>
  void sum_block(const float *const *light, size_t light_step, const float *coc, size_t coc_step, const float *weight, int s,
                 int k, float *out) const {
    typedef float f4 __attribute__((vector_size(16)));
    const float node = layers_[k].at, per_after = layers_[k].per_after;
    f4 share = {}, part_sum = {}, one[CHANNELS ? CHANNELS : 1] = {}, two[CHANNELS ? CHANNELS : 1] = {};
    const f4 none = {}, whole = {1, 1, 1, 1};
    auto add = [&](const f4 w, const f4 at, auto light_at) {
      f4 ramp = (axis(at, low_, high_) - node) * per_after;
      if (over_) {
        ramp = ramp < whole ? ramp : whole;
        ramp = eased(ramp > none ? ramp : none);
      }
      const f4 part = ramp * w;
      share += w;
      part_sum += part;
      for (int c = 0; c < CHANNELS; c++) {
        const f4 v = light_at(light[c]);
        one[c] += v * w;
        two[c] += v * part;
      }
    };
    if (s == 2) {
      auto four = [](const float *from, size_t step) { return f4{from[0], from[1], from[step], from[step + 1]}; };
      add(WEIGHTED ? four(weight, light_step) : whole, four(coc, coc_step), [&](const float *from) { return four(from, light_step); });
    } else {
      for (int y = 0; y < s; y++)
        for (int x = 0; x < s; x += 4)
          add(WEIGHTED ? load<f4>(weight + y * light_step + x) : whole, load<f4>(coc + y * coc_step + x),
              [&](const float *from) { return load<f4>(from + y * light_step + x); });
    }
    auto sum = [](f4 v) { return (v[0] + v[2]) + (v[1] + v[3]); };
    out[0] = sum(share);
    out[CHANNELS + 1] = sum(part_sum);
    for (int c = 0; c < CHANNELS; c++) {
      out[1 + c] = sum(one[c]);
      out[CHANNELS + 2 + c] = sum(two[c]);
    }
  }

  static uint64_t below(int k, int word) {  // bits of layers before layer k
    const int bit = k - 64 * word;
    return bit <= 0 ? 0 : bit >= 64 ? ~0ull : (1ull << bit) - 1;
  }

  // What layer k spreads of the pieces of its run; what lies behind it is added to the rest.
  void add_pieces(const Run &run, int k, int height, Scratch &b) {
    const int C = C_, stride = 2 * (C + 1), L = run.last - run.first + 2;
    const float each = 1.0f / (run.scale * run.scale);
    Pieces &p = b.pieces;
    for (int c = 0; c < C + 1; c++) memset(b.term[c], 0, sizeof(float) * height * pitch_);
    auto add = [&](int node, bool behind) {  // pieces before the layer's node, or behind it
      for (int i = p.order[node]; i < p.order[node + 1]; i++) {
        const int piece = p.order[L + 2 + i], at = p.at[piece];
        const float *one = &p.values[(size_t)piece * stride], *two = one + C + 1;
        auto part = [&](int v) { return (behind ? one[v] - two[v] : two[v]) * each; };
        b.term[C][at] += part(0);
        for (int c = 0; c < C; c++) b.term[c][at] += part(1 + c);
        if (behind)
          b.rest[at] += one[0] * each;
        else
          b.term[C + 1][at] += part(0);
      }
    };
    add(k - run.first + 1, true);
    memcpy(b.term[C + 1], b.rest, sizeof(float) * height * pitch_);
    add(k - run.first, false);
  }

  // The same of surfaces that cover each other: means of what the layer spreads at each pixel.
  void block_means(int k, int s, int top, int left, int height, int width, size_t shift, Scratch &b) {
    const float each = 1.0f / (s * s);
    const int n = width * s;
    std::vector<float> memory((size_t)(s_.count * (C_ + 2) + C_ + 2 + 2 * s_.count) * (n + LANES));
    float *m = memory.data();
    auto take = [&] { return (m += n + LANES) - (n + LANES); };  // vectors may read beyond the end
    std::vector<float *> light(s_.count * C_), coc(s_.count), weight(s_.count), term(C_ + 2), mine(2 * s_.count);
    for (auto *v : {&light, &coc, &weight, &term, &mine})
      for (float *&row : *v) row = take();
    for (int by = 0; by < height; by++) {
      const size_t to = shift + (size_t)by * pitch_;
      for (int c = 0; c < C_ + 2; c++) memset(b.term[c] + to, 0, width * sizeof(float));
      for (int y = 0; y < s; y++) {
        read_row((top + by) * s + y, left * s, n, false, light.data(), coc.data(), weight.data(), b);
        row_terms(layers_[k], n, false, light.data(), coc.data(), weight.data(), mine.data(), term.data());
        for (int x = 0; x < n; x++)
          for (int c = 0; c < C_ + 2; c++) b.term[c][to + x / s] += term[c][x] * each;
      }
    }
  }

  // A row of all surfaces, continued beyond the frame: light [surfaces, channels], place on the blur axis and weight.
  void read_row(int y, int x0, int n, bool single, float *const *light, float *const *coc, float *const *weight, Scratch &b) {
    const int at_y = std::clamp(y, 0, H_ - 1), first = std::clamp(x0, 0, W_ - 1), last = std::clamp(x0 + n - 1, 0, W_ - 1);
    const int before = std::max(0, std::min(n, -x0)), after = std::max(0, std::min(n, x0 + n - W_));
    for (int i = 0; i < (single ? 1 : s_.count); i++) {
      const float *from_coc, *from_weight;
      for (int x = first; x <= last;) {
        int end = last + 1;
        if (!s_.whole()) {  // as far as the image says all, or block by block
          const int blocks = at_y / BLOCK * s_.block_columns;
          const bool own = s_.has_block(blocks + x / BLOCK);
          end = (x / BLOCK + 1) * BLOCK;
          while (end <= last && !own && !s_.has_block(blocks + end / BLOCK)) end += BLOCK;
          end = std::min(end, last + 1);
        }
        const int count = end - x;
        // a window beside the frame sees its nearest pixel
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
      auto go_on = [&](float *row) {
        std::fill(row, row + before, row[std::min(before, n - 1)]);
        std::fill(row + n - after, row + n, row[std::max(n - after, 1) - 1]);
      };
      for (int c = 0; c < C_; c++) {
        float *row = light[i * C_ + c];
        go_on(row);
        for (int x = 0; x < before; x++) row[x] = border_.light(i, c, y, x0 + x, row[x]);
        for (int x = n - after; x < n; x++) row[x] = border_.light(i, c, y, x0 + x, row[x]);
        if (y != at_y && before + after < n) border_.continue_row(i, c, y, x0 + before, n - before - after, row + before);
      }
      go_on(coc[i]);
      go_on(weight[i]);
      for (int x = 0; x < n; x += LANES) store(coc[i] + x, axis(load<vec>(coc[i] + x), low_, high_));
    }
  }

  // What a layer spreads of a row: light, share, and the share at or behind it, its room.
  void row_terms(const Layer &l, int n, bool single, const float *const *light, const float *const *x, const float *const *weight,
                 float *const *mine, float *const *term) const {
    const float before = l.before, per_before = l.per_before, at = l.at, per_after = l.per_after;
    const float first = l.first ? 1.0f : 0.0f;
    auto at_or_behind = [&](vec p) {
      const vec ramp = clamp01((p - before) * per_before + first);
      return over_ ? eased(ramp) : ramp;
    };
    auto beyond = [&](vec p) {
      const vec ramp = clamp01((p - at) * per_after);
      return over_ ? eased(ramp) : ramp;
    };
    float *share = term[C_], *room = term[C_ + 1];
    if (single) {
      for (int i = 0; i < n; i += LANES) {
        const vec p = load<vec>(x[0] + i), h = at_or_behind(p), g = h - beyond(p);
        store(room + i, h);
        store(share + i, g);
        for (int c = 0; c < C_; c++) store(term[c] + i, load<vec>(light[c] + i) * g);
      }
      return;
    }
    if (!s_.independent) {
      for (int i = 0; i < n; i += LANES) {
        vec shares = {}, rooms = {};
        for (int j = 0; j < s_.count; j++) {
          const vec p = load<vec>(x[j] + i), w = load<vec>(weight[j] + i), h = at_or_behind(p);
          const vec m = (h - beyond(p)) * w;
          store(mine[j] + i, m);
          shares += m;
          rooms += h * w;
        }
        store(share + i, shares);
        store(room + i, rooms);
      }
    } else {
      // a pixel is there for the layer as far as what is at or behind it is known, but for what that has in front
      float *left = mine[s_.count], *unknown = mine[s_.count + 1 < 2 * s_.count ? s_.count + 1 : s_.count];
      std::vector<float> spare;
      if (s_.count == 1) {
        spare.resize(n);
        unknown = spare.data();
      }
      for (int i = 0; i < n; i++) room[i] = left[i] = unknown[i] = 1.0f;
      for (int j = 0; j < s_.count; j++) {
        const float *p = x[j], *w = weight[j];
        float *m = mine[j];
        for (int i = 0; i < n; i++) {
          const float ramp = clamp01((p[i] - before) * per_before + first), next = clamp01((p[i] - at) * per_after), cover = w[i];
          const float h = over_ ? eased(ramp) : ramp, g = h - (over_ ? eased(next) : next);
          const float here = cover * eased(std::min(h / HAIR, 1.0f)), there = 1.0f - here * (1.0f - h);
          const float stops = cover * g / std::max(there, LEAST);
          m[i] = left[i] * stops;
          left[i] *= 1.0f - stops;
          room[i] *= there;
          unknown[i] *= 1.0f - here;
        }
      }
      for (int i = 0; i < n; i++) share[i] = 0;
      for (int j = 0; j < s_.count; j++)
        for (int i = 0; i < n; i++) share[i] += mine[j][i] *= room[i];
      for (int i = 0; i < n; i++) room[i] *= 1.0f - unknown[i];
    }
    for (int c = 0; c < C_; c++)
      for (int i = 0; i < n; i += LANES) {
        vec sum = load<vec>(light[c] + i) * load<vec>(mine[0] + i);
        for (int j = 1; j < s_.count; j++) sum += load<vec>(light[j * C_ + c] + i) * load<vec>(mine[j] + i);
        store(term[c] + i, sum);
      }
  }

  // Spreads the terms of a layer, which begin at an offset, and lays them on the tile's canvas.
  void lay(Scratch &b, const Layer &l, int rows, int columns, size_t shift) {
    const int C = C_, E = E_, height = rows + 2 * l.half, width = columns + 2 * l.half;
    const int whole_rows = (rows + 3) / 4 * 4, whole_columns = (columns + 15) / 16 * 16;
    // where there is anything; whether nothing lies behind the layer, or before it
    bool any = false;
    vec open = {}, uneven = {};
    for (int y = 0; y < height; y++) {
      const float *share = b.term[C] + shift + (size_t)y * pitch_, *room = b.term[C + 1] + shift + (size_t)y * pitch_;
      uint32_t bits = 0;
      for (int x = 0; x < width; x += 16) {
        vec some = {};
        int i = x;
        for (; i + LANES <= std::min(x + 16, width); i += LANES) {
          const vec s = load<vec>(share + i);
          some = most(some, s);
          if (!over_) continue;
          const vec r = load<vec>(room + i), d = r - all(1.0f);
          open = most(open, r - s);
          uneven = most(uneven, d * d);
        }
        for (; i < std::min(x + 16, width); i++) {
          some[0] = std::max(some[0], share[i]);
          if (!over_) continue;
          open[0] = std::max(open[0], room[i] - share[i]);
          uneven[0] = std::max(uneven[0], (room[i] - 1.0f) * (room[i] - 1.0f));
        }
        bits |= (uint32_t)any_positive(some) << std::min(x / 16, 31);
      }
      b.rows[y] = bits;
      any |= bits != 0;
    }
    for (int y = height; y < whole_rows + 2 * l.half; y++) b.rows[y] = 0;
    const bool closed = !any_positive(open), flat = largest(uneven) <= 1e-12f;
    if (!any) return;
    auto spread = [&](int term, const uint32_t *rows_with, const Kernel &kernel, float *to) {
      if (l.half)
        convolve(b.term[term] + shift, pitch_, rows_with, kernel, whole_rows, whole_columns, to, TILE);
      else
        for (int y = 0; y < rows; y++)
          for (int x = 0; x < columns; x++) to[y * TILE + x] = b.term[term][shift + (size_t)y * pitch_ + x] * kernel.sum;
    };
    for (int c = 0; c < C; c++) spread(c, b.rows.data(), l.kernels[E > 1 ? c : 0], b.spread[c]);
    for (int e = 0; e < E; e++) {
      const Kernel &kernel = l.kernels[e];
      float *share = b.spread[C + e], *room = b.spread[C + E + e];
      if (!over_) {
        spread(C, b.rows.data(), kernel, share);
        for (int c = 0; c < C; c++)
          if (E == 1 || c == e) add_to(b.canvas[c], b.spread[c]);
        add_to(b.canvas[C + e], share);
        continue;
      }
      if (flat)
        std::fill(room, room + whole_rows * TILE, kernel.sum);
      else
        spread(C + 1, b.every.data(), kernel, room);
      if (closed)
        memcpy(share, room, whole_rows * TILE * sizeof(float));
      else
        spread(C, b.rows.data(), kernel, share);
      // colour = light / room, coverage = share / room
      for (int i = 0; i < whole_rows * TILE; i += LANES) {
          const vec one = all(1.0f), all_room = load<vec>(room + i), little = least(all_room, all(KNOWN));
          const vec per_room = one / (all_room - little + 0.5f * (all(KNOWN) + little * little / KNOWN));
          const vec cover = load<vec>(share + i) * per_room;
        const vec left = most(one - cover, vec{});
        for (int c = 0; c < C; c++)
          if (E == 1 || c == e) store(b.canvas[c] + i, load<vec>(b.spread[c] + i) * per_room + left * load<vec>(b.canvas[c] + i));
        store(b.canvas[C + e] + i, cover + left * load<vec>(b.canvas[C + e] + i));
      }
    }
  }

  static void add_to(float *to, const float *more) {
    for (int i = 0; i < TILE_PIXELS; i += LANES) store(to + i, load<vec>(to + i) + load<vec>(more + i));
  }

  // A coarser canvas, interpolated, over the tile's canvas.
  void join_finer(const Run &run, int y0, int x0, Scratch &b) {
    const int s = run.scale;
    const int r1 = std::min((y0 + TILE) / s + 1, run.rows - 1) / TILE, c1 = std::min((x0 + TILE) / s + 1, run.columns - 1) / TILE;
    bool any = false;
    for (int r = y0 / s / TILE; r <= r1; r++)
      for (int c = x0 / s / TILE; c <= c1; c++) any |= run.used[r * run.tile_columns + c];
    if (!any) return;
    const int channels = C_ + E_, count = TILE / s + 2, first = x0 / s, pitch = TILE + 32;
    std::vector<float> lines((size_t)channels * count), planes((size_t)channels * pitch);
    float *const values = planes.data() + s / 2;  // between two samples the first value lies half a sample behind
    float ramp[16];
    for (int i = 0; i < 16; i++) ramp[i] = (i % s + 0.5f) / s;
    for (int y = 0; y < TILE; y++) {
      const float at_y = (y0 + y + 0.5f) / s + 0.5f;
      const int row = std::min((int)at_y, run.rows - 2);
      const float down = at_y - row;
      const int inside = std::max(std::min(count, run.columns - first), 0);
      bool covered = false;
      for (int c = channels - 1; c >= 0; c--) {
        const float *upper = &run.canvas[((size_t)c * run.rows + row) * run.columns + first], *lower = upper + run.columns;
        float *line = &lines[(size_t)c * count];
        for (int i = 0; i < inside; i++) line[i] = upper[i] + down * (lower[i] - upper[i]);
        if (c >= C_)
          for (int i = 0; i < inside; i++) covered |= line[i] > 0;
        else if (!covered)
          break;
        float *v = &planes[(size_t)c * pitch];
        if (s == 2)
          for (int i = 0; i + 1 < count; i++, v += 2) {
            const float step = line[i + 1] - line[i];
            v[0] = line[i] + 0.25f * step;
            v[1] = line[i] + 0.75f * step;
          }
        else
          for (int i = 0; i + 1 < count; i++)
            for (int part = 0; part < s; part += 4, v += 4) {
              typedef float f4 __attribute__((vector_size(16)));
              const f4 from = f4{} + line[i], step = f4{} + (line[i + 1] - line[i]);
              store(v, from + step * load<f4>(ramp + part));
            }
      }
      if (!covered) continue;
      for (int e = 0; e < E_; e++) {
        const float *cover = values + (size_t)(C_ + e) * pitch;
        for (int x = 0; x < TILE; x += LANES) {
          const vec left = over_ ? most(all(1.0f) - load<vec>(cover + x), vec{}) : all(1.0f);
          for (int c = 0; c < channels; c++) {
            if (c < C_ ? E_ > 1 && c != e : c != C_ + e) continue;
            float *canvas = b.canvas[c] + y * TILE + x;
            store(canvas, load<vec>(values + (size_t)c * pitch + x) + left * load<vec>(canvas));
          }
        }
      }
    }
  }

  void tile(int tile_row, int tile_column, Scratch &b) {
    const int y0 = tile_row * TILE, x0 = tile_column * TILE, rows = std::min(TILE, H_ - y0), columns = std::min(TILE, W_ - x0);
    for (float *canvas : b.canvas) memset(canvas, 0, TILE_PIXELS * sizeof(float));
    // layers of full resolution whose light reaches the tile
    std::vector<int> reaching;
    int halo = 0, known_reach = -1;
    for (int k = N_ - 1; k >= 0; k--) {
      const Layer &l = layers_[k];
      if (l.scale > 1) continue;
      const int reach = ceil_div(l.half, CELL);
      if (reach != known_reach) look_around(y0, x0, known_reach = reach, b);
      if (!has(b.layers.data(), k)) continue;
      reaching.push_back(k);
      halo = std::max(halo, l.half);
    }
    bool single = false;
    int left = x0;  // where rows begin
    if (!reaching.empty()) {
      single = look_around(y0, x0, ceil_div(halo, CELL), b);
      std::vector<float *> light(b.light), coc(b.coc), weight(b.weight);
      left = floor_div(x0 - halo, BLOCK) * BLOCK;
      const int across = ceil_div(x0 + columns + halo - left, BLOCK) * BLOCK;
      for (int y = y0 - halo; y < y0 + rows + halo; y++) {
        read_row(y, left, across, single, light.data(), coc.data(), weight.data(), b);
        for (auto *v : {&light, &coc, &weight})
          for (float *&row : *v) row += pitch_;
      }
    }
    size_t next = 0;
    std::vector<const float *> light(s_.count * C_), coc(s_.count), weight(s_.count);
    std::vector<float *> term(C_ + 2);
    for (int r = (int)runs_.size() - 1; r >= 0; r--) {
      const Run &run = runs_[r];
      if (run.scale > 1) {
        join_finer(run, y0, x0, b);
        continue;
      }
      for (; next < reaching.size() && reaching[next] >= run.first; next++) {
        const Layer &l = layers_[reaching[next]];
        const int spare = halo - l.half, width = columns + 2 * l.half;
        for (int y = 0; y < rows + 2 * l.half; y++) {
          const size_t from = (size_t)(y + spare) * pitch_ + x0 - l.half - left, to = (size_t)y * pitch_;
          for (int i = 0; i < s_.count; i++) {
            for (int c = 0; c < C_; c++) light[i * C_ + c] = b.light[i * C_ + c] + from;
            coc[i] = b.coc[i] + from;
            weight[i] = b.weight[i] + from;
          }
          for (int c = 0; c < C_ + 2; c++) term[c] = b.term[c] + to;
          row_terms(l, width, single, light.data(), coc.data(), weight.data(), b.mine.data(), term.data());
        }
        lay(b, l, rows, columns, 0);
      }
    }
    finish(tile_row * ceil_div(W_, TILE) + tile_column, y0, x0, rows, columns, b);
  }

  bool look_around(int y0, int x0, int reach, Scratch &b) const {
    return around(y0 / CELL - reach, (y0 + TILE) / CELL - 1 + reach, x0 / CELL - reach, (x0 + TILE) / CELL - 1 + reach, b.layers.data());
  }

  // The tile's canvas over what lies behind all layers, with the light of rays, to the picture.
  void finish(int which, int y0, int x0, int rows, int columns, Scratch &b) {
    const int C = C_, E = E_;
    float *const traced = b.spread[0];  // [channels, TILE, TILE]: planes of spread lie side by side
    const bool has_rays = !job_.rays.empty() && ray_start_[which] < ray_start_[which + 1];
    if (has_rays) {
      memset(traced, 0, sizeof(float) * C * TILE_PIXELS);
      splat(job_, visibility_, y0, x0, &ray_list_[ray_start_[which]], ray_start_[which + 1] - ray_start_[which], ray_kernels_, ray_halves_, traced);
    }
    const bool normalize = over_ ? job_.behind.empty() : (bool)job_.scene.normalize;
    if (has_rays && !over_)
      for (int i = 0; i < C * TILE_PIXELS; i++) b.canvas[0][i] += traced[i];
    if (normalize)
      for (int c = 0; c < C; c++) {
        const float *cover = b.canvas[C + (E > 1 ? c : 0)];
        for (int i = 0; i < TILE_PIXELS; i++) b.canvas[c][i] = cover[i] > LEAST ? b.canvas[c][i] / cover[i] : 0.0f;
      }
    else if (over_)
      lay_over_behind(y0, x0, rows, columns, b);
    if (has_rays && over_)
      for (int i = 0; i < C * TILE_PIXELS; i++) b.canvas[0][i] += traced[i];
    for (int c = 0; c < C; c++)
      for (int y = 0; y < rows; y++) {
        const size_t at = ((size_t)c * H_ + y0 + y) * W_ + x0;
        memcpy(out_ + at, b.canvas[c] + y * TILE, columns * sizeof(float));
        if (!s_.valid) continue;
        const float *valid = s_.valid + (size_t)(y0 + y) * W_ + x0;
        for (int x = 0; x < columns; x++)
          if (!(valid[x] > 0)) out_[at + x] = job_.scene.light[0][at + x];
      }
  }

  void lay_over_behind(int y0, int x0, int rows, int columns, Scratch &b) {
    float least = 1.0f;
    for (int e = 0; e < E_; e++)
      for (int y = 0; y < rows; y++)
        for (int x = 0; x < columns; x++) least = std::min(least, b.canvas[C_ + e][y * TILE + x]);
    if (!(least < 1.0f - COVERED)) return;
    const int h = job_.behind_height, w = job_.behind_width;
    for (int y = 0; y < rows; y++) {
      const float at_y = (y0 + y - 0.5f * (H_ - 1)) / BEHIND_STEP + 0.5f * (h - 1);  // both have one centre
      const int top = std::min((int)at_y, h - 1), bottom = std::min(top + 1, h - 1);
      const float down = at_y - top;
      for (int c = 0; c < C_; c++) {
        const float *cover = b.canvas[C_ + (E_ > 1 ? c : 0)] + y * TILE;
        float *canvas = b.canvas[c] + y * TILE;
        const float *upper = &job_.behind[((size_t)c * h + top) * w], *lower = &job_.behind[((size_t)c * h + bottom) * w];
        for (int x = 0; x < columns; x++) {
          const float uncovered = 1.0f - cover[x];
          if (!(uncovered > COVERED)) continue;
          const float at_x = (x0 + x - 0.5f * (W_ - 1)) / BEHIND_STEP + 0.5f * (w - 1);
          const int left = std::min((int)at_x, w - 1), right = std::min(left + 1, w - 1);
          const float across = at_x - left;
          const float u = upper[left] + across * (upper[right] - upper[left]), v = lower[left] + across * (lower[right] - lower[left]);
          canvas[x] += uncovered * (u + down * (v - u));
        }
      }
    }
  }

  // For each tile the rays that land in it, in their order.
  void sort_rays() {
    visibility_ = look_at(job_);
    const int tile_rows = ceil_div(H_, TILE), tile_columns = ceil_div(W_, TILE);
    ray_start_.assign(tile_rows * tile_columns + 1, 0);
    auto each_tile = [&](auto body) {
      for (int i = 0; i < (int)job_.rays.size(); i++) {
        const Ray &ray = job_.rays[i];
        const int half = std::max(ray_halves_[ray.radius], ray_halves_[ray.radius + 1]);
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
  const float *const *ray_kernels_;
  const int32_t *ray_halves_;
  float *out_;
  int H_, W_, C_, E_, N_;
  bool over_;
  float low_, high_;  // the outermost nodes
  std::vector<Run> runs_;
  int window_, pitch_;
  std::vector<std::unique_ptr<Scratch>> scratches_;
  int words_, cell_rows_, cell_columns_;
  std::vector<uint64_t> cells_;            // layers that occur in each cell, a bit each
  std::vector<uint8_t> single_;            // cells that show the first surface alone, whole
  std::vector<Buffer<uint16_t>> intervals_;
  Border border_;
  Visibility visibility_;
  std::vector<int> ray_start_, ray_list_;
};

void composite(const Job &job, const float *const *ray_kernels, const int32_t *ray_halves, float *out) {
  Composite(job, ray_kernels, ray_halves, out).run();
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
