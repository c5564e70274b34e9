// Highlights: light far brighter than what is around it, extracted from the layers and splatted ray by ray. The
// formulas are told in render/highlights.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

constexpr float FACTOR = 8.0f;          // times the ordinary light around: a highlight
constexpr int THRESHOLD_CELL = 32;      // pixels over which light is ordered to tell what is ordinary
constexpr float NEARER_PX = 1.5f;       // difference in coc from which on a surface is another one, in front
constexpr int TAPS_PER_PIXEL = 16;      // of the frame: rays beyond this number are left to the layers
constexpr int STEPS_PER_PX = 32;        // of radius: kernels of rays
constexpr int CLASSES = 62;             // of coc, a bit each
constexpr int PATCH = 16;               // rays a side that are looked at together

struct Candidate {
  int row, column;
  float peak, coc, limit;
};

// Least of the values around each, so many to each side.
void least_around(std::vector<float> &values, int rows, int columns, int reach) {
  std::vector<float> line(values.size());
  auto slide = [&](const std::vector<float> &from, std::vector<float> &to, int lines, int count, size_t line_step, size_t step) {
    for (int l = 0; l < lines; l++)
      for (int i = 0; i < count; i++) {
        float least = from[l * line_step + i * step];
        for (int j = std::max(0, i - reach); j <= std::min(count - 1, i + reach); j++)
          least = std::min(least, from[l * line_step + j * step]);
        to[l * line_step + i * step] = least;
      }
  };
  slide(values, line, rows, columns, columns, 1);
  slide(line, values, columns, rows, 1, columns);
}

}  // namespace

void threshold_row(const Job &job, int y, int x, float &first, float &step) {
  const float at_y = std::max((y + 0.5f) / THRESHOLD_CELL - 0.5f, 0.0f), at_x = (x + 0.5f) / THRESHOLD_CELL - 0.5f;
  const int top = std::min((int)at_y, job.threshold_rows - 1), bottom = std::min(top + 1, job.threshold_rows - 1);
  const int left = (int)std::max(at_x, 0.0f), right = std::min(left + 1, job.threshold_columns - 1);
  const float down = at_y - top;
  auto level = [&](int column) {
    const float a = job.threshold[top * job.threshold_columns + column], b = job.threshold[bottom * job.threshold_columns + column];
    return a + down * (b - a);
  };
  const float a = level(left), slope = at_x < 0 ? 0.0f : level(right) - a;
  step = slope / THRESHOLD_CELL;
  first = a + slope * (at_x < 0 ? 0.0f : at_x - left);
}

float least_threshold(const Job &job, int y0, int x0) {
  float least = INFINITY;  // it is linear in between
  for (int y : {y0, y0 + BLOCK - 1}) {
    float first, step;
    threshold_row(job, y, x0, first, step);
    least = std::min(least, std::min(first, first + step * (BLOCK - 1)));
  }
  return least;
}

