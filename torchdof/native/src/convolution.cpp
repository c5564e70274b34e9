// Convolution with one kernel: four rows and two vectors of columns at a time, kept in registers.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

constexpr int ROWS = STRIP_ROWS;
constexpr int VECTORS = STRIP_COLUMNS / LANES;
constexpr int SHORT = 10;  // half width up to which one sum in float32 is exact enough

// Taps of a kernel for input row i and ROWS output rows: taps[(i + ROWS - 1) + d * stride - o] is for output row o and
// columns d apart; rows above and below the kernel are 0. Without symmetry d counts from the left end.
inline int stride_of(int half) { return 2 * half + 1 + 2 * (ROWS - 1); }

template <bool SYMMETRIC, bool LONG>
void rows_of(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel, vec (&sum)[ROWS][VECTORS]) {
  const int half = kernel.half, stride = stride_of(half);
  for (int i = 0; i < ROWS + 2 * half; i++) {
    if (!(rows[i] & columns)) continue;
    const float *row = in + (size_t)i * pitch + half;
    const float *tap = kernel.taps.data() + i + ROWS - 1;
    const int reach = kernel.reach[i];
    vec line[ROWS][VECTORS] = {};
    vec(&to)[ROWS][VECTORS] = LONG ? line : sum;
    vec v[VECTORS];
    if (SYMMETRIC) {
      for (int n = 0; n < VECTORS; n++) v[n] = load<vec>(row + n * LANES);
      for (int o = 0; o < ROWS; o++)
        for (int n = 0; n < VECTORS; n++) to[o][n] += v[n] * tap[-o];
      for (int d = 1; d <= reach; d++) {
        tap += stride;
        for (int n = 0; n < VECTORS; n++) v[n] = load<vec>(row + n * LANES - d) + load<vec>(row + n * LANES + d);
        for (int o = 0; o < ROWS; o++)
          for (int n = 0; n < VECTORS; n++) to[o][n] += v[n] * tap[-o];
      }
    } else {
      tap += (half - reach) * stride;
      for (int d = -reach; d <= reach; d++, tap += stride) {
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
  k.reach.assign(ROWS + 2 * half, -1);
  for (int y = 0; y < side; y++)
    for (int d = -half; d <= half; d++) {
      // light comes from where it is scattered to, turned by half
      const float tap = values[(side - 1 - y) * side + half - d];
      if (d >= first) k.taps[(size_t)(d - first) * stride + y + ROWS - 1] = tap;
      if (tap != 0)
        for (int o = 0; o < ROWS; o++) k.reach[y + o] = std::max(k.reach[y + o], std::abs(d));
    }
  return k;
}

void cut_kernel(const Kernel &whole, const Turned &turned, Kernel &cut) {
  const int half = whole.half, side = 2 * half + 1, stride = stride_of(half);
  cut.half = half;
  cut.symmetric = false;
  cut.sum = whole.sum;
  cut.reach.assign(whole.reach.size(), -1);
  cut.taps = whole.taps;
  float left = 0;
  for (int d = -half; d <= half; d++) {
    float *taps = cut.taps.data() + (size_t)(d + half) * stride + ROWS - 1;
    for (int y = 0; y < side; y++) {
      if (taps[y] == 0) continue;
      taps[y] *= turned.share((float)(half - y), (float)-d);
      if (taps[y] == 0) continue;
      left += taps[y];
      for (int o = 0; o < ROWS; o++) cut.reach[y + o] = std::max(cut.reach[y + o], std::abs(d));
    }
  }
  if (!(left > Turned::LEAST * whole.sum)) {
    cut.taps = whole.taps;
    cut.reach = whole.reach;
    return;
  }
  const float gain = whole.sum / left;
  for (float &tap : cut.taps) tap *= gain;
}

void convolve_strip(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel, float *out) {
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

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
