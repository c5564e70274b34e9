// A level of the pyramid from which hidden surfaces are filled, forward and backward, for training: the functions
// _finest_level and _farthest of render/surfaces/disocclusion.py. Inference computes them in disocclusion.cpp.
//
// A pixel shows its farther surface: the other one if it is mixed in and lies behind, else its own, with highlights
// dimmed to their threshold. For a sample and the pixels j around it with light I, coc d, weight w and share s of the
// sample:
//
//   f = max d_j,   n_j = w_j (1 - clamp(f - d_j - BEHIND_PX + 1/2, 0, 1)) s_j / 4
//   light = sum n_j I_j / sum n_j,   coc = sum n_j d_j / sum n_j,   weight = sum n_j
//
// A coarser level has samples of the finer one as its pixels, which have one surface and a weight.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "api.h"
#include "blocks.h"
#include "blur_axis.h"
#include "constants/disocclusion.h"
#include "constants/native.h"
#include "disocclusion.h"
#include "entry.h"
#include "light.h"
#include "rules.h"
#include "threads.h"

namespace torchdof {
namespace {

using constants::disocclusion::MIXED;
using constants::native::MOST_PLANES;
constexpr int BAND = 32;  // rows of pixels whose gradients one thread adds up

// The pixels of an axis around each sample: `taps` of them from 2 sample - before on, which the frame's ends repeat.
struct Axis {
  int size, samples, before, taps;
  Axis(int size, int samples)
      : size(size), samples(samples), before((2 * samples - size + 1) / 2), taps(2 + size % 2) {}
  int pixel(int sample, int tap) const { return std::clamp(2 * sample + tap - before, 0, size - 1); }
  // On an axis of odd size a sample covers half of its first and last pixel.
  float share(int tap) const { return taps == 3 && tap != 1 ? 0.5f : 1.0f; }
  // Samples whose pixels are in [from, to).
  int first(int from) const { return from == 0 ? 0 : std::max(0, ceil_div(from + before - taps + 1, 2)); }
  int last(int to) const { return to == size ? samples : std::min(samples, (to - 1 + before) / 2 + 1); }
};

template <int CHANNELS>
class Farthest {
 public:
  Farthest(const float *const *maps, int channels, int height, int width, int rows, int columns, int threads)
      : light_{maps[0], maps[2]}, coc_{maps[1], maps[3]}, weight_(maps[4]), threshold_(maps[5]), valid_(maps[6]),
        channels_(channels), threads_(threads), area_((size_t)height * width), rows_(height, rows),
        columns_(width, columns) {}

  void write(float *out) const {
    const size_t size = (size_t)rows_.samples * columns_.samples;
    torchdof::parallel(threads_, rows_.samples, nullptr, [&](int y, int) {
      for (int x = 0; x < columns_.samples; x++) {
        Sample s;
        look(y, x, s);
        float *to = out + (size_t)y * columns_.samples + x;
        for (int c = 0; c < channels(); c++) to[c * size] = s.mean[c];
        to[channels() * size] = s.total > 0 ? s.mean[channels()] : -NEVER_PX;
        to[(channels() + 1) * size] = s.total;
      }
    });
  }

  // d_maps: the gradients of light, coc, other light, other coc and other weight, to which those of the level are
  // added.
  void gradient(const float *slopes, float *const *d_maps) const {
    torchdof::parallel(threads_, ceil_div(rows_.size, BAND), nullptr, [&](int band, int) {
      const int from = band * BAND, to = std::min(rows_.size, from + BAND);
      for (int y = rows_.first(from); y < rows_.last(to); y++)
        for (int x = 0; x < columns_.samples; x++)
          back(y, x, slopes, from * (size_t)columns_.size, to * (size_t)columns_.size, d_maps);
    });
  }

 private:
  static constexpr int TAPS = 9, MOST = (CHANNELS ? CHANNELS : MOST_PLANES) + 1;
  struct Tap {
    size_t at;
    bool mixed;
    float share, coc, weight, valid, peak, dimmed;  // peak: largest channel; dimmed: factor of the light
    float behind;                                   // confidence that it lies in front of the farthest one, not clamped
    float count;
  };
  struct Sample {
    Tap taps[TAPS];
    int number = 0;
    float farthest = -INFINITY, total = 0, mean[MOST];  // mean: light and coc
  };

  int channels() const { return CHANNELS ? CHANNELS : channels_; }
  float light(const Tap &t, int c) const { return light_[t.mixed][c * area_ + t.at]; }

