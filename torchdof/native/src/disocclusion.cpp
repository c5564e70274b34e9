// Disocclusion: fills the surfaces hidden behind a blurred foreground with light and depth of the farthest surfaces
// around, as described in render/surfaces/disocclusion.py.
#include "disocclusion.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "blocks.h"
#include "blur_axis.h"
#include "highlights.h"
#include "job.h"
#include "light.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"
#include "surfaces.h"

namespace torchdof {
namespace {

using namespace constants::disocclusion;  // render/surfaces/disocclusion.py gives meanings, units and effects
constexpr int BAND = 8;                   // rows of a level computed together
constexpr int CELL_LEVEL = 3;             // cells that may show hidden surfaces have the size of this level's samples

// One level of a pyramid of the farthest surfaces. A sample has `stride` values: `means`, light of each channel and
// blur; coc, weight, padding.
struct Level {
  int height, width, step, stride, means;
  float vote;      // weight relative to other levels; 0: weights already contain it
  float least_px;  // blur above which a pixel reads this level; in full from twice this blur
  Buffer<float> values;
  float centre_y, centre_x;  // centre of the image, in its pixels; the level has the same centre
  float place_y(float y) const { return (y - centre_y) / step + 0.5f * (height - 1); }
  float place_x(float x) const { return (x - centre_x) / step + 0.5f * (width - 1); }
  float *at(int y, int x) const { return values.data() + ((size_t)y * width + x) * stride; }
  float coc(int y, int x) const { return at(y, x)[means]; }
};

// While hidden surfaces are filled, the sign of a second surface's weight is minus where it is the final one.
inline vec as_final(vec weight) { return -weight; }
inline bool is_final(float weight) { return weight < 0; }

// What counts of a mixed pixel's second surface: small weights fall to 0, so that a hidden surface can take their place
// without a step.
template <typename V>
inline V counted_of(V mixed) {
  return mixed * clamp01(mixed * (2.0f / HIDDEN_WEIGHT) - 1.0f);
}

typedef float f8 __attribute__((vector_size(32)));
constexpr int F8 = 8;

// Every second of 2 LANES values.
inline vec evens(const float *from) {
  vec v;
  for (int i = 0; i < LANES; i++) v[i] = from[2 * i];
  return v;
}

// A position between two samples along an axis: index of the first, and fraction of the way to the next.
struct Place {
  int before;
  float part;
};

inline Place place_in(float at, int size) {
  at = std::clamp(at, 0.0f, (float)(size - 1));
  const int before = std::min((int)at, std::max(0, size - 2));
  return {before, at - before};
}

// A level's sample behind a pixel.
struct Sample {
  float level_weight;      // of the level, for the pixel's blur, 0 to 1
  float weight;            // of the samples that lie behind the pixel; 0 without them
  std::vector<f8> values;  // only valid with a weight

  // Reads the bilinear mean of the four samples around a position, without those in front of or at coc `here`.
  void read(const Level &level, Place row, Place column, float here) {
    const int of_coc = level.means;
    level_weight = is_read(std::fabs(here), level.least_px);
    weight = 0;
    if (!(level_weight > 0)) return;
    const float end = own_end(here), down = row.part, right = column.part;
    const float share[4] = {(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right};
    const float *corners[4];
    float total = 0, counts[4];
    for (int k = 0; k < 4; k++) {
      corners[k] =
          level.at(std::min(row.before + k / 2, level.height - 1), std::min(column.before + k % 2, level.width - 1));
      total += counts[k] = share[k] * corners[k][of_coc + 1] * is_another_surface(corners[k][of_coc] - end);
    }
    if (!(total > LEAST_SEEN)) return;
    weight = total;
    std::fill(values.begin(), values.end(), f8{});
    for (int k = 0; k < 4; k++)
      for (size_t i = 0; i < values.size(); i++)
        values[i] += load<f8>(corners[k] + F8 * i) * (counts[k] * (1.0f / total));
  }
};

// Combines the samples of several levels: light, blur and coc; returns the sum of their votes. With `farthest`, only
// the farther of two surfaces counts.
float mix(const Level *levels, const Sample *samples, int n, bool farthest, float *out) {
  const int of_coc = levels->means;
  float total = 0;
  std::fill(out, out + levels->stride, 0.0f);
  for (int l = 0; l < n; l++) {
    const Level &level = levels[l];
    const float weight = samples[l].weight, level_weight = samples[l].level_weight;
    if (!(weight > 0)) continue;
    float vote = level_weight * (level.vote > 0 ? level.vote * std::min(weight / SURE, 1.0f) : weight);
    if (farthest) {
      const float apart = ((const float *)samples[l].values.data())[of_coc] - out[of_coc];
      if (total > 0) vote *= 1.0f - is_another_surface(-apart);
      total *= 1.0f - std::min(level_weight * weight / SURE, 1.0f) * is_another_surface(apart);
    }
    total += vote;
    if (!(vote > 0)) continue;
    const float part = vote / std::max(total, LEAST_TOTAL);
    for (const f8 &value : samples[l].values) {
      store(out, load<f8>(out) + (value - load<f8>(out)) * part);
      out += F8;
    }
    out -= levels->stride;
  }
  return total;
}

class Filling {
 public:
  Filling(Job &job)
      : job_(job), s_(job.surfaces), C_(job.channels), means_(C_ + 1), stride_((means_ + 2 + F8 - 1) / F8 * F8) {}

