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
  const vec per_total = all(1.0f) / most(total, all(1e-12f));
  for (int c = 0; c < C; c++, light += TAPS) {
    vec one = {}, two = {};
    for (int i = 0; i < TAPS; i++) one += light[i] * weight[i];
    mean[c] = one * per_total;
    for (int i = 0; i < TAPS; i++) two += (light[i] - mean[c]) * (light[i] - mean[c]) * weight[i];
    variance += two * per_total;
  }
  return variance;
}

// Splits the pixels of `beside`, out of LANES pixels of a row.
// 1. The near and far coc are the extremes of the 3 x 3 neighbours.
// 2. The colour of each surface is the mean of its unmixed neighbours. If a thin foreground has no such neighbours, they
//    count by their difference from the background.
// 3. The share of the near surface is the projection of the pixel's colour onto the line between both colours.
// 4. The share of the other surface is at most 1/2, and smaller where texture makes the projection unreliable.
// 5. The residual colour goes to both in proportion to their shares, within the range of the image's light.
template <int CHANNELS>
void split(const Job &job, Window &w, int y, int x, ivec beside, const float *falloff, const Block &block) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  const bool masked = job.surfaces.valid;
  const size_t first = (size_t)y * PITCH + x, in_coc = first + PITCH + 1;
  auto tap = [](int i) { return i / AROUND * PITCH + i % AROUND; };
  vec coc[TAPS], near = all(NEVER), far = all(-NEVER), scale = all(TINY);
  for (int i = 0; i < TAPS; i++) {
    coc[i] = load<vec>(w.coc + in_coc + tap(i));
    const auto known = masked ? load<vec>(w.valid + in_coc + tap(i)) > vec{} : ivec{} == 0;
    near = least(near, known ? coc[i] : all(NEVER));
    far = most(far, known ? coc[i] : all(-NEVER));
  }
  vec *const light = w.around.data(), *const front = light + C * TAPS, *const behind = front + C, *const colour = behind + C;
  for (int c = 0; c < C; c++)
    for (int i = 0; i < TAPS; i++) {
      const vec v = light[c * TAPS + i] = load<vec>(w.light.data() + (size_t)c * EDGES * PITCH + first + tap(i));
      scale = most(scale, most(v, -v));
    }
  const vec per_scale = all(1.0f) / scale;
  for (int i = 0; i < C * TAPS; i++) light[i] *= per_scale;
  const vec here = coc[TAPS / 2], gap = most(far - near, all(1e-6f)), per_gap = all(1.0f) / gap;
  vec nearer[TAPS], farther[TAPS], whole = {};
  for (int i = 0; i < TAPS; i++) {
    vec weight = (all(1.0f + UNCLEAN) - load<vec>(w.edge + first + tap(i))) * falloff[i];
    if (masked) weight *= load<vec>(w.valid + in_coc + tap(i));
    const vec nearness = (far - coc[i]) * per_gap;
    nearer[i] = weight * clamp01(4.0f * nearness - 2.8f);
    farther[i] = weight * clamp01(1.2f - 4.0f * nearness);
    whole += nearer[i];
  }
  const vec behind_variance = mean<CHANNELS>(light, C, farther, behind);
  const vec clean = clamp01(whole * (0.1f / UNCLEAN) - 1.0f);
  if (any_of(clean < all(1.0f))) {
    vec differs[TAPS] = {}, most_of = {};
    for (int c = 0; c < C; c++)
      for (int i = 0; i < TAPS; i++) {
        const vec d = light[c * TAPS + i] - behind[c];
        differs[i] += d * d;
      }
    for (int i = 0; i < TAPS; i++) most_of = most(most_of, differs[i]);
    const vec each = 1.0f / (most_of + ALIKE * ALIKE);
    for (int i = 0; i < TAPS; i++) {
      const vec part = (differs[i] + ALIKE * ALIKE) * each;
      nearer[i] *= part + clean * (1.0f - part);
    }
  }
  const vec front_variance = mean<CHANNELS>(light, C, nearer, front);

  vec strength = {}, along = {}, misfit = {};
  for (int c = 0; c < C; c++) {
    const vec contrast = front[c] - behind[c];
    colour[c] = light[c * TAPS + TAPS / 2];
    strength += contrast * contrast;
    along += (colour[c] - behind[c]) * contrast;
  }
  const auto is_near = here - near < far - here;
  const vec fitted = clamp01(along / most(strength, all(1e-12f)));
  for (int c = 0; c < C; c++) {
    const vec left = colour[c] - behind[c] - fitted * (front[c] - behind[c]);
    misfit += left * left;
  }
  const vec trust = strength / (strength + TRUST * (behind_variance + front_variance + misfit) + ALIKE * ALIKE);
  const vec aside = (here - near) - (far - here), sided = most(aside, -aside) * per_gap;
  const vec certainty = load<vec>(w.edge + first + tap(TAPS / 2)) * trust * clamp01(4.0f * sided - 2.0f);
  const vec weight = least(is_near ? 1.0f - fitted : fitted, all(0.5f)) * certainty, own_weight = 1.0f - weight;
  const vec per_own = 1.0f / own_weight, per_weight = 1.0f / most(weight, all(1e-12f)), of_each = weight / (weight * weight + own_weight * own_weight);
  auto put = [&](float *plane, vec value) {
    float *const to = plane + y * BLOCK + x;
    store(to, beside ? value : load<vec>(to));
  };
  for (int c = 0; c < C; c++) {
    const vec own_mean = is_near ? front[c] : behind[c], other_mean = is_near ? behind[c] : front[c];
    const vec unexplained = colour[c] - own_weight * own_mean - weight * other_mean;
    const vec darkest = most(job.light_least[c] * per_scale, all(-UNBOUNDED)), brightest = least(job.light_most[c] * per_scale, all(UNBOUNDED));
    // the two parts still sum to the pixel, and neither is brighter or darker than the image
    vec moved = weight * (other_mean + unexplained * of_each);
    moved = least(most(moved, colour[c] - own_weight * brightest), colour[c] - own_weight * darkest);
    moved = least(most(moved, weight * darkest), weight * brightest);
    put(block.own + c * BLOCK_PIXELS, (colour[c] - moved) * per_own * scale);
    put(block.other + c * BLOCK_PIXELS, weight > vec{} ? moved * per_weight * scale : vec{});
  }
  const vec valid = masked ? load<vec>(w.valid + in_coc + tap(TAPS / 2)) : all(1.0f);
  put(block.coc, is_near ? far : near);
  put(block.weight, weight * valid);
  put(block.own_weight, own_weight * valid);
}

