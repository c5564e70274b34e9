// The frame is processed in tiles, and within a tile only where the map changes.
#include "edge_search.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "edge_rules.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"

namespace torchdof {
namespace {

using namespace constants::edge_search;  // render/surfaces/edge_search.py gives meanings, units and effects

// A pixel's result depends on the pixels within this many of it: without ramps, and with ramps.
constexpr int STEP_HALO = RINGS + REACH, HALO = RINGS + RAMP_REACH + FLAT_REACH + 3;

class Search : EdgeMap {
 public:
  explicit Search(const EdgeMap &map) : EdgeMap(map) {}

  // Finds steps and ramps and their two surfaces: adds the groups' edges, and marks pixels up to `halo` around them.
  EdgeSums find_in(std::vector<Group> &groups, int halo, bool expects_ramps, bool measures, const KindMask &selected) {
    std::vector<EdgeSums> found(groups.size());
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      find_in(group.part, in_frame(group.part.grown(halo)), expects_ramps, selected, measures ? &found[g] : nullptr,
              group.edges);
      group.bounds = bounds(group);
    });
    EdgeSums total;
    for (const EdgeSums &here : found) {
      total.length += here.length;
      total.climbed += here.climbed;
      total.lost += here.lost;
      total.middles += here.middles;
    }
    return total;
  }

 private:
  // Finds the edges of one part.
  void find_in(const Part &own, const Part &part, bool expects_ramps, const KindMask &selected, EdgeSums *found,
               std::vector<Edge> &edges) {
    for (int y = part.y0; y < part.bottom(); y++) {
      const size_t i = pixel(y, part.x0);
      const float *values = map_.nearness + i;
      uint8_t *marks = marks_ + i;
      for (int x = 0; x < part.width; x++) marks[x] = std::fabs(values[x]) <= LARGEST ? 0 : (RINGS + 1) * UNSURE;
    }
    const Part busy = changing(part);
    if (busy.height <= 0 || busy.width <= 0) return;
    if (expects_ramps || !find_in(own, busy, STEP_HALO, selected, found, edges))
      find_in(own, busy, HALO, selected, found, edges);
  }

  // Bounding box of the pixels where the map changes enough for an edge, grown by the halo.
  Part changing(const Part &part) const {
    const Part around = in_frame(part.grown(STEP_HALO));
    float least_step = step(0);
    if (map_.steps) {
      least_step = NEVER;
      for (int y = around.y0; y < around.bottom(); y++)
        for (int x = around.x0; x < around.right(); x++) least_step = std::min(least_step, step(pixel(y, x)));
    }
    const float change = 0.9f * LEAST_SLOPE * least_step;
    Grid changes({0, 0, 2, around.width});
    float *of_row = changes.at(0, 0), *of_columns = changes.at(1, 0);
    changes.clear();
    int top = height_, bottom = 0;
    for (int y = around.y0; y < around.bottom(); y++) {
      const float *at = map_.nearness + pixel(y, around.x0), *above = y > around.y0 ? at - width_ : at;
      for (int x = 0; x < around.width - 1; x++) {
        const float beside = std::fabs(at[x + 1] - at[x]), below = std::fabs(at[x] - above[x]);
        const float known = beside > 0 ? beside : 0.0f;  // a change next to NaN counts as 0
        of_row[x] = below > known ? below : known;
      }
      of_row[around.width - 1] = std::fabs(at[around.width - 1] - above[around.width - 1]);
      vec row{};
      for (int x = 0; x < around.width; x += LANES) {
        const vec v = load<vec>(of_row + x);
        row = max(v, row);
        store(of_columns + x, max(v, load<vec>(of_columns + x)));
      }
      if (reduce_max(row) > change) {
        top = std::min(top, y);
        bottom = y + 1;
      }
    }
    int left = 0, right = around.width;
    while (left < right && !(of_columns[left] > change)) left++;
    while (left < right && !(of_columns[right - 1] > change)) right--;
    const Part found = {top, around.x0 + left, bottom - top, right - left};
    if (found.height <= 0 || found.width <= 0) return found;
    const Part wide = found.grown(STEP_HALO);
    const int y0 = std::max(part.y0, wide.y0), x0 = std::max(part.x0, wide.x0);
    return {y0, x0, std::min(part.bottom(), wide.bottom()) - y0, std::min(part.right(), wide.right()) - x0};
  }

