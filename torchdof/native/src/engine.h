// Declarations shared by the engine's files.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <memory>
#include <mutex>
#include <new>
#include <stdexcept>
#include <vector>

#include "api.h"
#include "constants/border.h"
#include "constants/disocclusion.h"
#include "constants/field.h"
#include "constants/matting.h"
#include "constants/native.h"
#include "constants/placed_kernels.h"
#include "memory.h"
#include "numbers.h"
#include "threads.h"

namespace torchdof {

#if defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif
typedef float vec __attribute__((vector_size(LANES * 4)));
typedef int32_t ivec __attribute__((vector_size(LANES * 4)));

template <typename V, typename T>
inline V load(const T *p) {
  typedef V unaligned __attribute__((aligned(4)));
  return *(const unaligned *)p;
}
template <typename V, typename T>
inline void store(T *p, V v) {
  typedef V unaligned __attribute__((aligned(4)));
  *(unaligned *)p = v;
}
inline vec all(float v) { return v - vec{}; }
#if defined(__AVX2__)  // compilers do not always find the single instruction
template <>
inline vec most(vec a, vec b) {
  return __builtin_ia32_maxps256(a, b);
}
template <>
inline vec least(vec a, vec b) {
  return __builtin_ia32_minps256(a, b);
}
#endif
inline vec counting() {  // 0, 1, 2, ...
  vec v;
  for (int i = 0; i < LANES; i++) v[i] = i;
  return v;
}
inline ivec convert(vec v) { return __builtin_convertvector(v, ivec); }
inline vec convert(ivec v) { return __builtin_convertvector(v, vec); }
inline float largest(vec v) {
  float m = v[0];
  for (int i = 1; i < LANES; i++) m = v[i] > m ? v[i] : m;
  return m;
}
inline float smallest(vec v) { return -largest(-v); }
inline vec size_of(vec v) { return (vec)((ivec)v & 0x7fffffff); }
typedef float quad __attribute__((vector_size(16)));
inline float sum(vec v) {
  quad parts[LANES / 4];
  memcpy(parts, &v, sizeof(v));
  for (int i = 1; i < LANES / 4; i++) parts[0] += parts[i];
  return (parts[0][0] + parts[0][2]) + (parts[0][1] + parts[0][3]);
}
// Looks up LANES of eight values by index.
inline vec pick(const float *values, ivec index) {
#if defined(__AVX2__)
  return (vec)__builtin_ia32_permvarsf256(load<vec>(values), index);
#else
  vec picked;
  for (int i = 0; i < LANES; i++) picked[i] = values[index[i]];
  return picked;
#endif
}
// Packs the sign bit of each lane.
#if defined(__AVX2__)
inline int bits(ivec mask) { return __builtin_ia32_movmskps256((vec)mask); }
inline bool any_of(ivec mask) { return bits(mask) != 0; }
#else
inline int bits(ivec mask) {
  int lanes = 0;
  for (int i = 0; i < LANES; i++) lanes |= (mask[i] & 1) << i;
  return lanes;
}
inline bool any_of(ivec mask) {
  typedef long long wide __attribute__((vector_size(LANES * 4)));
  return (((wide)mask)[0] | ((wide)mask)[1]) != 0;
}
#endif
inline bool any_positive(vec v) { return any_of(v > vec{}); }
inline float clamp(float v, float low, float high) { return std::min(std::max(v, low), high); }
inline int ceil_div(int a, int b) { return (a + b - 1) / b; }
inline int floor_div(int a, int b) { return a >= 0 ? a / b : -((-a + b - 1) / b); }

// Uninitialized memory.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(size_t size) : data_(static_cast<T *>(take_memory(size * sizeof(T)))) {}
  T *data() const { return data_.get(); }
  T &operator[](size_t i) const { return data_.get()[i]; }

 private:
  struct Give {
    void operator()(T *data) const { give_memory(data); }
  };
  std::unique_ptr<T, Give> data_;
};

// Sides in pixels
constexpr int BLOCK = 16;  // of the blocks in which second surfaces are stored
constexpr int BLOCK_PIXELS = BLOCK * BLOCK;
constexpr int CELL = 8;   // of the cells for which layers and occluders are listed
constexpr int TILE = 64;  // of the tiles that are composited at once

