// Repairs the edges of a depth map: the compiled version of torchdof/render/surfaces/edges.py, with the same constants.
//
// The frame is processed in tiles of AREA x AREA pixels, and within a tile only where the map changes.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "api.h"
#include "constants/doubt.h"
#include "constants/edge_colours.h"
#include "constants/edge_search.h"
#include "constants/edges.h"
#include "constants/soft_maps.h"
#include "entry.h"
#include "grid.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {
namespace {

// Python gives the meanings, units and effects of these constants.
using namespace constants::edges;
using namespace constants::edge_colours;
using namespace constants::edge_search;
using namespace constants::soft_maps;
using constants::doubt::ASSUMED, constants::doubt::CONTRADICTED, constants::doubt::OFTEN_CONTRADICTED;
using constants::doubt::LARGEST, constants::doubt::NEVER;
constexpr int SAMPLE_BLOCK = BLOCK, KINDS = DIRECTIONS * PLACES;

constexpr int AREA = 96;  // side of a tile in pixels
// A pixel's result depends on the pixels within this many of it: without ramps, and with ramps.
constexpr int STEP_HALO = RINGS + REACH, HALO = RINGS + RAMP_REACH + FLAT_REACH + 3;
constexpr float NO_SCORE = 100.0f;  // marks pixels without a score; above all scores
constexpr int NEIGHBOURS[8][2] = {{-1, -1}, {-1, 0}, {-1, 1}, {0, -1}, {0, 1}, {1, -1}, {1, 0}, {1, 1}};
constexpr float FINITE = 3.402823466e38f;
// Vectors of a window of SIDE x SIDE pixels: first WHOLE columns of each row, then the remaining 4 columns.
constexpr int SIDE = 2 * REACH + 1, WHOLE = SIDE / LANES * LANES, ROWS_AT_ONCE = LANES / 4,
              WINDOW = SIDE * WHOLE / LANES + (SIDE + ROWS_AT_ONCE - 1) / ROWS_AT_ONCE;
static_assert(SIDE - WHOLE <= 4 && WHOLE > REACH + 1);

// Bits of a pixel's mark. NEAR: the map gives it the near surface's depth. Bits from UNSURE up: index into SURE.
constexpr uint8_t EDGE = 1, RAMP = 2, NEAR = 4, LISTED = 8, UNSURE = 32;
// weight as a colour reference: far from steps, RINGS pixels from one, ..., beside one; 0 for invalid pixels and ramps
constexpr float SURE_OF[256 / UNSURE] = {SURE[4], SURE[3], SURE[2], SURE[1], SURE[0]};

// A pixel whose surface is to be decided.
struct Edge {
  int i;
  float near, far;  // of the two surfaces that meet there
  uint8_t kind;
};

// Calls look(n, take) for each vector n of a window; take(p, pitch) loads it from a grid, p being the window's first
// value.
template <typename Look>
inline void each_of_window(const Look &look) {
  int n = 0;
  for (int v = 0; v < SIDE; v++)
    for (int u = 0; u < WHOLE; u += LANES)
      look(n++, [v, u](const float *p, int pitch) { return load<vec>(p + v * pitch + u); });
  for (int v = 0; v + ROWS_AT_ONCE <= SIDE; v += ROWS_AT_ONCE)
    look(n++, [v](const float *p, int pitch) {
      p += v * pitch + WHOLE;
#if defined(__AVX2__)
      return (vec)__builtin_ia32_vinsertf128_ps256(load<vec>(p), load<quad>(p + pitch), 1);
#else
      return load<vec>(p);
#endif
    });
  if (SIDE % ROWS_AT_ONCE) look(n, [](const float *p, int pitch) { return load<vec>(p + (SIDE - 1) * pitch + WHOLE); });
}

// Samples a function of the squared distance from the centre at each pixel of a window.
template <typename Of>
std::vector<float> window(const Of &of) {
  std::vector<float> values(WINDOW * LANES, 0.0f);
  for (int v = 0; v < SIDE; v++)
    for (int u = 0; u < SIDE; u++)
      values[u < WHOLE ? v * WHOLE + u : SIDE * WHOLE + 4 * v + u - WHOLE] =
          of((float)((v - REACH) * (v - REACH) + (u - REACH) * (u - REACH)));
  return values;
}

// Which surface a pixel shows. score: log-odds of the near surface. reliability: 0 to 1, how well colours separate the
// two surfaces. near, far: nearness of the surfaces.
struct Judgement {
  float score, reliability, near, far;
};

struct Around {
  float alike[8][LANES];  // similarity of each pixel's colour to its 8 neighbours', 0 to 1
};

// Edge pixels of a part, in row order.
struct Group {
  Part part;
  std::vector<Edge> edges = {};
  Part bounds = {};                    // bounding box of the edges
  std::vector<Judgement> judged = {};  // one for each edge
  std::vector<Around> around = {};     // one for every LANES edges
};

// Selects edge pixels by kind: first those to which the map gives the far surface, then those with the near one.
using KindMask = std::array<bool, 2 * KINDS>;

// Sums over all edge pixels, from which the blur of a soft map is estimated.
struct EdgeSums {
  double length = 0;    // of steps, in pixels
  double climbed = 0;   // part of the length in the middle half of steps
  double lost = 0;      // near pixels in the map minus the near surface's coverage in pixels
  int64_t middles = 0;  // pixels in the middle half of steps
};

// Weights of the clearest edge pixels of far surfaces and of near ones, and of those that have the right colour.
struct Agreement {
  double clear[2] = {}, agreed[2] = {};
};

class Repair : Frame {
 public:
  explicit Repair(const torchdof_map &map)
      : Frame(map.height, map.width), map_(map), sign_(map.is_coc ? -1.0f : 1.0f), channels_(map.channels),
        score_(area_), evidence_(area_), marks_(area_) {}

