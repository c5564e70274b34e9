// Constants of render/surfaces/disocclusion.py that several files use, in the type of their computations.
#pragma once
#include "constants/disocclusion.h"
#include "constants/native.h"

namespace torchdof {

using constants::disocclusion::BEHIND_STEP, constants::disocclusion::CERTAIN, constants::disocclusion::FINE_LEVELS;
using constants::disocclusion::LEAST_SEEN, constants::disocclusion::LEAST_TOTAL, constants::disocclusion::SURE;
using constants::native::MOST_LEVELS;

}  // namespace torchdof
