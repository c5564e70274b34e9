#include "soft_maps.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "constants/edge_colours.h"
#include "constants/soft_maps.h"
#include "memory.h"
#include "numbers.h"
#include "sample_window.h"
#include "simd.h"

namespace torchdof {
namespace {

using namespace constants::soft_maps;  // render/surfaces/soft_maps.py gives meanings, units and effects
using constants::edge_colours::BRIGHTEST;

class SoftMap : EdgeMap {
 public:
  explicit SoftMap(const EdgeMap &map) : EdgeMap(map) {}

  // Removes rims beside steps that are a little nearer, or farther, than the surface to which they belong: the ringing
  // of interpolation. Such pixels move to the closer end of the range between the closed opening and the opened
  // closing.
  void remove_ringing() {
    memcpy(evidence_, map_.out, area_ * sizeof(float));
    const std::vector<Group> parts = tiles();
    parallel((int)parts.size(), [&](int g) {
      const Part &part = parts[g].part, whole = part.grown(4 * RINGING_REACH);
      const Grid span(part), up(whole), down(whole), rows(whole);
      const auto spread = [&](const Grid &values, int steps_left, bool negated) {
        const Part over = part.grown(steps_left * RINGING_REACH);
        max_filter<RINGING_REACH>(values, values, rows, over);
        clamp_to_frame(values, over);
        if (negated) each_vector(over, [&](int y, int x) { store(values.at(y, x), -load<vec>(values.at(y, x))); });
      };
      fetch(evidence_, up, [this](float v) { return std::fabs(v) <= LARGEST ? sign_ * v : -NEVER; });
      fetch(evidence_, down, [this](float v) { return std::fabs(v) <= LARGEST ? -sign_ * v : -NEVER; });
      for (const Grid *values : {&up, &down}) spread(*values, 3, true);
      vec widest = broadcast(-NEVER);
      each_vector(part, [&](int y, int x) {
        const vec here = -load<vec>(up.at(y, x)) - load<vec>(down.at(y, x));
        store(span.at(y, x), here);
        widest = max(widest, here);
      });
      if (!map_.steps && !(reduce_max(widest) > step(0))) return;
      for (const Grid *values : {&up, &down}) {  // the closed opening of -up and of up
        spread(*values, 2, false);
        spread(*values, 1, true);
        spread(*values, 0, true);
      }
      for (int y = part.y0; y < part.bottom(); y++)
        for (int x = part.x0; x < part.right(); x++) {
          const size_t i = pixel(y, x);
          const float own = sign_ * map_.out[i], gap = *span.at(y, x), ends[2] = {-*up.at(y, x), *down.at(y, x)};
          if (!(std::fabs(own) <= LARGEST && gap > step(i))) continue;
          const float moved = std::clamp(own, std::min(ends[0], ends[1]), std::max(ends[0], ends[1])) - own;
          map_.out[i] = sign_ * (own + moved * clamp01(2.0f - std::fabs(moved) / (OVERSHOOT * gap)));
        }
    });
  }

  // Raises the nearness of lamps of a few pixels, which a soft map averages with their surroundings.
  void lift_lamps(float sigma, float lost_px, float doubt) const {
    const std::vector<float> weights = even_window();
    const float is_lost = clamp01(LOST + LOST_PER_PX * lost_px) * (1.0f - doubt);
    const std::vector<Group> all_parts = tiles();
    const int reach = blur_reach(sigma);
    parallel((int)all_parts.size(), [&](int g) {
      const Part &inner = all_parts[g].part, part = in_frame(inner.grown(LAMP_REACH));
      const Grid near(part.grown(REACH));
      fetch(map_.nearness, near, [this](float v) { return sign_ * valid(v); });
      vec high = broadcast(-NEVER), low = broadcast(NEVER);
      each_vector(near, [&](int y, int x) {
        high = max(high, load<vec>(near.at(y, x)));
        low = min(low, load<vec>(near.at(y, x)));
      });
      if (!map_.steps && !(reduce_max(high) - reduce_min(low) > LAMP_STEP * step(0))) return;
      const Group group{part, lamps_of(part, near)};
      if (group.edges.empty()) return;
      const Part around = bounds(group).grown(REACH), covered = around.grown(reach), whole = covered.grown(USUAL_REACH);
      const Grid bright(whole), usual(whole), rows(whole), peak(covered), blurred(around), given(around);
      brightest(bright, usual, rows, covered);
      max_filter<2>(bright, peak, rows, covered);
      each_vector(covered, [&](int y, int x) {
        const vec own = load<vec>(bright.at(y, x));
        store(usual.at(y, x),
              own > GLARE * load<vec>(usual.at(y, x)) ? own / max(load<vec>(peak.at(y, x)), broadcast(1e-30f)) : vec{});
      });
      clamp_to_frame(usual, covered);
      gaussian(usual, blurred, rows, around, sigma);
      fetch(map_.nearness, given, [this](float v) { return sign_ * valid(v); });
      const Grid lamps(part.grown(LAMP_REACH), 3);  // planes: weight, weight * nearness, weight * fit
      std::fill(lamps.at(lamps.y0, lamps.x0), lamps.at(lamps.y0, lamps.x0) + 3 * lamps.size, 0.0f);
      each_edge(group, [&](size_t, const Edge &, int y, int x) {
        const Line line = regress(given, usual, blurred, weights.data(), y, x);
        const float weight = line.fit * *usual.at(y, x);
        float *lamp = lamps.at(y, x);
        lamp[0] = weight;
        lamp[lamps.size] = weight * (line.least + std::max(line.difference, 0.0f));
        lamp[2 * lamps.size] = weight * line.fit;
      });
      // all pixels of a lamp get one nearness
      each_edge(group, [&](size_t, const Edge &lamp, int y, int x) {
        if (!inner.has(y, x)) return;
        float sums[3] = {0, 0, 0};
        for (int v = y - LAMP_REACH; v <= y + LAMP_REACH; v++)
          for (int u = x - LAMP_REACH; u <= x + LAMP_REACH; u++)
            for (int n = 0; n < 3; n++)
              sums[n] +=
                  lamps.at(std::min(std::max(v, 0), height_ - 1), std::min(std::max(u, 0), width_ - 1))[n * lamps.size];
        const float per_weight = 1.0f / std::max(sums[0], 1e-9f);
        const float repaired = sign_ * map_.out[lamp.i];
        map_.out[lamp.i] =
            sign_ * (repaired + sums[2] * per_weight * is_lost * std::max(sums[1] * per_weight - repaired, 0.0f));
      });
    });
  }

