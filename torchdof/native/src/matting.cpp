// Matting: a pixel at a depth edge mixes the light of two surfaces but has the depth of one. Splits it into both, as
// described in render/matting.py.
#include "engine.h"

namespace torchdof {
namespace {

// Constants of render/matting.py, which gives their meanings, units and effects: mixed pixels, emitters.
constexpr float EDGE_PX = 0.5f, UNCLEAN = 1e-2f, TRUST = 10.0f, UNSURE = 3.0f, TEXTURE = 50.0f, MOST_CLEAN = 4.0f, ALIKE = 1.0f / 255, UNBOUNDED = 1e6f;
constexpr int EMITTER_REACH = 3, TOUCHING = 2;
constexpr float DIM = 0.1f, MOST_WEIGHT = 0.98f;
constexpr float SAME_PX = 0.5f;  // px of coc: a background at most this far behind the image's surface is the same surface
enum Side { IN_FRONT = -1, BEHIND = 1 };  // of an emitter, relative to a surface

// Windows around the pixels of a block
constexpr int REACH = 1;                   // pixels around a mixed pixel that define its two colours
constexpr int AROUND = 2 * REACH + 1;
constexpr int TAPS = AROUND * AROUND;
constexpr int RIM = REACH + 1;             // a neighbour's clean light depends on the pixels next to it
constexpr int MARGIN = RIM + 1;            // edges depend on the pixels next to them
constexpr int SIDE = BLOCK + 2 * MARGIN;   // of the window of coc
constexpr int EDGES = BLOCK + 2 * RIM;     // of the windows of edges and light
constexpr int PITCH = 24;                  // of all

// Falloff of Gaussians of 0.6 px, _SOFTNESS_PX, and 0.8 px, _UNSURE_PX, beside their centre.
constexpr float SMALL_BESIDE = 0.24935221f, SMALL_DIAGONAL = 0.06217652f, WIDE_BESIDE = 0.45783336f, WIDE_DIAGONAL = 0.20961138f;

struct Window {
  explicit Window(int channels) : light((size_t)channels * EDGES * PITCH + LANES), clean(light), around((size_t)channels * (2 * TAPS + 3)) {}

