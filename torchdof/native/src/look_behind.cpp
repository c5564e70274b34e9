// The surfaces behind each pixel, read from the levels of a pyramid, forward and backward: the functions shown_behind
// and search of render/surfaces/disocclusion.py, for training. Inference fills hidden surfaces in disocclusion.cpp.
//
// For a pixel with coc c, and the four samples j of level l around it with coc d, weight w and bilinear weight s:
//
//   e = c + max(OWN_SLOPE |c| - BEHIND_PX, 0)           largest coc of the pixel's own surface
//   p_j = s w clamp(d - e - BEHIND_PX + 1/2, 0, 1)      part of a sample that lies behind it
//   m_l = sum p_j sample_j / sum p_j                    light and coc of the level
//   v_l = clamp(|c| / least_l - 1, 0, 1) min(slope_l sum p_j, most_l)   its votes
//
// The result is sum v_l m_l / sum v_l, and sum v_l.
//
// A cell of BEHIND_STEP x BEHIND_STEP pixels has the smallest coc of its pixels. Its first result is the farthest
// surface of all levels: of two levels with different surfaces, only the farther one counts. Its second result is the
// one above, of the coarse levels alone.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "api.h"
#include "blocks.h"
#include "constants/native.h"
#include "disocclusion.h"
#include "entry.h"
#include "rules.h"
#include "threads.h"

namespace torchdof {
namespace {

using constants::native::MOST_PLANES;
constexpr int BAND = 32;  // least rows of places whose gradients one thread adds up

// Places of an axis, pixels or cells, `step` pixels apart and centred on an image; and the pixels of each place, as
// _window of render/surfaces/disocclusion.py: on an axis of even size a cell's last pixel repeats the one before.
struct Axis {
  const int step, count, taps;
  std::vector<int> pixels;  // [count, taps]
  Axis(int size, int step, int count) : step(step), count(count), taps(step > 1 ? step + 1 : 1) {
    for (int i = 0; i < count * taps; i++) {
      const int twice = size - 1 + step * (2 * (i / taps) + 1 - count), last = floor_div(twice + step, 2);
      pixels.push_back(std::clamp(std::min(floor_div(twice - step + 1, 2) + i % taps, last), 0, size - 1));
    }
  }
};

// The samples of a level before and after each place of an axis, and the weight of the one after.
struct Between {
  std::vector<int> before;
  std::vector<float> part;
  Between(const Axis &axis, int samples, int step) {
    for (int i = 0; i < axis.count; i++) {
      const float middle = (i - 0.5f * (axis.count - 1)) * axis.step + 0.5f * samples * step;
      const float place = std::clamp(middle / step - 0.5f, 0.0f, samples - 1.0f);
      before.push_back(std::min((int)place, samples - 2));
      part.push_back(place - before.back());
    }
  }
};

template <int CHANNELS>
struct Behind {
  static constexpr int MOST_VALUES = (CHANNELS ? CHANNELS : MOST_PLANES) + 2;
  const torchdof_level *const levels;
  const float *const coc, *wanted;          // wanted: null if the places are pixels
  const int count, channels, width, first;  // first: level of the mean
  const Axis down, across;
  std::vector<Between> rows, columns;
  const size_t area;

  Behind(const torchdof_level *levels, int count, int channels, const float *coc, const float *wanted, int height,
         int width)
      : levels(levels), coc(coc), wanted(wanted), count(count), channels(channels), width(width),
        first(wanted ? FINE_LEVELS : 0),
        down(height, wanted ? BEHIND_STEP : 1, wanted ? levels->rows * levels->step / BEHIND_STEP : height),
        across(width, wanted ? BEHIND_STEP : 1, wanted ? levels->columns * levels->step / BEHIND_STEP : width),
        area((size_t)down.count * across.count) {
    for (int l = 0; l < count; l++) {
      rows.emplace_back(down, levels[l].rows, levels[l].step);
      columns.emplace_back(across, levels[l].columns, levels[l].step);
    }
  }

