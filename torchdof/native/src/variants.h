// The engine is compiled once for each instruction set and chosen at run time.
#pragma once
#include <vector>

#include "api.h"

namespace torchdof {

// Kernels of highlights, for each radius, and the field's transmittance for some radii.
struct RayKernels {
  const float *const *kernels;
  const int32_t *halves;
  const torchdof_field_mask *field_masks;
  int32_t field_masks_count;
};

}  // namespace torchdof

struct torchdof_job {
  std::vector<int32_t> radii;  // of highlight kernels, in steps of 1/32 px
  virtual ~torchdof_job() = default;
  virtual void finish(const torchdof::RayKernels &kernels, float *out) = 0;
};

namespace torchdof {

struct Variant {
  torchdof_job *(*begin)(const torchdof_scene &scene);
  bool (*repair_edges)(const torchdof_map &map);
  void (*ends)(const float *values, int64_t count, int threads, float *low, float *high);
  void (*coc_of_depth)(const float *depth, int64_t count, float scale, float nearest, float farthest, int threads, float *out);
  std::vector<double> (*plan)(const float *coc, int maps, int height, int width, double &tolerance, int threads);
  void (*make_kernels)(const torchdof_spots &spots, int threads, float *const *out);
  void (*blend)(const torchdof_layers &layers, float *out, const float *gradient, float *const *of_light, float *const *of_place,
                float *const *of_weight);
  void (*farthest)(const float *const *maps, int channels, int height, int width, int rows, int columns, int threads, float *out,
                   const float *gradient, float *const *of_maps);
  void (*look_behind)(const torchdof_level *levels, int count, int channels, const float *coc, int height, int width, int threads,
                      float *out, const float *gradient, float *const *of_levels, float *of_coc);
};

namespace baseline {
extern const Variant variant;
}
namespace avx2 {
extern const Variant variant;
}

}  // namespace torchdof
