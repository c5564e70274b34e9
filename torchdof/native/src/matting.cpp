// Matting: a pixel at a depth edge mixes the light of two surfaces but has the depth of one. Splits it into both, as
// described in render/surfaces/matting.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

#include "api.h"
#include "blocks.h"
#include "blur_axis.h"
#include "constants/matting.h"
#include "constants/pipeline.h"
#include "emitters.h"
#include "entry.h"
#include "extremes.h"
#include "highlights.h"
#include "job.h"
#include "light.h"
#include "mixed_pixel.h"
#include "rules.h"
#include "simd.h"
#include "surfaces.h"
#include "threads.h"

namespace torchdof {
namespace {

// Constants of matting.py and pipeline.py in render, which give their meanings, units and effects.
using namespace constants::matting;
using constants::pipeline::SAME_PX;

// Windows around the pixels of a block
constexpr int REACH = 1;  // pixels around a mixed pixel that define its two colours
constexpr int AROUND = 2 * REACH + 1;
constexpr int TAPS = AROUND * AROUND;
constexpr int RIM = REACH + 1;            // a neighbour's clean light depends on the pixels next to it
constexpr int MARGIN = RIM + 1;           // edges depend on the pixels next to them
constexpr int SIDE = BLOCK + 2 * MARGIN;  // of the window of coc
constexpr int EDGES = BLOCK + 2 * RIM;    // of the windows of edges and light
constexpr int PITCH = 24;                 // of all

// How clearly two cocs around a pixel are those of two surfaces: none from 0 down, in full from 1 on.
vec edge_of(vec near, vec far) { return apart_px(near, far) * (1.0f / EDGE_PX) - 1.0f; }

// Falloff of the Gaussian by which two surfaces mix, beside its centre.
constexpr float SOFTNESS_DIAGONAL = SOFTNESS_FALLOFF * SOFTNESS_FALLOFF;

// An image whose mixed pixels are split.
struct Frame {
  int height, width, channels;
  const float *light, *coc, *valid;  // valid: or null
  const float *darkest, *brightest;  // range of the light of each channel

  size_t area() const { return (size_t)height * width; }
  size_t pixel(int y, int x) const { return (size_t)y * width + x; }  // its index in a plane
};

struct Window {
  explicit Window(int channels)
      : light((size_t)channels * EDGES * PITCH + LANES), clean(light), around((size_t)channels * (4 * TAPS + 9)) {}

  float coc[SIDE * PITCH + LANES] = {}, valid[SIDE * PITCH + LANES] = {}, edge[EDGES * PITCH + LANES] = {};
  std::vector<float> light;  // [channels, EDGES, PITCH]
  std::vector<float> clean;  // the same, without the light of other surfaces
  std::vector<vec> around;   // memory of Split
};

// Gradients by the values of a window, by the range of the image's light, and by the surfaces of the window's block.
struct Slopes {
  explicit Slopes(int channels)
      : light((size_t)channels * EDGES * PITCH + LANES), clean(light), darkest(channels), brightest(channels),
        surfaces((size_t)(2 * channels + 2) * BLOCK * PITCH + LANES) {}

  float coc[SIDE * PITCH + LANES] = {}, edge[EDGES * PITCH + LANES] = {};
  std::vector<float> light, clean;
  std::vector<float> darkest, brightest;  // [channels]
  std::vector<float> surfaces;            // of own and other light, coc and weight, [2 channels + 2, BLOCK, PITCH]
};

// Copies `size` rows and columns of a plane from y0, x0; a pixel outside the frame is the nearest one inside.
void read_window(const Frame &frame, const float *plane, int y0, int x0, int size, float *to) {
  const bool inside = x0 >= 0 && x0 + size <= frame.width;
  for (int i = 0; i < size; i++, to += PITCH) {
    const float *from = plane + (size_t)std::clamp(y0 + i, 0, frame.height - 1) * frame.width;
    if (inside)
      memcpy(to, from + x0, size * sizeof(float));
    else
      for (int j = 0; j < size; j++) to[j] = from[std::clamp(x0 + j, 0, frame.width - 1)];
  }
}

// For each pixel outside the frame in a window of EDGES x EDGES pixels around a block: body(its place, that of the
// nearest pixel inside).
template <typename Body>
void each_outside(const Frame &frame, int y0, int x0, const Body &body) {
  if (y0 >= RIM && x0 >= RIM && y0 + BLOCK + RIM <= frame.height && x0 + BLOCK + RIM <= frame.width) return;
  for (int i = 0; i < EDGES; i++)
    for (int j = 0; j < EDGES; j++) {
      const int y = std::clamp(y0 - RIM + i, 0, frame.height - 1), x = std::clamp(x0 - RIM + j, 0, frame.width - 1);
      const int from = i * PITCH + j, to = (y - y0 + RIM) * PITCH + x - x0 + RIM;
      if (from != to) body(from, to);
    }
}

// Computes for each pixel in and around a block the confidence, 0 to 1, that it lies at an edge. False if it is 0 in
// the whole block.
bool find_edges(const Frame &frame, int y0, int x0, Window &w) {
  const float *valid = frame.valid;
  float lows[SIDE * PITCH], highs[SIDE * PITCH];  // of valid pixels
  const float *low = valid ? lows : w.coc, *high = valid ? highs : w.coc;
  read_window(frame, frame.coc, y0 - MARGIN, x0 - MARGIN, SIDE, w.coc);
  if (valid) read_window(frame, valid, y0 - MARGIN, x0 - MARGIN, SIDE, w.valid);
  for (int i = 0; valid && i < SIDE * PITCH; i++) {
    lows[i] = w.valid[i] > 0 ? w.coc[i] : NEVER_PX;
    highs[i] = w.valid[i] > 0 ? w.coc[i] : -NEVER_PX;
  }
  for (int i = 0; i < EDGES; i++) {
    float least_of[PITCH + LANES], most_of[PITCH + LANES];
    for (int j = 0; j < PITCH; j += LANES) {
      auto row = [&](const float *values, int k) { return load<vec>(values + (i + k) * PITCH + j); };
      store(least_of + j, min(min(row(low, 0), row(low, 1)), row(low, 2)));
      store(most_of + j, max(max(row(high, 0), row(high, 1)), row(high, 2)));
    }
    for (int j = 0; j < PITCH; j += LANES) {
      auto high_of = [&](int k) { return load<vec>(most_of + j + k); };
      auto low_of = [&](int k) { return load<vec>(least_of + j + k); };
      const vec near = min(min(low_of(0), low_of(1)), low_of(2)), far = max(max(high_of(0), high_of(1)), high_of(2));
      const vec edge = clamp01(edge_of(near, far));
      store(w.edge + i * PITCH + j, valid ? edge * load<vec>(w.valid + (i + 1) * PITCH + j + 1) : edge);
    }
  }
  each_outside(frame, y0, x0, [&](int from, int to) { w.edge[from] = w.edge[to]; });
  vec most_edge = {};
  for (int i = RIM; i < RIM + BLOCK; i++)
    for (int j = RIM; j < RIM + BLOCK; j += LANES) most_edge = max(most_edge, load<vec>(w.edge + i * PITCH + j));
  return any_positive(most_edge);
}

inline int tap(int i) { return i / AROUND * PITCH + i % AROUND; }
inline vec select(ivec where, vec value) { return where ? value : vec{}; }
inline void add(float *to, vec value) { store(to, load<vec>(to) + value); }

// The nearest and farthest coc of the 3 x 3 pixels from a place of a window on.
struct Ends {
  vec near = broadcast(NEVER_PX), far = broadcast(-NEVER_PX);

