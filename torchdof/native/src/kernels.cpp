// Makes kernels of any radius from a lens's templates; formulas in optics/kernel_bank.py and optics/psf.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <vector>

#include "api.h"
#include "constants/psf.h"
#include "entry.h"
#include "threads.h"

namespace torchdof {
namespace {

using constants::psf::MARGIN_PX, constants::psf::RIPPLING;
constexpr int FAR = 11;  // distance in pixels beyond which the spline is below 5e-7
constexpr double ROOT = 1.7320508075688772, PI = 3.141592653589793;

// The cardinal cubic spline: 1 at 0 and 0 at every other integer. Linear interpolation of PER_PX samples for each
// pixel.
class Spline {
 public:
  Spline() : samples_(FAR * PER_PX + 2) {
    double right = 12 * ROOT - 18, left = 6 - 6 * ROOT;
    for (int knot = 0; knot < FAR; knot++, left = right, right *= ROOT - 2)
      for (int i = 0; i < PER_PX; i++) {
        const double part = (double)i / PER_PX, other = 1 - part;
        const double bent = left * (other * other * other - other) + right * (part * part * part - part);
        samples_[knot * PER_PX + i] = (float)((knot ? 0 : other) + bent / 6);
      }
  }
  float operator()(double t) const {
    const float place = (float)(std::fabs(t) * PER_PX);
    if (place >= FAR * PER_PX) return 0;
    const int at = (int)place;
    return samples_[at] + (place - at) * (samples_[at + 1] - samples_[at]);
  }

 private:
  static constexpr int PER_PX = 1024;
  std::vector<float> samples_;
};

// What a constant template would give at a pixel instead of 1: the sum of the spline over samples `cell` pixels apart,
// times `cell`. Weights are divided by it.
double ripple(int pixel, double cell) {
  const double cycles = 1 / std::min(std::max(cell, RIPPLING), 1.0), turn = PI * cycles, sinc = std::sin(turn) / turn;
  const double spectrum = 3 * sinc * sinc * sinc * sinc / (2 + std::cos(2 * turn));
  return 1 + 2 * spectrum * std::cos(2 * turn * pixel);
}

// Weights that resample a template's cells to a kernel's pixels along one axis, by the spline and linearly. If the
// kernel is symmetric (folded), only the half from its centre is kept, and each cell also represents its mirror image.
struct Axis {
  struct Weights {
    std::vector<float> values;     // [cells, pixels]
    std::vector<int> first, last;  // pixels within reach of each cell
    Weights(int cells, int pixels) : values((size_t)cells * pixels), first(cells), last(cells) {}
  };
  int pixels, cells;
  Weights spline, line;

  Axis(int half, int count, double cell, bool folded)
      : pixels(folded ? half + 1 : 2 * half + 1), cells(folded ? count + 1 : 2 * count + 1), spline(cells, pixels),
        line(cells, pixels) {
    const int p0 = folded ? 0 : -half, c0 = folded ? 0 : -count;
    static const Spline spline_at;
    const double wide = std::max(cell, 1.0);
    std::vector<float> per_ripple(pixels);
    for (int p = 0; p < pixels; p++) per_ripple[p] = (float)(1 / ripple(p + p0, cell));
    for (int c = 0; c < cells; c++) {
      const double place = (c + c0) * cell;
      for (Weights *weights : {&spline, &line}) {
        const double reach = weights == &line || cell > 1 ? wide : FAR;
        weights->first[c] = std::max((int)std::ceil(place - reach) - p0, 0);
        weights->last[c] = std::min((int)std::floor(place + reach) - p0, pixels - 1);
      }
      for (int p = spline.first[c]; p <= spline.last[c]; p++) {
        float in_spline = 0, in_line = 0;
        for (int side = 0; side < (folded && c ? 2 : 1); side++) {
          const double away = p + p0 + (side ? place : -place);
          const float of_line = std::max(1 - (float)(std::fabs(away) / wide), 0.0f);
          in_line += of_line;
          in_spline += cell > 1 ? of_line : spline_at(away) * per_ripple[p];
        }
        spline.values[(size_t)c * pixels + p] = in_spline;
        line.values[(size_t)c * pixels + p] = in_line;
      }
    }
  }
};

// Resamples the template: out [down.pixels, across.pixels]; row is a buffer.
void product(const Axis &down, const Axis &across, const float *light, Axis::Weights Axis::*which,
             std::vector<float> &row, float *out) {
  const Axis::Weights &by_row = down.*which, &by_column = across.*which;
  std::fill(out, out + (size_t)down.pixels * across.pixels, 0.0f);
  for (int y = 0; y < down.pixels; y++) {
    row.assign(across.cells, 0.0f);
    float *const u = row.data(), *const to = out + (size_t)y * across.pixels;
    for (int c = 0; c < down.cells; c++) {
      if (y < by_row.first[c] || y > by_row.last[c]) continue;
      const float weight = by_row.values[(size_t)c * down.pixels + y];
      const float *from = light + (size_t)c * across.cells;
      for (int x = 0; x < across.cells; x++) u[x] += weight * from[x];
    }
    for (int c = 0; c < across.cells; c++) {
      const float value = u[c], *weights = &by_column.values[(size_t)c * across.pixels];
      for (int x = by_column.first[c]; x <= by_column.last[c]; x++) to[x] += value * weights[x];
    }
  }
}

class Maker {
 public:
  explicit Maker(const torchdof_spots &spots) : s_(spots), folded_(spots.round != 0) {}