void Job::find_threshold() {
  constexpr int HALF = THRESHOLD_CELL / 2, COUNT = HALF * HALF;
  const int rows = (height + 1) / 2, columns = (width + 1) / 2;  // every second pixel
  threshold_rows = (rows + 2 * HALF - 1) / HALF;
  threshold_columns = (columns + 2 * HALF - 1) / HALF;
  threshold.resize((size_t)threshold_rows * threshold_columns);
  const float *light = surfaces.light, *valid = surfaces.valid;
  const size_t area = surfaces.area();
  parallel(threshold_rows, [&](int row, int) {
    float brightest[COUNT];
    for (int column = 0; column < threshold_columns; column++) {
      const bool inside = (row + 1) * THRESHOLD_CELL <= height && (column + 1) * THRESHOLD_CELL <= width;
      for (int i = 0; i < HALF; i++) {
        const size_t line = (size_t)2 * std::min(row * HALF + i, rows - 1) * width;
        float peaks[THRESHOLD_CELL];
        if (inside) {  // all pixels of the row, for they lie side by side
          const float *from = light + line + column * THRESHOLD_CELL;
          memcpy(peaks, from, sizeof peaks);
          for (int c = 1; c < channels; c++)
            for (int x = 0; x < THRESHOLD_CELL; x++) peaks[x] = std::max(peaks[x], from[c * area + x]);
          if (valid)
            for (int x = 0; x < THRESHOLD_CELL; x++) peaks[x] = valid[line + column * THRESHOLD_CELL + x] > 0 ? peaks[x] : INFINITY;
        } else {
          for (int j = 0; j < HALF; j++) {
            const size_t at = line + 2 * std::min(column * HALF + j, columns - 1);
            peaks[2 * j] = light[at];
            for (int c = 1; c < channels; c++) peaks[2 * j] = std::max(peaks[2 * j], light[c * area + at]);
            if (valid && !(valid[at] > 0)) peaks[2 * j] = INFINITY;
          }
        }
        for (int j = 0; j < HALF; j++) brightest[i * HALF + j] = peaks[2 * j];
      }
      std::nth_element(brightest, brightest + COUNT / 5 - 1, brightest + COUNT, std::greater<float>());
      const float largest = 3.4028234663852886e38f;
      threshold[(size_t)row * threshold_columns + column] = FACTOR * clamp(brightest[COUNT / 5 - 1], 0.0f, largest / FACTOR);
    }
  });
}

