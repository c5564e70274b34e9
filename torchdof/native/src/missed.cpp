// Gives missed fine parts of blurred foregrounds to them: the compiled version of torchdof/render/surfaces/missed.py.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <vector>

#include "api.h"
#include "constants/missed.h"
#include "entry.h"
#include "grid.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

using namespace constants::missed;  // render/surfaces/missed.py gives meanings, units and effects

constexpr int TILE = 128;                // px; side of the squares that a thread processes at once
constexpr int MARGIN = 32;               // px around it in which rings are found, too
constexpr int SIDE = TILE + 2 * MARGIN;  // px; side of a window
constexpr int PITCH = SIDE + 2 * LANES;  // of a window; its columns begin at LANES
constexpr int WINDOW = SIDE * PITCH;
constexpr int CELLS = TILE / CELL;  // along a side of a tile
constexpr int RINGS = sizeof(RINGS_PX) / sizeof(RINGS_PX[0]);
static_assert(TILE % CELL == 0 && TILE % LANES == 0 && MARGIN % LANES == 0 && MARGIN >= RINGS_PX[RINGS - 1], "");

// Distance from the near surface to the middle of each ring; the first value is for pixels without one.
constexpr float MIDDLES_PX[8] = {0,
                                 0.5f * RINGS_PX[0],
                                 0.5f * (RINGS_PX[0] + RINGS_PX[1]),
                                 0.5f * (RINGS_PX[1] + RINGS_PX[2]),
                                 0.5f * (RINGS_PX[2] + RINGS_PX[3]),
                                 0.5f * (RINGS_PX[3] + RINGS_PX[4])};
static_assert(RINGS == 5, "");

// The least of 2 * reach + 1 values around each of a vector. Two chains of operations, of which processors work on
// both.
vec least_of(const float *at, int stride, int reach) {
  vec before = load<vec>(at), after = load<vec>(at + stride);
  for (int u = 1; u < reach; u++) {
    before = min(before, load<vec>(at - u * stride));
    after = min(after, load<vec>(at + (u + 1) * stride));
  }
  return min(min(before, load<vec>(at - reach * stride)), after);
}

class Missed : Frame {
 public:
  explicit Missed(const torchdof_map &map)
      : Frame(map.height, map.width), map_(map), channels_(map.channels), across_((width_ + TILE - 1) / TILE),
        down_((height_ + TILE - 1) / TILE), pitch_(across_ * TILE), rows_((height_ + CELL - 1) / CELL),
        columns_((width_ + CELL - 1) / CELL), cells_((size_t)rows_ * columns_), plane_((size_t)pitch_ * height_),
        ring_(plane_), near_(plane_), coc_(plane_), roots_(channels_ * plane_) {}

  // Returns how far the map has missed parts, 0 to 1.
  double run() {
    memcpy(map_.out, map_.nearness, area_ * sizeof(float));
    find_rings();
    if (tiles_.empty()) return 0;
    const std::vector<float> means = described(background(described(background({}))));
    const float share = missed(count(means));
    grow(means, GROWTH_PX * share);
    return share;
  }

 private:
  // Planes of described() for the pixels of a row of cells of a tile, which share them cell by cell.
  struct Background {
    explicit Background(int channels) : values((size_t)(channels + 5) * TILE), channels(channels) {}
    const float *seen() const { return &values[0]; }
    const float *light(int c) const { return &values[(size_t)(1 + c) * TILE]; }
    const float *per_variance() const { return light(channels); }
    const float *coc() const { return light(channels + 1); }
    const float *spread() const { return light(channels + 2); }
    const float *is_smooth() const { return light(channels + 3); }
    std::vector<float> values;
    int channels;
  };

  void read(const std::vector<float> &means, int tile, int y, Background &background) const {
    const int first = tile % across_ * CELLS, count = std::min(CELLS, columns_ - first);
    for (int plane = 0; plane < channels_ + 5; plane++)
      for (int k = 0; k < count; k++)
        std::fill_n(&background.values[plane * TILE + k * CELL], CELL, means[plane * cells_ + cell(y, first + k)]);
  }

