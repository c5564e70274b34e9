// The window of samples around a pixel, in vectors.
#pragma once
#include <vector>

#include "constants/edge_search.h"
#include "simd.h"

namespace torchdof {

using constants::edge_search::REACH;
// Vectors of a window of SIDE x SIDE pixels: first WHOLE columns of each row, then the remaining 4 columns.
constexpr int SIDE = 2 * REACH + 1, WHOLE = SIDE / LANES * LANES, ROWS_AT_ONCE = LANES / 4,
              WINDOW = SIDE * WHOLE / LANES + (SIDE + ROWS_AT_ONCE - 1) / ROWS_AT_ONCE;
static_assert(SIDE - WHOLE <= 4 && WHOLE > REACH + 1);

// Calls look(n, take) for each vector n of a window; take(p, pitch) loads it from a grid, p being the window's first
// value.
template <typename Look>
inline void each_of_window(const Look &look) {
  int n = 0;
  for (int v = 0; v < SIDE; v++)
    for (int u = 0; u < WHOLE; u += LANES)
      look(n++, [v, u](const float *p, int pitch) { return load<vec>(p + v * pitch + u); });
  for (int v = 0; v + ROWS_AT_ONCE <= SIDE; v += ROWS_AT_ONCE)
    look(n++, [v](const float *p, int pitch) {
      p += v * pitch + WHOLE;
#if defined(__AVX2__)
      return (vec)__builtin_ia32_vinsertf128_ps256(load<vec>(p), load<quad>(p + pitch), 1);
#else
      return load<vec>(p);
#endif
    });
  if (SIDE % ROWS_AT_ONCE) look(n, [](const float *p, int pitch) { return load<vec>(p + (SIDE - 1) * pitch + WHOLE); });
}

// Samples a function of the squared distance from the centre at each pixel of a window.
template <typename Of>
std::vector<float> window(const Of &of) {
  std::vector<float> values(WINDOW * LANES, 0.0f);
  for (int v = 0; v < SIDE; v++)
    for (int u = 0; u < SIDE; u++)
      values[u < WHOLE ? v * WHOLE + u : SIDE * WHOLE + 4 * v + u - WHOLE] =
          of((float)((v - REACH) * (v - REACH) + (u - REACH) * (u - REACH)));
  return values;
}

}  // namespace torchdof