void Job::extract_highlights() {
  const size_t area = surfaces.area();
  const bool occlusion = scene.occlusion;
  const int blocks = surfaces.block_rows * surfaces.block_columns;
  const float *nearest = surfaces.coc;
  // the nearest surface in windows of cells, each twice as wide as the one before
  const int rows = ceil_div(height, CELL), columns = ceil_div(width, CELL);
  std::vector<std::vector<float>> nearest_around;
  float farthest = -NEVER, first_nearest = NEVER;
  for (int i = 0; i < blocks; i++) {
    farthest = std::max(farthest, block_high[i]);
    first_nearest = std::min(first_nearest, block_low[i]);
  }
  // bright pixels of each surface
  const int count = surfaces.count;
  std::vector<std::vector<Candidate>> bands((size_t)surfaces.block_rows * count);
  parallel(surfaces.block_rows, [&](int by, int) {
    std::vector<const float *> light(channels);
    const float *coc, *weight;
    for (int bx = 0; bx < surfaces.block_columns; bx++) {
      const int x0 = bx * BLOCK, n = std::min(BLOCK, width - x0), block = by * surfaces.block_columns + bx;
      if (!surfaces.whole() && !surfaces.has_block(block) && !(block_peak[block] > least_threshold(*this, by * BLOCK, x0))) continue;
      for (int y = by * BLOCK; y < std::min(height, (by + 1) * BLOCK); y++) {
        float first, step;
        threshold_row(*this, y, x0, first, step);
        for (int i = 0; i < count; i++) {
          if (!surfaces.row(i, y, x0, light.data(), coc, weight)) continue;
          float most[BLOCK];
          for (int x = 0; x < n; x++) most[x] = light[0][x];
          for (int c = 1; c < channels; c++)
            for (int x = 0; x < n; x++) most[x] = std::max(most[x], light[c][x]);
          bool any = false;
          for (int x = 0; x < n; x++) any |= most[x] > first + step * x;
          if (!any) continue;
          for (int x = 0; x < n; x++) {
            const float limit = first + step * x;
            if (!(most[x] > limit) || (weight && !(weight[x] > 0)) || !(std::fabs(coc[x]) > 1.0f)) continue;
            bands[(size_t)i * surfaces.block_rows + by].push_back({y, x0 + x, most[x], coc[x], limit});
          }
        }
      }
    }
  });
  for (int i = 0; i < count; i++) {
    std::vector<Candidate> all;
    for (int by = 0; by < surfaces.block_rows; by++) {
      const auto &band = bands[(size_t)i * surfaces.block_rows + by];
      all.insert(all.end(), band.begin(), band.end());
    }
    if (all.empty()) continue;
    if (occlusion && nearest_around.empty()) {
      std::vector<float> cells((size_t)rows * columns, NEVER);
      for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
          float &cell = cells[(size_t)(y / CELL) * columns + x / CELL];
          cell = std::min(cell, nearest[(size_t)y * width + x]);
        }
      int radius = 1, reached = 0;
      const float largest = std::max(std::fabs(farthest), std::fabs(first_nearest));
      for (float inner = NEARER_PX; inner < std::max(largest - first_nearest, 2.0f * largest);) {
        least_around(cells, rows, columns, radius - reached);
        reached = radius;
        nearest_around.push_back(cells);
        inner = std::max(NEARER_PX, (float)(radius * CELL));
        radius *= 2;
      }
    }
    // of these the ones that layers would not do for
    auto needs_rays = [&](const Candidate &p) {
      const float blur = std::fabs(p.coc);
      if (blur >= scene.crisp_px) return true;
      if (!occlusion) return false;
      float inner = NEARER_PX;
      int radius = 1;
      for (const auto &cells : nearest_around) {
        const float near = cells[(size_t)(p.row / CELL) * columns + p.column / CELL];
        if (near < p.coc - inner || (near < p.coc - NEARER_PX && 2.0f * blur > inner)) return true;
        inner = std::max(NEARER_PX, (float)(radius * CELL));
        radius *= 2;
      }
      return false;
    };
    all.erase(std::remove_if(all.begin(), all.end(), [&](const Candidate &p) { return !needs_rays(p); }), all.end());
    if (all.empty()) continue;
    // few: the brightest of them, and only what they are brighter by
    double taps = 0;
    for (const Candidate &p : all) taps += (2.0 * std::fabs(p.coc) + 1) * (2.0 * std::fabs(p.coc) + 1);
    if (taps > (double)TAPS_PER_PIXEL * area) {
      std::stable_sort(all.begin(), all.end(), [](const Candidate &a, const Candidate &b) { return a.peak > b.peak; });
      size_t few = 0;
      for (double sum = 0; few < all.size(); few++) {
        sum += (2.0 * std::fabs(all[few].coc) + 1) * (2.0 * std::fabs(all[few].coc) + 1);
        if (sum > (double)TAPS_PER_PIXEL * area) break;
      }
      const float next = all[few].peak;
      all.resize(few);
      for (Candidate &p : all) p.limit = std::max(p.limit, next);
      std::sort(all.begin(), all.end(), [](const Candidate &a, const Candidate &b) { return a.row != b.row ? a.row < b.row : a.column < b.column; });
    }
    for (const Candidate &p : all) {
      const float share = (1.0f - p.limit / p.peak) * std::min(std::fabs(p.coc) - 1.0f, 1.0f);
      const size_t at = (size_t)p.row * width + p.column;
      float weight = 1.0f, *light;
      size_t step;
      if (surfaces.whole()) {
        light = const_cast<float *>(surfaces.lights[i]) + at;  // of our own copy
        step = area;
        if (surfaces.weights[i]) weight = surfaces.weights[i][at];
      } else {
        const Block b = surfaces.make_block(p.row / BLOCK * surfaces.block_columns + p.column / BLOCK);
        const int within = p.row % BLOCK * BLOCK + p.column % BLOCK;
        light = (i ? b.other : b.own) + within;
        step = BLOCK_PIXELS;
        weight = (i ? b.weight : b.seen)[within];
      }
      const int radius = (int)std::nearbyint((double)p.coc * STEPS_PER_PX);
      rays.push_back({p.row, p.column, radius, p.coc});
      for (int c = 0; c < channels; c++) {
        const float excess = light[c * step] * share;
        light[c * step] -= excess;
        ray_light.push_back(excess * weight);
      }
    }
  }
  for (const Ray &ray : rays) radii.push_back(ray.radius);
  std::sort(radii.begin(), radii.end());
  radii.erase(std::unique(radii.begin(), radii.end()), radii.end());
  for (Ray &ray : rays) ray.radius = (int)(std::lower_bound(radii.begin(), radii.end(), ray.radius) - radii.begin());
}

