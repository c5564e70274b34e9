// Highlights: their threshold, and the rays that carry their light.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "job.h"

namespace torchdof {

// Smallest highlight threshold in a block.
float least_threshold(const Job &job, int y0, int x0);
// Highlight threshold of a pixel.
float threshold_at(const Job &job, int y, int x);

// Kernels of highlights, for each radius, and the field's transmittance for some radii.
struct RayKernels {
  const float *const *kernels;
  const int32_t *halves;
  const torchdof_field_mask *field_masks;
  int32_t field_masks_count;
};

// Where surfaces may block the rays of highlights; highlights.cpp
struct Visibility {
  static constexpr int CLASSES = 62;  // of coc; one bit for each
  struct Cell {
    uint64_t classes = 0;     // classes of coc in the cell
    uint64_t remainders = 0;  // remainders modulo 64 of the bins before its coc
  };
  float low = 0, class_width = 1;
  std::vector<int> bins;  // bins of 1 px of coc that may contain a surface, or whose previous bin may
  int cell_rows = 0, cell_columns = 0;
  std::vector<Cell> cells;  // those that a ray may cross
  // Classes that may contain a surface of a bin or of the bin before.
  uint64_t classes_of(int bin) const {
    const int first = std::min((int)(std::max(0, bin - 1) / class_width), CLASSES - 1),
              last = std::min((int)((bin + 1) / class_width), CLASSES - 1);
    return (2ull << last) - (1ull << first);
  }
  // Remainders of a bin and of the bin before, as a cell with a surface of the bin has them.
  static uint64_t remainders_of(int bin) { return 1ull << bin % 64 | 1ull << (bin + 63) % 64; }
  // Whether a cell may contain a surface of a bin. Classes alone would accept a distant coc of the same class,
  // remainders alone a coc that is 64 px away.
  bool may_show(const Cell &cell, uint64_t classes, uint64_t remainders) const {
    return (cell.classes & classes) != 0 && (cell.remainders & remainders) != 0;
  }
};
Visibility find_visibility(const Job &job, const RayKernels &kernels);
// Adds the light of rays to a tile [channels, TILE, TILE].
void splat(const Job &job, const Visibility &visibility, int y0, int x0, const int *rays, int count,
           const RayKernels &kernels, const std::vector<float> &gains, float *tile);
// For each ray and colour the gain that keeps a kernel's sum after masking by the field [rays, colours]; 0: the kernel
// is not masked. Empty if the lens has no field.
std::vector<float> gains_of(const Job &job, const RayKernels &kernels);

}  // namespace torchdof
