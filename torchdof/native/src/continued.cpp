// Surfaces continued beyond the frame's border, forward and backward, for training: the function _continued of
// render/surfaces/border.py. Inference computes only the parts that it needs, in border.cpp.
//
// For a pixel i of a line along the border with light I and weight w, and the pixels j within 4 d pixels of it:
//
//   light at distance d = (I_i + sum K_ij w_j I_j / sum K_ij w_j) / 2
//
// K_ij is the share of pixel j that is on the surface of pixel i or on a farther one. With all places reversed, the
// shares are K_ji, so that the gradients of sums over windows are sums over windows again.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "api.h"
#include "blur_axis.h"
#include "border.h"
#include "entry.h"
#include "light.h"
#include "memory.h"
#include "threads.h"

namespace torchdof {
namespace {

// The maps of a frame. Sides are those of Border.
struct Frame {
  const float *const *light, *const *coc, *const *weight,
      *limit;  // of each surface; limit: light above which a highlight begins
  const int32_t S, C, height, width,
      *ends;              // numbers of surfaces and channels; pixels added at the left, right, top, bottom
  const float low, high;  // ends of the blur axis
  const int32_t image;    // the image's own surface, or -1: each one is an image
  const int threads;
  const size_t area = (size_t)height * width, pitch = ends[0] + width + ends[1],
               wide_area = pitch * (ends[2] + height + ends[3]);
  const size_t first = ends[2] * pitch + ends[0];  // the frame's first pixel in a continued map
  const Buffer<float> x{S * area};                 // positions on the blur axis, of each surface
  const float *x_of(int s) const { return x.data() + s * area; }
  const float *image_x_of(int s) const { return x_of(image < 0 ? s : image); }

  void find_positions() const {
    parallel(threads, S * height, nullptr, [&](int row, int) {
      const float *const from = coc[row / height] + (size_t)(row % height) * width;
      for (int at = 0; at < width; at++) x[(size_t)row * width + at] = axis(from[at], low, high);
    });
  }

  int length(int side) const { return side < Border::LEFT ? width : height; }
  // Offset of a pixel beyond pixel `at` of a side, or of that pixel itself, from the frame's first pixel.
  ptrdiff_t place(int side, int at, int distance, ptrdiff_t its_pitch) const {
    const int across = side % 2 ? length(side ^ 2) - 1 + distance : -distance;
    return side < Border::LEFT ? across * its_pitch + at : at * its_pitch + across;
  }

  BorderLine line_of(int side, int s) const {
    BorderLine line(length(side), C);
    std::vector<const float *> colours(C);
    for (int at = 0; at < length(side); at++) {
      const size_t pixel = place(side, at, 0, width);
      for (int c = 0; c < C; c++) colours[c] = light[s] + c * area + pixel;
      line.set_light(at, colours.data(), C, weight[s][pixel], limit[pixel]);
      line.x[at] = x_of(s)[pixel], line.image_x[at] = image_x_of(s)[pixel];
    }
    line.find_places();
    return line;
  }

  void write(float *out) const {
    Border border(height, width, C, S, *std::max_element(ends, ends + 4));
    parallel(threads, 4 * S, nullptr,
             [&](int i, int) { border.set((Border::Side)(i % 4), i / 4, line_of(i % 4, i / 4)); });
    parallel(threads, S * (C + 2), nullptr, [&](int plane, int) {
      const int s = plane / (C + 2), c = plane % (C + 2);
      const float *const map = c < C ? light[s] + c * area : c == C ? x_of(s) : weight[s];
      for (int y = -ends[2]; y < height + ends[3]; y++) {
        const int nearest = std::clamp(y, 0, height - 1);
        const float *const from = map + (size_t)nearest * width;
        float *const to = out + plane * wide_area + first + y * (ptrdiff_t)pitch;
        std::copy_n(from, width, to);
        if (c >= C) {  // place and weight are those of the border
          std::fill(to - ends[0], to, from[0]);
          std::fill(to + width, to + width + ends[1], from[width - 1]);
          continue;
        }
        if (y != nearest) border.continue_row(s, c, y, 0, width, to);
        for (int column = -ends[0]; column < 0; column++) to[column] = border.light(s, c, y, column, from[0]);
        for (int column = width; column < width + ends[1]; column++)
          to[column] = border.light(s, c, y, column, from[width - 1]);
      }
    });
  }

  // Adds the gradients by light, coc and weight of each surface.
  void gradient(const float *slopes, float *const *d_maps) const {
    const Buffer<float> d_x(2 * S * area);  // by the position of each surface, and by that of the image next to it
    std::fill_n(d_x.data(), 2 * S * area, 0.0f);
    parallel(threads, S, nullptr, [&](int s, int) {
      add_surface(s, slopes, d_maps[s], d_maps[2 * S + s], &d_x[s * area], &d_x[(S + s) * area]);
    });
    parallel(threads, S * height, nullptr, [&](int row, int) {
      for (size_t s = row / height, at = (size_t)(row % height) * width, end = at + width; at < end; at++) {
        float slope = d_x[s * area + at] + (image < 0 ? d_x[(S + s) * area + at] : 0.0f);
        for (int i = 0; (int)s == image && i < S; i++) slope += d_x[(S + i) * area + at];
        d_maps[S + s][at] += slope * slope_of_axis(coc[s][at]);
      }
    });
  }
  // Derivative of a position on the blur axis by the coc.
  float slope_of_axis(float at) const {
    const float size = std::fabs(at), sum = size + (float)SQUARE_PX, place = at * size / sum;
    if (std::fabs(place) <= (float)IN_FOCUS) return 0.0f;
    const float moved = place - std::copysign((float)IN_FOCUS, place);
    return moved < low || moved > high ? 0.0f : size * (size + 2 * (float)SQUARE_PX) / (sum * sum);
  }

