// Emitters: whether a highlight's pixel shows its own surface or one in front or behind, as described in
// render/surfaces/emitters.py.
#include "emitters.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <vector>

#include "blocks.h"
#include "blur_axis.h"
#include "highlights.h"
#include "job.h"
#include "light.h"
#include "numbers.h"
#include "surfaces.h"

namespace torchdof {
namespace {

using namespace constants::emitters;      // render/surfaces/emitters.py gives meanings, units and effects
enum Side { IN_FRONT = -1, BEHIND = 1 };  // of an emitter, relative to a surface

// Estimates from the pixels around a highlight on which surface its emitter lies.
class Around {
 public:
  static constexpr int ACROSS = 2 * EMITTER_REACH + 1, COUNT = ACROSS * ACROSS;
  // The pixels around for an emitter on one side of a surface.
  struct Beyond {
    float certainty = 0, top = 0;              // top: largest light of both surfaces, relative to `scale`
    float there[COUNT] = {}, dim[COUNT] = {};  // weights of pixels on that side, and of dark pixels of the surface
  };

  // matted: compares the light of each pixel's own surface after matting, not that of the image.
  Around(const Surfaces &s, int y, int x, const float *falloff, bool matted)
      : s_(s), falloff_(falloff), matted_(matted) {
    for (int i = 0, dy = -EMITTER_REACH; dy <= EMITTER_REACH; dy++)
      for (int dx = -EMITTER_REACH; dx <= EMITTER_REACH; dx++, i++) {
        at_[i] = (size_t)std::clamp(y + dy, 0, s.height - 1) * s.width + std::clamp(x + dx, 0, s.width - 1);
        coc_[i] = s.coc[at_[i]];
        nearest_ = std::min(nearest_, coc_[i]);
        farthest_ = std::max(farthest_, coc_[i]);
        if (touches(i)) nearest_touching_ = std::min(nearest_touching_, coc_[i]);
      }
  }

  // Pixels, and the confidence, 0 to 1, that the emitter lies on one side of the surface at `coc`. light: of the
  // highlight's pixel; limit: the highlight threshold; share: minimum light on that side, relative to the surface's
  // brightest pixel.
  Beyond beyond(float coc, Side side, float share, float light, float limit) {
    Beyond b;
    if (!((side == BEHIND ? farthest_ - coc : coc - nearest_touching_) > 1)) return b;
    if (!scale)
      for (int i = 0; i < COUNT; i++) {
        scale = std::max(scale, peaks_[i] = peak_of(s_.light + at_[i], s_.area(), s_.channels));
        if (!matted_) continue;
        const int row = (int)(at_[i] / s_.width), column = (int)(at_[i] % s_.width), which = s_.block_of(row, column);
        if (s_.has_block(which))
          peaks_[i] = peak_of(s_.block(which).own + place_in_block(row, column), BLOCK_PIXELS, s_.channels);
      }
    const float own_peak = light / scale, dim_below = DIM_SLOPE / std::max(own_peak, 1e-12f);
    float dim_sum = 0, emitter_peak = 0,
          same_peak = std::max(LEAST_PEAK * own_peak, 1e-12f);  // a ratio of tiny peaks would depend on rounding
    for (int i = 0; i < COUNT; i++) {
      const float counted = s_.valid ? s_.valid[at_[i]] : 1.0f, peak = peaks_[i] / scale, away = side * (coc_[i] - coc);
      const float same = counted * clamp01(2.0f - std::fabs(away));
      b.there[i] = side == BEHIND || touches(i) ? counted * clamp01(away - 1.0f) : 0.0f;
      b.dim[i] = same * falloff_[i] * clamp01(DIM_SLOPE * DIM_TO - dim_below * peak);
      dim_sum += b.dim[i];
      emitter_peak = std::max(emitter_peak, b.there[i] * peak);
      same_peak = std::max(same_peak, same * peak);
    }
    b.top = std::max(emitter_peak, same_peak);
    b.certainty = clamp01(light / limit - 1.0f) * std::min(SURE * dim_sum, 1.0f) *
                  clamp01(SURE * (emitter_peak / same_peak - share));
    return b;
  }

  // Returns the emitter's coc; surface: light of the surface's darkest pixels.
  float measure_emitter(const Beyond &b, float light, std::vector<float> &surface) const {
    const float own_peak = light / scale, least_dim = DIM * own_peak;
    float dimmest_sum = 0, lit_sum = 0, lit_coc = 0;
    surface.assign(s_.channels, 0.0f);
    for (int i = 0; i < COUNT; i++) {
      const float peak = peaks_[i] / scale, brightness = std::min(peak * peak, 1e30f);
      const float dimmest = b.dim[i] / std::max(brightness + least_dim * least_dim, 1e-24f),
                  lit = b.there[i] * falloff_[i] * brightness;
      dimmest_sum += dimmest;
      for (int c = 0; c < s_.channels; c++) surface[c] += s_.light[c * s_.area() + at_[i]] / scale * dimmest;
      lit_sum += lit;
      lit_coc += (coc_[i] - nearest_) * lit;
    }
    for (float &colour : surface) colour /= std::max(dimmest_sum, 1e-12f);
    return nearest_ + lit_coc / std::max(lit_sum, 1e-12f);
  }

