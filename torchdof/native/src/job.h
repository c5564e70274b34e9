// A rendering: its scene, and what its steps make of it.
#pragma once
#include <cstdint>
#include <vector>

#include "api.h"
#include "layers.h"
#include "memory.h"
#include "surfaces.h"
#include "threads.h"

namespace torchdof {

struct Ray {
  int row, column;
  int radius;  // index of the smaller of the two kernels around its radius
  float part;  // interpolation weight of the next larger kernel
  float coc;
};

struct Job {
  explicit Job(const torchdof_scene &scene);
  void begin();
  void split_mixed();  // matting.cpp

  const torchdof_scene &scene;
  int height, width, channels, colours;  // colours: kernels of each layer, 1 or channels
  std::vector<Layer> layers;
  Surfaces surfaces;
  std::vector<int32_t> radii;    // of highlight kernels, in steps of 1/32 px
  std::vector<Ray> rays;         // sorted by surface and position
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
  std::vector<float> light_least, light_most;       // of each channel
  Buffer<float> block_low, block_high, block_peak;  // smallest and largest coc and largest light of each block

  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(scene.threads, count, scene.cancelled, body);
  }

 private:
  void take_scene();
  void clean_inputs();
  void find_extremes();
  void copy_masked_blocks();
  void find_threshold();      // highlights.cpp
  void fill_hidden();         // disocclusion.cpp
  void add_background();      // matting.cpp
  void extract_highlights();  // highlights.cpp
};

}  // namespace torchdof
