// Surfaces at the resolution of coarse layers.
#pragma once
#include <cstddef>
#include <cstdint>
#include <vector>

#include "blur_axis.h"
#include "border.h"
#include "job.h"
#include "memory.h"

namespace torchdof {

// The node before each pixel of each surface, and the layers that occur in each cell.
struct LayerIndex {
  float low, high;              // first and last node
  int words, rows, columns;     // words of `bits` for each cell; number of cells
  std::vector<uint64_t> bits;   // layers that occur in each cell, one bit for each
  std::vector<uint8_t> single;  // cells in which every pixel shows only the first surface
  std::vector<uint8_t> mixed;   // cells with mixed pixels whose farther surface continues behind the nearer one
  std::vector<Buffer<uint16_t>> intervals;

  const uint64_t *cell(size_t i) const { return &bits[i * words]; }
  // The node before all pixels of a cell, or -1 if there are several.
  int only_interval(size_t i) const;
  // Position on the blur axis.
  template <typename V>
  V place(V coc) const {
    return axis(coc, low, high);
  }
};

// Sparse block means: contributions of a block's pixels between two nodes, sorted by row of blocks. Row r has pieces
// start[r] to start[r + 1]. values: weight and light, and both times the pixel's position between the nodes. A node
// with the bit NORMALIZER_ONLY adds its weight to the normalizer alone.
struct Pieces {
  static constexpr uint16_t NORMALIZER_ONLY = 0x8000;
  std::vector<int> start, column;
  std::vector<uint16_t> node;
  std::vector<float> values;
};

// Means of the surfaces over blocks of scale x scale pixels, in the frame and around it; see downsampling.cpp.
class Downsampled {
 public:
  Downsampled(const Job &job, int scale, int margin);
  void take(const Job &job, const LayerIndex &index, const Border &border);

  int scale, margin, rows, columns, channels, pitch, first_band;  // margin: blocks around the frame
  // for each band of BLOCK rows of pixels: contributions beyond the first of a block, which is in the planes
  std::vector<Pieces> pieces;
  // For each interval between nodes: whether a layer of this scale blurs it, whether it lies behind one of them, and
  // the interval that represents it.
  std::vector<uint8_t> wanted, behind;
  std::vector<uint16_t> stands_for;
  std::vector<uint8_t> near;  // blocks of BLOCK x BLOCK pixels that layers of this scale may reach

  int stride() const { return 2 * (channels + 1); }  // number of values of a piece
  bool needed(int interval) const { return wanted[interval] || behind[interval]; }
  // A row of a plane, from the frame's first block. Planes: node before, and the values of a piece.
  float *row(int plane, int y) const { return planes.data() + plane * size + (size_t)(y + margin) * pitch + margin; }

 private:
  size_t size;
  Buffer<float> planes;
};

}  // namespace torchdof
