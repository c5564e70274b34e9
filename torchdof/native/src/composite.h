// Blurs the layers of a scene and composites them.
#pragma once
#include "highlights.h"
#include "job.h"

namespace torchdof {

void composite(const Job &job, const RayKernels &ray_kernels, float *out);

}  // namespace torchdof
