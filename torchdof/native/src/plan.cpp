// Circles of confusion of a frame, and the positions of its layers on the blur axis; formulas in optics/camera.py,
// render/layers/layer_cocs.py and render/layers/plan.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <numeric>
#include <vector>

#include "api.h"
#include "blur_axis.h"
#include "constants/layer_cocs.h"
#include "constants/plan.h"
#include "entry.h"
#include "extremes.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

// render/layers/layer_cocs.py and plan.py give meanings, units and effects
using namespace constants::layer_cocs;
using namespace constants::plan;
constexpr float WIDEST = constants::layer_cocs::WIDEST;

double finest(double x) { return std::max(FINEST, std::fabs(x) / FINEST_PARTS); }

double spacing(double x, double tolerance) {
  const double times = tolerance * 255;
  const double loose =
      times <= LOOSE ? std::pow(times, SPACING_POWER) : std::max(std::pow(LOOSE, SPACING_POWER), std::sqrt(times));
  return std::max(finest(x), SPACING * loose * std::pow(std::max(std::fabs(x) + (1 - GROWS_FROM_PX), 1.0), GROWTH));
}

// Positions in units of the finest spacing from focus, and the inverse.
double in_finest(double x) {
  const double steps =
      std::min(std::fabs(x), WIDE) / FINEST + FINEST_PARTS * std::log(std::max(std::fabs(x) / WIDE, 1.0));
  return std::copysign(steps, x);
}
double from_finest(double steps) {
  if (std::fabs(steps) <= FINEST_PARTS) return steps * FINEST;
  return std::copysign(WIDE * std::exp(std::fabs(steps) / FINEST_PARTS - 1), steps);
}

// Positions on the blur axis that many of the border's pixels share, most frequent first.
std::vector<double> border_nodes(std::vector<float> places) {
  std::vector<double> nodes;
  std::vector<int> bins(places.size());
  for (size_t i = 0; i < places.size(); i++) bins[i] = (int)std::nearbyint(in_finest(places[i]) * 3);
  const auto ends = std::minmax_element(bins.begin(), bins.end());
  const int first = *ends.first, last = *ends.second;
  std::vector<int> counts(last - first + 3), crowds(last - first + 1), order(crowds.size());
  for (int bin : bins) counts[bin - first + 1]++;
  for (size_t i = 0; i < crowds.size(); i++) crowds[i] = counts[i] + counts[i + 1] + counts[i + 2], order[i] = (int)i;
  std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return crowds[a] > crowds[b]; });
  const double least = std::max(CROWD * places.size(), (double)LEAST_CROWD);
  for (int i : order) {
    if (crowds[i] < least) break;
    const double place = from_finest((first + i) / 3.0);
    bool is_new = true;
    for (double other : nodes) is_new &= std::fabs(place - other) > APART * finest(place);
    if (!is_new) continue;
    std::vector<float> there;  // the median: a pixel's actual position, so that the pixel lies in this layer alone
    for (size_t k = 0; k < bins.size(); k++)
      if (std::abs(bins[k] - first - i) <= 1) there.push_back(places[k]);
    std::nth_element(there.begin(), there.begin() + (there.size() - 1) / 2, there.end());
    nodes.push_back(there[(there.size() - 1) / 2]);
  }
  return nodes;
}

// 1 / s - 1 / z, exactly 0 at z = s.
vec dioptres_behind(vec z, float s) {
  const vec apart = 1 / s - 1 / z;
  return std::isfinite(s) ? (z < INFINITY ? (z - s) / z / s : apart) : apart;
}

// Radius above which a kernel is constant within the frame.
float reach_of(int height, int width) { return WIDEST * std::max(height, width) + WIDEST; }

void coc_of_depth(const float *depth, int64_t count, float scale, float nearest, float farthest, int threads,
                  float *out) {
  constexpr int64_t PART = 1 << 15;
  torchdof::parallel(threads, (int)((count + PART - 1) / PART), nullptr, [&](int part, int) {
    const auto coc_at = [&](vec z) {
      vec dioptres = dioptres_behind(z, nearest);
      if (nearest != farthest) dioptres = min(dioptres, vec{}) + max(dioptres_behind(z, farthest), vec{});
      return z > vec{} ? scale * dioptres : broadcast(NAN);
    };
    int64_t i = part * PART;
    const int64_t end = std::min(count, i + PART);
    for (; i + LANES <= end; i += LANES) store(out + i, coc_at(load<vec>(depth + i)));
    for (; i < end; i++) out[i] = coc_at(broadcast(depth[i]))[0];
  });
}

}  // namespace

// NaN is in focus, larger radii are cut to `reach`.
double mean_change(const float *coc, int height, int width, int threads) {
  const float reach = reach_of(height, width);
  std::vector<double> changes(height);
  torchdof::parallel(threads, height, nullptr, [&](int y, int) {
    const float *row = coc + (size_t)y * width, *above = y ? row - width : row;
    auto known = [&](vec v) { return min(max(v == v ? v : vec{}, broadcast(-reach)), broadcast(reach)); };
    double sums = 0;
    int x = 0;
    for (; x + LANES < width; x += LANES) {
      const vec here = known(load<vec>(row + x));
      sums += reduce_add(abs(here - known(load<vec>(above + x))) + abs(known(load<vec>(row + x + 1)) - here));
    }
    for (; x < width; x++) {
      const float here = known(broadcast(row[x]))[0];
      sums += std::fabs(here - known(broadcast(above[x]))[0]);
      if (x + 1 < width) sums += std::fabs(known(broadcast(row[x + 1]))[0] - here);
    }
    changes[y] = sums;
  });
  return std::accumulate(changes.begin(), changes.end(), 0.0) / ((double)height * width);
}

