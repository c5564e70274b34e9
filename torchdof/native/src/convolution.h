// Kernels of layers, and their convolution with a strip of pixels.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

#include "simd.h"

namespace torchdof {

// A blur kernel.
struct Kernel {
  int half = 0;
  bool symmetric = true;  // about the vertical axis
  float sum = 0;
  std::vector<float> taps;       // see convolution.cpp
  std::vector<int> first, last;  // range of column offsets with taps for each input row; empty if first > last
};

// Size of the block of output pixels computed at once.
constexpr int STRIP_ROWS = 4, STRIP_COLUMNS = 2 * LANES, STRIP = STRIP_ROWS * STRIP_COLUMNS;
Kernel make_kernel(const float *values, int half, bool one_sided);

// Occupancy of rows is recorded as one bit for every MARKED columns; this is the bit of column x.
constexpr int MARKED = 8;
inline uint32_t mark(int x) { return 1u << std::min(x / MARKED, 31); }
// The bits of the columns from first to last.
inline uint32_t marks(int first, int last) { return (mark(last) | (mark(last) - 1)) & ~(mark(first) - 1); }
// The bits of the input columns of a strip at output column x.
inline uint32_t strip_inputs(int x, int half) { return marks(x, x + STRIP_COLUMNS - 1 + 2 * half); }
// Convolves rows (`pitch` values apart) with a kernel: out [STRIP_ROWS, STRIP_COLUMNS]. The input begins `half` rows
// and columns before the output. Input row i is skipped if rows[i] has none of the bits of `columns`.
void convolve_strip(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel,
                    float *out);

}  // namespace torchdof