  template <typename Body>
  void each_tile(const Body &body) {
    parallel(map_.threads, (int)tiles_.size(), map_.cancelled, [&](int k, int) { body(tiles_[k]); });
  }

  // Calls visit(j, index) for vectors of pixels with rings in every `step`-th row of a tile, prepare(row of cells)
  // before each row of cells with such pixels, and end(row of cells) after it.
  template <typename Prepare, typename Visit, typename End>
  void each_vector(int tile, int step, const Prepare &prepare, const Visit &visit, const End &end) const {
    const int y0 = tile / across_ * TILE, y1 = std::min(y0 + TILE, height_);
    for (int from = y0; from < y1; from += CELL) {
      bool found = false;
      for (int y = from; y < std::min(from + CELL, y1); y += step)
        for (int j = 0; j < TILE; j += LANES) {
          const size_t at = padded(y, tile % across_ * TILE + j);
          if (!any_positive(load<vec>(&ring_[at]))) continue;
          if (!found) prepare(from / CELL);
          found = true;
          visit(j, at);
        }
      if (found) end(from / CELL);
    }
  }

  // Step 1: `ring_`, `near_`, and the tiles with rings.
  void find_rings() {
    std::vector<uint8_t> has(across_ * down_);
    parallel(map_.threads, across_ * down_, map_.cancelled, [&](int tile, int) { has[tile] = rings_of(tile); });
    for (int tile = 0; tile < across_ * down_; tile++)
      if (has[tile]) tiles_.push_back(tile);
  }

  bool rings_of(int tile) const {
    const Buffer<float> windows(4 * WINDOW);
    float *const coc = windows.data(), *const near = coc + WINDOW, *const lowest = near + WINDOW,
                 *const ring = lowest + WINDOW;
    const int y0 = tile / across_ * TILE, x0 = tile % across_ * TILE, rows = std::min(TILE, height_ - y0);
    std::fill_n(coc, WINDOW, FAR_PX);
    const int from_x = std::max(x0 - MARGIN, 0), to_x = std::min(x0 + TILE + MARGIN, width_);
    for (int y = std::max(y0 - MARGIN, 0); y < std::min(y0 + TILE + MARGIN, height_); y++)
      memcpy(coc + (y - y0 + MARGIN) * PITCH + LANES + from_x - x0 + MARGIN, map_.nearness + pixel(y, from_x),
             (to_x - from_x) * sizeof(float));
    vec low = broadcast(FAR_PX), high = -low;
    for (int at = 0; at < WINDOW; at += LANES) {
      const vec value = load<vec>(coc + at);
      const ivec valid = abs(value) <= LARGEST_PX;
      store(coc + at, valid ? value : broadcast(FAR_PX));
      low = min(low, load<vec>(coc + at)), high = max(high, valid ? value : broadcast(-FAR_PX));
    }
    for (int i = 0; i < rows; i++) std::fill_n(&ring_[padded(y0 + i, x0)], TILE, 0.0f);
    if (!(reduce_max(high) - reduce_min(low) > APART_PX)) return false;
    std::fill_n(near, WINDOW, FAR_PX);
    std::fill_n(ring, WINDOW, 0.0f);
    bool found = false;
    for (int k = 0; k < RINGS; k++) {
      const int end = RINGS_PX[k], reach = k == 0 ? end : end - RINGS_PX[k - 1];
      const float *const from = k == 0 ? coc : near;
      for (int i = end - reach; i < SIDE - end + reach; i++)
        for (int at = i * PITCH + LANES; at < (i + 1) * PITCH - LANES; at += LANES)
          store(lowest + at, least_of(from + at, 1, reach));
      bool is_any_new = false;
      for (int i = end; i < SIDE - end; i++)
        for (int at = i * PITCH + LANES; at < (i + 1) * PITCH - LANES; at += LANES) {
          const vec was = load<vec>(near + at);
          const vec least = least_of(lowest + at, PITCH, reach);
          const ivec is_new = (was == FAR_PX) & (-least > (abs(load<vec>(coc + at)) + APART_PX) * (1.0f / SHARPER));
          if (!any_of(is_new)) continue;
          is_any_new = true;
          store(near + at, is_new ? least : was);
          store(ring + at, is_new ? broadcast(k + 1) : load<vec>(ring + at));
        }
      if (!is_any_new) break;
      found = true;
    }
    for (int i = 0; found && i < rows; i++) {
      const int at = (MARGIN + i) * PITCH + LANES + MARGIN;
      const size_t to = padded(y0 + i, x0);
      memcpy(&ring_[to], ring + at, TILE * sizeof(float));
      memcpy(&near_[to], near + at, TILE * sizeof(float));
    }
    return found;
  }