  // The maps of a part whose edges are looked for.
  struct Maps {
    const bool is_wide;
    const Part inner, beside, ramps;  // beside: pixels whose ramps affect the inner part; ramps: where a ramp may begin
    const Grid raw, up, down, slope, jump, high, low, rows, ramp;
    const Grid nears[RINGS], fars[RINGS], jumps[RINGS];  // near and far surface, and jump, within r + 1 pixels

    Maps(const Part &inner, int halo) : Maps(inner, inner.grown(halo), inner.grown(RINGS), halo == HALO) {}

   private:
    Maps(const Part &inner, const Part &whole, const Part &beside, bool is_wide)
        : is_wide(is_wide), inner(inner), beside(beside), ramps(is_wide ? beside.grown(RAMP_REACH) : beside),
          raw(whole), up(whole), down(whole), slope(whole), jump(whole), high(whole), low(whole), rows(whole),
          ramp(whole), nears{Grid(beside), Grid(beside), Grid(beside)}, fars{Grid(beside), Grid(beside), Grid(beside)},
          jumps{Grid(beside), Grid(beside), Grid(beside)} {}
  };

  // Finds the edges of the changing part; returns false if ramps require the larger halo.
  //
  // 1. Slopes that continue on both sides of a pixel are ramp candidates; end_ramps keeps the true ramps.
  // 2. Near and far surface within 1, 2 and 3 pixels, by maximum filters.
  // 3. A pixel belongs to the step at the smallest distance whose jump is abrupt.
  // 4. Each edge pixel gets its kind: ring or level on the ramp, side, and direction of the near surface.
  bool find_in(const Part &own, const Part &inner, int halo, const KindMask &selected, EdgeSums *found,
               std::vector<Edge> &edges) {
    const Maps m(inner, halo);
    fetch(map_.nearness, m.raw, [this](float v) { return std::fabs(v) <= LARGEST ? sign_ * v : NAN; });
    each_vector(m.raw, [&](int y, int x) {
      const vec v = load<vec>(m.raw.at(y, x));
      const auto is_valid = abs(v) <= LARGEST;
      store(m.up.at(y, x), is_valid ? v : broadcast(-NEVER));
      store(m.down.at(y, x), is_valid ? -v : broadcast(-NEVER));
    });
    slopes(m.raw, m.slope, m.jump, m.is_wide ? m.ramps.grown(FLAT_REACH + 2) : m.beside);
    if (!find_ramps(m)) return false;
    find_surfaces(m);
    std::vector<float> marks_of_row(inner.width + LANES);
    for (int y = inner.y0; y < inner.bottom(); y++) {
      find_in_row(m, own, y, selected, found, edges, marks_of_row.data());
      uint8_t *marks = marks_ + pixel(y, inner.x0);
      for (int k = 0; k < inner.width; k++) marks[k] = (uint8_t)(int)marks_of_row[k];
    }
    return true;
  }

  // Smallest differences between two surfaces at LANES pixels.
  vec steps_at(int y, int x) const {
    if (!map_.steps) return broadcast(step(0));
    vec steps = {};
    const float *row = map_.steps + pixel(std::clamp(y, 0, height_ - 1), 0);
    for (int i = 0; i < LANES; i++) steps[i] = row[std::clamp(x + i, 0, width_ - 1)];
    return max(steps, broadcast(noise_step_));
  }