// Constants of Python modules, which give their meanings, units and effects; here with the type of the computations.
constexpr float LEAST_SEEN = constants::disocclusion::LEAST_SEEN;
constexpr float CERTAIN = constants::disocclusion::CERTAIN;
constexpr int FINE_LEVELS = constants::disocclusion::FINE_LEVELS;
constexpr int BEHIND_STEP = constants::disocclusion::BEHIND_STEP;
constexpr float NEVER = constants::matting::NEVER_PX;
constexpr int MOST_LEVELS = constants::native::MOST_LEVELS;
constexpr int MOST_PLANES = constants::native::MOST_PLANES;

// The surfaces of BLOCK x BLOCK pixels where a second one exists or the first differs from the image.
struct Block {
  float *own;     // light of the first surface [channels, BLOCK_PIXELS]
  float *other;   // light of the second surface
  float *coc;     // of the second surface
  float *weight;  // of the second surface
  float *own_weight;  // of the first surface
};

constexpr float TINY = 1.17549435e-38f;  // lower limit where light is the divisor
// Largest channel of a pixel's light; the channels lie `step` values apart.
inline float peak_of(const float *light, size_t step, int channels) {
  float peak = *light;
  for (int c = 1; c < channels; c++) peak = std::max(peak, light[c * step]);
  return peak;
}

// Adds the gradient by that peak, which equal channels share.
inline void add_to_peak(const float *light, size_t step, int channels, float peak, float of_peak, float *of_light) {
  int peaks = 0;
  for (int c = 0; c < channels; c++) peaks += light[c * step] == peak;
  for (int c = 0; c < channels; c++)
    if (light[c * step] == peak) of_light[c * step] += of_peak / peaks;
}

inline int place_in_block(int y, int x) { return y % BLOCK * BLOCK + x % BLOCK; }

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
  int block_of(int y, int x) const { return y / BLOCK * block_columns + x / BLOCK; }
  bool has_block(int i) const { return blocks[i]; }
  Block block(int i) const {
    float *p = blocks[i];
    return {p, p + channels * BLOCK_PIXELS, p + 2 * channels * BLOCK_PIXELS, p + (2 * channels + 1) * BLOCK_PIXELS,
            p + (2 * channels + 2) * BLOCK_PIXELS};
  }
  // Returns a block; creates it from the image if it does not exist yet.
  Block make_block(int i);
  // Surface i at n pixels of a row from column x, within one block column: pointers to each channel, coc and weight
  // (null means 1). Returns false if there is no such surface.
  bool row(int i, int y, int x, const float **light_of, const float *&coc_of, const float *&weight_of) const {
    const size_t at = (size_t)y * width + x;
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

struct Ray {
  int row, column;
  int radius;  // index of the smaller of the two kernels around its radius
  float part;  // interpolation weight of the next larger kernel
  float coc;
};

// A layer and its blur kernel.
struct Kernel {
  int half = 0;
  bool symmetric = true;       // about the vertical axis
  float sum = 0;
  std::vector<float> taps;     // see convolution.cpp
  std::vector<int> first, last;  // range of column offsets with taps for each input row; empty if first > last
};
struct Layer {
  int scale = 1, half = 0;
  double node = 0;
  float before = 0, per_before = 0, at = 0, per_after = 0;  // ends and slopes of the ramps before and after the layer
  bool first = false;
  const torchdof_field_mask *field_mask = nullptr;
  bool spots = false;           // the field mask is 0 at and beyond the edge of its samples
  std::vector<Kernel> kernels;  // 1, or one for each colour
};

// The blur axis of render/layers/layer_weights.py: the position of a signed coc, clamped to [low, high], and its inverse.
constexpr double SQUARE_PX = constants::layer_weights::SQUARE_PX;
constexpr double IN_FOCUS = constants::layer_weights::IN_FOCUS;
template <typename V>
inline V axis(V coc, float low, float high) {
  const V zero = {}, focus = zero + (float)IN_FOCUS, size = most(coc, -coc), x = coc * size / (size + (float)SQUARE_PX);
  return least(most(x - least(most(x, -focus), focus), zero + low), zero + high);
}
inline float coc_at(double node) {
  const double beyond = (std::fabs(node) + IN_FOCUS) / 2;
  return (float)(node == 0 ? 0 : std::copysign(beyond + std::sqrt(beyond * (beyond + 2 * SQUARE_PX)), node));
}

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

// Kernels of highlights, for each radius, and the field's transmittance for some radii.
struct RayKernels {
  const float *const *kernels;
  const int32_t *halves;
  const torchdof_field_mask *field_masks;
  int32_t field_masks_count;
};

struct Job {
  explicit Job(const torchdof_scene &scene);
  void begin();
  void split_mixed();  // matting.cpp

  const torchdof_scene &scene;
  int height, width, channels, colours;  // colours: kernels of each layer, 1 or channels
  std::vector<Layer> layers;
  Surfaces surfaces;
  std::vector<int32_t> radii;  // of highlight kernels, in steps of 1/32 px
  std::vector<Ray> rays;       // sorted by surface and position
  std::vector<float> ray_light;  // [rays, channels]

  // light behind all surfaces at every fourth pixel [channels, behind_height, behind_width]; empty if unknown
  std::vector<float> behind;
  int behind_height = 0, behind_width = 0;
  int levels = 0;  // of the pyramid that fills hidden surfaces

  // Highlight threshold of each cell; the first cell begins before the image.
  std::vector<float> threshold;
  int threshold_rows = 0, threshold_columns = 0, threshold_top = 0, threshold_left = 0;

  Buffer<float> clean_light, clean_coc, validity;  // copies of inputs that had to be changed
  std::vector<Buffer<float>> copies;
  std::vector<float> light_least, light_most;        // of each channel
  Buffer<float> block_low, block_high, block_peak;  // smallest and largest coc and largest light of each block

  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(scene.threads, count, scene.cancelled, body);
  }

 private:
  void take_scene();
  void find_threshold();                  // highlights.cpp
  void fill_hidden();                     // disocclusion.cpp
  void add_background();           // matting.cpp
  void extract_highlights();              // highlights.cpp
};

