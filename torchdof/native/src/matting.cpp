// Matting: a pixel at a depth edge mixes the light of two surfaces but has the depth of one. Splits it into both, as
// described in render/matting.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

// Constants of render/matting.py, which gives their meanings, units and effects: mixed pixels, emitters.
constexpr float EDGE_PX = 0.5f, UNCLEAN = 1e-2f, TRUST = 4.0f, ALIKE = 1.0f / 255, UNBOUNDED = 1e6f;
constexpr int EMITTER_REACH = 3, TOUCHING = 2;
constexpr float DIM = 0.1f, MOST_WEIGHT = 0.98f;
constexpr float SAME_PX = 0.5f;  // px of coc: a background at most this far behind the image's surface is the same surface
enum Side { IN_FRONT = -1, BEHIND = 1 };  // of an emitter, relative to a surface

// Windows around the pixels of a block
constexpr int REACH = 1;                   // pixels around a mixed pixel that define its two colours
constexpr int AROUND = 2 * REACH + 1;
constexpr int TAPS = AROUND * AROUND;
constexpr int MARGIN = REACH + 1;          // edges depend on the pixels next to them
constexpr int SIDE = BLOCK + 2 * MARGIN;   // of the window of coc
constexpr int EDGES = BLOCK + 2 * REACH;   // of the windows of edges and light
constexpr int PITCH = 24;                  // of both

float falloff_at(int dy, int dx) { return (float)std::exp(-(dy * dy + dx * dx) / 4.5); }

struct Window {
  float coc[SIDE * PITCH], valid[SIDE * PITCH], edge[EDGES * PITCH];
  std::vector<float> light;  // [channels, EDGES, PITCH]
  std::vector<vec> around;   // of LANES pixels: light around them [channels, TAPS] and the colours of their surfaces
};