  // 1. Find the edges of a sample of the frame, see whether the map is soft, and decide by colour which surface each
  //    pixel shows.
  // 2. Calibrate: for each kind of edge pixel, the share that shows the near surface.
  // 3. In automatic mode stop here if the map is exact or its edges are unrelated to the image's.
  // 4. Find and decide the edges of the whole frame; move pixels that have the depth of the wrong surface.
  // 5. In a soft map also remove ringing, and restore the nearness of small lamps that a blur has reduced.
  // Returns whether the map has changed; doubt: how much the image contradicts a soft map, 0 to 1.
  bool run(double &doubt) {
    doubt = 0;
    noise_step_ = NOISES * noise();
    const int every = (int)std::ceil(std::sqrt((double)area_ / SAMPLED));
    const bool finds_twice =
        map_.automatic && every > 4;  // the sample is a small part of the frame: find only its edges first
    const auto is_sampled = [&](int y, int x) { return (block_of(y, height_) + block_of(x, width_)) % every == 0; };
    std::vector<Group> groups, sampled;
    KindMask all_kinds;
    all_kinds.fill(true);
    if (finds_twice) {
      sampled = find_in(blocks(is_sampled), REACH, false, false, all_kinds);
    } else {
      sampled = groups = find_in(tiles(), 0, false, true, all_kinds);
    }
    // blocks and tiles contain edge pixels that are not sampled
    choose_edges(sampled, [&](const Edge &edge) { return is_sampled(edge.i / width_, edge.i % width_); });
    const bool is_soft = is_on_ramps(sampled);
    sharpness_ = is_soft ? SOFT_SHARPNESS : SHARPNESS;
    judge(sampled, false);
    decide(sampled);
    calibrate(sampled);
    const Agreement agreement = agreement_of(sampled);
    if (map_.automatic && (!is_related(agreement) || !(is_soft || is_inexact(sampled)))) return false;
    parallel(height_, [&](int y) {
      memcpy(map_.out + (size_t)y * width_, map_.nearness + (size_t)y * width_, width_ * sizeof(float));
    });
    const KindMask doubtful = map_.automatic ? doubtful_kinds(is_soft) : all_kinds;
    if (finds_twice)
      groups = find_in(tiles(), 0, is_soft, is_soft, doubtful);
    else
      choose_edges(groups, [&](const Edge &edge) { return doubtful[given_kind_of(edge)]; });
    judge(groups, true);
    decide(groups);
    if (map_.automatic && is_soft) doubt = doubt_of(agreement);
    const float lost_px = move(groups, is_soft, (float)doubt);
    if (is_soft) remove_ringing();
    if (is_soft && doubt < 1) lift_lamps(blur(), lost_px, (float)doubt);
    return true;
  }

 private:
  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(map_.threads, count, map_.cancelled, [&](int i, int) { body(i); });
  }

  float step(size_t i) const { return std::max(map_.steps ? map_.steps[i] : map_.step, noise_step_); }
  float nearness(size_t i) const { return sign_ * map_.nearness[i]; }
  // Kind of an edge pixel, plus KINDS if the map gives it the near surface: an index into a KindMask.
  int given_kind_of(const Edge &edge) const { return edge.kind + (marks_[edge.i] & NEAR ? KINDS : 0); }
  // Share of the pixels of a given kind to which the map gives the wrong surface.
  float wrong(int given_kind) const {
    return given_kind >= KINDS ? 1.0f - shares_[given_kind - KINDS] : shares_[given_kind];
  }
  static float valid(float v) { return std::fabs(v) <= LARGEST ? v : 0.0f; }
  static float root(float light) {
    return (light <= FINITE) & (light > 0) ? std::sqrt(std::min(light, BRIGHTEST)) : 0.0f;
  }