  // 1. Build the pyramid; each level keeps the farthest of the finer level's surfaces.
  // 2. Find the cells near which a farther surface exists.
  // 3. Combine the levels behind cells of BEHIND_STEP pixels: the light behind all surfaces.
  // 4. Give each pixel of the cells found a second surface: the combined samples behind it.
  void run() {
    const int levels = job_.levels,
              step = 2 << levels;  // padding of half a cell on each side; even sizes on every level
    area_height_ = ceil_div(job_.height + BEHIND_STEP, step) * step;
    area_width_ = ceil_div(job_.width + BEHIND_STEP, step) * step;
    coarsest_ = std::min(levels, CELL_LEVEL);
    cell_ = 1 << coarsest_;
    cell_rows_ = ceil_div(job_.height, cell_);
    cell_columns_ = ceil_div(job_.width, cell_);
    pyramid_.resize(levels);
    for (int i = 0; i < levels; i++) {
      Level &l = pyramid_[i];
      l.height = area_height_ >> (i + 1);
      l.width = area_width_ >> (i + 1);
      l.step = 2 << i;
      l.stride = stride_;
      l.means = means_;
      centre(l);
      l.vote = (float)std::pow((double)FALL, i + 1);
      l.least_px = (float)std::pow(2.0, i - 1);
      l.values = Buffer<float>((size_t)l.height * l.width * stride_);
    }
    found_.resize(cell_rows_ * cell_columns_);
    fine_.resize(found_.size());
    job_.parallel(ceil_div(pyramid_[0].height, BLOCK / 2), [&](int band, int) { finest(band); });
    for (int i = 1; i < levels; i++)
      job_.parallel(ceil_div(pyramid_[i].height, BAND), [&](int band, int) { coarser(i, band); });
    job_.parallel(cell_rows_, [&](int row, int) { find_cells(row); });
    fill();
    job_.parallel((int)s_.blocks.size(), [&](int i, int) {
      if (!s_.has_block(i)) return;
      const Block b = s_.block(i);
      for (int at = 0; at < BLOCK_PIXELS; at++) {
        float &weight = b.weight[at];
        if (is_final(weight)) {
          weight = -weight;
          continue;
        }
        weight = counted_of(weight);
        b.own_weight[at] = b.own_weight[at] > 0 ? 1.0f - weight : 0.0f;
      }
    });
  }

 private:
  void centre(Level &level) const {
    level.centre_y = 0.5f * (job_.height - 1);
    level.centre_x = 0.5f * (job_.width - 1);
  }

  // First pixel covered by the first sample of a level; covered by half if the image's size is odd.
  static int first_pixel(int size, int samples, int step) { return floor_div(size - step * samples, 2); }