// Computes for each pixel in and around a block the confidence, 0 to 1, that it lies at an edge. False if it is 0 in the
// whole block.
bool find_edges(const Job &job, int y0, int x0, Window &w) {
  const int H = job.height, W = job.width;
  const float *coc = job.surfaces.coc, *valid = job.surfaces.valid;
  float lows[SIDE * PITCH], highs[SIDE * PITCH];  // of valid pixels
  const float *low = valid ? lows : w.coc, *high = valid ? highs : w.coc;
  const bool inside = x0 >= MARGIN && x0 + BLOCK + MARGIN <= W;
  for (int i = 0; i < SIDE; i++) {
    const size_t row = (size_t)std::clamp(y0 - MARGIN + i, 0, H - 1) * W;
    if (inside && !valid) memcpy(w.coc + i * PITCH, coc + row + x0 - MARGIN, SIDE * sizeof(float));
    for (int j = inside && !valid ? SIDE : 0; j < SIDE; j++) {
      const size_t at = row + std::clamp(x0 - MARGIN + j, 0, W - 1);
      w.coc[i * PITCH + j] = coc[at];
      if (!valid) continue;
      w.valid[i * PITCH + j] = valid[at];
      lows[i * PITCH + j] = valid[at] > 0 ? coc[at] : NEVER;
      highs[i * PITCH + j] = valid[at] > 0 ? coc[at] : -NEVER;
    }
    for (int j = SIDE; j < PITCH; j++) w.coc[i * PITCH + j] = lows[i * PITCH + j] = highs[i * PITCH + j] = 0;
  }
  bool any = false;
  for (int i = 0; i < EDGES; i++) {
    // a pixel outside the frame is the nearest one inside
    const int y = std::clamp(y0 - REACH + i, 0, H - 1) - y0 + MARGIN;
    float least_of[PITCH + LANES], most_of[PITCH + LANES];
    for (int j = 0; j < PITCH; j += LANES) {
      auto row = [&](const float *values, int k) { return load<vec>(values + (y - 1 + k) * PITCH + j); };
      store(least_of + j, least(least(row(low, 0), row(low, 1)), row(low, 2)));
      store(most_of + j, most(most(row(high, 0), row(high, 1)), row(high, 2)));
    }
    if (inside && !valid) {
      vec most_edge = {};
      for (int j = 0; j < PITCH; j += LANES) {
        auto high_of = [&](int k) { return load<vec>(most_of + j + k); };
        auto low_of = [&](int k) { return load<vec>(least_of + j + k); };
        const vec gap = most(most(high_of(0), high_of(1)), high_of(2)) - least(least(low_of(0), low_of(1)), low_of(2));
        store(w.edge + i * PITCH + j, clamp01(gap * (1.0f / EDGE_PX) - all(1.0f)));
      }
      for (int j = REACH; j < REACH + BLOCK; j += LANES) most_edge = most(most_edge, load<vec>(w.edge + i * PITCH + j));
      any |= i >= REACH && i < REACH + BLOCK && any_positive(most_edge);
      continue;
    }
    for (int j = 0; j < EDGES; j++) {
      const int x = std::clamp(x0 - REACH + j, 0, W - 1) - x0 + MARGIN;
      const float gap = std::max(std::max(most_of[x - 1], most_of[x]), most_of[x + 1]) -
                        std::min(std::min(least_of[x - 1], least_of[x]), least_of[x + 1]);
      float edge = clamp01(gap / EDGE_PX - 1.0f);
      if (valid) edge *= w.valid[y * PITCH + x];
      w.edge[i * PITCH + j] = edge;
      any |= edge > 0 && i >= REACH && i < REACH + BLOCK && j >= REACH && j < REACH + BLOCK;
    }
  }
  return any;
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

// The two surfaces of LANES pixels of a row, and the terms from which they follow.
struct Mix {
  vec coc[TAPS], near, far, gap, per_gap, scale;  // scale: brightest light around; all light is relative to it
  vec *light, *front, *behind, *colour;           // [channels, TAPS]; colours of both surfaces and of the pixel, [channels]
  vec weight[TAPS], nearer[TAPS], farther[TAPS];  // of the pixels around: of all, in the front's mean, in the mean behind
  vec near_weight[TAPS], differs[TAPS];           // weight in the front's mean without `differs`; difference from behind
  vec whole, clean;                               // sum of `near_weight`; 1 where the front has unmixed pixels
  vec strength, fitted, misfit, variance, trust, aside, sided, edge, certainty;
  vec other, own;  // weights of the other surface and of the pixel's own one
  ivec is_near;
};
inline int tap(int i) { return i / AROUND * PITCH + i % AROUND; }

// 1. The near and far coc are the extremes of the 3 x 3 neighbours.
// 2. The colour of each surface is the mean of its unmixed neighbours. If a thin foreground has no such neighbours, they
//    count by their difference from the background.
// 3. The share of the near surface is the projection of the pixel's colour onto the line between both colours.
// 4. The share of the other surface is at most 1/2, and smaller where texture makes the projection unreliable.
template <int CHANNELS>
void mix(const Job &job, Window &w, int y, int x, const float *falloff, Mix &m) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  const bool masked = job.surfaces.valid;
  const size_t first = (size_t)y * PITCH + x, in_coc = first + PITCH + 1;
  m.near = all(NEVER), m.far = all(-NEVER), m.scale = all(TINY);
  for (int i = 0; i < TAPS; i++) {
    m.coc[i] = load<vec>(w.coc + in_coc + tap(i));
    const auto known = masked ? load<vec>(w.valid + in_coc + tap(i)) > vec{} : ivec{} == 0;
    m.near = least(m.near, known ? m.coc[i] : all(NEVER));
    m.far = most(m.far, known ? m.coc[i] : all(-NEVER));
  }
  m.light = w.around.data(), m.front = m.light + C * TAPS, m.behind = m.front + C, m.colour = m.behind + C;
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      const vec v = m.light[c * TAPS + i] = load<vec>(w.light.data() + (size_t)c * EDGES * PITCH + first + tap(i));
      m.scale = most(m.scale, most(v, -v));
    }
  for (int i = 0; i < C * TAPS; i++) m.light[i] /= m.scale;
  const vec here = m.coc[TAPS / 2];
  m.gap = most(m.far - m.near, all(1e-6f)), m.per_gap = all(1.0f) / m.gap, m.whole = vec{};
  for (int i = 0; i < TAPS; i++) {
    m.weight[i] = (all(1.0f + UNCLEAN) - load<vec>(w.edge + first + tap(i))) * falloff[i];
    if (masked) m.weight[i] *= load<vec>(w.valid + in_coc + tap(i));
    const vec nearness = (m.far - m.coc[i]) / m.gap;  // not times 1 / gap, whose rounding the clamps below enlarge
    m.nearer[i] = m.near_weight[i] = m.weight[i] * clamp01(4.0f * nearness - 2.8f);
    m.farther[i] = m.weight[i] * clamp01(1.2f - 4.0f * nearness);
    m.whole += m.nearer[i];
  }
  m.variance = mean<CHANNELS>(m.light, C, m.farther, m.behind);
  m.clean = clamp01(m.whole * (0.1f / UNCLEAN) - 1.0f);
  if (any_of(m.clean < all(1.0f))) {
    vec most_of = {};
    for (int i = 0; i < TAPS; i++) m.differs[i] = vec{};
    for (int c = 0; c < C; c++)
      for (int i = 0; i < TAPS; i++) {
        const vec d = m.light[c * TAPS + i] - m.behind[c];
        m.differs[i] += d * d;
      }
    for (int i = 0; i < TAPS; i++) most_of = most(most_of, m.differs[i]);
    const vec each = 1.0f / (most_of + ALIKE * ALIKE);
    for (int i = 0; i < TAPS; i++) {
      const vec part = (m.differs[i] + ALIKE * ALIKE) * each;
      m.nearer[i] *= part + m.clean * (1.0f - part);
    }
  }
  m.variance += mean<CHANNELS>(m.light, C, m.nearer, m.front);

  vec along = {};
  m.strength = m.misfit = vec{};
  for (int c = 0; c < C; c++) {
    const vec contrast = m.front[c] - m.behind[c];
    m.colour[c] = m.light[c * TAPS + TAPS / 2];
    m.strength += contrast * contrast;
    along += (m.colour[c] - m.behind[c]) * contrast;
  }
  m.is_near = here - m.near < m.far - here;
  m.fitted = along / most(m.strength, all(1e-12f));
  const vec fitted = clamp01(m.fitted);
  for (int c = 0; c < C; c++) {
    const vec left = m.colour[c] - m.behind[c] - fitted * (m.front[c] - m.behind[c]);
    m.misfit += left * left;
  }
  m.trust = m.strength / (m.strength + TRUST * (m.variance + m.misfit) + ALIKE * ALIKE);
  m.aside = (here - m.near) - (m.far - here), m.sided = most(m.aside, -m.aside) * m.per_gap;
  m.edge = load<vec>(w.edge + first + tap(TAPS / 2));
  m.certainty = m.edge * m.trust * clamp01(4.0f * m.sided - 2.0f);
  m.other = least(m.is_near ? 1.0f - fitted : fitted, all(0.5f)) * m.certainty, m.own = 1.0f - m.other;
}

