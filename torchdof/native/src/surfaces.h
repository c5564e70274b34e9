// The surfaces of a scene.
#pragma once
#include <cstddef>
#include <mutex>
#include <vector>

#include "blocks.h"
#include "memory.h"

namespace torchdof {

// The surfaces of BLOCK x BLOCK pixels where a second one exists or the first differs from the image.
struct Block {
  float *own;         // light of the first surface [channels, BLOCK_PIXELS]
  float *other;       // light of the second surface
  float *coc;         // of the second surface
  float *weight;      // of the second surface
  float *own_weight;  // of the first surface
};

// The surfaces of a scene: either an image with a second surface in some blocks, or any number of full planes.
class Surfaces {
 public:
  int height, width, channels, count;
  bool independent = false;  // surfaces hide each other by their own coverage; otherwise their weights sum to 1
  const float *light = nullptr, *coc = nullptr, *valid = nullptr;  // of the image
  std::vector<const float *> lights, cocs, weights;                // of full planes
  int block_rows, block_columns;
  std::vector<float *> blocks;  // null where the image has only one surface

  bool full_planes() const { return !lights.empty(); }
  size_t area() const { return (size_t)height * width; }
  size_t pixel(int y, int x) const { return (size_t)y * width + x; }  // its index in a plane
  int block_of(int y, int x) const { return y / BLOCK * block_columns + x / BLOCK; }
  bool has_block(int i) const { return blocks[i]; }
  Block block(int i) const {
    float *p = blocks[i];
    return {p, p + channels * BLOCK_PIXELS, p + 2 * channels * BLOCK_PIXELS, p + (2 * channels + 1) * BLOCK_PIXELS,
            p + (2 * channels + 2) * BLOCK_PIXELS};
  }
  // Returns a block; creates it from the image if it does not exist yet.
  Block make_block(int i);
  // Sets the weight of a pixel's second surface; the first one keeps the light that the second does not take.
  void set_weight(const Block &block, size_t at, int within, float weight) const;
  // Surface i at n pixels of a row from column x, within one block column: pointers to each channel, coc and weight
  // (null means 1). Returns false if there is no such surface.
  bool row(int i, int y, int x, const float **light_of, const float *&coc_of, const float *&weight_of) const {
    const size_t at = pixel(y, x);
    if (full_planes()) {
      for (int c = 0; c < channels; c++) light_of[c] = lights[i] + c * area() + at;
      coc_of = cocs[i] + at;
      weight_of = weights[i] ? weights[i] + at : nullptr;
      return true;
    }
    const int which = block_of(y, x), within = place_in_block(y, x);
    if (!has_block(which)) {
      if (i) return false;
      for (int c = 0; c < channels; c++) light_of[c] = light + c * area() + at;
      coc_of = coc + at;
      weight_of = nullptr;
      return true;
    }
    const Block b = block(which);
    for (int c = 0; c < channels; c++) light_of[c] = (i ? b.other : b.own) + c * BLOCK_PIXELS + within;
    coc_of = i ? b.coc + within : coc + at;
    weight_of = (i ? b.weight : b.own_weight) + within;
    return true;
  }

 private:
  static constexpr int BLOCKS_AT_ONCE = 64;
  std::mutex mutex_;
  std::vector<Buffer<float>> memory_;  // BLOCKS_AT_ONCE blocks each
  int blocks_left_ = 0;
};

}  // namespace torchdof
