#include "surfaces.h"

#include <algorithm>
#include <cstring>

namespace torchdof {

Block Surfaces::make_block(int i) {
  if (blocks[i]) return block(i);
  const size_t size = (size_t)(2 * channels + 3) * BLOCK_PIXELS;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    if (!blocks_left_) {
      memory_.emplace_back(BLOCKS_AT_ONCE * size);
      blocks_left_ = BLOCKS_AT_ONCE;
    }
    blocks[i] = memory_.back().data() + --blocks_left_ * size;
  }
  memset(blocks[i], 0, size * sizeof(float));
  const Block made = block(i);
  const int y0 = i / block_columns * BLOCK, x0 = i % block_columns * BLOCK;
  const int rows = std::min(BLOCK, height - y0), columns = std::min(BLOCK, width - x0);
  for (int y = 0; y < rows; y++) {
    const size_t from = pixel(y0 + y, x0);
    for (int c = 0; c < channels; c++)
      memcpy(made.own + c * BLOCK_PIXELS + y * BLOCK, light + c * area() + from, columns * sizeof(float));
    memcpy(made.coc + y * BLOCK, coc + from, columns * sizeof(float));
    for (int x = 0; x < columns; x++) made.own_weight[y * BLOCK + x] = valid ? valid[from + x] : 1.0f;
  }
  return made;
}

void Surfaces::set_weight(const Block &block, size_t at, int within, float weight) const {
  for (int c = 0; c < channels; c++)
    block.own[c * BLOCK_PIXELS + within] =
        (light[c * area() + at] - weight * block.other[c * BLOCK_PIXELS + within]) / (1.0f - weight);
  block.weight[within] = weight;
  block.own_weight[within] = 1.0f - weight;
}

}  // namespace torchdof
