// A mixed pixel, split between two surfaces whose mean colours are known: steps 3 to 5 of matte in
// torchdof/render/surfaces/matting.py, with their gradients. The compiled engine splits vectors V of pixels, the
// kernels of GPUs (torchdof/kernels) single ones. Light is relative to the brightest light around. Gradients begin with
// d_.
#pragma once
#include "constants/matting.h"
#include "numbers.h"
#include "rules.h"

#ifdef __CUDACC__
#define UNROLLED _Pragma("unroll")  // so that colours stay in registers
#else
#define UNROLLED
#endif

namespace torchdof {

using constants::matting::ALIKE, constants::matting::EDGE_PX;
using constants::matting::TRUST, constants::matting::UNBOUNDED;
constexpr float LEAST = 1e-12f;  // smallest divisor

// The gradients by what a split is computed from.
template <typename V>
struct OfMixedPixel {
  V coc, near_px, far_px, gap, edge, covered, variance;
  V weight, own, lent;  // by the weights of the other surface and of the own one, and by `lent`
};

// COUNT: of channels; 0 if it is known only at run time.
template <typename V, int COUNT>
struct MixedPixel {
  V coc, near_px, far_px, gap;  // coc of the pixel and of both surfaces, and their distance
  V edge;                       // certainty that there is an edge, 0 to 1
  V covered;                    // share of the near surface around
  V variance;                   // sum of the variances of both surfaces
  int channels = COUNT;

  decltype(V{} < V{}) is_near;  // whether the pixel's own surface is the near one
  V strength, along, fitted;  // square of the contrast; place of the light from the far colour to the near one; limited
  V misfit, noise, total;     // square of the rest; variances; what the trust is relative to
  V trust;                    // in the place by colour, 0 to 1
  V side, sided, clear;       // place of the coc beside the middle of both; in halves of the gap; certainty of an edge
  V by_fit, by_cover, wide;   // weight of the other surface by colour, and by place; how far the gap is wide enough
  V by_place, contradiction;  // the part of the weight by place; what the colour says against it
  V weight;                   // of the other surface
  V sharper, lent;            // px by which that is less blurred; share of the residual that it may get

  V by_owner(V if_near, V if_far) const { return is_near ? if_near : if_far; }
  int count() const { return COUNT ? COUNT : channels; }

  // Steps 3 and 4: the weight of the other surface, from the light of the pixel and the colours of both [channels].
  void weigh(const V *light, const V *near, const V *far) {
    along = strength = misfit = V{};
    UNROLLED for (int c = 0; c < count(); c++) {
      const V contrast = near[c] - far[c];
      strength += contrast * contrast;
      along += (light[c] - far[c]) * contrast;
    }
    is_near = coc - near_px < far_px - coc;
    along /= max(strength, V{} + LEAST);
    fitted = clamp01(along);
    UNROLLED for (int c = 0; c < count(); c++) {
      const V left = light[c] - far[c] - fitted * (near[c] - far[c]);
      misfit += left * left;
    }
    noise = variance + ALIKE * ALIKE;
    total = strength + TRUST * (variance + misfit) + ALIKE * ALIKE;
    trust = strength / total;
    side = (coc - near_px) - (far_px - coc);
    sided = absolute(side) / gap;
    clear = edge * clamp01(unlimited_sided(sided));
    by_fit = by_owner(1.0f - fitted, fitted), by_cover = by_owner(1.0f - covered, covered);
    wide = gap * (1.0f / EDGE_PX) - 2.0f;
    by_place = min(by_cover, V{} + 0.5f) * clear * (1.0f - trust) * clamp01(wide);
    contradiction = misfit + (covered - fitted) * (covered - fitted) * strength;
    weight = min(by_fit, V{} + 0.5f) * (clear * trust) + by_place * noise / (noise + contradiction);
    sharper = absolute(coc) - absolute(by_owner(far_px, near_px));
    lent = clamp01(1.0f - sharper);
  }

  // Step 5, of a channel: light of the other surface times its weight, `moved`, without limits and after each of them.
  struct Moved {
    V light, own_mean, other_mean, residual, each, least, most, steps[4], moved;
  };
  Moved moved(V light, V near, V far, V darkest, V brightest) const {
    Moved m;
    const V own = 1.0f - weight;
    m.light = light, m.own_mean = by_owner(near, far), m.other_mean = by_owner(far, near);
    m.residual = light - own * m.own_mean - weight * m.other_mean;
    m.each = lent * weight / (weight * weight + own * own);
    m.least = max(min(darkest, V{} + UNBOUNDED), V{} - UNBOUNDED);
    m.most = max(min(brightest, V{} + UNBOUNDED), V{} - UNBOUNDED);
    // neither part is brighter or darker than the image
    m.steps[0] = weight * (m.other_mean + m.residual * m.each);
    m.steps[1] = max(m.steps[0], light - own * m.most);
    m.steps[2] = min(m.steps[1], light - own * m.least);
    m.steps[3] = max(m.steps[2], weight * m.least);
    m.moved = min(m.steps[3], weight * m.most);
    return m;
  }
  V own_light(const Moved &m) const { return (m.light - m.moved) / (1.0f - weight); }
  V other_light(const Moved &m) const { return weight > V{} ? m.moved / max(weight, V{} + LEAST) : V{}; }