// Smallest highlight threshold in a block.
float least_threshold(const Job &job, int y0, int x0);
// Highlight threshold of a pixel.
float threshold_at(const Job &job, int y, int x);

// Sums of values [length, count] of pixels over windows along a line; each level has a width, twice that of the level before.
// Pixels on surfaces nearer than that of the window's middle are left out. places: of the pixels, in bins. border.cpp
class WindowSums {
 public:
  static constexpr int WIDTH = constants::border::WIDTH, BINS = constants::border::BINS;
  WindowSums(int length, int count, const double *values, const double *places);
  // Computes the sums [length, count] of a level and, unless null, their derivatives by the place of the window's middle.
  void sum(int level, double *sums, double *slopes = nullptr) const;

 private:
  int length_, count_;
  std::vector<int> bin_;      // lower of each pixel's two bins
  std::vector<double> part_;  // weight of the upper one
  Buffer<double> until_;      // sums from the line's start on, of each bin and all farther ones [length + 1, count, BINS]
};

// The pixels of one surface along one side of the frame; border.cpp
struct BorderLine {
  BorderLine(int length, int channels)
      : image_x(length), x(length), surface(length), places(length), values((size_t)length * (channels + 1)), shares(length, 1.0f) {}
  void set_light(int at, const float *const *light, int channels, float weight, float limit);
  void find_places();
  // Adds gradients by x and image_x, whose pixels lie `step` values apart.
  void gradient(const double *of_places, ptrdiff_t step, float *of_x, float *of_image_x) const;

  std::vector<double> image_x, x;       // positions on the blur axis, of the image and of the surface
  std::vector<double> surface, places;  // accumulated steps of the image; place of each pixel in bins
  std::vector<double> values;           // [length, channels + 1]: weighted light, weight
  std::vector<float> shares;            // of the light below the highlight threshold
  double least, most, per_bin;          // smallest and largest accumulated steps; bins for each
};

// Level l of the means beyond the border is for a distance of 2^l pixels: the level at or below a distance, the fraction of
// the way to the next one, and the number of levels for distances up to this one.
struct Octave {
  int level = 0;
  float part;
  explicit Octave(int distance) {
    while (2 << level <= distance) level++;
    part = (float)distance / (1 << level) - 1.0f;
  }
  int levels() const { return level + 2; }
};