// Light of the other surface in a pixel, times its weight. The residual colour goes to both surfaces in proportion to their
// shares, within the range of the image's light.
struct Moved {
  vec own_mean, other_mean, darkest, brightest, unexplained, of_each, steps[4], value;
};
inline Moved moved_of(const Job &job, const Mix &m, int c) {
  Moved v;
  const vec colour = m.colour[c];
  v.own_mean = m.is_near ? m.front[c] : m.behind[c], v.other_mean = m.is_near ? m.behind[c] : m.front[c];
  v.unexplained = colour - m.own * v.own_mean - m.other * v.other_mean;
  v.darkest = most(job.light_least[c] / m.scale, all(-UNBOUNDED)), v.brightest = least(job.light_most[c] / m.scale, all(UNBOUNDED));
  v.of_each = m.other / (m.other * m.other + m.own * m.own);
  // the two parts still sum to the pixel, and neither is brighter or darker than the image
  v.steps[0] = m.other * (v.other_mean + v.unexplained * v.of_each);
  v.steps[1] = most(v.steps[0], colour - m.own * v.brightest);
  v.steps[2] = least(v.steps[1], colour - m.own * v.darkest);
  v.steps[3] = most(v.steps[2], m.other * v.darkest);
  v.value = least(v.steps[3], m.other * v.brightest);
  return v;
}

// Splits the pixels of `beside`, out of LANES pixels of a row.
template <int CHANNELS>
void split(const Job &job, Window &w, int y, int x, ivec beside, const float *falloff, const Block &block) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  Mix m;
  mix<CHANNELS>(job, w, y, x, falloff, m);
  const vec per_own = 1.0f / m.own, per_other = 1.0f / most(m.other, all(1e-12f));
  auto put = [&](float *plane, vec value) {
    float *const to = plane + y * BLOCK + x;
    store(to, beside ? value : load<vec>(to));
  };
  for (int c = 0; c < C; c++) {
    const vec moved = moved_of(job, m, c).value;
    put(block.own + c * BLOCK_PIXELS, (m.colour[c] - moved) * per_own * m.scale);
    put(block.other + c * BLOCK_PIXELS, m.other > vec{} ? moved * per_other * m.scale : vec{});
  }
  const vec valid = job.surfaces.valid ? load<vec>(w.valid + (size_t)(y + 1) * PITCH + x + 1 + tap(TAPS / 2)) : all(1.0f);
  put(block.coc, m.is_near ? m.far : m.near);
  put(block.weight, m.other * valid);
  put(block.own_weight, m.own * valid);
}

// Reads the light in and around a block, and calls body(y, x, beside) for each LANES of its pixels of which some lie at an
// edge.
template <typename Body>
void each_edge(const Job &job, int y0, int x0, Window &w, const Body &body) {
  const int height = job.height, width = job.width;
  const bool inside = x0 >= REACH && x0 + BLOCK + REACH <= width;
  for (int c = 0; c < job.channels; c++)
    for (int i = 0; i < EDGES; i++) {
      const float *from = job.surfaces.light + c * job.surfaces.area() + (size_t)std::clamp(y0 - REACH + i, 0, height - 1) * width;
      float *to = w.light.data() + ((size_t)c * EDGES + i) * PITCH;
      if (inside)
        memcpy(to, from + x0 - REACH, EDGES * sizeof(float));
      else
        for (int j = 0; j < EDGES; j++) to[j] = from[std::clamp(x0 - REACH + j, 0, width - 1)];
    }
  ivec lane;
  for (int i = 0; i < LANES; i++) lane[i] = i;
  for (int y = 0; y < std::min(BLOCK, height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, width - x0); x += LANES) {
      const ivec beside = (load<vec>(w.edge + (y + REACH) * PITCH + x + REACH) > vec{}) & (lane < width - x0 - x);
      if (any_of(beside)) body(y, x, beside);
    }
}

void split_block(Job &job, int by, int bx, Window &w, const float *falloff) {
  const Block block = job.surfaces.make_block(by * job.surfaces.block_columns + bx);
  each_edge(job, by * BLOCK, bx * BLOCK, w, [&](int y, int x, ivec beside) {
    job.channels == 3 ? split<3>(job, w, y, x, beside, falloff, block) : split<0>(job, w, y, x, beside, falloff, block);
  });
}