  // Standard deviation of the map's noise, from the median second difference along rows or columns, whichever is
  // larger. At least the noise of rounding, if the map has more than LEVELS_OF_A_FILE levels; their distance is the
  // smallest difference of two neighbours.
  float noise() const {
    const int every = (int)((2 * (int64_t)area_ + NOISE_SAMPLED - 1) / NOISE_SAMPLED);
    float quantum = INFINITY, span = 0;
    const auto middle_bend = [&](int lines, int size, int to_line, int stride) {
      std::vector<float> bends;
      float low = INFINITY, high = -INFINITY;
      for (int n = 0; n < lines; n++) {
        if (std::min(n, lines - 1 - n) % every != 0) continue;
        const float *line = map_.nearness + (ptrdiff_t)n * to_line;
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
    const float bend = std::max(middle_bend(height_, width_, width_, 1), middle_bend(width_, height_, 1, width_));
    return std::max(NOISE_OF_BEND * bend, span > LEVELS_OF_A_FILE * quantum ? NOISE_OF_ROUNDING * quantum : 0.0f);
  }

  // Whether the sampled steps are ramps that are wide, or whose values are often far from both surfaces.
  bool is_on_ramps(const std::vector<Group> &sampled) const {
    double edges = 0, ramps = 0, mixed = 0, length = 0;
    for (const Group &group : sampled)
      for (const Edge &edge : group.edges) {
        const bool is_ramp = marks_[edge.i] & RAMP;
        edges++;
        ramps += is_ramp;
        mixed += is_ramp && is_mixed((nearness(edge.i) - edge.far) / std::max(edge.near - edge.far, 1e-12f));
      }
    if (!(ramps > SOFT * edges)) return false;
    for (const Group &group : sampled)
      each_edge(group, [&](size_t, const Edge &edge, int y, int x) {
        const float *value = map_.nearness + edge.i;
        length += climb(value, x > 0 ? -1 : 0, x < width_ - 1 ? 1 : 0, y > 0 ? -width_ : 0,
                        y < height_ - 1 ? width_ : 0, std::max(edge.near - edge.far, 1e-12f));
      });
    return ramps > WIDE * length || mixed > MIXED * ramps;
  }

  // Whether a level on a step, 0 (far) to 1 (near), is in the middle half.
  static bool is_mixed(float level) { return std::fabs(level - 0.5f) < 0.25f; }

  // Gradient at a pixel as a fraction of the step `gap`, given the offsets of its neighbours. The sum over a step's
  // pixels is its length in pixels.
  static float climb(const float *value, int left, int right, int above, int below, float gap) {
    float steepness = 0;
    for (const int u : {left, right})
      for (const int v : {above, below}) {
        const float across = valid(value[u] - *value), along = valid(value[v] - *value);
        steepness += std::sqrt(across * across + along * along);
      }
    return 0.25f * steepness / gap;
  }

  // Whether more of the sampled step pixels are wrong than in an exact map.
  bool is_inexact(const std::vector<Group> &sampled) const {
    double found = 0, steps = 0;
    for (const Group &group : sampled)
      for (const Edge &edge : group.edges)
        if (!(marks_[edge.i] & RAMP)) {
          found += wrong(given_kind_of(edge));
          steps++;
        }
    return found > EXACT * steps;
  }

  // Tiles that cover the frame.
  std::vector<Group> tiles() const {
    std::vector<Group> parts;
    for (int y = 0; y < height_; y += AREA)
      for (int x = 0; x < width_; x += AREA)
        parts.push_back({{y, x, std::min(AREA, height_ - y), std::min(AREA, width_ - x)}});
    return parts;
  }

  // Block index of a row or column, counted from the nearest border so that mirroring the frame keeps it.
  static int block_of(int at, int size) { return std::min(at, size - 1 - at) / SAMPLE_BLOCK; }

  // The selected blocks of SAMPLE_BLOCK pixels.
  template <typename Wanted>
  std::vector<Group> blocks(const Wanted &wanted) const {
    struct Run {
      int start, size;
    };
    const auto along = [&](int size) {
      std::vector<Run> runs;
      for (int start = 0; start < (size + 1) / 2; start += SAMPLE_BLOCK) {
        const int near = std::min(SAMPLE_BLOCK, (size + 1) / 2 - start), far = std::min(SAMPLE_BLOCK, size / 2 - start);
        runs.push_back({start, near});
        if (far > 0) runs.push_back({size - start - far, far});
      }
      return runs;
    };
    std::vector<Group> parts;
    for (const Run &y : along(height_))
      for (const Run &x : along(width_))
        if (wanted(y.start, x.start)) parts.push_back({{y.start, x.start, y.size, x.size}});
    return parts;
  }

  // The kinds of pixels to decide in automatic mode: steps of kinds that are often wrong, and ramps if the map is soft.
  KindMask doubtful_kinds(bool is_soft) const {
    KindMask selected;
    for (int kind = 0; kind < 2 * KINDS; kind++)
      selected[kind] = kind % KINDS / DIRECTIONS >= 2 * RINGS ? is_soft : wrong(kind) > DOUBTFUL;
    return selected;
  }

  // Keeps the chosen edges and clears the mark of the others.
  template <typename Chosen>
  void choose_edges(std::vector<Group> &groups, const Chosen &chosen) {
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      size_t kept = 0;
      for (const Edge &edge : group.edges) {
        const bool is_listed = chosen(edge);
        marks_[edge.i] = (uint8_t)((marks_[edge.i] & ~LISTED) | (is_listed ? LISTED : 0));
        if (is_listed) group.edges[kept++] = edge;
      }
      group.edges.resize(kept);
      group.bounds = bounds(group);
    });
  }

  // Calls body(k, edge, y, x) for each edge of a group.
  template <typename Body>
  void each_edge(const Group &group, const Body &body) const {
    int y = group.part.y0, row = y * width_;
    for (size_t k = 0; k < group.edges.size(); k++) {
      for (; group.edges[k].i >= row + width_; row += width_) y++;
      body(k, group.edges[k], y, group.edges[k].i - row);
    }
  }

  // Bounding box of a group's edges.
  Part bounds(const Group &group) const {
    int top = height_, left = width_, bottom = 0, right = 0;
    each_edge(group, [&](size_t, const Edge &, int y, int x) {
      top = std::min(top, y);
      left = std::min(left, x);
      bottom = y + 1;
      right = std::max(right, x + 1);
    });
    return {top, left, bottom - top, right - left};
  }

