// Surfaces that share pixels, in a layer: the formula of _mixed in torchdof/render/surfaces/frame.py, with its
// gradients. For vectors V of pixels and, in the kernels of GPUs (torchdof/kernels), for single ones.
#pragma once
#include "rules.h"

namespace torchdof {

// One surface, or two of them, near to far. Gradients begin with d_.
template <typename V, int COUNT>
struct Mixture {
  V weight[COUNT];              // shares of the pixel
  V ahead[COUNT], here[COUNT];  // arguments of the ramps at or behind the layer, and behind it
  bool eased;                   // whether the ramps are

  V a[COUNT], b[COUNT], counted[COUNT];  // these ramps; the weight with the continuation of the farther surface

  void weigh() {
    for (int j = 0; j < COUNT; j++) {
      a[j] = ramp(ahead[j], eased);
      b[j] = ramp(here[j], eased);
      counted[j] = j ? weight[j] + continuation(weight[j]) * visible_part(a[0]) : weight[j];
    }
  }
  // The weight of a surface in the layer, and that of all surfaces behind it.
  V own(int j) const { return (a[j] - b[j]) * counted[j]; }
  V beyond() const {
    V sum = V{};
    for (int j = 0; j < COUNT; j++) sum += b[j] * counted[j];
    return sum;
  }
  // The gradients by the arguments of the ramps and by the shares, from those by these weights.
  void back(const V *d_own, V d_beyond, V *d_ahead, V *d_here, V *d_weight) const {
    V d_nearer = V{};
    for (int j = COUNT - 1; j >= 0; j--) {
      const V d_counted = d_own[j] * (a[j] - b[j]) + d_beyond * b[j];
      d_ahead[j] = (d_own[j] * counted[j] + (j ? V{} : d_nearer)) * slope_of_ramp(ahead[j], eased);
      d_here[j] = (d_beyond - d_own[j]) * counted[j] * slope_of_ramp(here[j], eased);
      d_weight[j] = j ? d_counted * (1.0f + slope_of_continuation(weight[j]) * visible_part(a[0])) : d_counted;
      if (j) d_nearer = d_counted * continuation(weight[j]) * slope_of_visible_part(a[0]);
    }
  }
};

}  // namespace torchdof