 private:
  struct Line {
    float least, difference, fit;
  };

  // Gaussian weights of a window; they sum to 1.
  static std::vector<float> even_window() {
    std::vector<float> weights =
        window([](float square) { return std::exp(-square / (2 * LAMP_FALLOFF_PX * LAMP_FALLOFF_PX)); });
    float total = 0;
    for (const float weight : weights) total += weight;
    for (float &weight : weights) weight /= total;
    return weights;
  }

  // Fits nearness around a pixel as least + difference * blurred by weighted least squares. fit: 0 to 1, high where the
  // blurred shape explains the nearness much better than the unblurred one.
  static Line regress(const Grid &given, const Grid &shape, const Grid &blurred, const float *weights, int y, int x) {
    const Grid *const maps[3] = {&given, &blurred, &shape};
    const auto at = [&](int i, const auto &take, vec weight) {  // the weights sum to 1
      return weight > vec{} ? take(maps[i]->at(y - REACH, x - REACH), maps[i]->pitch) : vec{};
    };
    vec sums[3] = {}, squares[3] = {}, products[3] = {};
    each_of_window([&](int n, const auto &take) {
      const vec weight = load<vec>(weights + n * LANES);
      for (int i = 0; i < 3; i++) sums[i] += weight * at(i, take, weight);
    });
    const float means[3] = {reduce_add(sums[0]), reduce_add(sums[1]), reduce_add(sums[2])};
    each_of_window([&](int n, const auto &take) {
      const vec weight = load<vec>(weights + n * LANES), off = at(0, take, weight) - means[0];
      for (int i = 0; i < 3; i++) {
        const vec its = at(i, take, weight) - means[i];
        squares[i] += weight * its * its;
        products[i] += weight * its * off;
      }
    });
    float explained[3];
    for (int i = 1; i < 3; i++) {
      const float product = std::max(reduce_add(products[i]), 0.0f);
      explained[i] = product * product / std::max(reduce_add(squares[i]) * reduce_add(squares[0]), 1e-12f);
    }
    const float of_blurred = reduce_add(squares[1]), unexplained = std::max(BETTER * (1.0f - explained[2]), 1e-6f);
    const float b = std::max(reduce_add(products[1]), 0.0f) / std::max(of_blurred, 1e-9f);
    const float better = clamp01((explained[1] - explained[2]) / unexplained);
    return {means[0] - b * means[1], b,
            of_blurred > LEAST_VARIANCE ? clamp01((explained[1] - EXPLAINED) / EXPLAINED_MORE) * better : 0.0f};
  }