  // Stores coc and square roots of light of every `step`-th row of a row of cells of a tile.
  void read(int tile, int of_cells, int step) const {
    const int x0 = tile % across_ * TILE, count = std::min(TILE, width_ - x0);
    for (int y = of_cells * CELL; y < std::min((of_cells + 1) * CELL, height_); y += step) {
      const size_t from = pixel(y, x0), to = padded(y, x0);
      for (int j = 0; j < count; j++) coc_[to + j] = ring_[to + j] > 0 ? map_.nearness[from + j] : 0.0f;
      std::fill(&coc_[to] + count, &coc_[to] + TILE, 0.0f);
      for (int c = 0; c < channels_; c++) {
        const float *const light = map_.light + c * area_ + from;
        float *const roots = &roots_[c * plane_ + to];
        for (int j = 0; j < count; j++) {
          const float known = (light[j] > 0) & (light[j] < INFINITY) ? light[j] : 0.0f;
          roots[j] = std::sqrt(std::min(known, BRIGHTEST));
        }
        std::fill(roots + count, roots + TILE, 0.0f);
      }
    }
  }

  // Turns sums of cells, plane by plane, into means over windows of 2 * reach + 1 cells, of which those beyond the
  // frame are 0.
  void average(std::vector<float> &planes, int reach) const {
    parallel(map_.threads, (int)(planes.size() / cells_), map_.cancelled, [&](int k, int) {
      float *const plane = &planes[k * cells_];
      const int side = 2 * reach + 1;
      const float per = 1.0f / (float)(CELL * CELL * side * side);
      std::vector<float> sums(cells_), row(columns_ + 2 * reach);
      for (int y = 0; y < rows_; y++)
        for (int v = std::max(y - reach, 0); v <= std::min(y + reach, rows_ - 1); v++)
          for (int x = 0; x < columns_; x++) sums[cell(y, x)] += plane[cell(v, x)];
      for (int y = 0; y < rows_; y++) {
        memcpy(&row[reach], &sums[cell(y, 0)], columns_ * sizeof(float));
        float *const to = plane + cell(y, 0);
        std::fill_n(to, columns_, 0.0f);
        for (int u = 0; u < side; u++)
          for (int x = 0; x < columns_; x++) to[x] += row[x + u];
        for (int x = 0; x < columns_; x++) to[x] *= per;
      }
    });
  }

  // Means around cells, of sums of background(): weight; light, its square; coc, its square. The squares become one
  // over the variance of light, and the standard deviation of coc. One more plane is 1 where the light is smooth, else
  // 0.
  std::vector<float> described(std::vector<float> planes) const {
    average(planes, NEARBY);
    planes.resize(planes.size() + cells_);
    parallel(map_.threads, rows_, map_.cancelled, [&](int y, int) {
      float *const seen = &planes[cell(y, 0)], *const light = seen + cells_;
      float *const square = light + channels_ * cells_, *const coc = square + cells_, *const coc_square = coc + cells_;
      float *const is_smooth = coc_square + cells_;
      const float per_channel = 1.0f / (float)channels_;
      for (int x = 0; x < columns_; x++) {
        const float per = 1.0f / std::max(seen[x], 1e-9f);
        float bright = 0;
        for (int c = 0; c < channels_; c++) {
          float &mean = light[c * cells_ + x];
          mean *= per, bright += per_channel * mean * mean;
        }
        const float variance = std::max(square[x] * per - bright, 0.0f) + GRAIN * bright + 1e-12f;
        is_smooth[x] = variance < SMOOTH * bright;
        square[x] = per_channel / variance, coc[x] *= per;
        coc_square[x] = std::sqrt(std::max(coc_square[x] * per - coc[x] * coc[x], 0.0f));
      }
    });
    return planes;
  }