void split_block(Job &job, int by, int bx, Window &w, const float *falloff) {
  const int y0 = by * BLOCK, x0 = bx * BLOCK, height = job.height, width = job.width;
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
  const Block block = job.surfaces.make_block(by * job.surfaces.block_columns + bx);
  ivec lane;
  for (int i = 0; i < LANES; i++) lane[i] = i;
  for (int y = 0; y < std::min(BLOCK, height - y0); y++)
    for (int x = 0; x < std::min(BLOCK, width - x0); x += LANES) {
      const ivec beside = (load<vec>(w.edge + (y + REACH) * PITCH + x + REACH) > vec{}) & (lane < width - x0 - x);
      if (any_of(beside)) job.channels == 3 ? split<3>(job, w, y, x, beside, falloff, block) : split<0>(job, w, y, x, beside, falloff, block);
    }
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
  float falloff[TAPS];
  for (int i = 0; i < TAPS; i++) falloff[i] = falloff_at(i / AROUND - REACH, i % AROUND - REACH);
  std::vector<float> around_emitter;
  for (int dy = -EMITTER_REACH; dy <= EMITTER_REACH; dy++)
    for (int dx = -EMITTER_REACH; dx <= EMITTER_REACH; dx++) around_emitter.push_back(falloff_at(dy, dx));
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
      if (find_edges(*this, y0, x0, w)) split_block(*this, by, bx, w, falloff);
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