  // The gradients of step 5, from those by the light of both surfaces; those by the light of the pixel and by the
  // colours of both are added.
  struct OfEnds {
    V darkest, brightest;
  };
  OfEnds back_of_moved(const Moved &m, V d_own_light, V d_other_light, OfMixedPixel<V> &d, V &d_light, V &d_near,
                       V &d_far) const {
    const V own = 1.0f - weight, known = max(weight, V{} + LEAST), squares = weight * weight + own * own;
    const V d_left = d_own_light / own, d_other = weight > V{} ? d_other_light : V{};
    d_light += d_left;
    d.own -= d_left * own_light(m);
    d.weight -= weight >= V{} + LEAST ? d_other * (m.moved / known) / known : V{};
    V d_moved = d_other / known - d_left;
    // each limit takes the gradient where it is in force, and half of it where both values are equal
    const auto taken = [&](V limit, V value, bool is_upper) {
      const auto limits = is_upper ? limit < value : limit > value;
      const V part = limits ? d_moved : limit == value ? 0.5f * d_moved : V{};
      d_moved -= part;
      return part;
    };
    const V by_most = taken(weight * m.most, m.steps[3], true), by_least = taken(weight * m.least, m.steps[2], false);
    const V by_own_least = taken(m.light - own * m.least, m.steps[1], true),
            by_own_most = taken(m.light - own * m.most, m.steps[0], false);
    d.weight += by_most * m.most + by_least * m.least;
    d_light += by_own_least + by_own_most;
    d.own -= by_own_least * m.least + by_own_most * m.most;
    // moved = weight (other_mean + residual each), each = lent weight / squares
    const V d_each = d_moved * weight * m.residual, d_residual = d_moved * weight * m.each;
    d.weight += d_moved * (m.other_mean + m.residual * m.each) - d_residual * m.other_mean;
    d.weight += d_each * lent * (own - weight) * (own + weight) / (squares * squares);
    d.own -= d_residual * m.own_mean + d_each * lent * 2.0f * weight * own / (squares * squares);
    d.lent += d_each * weight / squares;
    d_light += d_residual;
    const V d_own_mean = -d_residual * own, d_other_mean = d_moved * weight - d_residual * weight;
    d_near += by_owner(d_own_mean, d_other_mean);
    d_far += by_owner(d_other_mean, d_own_mean);
    return {by_least * weight - by_own_least * own, by_most * weight - by_own_most * own};
  }

  // The gradients of steps 3 and 4, from those by the weights and by the coc of the other surface.
  void back_of_weight(const V *light, const V *near, const V *far, V d_other_coc, OfMixedPixel<V> &d, V *d_light,
                      V *d_near, V *d_far) const {
    // lent = 1 - sharper, sharper = |coc| - |coc of the other surface|
    const V d_sharper = within(1.0f - sharper) ? -d.lent : V{};
    d_other_coc -= d_sharper * sign(by_owner(far_px, near_px));
    d.coc += d_sharper * sign(coc);
    d.near_px += by_owner(V{}, d_other_coc);
    d.far_px += by_owner(d_other_coc, V{});
    d.weight -= d.own;

    const V sum = noise + contradiction, agreeing = noise / sum, d_by_place = d.weight * agreeing;
    const V d_agreeing = d.weight * by_place / sum, d_contradiction = -d_agreeing * agreeing;
    const V cover = min(by_cover, V{} + 0.5f), fit = min(by_fit, V{} + 0.5f), is_wide = clamp01(wide),
            doubt = 1.0f - trust;
    const V d_clear = d_by_place * cover * doubt * is_wide + d.weight * fit * trust;
    const V d_trust = (d.weight * fit - d_by_place * cover * is_wide) * clear;
    const V d_cover = by_cover <= V{} + 0.5f ? d_by_place * clear * doubt * is_wide : V{};
    const V d_fit = by_fit <= V{} + 0.5f ? d.weight * clear * trust : V{};
    const V off = covered - fitted, d_off = d_contradiction * 2.0f * off * strength;
    d.covered += d_off + by_owner(-d_cover, d_cover);
    V d_fitted = by_owner(-d_fit, d_fit) - d_off;
    d.edge += d_clear * clamp01(unlimited_sided(sided));
    const V d_sided = within(unlimited_sided(sided)) ? PLACE_SLOPE * d_clear * edge / gap : V{};
    d.coc += 2.0f * sign(side) * d_sided;
    d.near_px -= sign(side) * d_sided;
    d.far_px -= sign(side) * d_sided;
    d.gap += (within(wide) ? d_by_place * cover * clear * doubt * (1.0f / EDGE_PX) : V{}) - d_sided * sided;
    const V d_total = -d_trust * trust / total, d_misfit = d_contradiction + d_total * TRUST;
    V d_strength = d_trust / total + d_total + d_contradiction * off * off;
    d.variance += d_total * TRUST + d_agreeing * (1.0f - agreeing);
    UNROLLED for (int c = 0; c < count(); c++) {
      const V contrast = near[c] - far[c];
      d_fitted -= 2.0f * d_misfit * (light[c] - far[c] - fitted * contrast) * contrast;
    }
    const V d_along = within(along) ? d_fitted / max(strength, V{} + LEAST) : V{};
    d_strength -= strength >= V{} + LEAST ? d_along * along : V{};
    UNROLLED for (int c = 0; c < count(); c++) {
      const V contrast = near[c] - far[c], from_far = light[c] - far[c];
      const V d_left = 2.0f * d_misfit * (from_far - fitted * contrast), d_from_far = d_left + d_along * contrast;
      const V d_contrast = d_along * from_far + 2.0f * d_strength * contrast - d_left * fitted;
      d_light[c] += d_from_far;
      d_near[c] += d_contrast;
      d_far[c] -= d_from_far + d_contrast;
    }
  }
};

}  // namespace torchdof
