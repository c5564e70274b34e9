// Light beyond the frame's border. The formulas are told in render/border.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {

constexpr int WIDTH = 4;  // the mean reaches so many times as far to each side as the place lies beyond the border

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
  job.parallel(4, [&](int which, int) {
    const auto side = (Border::Side)which;
    const bool upright = side >= Border::LEFT;
    const int length = border.length(side), C = job.channels, sums = C + 1;
    std::vector<double> until((size_t)(length + 1) * sums);  // sums of what comes before: weighted light, weight
    std::vector<const float *> light(C);
    const float *coc, *weight;
    for (int i = 0; i < s.count; i++) {
      for (int at = 0; at < length; at++) {
        const int y = upright ? at : side == Border::TOP ? 0 : job.height - 1;
        const int x = !upright ? at : side == Border::LEFT ? 0 : job.width - 1;
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
        border.shares_[side][(size_t)i * length + at] = share;
        for (int c = 0; c < C; c++) after[c] = before[c] + (there ? *light[c] * share * w : 0.0);
        after[C] = before[C] + w;
      }
      for (int level = 0; level < border.levels_; level++) {
        const int half = (int)std::min<int64_t>((int64_t)WIDTH << level, length);
        for (int at = 0; at < length; at++) {
          const double *from = &until[(size_t)std::max(at - half, 0) * sums], *to = &until[(size_t)std::min(at + half + 1, length) * sums];
          const double total = to[C] - from[C];
          for (int c = 0; c < C; c++)
            border.means_[side][border.start(side, i, c, level) + at] = total > 0 ? (float)((to[c] - from[c]) / total) : 0.0f;
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

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