  Ends(const Window &w, int at, bool masked) {
    for (int i = 0; i < TAPS; i++) {
      const vec coc = load<vec>(w.coc + at + tap(i));
      const ivec valid = masked ? load<vec>(w.valid + at + tap(i)) > vec{} : vec{} == vec{};
      near = min(near, valid ? coc : broadcast(NEVER_PX));
      far = max(far, valid ? coc : broadcast(-NEVER_PX));
    }
  }

  // Shares the gradients by both among the pixels that have these coc.
  void back(const Window &w, int at, bool masked, vec d_near, vec d_far, float *d_coc) const {
    vec nearest = {}, farthest = {};
    for (int pass = 0; pass < 2; pass++)
      for (int i = 0; i < TAPS; i++) {
        const vec coc = load<vec>(w.coc + at + tap(i));
        const vec counts = masked ? select(load<vec>(w.valid + at + tap(i)) > vec{}, broadcast(1.0f)) : broadcast(1.0f);
        const vec is_near = select(coc == near, counts), is_far = select(coc == far, counts);
        if (pass)
          add(d_coc + at + tap(i),
              d_near * is_near / max(nearest, broadcast(1.0f)) + d_far * is_far / max(farthest, broadcast(1.0f)));
        else
          nearest += is_near, farthest += is_far;
      }
  }
};

// Which of the pixels around those at `at` of a window belong to the same surface: weights and their parts.
struct SameSurface {
  vec near_by[TAPS], unmixed[TAPS], alike[TAPS], apart[TAPS], weight[TAPS], total = {};

