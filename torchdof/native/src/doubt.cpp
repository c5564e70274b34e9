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
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

using namespace constants::doubt;  // render/surfaces/doubt.py gives meanings, units and effects
using constants::windows::LARGEST, constants::windows::NEVER;

constexpr int TILE = 96;  // px; side of the squares that a thread processes at once

constexpr float MOST = FALL * ((1 << DOUBLINGS) - 1);  // px; blur whose fall ends within the largest distance
constexpr float one_over_square(int reach) { return 1.0f / (float)((2 * reach + 1) * (2 * reach + 1)); }

class Blur : Frame {
 public:
  Blur(const float *given, const float *repaired, int height, int width, float doubt, float *out)
      : Frame(height, width), given_(given), repaired_(repaired), doubt_(doubt), out_(out),
        falling_(Part{0, 0, height, width}.grown(1)) {}

  void run(int threads) const {
    memcpy(out_, repaired_, area_ * sizeof(float));
    falling_.clear();
    const int across = (width_ + TILE - 1) / TILE, down = (height_ + TILE - 1) / TILE;
    const auto each_tile = [&](const auto &body) {
      parallel(threads, across * down, nullptr, [&](int tile, int) {
        const int y = tile / across * TILE, x = tile % across * TILE;
        body(Part{y, x, std::min(TILE, height_ - y), std::min(TILE, width_ - x)});
      });
    };
    each_tile([&](const Part &part) { average(part); });
    fall(threads);
    each_tile([&](const Part &part) { blur(part); });
  }

 private:
  static float near_of(float coc) { return std::fabs(coc) <= LARGEST ? -coc : -NEVER; }

  // Blur beside surfaces in front of the focus.
  void average(const Part &part) const {
    const Part around = part.grown(AROUND_PX);
    const Grid blur(around), rows(around), mean(part);
    fetch(repaired_, blur, [](float coc) { return std::max(near_of(coc), 0.0f); });
    sums<AROUND_PX>(blur, mean, rows, part, OF_NEAR * one_over_square(AROUND_PX));
    for (int y = part.y0; y < part.bottom(); y++)
      for (int x = part.x0; x < part.right(); x++) *falling_.at(y, x) = std::min(*mean.at(y, x), MOST);
  }

  // How this blur falls with the distance: along rows, then down and up, straight and diagonally. A path that leaves
  // the frame is longer than one inside.
  void fall(int threads) const {
    parallel(threads, height_, nullptr, [&](int y, int) {
      float *const row = falling_.at(y, 0);
      for (int x = 1; x < width_; x++) row[x] = std::max(row[x], row[x - 1] - FALL);
      for (int x = width_ - 2; x >= 0; x--) row[x] = std::max(row[x], row[x + 1] - FALL);
    });
    const auto follow = [&](int y, const float *from) {
      float *const to = falling_.at(y, 0);
      for (int x = 0; x < width_; x += LANES) {
        const vec diagonal = max(load<vec>(from + x - 1), load<vec>(from + x + 1)) - FALL * DIAGONAL_PX;
        store(to + x, max(load<vec>(to + x), max(load<vec>(from + x) - FALL, diagonal)));
      }
    };
    for (int y = 1; y < height_; y++) follow(y, falling_.at(y - 1, 0));
    for (int y = height_ - 2; y >= 0; y--) follow(y, falling_.at(y + 1, 0));
  }

  void blur(const Part &part) const {
    const Part at_edge = part.grown(AROUND_PX), around = part.grown(EDGE_REACH);
    const Grid nearness(around), farness(around), moved(around), rows(around), high(part), low(part), edge(at_edge),
        fading(part);
    fetch(given_, moved, near_of);
    fetch(repaired_, nearness, near_of);
    each_vector(around, [&](int y, int x) {
      const vec own = load<vec>(nearness.at(y, x));
      store(moved.at(y, x), clamp01(abs(own - load<vec>(moved.at(y, x))) / MOVED_PX - 0.5f));
      store(farness.at(y, x), own > -NEVER ? -own : own);
    });
    max_filter<EDGE_REACH>(nearness, high, rows, part);
    max_filter<EDGE_REACH>(farness, low, rows, part);
    each_vector(at_edge, [&](int y, int x) { store(edge.at(y, x), max_3x3(moved.at(y, x), moved.pitch)); });
    clamp_to_frame(edge, at_edge);
    sums<AROUND_PX>(edge, fading, rows, part, one_over_square(AROUND_PX));

    for (int y = part.y0; y < part.bottom(); y++)
      for (int x = part.x0; x < part.right(); x++) {
        const float is_step = clamp01(*high.at(y, x) + *low.at(y, x) - LEAST_STEP_PX + 0.5f);
        const float of_edge = is_step * LEAST_BLUR_PX * *fading.at(y, x);
        const float least = doubt_ * std::max(*falling_.at(y, x), of_edge);
        if (std::fabs(*nearness.at(y, x)) < least) out_[pixel(y, x)] = least;
      }
  }

  const float *given_, *repaired_;
  const float doubt_;
  float *out_;
  const Grid falling_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_blurred_in_doubt(const float *given, const float *repaired, int32_t height, int32_t width, float doubt,
                                  int32_t threads, float *out) {
  return torchdof::guarded([&] { torchdof::Blur(given, repaired, height, width, doubt, out).run(threads); });
}