  // A band of rows of the first level.
  void finest(int band) {
    const int H = job_.height, W = job_.width, planes = C_ + 2;
    const Level &level = pyramid_[0];
    const int top = first_pixel(H, level.height, 2), left = first_pixel(W, level.width, 2);
    const int across =
        2 * ceil_div(level.width, LANES) * LANES + BLOCK;  // whole vectors are read, whole blocks written
    const size_t line = (size_t)planes * across;
    // planes of the band's rows, extended to both sides and starting at pixel `left`: first copied from the image, then
    // replaced where there are blocks
    const int first = band * BLOCK / 2, end = std::min(level.height, (band + 1) * BLOCK / 2);
    const int y0 = std::clamp(top + 2 * first, 0, H - 1), y1 = std::clamp(top + 2 * end - 1 + H % 2, 0, H - 1);
    const Buffer<float> memory((y1 + 1 - y0) * line);
    auto row_of = [&](int y) { return memory.data() + (std::clamp(y, 0, H - 1) - y0) * line; };
    for (int y = y0; y <= y1; y++) {
      float *const row = row_of(y) - left;
      for (int c = 0; c < C_; c++)
        memcpy(row + c * across, s_.light + c * s_.area() + s_.pixel(y, 0), W * sizeof(float));
      memcpy(row + C_ * across, s_.coc + s_.pixel(y, 0), W * sizeof(float));
      std::fill(row + (C_ + 1) * across, row + (C_ + 1) * across + W, 1.0f);
    }
    for (int block_y = y0 / BLOCK; block_y <= y1 / BLOCK; block_y++)
      for (int x0 = 0; x0 < W; x0 += BLOCK) {
        const int n = std::min(BLOCK, W - x0), which = block_y * s_.block_columns + x0 / BLOCK;
        const float limit = least_threshold(job_, block_y * BLOCK, x0);
        const bool bright = s_.has_block(which) || job_.block_peak[which] > limit;
        for (int y = std::max(y0, block_y * BLOCK); y <= std::min(y1, block_y * BLOCK + BLOCK - 1); y++)
          pixels(y, x0, n, bright, limit, row_of(y) + x0 - left, across);
      }
    for (int y = y0; y <= y1; y++)
      for (int k = 0; k < planes; k++) {
        float *plane = row_of(y) + (size_t)k * across;
        std::fill(plane, plane - left, plane[-left]);
        std::fill(plane + W - left, plane + across, plane[W - 1 - left]);
      }
    for (int y = first; y < end; y++) {
      const float *rows[3];
      for (int i = 0; i < 2 + H % 2; i++) rows[i] = row_of(top + 2 * y + i);
      W % 2 ? farthest_of_rows<3>(rows, across, level.at(y, 0)) : farthest_of_rows<2>(rows, across, level.at(y, 0));
    }
  }

  // Replaces n pixels of a row, in planes of light, coc and weight `pitch` values apart, by the surfaces of the blocks:
  // the farther of two surfaces, with highlights clipped to their threshold.
  void pixels(int y, int x0, int n, bool bright, float least_limit, float *out, size_t pitch) const {
    const int C = C_, which = y / BLOCK * s_.block_columns + x0 / BLOCK, first = y % BLOCK * BLOCK;
    if (s_.has_block(which)) {
      const Block b = s_.block(which);
      float *coc = out + C * pitch, *weight = coc + pitch;
      for (int x = 0; x < BLOCK; x += LANES) {
        const vec its = load<vec>(b.coc + first + x), mine = load<vec>(coc + x),
                  share = load<vec>(b.weight + first + x);
        const auto mixed = (share > MIXED) & (its > mine);
        store(coc + x, mixed ? its : mine);
        store(weight + x, mixed ? share : load<vec>(b.own_weight + first + x));
        for (int c = 0; c < C; c++)
          store(out + c * pitch + x, mixed ? load<vec>(b.other + c * BLOCK_PIXELS + first + x)
                                           : load<vec>(b.own + c * BLOCK_PIXELS + first + x));
      }
      for (int x = 0; s_.valid && x < n; x++)
        if (!(s_.valid[s_.pixel(y, x0 + x)] > 0)) coc[x] = -NEVER_PX;
    }
    if (!bright) return;
    for (int x = 0; x < n; x += LANES) {
      vec peaks = load<vec>(out + x);
      for (int c = 1; c < C; c++) peaks = max(peaks, load<vec>(out + c * pitch + x));
      if (!any_of(peaks > least_limit)) continue;
      for (int i = x; i < std::min(x + LANES, n); i++) {
        const float peak = peaks[i - x], limit = peak > least_limit ? threshold_at(job_, y, x0 + i) : peak;
        if (peak > limit)  // a hidden surface next to a highlight is not a highlight
          for (int c = 0; c < C; c++) out[c * pitch + i] *= limit / peak;
      }
    }
  }