  SameSurface(const Frame &frame, const Window &w, int at, const float *falloff) {
    const vec coc = load<vec>(w.coc + at + tap(TAPS / 2));  // the window of coc has one more pixel before
    for (int k = 0; k < TAPS; k++) {
      apart[k] = (load<vec>(w.coc + at + tap(k)) - coc) * (1.0f / EDGE_PX);
      near_by[k] = frame.valid ? falloff[k] * load<vec>(w.valid + at + tap(k)) : broadcast(falloff[k]);
      unmixed[k] = (broadcast(1.0f + UNCLEAN) - load<vec>(w.edge + at - PITCH - 1 + tap(k))) * near_by[k];
      alike[k] = 2.0f - 2.0f * abs(apart[k]);
      weight[k] = unmixed[k] * clamp01(alike[k]);
      total += weight[k];
    }
  }
};

// Replaces the light of mixed pixels by the mean of the unmixed pixels of the same surface around them. With `slopes`:
// adds the gradients by clean light to those by light, edges and coc instead.
void clean_light(const Frame &frame, int y0, int x0, Window &w, const float *falloff, Slopes *slopes = nullptr) {
  const int plane = EDGES * PITCH;
  if (slopes)
    for (int c = 0; c < frame.channels; c++)
      each_outside(frame, y0, x0, [&](int from, int to) {
        slopes->clean[c * plane + to] += slopes->clean[c * plane + from];
        slopes->clean[c * plane + from] = 0;
      });
  else
    w.clean = w.light;
  for (int i = 1; i < EDGES - 1; i++)
    for (int j = 1; j < EDGES - 1; j += LANES) {
      const int at = i * PITCH + j, first = at - PITCH - 1;
      const vec edge = load<vec>(w.edge + at);
      if (!any_of(edge > vec{})) {
        for (int c = 0; slopes && c < frame.channels; c++)
          add(&slopes->light[c * plane + at], load<vec>(&slopes->clean[c * plane + at]));
        continue;
      }
      const SameSurface same(frame, w, at, falloff);
      const vec enough = same.total - FEW_CLEAN, is_clean = edge * clamp01(enough),
                per_total = 1.0f / max(same.total, broadcast(LEAST));
      vec d_is_clean = {}, d_weight[TAPS] = {}, d_middle = {};
      for (int c = 0; c < frame.channels; c++) {
        const float *const light = &w.light[c * plane];
        vec sum = {};
        for (int k = 0; k < TAPS; k++) sum += same.weight[k] * load<vec>(light + first + tap(k));
        const vec mean = sum * per_total, here = load<vec>(light + at);
        if (!slopes) {
          store(&w.clean[c * plane + at], here + is_clean * (mean - here));
          continue;
        }
        const vec slope = load<vec>(&slopes->clean[c * plane + at]), d_mean = slope * is_clean * per_total;
        d_is_clean += slope * (mean - here);
        add(&slopes->light[c * plane + at], slope - slope * is_clean);
        for (int k = 0; k < TAPS; k++) {
          d_weight[k] += d_mean * (load<vec>(light + first + tap(k)) - mean);
          add(&slopes->light[c * plane + first + tap(k)], d_mean * same.weight[k]);
        }
      }
      if (!slopes) continue;
      add(slopes->edge + at, d_is_clean * clamp01(enough));
      for (int k = 0; k < TAPS; k++) {
        const vec slope = d_weight[k] + select(within(enough), d_is_clean * edge);
        add(slopes->edge + first + tap(k), -slope * clamp01(same.alike[k]) * same.near_by[k]);
        const vec d_apart =
            select(within(same.alike[k]), slope * same.unmixed[k] * (-2.0f / EDGE_PX)) * sign(same.apart[k]);
        add(slopes->coc + at + tap(k), d_apart);
        d_middle -= d_apart;
      }
      add(slopes->coc + at + tap(TAPS / 2), d_middle);
    }
  for (int c = 0; !slopes && c < frame.channels; c++)
    each_outside(frame, y0, x0, [&](int from, int to) { w.clean[c * plane + from] = w.clean[c * plane + to]; });
}

// Splits LANES pixels of a row.
//
// 1. The coc of both surfaces are the extremes of the 3 x 3 neighbours.
// 2. The colour of each surface is the mean of its neighbours. Their light moves towards their clean light, along the
//    line between the clean colours of both surfaces, and less where texture is strong.
// 3. mixed_pixel.h has the other steps.
template <int CHANNELS>
class Split {
 public:
  Split(const Frame &frame, Window &w, int y, int x, const float *falloff)
      : frame_(frame), w_(w), falloff_(falloff), y_(y), x_(x), first_((y + 1) * PITCH + x + 1),
        in_coc_(first_ + PITCH + 1), masked_(frame.valid), ends_(w, in_coc_, masked_) {
    vec *memory = w.around.data();
    for (vec **colours : {&light_, &clean_, &d_light_, &d_clean_}) *colours = memory, memory += C() * TAPS;
    for (vec **colours : {&near_, &far_, &own_, &clean_near_, &clean_far_, &d_near_, &d_far_, &d_own_, &d_contrast_})
      *colours = memory, memory += C();
    find_colours();
  }

  // Writes the surfaces of the pixels `beside` another surface.
  void put(const Block &block, ivec beside) const {
    const auto put = [&](float *plane, vec value) {
      float *const to = plane + y_ * BLOCK + x_;
      store(to, beside ? value : load<vec>(to));
    };
    for (int c = 0; c < C(); c++) {
      const auto moved = moved_of(c);
      put(block.own + c * BLOCK_PIXELS, mixed_.own_light(moved) * scale_);
      put(block.other + c * BLOCK_PIXELS, mixed_.other_light(moved) * scale_);
    }
    const vec valid = valid_[TAPS / 2];
    put(block.coc, mixed_.by_owner(ends_.far, ends_.near));
    put(block.weight, mixed_.weight * valid);
    put(block.own_weight, (1.0f - mixed_.weight) * valid);
  }

  // Adds the gradients by the surfaces of these pixels to those by the window.
  void back(Slopes &slopes, ivec beside) {
    std::fill(d_light_, d_light_ + 2 * C() * TAPS, vec{});
    std::fill(d_near_, d_near_ + 4 * C(), vec{});
    back_of_surfaces(slopes, beside);
    back_of_colours(slopes);
  }

 private:
  using Mixed = MixedPixel<vec, CHANNELS>;

  typename Mixed::Moved moved_of(int c) const {
    return mixed_.moved(own_[c], near_[c], far_[c], frame_.darkest[c] / scale_, frame_.brightest[c] / scale_);
  }

  // Weighted mean of the light around pixels [channels, TAPS]. Returns its variance, summed over channels.
  vec mean(const vec *light, const vec *weight, vec *mean) const {
    vec total = {}, variance = {};
    for (int i = 0; i < TAPS; i++) total += weight[i];
    total = max(total, broadcast(LEAST));  // divided by, not times its inverse: equal values are exactly their mean
    for (int c = 0; c < C(); c++, light += TAPS) {
      vec one = {}, two = {};
      for (int i = 0; i < TAPS; i++) one += light[i] * weight[i];
      mean[c] = one / total;
      for (int i = 0; i < TAPS; i++) two += (light[i] - mean[c]) * (light[i] - mean[c]) * weight[i];
      variance += two / total;
    }
    return variance;
  }