  // bright: the brightest channel of each pixel; usual: in a part, the square of the mean of its root around the pixel.
  void brightest(const Grid &bright, const Grid &usual, const Grid &rows, const Part &part) const {
    const Grid light{Part(bright)};
    const int first = std::max(0, -bright.x0), last = std::min(bright.pitch, width_ - bright.x0);
    for (int y = bright.y0; y < bright.bottom(); y++) {
      const float *from = map_.light + (ptrdiff_t)std::min(std::max(y, 0), height_ - 1) * width_ + bright.x0;
      float *to = bright.at(y, bright.x0), *roots = light.at(y, bright.x0);
      std::fill(to, to + bright.pitch, 0.0f);
      for (int c = 0; c < channels_; c++, from += area_)
        for (int x = first; x < last; x++) to[x] = from[x] <= FINITE && from[x] > to[x] ? from[x] : to[x];
      for (int x = first; x < last; x++) to[x] = std::min(to[x], BRIGHTEST);
      std::fill(to, to + first, to[first]);
      std::fill(to + last, to + bright.pitch, to[last - 1]);
      for (int x = 0; x < bright.pitch; x++) roots[x] = std::sqrt(to[x]);
    }
    sums<USUAL_REACH>(light, usual, rows, part, 1.0f / ((2 * USUAL_REACH + 1) * (2 * USUAL_REACH + 1)));
    each_vector(part,
                [&](int y, int x) { store(usual.at(y, x), load<vec>(usual.at(y, x)) * load<vec>(usual.at(y, x))); });
  }

  // The pixels of lamps in a part; up: nearness of the part and of REACH pixels around it.
  std::vector<Edge> lamps_of(const Part &part, const Grid &up) const {
    const Part whole = part.grown(USUAL_REACH);
    const Grid bright(whole), usual(part), rows(whole);
    brightest(bright, usual, rows, part);
    vec any{};
    each_vector(part, [&](int y, int x) {
      any = max(any, load<vec>(bright.at(y, x)) > LAMP * load<vec>(usual.at(y, x)) ? broadcast(1.0f) : vec{});
    });
    std::vector<Edge> found;
    if (!(reduce_max(any) > 0)) return found;
    const Part &around = up;
    const Grid down(around), high(part), low(part), peak(part);
    fetch(map_.nearness, down, [this](float v) { return -sign_ * valid(v); });
    max_filter<REACH>(up, high, rows, part);
    max_filter<REACH>(down, low, rows, part);
    max_filter<2>(bright, peak, rows, part);
    for (int y = part.y0; y < part.bottom(); y++)
      for (int x = part.x0; x < part.right(); x++) {
        const size_t i = pixel(y, x);
        const float own = *bright.at(y, x);
        if (own > LAMP * *usual.at(y, x) && own > LAMP_PEAK * *peak.at(y, x) &&
            *high.at(y, x) + *low.at(y, x) > LAMP_STEP * step(i) && std::fabs(map_.nearness[i]) <= LARGEST)
          found.push_back({(int)i, 0, 0, 0});
      }
    return found;
  }

  // Radius of the blur in pixels; beyond 6 sigma a Gaussian is below float32 precision.
  static int blur_reach(float sigma) { return std::min(BLUR_REACH, (int)std::ceil(6.0f * sigma)); }

  // Gaussian blur of a part; values beyond the frame are replaced by the nearest value inside.
  void gaussian(const Grid &in, const Grid &out, const Grid &rows, const Part &part, float sigma) const {
    const int reach = blur_reach(sigma);
    float kernel[BLUR_REACH + 1], total = 0;
    for (int d = -reach; d <= reach; d++)
      total += kernel[std::abs(d)] = std::exp(-(float)(d * d) / (2.0f * sigma * sigma));
    for (int d = 0; d <= reach; d++) kernel[d] /= total;
    each_vector({part.y0 - reach, part.x0, part.height + 2 * reach, part.width}, [&](int y, int x) {
      const float *from = in.at(y, x);
      vec spread = kernel[0] * load<vec>(from);
      for (int d = 1; d <= reach; d++) spread += kernel[d] * (load<vec>(from - d) + load<vec>(from + d));
      store(rows.at(y, x), spread);
    });
    std::fill(out.at(out.y0, out.x0), out.at(out.y0, out.x0) + out.size, 0.0f);
    each_vector(part, [&](int y, int x) {
      const float *from = rows.at(y, x);
      vec spread = kernel[0] * load<vec>(from);
      for (int d = 1; d <= reach; d++)
        spread += kernel[d] * (load<vec>(from - d * rows.pitch) + load<vec>(from + d * rows.pitch));
      store(out.at(y, x), spread);
    });
    clamp_to_frame(out, part);
  }
};

}  // namespace

void remove_ringing(const EdgeMap &map) { SoftMap(map).remove_ringing(); }

void lift_lamps(const EdgeMap &map, float sigma, float lost_px, float doubt) {
  SoftMap(map).lift_lamps(sigma, lost_px, doubt);
}

float sigma_of(const EdgeSums &found) {
  const double width = CLIMBED * found.middles / std::max(found.climbed, 1e-12);
  return std::clamp((float)std::sqrt(std::max(width * width - PIXEL, 0.0)), LEAST_BLUR_PX, MOST_BLUR_PX);
}

}  // namespace torchdof
