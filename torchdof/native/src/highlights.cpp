// Highlights: light far brighter than its surroundings is removed from the layers and rendered ray by ray, as described
// in render/highlights.py.
#include "highlights.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "blocks.h"
#include "blur_axis.h"
#include "constants/highlights.h"
#include "constants/plan.h"
#include "extremes.h"
#include "field_mask.h"
#include "job.h"
#include "light.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"
#include "surfaces.h"

namespace torchdof {
namespace {

// Constants of highlights.py and plan.py in render, which give their meanings, units and effects.
using constants::highlights::BETWEEN_SLOPE, constants::highlights::BETWEEN_START;
using constants::highlights::BRIGHT_PART, constants::highlights::DARK;
using constants::highlights::FACTOR, constants::highlights::FREE_CHANGE_PX;
using constants::highlights::LEAST_PX, constants::highlights::NEARER_PX;
using constants::highlights::STEP, constants::highlights::STEP_SLOPE, constants::highlights::STEP_START;
using constants::highlights::TAPS_PER_PIXEL, constants::highlights::WHOLE;
using constants::plan::KERNELS_PER_PX;
constexpr int CELL_STEPS = constants::highlights::CELL;
constexpr int THRESHOLD_CELL = STEP * CELL_STEPS;
constexpr int PATCH = 16;  // side in pixels of the squares in which rays are processed

struct Candidate {
  int row, column;
  float peak, coc, limit;
  float weight;  // share of the pixel that emits
};

// Number of cells along an axis, centred on the image; before: pixels of the first cell that lie before the image.
int cells_of(int size, int &before) {
  int count = (size + 2 * THRESHOLD_CELL - 1) / THRESHOLD_CELL;
  count += (count + size) % 2;
  before = (count * THRESHOLD_CELL - size) / 2;
  return count;
}

// Mirrors an index into the image.
int mirrored(int at, int size) {
  at = (at % (2 * size) + 2 * size) % (2 * size);
  return std::min(at, 2 * size - 1 - at);
}

// The rank-th largest of the values, or 0 if it is negative: binary search on the bit pattern, which for positive
// floats has the order of the values.
float ranked(int rank, const float *values, int vectors) {
  int32_t bits = 0;
  for (int bit = 30; bit >= 0; bit--) {
    const int32_t more = bits | 1 << bit;
    ivec reached = {};
    for (int i = 0; i < vectors; i++) reached -= (ivec)load<vec>(values + i * LANES) >= more;
    int count = 0;
    for (int i = 0; i < LANES; i++) count += reached[i];
    if (count >= rank) bits = more;
  }
  float value;
  memcpy(&value, &bits, sizeof(value));
  return value;
}

}  // namespace

float threshold_at(const Job &job, int y, int x) {
  const int rows = job.threshold_rows, columns = job.threshold_columns;
  const float at_y = std::clamp((y + job.threshold_top + 0.5f) / THRESHOLD_CELL - 0.5f, 0.0f, rows - 1.0f);
  const float at_x = std::clamp((x + job.threshold_left + 0.5f) / THRESHOLD_CELL - 0.5f, 0.0f, columns - 1.0f);
  const int top = std::min((int)at_y, rows - 2), left = std::min((int)at_x, columns - 2);
  const float down = at_y - top, across = at_x - left;
  const float *upper = &job.threshold[(size_t)top * columns + left], *lower = upper + columns;
  const float a = upper[0] + across * (upper[1] - upper[0]), b = lower[0] + across * (lower[1] - lower[0]);
  return a + down * (b - a);
}

float least_threshold(const Job &job, int y0, int x0) {
  auto cell = [](int at, int before, int count) {
    return std::clamp((at + before - THRESHOLD_CELL / 2) / THRESHOLD_CELL, 0, count - 1);
  };
  const int rows = job.threshold_rows, columns = job.threshold_columns, top = job.threshold_top,
            left = job.threshold_left;
  float least = INFINITY;
  for (int row = cell(y0, top, rows); row <= std::min(cell(y0 + BLOCK, top, rows) + 1, rows - 1); row++)
    for (int column = cell(x0, left, columns); column <= std::min(cell(x0 + BLOCK, left, columns) + 1, columns - 1);
         column++)
      least = std::min(least, job.threshold[(size_t)row * columns + column]);
  return least;
}

void Job::find_threshold() {
  constexpr int COUNT = CELL_STEPS * CELL_STEPS, VECTORS = (COUNT + LANES - 1) / LANES;
  threshold_rows = cells_of(height, threshold_top);
  threshold_columns = cells_of(width, threshold_left);
  threshold.resize((size_t)threshold_rows * threshold_columns);
  const float *light = surfaces.light, *valid = surfaces.valid;
  const size_t area = surfaces.area();
  std::vector<int> xs(threshold_columns * CELL_STEPS);
  for (int j = 0; j < (int)xs.size(); j++) xs[j] = mirrored(j * STEP + STEP / 2 - threshold_left, width);
  parallel(threshold_rows, [&](int row, int) {
    std::vector<float> brightest((size_t)threshold_columns * VECTORS * LANES, -1.0f);  // of each cell
    for (int i = 0; i < CELL_STEPS; i++) {
      const int y = mirrored(row * THRESHOLD_CELL + i * STEP + STEP / 2 - threshold_top, height);
      for (int column = 0; column < threshold_columns; column++)
        for (int j = 0; j < CELL_STEPS; j++) {
          const size_t at = surfaces.pixel(y, xs[column * CELL_STEPS + j]);
          brightest[(size_t)column * VECTORS * LANES + i * CELL_STEPS + j] =
              valid && !(valid[at] > 0) ? INFINITY : peak_of(light + at, area, channels);
        }
    }
    const float largest = 3.4028234663852886e38f;
    for (int column = 0; column < threshold_columns; column++)
      threshold[(size_t)row * threshold_columns + column] =
          FACTOR * std::min(ranked(COUNT / BRIGHT_PART, &brightest[(size_t)column * VECTORS * LANES], VECTORS),
                            largest / FACTOR);
  });
}

// Share of a bright pixel's surface whose light is emitted as rays. Behind a nearer, dark surface all of it is, because
// that surface blocks the rays itself; but not where coc around has values between the two surfaces, since the edge is
// then blurred.
static float part_sent(const Surfaces &surfaces, int channels, int second, int y, int x, float coc, float limit) {
  const Block block = surfaces.block(surfaces.block_of(y, x));
  const int within = place_in_block(y, x);
  const float cover = (second ? block.weight : block.own_weight)[within];
  const float gap = coc - (second ? surfaces.coc[surfaces.pixel(y, x)] : block.coc[within]);
  const float stopped = clamp01(gap - NEARER_PX);
  if (!(stopped > 0)) return cover;
  const float middle = coc - 0.5f * gap;
  float between = 0;  // of 25 pixels
  for (int dy = -2; dy <= 2; dy++) {
    const float *row = surfaces.coc + (size_t)std::clamp(y + dy, 0, surfaces.height - 1) * surfaces.width;
    for (int dx = -2; dx <= 2; dx++) {
      // 1/2 on either surface
      const float off_middle = std::fabs(row[std::clamp(x + dx, 0, surfaces.width - 1)] - middle) / gap;
      between += clamp01(BETWEEN_START - BETWEEN_SLOPE * off_middle);
    }
  }
  const float is_step = clamp01(STEP_START - STEP_SLOPE * (between / 25.0f));
  const float beside = peak_of((second ? block.own : block.other) + within, BLOCK_PIXELS, channels);
  const float is_dark = clamp01(DARK - beside / std::max(limit, TINY));
  return cover + continuation(cover) * (stopped * is_dark * is_step);
}

namespace {

// The bright, blurred, visible pixels of each surface in a row of blocks: adds those of surface i to bands[i * step].
void find_candidates(const Job &job, int by, float from_px, std::vector<Candidate> *bands, size_t step) {
  const Surfaces &s = job.surfaces;
  const int channels = job.channels;
  std::vector<const float *> light(channels);
  const float *coc, *weight;
  for (int bx = 0; bx < s.block_columns; bx++) {
    const int x0 = bx * BLOCK, n = std::min(BLOCK, s.width - x0), block = by * s.block_columns + bx;
    const float least_limit = least_threshold(job, by * BLOCK, x0);
    if (!s.full_planes()) {
      vec peak = broadcast(job.block_peak[block]);
      const float *of_block = s.blocks[block];  // light of both surfaces comes first
      for (int i = 0; of_block && i < 2 * channels * BLOCK_PIXELS; i += LANES)
        peak = max(peak, load<vec>(of_block + i));
      if (!any_of(peak > least_limit)) continue;
    }
    for (int y = by * BLOCK; y < std::min(s.height, (by + 1) * BLOCK); y++)
      for (int i = 0; i < s.count; i++) {
        if (!s.row(i, y, x0, light.data(), coc, weight)) continue;
        for (int x = 0; x < n; x++) {
          float brightest = light[0][x];
          for (int c = 1; c < channels; c++) brightest = std::max(brightest, light[c][x]);
          const bool is_seen = !weight || weight[x] > HIDDEN_WEIGHT;
          if (!(brightest > least_limit) || !is_seen || !(std::fabs(coc[x]) > from_px)) continue;
          const float limit = threshold_at(job, y, x0 + x);
          if (!(brightest > limit)) continue;
          float part = weight ? weight[x] : 1.0f;
          if (!s.full_planes() && s.has_block(block)) part = part_sent(s, channels, i, y, x0 + x, coc[x], limit);
          bands[i * step].push_back({y, x0 + x, brightest, coc[x], limit, part});
        }
      }
  }
}

// If the kernels have more taps than the budget, keeps only the brightest pixels, and of these only the light above a
// common limit. taps: of the kernel of a pixel.
template <typename Taps>
void limit_taps(std::vector<Candidate> &all, double budget, const Taps &taps) {
  double taps_of_all = 0;
  for (const Candidate &p : all) taps_of_all += taps(p);
  if (!(taps_of_all > budget)) return;
  std::vector<Candidate> sorted(all);
  std::sort(sorted.begin(), sorted.end(), [](const Candidate &a, const Candidate &b) { return a.peak > b.peak; });
  double least = 0, sum = 0, slope = 0;
  for (size_t k = 0; k < sorted.size(); k++) {
    sum += taps(sorted[k]);
    slope += 0.5 * taps(sorted[k]) / sorted[k].peak;
    if (sum - (k + 1 < sorted.size() ? sorted[k + 1].peak : 0.0) * slope < budget) continue;
    least = std::min((sum - budget) / slope, (double)sorted[k].peak);
    break;
  }
  const auto is_dimmer = [&](const Candidate &p) { return !(p.peak > least); };
  all.erase(std::remove_if(all.begin(), all.end(), is_dimmer), all.end());
  for (Candidate &p : all) p.limit = std::max(p.limit, (float)least);
}

}  // namespace

// Moves light above the threshold from the surfaces to rays.
//
// 1. Collect the bright, blurred, visible pixels of each surface.
// 2. If their kernels have more taps than the budget, raise the limit above which light is moved.
// 3. Subtract the light from the surface and store it in rays.
// 4. List the radii for which kernels are needed.
void Job::extract_highlights() {
  const float from_px = scene.occlusion ? LEAST_PX : std::max(scene.crisp_px - 1.0f, LEAST_PX);
  const int count = surfaces.count, band_count = surfaces.block_rows;
  std::vector<std::vector<Candidate>> bands((size_t)band_count * count);
  parallel(band_count, [&](int by, int) { find_candidates(*this, by, from_px, &bands[by], band_count); });
  const auto has_any = [](const std::vector<Candidate> &band) { return !band.empty(); };
  double budget = (double)TAPS_PER_PIXEL * surfaces.area();
  if (scene.occlusion && std::any_of(bands.begin(), bands.end(), has_any)) {
    const double crowd = std::max(mean_change(surfaces.coc, height, width, scene.threads) / FREE_CHANGE_PX, 1.0);
    budget /= crowd * scene.reach * scene.reach;
  }
  std::vector<const float *> light_of(channels);
  const float *coc, *weight;
  for (int i = 0; i < count; i++) {
    std::vector<Candidate> all;
    for (int by = 0; by < band_count; by++) {
      const auto &band = bands[(size_t)i * band_count + by];
      all.insert(all.end(), band.begin(), band.end());
    }
    const auto fades = [&](const Candidate &p) { return std::min(std::fabs(p.coc) - from_px, 1.0f); };
    limit_taps(all, budget, [&](const Candidate &p) {
      const double side = 2.0 * std::fabs(p.coc) + 1;
      return side * side * std::min(WHOLE * (1.0f - p.limit / p.peak) * fades(p), 1.0f);
    });
    for (const Candidate &p : all) {
      const float share = (1.0f - p.limit / p.peak) * fades(p);
      const float left = (1.0f - fades(p)) + fades(p) * (p.limit / p.peak);  // 1 - share without cancellation
      if (!surfaces.full_planes()) surfaces.make_block(surfaces.block_of(p.row, p.column));
      surfaces.row(i, p.row, p.column, light_of.data(), coc, weight);
      const double steps = (double)p.coc * KERNELS_PER_PX, below = std::floor(steps);
      rays.push_back({p.row, p.column, (int)below, (float)(steps - below), p.coc});
      for (int c = 0; c < channels; c++) {
        float &light = const_cast<float &>(*light_of[c]);  // of this job: a block, or a copy
        ray_light.push_back(light * share * p.weight);
        light *= left;
      }
    }
  }
  for (const Ray &ray : rays) radii.insert(radii.end(), {ray.radius, ray.radius + 1});
  std::sort(radii.begin(), radii.end());
  radii.erase(std::unique(radii.begin(), radii.end()), radii.end());
  for (Ray &ray : rays) ray.radius = (int)(std::lower_bound(radii.begin(), radii.end(), ray.radius) - radii.begin());
}

// Calls body(is_own, coc, weight, least_weight) for the surfaces shown in a row of a block column, from column x. A
// surface covers weight - least_weight of a pixel (weight null: 1), so that hidden surfaces cover nothing. Both are
// BLOCK values.
template <typename Body>
static void each_shown(const Surfaces &surfaces, int y, int x, const float **light, const Body &body) {
  const int own = surfaces.full_planes() ? 1 : 0;  // with a given background the first plane is the other surface
  const int n = std::min(BLOCK, surfaces.width - x);
  for (int i : {own, 1 - own}) {
    const float *coc, *weight;
    if (!surfaces.row(i, y, x, light, coc, weight)) continue;
    float its_coc[BLOCK] = {}, its_weight[BLOCK] = {};
    if (n < BLOCK) {  // pixels beyond the frame get the weight 0
      std::copy(coc, coc + n, its_coc);
      for (int j = 0; j < n; j++) its_weight[j] = weight ? weight[j] : 1.0f;
      coc = its_coc, weight = its_weight;
    }
    body(i == own, coc, weight, i == own ? 0.0f : HIDDEN_WEIGHT);
  }
}

// Half width of a ray's kernel.
static int half_of(const RayKernels &kernels, const Ray &ray) {
  return std::max(kernels.halves[ray.radius], kernels.halves[ray.radius + 1]);
}

// For each cell the number of rays that may cross it on surfaces with coc `low` or larger.
static std::vector<int> passing(const Job &job, const RayKernels &kernels, float low, int cell_rows, int cell_columns) {
  std::vector<int> count((size_t)cell_rows * cell_columns, 0);
  auto add = [&](int row, int column, int n) {
    if (row < cell_rows && column < cell_columns) count[(size_t)row * cell_columns + column] += n;
  };
  for (const Ray &ray : job.rays) {
    const int reach =
        (int)std::min(half_of(kernels, ray) * std::fabs(1.0f - low / ray.coc), (float)(job.height + job.width)) + 3;
    const int r0 = std::max(ray.row - reach, 0) / CELL, r1 = std::min(ray.row + reach, job.height - 1) / CELL + 1;
    const int c0 = std::max(ray.column - reach, 0) / CELL, c1 = std::min(ray.column + reach, job.width - 1) / CELL + 1;
    add(r0, c0, 1), add(r0, c1, -1), add(r1, c0, -1), add(r1, c1, 1);
  }
  for (int row = 0; row < cell_rows; row++)  // prefix sums
    for (int column = 0, in_row = 0; column < cell_columns; column++) {
      int &cell = count[(size_t)row * cell_columns + column];
      in_row += cell;
      cell = in_row + (row ? (&cell)[-cell_columns] : 0);
    }
  return count;
}

// The bits of a cell, in lanes.
struct CellBits {
  typedef uint64_t wide __attribute__((vector_size(LANES * 8)));
  wide classes = {}, remainders = {};

