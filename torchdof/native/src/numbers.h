// Numbers and comparisons with which the rules of the picture are written: for the compiled engine, with vectors of pixels,
// and for the kernels of GPUs (torchdof/kernels), with single pixels. Of the standard library only cstdint.
#pragma once
#include "constants/composite.h"
#include "constants/disocclusion.h"
#include "constants/frame.h"
#include "constants/layer_weights.h"

namespace torchdof {

// The larger and the smaller of two values; b if a is NaN.
template <typename V>
inline V most(V a, V b) {
  return a > b ? a : b;
}
template <typename V>
inline V least(V a, V b) {
  return a < b ? a : b;
}
template <typename V>
inline V clamp01(V v) {
  return least(most(v, V{}), V{} + 1.0f);
}
template <>
inline float clamp01(float v) {  // NaN stays NaN
  return v < 0.0f ? 0.0f : v > 1.0f ? 1.0f : v;
}

// Constants of Python modules, which give their meanings, units and effects; here with the type of the computations.
constexpr float KNOWN = constants::composite::KNOWN;
constexpr float BEHIND_PX = constants::disocclusion::BEHIND_PX;
constexpr float OWN_SLOPE = constants::disocclusion::OWN_SLOPE;
constexpr float FOOT = constants::layer_weights::FOOT;
constexpr float HIDDEN_WEIGHT = constants::frame::HIDDEN_WEIGHT;
constexpr float HIDING_SHARE = constants::frame::HIDING_SHARE;
constexpr float LEAST_PASSING = constants::frame::LEAST_PASSING;
constexpr float CONTINUES_FROM = constants::frame::CONTINUES_FROM;
constexpr float AT_FOCUS = constants::frame::AT_FOCUS;
constexpr float OFF_FOCUS = constants::frame::OFF_FOCUS;
constexpr float BARELY_BLURRED = constants::frame::BARELY_BLURRED;
constexpr float COUNTED = constants::frame::COUNTED;
constexpr float SEEN_FROM = constants::frame::SEEN_FROM;

}  // namespace torchdof