  // Kernel i of a colour: out [2 half + 1, 2 half + 1].
  void make(int i, int colour, float *out) {
    const int half = s_.half[i], side = 2 * half + 1;
    const double reach = s_.reach[(size_t)i * s_.colours + colour];
    const float finer = (float)s_.finer[i], fade = (float)s_.fade[(size_t)i * s_.colours + colour];
    const int32_t *which = s_.index + (size_t)i * 4;
    if (s_.even) {
      even(half, reach, out);
    } else {
      level(which, (float)s_.part[i], reach, colour, half, out);
      if (finer > 0) {
        finer_.resize((size_t)side * side);
        level(which + 2, (float)s_.part[i], reach, colour, half, finer_.data());
        for (int k = 0; k < side * side; k++) out[k] += finer * (finer_[k] - out[k]);
      }
    }
    if (s_.flipped[i]) std::reverse(out, out + side * side);
    if (fade < 1) {
      for (int k = 0; k < side * side; k++) out[k] *= fade;
      out[(size_t)half * side + half] += 1 - fade;
    }
  }

 private:
  static void even(int half, double reach, float *out) {
    int64_t count = 0;
    float *to = out;
    for (int y = -half; y <= half; y++)
      for (int x = -half; x <= half; x++, to++) count += (*to = std::hypot((double)y, (double)x) <= reach);
    for (const float *const end = to; out < end; out++) *out /= (float)count;
  }

