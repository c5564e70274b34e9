// What the two parts of matting share: edges, and strands thinner than a pixel.
#pragma once
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {

constexpr float EDGE_PX = 0.5f;  // difference in coc of neighbours from which on they may be two surfaces
constexpr float TRUST = 4.0f;    // how much texture discredits the contrast of the two surfaces
constexpr float ALIKE = 1.0f / 255;  // contrast, as a share of the brightest light around, that is worth as much as none
constexpr float UNBOUNDED = 1e6f;  // times the brightest pixel around: so bright is neither part of a pixel

inline float falloff_at(int dy, int dx) { return (float)std::exp(-(dy * dy + dx * dx) / 4.5); }

// Of a pixel's colour the part of its other surface, both in parts of a scale. What the mean colours do not explain goes to
// both; no light is lost, and none is brighter or darker than the image.
inline vec other_light(const Job &job, int c, vec colour, vec weight, vec own_mean, vec other_mean, vec per_scale) {
  const vec rest = 1.0f - weight, unexplained = colour - rest * own_mean - weight * other_mean;
  const vec darkest = most(job.light_least[c] * per_scale, all(-UNBOUNDED)), brightest = least(job.light_most[c] * per_scale, all(UNBOUNDED));
  vec moved = weight * (other_mean + unexplained * (weight / (weight * weight + rest * rest)));
  moved = least(most(moved, colour - rest * brightest), colour - rest * darkest);
  return least(most(moved, weight * darkest), weight * brightest);
}

// Joins strands thinner than a pixel; strands.cpp
class Strands {
 public:
  struct Maps;
  explicit Strands(int channels);
  ~Strands();
  // Gives farther pixels of a block, whose mixed pixels are split, the part of a strand that passes beside their centre.
  // No pixel of the block, and of those around it, is nearer than a low coc.
  void join(Job &job, int by, int bx, float low);

 private:
  std::unique_ptr<Maps> maps_;
};

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