  // Means of the farthest pixels of 2 x 2, in the first level. Where the image's size is odd: of 3, the outer two with
  // half weight.
  template <int COLUMNS>
  void farthest_of_rows(const float *const *rows, size_t across, float *out) const {
    const int C = C_, rows_count = 2 + job_.height % 2, count = rows_count * COLUMNS, width = pyramid_[0].width;
    for (int x0 = 0; x0 < width; x0 += LANES, out += LANES * stride_) {
      vec child[3 * COLUMNS], counts[3 * COLUMNS], total = {};
      auto read = [&](int plane) {
        for (int i = 0; i < rows_count; i++) {
          const float *from = rows[i] + plane * across + 2 * x0;
          vec *to = child + i * COLUMNS;
          for (int column = 0; column < COLUMNS; column++) to[column] = evens(from + column);
        }
      };
      const int n = std::min(LANES, width - x0);
      auto put = [&](int plane, vec value) {
        for (int i = 0; i < n; i++) out[i * stride_ + plane] = value[i];
      };
      read(C);
      vec farthest_coc = child[0];
      for (int j = 1; j < count; j++) farthest_coc = max(farthest_coc, child[j]);
      for (int j = 0; j < count; j++) counts[j] = 1.0f - is_another_surface(farthest_coc - child[j]);
      read(C + 1);
      for (int j = 0; j < count; j++) {
        const bool half_row = rows_count == 3 && j / COLUMNS != 1, half_column = COLUMNS == 3 && j % COLUMNS != 1;
        counts[j] *= 0.25f * (half_row ? 0.5f : 1.0f) * (half_column ? 0.5f : 1.0f) * child[j];
        total += counts[j];
      }
      const vec each = 1.0f / max(total, broadcast(LEAST_TOTAL));
      for (int i = 0; i < n; i++) store(out + (i + 1) * stride_ - F8, f8{});  // padding
      const auto mean_of = [&](int plane) {
        read(plane);
        vec sum = {};
        for (int j = 0; j < count; j++) sum += child[j] * counts[j];
        return sum * each;
      };
      for (int c = 0; c < C; c++) put(c, mean_of(c));
      const vec coc = mean_of(C);
      put(C, absolute(coc));
      put(means_, total > vec{} ? coc : broadcast(-NEVER_PX));
      put(means_ + 1, total);
    }
  }

  // A band of rows of a coarser level: means of the farthest of each four samples.
  void coarser(int i, int band) {
    const Level &fine = pyramid_[i - 1], &level = pyramid_[i];
    for (int y = band * BAND; y < std::min(level.height, (band + 1) * BAND); y++)
      for (int x = 0; x < level.width; x++) {
        const float *child[4];
        float farthest = -NEVER_PX, total = 0, counts[4], *out = level.at(y, x);
        for (int k = 0; k < 4; k++) {
          child[k] = fine.at(2 * y + k / 2, 2 * x + k % 2);
          farthest = std::max(farthest, child[k][means_]);
        }
        for (int k = 0; k < 4; k++)
          total += counts[k] = child[k][means_ + 1] * (1.0f - is_another_surface(farthest - child[k][means_]));
        total *= 0.25f;
        for (float &count : counts) count *= 0.25f / std::max(total, LEAST_TOTAL);
        for (int c = 0; c <= means_; c++)
          out[c] =
              child[0][c] * counts[0] + child[1][c] * counts[1] + child[2][c] * counts[2] + child[3][c] * counts[3];
        if (!(total > 0)) out[means_] = -NEVER_PX;
        out[means_ + 1] = total;
        std::fill(out + means_ + 2, out + stride_, 0.0f);
      }
  }

  // Marks cells near which a level used by their pixels has a farther surface; fine_: a fine level has it.
  void find_cells(int row) {
    for (int column = 0; column < cell_columns_; column++) {
      const size_t cell = (size_t)row * cell_columns_ + column, block = s_.block_of(row * cell_, column * cell_);
      const float near = job_.block_low[block], blur = std::max(std::fabs(near), std::fabs(job_.block_high[block]));
      found_[cell] = fine_[cell] = 0;
      for (int i = 0; i < job_.levels; i++) {
        const Level &l = pyramid_[i];
        if (blur <= l.least_px || (found_[cell] && i >= FINE_LEVELS)) break;
        // range of the samples read by the cell's pixels, including those shared with other cells
        const int y0 = (int)l.place_y(row * cell_) - 1, y1 = (int)l.place_y(row * cell_ + cell_ - 1) + 2;
        const int x0 = (int)l.place_x(column * cell_) - 1, x1 = (int)l.place_x(column * cell_ + cell_ - 1) + 2;
        float most = -NEVER_PX;
        for (int y = std::max(0, y0); y <= std::min(l.height - 1, y1); y++)
          for (int x = std::max(0, x0); x <= std::min(l.width - 1, x1); x++) most = std::max(most, l.coc(y, x));
        if (is_another_surface(most - near) > 0) {
          found_[cell] = 1;
          if (i < FINE_LEVELS) fine_[cell] = 1;
        }
      }
    }
  }

