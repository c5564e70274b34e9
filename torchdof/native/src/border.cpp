// Estimates the light beyond the frame's border, as described in render/surfaces/border.py.
#include "border.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "blur_axis.h"
#include "highlights.h"
#include "job.h"
#include "numbers.h"
#include "simd.h"

namespace torchdof {

using constants::border::STEP;

// The part of a difference on the blur axis that is a step between surfaces; 0 for a slope. Below, its derivative.
static double step_of(double difference) {
  return difference * std::clamp(std::fabs(difference) / STEP - 1.0, 0.0, 1.0);
}
static double slope_of_step(double difference) {
  const double steps = std::fabs(difference) / STEP;
  return steps < 1.0 ? 0.0 : steps > 2.0 ? 1.0 : 2.0 * steps - 1.0;
}

WindowSums::WindowSums(int length, int count, const double *values, const double *places)
    : length_(length), count_(count), bin_(length), part_(length), until_((size_t)(length + 1) * count * BINS) {
  typedef double bins __attribute__((vector_size(BINS * sizeof(double))));
  bins before;  // index of the bin before each one
  for (int k = 0; k < BINS; k++) before[k] = k - 1;
  double *until = until_.data();
  std::fill_n(until, count * BINS, 0.0);
  for (int at = 0; at < length; at++) {
    bin_[at] = std::min((int)places[at], BINS - 2);
    part_[at] = places[at] - bin_[at];
    // shares of the pixel in each bin and all farther ones
    const bins shares = min(max(places[at] - before, bins{}), bins{} + 1.0);
    for (int n = 0; n < count; n++, until += BINS) store(until + count * BINS, load<bins>(until) + shares * *values++);
  }
}

void WindowSums::sum(int level, double *sums, double *slopes) const {
  const int half = (int)std::min<int64_t>((int64_t)WIDTH << level, length_);
  for (int at = 0, i = 0; at < length_; at++) {
    const double *from = &until_[(size_t)std::max(at - half, 0) * count_ * BINS];
    const double *to = &until_[(size_t)std::min(at + half + 1, length_) * count_ * BINS];
    const int bin = bin_[at],
              before = std::max(bin - (part_[at] == 0), 0);  // a place at a bin has slopes to both sides
    for (int n = 0; n < count_; n++, i++, from += BINS, to += BINS) {
      const double lower = to[bin] - from[bin], upper = to[bin + 1] - from[bin + 1];
      sums[i] = (1.0 - part_[at]) * lower + part_[at] * upper;
      if (slopes) slopes[i] = (part_[at] < 1 ? upper : 0.0) - (to[before] - from[before]);
    }
  }
}

void BorderLine::set_light(int at, const float *const *light, int channels, float weight, float limit) {
  float brightest = *light[0];
  for (int c = 1; c < channels; c++) brightest = std::max(brightest, *light[c]);
  if (brightest > limit) shares[at] = limit / brightest;
  double *const value = &values[(size_t)at * (channels + 1)];
  for (int c = 0; c < channels; c++) value[c] = *light[c] * shares[at] * (double)weight;
  value[channels] = weight;
}

void BorderLine::find_places() {
  for (size_t at = 1; at < x.size(); at++) surface[at] = surface[at - 1] + step_of(image_x[at] - image_x[at - 1]);
  const auto ends = std::minmax_element(surface.begin(), surface.end());
  least = *ends.first, most = *ends.second, per_bin = (WindowSums::BINS - 1) / std::max(most - least, 1.0);
  for (size_t at = 0; at < x.size(); at++)
    places[at] =
        std::clamp((surface[at] + step_of(x[at] - image_x[at]) - least) * per_bin, 0.0, WindowSums::BINS - 1.0);
}

void BorderLine::gradient(const double *d_places, ptrdiff_t step, float *d_x, float *d_image_x) const {
  std::vector<double> d_surface(x.size());
  double d_least = 0, d_most = 0, d_next = 0;
  for (size_t at = 0; at < x.size(); at++) {
    const double own = x[at] - image_x[at], place = (surface[at] + step_of(own) - least) * per_bin;
    d_surface[at] = place < 0 || place > WindowSums::BINS - 1 ? 0.0 : d_places[at] * per_bin;
    d_least -= d_surface[at];
    if (most - least >= 1) d_most -= d_surface[at] * place / (WindowSums::BINS - 1);
    d_x[at * step] += d_surface[at] * slope_of_step(own);
    d_image_x[at * step] -= d_surface[at] * slope_of_step(own);
  }
  // pixels of equal extremes share their gradient
  d_least = (d_least - d_most) / std::count(surface.begin(), surface.end(), least);
  d_most /= std::count(surface.begin(), surface.end(), most);
  for (size_t at = x.size() - 1; at > 0; at--) {
    d_next += d_surface[at] + (surface[at] == least) * d_least + (surface[at] == most) * d_most;
    const double slope = d_next * slope_of_step(image_x[at] - image_x[at - 1]);
    d_image_x[at * step] += slope;
    d_image_x[(at - 1) * step] -= slope;
  }
}

Border::Border(int height, int width, int channels, int surfaces, int farthest)
    : height_(height), width_(width), channels_(channels), levels_(Octave(farthest).levels()) {
  for (int distance = 0; distance <= farthest; distance++) {
    const Octave octave(distance);
    level_of_.push_back(octave.level);
    part_of_.push_back(octave.part);
  }
  for (auto side : {TOP, BOTTOM, LEFT, RIGHT}) {
    means_[side].resize(start(side, surfaces, 0, 0));
    shares_[side].resize((size_t)surfaces * length(side));
  }
}

void Border::set(Side side, int surface, const BorderLine &line) {
  const int sums = channels_ + 1;
  std::copy(line.shares.begin(), line.shares.end(), shares_[side].begin() + (size_t)surface * length(side));
  const WindowSums windows(length(side), sums, line.values.data(), line.places.data());
  std::vector<double> sum(line.values.size());
  for (int level = 0; level < levels_; level++) {
    windows.sum(level, sum.data());
    for (int at = 0; at < length(side); at++) {
      const double *of = &sum[(size_t)at * sums], total = of[channels_];
      for (int c = 0; c < channels_; c++)
        means_[side][start(side, surface, c, level) + at] = total > 0 ? (float)(of[c] / total) : 0.0f;
    }
  }
}

Border border_of(const Job &job, int farthest) {
  const Surfaces &s = job.surfaces;
  Border border;
  border.dark_ = !job.scene.occlusion && !job.scene.normalize;
  if (border.dark_) return border;
  border = Border(job.height, job.width, job.channels, s.count, farthest);
  const float low = (float)job.scene.nodes[0], high = (float)job.scene.nodes[job.scene.layers - 1];
  job.parallel(4, [&](int which, int) {
    const auto side = (Border::Side)which;
    std::vector<const float *> light(job.channels);
    const float *coc, *weight;
    for (int i = 0; i < s.count; i++) {
      const float *const image = job.scene.kind == TORCHDOF_STACK ? s.cocs[i] : s.coc;
      BorderLine line(border.length(side), job.channels);
      for (int at = 0; at < border.length(side); at++) {
        const int y = side >= Border::LEFT ? at : side == Border::TOP ? 0 : job.height - 1;
        const int x = side < Border::LEFT ? at : side == Border::LEFT ? 0 : job.width - 1;
        line.x[at] = line.image_x[at] = axis(image[job.surfaces.pixel(y, x)], low, high);
        if (!s.row(i, y, x, light.data(), coc, weight)) continue;
        line.x[at] = axis(*coc, low, high);
        const float limit = job.threshold.empty() ? INFINITY : threshold_at(job, y, x);
        line.set_light(at, light.data(), job.channels, weight ? *weight : 1.0f, limit);
      }
      line.find_places();
      border.set(side, i, line);
    }
  });
  return border;
}

void Border::continue_row(int surface, int channel, int y, int x, int n, float *row) const {
  if (dark_) {
    std::fill(row, row + n, 0.0f);
    return;
  }
  const int far = y < 0 ? -y : y - height_ + 1;
  const float part = part_of_[far];
  const Side side = y < 0 ? TOP : BOTTOM;
  const float *nearer = means_[side].data() + start(side, surface, channel, level_of_[far]) + x,
              *farther = nearer + length(side);
  const float *share = shares_[side].data() + (size_t)surface * length(side) + x;
  for (int i = 0; i < n; i++) row[i] = 0.5f * (row[i] * share[i] + nearer[i] + part * (farther[i] - nearer[i]));
}

}  // namespace torchdof