  // Adds those of the surfaces shown. high: largest coc of the image.
  void add(const Visibility &v, float high, vec coc, ivec shown) {
    const vec place = min(max(coc - v.low, vec{}), broadcast(high - v.low));
    const auto bit = [&](ivec which) {
      return __builtin_convertvector(shown, wide) & ((wide{} + 1) << __builtin_convertvector(which, wide));
    };
    classes |= bit(min(convert(place * (1.0f / v.class_width)), ivec{} + (v.CLASSES - 1)));
    // at a bin's border both bins, because rays compute the distance from it with another rounding error
    for (const float border : {-1 / 16.0f, 1 / 16.0f}) remainders |= bit(convert(max(place + border, vec{})) & 63);
  }
};

Visibility find_visibility(const Job &job, const RayKernels &kernels) {
  Visibility v;
  const int H = job.height, W = job.width;
  float low = NEVER_PX, high = -NEVER_PX;
  for (int i = 0; i < job.surfaces.block_rows * job.surfaces.block_columns; i++) {
    low = std::min(low, job.block_low[i]);
    high = std::max(high, job.block_high[i]);
  }
  v.low = low;
  const int bins = (int)(high - low) + 2;
  v.class_width = std::max(1.0f, bins / (float)v.CLASSES);
  v.cell_rows = ceil_div(H, CELL);
  v.cell_columns = ceil_div(W, CELL);
  v.cells.resize((size_t)v.cell_rows * v.cell_columns);
  const std::vector<int> passed = passing(job, kernels, low, v.cell_rows, v.cell_columns);
  const Surfaces &surfaces = job.surfaces;
  job.parallel(v.cell_rows, [&](int row, int) {
    Visibility::Cell *cells = &v.cells[(size_t)row * v.cell_columns];
    std::vector<const float *> light(job.channels);
    for (int x = 0; x < W; x += BLOCK) {
      const int block = row * CELL / BLOCK * surfaces.block_columns + x / BLOCK, n = std::min(BLOCK, W - x);
      bool passes = false;
      for (int j = 0; j < n; j += CELL) passes |= passed[(size_t)row * v.cell_columns + (x + j) / CELL] > 0;
      if (!passes) continue;
      // all coc of a block lie within 1 px: its two extremes give its classes
      const float ends[2] = {job.block_low[block], job.block_high[block]};
      const bool flat = !surfaces.full_planes() && ends[1] - ends[0] < 1;
      CellBits bits[BLOCK / CELL];
      for (CellBits &of_cell : bits)
        for (float coc : ends) of_cell.add(v, high, broadcast(coc), ivec{} - flat);
      for (int y = row * CELL; y < std::min(H, (row + 1) * CELL) && !(flat && !surfaces.has_block(block)); y++)
        each_shown(surfaces, y, x, light.data(),
                   [&](bool own, const float *coc, const float *weight, float least_weight) {
                     if (own && flat) return;
                     for (int j = 0; j < BLOCK; j += LANES)
                       bits[j / CELL].add(v, high, load<vec>(coc + j),
                                          weight ? load<vec>(weight + j) > least_weight : ivec{} == 0);
                   });
      for (int j = 0; j < n; j += CELL)
        for (int i = 0; i < LANES; i++) {
          cells[(x + j) / CELL].classes |= bits[j / CELL].classes[i];
          cells[(x + j) / CELL].remainders |= bits[j / CELL].remainders[i];
        }
    }
  });
  uint64_t any = 0;
  for (const Visibility::Cell &cell : v.cells) any |= cell.classes;
  for (int k = 0; k <= bins; k++)
    if (any & v.classes_of(k)) v.bins.push_back(k);
  return v;
}

namespace {

// Coverage of a row of pixels, from a block column, by surfaces within 1 px of coc `place`; returns whether there is
// any.
bool cover_row(const Job &job, int y, int block_column, int block_columns, float place, const float **light,
               float *covered) {
  vec most_cover = {};
  for (int i = 0; i < block_columns; i++, covered += BLOCK) {
    const int x = (block_column + i) * BLOCK;
    for (int j = 0; j < BLOCK; j += LANES) store(covered + j, vec{});
    each_shown(job.surfaces, y, x, light, [&](bool, const float *coc, const float *weight, float least_weight) {
      for (int j = 0; j < BLOCK; j += LANES) {
        const vec apart = load<vec>(coc + j) - place;
        vec cover = max(1.0f - max(apart, -apart), vec{});
        if (weight) cover *= max(load<vec>(weight + j) - least_weight, vec{});
        store(covered + j, load<vec>(covered + j) + cover);
        most_cover = max(most_cover, cover);
      }
    });
  }
  return any_positive(most_cover);
}

// Adds, for rays that land in a patch of rows x columns pixels at y, x, the share blocked by surfaces of bin k.
void add_blocked(const Job &job, const Visibility &v, const Ray &ray, int k, int y, int x, int rows, int columns,
                 const float **light, float (*blocked)[PATCH]) {
  constexpr int LONGEST = 256;  // columns of the image processed together
  const int H = job.height, W = job.width;
  const float place = v.low + k, fades = clamp01(ray.coc - NEARER_PX - place), along = 1.0f - place / ray.coc;
  const uint64_t classes = v.classes_of(k), remainders = v.remainders_of(k);
  int column[PATCH];
  float across[PATCH];
  for (int i = 0; i < columns; i++) {
    const float at_x = std::clamp(ray.column + (x + i - ray.column) * along, 0.0f, W - 1.0f);
    column[i] = (int)at_x;
    across[i] = at_x - column[i];
  }
  // covered share of an image row at each column's ray; an even and an odd row are kept, because rays of adjacent rows
  // cross the same ones
  float met[2][PATCH] = {};
  int known[2] = {-1, -1};
  bool meets[2];
  // columns whose rays may cross a surface of the bin in a row of cells; rays far apart pass between most surfaces
  bool crosses[PATCH];
  int crossed_row = -1;
  auto take_cells = [&](int cell_row) {
    if (crossed_row == cell_row) return;
    crossed_row = cell_row;
    const Visibility::Cell *cells = &v.cells[(size_t)cell_row * v.cell_columns];
    for (int i = 0; i < columns; i++) {
      const int cell = column[i] / CELL, next = std::min(column[i] + 1, W - 1) / CELL;
      crosses[i] =
          v.may_show(cells[cell], classes, remainders) || (next > cell && v.may_show(cells[next], classes, remainders));
    }
  };
  auto take_row = [&](int row) {
    if (known[row % 2] == row) return meets[row % 2];
    known[row % 2] = row;
    meets[row % 2] = false;
    float covered[LONGEST], *to = met[row % 2];
    take_cells(row / CELL);
    for (int start = 0, stop; start < columns; start = stop) {
      if (!crosses[start]) {
        to[start] = 0;
        stop = start + 1;
        continue;
      }
      for (stop = start + 1;
           stop < columns && crosses[stop] && std::abs(column[stop] - column[start]) < LONGEST - 2 * BLOCK; stop++) {}
      const int low = std::min(column[start], column[stop - 1]),
                high = std::min(std::max(column[start], column[stop - 1]) + 1, W - 1);
      const int first = low / BLOCK;
      meets[row % 2] |= cover_row(job, row, first, high / BLOCK - first + 1, place, light, covered);
      for (int i = start; i < stop; i++) {
        const float *value = covered + column[i] - first * BLOCK, *next = column[i] < W - 1 ? value + 1 : value;
        to[i] = *value + across[i] * (*next - *value);
      }
    }
    return meets[row % 2];
  };
  for (int i = 0; i < rows; i++) {
    const float at_y = std::clamp(ray.row + (y + i - ray.row) * along, 0.0f, H - 1.0f);
    const int row = std::min((int)at_y, std::max(0, H - 2)), below = H > 1 ? row + 1 : row;
    const bool upper = take_row(row), lower = take_row(below);
    if (!upper && !lower) continue;
    for (int j = 0; j < PATCH; j += LANES) {
      const vec a = load<vec>(met[row % 2] + j), b = load<vec>(met[below % 2] + j);
      store(blocked[i] + j, load<vec>(blocked[i] + j) + fades * (a + (at_y - row) * (b - a)));
    }
  }
}

}  // namespace

// Transmittance of the lens's field for a ray's kernel.
static FieldMask mask_of(const Job &job, const RayKernels &kernels, const Ray &ray, int colour) {
  const auto *masks = kernels.field_masks;
  int low = 0;
  while (low < kernels.field_masks_count - 2 && masks[low + 1].radius <= ray.coc) low++;
  const float part = clamp01((ray.coc - masks[low].radius) / (masks[low + 1].radius - masks[low].radius));
  const float per = per_half_diagonal(job.scene);
  const float y = (ray.row + 0.5f - 0.5f * job.height) * per, x = (ray.column + 0.5f - 0.5f * job.width) * per;
  return FieldMask(job.scene, masks[low], &masks[low + 1], part, colour, y, x);
}

// Adds n values of row y, from column x, of a ray's kernel: the interpolation of those of the two nearest radii.
static void add_taps(const RayKernels &kernels, const Ray &ray, int colour, int y, int x, int n, float *taps) {
  for (int which = ray.radius; which <= ray.radius + 1; which++) {
    const int half = kernels.halves[which], side = 2 * half + 1;
    if (std::abs(y) > half) continue;
    const float part = which == ray.radius ? 1.0f - ray.part : ray.part;
    const float *from = kernels.kernels[which] + ((size_t)colour * side + y + half) * side + half;
    for (int i = std::max(x, -half); i <= std::min(x + n - 1, half); i++) taps[i - x] += part * from[i];
  }
}

std::vector<float> gains_of(const Job &job, const RayKernels &kernels) {
  const int E = job.colours;
  if (!job.scene.field_masks) return {};
  std::vector<float> gains(job.rays.size() * E);
  job.parallel((int)gains.size(), [&](int i, int) {
    const Ray &ray = job.rays[i / E];
    const FieldMask mask = mask_of(job, kernels, ray, i % E);
    const int half = half_of(kernels, ray), side = 2 * half + 1;
    std::vector<float> row(side + LANES);
    double all_light = 0, left = 0;
    for (int y = -half; y <= half; y++) {
      std::fill(row.begin(), row.end(), 0.0f);
      add_taps(kernels, ray, i % E, y, -half, side, row.data());
      for (int x = 0; x < side; x += LANES) {
        const vec light = load<vec>(row.data() + x);
        if (!any_positive(light)) continue;
        const vec passed = light * mask.transmittance(broadcast((float)y), (float)(x - half) + iota());
        for (int lane = 0; lane < LANES; lane++) all_light += light[lane], left += passed[lane];
      }
    }
    gains[i] = left > FieldMask::LEAST * all_light ? (float)(all_light / left) : 0.0f;
  });
  return gains;
}

namespace {

// A ray on its way to a rectangle of pixels, and the surfaces that may block it there.
struct Crossing {
  const Job &job;
  const Visibility &v;
  const Ray &ray;
  std::vector<int> &nearer;                   // bins of surfaces that may block the ray
  std::vector<const float *> &surface_light;  // memory