// The surfaces that pixels show, own and other, in a row from column x on within one block column, with the part of a
// pixel that each covers; what is hidden covers nothing.
template <typename Body>
static void each_shown(const Surfaces &surfaces, int y, int x, const float **light, const Body &body) {
  const int own = surfaces.whole() ? 1 : 0;  // before a known background the other surface comes first
  const float *coc, *weight;
  for (int i : {own, 1 - own}) {
    if (!surfaces.row(i, y, x, light, coc, weight)) continue;
    const float least = i == own ? 0.0f : HIDDEN_WEIGHT;
    body(coc, [=](int j) { return weight ? std::max(weight[j] - least, 0.0f) : 1.0f; });
  }
}

Visibility look_at(const Job &job) {
  Visibility v;
  const int H = job.height, W = job.width;
  float low = NEVER, high = -NEVER;
  for (int i = 0; i < job.surfaces.block_rows * job.surfaces.block_columns; i++) {
    low = std::min(low, job.block_low[i]);
    high = std::max(high, job.block_high[i]);
  }
  v.low = low;
  const int bins = (int)(high - low) + 2;
  std::vector<uint8_t> present(bins + 1, 0);
  v.class_width = std::max(1.0f, bins / (float)CLASSES);
  v.cell_rows = ceil_div(H, CELL);
  v.cell_columns = ceil_div(W, CELL);
  v.cells.assign((size_t)v.cell_rows * v.cell_columns, 0);
  std::vector<uint8_t> floors((size_t)v.cell_rows * bins);
  job.parallel(v.cell_rows, [&](int row, int) {
    uint8_t *here = floors.data() + (size_t)row * bins;
    std::vector<const float *> light(job.channels);
    for (int y = row * CELL; y < std::min(H, (row + 1) * CELL); y++)
      for (int x = 0; x < W; x += BLOCK)
        each_shown(job.surfaces, y, x, light.data(), [&](const float *coc, auto cover) {
          for (int j = 0; j < std::min(BLOCK, W - x); j++) {
            if (!(cover(j) > 0)) continue;
            const float place = clamp(coc[j] - low, 0.0f, high - low);
            here[(int)place] = 1;
            v.cells[(size_t)row * v.cell_columns + (x + j) / CELL] |= 1ull << std::min((int)(place / v.class_width), CLASSES - 1);
          }
        });
  });
  for (size_t i = 0; i < floors.size(); i++)
    if (floors[i]) present[i % bins] = present[i % bins + 1] = 1;
  for (int k = 0; k <= bins; k++)
    if (present[k]) v.bins.push_back(k);
  return v;
}

// How much of the pixels first to last of a row the surfaces at a place cover.
static void cover_row(const Job &job, int y, int first, int last, float place, const float **light, float *covered) {
  for (int x = first; x <= last;) {
    const int n = std::min(last + 1, (x / BLOCK + 1) * BLOCK) - x;
    float *to = covered + (x - first);
    for (int j = 0; j < n; j++) to[j] = 0;
    each_shown(job.surfaces, y, x, light, [&](const float *coc, auto cover) {
      for (int j = 0; j < n; j++) to[j] += std::max(1.0f - std::fabs(coc[j] - place), 0.0f) * cover(j);
    });
    x += n;
  }
}

// Adds how much of the rays of a row that land n pixels from column x on is taken by surfaces at a place.
static void add_blocked(const Job &job, const Ray &ray, float place, int y, int x, int n, const float **light, float *blocked) {
  constexpr int LONGEST = 256;
  const int H = job.height, W = job.width;
  const float along = 1.0f - place / ray.coc;
  const float at_y = clamp(ray.row + (y - ray.row) * along, 0.0f, H - 1.0f);
  const int row = std::min((int)at_y, std::max(0, H - 2)), below = H > 1 ? row + 1 : row;
  const float down = at_y - row;
  auto column_of = [&](int i) { return clamp(ray.column + (x + i - ray.column) * along, 0.0f, W - 1.0f); };
  float upper[LONGEST], lower[LONGEST];
  for (int i = 0; i < n;) {  // as many rays as meet a bounded number of columns
    const float start = column_of(i);
    int stop = i + 1;
    while (stop < n && std::fabs(column_of(stop) - start) < LONGEST - 3) stop++;
    const float ends[2] = {start, column_of(stop - 1)};
    const int first = (int)std::min(ends[0], ends[1]), last = std::min((int)std::max(ends[0], ends[1]) + 1, W - 1);
    cover_row(job, row, first, last, place, light, upper);
    cover_row(job, below, first, last, place, light, lower);
    for (int k = 0; k <= last - first; k++) upper[k] += down * (lower[k] - upper[k]);
    upper[last - first + 1] = upper[last - first];
    for (; i < stop; i++) {
      const float at_x = column_of(i);
      const int column = (int)at_x;
      const float across = at_x - column, a = upper[column - first], b = upper[column - first + 1];
      blocked[i] += a + across * (b - a);
    }
  }
}