// Estimates from the pixels around a highlight on which surface its emitter lies.
class Around {
 public:
  Around(const Surfaces &s, int y, int x, const float *falloff) : s_(s), falloff_(falloff) {
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
      for (int i = 0; i < COUNT; i++) scale = std::max(scale, peaks_[i] = peak_of(s_.light + at_[i], s_.area(), s_.channels));
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
      const float peak = peaks_[i] / scale, dimmest = dim_[i] / std::max(peak * peak + least_dim * least_dim, 1e-24f);
      const float lit = there_[i] * falloff_[i] * peak * peak;
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
  size_t at_[COUNT];
  float coc_[COUNT], peaks_[COUNT], there_[COUNT], dim_[COUNT], nearest_ = NEVER, nearest_touching_ = NEVER, farthest_ = -NEVER;

 public:
  float scale = 0, top = 0;  // scale: largest light around; top: largest light of both surfaces, relative to scale
};

// Assigns the light of a highlight's pixel to the surface of its emitter, in front of the pixel's own surface or behind.
// First the emitter's surface gets the light; then a dark surface returns the light that matting gave to it.
void attribute_emitter(Job &job, int y, int x, float least_limit, const float *falloff) {
  Surfaces &s = job.surfaces;
  const int channels = job.channels;
  const size_t at = (size_t)y * s.width + x, area = s.area();
  const float light = peak_of(s.light + at, area, channels), own_coc = s.coc[at];
  if (!(light > least_limit) || (s.valid && !(s.valid[at] > 0))) return;
  const float limit = threshold_at(job, y, x);
  if (!(light > limit)) return;
  Around around(s, y, x, falloff);
  const int i = y / BLOCK * s.block_columns + x / BLOCK, within = y % BLOCK * BLOCK + x % BLOCK;
  std::vector<float> surface, emitter;
  bool changed = false;
  for (const Side side : {IN_FRONT, BEHIND}) {
    float sureness = around.certainty_beyond(own_coc, side, side == IN_FRONT ? 1.0f : 0.5f, light, limit);
    if (sureness > 0) {
      const Block block = s.make_block(i);
      const float coc = around.measure_emitter(light, surface), floor = *std::max_element(surface.begin(), surface.end());
      const float share = clamp((light / around.scale - floor) / std::max(around.top - floor, 1e-12f), 1.0f - MOST_WEIGHT, MOST_WEIGHT);
      emitter.resize(channels);
      for (int c = 0; c < channels; c++)
        emitter[c] = std::max(s.light[c * area + at] / around.scale - (1.0f - share) * surface[c], 0.0f) * around.scale;
      // an emitter seen behind a surface is not in front of it
      if (side == IN_FRONT) sureness *= 1.0f - around.certainty_beyond(coc, BEHIND, 0.5f, light, limit);
      const float given = std::max(side == IN_FRONT ? sureness : 2.0f * sureness - 1.0f, 0.0f);
      const float kept = std::max(side == IN_FRONT ? 1.0f - sureness : 1.0f - 2.0f * sureness, 0.0f) * block.weight[within];
      const float weight = kept + given * share, per_weight = weight > 0 ? 1.0f / std::max(weight, 1e-12f) : 0.0f;
      for (int c = 0; c < channels; c++) {
        float &other = block.other[c * BLOCK_PIXELS + within];
        other = (kept * other + given * emitter[c]) * per_weight;
      }
      block.coc[within] += given * share * per_weight * (coc - block.coc[within]);
      block.weight[within] = weight;
      changed = true;
    }
    if (!s.has_block(i)) continue;

    // return light of this pixel that was given to the other surface, if that surface is dark around it
    const Block block = s.block(i);
    const float other_light = peak_of(block.other + within, BLOCK_PIXELS, channels);
    const float taken = clamp01(side * (own_coc - block.coc[within]) - 1.0f) * clamp01(other_light / std::max(limit, TINY) - 1.0f);
    if (!(block.weight[within] * taken > 0)) continue;
    const float given_back = taken * around.certainty_beyond(block.coc[within], side, 1.0f, light, limit);
    block.weight[within] *= 1.0f - given_back;
    changed |= given_back > 0;
  }
  if (!changed) return;
  const Block block = s.block(i);
  const float weight = block.weight[within];
  for (int c = 0; c < channels; c++)
    block.own[c * BLOCK_PIXELS + within] = (s.light[c * area + at] - weight * block.other[c * BLOCK_PIXELS + within]) / (1.0f - weight);
  block.own_weight[within] = 1.0f - weight;
}

// The gradient of `split`, for training: the derivatives of `mix`, `moved_of` and `split`, last operation first.
class Gradient {
 public:
  // slopes: gradient of own light, other light, other coc and other weight, [2 channels + 2, height, width].
  Gradient(const Job &job, const float *falloff, const float *slopes) : job_(job), s_(job.surfaces), falloff_(falloff), slopes_(slopes), C_(job.channels) {}

  // Adds the gradients of light and coc to those of an image that is not split.
  void run(float *of_light, float *of_coc) const {
    const size_t area = s_.area();
    Buffer<float> of_edge(area);
    for (size_t i = 0; i < area; i++) of_edge[i] = 0;
    std::vector<float> of_extremes(2 * C_, 0.0f);
    each_band([&](int band, std::vector<float> &sums) {
      Window w;
      w.light.assign((size_t)C_ * EDGES * PITCH, 0.0f);
      w.around.resize((size_t)C_ * (2 * TAPS + 6));
      sums.assign(plane() * (C_ + 2) + 2 * C_, 0.0f);
      for (int bx = 0; bx < s_.block_columns; bx++)
        if (find_edges(job_, band * BLOCK, bx * BLOCK, w))
          each_edge(job_, band * BLOCK, bx * BLOCK, w, [&](int y, int x, ivec beside) {
            C_ == 3 ? back<3>(w, band * BLOCK, bx * BLOCK, y, x, beside, sums.data()) : back<0>(w, band * BLOCK, bx * BLOCK, y, x, beside, sums.data());
          });
    }, [&](int band, const std::vector<float> &sums) {
      for (int c = 0; c < C_; c++) merge(band, sums.data() + c * plane(), of_light + c * area);
      merge(band, sums.data() + C_ * plane(), of_coc);
      merge(band, sums.data() + (C_ + 1) * plane(), of_edge.data());
      for (int i = 0; i < 2 * C_; i++) of_extremes[i] += sums[plane() * (C_ + 2) + i];
    });
    each_band([&](int band, std::vector<float> &sums) {
      sums.assign(plane(), 0.0f);
      for (int y = band * BLOCK; y < std::min(s_.height, (band + 1) * BLOCK); y++)
        for (int x = 0; x < s_.width; x++)
          if (of_edge[(size_t)y * s_.width + x] != 0) edge_back(y, x, of_edge[(size_t)y * s_.width + x], band, sums.data());
    }, [&](int band, const std::vector<float> &sums) { merge(band, sums.data(), of_coc); });
    for (int c = 0; c < C_; c++)
      for (const bool is_most : {false, true}) {
        const float extreme = is_most ? job_.light_most[c] : job_.light_least[c], slope = of_extremes[2 * c + is_most];
        if (slope == 0) continue;
        const float *light = s_.light + c * area;
        const float each = slope / std::count(light, light + area, extreme);
        for (size_t i = 0; i < area; i++) of_light[c * area + i] += light[i] == extreme ? each : 0.0f;
      }
  }