  // Adds the gradients of `mean` by light and weights.
  void back_of_mean(const vec *light, const vec *weight, const vec *mean, vec variance, const vec *d_mean,
                    vec d_variance, vec *d_light, vec *d_weight) const {
    vec total = {};
    for (int i = 0; i < TAPS; i++) total += weight[i];
    const vec each = 1.0f / max(total, broadcast(LEAST));
    for (int i = 0; i < TAPS; i++) {
      vec sum = -d_variance * variance;
      for (int c = 0; c < C(); c++) {
        const vec off = light[c * TAPS + i] - mean[c];
        d_light[c * TAPS + i] += weight[i] * each * (d_mean[c] + 2.0f * d_variance * off);
        sum += off * (d_mean[c] + d_variance * off);
      }
      d_weight[i] += sum * each;
    }
  }

  void find_colours() {
    const int plane = EDGES * PITCH;
    for (int i = 0; i < TAPS; i++) valid_[i] = masked_ ? load<vec>(w_.valid + in_coc_ + tap(i)) : broadcast(1.0f);
    scale_ = broadcast(TINY);  // brightest light around; all light is relative to it
    for (int c = 0; c < C(); c++)
      for (int i = 0; i < TAPS; i++) {
        light_[c * TAPS + i] = load<vec>(&w_.light[c * plane + first_ + tap(i)]);
        scale_ = max(scale_, abs(light_[c * TAPS + i]));
      }
    for (int i = 0; i < C() * TAPS; i++) light_[i] /= scale_;
    for (int c = 0; c < C(); c++) own_[c] = light_[c * TAPS + TAPS / 2];

    mixed_.coc = load<vec>(w_.coc + in_coc_ + tap(TAPS / 2));
    mixed_.gap = max(ends_.far - ends_.near, broadcast(1e-6f));
    vec counted = {};  // sum of the weights of the small Gaussian
    mixed_.covered = vec{};
    for (int i = 0; i < TAPS; i++) {
      const vec weight = (broadcast(1.0f + UNCLEAN) - load<vec>(w_.edge + first_ + tap(i))) * falloff_[i] * valid_[i];
      const vec nearness = (ends_.far - load<vec>(w_.coc + in_coc_ + tap(i))) /
                           mixed_.gap;  // not times 1 / gap, whose rounding the clamps below enlarge
      nearer_[i] = weight * on_near(nearness);
      farther_[i] = weight * on_far(nearness);
      small_[i] = (i == TAPS / 2 ? 1.0f : i % 2 ? SOFTNESS_FALLOFF : SOFTNESS_DIAGONAL) * valid_[i];
      mixed_.covered += small_[i] * nearness, counted += small_[i];
    }
    per_counted_ = 1.0f / max(counted, broadcast(LEAST));
    mixed_.covered *= per_counted_;

    const vec per_scale = 1.0f / scale_;
    for (int c = 0; c < C(); c++)
      for (int i = 0; i < TAPS; i++) {
        const vec relative = load<vec>(&w_.clean[c * plane + first_ + tap(i)]) * per_scale;
        clean_[c * TAPS + i] = max(min(relative, broadcast(MOST_CLEAN)), broadcast(-MOST_CLEAN));
      }
    clean_far_variance_ = mean(clean_, farther_, clean_far_), clean_near_variance_ = mean(clean_, nearer_, clean_near_);
    vec strength = {};
    for (vec &shift : shift_) shift = vec{};
    for (int c = 0; c < C(); c++) {
      const vec contrast = clean_near_[c] - clean_far_[c];
      strength += contrast * contrast;
      for (int i = 0; i < TAPS; i++) shift_[i] += (light_[c * TAPS + i] - clean_[c * TAPS + i]) * contrast;
    }
    per_strength_ = 1.0f / (strength + TEXTURE * (clean_far_variance_ + clean_near_variance_) + ALIKE * ALIKE);
    for (int i = 0; i < TAPS; i++) {
      shift_[i] *= per_strength_;
      const vec shift = limited_shift(i);
      for (int c = 0; c < C(); c++) light_[c * TAPS + i] -= shift * (clean_near_[c] - clean_far_[c]);
    }
    far_variance_ = mean(light_, farther_, far_);
    near_variance_ = mean(light_, nearer_, near_);

    mixed_.near_px = ends_.near, mixed_.far_px = ends_.far, mixed_.channels = C();
    mixed_.edge = load<vec>(w_.edge + first_ + tap(TAPS / 2));
    mixed_.variance = far_variance_ + near_variance_;
    mixed_.weigh(own_, near_, far_);
  }

  // Light of the other surface in a neighbour, as a multiple of the contrast between the clean colours.
  vec limited_shift(int i) const { return nearer_[i] > farther_[i] ? -clamp01(-shift_[i]) : clamp01(shift_[i]); }

  // Steps 5 to 3 back: the gradients by the colours, by the pixel's light and by coc, from those by the surfaces.
  void back_of_surfaces(Slopes &slopes, ivec beside) {
    const auto slope = [&](int plane) {
      return select(beside, load<vec>(&slopes.surfaces[plane * BLOCK * PITCH + y_ * PITCH + x_]));
    };
    d_ = OfMixedPixel<vec>{};
    d_.weight = slope(2 * C() + 1);
    for (int c = 0; c < C(); c++) {
      const auto of_end = mixed_.back_of_moved(moved_of(c), slope(c) * scale_, slope(C() + c) * scale_, d_, d_own_[c],
                                               d_near_[c], d_far_[c]);
      const auto is_bounded = [&](float end) { return beside & (abs(end / scale_) <= UNBOUNDED); };
      slopes.darkest[c] += reduce_add(select(is_bounded(frame_.darkest[c]), of_end.darkest / scale_));
      slopes.brightest[c] += reduce_add(select(is_bounded(frame_.brightest[c]), of_end.brightest / scale_));
    }
    mixed_.back_of_weight(own_, near_, far_, slope(2 * C()), d_, d_own_, d_near_, d_far_);
  }

