// Convolution with one kernel: four rows and two vectors of columns at a time, kept in registers.
#include "convolution.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "field_mask.h"
#include "layers.h"
#include "simd.h"

namespace torchdof {
namespace {

constexpr int ROWS = STRIP_ROWS;
constexpr int VECTORS = STRIP_COLUMNS / LANES;
constexpr int SHORT = 10;  // half width up to which a single float32 sum is accurate enough

// Layout of taps: taps[(i + ROWS - 1) + d * stride - o] applies to input row i, output row o and column offset d; rows
// above and below the kernel are 0. d starts at 0 for symmetric kernels, else at -half.
inline int stride_of(int half) { return 2 * half + 1 + 2 * (ROWS - 1); }

template <bool SYMMETRIC, bool LONG>
void rows_of(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel,
             vec (&sum)[ROWS][VECTORS]) {
  const int half = kernel.half, stride = stride_of(half);
  for (int i = 0; i < ROWS + 2 * half; i++) {
    const int first = kernel.first[i], last = kernel.last[i];
    if (!(rows[i] & columns) || first > last) continue;
    const float *row = in + (size_t)i * pitch + half;
    const float *tap = kernel.taps.data() + i + ROWS - 1;
    vec line[ROWS][VECTORS] = {};
    vec(&to)[ROWS][VECTORS] = LONG ? line : sum;
    vec v[VECTORS];
    if (SYMMETRIC) {
      for (int n = 0; n < VECTORS; n++) v[n] = load<vec>(row + n * LANES);
      for (int o = 0; o < ROWS; o++)
        for (int n = 0; n < VECTORS; n++) to[o][n] += v[n] * tap[-o];
      for (int d = 1; d <= last; d++) {
        tap += stride;
        for (int n = 0; n < VECTORS; n++) v[n] = load<vec>(row + n * LANES - d) + load<vec>(row + n * LANES + d);
        for (int o = 0; o < ROWS; o++)
          for (int n = 0; n < VECTORS; n++) to[o][n] += v[n] * tap[-o];
      }
    } else {
      tap += (half + first) * stride;
      for (int d = first; d <= last; d++, tap += stride) {
        for (int n = 0; n < VECTORS; n++) v[n] = load<vec>(row + n * LANES + d);
        for (int o = 0; o < ROWS; o++)
          for (int n = 0; n < VECTORS; n++) to[o][n] += v[n] * tap[-o];
      }
    }
    if (LONG)
      for (int o = 0; o < ROWS; o++)
        for (int n = 0; n < VECTORS; n++) sum[o][n] += line[o][n];
  }
}

// Finds for each input row the range of columns with nonzero taps.
void find_rows(Kernel &kernel) {
  const int half = kernel.half, side = 2 * half + 1, none = half + 1;
  std::vector<int> low(side, none), high(side, -none);
  const float *taps = kernel.taps.data() + ROWS - 1;
  for (int d = kernel.symmetric ? 0 : -half; d <= half; d++, taps += stride_of(half))
    for (int y = 0; y < side; y++) {
      low[y] = std::min(low[y], taps[y] != 0 ? d : none);
      high[y] = std::max(high[y], taps[y] != 0 ? d : -none);
    }
  kernel.first.assign(ROWS + 2 * half, none);
  kernel.last.assign(ROWS + 2 * half, -none);
  for (int y = 0; y < side; y++)
    for (int i = y; i < y + ROWS; i++) {
      kernel.first[i] = std::min(kernel.first[i], low[y]);
      kernel.last[i] = std::max(kernel.last[i], high[y]);
    }
}

}  // namespace

Kernel make_kernel(const float *values, int half, bool one_sided) {
  Kernel k;
  k.half = half;
  k.symmetric = one_sided;
  const int side = 2 * half + 1, stride = stride_of(half);
  double sum = 0;
  for (int y = 0; y < side; y++)
    for (int d = 1; d <= half; d++) k.symmetric &= values[y * side + half - d] == values[y * side + half + d];
  for (int i = 0; i < side * side; i++) sum += values[i];
  k.sum = (float)sum;
  const int first = k.symmetric ? 0 : -half;
  k.taps.assign((size_t)(half - first + 1) * stride, 0.0f);
  for (int y = 0; y < side; y++)
    for (int d = first; d <= half; d++)  // convolution: the kernel is rotated by half a turn
      k.taps[(size_t)(d - first) * stride + y + ROWS - 1] = values[(side - 1 - y) * side + half - d];
  find_rows(k);
  return k;
}

bool ends_dark(const torchdof_field_mask &mask, int distances) {
  const int rows = mask.rows, columns = mask.columns;
  for (int i = 0; i < mask.colours * distances; i++) {
    const float *values = mask.values + (size_t)i * rows * columns;
    for (int row = 0; row < rows; row++) {
      const float *of_row = values + (size_t)row * columns;
      if (of_row[columns - 1] != 0) return false;
      for (int column = 0; (row == 0 || row == rows - 1) && column < columns; column++)
        if (of_row[column] != 0) return false;
    }
  }
  return true;
}

void mask_kernel(const Layer &layer, int colour, const FieldMask &mask, Kernel &masked) {
  const Kernel &whole = layer.kernels[colour];
  const int half = whole.half, side = 2 * half + 1, stride = stride_of(half);
  masked.half = half;
  masked.symmetric = false;
  masked.sum = whole.sum;
  masked.taps.assign(whole.taps.size(), 0.0f);
  vec left = {};
  for (int d = -half; d <= half; d++) {
    const size_t column = (size_t)(d + half) * stride + ROWS - 1;
    const float *from = whole.taps.data() + column;
    float *to = masked.taps.data() + column;
    float low = -half, high = half;
    if (layer.spots) mask.rows_of((float)-d, low, high);
    const int start = (int)std::ceil(std::clamp(half - high, 0.0f, (float)side)),
              end = (int)std::floor(std::clamp(half - low, -1.0f, (float)(side - 1))) + 1;
    for (int y = start; y < end; y += LANES) {
      const int n = std::min(LANES, end - y);
      vec taps = {};
      memcpy(&taps, from + y, n * sizeof(float));
      taps *= mask.transmittance((float)(half - y) - iota(), broadcast((float)-d));
      left += taps;
      memcpy(to + y, &taps, n * sizeof(float));
    }
  }
  float light = 0;
  for (int i = 0; i < LANES; i++) light += left[i];
  if (!(light > FieldMask::LEAST * whole.sum)) {
    masked.taps = whole.taps;
    masked.first = whole.first;
    masked.last = whole.last;
    return;
  }
  const float gain = whole.sum / light;
  for (float &tap : masked.taps) tap *= gain;
  find_rows(masked);
}

void convolve_strip(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel,
                    float *out) {
  vec sum[ROWS][VECTORS] = {};
  if (kernel.symmetric && kernel.half <= SHORT)
    rows_of<true, false>(in, pitch, rows, columns, kernel, sum);
  else if (kernel.symmetric)
    rows_of<true, true>(in, pitch, rows, columns, kernel, sum);
  else
    rows_of<false, true>(in, pitch, rows, columns, kernel, sum);
  for (int o = 0; o < ROWS; o++)
    for (int n = 0; n < VECTORS; n++) store(out + o * STRIP_COLUMNS + n * LANES, sum[o][n]);
}

}  // namespace torchdof
