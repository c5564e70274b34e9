// Decides by colour which surface edge pixels show: the compiled version of torchdof/render/surfaces/edge_colours.py.
#pragma once
#include <vector>

#include "edge_map.h"

namespace torchdof {

// Judges each edge: its score and reliability, the nearness of its surfaces if they are wanted, and the evidence that
// its pixel shows one of them. sharpness: factor on scores. edge_colours.cpp
void judge_edges(const EdgeMap &map, std::vector<Group> &groups, bool wants_surfaces, float sharpness);

}  // namespace torchdof
