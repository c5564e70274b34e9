// The surfaces behind each pixel, read from the levels of a pyramid, forward and backward: the functions shown_behind and
// search of render/disocclusion.py, for training. Inference fills hidden surfaces in disocclusion.cpp.
//
// For a pixel with coc c, and the four samples j of level l around it with coc d, weight w and bilinear weight s:
//
//   e = c + max(OWN_SLOPE |c| - BEHIND_PX, 0)           largest coc of the pixel's own surface
//   p_j = s w clamp(d - e - BEHIND_PX + 1/2, 0, 1)      part of a sample that lies behind it
//   m_l = sum p_j sample_j / sum p_j                    light and coc of the level
//   v_l = clamp(|c| / least_l - 1, 0, 1) min(slope_l sum p_j, most_l)   its votes
//
// The result is sum v_l m_l / sum v_l, and sum v_l.
#include "engine.h"

namespace torchdof {
namespace {

constexpr float LEAST_VOTE = 1e-9f;  // smallest divisor
constexpr int BAND = 32;  // rows of pixels whose gradients one thread adds up; at least twice the step of a level
constexpr int MOST_LEVELS = TORCHDOF_MOST_LEVELS, MOST_PLANES = TORCHDOF_MOST_PLANES + 2;

// The samples before and after each pixel of an axis, and the weight of the one after.
struct Axis {
  std::vector<int> before;
  std::vector<float> part;
  Axis(int length, int samples, int step, int whole) {
    const float last = (float)whole / step - 1.0f;
    for (int i = 0; i < length; i++) {
      const float place = std::min(std::max((i - 0.5f * (length - 1) + 0.5f * whole) / step - 0.5f, 0.0f), last);
      before.push_back(std::min((int)place, samples - 2));
      part.push_back(place - before.back());
    }
  }
};

struct Behind {
  const torchdof_level *levels;
  int count, planes, height, width;  // planes: light, coc, weight
  std::vector<Axis> rows, columns;

  Behind(const torchdof_level *levels, int count, int channels, int height, int width)
      : levels(levels), count(count), planes(channels + 2), height(height), width(width) {
    for (int l = 0; l < count; l++) {
      rows.emplace_back(height, levels[l].rows, levels[l].step, levels[0].rows * levels[0].step);
      columns.emplace_back(width, levels[l].columns, levels[l].step, levels[0].columns * levels[0].step);
    }
  }

  // Values of a pixel in a level.
  struct Found {
    size_t at[4];                   // of the samples
    float share[4], is_behind[4], part[4];  // is_behind: not clamped
    float weight, looked;           // sum of the parts, or 0 if tiny; clamped blur
    float mean[MOST_PLANES];        // light and coc
    float vote;
  };
  // Returns false if nothing lies behind the pixel in this level.
  bool find(int l, int y, int x, float coc, Found &f) const {
    const torchdof_level &level = levels[l];
    const float blur = std::fabs(coc) / level.least_px - 1.0f;
    f.looked = clamp01(blur);
    f.vote = 0;
    if (!(blur >= 0)) return false;
    const size_t size = (size_t)level.rows * level.columns;
    const float *const cocs = level.values + (planes - 2) * size, *const weights = cocs + size;
    const int row = rows[l].before[y], column = columns[l].before[x];
    const float down = rows[l].part[y], aside = columns[l].part[x];
    const float end = end_of_surface(coc);
    bool any = false;
    for (int j = 0; j < 4; j++) {
      f.at[j] = (size_t)(row + j / 2) * level.columns + column + j % 2;
      f.is_behind[j] = cocs[f.at[j]] - end - (BEHIND_PX - 0.5f);
      any |= f.is_behind[j] >= 0;
    }
    if (!any) return false;
    float total = 0;
    for (int j = 0; j < 4; j++) {
      f.share[j] = (j / 2 ? down : 1.0f - down) * (j % 2 ? aside : 1.0f - aside);
      f.part[j] = f.share[j] * weights[f.at[j]] * clamp01(f.is_behind[j]);
      total += f.part[j];
    }
    f.weight = total > LEAST_SEEN ? total : 0.0f;
    const float per = 1.0f / std::max(f.weight, LEAST_SEEN);
    for (int c = 0; c < planes - 1; c++) {
      float sum = 0;
      for (int j = 0; j < 4; j++) sum += f.part[j] * level.values[c * size + f.at[j]];
      f.mean[c] = sum * per;
    }
    f.vote = f.looked * std::min(f.weight * level.slope, level.most);
    return true;
  }

