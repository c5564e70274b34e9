// Transmittance of the lens's field over a blur kernel.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>

#include "api.h"
#include "constants/field.h"
#include "constants/placed_kernels.h"
#include "convolution.h"
#include "layers.h"
#include "simd.h"

namespace torchdof {

// Transmittance of the lens's field over a blur kernel at one position in the frame; see optics/placed_kernels.py.
class FieldMask {
 public:
  static constexpr int ROWS = constants::field::BLOCK[0], COLUMNS = constants::field::BLOCK[1];
  static constexpr float LEAST = constants::placed_kernels::MIN_LIGHT;

  // For the samples a, or the mix of a and b with weight `part` of b. y, x: position in half diagonals from the centre.
  FieldMask(const torchdof_scene &scene, const torchdof_field_mask &a, const torchdof_field_mask *b, float part,
            int colour, float y, float x)
      : squeeze_(scene.squeeze), part_(part), both_(b != nullptr) {
    x += ASIDE;
    const float distance = std::sqrt(y * y + x * x), place = std::min(distance, 1.0f) * (scene.distances - 1);
    const int low = std::min((int)place, scene.distances - 2);
    const float near = place - low;
    down_ = y / distance;
    right_ = x / distance;
    const torchdof_field_mask *const of[2] = {&a, b};
    float box[3] = {};
    for (int k = 0; k <= both_; k++) {
      const float *p = of[k]->boxes + 3 * low, weight = both_ ? k ? part : 1.0f - part : 1.0f;
      for (int i = 0; i < 3; i++) box[i] += weight * (p[i] + near * (p[3 + i] - p[i]));
    }
    middle_ = box[0], length_ = box[1], width_ = box[2];
    for (int k = 0; k <= both_; k++) {
      Samples &s = samples_[k];
      const int rows = of[k]->rows, count = rows * of[k]->columns;
      s.columns = of[k]->columns;
      s.near = near;
      s.last_row = (float)(rows - 1);
      s.last_column = (float)(s.columns - 1);
      s.per_u = s.last_row / (2.0f * box[1]);
      s.first_u = 0.5f * s.last_row - box[0] * s.per_u;
      s.per_v = s.last_column / box[2];
      s.values = of[k]->values + ((size_t)(of[k]->colours > 1 ? colour : 0) * scene.distances + low) * count;
      s.next = s.values + count;
    }
  }
  // Transmittance at offsets from the kernel's centre.
  vec transmittance(vec dy, vec dx) const {
    const vec across = dx * squeeze_, u = dy * down_ + across * right_, v = abs(across * down_ - dy * right_),
              first = samples_[0].at(u, v);
    return both_ ? (1.0f - part_) * first + part_ * samples_[1].at(u, v) : first;
  }
  // Range of rows of a column that the samples cover.
  void rows_of(float dx, float &low, float &high) const {
    const float across = dx * squeeze_;
    low = -FAR, high = FAR;
    auto within = [&](float per_row, float from, float to) {
      if (std::fabs(per_row) < ASIDE) return;
      low = std::max(low, std::min(from / per_row, to / per_row));
      high = std::min(high, std::max(from / per_row, to / per_row));
    };
    within(down_, middle_ - length_ - across * right_, middle_ + length_ - across * right_);
    within(right_, across * down_ - width_, across * down_ + width_);
  }

 private:
  static constexpr float ASIDE = 1e-6f, FAR = 1e6f;
  struct Samples {
    const float *values, *next;  // samples at the field distances before and after the position
    int columns;
    float near, last_row, last_column, per_u, first_u, per_v;
    vec at(vec u, vec v) const {
      // NaN becomes 0
      const vec row = min(max(u * per_u + first_u, vec{}), broadcast(last_row)),
                column = min(max(v * per_v, vec{}), broadcast(last_column));
      const ivec i = convert(min(row, broadcast(last_row - 1.0f))),
                 j = convert(min(column, broadcast(last_column - 1.0f)));
      const vec down = row - convert(i), right = column - convert(j);
      const ivec first = i * columns + j;
      vec mean[2];
      for (int k = 0; k < 2; k++) {
        const float *p = k ? next : values;
        const float *from[LANES];
        for (int lane = 0; lane < LANES; lane++) from[lane] = p + first[lane];
        const auto samples = [&](int offset) {
          vec v = {};
          for (int lane = 0; lane < LANES; lane++) v[lane] = from[lane][offset];
          return v;
        };
        const vec corners[4] = {samples(0), samples(1), samples(columns), samples(columns + 1)};
        const vec upper = corners[0] + right * (corners[1] - corners[0]);
        const vec lower = corners[2] + right * (corners[3] - corners[2]);
        mean[k] = upper + down * (lower - upper);
      }
      return clamp01(mean[0] + near * (mean[1] - mean[0]));
    }
  };
  Samples samples_[2];
  float squeeze_, part_, down_, right_, middle_, length_, width_;
  bool both_;
};
inline float per_half_diagonal(const torchdof_scene &scene) {
  return 2.0f / std::sqrt((float)scene.height * scene.height + (float)scene.width * scene.width);
}
// Whether a field mask is 0 at the edge of its samples.
bool ends_dark(const torchdof_field_mask &mask, int distances);
// Multiplies a layer's kernel by the field's transmittance and restores its sum.
void mask_kernel(const Layer &layer, int colour, const FieldMask &turned, Kernel &cut);

}  // namespace torchdof