 private:
  size_t plane() const { return (size_t)(BLOCK + 2) * s_.width; }  // rows of a band of blocks, and one more on each side

  // Fills the sums of each band in parallel, and merges them in order, so that threads do not change the bits.
  template <typename Fill, typename Merge>
  void each_band(const Fill &fill, const Merge &merge) const {
    std::vector<std::vector<float>> sums(s_.block_rows);
    job_.parallel(s_.block_rows, [&](int band, int) { fill(band, sums[band]); });
    for (int band = 0; band < s_.block_rows; band++) merge(band, sums[band]);
  }
  void merge(int band, const float *from, float *to) const {
    for (int i = 0; i < BLOCK + 2; i++) {
      const int y = band * BLOCK - 1 + i;
      for (int x = 0; y >= 0 && y < s_.height && x < s_.width; x++) to[(size_t)y * s_.width + x] += from[(size_t)i * s_.width + x];
    }
  }
  // Position of a pixel around (y, x) in the sums of its band.
  size_t at(int band, int y, int x, int i) const {
    const int row = std::clamp(y + i / AROUND - REACH, 0, s_.height - 1), column = std::clamp(x + i % AROUND - REACH, 0, s_.width - 1);
    return (size_t)(row - band * BLOCK + 1) * s_.width + column;
  }

  static constexpr float ROUNDING = 1e-6f;
  static vec when(ivec condition, vec value) { return condition ? value : vec{}; }
  static ivec inside(vec v) { return (v >= vec{}) & (v <= all(1.0f)); }
  // Share of the gradient of max(a, b) that goes to a.
  static vec of_first(vec a, vec b) { return a > b ? all(1.0f) : a == b ? all(0.5f) : vec{}; }

  // Adds to the gradients of light [channels, TAPS] and sets that of the weights, from those of `mean` and its variance.
  void mean_back(const vec *light, const vec *weight, const vec *mean, const vec *of_mean, vec of_variance, vec *of_light, vec *of_weight) const {
    vec sum = {};
    for (int i = 0; i < TAPS; i++) sum += weight[i], of_weight[i] = vec{};
    const vec per = all(1.0f) / most(sum, all(1e-12f));
    const ivec counted = sum >= all(1e-12f);  // the sum is the divisor
    for (int c = 0; c < C_; c++, light += TAPS, of_light += TAPS) {
      vec moment = {}, spread = {};
      for (int i = 0; i < TAPS; i++) {
        const vec away = light[i] - mean[c];
        moment += away * weight[i];
        spread += away * away * weight[i];
      }
      const vec its = of_mean[c] - 2.0f * of_variance * moment * per, middle = when(counted, mean[c]), variance = when(counted, spread * per);
      for (int i = 0; i < TAPS; i++) {
        const vec away = light[i] - mean[c];
        of_light[i] += (its + 2.0f * of_variance * away) * weight[i] * per;
        of_weight[i] += (its * (light[i] - middle) + of_variance * (away * away - variance)) * per;
      }
    }
  }