  float coc[SIDE * PITCH + LANES] = {}, valid[SIDE * PITCH + LANES] = {}, moved[BLOCK * PITCH + LANES] = {}, edge[EDGES * PITCH + LANES] = {};
  std::vector<float> light;  // [channels, EDGES, PITCH]
  std::vector<float> clean;  // the same, without the light of other surfaces
  std::vector<vec> around;   // of LANES pixels: light and clean light around them [channels, TAPS], and three colours
};

// Copies `size` rows and columns of a plane from y0, x0; a pixel outside the frame is the nearest one inside.
void read_window(const Job &job, const float *plane, int y0, int x0, int size, float *to) {
  const bool inside = x0 >= 0 && x0 + size <= job.width;
  for (int i = 0; i < size; i++, to += PITCH) {
    const float *from = plane + (size_t)std::clamp(y0 + i, 0, job.height - 1) * job.width;
    if (inside)
      memcpy(to, from + x0, size * sizeof(float));
    else
      for (int j = 0; j < size; j++) to[j] = from[std::clamp(x0 + j, 0, job.width - 1)];
  }
}

// Gives pixels outside the frame the value of the nearest one inside, in a window of EDGES x EDGES pixels around a block.
void clamp_to_frame(const Job &job, int y0, int x0, float *window) {
  if (y0 >= RIM && x0 >= RIM && y0 + BLOCK + RIM <= job.height && x0 + BLOCK + RIM <= job.width) return;
  for (int i = 0; i < EDGES; i++)
    for (int j = 0; j < EDGES; j++) {
      const int y = std::clamp(y0 - RIM + i, 0, job.height - 1), x = std::clamp(x0 - RIM + j, 0, job.width - 1);
      window[i * PITCH + j] = window[(y - y0 + RIM) * PITCH + x - x0 + RIM];
    }
}

// Computes for each pixel in and around a block the confidence, 0 to 1, that it lies at an edge. False if it is 0 in the
// whole block.
bool find_edges(const Job &job, int y0, int x0, Window &w) {
  const float *valid = job.surfaces.valid;
  float lows[SIDE * PITCH], highs[SIDE * PITCH];  // of valid pixels
  const float *low = valid ? lows : w.coc, *high = valid ? highs : w.coc;
  read_window(job, job.surfaces.coc, y0 - MARGIN, x0 - MARGIN, SIDE, w.coc);
  if (valid) read_window(job, valid, y0 - MARGIN, x0 - MARGIN, SIDE, w.valid);
  for (int i = 0; valid && i < SIDE * PITCH; i++) {
    lows[i] = w.valid[i] > 0 ? w.coc[i] : NEVER;
    highs[i] = w.valid[i] > 0 ? w.coc[i] : -NEVER;
  }
  for (int i = 0; i < EDGES; i++) {
    float least_of[PITCH + LANES], most_of[PITCH + LANES];
    for (int j = 0; j < PITCH; j += LANES) {
      auto row = [&](const float *values, int k) { return load<vec>(values + (i + k) * PITCH + j); };
      store(least_of + j, least(least(row(low, 0), row(low, 1)), row(low, 2)));
      store(most_of + j, most(most(row(high, 0), row(high, 1)), row(high, 2)));
    }
    for (int j = 0; j < PITCH; j += LANES) {
      auto high_of = [&](int k) { return load<vec>(most_of + j + k); };
      auto low_of = [&](int k) { return load<vec>(least_of + j + k); };
      const vec gap = most(most(high_of(0), high_of(1)), high_of(2)) - least(least(low_of(0), low_of(1)), low_of(2));
      const vec edge = clamp01(gap * (1.0f / EDGE_PX) - all(1.0f));
      store(w.edge + i * PITCH + j, valid ? edge * load<vec>(w.valid + (i + 1) * PITCH + j + 1) : edge);
    }
  }
  clamp_to_frame(job, y0, x0, w.edge);
  vec most_edge = {};
  for (int i = RIM; i < RIM + BLOCK; i++)
    for (int j = RIM; j < RIM + BLOCK; j += LANES) most_edge = most(most_edge, load<vec>(w.edge + i * PITCH + j));
  return any_positive(most_edge);
}

// Weighted mean of the light around pixels [channels, TAPS]. Returns its variance, summed over channels.
template <int CHANNELS>
vec mean(const vec *light, int channels, const vec *weight, vec *mean) {
  const int C = CHANNELS ? CHANNELS : channels;
  vec total = {}, variance = {};
  for (int i = 0; i < TAPS; i++) total += weight[i];
  total = most(total, all(1e-12f));  // divided by, not multiplied with its inverse: equal values are exactly their mean
  for (int c = 0; c < C; c++, light += TAPS) {
    vec one = {}, two = {};
    for (int i = 0; i < TAPS; i++) one += light[i] * weight[i];
    mean[c] = one / total;
    for (int i = 0; i < TAPS; i++) two += (light[i] - mean[c]) * (light[i] - mean[c]) * weight[i];
    variance += two / total;
  }
  return variance;
}

inline int tap(int i) { return i / AROUND * PITCH + i % AROUND; }

// Replaces the light of mixed pixels by the mean of the unmixed pixels of the same surface around them.
void clean_light(const Job &job, int y0, int x0, Window &w, const float *falloff) {
  w.clean = w.light;
  for (int i = 1; i < EDGES - 1; i++)
    for (int j = 1; j < EDGES - 1; j += LANES) {
      const size_t at = i * PITCH + j, in_coc = at + PITCH + 1;
      const vec edge = load<vec>(w.edge + at), coc = load<vec>(w.coc + in_coc);
      if (!any_of(edge > vec{})) continue;
      vec weight[TAPS], total = {};
      for (int k = 0; k < TAPS; k++) {
        const int to = tap(k) - PITCH - 1;
        const vec apart = (load<vec>(w.coc + in_coc + to) - coc) * (1.0f / EDGE_PX);
        weight[k] = (all(1.0f + UNCLEAN) - load<vec>(w.edge + at + to)) * falloff[k] * clamp01(2.0f - 2.0f * most(apart, -apart));
        if (job.surfaces.valid) weight[k] *= load<vec>(w.valid + in_coc + to);
        total += weight[k];
      }
      const vec is_clean = edge * clamp01(total - 10.0f * UNCLEAN), per_total = 1.0f / most(total, all(1e-12f));
      for (int c = 0; c < job.channels; c++) {
        const float *const light = w.light.data() + (size_t)c * EDGES * PITCH + at;
        vec sum = {};
        for (int k = 0; k < TAPS; k++) sum += weight[k] * load<vec>(light + tap(k) - PITCH - 1);
        store(w.clean.data() + (light - w.light.data()), load<vec>(light) + is_clean * (sum * per_total - load<vec>(light)));
      }
    }
  for (int c = 0; c < job.channels; c++) clamp_to_frame(job, y0, x0, w.clean.data() + (size_t)c * EDGES * PITCH);
}

// Splits the pixels of `beside`, out of LANES pixels of a row.
//
// 1. The near and far coc are the extremes of the 3 x 3 neighbours.
// 2. The colour of each surface is the mean of its neighbours. Their light moves towards their clean light, along the line
//    between the clean colours of both surfaces, and less where texture is strong. If a thin foreground has no unmixed
//    neighbours, they count by their difference from the background.
// 3. The share of the near surface is the projection of the pixel's colour onto the line between both colours.
// 4. The share of the other surface is at most 1/2. Where texture makes the projection unreliable, it is the share that
//    the other surface has under a small Gaussian, unless this contradicts the pixel's colour. It may where the map as
//    given has no edge; then the surfaces have their own colours.
// 5. The residual colour goes to both surfaces in proportion to their shares, within the range of the image's light.
template <int CHANNELS>
void split(const Job &job, Window &w, int y, int x, ivec beside, const float *falloff, const Block &block) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  const bool masked = job.surfaces.valid;
  const size_t first = (size_t)(y + 1) * PITCH + x + 1, in_coc = first + PITCH + 1;
  vec coc[TAPS], valid[TAPS], near = all(NEVER), far = all(-NEVER);
  for (int i = 0; i < TAPS; i++) {
    coc[i] = load<vec>(w.coc + in_coc + tap(i));
    valid[i] = masked ? load<vec>(w.valid + in_coc + tap(i)) : all(1.0f);
    near = least(near, valid[i] > vec{} ? coc[i] : all(NEVER));
    far = most(far, valid[i] > vec{} ? coc[i] : all(-NEVER));
  }
  vec *const light = w.around.data(), *const clean = light + C * TAPS;                        // [channels, TAPS]
  vec *const front = light + 2 * C * TAPS, *const behind = front + C, *const colour = behind + C;  // [channels]
  vec scale = all(TINY);  // brightest light around; all light is relative to it
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      light[c * TAPS + i] = load<vec>(w.light.data() + (size_t)c * EDGES * PITCH + first + tap(i));
      scale = most(scale, most(light[c * TAPS + i], -light[c * TAPS + i]));
    }
  for (int i = 0; i < C * TAPS; i++) light[i] /= scale;
  for (int c = 0; c < C; c++) colour[c] = light[c * TAPS + TAPS / 2];

