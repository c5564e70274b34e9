// Finds the edges of a depth map: the compiled version of torchdof/render/surfaces/edge_search.py.
#pragma once
#include <cmath>
#include <vector>

#include "edge_map.h"

namespace torchdof {

// Standard deviation of the map's noise, from the median second difference along rows or columns, whichever is larger.
// At least the noise of rounding, if the map has more than LEVELS_OF_A_FILE levels; their distance is the smallest
// difference of two neighbours. edge_search.cpp
float noise_of(const torchdof_map &map);

// Finds the edges of parts, and marks the pixels up to `halo` around them; adds those of the selected kinds to the
// groups. Returns the sums over all edge pixels if they are wanted. edge_search.cpp
EdgeSums find_edges(const EdgeMap &map, std::vector<Group> &groups, int halo, bool expects_ramps, bool measures,
                    const KindMask &selected);

// Gradient at a pixel as a fraction of the step `gap`, given the offsets of its neighbours. The sum over a step's
// pixels is its length in pixels.
float climb(const float *value, int left, int right, int above, int below, float gap);

}  // namespace torchdof
