// Smallest and largest values, and how much values change.
#pragma once
#include <cstdint>

namespace torchdof {

// Mean change of coc between neighbours, horizontal plus vertical; plan.cpp
double mean_change(const float *coc, int height, int width, int threads);

// Smallest and largest value of each block of a band of blocks, whose rows are read in memory order; engine.cpp
void ends_of(const float *values, int width, int rows, float *low, float *high);

// Smallest and largest value; both NaN if any value is NaN.
void find_ends(const float *values, int64_t count, int threads, float *low, float *high);

}  // namespace torchdof
