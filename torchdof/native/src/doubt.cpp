// Blurs the edges of maps in doubt: the compiled version of torchdof/render/surfaces/doubt.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "api.h"
#include "constants/doubt.h"
#include "constants/windows.h"
#include "entry.h"
#include "grid.h"
#include "rules.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

using namespace constants::doubt;  // render/surfaces/doubt.py gives meanings, units and effects
using constants::windows::LARGEST, constants::windows::NEVER;

constexpr int TILE = 96;  // px; side of the squares that a thread processes at once

constexpr float one_over_square(int reach) { return 1.0f / (float)((2 * reach + 1) * (2 * reach + 1)); }

class Blur : Frame {
 public:
  Blur(const float *given, const float *repaired, const float *unlike, int height, int width, float doubt, float *out)
      : Frame(height, width), given_(given), repaired_(repaired), unlike_(unlike), doubt_(doubt), out_(out) {}

  void run(int threads) const {
    memcpy(out_, repaired_, area_ * sizeof(float));
    const int across = (width_ + TILE - 1) / TILE, down = (height_ + TILE - 1) / TILE;
    parallel(threads, across * down, nullptr, [&](int tile, int) {
      const int y = tile / across * TILE, x = tile % across * TILE;
      blur({y, x, std::min(TILE, height_ - y), std::min(TILE, width_ - x)});
    });
  }

 private:
  void blur(const Part &part) const {
    const Part beside = part.grown(REACH), farther = beside.grown(REACH), whole = farther.grown(REACH);
    const Grid nearness(whole), moved(whole), rows(whole);
    const auto near_of = [](float coc) { return std::fabs(coc) <= LARGEST ? -coc : -NEVER; };
    fetch(given_, moved, near_of);
    fetch(repaired_, nearness, near_of);
    vec any{};
    each_vector(whole, [&](int y, int x) {
      const vec change = abs(load<vec>(nearness.at(y, x)) - load<vec>(moved.at(y, x)));
      store(moved.at(y, x), clamp01(change / MOVED_PX - 0.5f));
      any = max(any, load<vec>(moved.at(y, x)));
    });
    if (!(reduce_max(any) > 0)) return;

    const Grid near(farther), compared(beside), is_near(beside), share(part), is_beside(part);
    max_filter<REACH>(nearness, near, rows, farther);
    max_filter<REACH>(near, compared, rows, beside);
    each_vector(beside, [&](int y, int x) {
      const vec nearest = max(load<vec>(compared.at(y, x)), broadcast(1.0f));
      store(is_near.at(y, x), clamp01(NEAR_SLOPE * (load<vec>(nearness.at(y, x)) / nearest - NEAR_FROM)));
    });
    clamp_to_frame(is_near, beside);
    sums<REACH>(is_near, share, rows, part, one_over_square(REACH));
    max_filter<REACH>(moved, is_beside, rows, part);

    const Grid unlike(part.grown(AROUND_PX)), unlike_around(part);
    fetch(unlike_, unlike, [](float value) { return value; });
    sums<AROUND_PX>(unlike, unlike_around, rows, part, one_over_square(AROUND_PX));

    const Part at_edge = part.grown(AT_EDGE_PX), around = part.grown(EDGE_REACH);
    const Grid farness(around), high(part), low(part), edge(at_edge), fading(part);
    each_vector(around, [&](int y, int x) {
      const vec own = load<vec>(nearness.at(y, x));
      store(farness.at(y, x), own > -NEVER ? -own : own);
    });
    max_filter<EDGE_REACH>(nearness, high, rows, part);
    max_filter<EDGE_REACH>(farness, low, rows, part);
    each_vector(at_edge, [&](int y, int x) { store(edge.at(y, x), max_3x3(moved.at(y, x), moved.pitch)); });
    clamp_to_frame(edge, at_edge);
    sums<AT_EDGE_PX>(edge, fading, rows, part, one_over_square(AT_EDGE_PX));

    for (int y = part.y0; y < part.bottom(); y++)
      for (int x = part.x0; x < part.right(); x++) {
        const float own = *nearness.at(y, x), nearest = *near.at(y, x);
        const float is_beyond = *is_beside.at(y, x) * clamp01(nearest - hiding_px(std::fabs(own)) + 0.5f);
        const float is_foreign = clamp01(FROM_BACKGROUND * (*unlike_around.at(y, x) - BACKGROUND));
        const float is_step = clamp01(*high.at(y, x) + *low.at(y, x) - LEAST_STEP_PX + 0.5f);
        const float beside = is_beyond * is_foreign * OF_NEAR * nearest * std::min(2.0f * *share.at(y, x), 1.0f);
        const float least = doubt_ * std::max(beside, is_step * LEAST_BLUR_PX * *fading.at(y, x));
        if (std::fabs(own) < least) out_[pixel(y, x)] = least;
      }
  }

  const float *given_, *repaired_, *unlike_;
  const float doubt_;
  float *out_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_blurred_in_doubt(const float *given, const float *repaired, const float *unlike, int32_t height,
                                  int32_t width, float doubt, int32_t threads, float *out) {
  return torchdof::guarded([&] { torchdof::Blur(given, repaired, unlike, height, width, doubt, out).run(threads); });
}
