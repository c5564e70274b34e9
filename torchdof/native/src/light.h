// The largest channel of a pixel's light.
#pragma once
#include <algorithm>
#include <cstddef>

#include "numbers.h"

namespace torchdof {

// Largest channel of a pixel's light; the channels lie `step` values apart.
inline float peak_of(const float *light, size_t step, int channels) {
  float peak = *light;
  for (int c = 1; c < channels; c++) peak = std::max(peak, light[c * step]);
  return peak;
}

// Adds the gradient by that peak, which equal channels share.
inline void add_to_peak(const float *light, size_t step, int channels, float peak, float d_peak, float *d_light) {
  int peaks = 0;
  for (int c = 0; c < channels; c++) peaks += light[c * step] == peak;
  for (int c = 0; c < channels; c++)
    if (light[c * step] == peak) d_light[c * step] += d_peak / peaks;
}

}  // namespace torchdof