  // The gradients by light, clean light, edges and coc of the window, from those by the colours.
  void back_of_colours(Slopes &slopes) {
    vec d_nearer[TAPS] = {}, d_farther[TAPS] = {};
    back_of_mean(light_, nearer_, near_, near_variance_, d_near_, d_.variance, d_light_, d_nearer);
    back_of_mean(light_, farther_, far_, far_variance_, d_far_, d_.variance, d_light_, d_farther);
    back_of_clean_colours(d_nearer, d_farther);
    back_of_taps(d_nearer, d_farther, slopes);
  }

  // The gradients by the colours of clean light, and from there by the weights of both surfaces.
  void back_of_clean_colours(vec *d_nearer, vec *d_farther) {
    // light -= shift contrast, shift = per_strength sum((light - clean) contrast), of the clean colours
    vec d_per_strength = {};
    std::fill(d_contrast_, d_contrast_ + C(), vec{});
    for (int i = 0; i < TAPS; i++) {
      const vec shift = limited_shift(i);
      vec d_shift = {}, along = {};
      for (int c = 0; c < C(); c++) {
        const vec contrast = clean_near_[c] - clean_far_[c],
                  off = light_[c * TAPS + i] + shift * contrast - clean_[c * TAPS + i];
        d_shift -= d_light_[c * TAPS + i] * contrast;
        d_contrast_[c] -= d_light_[c * TAPS + i] * shift;
        along += off * contrast;
      }
      d_shift = select(within(nearer_[i] > farther_[i] ? -shift_[i] : shift_[i]), d_shift);
      d_per_strength += d_shift * along;
      d_shift *= per_strength_;
      for (int c = 0; c < C(); c++) {
        const vec contrast = clean_near_[c] - clean_far_[c],
                  off = light_[c * TAPS + i] + shift * contrast - clean_[c * TAPS + i];
        d_light_[c * TAPS + i] += d_shift * contrast;
        d_clean_[c * TAPS + i] -= d_shift * contrast;
        d_contrast_[c] += d_shift * off;
      }
    }
    const vec d_strength = -d_per_strength * per_strength_ * per_strength_;
    for (int c = 0; c < C(); c++) {
      d_contrast_[c] += 2.0f * d_strength * (clean_near_[c] - clean_far_[c]);
      d_near_[c] = d_contrast_[c], d_far_[c] = -d_contrast_[c];
    }
    back_of_mean(clean_, nearer_, clean_near_, clean_near_variance_, d_near_, TEXTURE * d_strength, d_clean_, d_nearer);
    back_of_mean(clean_, farther_, clean_far_, clean_far_variance_, d_far_, TEXTURE * d_strength, d_clean_, d_farther);
  }

  // Adds the gradients by the pixels of the window, from those by the weights of both surfaces.
  void back_of_taps(const vec *d_nearer, const vec *d_farther, Slopes &slopes) {
    const vec per_scale = 1.0f / scale_;
    for (int c = 0; c < C(); c++) {
      d_light_[c * TAPS + TAPS / 2] += d_own_[c];
      for (int i = 0; i < TAPS; i++) {
        const int at = c * EDGES * PITCH + first_ + tap(i);
        add(&slopes.light[at], d_light_[c * TAPS + i] * per_scale);
        add(&slopes.clean[at],
            select(abs(load<vec>(&w_.clean[at]) * per_scale) <= MOST_CLEAN, d_clean_[c * TAPS + i] * per_scale));
      }
    }
    add(slopes.edge + first_ + tap(TAPS / 2), d_.edge);
    for (int i = 0; i < TAPS; i++) {
      const int in_coc = in_coc_ + tap(i);
      const vec near_by = falloff_[i] * valid_[i],
                weight = (broadcast(1.0f + UNCLEAN) - load<vec>(w_.edge + first_ + tap(i))) * near_by;
      const vec nearness = (ends_.far - load<vec>(w_.coc + in_coc)) / mixed_.gap, to_near = unlimited_on_near(nearness),
                to_far = unlimited_on_far(nearness);
      add(slopes.edge + first_ + tap(i), -near_by * (d_nearer[i] * clamp01(to_near) + d_farther[i] * clamp01(to_far)));
      const vec d_ends =
          PLACE_SLOPE * weight * (select(within(to_near), d_nearer[i]) - select(within(to_far), d_farther[i]));
      const vec d_nearness = (d_ends + d_.covered * small_[i] * per_counted_) / mixed_.gap;
      add(slopes.coc + in_coc, -d_nearness);
      d_.far_px += d_nearness;
      d_.gap -= d_nearness * nearness;
    }
    add(slopes.coc + in_coc_ + tap(TAPS / 2), d_.coc);
    ends_.back(w_, in_coc_, masked_, d_.near_px - d_.gap, d_.far_px + d_.gap, slopes.coc);
  }

  int C() const { return CHANNELS ? CHANNELS : frame_.channels; }