  void add_surface(int s, const float *slopes, float *d_light, float *d_weight, float *d_x, float *d_image_x) const {
    slopes += s * (C + 2) * wide_area + first;
    for (int c = 0; c < C; c++)
      for (size_t y = 0; y < (size_t)height; y++)
        for (int at = 0; at < width; at++) d_light[c * area + y * width + at] += slopes[c * wide_area + y * pitch + at];
    for (int side = 0; side < 4; side++) add_line(side, s, slopes, d_light, d_weight, d_x, d_image_x);
    for (int k = 0; k < 2; k++)
      for (int y = -ends[2]; y < height + ends[3]; y++) {
        const float *const from = slopes + (C + k) * wide_area + y * (ptrdiff_t)pitch;
        float *const to = (k ? d_weight : d_x) + (size_t)std::clamp(y, 0, height - 1) * width;
        for (int at = 0; at < width; at++) to[at] += from[at];
        for (int at = -ends[0]; at < 0; at++) to[0] += from[at];
        for (int at = width; at < width + ends[1]; at++) to[width - 1] += from[at];
      }
  }

  // Adds the gradients by the pixels of a line.
  void add_line(int side, int s, const float *slopes, float *d_light, float *d_weight, float *d_x,
                float *d_image_x) const {
    const BorderLine line = line_of(side, s);
    const int n = length(side), sums = C + 1, added = ends[side ^ 2], *const beside = ends + (side & 2);
    const ptrdiff_t wide_step = place(side, 1, 0, pitch) - place(side, 0, 0, pitch);
    const int levels = Octave(added).levels();
    // gradients by the means of each level; each distance has half of the mean, and half of the nearest pixel
    std::vector<float> d_means(levels * C * n), row(n);
    for (int c = 0; c < C; c++)
      for (int distance = 1; distance <= added; distance++) {
        const Octave octave(distance);
        const float *const beyond = slopes + c * wide_area + place(side, 0, distance, pitch);
        for (int at = 0; at < n; at++) row[at] = beyond[at * wide_step];
        for (int k = 1; k <= beside[0]; k++) row[0] += beyond[-k * wide_step] * distance / (distance + k);
        for (int k = 1; k <= beside[1]; k++) row[n - 1] += beyond[(n - 1 + k) * wide_step] * distance / (distance + k);
        float *const near = &d_means[(octave.level * C + c) * n], *const far = near + C * n;
        for (int at = 0; at < n; at++) near[at] += 0.5f * (1.0f - octave.part) * row[at];
        for (int at = 0; at < n; at++) far[at] += 0.5f * octave.part * row[at];
      }

    // gradients by the nearest pixels, by the values in the sums, and by places
    std::vector<double> sum(n * sums), slope(n * sums), d_sum(n * sums), d_nearest(n * C), d_values(n * sums),
        d_places(n);
    std::vector<double> reversed(n);
    for (int at = 0; at < n; at++) reversed[at] = WindowSums::BINS - 1 - line.places[at];
    const WindowSums windows(n, sums, line.values.data(), line.places.data());
    for (int level = 0; level < levels; level++) {
      windows.sum(level, sum.data(), slope.data());
      for (int at = 0; at < n; at++) {
        double *const d = &d_sum[at * sums], *const own = &sum[at * sums], total = own[C] > 0 ? own[C] : 1.0;
        d[C] = 0;
        for (int c = 0; c < C; c++) {
          d_nearest[at * C + c] += d_means[(level * C + c) * n + at];
          d[c] = d_means[(level * C + c) * n + at] / total;
          if (own[C] > 0) d[C] -= d[c] * own[c] / total;
        }
        for (int k = 0; k < sums; k++) d_places[at] += d[k] * slope[at * sums + k];
      }
      WindowSums(n, sums, d_sum.data(), reversed.data()).sum(level, sum.data(), slope.data());
      for (int at = 0, k = 0; at < n; at++)
        for (int end = k + sums; k < end; k++) d_values[k] += sum[k], d_places[at] -= line.values[k] * slope[k];
    }

    const size_t start = place(side, 0, 0, width), step = place(side, 1, 0, width) - start;
    for (int at = 0; at < n; at++) {
      const float *const pixel = light[s] + start + at * step, share = line.shares[at], peak = peak_of(pixel, area, C);
      float *const d_pixel = d_light + start + at * step;
      double d_its_weight = d_values[at * sums + C], d_share = 0;
      for (int c = 0; c < C; c++) {
        const double d_dimmed = d_nearest[at * C + c] + d_values[at * sums + c] * line.values[at * sums + C];
        d_pixel[c * area] += (float)(d_dimmed * share);
        d_share += d_dimmed * pixel[c * area];
        d_its_weight += d_values[at * sums + c] * pixel[c * area] * share;
      }
      if (share < 1) add_to_peak(pixel, area, C, peak, (float)-d_share * share / peak, d_pixel);
      d_weight[start + at * step] += (float)d_its_weight;
    }
    line.gradient(d_places.data(), step, d_x + start, d_image_x + start);
  }
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_continued(const float *const *maps, int32_t surfaces, int32_t channels, int32_t height, int32_t width,
                           const int32_t *ends, float low, float high, int32_t image, int32_t threads, float *out,
                           const float *gradient, float *const *d_maps) {
  return torchdof::guarded([&] {
    const torchdof::Frame frame{maps,
                                maps + surfaces,
                                maps + 2 * surfaces,
                                maps[3 * surfaces],
                                surfaces,
                                channels,
                                height,
                                width,
                                ends,
                                low,
                                high,
                                image,
                                threads};
    frame.find_positions();
    gradient ? frame.gradient(gradient, d_maps) : frame.write(out);
  });
}
