// Restores what a blur has done to a map: the compiled version of torchdof/render/surfaces/soft_maps.py.
#pragma once
#include "edge_map.h"

namespace torchdof {

// Removes the ringing of interpolation from the repaired map. soft_maps.cpp
void remove_ringing(const EdgeMap &map);

// Raises the nearness of lamps in the repaired map, of which the blur with the standard deviation sigma, in pixels, has
// made less. lost_px: width that it has taken from near surfaces. soft_maps.cpp
void lift_lamps(const EdgeMap &map, float sigma, float lost_px, float doubt);

// Standard deviation, in pixels, of the blur that turned steps into ramps. soft_maps.cpp
float sigma_of(const EdgeSums &found);

}  // namespace torchdof
