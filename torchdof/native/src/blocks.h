// Sides in pixels of the squares into which frames are divided, and the divisions of integers that this takes.
#pragma once
#include "constants/highlights.h"

namespace torchdof {

constexpr int BLOCK = 16;  // of the blocks in which second surfaces are stored
constexpr int BLOCK_PIXELS = BLOCK * BLOCK;
constexpr int CELL = constants::highlights::COARSE_CELL;  // of the cells for which layers and occluders are listed
constexpr int TILE = 64;                                  // of the tiles that are composited at once

inline int ceil_div(int a, int b) { return (a + b - 1) / b; }
inline int floor_div(int a, int b) { return a >= 0 ? a / b : -((-a + b - 1) / b); }

inline int place_in_block(int y, int x) { return y % BLOCK * BLOCK + x % BLOCK; }

}  // namespace torchdof