  bool wanted(int y, int x) const { return std::fabs(s_.coc[s_.pixel(y, x)]) > HIDING_FROM_PX; }

  // Positions of pixels first, first + step, ... in a level.
  static std::vector<Place> places(float first, int step, int count, int size, float (Level::*place)(float) const,
                                   const Level &level) {
    std::vector<Place> at(count);
    for (int i = 0; i < count; i++) at[i] = place_in((level.*place)(first + (float)i * step), size);
    return at;
  }

  // Steps 3 and 4 of `run`. The levels from FINE_LEVELS up are combined once for each cell of BEHIND_STEP pixels, and
  // read like one level by the pixels.
  void fill() {
    const int levels = job_.levels, H = job_.height, W = job_.width;
    const int rows = area_height_ / BEHIND_STEP, columns = area_width_ / BEHIND_STEP;
    const int fine = std::min(levels, FINE_LEVELS), reads = fine + (levels > fine);
    job_.behind_height = rows;
    job_.behind_width = columns;
    job_.behind.resize((size_t)C_ * rows * columns + 8);  // padding: eight values are read from any position
    Level combined = {rows, columns, BEHIND_STEP, stride_, means_,
                      0,    0,       {},          0,       0};  // mean of the coarse levels behind cells
    centre(combined);
    if (levels > fine) {
      combined.least_px = pyramid_[FINE_LEVELS].least_px;
      combined.values = Buffer<float>((size_t)rows * columns * stride_);
    }
    const float first_y = 0.5f * (H - 1) - 0.5f * (rows - 1) * BEHIND_STEP;
    const float first_x = 0.5f * (W - 1) - 0.5f * (columns - 1) * BEHIND_STEP;
    std::vector<std::vector<Place>> ys, xs;  // positions of the cells in each level
    for (const Level &l : pyramid_) {
      ys.push_back(places(first_y, BEHIND_STEP, rows, l.height, &Level::place_y, l));
      xs.push_back(places(first_x, BEHIND_STEP, columns, l.width, &Level::place_x, l));
    }
    const std::vector<float> mean = mean_light(pyramid_[fine - 1]);
    job_.parallel(rows, [&](int row, int) { look_behind(row, ys, xs, mean, combined); });
    const Level *read[FINE_LEVELS + 1];  // by pixels: the fine levels, and the coarse ones combined
    for (int i = 0; i < reads; i++) {
      read[i] = i < fine ? &pyramid_[i] : &combined;
      ys[i] = places(0, 1, H, read[i]->height, &Level::place_y, *read[i]);
      xs[i] = places(0, 1, W, read[i]->width, &Level::place_x, *read[i]);
    }
    job_.parallel(s_.block_rows, [&](int by, int) {
      CellLevels to{read, reads, ys.data(), xs.data()};
      for (int y = by * BLOCK; y < std::min(H, (by + 1) * BLOCK); y += CELL)
        for (int x = 0; x < W; x += CELL) {
          bool found = false, found_fine = false;
          for (int r = y / cell_; r < std::min((y + CELL) / cell_, cell_rows_); r++)
            for (int c = x / cell_; c < std::min((x + CELL) / cell_, cell_columns_); c++) {
              found |= found_[(size_t)r * cell_columns_ + c];
              found_fine |= fine_[(size_t)r * cell_columns_ + c];
            }
          to.first = found_fine ? 0 : fine;
          if (found && to.first < reads) C_ == 3 ? fill_cell<3>(y, x, to) : fill_cell<0>(y, x, to);
        }
    });
  }

