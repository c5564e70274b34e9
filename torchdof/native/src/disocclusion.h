// Constants of render/surfaces/disocclusion.py that several files use, in the type of their computations.
#pragma once
#include "constants/disocclusion.h"
#include "constants/native.h"

namespace torchdof {

constexpr float LEAST_SEEN = constants::disocclusion::LEAST_SEEN;
constexpr float LEAST_TOTAL = constants::disocclusion::LEAST_TOTAL;
constexpr float CERTAIN = constants::disocclusion::CERTAIN;
constexpr int FINE_LEVELS = constants::disocclusion::FINE_LEVELS;
constexpr int BEHIND_STEP = constants::disocclusion::BEHIND_STEP;
constexpr int MOST_LEVELS = constants::native::MOST_LEVELS;

}  // namespace torchdof
