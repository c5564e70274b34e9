// What the surfaces of a pixel weigh: in a layer, and as stand-ins for the background; with the gradients. The formulas
// of _mixed and of PaddedFrame.stand_ins in torchdof/render/surfaces/frame.py, for vectors V of pixels and, in the
// kernels of GPUs (torchdof/kernels), for single ones. Surfaces are listed near to far; gradients begin with d_.
#pragma once
#include "rules.h"

namespace torchdof {

// One surface, or two that share a pixel, in a layer.
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

// The product of 1 - values[i] for i < count, without one or two of them.
template <typename V>
inline V left_by(const V *values, int count, int without, int and_without = -1) {
  V left = V{} + 1.0f;
  for (int i = 0; i < count; i++)
    if (i != without && i != and_without) left *= 1.0f - values[i];
  return left;
}

// Stand-ins: a barely blurred surface counts as its own background. IN_ORDER: the surfaces cover a pixel independently.
template <typename V, int COUNT, bool IN_ORDER>
struct StandIns {
  V place[COUNT], weight[COUNT];

  V taken[COUNT];                    // how far a surface at the focus takes the place of a stand-in
  V seen_part[COUNT], is_in[COUNT];  // weight as one; how far its place is that of one
  V alone[COUNT], left[COUNT];       // what surfaces at the focus leave, and what nearer ones leave
  V cover[COUNT], sum;

  void find() {
    sum = V{};
    for (int j = 0; j < COUNT; j++) taken[j] = counts(weight[j]) * at_focus(place[j]);
    for (int j = 0; j < COUNT; j++) {
      seen_part[j] = seen(weight[j]);
      is_in[j] = stands_in(place[j]);
      alone[j] = left_by(taken, COUNT, j);
      left[j] = IN_ORDER ? left_by(weight, j, -1) : V{} + 1.0f;
      cover[j] = seen_part[j] * is_in[j] * alone[j] * left[j];
      sum += cover[j];
    }
  }
  // Adds the gradients by places and weights, from those by the covers.
  void back(const V *d_cover, V *d_place, V *d_weight) const {
    for (int j = 0; j < COUNT; j++) {
      const V d_part = d_cover[j] * alone[j] * left[j], d_alone = d_cover[j] * seen_part[j] * is_in[j] * left[j];
      d_weight[j] += d_part * slope_of_seen(weight[j]) * is_in[j];
      d_place[j] += d_part * seen_part[j] * slope_of_stands_in(place[j]);
      for (int i = 0; i < COUNT; i++) {
        if (i == j) continue;
        const V d_taken = -d_alone * left_by(taken, COUNT, i, j);
        d_weight[i] += d_taken * slope_of_counts(weight[i]) * at_focus(place[i]);
        d_place[i] += d_taken * counts(weight[i]) * slope_of_at_focus(place[i]);
        if (IN_ORDER && i < j) d_weight[i] -= d_cover[j] * seen_part[j] * is_in[j] * alone[j] * left_by(weight, j, i);
      }
    }
  }
};

}  // namespace torchdof