  // Squared deviation of pixels from the background, over its variance.
  vec deviation(size_t at, const Background &of, int j) const {
    vec off{};
    for (int c = 0; c < channels_; c++) {
      const vec apart = load<vec>(&roots_[c * plane_ + at]) - load<vec>(of.light(c) + j);
      off += apart * apart;
    }
    return off * load<vec>(of.per_variance() + j);
  }

  // How unlike the background pixels are, 0 to 1.
  vec unlike(size_t at, const Background &of, int j) const {
    const vec capped = min(deviation(at, of, j) * (1.0f / UNLIKE), broadcast(MOST_UNLIKE)), odds = capped * capped;
    return odds / (1.0f + odds);
  }

  // Where the background around pixels is one surface, which continues theirs.
  ivec known(size_t at, const Background &of, int j) const {
    const vec coc = load<vec>(&coc_[at]), apart = load<vec>(of.spread() + j) + abs(load<vec>(of.coc() + j) - coc);
    return (load<vec>(&ring_[at]) > vec{}) & (load<vec>(of.seen() + j) > LEAST_SAMPLES) &
           (apart < ON_SURFACE * (coc - load<vec>(&near_[at])));
  }

  // Adds up sums of pixels of a row of cells, plane by plane, in the cells of planes of the frame.
  void add_cells(std::vector<float> &sums, int tile, int y, float *planes) const {
    for (size_t plane = 0; plane < sums.size() / cells_; plane++, planes += TILE)
      for (int k = 0; k < std::min(CELLS, columns_ - tile % across_ * CELLS); k++) {
        const float *const pixels = planes + k * CELL;
        float sum = 0;
        for (int j = 0; j < CELL; j++) sum += pixels[j];
        sums[plane * cells_ + cell(y, tile % across_ * CELLS + k)] = sum;
      }
  }

  // Step 2: sums of the samples of each cell: their weight, light, its square, coc and its square. With the means of a
  // first pass, samples far from them get less weight.
  std::vector<float> background(const std::vector<float> &means) {
    const int planes = channels_ + 4;
    const bool is_second = !means.empty();
    std::vector<float> sums(planes * cells_);
    each_tile([&](int tile) {
      Background of(channels_);
      std::vector<float> added(planes * TILE);
      each_vector(
          tile, SAMPLED,
          [&](int y) {
            std::fill(added.begin(), added.end(), 0.0f);
            if (is_second)
              read(means, tile, y, of);
            else
              read(tile, y, SAMPLED);
          },
          [&](int j, size_t at) {
            vec weight = load<vec>(&ring_[at]) > (float)RIM ? broadcast(1.0f) : vec{}, square{};
            if (!any_positive(weight)) return;
            if (is_second) {
              const vec outlier = 1.0f + deviation(at, of, j) * (1.0f / OUTLIER);
              weight /= outlier * outlier;
            }
            const auto add = [&](int plane, vec value) {
              float *const to = &added[plane * TILE + j];
              store(to, load<vec>(to) + value);
            };
            for (int c = 0; c < channels_; c++) {
              const vec root = load<vec>(&roots_[c * plane_ + at]);
              square += root * root;
              add(1 + c, weight * root);
            }
            const vec coc = load<vec>(&coc_[at]);
            add(0, weight), add(1 + channels_, weight * square * (1.0f / (float)channels_));
            add(2 + channels_, weight * coc), add(3 + channels_, weight * coc * coc);
          },
          [&](int y) { add_cells(sums, tile, y, added.data()); });
    });
    return sums;
  }