  // A kernel from the templates of two nodes:
  //
  // 1. Interpolate between the templates.
  // 2. Resample their cells to pixels, by the spline and linearly.
  // 3. Remove the spline's overshoot, with the linear interpolation as a limit.
  // 4. Crop the pixels around the kernel, and normalize the sum to 1.
  void level(const int32_t *which, float part, double reach, int colour, int half, float *out) {
    const int count = s_.cells[which[0]] + 1, across_all = 2 * count + 1;
    const size_t area = (size_t)across_all * across_all;
    const float *a = s_.templates[which[0]] + area * colour, *b = s_.templates[which[1]] + area * colour;
    const double high = reach / (count - 1), wide = high / s_.squeeze;
    const int cells = folded_ ? count + 1 : across_all, from = folded_ ? count : 0;
    light_.resize((size_t)cells * cells);
    for (int y = 0; y < cells; y++)
      for (int x = 0; x < cells; x++) {
        const size_t at = (size_t)(from + y) * across_all + from + x;
        light_[(size_t)y * cells + x] = a[at] + part * (b[at] - a[at]);
      }
    const Axis down(half + MARGIN_PX, count, high, folded_);
    const Axis across = wide == high ? down : Axis(half + MARGIN_PX, count, wide, folded_);
    const int n = down.pixels;
    kernel_.resize((size_t)n * n);
    at_most_.resize(kernel_.size());
    product(down, across, light_.data(), &Axis::spline, row_, kernel_.data());
    product(down, across, light_.data(), &Axis::line, row_, at_most_.data());
    settle(n);
    const int start = folded_ ? 0 : MARGIN_PX, side = 2 * half + 1;
    double sum = 0;
    for (int y = 0; y < side; y++)
      for (int x = 0; x < side; x++) {
        const int row = folded_ ? std::abs(y - half) : y + start, column = folded_ ? std::abs(x - half) : x + start;
        sum += out[(size_t)y * side + x] = settled_[(size_t)row * n + column];
      }
    const double widest = reach * std::max(1.0, 1.0 / s_.squeeze);
    if (half < widest - 1e-9) {  // the kernel is cropped: normalize by the whole template's sum
      sum = 0;
      for (size_t k = 0; k < area; k++) sum += a[k] + part * (b[k] - a[k]);
      sum *= std::max(high, 1.0) * std::max(wide, 1.0);
    }
    const double per_sum = sum > 0 ? 1 / sum : 0.0;
    for (int k = 0; k < side * side; k++) out[k] = (float)(out[k] * per_sum);
  }

  // Removes the spline's overshoot from a kernel [n, n]: limits each value to twice the linear interpolation, and
  // raises negative values to 0. Their four neighbours give the light for this, in proportion to their own.
  void settle(int n) {
    const int pitch = n + 2;
    const auto in = [pitch](int y, int x) { return (size_t)y * pitch + x; };  // index in planes with a margin of 1
    positive_.assign((size_t)pitch * pitch, 0.0f);
    rate_.assign(positive_.size(), 0.0f);
    settled_.resize((size_t)n * n);
    auto mirror = [&](std::vector<float> &values) {  // fills the values before the centre of a symmetric kernel
      if (!folded_) return;
      for (int k = 0; k < pitch; k++) values[k] = values[2 * pitch + k];
      for (int k = 0; k < pitch; k++) values[in(k, 0)] = values[in(k, 2)];
    };
    for (int y = 0; y < n; y++)
      for (int x = 0; x < n; x++) {
        float &value = kernel_[(size_t)y * n + x];
        value = std::min(value, 2 * std::max(at_most_[(size_t)y * n + x], 0.0f));
        positive_[in(y + 1, x + 1)] = std::max(value, 0.0f);
      }
    mirror(positive_);
    auto around = [&](const std::vector<float> &values, int y, int x) {
      const float *p = &values[in(y + 1, x + 1)];
      return p[-pitch] + p[pitch] + p[-1] + p[1];
    };
    for (int y = 0; y < n; y++)
      for (int x = 0; x < n; x++) {
        const float owed = -kernel_[(size_t)y * n + x];
        if (!(owed > 0)) continue;
        const float have = around(positive_, y, x);
        if (have > 0) rate_[in(y + 1, x + 1)] = owed / have;
      }
    mirror(rate_);
    for (int y = 0; y < n; y++)
      for (int x = 0; x < n; x++)
        settled_[(size_t)y * n + x] = std::max(positive_[in(y + 1, x + 1)] * (1 - around(rate_, y, x)), 0.0f);
  }

  const torchdof_spots &s_;
  const bool folded_;
  std::vector<float> light_, row_, kernel_, at_most_, positive_, rate_, settled_, finer_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_kernels(const torchdof_spots *spots, int32_t threads, float *const *out) {
  return torchdof::guarded([&] {
    std::vector<std::unique_ptr<torchdof::Maker>> makers(std::max(threads, 1));
    torchdof::parallel(threads, spots->count, nullptr, [&](int i, int thread) {
      if (!makers[thread]) makers[thread].reset(new torchdof::Maker(*spots));
      const size_t area = (size_t)(2 * spots->half[i] + 1) * (2 * spots->half[i] + 1);
      for (int e = 0; e < spots->colours; e++) makers[thread]->make(i, e, out[i] + area * e);
    });
  });
}