  void look(int y, int x, Sample &s) const {
    for (int i = 0; i < rows_.taps; i++)
      for (int j = 0; j < columns_.taps; j++) {
        Tap &t = s.taps[s.number++];
        t.at = (size_t)rows_.pixel(y, i) * columns_.size + columns_.pixel(x, j);
        t.share = 0.25f * rows_.share(i) * columns_.share(j);
        t.mixed = coc_[1] && weight_[t.at] > MIXED && coc_[1][t.at] > coc_[0][t.at];
        t.valid = valid_ ? valid_[t.at] : 1.0f;
        t.coc = t.valid > 0 ? coc_[t.mixed][t.at] : -NEVER_PX;
        t.weight = (t.mixed || !coc_[1] ? weight_[t.at] : 1.0f - weight_[t.at]) * t.valid;
        t.peak = peak_of(light_[t.mixed] + t.at, area_, channels());
        t.dimmed = threshold_ && t.peak > threshold_[t.at] ? threshold_[t.at] / t.peak : 1.0f;
        s.farthest = std::max(s.farthest, t.coc);
      }
    for (int c = 0; c <= channels(); c++) s.mean[c] = 0;
    for (int k = 0; k < s.number; k++) {
      Tap &t = s.taps[k];
      t.behind = unlimited_another_surface(s.farthest - t.coc);
      t.count = t.weight * (1.0f - clamp01(t.behind)) * t.share;
      s.total += t.count;
      for (int c = 0; c < channels(); c++) s.mean[c] += t.count * (light(t, c) * t.dimmed);
      s.mean[channels()] += t.count * t.coc;
    }
    for (int c = 0; c <= channels(); c++) s.mean[c] *= 1.0f / std::max(s.total, LEAST_TOTAL);
  }

  // Adds a sample's gradients to those of its pixels in [from, to).
  void back(int y, int x, const float *slopes, size_t from, size_t to, float *const *d_maps) const {
    const size_t size = (size_t)rows_.samples * columns_.samples, at = (size_t)y * columns_.samples + x;
    Sample s;
    look(y, x, s);
    float slope[MOST], d_total = slopes[(channels() + 1) * size + at], d_farthest = 0, d_coc[TAPS];
    for (int c = 0; c <= channels(); c++) {
      slope[c] = c < channels() || s.total > 0 ? slopes[c * size + at] / std::max(s.total, LEAST_TOTAL) : 0.0f;
      if (s.total >= LEAST_TOTAL) d_total -= slope[c] * s.mean[c];
    }
    int ties = 0;
    for (int k = 0; k < s.number; k++) {
      const Tap &t = s.taps[k];
      float d_count = d_total + slope[channels()] * t.coc, d_dimmed = 0;
      for (int c = 0; c < channels(); c++) d_count += slope[c] * (light(t, c) * t.dimmed);
      d_coc[k] = slope[channels()] * t.count;
      if (within(t.behind)) {
        const float d_behind = -d_count * t.weight * t.share;
        d_farthest += d_behind;
        d_coc[k] -= d_behind;
      }
      if (coc_[1] || !ties) ties += t.coc == s.farthest;  // in a coarser level the first one has the gradient
      if (t.at < from || t.at >= to) continue;
      for (int c = 0; c < channels(); c++) {
        d_maps[2 * t.mixed][c * area_ + t.at] += slope[c] * t.count * t.dimmed;
        d_dimmed += slope[c] * t.count * light(t, c);
      }
      if (threshold_ && t.peak > threshold_[t.at])
        add_to_peak(light_[t.mixed] + t.at, area_, channels(), t.peak, -d_dimmed * t.dimmed / t.peak,
                    d_maps[2 * t.mixed] + t.at);
      d_maps[4][t.at] += (t.mixed || !coc_[1] ? t.valid : -t.valid) * d_count * (1.0f - clamp01(t.behind)) * t.share;
    }
    for (int k = 0; k < s.number; k++) {
      const Tap &t = s.taps[k];
      if (t.at < from || t.at >= to || !(t.valid > 0)) continue;
      const bool shares = ties && t.coc == s.farthest;
      d_maps[1 + 2 * t.mixed][t.at] += d_coc[k] + (shares ? d_farthest / ties : 0.0f);
      if (!coc_[1] && shares) ties = 0;
    }
  }

  const float *const light_[2], *const coc_[2], *const weight_, *const threshold_,
                                                                    *const valid_;  // own and other surface
  const int channels_, threads_;
  const size_t area_;
  const Axis rows_, columns_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_farthest(const float *const *maps, int32_t channels, int32_t height, int32_t width, int32_t rows,
                          int32_t columns, int32_t threads, float *out, const float *gradient, float *const *d_maps) {
  return torchdof::guarded([&] {
    const auto run = [&](const auto &level) { gradient ? level.gradient(gradient, d_maps) : level.write(out); };
    if (channels == 3)
      run(torchdof::Farthest<3>(maps, channels, height, width, rows, columns, threads));
    else
      run(torchdof::Farthest<0>(maps, channels, height, width, rows, columns, threads));
  });
}