  // Pixels of the rim, or of the background, and how many of them are unlike the background.
  struct Count {
    double unlike = 0, all = 0;
    double share() const { return unlike / std::max(all, 1.0); }
  };
  using Counts = std::array<Count, 2>;

  // Step 3: counts of the rim and of the background.
  Counts count(const std::vector<float> &means) {
    std::vector<Counts> of_tiles(across_ * down_);
    each_tile([&](int tile) {
      Background of(channels_);
      vec found[2], all[2];
      const auto prepare = [&](int y) {
        read(means, tile, y, of);
        for (int part = 0; part < 2; part++) found[part] = all[part] = vec{};
      };
      const auto add = [&](int j, size_t at) {
        const vec ring = load<vec>(&ring_[at]);
        const vec is_unlike = unlike(at, of, j);
        const ivec compared = known(at, of, j);
        const ivec parts[] = {compared & (ring > 1.0f) & (ring <= (float)RIM), compared & (ring == (float)RINGS)};
        for (int part = 0; part < 2; part++) {
          found[part] += parts[part] ? is_unlike : vec{};
          all[part] += parts[part] ? broadcast(1.0f) : vec{};
        }
      };
      const auto end = [&](int) {
        for (int part = 0; part < 2; part++) {
          of_tiles[tile][part].unlike += reduce_add(found[part]);
          of_tiles[tile][part].all += reduce_add(all[part]);
        }
      };
      each_vector(tile, SAMPLED, prepare, add, end);
    });
    Counts counts;
    for (const Counts &of_tile : of_tiles)
      for (int part = 0; part < 2; part++)
        counts[part].unlike += of_tile[part].unlike, counts[part].all += of_tile[part].all;
    return counts;
  }

  // Step 4: how far the map has missed parts.
  static float missed(const Counts &counts) {
    const auto &[rim, background] = counts;
    const double excess = (rim.share() - background.share()) / std::max(1.0 - background.share(), (double)LEAST_LIKE);
    const float share = (float)(excess * rim.all / (rim.all + constants::missed::COUNTED));
    return clamp01((share - MISSED) / (MANY_MISSED - MISSED));
  }

  // Step 5: gives the near surface to pixels of rings whose middle is within its growth.
  void grow(const std::vector<float> &means, float everywhere) {
    each_tile([&](int tile) {
      Background of(channels_);
      const auto prepare = [&](int y) {
        read(tile, y, 1);
        read(means, tile, y, of);
      };
      const auto take = [&](int j, size_t at) {
        const ivec is_known = known(at, of, j);
        if (!any_of(is_known)) return;
        const vec smooth = load<vec>(of.is_smooth() + j) * GROWTH_OVER_SMOOTH_PX;
        const vec middle = lookup(MIDDLES_PX, convert(load<vec>(&ring_[at])));
        const ivec is_taken = is_known & (max(smooth, broadcast(everywhere)) > middle);
        float *const out = map_.out + pixel((int)(at / pitch_), (int)(at % pitch_));
        for (int l = 0; l < LANES; l++)
          if (is_taken[l]) out[l] = near_[at + l];
      };
      each_vector(tile, 1, prepare, take, [](int) {});
    });
  }

  // Index of a pixel in a plane whose rows are padded to whole tiles; index of a cell.
  size_t padded(int y, int x) const { return (size_t)y * pitch_ + x; }
  size_t cell(int y, int x) const { return (size_t)y * columns_ + x; }

  const torchdof_map &map_;
  const int channels_;
  const int across_, down_, pitch_;  // tiles along both axes, pixels of whole tiles
  const int rows_, columns_;         // of cells
  const size_t cells_;
  const size_t plane_;         // pixels of an image whose rows are pitch_ long
  Buffer<float> ring_, near_;  // of each pixel; 0 without. The coc of its near surface.
  Buffer<float> coc_, roots_;  // of pixels of rings; square roots of light, channel by channel
  std::vector<int> tiles_;     // with rings
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_missed_parts(const torchdof_map *map, double *share) {
  return torchdof::guarded([&] { *share = torchdof::Missed(*map).run(); });
}