void splat(const Job &job, const Visibility &v, int y0, int x0, const int *rays, int count, const float *const *kernels,
           const int32_t *halves, float *tile) {
  const int H = job.height, W = job.width, C = job.channels, E = job.colours;
  std::vector<int> nearer(v.bins.size());
  std::vector<const float *> surface_light(C);
  for (int r = 0; r < count; r++) {
    const Ray &ray = job.rays[rays[r]];
    const float *light = job.ray_light.data() + (size_t)rays[r] * C;
    const int half = halves[ray.radius], side = 2 * half + 1;
    const float *kernel = kernels[ray.radius];
    // the part of the tile in which its rays land
    const int top = std::max(y0, ray.row - half), bottom = std::min(std::min(y0 + TILE, H), ray.row + half + 1);
    const int left = std::max(x0, ray.column - half), right = std::min(std::min(x0 + TILE, W), ray.column + half + 1);
    for (int py = top; py < bottom; py += PATCH)
      for (int px = left; px < right; px += PATCH) {
        const int ny = std::min(PATCH, bottom - py), nx = std::min(PATCH, right - px);
        int m = 0;
        if (job.scene.occlusion)
          for (int k : v.bins) {
            if (!(ray.coc - NEARER_PX >= v.low + k)) break;
            // a ray that lands so many pixels away met the surface at this share of them
            const float along = 1.0f - (v.low + k) / ray.coc;
            const float ya = ray.row + (py - ray.row) * along, yb = ray.row + (py + ny - 1 - ray.row) * along;
            const float xa = ray.column + (px - ray.column) * along, xb = ray.column + (px + nx - 1 - ray.column) * along;
            auto cell = [](float at, int size) { return (int)clamp(at, 0.0f, size - 1.0f) / CELL; };
            const int r0 = cell(std::floor(std::min(ya, yb)), H), r1 = cell(std::max(ya, yb) + 1, H);
            const int c0 = cell(std::floor(std::min(xa, xb)), W), c1 = cell(std::max(xa, xb) + 1, W);
            uint64_t classes = 0;
            for (int i = r0; i <= r1; i++)
              for (int j = c0; j <= c1; j++) classes |= v.cells[(size_t)i * v.cell_columns + j];
            const int first = std::min((int)(std::max(0, k - 1) / v.class_width), CLASSES - 1);
            const int last = std::min((int)((k + 1) / v.class_width), CLASSES - 1);
            if (classes & ((2ull << last) - (1ull << first))) nearer[m++] = k;
          }
        for (int y = py; y < py + ny; y++) {
          const size_t tap = (size_t)(y - ray.row + half) * side + (px - ray.column + half);
          float blocked[PATCH] = {};
          for (int i = 0; i < m; i++) add_blocked(job, ray, v.low + nearer[i], y, px, nx, surface_light.data(), blocked);
          for (int c = 0; c < C; c++) {
            const float *taps = kernel + (E > 1 ? (size_t)c * side * side : 0) + tap;
            float *to = tile + (size_t)c * TILE * TILE + (y - y0) * TILE + (px - x0);
            for (int x = 0; x < nx; x++) to[x] += taps[x] * (1.0f - std::min(blocked[x], 1.0f)) * light[c];
          }
        }
      }
  }
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