 private:
  static bool touches(int i) {
    return std::abs(i / ACROSS - EMITTER_REACH) <= TOUCHING && std::abs(i % ACROSS - EMITTER_REACH) <= TOUCHING;
  }
  const Surfaces &s_;
  const float *falloff_;
  const bool matted_;
  size_t at_[COUNT];
  float coc_[COUNT], peaks_[COUNT], nearest_ = NEVER_PX, nearest_touching_ = NEVER_PX, farthest_ = -NEVER_PX;

 public:
  float scale = 0;  // largest light around
};

// The highlight threshold of a pixel, if its light is above it; else 0.
float limit_of_highlight(const Job &job, int y, int x, float light, float least_limit) {
  const Surfaces &s = job.surfaces;
  if (!(light > least_limit) || (s.valid && !(s.valid[s.pixel(y, x)] > 0))) return 0.0f;
  const float limit = threshold_at(job, y, x);
  return light > limit ? limit : 0.0f;
}

}  // namespace

void attribute_emitter(Job &job, int y, int x, float least_limit, const float *falloff) {
  Surfaces &s = job.surfaces;
  const int channels = job.channels;
  const size_t at = s.pixel(y, x), area = s.area();
  const float light = peak_of(s.light + at, area, channels), own_coc = s.coc[at];
  const float limit = limit_of_highlight(job, y, x, light, least_limit);
  if (!(limit > 0)) return;
  Around around(s, y, x, falloff, false);
  const int i = s.block_of(y, x), within = place_in_block(y, x);
  std::vector<float> surface;
  for (const Side side : {IN_FRONT, BEHIND}) {
    const Around::Beyond beyond = around.beyond(own_coc, side, side == IN_FRONT ? 1.0f : BEHIND_SHARE, light, limit);
    float sureness = beyond.certainty;
    if (!(sureness > 0)) continue;
    const Block block = s.make_block(i);
    const float coc = around.measure_emitter(beyond, light, surface),
                floor = *std::max_element(surface.begin(), surface.end());
    const float share = std::clamp((light / around.scale - floor) / std::max(beyond.top - floor, 1e-12f),
                                   1.0f - MOST_WEIGHT, MOST_WEIGHT);
    // an emitter seen behind a surface is not in front of it
    if (side == IN_FRONT) sureness *= 1.0f - around.beyond(coc, BEHIND, BEHIND_SHARE, light, limit).certainty;
    const float given = std::max(side == IN_FRONT ? sureness : 2.0f * sureness - 1.0f, 0.0f);
    const float kept =
        std::max(side == IN_FRONT ? 1.0f - sureness : 1.0f - 2.0f * sureness, 0.0f) * block.weight[within];
    const float weight = kept + given * share, per_weight = weight > 0 ? 1.0f / std::max(weight, 1e-12f) : 0.0f;
    for (int c = 0; c < channels; c++) {
      const float emitter =
          std::max(s.light[c * area + at] / around.scale - (1.0f - share) * surface[c], 0.0f) * around.scale;
      float &other = block.other[c * BLOCK_PIXELS + within];
      other = (kept * other + given * emitter) * per_weight;
    }
    block.coc[within] += given * share * per_weight * (coc - block.coc[within]);
    s.set_weight(block, at, within, weight);
  }
}

float weight_left(const Job &job, int y, int x, float least_limit, const float *falloff) {
  const Surfaces &s = job.surfaces;
  const int i = s.block_of(y, x), within = place_in_block(y, x);
  const size_t at = s.pixel(y, x);
  const float light = peak_of(s.light + at, s.area(), s.channels),
              limit = limit_of_highlight(job, y, x, light, least_limit);
  const Block block = s.block(i);
  if (!(limit > 0) || !(block.weight[within] > 0)) return 1.0f;
  const float bright = clamp01(peak_of(block.other + within, BLOCK_PIXELS, s.channels) / std::max(limit, TINY) - 1.0f);
  const float beyond = s.coc[at] - block.coc[within], taken = bright * clamp01(std::fabs(beyond) - 1.0f);
  if (!(taken > 0)) return 1.0f;
  Around around(s, y, x, falloff, true);
  return 1.0f - taken * around.beyond(block.coc[within], beyond > 0 ? BEHIND : IN_FRONT, 1.0f, light, limit).certainty;
}

}  // namespace torchdof
