// Circles of confusion, and the blur axis of render/layers/layer_weights.py.
#pragma once
#include <cmath>

#include "constants/layer_weights.h"
#include "constants/matting.h"
#include "numbers.h"

namespace torchdof {

using constants::matting::NEVER_PX;

// The position of a signed coc, clamped to [low, high], and its inverse.
using constants::layer_weights::IN_FOCUS, constants::layer_weights::SQUARE_PX;
template <typename V>
inline V axis(V coc, float low, float high) {
  const V zero = {}, focus = zero + (float)IN_FOCUS, size = max(coc, -coc), x = coc * size / (size + (float)SQUARE_PX);
  return min(max(x - min(max(x, -focus), focus), zero + low), zero + high);
}
inline float coc_at(double node) {
  const double beyond = (std::fabs(node) + IN_FOCUS) / 2;
  return (float)(node == 0 ? 0 : std::copysign(beyond + std::sqrt(beyond * (beyond + 2 * SQUARE_PX)), node));
}

}  // namespace torchdof
