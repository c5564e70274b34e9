// Estimate of the light beyond the frame's border.
#pragma once
#include <algorithm>
#include <cstddef>
#include <vector>

#include "constants/border.h"
#include "memory.h"

namespace torchdof {

struct Job;

// Sums of values [length, count] of pixels over windows along a line; each level has a width, twice that of the level
// before. Pixels on surfaces nearer than that of the window's middle are left out. places: of the pixels, in bins.
// border.cpp
class WindowSums {
 public:
  static constexpr int WIDTH = constants::border::WIDTH, BINS = constants::border::BINS;
  WindowSums(int length, int count, const double *values, const double *places);
  // Computes the sums [length, count] of a level and, unless null, their derivatives by the place of the window's
  // middle.
  void sum(int level, double *sums, double *slopes = nullptr) const;

 private:
  int length_, count_;
  std::vector<int> bin_;      // lower of each pixel's two bins
  std::vector<double> part_;  // weight of the upper one
  Buffer<double> until_;  // sums from the line's start on, of each bin and all farther ones [length + 1, count, BINS]
};

// The pixels of one surface along one side of the frame; border.cpp
struct BorderLine {
  BorderLine(int length, int channels)
      : image_x(length), x(length), surface(length), places(length), values((size_t)length * (channels + 1)),
        shares(length, 1.0f) {}
  void set_light(int at, const float *const *light, int channels, float weight, float limit);
  void find_places();
  // Adds gradients by x and image_x, whose pixels lie `step` values apart.
  void gradient(const double *d_places, ptrdiff_t step, float *d_x, float *d_image_x) const;

  std::vector<double> image_x, x;       // positions on the blur axis, of the image and of the surface
  std::vector<double> surface, places;  // accumulated steps of the image; place of each pixel in bins
  std::vector<double> values;           // [length, channels + 1]: weighted light, weight
  std::vector<float> shares;            // of the light below the highlight threshold
  double least, most, per_bin;          // smallest and largest accumulated steps; bins for each
};

// Level l of the means beyond the border is for a distance of 2^l pixels: the level at or below a distance, the
// fraction of the way to the next one, and the number of levels for distances up to this one.
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
    const float *nearer = means_[side].data() + start(side, surface, channel, level_of_[distance]) + at,
                *farther = nearer + length(side);
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

}  // namespace torchdof