// Estimate of the light beyond the frame; border.cpp
class Border {
 public:
  enum Side { TOP, BOTTOM, LEFT, RIGHT };
  Border() = default;
  Border(int height, int width, int channels, int surfaces, int farthest);
  // Computes the means along a line.
  void set(Side side, int surface, const BorderLine &line);
  // Light of a surface at a position beyond the frame; nearest: light of the nearest pixel inside.
  float light(int surface, int channel, int y, int x, float nearest) const {
    if (dark_) return 0;
    const int far = y < 0 ? -y : std::max(y - height_ + 1, 0), across = x < 0 ? -x : std::max(x - width_ + 1, 0);
    const int at_y = std::clamp(y, 0, height_ - 1), at_x = std::clamp(x, 0, width_ - 1);
    float from_row = 0, from_column = 0, share = 1;
    if (far) {
      const Side side = y < 0 ? TOP : BOTTOM;
      from_row = mean(side, surface, channel, far, at_x);
      share = shares_[side][(size_t)surface * width_ + at_x];
    }
    if (across) {
      const Side side = x < 0 ? LEFT : RIGHT;
      from_column = mean(side, surface, channel, across, at_y);
      share = shares_[side][(size_t)surface * height_ + at_y];
    }
    const float on = !across ? from_row : !far ? from_column : (from_row * far + from_column * across) / (far + across);
    return 0.5f * (nearest * share + on);
  }
  // Mean of the light at n positions in a line away from the frame; the line covers rows or columns y, x to + n - 1.
  float mean_light(int surface, int channel, int y, int x, int n, float nearest) const {
    if (dark_) return 0;
    const bool upright = y >= 0 && y < height_;
    const int first = upright ? x : y, size = upright ? width_ : height_, place = upright ? y : x;
    const Side side = upright ? (first < 0 ? LEFT : RIGHT) : first < 0 ? TOP : BOTTOM;
    const int nearest_distance = first < 0 ? 1 - first - n : first - size + 1;
    float on = 0;
    for (int i = 0; i < n; i++) on += mean(side, surface, channel, nearest_distance + i, place);
    return 0.5f * (nearest * shares_[side][(size_t)surface * length(side) + place] + on / n);
  }
  // Overwrites n pixels of a row above or below the frame with the estimate.
  void continue_row(int surface, int channel, int y, int x, int n, float *row) const;

 private:
  friend Border border_of(const Job &job, int farthest);
  int length(Side side) const { return side <= BOTTOM ? width_ : height_; }
  size_t start(Side side, int surface, int channel, int level) const {
    return ((size_t)(surface * channels_ + channel) * levels_ + level) * length(side);
  }
  float mean(Side side, int surface, int channel, int distance, int at) const {
    const float part = part_of_[distance];
    const float *nearer = means_[side].data() + start(side, surface, channel, level_of_[distance]) + at, *farther = nearer + length(side);
    return *nearer + part * (*farther - *nearer);
  }
  int height_ = 0, width_ = 0, channels_ = 0, levels_ = 0;
  // for each distance beyond the frame: level of the means, and fraction of the way to the next level
  std::vector<int> level_of_;
  std::vector<float> part_of_;
  bool dark_ = false;  // the light beyond the frame is 0
  // for each side [surfaces, length]: share of the border's light below the highlight threshold
  std::vector<float> shares_[4];
  // for each side [surfaces, channels, levels, length]; level l holds means for distance 2^l pixels
  std::vector<float> means_[4];
};
Border border_of(const Job &job, int farthest);

// Where surfaces may block the rays of highlights; highlights.cpp
struct Visibility {
  static constexpr int CLASSES = 62;  // of coc; one bit for each
  struct Cell {
    uint64_t classes = 0;     // classes of coc in the cell
    uint64_t remainders = 0;  // remainders modulo 64 of the bins before its coc
  };
  float low = 0, class_width = 1;
  std::vector<int> bins;  // bins of 1 px of coc that may contain a surface, or whose previous bin may
  int cell_rows = 0, cell_columns = 0;
  std::vector<Cell> cells;  // those that a ray may cross
  // Classes that may contain a surface of a bin or of the bin before.
  uint64_t classes_of(int bin) const {
    const int first = std::min((int)(std::max(0, bin - 1) / class_width), CLASSES - 1), last = std::min((int)((bin + 1) / class_width), CLASSES - 1);
    return (2ull << last) - (1ull << first);
  }
  // Remainders of a bin and of the bin before, as a cell with a surface of the bin has them.
  static uint64_t remainders_of(int bin) { return 1ull << bin % 64 | 1ull << (bin + 63) % 64; }
  // Whether a cell may contain a surface of a bin. Classes alone would accept a distant coc of the same class, remainders
  // alone a coc that is 64 px away.
  bool may_show(const Cell &cell, uint64_t classes, uint64_t remainders) const {
    return (cell.classes & classes) != 0 && (cell.remainders & remainders) != 0;
  }
};
Visibility find_visibility(const Job &job, const RayKernels &kernels);
// Adds the light of rays to a tile [channels, TILE, TILE].
void splat(const Job &job, const Visibility &visibility, int y0, int x0, const int *rays, int count,
           const RayKernels &kernels, const std::vector<float> &gains, float *tile);