  int planes() const { return (CHANNELS ? CHANNELS : channels) + 2; }  // light, coc, weight
  int outputs() const { return (wanted ? planes() : 0) + (first < count ? planes() : 0); }
  // Calls use(index of a pixel, column of the tap) for the pixels of a place.
  template <typename Use>
  void each_pixel(int y, int x, const Use &use) const {
    for (int j = 0; j < across.taps; j++)
      for (int i = 0; i < down.taps; i++)
        use((size_t)down.pixels[y * down.taps + i] * width + across.pixels[x * across.taps + j], j);
  }
  // Smallest coc of a place; 0, with which no level is read, if none of its pixels is wanted.
  float nearest(int y, int x) const {
    float least = INFINITY;
    bool any = !wanted;
    each_pixel(y, x, [&](size_t at, int) {
      least = std::min(least, coc[at]);
      any = any || wanted[at] > 0;
    });
    return any ? least : 0.0f;
  }

  // Values of a place in a level.
  struct Found {
    bool any;      // false if nothing lies behind the place in this level, which then has no votes
    size_t at[4];  // of the samples
    float share[4], is_behind[4], part[4];  // is_behind: not clamped
    float weight, looked;                   // sum of the parts, or 0 if tiny; clamped blur
    float mean[MOST_VALUES];                // light and coc
    float vote;
    float d_mean[MOST_VALUES], d_vote, d_sure;  // gradients; d_sure: that of looked * weight / SURE up to 1
  };
  struct Result {
    float values[MOST_VALUES], votes;  // values: light and coc
  };
  // Returns false if nothing lies behind the place in this level.
  bool find(int l, int y, int x, float coc, Found &f) const {
    const torchdof_level &level = levels[l];
    const float blur = unlimited_read(std::fabs(coc), level.least_px);
    f.looked = clamp01(blur);
    f.vote = 0;
    if (!(blur >= 0)) return false;
    const size_t size = (size_t)level.rows * level.columns;
    const float *const cocs = level.values + (planes() - 2) * size, *const weights = cocs + size;
    const int row = rows[l].before[y], column = columns[l].before[x];
    const float below = rows[l].part[y], aside = columns[l].part[x];
    const float end = own_end(coc);
    bool any = false;
    for (int j = 0; j < 4; j++) {
      f.at[j] = (size_t)(row + j / 2) * level.columns + column + j % 2;
      f.is_behind[j] = unlimited_another_surface(cocs[f.at[j]] - end);
      any |= f.is_behind[j] >= 0;
    }
    if (!any) return false;
    float total = 0;
    for (int j = 0; j < 4; j++) {
      f.share[j] = (j / 2 ? below : 1.0f - below) * (j % 2 ? aside : 1.0f - aside);
      f.part[j] = f.share[j] * weights[f.at[j]] * clamp01(f.is_behind[j]);
      total += f.part[j];
    }
    f.weight = total > LEAST_SEEN ? total : 0.0f;
    const float per = 1.0f / std::max(f.weight, LEAST_SEEN);
    for (int c = 0; c < planes() - 1; c++) {
      float sum = 0;
      for (int j = 0; j < 4; j++) sum += f.part[j] * level.values[c * size + f.at[j]];
      f.mean[c] = sum * per;
    }
    f.vote = f.looked * std::min(f.weight * level.slope, level.most);
    return true;
  }

  bool find_all(int y, int x, float coc, Found *found) const {
    bool any = false;
    for (int l = 0; l < count; l++) any |= found[l].any = find(l, y, x, coc, found[l]);
    return any;
  }

  // Mean of the levels from the first on, weighted by their votes.
  Result mean(const Found *found) const {
    Result r = {};
    for (int l = first; l < count; l++) {
      if (!found[l].any) continue;
      r.votes += found[l].vote;
      for (int c = 0; c < planes() - 1; c++) r.values[c] += found[l].vote * found[l].mean[c];
    }
    for (int c = 0; c < planes() - 1; c++) r.values[c] *= 1.0f / std::max(r.votes, LEAST_TOTAL);
    return r;
  }
  void back_of_mean(const float *slopes, Found *found) const {
    const Result r = mean(found);
    const float per = 1.0f / std::max(r.votes, LEAST_TOTAL);
    float slope[MOST_VALUES], along = 0;
    for (int c = 0; c < planes() - 1; c++) {
      slope[c] = slopes[c * area] * per;
      along += slope[c] * r.values[c];
    }
    if (r.votes < LEAST_TOTAL) along = 0;
    for (int l = first; l < count; l++) {
      Found &f = found[l];
      if (!f.any) continue;
      f.d_vote += slopes[(planes() - 1) * area] - along;
      for (int c = 0; c < planes() - 1; c++) {
        f.d_vote += slope[c] * f.mean[c];
        f.d_mean[c] += slope[c] * f.vote;
      }
    }
  }