  // Finds steps and ramps and their two surfaces: returns the groups' edges, and marks pixels up to `halo` around them.
  std::vector<Group> find_in(std::vector<Group> groups, int halo, bool expects_ramps, bool measures,
                             const KindMask &selected) {
    std::vector<EdgeSums> found(groups.size());
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      find_in(group.part, in_frame(group.part.grown(halo)), expects_ramps, selected, measures ? &found[g] : nullptr,
              group.edges);
      group.bounds = bounds(group);
    });
    found_ = {};
    for (const EdgeSums &here : found) {
      found_.length += here.length;
      found_.climbed += here.climbed;
      found_.lost += here.lost;
      found_.middles += here.middles;
    }
    return groups;
  }

  // Finds the edges of one part.
  void find_in(const Part &own, const Part &part, bool expects_ramps, const KindMask &selected, EdgeSums *found,
               std::vector<Edge> &edges) {
    for (int y = part.y0; y < part.bottom(); y++) {
      const size_t i = (size_t)y * width_ + part.x0;
      const float *values = map_.nearness + i;
      uint8_t *marks = marks_.data() + i;
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
        for (int x = around.x0; x < around.right(); x++)
          least_step = std::min(least_step, step((size_t)y * width_ + x));
    }
    const float change = 0.09f * least_step;
    Grid changes({0, 0, 2, around.width});
    float *of_row = changes.at(0, 0), *of_columns = changes.at(1, 0);
    changes.clear();
    int top = height_, bottom = 0;
    for (int y = around.y0; y < around.bottom(); y++) {
      const float *at = map_.nearness + (size_t)y * width_ + around.x0, *above = y > around.y0 ? at - width_ : at;
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
    float marks_of_row[AREA + LANES];
    for (int y = inner.y0; y < inner.bottom(); y++) {
      find_in_row(m, own, y, selected, found, edges, marks_of_row);
      uint8_t *marks = marks_.data() + (size_t)y * width_ + inner.x0;
      for (int k = 0; k < inner.width; k++) marks[k] = (uint8_t)(int)marks_of_row[k];
    }
    return true;
  }

  // Smallest differences between two surfaces at LANES pixels.
  vec steps_at(int y, int x) const {
    if (!map_.steps) return broadcast(step(0));
    vec steps = {};
    const float *row = map_.steps + (size_t)std::clamp(y, 0, height_ - 1) * width_;
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
    const auto is_steep = [&](int y, int x) { return load<vec>(m.slope.at(y, x)) > 0.1f * steps_at(y, x); };
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
      vec near = load<vec>(m.nears[RINGS - 1].at(y, x)), far = load<vec>(m.fars[RINGS - 1].at(y, x)), unsure = {};
      if (!any_of((near + far > s) | (is_ramp > none))) {  // no step is large enough
        store(marks + k, is_valid ? none : broadcast((float)UNSURE * (RINGS + 1)));
        continue;
      }
      const vec least_gap = max(NEAREST * (near + far), s);
      for (int r = RINGS - 1; r >= 0; r--) {
        const vec n = load<vec>(m.nears[r].at(y, x)), f = load<vec>(m.fars[r].at(y, x)), gap = n + f;
        const auto is_step = (gap > least_gap) & (load<vec>(m.jumps[r].at(y, x)) > ABRUPT * gap);
        near = is_step ? n : near;
        far = is_step ? f : far;
        unsure = is_step ? broadcast((float)(RINGS - r)) : unsure;
      }
      near = is_ramp > none ? load<vec>(m.up.at(y, x)) : near;
      far = is_ramp > none ? -load<vec>(m.down.at(y, x)) : -far;
      const auto is_edge = (is_ramp + unsure > none) & (near - far > s) & is_valid;
      const vec is_near = 2.0f * v > near + far ? one : none;
      const vec mark = (is_edge ? broadcast((float)EDGE) : none) + is_near * (float)NEAR + is_ramp * (float)RAMP;
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

  // Kinds of LANES edge pixels. level: nearness, from 0 at the far surface to 1 at the near one; unsure: RINGS less the
  // ring.
  static ivec kinds_at(const Maps &m, int y, int x, vec gap, vec level, vec is_ramp, vec unsure) {
    const vec none = {}, one = broadcast(1.0f);
    const vec right = load<vec>(m.high.at(y, x + 2)) - load<vec>(m.high.at(y, x - 2));
    const vec below = load<vec>(m.high.at(y + 2, x)) - load<vec>(m.high.at(y - 2, x));
    const vec across = abs(right) > abs(below) + TIE * gap ? (right > none ? one : -one) : none;
    const vec along = abs(below) > abs(right) + TIE * gap ? (below > none ? one : -one) : none;
    const ivec of_level = convert(min(max(level * (float)LEVELS, none), broadcast(LEVELS - 1.0f)));
    const vec on_step = (level > 0.5f ? broadcast((float)RINGS) : none) + (float)RINGS - unsure;
    const vec place = is_ramp > none ? 2.0f * RINGS + convert(of_level) : on_step;
    return convert(place * (float)DIRECTIONS + 2.0f * along + across + (float)(DIRECTIONS / 2));
  }

  // Adds an edge pixel to the statistics.
  static void measure(EdgeSums &found, float level, bool is_near, float climbed) {
    const bool is_middle = is_mixed(level);
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
      const vec ax0 = abs(x0), ax1 = abs(x1), ay0 = abs(y0), ay1 = abs(y1);
      const vec sx = x0 * x1 > vec{} ? min(ax0, ax1) : vec{}, sy = y0 * y1 > vec{} ? min(ay0, ay1) : vec{};
      store(slope.at(y, x), max(sx, sy));
      store(jump.at(y, x), max(max(ax0, ax1) - sx, max(ay0, ay1) - sy));
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

  // For each edge: the score of its surfaces by colour and, if wanted, their nearness.
  void judge(std::vector<Group> &groups, bool wants_surfaces) const {
    // a pixel is not its own reference
    const std::vector<float> falloff =
        window([](float square) { return square > 0 ? std::exp(-square / (2 * FALLOFF_PX * FALLOFF_PX)) : 0.0f; });
    parallel((int)groups.size(), [&](int g) {
      if (groups[g].edges.empty()) return;
      groups[g].judged.resize(groups[g].edges.size());
      groups[g].around.resize((groups[g].edges.size() + LANES - 1) / LANES);
      channels_ == 3 ? judge<3>(groups[g], falloff.data(), wants_surfaces)
                     : judge<0>(groups[g], falloff.data(), wants_surfaces);
    });
  }

  // How clearly the near surface is the more blurred one, 0 to 1.
  static float more_blurred(const Edge &edge) {
    return clamp01((std::fabs(edge.near) - std::fabs(edge.far)) / MORE_BLURRED_PX);
  }

  // A window around a pixel: weights of both surfaces, nearness, and squared differences to the pixel's colour.
  struct Window {
    vec weights[2][WINDOW], values[WINDOW], apart[WINDOW];
  };
  struct Windows {
    explicit Windows(int count) : values(count * LANES) {}
    Window of_pixel[LANES];
    std::vector<float> values;  // of LANES pixels each: totals of both surfaces, and the pixels' own colours
  };

  // Likelihoods and surfaces of the pixels of some windows, and how alike the pixels around each one are.
  struct Likelihoods {
    float likely[2][LANES], surfaces[2][LANES], blurs[LANES];
    Likelihoods(const Edge *edges, int pixels, const Windows &windows, vec per_spread, bool wants_surfaces,
                float *around) {
      for (int l = 0; l < pixels; l++) {
        const Window &window = windows.of_pixel[l];
        const float *apart_at = (const float *)window.apart + REACH * WHOLE + REACH;
        for (int n = 0; n < 8; n++) around[n * LANES + l] = apart_at[NEIGHBOURS[n][0] * WHOLE + NEIGHBOURS[n][1]];
        vec parts[6] = {};  // of both surfaces: likelihood, weights, weighted nearness
        for (int n = 0; n < WINDOW; n++) {
          const vec t = 1.0f + window.apart[n] * per_spread[l], alike = 1.0f / (t * t);
          for (int side = 0; side < 2; side++) {
            parts[side] += window.weights[side][n] * alike;
            if (!wants_surfaces) continue;
            const vec part = window.weights[side][n] * (alike + 1e-3f);
            parts[2 + side] += part;
            parts[4 + side] += part * window.values[n];
          }
        }
        blurs[l] = more_blurred(edges[l]);
        for (int side = 0; side < 2; side++) {
          likely[side][l] = reduce_add(parts[side]);
          surfaces[side][l] =
              edges[l].near + reduce_add(parts[4 + side]) / std::max(reduce_add(parts[2 + side]), 1e-12f);
        }
      }
    }
  };

  // C: channels, or 0 for any number.
  //
  // The reference colours of a surface are those of the window's pixels whose nearness is within a quarter of the gap.
  // A surface's likelihood is the mean of (1 + d / spread)^-2 over them, d being the squared colour difference.
  //
  // 1. Sum over each pixel's window the weights and colour differences of the references of both surfaces.
  // 2. For LANES pixels at once, compute the spread of the references' colours, and the contrast of the surfaces.
  // 3. Sum the likelihoods over the windows, which need the spread.
  // 4. In maps of the coc, where surfaces are wanted: add the likelihood of a mixture to a more blurred near surface.
  // 5. The score is the logarithm of the likelihoods' ratio, less beside a step with few samples; the reliability grows
  //    with the contrast. A likelihood of LIKELY is full evidence that the pixel shows one of both surfaces.
  template <int C>
  void judge(Group &group, const float *falloff, bool wants_surfaces) const {
    const int channels = C ? C : channels_, count = 4 + 2 * channels;
    const Part around = group.bounds.grown(REACH);
    const Grid given(around), witness(around), colour(around, channels);
    for (int c = 0; c < channels; c++)
      fetch(map_.light + c * area_, colour, colour.at(around.y0, around.x0) + c * colour.size, root);
    fetch(map_.nearness, given, [this](float v) { return sign_ * valid(v); });
    fetch(marks_.data(), witness, [](uint8_t marks) { return (float)(marks / UNSURE); });
    float *sure = witness.at(around.y0, around.x0);
    for (size_t i = 0; i < witness.size; i += LANES) store(sure + i, lookup(SURE_OF, convert(load<vec>(sure + i))));
    std::vector<vec> many(C ? 0 : count);
    Windows windows(count + channels);
    const vec none = {};
    each_edge(group, [&](size_t k, const Edge &edge, int y, int x) {
      const int lane = (int)(k % LANES);
      Window &window = windows.of_pixel[lane];
      const float near = edge.near, far = edge.far;
      const vec most_difference = broadcast(SAMPLED_GAP * std::max(near - far, 1e-12f));
      vec few[C ? 4 + 2 * C : 1];
      // of both surfaces: weights, squared colour differences, colour differences of each channel
      vec *sums = C ? few : many.data();
      float *own = &windows.values[count * LANES + lane];
      for (int n = 0; n < count; n++) sums[n] = none;
      const float *given_at = given.at(y - REACH, x - REACH), *witness_at = witness.at(y - REACH, x - REACH),
                  *colour_at = colour.at(y - REACH, x - REACH);
      for (int c = 0; c < channels; c++) own[c * LANES] = colour_at[c * colour.size + REACH * colour.pitch + REACH];
      each_of_window([&](int n, const auto &take) {
        const vec value = take(given_at, given.pitch),
                  weight = load<vec>(falloff + n * LANES) * take(witness_at, given.pitch), off = value - near;
        const vec w[2] = {abs(off) < most_difference ? weight : none,
                          abs(value - far) < most_difference ? weight : none};
        vec apart = none;  // squared colour difference
        for (int c = 0; c < channels; c++) {
          const vec d = take(colour_at + c * colour.size, given.pitch) - own[c * LANES];
          apart += d * d;
          for (int side = 0; side < 2; side++) sums[4 + 2 * c + side] += w[side] * d;
        }
        for (int side = 0; side < 2; side++) {
          sums[side] += w[side];
          sums[2 + side] += w[side] * apart;
          window.weights[side][n] = w[side];
        }
        window.values[n] = off;
        window.apart[n] = apart;
      });
      for (int n = 0; n < count; n++) windows.values[n * LANES + lane] = reduce_add(sums[n]);
      if (lane == LANES - 1 || k + 1 == group.edges.size())
        score(group, k - lane, lane + 1, windows, channels, wants_surfaces);
    });
  }

  // Steps 2 to 5 of `judge` for up to LANES pixels at once, from pixel `first` of a group on.
  void score(Group &group, size_t first, int pixels, const Windows &windows, int channels, bool wants_surfaces) const {
    const vec none = {}, one = broadcast(1.0f);
    const auto of = [&](int n) { return load<vec>(&windows.values[n * LANES]); };
    const int count = 4 + 2 * channels;
    const vec per_total[2] = {1.0f / of(0), 1.0f / of(1)};
    vec square = none, contrast = none, noise = none, from_mean[2] = {none, none}, along = none;
    for (int c = 0; c < channels; c++) {
      const vec mine = of(count + c), near_off = of(4 + 2 * c) * per_total[0], far_off = of(5 + 2 * c) * per_total[1],
                both = 2.0f * mine + near_off + far_off;
      square += mine * mine;
      from_mean[0] += near_off * near_off;
      from_mean[1] += far_off * far_off;
      contrast += (near_off - far_off) * (near_off - far_off);
      along += far_off * (far_off - near_off);  // from the far surface's colour towards the near one's
      noise += both * both;
    }
    vec spread = COLOUR_NOISE * noise + 1e-12f;
    for (int side = 0; side < 2; side++) spread += 0.5f * max(of(2 + side) * per_total[side] - from_mean[side], none);
    const vec per_light = 1.0f / (SIMILAR * square + 1e-12f), per_spread = 1.0f / (SPREAD * spread);
    const auto is_known = (of(0) > 1e-3f) & (of(1) > 1e-3f);  // else the neighbours decide
    const vec reliability = is_known ? max(contrast / (contrast + 0.5f * spread) - 0.1f, none) / 0.9f : one;
    const vec share = max(min(along / max(contrast, broadcast(1e-12f)), one), none);
    const vec unmixed = 1.0f + max(from_mean[1] - share * (2.0f * along - share * contrast), none) / spread;
    const vec mixed = wants_surfaces && map_.is_coc ? MIXTURE / (unmixed * unmixed) : none;
    float *const around = group.around[first / LANES].alike[0];
    const Likelihoods found(&group.edges[first], pixels, windows, per_spread, wants_surfaces, around);
    for (int n = 0; n < 8; n++) store(around + n * LANES, 1.0f / (1.0f + load<vec>(around + n * LANES) * per_light));
    vec likelihood[2];
    for (int side = 0; side < 2; side++) likelihood[side] = load<vec>(found.likely[side]) * per_total[side] + 1e-9f;
    likelihood[0] += mixed * load<vec>(found.blurs);
    const vec likeliest = is_known ? min(max(likelihood[0], likelihood[1]) / LIKELY, one) : one;
    const vec odds = likelihood[0] / likelihood[1],
              clear = min(min(of(0), of(1)) / (wants_surfaces ? CLEAR : CLEAR_IN_PRIOR), one);
    for (int l = 0; l < pixels; l++) {
      const Edge &edge = group.edges[first + l];
      score_[edge.i] =
          is_known[l] ? std::clamp(std::log(odds[l]), -8.0f, 8.0f) * (marks_[edge.i] & RAMP ? 1.0f : clear[l]) : 0.0f;
      evidence_[edge.i] = likeliest[l];
      group.judged[first + l] = {0.0f, reliability[l], is_known[l] ? found.surfaces[0][l] : edge.near,
                                 is_known[l] ? found.surfaces[1][l] : edge.far};
    }
  }

  // Averages the scores of neighbours of similar colour, and adds their evidence.
  void decide(std::vector<Group> &groups) {
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      if (group.edges.empty()) return;
      const Grid scores(group.bounds.grown(1));
      take_listed(score_.data(), scores, NO_SCORE);
      float beside[9][LANES];  // scores of the 8 neighbours of LANES pixels, and their own
      each_edge(group, [&](size_t k, const Edge &, int y, int x) {
        const int lane = (int)(k % LANES);
        const float *own = scores.at(y, x);
        for (int n = 0; n < 8; n++) beside[n][lane] = own[NEIGHBOURS[n][0] * scores.pitch + NEIGHBOURS[n][1]];
        beside[8][lane] = *own;
        if (lane < LANES - 1 && k + 1 < group.edges.size()) return;
        const float *around = group.around[k / LANES].alike[0];
        const vec none = {};
        vec total = broadcast(1.0f), score = load<vec>(beside[8]), strongest = abs(score);
        for (int n = 0; n < 8; n++) {
          const vec other = load<vec>(beside[n]), alike = other < NO_SCORE ? load<vec>(around + n * LANES) : none;
          total += alike;
          score += alike * other;
          strongest = max(strongest, other < NO_SCORE ? abs(other) : none);
        }
        score /= total;
        for (int l = 0; l <= lane; l++) {
          Judgement &judged = group.judged[k - lane + l];
          judged.score = std::clamp(sharpness_ * judged.reliability * score[l], -6.0f, 6.0f);
          float &evidence = evidence_[group.edges[k - lane + l].i];
          evidence = std::max(clamp01(2.0f * judged.reliability * strongest[l] - 1.0f), evidence);
        }
      });
    });
  }

  // Copies a plane where pixels are listed, a constant elsewhere.
  void take_listed(const float *plane, const Grid &grid, float elsewhere) const {
    const Part inside = in_frame(grid);
    for (int y = inside.y0; y < inside.bottom(); y++) {
      float *row = grid.at(y, 0);
      const float *from = plane + (size_t)y * width_;
      const uint8_t *marks = marks_.data() + (size_t)y * width_;
      for (int x = inside.x0; x < inside.right(); x++) row[x] = marks[x] & LISTED ? from[x] : elsewhere;
    }
    clamp_to_frame(grid, grid);
  }

  // How far colours agree with the map at pixels where the map is most likely right.
  Agreement agreement_of(const std::vector<Group> &groups) const {
    Agreement found;
    for (const Group &group : groups)
      for (size_t k = 0; k < group.edges.size(); k++) {
        const Edge &edge = group.edges[k];
        const float score = group.judged[k].score,
                    level = (nearness(edge.i) - edge.far) / std::max(edge.near - edge.far, 1e-12f);
        if (marks_[edge.i] & RAMP ? std::fabs(level - 0.5f) <= CLEAR_LEVEL
                                  : edge.kind / DIRECTIONS % RINGS != RINGS - 1)
          continue;
        const float weight = std::min(0.5f * std::fabs(score), 1.0f);
        const bool is_near = level > 0.5f;
        found.clear[is_near] += weight;
        if ((score > 0) == is_near) found.agreed[is_near] += weight;
      }
    return found;
  }

  // Whether they do on one side of its edges at least, because beside a foreground that is too thin they show the
  // foreground.
  static bool is_related(const Agreement &found) {
    const auto agrees = [&](bool side) {
      return (found.agreed[side] + 0.25f * PRIOR_COUNT) / (found.clear[side] + 0.5f * PRIOR_COUNT) > RELATED;
    };
    return agrees(false) || agrees(true);
  }

  // render/surfaces/doubt.py, doubt_of.
  static float doubt_of(const Agreement &found) {
    const auto share = [&](bool side) {
      return (float)((found.clear[side] - found.agreed[side]) / (found.clear[side] + ASSUMED));
    };
    return clamp01((std::min(share(false), share(true)) - CONTRADICTED) / (OFTEN_CONTRADICTED - CONTRADICTED));
  }

  // Share of pixels that show the near surface, by kind: a maximum-likelihood fit (EM) to the scores, with PRIOR_COUNT
  // pixels assumed at the share that an almost exact map has.
  void calibrate(const std::vector<Group> &groups) {
    std::vector<float> assumed(PLACES), start(PLACES);
    for (int p = 0; p < PLACES; p++) {
      assumed[p] = p < RINGS ? TRUSTED : p < 2 * RINGS ? 1.0f - TRUSTED : (p - 2 * RINGS + 0.5f) / LEVELS;
      start[p] = p < 2 * RINGS ? 0.5f : assumed[p];
    }
    std::vector<Observations> observations(KINDS);
    for (const Group &group : groups)
      for (size_t k = 0; k < group.edges.size(); k++) {
        const float score = group.judged[k].score;
        Observations &observed = observations[group.edges[k].kind];
        observed.weights.push_back(std::min(0.5f * std::fabs(score), 1.0f));
        observed.odds.push_back(std::exp(-score));
      }
    for (Observations &observed : observations)
      for (std::vector<float> *values : {&observed.weights, &observed.odds})
        values->resize((values->size() + LANES - 1) / LANES * LANES);
    const std::vector<float> together = fit(observations, DIRECTIONS, start, assumed);
    std::vector<float> each(KINDS);
    for (int k = 0; k < KINDS; k++) each[k] = together[k / DIRECTIONS];
    shares_ = fit(observations, 1, std::vector<float>(KINDS, 0.5f), each);
  }

  // Scores of the pixels of one kind: weight, and odds of the far surface. Padded to whole vectors with weight 0.
  struct Observations {
    std::vector<float> weights, odds;
  };

  static std::vector<float> fit(const std::vector<Observations> &observations, int together, std::vector<float> share,
                                const std::vector<float> &assumed) {
    const auto sum_of = [&](size_t first, const auto &part) {
      double totals[LANES] = {}, total = 0;
      for (size_t kind = first; kind < first + together; kind++)
        for (size_t n = 0; n < observations[kind].weights.size(); n += LANES) {
          float parts[LANES];
          store(parts, part(load<vec>(&observations[kind].weights[n]), load<vec>(&observations[kind].odds[n])));
          for (int i = 0; i < LANES; i++) totals[i] += parts[i];
        }
      for (const double each : totals) total += each;
      return total;
    };
    for (size_t g = 0; g < share.size(); g++) {
      const double total = sum_of(g * together, [](vec weight, vec) { return weight; });
      for (int round = 0; round < ROUNDS; round++) {
        const float odds = (1.0f - share[g]) / share[g];
        const double found =
            sum_of(g * together, [&](vec weight, vec other) { return weight / (1.0f + odds * other); });
        share[g] = std::clamp((float)((found + PRIOR_COUNT * assumed[g]) / (total + PRIOR_COUNT)), 0.005f, 0.995f);
      }
    }
    return share;
  }

  // Standard deviation, in pixels, of the blur that turned steps into ramps.
  float blur() const {
    const double width = CLIMBED * found_.middles / std::max(found_.climbed, 1e-12);
    return std::clamp((float)std::sqrt(std::max(width * width - PIXEL, 0.0)), LEAST_BLUR_PX, MOST_BLUR_PX);
  }

  // Decides which surface pixels show, and moves them to its nearness; on ramps in proportion to the evidence, or to
  // the doubt. Returns the width, in pixels, by which the map's near surfaces are too thin.
  float move(const std::vector<Group> &groups, bool is_soft, float doubt) const {
    const float lean = map_.automatic ? LEAN : 0.0f, to_blurred = map_.automatic && map_.is_coc ? TO_BLURRED : 0.0f;
    float prior[KINDS];
    for (int k = 0; k < KINDS; k++) prior[k] = std::log(shares_[k] / (1.0f - shares_[k]));
    const auto odds = [&](const Group &group, size_t k) {
      const float score = group.judged[k].score;
      const Edge &edge = group.edges[k];
      return score + prior[edge.kind] + lean * clamp01(std::fabs(score) - 1.0f) +
             (is_soft ? to_blurred * more_blurred(edge) : 0.0f);
    };
    std::vector<std::vector<float>> chances(groups.size());
    for (int round = 0; is_soft && round < DECIDED_ROUNDS; round++) {
      parallel((int)groups.size(), [&](int g) {
        chances[g].resize(groups[g].edges.size());
        for (size_t k = 0; k < chances[g].size(); k++)
          chances[g][k] =
              1.0f / (1.0f + std::exp(-odds(groups[g], k) - (round ? neighbours(groups[g].edges[k]) : 0.0f)));
      });
      parallel((int)groups.size(), [&](int g) {
        for (size_t k = 0; k < chances[g].size(); k++) score_[groups[g].edges[k].i] = chances[g][k];
      });
    }
    std::vector<int64_t> lost(groups.size(), 0);
    parallel((int)groups.size(), [&](int g) {
      for (size_t k = 0; k < groups[g].edges.size(); k++) {
        const Edge &edge = groups[g].edges[k];
        const Judgement &judged = groups[g].judged[k];
        const bool shows_near = odds(groups[g], k) + (is_soft ? neighbours(edge) : 0.0f) > 0;
        const uint8_t marks = marks_[edge.i];
        const bool was_near = marks & NEAR;
        lost[g] += shows_near - was_near;
        const float moved = !(marks & RAMP) ? (float)(shows_near != was_near) : std::max(evidence_[edge.i], doubt);
        if (!(moved > 0)) continue;
        const float own = nearness(edge.i), surface = shows_near ? judged.near : judged.far;
        map_.out[edge.i] = sign_ * (own + moved * (surface - own));
      }
    });
    double total = found_.lost;
    for (const int64_t here : lost) total += (double)here;
    return (float)(total / std::max(found_.length, 1e-12));
  }

  // Log-odds of the near surface from the neighbours; score_ is the chance that a listed one shows it.
  float neighbours(const Edge &edge) const {
    float odds = 0;
    for (const auto &[dy, dx] : NEIGHBOURS) {
      const int at =
          std::clamp(edge.i / width_ + dy, 0, height_ - 1) * width_ + std::clamp(edge.i % width_ + dx, 0, width_ - 1);
      const bool is_near = sign_ * valid(map_.nearness[at]) > 0.5f * (edge.near + edge.far);
      odds += (dy && dx ? DIAGONAL : BESIDE) * (2.0f * (marks_[at] & LISTED ? score_[at] : (float)is_near) - 1.0f);
    }
    return odds;
  }

  // Removes rims beside steps that are a little nearer, or farther, than the surface to which they belong: the ringing
  // of interpolation. Such pixels move to the closer end of the range between the closed opening and the opened
  // closing.
  void remove_ringing() {
    memcpy(evidence_.data(), map_.out, area_ * sizeof(float));
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
      fetch(evidence_.data(), up, [this](float v) { return std::fabs(v) <= LARGEST ? sign_ * v : -NEVER; });
      fetch(evidence_.data(), down, [this](float v) { return std::fabs(v) <= LARGEST ? -sign_ * v : -NEVER; });
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
          const size_t i = (size_t)y * width_ + x;
          const float own = sign_ * map_.out[i], gap = *span.at(y, x), ends[2] = {-*up.at(y, x), *down.at(y, x)};
          if (!(std::fabs(own) <= LARGEST && gap > step(i))) continue;
          const float moved = std::clamp(own, std::min(ends[0], ends[1]), std::max(ends[0], ends[1])) - own;
          map_.out[i] = sign_ * (own + moved * clamp01(2.0f - std::fabs(moved) / (OVERSHOOT * gap)));
        }
    });
  }

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
            of_blurred > 0.004f ? clamp01((explained[1] - EXPLAINED) / EXPLAINED_MORE) * better : 0.0f};
  }

  // Raises the nearness of lamps of a few pixels, which a soft map averages with their surroundings.
  void lift_lamps(float sigma, float lost_px, float doubt) const {
    const std::vector<float> weights = even_window();
    // 0 if the map's near surfaces are 1 px too wide: then it has lost no lamps
    const float is_lost = clamp01(2.4f + 2.5f * lost_px) * (1.0f - doubt);
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
      if (!map_.steps && !(reduce_max(high) - reduce_min(low) > 0.5f * step(0))) return;
      const Group group{part, lamps_of(part, near)};
      if (group.edges.empty()) return;
      const Part around = bounds(group).grown(REACH), covered = around.grown(reach), whole = covered.grown(USUAL_REACH);
      const Grid bright(whole), usual(whole), rows(whole), peak(covered), blurred(around), given(around);
      brightest(bright, usual, rows, covered);
      max_filter<2>(bright, peak, rows, covered);
      each_vector(covered, [&](int y, int x) {
        const vec own = load<vec>(bright.at(y, x));
        store(usual.at(y, x),
              own > 2.0f * load<vec>(usual.at(y, x)) ? own / max(load<vec>(peak.at(y, x)), broadcast(1e-30f)) : vec{});
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
      any = max(any, load<vec>(bright.at(y, x)) > 4.0f * load<vec>(usual.at(y, x)) ? broadcast(1.0f) : vec{});
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
        const size_t i = (size_t)y * width_ + x;
        const float own = *bright.at(y, x);
        if (own > 4.0f * *usual.at(y, x) && own > 0.1f * *peak.at(y, x) &&
            *high.at(y, x) + *low.at(y, x) > 0.5f * step(i) && std::fabs(map_.nearness[i]) <= LARGEST)
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

  const torchdof_map &map_;
  const float sign_;  // -1 for a map of coc, where larger is farther
  const int channels_;
  float noise_step_ = 0.0f;  // smallest step that is larger than the map's noise
  float sharpness_ = SHARPNESS;
  const Buffer<float> score_, evidence_;
  const Buffer<uint8_t> marks_;
  std::vector<float> shares_;
  EdgeSums found_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_repair_edges(const torchdof_map *map, int32_t *changed, double *doubt) {
  return torchdof::guarded([&] { *changed = torchdof::Repair(*map).run(*doubt); });
}