// For each ray and colour the gain that keeps a kernel's sum after masking by the field [rays, colours]; 0: the kernel
// is not masked. Empty if the lens has no field.
std::vector<float> gains_of(const Job &job, const RayKernels &kernels);

// The node before each pixel of each surface, and the layers that occur in each cell.
struct LayerIndex {
  float low, high;            // first and last node
  int words, rows, columns;   // words of `bits` for each cell; number of cells
  std::vector<uint64_t> bits;    // layers that occur in each cell, one bit for each
  std::vector<uint8_t> single;   // cells in which every pixel shows only the first surface
  std::vector<uint8_t> mixed;    // cells with mixed pixels whose farther surface continues behind the nearer one
  std::vector<Buffer<uint16_t>> intervals;

  const uint64_t *cell(size_t i) const { return &bits[i * words]; }
  // The node before all pixels of a cell, or -1 if there are several.
  int only_interval(size_t i) const;
  // Position on the blur axis.
  template <typename V>
  V place(V coc) const { return axis(coc, low, high); }
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
  // For each interval between nodes: whether a layer of this scale blurs it, whether it lies behind one of them, and the
  // interval that represents it.
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

// Size of the block of output pixels computed at once.
constexpr int STRIP_ROWS = 4, STRIP_COLUMNS = 2 * LANES, STRIP = STRIP_ROWS * STRIP_COLUMNS;
Kernel make_kernel(const float *values, int half, bool one_sided);

// Transmittance of the lens's field over a blur kernel at one position in the frame; see optics/placed_kernels.py.
class FieldMask {
 public:
  static constexpr int ROWS = constants::field::BLOCK[0], COLUMNS = constants::field::BLOCK[1];
  static constexpr float LEAST = constants::placed_kernels::MIN_LIGHT;

  // For the samples a, or the mix of a and b with weight `part` of b. y, x: position in half diagonals from the centre.
  FieldMask(const torchdof_scene &scene, const torchdof_field_mask &a, const torchdof_field_mask *b, float part, int colour, float y, float x)
      : squeeze_(scene.squeeze), part_(part), both_(b != nullptr) {
    x += ASIDE;
    const float distance = std::sqrt(y * y + x * x), place = std::min(distance, 1.0f) * (scene.distances - 1);
    const int low = std::min((int)place, scene.distances - 2);
    const float near = place - low;
    down_ = y / distance;
    right_ = x / distance;
    const torchdof_field_mask *const of[2] = {&a, b};
    float box[3] = {};
    for (int k = 0; k <= both_; k++) {
      const float *p = of[k]->boxes + 3 * low, weight = both_ ? k ? part : 1.0f - part : 1.0f;
      for (int i = 0; i < 3; i++) box[i] += weight * (p[i] + near * (p[3 + i] - p[i]));
    }
    middle_ = box[0], length_ = box[1], width_ = box[2];
    for (int k = 0; k <= both_; k++) {
      Samples &s = samples_[k];
      const int rows = of[k]->rows, count = rows * of[k]->columns;
      s.columns = of[k]->columns;
      s.near = near;
      s.last_row = (float)(rows - 1);
      s.last_column = (float)(s.columns - 1);
      s.per_u = s.last_row / (2.0f * box[1]);
      s.first_u = 0.5f * s.last_row - box[0] * s.per_u;
      s.per_v = s.last_column / box[2];
      s.values = of[k]->values + ((size_t)(of[k]->colours > 1 ? colour : 0) * scene.distances + low) * count;
      s.next = s.values + count;
    }
  }
  // Transmittance at offsets from the kernel's centre.
  vec transmittance(vec dy, vec dx) const {
    const vec across = dx * squeeze_, u = dy * down_ + across * right_, v = size_of(across * down_ - dy * right_), first = samples_[0].at(u, v);
    return both_ ? (1.0f - part_) * first + part_ * samples_[1].at(u, v) : first;
  }
  // Range of rows of a column that the samples cover.
  void rows_of(float dx, float &low, float &high) const {
    const float across = dx * squeeze_;
    low = -FAR, high = FAR;
    auto within = [&](float per_row, float from, float to) {
      if (std::fabs(per_row) < ASIDE) return;
      low = std::max(low, std::min(from / per_row, to / per_row));
      high = std::min(high, std::max(from / per_row, to / per_row));
    };
    within(down_, middle_ - length_ - across * right_, middle_ + length_ - across * right_);
    within(right_, across * down_ - width_, across * down_ + width_);
  }