  // Mean light of a level, for cells without valid pixels; 0 if all pixels are valid.
  std::vector<float> mean_light(const Level &level) const {
    std::vector<float> mean(C_, 0.0f);
    if (!s_.valid) return mean;
    std::vector<double> sums(C_ + 1, 0.0);
    for (int row = 0; row < level.height; row++)
      for (int column = 0; column < level.width; column++) {
        const float *sample = level.at(row, column), weight = sample[means_ + 1];
        if (!(weight > 0)) continue;
        for (int c = 0; c < C_; c++) sums[c] += (double)weight * sample[c];
        sums[C_] += weight;
      }
    for (int c = 0; c < C_; c++) mean[c] = (float)(sums[c] / std::max(sums[C_], 1e-12));
    return mean;
  }

  // A row of cells of BEHIND_STEP pixels: the light behind them, and the mean of the coarse levels in `combined`. ys,
  // xs: positions of the cells in each level; mean: light of cells without valid pixels.
  void look_behind(int row, const std::vector<std::vector<Place>> &ys, const std::vector<std::vector<Place>> &xs,
                   const std::vector<float> &mean, const Level &combined) {
    const int levels = job_.levels, C = C_, rows = combined.height, columns = combined.width;
    const int coarse = std::max(levels - FINE_LEVELS, 0);
    const Level &base = pyramid_[std::min(levels, FINE_LEVELS) - 1];
    std::vector<float> mean_behind(stride_);
    std::vector<Sample> samples(levels, {0, 0, std::vector<f8>(stride_ / F8)});
    for (int column = 0; column < columns; column++) {
      const float *light = base.at(row, column);
      if (!(light[means_ + 1] > 0)) light = mean.data();
      float *const coarse_mean = coarse ? combined.at(row, column) : nullptr;
      if (coarse) memset(coarse_mean, 0, stride_ * sizeof(float));
      float nearest;
      if (is_wanted(row, column, rows, columns, nearest)) {
        for (int i = 0; i < levels; i++) samples[i].read(pyramid_[i], ys[i][row], xs[i][column], nearest);
        if (coarse)
          coarse_mean[means_ + 1] = mix(&pyramid_[FINE_LEVELS], &samples[FINE_LEVELS], coarse, false, coarse_mean);
        if (mix(pyramid_.data(), samples.data(), levels, true, mean_behind.data()) > 0) light = mean_behind.data();
      }
      const size_t at = (size_t)row * columns + column;
      for (int c = 0; c < C; c++) job_.behind[(size_t)c * rows * columns + at] = light[c];
    }
  }

  // Whether a pixel of a cell of BEHIND_STEP pixels may show a hidden surface; nearest: smallest coc of the cell's
  // pixels.
  bool is_wanted(int row, int column, int rows, int columns, float &nearest) const {
    const int H = job_.height, W = job_.width;
    const int top = first_pixel(H, rows, BEHIND_STEP) + row * BEHIND_STEP;
    const int left = first_pixel(W, columns, BEHIND_STEP) + column * BEHIND_STEP;
    const int y0 = std::clamp(top, 0, H - 1), y1 = std::clamp(top + BEHIND_STEP - 1 + H % 2, 0, H - 1);
    const int x0 = std::clamp(left, 0, W - 1), x1 = std::clamp(left + BEHIND_STEP - 1 + W % 2, 0, W - 1);
    bool found = false, any = false;
    for (int r = y0 / cell_; r <= y1 / cell_; r++)
      for (int c = x0 / cell_; c <= x1 / cell_; c++) found |= found_[(size_t)r * cell_columns_ + c];
    if (!found) return false;
    nearest = NEVER_PX;
    for (int y = y0; y <= y1; y++)
      for (int x = x0; x <= x1; x++) {
        nearest = std::min(nearest, s_.coc[s_.pixel(y, x)]);
        any = any || wanted(y, x);
      }
    return any;
  }

  // The levels that the pixels of a cell read, and the positions of rows and columns in each.
  struct CellLevels {
    const Level *const *levels;
    int count;
    const std::vector<Place> *ys, *xs;
    int first = 0;
    // for each level and row around the cell: samples before and after each of the cell's columns
    std::vector<vec> samples = {};
    std::vector<float> lines = {};  // the same in the level's order
  };

