// A map of depth whose edges are repaired, and its edge pixels: what the files of the repair share.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "api.h"
#include "constants/edge_search.h"
#include "constants/windows.h"
#include "grid.h"
#include "threads.h"

namespace torchdof {

using constants::edge_search::DIRECTIONS, constants::edge_search::PLACES;
using constants::edge_search::REACH, constants::edge_search::RINGS;
using constants::windows::LARGEST, constants::windows::NEVER;
constexpr int KINDS = DIRECTIONS * PLACES;
constexpr float FINITE = 3.402823466e38f;
constexpr int NEIGHBOURS[8][2] = {{-1, -1}, {-1, 0}, {-1, 1}, {0, -1}, {0, 1}, {1, -1}, {1, 0}, {1, 1}};

// Bits of a pixel's mark. NEAR: the map gives it the near surface's depth. Bits from UNSURE up: index into SURE.
constexpr uint8_t RAMP = 2, NEAR = 4, LISTED = 8, UNSURE = 32;

inline float valid(float v) { return std::fabs(v) <= LARGEST ? v : 0.0f; }

// A pixel whose surface is to be decided.
struct Edge {
  int i;
  float near, far;  // of the two surfaces that meet there
  uint8_t kind;
};

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

// The map, and planes of all its pixels, which the repair owns.
class EdgeMap : public Frame {
 public:
  EdgeMap(const torchdof_map &map, float *score, float *evidence, uint8_t *marks)
      : Frame(map.height, map.width), map_(map), sign_(map.is_coc ? -1.0f : 1.0f), channels_(map.channels),
        score_(score), evidence_(evidence), marks_(marks) {}

 protected:
  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(map_.threads, count, map_.cancelled, [&](int i, int) { body(i); });
  }

  float step(size_t i) const { return std::max(map_.steps ? map_.steps[i] : map_.step, noise_step_); }
  float nearness(size_t i) const { return sign_ * map_.nearness[i]; }

  // Tiles that cover the frame.
  std::vector<Group> tiles() const {
    std::vector<Group> parts;
    for (int y = 0; y < height_; y += AREA)
      for (int x = 0; x < width_; x += AREA)
        parts.push_back({{y, x, std::min(AREA, height_ - y), std::min(AREA, width_ - x)}});
    return parts;
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

  const torchdof_map &map_;
  const float sign_;  // -1 for a map of coc, where larger is farther
  const int channels_;
  float noise_step_ = 0.0f;  // smallest step that is larger than the map's noise
  float *const score_, *const evidence_;
  uint8_t *const marks_;

 private:
  static constexpr int AREA = 96;  // side of a tile in pixels
};

}  // namespace torchdof
