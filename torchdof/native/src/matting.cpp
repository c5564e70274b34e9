// Matting: a pixel at a depth edge mixes the light of two surfaces but has the depth of one. Splits it into both, as
// described in render/matting.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

// Constants of render/matting.py, which gives their meanings, units and effects: mixed pixels, emitters.
constexpr float EDGE_PX = 0.5f, UNCLEAN = 1e-2f, TRUST = 10.0f, TEXTURE = 50.0f, MOST_CLEAN = 4.0f, ALIKE = 1.0f / 255, UNBOUNDED = 1e6f;
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

float falloff_at(int dy, int dx) { return (float)std::exp(-(dy * dy + dx * dx) / 4.5); }
constexpr float SMALL_BESIDE = 0.24935221f, SMALL_DIAGONAL = 0.06217652f;  // the same of a Gaussian of 0.6 px: _SOFTNESS_PX

struct Window {
  explicit Window(int channels) : light((size_t)channels * EDGES * PITCH + LANES), clean(light) {}

  float coc[SIDE * PITCH + LANES], valid[SIDE * PITCH + LANES], edge[EDGES * PITCH + LANES];
  std::vector<float> light;  // [channels, EDGES, PITCH]
  std::vector<float> clean;  // the same, without the light of other surfaces
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
    const int y = std::clamp(y0 - RIM + i, 0, H - 1) - y0 + MARGIN;
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
      for (int j = RIM; j < RIM + BLOCK; j += LANES) most_edge = most(most_edge, load<vec>(w.edge + i * PITCH + j));
      any |= i >= RIM && i < RIM + BLOCK && any_positive(most_edge);
      continue;
    }
    for (int j = 0; j < EDGES; j++) {
      const int x = std::clamp(x0 - RIM + j, 0, W - 1) - x0 + MARGIN;
      const float gap = std::max(std::max(most_of[x - 1], most_of[x]), most_of[x + 1]) -
                        std::min(std::min(least_of[x - 1], least_of[x]), least_of[x + 1]);
      float edge = clamp01(gap / EDGE_PX - 1.0f);
      if (valid) edge *= w.valid[y * PITCH + x];
      w.edge[i * PITCH + j] = edge;
      any |= edge > 0 && i >= RIM && i < RIM + BLOCK && j >= RIM && j < RIM + BLOCK;
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
  vec geometric;   // part of the other surface's weight that does not follow from colours
  vec other, own;  // weights of the other surface and of the pixel's own one
  ivec is_near;
};
inline int tap(int i) { return i / AROUND * PITCH + i % AROUND; }

// Replaces the light of mixed pixels by the mean of the unmixed pixels of the same surface around them.
void clean_light(const Job &job, int y0, int x0, Window &w, const float *falloff) {
  const auto clamped = [&](int i, int j) {  // a pixel outside the frame is the nearest one inside
    return (std::clamp(y0 - RIM + i, 0, job.height - 1) - y0 + RIM) * PITCH + std::clamp(x0 - RIM + j, 0, job.width - 1) - x0 + RIM;
  };
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
  const bool inside = y0 >= RIM && x0 >= RIM && y0 + BLOCK + RIM <= job.height && x0 + BLOCK + RIM <= job.width;
  for (int i = 1; i < EDGES - 1 && !inside; i++)
    for (int j = 1; j < EDGES - 1; j++)
      for (int c = 0; clamped(i, j) != i * PITCH + j && c < job.channels; c++) {
        float *const clean = w.clean.data() + (size_t)c * EDGES * PITCH;
        clean[i * PITCH + j] = clean[clamped(i, j)];
      }
}

// Takes the light of one surface out of the neighbours on the other: their light moves towards their clean light, along
// the line between the colours of both surfaces, and less where texture is strong.
template <int CHANNELS>
void separate(const Window &w, size_t first, int C, Mix &m) {
  vec *const light = m.light, *const clean = m.light + C * TAPS, *const front = m.front, *const behind = m.behind;
  const vec per_scale = 1.0f / m.scale;
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      const vec relative = load<vec>(w.clean.data() + (size_t)c * EDGES * PITCH + first + tap(i)) * per_scale;
      clean[c * TAPS + i] = most(least(relative, all(MOST_CLEAN)), all(-MOST_CLEAN));
    }
  const vec texture = mean<CHANNELS>(clean, C, m.farther, behind) + mean<CHANNELS>(clean, C, m.nearer, front);
  vec strength = {}, moved[TAPS] = {};
  for (int c = 0; c < C; c++) {
    const vec contrast = front[c] - behind[c];
    strength += contrast * contrast;
    for (int i = 0; i < TAPS; i++) moved[i] += (light[c * TAPS + i] - clean[c * TAPS + i]) * contrast;
  }
  const vec per_strength = 1.0f / (strength + TEXTURE * texture + ALIKE * ALIKE);
  for (int i = 0; i < TAPS; i++) {
    moved[i] *= per_strength;
    moved[i] = m.nearer[i] > m.farther[i] ? -clamp01(-moved[i]) : clamp01(moved[i]);
  }
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) light[c * TAPS + i] -= moved[i] * (front[c] - behind[c]);
}

