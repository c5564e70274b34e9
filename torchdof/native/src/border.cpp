// Light beyond the frame's border. The formulas are told in render/border.py.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {

Border border_of(const Job &job, int farthest) {
  constexpr int WIDTH = 4;  // the mean reaches so many times as far to each side as the place lies beyond the border
  constexpr float INSIDE = 0.2f, GOES_ON = 1.5f;
  constexpr int TREND_LEVELS = 3;
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
    std::vector<float> own((size_t)C * length), least(own.size()), most(own.size()), trend(own.size());
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
          if (w > 0 && inside < 2) {
            float &low = least[(size_t)c * length + at], &high = most[(size_t)c * length + at];
            low = std::min(low, seen), high = std::max(high, seen);
          }
          after[c] = before[c] + seen * w;
        }
        after[C] = before[C] + w;
      }
    };
    for (int i = 0; i < s.count; i++) {
      std::fill(least.begin(), least.end(), INFINITY), std::fill(most.begin(), most.end(), -INFINITY);
      summed(i, 0, border_until);
      for (int level = 0; level < border.levels_; level++) {
        summed(i, 1 << level, inside_until);
        const int half = (int)std::min<int64_t>((int64_t)WIDTH << level, length);
        for (int at = 0; at < length; at++) {
          const int first = std::max(at - half, 0), end = std::min(at + half + 1, length);
          const auto within = [&](const std::vector<double> &until, int c) { return until[(size_t)end * sums + c] - until[(size_t)first * sums + c]; };
          const double total = within(border_until, C), total_inside = within(inside_until, C);
          const float known = total > 0 ? (float)std::min(total_inside / total, 1.0) : (float)std::min(total_inside, 1.0);
          for (int c = 0; c < C; c++) {
            const float mean = total > 0 ? (float)(within(border_until, c) / total) : 0.0f;
            const float inwards = ((total_inside > 0 ? (float)(within(inside_until, c) / total_inside) : 0.0f) - mean) * known;
            const size_t line = (size_t)c * length, here = line + at;
            const float itself = 0.5f * own[here], on = itself + 0.5f * mean + INSIDE * inwards;
            float beyond = on;
            if (level < TREND_LEVELS) {  // within the range of what the last two lines show around it
              if (!level) trend[here] = -GOES_ON * inwards;
              const size_t from = line + std::max(at - WIDTH, 0), to = line + std::min(at + WIDTH + 1, length);
              const float low = *std::min_element(&least[from], least.data() + to), high = *std::max_element(&most[from], most.data() + to);
              beyond = std::max(std::min(on + trend[here], std::max(on, high)), std::min(on, low));
            }
            border.means_[side][border.start(side, i, c, level) + at] = beyond - itself;
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
  for (int i = 0; i < n; i++) row[i] = 0.5f * row[i] * share[i] + nearer[i] + part * (farther[i] - nearer[i]);
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