  // How a level changes the farthest surface of the levels before it, whose votes are `votes`.
  struct Change {
    float apart, nearer, sure, vote, left, votes, part;  // left: share of the votes before that stays
    Change(const Found &f, const Result &r, int coc_plane) : apart(f.mean[coc_plane] - r.values[coc_plane]) {
      nearer = r.votes > 0 ? is_another_surface(-apart) : 0.0f;
      sure = std::min(f.looked * f.weight / SURE, 1.0f);
      vote = f.vote * (1.0f - nearer);
      left = 1.0f - sure * is_another_surface(apart);
      votes = r.votes * left + vote;
      part = vote / std::max(votes, LEAST_TOTAL);
    }
  };
  // The farthest surface; before: the one without each level and those after it.
  Result farthest(const Found *found, Result *before) const {
    Result r = {};
    for (int l = 0; l < count; l++) {
      before[l] = r;
      if (!found[l].any) continue;
      const Change change(found[l], r, planes() - 2);
      for (int c = 0; c < planes() - 1; c++) r.values[c] += (found[l].mean[c] - r.values[c]) * change.part;
      r.votes = change.votes;
    }
    return r;
  }
  void back_of_farthest(const float *slopes, Found *found) const {
    Result before[MOST_LEVELS], d;
    farthest(found, before);
    for (int c = 0; c < planes() - 1; c++) d.values[c] = slopes[c * area];
    d.votes = slopes[(planes() - 1) * area];
    const auto slopes_up = [](float distance) { return within(unlimited_another_surface(distance)); };
    for (int l = count - 1; l >= 0; l--) {
      Found &f = found[l];
      if (!f.any) continue;
      const Change change(f, before[l], planes() - 2);
      float d_part = 0;
      for (int c = 0; c < planes() - 1; c++) {
        d_part += d.values[c] * (f.mean[c] - before[l].values[c]);
        f.d_mean[c] += d.values[c] * change.part;
        d.values[c] -= d.values[c] * change.part;
      }
      d_part /= std::max(change.votes, LEAST_TOTAL);
      if (change.votes >= LEAST_TOTAL) d.votes -= d_part * change.part;
      const float d_vote = d.votes + d_part, d_left = d.votes * before[l].votes;
      f.d_vote += d_vote * (1.0f - change.nearer);
      f.d_sure -= d_left * is_another_surface(change.apart);
      float d_apart = 0;
      if (slopes_up(change.apart)) d_apart -= d_left * change.sure;
      if (before[l].votes > 0 && slopes_up(-change.apart)) d_apart += d_vote * f.vote;
      f.d_mean[planes() - 2] += d_apart;
      d.values[planes() - 2] -= d_apart;
      d.votes *= change.left;
    }
  }

  void look(int threads, float *out) const {
    torchdof::parallel(threads, down.count, nullptr, [&](int y, int) {
      for (int x = 0; x < across.count; x++) {
        Found found[MOST_LEVELS];
        Result before[MOST_LEVELS];
        float *to = out + (size_t)y * across.count + x;
        if (!find_all(y, x, nearest(y, x), found)) {
          for (int c = 0; c < outputs(); c++) to[c * area] = 0;
          continue;
        }
        const auto put = [&](const Result &r) {
          for (int c = 0; c < planes(); c++, to += area) *to = c < planes() - 1 ? r.values[c] : r.votes;
        };
        if (wanted) put(farthest(found, before));
        if (first < count) put(mean(found));
      }
    });
  }