  // Marks ramps, and puts the surfaces at their ends into `up` and `down`; returns false if this takes the larger halo.
  bool find_ramps(const Maps &m) const {
    m.ramp.clear();
    // ramps within RINGS pixels affect the inner part
    const auto any_beside = [&](const auto &is) {
      vec any{};
      each_vector(m.beside, [&](int y, int x) { any = is(y, x) ? broadcast(1.0f) : any; });
      return any_positive(any);
    };
    const auto is_steep = [&](int y, int x) { return load<vec>(m.slope.at(y, x)) > LEAST_SLOPE * steps_at(y, x); };
    const auto is_ramp = [&](int y, int x) { return load<vec>(m.ramp.at(y, x)) > vec{}; };
    if (any_beside(is_steep)) {
      max_filter<REACH>(m.up, m.high, m.rows, m.ramps);
      max_filter<REACH>(m.down, m.low, m.rows, m.ramps);
      each_vector(m.ramps, [&](int y, int x) {
        const vec span = load<vec>(m.high.at(y, x)) + load<vec>(m.low.at(y, x));
        const auto is_candidate = is_steep(y, x) & (load<vec>(m.slope.at(y, x)) > SHALLOW * span) &
                                  (span > steps_at(y, x)) & (abs(load<vec>(m.raw.at(y, x))) <= LARGEST);
        store(m.ramp.at(y, x), is_candidate ? broadcast(1.0f) : vec{});
      });
    }
    if (!any_beside(is_ramp)) return true;
    if (!m.is_wide) return false;
    end_ramps(m.up, m.down, m.slope, m.high, m.low, m.rows, m.ramp, m.ramps);
    each_vector(m.beside, [&](int y, int x) {
      const vec near = load<vec>(m.high.at(y, x)), far = load<vec>(m.low.at(y, x));
      const auto is_kept = is_ramp(y, x) & (near + far > steps_at(y, x));
      store(m.ramp.at(y, x), is_kept ? broadcast(1.0f) : vec{});
      store(m.up.at(y, x), is_kept ? near : load<vec>(m.up.at(y, x)));
      store(m.down.at(y, x), is_kept ? far : load<vec>(m.down.at(y, x)));
    });
    return true;
  }

  // Near and far surface within each distance; `high`: means over 5 x 5 pixels, whose differences give the direction of
  // the step.
  void find_surfaces(const Maps &m) const {
    for (int r = 0; r < RINGS; r++) {
      const Part part = m.inner.grown(RINGS - 1 - r);
      max_filter<1>(r ? m.nears[r - 1] : m.up, m.nears[r], m.rows, part);
      max_filter<1>(r ? m.fars[r - 1] : m.down, m.fars[r], m.rows, part);
      max_filter<1>(r ? m.jumps[r - 1] : m.jump, m.jumps[r], m.rows, part);
    }
    each_vector(m.inner.grown(4), [&](int y, int x) {
      const vec v = load<vec>(m.raw.at(y, x));
      store(m.slope.at(y, x), abs(v) <= FINITE ? v : vec{});
    });
    sums<2>(m.slope, m.high, m.rows, m.inner.grown(2), 1.0f / 25.0f);
  }

  // Finds the edges in a row: adds the selected ones to `edges`, measures those of the own part, and writes the marks
  // of the row's pixels.
  void find_in_row(const Maps &m, const Part &own, int y, const KindMask &selected, EdgeSums *found,
                   std::vector<Edge> &edges, float *marks) const {
    const bool is_own = y >= own.y0 && y < own.bottom();
    const vec none = {}, one = broadcast(1.0f);
    for (int x = m.inner.x0, k = 0; x < m.inner.right(); x += LANES, k += LANES) {
      const vec s = steps_at(y, x), v = load<vec>(m.raw.at(y, x)), is_ramp = load<vec>(m.ramp.at(y, x));
      const auto is_valid = abs(v) <= LARGEST;
      const auto within = [&](int r) -> Extremes<vec> {
        return {load<vec>(m.nears[r].at(y, x)), load<vec>(m.fars[r].at(y, x)), load<vec>(m.jumps[r].at(y, x))};
      };
      const Extremes<vec> widest = within(RINGS - 1);
      if (!any_of((widest.near + widest.far > s) | (is_ramp > none))) {  // no step is large enough
        store(marks + k, is_valid ? none : broadcast((float)UNSURE * (RINGS + 1)));
        continue;
      }
      const Step<vec> step(s, within);
      const vec near = is_ramp > none ? load<vec>(m.up.at(y, x)) : step.near, unsure = step.unsure;
      const vec far = is_ramp > none ? -load<vec>(m.down.at(y, x)) : -step.far;
      const auto is_edge = (is_ramp + unsure > none) & (near - far > s) & is_valid;
      const vec is_near = 2.0f * v > near + far ? one : none;
      const vec mark = is_near * (float)NEAR + is_ramp * (float)RAMP;
      const vec reference = is_valid & (is_ramp <= none) ? unsure : broadcast((float)(RINGS + 1));
      store(marks + k, (is_edge | (is_ramp > none) ? mark : none) + (float)UNSURE * reference);
      const int first = std::max(0, own.x0 - x), last = std::min(LANES, std::min(m.inner.right(), own.right()) - x);
      int edges_here = is_own && first < last ? movemask(is_edge) & ((1 << last) - (1 << first)) : 0;
      if (!edges_here) continue;
      const vec gap = max(near - far, broadcast(1e-12f)), level = (v - far) / gap;
      const ivec kind = kinds_at(m, y, x, gap, level, is_ramp, unsure), side = kind + convert(is_near * (float)KINDS);
      for (; edges_here; edges_here &= edges_here - 1) {
        const int n = __builtin_ctz(edges_here);
        if (found) {
          const float climbed = climb(m.raw.at(y, x + n), -1, 1, -m.raw.pitch, m.raw.pitch, gap[n]);
          measure(*found, level[n], is_near[n] > 0, climbed);
        }
        if (!selected[side[n]]) continue;
        edges.push_back({y * width_ + x + n, near[n], far[n], (uint8_t)kind[n]});
        marks[k + n] += (float)LISTED;
      }
    }
  }