  // Copies the samples of level i around a cell so that the four around each of LANES pixels are vectors; returns the
  // first row of samples.
  static int copy_samples(CellLevels &to, int i, int y0, int x0, int rows, int columns, int planes, vec *out) {
    constexpr int VECTORS = CELL / LANES;
    const Level &level = *to.levels[i];
    const Place *ys = &to.ys[i][y0], *xs = &to.xs[i][x0];
    const int top = ys->before, bottom = std::min(ys[rows - 1].before + 1, level.height - 1), left = xs->before;
    const int last = std::min(xs[columns - 1].before + 1, level.width - 1) - left;
    ivec samples[2][VECTORS];
    for (int x = 0; x < CELL; x++) {
      const int before = xs[std::min(x, columns - 1)].before - left;
      samples[0][x / LANES][x % LANES] = before;
      samples[1][x / LANES][x % LANES] = std::min(before + 1, last);
    }
    float *line = to.lines.data();
    for (int row = top; row <= bottom; row++, line += planes * CELL)
      for (int x = 0; x <= last; x++)
        for (int k = 0; k < planes; k++) line[k * CELL + x] = level.at(row, left + x)[k];
    line = to.lines.data();
    for (int row = top; row <= bottom; row++, line += planes * CELL)
      for (int side = 0; side < 2; side++)
        for (int k = 0; k < planes; k++)
          for (int v = 0; v < VECTORS; v++) *out++ = lookup(line + k * CELL, samples[side][v]);
    return top;
  }

  // Mean of the samples behind LANES pixels: vector v of row y of the cell at column x0, with the coc `here`. Returns
  // the sum of the votes; mean: light, blur and coc.
  template <int CHANNELS>
  vec mean_behind(const CellLevels &to, const int *first_rows, vec here, int y, int x0, int v, int columns,
                  vec *mean) const {
    constexpr int VECTORS = CELL / LANES, ROWS = CELL / 2 + 2;
    const int means = (CHANNELS ? CHANNELS : C_) + 1, planes = means + 2;
    const size_t beside = (size_t)planes * VECTORS, below = 2 * beside, of_level = ROWS * below;
    const vec size = max(here, -here), end = own_end(here);
    vec total = {};
    for (int k = 0; k <= means; k++) mean[k] = vec{};
    for (int i = to.first; i < to.count; i++) {
      const Level &level = *to.levels[i];
      const Place row = to.ys[i][y], *xs = &to.xs[i][x0];
      const vec *corners[4];
      corners[0] = &to.samples[i * of_level + (row.before - first_rows[i]) * below + v];
      corners[1] = corners[0] + beside;
      corners[2] = corners[0] + (level.height > 1 ? below : 0);
      corners[3] = corners[2] + beside;
      vec right, weight = {}, counts[4];
      for (int x = 0; x < LANES; x++) right[x] = xs[std::min(v * LANES + x, columns - 1)].part;
      const vec left = 1.0f - right,
                shares[4] = {left * (1.0f - row.part), right * (1.0f - row.part), left * row.part, right * row.part};
      for (int k = 0; k < 4; k++) {
        const vec farther = is_another_surface(corners[k][means * VECTORS] - end);
        weight += counts[k] = shares[k] * corners[k][(means + 1) * VECTORS] * farther;
      }
      const vec level_weight = is_read(size, level.least_px);
      const ivec is_seen = (weight > LEAST_SEEN) & (level_weight > vec{});
      if (!any_of(is_seen)) continue;
      const vec voted = level.vote > 0 ? level.vote * min(weight * (1.0f / SURE), broadcast(1.0f)) : weight;
      const vec vote = is_seen ? level_weight * voted : vec{};
      total += vote;
      const vec part = vote / max(total, broadcast(LEAST_TOTAL)), each = 1.0f / max(weight, broadcast(LEAST_SEEN));
      for (vec &count : counts) count *= each;
      for (int k = 0; k <= means; k++) {
        const size_t plane = (size_t)k * VECTORS;
        const vec sample = corners[0][plane] * counts[0] + corners[1][plane] * counts[1] +
                           corners[2][plane] * counts[2] + corners[3][plane] * counts[3];
        mean[k] += (sample - mean[k]) * part;
      }
    }
    return total;
  }