  const vec here = coc[TAPS / 2], gap = most(far - near, all(1e-6f));
  const vec part = load<vec>(w.moved + y * PITCH + x) / gap;  // 0 or 1: the map as given has an edge here
  const vec unsure = clamp01(4.0f * least(part, 1.0f - part));
  const vec at_side = SMALL_BESIDE + unsure * (WIDE_BESIDE - SMALL_BESIDE), at_corner = SMALL_DIAGONAL + unsure * (WIDE_DIAGONAL - SMALL_DIAGONAL);
  vec nearer[TAPS], farther[TAPS], whole = {};  // weights in the means of both surfaces; sum of those of the front
  vec covered = {}, counted = {};               // by the near surface, under a small Gaussian
  for (int i = 0; i < TAPS; i++) {
    const vec weight = (all(1.0f + UNCLEAN) - load<vec>(w.edge + first + tap(i))) * falloff[i] * valid[i];
    const vec nearness = (far - coc[i]) / gap;  // not times 1 / gap, whose rounding the clamps below enlarge
    nearer[i] = weight * clamp01(4.0f * nearness - 2.8f);
    farther[i] = weight * clamp01(1.2f - 4.0f * nearness);
    whole += nearer[i];
    const vec small = (i == TAPS / 2 ? all(1.0f) : i % 2 ? at_side : at_corner) * valid[i];
    covered += small * nearness, counted += small;
  }
  covered /= most(counted, all(1e-12f));