// 1. The near and far coc are the extremes of the 3 x 3 neighbours.
// 2. The colour of each surface is the mean of its unmixed neighbours, or of the mixed ones without the light of the other
//    surface. If a thin foreground has no unmixed neighbours, they count by their difference from the background.
// 3. The share of the near surface is the projection of the pixel's colour onto the line between both colours.
// 4. The share of the other surface is at most 1/2. Where texture makes the projection unreliable, it is the share that
//    the other surface has under a small Gaussian, unless this contradicts the pixel's colour.
template <int CHANNELS>
void mix(const Job &job, Window &w, int y, int x, const float *falloff, Mix &m) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  const bool masked = job.surfaces.valid;
  const size_t first = (size_t)(y + 1) * PITCH + x + 1, in_coc = first + PITCH + 1;
  m.near = all(NEVER), m.far = all(-NEVER), m.scale = all(TINY);
  for (int i = 0; i < TAPS; i++) {
    m.coc[i] = load<vec>(w.coc + in_coc + tap(i));
    const auto known = masked ? load<vec>(w.valid + in_coc + tap(i)) > vec{} : ivec{} == 0;
    m.near = least(m.near, known ? m.coc[i] : all(NEVER));
    m.far = most(m.far, known ? m.coc[i] : all(-NEVER));
  }
  m.light = w.around.data(), m.front = m.light + 2 * C * TAPS, m.behind = m.front + C, m.colour = m.behind + C;
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      const vec v = m.light[c * TAPS + i] = load<vec>(w.light.data() + (size_t)c * EDGES * PITCH + first + tap(i));
      m.scale = most(m.scale, most(v, -v));
    }
  for (int i = 0; i < C * TAPS; i++) m.light[i] /= m.scale;
  for (int c = 0; c < C; c++) m.colour[c] = m.light[c * TAPS + TAPS / 2];
  const vec here = m.coc[TAPS / 2];
  m.gap = most(m.far - m.near, all(1e-6f)), m.per_gap = all(1.0f) / m.gap, m.whole = vec{};
  vec covered = {}, counted = {};  // by the near surface, under a small Gaussian
  for (int i = 0; i < TAPS; i++) {
    m.weight[i] = (all(1.0f + UNCLEAN) - load<vec>(w.edge + first + tap(i))) * falloff[i];
    if (masked) m.weight[i] *= load<vec>(w.valid + in_coc + tap(i));
    const vec nearness = (m.far - m.coc[i]) / m.gap;  // not times 1 / gap, whose rounding the clamps below enlarge
    m.nearer[i] = m.near_weight[i] = m.weight[i] * clamp01(4.0f * nearness - 2.8f);
    m.farther[i] = m.weight[i] * clamp01(1.2f - 4.0f * nearness);
    m.whole += m.nearer[i];
    vec small = all(i == TAPS / 2 ? 1.0f : i % 2 ? SMALL_BESIDE : SMALL_DIAGONAL);
    if (masked) small *= load<vec>(w.valid + in_coc + tap(i));
    covered += small * nearness, counted += small;
  }
  covered /= most(counted, all(1e-12f));
  separate<CHANNELS>(w, first, C, m);
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
  const vec clear = m.edge * clamp01(4.0f * m.sided - 2.0f), noise = m.variance + ALIKE * ALIKE;
  const vec misfit = m.misfit + (covered - fitted) * (covered - fitted) * m.strength;
  m.geometric = least(m.is_near ? 1.0f - covered : covered, all(0.5f)) * clear * (1.0f - m.trust) * noise / (noise + misfit);
  m.geometric *= clamp01(m.gap * (1.0f / EDGE_PX) - 2.0f);
  m.certainty = clear * m.trust;
  m.other = least(m.is_near ? 1.0f - fitted : fitted, all(0.5f)) * m.certainty + m.geometric, m.own = 1.0f - m.other;
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
  const vec valid = job.surfaces.valid ? load<vec>(w.valid + (size_t)(y + 2) * PITCH + x + 2 + tap(TAPS / 2)) : all(1.0f);
  put(block.coc, m.is_near ? m.far : m.near);
  put(block.weight, m.other * valid);
  put(block.own_weight, m.own * valid);
}

// Reads the light in and around a block, and calls body(y, x, beside) for each LANES of its pixels of which some lie at an
// edge.
template <typename Body>
void each_edge(const Job &job, int y0, int x0, Window &w, const float *falloff, const Body &body) {
  const int height = job.height, width = job.width;
  const bool inside = x0 >= RIM && x0 + BLOCK + RIM <= width;
  for (int c = 0; c < job.channels; c++)
    for (int i = 0; i < EDGES; i++) {
      const float *from = job.surfaces.light + c * job.surfaces.area() + (size_t)std::clamp(y0 - RIM + i, 0, height - 1) * width;
      float *to = w.light.data() + ((size_t)c * EDGES + i) * PITCH;
      if (inside)
        memcpy(to, from + x0 - RIM, EDGES * sizeof(float));
      else
        for (int j = 0; j < EDGES; j++) to[j] = from[std::clamp(x0 - RIM + j, 0, width - 1)];
    }
  clean_light(job, y0, x0, w, falloff);
  ivec lane;
  for (int i = 0; i < LANES; i++) lane[i] = i;
  for (int y = 0; y < std::min(BLOCK, height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, width - x0); x += LANES) {
      const ivec beside = (load<vec>(w.edge + (y + RIM) * PITCH + x + RIM) > vec{}) & (lane < width - x0 - x);
      if (any_of(beside)) body(y, x, beside);
    }
}

void split_block(Job &job, int by, int bx, Window &w, const float *falloff) {
  const Block block = job.surfaces.make_block(by * job.surfaces.block_columns + bx);
  each_edge(job, by * BLOCK, bx * BLOCK, w, falloff, [&](int y, int x, ivec beside) {
    job.channels == 3 ? split<3>(job, w, y, x, beside, falloff, block) : split<0>(job, w, y, x, beside, falloff, block);
  });
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
    for (int dx = -reach; dx <= reach; dx++) falloff.push_back(falloff_at(dy, dx));
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
    if (!windows[worker]) {
      windows[worker].reset(new Window(channels));
      windows[worker]->around.resize((size_t)channels * (2 * TAPS + 3));
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