  // Fills the second surfaces of a cell: `behind` and `mix` for LANES pixels at once.
  //
  // 1. Copy each level's samples so that the four around each of LANES pixels are vectors.
  // 2. For each vector of pixels and each level, take the mean of the samples behind them, and add it by its votes.
  // 3. Fill the second surfaces of the pixels that any level voted for; what matting gave them stays by its share.
  template <int CHANNELS>
  void fill_cell(int y0, int x0, CellLevels &to) {
    constexpr int VECTORS = CELL / LANES, ROWS = CELL / 2 + 2;
    const int C = CHANNELS ? CHANNELS : C_, planes = C + 3, W = job_.width,
              which = y0 / BLOCK * s_.block_columns + x0 / BLOCK;
    const int rows = std::min(CELL, job_.height - y0), columns = std::min(CELL, W - x0);
    const size_t of_level = (size_t)2 * ROWS * planes * VECTORS;
    to.samples.resize(to.count * of_level + planes);
    to.lines.resize(ROWS * planes * CELL);
    vec *const mean = &to.samples[to.count * of_level];
    int first_rows[FINE_LEVELS + 1];
    for (int i = to.first; i < to.count; i++)
      first_rows[i] = copy_samples(to, i, y0, x0, rows, columns, planes, &to.samples[i * of_level]);
    for (int y = 0; y < rows; y++) {
      const int within = (y0 + y) % BLOCK * BLOCK + x0 % BLOCK;
      const float *here_of = s_.coc + s_.pixel(y0 + y, x0);
      float cut[CELL] = {};
      if (columns < CELL) here_of = (const float *)memcpy(cut, here_of, columns * sizeof(float));
      for (int v = 0; v < VECTORS; v++) {
        const vec here = load<vec>(here_of + v * LANES), size = max(here, -here);
        ivec filled = size > HIDING_FROM_PX;
        if (!any_of(filled)) continue;
        const vec total = mean_behind<CHANNELS>(to, first_rows, here, y0 + y, x0, v, columns, mean);
        const vec certain = min(total * (1.0f / CERTAIN), broadcast(1.0f)) * on_one_side(mean[C + 1], mean[C]);
        if (!any_of(filled & (certain > vec{}))) continue;
        const Block b = s_.make_block(which);
        const size_t at = within + v * LANES;
        const vec mixed = load<vec>(b.weight + at), coc = load<vec>(b.coc + at), own = load<vec>(b.own_weight + at);
        // how far the samples may take the part of the other surface: a small one that is no highlight
        vec alike = clamp01(1.0f - 2.0f * mixed) * (1.0f - is_another_surface(abs(mean[C + 1] - coc)));
        vec valid = broadcast(1.0f);
        for (int x = 0; x < std::min(LANES, columns - v * LANES); x++) {
          const int row = y0 + y, column = x0 + v * LANES + x;
          if (s_.valid) valid[x] = s_.valid[s_.pixel(row, column)];
          if (!(mixed[x] > 0) || !(alike[x] > 0)) continue;
          const float peak = peak_of(b.other + at + x, BLOCK_PIXELS, C);
          alike[x] *= clamp01(2.0f - 2.0f * (peak / std::max(threshold_at(job_, row, column), TINY)));
        }
        const vec counted = counted_of(mixed), part = clamp01(mixed * (2.0f / HIDDEN_WEIGHT));
        const vec hidden = HIDDEN_WEIGHT * certain * (1.0f - (1.0f - alike) * part);
        filled &= hidden > vec{};
        const vec sharper = clamp01(size - abs(coc));
        const vec kept = (1.0f - sharper * certain * alike) * (counted / max(hidden + counted, broadcast(1e-12f)));
        const auto put = [&](float *other, vec seen) {
          const vec given = load<vec>(other);
          store(other, filled ? seen + kept * (given - seen) : given);
        };
        for (int c = 0; c < C; c++) put(b.other + c * BLOCK_PIXELS + at, mean[c]);
        put(b.coc + at, mean[C + 1]);
        store(b.weight + at, filled ? as_final((hidden + counted) * valid) : mixed);
        store(b.own_weight + at, filled & (own > vec{}) ? 1.0f - counted : own);
      }
    }
  }

  Job &job_;
  Surfaces &s_;
  const int C_, means_, stride_;
  int area_height_, area_width_, coarsest_, cell_, cell_rows_, cell_columns_;
  std::vector<Level> pyramid_;
  std::vector<uint8_t> found_, fine_;  // of each cell: a farther surface exists; a fine level has it
};

}  // namespace

void Job::fill_hidden() { Filling(*this).run(); }

}  // namespace torchdof