  const vec per_scale = 1.0f / scale;
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      const vec relative = load<vec>(w.clean.data() + (size_t)c * EDGES * PITCH + first + tap(i)) * per_scale;
      clean[c * TAPS + i] = most(least(relative, all(MOST_CLEAN)), all(-MOST_CLEAN));
    }
  const vec texture = mean<CHANNELS>(clean, C, farther, behind) + mean<CHANNELS>(clean, C, nearer, front);
  vec clean_strength = {}, moved[TAPS] = {};
  for (int c = 0; c < C; c++) {
    const vec contrast = front[c] - behind[c];
    clean_strength += contrast * contrast;
    for (int i = 0; i < TAPS; i++) moved[i] += (light[c * TAPS + i] - clean[c * TAPS + i]) * contrast;
  }
  const vec per_strength = 1.0f / (clean_strength + TEXTURE * texture + ALIKE * ALIKE);
  for (int i = 0; i < TAPS; i++) {
    moved[i] *= per_strength;
    moved[i] = nearer[i] > farther[i] ? -clamp01(-moved[i]) : clamp01(moved[i]);
  }
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) light[c * TAPS + i] -= moved[i] * (front[c] - behind[c]);
  vec variance = mean<CHANNELS>(light, C, farther, behind);
  const vec has_clean = clamp01(whole * (0.1f / UNCLEAN) - 1.0f);
  if (any_of(has_clean < all(1.0f))) {
    vec differs[TAPS] = {}, most_of = {};
    for (int c = 0; c < C; c++)
      for (int i = 0; i < TAPS; i++) differs[i] += (light[c * TAPS + i] - behind[c]) * (light[c * TAPS + i] - behind[c]);
    for (int i = 0; i < TAPS; i++) most_of = most(most_of, differs[i]);
    const vec each = 1.0f / (most_of + ALIKE * ALIKE);
    for (int i = 0; i < TAPS; i++) {
      const vec part = (differs[i] + ALIKE * ALIKE) * each;
      nearer[i] *= part + has_clean * (1.0f - part);
    }
  }
  variance += mean<CHANNELS>(light, C, nearer, front);

  vec along = {}, strength = {}, misfit = {};
  for (int c = 0; c < C; c++) {
    const vec contrast = front[c] - behind[c];
    strength += contrast * contrast;
    along += (colour[c] - behind[c]) * contrast;
  }
  const ivec is_near = here - near < far - here;
  const vec fitted = clamp01(along / most(strength, all(1e-12f)));
  for (int c = 0; c < C; c++) {
    const vec left = colour[c] - behind[c] - fitted * (front[c] - behind[c]);
    misfit += left * left;
  }
  const vec noise = variance + ALIKE * ALIKE;
  const vec trust = strength / (strength + TRUST * (variance + misfit) * (1.0f + UNSURE * unsure) + ALIKE * ALIKE);
  const vec sided = size_of((here - near) - (far - here)) * (all(1.0f) / gap), edge = load<vec>(w.edge + first + tap(TAPS / 2));
  const vec clear = edge * clamp01(4.0f * sided - 2.0f), contradiction = misfit + (covered - fitted) * (covered - fitted) * strength;
  vec geometric = least(is_near ? 1.0f - covered : covered, all(0.5f)) * clear * (1.0f - trust);
  geometric *= clamp01(gap * (1.0f / EDGE_PX) - 2.0f);
  vec disagreed = geometric * unsure * contradiction / (noise + contradiction);  // with the pixel's colour
  const vec agreed = geometric * noise / (noise + contradiction);
  const vec other = least(is_near ? 1.0f - fitted : fitted, all(0.5f)) * (clear * trust) + agreed + disagreed, own = 1.0f - other;

  const vec per_own = 1.0f / own, per_other = 1.0f / most(other, all(1e-12f)), of_each = other / (other * other + own * own);
  disagreed *= per_other;
  auto put = [&](float *plane, vec value) {
    float *const to = plane + y * BLOCK + x;
    store(to, beside ? value : load<vec>(to));
  };
  for (int c = 0; c < C; c++) {
    const vec own_mean = is_near ? front[c] : behind[c], other_mean = is_near ? behind[c] : front[c];
    const vec unexplained = colour[c] - own * own_mean - other * other_mean;
    const vec darkest = most(job.light_least[c] / scale, all(-UNBOUNDED)), brightest = least(job.light_most[c] / scale, all(UNBOUNDED));
    vec others = other * (other_mean + unexplained * of_each);  // the other surface's light, times its weight
    // the two parts still sum to the pixel, and neither is brighter or darker than the image
    others = least(most(others, colour[c] - own * brightest), colour[c] - own * darkest);
    others = least(most(others, other * darkest), other * brightest);
    const vec own_light = (colour[c] - others) * per_own, other_light = other > vec{} ? others * per_other : vec{};
    put(block.own + c * BLOCK_PIXELS, (own_light + disagreed * (colour[c] - own_light)) * scale);
    put(block.other + c * BLOCK_PIXELS, (other_light + disagreed * (other_mean - other_light)) * scale);
  }
  put(block.coc, is_near ? far : near);
  put(block.weight, other * valid[TAPS / 2]);
  put(block.own_weight, own * valid[TAPS / 2]);
}

