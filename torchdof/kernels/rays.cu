// The rays of highlights that nearer surfaces block, on a GPU: _blocked in torchdof/render/highlights.py, which has the formula. NVRTC
// compiles this file at first use. Forward only; without shared memory, barriers and atomic operations, as layers.cu.
#include "numbers.h"

using torchdof::absolute;
using torchdof::max;
using torchdof::min;

constexpr int BLOCK = 128;  // threads, as in rays.py

// What the kernel works on, filled in by rays.py: one member a line.
struct Run {
  const float *scale;       // way of a ray in a bin over that on the picture, [count, bins]
  const float *fades;       // how far a bin blocks, 0 to 1, the same
  const bool *wanted;       // whether a bin has surfaces within reach, the same
  const long long *item;    // of a highlight, [count]
  const long long *row;     // the same
  const long long *column;  // the same
  const float *place;       // of surfaces, in bins, [surfaces, items, height, width]
  const float *cover;       // the same
  float *hidden;            // part of a ray that is blocked, [count, side, side]
  int count;
  int bins;
  int side;
  int surfaces;
  int items;
  int height;
  int width;
};

// The two pixels beside a place on an axis of some pixels, and how far it is at the second one, 0 to 1.
struct Beside {
  int first, second;
  float part;
  __device__ Beside(float at, int pixels) {
    at = max(at, 0.0f);
    first = max(min((int)min(at, 1e9f), pixels - 2), 0);
    second = min(first + 1, pixels - 1);
    part = min(at - first, 1.0f);
  }
};
__device__ inline float between(float a, float b, float part) { return a + part * (b - a); }

// One thread a ray.
extern "C" __global__ void block_rays(const __grid_constant__ Run r) {
  const long long ray = (long long)blockIdx.x * BLOCK + threadIdx.x, taps = (long long)r.side * r.side;
  if (ray >= r.count * taps) return;
  const int n = ray / taps, y = ray / r.side % r.side - r.side / 2, x = ray % r.side - r.side / 2;
  float hidden = 0;
  for (long long k = (long long)n * r.bins; k < (long long)(n + 1) * r.bins; k++) {
    if (!r.wanted[k]) continue;
    const Beside rows(r.row[n] + r.scale[k] * y, r.height), columns(r.column[n] + r.scale[k] * x, r.width);
    const auto covered = [&](int v, int u) {
      float sum = 0;
      for (int s = 0; s < r.surfaces; s++) {
        const long long at = ((s * r.items + r.item[n]) * r.height + v) * r.width + u;
        sum += r.cover[at] * max(1 - absolute(r.place[at] - (k - (long long)n * r.bins)), 0.0f);
      }
      return sum;
    };
    const float above = between(covered(rows.first, columns.first), covered(rows.first, columns.second), columns.part);
    const float below = between(covered(rows.second, columns.first), covered(rows.second, columns.second), columns.part);
    hidden += between(above, below, rows.part) * r.fades[k];
  }
  r.hidden[ray] = min(hidden, 1.0f);
}