  void gradient(const float *slopes, int threads, float *const *d_levels, float *d_coc) const {
    // two bands with one between them read different samples: a place reads those up to 2.5 steps away
    const int band = std::max(BAND, 3 * levels[count - 1].step / down.step);
    for (int odd : {0, 1})
      torchdof::parallel(threads, ceil_div(down.count, 2 * band), nullptr, [&](int i, int) {
        for (int y = (2 * i + odd) * band; y < std::min((2 * i + odd + 1) * band, down.count); y++)
          for (int x = 0; x < across.count; x++) place(y, x, slopes, d_levels, d_coc);
      });
  }

  // Adds a place's gradients to those of the samples and pixels that it reads.
  void place(int y, int x, const float *slopes, float *const *d_levels, float *d_coc) const {
    slopes += (size_t)y * across.count + x;
    bool used = false;  // places without a hidden surface have no gradient
    for (int c = 0; c < outputs(); c++) used |= slopes[c * area] != 0;
    Found found[MOST_LEVELS];
    const float least = used ? nearest(y, x) : 0.0f;
    if (!find_all(y, x, least, found)) return;
    for (int l = 0; l < count; l++) {
      found[l].d_vote = found[l].d_sure = 0;
      std::fill(found[l].d_mean, found[l].d_mean + planes(), 0.0f);
    }
    if (wanted) back_of_farthest(slopes, found);
    if (first < count) back_of_mean(slopes + (wanted ? planes() * area : 0), found);
    float d_least = 0;
    for (int l = 0; l < count; l++) {
      const torchdof_level &level = levels[l];
      const Found &f = found[l];
      if (!f.any) continue;
      const size_t size = (size_t)level.rows * level.columns;
      const float counted = f.weight * level.slope, bounded = std::min(counted, level.most);
      const float blur = unlimited_read(std::fabs(least), level.least_px),
                  d_sure = f.looked * f.weight <= SURE ? f.d_sure / SURE : 0.0f;
      if (blur <= 1) d_least += (f.d_vote * bounded + d_sure * f.weight) / level.least_px * (least < 0 ? -1.0f : 1.0f);
      float d_parts = 0;
      if (f.weight > 0) {
        d_parts = d_sure * f.looked;
        if (counted <= level.most) d_parts += f.d_vote * f.looked * level.slope * (counted == level.most ? 0.5f : 1.0f);
      }
      const float per_weight = 1.0f / std::max(f.weight, LEAST_SEEN);
      for (int j = 0; j < 4; j++) {
        const float *value = level.values + f.at[j];
        float *const d_value = d_levels[l] + f.at[j];
        float d_part = d_parts;
        for (int c = 0; c < planes() - 1; c++) {
          const float d_mean = f.d_mean[c] * per_weight;
          d_part += d_mean * (value[c * size] - f.mean[c]);
          d_value[c * size] += d_mean * f.part[j];
        }
        d_value[(planes() - 1) * size] += d_part * f.share[j] * clamp01(f.is_behind[j]);
        if (!within(f.is_behind[j])) continue;
        const float d_distance = d_part * f.share[j] * value[(planes() - 1) * size];
        d_value[(planes() - 2) * size] += d_distance;
        d_least -= d_distance * slope_of_own_end(least);
      }
    }
    // the gradient of equal coc is shared by columns, then by rows
    int ties[BEHIND_STEP + 1] = {}, tied = 0;
    each_pixel(y, x, [&](size_t at, int j) { ties[j] += coc[at] == least; });
    for (int n : ties) tied += n > 0;
    each_pixel(y, x, [&](size_t at, int j) {
      if (coc[at] == least) d_coc[at] += d_least / (tied * ties[j]);
    });
  }
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_look_behind(const torchdof_level *levels, int32_t count, int32_t channels, const float *coc,
                             const float *wanted, int32_t height, int32_t width, int32_t threads, float *out,
                             const float *gradient, float *const *d_levels, float *d_coc) {
  return torchdof::guarded([&] {
    const auto run = [&](const auto &behind) {
      gradient ? behind.gradient(gradient, threads, d_levels, d_coc) : behind.look(threads, out);
    };
    if (channels == 4)  // light and blur
      run(torchdof::Behind<4>(levels, count, channels, coc, wanted, height, width));
    else
      run(torchdof::Behind<0>(levels, count, channels, coc, wanted, height, width));
  });
}