  Crossing(const Job &job, const Visibility &v, const Ray &ray, int top, int bottom, int left, int right,
           std::vector<int> &nearer, std::vector<const float *> &surface_light)
      : job(job), v(v), ray(ray), nearer(nearer), surface_light(surface_light) {
    nearer.clear();
    for (int k : v.bins) {
      if (!job.scene.occlusion || !(ray.coc - NEARER_PX > v.low + k)) break;
      if (may_meet(k, top, left, bottom - top, right - left)) nearer.push_back(k);
    }
  }

  // Whether rays that land in a rectangle may cross a surface of bin k.
  bool may_meet(int k, int y, int x, int rows, int columns) const {
    // a ray to a pixel at distance d from its source crosses the surface at distance along * d
    const float along = 1.0f - (v.low + k) / ray.coc;
    const float ya = ray.row + (y - ray.row) * along, yb = ray.row + (y + rows - 1 - ray.row) * along;
    const float xa = ray.column + (x - ray.column) * along, xb = ray.column + (x + columns - 1 - ray.column) * along;
    const auto cell = [](float at, int size) { return (int)std::clamp(at, 0.0f, size - 1.0f) / CELL; };
    const int r0 = cell(std::floor(std::min(ya, yb)), job.height), r1 = cell(std::max(ya, yb) + 1, job.height);
    const int c0 = cell(std::floor(std::min(xa, xb)), job.width), c1 = cell(std::max(xa, xb) + 1, job.width);
    const uint64_t classes = v.classes_of(k), remainders = v.remainders_of(k);
    for (int i = r0; i <= r1; i++)
      for (int j = c0; j <= c1; j++)
        if (v.may_show(v.cells[(size_t)i * v.cell_columns + j], classes, remainders)) return true;
    return false;
  }