  void look(const float *coc, int threads, float *out) const {
    const size_t area = (size_t)height * width;
    torchdof::parallel(threads, height, nullptr, [&](int y, int) {
      for (int x = 0; x < width; x++) {
        const size_t at = (size_t)y * width + x;
        float sums[MOST_PLANES] = {}, votes = 0;
        for (int l = 0; l < count; l++) {
          Found f;
          if (!find(l, y, x, coc[at], f)) continue;
          votes += f.vote;
          for (int c = 0; c < planes - 1; c++) sums[c] += f.vote * f.mean[c];
        }
        const float per = 1.0f / std::max(votes, LEAST_VOTE);
        for (int c = 0; c < planes - 1; c++) out[c * area + at] = sums[c] * per;
        out[(planes - 1) * area + at] = votes;
      }
    });
  }

  void gradient(const float *coc, const float *slopes, int threads, float *const *of_levels, float *of_coc) const {
    for (int odd : {0, 1})  // two bands with one between them read different samples
      torchdof::parallel(threads, ceil_div(height, 2 * BAND), nullptr, [&](int i, int) {
        for (int y = (2 * i + odd) * BAND; y < std::min((2 * i + odd + 1) * BAND, height); y++)
          for (int x = 0; x < width; x++) pixel(y, x, coc, slopes, of_levels, of_coc);
      });
  }

  // Adds a pixel's gradients to those of the samples that it reads, and sets that of its coc.
  void pixel(int y, int x, const float *coc, const float *slopes, float *const *of_levels, float *of_coc) const {
    const size_t area = (size_t)height * width, at = (size_t)y * width + x;
    of_coc[at] = 0;
    bool used = false;  // pixels without a hidden surface have no gradient
    for (int c = 0; c < planes; c++) used |= slopes[c * area + at] != 0;
    if (!used) return;
    Found found[MOST_LEVELS];
    bool any[MOST_LEVELS];
    float sums[MOST_PLANES] = {}, votes = 0, slope[MOST_PLANES], along = 0, of_own = 0;
    for (int l = 0; l < count; l++) {
      any[l] = find(l, y, x, coc[at], found[l]);
      votes += found[l].vote;
      for (int c = 0; any[l] && c < planes - 1; c++) sums[c] += found[l].vote * found[l].mean[c];
    }
    const float per = 1.0f / std::max(votes, LEAST_VOTE);
    const float slope_of_end = OWN_SLOPE * std::fabs(coc[at]) >= BEHIND_PX ? 1.0f + (coc[at] < 0 ? -OWN_SLOPE : OWN_SLOPE) : 1.0f;
    for (int c = 0; c < planes - 1; c++) {
      slope[c] = slopes[c * area + at] * per;
      along += slope[c] * sums[c] * per;
    }
    if (votes < LEAST_VOTE) along = 0;
    for (int l = 0; l < count; l++) {
      if (!any[l]) continue;
      const torchdof_level &level = levels[l];
      const Found &f = found[l];
      const size_t size = (size_t)level.rows * level.columns;
      float of_vote = slopes[(planes - 1) * area + at] - along, of_parts = 0;
      for (int c = 0; c < planes - 1; c++) of_vote += slope[c] * f.mean[c];
      const float counted = f.weight * level.slope, bounded = std::min(counted, level.most);
      const float blur = std::fabs(coc[at]) / level.least_px - 1.0f;
      if (blur <= 1) of_own += of_vote * bounded / level.least_px * (coc[at] < 0 ? -1.0f : 1.0f);
      if (f.weight > 0) {
        if (counted <= level.most) of_parts = of_vote * f.looked * level.slope * (counted == level.most ? 0.5f : 1.0f);
        for (int c = 0; c < planes - 1; c++) of_parts -= slope[c] * f.vote * f.mean[c] / f.weight;
      }
      const float per_weight = 1.0f / std::max(f.weight, LEAST_SEEN);
      for (int j = 0; j < 4; j++) {
        const float *value = level.values + f.at[j];
        float *const of_value = of_levels[l] + f.at[j];
        float of_part = of_parts;
        for (int c = 0; c < planes - 1; c++) {
          const float of_mean = slope[c] * f.vote * per_weight;
          of_part += of_mean * value[c * size];
          of_value[c * size] += of_mean * f.part[j];
        }
        of_value[(planes - 1) * size] += of_part * f.share[j] * clamp01(f.is_behind[j]);
        if (f.is_behind[j] < 0 || f.is_behind[j] > 1) continue;
        const float of_distance = of_part * f.share[j] * value[(planes - 1) * size];
        of_value[(planes - 2) * size] += of_distance;
        of_own -= of_distance * slope_of_end;
      }
    }
    of_coc[at] = of_own;
  }
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_look_behind(const torchdof_level *levels, int32_t count, int32_t channels, const float *coc, int32_t height, int32_t width,
                             int32_t threads, float *out, const float *gradient, float *const *of_levels, float *of_coc) {
  return torchdof::guarded([&] {
    const torchdof::Behind behind(levels, count, channels, height, width);
    gradient ? behind.gradient(coc, gradient, threads, of_levels, of_coc) : behind.look(coc, threads, out);
  });
}
