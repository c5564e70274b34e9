// A pixel of an item. Included after `Run`, the argument of the kernels, which has the height and width of maps.
#pragma once
#include "numbers.h"

constexpr int TILE_ROWS = 4, TILE_COLUMNS = 32;  // of a block of threads, as in loader.py

struct Pixel {
  int item, y, x;
  // That of a thread.
  __device__ Pixel() : item(blockIdx.z), y(blockIdx.y * TILE_ROWS + threadIdx.y), x(blockIdx.x * TILE_COLUMNS + threadIdx.x) {}
  // That of an index: (item height + y) width + x.
  __device__ Pixel(const Run &r, long long index) : item(index / r.width / r.height), y(index / r.width % r.height), x(index % r.width) {}
  __device__ bool is_in(const Run &r) const { return y < r.height && x < r.width; }
  // Its index in a map with a number of planes.
  __device__ long long in(const Run &r, int planes, int plane) const { return ((long long)(item * planes + plane) * r.height + y) * r.width + x; }
  // The pixel at an offset; beyond the frame, that of its border.
  __device__ Pixel at(const Run &r, int dy, int dx) const {
    Pixel q = *this;
    q.y = torchdof::min(torchdof::max(y + dy, 0), r.height - 1);
    q.x = torchdof::min(torchdof::max(x + dx, 0), r.width - 1);
    return q;
  }
};