  // Accumulates the blocked share of the rays that land in a patch; returns whether all are blocked.
  bool block_all(int y, int x, int rows, int columns, float (&blocked)[PATCH][PATCH]) const {
    for (int k : nearer) {
      if (!may_meet(k, y, x, rows, columns)) continue;
      add_blocked(job, v, ray, k, y, x, rows, columns, surface_light.data(), blocked);
      vec least_blocked = broadcast(1.0f);
      for (int i = 0; i < rows; i++)
        for (int j = 0; j < PATCH; j += LANES) least_blocked = min(least_blocked, load<vec>(blocked[i] + j));
      if (!any_of(least_blocked < 1.0f)) return true;
    }
    return false;
  }
};

}  // namespace

// For each ray that reaches the tile:
//
// 1. Interpolate its kernel between the two nearest radii and mask it by the field, patch by patch.
// 2. Let p be a pixel of the patch and q the ray's source: the ray to p crosses a surface of coc c at
//    q + (p - q) (1 - c / coc of the ray). Sum the coverage there over all nearer bins of coc.
// 3. Add light * tap * (1 - blocked), with blocked at most 1.
void splat(const Job &job, const Visibility &v, int y0, int x0, const int *rays, int count,
           const RayKernels &ray_kernels, const std::vector<float> &gains, float *tile) {
  const int C = job.channels, E = job.colours, y_end = std::min(y0 + TILE, job.height),
            x_end = std::min(x0 + TILE, job.width);
  std::vector<int> nearer;
  std::vector<const float *> surface_light(C);
  std::vector<FieldMask> masks;                        // one for each colour
  std::vector<float> taps((size_t)E * PATCH * PATCH);  // [colours, PATCH, PATCH]
  for (int r = 0; r < count; r++) {
    const Ray &ray = job.rays[rays[r]];
    const float *light = job.ray_light.data() + (size_t)rays[r] * C;
    const int half = half_of(ray_kernels, ray);
    masks.clear();
    for (int e = 0; e < E && !gains.empty(); e++) masks.push_back(mask_of(job, ray_kernels, ray, e));
    const int top = std::max(y0, ray.row - half), bottom = std::min(y_end, ray.row + half + 1);
    const int left = std::max(x0, ray.column - half), right = std::min(x_end, ray.column + half + 1);
    const Crossing crossing(job, v, ray, top, bottom, left, right, nearer, surface_light);
    for (int py = top; py < bottom; py += PATCH)
      for (int px = left; px < right; px += PATCH) {
        const int ny = std::min(PATCH, bottom - py), nx = std::min(PATCH, right - px);
        bool any = false;
        for (int e = 0; e < E; e++) {
          const float gain = gains.empty() ? 0.0f : gains[(size_t)rays[r] * E + e];
          for (int i = 0; i < ny; i++) {
            float *row = &taps[(e * PATCH + i) * PATCH];
            const vec dy = broadcast((float)(py + i - ray.row));
            std::fill(row, row + PATCH, 0.0f);
            add_taps(ray_kernels, ray, e, py + i - ray.row, px - ray.column, nx, row);
            for (int x = 0; x < nx && gain > 0; x += LANES) {
              const vec tap = load<vec>(row + x), dx = (float)(px + x - ray.column) + iota();
              if (any_positive(tap)) store(row + x, tap * gain * masks[e].transmittance(dy, dx));
            }
            for (int x = 0; x < PATCH; x += LANES) any |= any_positive(load<vec>(row + x));
          }
        }
        float blocked[PATCH][PATCH] = {};
        if (!any || crossing.block_all(py, px, ny, nx, blocked)) continue;
        for (int c = 0; c < C; c++)
          for (int i = 0; i < ny; i++) {
            const float *row = &taps[((E > 1 ? c : 0) * PATCH + i) * PATCH];
            float *to = tile + (size_t)c * TILE * TILE + (py + i - y0) * TILE + (px - x0);
            for (int x = 0; x < nx; x++) to[x] += row[x] * (1.0f - std::min(blocked[i][x], 1.0f)) * light[c];
          }
      }
  }
}

}  // namespace torchdof
