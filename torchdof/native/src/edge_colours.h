// Decides by colour which surface edge pixels show: the compiled version of torchdof/render/surfaces/edge_colours.py.
#pragma once
#include <cmath>
#include <vector>

#include "constants/edge_colours.h"
#include "edge_map.h"
#include "numbers.h"

namespace torchdof {

// Judges each edge: its score and reliability, the nearness of its surfaces if they are wanted, and the evidence that
// its pixel shows one of them. sharpness: factor on scores. edge_colours.cpp
void judge_edges(const EdgeMap &map, std::vector<Group> &groups, bool wants_surfaces, float sharpness);

// How clearly the near surface is the more blurred one, 0 to 1.
inline float more_blurred(const Edge &edge) {
  return clamp01((std::fabs(edge.near) - std::fabs(edge.far)) / constants::edge_colours::MORE_BLURRED_PX);
}

}  // namespace torchdof