  template <int CHANNELS>
  void back(Window &w, int y0, int x0, int y, int x, ivec beside, float *sums) const {
    const int C = CHANNELS ? CHANNELS : C_, n = std::min(LANES, s_.width - x0 - x);
    const size_t area = s_.area(), here = (size_t)(y0 + y) * s_.width + x0 + x;
    Mix m;
    mix<CHANNELS>(job_, w, y, x, falloff_, m);
    vec *const of_light = m.colour + C, *const of_front = of_light + C * TAPS, *const of_behind = of_front + C, *const of_colour = of_behind + C;
    for (int i = 0; i < C * TAPS; i++) of_light[i] = vec{};
    auto slope = [&](int plane) {
      vec v = {};
      memcpy(&v, slopes_ + plane * area + here, n * sizeof(float));
      return beside ? v : vec{};
    };
    const vec of_given = slope(2 * C), per_own = 1.0f / m.own, per_other = 1.0f / most(m.other, all(1e-12f));
    vec of_other = slope(2 * C + 1), of_own = {}, of_each = {}, each = {};
    vec of_far = when(m.is_near, of_given), of_near = of_given - of_far, of_gap = {}, of_coc[TAPS] = {}, of_edge[TAPS] = {};

    // the light of both surfaces
    for (int c = 0; c < C; c++) {
      const Moved v = moved_of(job_, m, c);
      each = v.of_each;
      const vec of_its = slope(c) * m.scale * per_own, of_theirs = when(m.other > vec{}, slope(C + c) * m.scale * per_other);
      vec of_moved = of_theirs - of_its, of_darkest = {}, of_brightest = {};
      of_colour[c] = of_its;
      of_own -= of_its * (m.colour[c] - v.value) * per_own;
      of_other -= when(m.other >= all(1e-12f), of_theirs * v.value * per_other);
      auto bounded = [&](vec first) {  // keeps the part of the gradient that passes a bound; returns that of the bound
        const vec of_bound = of_moved * (1.0f - first);
        of_moved -= of_bound;
        return of_bound;
      };
      vec of_bound = bounded(of_first(-v.steps[3], -m.other * v.brightest));
      of_other += of_bound * v.brightest, of_brightest += of_bound * m.other;
      of_bound = bounded(of_first(v.steps[2], m.other * v.darkest));
      of_other += of_bound * v.darkest, of_darkest += of_bound * m.other;
      of_bound = bounded(of_first(-v.steps[1], m.own * v.darkest - m.colour[c]));
      of_colour[c] += of_bound, of_own -= of_bound * v.darkest, of_darkest -= of_bound * m.own;
      of_bound = bounded(of_first(v.steps[0], m.colour[c] - m.own * v.brightest));
      of_colour[c] += of_bound, of_own -= of_bound * v.brightest, of_brightest -= of_bound * m.own;
      const vec of_unexplained = of_moved * m.other * v.of_each;
      const vec of_own_mean = -of_unexplained * m.own, of_other_mean = of_moved * m.other - of_unexplained * m.other;
      of_other += of_moved * (v.other_mean + v.unexplained * v.of_each) - of_unexplained * v.other_mean;
      of_own -= of_unexplained * v.own_mean;
      of_each += of_moved * m.other * v.unexplained;
      of_colour[c] += of_unexplained;
      of_front[c] = m.is_near ? of_own_mean : of_other_mean;
      of_behind[c] = m.is_near ? of_other_mean : of_own_mean;
      const vec per_scale = 1.0f / m.scale;
      float *extremes = sums + plane() * (C + 2) + 2 * c;
      extremes[0] += sum(when(v.darkest > all(-UNBOUNDED), of_darkest) * per_scale);
      extremes[1] += sum(when(v.brightest < all(UNBOUNDED), of_brightest) * per_scale);
    }

    // the weight of the other surface
    const vec per_squares = 1.0f / (m.other * m.other + m.own * m.own), of_squares = -of_each * each * per_squares;
    of_other += of_each * per_squares + 2.0f * m.other * of_squares;
    of_own += 2.0f * m.own * of_squares;
    of_other -= of_own;
    const vec fitted = clamp01(m.fitted), share = m.is_near ? 1.0f - fitted : fitted, aside = 4.0f * m.sided - 2.0f;
    const vec of_certainty = of_other * least(share, all(0.5f)), of_share = when(share <= all(0.5f), of_other * m.certainty);
    vec of_fitted = m.is_near ? -of_share : of_share;
    of_edge[TAPS / 2] = of_certainty * m.trust * clamp01(aside);
    const vec of_trust = of_certainty * m.edge * clamp01(aside), of_sided = when(inside(aside), 4.0f * of_certainty * m.edge * m.trust) * m.per_gap;
    const vec of_aside = m.aside > vec{} ? of_sided : when(m.aside < vec{}, -of_sided);
    of_gap -= of_sided * m.sided;
    of_coc[TAPS / 2] += 2.0f * of_aside;
    of_near -= of_aside;
    of_far -= of_aside;
    const vec per_trust = 1.0f / (m.strength + TRUST * (m.variance + m.misfit) + ALIKE * ALIKE);
    vec of_strength = of_trust * (1.0f - m.trust) * per_trust;
    const vec of_variance = -of_trust * m.trust * TRUST * per_trust;
    for (int c = 0; c < C; c++) of_fitted -= 2.0f * of_variance * (m.colour[c] - m.behind[c] - fitted * (m.front[c] - m.behind[c])) * (m.front[c] - m.behind[c]);
    // A pixel of the colour of a surface has a share of 1 up to rounding, where the gradient still passes.
    of_fitted = when((m.fitted >= all(-ROUNDING)) & (m.fitted <= all(1.0f + ROUNDING)), of_fitted) / most(m.strength, all(1e-12f));
    of_strength -= when(m.strength >= all(1e-12f), of_fitted * m.fitted);
    for (int c = 0; c < C; c++) {
      const vec contrast = m.front[c] - m.behind[c], away = m.colour[c] - m.behind[c], of_left = 2.0f * of_variance * (away - fitted * contrast);
      const vec of_contrast = of_fitted * away + 2.0f * of_strength * contrast - of_left * fitted, of_away = of_fitted * contrast + of_left;
      of_colour[c] += of_away;
      of_front[c] += of_contrast;
      of_behind[c] -= of_contrast + of_away;
    }

    // the colours of both surfaces
    vec of_nearer[TAPS], of_farther[TAPS];
    mean_back(m.light, m.nearer, m.front, of_front, of_variance, of_light, of_nearer);
    if (any_of(m.clean < all(1.0f))) {
      vec most_of = {}, of_most = {}, of_clean = {}, of_differs[TAPS], ties = {};
      for (int i = 0; i < TAPS; i++) most_of = most(most_of, m.differs[i]);
      const vec per = 1.0f / (most_of + ALIKE * ALIKE);
      for (int i = 0; i < TAPS; i++) {
        const vec part = (m.differs[i] + ALIKE * ALIKE) * per, of_factor = of_nearer[i] * m.near_weight[i];
        of_clean += of_factor * (1.0f - part);
        of_nearer[i] *= part + m.clean * (1.0f - part);
        of_differs[i] = of_factor * (1.0f - m.clean) * per;
        of_most -= of_differs[i] * part;
        ties += m.differs[i] == most_of ? all(1.0f) : vec{};
      }
      for (int i = 0; i < TAPS; i++) {
        of_differs[i] += when(m.differs[i] == most_of, of_most / ties);
        of_nearer[i] += when(inside(m.whole * (0.1f / UNCLEAN) - 1.0f), of_clean * (0.1f / UNCLEAN));
      }
      for (int c = 0; c < C; c++)
        for (int i = 0; i < TAPS; i++) {
          const vec its = 2.0f * of_differs[i] * (m.light[c * TAPS + i] - m.behind[c]);
          of_light[c * TAPS + i] += its;
          of_behind[c] -= its;
        }
    }
    mean_back(m.light, m.farther, m.behind, of_behind, of_variance, of_light, of_farther);

    // the places of the pixels around
    const size_t in_coc = (size_t)(y + 1) * PITCH + x + 1;
    for (int i = 0; i < TAPS; i++) {
      const vec nearness = (m.far - m.coc[i]) / m.gap, to_near = 4.0f * nearness - 2.8f, to_far = 1.2f - 4.0f * nearness;
      const vec of_nearness = 4.0f * m.weight[i] * (when(inside(to_near), of_nearer[i]) - when(inside(to_far), of_farther[i])) * m.per_gap;
      of_far += of_nearness;
      of_coc[i] -= of_nearness;
      of_gap -= of_nearness * nearness;
      of_edge[i] -= (of_nearer[i] * clamp01(to_near) + of_farther[i] * clamp01(to_far)) * falloff_[i] * (s_.valid ? load<vec>(w.valid + in_coc + tap(i)) : all(1.0f));
    }
    of_gap = when(m.far - m.near >= all(1e-6f), of_gap);
    of_far += of_gap;
    of_near -= of_gap;
    vec nearest = {}, farthest = {};  // number of equal extremes, which share the gradient
    auto known = [&](int i) { return s_.valid ? load<vec>(w.valid + in_coc + tap(i)) > vec{} : ivec{} == 0; };
    for (int i = 0; i < TAPS; i++) {
      nearest += when(known(i) & (m.coc[i] == m.near), all(1.0f));
      farthest += when(known(i) & (m.coc[i] == m.far), all(1.0f));
    }
    for (int i = 0; i < TAPS; i++) of_coc[i] += when(known(i) & (m.coc[i] == m.near), of_near / nearest) + when(known(i) & (m.coc[i] == m.far), of_far / farthest);

    for (int c = 0; c < C; c++) of_light[c * TAPS + TAPS / 2] += of_colour[c];
    const vec per_scale = 1.0f / m.scale;
    for (int i = 0; i < C * TAPS; i++) of_light[i] *= per_scale;
    for (int lane = 0; lane < n; lane++) {
      if (!beside[lane]) continue;
      for (int i = 0; i < TAPS; i++) {
        float *to = sums + at(y0 / BLOCK, y0 + y, x0 + x + lane, i);
        for (int c = 0; c < C; c++) to[c * plane()] += of_light[c * TAPS + i][lane];
        to[C * plane()] += of_coc[i][lane];
        to[(C + 1) * plane()] += of_edge[i][lane];
      }
      float *to = sums + at(y0 / BLOCK, y0 + y, x0 + x + lane, TAPS / 2);
      for (int c = 0; c < C; c++) to[c * plane()] -= slopes_[c * area + here + lane];
      to[C * plane()] -= slopes_[2 * C * area + here + lane];
    }
  }