  const Frame &frame_;
  const Window &w_;
  const float *const falloff_;
  const int y_, x_, first_,
      in_coc_;  // place in the block; of the first neighbour in windows of edges and light, and of coc
  const bool masked_;
  const Ends ends_;
  vec *light_, *clean_, *d_light_, *d_clean_;  // of the neighbours [channels, TAPS]; gradients begin with d_
  vec *near_, *far_, *own_, *clean_near_, *clean_far_, *d_near_, *d_far_, *d_own_, *d_contrast_;  // [channels]
  vec valid_[TAPS], small_[TAPS];
  vec nearer_[TAPS], farther_[TAPS];  // weights in the means of both surfaces
  vec shift_[TAPS];                   // not limited
  vec scale_, per_counted_, per_strength_;
  vec clean_near_variance_, clean_far_variance_, near_variance_, far_variance_;
  Mixed mixed_;
  OfMixedPixel<vec> d_;
};

void read_light(const Frame &frame, int y0, int x0, Window &w) {
  for (int c = 0; c < frame.channels; c++)
    read_window(frame, frame.light + c * frame.area(), y0 - RIM, x0 - RIM, EDGES,
                w.light.data() + (size_t)c * EDGES * PITCH);
}

// Calls body(row, column, which are mixed) for each LANES pixels of a block that contain mixed ones.
template <typename Body>
void each_mixed(const Frame &frame, int y0, int x0, const Window &w, const Body &body) {
  for (int y = 0; y < std::min(BLOCK, frame.height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, frame.width - x0); x += LANES) {
      const ivec beside =
          (load<vec>(w.edge + (y + RIM) * PITCH + x + RIM) > vec{}) & (iota() < (float)(frame.width - x0 - x));
      if (any_of(beside)) body(y, x, beside);
    }
}

void split_block(const Frame &frame, int by, int bx, Window &w, const float *falloff, const Block &block) {
  const int y0 = by * BLOCK, x0 = bx * BLOCK;
  read_light(frame, y0, x0, w);
  clean_light(frame, y0, x0, w, falloff);
  each_mixed(frame, y0, x0, w, [&](int y, int x, ivec beside) {
    frame.channels == 3 ? Split<3>(frame, w, y, x, falloff).put(block, beside)
                        : Split<0>(frame, w, y, x, falloff).put(block, beside);
  });
}

// Adds the gradients by light and coc of a block's window, from those by the block's surfaces [2 channels + 2, height,
// width].
void back_of_block(const Frame &frame, int by, int bx, Window &w, const float *falloff, const float *gradient,
                   Slopes &slopes, float *const *d_maps) {
  const int y0 = by * BLOCK, x0 = bx * BLOCK, C = frame.channels, plane = EDGES * PITCH;
  const bool has_edges = find_edges(frame, y0, x0, w);
  for (int k = 0; k < 2 * C + 2; k++)
    read_window(frame, gradient + k * frame.area(), y0, x0, BLOCK, &slopes.surfaces[k * BLOCK * PITCH]);
  for (int y = 0; y < std::min(BLOCK, frame.height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, frame.width - x0); x++)
      if (!has_edges || !(w.edge[(y + RIM) * PITCH + x + RIM] > 0)) {  // a pixel of one surface stays as it is
        const size_t at = frame.pixel(y0 + y, x0 + x);
        for (int c = 0; c < C; c++) d_maps[0][c * frame.area() + at] += slopes.surfaces[(c * BLOCK + y) * PITCH + x];
        d_maps[1][at] += slopes.surfaces[(2 * C * BLOCK + y) * PITCH + x];
      }
  if (!has_edges) return;
  read_light(frame, y0, x0, w);
  clean_light(frame, y0, x0, w, falloff);
  std::fill(slopes.coc, slopes.coc + SIDE * PITCH, 0.0f);
  std::fill(slopes.edge, slopes.edge + plane, 0.0f);
  std::fill(slopes.light.begin(), slopes.light.end(), 0.0f);
  std::fill(slopes.clean.begin(), slopes.clean.end(), 0.0f);
  each_mixed(frame, y0, x0, w, [&](int y, int x, ivec beside) {
    C == 3 ? Split<3>(frame, w, y, x, falloff).back(slopes, beside)
           : Split<0>(frame, w, y, x, falloff).back(slopes, beside);
  });
  clean_light(frame, y0, x0, w, falloff, &slopes);
  each_outside(frame, y0, x0, [&](int from, int to) {
    slopes.edge[to] += slopes.edge[from];
    slopes.edge[from] = 0;
  });
  for (int i = 0; i < EDGES; i++)
    for (int j = 0; j < EDGES; j += LANES) {
      const int at = i * PITCH + j;
      const Ends ends(w, at, frame.valid);
      const vec rise = edge_of(ends.near, ends.far);
      const vec slope =
          select(within(rise) & (load<vec>(w.edge + at) > vec{}), load<vec>(slopes.edge + at) * (1.0f / EDGE_PX));
      // the smaller of both blurs is that of one surface, or of both by halves
      const vec near_blur = abs(ends.near), far_blur = abs(ends.far);
      const vec part = SAME_BLUR * slope * (near_blur == far_blur ? broadcast(0.5f) : broadcast(1.0f));
      const vec d_near_blur = select(near_blur <= far_blur, part), d_far_blur = select(far_blur <= near_blur, part);
      const vec d_near = -slope - select(ends.near > vec{}, d_near_blur) + select(ends.near < vec{}, d_near_blur);
      const vec d_far = slope - select(ends.far > vec{}, d_far_blur) + select(ends.far < vec{}, d_far_blur);
      if (any_of(slope != vec{})) ends.back(w, at, frame.valid, d_near, d_far, slopes.coc);
    }
  const auto add_window = [&](const float *window, int size, int margin, float *to) {
    for (int i = 0; i < size; i++)
      for (int j = 0; j < size; j++) {
        const int y = std::clamp(y0 - margin + i, 0, frame.height - 1),
                  x = std::clamp(x0 - margin + j, 0, frame.width - 1);
        to[frame.pixel(y, x)] += window[i * PITCH + j];
      }
  };
  for (int c = 0; c < C; c++) add_window(&slopes.light[c * plane], EDGES, RIM, d_maps[0] + c * frame.area());
  add_window(slopes.coc, SIDE, MARGIN, d_maps[1]);
}

// Gives pixels of a block the second surfaces of a matte, by their certainty; see render/surfaces/coverage.py.
void cover_block(Job &job, int by, int bx) {
  Surfaces &s = job.surfaces;
  const size_t area = s.area();
  const float *const part = job.scene.covered, *const coc = part + s.channels * area, *const weight = coc + area,
                     *const certainty = weight + area;
  for (int y = by * BLOCK; y < std::min(s.height, (by + 1) * BLOCK); y++)
    for (int x = bx * BLOCK; x < std::min(s.width, (bx + 1) * BLOCK); x++) {
      const size_t at = s.pixel(y, x);
      if (!(certainty[at] > 0)) continue;
      const Block block = s.make_block(by * s.block_columns + bx);
      const int within = place_in_block(y, x);
      const float kept = (1.0f - certainty[at]) * block.weight[within], given = certainty[at] * weight[at],
                  both = kept + given;
      const float per = both > 0 ? 1.0f / std::max(both, LEAST) : 0.0f;
      for (int c = 0; c < s.channels; c++) {
        float &other = block.other[c * BLOCK_PIXELS + within];
        other = (kept * other + certainty[at] * part[c * area + at] * s.light[c * area + at]) * per;
      }
      if (both > 0) block.coc[within] = (kept * block.coc[within] + given * coc[at]) * per;
      s.set_weight(block, at, within, both);
    }
}

std::vector<float> falloff_around(int reach) {
  std::vector<float> falloff;
  for (int dy = -reach; dy <= reach; dy++)
    for (int dx = -reach; dx <= reach; dx++)
      falloff.push_back((float)std::exp(-0.5 * (dy * dy + dx * dx) / (NEAR_BY_PX * NEAR_BY_PX)));
  return falloff;
}

}  // namespace

void Job::split_mixed() {
  const std::vector<float> falloff = falloff_around(REACH), around_emitter = falloff_around(EMITTER_REACH);
  const bool emitters = scene.kind != TORCHDOF_BACKGROUND;  // a given background replaces the light behind
  const int rows = surfaces.block_rows, columns = surfaces.block_columns;
  const Frame frame{height,       width,          channels,           surfaces.light,
                    surfaces.coc, surfaces.valid, light_least.data(), light_most.data()};
  std::vector<std::unique_ptr<Window>> windows(std::max(1, scene.threads));
  struct Left {
    int y, x;
    float weight;
  };
  std::vector<std::vector<Left>> left(rows);  // other surfaces of highlights' pixels
  const auto each_highlight = [&](int by, int bx, const auto &body) {
    if (!emitters) return;
    const int y0 = by * BLOCK, x0 = bx * BLOCK;
    const float least_limit = least_threshold(*this, y0, x0);
    if (!(block_peak[by * columns + bx] > least_limit)) return;
    for (int y = y0; y < std::min(height, y0 + BLOCK); y++)
      for (int x = x0; x < std::min(width, x0 + BLOCK); x++) body(y, x, least_limit);
  };
  parallel(rows, [&](int by, int worker) {
    if (!windows[worker]) windows[worker].reset(new Window(channels));
    Window &w = *windows[worker];
    for (int bx = 0; bx < columns; bx++) {
      float low = NEVER_PX, high = -NEVER_PX;
      for (int v = std::max(by - 1, 0); v <= std::min(by + 1, rows - 1); v++)
        for (int u = std::max(bx - 1, 0); u <= std::min(bx + 1, columns - 1); u++) {
          low = std::min(low, block_low[v * columns + u]);
          high = std::max(high, block_high[v * columns + u]);
        }
      const int y0 = by * BLOCK, x0 = bx * BLOCK;
      if (high - low > EDGE_PX && find_edges(frame, y0, x0, w))
        split_block(frame, by, bx, w, falloff.data(), surfaces.make_block(by * columns + bx));
      if (scene.covered) cover_block(*this, by, bx);
      if (!(high - low > 1)) continue;
      each_highlight(by, bx, [&](int y, int x, float least_limit) {
        attribute_emitter(*this, y, x, least_limit, around_emitter.data());
      });
    }
  });
  parallel(rows, [&](int by, int) {
    for (int bx = 0; bx < columns; bx++)
      if (surfaces.has_block(by * columns + bx))
        each_highlight(by, bx, [&](int y, int x, float least_limit) {
          const float weight = weight_left(*this, y, x, least_limit, around_emitter.data());
          if (weight < 1) left[by].push_back({y, x, weight});
        });
  });
  for (const auto &row : left)
    for (const Left &l : row) {
      const Block block = surfaces.block(surfaces.block_of(l.y, l.x));
      const int within = place_in_block(l.y, l.x);
      surfaces.set_weight(block, (size_t)l.y * width + l.x, within, l.weight * block.weight[within]);
    }
}

void Job::add_background() {
  const size_t area = surfaces.area();
  const float low = coc_at(layers.front().node), high = coc_at(layers.back().node);
  float *planes[3];  // [channels + 2, height, width] of each surface: light, coc, weight
  for (float *&plane : planes) plane = copies.emplace_back(area * (channels + 2)).data();
  parallel(height, [&](int y, int) {
    std::vector<const float *> own(channels), other(channels);
    for (int x = 0; x < width; x++) {
      const size_t at = surfaces.pixel(y, x);
      const float *own_coc, *own_weight, *other_coc, *weight;
      surfaces.row(0, y, x, own.data(), own_coc, own_weight);
      const bool mixed = surfaces.row(1, y, x, other.data(), other_coc, weight);
      bool known = std::isfinite(scene.coc[1][at]);
      for (int c = 0; c < channels; c++) known &= std::isfinite(scene.light[1][c * area + at]);
      const float here = surfaces.coc[at], there = std::clamp(scene.coc[1][at], low, high);
      const float second = mixed ? *other_coc : here, of_second = mixed ? *weight : 0.0f;
      // 0 where the background is the surface in the image, or the farther one of a mixed pixel
      const float apart = clamp01(there - here - SAME_PX),
                  of_farther = clamp01(there - std::max(here, second) - SAME_PX);
      // of two surfaces the nearer one stays; the background replaces the farther one if that shows it
      const float share = second < here ? of_second : 0.0f;
      for (int c = 0; c < channels; c++) {
        planes[0][c * area + at] = mixed ? *other[c] : 0.0f;
        planes[1][c * area + at] = *own[c];
        planes[2][c * area + at] = known ? scene.light[1][c * area + at] : 0.0f;
      }
      const float coc[3] = {second, here, std::max(known ? there : 0.0f, here)};
      const float weights[3] = {share, (own_weight ? *own_weight : 1.0f) + of_second * of_farther,
                                known ? apart + (1.0f - apart) * share : 0.0f};
      for (int i = 0; i < 3; i++) {
        planes[i][channels * area + at] = coc[i];
        planes[i][(channels + 1) * area + at] = weights[i];
      }
    }
  });
  for (float *plane : planes) {
    surfaces.lights.push_back(plane);
    surfaces.cocs.push_back(plane + channels * area);
    surfaces.weights.push_back(plane + (channels + 1) * area);
  }
  surfaces.count = 3;
  surfaces.independent = true;
}

// The surfaces of an image [2 channels + 2, height, width]: own and other light, coc and weight of the other; or, given
// their gradient, the gradients by light and coc.
static void matte(const float *const *maps, int channels, int height, int width, int threads, float *out,
                  const float *gradient, float *const *d_maps) {
  const int C = channels, rows = ceil_div(height, BLOCK), columns = ceil_div(width, BLOCK);
  std::vector<float> darkest(C), brightest(C), d_range((size_t)rows * 2 * C);
  const size_t area = (size_t)height * width;
  for (int c = 0; c < C; c++) find_ends(maps[0] + c * area, area, threads, &darkest[c], &brightest[c]);
  const Frame frame{height, width, C, maps[0], maps[1], maps[2], darkest.data(), brightest.data()};
  const std::vector<float> falloff = falloff_around(REACH);
  if (!gradient) {
    memcpy(out, maps[0], C * area * sizeof(float));
    memcpy(out + 2 * C * area, maps[1], area * sizeof(float));
    std::fill(out + C * area, out + 2 * C * area, 0.0f);
    std::fill(out + (2 * C + 1) * area, out + (2 * C + 2) * area, 0.0f);
    parallel(threads, rows, nullptr, [&](int by, int) {
      Window w(C);
      std::vector<float> planes((size_t)(2 * C + 3) * BLOCK_PIXELS);
      const auto plane = [&](int k) { return &planes[(size_t)k * BLOCK_PIXELS]; };
      for (int bx = 0; bx < columns; bx++) {
        const int y0 = by * BLOCK, x0 = bx * BLOCK;
        if (!find_edges(frame, y0, x0, w)) continue;
        split_block(frame, by, bx, w, falloff.data(),
                    {plane(0), plane(C), plane(2 * C), plane(2 * C + 1), plane(2 * C + 2)});
        each_mixed(frame, y0, x0, w, [&](int y, int x, ivec beside) {
          for (int lane = 0; lane < LANES; lane++)
            for (int k = 0; beside[lane] && k < 2 * C + 2; k++)
              out[k * area + frame.pixel(y0 + y, x0 + x + lane)] = plane(k)[y * BLOCK + x + lane];
        });
      }
    });
    return;
  }
  for (int first = 0; first < 2; first++)  // windows of every second row of blocks do not overlap
    parallel(threads, (rows + 1 - first) / 2, nullptr, [&](int i, int) {
      const int by = 2 * i + first;
      Window w(C);
      Slopes slopes(C);
      for (int bx = 0; bx < columns; bx++) back_of_block(frame, by, bx, w, falloff.data(), gradient, slopes, d_maps);
      std::copy(slopes.darkest.begin(), slopes.darkest.end(), &d_range[(size_t)by * 2 * C]);
      std::copy(slopes.brightest.begin(), slopes.brightest.end(), &d_range[(size_t)by * 2 * C + C]);
    });
  for (int k = 0; k < 2 * C; k++) {  // the pixels with the extremes share their gradients
    float slope = 0;
    for (int by = 0; by < rows; by++) slope += d_range[(size_t)by * 2 * C + k];
    const float *const light = maps[0] + k % C * area, extreme = k < C ? darkest[k] : brightest[k - C];
    slope /= (float)std::count(light, light + area, extreme);
    for (size_t at = 0; slope != 0 && at < area; at++)
      if (light[at] == extreme) d_maps[0][k % C * area + at] += slope;
  }
}

}  // namespace torchdof

int32_t torchdof_matte(const float *const *maps, int32_t channels, int32_t height, int32_t width, int32_t threads,
                       float *out, const float *gradient, float *const *d_maps) {
  return torchdof::guarded([&] { torchdof::matte(maps, channels, height, width, threads, out, gradient, d_maps); });
}
