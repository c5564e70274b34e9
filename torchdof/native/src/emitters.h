// The surfaces on which emitters of highlights lie.
#pragma once
#include "constants/emitters.h"
#include "job.h"

namespace torchdof {

using constants::emitters::EMITTER_REACH;

// Assigns the light of a highlight's pixel to the surface of its emitter, in front of the pixel's own surface or
// behind.
void attribute_emitter(Job &job, int y, int x, float least_limit, const float *falloff);

// Factor of the other surface's weight in a highlight's pixel, below 1 if the emitter lies on the pixel's own surface:
// the other surface is dark around the pixel, after light of emitters seen through it was taken from it.
float weight_left(const Job &job, int y, int x, float least_limit, const float *falloff);

}  // namespace torchdof