  // Adds the gradients of the coc around a pixel, from that of its confidence of being at an edge.
  void edge_back(int y, int x, float slope, int band, float *sums) const {
    float low = NEVER, high = -NEVER, cocs[TAPS];
    bool known[TAPS];
    for (int i = 0; i < TAPS; i++) {
      const size_t from = at(band, y, x, i) + (size_t)(band * BLOCK) * s_.width - s_.width;
      cocs[i] = s_.coc[from];
      known[i] = !s_.valid || s_.valid[from] > 0;
      if (!known[i]) continue;
      low = std::min(low, cocs[i]);
      high = std::max(high, cocs[i]);
    }
    const float edge = (high - low) / EDGE_PX - 1.0f;
    if (!known[TAPS / 2] || !(edge > 0 && edge <= 1)) return;
    int lows = 0, highs = 0;
    for (int i = 0; i < TAPS; i++) lows += known[i] && cocs[i] == low, highs += known[i] && cocs[i] == high;
    for (int i = 0; i < TAPS; i++) {
      if (!known[i]) continue;
      if (cocs[i] == low) sums[at(band, y, x, i)] -= slope / EDGE_PX / lows;
      if (cocs[i] == high) sums[at(band, y, x, i)] += slope / EDGE_PX / highs;
    }
  }

  const Job &job_;
  const Surfaces &s_;
  const float *const falloff_, *const slopes_;
  const int C_;
};

std::vector<float> falloff_around(int reach) {
  std::vector<float> falloff;
  for (int dy = -reach; dy <= reach; dy++)
    for (int dx = -reach; dx <= reach; dx++) falloff.push_back(falloff_at(dy, dx));
  return falloff;
}

}  // namespace