void split_block(Job &job, int by, int bx, Window &w, const float *falloff) {
  const int y0 = by * BLOCK, x0 = bx * BLOCK;
  const Block block = job.surfaces.make_block(by * job.surfaces.block_columns + bx);
  for (int c = 0; c < job.channels; c++)
    read_window(job, job.surfaces.light + c * job.surfaces.area(), y0 - RIM, x0 - RIM, EDGES, w.light.data() + (size_t)c * EDGES * PITCH);
  clean_light(job, y0, x0, w, falloff);
  if (job.scene.moved) read_window(job, job.scene.moved, y0, x0, BLOCK, w.moved);
  for (int y = 0; y < std::min(BLOCK, job.height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, job.width - x0); x += LANES) {
      const ivec beside = (load<vec>(w.edge + (y + RIM) * PITCH + x + RIM) > vec{}) & (counting() < (float)(job.width - x0 - x));
      if (!any_of(beside)) continue;
      job.channels == 3 ? split<3>(job, w, y, x, beside, falloff, block) : split<0>(job, w, y, x, beside, falloff, block);
    }
}

// Estimates from the pixels around a highlight on which surface its emitter lies.
class Around {
 public:
  // matted: compares the light of each pixel's own surface after matting, not that of the image.
  Around(const Surfaces &s, int y, int x, const float *falloff, bool matted) : s_(s), falloff_(falloff), matted_(matted) {
    for (int i = 0, dy = -EMITTER_REACH; dy <= EMITTER_REACH; dy++)
      for (int dx = -EMITTER_REACH; dx <= EMITTER_REACH; dx++, i++) {
        at_[i] = (size_t)std::clamp(y + dy, 0, s.height - 1) * s.width + std::clamp(x + dx, 0, s.width - 1);
        coc_[i] = s.coc[at_[i]];
        nearest_ = std::min(nearest_, coc_[i]);
        farthest_ = std::max(farthest_, coc_[i]);
        if (touches(i)) nearest_touching_ = std::min(nearest_touching_, coc_[i]);
      }
  }

