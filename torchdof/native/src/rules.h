// Rules of the picture, each in one place: its formula, the Python function that defines it, and for the gradients its
// derivative. A rule without its limits to [0, 1] is named `unlimited`: the derivative is that of the limited one where
// `within` holds, and 0 elsewhere. Templates are for a float and for a vector of pixels; a layer is any type with the
// ends and slopes of its ramps. Of the standard library only cstdint is included.
#pragma once
#include "constants/composite.h"
#include "constants/disocclusion.h"
#include "constants/frame.h"
#include "constants/layer_weights.h"
#include "constants/matting.h"
#include "numbers.h"

namespace torchdof {

// Constants of Python modules, which give their meanings, units and effects.
using constants::composite::KNOWN;
using constants::disocclusion::BEHIND_PX, constants::disocclusion::OF_MEAN, constants::disocclusion::OWN_SLOPE;
using constants::frame::AT_FOCUS, constants::frame::OFF_FOCUS, constants::frame::BARELY_BLURRED;
using constants::frame::CONTINUES_FROM, constants::frame::COUNTED, constants::frame::HIDDEN_WEIGHT;
using constants::frame::HIDING_SHARE, constants::frame::LEAST_PASSING, constants::frame::SEEN_FROM;
using constants::frame::LESS_BLURRED, constants::frame::SLOPES, constants::frame::SLOPES_LEAST;
using constants::matting::ON_FAR_TO, constants::matting::ON_NEAR_FROM, constants::matting::PLACE_SLOPE;
using constants::matting::SAME_BLUR, constants::matting::SIDED_FROM;
constexpr float FOOT = constants::layer_weights::FOOT;

// Whether 0 <= v <= 1.
template <typename V>
inline auto within(V v) {
  return (v >= V{}) & (v <= V{} + 1.0f);
}

// Difference in coc of two surfaces, less the part that is not seen in a strong blur: far - near - SAME_BLUR
// min(|near|, |far|). render/surfaces/matting.py, _apart_px.
template <typename V>
inline V apart_px(V near, V far) {
  return far - near - SAME_BLUR * min(absolute(near), absolute(far));
}

// A pixel between two surfaces, at n from 0 at the far one to 1 at the near one, counts to the near one by
// clamp(PLACE_SLOPE (n - ON_NEAR_FROM), 0, 1), and to the far one by clamp(PLACE_SLOPE (ON_FAR_TO - n), 0, 1).
// render/surfaces/matting.py, on_near and _on_far.
template <typename V>
inline V unlimited_on_near(V n) {
  return PLACE_SLOPE * (n - ON_NEAR_FROM);
}
template <typename V>
inline V on_near(V n) {
  return clamp01(unlimited_on_near(n));
}
template <typename V>
inline V unlimited_on_far(V n) {
  return PLACE_SLOPE * (ON_FAR_TO - n);
}
template <typename V>
inline V on_far(V n) {
  return clamp01(unlimited_on_far(n));
}

// How far a pixel, at a distance from their middle in halves of the gap, lies on one of both: clamp(PLACE_SLOPE
// (sided - SIDED_FROM), 0, 1). render/surfaces/matting.py, _weight_of_other.
template <typename V>
inline V unlimited_sided(V sided) {
  return PLACE_SLOPE * (sided - SIDED_FROM);
}

// Largest coc of a pixel's own surface nearby, which may slope: c + max(OWN_SLOPE |c| - BEHIND_PX, 0); and its
// derivative. render/surfaces/disocclusion.py, own_end.
template <typename V>
inline V own_end(V coc) {
  return coc + max(absolute(coc) * OWN_SLOPE - BEHIND_PX, V{});
}
inline float slope_of_own_end(float coc) {
  return OWN_SLOPE * absolute(coc) >= BEHIND_PX ? 1.0f + (coc < 0 ? -OWN_SLOPE : OWN_SLOPE) : 1.0f;
}

// Confidence that samples with the mean coc c and the mean blur b lie on one side of the focus: clamp(1 + OF_MEAN |c| -
// b, 0, 1). render/surfaces/disocclusion.py, _on_one_side.
template <typename V>
inline V on_one_side(V coc, V blur) {
  return clamp01(1.0f + OF_MEAN * absolute(coc) - blur);
}

// Confidence that a surface whose coc is larger by d is another surface: clamp(d - BEHIND_PX + 1/2, 0, 1).
// render/surfaces/disocclusion.py, is_another_surface.
template <typename V>
inline V unlimited_another_surface(V distance_px) {
  return distance_px - (BEHIND_PX - 0.5f);
}
template <typename V>
inline V is_another_surface(V distance_px) {
  return clamp01(unlimited_another_surface(distance_px));
}

// How much a pixel reads a level of the pyramid: clamp(|c| / least_px - 1, 0, 1). render/surfaces/disocclusion.py,
// is_read.
template <typename V>
inline V unlimited_read(V size_px, float least_px) {
  return size_px * (1.0f / least_px) - 1.0f;  // least_px is a power of two: no rounding
}
template <typename V>
inline V is_read(V size_px, float least_px) {
  return clamp01(unlimited_read(size_px, least_px));
}

// A ramp from 0 to 1 with a parabola as its foot, up to FOOT; exact at both ends. render/layers/layer_weights.py,
// eased.
constexpr float SLOPE = 1 / (1 - FOOT / 2);  // of the straight part
template <typename V>
inline V eased(V v) {
  const V foot = min(v, V{} + FOOT);
  return max(1.0f - SLOPE * (1.0f - v), SLOPE / (2 * FOOT) * foot * foot);
}
// The ramp clamp(v, 0, 1), eased or not, and its derivative.
template <typename V>
inline V ramp(V v, bool ease) {
  v = clamp01(v);
  return ease ? eased(v) : v;
}
template <typename V>
inline V slope_of_ramp(V v, bool ease) {
  const V slope = ease ? (v > V{} + FOOT ? V{} + SLOPE : v * (SLOPE / FOOT)) : V{} + 1.0f;
  return within(v) ? slope : V{};
}

// Share of a surface at `place` that belongs to a layer or to layers behind it; below, the share that belongs to layers
// behind it. Both are ramps, eased under occlusion. render/layers/layer_weights.py, weights_at_or_behind.
template <typename L, typename V>
inline V unlimited_at_or_behind(const L &l, V place) {
  return (place - l.before) * l.per_before + (l.first ? 1.0f : 0.0f);
}
template <typename L, typename V>
inline V at_or_behind(const L &l, V place, bool ease) {
  return ramp(unlimited_at_or_behind(l, place), ease);
}
template <typename L, typename V>
inline V unlimited_behind(const L &l, V place) {
  return (place - l.at) * l.per_after;
}
template <typename L, typename V>
inline V behind(const L &l, V place, bool ease) {
  return ramp(unlimited_behind(l, place), ease);
}

// The farther surface of a mixed pixel, whose share of the pixel is w, continues behind the nearer one with the extra
// weight (1 - w) clamp((w - HIDDEN_WEIGHT) / CONTINUES_FROM, 0, 1); and the derivative. render/surfaces/frame.py,
// continuation_weight.
template <typename V>
inline V unlimited_known(V share) {
  return (share - HIDDEN_WEIGHT) * (1.0f / CONTINUES_FROM);
}
template <typename V>
inline V continuation(V share) {
  return (1.0f - share) * clamp01(unlimited_known(share));
}
template <typename V>
inline V slope_of_continuation(V share) {
  const V known = unlimited_known(share);
  return (within(known) ? (1.0f - share) * (1.0f / CONTINUES_FROM) : V{}) - clamp01(known);
}

// Part of that weight that counts in a layer, where the nearer surface has a share at or behind the layer: 1 -
// clamp(nearer / HIDING_SHARE, 0, 1); and the derivative. render/surfaces/frame.py, visible_part.
template <typename V>
inline V visible_part(V nearer) {
  return 1.0f - clamp01(nearer * (1.0f / HIDING_SHARE));
}
template <typename V>
inline V slope_of_visible_part(V nearer) {
  return within(nearer * (1.0f / HIDING_SHARE)) ? V{} - 1.0f / HIDING_SHARE : V{};
}

// Farthest place at which a stacked surface may continue nearby: x + max(SLOPES |x|, SLOPES_LEAST); and its derivative.
// render/surfaces/frame.py, end_of_surface.
template <typename V>
inline V end_of_surface(V place) {
  return place + max(SLOPES * absolute(place), V{} + SLOPES_LEAST);
}
template <typename V>
inline V slope_of_end(V place) {
  return 1.0f + (SLOPES * absolute(place) < V{} + SLOPES_LEAST ? V{} : place < V{} ? V{} - SLOPES : V{} + SLOPES);
}

// How far a layer is clear of a farther surface, with a share behind the layer, that is less blurred than the one at
// `place`. render/surfaces/frame.py, is_clear.
template <typename V>
inline V is_clear(V place, V farther, V cover, V beyond) {
  const V less_blurred = clamp01(LESS_BLURRED * absolute(place) - absolute(farther));
  return 1.0f - less_blurred * cover * clamp01((1.0f - beyond) * (1.0f / HIDING_SHARE));
}

// Stand-ins for the background, each rule with its derivative. A surface at x counts as one at the focus by clamp(1 + x
// / AT_FOCUS, 0, 1), and stands in by clamp(2 + x / BARELY_BLURRED, 0, 1) clamp(-x / OFF_FOCUS, 0, 1). With the weight
// w it takes the place of a stand-in by clamp(COUNTED w, 0, 1), and has the weight max(w - SEEN_FROM, 0) as one.
// render/surfaces/frame.py, at_focus, stands_in, counts and seen.
template <typename V>
inline V unlimited_at_focus(V place) {
  return place * (1.0f / AT_FOCUS) + 1.0f;
}
template <typename V>
inline V at_focus(V place) {
  return clamp01(unlimited_at_focus(place));
}
template <typename V>
inline V slope_of_at_focus(V place) {
  return within(unlimited_at_focus(place)) ? V{} + 1.0f / AT_FOCUS : V{};
}
template <typename V>
inline V unlimited_stand_in(V place) {
  return place * (1.0f / BARELY_BLURRED) + 2.0f;
}
template <typename V>
inline V unlimited_off_focus(V place) {
  return place * (-1.0f / OFF_FOCUS);
}
template <typename V>
inline V stands_in(V place) {
  return clamp01(unlimited_stand_in(place)) * clamp01(unlimited_off_focus(place));
}
template <typename V>
inline V slope_of_stands_in(V place) {  // 0 where it is 0
  const V in = unlimited_stand_in(place), off = unlimited_off_focus(place);
  const V slope = (in <= V{} + 1.0f ? clamp01(off) * (1.0f / BARELY_BLURRED) : V{}) -
                  (off <= V{} + 1.0f ? clamp01(in) * (1.0f / OFF_FOCUS) : V{});
  return stands_in(place) > V{} ? slope : V{};
}
template <typename V>
inline V seen(V weight) {
  return max(weight - SEEN_FROM, V{});
}
template <typename V>
inline V slope_of_seen(V weight) {
  return weight > SEEN_FROM ? V{} + 1.0f : V{};
}
template <typename V>
inline V unlimited_counts(V weight) {
  return weight * COUNTED;
}
template <typename V>
inline V counts(V weight) {
  return clamp01(unlimited_counts(weight));
}
template <typename V>
inline V slope_of_counts(V weight) {
  return within(unlimited_counts(weight)) ? V{} + COUNTED : V{};
}

// The normalizer of a layer, its weight w plus the weight v behind it, is raised where it is small: with l = max(KNOWN
// - w - v, 0), by l^2 / (2 KNOWN), whose derivative by w or v is -l / KNOWN. render/layers/composite.py, raised.
template <typename V>
inline V lacking(V weight, V behind = V{}) {
  return max(V{} + KNOWN - weight - behind, V{});
}
template <typename V>
inline V raise(V lacking) {
  return lacking * lacking * (0.5f / KNOWN);
}
template <typename V>
inline V slope_of_raise(V lacking) {
  return lacking * (-1.0f / KNOWN);
}

}  // namespace torchdof