void matte(const float *const *maps, int channels, int height, int width, int threads, const float *gradient, float *const *out) {
  torchdof_scene scene = {};
  scene.height = height, scene.width = width, scene.channels = channels, scene.threads = threads;
  scene.kind = TORCHDOF_BACKGROUND;  // emitters are not attributed
  Job job(scene);
  Surfaces &s = job.surfaces;
  s.height = height, s.width = width, s.channels = channels, s.count = 2;
  s.block_rows = ceil_div(height, BLOCK), s.block_columns = ceil_div(width, BLOCK);
  s.blocks.assign((size_t)s.block_rows * s.block_columns, nullptr);
  s.light = maps[0], s.coc = maps[1], s.valid = maps[2];
  const size_t area = s.area();
  for (int c = 0; c < channels; c++) {
    find_ends(s.light + c * area, area, threads, &job.light_least.emplace_back(), &job.light_most.emplace_back());
  }
  if (gradient) {  // of pixels that are not split: unchanged
    memcpy(out[0], gradient, channels * area * sizeof(float));
    memcpy(out[1], gradient + 2 * channels * area, area * sizeof(float));
    Gradient(job, falloff_around(REACH).data(), gradient).run(out[0], out[1]);
    return;
  }
  job.block_low = Buffer<float>(s.blocks.size()), job.block_high = Buffer<float>(s.blocks.size());
  job.parallel(s.block_rows, [&](int by, int) {
    const int first = by * s.block_columns, y0 = by * BLOCK;
    ends_of(s.coc + (size_t)y0 * width, width, std::min(BLOCK, height - y0), &job.block_low[first], &job.block_high[first]);
  });
  job.split_mixed();
  float *const planes = out[0];
  memcpy(planes, s.light, channels * area * sizeof(float));
  memset(planes + channels * area, 0, channels * area * sizeof(float));
  memcpy(planes + 2 * channels * area, s.coc, area * sizeof(float));
  memset(planes + (2 * channels + 1) * area, 0, area * sizeof(float));
  for (int i = 0; i < (int)s.blocks.size(); i++) {
    if (!s.has_block(i)) continue;
    const float *const from = s.block(i).own;  // own light, other light, coc and weight follow each other
    const int y0 = i / s.block_columns * BLOCK, x0 = i % s.block_columns * BLOCK, n = std::min(BLOCK, width - x0);
    for (int v = 0; v < 2 * channels + 2; v++)
      for (int y = 0; y < std::min(BLOCK, height - y0); y++)
        memcpy(planes + v * area + (size_t)(y0 + y) * width + x0, from + v * BLOCK_PIXELS + y * BLOCK, n * sizeof(float));
  }
}

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
  parallel(rows, [&](int by, int worker) {
    if (!windows[worker]) {
      windows[worker].reset(new Window());
      windows[worker]->light.assign((size_t)channels * EDGES * PITCH, 0.0f);
      windows[worker]->around.resize((size_t)channels * (TAPS + 3));
    }
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
      if (!(high - low > 1) || !emitters || !(block_peak[by * columns + bx] > least_threshold(*this, y0, x0))) continue;
      const float least_limit = least_threshold(*this, y0, x0);
      for (int y = y0; y < std::min(height, y0 + BLOCK); y++)
        for (int x = x0; x < std::min(width, x0 + BLOCK); x++) attribute_emitter(*this, y, x, least_limit, around_emitter.data());
    }
  });
}

void Job::add_background() {
  const size_t area = surfaces.area();
  const float *coc = surfaces.coc, *valid = surfaces.valid;
  for (int i = 0; i < 3; i++) copies.emplace_back(area * (channels + 2));
  float *planes[3];
  for (int i = 0; i < 3; i++) planes[i] = copies[copies.size() - 3 + i].data();
  const float low = coc_at(layers.front().node), high = coc_at(layers.back().node);
  const float *behind_light = scene.light[1], *behind_coc = scene.coc[1];
  parallel(height, [&](int y, int) {
    std::vector<const float *> own(channels), other(channels);
    for (int x = 0; x < width; x++) {
      const size_t at = (size_t)y * width + x;
      const float *own_coc, *other_coc = nullptr, *seen, *weight = nullptr;
      surfaces.row(0, y, x, own.data(), own_coc, seen);
      const bool mixed = surfaces.row(1, y, x, other.data(), other_coc, weight);
      const float valid_here = valid ? valid[at] : 1.0f, here = coc[at];
      // a given background replaces the farther surface of a mixed pixel
      const float share = mixed && *other_coc < here ? *weight : 0.0f;
      bool known = true;
      for (int c = 0; c < channels; c++) {
        planes[0][c * area + at] = mixed ? *other[c] : 0.0f;
        planes[1][c * area + at] = *own[c];
        const float light = behind_light[c * area + at];
        known &= std::isfinite(light);
        planes[2][c * area + at] = light;
      }
      known &= std::isfinite(behind_coc[at]);
      const float there = clamp(behind_coc[at], low, high), apart = clamp01(there - here - SAME_PX);
      float behind_weight = apart + (1.0f - apart) * share;  // apart = 0: the background is the surface in the image
      if (!known) {
        behind_weight = 0;
        for (int c = 0; c < channels; c++) planes[2][c * area + at] = 0.0f;
      }
      float *coc_of[3], *weight_of[3];
      for (int i = 0; i < 3; i++) {
        coc_of[i] = planes[i] + channels * area + at;
        weight_of[i] = coc_of[i] + area;
      }
      *coc_of[0] = mixed ? *other_coc : here;
      *coc_of[1] = here;
      *coc_of[2] = std::max(known ? there : 0.0f, here);
      *weight_of[0] = share;
      *weight_of[1] = seen ? *seen : valid_here;
      *weight_of[2] = behind_weight;
    }
  });
  for (int i = 0; i < 3; i++) {
    surfaces.lights.push_back(planes[i]);
    surfaces.cocs.push_back(planes[i] + channels * area);
    surfaces.weights.push_back(planes[i] + (channels + 1) * area);
  }
  surfaces.count = 3;
  surfaces.independent = true;
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