  // Confidence, 0 to 1, that the emitter lies on one side of the surface at `coc`. light: of the highlight's pixel;
  // limit: the highlight threshold; share: minimum light on that side, relative to the surface's brightest pixel.
  float certainty_beyond(float coc, Side side, float share, float light, float limit) {
    if (!((side == BEHIND ? farthest_ - coc : coc - nearest_touching_) > 1)) return 0.0f;
    if (!scale)
      for (int i = 0; i < COUNT; i++) {
        scale = std::max(scale, peaks_[i] = peak_of(s_.light + at_[i], s_.area(), s_.channels));
        if (!matted_) continue;
        const int row = (int)(at_[i] / s_.width), column = (int)(at_[i] % s_.width), which = s_.block_of(row, column);
        if (s_.has_block(which)) peaks_[i] = peak_of(s_.block(which).own + place_in_block(row, column), BLOCK_PIXELS, s_.channels);
      }
    const float own_peak = light / scale, dim_below = 5.0f / std::max(own_peak, 1e-12f);
    float dim_sum = 0, emitter_peak = 0, same_peak = 1e-12f;
    for (int i = 0; i < COUNT; i++) {
      const float counted = s_.valid ? s_.valid[at_[i]] : 1.0f, peak = peaks_[i] / scale, away = side * (coc_[i] - coc);
      const float same = counted * clamp01(2.0f - std::fabs(away));
      there_[i] = side == BEHIND || touches(i) ? counted * clamp01(away - 1.0f) : 0.0f;
      dim_[i] = same * falloff_[i] * clamp01(2.5f - dim_below * peak);
      dim_sum += dim_[i];
      emitter_peak = std::max(emitter_peak, there_[i] * peak);
      same_peak = std::max(same_peak, same * peak);
    }
    top = std::max(emitter_peak, same_peak);
    return clamp01(light / limit - 1.0f) * std::min(10.0f * dim_sum, 1.0f) * clamp01(10.0f * (emitter_peak / same_peak - share));
  }

  // For the last call of `certainty_beyond`: returns the emitter's coc; surface: light of the surface's darkest pixels.
  float measure_emitter(float light, std::vector<float> &surface) const {
    const float own_peak = light / scale, least_dim = DIM * own_peak;
    float dimmest_sum = 0, lit_sum = 0, lit_coc = 0;
    surface.assign(s_.channels, 0.0f);
    for (int i = 0; i < COUNT; i++) {
      const float peak = peaks_[i] / scale, brightness = std::min(peak * peak, 1e30f);
      const float dimmest = dim_[i] / std::max(brightness + least_dim * least_dim, 1e-24f), lit = there_[i] * falloff_[i] * brightness;
      dimmest_sum += dimmest;
      for (int c = 0; c < s_.channels; c++) surface[c] += s_.light[c * s_.area() + at_[i]] / scale * dimmest;
      lit_sum += lit;
      lit_coc += (coc_[i] - nearest_) * lit;
    }
    for (float &colour : surface) colour /= std::max(dimmest_sum, 1e-12f);
    return nearest_ + lit_coc / std::max(lit_sum, 1e-12f);
  }

 private:
  static constexpr int ACROSS = 2 * EMITTER_REACH + 1, COUNT = ACROSS * ACROSS;
  static bool touches(int i) { return std::abs(i / ACROSS - EMITTER_REACH) <= TOUCHING && std::abs(i % ACROSS - EMITTER_REACH) <= TOUCHING; }
  const Surfaces &s_;
  const float *falloff_;
  const bool matted_;
  size_t at_[COUNT];
  float coc_[COUNT], peaks_[COUNT], there_[COUNT], dim_[COUNT], nearest_ = NEVER, nearest_touching_ = NEVER, farthest_ = -NEVER;

 public:
  float scale = 0, top = 0;  // scale: largest light around; top: largest light of both surfaces, relative to scale
};

// The highlight threshold of a pixel, if its light is above it; else 0.
float limit_of_highlight(const Job &job, int y, int x, float light, float least_limit) {
  const Surfaces &s = job.surfaces;
  if (!(light > least_limit) || (s.valid && !(s.valid[(size_t)y * s.width + x] > 0))) return 0.0f;
  const float limit = threshold_at(job, y, x);
  return light > limit ? limit : 0.0f;
}

