// A frame that is processed in parts. Each part is copied to a grid with a margin, padded beyond the frame with the
// nearest border pixel, so that loops run in whole vectors.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstring>

#include "memory.h"
#include "simd.h"

namespace torchdof {

// A rectangle in the coordinates of the frame; may reach beyond the frame.
struct Part {
  int y0, x0, height, width;

  int bottom() const { return y0 + height; }
  int right() const { return x0 + width; }
  bool has(int y, int x) const { return y >= y0 && y < bottom() && x >= x0 && x < right(); }
  Part grown(int by) const { return {y0 - by, x0 - by, height + 2 * by, width + 2 * by}; }
};

// A temporary plane, or several, addressed by frame coordinates. Rows are padded by up to two vectors that may be read.
class Grid : public Part {
 public:
  explicit Grid(const Part &part, int planes = 1)
      : Part(part), pitch((part.width + LANES - 1) / LANES * LANES + 2 * LANES), size((size_t)part.height * pitch),
        data_(size * planes + LANES) {
    std::fill(&data_[size * planes], &data_[size * planes] + LANES, 0.0f);
  }

  float *at(int y, int x) const { return data_.data() + (size_t)(y - y0) * pitch + (x - x0); }
  void clear() const { std::fill(data_.data(), data_.data() + size, 0.0f); }

  const int pitch;
  const size_t size;  // values in a plane

 private:
  const Buffer<float> data_;
};

// Calls body(y, x) for each vector of a part; the last vector of a row may extend beyond the part.
template <typename Body>
inline void each_vector(const Part &part, const Body &body) {
  for (int y = part.y0; y < part.bottom(); y++)
    for (int x = part.x0; x < part.right(); x += LANES) body(y, x);
}

// Maximum over a square of side 2 REACH_ + 1 around each value of a part: the maximum of three overlapping runs.
template <int REACH_>
void max_filter(const Grid &in, const Grid &out, const Grid &rows, const Part &part) {
  constexpr int TAPS = 2 * REACH_ + 1, RUN = (TAPS + 2) / 3, LAST = TAPS - RUN, MIDDLE = LAST / 2;
  const auto run = [](const float *from, int stride) {
    vec high = load<vec>(from);
    for (int d = 1; d < RUN; d++) high = max(high, load<vec>(from + d * stride));
    return high;
  };
  const auto three = [](const float *from, int stride) {
    return max(load<vec>(from), max(load<vec>(from + MIDDLE * stride), load<vec>(from + LAST * stride)));
  };
  for (int y = part.y0 - REACH_; y < part.bottom() + REACH_; y++) {
    for (int x = part.x0; RUN > 1 && x < part.right() + LAST; x += LANES)
      store(rows.at(y, x), run(in.at(y, x - REACH_), 1));
    for (int x = part.x0; x < part.right(); x += LANES)
      store(rows.at(y, x), three(RUN > 1 ? rows.at(y, x) : in.at(y, x - REACH_), 1));
  }
  each_vector({part.y0 - REACH_, part.x0, RUN > 1 ? part.height + LAST : 0, part.width},
              [&](int y, int x) { store(rows.at(y, x), run(rows.at(y, x), rows.pitch)); });
  each_vector(part, [&](int y, int x) { store(out.at(y, x), three(rows.at(y - REACH_, x), rows.pitch)); });
}

// Maximum over 3 x 3 values around each value of a vector.
inline vec max_3x3(const float *from, int pitch) {
  vec high = max(load<vec>(from), max(load<vec>(from - 1), load<vec>(from + 1)));
  for (const float *row : {from - pitch, from + pitch})
    high = max(high, max(load<vec>(row), max(load<vec>(row - 1), load<vec>(row + 1))));
  return high;
}

// Sum over a square of side 2 REACH_ + 1 around each value of a part, times a factor.
template <int REACH_>
void sums(const Grid &in, const Grid &out, const Grid &rows, const Part &part, float factor) {
  const auto sum = [](const float *middle, int stride) {
    vec total = load<vec>(middle);
    for (int d = 1; d <= REACH_; d++) total += load<vec>(middle - d * stride) + load<vec>(middle + d * stride);
    return total;
  };
  each_vector({part.y0 - REACH_, part.x0, part.height + 2 * REACH_, part.width},
              [&](int y, int x) { store(rows.at(y, x), sum(in.at(y, x), 1)); });
  each_vector(part, [&](int y, int x) { store(out.at(y, x), sum(rows.at(y, x), rows.pitch) * factor); });
}

// The size of a frame, with what depends on it.
class Frame {
 protected:
  Frame(int height, int width) : height_(height), width_(width), area_((size_t)height * width) {}

  // Index of a pixel in a plane of the frame.
  size_t pixel(int y, int x) const { return (size_t)y * width_ + x; }

  Part in_frame(const Part &part) const {
    const int y0 = std::max(0, part.y0), x0 = std::max(0, part.x0);
    return {y0, x0, std::min(height_, part.bottom()) - y0, std::min(width_, part.right()) - x0};
  }

  // Fills all rows of a grid from a plane of the frame, padding with the nearest border pixel.
  template <typename Value, typename Of>
  void fetch(const Value *plane, const Grid &grid, float *to, const Of &of) const {
    const int first = std::max(0, -grid.x0), last = std::min(grid.pitch, width_ - grid.x0);
    for (int y = grid.y0; y < grid.bottom(); y++, to += grid.pitch) {
      const Value *from = plane + (ptrdiff_t)std::min(std::max(y, 0), height_ - 1) * width_ + grid.x0;
      for (int x = first; x < last; x++) to[x] = of(from[x]);
      std::fill(to, to + first, to[first]);
      std::fill(to + last, to + grid.pitch, to[last - 1]);
    }
  }
  template <typename Value, typename Of>
  void fetch(const Value *plane, const Grid &grid, const Of &of) const {
    fetch(plane, grid, grid.at(grid.y0, grid.x0), of);
  }

  // Overwrites values of a part beyond the frame with the nearest value inside.
  void clamp_to_frame(const Grid &grid, const Part &part) const {
    const Part inside = in_frame(part);
    for (int y = inside.y0; y < inside.bottom(); y++) {
      float *row = grid.at(y, 0);
      std::fill(row + part.x0, row + inside.x0, row[inside.x0]);
      if (inside.right() < part.right()) std::fill(row + inside.right(), row + part.right(), row[inside.right() - 1]);
    }
    for (int y = part.y0; y < part.bottom(); y++)
      if (const int nearest = std::min(std::max(y, inside.y0), inside.bottom() - 1); nearest != y)
        memcpy(grid.at(y, part.x0), grid.at(nearest, part.x0), part.width * sizeof(float));
  }

  const int height_, width_;
  const size_t area_;
};

}  // namespace torchdof