// Mean radius of the widest pixels of a map, 1 of FEW, so that a single one does not decide: the largest of all maps.
static double mean_of_widest(const float *coc, int maps, int64_t area, float reach) {
  double usual = 1;
  std::vector<float> radii(area);
  const auto most = radii.begin() + (area + FEW - 1) / FEW;
  for (const float *map = coc; map < coc + maps * area; map += area) {
    for (int64_t i = 0; i < area; i++) radii[i] = std::isnan(map[i]) ? 0.0f : std::min(std::fabs(map[i]), reach);
    std::nth_element(radii.begin(), most - 1, radii.end(), std::greater<float>());
    usual = std::max(usual, std::accumulate(radii.begin(), most, 0.0) / (double)(most - radii.begin()));
  }
  return usual;
}

// 1. Fixed nodes: the nearest and the farthest place, and places with much of the border, with a neighbour on each
// side.
// 2. Nodes from the focus outwards, with a spacing that grows with the blur and the tolerance.
// 3. Nodes close to a fixed one move towards it, so that the nodes change continuously with the scene.
std::vector<double> plan(const float *coc, int maps, int height, int width, double &tolerance, int threads) {
  float low, high;
  const int64_t area = (int64_t)height * width;
  find_ends(coc, maps * area, threads, &low, &high);
  if (std::isnan(low)) {  // NaN is in focus
    low = high = 0;
    for (int64_t i = 0; i < maps * area; i++) low = std::min(low, coc[i]), high = std::max(high, coc[i]);
  }
  const float reach = reach_of(height, width);
  auto place = [&](float c) { return axis(std::isnan(c) ? 0.0f : std::clamp(c, -reach, reach), -INFINITY, INFINITY); };
  const double nearest = place(low), farthest = place(high);
  double widest = std::max({-(double)coc_at(nearest), (double)coc_at(farthest), 1.0});  // px
  if (SMALL_RADII * widest > std::min(height, width)) widest = mean_of_widest(coc, maps, area, reach);
  double change = INFINITY;
  for (int i = 0; i < maps; i++) change = std::min(change, mean_change(coc + i * area, height, width, threads));
  tolerance *= std::min(1.0, std::min(height, width) / (SMALL_RADII * widest));
  tolerance = std::max(tolerance, std::min(tolerance * std::sqrt(change / ROUGH_PX), ROUGH_TOLERANCE));
  if (farthest <= nearest) return {nearest};
  std::vector<float> border;  // places of the pixels at the frame's border
  for (const float *map = coc; map < coc + maps * area; map += area) {
    for (int x = 0; x < width; x++) border.insert(border.end(), {place(map[x]), place(map[area - width + x])});
    for (int y = 0; y < height; y++)
      border.insert(border.end(), {place(map[(int64_t)y * width]), place(map[(int64_t)(y + 1) * width - 1])});
  }
  std::vector<double> fixed = {nearest, farthest};
  auto to_fixed = [&](double node) {
    double least = INFINITY;
    for (double other : fixed) least = std::min(least, std::fabs(node - other));
    return least;
  };
  for (double node : border_nodes(std::move(border))) {
    const double step = finest(node);
    if (!(spacing(node, tolerance) > CROWDS_FROM * step)) continue;
    for (double beside : {node, node - step, node + step})
      if (nearest < beside && beside < farthest && to_fixed(beside) > APART * step) fixed.push_back(beside);
  }
  std::vector<double> nodes(fixed);
  if (nearest < 0 && 0 < farthest) nodes.push_back(0);
  for (int sign : {-1, 1})
    for (double x = spacing(0, tolerance), limit = sign < 0 ? -nearest : farthest; x < limit;
         x += spacing(x, tolerance)) {
      const double node = sign * x;
      if (!(nearest < node && node < farthest)) continue;
      double near = fixed[0];  // a node close to a fixed one moves towards it, or onto it
      for (double other : fixed)
        if (std::fabs(node - other) < std::fabs(node - near)) near = other;
      const double gap = std::fabs(node - near) / spacing(node, tolerance);
      nodes.push_back(near + (node - near) * std::min(std::max((gap - NEAR) / NEAR, 0.0), 1.0));
    }
  std::sort(nodes.begin(), nodes.end());
  nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
  return nodes;
}

}  // namespace torchdof

int32_t torchdof_coc(const float *depth, int64_t count, float scale, float nearest, float farthest, int32_t threads,
                     float *out) {
  return torchdof::guarded([&] { torchdof::coc_of_depth(depth, count, scale, nearest, farthest, threads, out); });
}

int32_t torchdof_plan(const float *coc, int32_t maps, int32_t height, int32_t width, double *tolerance, int32_t threads,
                      double *nodes, int32_t capacity, int32_t *count) {
  return torchdof::guarded([&] {
    const std::vector<double> planned = torchdof::plan(coc, maps, height, width, *tolerance, threads);
    *count = (int32_t)planned.size();
    if (*count <= capacity) memcpy(nodes, planned.data(), planned.size() * sizeof(double));
  });
}