 private:
  static constexpr float ASIDE = 1e-6f, FAR = 1e6f;
  struct Samples {
    const float *values, *next;  // samples at the field distances before and after the position
    int columns;
    float near, last_row, last_column, per_u, first_u, per_v;
    vec at(vec u, vec v) const {
      // NaN becomes 0
      const vec row = least(most(u * per_u + first_u, vec{}), all(last_row)), column = least(most(v * per_v, vec{}), all(last_column));
      const ivec i = convert(least(row, all(last_row - 1.0f))), j = convert(least(column, all(last_column - 1.0f)));
      const vec down = row - convert(i), right = column - convert(j);
      const ivec first = i * columns + j;
      vec mean[2];
      for (int k = 0; k < 2; k++) {
        const float *p = k ? next : values;
        vec corner[4];
        for (int lane = 0; lane < LANES; lane++) {
          const float *from = p + first[lane];
          corner[0][lane] = from[0], corner[1][lane] = from[1], corner[2][lane] = from[columns], corner[3][lane] = from[columns + 1];
        }
        const vec upper = corner[0] + right * (corner[1] - corner[0]), lower = corner[2] + right * (corner[3] - corner[2]);
        mean[k] = upper + down * (lower - upper);
      }
      return clamp01(mean[0] + near * (mean[1] - mean[0]));
    }
  };
  Samples samples_[2];
  float squeeze_, part_, down_, right_, middle_, length_, width_;
  bool both_;
};
inline float per_half_diagonal(const torchdof_scene &scene) {
  return 2.0f / std::sqrt((float)scene.height * scene.height + (float)scene.width * scene.width);
}
// Whether a field mask is 0 at the edge of its samples.
bool ends_dark(const torchdof_field_mask &mask, int distances);
// Multiplies a layer's kernel by the field's transmittance and restores its sum.
void mask_kernel(const Layer &layer, int colour, const FieldMask &turned, Kernel &cut);
// Occupancy of rows is recorded as one bit for every MARKED columns; this is the bit of column x.
constexpr int MARKED = 8;
inline uint32_t mark(int x) { return 1u << std::min(x / MARKED, 31); }
// The bits of the columns from first to last.
inline uint32_t marks(int first, int last) { return (mark(last) | (mark(last) - 1)) & ~(mark(first) - 1); }
// The bits of the input columns of a strip at output column x.
inline uint32_t strip_inputs(int x, int half) { return marks(x, x + STRIP_COLUMNS - 1 + 2 * half); }
// Convolves rows (`pitch` values apart) with a kernel: out [STRIP_ROWS, STRIP_COLUMNS]. The input begins `half` rows
// and columns before the output. Input row i is skipped if rows[i] has none of the bits of `columns`.
void convolve_strip(const float *in, int pitch, const uint32_t *rows, uint32_t columns, const Kernel &kernel, float *out);

// Mean change of coc between neighbours, horizontal plus vertical; plan.cpp
double mean_change(const float *coc, int height, int width, int threads);

// Smallest and largest value of each block of a band of blocks, whose rows are read in memory order; engine.cpp
void ends_of(const float *values, int width, int rows, float *low, float *high);

// Smallest and largest value; both NaN if any value is NaN.
void find_ends(const float *values, int64_t count, int threads, float *low, float *high);

void composite(const Job &job, const RayKernels &ray_kernels, float *out);

// Calls the body of a function of api.h, and returns its status.
template <typename Body>
int32_t guarded(const Body &body) {
  try {
    body();
    return TORCHDOF_OK;
  } catch (const Cancelled &) {
    return TORCHDOF_CANCELLED;
  } catch (const TooBright &) {
    return TORCHDOF_TOO_BRIGHT;
  } catch (const std::bad_alloc &) {
    return TORCHDOF_NO_MEMORY;
  } catch (const std::length_error &) {
    return TORCHDOF_NO_MEMORY;
  }
}

}  // namespace torchdof