  // Kinds of LANES edge pixels. level: nearness, from 0 at the far surface to 1 at the near one; unsure: RINGS + 1
  // less the ring.
  static ivec kinds_at(const Maps &m, int y, int x, vec gap, vec level, vec is_ramp, vec unsure) {
    const vec none = {};
    const vec right = load<vec>(m.high.at(y, x + 2)) - load<vec>(m.high.at(y, x - 2));
    const vec below = load<vec>(m.high.at(y + 2, x)) - load<vec>(m.high.at(y - 2, x));
    const ivec of_level = convert(min(max(level * (float)LEVELS, none), broadcast(LEVELS - 1.0f)));
    const vec on_step = (level > 0.5f ? broadcast((float)RINGS) : none) + (float)RINGS - unsure;
    const vec place = is_ramp > none ? 2.0f * RINGS + convert(of_level) : on_step;
    return convert(place * (float)DIRECTIONS + direction(right, below, gap) + (float)(DIRECTIONS / 2));
  }

  // Adds an edge pixel to the statistics.
  static void measure(EdgeSums &found, float level, bool is_near, float climbed) {
    const bool is_middle = std::fabs(level - 0.5f) < 0.25f;
    found.length += climbed;
    found.climbed += is_middle ? climbed : 0.0f;
    found.middles += is_middle;
    found.lost += is_near - clamp01(level);
  }

  // slope: the smaller change to both neighbours if these have one sign, else 0. jump: the larger change minus the
  // slope.
  void slopes(const Grid &raw, const Grid &slope, const Grid &jump, const Part &part) const {
    const auto known = [](vec change) { return abs(change) <= FINITE ? change : vec{}; };
    each_vector(part, [&](int y, int x) {
      const float *at = raw.at(y, x);
      const vec here = load<vec>(at);
      const vec x0 = known(here - load<vec>(at - 1)), x1 = known(load<vec>(at + 1) - here);
      const vec y0 = known(here - load<vec>(at - raw.pitch)), y1 = known(load<vec>(at + raw.pitch) - here);
      const Slope<vec> found(x0, x1, y0, y1);
      store(slope.at(y, x), found.slope);
      store(jump.at(y, x), found.jump);
    });
  }

