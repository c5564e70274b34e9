// Estimates the light beyond the frame's border, as described in render/border.py.
#include "engine.h"

namespace torchdof {

// Constants of render/border.py, which gives their meanings and effects.
constexpr int WIDTH = 4, BINS = 16;
constexpr double STEP = 0.5;

// The part of a difference on the blur axis that is a step between surfaces; 0 for a slope.
static double step_of(double difference) { return difference * std::clamp(std::fabs(difference) / STEP - 1.0, 0.0, 1.0); }

// Computes, for each side of the frame and each surface, means of the light along the border.
//
// 1. Place the border's pixels on an axis on which only steps between surfaces count, in BINS bins.
// 2. Accumulate light and weight along the border for each bin and all farther ones, so that nearer surfaces are left out.
// 3. Differences of these sums are the means over windows of doubling width, one for each level.
Border border_of(const Job &job, int farthest) {
  const Surfaces &s = job.surfaces;
  Border border;
  border.height_ = job.height, border.width_ = job.width, border.channels_ = job.channels;
  border.dark_ = !job.scene.occlusion && !job.scene.normalize;
  if (border.dark_) return border;
  while (farthest >> border.levels_) border.levels_++;
  border.levels_++;
  for (int distance = 0, level = 0; distance <= farthest; distance++) {
    while (2 << level <= distance) level++;
    border.level_of_.push_back(level);
    border.part_of_.push_back((float)distance / (1 << level) - 1.0f);
  }
  for (auto side : {Border::TOP, Border::BOTTOM, Border::LEFT, Border::RIGHT}) {
    border.means_[side].resize(border.start(side, s.count, 0, 0));
    border.shares_[side].resize((size_t)s.count * border.length(side));
  }
  const float low = (float)job.scene.nodes[0], high = (float)job.scene.nodes[job.scene.layers - 1];
  job.parallel(4, [&](int which, int) {
    const auto side = (Border::Side)which;
    const bool upright = side >= Border::LEFT;
    const int length = border.length(side), C = job.channels, sums = C + 1;
    const auto row_of = [&](int at) { return upright ? at : side == Border::TOP ? 0 : job.height - 1; };
    const auto column_of = [&](int at) { return !upright ? at : side == Border::LEFT ? 0 : job.width - 1; };
    std::vector<double> until((size_t)(length + 1) * BINS * sums);  // prefix sums of each bin: weighted light, weight
    std::vector<int> bin(length);                                   // lower of each pixel's two bins
    std::vector<double> part(length);                               // weight of the upper one
    std::vector<double> image_x(length), surface(length);           // positions on the blur axis; accumulated steps
    std::vector<const float *> light(C);
    const float *coc, *weight;
    for (int i = 0; i < s.count; i++) {
      const float *const image = job.scene.kind == TORCHDOF_STACK ? s.cocs[i] : s.coc;
      for (int at = 0; at < length; at++) {
        image_x[at] = axis(image[(size_t)row_of(at) * job.width + column_of(at)], low, high);
        surface[at] = at ? surface[at - 1] + step_of(image_x[at] - image_x[at - 1]) : 0.0;
      }
      const auto ends = std::minmax_element(surface.begin(), surface.end());
      const double least_surface = *ends.first, per_bin = (BINS - 1) / std::max(*ends.second - least_surface, 1.0);
      for (int at = 0; at < length; at++) {
        const int y = row_of(at), x = column_of(at);
        double *after = &until[(size_t)(at + 1) * BINS * sums];
        std::copy(after - BINS * sums, after, after);
        const bool there = s.row(i, y, x, light.data(), coc, weight);
        const double w = !there ? 0.0 : weight ? *weight : 1.0;
        float share = 1.0f;  // part of its light below the highlight threshold
        if (there && !job.threshold.empty()) {
          float brightest = *light[0];
          for (int c = 1; c < C; c++) brightest = std::max(brightest, *light[c]);
          const float limit = threshold_at(job, y, x);
          if (brightest > limit) share = limit / brightest;
        }
        border.shares_[side][(size_t)i * length + at] = share;
        const double step = there ? step_of(axis(*coc, low, high) - image_x[at]) : 0.0;
        const double place = std::clamp((surface[at] + step - least_surface) * per_bin, 0.0, BINS - 1.0);
        bin[at] = std::min((int)place, BINS - 2);
        part[at] = place - bin[at];
        for (int next = 0; next < 2 && there; next++) {
          const double its_weight = w * (next ? part[at] : 1.0 - part[at]);
          double *const to = after + (bin[at] + next) * sums;
          for (int c = 0; c < C; c++) to[c] += *light[c] * share * its_weight;
          to[C] += its_weight;
        }
      }
      for (size_t at = 1; at <= (size_t)length; at++)  // add the sums of all farther bins
        for (int n = (BINS - 1) * sums - 1; n >= 0; n--) until[at * BINS * sums + n] += until[at * BINS * sums + n + sums];
      for (int level = 0; level < border.levels_; level++) {
        const int half = (int)std::min<int64_t>((int64_t)WIDTH << level, length);
        for (int at = 0; at < length; at++) {
          const double *from = &until[((size_t)std::max(at - half, 0) * BINS + bin[at]) * sums];
          const double *to = &until[((size_t)std::min(at + half + 1, length) * BINS + bin[at]) * sums];
          const auto of = [&](int n) { return (1.0 - part[at]) * (to[n] - from[n]) + part[at] * (to[n + sums] - from[n + sums]); };
          const double total = of(C);
          for (int c = 0; c < C; c++) border.means_[side][border.start(side, i, c, level) + at] = total > 0 ? (float)(of(c) / total) : 0.0f;
        }
      }
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
  const float *nearer = means_[side].data() + start(side, surface, channel, level_of_[far]) + x, *farther = nearer + length(side);
  const float *share = shares_[side].data() + (size_t)surface * length(side) + x;
  for (int i = 0; i < n; i++) row[i] = 0.5f * (row[i] * share[i] + nearer[i] + part * (farther[i] - nearer[i]));
}

}  // namespace torchdof