// The own surface keeps what the other surface does not take.
void set_weight(const Surfaces &s, const Block &block, size_t at, int within, float weight) {
  for (int c = 0; c < s.channels; c++)
    block.own[c * BLOCK_PIXELS + within] = (s.light[c * s.area() + at] - weight * block.other[c * BLOCK_PIXELS + within]) / (1.0f - weight);
  block.weight[within] = weight;
  block.own_weight[within] = 1.0f - weight;
}

// Assigns the light of a highlight's pixel to the surface of its emitter, in front of the pixel's own surface or behind.
void attribute_emitter(Job &job, int y, int x, float least_limit, const float *falloff) {
  Surfaces &s = job.surfaces;
  const int channels = job.channels;
  const size_t at = (size_t)y * s.width + x, area = s.area();
  const float light = peak_of(s.light + at, area, channels), own_coc = s.coc[at];
  const float limit = limit_of_highlight(job, y, x, light, least_limit);
  if (!(limit > 0)) return;
  Around around(s, y, x, falloff, false);
  const int i = s.block_of(y, x), within = place_in_block(y, x);
  std::vector<float> surface;
  for (const Side side : {IN_FRONT, BEHIND}) {
    float sureness = around.certainty_beyond(own_coc, side, side == IN_FRONT ? 1.0f : 0.5f, light, limit);
    if (!(sureness > 0)) continue;
    const Block block = s.make_block(i);
    const float coc = around.measure_emitter(light, surface), floor = *std::max_element(surface.begin(), surface.end());
    const float share = clamp((light / around.scale - floor) / std::max(around.top - floor, 1e-12f), 1.0f - MOST_WEIGHT, MOST_WEIGHT);
    // an emitter seen behind a surface is not in front of it
    if (side == IN_FRONT) sureness *= 1.0f - around.certainty_beyond(coc, BEHIND, 0.5f, light, limit);
    const float given = std::max(side == IN_FRONT ? sureness : 2.0f * sureness - 1.0f, 0.0f);
    const float kept = std::max(side == IN_FRONT ? 1.0f - sureness : 1.0f - 2.0f * sureness, 0.0f) * block.weight[within];
    const float weight = kept + given * share, per_weight = weight > 0 ? 1.0f / std::max(weight, 1e-12f) : 0.0f;
    for (int c = 0; c < channels; c++) {
      const float emitter = std::max(s.light[c * area + at] / around.scale - (1.0f - share) * surface[c], 0.0f) * around.scale;
      float &other = block.other[c * BLOCK_PIXELS + within];
      other = (kept * other + given * emitter) * per_weight;
    }
    block.coc[within] += given * share * per_weight * (coc - block.coc[within]);
    set_weight(s, block, at, within, weight);
  }
}

// Factor of the other surface's weight in a highlight's pixel, below 1 if the emitter lies on the pixel's own surface:
// the other surface is dark around the pixel, after light of emitters seen through it was taken from it.
float weight_left(const Job &job, int y, int x, float least_limit, const float *falloff) {
  const Surfaces &s = job.surfaces;
  const int i = s.block_of(y, x), within = place_in_block(y, x);
  const size_t at = (size_t)y * s.width + x;
  const float light = peak_of(s.light + at, s.area(), s.channels), limit = limit_of_highlight(job, y, x, light, least_limit);
  const Block block = s.block(i);
  if (!(limit > 0) || !(block.weight[within] > 0)) return 1.0f;
  const float bright = clamp01(peak_of(block.other + within, BLOCK_PIXELS, s.channels) / std::max(limit, TINY) - 1.0f);
  const float beyond = s.coc[at] - block.coc[within], taken = bright * clamp01(std::fabs(beyond) - 1.0f);
  if (!(taken > 0)) return 1.0f;
  Around around(s, y, x, falloff, true);
  return 1.0f - taken * around.certainty_beyond(block.coc[within], beyond > 0 ? BEHIND : IN_FRONT, 1.0f, light, limit);
}

std::vector<float> falloff_around(int reach) {
  std::vector<float> falloff;
  for (int dy = -reach; dy <= reach; dy++)
    for (int dx = -reach; dx <= reach; dx++) falloff.push_back((float)std::exp(-(dy * dy + dx * dx) / 4.5));
  return falloff;
}

}  // namespace