  // Nearness at both ends of each ramp: near in `high`, far in `low`, negated. Clears the ramp mark on slopes, which do
  // not flatten within FLAT_REACH pixels.
  void end_ramps(const Grid &up, const Grid &down, const Grid &slope, const Grid &high, const Grid &low,
                 const Grid &rows, const Grid &ramp, const Part &ramps) const {
    const Part around = ramps.grown(FLAT_REACH), inside = in_frame(ramps);
    clamp_to_frame(slope, around.grown(2));
    sums<2>(slope, high, rows, around, -1.0f / 25.0f);
    clamp_to_frame(high, around);
    max_filter<FLAT_REACH>(high, low, rows, ramps);
    struct Piece {
      int y, x;
      vec near, far;
    };
    std::vector<Piece> pieces;
    for (int y = inside.y0; y < inside.bottom(); y++)
      for (int x = ramps.x0; x < ramps.right(); x += LANES) {
        vec is_ramp = (load<vec>(ramp.at(y, x)) > vec{}) & (-load<vec>(low.at(y, x)) < FLAT * load<vec>(slope.at(y, x)))
                          ? broadcast(1.0f)
                          : vec{};
        if (x < inside.x0 || x + LANES > inside.right())
          for (int i = 0; i < LANES; i++)
            if (x + i < inside.x0 || x + i >= inside.right()) is_ramp[i] = 0;
        store(ramp.at(y, x), is_ramp);
        if (reduce_max(is_ramp) > 0) pieces.push_back(Piece{y, x, is_ramp, is_ramp});
      }
    for (int y = ramps.y0; y < ramps.bottom(); y++) {
      if (y < inside.y0 || y >= inside.bottom())
        std::fill(ramp.at(y, ramps.x0), ramp.at(y, ramps.x0) + ramps.width, 0.0f);
      for (int x = ramps.x0 - 1; x < ramps.right() + 1 + LANES; x += LANES) {
        store(high.at(y, x), load<vec>(up.at(y, x)));
        store(low.at(y, x), load<vec>(down.at(y, x)));
      }
    }
    for (const int y : {ramps.y0 - 1, ramps.bottom()}) {
      memcpy(high.at(y, ramps.x0 - 1), up.at(y, ramps.x0 - 1), (ramps.width + 2) * sizeof(float));
      memcpy(low.at(y, ramps.x0 - 1), down.at(y, ramps.x0 - 1), (ramps.width + 2) * sizeof(float));
    }
    vec changed = broadcast(1.0f);
    for (int round = 0; round < RAMP_REACH && reduce_max(changed) > 0; round++) {
      changed = vec{};
      for (Piece &b : pieces) {
        const vec near = load<vec>(high.at(b.y, b.x)), far = load<vec>(low.at(b.y, b.x));
        const auto is_ramp = load<vec>(ramp.at(b.y, b.x)) > vec{};
        b.near = is_ramp ? max_3x3(high.at(b.y, b.x), high.pitch) : near;
        b.far = is_ramp ? max_3x3(low.at(b.y, b.x), low.pitch) : far;
        changed = (b.near > near) | (b.far > far) ? broadcast(1.0f) : changed;
      }
      for (const Piece &b : pieces) {
        store(high.at(b.y, b.x), b.near);
        store(low.at(b.y, b.x), b.far);
      }
    }
  }
};

}  // namespace

float climb(const float *value, int left, int right, int above, int below, float gap) {
  float steepness = 0;
  for (const int u : {left, right})
    for (const int v : {above, below}) {
      const float across = valid(value[u] - *value), along = valid(value[v] - *value);
      steepness += std::sqrt(across * across + along * along);
    }
  return 0.25f * steepness / gap;
}

float noise_of(const torchdof_map &map) {
  const int every = (int)((2 * (int64_t)map.height * map.width + NOISE_SAMPLED - 1) / NOISE_SAMPLED);
  float quantum = INFINITY, span = 0;
  const auto middle_bend = [&](int lines, int size, int to_line, int stride) {
    std::vector<float> bends;
    float low = INFINITY, high = -INFINITY;
    for (int n = 0; n < lines; n++) {
      if (std::min(n, lines - 1 - n) % every != 0) continue;
      const float *line = map.nearness + (ptrdiff_t)n * to_line;
      for (int k = 0; k < size - 2; k++, line += stride) {
        const float a = line[0], b = line[stride], c = line[2 * stride];
        if (!(std::fabs(a) <= LARGEST && std::fabs(b) <= LARGEST && std::fabs(c) <= LARGEST)) continue;
        bends.push_back(std::fabs((c - b) - (b - a)));
        if (a != b) quantum = std::min(quantum, std::fabs(b - a));
        low = std::min(low, a);
        high = std::max(high, a);
      }
    }
    if (bends.empty()) return 0.0f;
    span = std::max(span, high - low);
    const auto middle = bends.begin() + (bends.size() - 1) / 2;
    std::nth_element(bends.begin(), middle, bends.end());
    return *middle;
  };
  const float bend =
      std::max(middle_bend(map.height, map.width, map.width, 1), middle_bend(map.width, map.height, 1, map.width));
  return std::max(NOISE_OF_BEND * bend, span > LEVELS_OF_A_FILE * quantum ? NOISE_OF_ROUNDING * quantum : 0.0f);
}

EdgeSums find_edges(const EdgeMap &map, std::vector<Group> &groups, int halo, bool expects_ramps, bool measures,
                    const KindMask &selected) {
  return Search(map).find_in(groups, halo, expects_ramps, measures, selected);
}

}  // namespace torchdof
