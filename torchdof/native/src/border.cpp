// Light beyond the frame's border. The formulas are told in render/border.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {

Border border_of(const Job &job, int farthest) {
  constexpr int WIDTH = 4, WIDER = 16;
  constexpr float MEAN = 0.35f, WIDE_MEAN = 0.1f, INSIDE = 0.15f, GOES_ON = 1.1f;
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
  job.parallel(4, [&](int which, int) {
    const auto side = (Border::Side)which;
    const bool upright = side >= Border::LEFT;
    const int length = border.length(side), C = job.channels, sums = C + 1, depth = upright ? job.width : job.height;
    std::vector<double> border_until((size_t)(length + 1) * sums), inside_until(border_until.size());
    std::vector<float> own((size_t)C * length), least(C), most(C);
    std::vector<const float *> light(C);
    // sums, along a line so far inside the frame, of what comes before: weighted light, and weight
    const auto summed = [&](int i, int inside, std::vector<double> &until) {
      const int line = std::min(inside, depth - 1);
      const float *coc, *weight;
      for (int at = 0; at < length; at++) {
        const int y = upright ? at : side == Border::TOP ? line : job.height - 1 - line;
        const int x = !upright ? at : side == Border::LEFT ? line : job.width - 1 - line;
        const double *before = &until[(size_t)at * sums];
        double *after = &until[(size_t)(at + 1) * sums];
        const bool there = s.row(i, y, x, light.data(), coc, weight);
        const double w = !there ? 0.0 : weight ? *weight : 1.0;
        float share = 1.0f;  // of its light that is no highlight's
        if (there && !job.threshold.empty()) {
          float brightest = *light[0];
          for (int c = 1; c < C; c++) brightest = std::max(brightest, *light[c]);
          const float limit = threshold_at(job, y, x);
          if (brightest > limit) share = limit / brightest;
        }
        if (!inside) border.shares_[side][(size_t)i * length + at] = share;
        for (int c = 0; c < C; c++) {
          const float seen = there ? *light[c] * share : 0.0f;
          if (!inside) own[(size_t)c * length + at] = seen;
          if (w > 0 && inside < 2) least[c] = std::min(least[c], seen), most[c] = std::max(most[c], seen);
          after[c] = before[c] + seen * w;
        }
        after[C] = before[C] + w;
      }
    };
    for (int i = 0; i < s.count; i++) {
      std::fill(least.begin(), least.end(), INFINITY), std::fill(most.begin(), most.end(), -INFINITY);
      summed(i, 0, border_until);
      for (int level = border.levels_ - 1; level >= 0; level--) {  // the nearest last, by which the range is known
        summed(i, 1 << level, inside_until);
        const auto within = [&](const std::vector<double> &until, int at, int64_t half, int c) {
          return until[(size_t)std::min<int64_t>(at + half + 1, length) * sums + c] - until[(size_t)std::max<int64_t>(at - half, 0) * sums + c];
        };
        const int64_t half = (int64_t)WIDTH << level;
        for (int at = 0; at < length; at++) {
          const double total = within(border_until, at, half, C), total_wide = within(border_until, at, WIDER * half, C);
          const double total_inside = within(inside_until, at, half, C);
          const float known = total > 0 ? (float)std::min(total_inside / total, 1.0) : (float)std::min(total_inside, 1.0);
          for (int c = 0; c < C; c++) {
            const float near = total > 0 ? (float)(within(border_until, at, half, c) / total) : 0.0f;
            const float wide = total_wide > 0 ? (float)(within(border_until, at, WIDER * half, c) / total_wide) : 0.0f;
            const float inside = total_inside > 0 ? (float)(within(inside_until, at, half, c) / total_inside) : 0.0f;
            float mean = MEAN * near + WIDE_MEAN * wide;
            const float inwards = (inside - near) * known, itself = Border::OWN * own[(size_t)c * length + at];
            if (level)
              mean += INSIDE * inwards;
            else if (mean = itself + mean - GOES_ON * inwards; least[c] <= most[c])
              mean = std::clamp(mean, least[c], most[c]) - itself;
            else
              mean -= itself;
            border.means_[side][border.start(side, i, c, level) + at] = mean;
          }
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
  for (int i = 0; i < n; i++) row[i] = Border::OWN * row[i] * share[i] + nearer[i] + part * (farther[i] - nearer[i]);
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