Block Surfaces::make_block(int i) {
  if (blocks[i]) return block(i);
  const size_t size = (size_t)(2 * channels + 3) * BLOCK_PIXELS;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (!blocks_left_) {
      memory_.emplace_back(BLOCKS_AT_ONCE * size);
      blocks_left_ = BLOCKS_AT_ONCE;
    }
    blocks[i] = memory_.back().data() + --blocks_left_ * size;
  }
  memset(blocks[i], 0, size * sizeof(float));
  const Block made = block(i);
  const int y0 = i / block_columns * BLOCK, x0 = i % block_columns * BLOCK;
  const int rows = std::min(BLOCK, height - y0), columns = std::min(BLOCK, width - x0);
  for (int y = 0; y < rows; y++) {
    const size_t from = (size_t)(y0 + y) * width + x0;
    for (int c = 0; c < channels; c++)
      memcpy(made.own + c * BLOCK_PIXELS + y * BLOCK, light + c * area() + from, columns * sizeof(float));
    memcpy(made.coc + y * BLOCK, coc + from, columns * sizeof(float));
    for (int x = 0; x < columns; x++) made.own_weight[y * BLOCK + x] = valid ? valid[from + x] : 1.0f;
  }
  return made;
}

void Job::split_mixed() {
  const std::vector<float> falloff = falloff_around(REACH), around_emitter = falloff_around(EMITTER_REACH);
  const bool emitters = scene.kind != TORCHDOF_BACKGROUND;  // a given background replaces the light behind
  const int rows = surfaces.block_rows, columns = surfaces.block_columns;
  std::vector<std::unique_ptr<Window>> windows(std::max(1, scene.threads));
  struct Left { int y, x; float weight; };
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
      float low = NEVER, high = -NEVER;
      for (int v = std::max(by - 1, 0); v <= std::min(by + 1, rows - 1); v++)
        for (int u = std::max(bx - 1, 0); u <= std::min(bx + 1, columns - 1); u++) {
          low = std::min(low, block_low[v * columns + u]);
          high = std::max(high, block_high[v * columns + u]);
        }
      if (!(high - low > EDGE_PX)) continue;
      const int y0 = by * BLOCK, x0 = bx * BLOCK;
      if (find_edges(*this, y0, x0, w)) split_block(*this, by, bx, w, falloff.data());
      if (!(high - low > 1)) continue;
      each_highlight(by, bx, [&](int y, int x, float least_limit) { attribute_emitter(*this, y, x, least_limit, around_emitter.data()); });
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
      set_weight(surfaces, block, (size_t)l.y * width + l.x, within, l.weight * block.weight[within]);
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
      const size_t at = (size_t)y * width + x;
      const float *own_coc, *own_weight, *other_coc, *weight;
      surfaces.row(0, y, x, own.data(), own_coc, own_weight);
      const bool mixed = surfaces.row(1, y, x, other.data(), other_coc, weight);
      bool known = std::isfinite(scene.coc[1][at]);
      for (int c = 0; c < channels; c++) known &= std::isfinite(scene.light[1][c * area + at]);
      const float here = surfaces.coc[at], there = clamp(scene.coc[1][at], low, high), apart = clamp01(there - here - SAME_PX);
      // a given background replaces the farther surface of a mixed pixel
      const float share = mixed && *other_coc < here ? *weight : 0.0f;
      for (int c = 0; c < channels; c++) {
        planes[0][c * area + at] = mixed ? *other[c] : 0.0f;
        planes[1][c * area + at] = *own[c];
        planes[2][c * area + at] = known ? scene.light[1][c * area + at] : 0.0f;
      }
      const float coc[3] = {mixed ? *other_coc : here, here, std::max(known ? there : 0.0f, here)};
      // apart = 0: the background is the surface in the image
      const float weights[3] = {share, own_weight ? *own_weight : 1.0f, known ? apart + (1.0f - apart) * share : 0.0f};
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

}  // namespace torchdof
