// The layers of a picture.
#pragma once
#include <vector>

#include "api.h"
#include "convolution.h"

namespace torchdof {

struct Layer {
  int scale = 1, half = 0;
  double node = 0;
  float before = 0, per_before = 0, at = 0, per_after = 0;  // ends and slopes of the ramps before and after the layer
  bool first = false;
  const torchdof_field_mask *field_mask = nullptr;
  bool spots = false;           // the field mask is 0 at and beyond the edge of its samples
  std::vector<Kernel> kernels;  // 1, or one for each colour
};

// Layer k of `count`, without its resolution and kernels.
inline Layer make_layer(const double *nodes, int count, int k) {
  Layer l;
  l.node = nodes[k];
  l.first = k == 0;
  l.before = (float)(l.first ? l.node : nodes[k - 1]);
  l.per_before = l.first ? 0.0f : (float)(1.0 / (l.node - nodes[k - 1]));
  l.at = (float)l.node;
  l.per_after = k == count - 1 ? 0.0f : (float)(1.0 / (nodes[k + 1] - l.node));
  return l;
}

}  // namespace torchdof
